"""Gaussians keep their shapes, their covariances are positive definite and move with the body."""

import numpy as np
import pytest

from fluidlift.types import (
    SH_C0,
    Gaussians,
    Similarity3,
    concatenate,
    decompose_covariances,
    harmonics,
    matrix_from_quat,
    sh_from_rgb,
)

TURN = Similarity3(3.0, matrix_from_quat(np.array([0.8, 0.1, -0.5, 0.3])), np.array([1.0, -2.0, 0.5]))


def some(n=8, k=1, seed=0):
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(n, 4))
    return Gaussians(
        rng.normal(size=(n, 3)), quats / np.linalg.norm(quats, axis=1, keepdims=True), rng.uniform(0.01, 1, (n, 3)),
        rng.uniform(0, 1, n), rng.normal(size=(n, k, 3)),
    )  # fmt: skip


def test_covariances_are_symmetric_with_the_squared_scales_as_eigenvalues():
    g = some()
    c = g.covariances()
    # float32 numbers up to 1
    np.testing.assert_allclose(c, np.swapaxes(c, 1, 2), atol=1e-7)
    np.testing.assert_allclose(np.linalg.eigvalsh(c), np.sort(g.scales**2, axis=1), rtol=1e-3, atol=1e-6)
    assert (np.linalg.eigvalsh(c.astype(np.float64)) > 0).all()


def test_a_moved_body_has_moved_covariances():
    g = some()
    moved = g.transformed(TURN)
    np.testing.assert_allclose(moved.means, TURN.points(g.means), rtol=1e-5, atol=1e-5)
    # float32, entries up to 9
    np.testing.assert_allclose(moved.covariances(), TURN.covariances(g.covariances()), atol=2e-5)
    np.testing.assert_array_equal(moved.opacities, g.opacities)
    np.testing.assert_array_equal(moved.sh, g.sh)


@pytest.mark.parametrize("coefficients", [4, 9, 16])
def test_a_turned_body_shows_the_same_colour_to_a_viewer_who_turned_with_it(coefficients):
    g, degree = some(k=coefficients), round(coefficients**0.5) - 1
    moved = g.transformed(TURN)
    directions = np.random.default_rng(1).normal(size=(len(g), 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    here = np.einsum("nk,nkc->nc", harmonics.basis(directions, degree), g.sh)
    there = np.einsum("nk,nkc->nc", harmonics.basis(directions @ TURN.rotation.T, degree), moved.sh)
    np.testing.assert_allclose(there, here, atol=2e-5)  # float32 sums of up to 16 terms of size up to 3
    assert np.abs(moved.sh[:, 1:] - g.sh[:, 1:]).max() > 0.1  # which the unturned coefficients would not have done
    np.testing.assert_array_equal(moved.sh[:, 0], g.sh[:, 0])


def test_a_turn_mixes_harmonics_of_one_degree_only_and_keeps_their_lengths():
    turn = harmonics.harmonics_rotation(TURN.rotation, 3)
    np.testing.assert_allclose(turn @ turn.T, np.eye(16), atol=1e-12)  # an orthonormal basis stays one
    degree = np.repeat([0, 1, 2, 3], [1, 3, 5, 7])
    assert np.abs(turn[degree[:, None] != degree]).max() < 1e-12


def test_a_body_moved_there_and_back_is_the_same():
    g = some()
    back = g.transformed(TURN).transformed(TURN.inverse())
    np.testing.assert_allclose(back.means, g.means, atol=1e-5)
    np.testing.assert_allclose(back.covariances(), g.covariances(), atol=1e-5)


def test_a_covariance_is_rebuilt_from_its_orientation_and_scales():
    c = some(20).covariances()
    quats, scales = decompose_covariances(c)
    assert (np.diff(scales, axis=1) >= 0).all()
    np.testing.assert_allclose(np.linalg.norm(quats, axis=1), 1, atol=1e-6)
    r = matrix_from_quat(quats) * scales[:, None, :]
    np.testing.assert_allclose(r @ np.swapaxes(r, 1, 2), c, atol=1e-6)


def test_a_flat_covariance_gets_the_floor_instead_of_no_thickness():
    _, scales = decompose_covariances(np.diag([1.0, 1.0, 0.0])[None], floor=1e-4)
    np.testing.assert_allclose(scales, [[0.01, 1, 1]])


def test_colours_in_the_harmonics_come_out_again():
    rgb = np.array([[0.0, 0.5, 1.0], [0.2, 0.3, 0.4]], np.float32)
    sh = sh_from_rgb(rgb)
    np.testing.assert_allclose(0.5 + SH_C0 * sh[:, 0], rgb, atol=1e-6)
    g = Gaussians.isotropic(np.zeros((2, 3)), 0.1, rgb)
    np.testing.assert_allclose(g.rgb, rgb, atol=1e-6)


def test_round_gaussians_have_the_same_variance_everywhere():
    g = Gaussians.isotropic(np.zeros((3, 3)), np.array([0.1, 0.2, 0.3]), np.full((3, 3), 0.5), 0.7)
    np.testing.assert_allclose(g.covariances()[1], 0.04 * np.eye(3), atol=1e-7)
    np.testing.assert_allclose(g.opacities, 0.7)


def test_joining_keeps_order_and_pads_harmonics():
    a, b = some(3, 1, 1), some(2, 4, 2)
    both = concatenate([a, Gaussians.empty(), b])
    assert len(both) == 5 and both.sh.shape == (5, 4, 3)
    np.testing.assert_array_equal(both.means, np.concatenate([a.means, b.means]))
    np.testing.assert_array_equal(both.sh[:3, :1], a.sh)
    assert (both.sh[:3, 1:] == 0).all()
    assert len(concatenate([Gaussians.empty(), Gaussians.empty()])) == 0


def test_selecting_takes_the_same_of_every_field():
    g = some()
    np.testing.assert_array_equal(g.select(g.opacities > 0.5).means, g.means[g.opacities > 0.5])
    np.testing.assert_array_equal(g.select(np.array([4, 1])).sh, g.sh[[4, 1]])


def test_fields_are_contiguous_single_precision():
    g = Gaussians(*(np.asfortranarray(getattr(some(), k)) for k in ("means", "quats", "scales", "opacities", "sh")))
    for name in ("means", "quats", "scales", "opacities", "sh"):
        array = getattr(g, name)
        assert array.dtype == np.float32 and array.flags.c_contiguous


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("quats", (8, 3)),
        ("scales", (7, 3)),
        ("opacities", (8, 1)),
        ("sh", (8, 2, 3)),
        ("sh", (8, 3)),
        ("sh", (7, 1, 3)),
    ],
)
def test_wrong_shapes_are_refused_by_name(name, shape):
    g = some()
    fields = {k: getattr(g, k) for k in ("means", "quats", "scales", "opacities", "sh")}
    with pytest.raises(ValueError, match=name):
        Gaussians(**(fields | {name: np.zeros(shape)}))
