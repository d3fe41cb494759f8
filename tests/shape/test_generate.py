"""The embedded generator: Gaussians that look like the picture, a hull inside the body, a plate without fluid."""

import cv2
import numpy as np
import pytest
from scipy import ndimage

from fluidlift.look.rasterize import render
from fluidlift.shape.generate import (
    _median_where,
    background_plate,
    beneath_front,
    body_cells,
    fluid_colour_frame,
    front_gaussians,
    hull_gaussians,
    picture_colours,
    united_mask,
    within_silhouette,
)
from fluidlift.types import CellType, Gaussians, Grid, PinholeCamera, Setting, Terrain, TriangleMesh, concatenate

H, W = 64, 96
ROW, COL = np.mgrid[:H, :W]


def soft_picture(seed=0, blur=2.5):
    noise = np.random.default_rng(seed).standard_normal((H, W, 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), blur)
    return np.clip(128 + 50 * smooth / smooth.std(), 0, 255).astype(np.uint8)


def water(pitch=40.0):
    """A camera 2 m above a level surface, and the surface's depth."""
    low = np.array([0.0, -2.0 / np.tan(np.radians(pitch)), 2.0])
    camera = PinholeCamera.looking(low, (0.0, 0.0, 0.0), 50.0, (W, H))
    rays = camera.rays(camera.pixel_grid())
    return camera, -camera.position[2] / rays[..., 2]


def psnr(a, b, where):
    return -10 * np.log10(np.mean((a[where] - b[where]) ** 2))


@pytest.mark.parametrize("stride", [1, 2])
def test_front_gaussians_look_like_the_picture(stride):
    frame, (camera, depth) = soft_picture(), water()
    mask = (ROW > 12) & (ROW < 52)
    front = front_gaussians(frame, mask, depth, camera, stride=stride)
    shown = render(front, camera)
    inner = (ROW > 16) & (ROW < 48) & (COL > 4) & (COL < W - 4)
    truth = frame / 255.0
    # on a surface that rises away from the viewer each splat covers half of the one behind it, which moves the picture
    # by less than a block before refinement: it must be clearly nearer to the truth than the truth moved by a block
    assert psnr(shown.image, truth, inner) > psnr(np.roll(truth, stride, axis=0), truth, inner) + 1.0
    assert psnr(shown.image, truth, inner) > 25.0  # 5 % of white, a quarter of the picture's own contrast
    assert shown.alpha[inner].min() > 0.95  # no holes
    # expected depth is a mean over overlapping splats on a slanted surface
    np.testing.assert_allclose(shown.depth[inner], depth[inner], rtol=0.03)


def test_front_gaussians_lie_on_the_surface_and_along_it():
    camera, depth = water()
    front = front_gaussians(soft_picture(), ROW > 20, depth, camera)
    np.testing.assert_allclose(front.means[:, 2], 0.0, atol=1e-5)
    c = front.covariances()
    # flat: thin across the surface (a quarter of a block of 1 px) and wider along it
    assert (c[:, 2, 2] < 0.3 * np.maximum(c[:, 0, 0], c[:, 1, 1])).all()
    assert (np.linalg.eigvalsh(c.astype(float)) > 0).all()


def test_there_is_one_gaussian_per_block_inside_the_mask():
    camera, depth = water()
    mask = (ROW > 20) & (ROW < 50) & (COL > 10) & (COL < 80)
    front = front_gaussians(soft_picture(), mask, depth, camera, stride=3)
    assert len(front) == pytest.approx(mask.sum() / 9, rel=0.1)
    uv, _ = camera.project(front.means)
    assert mask[uv[:, 1].astype(int), uv[:, 0].astype(int)].all()


def test_a_step_in_depth_makes_no_long_gaussians():
    camera, _ = water()
    depth = np.where(COL < 48, 2.0, 8.0)
    front = front_gaussians(soft_picture(), np.ones((H, W), bool), depth, camera)
    block = np.where(
        front.means @ camera.camera_from_world.rotation[2] + camera.camera_from_world.translation[2] < 5, 2, 8
    )
    # edges are cut at four blocks; 0.3 is the variance of a block in its own width
    assert (front.scales.max(axis=1) <= np.sqrt(0.3) * 4 * np.sqrt(2) * block / camera.focal[0]).all()


def test_where_nothing_is_fluid_or_deep_there_are_no_gaussians():
    camera, depth = water()
    assert len(front_gaussians(soft_picture(), np.zeros((H, W), bool), depth, camera)) == 0
    assert len(front_gaussians(soft_picture(), np.ones((H, W), bool), 0 * depth, camera)) == 0


