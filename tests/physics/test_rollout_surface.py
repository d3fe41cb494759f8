"""A liquid at rest stays at rest, whatever angle its surface and its bed make with the grid."""

import numpy as np
import pytest
import torch

from fluidlift.physics.pressure import build_system, project
from fluidlift.physics.rollout import RolloutParameters, rollout
from fluidlift.physics.rollout_domain import prepare_domain
from fluidlift.physics.rollout_pressure import RolloutOptions
from fluidlift.physics.rollout_surface import (
    liquid_distance,
    surface_cells,
    surface_distances,
)
from fluidlift.types import CellType, FaceVelocity, FluidParameters, Grid, Terrain, TriangleMesh

G = 9.81


def tilted(cells, tilt, bed=None, turn=0.0):
    """A box of 1 m, half full; the surface inclined by `tilt` degrees, a bed by `bed` the other way."""
    grid = Grid((cells, cells if turn else 3, cells - 2), 1.0 / cells)
    along = np.array([np.cos(np.radians(turn)), np.sin(np.radians(turn)), 0.0])
    up = np.cos(np.radians(tilt)) * np.array([0.0, 0.0, 1.0]) + np.sin(np.radians(tilt)) * along
    middle = np.array([0.5, 0.5 * grid.shape[1] / cells, 0.463])
    distance = (grid.centers() - middle) @ up
    types = np.where(distance < 0, CellType.FLUID, CellType.EMPTY).astype(np.uint8)
    if bed is None:
        return grid, types, None, distance, up
    normal = np.array([-np.sin(np.radians(bed)), 0.0, np.cos(np.radians(bed))])
    above = (grid.nodes() - np.array([0.5, 0.0, 0.17])) @ normal
    mesh = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    types[(grid.centers() - np.array([0.5, 0.0, 0.17])) @ normal < 0] = CellType.SOLID
    return grid, types, Terrain(grid, above, np.array([1.0, 0.0, 0.0]), mesh), distance, up


def residual_acceleration(grid, types, terrain, up, distance=None):
    """m/s^2: mean and largest share of gravity along `up` that the pressure does not hold."""
    x, y, z = (np.asarray(g, np.float32) for g in surface_distances(types, distance))
    system = build_system(types, terrain, grid, gaps=(x, y, z))
    pull = FaceVelocity(*(np.full(grid.face_shape(a), -G * up[a]) for a in range(3)))
    left, _, report = project(pull, system, tolerance=1e-9)
    assert report.converged
    moving = [np.abs(c[w > 0]) for c, w in zip(left.components, system.weights)]
    return np.concatenate(moving).mean(), max(m.max() for m in moving)


@pytest.mark.parametrize(("tilt", "bed", "turn"), [(5, None, 0), (17, None, 30), (30, None, 0), (0, 10, 0), (9, 20, 0)])
def test_a_pool_below_a_known_surface_does_not_move(tilt, bed, turn):
    grid, types, terrain, distance, up = tilted(16, tilt, bed, turn)
    openings = build_system(types, terrain, grid).openings
    own, level = surface_cells(types, distance, openings, grid.spacing)
    _, largest = residual_acceleration(grid, own, terrain, up, level)
    # a linear pressure solves the equations exactly; weights are single precision, and up to 1000 where gaps are small
    assert largest < 1e-4 * G


@pytest.mark.parametrize(("tilt", "bed", "turn"), [(10, None, 0), (10, 15, 0), (10, None, 30), (30, None, 0)])
def test_a_surface_guessed_from_the_cells_leaves_a_tenth_of_what_their_stairs_would(tilt, bed, turn):
    grid, types, terrain, _, up = tilted(24, tilt, bed, turn)
    guessed, _ = residual_acceleration(grid, types, terrain, up)
    # p = 0 half a cell beyond every liquid cell
    stairs, _ = residual_acceleration(grid, types, terrain, up, np.where(types == CellType.EMPTY, 0.5, -0.5))
    print(f"mean residual acceleration {guessed:.4f} against {stairs:.3f} m/s2")
    assert guessed < 0.1 * stairs


