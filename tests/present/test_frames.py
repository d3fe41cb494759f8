"""What stands behind the terrain in pictures of frames."""

from dataclasses import replace

import numpy as np
import pytest

from fluidlift.present.frames import FrameRenderer, SimulatedFrame
from fluidlift.types import PinholeCamera, RigidTransform


@pytest.mark.parametrize(("kind", "grey", "dim"), [("plume", 0.8, True), ("plume", 0.2, False), ("stream", 0.8, False)])
def test_pale_smoke_is_shown_before_a_dim_sky(channel, kind, grey, dim):
    scene = channel(2, kind=kind)
    scene = replace(scene, rest=replace(scene.rest, sh=np.full_like(scene.rest.sh, (grey - 0.5) / 0.2820948)))
    up = PinholeCamera((96.0, 96.0), (32.0, 24.0), (64, 48), RigidTransform(np.eye(3), -np.array([0.6, 0.4, 2.4])))
    frame = SimulatedFrame(scene.rest, np.zeros((len(scene.rest), 3)))
    sky = FrameRenderer(scene, None).draw(frame, up, "terrain").shown
    assert np.ptp(sky.mean(axis=-1), axis=1).max() < 1e-6  # nothing else is seen
    contrast = abs(float(sky.mean()) - grey)
    assert contrast > (0.4 if dim or grey < 0.5 else 0.0) and (float(sky.mean()) < 0.4) == dim


def test_the_motion_in_the_picture_is_drawn_with_it(channel):
    scene = channel(2)
    renderer = FrameRenderer(scene, None)
    velocity = np.tile([0.5, 0.0, 0.0], (len(scene.rest), 1))
    frame = SimulatedFrame(scene.rest, velocity)
    alone, nothing = renderer.measured(frame, moving=False)
    both, motion = renderer.measured(frame, moving=True)
    assert nothing is None and motion is not None
    for name in ("image", "depth", "alpha"):
        np.testing.assert_array_equal(getattr(both, name), getattr(alone, name))
    known = np.isfinite(motion).all(axis=-1)
    np.testing.assert_array_equal(known, alone.alpha > 0.3)
    before, _ = scene.camera.project(scene.rest.means)
    after, _ = scene.camera.project(scene.rest.means + scene.interval * velocity)
    steps = after - before
    # a pixel shows a mean of splats: no further than they
    for axis in range(2):
        low, high = steps[:, axis].min(), steps[:, axis].max()
        assert low - 1e-3 <= motion[known][:, axis].min() and motion[known][:, axis].max() <= high + 1e-3
    assert np.abs(steps).max() > 0.1 and known.mean() > 0.01


def test_splats_that_are_not_drawn_change_nothing(channel):
    scene = channel(2)
    renderer, rest = FrameRenderer(scene, None), scene.rest
    half = np.arange(len(rest)) % 2 == 0
    faint = replace(rest, opacities=np.where(half, rest.opacities, np.float32(0.002)))
    velocity = np.tile([0.5, 0.0, 0.0], (len(rest), 1))
    frames = SimulatedFrame(faint, velocity), SimulatedFrame(rest.select(half), velocity[half])
    (all_of_them, motion), (some, other) = (renderer.measured(f, moving=True) for f in frames)
    for name in ("image", "depth", "alpha"):
        np.testing.assert_array_equal(getattr(all_of_them, name), getattr(some, name))
    np.testing.assert_array_equal(motion, other)
    assert some.alpha.max() > 0.5