# the hull -------------------------------------------------------------------------------------------------------


def trough():
    """A block of water 12 x 6 x 4 cells in solid ground, its surface at the upper side."""
    grid = Grid((16, 10, 8), 0.1, (-0.8, -0.5, -0.6))
    cells = np.full(grid.shape, CellType.SOLID, np.uint8)
    cells[:, :, 6:] = CellType.EMPTY
    cells[2:14, 2:8, 2:6] = CellType.FLUID
    cells[2:4, 2:8, 2:6] = CellType.INFLOW
    terrain = Terrain(
        grid,
        np.zeros((17, 11, 9), np.float32),
        np.array([1.0, 0, 0]),
        TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int)),
    )
    return Setting(terrain, cells, np.zeros((16, 10)), np.full((16, 10), -0.4))


def test_the_hull_stays_within_half_a_cell_of_the_body_and_below_its_surface():
    setting = trough()
    grid = setting.terrain.grid
    hull = hull_gaussians(soft_picture(), setting, water()[0])
    assert len(hull) > 100
    wet = body_cells(setting)
    assert wet.sum() == 12 * 6 * 4  # the inlet belongs to the body
    half = 0.5 * grid.spacing
    near = np.zeros(len(hull), bool)
    for offset in np.array(np.meshgrid(*[[-half, 0, half]] * 3)).reshape(3, -1).T:
        cell = np.clip(grid.cell_of(hull.means + offset), 0, np.array(grid.shape) - 1)
        near |= wet[tuple(cell.T)]
    assert near.all()
    assert (hull.means[:, 2] < 0).all()


def test_the_hull_covers_every_side_but_not_the_inside():
    setting = trough()
    hull = hull_gaussians(soft_picture(), setting, water()[0])
    cells = {tuple(c) for c in setting.terrain.grid.cell_of(hull.means)}
    for side in ((5, 2, 4), (5, 7, 4), (2, 5, 4), (13, 5, 4), (5, 5, 2), (5, 5, 5)):
        assert side in cells
    assert (7, 4, 4) not in cells


def test_the_hull_is_darker_below_the_surface():
    white = np.full((H, W, 3), 200, np.uint8)
    hull = hull_gaussians(white, trough(), water()[0], shade=0.5)
    deep = hull.means[:, 2] < -0.11
    np.testing.assert_allclose(hull.rgb[deep], 0.5 * 200 / 255, atol=1e-5)
    np.testing.assert_allclose(hull.rgb[~deep & (hull.means[:, 2] > -0.09)], 200 / 255, atol=1e-5)


def test_the_same_seed_gives_the_same_hull():
    frame, camera = soft_picture(), water()[0]
    a, b, c = (hull_gaussians(frame, trough(), camera, seed=s) for s in (1, 1, 2))
    np.testing.assert_array_equal(a.means, b.means)
    assert not np.array_equal(a.means, c.means)


# below the visible surface --------------------------------------------------------------------------------------


def test_no_splat_of_the_inside_shows_through_the_surface_above_it():
    camera, depth = water(pitch=25.0)
    mask = ROW > 12
    front = front_gaussians(np.full((H, W, 3), 200, np.uint8), mask, depth, camera)
    rng = np.random.default_rng(0)
    points = camera.unproject(camera.pixel_grid(), depth)[(ROW > 20) & (ROW < 60) & (COL > 6) & (COL < 90)]
    points = rng.permutation(points)[:300] - [0, 0, 1] * rng.uniform(0.02, 0.2, (300, 1))
    dark = Gaussians.isotropic(points, 0.1, np.zeros((300, 3)), 0.8)
    inner = (ROW > 22) & (ROW < 52) & (COL > 10) & (COL < 86)

    def error(inside):
        shown = render(concatenate([front, inside]), camera)
        return float(np.sqrt(np.mean((shown.image[inner] - 200 / 255) ** 2)))

    # standing out by less than exp(-2) at the rim of a splat, the black ones darken the picture by a few per cent
    assert error(dark) > 0.2
    assert error(beneath_front(dark, depth, mask, camera)) < 0.05


def test_splats_get_half_their_distance_from_the_surface_and_keep_their_places():
    camera, depth = water()
    deep = np.array([[0.0, 0.0, -z] for z in (0.001, 0.1, 0.5)])
    g = Gaussians.isotropic(deep, 0.1, np.zeros((3, 3)), 0.8)
    small = beneath_front(g, depth, ROW >= 0, camera, smallest=0.3)
    np.testing.assert_allclose(small.scales[:, 0], [0.03, 0.05, 0.1], rtol=0.02)  # depth between pixels is not linear
    np.testing.assert_array_equal(small.means, g.means)


