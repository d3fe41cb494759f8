"""What a frame shows without its fluid: the bed in its place, a rock's own picture, no sky through a far end."""

from pathlib import Path

import numpy as np
import pytest

from fluidlift.io.scene_look import Look
from fluidlift.look.environment import Environment
from fluidlift.look.liquid import Behind
from fluidlift.look.outlet_section import OpenEnd
from fluidlift.look.stream_slab import Slab
from fluidlift.numerics.ground_block import PARTS, ground_mesh
from fluidlift.numerics.srgb import linear_from_srgb
from fluidlift.present.bed import FOOT, beds_of
from fluidlift.present.looks import Frame, Painter
from fluidlift.present.without_fluid import Backdrop, GroundPictures, wet_behind
from fluidlift.types import Gaussians, Grid, PinholeCamera, Terrain, TriangleMesh, sh_from_rgb

H = 0.05
GRID = Grid((32, 24, 10), H)
BED, ROCK, WATER = (np.array(c, float) for c in ((110, 90, 60), (160, 160, 165), (20, 140, 160)))
LEVEL, MIDDLE, RADIUS = 0.2, (0.8, 0.6), 0.11
SIZE = (160, 120)
CAMERA = PinholeCamera.looking(np.array([0.8, -0.9, 1.5]), np.array([0.8, 0.6, 0.15]), 45.0, SIZE)
ENDS = (OpenEnd(np.array([1.0, 0, 0]), 1.375, H), OpenEnd(np.array([-1.0, 0, 0]), -0.225, H))


def liquid(step: float = 0.5 * H) -> np.ndarray:
    """Points of water between the banks, from the bed to `LEVEL`, around the rock."""
    axes = (np.arange(0.5 * step, 1.6, step), np.arange(0.15 + step, 1.05, step), np.arange(0.05 + step, LEVEL, step))
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    return points[np.hypot(points[:, 0] - MIDDLE[0], points[:, 1] - MIDDLE[1]) > RADIUS + 0.03]


def ground() -> TriangleMesh:
    """A channel with a rock in it, each in its colour."""
    x, y = GRID.nodes()[:, :, 0, 0], GRID.nodes()[:, :, 0, 1]
    heights = np.where((y < 0.15) | (y > 1.05), 0.3, 0.05)
    heights = np.where(np.hypot(x - MIDDLE[0], y - MIDDLE[1]) < RADIUS, 0.33, heights)
    mesh = ground_mesh(GRID, heights)
    rows, columns = 96, 128
    v, u = (np.mgrid[:rows, :columns] + 0.5) / np.array([rows, columns])[:, None, None]
    at = u * 1.6, (1.0 - v) * 1.2
    painted = np.hypot(at[0] - MIDDLE[0], at[1] - MIDDLE[1]) < RADIUS + 2 * H
    texture = np.where(painted[..., None], ROCK, BED) + np.random.default_rng(0).normal(0, 3, (rows, columns, 1))
    uv = np.stack([mesh.vertices[:, 0] / 1.6, 1.0 - mesh.vertices[:, 1] / 1.2], -1)[mesh.faces]
    return TriangleMesh(mesh.vertices, mesh.faces, None, uv.astype(np.float32), texture.round().astype(np.uint8))


def filmed(camera: PinholeCamera = CAMERA) -> tuple[Backdrop, np.ndarray, np.ndarray]:
    """A clip's plate that shows water where the water was, and a rock; where each is."""
    rays = camera.rays(camera.pixel_grid())
    place = camera.position + ((LEVEL - camera.position[2]) / rays[..., 2])[..., None] * rays
    rock = np.hypot(place[..., 0] - MIDDLE[0], place[..., 1] - MIDDLE[1]) < RADIUS
    water = (np.abs(place[..., 1] - 0.6) < 0.45) & ~rock
    plate = np.where(rock[..., None], ROCK, np.where(water[..., None], WATER, BED))
    pictures = GroundPictures(ground(), GRID, Slab(still=liquid()), Environment.white())
    depth = np.where(rock, pictures.ground.depth(camera), 0.0).astype(np.float32)
    picture = linear_from_srgb(plate / 255.0).astype(np.float32)
    return Backdrop(picture, depth, 1.0, water.astype(np.float32)), water, rock


