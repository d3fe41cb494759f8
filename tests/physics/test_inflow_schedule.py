"""The inflow follows its schedule, and the discharge follows the inflow."""

import numpy as np
import pytest

from fluidlift.physics.apic import LiquidSimulator
from fluidlift.physics.emitter import Supply
from fluidlift.physics.inflow_schedule import InflowSchedule
from fluidlift.types import CellType, FluidParameters, Grid, Particles, Terrain, TriangleMesh

NO_MESH = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))


def test_without_a_schedule_the_factor_is_one_at_all_times():
    assert [InflowSchedule().factor(t) for t in (0.0, 0.3, 1e6)] == [1.0, 1.0, 1.0]
    assert InflowSchedule().steady


def test_between_keyframes_it_changes_on_a_straight_line_and_beyond_them_it_holds_on():
    schedule = InflowSchedule(((1.0, 1.0), (2.0, 3.0)))
    assert [schedule.factor(t) for t in (0.0, 1.5, 9.0)] == [1.0, 2.0, 3.0]
    assert schedule.travelled(1.0, 1.0) == pytest.approx(2.0)  # Simpson's rule is exact on lines


def test_the_surge_has_the_share_that_was_asked_for_about_an_unchanged_mean():
    factors = np.array([InflowSchedule(fluctuation=0.2, period=0.7).factor(t) for t in np.linspace(0, 300, 20_000)])
    # 430 periods of the slowest of three waves: the mean is that of the waves' ends, the share that of their squares
    assert factors.mean() == pytest.approx(1.0, abs=0.005)
    assert factors.std() == pytest.approx(0.2, rel=0.02)


def test_a_surge_never_turns_the_flow_round():
    factors = [InflowSchedule(fluctuation=2.0).factor(t) for t in np.linspace(0, 20, 500)]
    assert min(factors) == 0.0


@pytest.mark.parametrize(
    "wrong",
    [{"keyframes": ()}, {"keyframes": ((0.0, -1.0),)}, {"keyframes": ((1.0, 1.0), (0.5, 1.0))}, {"fluctuation": -0.1},
     {"period": 0.0}, {"keyframes": ((0.0, np.nan),)}],
)  # fmt: skip
def test_a_schedule_that_makes_no_sense_is_refused(wrong):
    with pytest.raises(ValueError, match=r"inflow|fluctuation|period"):
        InflowSchedule(**wrong)


def jet(schedule):
    """m^3 that enter an empty box without gravity through an opening of 0.4 x 0.4 m at 1 m/s within 0.6 s."""
    grid = Grid((24, 8, 8), 0.1)
    cells = np.zeros(grid.shape, np.uint8)
    cells[:2, 2:6, 2:6] = CellType.INFLOW
    terrain = Terrain(grid, np.full((25, 9, 9), 10.0, np.float32), np.array([1.0, 0.0, 0.0]), NO_MESH)
    parameters = FluidParameters(gravity=(0.0, 0.0, 0.0), inflow_velocity=(1.0, 0.0, 0.0), time_step=0.05)
    nothing = Particles.at_rest(np.zeros((0, 3)), 1.0)
    simulator = LiquidSimulator(
        grid, terrain, parameters, nothing, cell_types=cells, supply=Supply(InflowSchedule(schedule))
    )
    simulator.advance(1e-3)  # the inlet itself fills
    before = simulator.volume
    simulator.advance(0.6)
    return simulator.volume - before


@pytest.mark.parametrize(
    ("schedule", "mean"),
    [(((0.0, 1.0),), 1.0), (((0.0, 2.0),), 2.0), (((0.0, 0.0), (0.6, 2.0)), 1.0), (((0.0, 0.0),), 0.0)],
)  # fmt: skip
def test_what_enters_is_the_area_times_the_speed_of_the_schedule(schedule, mean):
    # particles come in whole layers of half a cell: one of 12 may be on its way
    assert jet(schedule) == pytest.approx(0.16 * 0.6 * mean, abs=0.16 * 0.05)
