"""Bed, banks, rocks, inlets and outlets of a straight channel; floors and vessels of jets and smoke."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from scipy import ndimage

from fluidlift.numerics.sampling import sample_nodes
from fluidlift.physics.apic import LiquidSimulator
from fluidlift.shape.airborne import airborne_setting, inside_body
from fluidlift.shape.channel import BEYOND, MARGIN, OUTLET, ChannelConfig, above_rim, channel_setting, upper_rim
from fluidlift.shape.filled_vessel import find_vessel
from fluidlift.shape.heights import PlaneHeight
from fluidlift.shape.plan import PlanEvidence
from fluidlift.shape.terrain import signed_distance_from
from fluidlift.types import CellType, FluidParameters, Label, Particles, PinholeCamera

WIDTH = 1.2
ROCK, ROCK_RADIUS = (0.35, 0.05), 0.18


def channel(mainstream=(1.0, 0.0, 0.0), *, slope=0.0, rock=True, along="x", tail=False, **options):
    """Water 1.2 m wide between straight banks, seen at 45 degrees from beside it; a rock stands in it."""
    camera = options.pop("camera", PinholeCamera.looking((0.0, -3.0, 3.0), (0.0, 0.0, 0.0), 50.0, (132, 96)))
    surface = PlaneHeight((slope, 0.0), 0.0)
    rays = camera.rays(camera.pixel_grid())
    depth = -camera.position[2] / (rays[..., 2] - slope * rays[..., 0])
    ground = camera.position + rays * depth[..., None]
    across = ground[..., 1] if along == "x" else ground[..., 0]
    labels = np.where(np.abs(across) < WIDTH / 2, Label.FLUID, Label.BACKGROUND)
    if tail:  # a thread of falsely marked pixels that runs up the bank
        labels[(np.abs(ground[..., 0]) < 0.04) & (across > 0) & (across < 2.5)] = Label.FLUID
    if "ends" in options:
        labels[options.pop("ends")(ground[..., 0], ground[..., 1])] = Label.BACKGROUND
    visible = ground[labels == Label.FLUID]
    if callable(rock):
        labels[rock(ground[..., 0], ground[..., 1])] = Label.SOLID
    elif rock:
        labels[np.hypot(ground[..., 0] - ROCK[0], ground[..., 1] - ROCK[1]) < ROCK_RADIUS] = Label.SOLID
    told = {k: options.pop(k) for k in ("speed", "scene_depth", "closed") if k in options}
    if "ever" in options:  # what is wet at some time, beside what is so now
        told["ever"] = (labels == Label.FLUID) | options.pop("ever")(ground[..., 0], ground[..., 1])
    seen = PlanEvidence(surface, labels.astype(np.uint8), visible, camera, np.array(mainstream), **told)
    setting = channel_setting(seen, ChannelConfig(**{"kind": "stream", "longest": 48, "cell_limit": 120_000} | options))
    return SimpleNamespace(
        setting=setting, grid=setting.terrain.grid, cells=setting.cell_types, phi=setting.terrain.signed_distance,
        bed=setting.bed_height, level=setting.surface_height, camera=camera,
    )  # fmt: skip


@pytest.fixture(scope="module")
def river():
    return channel()


def columns(scene):
    """x and y of each column."""
    return np.moveaxis(scene.grid.centers()[:, :, 0, :2], -1, 0)


def positions(scene, kind):
    return scene.grid.centers()[scene.cells == kind]


@pytest.mark.parametrize(("ratio", "expected"), [(None, 0.2), (0.4, 0.4)])
def test_water_is_as_deep_in_the_middle_as_its_width_says(ratio, expected):
    scene = channel(rock=False, depth_ratio=ratio)
    x, y = columns(scene)
    middle = (np.abs(y) < 0.15) & (np.abs(x) < 1.0)
    depth = np.median((scene.level - scene.bed)[middle])
    # the width is measured to a cell at either bank (of 1.2 m), the bed is smoothed over a cell
    assert depth == pytest.approx(expected * WIDTH, rel=0.12)


def test_water_is_shallow_at_the_banks(river):
    x, y = columns(river)
    depth = river.level - river.bed
    inner = np.abs(x) < 1.0
    rim = inner & (np.abs(np.abs(y) - 0.5) < 0.06)
    clear = inner & (np.abs(y) < 0.15) & (np.hypot(x - ROCK[0], y - ROCK[1]) > 0.4)
    assert np.median(depth[rim]) < 0.7 * np.median(depth[clear])


def test_banks_stand_above_the_water(river):
    x, y = columns(river)
    h = river.grid.spacing
    bank = (np.abs(y) > WIDTH / 2 + 2 * h) & (np.abs(x) < 1.0)
    assert bank.any()
    assert (river.bed[bank] > river.level[bank] + 0.3 * h).all()


def test_a_rock_stands_out_of_the_water_and_holds_none(river):
    x, y = columns(river)
    rock = np.hypot(x - ROCK[0], y - ROCK[1]) < ROCK_RADIUS - river.grid.spacing
    assert rock.any()
    assert (river.bed[rock] > river.level[rock]).all()
    assert not np.isin(river.cells[rock], [CellType.FLUID, CellType.INFLOW]).any()


def test_around_the_rock_there_is_water(river):
    x, y = columns(river)
    distance = np.hypot(x - ROCK[0], y - ROCK[1])
    ring = (distance > ROCK_RADIUS + 1.5 * river.grid.spacing) & (distance < ROCK_RADIUS + 3 * river.grid.spacing)
    assert (river.cells[ring] == CellType.FLUID).any(axis=-1).all()


def test_what_is_seen_of_the_water_is_not_inside_the_bank():
    scene = channel(rock=False)
    grid = scene.grid
    rays = scene.camera.rays(scene.camera.pixel_grid())
    ground = scene.camera.position + rays * (-scene.camera.position[2] / rays[..., 2])[..., None]
    seen = ground[(np.abs(ground[..., 1]) < WIDTH / 2) & (np.abs(ground[..., 0]) < 1.0)]
    # bed and bank meet the surface a third of a cell outside the middle of the last column that holds fluid, and a
    # seen point may be half a cell from it; the slope there is below 2
    assert sample_nodes(scene.phi, grid, seen).min() > -0.25 * grid.spacing


@pytest.mark.parametrize("stream", [(1.0, 0, 0), (-1.0, 0, 0)], ids=["right", "left"])
def test_water_enters_upstream_and_leaves_downstream(stream):
    scene = channel(stream)
    inlet, body, outlet = (
        positions(scene, k)[:, 0] * stream[0] for k in (CellType.INFLOW, CellType.FLUID, CellType.OUTFLOW)
    )
    assert len(inlet) and len(outlet)
    assert inlet.max() < body.min() + 3 * scene.grid.spacing
    assert inlet.mean() < np.percentile(body, 1)
    assert outlet.min() > np.percentile(body, 99)
    np.testing.assert_allclose(scene.setting.terrain.mainstream, stream, atol=1e-12)


def test_a_stream_along_the_view_is_open_at_its_near_and_far_ends():
    scene = channel((0.0, -1.0, 0.0), along="y", rock=False)
    assert positions(scene, CellType.INFLOW)[:, 1].mean() > 0.8 * positions(scene, CellType.FLUID)[:, 1].max()
    assert positions(scene, CellType.OUTFLOW)[:, 1].mean() < 0.8 * positions(scene, CellType.FLUID)[:, 1].min()


def test_no_water_is_inside_the_solid_nor_above_its_level(river):
    for kind in (CellType.FLUID, CellType.INFLOW):
        p = positions(river, kind)
        assert (sample_nodes(river.phi, river.grid, p) >= 0).all()
        assert (p[:, 2] < 0).all()
    solid = sample_nodes(river.phi, river.grid, positions(river, CellType.SOLID))
    assert (solid < 1e-6).all()  # the wall behind the inlet ends exactly at cell centres: zero up to rounding


def test_the_signed_distance_is_negative_below_the_bed_and_positive_above(river):
    nodes = river.grid.nodes()
    inner = (slice(2, -2), slice(2, -2))
    bed = 0.25 * sum(np.pad(river.bed, ((a, 1 - a), (b, 1 - b)), mode="edge") for a in (0, 1) for b in (0, 1))
    above = nodes[..., 2] - bed[..., None]
    np.testing.assert_array_equal(river.phi[inner] > 0, above[inner] > 0)


@pytest.mark.parametrize("rock", [False, True])
def test_the_signed_distance_grows_by_one_metre_per_metre(rock):
    scene = channel(rock=rock)
    h = scene.grid.spacing
    gradient = np.linalg.norm(np.stack(np.gradient(scene.phi.astype(float), h)), axis=0)
    near = np.abs(scene.phi) < 1.5 * h
    near[[0, 1, -1, -2]] = False
    near[:, [0, 1, -1, -2]] = False
    near[:, :, [0, -1]] = False
    # height over slope length is exact on planes only: the bed is curved, and bends at the waterline and at rocks
    assert np.median(gradient[near]) == pytest.approx(1.0, abs=0.1)
    assert np.percentile(np.abs(gradient[near] - 1), 90) < 0.5


def test_the_terrain_is_a_watertight_solid_that_points_outwards(river):
    mesh = trimesh.Trimesh(river.setting.terrain.mesh.vertices, river.setting.terrain.mesh.faces, process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent
    lower, upper = mesh.bounds
    # the ground over a flat floor: columns of the bed, and half a column at the rim that the open inlet changes
    columns = (river.bed - lower[2]).sum() * river.grid.spacing**2
    assert mesh.volume == pytest.approx(columns, rel=0.1)
    assert upper[2] > 0 > lower[2]


def test_no_wall_of_the_mesh_stands_where_water_enters_or_leaves():
    scene = channel(rock=False)
    v = scene.setting.terrain.mesh.vertices
    inlet = np.abs(v[:, 0] - v[:, 0].min()) < 1e-5
    outlet = np.abs(v[:, 0] - v[:, 0].max()) < 1e-5
    for end in (inlet, outlet):
        middle = end & (np.abs(v[:, 1]) < 0.3)
        assert v[middle, 2].max() < -0.1  # the bed lies 0.24 m down there
    # the simulated ground is closed behind the inlet
    behind = positions(scene, CellType.SOLID)
    assert (behind[(np.abs(behind[:, 1]) < 0.3) & (behind[:, 0] < v[inlet, 0].max() + scene.grid.spacing), 2] > 0).any()


def test_the_mesh_lies_on_the_zero_of_the_signed_distance():
    scene = channel(rock=False)
    v, h = scene.setting.terrain.mesh.vertices.astype(float), scene.grid.spacing
    inner = (np.abs(v[:, 0]) < 1.0) & (np.abs(v[:, 1]) < WIDTH / 2) & (v[:, 2] > -0.3)
    # a spline through heights at the nodes, beside values linear between them: they differ where the bank bends
    assert np.abs(sample_nodes(scene.phi, scene.grid, v[inner])).max() < 0.35 * h


def test_water_at_rest_loses_nothing_through_its_bed():
    scene = channel(longest=32, cell_limit=20_000)
    grid, terrain = scene.grid, scene.setting.terrain
    closed = np.where(scene.cells == CellType.SOLID, CellType.SOLID, CellType.EMPTY).astype(np.uint8)
    rng = np.random.default_rng(0)
    # the outlet is walled up and full: nothing should move
    full = (scene.cells == CellType.OUTFLOW) & (grid.centers()[..., 2] < 0)
    wet = np.argwhere(np.isin(scene.cells, [CellType.FLUID, CellType.INFLOW]) | full)
    corner = np.stack(np.meshgrid([0.25, 0.75], [0.25, 0.75], [0.25, 0.75], indexing="ij"), -1).reshape(-1, 3)
    start = (wet[:, None] + corner).reshape(-1, 3) + rng.uniform(-0.1, 0.1, (8 * len(wet), 3))
    start = grid.low + start * grid.spacing
    start = start[sample_nodes(terrain.signed_distance, grid, start) > 0]
    body = Particles.at_rest(start, 1.0)
    simulator = LiquidSimulator(grid, terrain, FluidParameters(time_step=0.02), body, cell_types=closed)
    for _ in range(10):
        report = simulator.advance(0.1)
    end = simulator.particles.positions
    assert report.removed == 0 and len(end) >= len(start)  # thinned places are seeded again
    # a particle may stand as far inside a bend of the bed as the cell's linear distance misses it
    assert sample_nodes(terrain.signed_distance, grid, end).min() > -0.25 * grid.spacing
    assert report.max_speed < 0.2  # falling through the bed for this second would give 9.8 m/s
    # it settles by no more than the unevenness of its first surface, which is half a cell
    assert abs(start[:, 2].mean() - end[:, 2].mean()) < 0.5 * grid.spacing


def test_a_rock_at_the_inlet_splits_it():
    reach = positions(channel(rock=False), CellType.INFLOW)[:, 0].min()
    scene = channel(rock=lambda x, y: np.hypot(x - reach - 0.3, y) < 0.25)
    x, y = columns(scene)
    ridge = (np.abs(y) < 0.1) & (np.abs(x - reach - 0.3) < 0.15)
    assert ridge.any() and (scene.bed[ridge] > scene.level[ridge]).all()
    inlet = (scene.cells == CellType.INFLOW).any(axis=2)
    assert not inlet[ridge].any()
    assert inlet[(y > 0.35) & (y < 0.5)].any() and inlet[(y < -0.35) & (y > -0.5)].any()


def scene_depth(camera, height):
    """Camera depth of ground at `height` (m) beyond the banks, nan on the water."""
    rays = camera.rays(camera.pixel_grid())
    depth = (height - camera.position[2]) / rays[..., 2]
    y = (camera.position + rays * depth[..., None])[..., 1]
    return np.where(np.abs(y) > 0.62, depth, np.nan)


def test_banks_are_as_high_as_the_scenes_depth_shows_them():
    plain = channel(rock=False)
    scene = channel(rock=False, scene_depth=scene_depth(plain.camera, 0.5))
    x, y = columns(scene)
    h = scene.grid.spacing
    far = (y > 0.62 + h) & (np.abs(x) < 0.8)
    assert far.any() and not np.allclose(plain.bed[far], 0.5, atol=h)
    np.testing.assert_allclose(scene.bed[far], 0.5, atol=0.1 * h)  # a median over the pixels of a column
    water = (np.abs(y) < 0.4) & (np.abs(x) < 1.0)
    np.testing.assert_array_equal(scene.bed[water], plain.bed[water])


def test_a_bank_that_the_depth_puts_below_the_water_still_holds_it():
    plain = channel(rock=False)
    scene = channel(rock=False, scene_depth=scene_depth(plain.camera, -0.5))
    x, y = columns(scene)
    h = scene.grid.spacing
    bank = (np.abs(y) > WIDTH / 2 + 2 * h) & (np.abs(x) < 1.0)
    assert (scene.bed[bank] > scene.level[bank] + 0.25 * h).all()


# where the clip stays dry ---------------------------------------------------------------------------------------


def never(x, y):
    return np.zeros(x.shape, bool)


def above_water(scene, cells):
    """Signed distance (m) over each column, so many cells above its water."""
    places = np.concatenate([scene.grid.centers()[:, :, 0, :2], scene.level[..., None]], axis=-1)
    places[..., 2] += cells * scene.grid.spacing
    return sample_nodes(scene.phi, scene.grid, places.reshape(-1, 3)).reshape(scene.level.shape)


def beside(scene, low, high):
    """Columns from `low` to `high` cells outside of the banks, away from both ends."""
    x, y = columns(scene)
    out = (np.abs(y) - WIDTH / 2) / scene.grid.spacing
    return (out > low) & (out < high) & (np.abs(x) < 0.6)


@pytest.fixture(scope="module")
def dry_beside():
    return channel(rock=False, ever=never)


def test_ground_that_stays_dry_stands_above_the_water(dry_beside):
    """A wave of a cell does not run up it; and it is a wall, no tower."""
    # the picture tells wet from dry to a column, and the corners between columns round it off by half of one
    rim = beside(dry_beside, 1.0, 2.0)
    assert rim.sum() > 20
    assert (above_water(dry_beside, MARGIN - 0.5)[rim] < 0).all()
    plain = channel(rock=False)
    assert (above_water(plain, MARGIN - 0.5)[beside(plain, 0.3, 1.0)] > 0).all(), "a bank slopes up to there"
    assert (above_water(dry_beside, MARGIN + 0.5)[rim] > 0).all()


def test_the_wall_stands_just_outside_of_the_water(dry_beside):
    """Its face is `BEYOND` cells from the rim of the wet columns: the stream is as wide as it was filmed."""
    h = dry_beside.grid.spacing
    middle = np.argmin(np.abs(columns(dry_beside)[0][:, 0]))
    y = np.linspace(0.3, 1.0, 400)
    x = np.full_like(y, columns(dry_beside)[0][middle, 0])
    phi = sample_nodes(dry_beside.phi, dry_beside.grid, np.stack([x, y, np.full_like(y, 0.5 * h)], axis=-1))
    face = y[np.argmax(phi < 0)]
    # half a column to either side for where columns lie, and half for the corners between them
    assert face == pytest.approx(WIDTH / 2 + BEYOND * h, abs=h)
    assert (phi[y < WIDTH / 2 - 1.5 * h] > 0).all()


def test_water_keeps_all_of_its_cells_beside_such_a_wall(dry_beside):
    plain = channel(rock=False)
    assert plain.grid == dry_beside.grid
    np.testing.assert_array_equal(plain.cells, dry_beside.cells)
    np.testing.assert_array_equal(plain.bed, dry_beside.bed)
    centers = dry_beside.grid.centers()[np.isin(dry_beside.cells, [CellType.FLUID, CellType.INFLOW])]
    # the wall's face may cut a cell of the rim, whose middle is a quarter of a cell from it at least
    assert sample_nodes(dry_beside.phi, dry_beside.grid, centers).min() > 0


def test_before_the_outlet_ground_is_no_wall(dry_beside):
    """The section in which a stream leaves is thinner, and needs room."""
    plain, h = channel(rock=False), dry_beside.grid.spacing
    x, _ = columns(dry_beside)
    stop = x[(dry_beside.cells == CellType.OUTFLOW).any(axis=2)].min() + 2.5 * h
    nodes = dry_beside.grid.nodes()[..., 0]
    behind = nodes > stop - OUTLET * h + 2 * h  # the corners between columns, and where the sections begin: to a cell
    assert behind.any()
    # the end of the wall is nearer than the bank is, but is not there
    np.testing.assert_array_equal(dry_beside.phi[behind] < 0, plain.phi[behind] < 0)
    before = nodes < stop - OUTLET * h - 2 * h
    assert ((dry_beside.phi < 0) & (plain.phi > 0))[before].any()


def test_ground_that_is_wet_at_some_time_is_no_wall():
    """A wave that comes once in the clip needs its way: one bank stays dry, the other is washed over."""
    scene = channel(rock=False, ever=lambda x, y: (y > 0) & (y < 1.0))
    _, y = columns(scene)
    rim, height = beside(scene, 1.0, 2.0), above_water(scene, MARGIN - 0.5)
    assert (height[rim & (y > 0)] > 0).all() and (height[rim & (y < 0)] < 0).all()


def test_where_the_clip_is_not_known_nothing_is_a_wall():
    plain, unknown = channel(rock=False), channel(rock=False, ever=lambda x, y: np.ones(x.shape, bool))
    np.testing.assert_array_equal(plain.phi, unknown.phi)


@pytest.mark.parametrize("closed", [False, True])
def test_a_river_of_known_metres_is_shallow_and_a_pond_and_an_assumed_size_are_not(closed):
    camera = PinholeCamera.looking((0.0, -60.0, 60.0), (0.0, 0.0, 0.0), 50.0, (132, 96))
    rays = camera.rays(camera.pixel_grid())
    ground = camera.position - rays * (camera.position[2] / rays[..., 2])[..., None]
    labels = np.where(np.abs(ground[..., 1]) < 12.0, Label.FLUID, Label.BACKGROUND).astype(np.uint8)
    water, along = ground[labels == Label.FLUID], np.array([1.0, 0, 0])
    seen = PlanEvidence(PlaneHeight((0.0, 0.0), 0.0), labels, water, camera, along, closed=closed)
    deepest = []
    for in_metres in (False, True):
        setting = channel_setting(seen, ChannelConfig("stream", 48, 120_000, in_metres=in_metres))
        wet = (setting.cell_types == CellType.FLUID).any(axis=2)
        deepest.append(float((setting.surface_height - setting.bed_height)[wet].max()))
    if closed:
        assert deepest[0] == deepest[1]
    else:  # 24 m wide: a fifth of it, and 1.0 m by Parker and others 2007, to a cell
        assert deepest[0] == pytest.approx(4.8, abs=0.5) and deepest[1] == pytest.approx(1.0, abs=0.3)


def test_a_closed_puddle_has_a_bank_on_all_sides():
    camera = PinholeCamera.looking((0.0, -3.0, 3.0), (0.0, 0.0, 0.0), 50.0, (132, 96))
    rays = camera.rays(camera.pixel_grid())
    ground = camera.position - rays * (camera.position[2] / rays[..., 2])[..., None]
    labels = np.where(np.hypot(ground[..., 0], ground[..., 1]) < 0.7, Label.FLUID, Label.BACKGROUND).astype(np.uint8)
    seen = PlanEvidence(
        PlaneHeight((0.0, 0.0), 0.0), labels, ground[labels == Label.FLUID], camera, np.array([1.0, 0, 0]), closed=True
    )
    setting = channel_setting(seen, ChannelConfig("stream", 48, 120_000))
    cells, grid = setting.cell_types, setting.terrain.grid
    assert set(np.unique(cells)) == {CellType.EMPTY, CellType.SOLID, CellType.FLUID}
    x, y = np.moveaxis(grid.centers()[:, :, 0, :2], -1, 0)
    rim = np.hypot(x, y) > 0.7 + 2 * grid.spacing
    assert (setting.bed_height[rim] > 0.3 * grid.spacing).all()
    box = np.ones(rim.shape, bool)
    box[1:-1, 1:-1] = False
    assert (setting.bed_height[box] > 0).all()
    # a fifth of the pool's true width
    assert -setting.bed_height.min() == pytest.approx(0.2 * 1.4, rel=0.1)


def beach(shore=0.2, longest=48):
    """Setting of water beyond a straight shore near the camera, cut by the picture on the three other sides."""
    camera = PinholeCamera.looking((0.0, -3.0, 3.0), (0.0, 0.0, 0.0), 50.0, (132, 96))
    rays = camera.rays(camera.pixel_grid())
    ground = camera.position - rays * (camera.position[2] / rays[..., 2])[..., None]
    labels = np.where(ground[..., 1] > -shore, Label.FLUID, Label.BACKGROUND).astype(np.uint8)
    wet = labels == Label.FLUID
    seen = PlanEvidence(
        PlaneHeight((0.0, 0.0), 0.0), labels, ground[wet], camera, np.array([1.0, 0, 0]), closed=True, goes_on=True,
        ever=wet,
    )  # fmt: skip
    return channel_setting(seen, ChannelConfig("basin", longest, 120_000))


def test_standing_water_goes_on_where_the_picture_cuts_it_and_deepens_away_from_its_shore():
    setting = beach()
    cells, grid = setting.cell_types, setting.terrain.grid
    assert set(np.unique(cells)) == {CellType.EMPTY, CellType.SOLID, CellType.FLUID}, "nothing flows in or out"
    y = grid.centers()[0, :, 0, 1]
    wet = (cells == CellType.FLUID).any(axis=2)
    far = y > 0.0
    assert wet[:, far].all(), "to the sides of the box, where its walls are"
    assert not wet[:, y < -0.2 - 2 * grid.spacing].any()
    depth = -setting.bed_height.mean(axis=0)
    near = (y > -0.1) & (y < 0.3)
    assert (np.diff(depth[near]) > -1e-3).all() and depth[near][-1] > depth[near][0] + grid.spacing
    assert (-setting.bed_height[[0, -1]][:, y > 1.0] > 0.5 * depth.max()).all(), "a cut is no shore"
    assert np.allclose(setting.surface_height, 0.0)


def sea(shore=2.0, pole=False, lean=0.0, **config):
    """Setting of a sea beyond a beach, built from higher than it is seen: its horizon is at a third of the picture.

    Without what is known of the horizon for comparison; `pole`: something stands before it; `lean`: px by which the
    horizon falls from left to right.
    """
    camera = PinholeCamera.looking((0.0, -6.0, 3.0), (0.0, 0.0, 0.0), 50.0, (132, 96))
    rays = camera.rays(camera.pixel_grid())
    ground = camera.position - rays * (camera.position[2] / np.minimum(rays[..., 2], -1e-3))[..., None]
    row = np.arange(96)[:, None] - lean * (np.arange(132) / 132.0 - 0.5)
    labels = np.where((ground[..., 1] > -shore) & (row >= 32), Label.FLUID, Label.BACKGROUND).astype(np.uint8)
    if pole:
        labels[28:36, 60:64] = Label.BACKGROUND
    wet = labels == Label.FLUID
    made = []
    for horizon in (((0.0, 31.0 - 0.5 * lean), (132.0, 31.0 + 0.5 * lean)), None):
        seen = PlanEvidence(
            PlaneHeight((0.0, 0.0), 0.0), labels, ground[wet], camera, np.array([1.0, 0, 0]), closed=True, goes_on=True,
            ever=wet, horizon=horizon,
        )  # fmt: skip
        made.append(channel_setting(seen, ChannelConfig("basin", **{"longest": 64, "cell_limit": 250_000} | config)))
    return (*made, camera)


def test_a_sea_ends_at_its_horizon_and_not_at_a_bank_of_sky():
    setting, walled, camera = sea(pole=True)
    grid = setting.terrain.grid
    assert (walled.bed_height[:, -1] > 0).all(), "a bank, without the horizon"
    assert (setting.bed_height[:, -1] < 0).all()
    top = grid.centers()[:, -1, 0].copy()
    top[:, 2] = 0.0
    line = camera.project(top)[0][:, 1]
    assert (line > 31.0 - 2.0).all() and line.max() < 34.0, "no water in the sky, none missing below it"
    wet = (setting.cell_types == CellType.FLUID).any(axis=2)
    assert wet[:, -2:].mean() > 0.9, "neither does what stands before the horizon"


def test_a_horizon_that_leans_leaves_no_water_beyond_it():
    setting, _, camera = sea(lean=8.0)
    grid, terrain = setting.terrain.grid, setting.terrain
    level = grid.centers()[:, :, 0].copy()
    level[..., 2] = 0.0
    uv = camera.project(level)[0]
    beyond = uv[..., 1] < 31.0 + 8.0 * (uv[..., 0] / 132.0 - 0.5)
    assert 0.02 < beyond.mean() < 0.3
    assert not (setting.cell_types == CellType.FLUID).any(axis=2)[beyond].any()
    level[..., 2] = 0.5 * grid.spacing
    inner = ndimage.binary_erosion(beyond, iterations=2, border_value=1)
    assert inner.any() and (sample_nodes(terrain.signed_distance, grid, level[inner]) < 0).all(), "it stays dry"
    assert (setting.bed_height[beyond] < 0).all(), "and no bank is shown"


def test_a_sea_shelves_as_sand_does_and_its_beach_is_flat():
    setting, _, _ = sea()
    grid = setting.terrain.grid
    x, y = np.moveaxis(grid.centers()[:, :, 0, :2], -1, 0)
    away = y + 2.0
    deep = (away > 8 * grid.spacing) & (np.abs(x) < 1.0)
    # Dean 1977: h = A x^(2/3); a column by which the waterline is off is then a twelfth of it. A in metres, or so much
    # more that the far end is eight cells deep
    profile = -setting.bed_height[deep] / away[deep] ** (2 / 3)
    np.testing.assert_allclose(profile, np.median(profile), rtol=0.12)
    assert np.median(profile) > 0.9 * 0.125
    assert -setting.bed_height.min() == pytest.approx(max(8.0 * grid.spacing, 0.125 * away.max() ** (2 / 3)), rel=0.12)
    dry = (away < -2 * grid.spacing) & (np.abs(x) < 1.0)
    rise = np.polyfit(-away[dry], setting.bed_height[dry], 1)[0]
    assert 1 / 25 < rise < 1 / 15, "as in experiments on beaches"


def test_a_depth_that_is_asked_for_is_that_of_a_sea_as_well():
    setting, _, _ = sea(depth_ratio=0.3)
    assert -setting.bed_height.min() > 1.0


def lines_of_sight(scene, points):
    """Least height (m) of lines from points [n,3] to the camera over the ground, a column and a half away and more."""
    grid = scene.grid
    least = np.full(len(points), np.inf)
    for share in np.linspace(0.0, 1.0, 400)[1:-1]:
        at = points + share * (scene.camera.position - points)
        column = grid.cell_of(at)[:, :2]
        inside = ((column >= 0) & (column < grid.shape[:2])).all(axis=1)
        inside &= np.hypot(*(at - points)[:, :2].T) > 1.5 * grid.spacing
        least[inside] = np.minimum(least[inside], at[inside, 2] - scene.bed[tuple(column[inside].T)])
    return least


def test_no_bank_and_no_rock_hides_water_that_is_seen():
    flat = PinholeCamera.looking((0.0, -4.0, 0.8), (0.0, 0.0, 0.0), 50.0, (132, 96))
    scene = channel(camera=flat)
    x, y = columns(scene)
    clear = np.hypot(x - ROCK[0], y - ROCK[1]) > ROCK_RADIUS + scene.grid.spacing
    seen = (np.abs(y) < 0.5 * WIDTH - scene.grid.spacing) & (np.abs(x) < 1.0) & clear
    points = np.stack([x[seen], y[seen], scene.level[seen]], axis=1)
    shadow = (points[:, 1] > ROCK[1]) & (np.abs(points[:, 0] - ROCK[0]) < 2 * ROCK_RADIUS)  # not seen, in the picture
    assert (lines_of_sight(scene, points[~shadow]) > -0.3 * scene.grid.spacing).all()
    bank = (y > 0.5 * WIDTH + 2 * scene.grid.spacing) & (np.abs(x) < 1.0)
    assert scene.bed[bank].max() > 1.5 * scene.grid.spacing, "the far one rises behind the water"
    near = (y < -0.5 * WIDTH - scene.grid.spacing) & (np.abs(x) < 1.0)
    assert (scene.bed[near] > 0).all(), "above the water it stays"


def test_standing_water_at_rest_stays_at_rest():
    setting = beach(longest=20)
    grid, wet = setting.terrain.grid, setting.cell_types == CellType.FLUID
    start = np.concatenate([grid.centers()[wet] + 0.25 * grid.spacing * np.array(o) for o in np.ndindex(2, 2, 2)])
    start = start[sample_nodes(setting.terrain.signed_distance, grid, start) > 0]
    simulator = LiquidSimulator(
        grid, setting.terrain, FluidParameters(time_step=0.01), Particles.at_rest(start, 1.0, np.arange(len(start))),
        cell_types=setting.cell_types,
    )  # fmt: skip
    for _ in range(4):
        simulator.advance(0.05)
    after = simulator.particles
    assert len(after) == len(start)
    assert np.abs(np.percentile(after.positions[:, 2], 99) - np.percentile(start[:, 2], 99)) < 0.5 * grid.spacing
    assert np.linalg.norm(after.velocities, axis=1).mean() < 0.1 * np.sqrt(9.81 * grid.spacing)


def test_a_dry_corner_beyond_the_end_of_the_stream_is_no_bank():
    from fluidlift.shape.plan import _without_corners

    label = np.full((12, 10), Label.FLUID, np.uint8)
    label[:, :2] = Label.BACKGROUND  # a bank all along
    label[9:, 8:] = Label.BACKGROUND  # a corner of its own
    source = np.zeros(label.shape, bool)
    source[2:8] = True
    out = _without_corners(label, source)
    assert (out[:, :2] == Label.BACKGROUND).all() and (out[:, 2:] == Label.FLUID).all()


def test_a_thread_of_the_mask_does_not_widen_the_box():
    plain, threaded = channel(rock=False), channel(rock=False, tail=True)
    assert threaded.grid.high[1] == pytest.approx(plain.grid.high[1], abs=2 * plain.grid.spacing)
    x, y = columns(threaded)
    assert (threaded.bed[(np.abs(x) < 0.1) & (y > 0.9)] > 0).all()


def test_the_ground_is_the_same_whenever_it_is_built():
    first, second = channel(), channel()
    np.testing.assert_array_equal(first.phi, second.phi)
    np.testing.assert_array_equal(first.setting.terrain.mesh.vertices, second.setting.terrain.mesh.vertices)


def test_a_tilted_surface_is_followed_by_its_bed():
    scene = channel(slope=-0.1, rock=False)
    x, y = columns(scene)
    middle = (np.abs(y) < 0.15) & (np.abs(x) < 1.0)
    np.testing.assert_allclose(scene.level[middle], -0.1 * x[middle], atol=1e-9)
    fall = np.polyfit(x[middle], scene.bed[middle], 1)[0]
    assert fall == pytest.approx(-0.1, abs=0.01)


def test_the_grid_keeps_to_its_limit_and_holds_the_water():
    scene = channel(cell_limit=8000)
    assert scene.grid.cells <= 8000
    assert scene.grid.contains(positions(scene, CellType.FLUID)).all()
    assert (scene.cells == CellType.FLUID).sum() > 100


def test_the_inlet_is_closed_behind(river):
    inlet = river.cells == CellType.INFLOW
    first = int(np.argwhere(inlet)[:, 0].min())
    assert first > 0
    behind = river.cells[first - 1][inlet[first]]
    assert (behind == CellType.SOLID).all()


def test_distance_above_a_slope_is_shorter_than_height():
    x = np.linspace(0, 1, 11)
    above = (np.linspace(-1, 1, 21)[None, None, :] - 0.75 * x[:, None, None]) * np.ones((1, 11, 1))
    phi = signed_distance_from(above, 0.1, 1.25)
    near = np.abs(above) < 0.15
    np.testing.assert_allclose(phi[near], above[near] / 1.25)
    np.testing.assert_array_equal(phi > 0, above > 0)


# in the air -----------------------------------------------------------------------------------------------------


def airborne(kind, parts):
    """Round bodies about vertical axes, (radius, low, high) in metres, seen level from 3 m."""
    camera = PinholeCamera.looking((0.0, -3.0, 0.5), (0.0, 0.0, 0.5), 30.0, (120, 120))
    rays, eye = camera.rays(camera.pixel_grid()), camera.position
    flat = (rays[..., :2] ** 2).sum(-1)
    along = rays[..., 1] * eye[1]
    front, back, mask = np.zeros((120, 120)), np.zeros((120, 120)), np.zeros((120, 120), bool)
    for radius, low, high in parts:
        root = along**2 - flat * (eye[1] ** 2 - radius**2)
        near = (-along - np.sqrt(np.maximum(root, 0))) / flat
        far = (-along + np.sqrt(np.maximum(root, 0))) / flat
        z = eye[2] + rays[..., 2] * near
        hit = (root > 0) & (z > low) & (z < high) & ~mask
        front[hit], back[hit] = near[hit], far[hit]
        mask |= hit
    grid = camera.pixel_grid()
    body = np.concatenate([camera.unproject(grid[mask], d[mask]) for d in (front, 0.5 * (front + back), back)])
    down = np.array([0, 0, -1.0 if kind == "pour" else 1.0])
    vessel = find_vessel(camera, mask, 3.0) if kind == "pour" else None
    setting = airborne_setting(
        front, back, mask, camera, body, down, kind=kind, longest=40, cell_limit=120_000, vessel=vessel
    )
    return SimpleNamespace(setting=setting, grid=setting.terrain.grid, cells=setting.cell_types, body=body)


JET, POOL = (0.05, 0.35, 1.0), (0.4, 0.0, 0.35)


def test_a_jet_above_a_wide_pool_gets_a_vessel():
    scene = airborne("pour", [JET, POOL])
    # 1 px of 13 mm; of the pool the near wall alone is drawn, whose edge is seen 23 mm below the axis' level
    assert scene.setting.pool_level == pytest.approx(0.35 - 0.023, abs=0.013)
    h = scene.grid.spacing
    # the wall stands around the pool: solid half way up, just outside its radius of 0.4 m, all around
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = 0.4 + 1.2 * h
    wall = np.column_stack([ring * np.cos(turn), ring * np.sin(turn), np.full(24, 0.15)])
    inside = np.column_stack([0.3 * np.cos(turn), 0.3 * np.sin(turn), np.full(24, 0.15)])
    assert (sample_nodes(scene.setting.terrain.signed_distance, scene.grid, wall) < 0).mean() > 0.9
    assert (sample_nodes(scene.setting.terrain.signed_distance, scene.grid, inside) > 0).all()


def test_a_plain_jet_gets_none():
    scene = airborne("pour", [(0.05, 0.0, 1.0)])
    assert scene.setting.pool_level is None
    # only the floor is solid
    assert positions(scene, CellType.SOLID)[:, 2].max() < 0.0 + scene.grid.spacing


def test_smoke_gets_no_vessel():
    assert airborne("plume", [(0.1, 0.5, 1.0), POOL]).setting.pool_level is None


@pytest.mark.parametrize(("kind", "sign"), [("pour", 1.0), ("plume", -1.0)])
def test_jets_enter_from_above_and_smoke_from_below(kind, sign):
    scene = airborne(kind, [(0.08, 0.0, 1.0)])
    inlet, body = scene.cells == CellType.INFLOW, scene.cells == CellType.FLUID
    assert inlet.any() and body.any()
    # column by column: the end of what the picture cuts need not be level
    z = sign * scene.grid.centers()[..., 2]
    lowest, highest = np.where(inlet, z, np.inf).min(axis=2), np.where(body, z, -np.inf).max(axis=2)
    fed = inlet.any(axis=2)
    assert (lowest > highest)[fed].all()
    assert fed[body.any(axis=2)].mean() > 0.9, "all of its section"
    assert (scene.cells == CellType.OUTFLOW).any()
    assert scene.setting.surface_height is None


def test_the_cells_of_a_jet_have_its_volume():
    scene = airborne("pour", [(0.08, 0.0, 1.0)])
    wet = np.isin(scene.cells, [CellType.FLUID, CellType.INFLOW]).sum() * scene.grid.spacing**3
    # 6 cells of 27 mm across: cells are counted by their centres, and the lowest layer is taken by the floor
    assert wet == pytest.approx(np.pi * 0.08**2, rel=0.15)


def test_the_box_holds_all_of_the_body():
    scene = airborne("plume", [(0.1, 0.0, 1.0)])
    assert scene.grid.contains(scene.body).mean() > 0.99


def test_inside_is_between_the_near_and_the_far_side():
    camera = PinholeCamera.from_fov(60.0, (10, 10))
    front, back = np.full((10, 10), 2.0), np.full((10, 10), 3.0)
    mask = np.zeros((10, 10), bool)
    mask[:, :5] = True
    left, right = [3.5, 5.5], [7.5, 5.5]
    uv = np.array([left, left, left, right, [-50.0, 5.5]])
    points = camera.unproject(uv, np.array([1.9, 2.5, 3.1, 2.5, 2.5]))
    np.testing.assert_array_equal(
        inside_body(np.vstack([points, -points[1]]), front, back, mask, camera), [0, 1, 0, 0, 0, 0]
    )


def test_a_pointed_end_of_the_mask_is_no_nozzle():
    from fluidlift.shape.plan import wide_ends

    x, y = np.meshgrid(np.arange(60) * 0.1, np.arange(20) * 0.1, indexing="ij")
    water = np.abs(y - 0.95) < np.clip(0.25 * x, 0.0, 0.8)  # a wedge that opens over the first 3.2 m
    start, stop = wide_ends(water, x, (0.0, 6.0), 0.1, share=0.4)
    # 0.4 of the typical width of 1.6 m is reached at x = 1.28 m, but only 15 % of the length may be given up
    assert start == pytest.approx(0.9, abs=0.1)
    assert stop == pytest.approx(6.0, abs=0.15)


def test_a_channel_does_not_go_on_over_ground_that_is_seen_dry_far_from_its_mask():
    """A dam across a river at a slant, in the middle of the picture: the river begins below it."""
    slanted = channel(rock=False, ends=lambda x, y: (x < -0.7 + 0.5 * y) & (np.abs(y) < WIDTH / 2))
    x, y = columns(slanted)
    h, inside = slanted.grid.spacing, np.abs(y) < WIDTH / 2 - 2 * slanted.grid.spacing
    wet = np.isin(slanted.cells, (CellType.FLUID, CellType.INFLOW)).any(axis=2)
    leaves = (slanted.cells == CellType.OUTFLOW).any(axis=2)
    behind = inside & (x < -0.7 + 0.5 * y - 0.3)
    assert behind.sum() > 20 and not wet[behind].any()
    assert (wet | leaves)[inside & (x > -0.7 + 0.5 * y + 2 * h)].mean() > 0.95


def test_a_ragged_curtain_is_fed_along_its_whole_edge():
    along = np.array([1.0, 0.0])
    level = np.repeat(np.linspace(2.0, 0.0, 20)[:, None], 6, axis=1)
    water = np.ones((20, 6), bool)
    water[:2] = False
    water[:5, 3] = False  # a notch in the edge
    rim = upper_rim(water, level, along, 0.1)
    assert rim[2:4, [0, 1, 2, 4, 5]].all() and rim[5:7, 3].all()
    assert not rim[10:].any()


@pytest.mark.parametrize(("slope", "deep"), [(4.0, 1), (1.0, 2), (0.0, 2)])
def test_a_curtain_is_fed_by_a_cross_section_at_its_rim_and_not_down_its_face(slope, deep):
    """Water that falls is faster below: an inlet down the face would bring in more than passes the rim."""
    h, n = 0.1, 12
    i = np.arange(n)[:, None] + np.zeros((1, 9))
    water = (i >= 2) & (np.arange(9) > 0) & (np.arange(9) < 8)
    level = -slope * h * i
    if slope == 0.0:  # flat, then over a lip: the bulk flow says where it comes from
        level = np.where(i > 8, -3.0 * h * (i - 8), 0.0)
    rim = upper_rim(water, level, np.array([1.0, 0.0]), h)
    assert rim[2 : 2 + deep, 2:7].all()
    assert not rim[2 + deep :].any()  # 2.5 cells on the surface are 0.6, 1.8 and 2.5 columns; one at least


def test_a_ragged_curtain_is_fed_along_its_whole_upper_edge_whichever_way_the_pool_runs():
    h = 0.1
    i, j = np.indices((16, 12))
    water = i >= 2 + np.abs(j - 6) // 2
    level = -3.0 * h * np.minimum(i, 9).astype(float)
    rim = upper_rim(water, level, np.array([0.6, 0.8]), h)  # the pool leads off to the side
    inner = slice(2, 10)  # sides are where the picture ends
    first = water[:, inner].argmax(axis=0)
    assert rim[first, np.arange(2, 10)].all()
    assert rim[:, inner].sum(axis=0).max() <= 2
    assert not rim[8:, inner].any()


def test_what_comes_over_a_rim_has_no_bank_there_but_has_its_sides():
    h, n = 0.1, 14
    i, j = np.indices((n, 11))
    water = (i >= 4) & (j >= 2) & (j < 9)
    level = -2.0 * h * i
    open_end = above_rim(water, level, np.array([1.0, 0.0]), h, 3)
    assert open_end[1:4, 2:9].all(), "the way down from there leads to the water"
    assert not open_end[:1].any() and not open_end[:, [0, 1, 9, 10]].any()
    assert not (open_end & water).any() and not above_rim(water[::-1], level, np.array([1.0, 0.0]), h, 3)[10:].any()