def test_what_the_camera_does_not_see_from_above_keeps_its_size():
    camera, depth = water()
    g = Gaussians.isotropic(np.array([[0.0, 0.0, -0.05], [50.0, 0.0, -0.05]]), 0.1, np.zeros((2, 3)), 0.8)
    beside = beneath_front(g, depth, ROW >= 0, camera)
    assert beside.scales[0, 0] < 0.05 and beside.scales[1, 0] == g.scales[1, 0]
    np.testing.assert_array_equal(beneath_front(g, depth, ROW < 0, camera).scales, g.scales)


def test_what_lies_before_the_visible_surface_can_be_dropped():
    camera, depth = water()
    g = Gaussians.isotropic(np.array([[0.0, 0.0, 0.05], [0.0, 0.0, -0.05]]), 0.1, np.zeros((2, 3)), 0.8)
    assert len(beneath_front(g, depth, ROW >= 0, camera)) == 2
    left = beneath_front(g, depth, ROW >= 0, camera, drop_above=True)
    np.testing.assert_array_equal(left.means, g.means[1:])


# within the silhouette ------------------------------------------------------------------------------------------


def test_nothing_of_the_inside_shows_beside_the_silhouette():
    camera, depth = water()
    fluid = (np.abs(COL - 48) < 25) & (np.abs(ROW - 32) < 15)
    # one splat on 16 px, 3.3 px wide: as dense as the hull of a grid
    drawn = np.random.default_rng(0).uniform(size=fluid.shape) < 1 / 16
    points = camera.unproject(camera.pixel_grid(), depth)[drawn & (np.abs(COL - 48) < 35) & (np.abs(ROW - 32) < 25)]
    body = Gaussians.isotropic(points, 0.1, np.ones((len(points), 3)), 0.8)
    away = ndimage.distance_transform_edt(~fluid)
    beside = (away > 1.5) & (away < 7.0)
    assert render(body, camera).alpha[beside].mean() > 0.9
    shown = render(within_silhouette(body, fluid, camera, smallest=0.0), camera).alpha
    # what stands out of a single splat weighs less than exp(-2), a seventh, and the rasteriser blurs by half a pixel
    assert shown[beside].mean() < 0.05
    assert shown[ndimage.binary_erosion(fluid, iterations=6)].mean() > 0.9


def test_splats_get_half_their_distance_from_the_edge_of_the_silhouette():
    camera, depth = water()
    places = camera.unproject(np.array([[20.5, 32.5], [24.5, 32.5], [60.5, 32.5]]), np.full(3, depth[32, 48]))
    g = Gaussians.isotropic(places, 0.1, np.zeros((3, 3)), 0.8)
    small = within_silhouette(g, COL >= 20, camera)
    pixel = depth[32, 48] / camera.focal[0]
    # half a pixel and four and a half from the edge; and far from it
    np.testing.assert_allclose(small.scales[:, 0], [0.03, 2.25 * pixel, 0.1], rtol=1e-4)
    np.testing.assert_array_equal(small.means, g.means)


def test_what_is_off_the_picture_does_not_contradict_its_silhouette():
    camera, _ = water()
    g = Gaussians.isotropic(np.array([[50.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, -9.0, 3.0]]), 0.1, np.zeros((3, 3)), 0.8)
    left = within_silhouette(g, COL > 70, camera)
    np.testing.assert_array_equal(left.means, g.means[[0, 2]])
    np.testing.assert_array_equal(left.scales, g.scales[[0, 2]])


# colours --------------------------------------------------------------------------------------------------------


def test_points_take_the_colour_of_their_pixel_or_of_the_nearest():
    frame, (camera, depth) = soft_picture(), water()
    uv = np.array([[10.5, 20.5], [95.5, 63.5]])
    points = camera.unproject(uv, depth[[20, 63], [10, 95]])
    np.testing.assert_allclose(picture_colours(frame, points, camera), frame[[20, 63], [10, 95]] / 255.0)
    outside = camera.unproject(np.array([[-500.0, 20.5]]), np.array([2.0]))
    np.testing.assert_allclose(picture_colours(frame, outside, camera), frame[20:21, 0] / 255.0)


