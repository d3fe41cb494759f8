"""The picture on the ground: where it shows it, behind what hides it, under water, and on the cut sides."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage
from scipy.ndimage import binary_dilation, binary_erosion

from fluidlift.numerics.textures import sample_texture
from fluidlift.shape.ground_mesh import ground_mesh
from fluidlift.shape.ground_texture import STRIP, GroundView, hidden_ground, over_bed, sky_pixels, textured
from fluidlift.types import Grid, Label, PinholeCamera

GRID = Grid((24, 16, 6), 0.125, (-1.5, -1.0, -1.0))
CAMERA = PinholeCamera.looking((0.0, -3.0, 3.0), (0.0, 0.0, 0.0), 50.0, (200, 150))
DRY = np.full((24, 16), -10.0)
"""level of water far below the ground"""


def pattern(points):
    """A colour for each place: smooth, but finer than the grid's cells."""
    x, y = points[..., 0], points[..., 1]
    waves = [np.sin(30 * x) * np.cos(4 * y), np.cos(5 * x), np.sin(12 * y + 2 * x)]
    return 127.0 + 90.0 * np.stack(waves, axis=-1)


def picture():
    """What the camera sees of the pattern on level ground."""
    rays = CAMERA.rays(CAMERA.pixel_grid())
    return np.clip(pattern(CAMERA.position - rays * (CAMERA.position[2] / rays[..., 2])[..., None]), 0, 255)


def seen_on(heights, *, plate=None, labels=None, level=DRY, seen=None):
    plate = picture() if plate is None else plate
    labels = np.full(plate.shape[:2], Label.BACKGROUND) if labels is None else labels
    view = GroundView(
        plate.astype(np.uint8), CAMERA, labels.astype(np.uint8), np.ones(labels.shape, bool) if seen is None else seen
    )
    return textured(ground_mesh(GRID, heights), GRID, level, view)


