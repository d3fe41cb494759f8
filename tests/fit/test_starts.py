"""Corrected starts of windows: as good as they get, and no more work than that takes."""

import numpy as np
import pytest
import torch

from fluidlift.fit import starts
from fluidlift.fit.evaluation import Budget, evaluate, jacobian
from fluidlift.fit.problem import build_problem
from fluidlift.fit.ranges import parameter_space
from fluidlift.fit.scene import build_scene, plan_windows
from fluidlift.fit.starts import corrected_starts, profile, start_residuals
from fluidlift.synthetic.twins import make_twin


@pytest.fixture(scope="module")
def rough():
    """A river with 20 % noise, in two windows, at its true parameters."""
    twin = make_twin("river", seed=0, noise=0.2, hidden=0.0, cells=(16, 8, 8), frames=8)
    scene = build_scene(
        twin.frames, [twin.cell_types] * len(twin.frames), None, twin.grid, kind=twin.kind, mainstream=twin.mainstream
    )
    plan = plan_windows(scene, twin.interval, windows=2, steps_per_frame=twin.steps_per_frame)
    space = parameter_space(twin.truth, free=("kinematic_viscosity",), speed=scene.speed, spacing=twin.grid.spacing)
    return build_problem(scene, plan), space


def objective(problem, space) -> float:
    """Loss and departures from the measured starts."""
    departed = sum(float(np.square(r).sum()) for r in start_residuals(problem))
    return evaluate(problem, space, space.prior_raw, Budget()).loss + departed


def test_a_start_ends_within_what_is_said_of_the_best(rough, monkeypatch):
    problem, space = rough
    before, budget, long = objective(problem, space), Budget(), Budget()
    found = corrected_starts(problem, space, space.prior_raw, budget, iterations=30)
    monkeypatch.setattr(starts, "SETTLED", 0.0)
    best = corrected_starts(problem, space, space.prior_raw, long, iterations=30)
    reached, least = objective(found, space), objective(best, space)
    assert least < 0.9 * before  # there was something to gain
    assert reached <= least * (1 + 1e-3)
    assert budget.work < 0.7 * long.work


def test_a_start_that_is_found_is_left_at_once(rough):
    problem, space = rough
    found = corrected_starts(problem, space, space.prior_raw, Budget(), iterations=30)
    again = Budget()
    left = corrected_starts(found, space, space.prior_raw, again, iterations=30)
    # one rollout and its gradient for each window
    assert again.work == pytest.approx(3 * problem.work)
    for window, other in zip(left.windows, found.windows, strict=True):
        assert torch.equal(window.start, other.start)


class Counted(Budget):
    """A budget that keeps how many tasks were handed out at once."""

    def each(self, problem, task, *arguments):
        self.handed = len(arguments[0])
        return super().each(problem, task, *arguments)


def test_a_profile_is_shared_out_evenly_and_is_the_same_bits_for_any_number_of_workers():
    twin = make_twin("river", seed=0, noise=0.2, hidden=0.0, cells=(12, 6, 6), frames=6)
    scene = build_scene(
        twin.frames, [twin.cell_types] * len(twin.frames), None, twin.grid, kind=twin.kind, mainstream=twin.mainstream
    )
    plan = plan_windows(scene, twin.interval, windows=2, steps_per_frame=twin.steps_per_frame)
    free = ("kinematic_viscosity", "density", "inflow_velocity")
    space = parameter_space(twin.truth, free=free, speed=scene.speed, spacing=twin.grid.spacing)
    problem, found = build_problem(scene, plan), {}
    for workers, tasks in ((1, 2), (2, 2), (3, 6), (4, 4)):
        budget = Counted(workers=workers)
        here = evaluate(problem, space, space.prior_raw, budget)
        slopes = jacobian(problem, space, here, budget)
        found[workers] = profile(problem, space, here, slopes, budget, iterations=3)
        assert budget.handed == tasks
    one = found.pop(1)
    density = [f.name for f in space.fitted].index("density")  # no velocity shows it
    for columns, moves in zip(one.slopes.columns, one.moves, strict=True):
        assert not columns[density].any()
        assert not moves[density].any()
        assert np.delete(moves, density, axis=0).any(axis=1).all()
    for other in found.values():
        assert np.array_equal(other.slopes.normal, one.slopes.normal)
        for a, b in zip([*one.slopes.columns, *one.moves], [*other.slopes.columns, *other.moves], strict=True):
            assert np.array_equal(a, b)
