"""Arrows of the flow: what lies around them turns, what lies far away stays, and what cannot be is refused."""

import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.messages import code_of
from fluidlift.shape.drawn_flow import REACH, heard, require_downhill, require_one_horizon
from fluidlift.types import PixelFlow
from fluidlift.types.hints import Arrow

SIZE = (120, 200)
AT = (50.0, 60.0)


def stream(trust=0.8):
    """A mask, motion of 2 px per frame to the right with eddies, and its confidence."""
    columns = np.arange(SIZE[1])
    motion = np.zeros((*SIZE, 2), np.float32)
    motion[..., 0], motion[..., 1] = 2.0, 0.4 * np.sin(2.0 * np.pi * columns / 6.0)
    return np.ones(SIZE, bool), motion, np.full(SIZE, trust, np.float32)


def arrow(degrees, at=AT, length=20.0):
    angle = np.radians(degrees)
    return Arrow(at, (at[0] + length * np.cos(angle), at[1] + length * np.sin(angle)))


def direction(motion, at, radius=6):
    part = motion[int(at[1]) - radius : int(at[1]) + radius, int(at[0]) - radius : int(at[0]) + radius]
    mean = part.reshape(-1, 2).mean(axis=0)
    return float(np.degrees(np.arctan2(mean[1], mean[0])))


@pytest.mark.parametrize("degrees", [30.0, -70.0, 179.0])
def test_the_motion_around_an_arrow_goes_its_way_and_keeps_its_speed_and_its_eddies(degrees):
    mask, motion, trust = stream()
    found, sure = heard([arrow(degrees)], mask, motion, trust).mean(motion, trust)
    assert direction(found, AT) == pytest.approx(degrees, abs=3.0)
    near = np.s_[50:70, 40:60]
    assert np.linalg.norm(found[near], axis=-1) == pytest.approx(np.linalg.norm(motion[near], axis=-1), rel=1e-4)
    assert sure[near] == pytest.approx(trust[near])


def test_what_lies_farther_away_than_it_reaches_stays():
    mask, motion, trust = stream()
    found, _ = heard([arrow(180.0)], mask, motion, trust).mean(motion, trust)
    far = int(AT[0] + REACH * SIZE[1]) + 2
    assert np.array_equal(found[:, far:], motion[:, far:])


def test_what_goes_another_way_beside_an_arrow_stays():
    mask, motion, trust = stream()
    motion[:45] = (0.0, 5.0)  # a ledge above the pool that the arrow lies in
    found, _ = heard([arrow(-40.0, (50.0, 70.0))], mask, motion, trust).mean(motion, trust)
    assert direction(found, (50.0, 70.0)) == pytest.approx(-40.0, abs=5.0)
    assert found[30:38, 40:60] == pytest.approx(motion[30:38, 40:60], abs=0.3)


def test_each_of_several_arrows_counts_where_it_lies():
    mask, motion, trust = stream()
    other = (80.0, 60.0)
    found, _ = heard([arrow(40.0), arrow(-50.0, other)], mask, motion, trust).mean(motion, trust)
    assert direction(found, AT, 3) == pytest.approx(40.0, abs=8.0)
    assert direction(found, other, 3) == pytest.approx(-50.0, abs=8.0)


def test_where_nothing_was_measured_an_arrow_gives_a_direction_and_pairs_lose_their_confidence():
    mask, motion, trust = stream()
    trust[:, :120] = 0.0
    motion[:, :120] = np.random.default_rng(0).normal(size=(SIZE[0], 120, 2))
    said = heard([arrow(90.0)], mask, motion, trust)
    found, sure = said.mean(motion, trust)
    assert direction(found, AT) == pytest.approx(90.0, abs=1.0)
    assert np.linalg.norm(found[60, 50]) == pytest.approx(2.0, abs=0.3) and sure[60, 50] == pytest.approx(1.0)
    pair = said.flow.turned(PixelFlow(motion[None], np.ones((1, *SIZE), np.float32)))
    assert pair.confidence[0, 60, 50] == pytest.approx(0.0, abs=1e-6) and pair.confidence[0, 60, 150] == 1.0


def test_every_pair_is_turned_as_the_mean_is():
    mask, motion, trust = stream()
    said = heard([arrow(180.0)], mask, motion, trust)
    pair = said.flow.turned(PixelFlow(np.stack([motion, 2 * motion]), np.ones((2, *SIZE), np.float32)))
    assert pair.displacement[1, 60, 50, 0] == pytest.approx(-4.0, abs=0.3)
    assert said.flow.counts[60, 50] and not said.flow.counts[60, 150]


def test_an_arrow_against_what_is_sure_is_told_and_one_with_it_is_not():
    mask, motion, trust = stream()
    told = heard([arrow(0.0), arrow(170.0, (140.0, 60.0))], mask, motion, trust).warnings
    assert [code_of(w) for w in told] == ["flow-as-drawn"] and "arrow 2" in told[0]
    assert heard([arrow(170.0)], mask, motion, 0.2 * trust).warnings == ()


def test_an_arrow_beside_the_fluid_and_two_against_each_other_are_refused():
    mask, motion, trust = stream()
    with pytest.raises(InputRejected, match="arrow 1 of the flow lies where no fluid"):
        heard([arrow(0.0)], mask & (np.arange(SIZE[1]) > 150), motion, trust)
    with pytest.raises(InputRejected, match="arrows 1 and 2 of the flow begin at one place"):
        heard([arrow(0.0), arrow(180.0)], mask, motion, trust)


def test_a_ledge_that_runs_uphill_is_refused_by_the_horizon_or_the_picture():
    ledge = np.zeros(SIZE, bool)
    ledge[40:80, 30:70] = True
    require_downhill([arrow(90.0), arrow(-90.0, (150.0, 60.0))], [ledge], None)
    with pytest.raises(InputRejected, match="ledge 1 runs uphill: arrow 1"):
        require_downhill([arrow(-80.0)], [ledge], None)
    tilted = ((0.0, 100.0), (100.0, 0.0))  # turned by 45 degrees: down is to the lower right
    require_downhill([arrow(-30.0)], [ledge], tilted)
    with pytest.raises(InputRejected, match="uphill"):
        require_downhill([arrow(-60.0)], [ledge], tilted)


def test_a_level_line_and_sky_that_mean_another_horizon_are_refused():
    horizon = ((0.0, 30.0), (200.0, 30.0))
    require_one_horizon(horizon, ((0.0, 80.0), (200.0, 84.0)), [(50.0, 31.0)], 120)
    with pytest.raises(InputRejected, match="two horizons: the level line is turned by 11"):
        require_one_horizon(horizon, ((0.0, 80.0), (200.0, 120.0)), [], 120)
    with pytest.raises(InputRejected, match="sky reaches below"):
        require_one_horizon(horizon, None, [(50.0, 60.0)], 120)
    require_one_horizon(None, ((0.0, 80.0), (200.0, 120.0)), [(50.0, 60.0)], 120)
