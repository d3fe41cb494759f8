"""Clips, labels, flow, surface motion and particles check themselves."""

import numpy as np
import pytest

from fluidlift.types import Label, Particles, PixelFlow, PixelLabels, SurfaceMotion, VideoClip


def frames(t=3):
    return np.zeros((t, 4, 6, 3), np.uint8)


def test_the_interval_is_the_usual_time_between_frames():
    clip = VideoClip(frames(4), np.array([0.0, 0.04, 0.08, 0.5]))
    assert clip.interval == pytest.approx(0.04)  # one long gap does not count
    assert clip.size == (6, 4) and len(clip) == 4


@pytest.mark.parametrize("times", [[0, 1], [0, 1, 1], [0, 2, 1], [0, np.nan, 1]], ids=str)
def test_every_frame_has_a_later_time_than_the_one_before(times):
    with pytest.raises(ValueError, match="times"):
        VideoClip(frames(), np.array(times, float))


@pytest.mark.parametrize(
    "array", [frames()[..., :1], frames()[0], frames().astype(float)], ids=["gray", "one", "float"]
)
def test_frames_are_bytes_in_three_colours(array):
    with pytest.raises(ValueError, match="frames"):
        VideoClip(array, np.arange(len(array)) * 0.04)


def test_labels_split_into_fluid_and_solid():
    labels = np.array([[[Label.FLUID, Label.SOLID, Label.BACKGROUND]]], np.uint8)
    found = PixelLabels(labels, np.ones_like(labels, float))
    np.testing.assert_array_equal(found.fluid, [[[True, False, False]]])
    np.testing.assert_array_equal(found.solid, [[[False, True, False]]])
    with pytest.raises(ValueError, match="shapes"):
        PixelLabels(labels, np.ones((1, 1, 2)))
    with pytest.raises(ValueError, match="labels"):
        PixelLabels(labels.astype(int), np.ones((1, 1, 3)))


def test_flow_has_one_confidence_per_displacement():
    assert len(PixelFlow(np.zeros((2, 4, 6, 2)), np.zeros((2, 4, 6)))) == 2
    with pytest.raises(ValueError, match="displacement"):
        PixelFlow(np.zeros((2, 4, 6, 3)), np.zeros((2, 4, 6)))
    with pytest.raises(ValueError, match="confidence"):
        PixelFlow(np.zeros((2, 4, 6, 2)), np.zeros((1, 4, 6)))


def test_surface_motion_has_one_velocity_per_point():
    with pytest.raises(ValueError, match="velocities"):
        SurfaceMotion(np.zeros((5, 3)), np.zeros((4, 3)), np.zeros(5, bool))


def test_particles_at_rest_are_undeformed_with_ids_in_order():
    p = Particles.at_rest(np.zeros((3, 3)), 2.0, first_id=10)
    np.testing.assert_array_equal(p.deformation, np.broadcast_to(np.eye(3), (3, 3, 3)))
    np.testing.assert_array_equal(p.ids, [10, 11, 12])
    assert (p.velocities == 0).all() and (p.affine == 0).all() and (p.masses == 2).all()


def test_joined_particles_keep_order_and_selected_ones_their_ids():
    a, b = Particles.at_rest(np.zeros((2, 3)), 1.0), Particles.at_rest(np.ones((2, 3)), 3.0, first_id=2)
    both = a.joined(b)
    np.testing.assert_array_equal(both.ids, [0, 1, 2, 3])
    np.testing.assert_array_equal(both.select(both.masses > 2).ids, [2, 3])
    with pytest.raises(ValueError, match="masses"):
        Particles(
            *(getattr(a, k) for k in ("positions", "velocities", "affine", "deformation")),
            a.masses[:1],
            a.source,
            a.ids,
        )
