"""Foam on clear water: what a film shows brighter than its surface could mirror, from wherever it is looked at."""

import cv2
import numpy as np
import pytest

from fluidlift.look.environment import Environment
from fluidlift.look.liquid import SurfaceBuffer
from fluidlift.look.materials import HONEY, MUDDY_WATER, WATER
from fluidlift.look.surface_foam import ALBEDO, BROAD, DARKEST_WHITE, FINE, FilmedWhite, _smoothed, with_foam
from fluidlift.types import PinholeCamera

SIZE = (64, 48)
INDEX = WATER.refractive_index


def plane(camera: PinholeCamera, normal: np.ndarray, through: np.ndarray, color: np.ndarray) -> SurfaceBuffer:
    """A surface that fills the picture, with a colour for each pixel."""
    rays = camera.rays(camera.pixel_grid())
    depth = ((through - camera.position) @ normal) / (rays @ normal)
    shape = depth.shape
    return SurfaceBuffer(
        np.maximum(depth, 0.0), np.broadcast_to(normal, (*shape, 3)), np.ones(shape),
        np.broadcast_to(color, (*shape, 3)), np.ones(shape),
    )  # fmt: skip


def looking_at(elevation: float) -> PinholeCamera:
    """From 5 m away, so many degrees above the horizon."""
    up = np.radians(elevation)
    return PinholeCamera.looking(5.0 * np.array([-np.cos(up), 0.0, np.sin(up)]), np.zeros(3), 20.0, SIZE)


FLAT, UPRIGHT = np.array([0.0, 0.0, 1.0]), np.array([-1.0, 0.0, 0.0])


def middle(cover: np.ndarray) -> float:
    return float(cover[20:28, 28:36].mean())


def test_a_fall_is_white_and_as_bright_a_mirror_image_on_a_river_is_not():
    camera = looking_at(12.0)
    white = FilmedWhite(camera.position, 0.6)
    fall, river = (plane(camera, n, np.zeros(3), np.full(3, 0.55)) for n in (UPRIGHT, FLAT))
    assert middle(white.cover(fall, camera, INDEX)) > 0.95
    assert middle(white.cover(river, camera, INDEX)) == 0.0
    dark = plane(camera, UPRIGHT, np.zeros(3), np.full(3, 0.1))
    brown = plane(camera, UPRIGHT, np.zeros(3), np.array([0.6, 0.4, 0.1]))
    assert middle(white.cover(dark, camera, INDEX)) == middle(white.cover(brown, camera, INDEX)) == 0.0


def test_what_it_mirrors_is_judged_from_where_the_clip_was_filmed():
    """From above nothing is mirrored, but the colours are those that the clip's camera saw."""
    above, flat = looking_at(85.0), looking_at(12.0)
    seen = plane(above, FLAT, np.zeros(3), np.full(3, 0.55))
    assert middle(FilmedWhite(flat.position, 0.6).cover(seen, above, INDEX)) == 0.0
    assert middle(FilmedWhite(above.position, 0.6).cover(seen, above, INDEX)) > 0.95


def test_bumps_of_the_surface_are_none_of_the_face_of_a_fall():
    camera = looking_at(12.0)
    river = plane(camera, FLAT, np.zeros(3), np.full(3, 0.55))
    bumpy = river.normal.copy()
    bumpy[:, ::2, 0], bumpy[:, 1::2, 0] = -0.6, 0.6
    bumpy /= np.linalg.norm(bumpy, axis=-1, keepdims=True)
    rough = SurfaceBuffer(river.depth, bumpy, river.thickness, river.albedo, river.covered)
    assert middle(FilmedWhite(camera.position, 0.6).cover(rough, camera, INDEX)) < 0.05


def test_white_is_the_brightest_fifth_of_the_fluid_and_no_dark_river_has_any():
    camera, colors = looking_at(12.0), np.zeros((10, 3))
    colors[7:] = 1.0
    assert FilmedWhite.of(camera, colors).white == pytest.approx(1.0)
    assert FilmedWhite.of(camera, 0.3 * np.ones((10, 3))).white == DARKEST_WHITE
    assert FilmedWhite.of(camera, np.ones((0, 3))).white == 1.0


def test_foam_is_matt_and_hides_as_much_of_the_water_as_it_covers():
    camera = looking_at(30.0)
    surface, image = plane(camera, UPRIGHT, np.zeros(3), np.ones(3)), np.full((48, 64, 3), 0.05, np.float32)
    cover = np.zeros((48, 64), np.float32)
    cover[:, :32], cover[:, 32:40] = 1.0, 0.5
    found = with_foam(image, surface, cover, Environment.white())
    np.testing.assert_allclose(found[:, :32], ALBEDO, atol=0.01)
    np.testing.assert_allclose(found[:, 32:40], 0.5 * (ALBEDO + 0.05), atol=0.01)
    np.testing.assert_array_equal(found[:, 40:], image[:, 40:])


def test_waters_foam_and_honey_does_not():
    assert WATER.foams and MUDDY_WATER.foams and not HONEY.foams


def test_compiled_and_plain_foam_agree_and_a_broad_bell_is_found_in_a_small_picture():
    camera, rng = looking_at(30.0).resized((320, 200)), np.random.default_rng(5)
    depth = rng.uniform(1.0, 2.0, (200, 320)) * (rng.uniform(size=(200, 320)) > 0.2)
    normal = rng.normal(size=(200, 320, 3)) + [0, 0, 2]
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    full = np.ones((200, 320), np.float32)
    surface = SurfaceBuffer(depth, normal, full, rng.uniform(size=(200, 320, 3)), full)
    white = FilmedWhite(np.array([1.0, -1.0, 2.0]), 0.5)
    np.testing.assert_allclose(
        white.cover(surface, camera, 1.333), white.cover_plain(surface, camera, 1.333), atol=1e-5
    )
    for size in ((700, 500), (501, 701)):
        picture = rng.normal(size=(*size, 3))
        picture /= np.linalg.norm(picture, axis=-1, keepdims=True)
        picture = (picture * (np.arange(size[1])[None, :, None] > 200)).astype(np.float32)
        sigma = BROAD * max(size)
        assert sigma > 2 * FINE  # smaller pictures are blurred as they are
        assert np.abs(_smoothed(picture) - cv2.GaussianBlur(picture, (0, 0), sigma)).max() < 0.01