def test_the_guess_is_exact_for_a_level_surface_and_never_moves_a_cell_across_it():
    types = np.full((6, 5, 7), CellType.EMPTY, np.uint8)
    types[:, :, :3] = CellType.FLUID
    z = np.broadcast_to(np.arange(7) + 0.5 - 3, types.shape)
    # planes are fixed points of the fit; the regularisation of a thin layout is 1e-9
    np.testing.assert_allclose(liquid_distance(types), z, atol=1e-6)
    rng = np.random.default_rng(0)
    types = rng.choice([CellType.EMPTY, CellType.FLUID, CellType.SOLID], (9, 1, 8)).astype(np.uint8)
    guess = liquid_distance(types)
    assert np.isfinite(guess).all()
    assert (guess[types == CellType.FLUID] < 0).all()
    assert (guess[types == CellType.EMPTY] > 0).all()


def test_layouts_without_a_surface_have_none():
    for value in (CellType.EMPTY, CellType.FLUID, CellType.SOLID):
        for gap in surface_distances(np.full((4, 3, 5), value, np.uint8)):
            assert (gap == 1.0).all()


def test_wrong_distances_are_rejected():
    types = np.full((4, 3, 5), CellType.FLUID, np.uint8)
    openings = build_system(types, None, Grid(types.shape, 0.1)).openings
    with pytest.raises(ValueError, match="distance"):
        surface_distances(types, np.zeros((4, 3, 4)))
    with pytest.raises(ValueError, match="finite"):
        surface_cells(types, np.full(types.shape, np.nan), openings, 0.1)


def test_a_rollout_below_a_known_surface_keeps_a_tilted_pool_at_rest():
    grid, types, terrain, distance, up = tilted(12, 10, 15)
    openings = build_system(types, terrain, grid).openings
    own, level = surface_cells(types, distance, openings, grid.spacing)
    domain = prepare_domain(own, build_system(own, terrain, grid), distance=level, dtype=np.float64)
    x, y, z = -G * up
    water = RolloutParameters.of(FluidParameters(gravity=(x, y, z), time_step=0.02), torch.float64)
    still = torch.zeros(domain.offsets[3], dtype=torch.float64)
    moved = rollout(still, domain, water, steps=10, options=RolloutOptions(tolerance=1e-9))
    # 0.2 s of gravity are 2 m/s; distances are single precision, and gaps a thousandth of a cell at least
    assert float(moved.velocity.abs().max()) < 1e-4 * 2.0


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("end", [0, -1])
def test_water_at_rest_before_an_outlet_does_not_run_out(axis, end):
    """The cut carries on the pool: its pressure is that of the water above, not that of air."""
    types = np.full((10, 10, 8), CellType.FLUID, np.uint8)
    types[:, :, 0], types[:, :, 6:] = CellType.SOLID, CellType.EMPTY
    cut = [slice(None)] * 3
    cut[axis], cut[2] = end, slice(1, 6)
    types[tuple(cut)] = CellType.OUTFLOW
    grid = Grid(types.shape, 0.1)
    z = (np.arange(8) + 0.5) * 0.1
    level = np.broadcast_to(z - 0.57, types.shape).astype(np.float32)
    flow = np.eye(3)[axis] * (1 if end == -1 else -1)
    domain = prepare_domain(types, build_system(types, None, grid), mainstream=flow, distance=level, dtype=np.float64)
    at_rest = RolloutParameters.of(FluidParameters(gravity=(0.0, 0.0, -9.81), time_step=0.02), torch.float64)
    out = rollout(torch.zeros(domain.offsets[3], dtype=torch.float64), domain, at_rest, steps=5).velocity
    # without the head the lowest cell would gain half of 9.81 m/s^2 times 0.1 s or more
    assert float(out.abs().max()) < 1e-4