def apart(image: np.ndarray, colour: np.ndarray) -> np.ndarray:
    """How far the hue (colours of one brightness) of linear pixels is from that of an sRGB colour."""
    wanted = linear_from_srgb(colour / 255.0)
    unit = image / np.maximum(np.linalg.norm(image, axis=-1, keepdims=True), 1e-9)
    return np.linalg.norm(unit - wanted / np.linalg.norm(wanted), axis=-1)


def test_the_plate_shows_the_bed_where_the_clip_shows_water_and_no_rock_beside_its_own_picture():
    backdrop, water, rock = filmed()
    pictures = GroundPictures(ground(), GRID, Slab(still=liquid()), Environment.white())
    beside, through = pictures.on_plate(CAMERA, backdrop)
    inner = water & (pictures.bed.lying(CAMERA) > 0.99) & (pictures.bed.depth(CAMERA) > 0)
    assert inner.sum() > 2000
    assert (apart(beside.image, BED) < apart(beside.image, WATER))[inner].all()
    rock_like = apart(beside.image, ROCK) < apart(beside.image, BED)
    rays = CAMERA.rays(CAMERA.pixel_grid())
    bed = CAMERA.position + ((0.05 - CAMERA.position[2]) / rays[..., 2])[..., None] * rays
    far = np.hypot(bed[..., 0] - MIDDLE[0], bed[..., 1] - MIDDLE[1]) > RADIUS + 0.3
    assert not rock_like[inner & far].any()
    # above its picture, where its model stands out of the water, there is water, and the model hides none
    high = pictures.ground.depth(CAMERA) < 0.97 * through.depth
    assert (high & water).sum() > 10 and (
        beside.depth[high & water] > pictures.ground.depth(CAMERA)[high & water]
    ).all()
    np.testing.assert_array_equal(beside.image[rock], backdrop.picture[rock])
    assert (through.depth[rock] > 1.02 * beside.depth[rock]).all()  # behind it the bed goes on
    ashore = ~water & ~rock
    np.testing.assert_array_equal(beside.image[ashore], backdrop.picture[ashore])


