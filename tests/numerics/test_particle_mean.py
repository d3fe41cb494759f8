"""Means of what particles carry."""

import numpy as np
import pytest

from fluidlift.numerics.particle_mean import kernel_mean, kernel_mean_plain


def scene(count: int = 800):
    rng = np.random.default_rng(0)
    particles = rng.random((count, 3)).astype(np.float32) * np.float32([1.0, 0.5, 0.2])
    return particles[::7] + np.float32(0.01), particles, rng.random((count, 5)).astype(np.float32)


@pytest.mark.parametrize("reach", [0.07, 0.15, 3.0])
def test_the_fast_mean_is_its_plain_twin(reach):
    points, particles, values = scene()
    fast, plain = kernel_mean(points, particles, values, reach), kernel_mean_plain(points, particles, values, reach)
    # distances are single precision: up to 1e-6 of a reach, times the spline's slope
    np.testing.assert_allclose(fast, plain, atol=1e-5)


def test_an_even_field_stays_even_up_to_the_rim():
    points, particles, _ = scene()
    rim = points + np.float32([0, 0, 0.1])
    values = np.full((len(particles), 1), 0.4, np.float32)
    np.testing.assert_allclose(kernel_mean(rim, particles, values, 0.15), 0.4, rtol=1e-6)


def test_stray_particles_change_nothing_elsewhere_and_cost_no_memory():
    points, particles, values = scene()
    far = np.float32([[1e6, -3e5, 2e5], [1e30, 0, 0]])
    more = np.concatenate([particles, far]), np.concatenate([values, np.full((2, 5), 9, np.float32)])
    # the cells begin elsewhere: sums in another order, and the lowest corner is 3e5 m away in double precision
    np.testing.assert_allclose(
        kernel_mean(points, *more, 0.15), kernel_mean(points, particles, values, 0.15), atol=1e-6
    )


def test_a_point_out_of_reach_takes_the_nearest():
    _, particles, values = scene()
    lonely = np.float32([[5, 5, 5]])
    nearest = np.linalg.norm(particles - lonely, axis=1).argmin()
    assert np.array_equal(kernel_mean(lonely, particles, values, 0.1)[0], values[nearest])


def test_none_to_take_a_mean_of_is_refused():
    points, particles, values = scene()
    with pytest.raises(ValueError, match="no particles"):
        kernel_mean(points, particles[:0], values[:0], 0.1)
    with pytest.raises(ValueError, match="reach"):
        kernel_mean(points, particles, values, 0.0)
