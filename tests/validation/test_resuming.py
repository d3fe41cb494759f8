"""A simulation that is stopped and resumed is the same simulation."""

import io

import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.physics.apic import LiquidSimulator
from fluidlift.physics.gas import GasSimulator
from fluidlift.types import CellType, FluidParameters, Grid


def river(scene, cells=(16, 6, 8)):
    """A short channel: inlet, outlet, fluctuating inflow."""
    grid = Grid(cells, 0.1)
    types = scene.cells(grid)
    types[:2, :, :4], types[-2:] = CellType.INFLOW, CellType.OUTFLOW
    parameters = FluidParameters(
        inflow_velocity=(0.8, 0, 0), inflow_fluctuation=0.1, kinematic_viscosity=1e-3, wall_damping=0.3, time_step=0.02
    )
    body = scene.body(grid, lambda p: p[:, 2] < 0.4, velocity=(0.8, 0, 0))
    return LiquidSimulator(grid, scene.terrain(grid), parameters, body, cell_types=types, seed=3)


def plume(scene, cells=(12, 12, 14)):
    grid = Grid(cells, 0.1)
    types = scene.cells(grid)
    types[5:7, 5:7, 0] = CellType.INFLOW
    parameters = FluidParameters(density=1.2, inflow_velocity=(0, 0, 0.5), inflow_fluctuation=0.1, time_step=0.04)
    body = scene.body(grid, lambda p: np.linalg.norm(p - [0.6, 0.6, 0.3], axis=1) < 0.2)
    return GasSimulator(grid, scene.terrain(grid), parameters, body, cell_types=types, buoyancy=2.0, seed=3)


@pytest.mark.parametrize("build", [river, plume])
def test_a_resumed_simulation_goes_on_bit_for_bit(scene, build):
    through = build(scene)
    through.advance(0.2)
    file = io.BytesIO()
    np.savez(file, **through.state())
    file.seek(0)
    through.advance(0.2)
    resumed = build(scene)
    with np.load(file, allow_pickle=False) as stored:
        resumed.restore(dict(stored))
    resumed.advance(0.2)
    state, again = through.state(), resumed.state()
    assert state.keys() == again.keys() and len(through.particles) > 100
    for name, value in state.items():
        np.testing.assert_array_equal(value, again[name], err_msg=name)


@pytest.mark.parametrize("build", [river, plume])
def test_a_stored_state_is_not_changed_by_going_on(scene, build):
    simulator = build(scene)
    simulator.advance(0.1)
    state = simulator.state()
    before = {name: value.copy() for name, value in state.items()}
    simulator.advance(0.1)
    for name, value in state.items():
        np.testing.assert_array_equal(value, before[name], err_msg=name)


@pytest.mark.parametrize("build", [river, plume])
def test_a_state_that_does_not_fit_is_refused_and_changes_nothing(scene, build):
    simulator = build(scene)
    simulator.advance(0.1)
    good = simulator.state()
    broken = [
        {k: v for k, v in good.items() if k != "particles.affine"},
        good | {"particles.positions": np.full_like(good["particles.positions"], np.nan)},
        good | {"particles.masses": good["particles.masses"][:-1]},
        good | {"generator": np.frombuffer(b"nonsense", np.uint8)},
    ]
    for state in broken:
        with pytest.raises(InputRejected, match="does not fit"):
            simulator.restore(state)
    larger = build(scene, (20, 12, 16))
    larger.advance(0.1)
    with pytest.raises(InputRejected, match="another"):
        simulator.restore(larger.state())
    for name, value in simulator.state().items():
        np.testing.assert_array_equal(value, good[name], err_msg=name)
