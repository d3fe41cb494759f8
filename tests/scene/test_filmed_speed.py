"""What pours comes in as fast as it was filmed, with the discharge that is known of it."""

from dataclasses import replace

import pytest

from fluidlift.scene.simulator import as_fast_as_filmed, simulator_of


def test_a_pour_flows_in_as_fast_as_it_was_filmed(channel):
    scene = channel(2, kind="pour")
    slower = scene.parameters.updated({"inflow_velocity": (0.15, 0.0, 0.0)})
    found, discharge = as_fast_as_filmed(replace(scene, parameters=slower), slower)
    assert found.inflow_velocity == pytest.approx((0.6, 0.0, 0.0)) and discharge == pytest.approx(0.15)
    simulator = simulator_of(replace(scene, parameters=slower))
    assert simulator.settings.discharge_speed == pytest.approx(0.15)
    faster = scene.parameters.updated({"inflow_velocity": (0.7, 0.0, 0.0)})
    assert as_fast_as_filmed(replace(scene, parameters=faster), faster) == (faster, None)
    assert as_fast_as_filmed(replace(scene, kind="stream", parameters=slower), slower) == (slower, None)
    nothing = scene.parameters.updated({"inflow_velocity": (0.0, 0.0, 0.0)})
    assert as_fast_as_filmed(replace(scene, parameters=nothing), nothing) == (nothing, None)
