"""The pattern of a surface is carried by the flow, and is not drawn out by it."""

import numpy as np
import pytest

from fluidlift.look.appearance import SteadyShading
from fluidlift.look.seen_texture import SeenTexture
from fluidlift.look.surface_map import SurfaceMap
from fluidlift.look.texture_patches import LIMIT, TexturePatches
from fluidlift.types import Gaussians, PinholeCamera

CELL, SIZE = 0.1, 4.0
CAMERA = PinholeCamera.looking((2.0, 2.0, 10.0), (2.0, 2.0, 0.5), fov_degrees=25.0, size=(128, 128), up=(0.0, 1.0, 0.0))
SPOT = 0.35
"""m, between dark and bright"""


def pattern(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Brightness of a surface that is alike in all directions."""
    rng = np.random.default_rng(5)
    waves = rng.uniform(0, 2 * np.pi, (24, 2))
    k = np.pi / SPOT
    return 0.5 + 0.4 * sum(np.sin(k * (np.cos(a) * x + np.sin(a) * y) + p) for a, p in waves) / np.sqrt(12) / 1.5


def sheet(pitch: float = 0.03, colors=None) -> Gaussians:
    x, y = (a.ravel() for a in np.meshgrid(*[np.arange(0, SIZE, pitch)] * 2, indexing="ij"))
    grey = np.clip(pattern(x, y), 0, 1)[:, None] * np.ones(3) if colors is None else colors(x, y)
    # at one depth, splats would cover their neighbours on one side only
    z = 0.5 + np.random.default_rng(3).uniform(-1e-3, 1e-3, len(x))
    means = np.stack([x, y, z], axis=-1).astype(np.float32)
    return Gaussians.isotropic(means, 0.6 * pitch, grey.astype(np.float32), 0.99)


def surface(flow) -> SurfaceMap:
    x, y, z = np.meshgrid(np.arange(0.025, SIZE, 0.05), np.arange(0.025, SIZE, 0.05), [0.45, 0.5], indexing="ij")
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    velocity = np.stack([*flow(points[:, 0], points[:, 1]), np.zeros(len(points))], axis=-1)
    return SurfaceMap.of(points, velocity, CELL)


def patches_over(flow, frames: int, interval: float = 0.05, body: Gaussians | None = None, radius: float = 0.6):
    where = surface(flow)
    patches = TexturePatches(SeenTexture(sheet() if body is None else body, CAMERA, where), radius)
    for k in range(frames + 1):
        patches.advance(where, interval if k else 0.0, np.random.default_rng([1, k]))
    return patches


def places(count: int = 60, inset: float = 1.2) -> np.ndarray:
    x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(inset, SIZE - inset, count)] * 2, indexing="ij"))
    return np.stack([x, y, np.full_like(x, 0.5)], axis=-1)


def test_at_the_first_instant_the_body_is_seen_as_it_is():
    points = places()
    color, there = patches_over(lambda x, y: (0 * x, 0 * y), 0).colors(points)
    expected = np.clip(pattern(points[:, 0], points[:, 1]), 0, 1)
    # pixels are 3.3 cm wide, a tenth of the pattern's half wave
    assert there.all() and np.abs(color[:, 0] - expected).mean() < 0.02


def test_a_flow_without_shear_carries_the_pattern_along():
    points = places()
    color, _ = patches_over(lambda x, y: (0.5 + 0 * x, 0.2 + 0 * y), 20).colors(points)
    carried = np.clip(pattern(points[:, 0] - 0.5, points[:, 1] - 0.2), 0, 1)
    still = np.clip(pattern(points[:, 0], points[:, 1]), 0, 1)
    assert np.abs(color[:, 0] - carried).mean() < 0.03
    assert np.abs(still - carried).mean() > 0.1, "the two patterns must differ for this to say anything"


def test_a_flow_that_turns_turns_the_pattern():
    turned = 0.6
    speed, points = turned / 1.0, places(inset=1.5)
    color, _ = patches_over(lambda x, y: (-speed * (y - 2), speed * (x - 2)), 100, interval=0.01).colors(points)
    away, cos, sin = points[:, :2] - 2.0, np.cos(-turned), np.sin(-turned)
    x, y = 2 + cos * away[:, 0] - sin * away[:, 1], 2 + sin * away[:, 0] + cos * away[:, 1]
    assert np.abs(color[:, 0] - np.clip(pattern(x, y), 0, 1)).mean() < 0.06  # the middle of each patch moves exactly


def gradients(color: np.ndarray, count: int) -> np.ndarray:
    picture = color[:, 0].reshape(count, count)
    return np.array([np.abs(np.diff(picture, axis=a)).mean() for a in (0, 1)])


def test_shear_does_not_draw_the_pattern_out():
    shear, seconds = 2.0, 5.0
    points = places()
    at_rest = gradients(np.clip(pattern(points[:, 0], points[:, 1]), 0, 1)[:, None], 60)
    drawn_out = gradients(
        np.clip(pattern(points[:, 0] - shear * seconds * (points[:, 1] - 2), points[:, 1]), 0, 1)[:, None], 60
    )
    assert drawn_out[1] > 2.5 * at_rest[1], "carried alone it would be streaks (as far as the raster can show them)"
    patches = patches_over(lambda x, y: (shear * (y - 2), 0 * y), 100)
    found = gradients(patches.colors(points)[0], 60)
    # seams between patches of 0.6 m add edges to a pattern of 0.35 m, in no direction more than in the other
    assert (0.7 < found / at_rest).all() and (found / at_rest < 1.5).all()
    assert 0.75 < (found[1] / at_rest[1]) / (found[0] / at_rest[0]) < 1.33
    assert (patches.state.strains < LIMIT + 13 * 0.05 * shear).all(), "those beyond the limit go within twelve frames"


def test_streaks_stay_along_a_flow_that_shears():
    """Turned with half of the vorticity, they would lie across it by half a radian before they give way."""
    state = patches_over(lambda x, y: (2.0 + 0.8 * (y - 2), 0 * y), 60).state
    assert state.strains.max() > 0.5 and np.abs(state.turns).max() < 0.05


def test_a_piece_taken_from_a_stretch_that_heads_elsewhere_lies_along_the_flow():
    """Seen, everything went along x; now it goes along y: old pieces come round as fast as the flow can turn a line."""
    seen = surface(lambda x, y: (1.0 + 0 * x, 0 * y))
    patches = TexturePatches(SeenTexture(sheet(), CAMERA, seen), 0.6)
    patches.advance(seen, 0.0, np.random.default_rng(0))
    now = surface(lambda x, y: (0 * x, 1.0 + 0 * y))
    for k in range(60):
        patches.advance(now, 0.05, np.random.default_rng(k))
    young = patches.state.presences < 1
    assert young.any()
    np.testing.assert_allclose(patches.state.turns[young], np.pi / 2, atol=0.05)


def test_new_patches_show_what_was_seen_of_the_fluid_and_not_what_was_not():
    """Red is what may not lend its look: a bank, say. After three seconds all that was there at first has left."""
    inside = lambda x, y: (np.abs(x - 2) < 1.4) & (np.abs(y - 2) < 1.4)  # noqa: E731
    body = sheet(colors=lambda x, y: np.where(inside(x, y)[:, None], [0.2, 0.5, 0.2], [1.0, 0.0, 0.0]))
    where = surface(lambda x, y: (1.5 + 0 * x, 0.3 * np.sin(3 * y)))
    texture = SeenTexture(body, CAMERA, where, usable=inside(body.means[:, 0], body.means[:, 1]))
    patches = TexturePatches(texture, 0.6)
    for k in range(61):
        patches.advance(where, 0.05 if k else 0.0, np.random.default_rng([2, k]))
    color, there = patches.colors(places(40, inset=0.2))
    # a source is good from four fifths on: its last fifth shows where no other patch is
    assert there.all() and (color[:, 0] > 0.3).mean() < 0.02 and color[:, 0].mean() < 0.22


def test_the_shade_of_a_place_stays_there():
    """Left half in the shade: three tenths darker, whatever comes by."""
    shade = np.ones((128, 128, 3), np.float32)
    shade[:, :64] = 0.7
    body = sheet(colors=lambda x, y: np.where(x[:, None] < 2, 0.56, 0.8) * np.ones(3))
    where = surface(lambda x, y: (1.0 + 0 * x, 0 * y))
    patches = TexturePatches(SeenTexture(body, CAMERA, where, shading=SteadyShading(shade, CAMERA)), 0.6)
    for k in range(21):
        patches.advance(where, 0.05 if k else 0.0, np.random.default_rng(k))
    points = places(40)
    color = patches.colors(points)[0][:, 0]
    left, right = color[points[:, 0] < 1.8], color[points[:, 0] > 2.2]
    np.testing.assert_allclose([left.mean(), right.mean()], [0.56, 0.8], rtol=0.05)


def test_their_number_does_not_grow_with_time():
    flow = lambda x, y: (0.5 + np.sin(2 * y), np.cos(3 * x))  # noqa: E731
    few, many = (len(patches_over(flow, n).state) for n in (40, 160))
    assert many < 1.2 * few


def test_a_radius_of_nothing_and_a_body_out_of_sight_are_refused():
    where = surface(lambda x, y: (0 * x, 0 * y))
    with pytest.raises(ValueError, match="radius"):
        TexturePatches(SeenTexture(sheet(), CAMERA, where), 0.0)
    away = PinholeCamera.looking((2.0, 2.0, 10.0), (2.0, 9.0, 20.0), fov_degrees=20.0, size=(64, 64))
    with pytest.raises(ValueError, match="nothing was seen"):
        TexturePatches(SeenTexture(sheet(), away, where), 0.6)