def test_beyond_the_ends_liquid_is_hidden_where_the_clip_is_dry_and_nowhere_else():
    """A mirror image of the stream knows no bend of it and no far shore: it stood before the trees."""
    camera = PinholeCamera.looking(np.array([0.3, 0.6, 0.5]), np.array([1.6, 0.6, 0.2]), 60.0, SIZE)
    backdrop, _, _ = filmed(camera)
    assert backdrop.picture is not None and backdrop.fluid is not None
    height, width = backdrop.fluid.shape
    fluid = np.zeros((height, width), np.float32)
    fluid[:, : width // 2] = 1.0
    pictures = GroundPictures(ground(), GRID, Slab(ENDS, liquid()), Environment.white())
    beside, _ = pictures.on_plate(camera, Backdrop(backdrop.picture, None, 1.0, fluid))
    points = camera.unproject(camera.pixel_grid(), beside.depth)
    ahead = camera.rays(camera.pixel_grid()) @ ENDS[0].along > 1e-6
    dry = (fluid < 0.5) & ahead
    assert dry.sum() > 3000 and (beside.depth[dry] > 0).all()
    assert (points[dry] @ ENDS[0].along <= ENDS[0].at + 1e-4).all(), "no farther than the section"
    whole = pictures.on_plate(camera, Backdrop(backdrop.picture, None, 1.0, np.ones_like(fluid)))[0]
    np.testing.assert_array_equal(beside.depth[fluid > 0.5], whole.depth[fluid > 0.5])


def test_a_ray_that_misses_the_model_of_a_rock_has_the_depth_of_its_neighbour():
    backdrop, _, rock = filmed()
    assert backdrop.depth is not None
    pictures = GroundPictures(ground(), GRID, Slab(still=liquid()), Environment.white())
    missed = np.array(backdrop.depth)
    row, column = np.argwhere(rock).mean(axis=0).astype(int)
    missed[row, column] = 1.5 * missed[row, column]  # the bed behind it
    found = pictures.depth_of_rocks(CAMERA, missed)
    assert found[row, column] == pytest.approx(backdrop.depth[row, column], rel=0.05)
    assert not found[~rock].any()


def test_a_bed_without_rocks_is_level_and_has_no_colour_of_theirs_beyond_their_feet():
    slab, mesh = Slab(still=liquid()), ground()
    found = beds_of(slab, mesh, GRID)
    assert found is not None and found.level.texture is not None
    nodes = (GRID.shape[0] * PARTS + 1, GRID.shape[1] * PARTS + 1)
    level = found.level.vertices[: nodes[0] * nodes[1], 2].reshape(nodes)
    sunk = found.sunk.vertices[: nodes[0] * nodes[1], 2].reshape(nodes)
    i, j = round(MIDDLE[0] / H * PARTS), round(MIDDLE[1] / H * PARTS)
    assert level[i, j] == pytest.approx(0.05, abs=0.02) and 0.1 < sunk[i, j] < LEVEL
    colours = found.level.texture.astype(float)
    v, u = (np.mgrid[:96, :128] + 0.5) / np.array([96.0, 128.0])[:, None, None]
    away = np.hypot(u * 1.6 - MIDDLE[0], (1 - v) * 1.2 - MIDDLE[1]) - RADIUS
    ring = (away > (FOOT - 0.5) * H) & (away < (FOOT + 1) * H)
    np.testing.assert_allclose(colours[ring].mean(axis=0), BED, atol=6.0)
    assert np.abs(colours[away < 0] - ROCK).mean() < 12.0
    assert beds_of(Slab(still=liquid()), ground_mesh(GRID, np.full((33, 25), 0.05)), GRID) is None


def test_behind_a_rock_the_bed_is_as_wet_as_around_it():
    shape = (96, 128)
    dry = Behind(np.full((*shape, 3), 0.4), np.full(shape, 2.0))
    rock = np.zeros(shape, bool)
    rock[40:56, 50:70] = True
    wet = Behind(np.where(rock[..., None], 0.4, 0.2).repeat(3, 2), dry.depth)
    beside = Behind(wet.image, np.where(rock, 1.5, 2.0))
    found = wet_behind(dry, wet, beside)
    np.testing.assert_allclose(found.image, 0.2, rtol=0.02)
    np.testing.assert_array_equal(wet_behind(dry, wet, dry).image, wet.image)


@pytest.mark.parametrize("engine", ["mesh", "screen"])
def test_no_sky_is_seen_through_the_far_end_of_a_stream(engine):
    points = liquid()
    n = len(points)
    fluid = Gaussians(points, np.tile([1.0, 0, 0, 0], (n, 1)), np.full((n, 3), 0.42 * H), np.full(n, 0.9),
                      sh_from_rgb(np.full((n, 3), 0.5)))  # fmt: skip
    solid = ground()
    dark = TriangleMesh(solid.vertices, solid.faces, np.full((len(solid.vertices), 3), 0.2))
    z = GRID.nodes()[..., 2]
    terrain = Terrain(GRID, (z - 0.05).astype(np.float32), np.float32([1, 0, 0]), dark)
    # along the stream, from above its upper end: its far end is a window
    camera = PinholeCamera.looking(np.array([0.2, 0.75, 0.45]), np.array([1.3, 0.75, 0.15]), 35.0, (96, 72))
    clear, frame = Look("surface", "water", "white"), Frame(fluid, np.zeros_like(points))
    closed, bare = (Painter(clear, terrain, Path(), engine=engine, slab=Slab(ends, points)) for ends in (ENDS, ()))
    found = closed.picture(frame, camera, Backdrop()).image.mean(axis=-1)
    # just before the end, where a ray through the surface leaves the liquid by its end and not by its bed
    uv, _ = camera.project(np.array([[1.27, y, LEVEL] for y in (0.7, 0.75, 0.8, 0.85, 0.9)]))
    seen = [found[int(v), int(u)] for u, v in uv]
    # a white world is mirrored by Fresnel's 0.25 at 13 degrees above the surface; a dark bed adds little. Through
    # the end the pale floor of the surroundings, 0.6, would be seen
    assert max(seen) < 0.4, seen
    assert bare.picture(frame, camera, Backdrop()).image.shape == (72, 96, 3)
