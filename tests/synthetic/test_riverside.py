"""The made riverside: what its depth and its water claim."""

import numpy as np
import pytest

from fluidlift.synthetic.riverside import WALKS, Riverside, film, walk

SIZE = (48, 32)


@pytest.fixture(scope="module")
def scene():
    return Riverside.make()


def test_depth_leads_to_the_ground_or_to_the_water(scene):
    clip = film(scene, walk("forward", 2, size=SIZE))
    for camera, depth, water in zip(clip.cameras, clip.depth, clip.water):
        seen = np.isfinite(depth)
        points = camera.unproject(camera.pixel_grid()[seen], depth[seen])
        ground = np.maximum(scene.height(points[:, :2]), 0.0)
        assert np.median(np.abs(points[:, 2] - ground)) < 1e-3  # twelve halvings of a step of 4 %
        assert np.abs(points[water[seen], 2]).max() < 0.02
        assert 0.2 < water.mean() < 0.8


def test_water_changes_before_a_camera_that_stands_and_the_ground_does_not(scene):
    clip = film(scene, walk("standing", 2, size=SIZE)[:1] * 2)
    change = np.abs(np.diff(clip.frames.astype(float), axis=0)[0]).mean(axis=-1)
    wet = clip.water[0]
    assert change[wet].mean() > 3 * change[~wet].mean()


@pytest.mark.parametrize("path", WALKS)
def test_a_path_is_what_its_name_says(path):
    cameras = walk(path, 5, size=SIZE, length=1.0)
    way = np.linalg.norm(cameras[-1].position - cameras[0].position)
    turn = cameras[-1].camera_from_world.rotation @ cameras[0].camera_from_world.rotation.T
    angle = np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
    assert way == pytest.approx(1.0 if path in ("forward", "sideways") else 0.0, abs=1e-9)
    assert angle == pytest.approx(10.0, abs=0.1) if path == "turning" else angle < 5.0
