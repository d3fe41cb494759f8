"""Axes of symmetric 3x3 matrices, in lanes."""

import numpy as np
import pytest

from fluidlift.numerics.symmetric3 import LANES, axes_of, matrices


def found(many):
    """(eigenvalues [n,3], vectors [n,3,3]) of `LANES` matrices or fewer; those left over are unit matrices."""
    a, v = matrices(), matrices()
    filled = np.broadcast_to(np.eye(3), (LANES, 3, 3)).copy()
    filled[: len(many)] = many
    for entry, values in zip(a, filled.reshape(LANES, 9).T):
        entry[:] = values
    axes_of(a, v, np.empty(LANES, np.bool_))
    values, vectors = np.stack([a[0], a[4], a[8]], axis=1), np.stack(v, axis=1).reshape(LANES, 3, 3)
    return values[: len(many)], vectors[: len(many)]


def symmetric(seed, n=LANES):
    half = np.random.default_rng(seed).normal(size=(n, 3, 3))
    return half @ np.swapaxes(half, 1, 2)


@pytest.mark.parametrize("seed", range(4))
def test_axes_and_lengths_are_those_of_lapack(seed):
    many = symmetric(seed)
    values, vectors = found(many)
    largest = np.linalg.norm(many, axis=(1, 2))[:, None]
    # the sweeps end at angles of 1e-9, of which a length sees the square
    assert (np.abs(np.sort(values, axis=1) - np.linalg.eigvalsh(many)) < 1e-13 * largest).all()
    again = (vectors * values[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    assert (np.abs(again - many) < 3e-9 * largest[..., None]).all()


def test_axes_are_a_proper_rotation():
    _, vectors = found(symmetric(5))
    np.testing.assert_allclose(
        vectors @ np.swapaxes(vectors, 1, 2), np.broadcast_to(np.eye(3), vectors.shape), atol=1e-14
    )
    np.testing.assert_allclose(np.linalg.det(vectors), 1.0, atol=1e-14)


def test_what_is_diagonal_stays_as_it_is():
    many = np.array([np.diag(d) for d in ([3.0, 2.0, 1.0], [0.0, 0.0, 0.0], [1.0, 1.0, 1e-12], [-1.0, 2.0, 0.0])])
    values, vectors = found(many)
    np.testing.assert_array_equal(values, [np.diag(m) for m in many])
    np.testing.assert_array_equal(vectors, np.broadcast_to(np.eye(3), vectors.shape))


def test_equal_lengths_and_none_at_all_have_axes_too():
    turn = np.linalg.qr(np.random.default_rng(6).normal(size=(3, 3)))[0]
    lengths = np.array([[2.0, 2.0, 1.0], [2.0, 1.0, 1.0], [1.0, 0.0, 0.0], [1.0, 1.0 + 1e-12, 1e-9]])
    many = (turn * lengths[:, None, :]) @ turn.T
    values, vectors = found(many)
    np.testing.assert_allclose(np.sort(values, axis=1), np.sort(lengths, axis=1), atol=1e-15 * 10)
    np.testing.assert_allclose((vectors * values[:, None, :]) @ np.swapaxes(vectors, 1, 2), many, atol=1e-8)


def test_a_lane_does_not_hang_on_what_is_beside_it():
    many = symmetric(7)
    values, vectors = found(many)
    for n in range(LANES):
        alone = found(many[n : n + 1])
        np.testing.assert_array_equal(alone[0][0], values[n])
        np.testing.assert_array_equal(alone[1][0], vectors[n])


def test_what_is_not_finite_spoils_no_other():
    many = symmetric(8)
    values, _ = found(many)
    many[3] = np.nan
    many[9, 0, 1] = many[9, 1, 0] = np.inf
    spoilt, _ = found(many)
    sound = np.isin(np.arange(LANES), (3, 9), invert=True)
    np.testing.assert_array_equal(spoilt[sound], values[sound])
