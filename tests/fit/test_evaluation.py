"""What a fit may spend."""

import time

import numba
import numpy as np
import pytest

from fluidlift.fit.evaluation import Budget, evaluate, jacobian
from fluidlift.fit.problem import build_problem
from fluidlift.fit.ranges import parameter_space
from fluidlift.fit.scene import build_scene, plan_windows
from fluidlift.synthetic.twins import make_twin


@pytest.fixture(scope="module")
def river():
    """A small river in two windows, with its density and its viscosity unknown."""
    twin = make_twin("river", seed=0, noise=0.0, hidden=0.0, cells=(16, 8, 8), frames=8)
    scene = build_scene(
        twin.frames, [twin.cell_types] * len(twin.frames), None, twin.grid, kind=twin.kind, mainstream=twin.mainstream
    )
    plan = plan_windows(scene, twin.interval, windows=2, steps_per_frame=twin.steps_per_frame)
    free = ("density", "kinematic_viscosity")
    space = parameter_space(twin.truth, free=free, speed=scene.speed, spacing=twin.grid.spacing)
    return build_problem(scene, plan), space


def test_the_clock_stands_while_kernels_are_compiled():
    kernel = numba.njit(lambda a: a.sum())
    began = time.monotonic()
    budget = Budget()
    with budget.counted():
        kernel.compile((numba.float32[:],))
    took = time.monotonic() - began
    budget.deadline = time.monotonic() - 0.5 * took  # it would be over, had it gone on
    assert not budget.spent
    budget.deadline -= took
    assert budget.spent and budget.ended_by.startswith("the clock")


def test_no_velocity_shows_the_density_and_no_rollout_asks_for_it(river):
    problem, space = river
    here = evaluate(problem, space, space.prior_raw, Budget())
    heavier = evaluate(problem, space, space.prior_raw + [0.5, 0.0], Budget())
    for before, after in zip(here.residuals, heavier.residuals, strict=True):
        np.testing.assert_array_equal(before, after)
    budget = Budget()
    slopes = jacobian(problem, space, here, budget)
    assert budget.rollouts == len(problem.windows)
    assert all(not c[0].any() and c[1].any() for c in slopes.columns)


def test_a_window_begins_with_the_same_flow_whoever_asks(river):
    problem, space = river
    first = evaluate(problem, space, space.prior_raw, Budget())
    moved = problem.with_starts([1.1 * w.start for w in problem.windows])
    other = evaluate(moved, space, space.prior_raw, Budget())
    again = evaluate(problem, space, space.prior_raw, Budget())
    for one, two, three in zip(first.residuals, other.residuals, again.residuals, strict=True):
        assert np.abs(one - two).max() > 1e-3  # a tenth more speed shows
        np.testing.assert_array_equal(one, three)
