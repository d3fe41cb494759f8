"""Where the liquid leaves: how thick the outlet is, and that it does not fill up."""

import numpy as np
import pytest

from fluidlift.physics.outlet import OUTLET_CELLS, OVERFULL, surplus, thin_outlet
from fluidlift.physics.transfer import sort_by_cell
from fluidlift.types import CellType, Grid

THICK = int(OUTLET_CELLS)


def channel(length=20, outlet=8):
    """A channel along x, walls beside it and below."""
    cells = np.full((length, 7, 5), CellType.EMPTY, np.uint8)
    cells[:, 1:-1, 1:3] = CellType.FLUID
    cells[-outlet:] = CellType.OUTFLOW
    cells[:, [0, -1]], cells[:, :, 0] = CellType.SOLID, CellType.SOLID
    return cells


def test_liquid_is_taken_away_a_few_cells_behind_the_end_that_was_seen():
    cells = channel(outlet=8)
    thin = thin_outlet(cells)
    begin = 20 - 8
    np.testing.assert_array_equal(thin[: begin + THICK], cells[: begin + THICK])
    assert not (thin == CellType.OUTFLOW)[begin + THICK :].any()
    np.testing.assert_array_equal(thin == CellType.SOLID, cells == CellType.SOLID)


@pytest.mark.parametrize("outlet", [1, THICK])
def test_an_outlet_that_is_thin_already_stays_as_it_is(outlet):
    np.testing.assert_array_equal(thin_outlet(channel(outlet=outlet)), channel(outlet=outlet))


def test_a_closed_basin_has_no_outlet_to_change():
    closed = np.where(channel() == CellType.OUTFLOW, CellType.FLUID, channel()).astype(np.uint8)
    np.testing.assert_array_equal(thin_outlet(closed), closed)


def test_what_crowds_in_the_outlet_has_left_the_heaviest_first_and_nothing_else():
    grid, rng = Grid((4, 3, 3), 0.1), np.random.default_rng(0)
    positions = (grid.low + rng.uniform(0, 1, (900, 3)) * 0.1 * np.array(grid.shape)).astype(np.float32)
    masses = rng.uniform(0.1, 0.5, 900).astype(np.float32)  # some 25 particles a cell: 7 kg where 1 kg is full
    outflow = np.zeros(grid.shape, bool)
    outflow[-1] = True
    gone = surplus(masses, sort_by_cell(positions, grid), outflow, 1.0)
    cell = grid.cell_of(positions)
    assert not gone[cell[:, 0] < 3].any()
    for place in np.argwhere(outflow):
        here = (cell == place).all(axis=1)
        kept = here & ~gone
        assert masses[kept].sum() <= OVERFULL
        # no more than it takes: the lightest that went would not have had room
        assert masses[kept].sum() + masses[here & gone].min() > OVERFULL
        assert masses[kept].max() <= masses[here & gone].min()
    held = surplus(masses, sort_by_cell(positions, grid), outflow, 100.0)
    assert not held.any()