def colour_at(mesh, x, y):
    """0 to 255, of the top at places: found through the faces and their texture coordinates."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(float) for k in range(3))
    top = np.cross(b - a, c - a)[:, 2] > 0
    middle, uv = mesh.vertices[mesh.faces[top]].mean(axis=1), mesh.uv[top].mean(axis=1)
    found = [np.hypot(middle[:, 0] - px, middle[:, 1] - py).argmin() for px, py in zip(np.ravel(x), np.ravel(y))]
    return 255.0 * sample_texture(mesh.texture, uv[found]), middle[found]


@pytest.fixture(scope="module")
def level_ground():
    return seen_on(np.zeros((25, 17)))


def test_seen_ground_has_the_colours_of_the_picture_finer_than_its_faces(level_ground):
    x, y = np.random.default_rng(1).uniform([-1.1, -0.8], [1.1, 0.8], (200, 2)).T
    colour, place = colour_at(level_ground, x, y)
    # 8 bits, and looked up between pixels, of which the finest wave (90 grey levels high) has more than ten
    assert np.abs(colour - pattern(place)).max() < 6.0


def test_the_sides_and_the_floor_are_of_one_earthy_colour(level_ground):
    a, b, c = (level_ground.vertices[level_ground.faces[:, k]].astype(float) for k in range(3))
    cut = np.cross(b - a, c - a)[:, 2] < 1e-9
    assert cut.sum() > 100
    colours = sample_texture(level_ground.texture, level_ground.uv[cut])
    assert np.ptp(colours.reshape(-1, 3), axis=0).max() == 0
    assert np.ptp(level_ground.texture[-STRIP:].reshape(-1, 3), axis=0).max() == 0


def test_a_texture_is_not_larger_than_it_may_be(level_ground):
    view = GroundView(picture().astype(np.uint8), CAMERA, np.zeros((150, 200), np.uint8), np.ones((150, 200), bool))
    small = textured(ground_mesh(GRID, np.zeros((25, 17))), GRID, DRY, view, longest=64)
    assert max(small.texture.shape) == 64 and max(level_ground.texture.shape) > 200


def ridge():
    """A wall along x, 0.4 m high, between y = 0.1 and 0.3."""
    y = GRID.nodes()[:, :, 0, 1]
    return 0.4 * ((y > 0.1) & (y < 0.3))


def test_ground_behind_a_ridge_is_hidden_from_the_camera_and_the_rest_is_not():
    nodes = GRID.nodes()[:, :, 0]
    top = np.concatenate([nodes[..., :2], ridge()[..., None]], axis=-1)
    hidden = hidden_ground(top, np.array([0.0, -3.0, 3.0]))
    y = nodes[..., 1]
    # seen at 42 degrees, 0.4 m hide about 0.44 m of ground
    assert hidden[(y > 0.4) & (y < 0.6)].all()
    assert not hidden[(y < 0.05) | (y > 0.9)].any()


def test_a_ridge_is_not_painted_on_the_ground_behind_it():
    rays = CAMERA.rays(CAMERA.pixel_grid())
    ground = CAMERA.position - rays * (CAMERA.position[2] / rays[..., 2])[..., None]
    plate = np.full((150, 200, 3), 60.0)
    plate[(ground[..., 1] > 0.1) & (ground[..., 1] < 0.73)] = (220, 40, 40)  # the ridge, as it covers the picture
    mesh = seen_on(ridge(), plate=plate)
    x = np.linspace(-0.6, 0.6, 13)
    colour, _ = colour_at(mesh, x, np.full(13, 0.85))
    np.testing.assert_allclose(colour, 60.0, atol=2.0)


def test_a_rock_is_painted_on_itself_and_not_on_what_lies_behind_it():
    nodes = GRID.nodes()[:, :, 0]
    rays = CAMERA.rays(CAMERA.pixel_grid())
    ground = CAMERA.position - rays * (CAMERA.position[2] / rays[..., 2])[..., None]
    # the rock is taller than its model: its picture reaches 0.3 m past its foot, where the model is level ground
    labels = np.full(ground.shape[:2], Label.BACKGROUND)
    rock = (np.abs(ground[..., 0]) < 0.3) & (np.abs(ground[..., 1]) < 0.2)
    labels[rock] = Label.SOLID
    plate = np.full((150, 200, 3), 60.0)
    plate[rock] = (220, 200, 190)
    level = np.full((24, 16), -0.02)
    heights = 0.25 * ((np.abs(nodes[..., 0]) < 0.25) & (np.abs(nodes[..., 1]) < 0.15)) - 0.1
    mesh = seen_on(heights, plate=plate, labels=labels, level=level)
    on_rock, _ = colour_at(mesh, [0.0, 0.1], [0.05, 0.1])
    beside, _ = colour_at(mesh, [0.0, 0.1, -0.1], [0.5, 0.45, 0.6])
    assert (on_rock[:, 0] > 180).all()
    np.testing.assert_allclose(beside, 60.0, atol=3.0)


def test_the_bed_under_water_is_of_the_stuff_of_its_rim_and_not_of_specks_that_the_mask_missed():
    y = GRID.nodes()[:, :, 0, 1]
    heights = np.where(np.abs(y) < 0.4, -0.2, 0.02)
    rays = CAMERA.rays(CAMERA.pixel_grid())
    ground = CAMERA.position - rays * (CAMERA.position[2] / rays[..., 2])[..., None]
    plate = np.full((150, 200, 3), (110.0, 90.0, 60.0)) + np.random.default_rng(0).normal(0, 4, (150, 200, 1))
    wet = np.abs(ground[..., 1]) < 0.45
    plate[wet] = (20, 140, 160)  # whatever was painted there
    plate[(np.abs(ground[..., 0]) < 0.06) & (np.abs(ground[..., 1] - 0.48) < 0.06)] = (20, 140, 160)
    mesh = seen_on(heights, plate=plate, level=np.zeros((24, 16)), seen=~wet)
    colour, _ = colour_at(mesh, np.linspace(-1, 1, 9), np.zeros(9))
    np.testing.assert_allclose(colour, np.tile([110.0, 90.0, 60.0], (9, 1)), atol=8.0)


def test_a_bank_does_not_wear_the_water_that_the_clip_shows_there():
    # the model's bank reaches over what the clip shows as water: nobody has seen what lies under that
    y = GRID.nodes()[:, :, 0, 1]
    heights = np.where(np.abs(y) < 0.4, -0.2, 0.02)
    rays = CAMERA.rays(CAMERA.pixel_grid())
    ground = CAMERA.position - rays * (CAMERA.position[2] / rays[..., 2])[..., None]
    wet = np.abs(ground[..., 1]) < 0.6
    plate = np.where(wet[..., None], (20.0, 140.0, 160.0), (110.0, 90.0, 60.0))
    mesh = seen_on(heights, plate=plate, level=np.zeros((24, 16)), seen=~wet)
    for place in (0.5, -0.5, 0.0):  # both banks, and the bed between them
        colour, _ = colour_at(mesh, np.linspace(-0.8, 0.8, 7), np.full(7, place))
        bank, water = (np.linalg.norm(colour - c, axis=1) for c in ([110, 90, 60], [20, 140, 160]))
        assert (bank < 0.2 * water).all()


def test_the_bed_under_water_is_as_grainy_as_its_rim():
    y = GRID.nodes()[:, :, 0, 1]
    heights = np.where(np.abs(y) < 0.4, -0.2, 0.02)
    rays = CAMERA.rays(CAMERA.pixel_grid())
    ground = CAMERA.position - rays * (CAMERA.position[2] / rays[..., 2])[..., None]
    wet = np.abs(ground[..., 1]) < 0.45
    stones = np.random.default_rng(0).normal(0, 15, (150, 200, 1))
    plate = np.clip(np.where(wet[..., None], (20.0, 140.0, 160.0), (110.0, 90.0, 60.0)) + stones, 0, 255)
    mesh = seen_on(heights, plate=plate, level=np.zeros((24, 16)), seen=~wet)
    texture = mesh.texture[:-STRIP].astype(float)
    rows = len(texture)
    # y runs from -1 m at the lower edge to 1 m
    bed, bank = (texture[int(rows * (0.5 - y / 2)) - 4 :][:8, :, 0].std() for y in (0.0, 0.6))
    assert bed > 0.5 * bank > 2.0


def rock_in_a_channel():
    """Ground with a bank of 45 degrees and a rock whose sides fall at 60 degrees, water at z = 0, and its picture."""
    nodes = GRID.nodes()[:, :, 0]
    away = np.hypot(nodes[..., 0], nodes[..., 1])
    heights = np.maximum(0.1 - np.tan(np.radians(60)) * np.maximum(away - 0.15, 0.0), -0.4)
    heights = np.maximum(heights, np.minimum(nodes[..., 1] - 0.5, 0.1))
    rays = CAMERA.rays(CAMERA.pixel_grid())
    water = CAMERA.position - rays * (CAMERA.position[2] / rays[..., 2])[..., None]
    labels = np.where(water[..., 1] < 0.5, Label.FLUID, Label.BACKGROUND)
    labels[np.hypot(water[..., 0], water[..., 1]) < 0.2] = Label.SOLID
    plate = np.where((labels == Label.BACKGROUND)[..., None], (110.0, 90.0, 60.0), (20.0, 140.0, 160.0))
    plate[labels == Label.SOLID] = (120, 120, 125)
    seen = labels != Label.FLUID
    return seen_on(heights, plate=plate, labels=labels, level=np.zeros((24, 16)), seen=seen), plate, seen


def test_a_rock_goes_on_down_to_its_foot_and_a_bank_as_steep_is_no_rock():
    mesh, *_ = rock_in_a_channel()
    foot, place = colour_at(mesh, [0.28, -0.28, 0.0, 0.2], [0.0, 0.0, -0.28, 0.2])
    assert (place[:, 2] < -0.05).all()  # under water
    np.testing.assert_allclose(foot, np.tile([120.0, 120.0, 125.0], (4, 1)), atol=8.0)
    bed, _ = colour_at(mesh, [0.8, -0.8, 0.0], [0.0, 0.0, 0.35])  # the last on the bank's side under water
    np.testing.assert_allclose(bed, np.tile([110.0, 90.0, 60.0], (3, 1)), atol=8.0)


def test_behind_a_fluid_the_picture_shows_the_ground_and_elsewhere_what_was_filmed():
    mesh, plate, seen = rock_in_a_channel()
    picture = over_bed(plate.astype(np.uint8), seen, mesh, CAMERA).astype(float)
    uv, _ = CAMERA.project(np.array([[0.28, -0.1, -0.12], [0.8, 0.0, -0.4]]))
    (x, y), (u, v) = np.round(uv - 0.5).astype(int)
    np.testing.assert_allclose(picture[y, x], (120, 120, 125), atol=12.0)  # the rock's foot
    np.testing.assert_allclose(picture[v, u], (110, 90, 60), atol=12.0)  # the bed
    far = binary_erosion(seen, iterations=8)  # beyond the blend of 1.5 px
    assert far.any() and (picture[far] == plate[far]).all()


def test_no_edge_runs_along_the_rim_of_the_fluid_where_the_ground_has_other_colours_than_the_picture():
    mesh, plate, seen = rock_in_a_channel()
    hole = ndimage.distance_transform_edt(~seen)
    painted = plate.astype(np.uint8) + np.uint8(40) * seen[..., None].astype(np.uint8)
    picture, own = (over_bed(p, seen, mesh, CAMERA).astype(float) for p in (painted, plate.astype(np.uint8)))
    brighter = (picture - own).mean(axis=-1)
    inside = binary_erosion(np.ones_like(seen), iterations=12)  # of the picture
    rim, middle = inside & (hole > 0) & (hole < 2), inside & (hole > 20)
    assert rim.any() and middle.any()
    assert np.median(brighter[rim]) > 20.0  # of the 40 beside it
    assert np.abs(brighter[middle]).max() < 2.0


def test_the_cut_side_of_the_ground_is_no_part_of_the_picture_without_fluid():
    """The block ends somewhere; the scene does not, and earth is nothing that the clip shows there."""
    plate, seen = np.full((150, 200, 3), (30, 60, 120), np.uint8), np.zeros((150, 200), bool)
    seen[:2] = True
    view = GroundView(plate, CAMERA, np.full((150, 200), Label.BACKGROUND, np.uint8), seen)
    mesh = textured(ground_mesh(GRID, np.zeros((25, 17))), GRID, DRY, view)
    uv, _ = CAMERA.project(np.array([[0.0, -1.0, -0.1]]))  # on the side towards the camera, below much that lies
    x, y = np.round(uv[0] - 0.5).astype(int)
    np.testing.assert_array_equal(over_bed(plate, seen, mesh, CAMERA)[y, x], plate[y, x])


FACING = PinholeCamera.looking((0.0, -4.0, 0.5), (0.0, 0.0, 0.4), 50.0, (200, 150))
"""level: the horizon is in the middle of its picture"""


def landscape():
    """Trees and rocks, white sky in the upper corner at the right, as far down as the horizon."""
    plate = np.random.default_rng(0).normal(80, 15, (150, 200, 1)) * np.array([0.7, 0.8, 0.6])
    plate[:60, 120:] = (240, 245, 243)
    return np.clip(plate, 0, 255).astype(np.uint8)


def water_before_a_wall():
    """A sheet of water that stands, the ground that was made up behind it, and a picture of what is really there."""
    x, y = np.moveaxis(GRID.nodes()[:, :, 0, :2], -1, 0)
    wall = np.clip(3.0 * (y + 0.3), 0.0, 1.2)
    level = np.clip(3.0 * (GRID.centers()[:, :, 0, 1] + 0.4), 0.0, 1.3) + 0.05
    labels = np.full((150, 200), Label.BACKGROUND)
    labels[20:, 60:120] = Label.FLUID
    plate = landscape()
    plate[20:, 60:120] = (150, 40, 40)  # whatever was painted there
    mesh = ground_mesh(GRID, wall + 0.0 * x)
    seen = labels != Label.FLUID
    return textured(mesh, GRID, level, GroundView(plate, FACING, labels.astype(np.uint8), seen)), plate, seen


def test_no_ground_is_painted_over_the_scene_behind_water_that_stands():
    mesh, plate, seen = water_before_a_wall()
    picture = over_bed(plate, seen, mesh, FACING)
    np.testing.assert_array_equal(picture[35:70, 75:105], plate[35:70, 75:105])


def test_a_wall_behind_water_has_the_colours_of_the_scene_behind_it():
    mesh, *_ = water_before_a_wall()
    on_wall, place = colour_at(mesh, [-0.1, -0.1], [-0.2, -0.1])
    assert (place[:, 2] > 0.2).all()
    np.testing.assert_allclose(on_wall, np.tile([150.0, 40.0, 40.0], (2, 1)), atol=6.0)


def test_the_sky_is_above_the_horizon_even_and_bright_or_blue_and_reaches_the_upper_edge():
    truth = np.zeros((150, 200), bool)
    truth[:60, 120:] = True
    white = landscape()
    blue = white.copy()
    blue[truth] = (70, 95, 130)
    grown = binary_dilation(truth, iterations=6)  # its rim is mixed with what stands before it: 1 % twice
    for plate in (white, blue):
        found = sky_pixels(plate, FACING)
        assert found[binary_erosion(truth, iterations=4, border_value=1)].all() and not found[~grown].any()
    cliff = white.copy()
    cliff[truth] = np.clip(np.random.default_rng(1).normal(200, 30, (truth.sum(), 1)), 0, 255)  # bright, but not even
    assert not sky_pixels(cliff, FACING).any()
    roof = white.copy()
    roof[:8] = white[80:88]  # trees above it: no sky
    assert not sky_pixels(roof, FACING).any()
    assert not sky_pixels(white, CAMERA).any()  # looks down


def test_no_sky_is_laid_on_the_ground():
    y = GRID.nodes()[:, :, 0, 1]
    rises = np.clip(3.0 * (y + 0.3), 0.0, 1.2)
    labels = np.full((150, 200), Label.BACKGROUND, np.uint8)
    view = GroundView(landscape(), FACING, labels, np.ones((150, 200), bool))
    assert textured(ground_mesh(GRID, rises), GRID, DRY, view).texture.max() < 160
    sky_seen = textured(ground_mesh(GRID, 0 * rises), GRID, DRY, replace(view, camera=CAMERA)).texture
    assert sky_seen.max() > 230  # a white thing on level ground stays


def test_vertex_colours_are_those_of_the_texture(level_ground):
    top = level_ground.vertices[:, 2] > -1e-6
    inner = top & (np.abs(level_ground.vertices[:, :2]) < 0.7).all(axis=1)
    expected = pattern(level_ground.vertices[inner]) / 255.0
    np.testing.assert_allclose(level_ground.colors[inner], expected, atol=6.0 / 255)
