"""The loss of the paper and its least-squares form."""

import numpy as np
import pytest
import torch

from fluidlift.fit.loss import VelocityLossWeights, grid_mask, residuals, surface_cells, velocity_loss
from fluidlift.types import CellType


def fields(seed=0):
    rng = np.random.default_rng(seed)
    target = torch.tensor(rng.standard_normal((4, 3, 2, 3)))
    mask = torch.tensor(rng.random((4, 3, 2)))
    return target, mask / mask.sum()


def test_equal_velocities_lose_nothing_and_a_fluid_at_rest_loses_more_than_beta():
    target, mask = fields()
    assert float(velocity_loss(target, target, mask, speed=1.0)) == 0.0
    speed = float(target.norm(dim=-1).mean())
    at_rest = float(velocity_loss(torch.zeros_like(target), target, mask, speed=speed))
    assert at_rest > 1.0


def test_without_stagnation_the_direction_term_is_one_minus_cosine():
    target, mask = fields()
    other = fields(1)[0]
    weights = VelocityLossWeights(direction=1.0, magnitude=0.0, stagnant=0.0)
    cosine = (target * other).sum(-1) / (target.norm(dim=-1) * other.norm(dim=-1))
    expected = float((mask * (1 - cosine)).sum())
    assert float(velocity_loss(other, target, mask, speed=1.0, weights=weights)) == pytest.approx(expected, rel=1e-12)


def test_reversed_flow_loses_its_direction_in_full():
    target, mask = fields()
    weights = VelocityLossWeights(direction=1.0, magnitude=0.0, stagnant=0.0)
    assert float(velocity_loss(-target, target, mask, speed=1.0, weights=weights)) == pytest.approx(2.0, rel=1e-12)


def test_squares_of_the_residuals_add_up_to_the_loss():
    target, mask = fields()
    other = fields(1)[0]
    r = residuals(other, target, mask, speed=0.7)
    assert float((r**2).sum()) == pytest.approx(float(velocity_loss(other, target, mask, speed=0.7)), rel=1e-12)


def test_the_loss_has_a_finite_gradient_at_rest():
    target, mask = fields()
    still = torch.zeros_like(target, requires_grad=True)
    velocity_loss(still, target, mask, speed=1.0).backward()
    assert bool(torch.isfinite(still.grad).all())
    assert float(still.grad.abs().max()) > 0


def test_the_mask_weighs_surface_over_depth_and_ignores_walls():
    types = np.full((3, 3, 4), CellType.FLUID, np.uint8)
    types[:, :, 0] = CellType.SOLID
    types[:, :, 3] = CellType.EMPTY
    types[0] = CellType.INFLOW
    mask = grid_mask(types)
    assert surface_cells(types)[1, 1].tolist() == [False, False, True, False]
    assert mask[1, 1, 2] == pytest.approx(2 * mask[1, 1, 1])
    assert mask.sum() == pytest.approx(1.0, rel=1e-6)
    assert (mask[types != CellType.FLUID] == 0).all()


def test_a_layout_without_fluid_is_refused():
    with pytest.raises(ValueError, match="no fluid cell"):
        grid_mask(np.zeros((2, 2, 2), np.uint8))


def test_errors_of_a_target_do_not_pass_for_friction():
    """Targets of one velocity with errors: the mean gradient of the direction term at the true one is zero."""
    rng = np.random.default_rng(0)
    weights = VelocityLossWeights(magnitude=0.0, stagnant=0.4)
    slopes = {}
    for size in (0.1, 0.4, 1.0):
        target = torch.tensor([size, 0.0, 0.0]) + 0.14 * torch.tensor(rng.standard_normal((200_000, 3)))
        mask = torch.full((200_000,), 1 / 200_000, dtype=torch.float64)
        for error in (0.0, 0.14):
            stretch = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
            there = (stretch * torch.tensor([size, 0.0, 0.0], dtype=torch.float64)).expand(200_000, 3)
            velocity_loss(there, target, mask, speed=1.0, weights=weights, error=error).backward()
            slopes[size, error] = abs(float(stretch.grad))
    for size in (0.1, 0.4, 1.0):
        # what is left is of fourth order in 0.14 / 0.4, and scatter of 1 / sqrt(200000)
        assert slopes[size, 0.14] < 0.25 * slopes[size, 0.0]
