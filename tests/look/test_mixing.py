"""Fluid that was drawn out into filaments looks like their mixture."""

import numpy as np
import pytest

from fluidlift.look.mixing import mixed, mixed_share
from fluidlift.types import Gaussians


def chequered(n: int = 12) -> Gaussians:
    """A sheet of splats that are black and white in turn."""
    x, y = np.meshgrid(np.arange(n), np.arange(n))
    means = np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3).astype(np.float32)
    white = ((x + y) % 2).reshape(-1, 1) * np.ones(3)
    return Gaussians.isotropic(means, 0.4, white, 0.9)


def shear(stretch: float, n: int) -> np.ndarray:
    return np.tile(np.diag([stretch, 1.0, 1.0 / stretch]), (n, 1, 1))


def test_fluid_that_moved_as_a_whole_keeps_its_pattern():
    g = chequered()
    turn = np.tile([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], (len(g), 1, 1))
    np.testing.assert_array_equal(mixed(g, turn, widest=0.5).sh, g.sh)
    np.testing.assert_array_equal(mixed(g, shear(1.9, len(g)), widest=0.5).sh, g.sh)


def test_fluid_drawn_out_beyond_its_splats_is_grey_where_it_was_chequered():
    g = chequered()
    middle = (np.abs(g.means[:, :2] - 5.5) < 4).all(1)
    grey = mixed(g, shear(3.5, len(g)), widest=0.5).rgb[middle, 0]
    assert np.std(g.rgb[middle, 0]) > 0.49
    # thirteen neighbours of a chessboard: one colour outweighs the other by less than a quarter
    assert np.std(grey) < 0.15 and abs(grey.mean() - 0.5) < 0.05


def test_only_what_was_drawn_out_changes_and_shape_stays():
    g = chequered()
    drawn = np.tile(np.eye(3), (len(g), 1, 1))
    drawn[:10] = shear(4.0, 10)
    out = mixed(g, drawn, widest=0.5)
    np.testing.assert_array_equal(out.sh[10:], g.sh[10:])
    assert not np.array_equal(out.sh[:10], g.sh[:10])
    inner = (np.abs(g.means[:, :2] - 5.5) < 4).all(1)
    np.testing.assert_array_equal(out.scales[inner], g.scales[inner])


def test_splats_that_lost_touch_close_up_and_none_grows_beyond_its_bound():
    g = chequered()
    apart = Gaussians(g.means * 4, g.quats, g.scales, g.opacities, g.sh)
    still = np.tile(np.eye(3), (len(g), 1, 1))
    inner = (np.abs(g.means[:, :2] - 5.5) < 4).all(1)
    # the sixth neighbour on a square lattice is a diagonal away
    np.testing.assert_allclose(mixed(apart, still, widest=9.0).scales[inner], 0.5 * 4 * np.sqrt(2), rtol=1e-5)
    np.testing.assert_allclose(mixed(apart, still, widest=1.5).scales, 1.5, rtol=1e-5)
    np.testing.assert_array_equal(mixed(g, still, widest=9.0).scales[inner], g.scales[inner])


def test_the_share_grows_from_none_to_all_between_its_limits():
    stretches = [1.0, 2.0, 2.5, 3.0, 4.0]
    shares = mixed_share(np.stack([np.diag([s, 1, 1 / s]) for s in stretches]))
    assert shares[0] == shares[1] == 0 and 0 < shares[2] < 1
    np.testing.assert_allclose(shares[3:], 1.0)
    assert mixed_share(np.full((1, 3, 3), np.nan)) == 0


def test_few_or_broken_splats_pass_and_a_wrong_number_is_refused():
    few = chequered(3)
    assert mixed(few, shear(4.0, 9), widest=0.5) is few
    g = chequered()
    g.means[5] = np.nan
    assert np.isfinite(mixed(g, shear(4.0, len(g)), widest=0.5).sh).all()
    with pytest.raises(ValueError, match="deformations"):
        mixed(g, shear(4.0, 3), widest=0.5)


def test_a_splat_that_keeps_its_colour_grows_as_one_that_shares_it():
    g = chequered()
    small = Gaussians(g.means, g.quats, 0.1 * g.scales, g.opacities, g.sh)
    some = np.tile(np.eye(3), (len(g), 1, 1))
    some[::2] = shear(4.0, len(g) // 2)
    drawn, still = mixed(small, some, widest=9.0), mixed(small, np.tile(np.eye(3), (len(g), 1, 1)), widest=9.0)
    inner = (np.abs(g.means[:, :2] - 5.5) < 4).all(1)
    np.testing.assert_allclose(drawn.scales[inner], still.scales[inner], rtol=1e-6)
    np.testing.assert_array_equal(drawn.sh[1::2], g.sh[1::2])


def test_splats_that_nobody_sees_stay_as_they_are_and_the_others_look_as_if_all_were_looked_at():
    g = chequered()
    g = Gaussians(g.means * 2, g.quats, g.scales, g.opacities, g.sh)
    drawn = np.tile(np.eye(3), (len(g), 1, 1))
    drawn[::3] = shear(3.5, len(drawn[::3]))
    seen = np.arange(len(g)) % 2 == 0
    every, some = mixed(g, drawn, widest=2.0), mixed(g, drawn, widest=2.0, seen=seen)
    for name in ("sh", "scales"):
        np.testing.assert_array_equal(getattr(some, name)[seen], getattr(every, name)[seen])
        np.testing.assert_array_equal(getattr(some, name)[~seen], getattr(g, name)[~seen])
        assert not np.array_equal(getattr(every, name)[~seen], getattr(g, name)[~seen])
