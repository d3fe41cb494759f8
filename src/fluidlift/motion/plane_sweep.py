"""Depth of what stands before a moving camera: plane sweep (Collins 1996) from one frame over the others.

Each pixel of the reference frame is laid on the other frames at a number of depths; where it stands, all frames agree
at its depth, and where they agree at none, it flows. Where nothing but one colour is seen they agree at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from fluidlift.types import CameraPath

WORKING_SIZE = 256
"""px, longer side of the pictures compared"""
DEPTHS = 48
"""hypotheses, even in inverse depth, as their places in the picture then are"""
OTHERS = 12
"""frames compared with the reference, at most"""
WINDOW = 5
"""px over which the comparison is averaged"""
FAR_WRONG = 40.0
"""grey levels above which a difference counts no more: what is hidden in one frame may look like anything"""
READING, TREMBLE = 2.0, 0.25
"""grey levels, and px: difference that a still thing shows, in flat places and by the gradient of the picture"""

QUIET = 0.2
"""part of the picture that stands, at least"""


@dataclass(frozen=True)
class Swept:
    """Of the reference picture, at working size [h,w]."""

    inverse_depth: Float[np.ndarray, "h w"]
    """1 over camera z, in units of the path, where the frames agree most"""
    unlike: Float[np.ndarray, "h w"]
    """difference of the frames there, in units of what a still thing shows"""
    sure: Float[np.ndarray, "h w"]
    """how much larger the difference is at other depths, in the same units: 0 where any depth would do"""
    scale: float
    """px of working size per px of the clip"""

    def rays(self, focal: float) -> Float[np.ndarray, "h w 3"]:
        """Of unit depth, through each pixel; focal length of the clip, px."""
        height, width = self.unlike.shape
        x, y = np.meshgrid(np.arange(width) + 0.5 - 0.5 * width, np.arange(height) + 0.5 - 0.5 * height)
        return np.stack([x, y, np.full(x.shape, focal * self.scale)], axis=-1) / (focal * self.scale)


def sweep(grey: Sequence[np.ndarray], path: CameraPath, reference: int) -> Swept:
    """Sweep a reference frame.

    Args:
        grey: u8 [H,W] pictures of the clip.
        path: of its camera, in the axes of the reference frame.
        reference: its number.
    """
    height, width = grey[reference].shape
    scale = min(1.0, WORKING_SIZE / max(height, width))
    size = (round(width * scale), round(height * scale))
    focal, middle = path.focal * scale, 0.5 * np.array(size, float)
    still = _small(grey[reference], size)
    gradient = np.hypot(*(cv2.Sobel(still, cv2.CV_32F, dx, dy, scale=0.125) for dx, dy in ((1, 0), (0, 1))))
    expected = READING + TREMBLE * cv2.blur(gradient, (WINDOW, WINDOW))
    x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    rays = np.stack([(x - middle[0]) / focal, (y - middle[1]) / focal, np.ones_like(x)], axis=-1)
    depth = path.points[:, 2]
    near = 1.3 / np.percentile(depth[depth > 0], 2)
    hypotheses = np.linspace(0.0, near, DEPTHS)
    others = [t for t in _spread(len(path.rotations)) if t != reference]
    pictures = [_small(grey[t], size) for t in others]
    costs = np.empty((DEPTHS, size[1], size[0]), np.float32)
    turned = [rays @ path.rotations[t].T for t in others]
    for k, inverse in enumerate(hypotheses):
        total, seen = np.zeros(still.shape, np.float32), np.zeros(still.shape, np.float32)
        for t, picture, far in zip(others, pictures, turned):
            at = far + inverse * path.translations[t]
            z = np.maximum(at[..., 2], 1e-6)
            u, v = focal * at[..., 0] / z + middle[0] - 0.5, focal * at[..., 1] / z + middle[1] - 0.5
            there = cv2.remap(picture, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR)
            inside = ((u >= 0) & (v >= 0) & (u <= size[0] - 1) & (v <= size[1] - 1)).astype(np.float32)
            total += inside * np.minimum(np.abs(there - still), FAR_WRONG)
            seen += inside
        window = (WINDOW, WINDOW)
        costs[k] = cv2.blur(total, window) / np.maximum(cv2.blur(seen, window), 0.2)
    best = costs.argmin(axis=0)
    least = np.take_along_axis(costs, best[None], 0)[0]
    # a clip with more noise, or strongly compressed, has it in its quiet part as well
    expected *= max(1.0, float(np.quantile(least / expected, QUIET)))
    return Swept(_between(costs, best, hypotheses), least / expected, (costs.mean(axis=0) - least) / expected, scale)


def _between(costs: np.ndarray, best: np.ndarray, hypotheses: np.ndarray) -> np.ndarray:
    """Inverse depth at the vertex of the parabola through the best hypothesis and its neighbours."""
    k = np.clip(best, 1, len(hypotheses) - 2)
    low, mid, high = (np.take_along_axis(costs, (k + d)[None], 0)[0] for d in (-1, 0, 1))
    bend = np.maximum(low - 2.0 * mid + high, 1e-6)
    shift = np.where(best == k, np.clip(0.5 * (low - high) / bend, -0.5, 0.5), best - k)
    return hypotheses[k] + shift * (hypotheses[1] - hypotheses[0])


def _spread(count: int) -> list[int]:
    return np.unique(np.linspace(0, count - 1, min(count, OTHERS)).round().astype(int)).tolist()


def _small(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    return cv2.GaussianBlur(cv2.resize(picture, size, interpolation=cv2.INTER_AREA).astype(np.float32), (0, 0), 0.7)
