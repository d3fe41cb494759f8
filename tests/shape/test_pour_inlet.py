"""The inlet of what pours is the upper end of its jet, over all of its section."""

import numpy as np
import pytest

from fluidlift.shape.kinds import builder_of

X, Y, Z = np.meshgrid(np.arange(40) + 0.5, np.arange(20) + 0.5, np.arange(40) + 0.5, indexing="ij")
"""middles of cells of 1 m"""


def jet(radius: float, slant: float, lean: float = 0.0) -> np.ndarray:
    """Cells of a jet above a pool, cut off on a slant (rise over run) at its upper end, and leaning to the side."""
    away = X - 14.0 - lean * (30.0 - Z)
    return ((np.hypot(away, Y - 10.0) < radius) & (Z < 30.0 - slant * away)) | ((Z < 8.0) & (np.abs(Y - 10.0) < 8.0))


@pytest.mark.parametrize("radius", [2.5, 4.0, 6.0])
@pytest.mark.parametrize("slant", [0.0, 0.6, 1.0])
def test_all_columns_of_a_jet_that_is_cut_on_a_slant_are_fed(radius, slant):
    """As the picture's upper edge cuts what is seen from above. By its tip alone a quarter of it and less would be."""
    body = jet(radius, slant)
    inlet = builder_of("pour").inlet(body, Z, 1.0)
    columns, section = inlet.any(axis=2), (body & (Z > 8.0)).any(axis=2)
    np.testing.assert_array_equal(columns, section)
    assert (inlet.sum(axis=2)[columns] == 2).all(), "two cells tall"
    assert not (inlet & ~body).any() and not inlet[Z < 8.0].any()


def test_a_jet_that_leans_is_fed_at_its_end_and_not_along_its_upper_side():
    body = jet(3.0, 0.0, lean=0.5)
    inlet = builder_of("pour").inlet(body, Z, 1.0)
    # its end is as high as it is wide at most
    assert inlet.any() and Z[inlet].min() > 30.0 - 2.0 * 3.0 - 4.0
    assert inlet.any(axis=2).sum() >= 0.9 * np.pi * 3.0**2
