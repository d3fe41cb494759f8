"""Differentiable Gaussian splatting in torch: the fast kernels of `splatting` as autograd functions, and a plain twin.

`splat` and `splat_dense` compute the same picture and the same gradients. The twin is written for reading: every
Gaussian meets every pixel, in whatever precision the tensors have; torch differentiates it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from fluidlift.numerics import splatting
from fluidlift.numerics.splatting import Projected, SplatCamera
from fluidlift.numerics.splatting_kernels import ALPHA_MAX, TRANSMITTANCE_MIN
from fluidlift.numerics.splatting_projection import ALPHA_MIN, BLUR
from fluidlift.seams import Rasterizer, Splatted, SplatView


def _array(tensor: Tensor) -> np.ndarray:
    """float64 stays (for exact comparisons), all else is drawn in float32."""
    values = tensor.detach().numpy()
    return np.ascontiguousarray(values, np.float64 if values.dtype == np.float64 else np.float32)


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, view: SplatCamera) -> Any:
        arrays = _array(means), _array(quats), _array(scales)
        projected = splatting.project(view, *arrays, _array(opacities))
        ctx.saved = (view, *arrays, projected)
        depths, extents = torch.from_numpy(projected.depths), torch.from_numpy(projected.extents)
        ctx.mark_non_differentiable(depths, extents)
        return torch.from_numpy(projected.means), torch.from_numpy(projected.conics), depths, extents

    @staticmethod
    def backward(ctx: Any, g_uv: Tensor, g_conics: Tensor, *_: Tensor) -> Any:
        view, means, quats, scales, projected = ctx.saved
        gradients = splatting.project_backward(view, means, quats, scales, projected, _array(g_uv), _array(g_conics))
        return (*(torch.from_numpy(g) for g in gradients), None, None)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, uv: Tensor, conics: Tensor, opacities: Tensor, features: Tensor,
        depths: Tensor, extents: Tensor, size: tuple[int, int],
    ) -> Any:  # fmt: skip
        projected = Projected(_array(uv), _array(conics), _array(depths), _array(extents))
        bins = splatting.bin_tiles(projected, size)
        arrays = _array(opacities), _array(features)
        image, light = splatting.rasterize(projected, *arrays, bins, size)
        ctx.saved = (projected, *arrays, bins, image, light)
        return torch.from_numpy(image), torch.from_numpy(light)

    @staticmethod
    def backward(ctx: Any, g_image: Tensor, g_light: Tensor) -> Any:
        projected, opacities, features, bins, image, light = ctx.saved
        gradients = splatting.rasterize_backward(
            projected, opacities, features, bins, image, light, _array(g_image), _array(g_light)
        )
        return (*(torch.from_numpy(g) for g in gradients), None, None, None)


def project(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, " n"],
    view: SplatCamera,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Centres [n,2] px, conics [n,3], depths [n] m and box sizes [n,2] px; the first two carry gradients.

    The opacities only decide how far a Gaussian reaches. Quaternions are normalised here.
    """
    return _Project.apply(means, quats, scales, opacities, view)


def rasterize(
    uv: Float[Tensor, "n 2"],
    conics: Float[Tensor, "n 3"],
    opacities: Float[Tensor, " n"],
    features: Float[Tensor, "n c"],
    depths: Float[Tensor, " n"],
    extents: Float[Tensor, "n 2"],
    size: tuple[int, int],
) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w"]]:
    """Features composited front to back and the transmittance left, with gradients to the first four."""
    return _Rasterize.apply(uv, conics, opacities, features, depths, extents, size)


def splat(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, " n"],
    features: Float[Tensor, "n c"],
    view: SplatCamera,
) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w"]]:
    """Picture of any features and the transmittance left, differentiable in all five operands (float32)."""
    uv, conics, depths, extents = project(means, quats, scales, opacities, view)
    return rasterize(uv, conics, opacities, features, depths, extents, view.size)


