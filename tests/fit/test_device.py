"""The same fit by compiled kernels and by torch operations on a device."""

import numpy as np
import pytest

from fluidlift.fit.optimize import FitOptions, fit_parameters
from fluidlift.physics.rollout_pressure import RolloutOptions
from fluidlift.synthetic.twins import make_twin


def test_a_fit_in_torch_operations_ends_where_the_one_in_compiled_kernels_does():
    twin = make_twin("honey", seed=0, noise=0.1, cells=(12, 6, 6), frames=5)
    ends = [
        fit_parameters(
            twin.frames, twin.cell_types, None, twin.grid, twin.interval, twin.start, mainstream=twin.mainstream,
            steps_per_frame=twin.steps_per_frame, windows=1, start_rounds=1, device=device,
            free=("kinematic_viscosity", "inflow_velocity", "outflow_velocity"),
        )
        for device in ("cpu", "cpu:0")
    ]  # fmt: skip
    assert ends[0].estimates.keys() == ends[1].estimates.keys()
    assert ends[0].extra["loss"] == pytest.approx(ends[1].extra["loss"], rel=1e-3)
    for label, first in ends[0].estimates.items():
        second = ends[1].estimates[label]
        assert first.identifiable == second.identifiable
        # the stopping rule leaves a hundredth of the objective: a seventh of a standard deviation
        if np.isfinite(first.sigma):
            assert abs(first.value - second.value) < 0.15 * first.sigma
            assert first.sigma == pytest.approx(second.sigma, rel=0.05)


@pytest.mark.parametrize("device", ["warp", "cuda:99", "meta"])
def test_a_device_that_is_not_there_is_refused(device):
    with pytest.raises(ValueError, match=device):
        FitOptions(device=device)


def test_a_way_through_the_pressure_that_only_the_cpu_knows_is_refused_on_a_device():
    with pytest.raises(ValueError, match="unrolled"):
        FitOptions(device="cpu:0", options=RolloutOptions(projection="unrolled"))
