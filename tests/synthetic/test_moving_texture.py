"""The moving texture does what its truth says, and each hard situation changes what it names and nothing else."""

import cv2
import numpy as np
import pytest

from fluidlift.synthetic.moving_texture import FLOWS, Situation, carried, moving_texture

STILL = Situation(noise=0.0)


def interior(mask: np.ndarray) -> np.ndarray:
    """Pixels whose neighbourhood is fluid, away from the border: sampling there does not look at the banks."""
    kernel = np.ones((11, 11), np.uint8)
    return cv2.erode(mask.astype(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0


@pytest.mark.parametrize("name", FLOWS)
def test_the_next_frame_read_at_the_true_places_is_this_frame(name):
    clip = moving_texture(name, frames=5, situation=STILL)
    h, w = clip.mask.shape[1:]
    u, v = np.meshgrid(np.arange(w, dtype=np.float32), np.arange(h, dtype=np.float32))
    for t, flow in enumerate(clip.flow):
        back = cv2.remap(clip.frames[t + 1], u + flow[..., 0], v + flow[..., 1], cv2.INTER_CUBIC)
        still_in = (u + flow[..., 0] < w - 6) & interior(clip.mask[t])
        error = np.abs(back.astype(float) - clip.frames[t])[still_in].mean()
        moved = np.abs(clip.frames[t + 1].astype(float) - clip.frames[t])[still_in].mean()
        # rounding to grey levels twice and cubic sampling of grains of 5 px: about 1 level, against some 30 unmoved
        assert error < 1.5 and moved > 8 * error


def test_the_channels_keep_their_volume():
    # d_u v_u + d_v v_v of the formulas by central differences, away from the kink at the banks
    for name in FLOWS:
        velocity, inside = FLOWS[name]((128, 96), 3.0)
        points = np.random.default_rng(0).uniform([10, 10], [118, 86], (500, 2))
        points = points[inside(points + [0, 1]) & inside(points - [0, 1])]
        step = 1e-4
        terms = [
            (velocity(points + e) - velocity(points - e))[:, a] / (2 * step) for a, e in enumerate(step * np.eye(2))
        ]
        assert len(points) > 50
        np.testing.assert_allclose(sum(terms), 0.0, atol=1e-6)


def test_fluid_goes_forth_and_comes_back():
    velocity, _ = FLOWS["vortex"]((128, 96), 5.0)
    points = np.random.default_rng(1).uniform(20, 80, (50, 2))
    there = carried(velocity, points, 6)
    # fourth order with steps of 2.5 px about a core of 19 px
    np.testing.assert_allclose(carried(velocity, there, -6), points, atol=1e-2)
    assert np.linalg.norm(there - points, axis=-1).max() > 10


def test_the_same_seed_gives_the_same_clip_and_another_one_another():
    one, two, other = (moving_texture(frames=2, seed=s) for s in (0, 0, 1))
    np.testing.assert_array_equal(one.frames, two.frames)
    assert (one.frames != other.frames).mean() > 0.5


def test_a_sparse_stream_is_dark_between_patches_of_the_share_asked_for():
    clip = moving_texture("uniform", frames=3, situation=Situation(noise=0.0, textured=0.4))
    bare = clip.mask & ~clip.textured
    share = clip.textured.sum() / clip.mask.sum()
    assert 0.25 < share < 0.55  # few patches fit into a picture, so their share varies
    assert clip.frames[bare].std(axis=0).max() < 1e-6 and clip.frames[clip.textured].std(axis=0).min() > 10


def test_exposure_changes_every_pixel_alike():
    plain = moving_texture(frames=4, situation=STILL).frames.astype(float)
    ramp = moving_texture(frames=4, situation=Situation(noise=0.0, brightness=0.05)).frames.astype(float)
    ratio = ramp.sum(axis=(1, 2, 3)) / plain.sum(axis=(1, 2, 3))
    np.testing.assert_allclose(ratio, 1 + 0.05 * (np.arange(4) - 2), atol=0.01)  # 8 bit, and the brightest are cut


def test_glints_cover_their_share_and_stay_in_place():
    clip = moving_texture("vortex", frames=6, situation=Situation(noise=0.0, highlights=0.1))
    white = clip.frames.min(axis=-1) > 210
    assert 0.03 < white.mean() < 0.25
    both = (white[:-1] & white[1:]).sum() / white[:-1].sum()
    assert both > 0.3  # of a pattern that moves 3 px with grains of 10 px flickering, more stays than leaves
    assert not (clip.textured & white).any()


def test_a_shaken_camera_moves_the_ground_by_what_it_says():
    clip = moving_texture("uniform", frames=4, size=(128, 96), situation=Situation(noise=0.0, shake=2.0))
    grey = clip.frames[..., 1].astype(np.float32)
    strip = slice(None), slice(0, 16), slice(None)  # ground above the channel
    for t in range(1, 4):
        (du, dv), _ = cv2.phaseCorrelate(grey[strip][0], grey[strip][t], cv2.createHanningWindow((128, 16), cv2.CV_32F))
        # phase correlation of a strip 16 px high finds whole pixels surely, parts roughly
        np.testing.assert_allclose([du, dv], clip.shift[t] - clip.shift[0], atol=1.0)


def test_a_front_advances_at_the_speed_of_the_fluid():
    clip = moving_texture("uniform", frames=6, speed=4.0, situation=Situation(front=True))
    tip = np.array([np.flatnonzero(m.any(axis=0)).max() for m in clip.mask])
    np.testing.assert_allclose(np.diff(tip), 4.0)


def test_wrong_requests_are_refused():
    for bad in ({"name": "river"}, {"frames": 1}, {"situation": Situation(textured=1.5)}):
        with pytest.raises(ValueError):
            moving_texture(**bad)
