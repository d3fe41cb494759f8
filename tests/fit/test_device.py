"""The same fit by compiled kernels and by torch operations on a device."""

import numpy as np
import pytest

from fluidlift.fit import optimize
from fluidlift.fit.optimize import FitOptions, fit_parameters
from fluidlift.fit.problem import build_problem
from fluidlift.physics.rollout_pressure import RolloutOptions
from fluidlift.synthetic.twins import make_twin


def fitted(device, **options):
    """Of a few cells of honey; "cpu:0" is a device of torch's."""
    twin = make_twin("honey", seed=0, noise=0.1, cells=(12, 6, 6), frames=5)
    return fit_parameters(
        twin.frames, twin.cell_types, None, twin.grid, twin.interval, twin.start, mainstream=twin.mainstream,
        steps_per_frame=twin.steps_per_frame, windows=1, start_rounds=1, device=device,
        free=("kinematic_viscosity", "inflow_velocity", "outflow_velocity"), **options,
    )  # fmt: skip


def test_a_fit_in_torch_operations_ends_where_the_one_in_compiled_kernels_does():
    ends = fitted("cpu"), fitted("cpu:0", device_from=0)
    assert ends[0].estimates.keys() == ends[1].estimates.keys()
    assert ends[0].extra["loss"] == pytest.approx(ends[1].extra["loss"], rel=1e-3)
    for label, first in ends[0].estimates.items():
        second = ends[1].estimates[label]
        assert first.identifiable == second.identifiable
        # the stopping rule leaves a hundredth of the objective: a seventh of a standard deviation
        if np.isfinite(first.sigma):
            assert abs(first.value - second.value) < 0.15 * first.sigma
            assert first.sigma == pytest.approx(second.sigma, rel=0.05)


@pytest.fixture
def on_devices(monkeypatch):
    """Where each problem is rolled out."""
    asked = []
    monkeypatch.setattr(
        optimize, "build_problem", lambda *a, device, **k: asked.append(device) or build_problem(*a, device=device, **k)
    )
    return asked


def test_a_device_is_left_alone_by_what_the_cpu_rolls_out_faster(on_devices):
    plain, small = fitted("cpu"), fitted("cpu:0")
    assert set(on_devices) == {"cpu"}
    assert small.parameters == plain.parameters
    (note,) = set(small.notes) - set(plain.notes)
    assert note.startswith("rolled out on the CPU: ") and "too few for cpu:0" in note


@pytest.mark.parametrize(("workers", "device"), [(1, "cpu:0"), (2, "cpu")])
def test_each_thread_of_the_cpu_counts_against_the_device(on_devices, workers, device):
    fitted("cpu:0", device_from=80, workers=workers, max_rollouts=1)  # the layout has between 80 and 160 cells
    assert set(on_devices) == {device}


@pytest.mark.parametrize("device", ["warp", "cuda:99", "meta"])
def test_a_device_that_is_not_there_is_refused(device):
    with pytest.raises(ValueError, match=device):
        FitOptions(device=device)


def test_a_way_through_the_pressure_that_only_the_cpu_knows_is_refused_on_a_device():
    with pytest.raises(ValueError, match="unrolled"):
        FitOptions(device="cpu:0", options=RolloutOptions(projection="unrolled"))
