"""The five terms of the refinement mean what they say."""

import pytest
import torch

from fluidlift.shape.losses import (
    LossWeights,
    anisotropy_loss,
    depth_loss,
    image_loss,
    luminance_loss,
    scale_loss,
    structural_similarity,
    volume_loss,
)
from fluidlift.types.gaussians import SH_C0


def pictures(height: int = 20, width: int = 27) -> tuple[torch.Tensor, torch.Tensor]:
    rng = torch.Generator().manual_seed(0)
    return torch.rand(height, width, 3, generator=rng), torch.rand(height, width, 3, generator=rng)


def test_equal_pictures_are_perfectly_similar_and_cost_nothing():
    a, _ = pictures()
    torch.testing.assert_close(structural_similarity(a, a), torch.ones(20, 27))
    assert image_loss(a, a, torch.ones(20, 27), 0.2).abs() < 1e-6


def test_the_filtered_image_loss_equals_the_plain_one_with_its_gradient():
    a, b = pictures()
    weight = torch.rand(20, 27, generator=torch.Generator().manual_seed(1))
    fast, plain = a.clone().requires_grad_(), a.clone().requires_grad_()
    value = image_loss(fast, b, weight, 1.0)
    exact = 1 - (structural_similarity(plain, b) * weight).sum() / weight.sum()
    value.backward()
    exact.backward()
    # float32 through differences of squares: 1e-7 over variances of about 0.05
    torch.testing.assert_close(value, exact, atol=1e-5, rtol=0)
    torch.testing.assert_close(fast.grad, plain.grad, atol=1e-4 * float(plain.grad.abs().max()), rtol=1e-3)


def test_pixels_without_weight_do_not_count():
    a, b = pictures()
    weight = torch.zeros(20, 27)
    weight[:, :8] = 1
    far = b.clone()
    far[:, 20:] = 0  # the window reaches five pixels
    torch.testing.assert_close(image_loss(a, b, weight, 0.2), image_loss(a, far, weight, 0.2))


def test_needles_cost_and_discs_are_free():
    assert anisotropy_loss(torch.tensor([[1.0, 1.0, 0.01]])) == 0
    assert anisotropy_loss(torch.tensor([[1.0, 1.05, 0.5]])) == 0
    torch.testing.assert_close(anisotropy_loss(torch.tensor([[0.5, 3.0, 1.0]])), torch.tensor(1.9))


def test_the_hinge_holds_large_volumes_only_and_the_mean_all():
    sizes = torch.tensor([[1.0, 1, 1], [1, 1, 1], [1, 1, 1], [2, 2, 2]], requires_grad=True)
    hinge = volume_loss(sizes, "hinge")
    torch.testing.assert_close(hinge, torch.tensor(1.5))  # (8 - 2) / 4
    (g,) = torch.autograd.grad(hinge, sizes)
    assert (g[:3] == 0).all() and (g[3] > 0).all()
    torch.testing.assert_close(volume_loss(sizes, "mean"), torch.tensor(11 / 4))
    assert (torch.autograd.grad(volume_loss(sizes, "mean"), sizes)[0] > 0).all()
    with pytest.raises(ValueError, match="volume_form"):
        LossWeights(volume_form="cube")


def test_the_scale_term_is_the_mean_geometric_mean():
    torch.testing.assert_close(scale_loss(torch.tensor([[1.0, 2, 4], [3, 3, 3]])), torch.tensor(2.5))


def test_only_oversaturated_colours_cost():
    rgb = torch.tensor([[0.0, 0.5, 1.0], [1.2, 0.5, -0.1]])
    torch.testing.assert_close(luminance_loss((rgb - 0.5) / SH_C0), torch.tensor((0.2**2 + 0.1**2) / 6))


def test_depth_costs_where_it_is_known_and_covered():
    before = torch.tensor([[2.0, float("nan")]])
    light = torch.tensor([[0.5, 0.0]], requires_grad=True)
    drawn = torch.tensor([[1.0, 7.0]], requires_grad=True)
    assert depth_loss(drawn, light, before, 0.1) == 0, "half covered at depth 2 composites to 1"
    cost = depth_loss(drawn + 0.05, light, before, 0.1)
    torch.testing.assert_close(cost, torch.tensor(0.5))
    g = torch.autograd.grad(cost, (drawn, light))
    assert all(torch.isfinite(x).all() for x in g) and g[0][0, 1] == 0
