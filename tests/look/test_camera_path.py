"""Cameras that move: around a body, and through keys."""

import numpy as np
import pytest

from fluidlift.look.camera_path import keyed_path, orbit_path
from fluidlift.types import PinholeCamera, ViewKey

CAMERA = PinholeCamera.looking((0.0, -3.0, 1.0), (0.0, 0.0, 0.0), 50.0, (160, 120))
BODY = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-0.4, 0.4) for z in (0.0, 0.3)])


def test_a_turn_sees_the_whole_body_from_one_distance_and_height():
    path = orbit_path(CAMERA, BODY, 12)
    centre = 0.5 * (BODY.min(0) + BODY.max(0))
    away = np.array([c.position - centre for c in path])
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), np.linalg.norm(away[0]), rtol=1e-9)
    np.testing.assert_allclose(away[:, 2], away[0, 2], atol=1e-9)
    for camera in path:
        uv, z = camera.project(BODY)
        assert (z > 0).all() and (uv > 0).all() and (uv < np.array(camera.size)).all()


def test_a_full_turn_ends_one_step_before_its_start_so_that_it_loops():
    path = orbit_path(CAMERA, BODY, 8)
    angles = np.unwrap([np.arctan2(*c.position[1::-1]) for c in path])
    np.testing.assert_allclose(np.diff(angles), np.pi / 4, atol=1e-9)
    half = orbit_path(CAMERA, BODY, 5, turn=180.0)
    np.testing.assert_allclose(half[-1].position[:2], -half[0].position[:2], atol=1e-9)


def test_the_turn_starts_on_the_side_that_the_clip_was_filmed_from():
    first = orbit_path(CAMERA, BODY, 4)[0].position
    assert first[1] < 0 and abs(first[0]) < 1e-9


def test_a_keyed_camera_is_at_its_keys_and_never_beyond_them():
    keys = [
        ViewKey(0, (0, -4, 1), (0, 0, 0), 40),
        ViewKey(4, (2, -4, 1), (0, 0, 0), 50),
        ViewKey(8, (2, -4, 3), (0, 0, 1), 50),
    ]
    path = keyed_path(keys[::-1], 12, (64, 48))
    for key in keys:
        np.testing.assert_allclose(path[int(key.frame)].position, key.eye, atol=1e-9)
    eyes = np.array([c.position for c in path])
    assert eyes[:, 0].max() <= 2 + 1e-9 and eyes[:, 2].max() <= 3 + 1e-9
    np.testing.assert_allclose(eyes[9:], [keys[-1].eye] * 3, atol=1e-9)
    uv, _ = path[4].project(np.zeros((1, 3)))
    np.testing.assert_allclose(uv[0], (32, 24), atol=1e-9)


def test_keys_that_cannot_be_a_path_are_refused():
    key = ViewKey(0, (0, -4, 1), (0, 0, 0), 40)
    with pytest.raises(ValueError, match="one key per frame"):
        keyed_path([key, key], 3, (64, 48))
    with pytest.raises(ValueError, match="at least one"):
        keyed_path([], 3, (64, 48))
