"""Colours by harmonics agree with the plain twin, the basis and finite differences."""

import numpy as np
import pytest
import torch

from fluidlift.numerics.harmonics import basis
from fluidlift.numerics.splatting_colors import colors
from fluidlift.numerics.splatting_colors_torch import view_colors, view_colors_plain

EYE = np.array([0.3, -2.0, 0.8])


def body(coefficients: int, count: int = 60, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(seed)
    sh = 1.5 * rng.normal(size=(count, coefficients, 3))
    return torch.tensor(rng.normal(size=(count, 3)), requires_grad=True), torch.tensor(sh, requires_grad=True)


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
def test_colours_and_their_gradients_equal_the_plain_twin(coefficients):
    means, sh = body(coefficients)
    push = torch.randn(60, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    results = []
    for function in (view_colors, view_colors_plain):
        out = function(means, sh, EYE)
        gradients = torch.autograd.grad((out * push).sum(), (means, sh), allow_unused=True)
        results.append((out, *gradients))
    (out, g_means, g_sh), (exact, e_means, e_sh) = results
    assert (exact == 0).any() and (exact > 0).any(), "some colours must be held at 0"
    # double precision on both sides
    assert (out - exact).abs().max() < 1e-13 and (g_sh - e_sh).abs().max() < 1e-13
    e_means = torch.zeros_like(means) if e_means is None else e_means
    assert (g_means - e_means).abs().max() < 1e-12


def test_gradients_of_all_degrees_are_finite_differences():
    means, sh = body(16, 8)
    # central differences of a smooth function: error about step^2 + 1e-16 / step
    assert torch.autograd.gradcheck(lambda m, s: view_colors(m, s, EYE), (means, sh), eps=1e-6, atol=1e-7, rtol=1e-6)


def test_colours_are_those_of_the_basis():
    means, sh = (x.detach().numpy() for x in body(16))
    d = means - EYE
    expected = 0.5 + np.einsum("nk,nkc->nc", basis(d / np.linalg.norm(d, axis=1, keepdims=True), 3), sh)
    np.testing.assert_allclose(colors(means, sh, EYE), np.maximum(expected, 0), atol=1e-13)


def test_a_gaussian_at_the_camera_has_a_finite_colour():
    out = colors(np.float32([EYE]), np.ones((1, 16, 3), np.float32), np.float32(EYE).astype(float))
    assert np.isfinite(out).all()


def test_other_numbers_of_coefficients_are_refused():
    with pytest.raises(ValueError, match="5 coefficients"):
        colors(np.zeros((2, 3), np.float32), np.zeros((2, 5, 3), np.float32), EYE)


def test_colours_of_some_are_those_of_all_in_the_order_asked_for():
    rng = np.random.default_rng(0)
    means, sh = rng.normal(size=(50, 3)).astype(np.float32), rng.normal(size=(50, 16, 3)).astype(np.float32)
    some = rng.permutation(50)[:20]
    assert np.array_equal(colors(means, sh, EYE, some), colors(means, sh, EYE)[some])
