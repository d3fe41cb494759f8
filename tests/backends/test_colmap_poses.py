"""Poses of a camera on a known path."""

import sys

import numpy as np
import pytest

from fluidlift.errors import MissingPackage
from fluidlift.synthetic.riverside import walk
from fluidlift.types import CameraPath, PinholeCamera

SIZE, FRAMES = (320, 208), 30


def tracks_of(cameras, *, noise: float = 0.2, lost: float = 0.3) -> np.ndarray:
    """Places [n,t,2] of points of a valley, px, each seen by a part of the frames; 5 % of them move on their own."""
    rng = np.random.default_rng(0)
    points = np.stack([rng.uniform(-6, 6, 500), rng.uniform(3, 25, 500), rng.uniform(0, 5, 500)], axis=-1)
    places = np.full((len(points), len(cameras), 2), np.nan)
    for t, camera in enumerate(cameras):
        moved = points + np.where(np.arange(len(points)) % 20 == 0, 0.05 * t, 0.0)[:, None]
        uv, _ = camera.project(moved)
        seen = (uv > 0).all(axis=1) & (uv < SIZE).all(axis=1)
        places[seen, t] = uv[seen] + rng.normal(0.0, noise, uv[seen].shape)
    for i in np.flatnonzero(rng.random(len(points)) < lost):
        places[i, rng.integers(5, len(cameras)) :] = np.nan
    return places


def errors(path: CameraPath, cameras) -> tuple[float, float]:
    """Largest error of rotation, degrees, and of place, as a part of the way, after alignment to the middle frame."""
    turns = np.stack([c.camera_from_world.rotation for c in cameras])
    places = np.stack([c.position for c in cameras])
    middle = len(cameras) // 2
    align = turns[middle].T @ path.rotations[middle]
    off = [np.trace(r @ align.T @ t.T) for r, t in zip(path.rotations, turns)]
    way, true = (path.centers - path.centers[middle]) @ align.T, places - places[middle]
    scale = (way * true).sum() / (way**2).sum()
    rotation = np.degrees(np.arccos(np.clip((np.array(off) - 1) / 2, -1, 1))).max()
    return rotation, np.linalg.norm(scale * way - true, axis=1).max() / np.linalg.norm(places[-1] - places[0])


@pytest.mark.parametrize("route", ["forward", "sideways"])
@pytest.mark.parametrize("told", [True, False])
def test_the_path_is_found(route, told):
    pytest.importorskip("pycolmap")
    from fluidlift.backends.colmap_poses import ColmapPoses

    cameras = walk(route, FRAMES, size=SIZE)
    guess = cameras[0].focal[0] if told else PinholeCamera.from_fov(50.0, SIZE).focal[0]
    path = ColmapPoses().solve(tracks_of(cameras), SIZE, guess, told=told)
    assert path is not None and path.error_px < 0.3
    rotation, place = errors(path, cameras)
    assert rotation < 0.5 and place < 0.02
    assert path.focal == pytest.approx(cameras[0].focal[0], rel=1e-9 if told else 0.15)


def test_a_camera_that_only_turns_has_no_path():
    pytest.importorskip("pycolmap")
    from fluidlift.backends.colmap_poses import ColmapPoses

    cameras = walk("turning", FRAMES, size=SIZE)
    path = ColmapPoses().solve(tracks_of(cameras), SIZE, cameras[0].focal[0], told=True)
    if path is not None:  # whatever way it found, it is one of noise: nothing beside the depth of the scene
        way = np.linalg.norm(path.centers[-1] - path.centers[0])
        assert way < 0.01 * np.median(np.linalg.norm(path.points, axis=1))


def test_without_the_package_the_remedy_is_said(monkeypatch):
    from fluidlift.backends.colmap_poses import ColmapPoses

    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(MissingPackage, match=r"fluidlift\[camera\]"):
        ColmapPoses()