def test_a_large_splat_takes_the_mean_of_what_it_covers_and_no_single_glint():
    camera, depth = water()
    frame = np.full((H, W, 3), 100, np.uint8)
    frame[32, 48] = 255
    point = camera.unproject(np.array([[48.5, 32.5]]), depth[32, 48][None])
    size = 4.0 * depth[32, 48] / camera.focal[0]  # 4 px in the picture
    assert picture_colours(frame, point, camera)[0, 0] == 1.0
    # a pixel has 1 / (2 pi 4^2) = 1 % of the weight of a splat of 4 px
    np.testing.assert_allclose(picture_colours(frame, point, camera, size=size)[0], 100 / 255, atol=0.01)


def test_fluid_colours_are_carried_beyond_the_mask():
    frame = np.full((H, W, 3), 10, np.uint8)
    mask = (ROW > 20) & (ROW < 40)
    frame[mask] = (0, 100, 200)
    carried = fluid_colour_frame(frame, mask)
    assert (carried == (0, 100, 200)).all()
    np.testing.assert_array_equal(fluid_colour_frame(frame, np.zeros((H, W), bool)), frame)


def test_a_third_of_the_frames_makes_a_fluid_pixel():
    fluid = np.zeros((3, 1, 4), bool)
    fluid[0, 0, 1], fluid[:2, 0, 2], fluid[:, 0, 3] = True, True, True
    np.testing.assert_array_equal(united_mask(fluid)[0], [False, False, True, True])
    np.testing.assert_array_equal(united_mask(fluid[:2])[0], [False, True, True, True])


# the background plate -------------------------------------------------------------------------------------------

BROWN, BLUE, BLACK = (120, 90, 60), (30, 90, 200), (15, 15, 15)


def passing_blob(rock=False):
    """A blue blob that crosses a brown scene; with a black rock, water flows all around it at all times."""
    frames = np.full((12, H, W, 3), BROWN, np.uint8)
    fluid = np.zeros((12, H, W), bool)
    for t in range(12):
        fluid[t] = np.hypot(COL - 8 * t, ROW - 30) < 10
    stone = np.hypot(COL - 48, ROW - 30) < 6
    if rock:
        fluid |= (np.hypot(COL - 48, ROW - 30) < 16)[None]
        fluid &= ~stone
        frames[:, stone] = BLACK
    frames[fluid] = BLUE
    return frames, fluid, stone


def test_behind_a_passing_fluid_its_background_is_found():
    frames, fluid, _ = passing_blob()
    plate = background_plate(frames, fluid)
    assert plate.seen.all()
    np.testing.assert_array_equal(plate.image, np.full((H, W, 3), BROWN))


def test_behind_a_fluid_that_never_goes_the_ground_around_it_is_painted():
    frames, fluid, _ = passing_blob()
    fluid[:, 40:56] = True
    frames[:, 40:56] = BLUE
    plate = background_plate(frames, fluid)
    assert not plate.seen[45, 48] and plate.seen[5, 5]
    # all ground is of one colour, so that any painting from it is; blending of bytes rounds
    np.testing.assert_allclose(plate.image.astype(int), np.broadcast_to(BROWN, (H, W, 3)), atol=3)


def test_behind_a_fluid_that_stands_the_layers_of_the_scene_go_on_and_no_seam_is_in_them():
    scene = np.where(ROW[..., None] < 20, (230, 235, 240), (40, 60, 30)).astype(np.uint8)  # sky over trees
    fluid = np.zeros((3, H, W), bool)
    fluid[:, 8:, 28:68] = True
    frames = np.where(fluid[..., None], np.uint8(128), scene)
    plate = background_plate(frames, fluid).image.astype(float)
    # in a hole 40 px wide the sky fades by exp(-3 pi / 40) per row: to 4 % of it, 8 grey levels, in row 34
    np.testing.assert_allclose(plate[34:, 48], np.broadcast_to((40, 60, 30), (H - 34, 3)), atol=12)
    assert (plate[8:14, 48] > 150).all()
    assert np.abs(np.diff(plate[34:, 32:64], axis=1)).max() < 4  # no seam where sides meet


def test_at_the_rim_of_wide_fluid_the_plate_shows_the_clip_and_of_a_jet_nothing():
    frames = np.tile(BROWN, (3, 120, 160, 1)).astype(np.uint8)
    fluid = np.zeros(frames.shape[:3], bool)
    fluid[:, 40:, 30:130] = True  # runs out of the picture below
    fluid[:, :40, 70:80] = True
    frames[fluid] = BLUE
    frames[:, :, 26:30] = BLACK  # what the rim of the inpainted ground must not touch
    plate = background_plate(frames, fluid, shore=True)
    shown = plate.image.astype(int)
    assert np.abs(shown[60:, :30] - frames[0, 60:, :30].astype(int)).max() <= 1  # bank, up to the fluid
    # of the blur over 1.5 px, a normal distribution's share beyond 5 px is left 0.4 %, beyond 3.5 px 2 * 1 %
    assert np.abs(shown[60:, 30] - BLUE).max() <= 2 and plate.kept[60:, 30:32].all()
    assert not plate.kept[70:, 40:120].any() and np.abs(shown[110:, 80] - BLUE).max() > 60
    assert not plate.kept[:30, 71:79].any() and np.abs(shown[:20, 75] - BROWN).max() <= 3
    assert (background_plate(frames, fluid).kept == plate.seen).all(), "smoke and jets leave none in the air"


