import numpy as np

from fluidlift.shape.filled_vessel import fills_a_vessel, in_vessel
from fluidlift.shape.view import drawn_rim

H, W = 160, 160
ROW, COL = np.mgrid[:H, :W] + 0.5
JET = (np.abs(COL - 80) < 7) & (ROW < 100)
POOL = ((COL - 80) / 50) ** 2 + ((ROW - 100) / 32) ** 2 < 1
RIM = drawn_rim((80.0, 90.0), (68.0, 46.0), 0.0)
ITS_OWN = drawn_rim((80.0, 100.0), (51.0, 33.0), 0.0)


def test_a_pool_below_a_rim_lies_in_a_vessel():
    assert in_vessel([RIM], POOL)
    assert not in_vessel([], POOL)
    assert not in_vessel([ITS_OWN], POOL), "the outline of a puddle is no rim"
    assert not in_vessel([drawn_rim((30.0, 90.0), (68.0, 46.0), 0.0)], POOL)


def test_a_vessel_fills_where_a_jet_falls_in_and_more_of_its_liquid_is_seen():
    pools = [((COL - 80) / a) ** 2 + ((ROW - 100) / (0.64 * a)) ** 2 < 1 for a in np.linspace(42.0, 52.0, 6)]
    rising = np.stack([JET | pool for pool in pools])
    assert fills_a_vessel([RIM], rising)
    assert not fills_a_vessel([], rising)
    assert not fills_a_vessel([RIM], rising[::-1]), "it empties"
    assert not fills_a_vessel([RIM], np.stack([rising[3]] * 6)), "its level stands"
    assert not fills_a_vessel([RIM], np.stack(pools)), "nothing falls in"
