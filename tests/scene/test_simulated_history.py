"""Figures of simulated frames."""

import numpy as np
import pytest

from fluidlift.scene.simulated_history import _distinct


@pytest.mark.parametrize("largest", [5, 60, 2**40])  # marked, numbered, sorted by rows
def test_cells_are_counted_once_each_however_far_apart_they_are(largest):
    rng = np.random.default_rng(0)
    cells = rng.integers(-largest, largest, (3000, 3))
    cells[1500:] = cells[:1500]
    assert _distinct(cells) == len(set(map(tuple, cells.tolist())))


def test_there_is_no_cell_without_particles():
    assert _distinct(np.zeros((0, 3), np.int64)) == 0
