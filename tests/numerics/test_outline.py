"""The upper end of an outline."""

import numpy as np
import pytest

from fluidlift.numerics.outline import upper_end


def test_the_upper_end_moves_with_an_outline_by_parts_of_rows():
    rows = np.zeros(50)
    rows[20:40] = 10.0
    lower = 0.5 * (rows + np.roll(rows, 1))  # by half a row
    # 3 % are 0.6 rows, of which half a row has half the width
    assert upper_end(rows) == pytest.approx(20.6)
    assert upper_end(lower) == pytest.approx(21.1)
