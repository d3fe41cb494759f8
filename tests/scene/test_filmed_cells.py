"""Cells that the clip shows dry, or wet: by what the camera sees of them, and what a simulation does there."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from fluidlift.config import build_config
from fluidlift.messages import code_of
from fluidlift.physics.refill import Refill
from fluidlift.pipeline.settings import SimulateSettings, taken
from fluidlift.pipeline.stages import simulate
from fluidlift.scene.filmed_cells import MARGIN, dry_cells, filmed_shares, wet_cells
from fluidlift.scene.simulator import simulator_of, within_outlet
from fluidlift.types import (
    CellType,
    FaceVelocity,
    Grid,
    Label,
    Particles,
    PinholeCamera,
    Terrain,
    TriangleMesh,
    kind_of,
)
from fluidlift.types.fluid_masks import FluidMasks

GRID = Grid((20, 16, 12), 0.1, (-1.0, -0.8, 0.0))
EYE = np.array([0.0, 0.0, 5.0])


def camera_above() -> PinholeCamera:
    """Looks straight down at the grid; a cell at the floor is about 8 px wide."""
    return PinholeCamera.looking(EYE, np.array([0.0, 1e-3, 0.0]), 40.0, (300, 240))


def flat(grid: Grid = GRID, wall: np.ndarray | None = None) -> Terrain:
    """A floor at z = 0.1, with heights of its own where `wall` says so."""
    heights = np.full((grid.shape[0] + 1, grid.shape[1] + 1), 0.1) if wall is None else wall
    mesh = TriangleMesh(np.zeros((3, 3), np.float32), np.array([[0, 1, 2]]), np.zeros((3, 3), np.float32))
    slope_x, slope_y = np.gradient(heights, grid.spacing)
    away = (grid.nodes()[..., 2] - heights[..., None]) / np.sqrt(1.0 + slope_x**2 + slope_y**2)[..., None]
    return Terrain(grid, away.astype(np.float32), np.array([1.0, 0.0, 0.0]), mesh)


def types_of(terrain: Terrain) -> np.ndarray:
    solid = terrain.grid.centers()[..., 2] < 0.1
    return np.where(solid, np.uint8(CellType.SOLID), np.uint8(CellType.EMPTY))


def wet_half(camera: PinholeCamera) -> np.ndarray:
    """The fluid fills the half of the picture in which x is negative."""
    rays = camera.rays(camera.pixel_grid())
    return rays[..., 0] < 0


def test_what_is_seen_more_than_a_margin_beside_the_fluid_is_dry_and_nothing_else():
    terrain, camera = flat(), camera_above()
    dry = dry_cells(terrain, camera, wet_half(camera), types_of(terrain))
    centres = GRID.centers()
    seen_at = centres[..., 0] / (EYE[2] - centres[..., 2])  # tangent of the angle from the picture's middle
    beyond = seen_at * (EYE[2] - centres[..., 2])
    assert not dry[beyond < (MARGIN - 0.1) * GRID.spacing].any()
    clear = (beyond > (MARGIN + 0.2) * GRID.spacing) & (centres[..., 2] > 0.1)
    assert dry[clear].all() and clear.sum() > 500
    assert not dry[centres[..., 2] < 0.1].any(), "ground is neither"


def test_what_ground_hides_from_the_camera_may_be_wet():
    camera = PinholeCamera.looking(np.array([-4.0, 0.0, 0.6]), np.array([0.0, 0.0, 0.5]), 40.0, (300, 240))
    heights = np.full((21, 17), 0.1)
    heights[10, :] = 0.9  # a wall across the view
    terrain = flat(wall=heights)
    wet = np.zeros((240, 300), bool)
    wet[:4, :4] = True
    dry = dry_cells(terrain, camera, wet, types_of(terrain))
    assert dry[4, 8, 4] and not dry[14, 8, 4], "before the wall and behind it"
    assert dry[14, 8, 11], "above it"


def test_nothing_comes_twice_as_near_as_the_nearest_fluid():
    camera = PinholeCamera.looking(np.array([-1.2, 0.0, 0.6]), np.array([0.0, 0.0, 0.5]), 60.0, (300, 240))
    types = types_of(flat())
    types[15:, :, 1:3] = CellType.FLUID  # from x = 0.5 on: 1.7 m away
    dry = dry_cells(flat(), camera, np.ones((240, 300), bool), types)
    assert dry[4, 8, 5] and not dry[11, 8, 5], "0.65 and 1.35 m away"
    assert not dry[types == CellType.FLUID].any()


def test_a_picture_full_of_fluid_or_without_any_says_nothing():
    terrain, camera = flat(), camera_above()
    for wet in (np.ones((240, 300), bool), np.zeros((240, 300), bool)):
        assert not dry_cells(terrain, camera, wet, types_of(terrain)).any()
    with pytest.raises(ValueError, match="a mask"):
        dry_cells(terrain, camera, np.ones((3, 3), bool), types_of(terrain))


def test_fluid_that_gets_into_dry_cells_is_taken_out_and_counted(channel):
    scene = channel(6)
    grid = scene.terrain.grid
    free = simulator_of(scene)
    dry = np.zeros(grid.shape, bool)
    dry[grid.shape[0] // 2 :] = True  # the lower half of the channel
    kept = simulator_of(replace(scene, dry=dry))
    assert not dry[tuple(grid.cell_of(kept.particles.positions).T)].any(), "nor is any there at first"
    for _ in range(4):
        free.advance(scene.interval)
        report = kept.advance(scene.interval)
    assert not dry[tuple(np.clip(grid.cell_of(kept.particles.positions), 0, np.array(grid.shape) - 1).T)].any()
    assert dry[tuple(np.clip(grid.cell_of(free.particles.positions), 0, np.array(grid.shape) - 1).T)].any()
    assert kept.drained > 0 and report.removed > 0 and free.drained == 0
    again = simulator_of(replace(scene, dry=dry))
    again.restore(kept.state())
    assert again.drained == kept.drained


def test_an_outline_that_grows_is_known_to_the_end_of_its_clip_and_one_that_stays_for_good():
    labels = np.full((20, 30, 30), Label.BACKGROUND, np.uint8)
    for t, frame in enumerate(labels):
        frame[25 - t : 25, 10:20] = Label.FLUID
    grows, stays = FluidMasks(labels), FluidMasks(labels[-1:].repeat(4, axis=0))
    sways = FluidMasks(np.stack([np.roll(labels[10], t, axis=1) for t in range(10)]))
    for kind, masks, held, dry_for in (
        ("pour", grows, True, 0.8), ("pour", stays, True, np.inf), ("stream", grows, False, np.inf),
        ("pour", sways, True, np.inf), ("pour", grows, False, np.inf), ("plume", grows, False, 0.8),
    ):  # fmt: skip
        shares, known = filmed_shares(kind_of(kind), masks, 0.8, held=held)
        assert known == dry_for, "what is poured goes on to rise where a vessel takes it, or it would flood a table"
        np.testing.assert_array_equal(shares, masks.shares())
    shares, _ = filmed_shares(kind_of("dam"), grows, 0.8, held=False)
    assert shares is None, "it would lose fluid that nothing brings back"


def test_of_an_outline_that_grows_cells_stay_dry_as_long_as_its_clip(channel):
    scene = channel(6)
    grid, dry = scene.terrain.grid, np.zeros(scene.terrain.grid.shape, bool)
    dry[grid.shape[0] // 2 :] = True
    simulator = simulator_of(replace(scene, dry=dry, dry_for=2.5 * scene.interval))
    for k in range(1, 6):
        simulator.advance(scene.interval)
        if k == 2:
            within, drained = (dry & held(simulator)).any(), simulator.drained
    assert not within and drained > 0, "while the clip lasts"
    assert (dry & held(simulator)).any() and simulator.drained == drained, "afterwards nobody has seen what is there"
    for_good = replace(scene, dry=dry)
    assert for_good.parts["dry cells"] != replace(for_good, dry_for=1.0).parts["dry cells"]


def test_cells_of_the_body_that_are_fluid_in_nearly_all_frames_are_wet():
    camera = camera_above()
    shares = np.where(wet_half(camera), np.float32(0.97), np.float32(0.9))
    body = GRID.centers()[:, :, 3].reshape(-1, 3)
    wet = wet_cells(GRID, camera, shares, body)
    centres = GRID.centers()
    assert wet[centres[..., 0] < -0.1].any() and not wet[centres[..., 0] > 0.1].any()
    np.testing.assert_array_equal(np.unique(np.argwhere(wet)[:, 2]), [3])
    with pytest.raises(ValueError, match="shares"):
        wet_cells(GRID, camera, np.ones((3, 3), np.float32), body)


def leaking(channel, wet):
    """The channel after two frames in which it ran out of its middle, whose cells may be kept wet."""
    scene = channel(3)
    middle = np.zeros(scene.terrain.grid.shape, bool)
    middle[3:8] = True
    simulator = simulator_of(replace(scene, wet=middle if wet else None))
    at_rest = held(simulator)
    simulator.drains = middle
    for _ in range(2):
        report = simulator.advance(scene.interval)
    lost = middle & at_rest & ~ndimage.binary_dilation(held(simulator), np.ones((5, 5, 5)))
    return simulator, lost, report


def held(simulator):
    """Cells with particles."""
    grid = simulator.grid
    found = np.zeros(grid.shape, bool)
    found[tuple(np.clip(grid.cell_of(simulator.particles.positions), 0, np.array(grid.shape) - 1).T)] = True
    return found


def test_cells_that_the_clip_shows_wet_do_not_run_dry(channel):
    free, lost, before = leaking(channel, wet=False)
    assert lost.sum() > 10 and free.refilled == 0
    kept, lost, report = leaking(channel, wet=True)
    assert not lost.any() and report.emitted >= before.emitted + 8 * 2 * 8 * 2
    assert kept.refilled > 0.3 * kept.drained > 0, "what ran out, but for cells beside those that are full"
    assert kept.volume > free.volume
    again = simulator_of(channel(3))
    again.restore(kept.state())
    assert again.refilled == kept.refilled > 0


@pytest.mark.parametrize("kind", ["stream", "pour"])
def test_much_water_that_is_put_in_is_told_of_all_kinds(channel, tmp_path, monkeypatch, kind):
    middle = np.zeros(channel(3).terrain.grid.shape, bool)
    middle[3:8] = True

    def leaking_simulator(scene, device, **more):
        simulator = simulator_of(scene, device, **more)
        simulator.drains = middle
        return simulator

    monkeypatch.setattr(simulate, "simulator_of", leaking_simulator)
    config = taken(SimulateSettings, build_config().simulate)
    told = {}
    for wet in (None, middle):
        scene = channel(3, kind=kind, wet=wet)
        found = simulate.simulate(scene, config, folder=tmp_path / f"{kind}{wet is None}")
        told[wet is None] = {code_of(w) for w in found.warnings}
    assert "refilled" in told[False] and "refilled" not in told[True]
    assert ("strayed" in told[True]) == (kind == "stream")


def test_what_fills_a_dry_cell_moves_as_filmed_and_keeps_clear_of_ground():
    velocity = FaceVelocity(*(np.full(GRID.face_shape(a), v, np.float32) for a, v in enumerate((0.3, 0.0, -0.2))))
    body = Particles.at_rest(GRID.centers()[4:12, 4:12, :3].reshape(-1, 3), 1.0)
    refill = Refill(np.ones(GRID.shape, bool), velocity, body, flat(), camera_above())
    rng = np.random.default_rng(0)
    assert not len(refill.missing(body.positions, 0.05, rng))
    half = body.positions[body.positions[:, 0] < -0.2]
    places = refill.missing(half, 0.05, rng)
    cells = np.unique(GRID.cell_of(places), axis=0)
    assert len(places) == 8 * len(cells) and 1 <= cells[:, 0].min() - GRID.cell_of(half)[:, 0].max() <= 2
    nearer = body.positions + np.float32([0.0, 0.0, 0.3])
    assert not len(refill.missing(nearer, 0.05, rng)), "what came nearer is no hole"
    assert cells[:, 0].max() == 11, "not beyond the body at rest"
    assert cells[:, 2].min() == 1, "the ground lies below z = 0.1"
    new = refill.particles(places, 2.0, 70)
    np.testing.assert_allclose(new.velocities, np.tile(np.float32([0.3, 0.0, -0.2]), (len(new), 1)), atol=1e-6)
    assert new.ids[0] == 70 and (new.masses == 2.0).all()


def test_an_inlet_beside_the_filmed_fluid_is_closed_unless_all_of_it_is(channel):
    scene = channel(2)
    inlet = scene.cell_types == CellType.INFLOW
    half = inlet & (np.arange(inlet.shape[1]) < inlet.shape[1] // 2)[None, :, None]
    assert half.any() and (inlet & ~half).any()
    fed = simulator_of(replace(scene, dry=half))._walls.regions == CellType.INFLOW
    assert fed.any() and not (fed & half).any()
    assert (simulator_of(replace(scene, dry=inlet))._walls.regions == CellType.INFLOW).any()


def test_a_fall_whose_rim_is_dry_is_fed_below_it(channel):
    scene = channel(2)
    inlet = scene.cell_types == CellType.INFLOW
    half = inlet & (np.arange(inlet.shape[1]) < inlet.shape[1] // 2)[None, :, None]
    down = FaceVelocity(
        *(np.full(scene.terrain.grid.face_shape(a), v, np.float32) for a, v in enumerate((0.3, 0.0, -0.2)))
    )
    fall = replace(scene, kind="fall", velocity=down)
    cells, body = within_outlet(replace(fall, dry=half))
    new = (cells == CellType.INFLOW) & ~inlet
    assert new.any() and not ((cells == CellType.INFLOW) & half).any()
    below = np.zeros_like(half)
    for steps in range(1, 4):
        below[steps:] |= half[:-steps]  # the channel runs along x
    columns, dry = np.unique(np.argwhere(new & below)[:, 1]), np.unique(np.argwhere(half)[:, 1])
    assert len(np.intersect1d(columns, dry)) > 0.6 * len(dry), "as wide as what was closed"
    at = np.clip(scene.terrain.grid.cell_of(body.positions), 0, np.array(half.shape) - 1)
    assert not half[tuple(at.T)].any()
    stream = within_outlet(replace(scene, dry=half))[0]
    assert not ((stream == CellType.INFLOW) & ~inlet & below).any(), "a stream is not fed within"