def test_where_wide_fluid_sways_its_rim_is_not_left_in_the_plate():
    """The ground beside it is seen up to what it always covers: a line of fluid would stand in the open."""
    frames = np.tile(BROWN, (9, 120, 160, 1)).astype(np.uint8)
    fluid = np.zeros(frames.shape[:3], bool)
    for t in range(9):
        fluid[t, :, 30 + 5 * abs(t - 4) : 130] = True
    frames[fluid] = BLUE
    plate = background_plate(frames, fluid, shore=True)
    assert np.abs(plate.image[60, :60].astype(int) - BROWN).max() <= 12
    assert plate.kept[60, 126:130].all() and np.abs(plate.image[60, 129].astype(int) - BLUE).max() <= 2


def test_fluid_that_the_masks_of_a_few_frames_have_missed_is_no_ground():
    frames = np.tile(BROWN, (10, 120, 160, 1)).astype(np.uint8)
    fluid = np.zeros(frames.shape[:3], bool)
    fluid[:, 30:90] = True
    frames[fluid] = BLUE
    fluid[2, 55:65, 40:60] = False  # blue as ever
    fluid[3, 55:65, 100:120] = False
    frames[3, 55:65, 100:120] = BROWN  # there the water has gone
    plate = background_plate(frames, fluid, shore=True)
    assert not plate.seen[58:62, 45:55].any() and plate.seen[58:62, 105:115].all()
    to_bank, to_water = (np.abs(plate.image[60, 50].astype(int) - c).sum() for c in (BROWN, BLUE))
    assert to_bank < 0.2 * to_water


def test_rocks_stay_in_the_plate_but_do_not_colour_the_bed_beside_them():
    frames, fluid, stone = passing_blob(rock=True)
    plate = background_plate(frames, fluid, stone)
    core = np.hypot(COL - 48, ROW - 30) < 3
    # the seam is blended over 1.5 px on either side, whose tail reaches the core 3 px away with a few grey levels
    np.testing.assert_allclose(plate.image[core].astype(int), np.broadcast_to(BLACK, (core.sum(), 3)), atol=8)
    bed = (np.hypot(COL - 48, ROW - 30) > 10) & (np.hypot(COL - 48, ROW - 30) < 14)
    # ground, neither fluid nor rock
    np.testing.assert_allclose(np.median(plate.image[bed], axis=0), BROWN, atol=6)


def test_a_picture_full_of_fluid_has_no_background():
    frames, fluid, _ = passing_blob()
    plate = background_plate(frames, np.ones_like(fluid))
    assert not plate.seen.any()
    assert plate.image.shape == frames.shape[1:]


def test_colours_stay_within_what_the_picture_shows_around():
    from fluidlift.shape.generate import bounded_colours

    camera = PinholeCamera.from_fov(50, (40, 30))
    frame = np.full((30, 40, 3), 100, np.uint8)
    points = camera.unproject(np.array([[20.0, 15.0]]), np.array([1.0]))
    shrill = Gaussians.isotropic(points, 0.01, np.array([[1.0, 0.0, 1.0]]))
    held = bounded_colours(shrill, frame, camera, slack=0.04)
    np.testing.assert_allclose(held.rgb[0], [100 / 255 + 0.04, 100 / 255 - 0.04, 100 / 255 + 0.04], atol=1e-5)


@pytest.mark.parametrize("count", [1, 2, 5, 24])
def test_medians_of_what_counts_are_those_of_masked_arrays(count):
    rng = np.random.default_rng(count)
    frames, where = rng.integers(0, 256, (count, 20, 30, 3), np.uint8), rng.random((count, 20, 30)) < 0.5
    where[:, :3], where[:, 3:6], frames[:, :, :5] = False, True, 255
    values = np.ma.masked_array(frames, mask=np.repeat(~where[..., None], 3, axis=-1))
    plain = np.clip(np.ma.median(values, axis=0).filled(0), 0, 255).astype(np.uint8)
    np.testing.assert_array_equal(_median_where(frames, where), plain)
