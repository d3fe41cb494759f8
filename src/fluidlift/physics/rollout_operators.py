"""Linear operators of the rollout as differentiable functions: sparse maps and backward Euler diffusion."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy import sparse
from torch import Tensor

from fluidlift.physics.rollout_domain import LinearMap, RolloutDomain


class _Apply(torch.autograd.Function):
    """A sparse matrix; backward is its transpose."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, linear: LinearMap) -> Tensor:
        ctx.linear = linear
        return torch.from_numpy(linear.matrix @ x.detach().numpy())

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        return torch.from_numpy(ctx.linear.transpose @ gradients[0].contiguous().numpy()), None


def apply_linear(x: Tensor, linear: LinearMap) -> Tensor:
    """The sparse map of a vector; differentiable."""
    return _Apply.apply(x, linear)


class _Diffuse(torch.autograd.Function):
    """x with (1 - c L + e W) x = b, L symmetric, W diagonal (given as a vector).

    The adjoint l = (1 - c L + e W)^-1 g gives db = l, dc = l . L x, de = -l . W x.
    """

    @staticmethod
    def forward(ctx: Any, b: Tensor, c: Tensor, e: Tensor, laplacian: sparse.csr_matrix, drag: np.ndarray) -> Tensor:
        ctx.operator = (float(c), float(e), laplacian, drag)
        x = _solve_diffusion(b.detach().numpy(), *ctx.operator)
        ctx.save_for_backward(torch.from_numpy(x))
        return torch.from_numpy(x)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        x = ctx.saved_tensors[0].numpy()
        _, _, laplacian, drag = ctx.operator
        adjoint = _solve_diffusion(gradients[0].contiguous().numpy(), *ctx.operator)
        wide = adjoint.astype(float)
        gc, ge = float(np.vdot(wide, laplacian @ x)), -float(np.vdot(wide, drag * x))
        dtype = gradients[0].dtype
        return torch.from_numpy(adjoint), torch.tensor(gc, dtype=dtype), torch.tensor(ge, dtype=dtype), None, None


def _solve_diffusion(
    b: np.ndarray, c: float, e: float, laplacian: sparse.csr_matrix, drag: np.ndarray, max_iterations: int = 500
) -> np.ndarray:
    """Conjugate gradients for (1 - c L + e W) x = b; the diagonal varies little, so no preconditioner is needed."""
    tolerance = 1e-6 if b.dtype == np.float32 else 1e-13
    friction = b.dtype.type(e) * drag
    x = b.copy()
    residual = c * (laplacian @ b) - friction * b
    direction = residual.copy()
    rr = float(np.vdot(residual, residual))
    goal = (tolerance * float(np.linalg.norm(b))) ** 2
    for _ in range(max_iterations):
        if rr <= goal:
            break
        image = direction - c * (laplacian @ direction) + friction * direction
        alpha = rr / float(np.vdot(direction, image))
        x += b.dtype.type(alpha) * direction
        residual -= b.dtype.type(alpha) * image
        rr, previous = float(np.vdot(residual, residual)), rr
        direction = residual + b.dtype.type(rr / previous) * direction
    return x


def implicit_diffusion(
    velocity: Float[Tensor, "f"], domain: RolloutDomain, viscosity: Tensor, wall_damping: Tensor, time_step: Tensor
) -> Float[Tensor, "f"]:
    """One backward Euler step of viscosity; prescribed faces act as boundary values, walls by their damping."""
    c = viscosity * time_step
    b = velocity + c * apply_linear(velocity, domain.boundary_laplacian)
    e = c * wall_damping * (2 / float(domain.system.spacing) ** 2)
    return _Diffuse.apply(b, c, e, domain.laplacian, domain.wall_count)
