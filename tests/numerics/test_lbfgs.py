"""L-BFGS ends where the gradient does, and as soon as it may."""

import numpy as np
import pytest

from fluidlift.numerics.lbfgs import lowered


class Counted:
    """Sum of d (x - a)^2 / 2 over n numbers, which counts how often it is asked."""

    def __init__(self, n: int, stiffest: float) -> None:
        rng = np.random.default_rng(0)
        self.best, self.bend, self.calls = rng.normal(size=n), np.geomspace(1.0, stiffest, n), 0

    def __call__(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        self.calls += 1
        away = x - self.best
        return 0.5 * float(self.bend @ away**2), self.bend * away


def rosenbrock(x: np.ndarray) -> tuple[float, np.ndarray]:
    """A curved valley, least (0) at (1, 1)."""
    a, b = 1.0 - x[0], x[1] - x[0] ** 2
    return a**2 + 100.0 * b**2, np.array([-2.0 * a - 400.0 * x[0] * b, 200.0 * b])


def test_a_quadratic_of_few_numbers_is_solved():
    bowl = Counted(5, 30.0)
    found = lowered(bowl, np.zeros(5), steps=40, evaluations=80)
    # the line searches are inexact: 40 steps leave far more than the rounding of doubles
    np.testing.assert_allclose(found, bowl.best, atol=1e-6)


def test_a_curved_valley_is_followed_to_its_end():
    found = lowered(rosenbrock, np.array([-1.2, 1.0]), steps=100, evaluations=200)
    np.testing.assert_allclose(found, [1.0, 1.0], atol=1e-5)


def test_each_step_is_downhill():
    start = np.array([-1.2, 1.0])
    reached = [rosenbrock(lowered(rosenbrock, start, steps=n, evaluations=200))[0] for n in range(12)]
    assert reached[0] == rosenbrock(start)[0]
    assert all(after < before for before, after in zip(reached, reached[1:], strict=False))


def test_single_precision_stays_single():
    bowl = Counted(50, 10.0)

    def single(x: np.ndarray) -> tuple[float, np.ndarray]:
        assert x.dtype == np.float32
        value, gradient = bowl(x)
        return value, gradient.astype(np.float32)

    found = lowered(single, np.zeros(50, np.float32), steps=30, evaluations=60)
    assert found.dtype == np.float32
    # the gradient is rounded to 1e-7 of numbers of about 10
    np.testing.assert_allclose(found, bowl.best, atol=1e-4)


def test_it_ends_at_the_first_point_that_will_do():
    bowl, seen = Counted(20, 100.0), []

    def settled(value: float, gradient: np.ndarray) -> bool:
        seen.append(value)
        return value < 1.0

    found = lowered(bowl, np.zeros(20), steps=50, evaluations=100, settled=settled)
    assert bowl.calls == len(seen)
    assert seen[-1] < 1.0 <= min(seen[:-1])
    assert bowl(found)[0] == seen[-1]


def test_no_step_is_begun_beyond_the_evaluations():
    bowl = Counted(20, 1000.0)
    lowered(bowl, np.zeros(20), steps=1000, evaluations=10)
    # a line search that was begun is ended; on a bowl it takes a few tries
    assert 10 <= bowl.calls < 15


@pytest.mark.parametrize("start", [np.zeros(3), np.array([2.0, -1.0, 0.5])])
def test_a_flat_function_stays_where_it_is(start):
    found = lowered(lambda x: (1.0, np.zeros_like(x)), start, steps=5, evaluations=10)
    np.testing.assert_array_equal(found, start)
