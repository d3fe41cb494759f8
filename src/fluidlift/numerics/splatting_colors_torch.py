"""Differentiable colours of Gaussians in torch: the kernels of `splatting_colors` as an autograd function, and plain.

`view_colors` and `view_colors_plain` are the same function, compiled and for reading.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from fluidlift.numerics.splatting_colors import C0, C1, C2, C3, colors, colors_backward_kernel


class _ViewColors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means: Tensor, sh: Tensor, position: np.ndarray) -> Tensor:
        arrays = means.detach().contiguous().numpy(), sh.detach().contiguous().numpy()
        out = colors(*arrays, position)
        ctx.saved = (*arrays, position, out)
        return torch.from_numpy(out)

    @staticmethod
    def backward(ctx: Any, g_out: Tensor) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        means, sh, position, out = ctx.saved
        g_means, g_sh = np.empty_like(means), np.empty_like(sh)
        colors_backward_kernel(means, sh, position, out, g_out.contiguous().numpy(), g_means, g_sh)
        return torch.from_numpy(g_means), torch.from_numpy(g_sh), None


def view_colors(means: Float[Tensor, "n 3"], sh: Float[Tensor, "n k 3"], position: np.ndarray) -> Float[Tensor, "n 3"]:
    """`colors` with gradients to the harmonics and, through the line of sight, to the means."""
    return _ViewColors.apply(means, sh, np.asarray(position, np.float64))


def view_colors_plain(
    means: Float[Tensor, "n 3"], sh: Float[Tensor, "n k 3"], position: np.ndarray
) -> Float[Tensor, "n 3"]:
    """The plain twin of `view_colors`."""
    d = means - torch.as_tensor(position, dtype=means.dtype)
    x, y, z = (d / d.norm(dim=1, keepdim=True).clamp(min=1e-12)).unbind(1)
    values = [
        torch.full_like(x, C0), -C1 * y, C1 * z, -C1 * x,
        C2[0] * x * y, -C2[0] * y * z, C2[1] * (2 * z * z - x * x - y * y), -C2[0] * x * z,
        C2[2] * (x * x - y * y),
        -C3[0] * y * (3 * x * x - y * y), C3[1] * x * y * z, -C3[2] * y * (4 * z * z - x * x - y * y),
        C3[3] * z * (2 * z * z - 3 * x * x - 3 * y * y), -C3[2] * x * (4 * z * z - x * x - y * y),
        C3[4] * z * (x * x - y * y), -C3[0] * x * (x * x - 3 * y * y),
    ]  # fmt: skip
    basis = torch.stack(values[: sh.shape[1]], 1)
    return (0.5 + torch.einsum("nk,nkc->nc", basis, sh)).clamp(min=0)
