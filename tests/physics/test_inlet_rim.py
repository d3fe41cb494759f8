"""The inlet of what falls: along its whole rim."""

import numpy as np
import pytest

from fluidlift.physics.apic import LiquidSimulator
from fluidlift.physics.inlet import inlet_along_rim
from fluidlift.types import CellType, FaceVelocity, FluidParameters, Grid, Particles, Terrain, TriangleMesh

G = (0.0, 0.0, -9.81)
GRID = Grid((20, 12, 30), 0.02)
FIRST, LAST = 4, 16
"""columns of x that the curtain covers"""


def rim(x):
    """Topmost layer of the curtain in a column: it begins lower on the left, in steps of four cells."""
    return 15 + 4 * ((x - FIRST) // 4)


def behind(z):
    """Where the curtain is in y: a staircase, a cell nearer for each four that it has fallen."""
    return 2 + z // 4


def curtain(hole=()):
    """Cells of a curtain of one cell, its inlet at every third column of the rim as a plan may give it, its particles
    and its velocity."""
    types, positions = np.zeros(GRID.shape, np.uint8), []
    for x in range(FIRST, LAST):
        for z in range(2, rim(x) + 1):
            if (x, z) not in hole:
                types[x, behind(z), z] = CellType.FLUID
                positions.append(GRID.low + (np.array([x, behind(z), z]) + 0.5) * GRID.spacing)
        if (x - FIRST) % 3 == 0:
            types[x, behind(rim(x)), rim(x)] = CellType.INFLOW
    components = [np.full(GRID.face_shape(a), v, np.float32) for a, v in enumerate((0.0, -0.1, -0.4))]
    return types, np.array(positions), FaceVelocity(*components)


def test_the_inlet_of_a_curtain_has_no_gap_and_no_cell_that_is_fed_from_above():
    hole = {(9, 12), (9, 13), (10, 12)}  # as behind a rock
    types, positions, velocity = curtain(hole)
    cells = inlet_along_rim(types, positions, velocity, GRID, np.array(G))
    found = {tuple(c) for c in np.argwhere(cells == CellType.INFLOW)}
    assert found == {(x, behind(rim(x)), rim(x)) for x in range(FIRST, LAST)}
    np.testing.assert_array_equal(cells[cells != types], CellType.INFLOW)


@pytest.mark.parametrize("velocity", [(0.0, -0.1, -0.4), (0.0, -0.2, -0.15)])
def test_the_rim_is_fed_without_a_gap_where_water_runs_over_it_as_where_it_falls(velocity):
    types, positions, _ = curtain()
    field = FaceVelocity(*(np.full(GRID.face_shape(a), v, np.float32) for a, v in enumerate(velocity)))
    cells = inlet_along_rim(types, positions, field, GRID, np.array(G))
    assert {tuple(c) for c in np.argwhere(cells == CellType.INFLOW)} == {
        (x, behind(rim(x)), rim(x)) for x in range(FIRST, LAST)
    }


def test_no_inlet_is_made_below_the_lowest_one_that_was_given():
    types, positions, velocity = curtain()
    types[types == CellType.INFLOW] = CellType.FLUID
    types[LAST - 1, behind(rim(LAST - 1)), rim(LAST - 1)] = CellType.INFLOW
    cells = inlet_along_rim(types, positions, velocity, GRID, np.array(G))
    # of three heights of the rim, the top one alone: whether lower ones are fed from outside is not for cells to say
    assert set(np.argwhere(cells == CellType.INFLOW)[:, 2]) == {rim(LAST - 1)}


def test_an_inlet_away_from_the_body_does_not_say_how_far_down_its_rim_goes():
    types, positions, velocity = curtain()
    types[types == CellType.INFLOW] = CellType.FLUID
    types[LAST - 1, behind(rim(LAST - 1)), rim(LAST - 1)] = CellType.INFLOW
    types[LAST + 2, 5, 3] = CellType.INFLOW
    cells = inlet_along_rim(types, positions, velocity, GRID, np.array(G))
    assert set(np.argwhere((cells == CellType.INFLOW) & (types != CellType.INFLOW))[:, 2]) == {rim(LAST - 1)}
    alone = np.where(types == CellType.INFLOW, types, CellType.EMPTY)
    np.testing.assert_array_equal(inlet_along_rim(alone, positions[:0], velocity, GRID, np.array(G)), alone)


@pytest.mark.parametrize("change", ["no gravity", "no inlet", "upwards"])
def test_what_does_not_fall_keeps_its_cells(change):
    types, positions, velocity = curtain()
    gravity = np.array(G)
    if change == "no gravity":
        gravity = np.zeros(3)
    elif change == "no inlet":
        types[types == CellType.INFLOW] = CellType.FLUID
    else:
        velocity = FaceVelocity(*(-c for c in velocity.components))
    np.testing.assert_array_equal(inlet_along_rim(types, positions, velocity, GRID, gravity), types)


def test_a_curtain_falls_as_wide_as_its_rim():
    types, positions, velocity = curtain()
    cells = inlet_along_rim(types, positions, velocity, GRID, np.array(G))
    distance = np.full(tuple(n + 1 for n in GRID.shape), 100.0, np.float32)
    terrain = Terrain(GRID, distance, np.array([0.0, 0.0, -1.0]), TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int)))
    cells[:, :, :2] = CellType.OUTFLOW
    parameters = FluidParameters(gravity=G, inflow_velocity=(0.0, -0.1, -0.4), time_step=0.01)
    nothing = Particles.at_rest(np.zeros((0, 3)), 1.0)
    simulator = LiquidSimulator(GRID, terrain, parameters, nothing, cell_types=cells)
    simulator.advance(0.4)  # 0.3 s to fall through the box
    at = GRID.cell_of(simulator.particles.positions)
    for z in (4, 8, 12):  # below all of the rim
        columns = np.unique(at[(at[:, 2] >= z) & (at[:, 2] < z + 4), 0])
        # eight particles per cell at the inlet are a few where it falls four times as fast: one column may have none,
        # and the surface's own pressure draws each edge in by a cell. The gaps of the given inlet leave four of twelve
        assert len(columns) >= LAST - FIRST - 3