class NumbaRasterizer(Rasterizer):
    """The kernels of `splatting` behind the seam: on the CPU, whatever device the operands are on."""

    def splat(
        self, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, features: Tensor, view: SplatView
    ) -> Splatted:
        """See `seams.Rasterizer`."""
        numbers = SplatCamera(view.rotation, view.translation, view.focal, view.center, view.size, view.near)
        o = opacities.cpu()
        uv, conics, depths, extents = project(means.cpu(), quats.cpu(), scales.cpu(), o, numbers)
        if uv.requires_grad:
            uv.retain_grad()
        image, light = rasterize(uv, conics, o, features.cpu(), depths, extents, view.size)
        return Splatted(image.to(means.device), light.to(means.device), uv)


def splat_dense(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, " n"],
    features: Float[Tensor, "n c"],
    view: SplatCamera,
) -> tuple[Float[Tensor, "h w c"], Float[Tensor, "h w"]]:
    """The plain twin of `splat`: n x h x w numbers, for small scenes and for reading."""
    dtype = means.dtype
    z = means.detach() @ torch.as_tensor(view.rotation[2], dtype=dtype) + float(view.translation[2])
    order = torch.argsort(z, stable=True)
    order = order[z[order] > view.near]
    means, quats, scales, opacities, features = (a[order] for a in (means, quats, scales, opacities, features))
    uv, covariance = ellipses(means, quats, scales, view)
    conic = torch.linalg.inv(covariance)

    width, height = view.size
    v, u = torch.meshgrid(
        torch.arange(height, dtype=dtype) + 0.5, torch.arange(width, dtype=dtype) + 0.5, indexing="ij"
    )
    d = torch.stack([u, v], -1)[None] - uv[:, None, None, :]
    power = 0.5 * torch.einsum("nhwi,nij,nhwj->nhw", d, conic, d)
    raw = opacities[:, None, None] * torch.exp(-power)
    alpha = torch.where(raw >= float(ALPHA_MIN), raw.clamp(max=float(ALPHA_MAX)), torch.zeros_like(raw))

    passed = torch.cumprod(1 - alpha, 0)
    before = torch.cat([torch.ones_like(passed[:1]), passed[:-1]])
    # finished at the first Gaussian that would pass too little
    live = (passed > float(TRANSMITTANCE_MIN)).cummin(0).values
    weights = torch.where(live, alpha * before, torch.zeros_like(alpha))
    light = torch.where(live, 1 - alpha, torch.ones_like(alpha)).prod(0)
    return torch.einsum("nhw,nc->hwc", weights, features), light


def ellipses(
    means: Float[Tensor, "n 3"], quats: Float[Tensor, "n 4"], scales: Float[Tensor, "n 3"], view: SplatCamera
) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n 2 2"]]:
    """Centres (px) and covariances (px^2) in the picture: the plain twin of `project`."""
    rotation = torch.as_tensor(view.rotation, dtype=means.dtype)
    x = means @ rotation.T + torch.as_tensor(view.translation, dtype=means.dtype)
    z = x[:, 2]
    focal = torch.tensor(view.focal, dtype=x.dtype)
    center = torch.tensor(view.center, dtype=x.dtype)
    size = torch.tensor(view.size, dtype=x.dtype)
    margin = 0.15 * size / focal
    slope = torch.clamp(x[:, :2] / z[:, None], -center / focal - margin, (size - center) / focal + margin)
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [
            torch.stack([focal[0] / z, zero, -focal[0] / z * slope[:, 0]], -1),
            torch.stack([zero, focal[1] / z, -focal[1] / z * slope[:, 1]], -1),
        ],
        1,
    )
    half = jacobian @ rotation @ rotation_matrices(quats) * scales[:, None, :]
    covariance = half @ half.transpose(1, 2) + float(BLUR) * torch.eye(2, dtype=x.dtype)
    return x[:, :2] / z[:, None] * focal + center, covariance


def rotation_matrices(quats: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3 3"]:
    """Rotation matrices of quaternions w x y z, normalised here."""
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True).clamp(min=1e-12)).unbind(1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).reshape(-1, 3, 3)
