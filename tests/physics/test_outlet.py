"""Where the liquid leaves: how thick the outlet is."""

import numpy as np
import pytest

from fluidlift.physics.outlet import OUTLET_CELLS, thin_outlet
from fluidlift.types import CellType

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
    closed = np.where(channel() == CellType.OUTFLOW, CellType.FLUID, channel())
    np.testing.assert_array_equal(thin_outlet(closed), closed)
