"""The terms of the single-view refinement of Gaussians (paper: `loss_optGS`), and one on depth.

The paper names the terms and gives no weights. The weights here are for lengths measured in the median scale of the
Gaussians before the refinement, so that they hold for a jet of millimetres and a fall of metres alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from fluidlift.errors import require
from fluidlift.types.gaussians import SH_C0


@dataclass(frozen=True)
class LossWeights:
    """Weights of `loss_optGS` and the parameters of its terms."""

    image: float = 1.0
    dissimilarity: float = 0.2
    """share of 1 - SSIM in the image term; the rest is L1 (3D Gaussian Splatting)"""
    anisotropy: float = 0.3
    stretch: float = 1.1
    """ratio of the two largest scales that is free (Gaussian Splashing, eq. 6)"""
    volume: float = 0.02
    volume_form: str = "hinge"
    """"hinge" or "mean", see `volume_loss`"""
    scale: float = 0.01
    luminance: float = 1.0
    depth: float = 0.02
    """not in the paper, see `depth_loss`"""

    def __post_init__(self) -> None:
        require(self.volume_form in ("hinge", "mean"), f"volume_form {self.volume_form!r}", "'hinge' or 'mean'")


def image_loss(
    picture: Float[Tensor, "h w 3"],
    target: Float[Tensor, "h w 3"],
    weight: Float[Tensor, "h w"],
    dissimilarity: float,
) -> Tensor:
    """(1 - d) L1 + d (1 - SSIM), averaged with a weight per pixel."""
    total = weight.sum().clamp(min=1.0)
    l1 = ((picture - target).abs().mean(-1) * weight).sum() / total
    if dissimilarity == 0:
        return l1
    similarity = (_FilteredSimilarity.apply(picture, target) * weight).sum() / total
    return (1 - dissimilarity) * l1 + dissimilarity * (1 - similarity)


def structural_similarity(a: Float[Tensor, "h w c"], b: Float[Tensor, "h w c"]) -> Float[Tensor, "h w"]:
    """SSIM (Wang et al. 2004): window of 11 px with standard deviation 1.5 px, zeros outside, mean over channels."""
    x = torch.arange(11, dtype=a.dtype) - 5
    window = torch.exp(-0.5 * (x / 1.5) ** 2)
    window = window / window.sum()
    c = a.shape[-1]
    stack = torch.cat([a, b, a * a, b * b, a * b], -1).permute(2, 0, 1)[:, None]
    stack = torch.nn.functional.conv2d(stack, window.view(1, 1, 1, 11), padding=(0, 5))
    stack = torch.nn.functional.conv2d(stack, window.view(1, 1, 11, 1), padding=(5, 0))[:, 0]
    ma, mb, aa, bb, ab = stack.split(c)
    luminance = (2 * ma * mb + 1e-4) / (ma * ma + mb * mb + 1e-4)
    structure = (2 * (ab - ma * mb) + 9e-4) / (aa - ma * ma + bb - mb * mb + 9e-4)
    return (luminance * structure).mean(0)


class _FilteredSimilarity(torch.autograd.Function):
    """`structural_similarity` with its gradient in the first picture, by OpenCV's separable filter (20 times as fast).

    The window is symmetric and zeros lie outside, so that the filter is its own adjoint.
    """

    @staticmethod
    def forward(ctx: Any, a: Tensor, b: Tensor) -> Tensor:
        x, y = a.detach().numpy(), b.detach().numpy()
        mx, my = _smooth(x), _smooth(y)
        xx, yy, xy = _smooth(x * x), _smooth(y * y), _smooth(x * y)
        a1, a2 = 2 * mx * my + 1e-4, 2 * (xy - mx * my) + 9e-4
        b1, b2 = mx * mx + my * my + 1e-4, xx - mx * mx + yy - my * my + 9e-4
        s = a1 * a2 / (b1 * b2)
        g_mean = 2 * my * (a2 - a1) / (b1 * b2) - 2 * mx * s * (1 / b1 - 1 / b2)
        ctx.saved = x, y, g_mean, -s / b2, 2 * a1 / (b1 * b2)
        return torch.from_numpy(s.mean(-1))

    @staticmethod
    def backward(ctx: Any, g: Tensor) -> Any:
        x, y, g_mean, g_xx, g_xy = ctx.saved
        w = g.numpy()[..., None] / x.shape[-1]
        return torch.from_numpy(_smooth(w * g_mean) + 2 * x * _smooth(w * g_xx) + y * _smooth(w * g_xy)), None


def _smooth(picture: np.ndarray) -> np.ndarray:
    window = np.exp(-0.5 * ((np.arange(11) - 5) / 1.5) ** 2)
    window = (window / window.sum()).astype(np.float32)
    return cv2.sepFilter2D(picture, -1, window, window, borderType=cv2.BORDER_CONSTANT).reshape(picture.shape)


def anisotropy_loss(scales: Float[Tensor, "n 3"], stretch: float = 1.1) -> Tensor:
    """mean max(S1/S2 - stretch, 0) with S1 >= S2 >= S3: needles are drawn in, flat discs are free."""
    ordered = scales.sort(dim=1, descending=True).values
    return (ordered[:, 0] / ordered[:, 1].clamp(min=1e-12) - stretch).clamp(min=0).mean()


def volume_loss(scales: Float[Tensor, "n 3"], form: str = "hinge") -> Tensor:
    """Keeps single Gaussians from growing; scales in units of a typical one.

    The paper refers to a source that defines no such term. "mean": mean of s1 s2 s3 (as in Scaffold-GS), which shrinks
    all. "hinge": mean of max(V / median(V) - 2, 0) with V = s1 s2 s3, which only holds the large ones and leaves
    the size of the body alone. The median carries no gradient.
    """
    volume = scales.prod(1)
    if form == "mean":
        return volume.mean()
    return (volume / volume.detach().median().clamp(min=1e-20) - 2.0).clamp(min=0, max=1e3).mean()


def scale_loss(scales: Float[Tensor, "n 3"]) -> Tensor:
    """Mean of the geometric means of the three scales: asks for finer Gaussians."""
    return scales.clamp(min=1e-12).log().mean(1).exp().mean()


def depth_loss(
    drawn: Float[Tensor, "h w"], light: Float[Tensor, "h w"], before: Float[Tensor, "h w"], unit: float
) -> Tensor:
    """Mean distance between the expected depth and that before the refinement, in units of a typical scale.

    The paper leaves depth to the other terms. The motion of the surface is lifted by this depth, so it is held here.

    Args:
        drawn: depth composited front to back, m.
        light: transmittance left.
        before: camera z, m; NaN where free.
        unit: m.
    """
    known = torch.isfinite(before)
    off = (drawn - (1 - light) * torch.where(known, before, torch.zeros_like(before))).abs()
    return torch.where(known, off, torch.zeros_like(off)).sum() / (known.sum().clamp(min=1) * unit)


def luminance_loss(sh: Float[Tensor, "n 3"]) -> Tensor:
    """Penalises colours outside [0, 1] in the constant harmonics: mean of the squared overshoot."""
    rgb = 0.5 + SH_C0 * sh
    return ((rgb - 1).clamp(min=0) ** 2 + (-rgb).clamp(min=0) ** 2).mean()
