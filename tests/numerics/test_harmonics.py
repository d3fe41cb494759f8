"""Spherical harmonics are orthonormal on the sphere."""

import numpy as np
import pytest

from fluidlift.numerics.harmonics import basis


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_basis_is_orthonormal(degree):
    # Gauss-Legendre in z and equal steps around: exact for products of degree 6
    z, weight = np.polynomial.legendre.leggauss(8)
    angle = np.arange(16) * 2 * np.pi / 16
    r = np.sqrt(1 - z**2)
    points = np.stack(
        [np.outer(r, np.cos(angle)), np.outer(r, np.sin(angle)), np.repeat(z[:, None], 16, 1)], -1
    ).reshape(-1, 3)
    weights = np.repeat(weight * 2 * np.pi / 16, 16)
    b = basis(points, degree)
    np.testing.assert_allclose(b.T @ (b * weights[:, None]), np.eye(b.shape[1]), atol=1e-12)


def test_a_degree_beyond_three_is_refused():
    with pytest.raises(ValueError, match="degree 4"):
        basis(np.zeros((1, 3)), 4)
