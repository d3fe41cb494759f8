"""Gaussian splatting on the CPU: projection, binning, front-to-back compositing and the exact derivatives of all.

Sources: Zwicker et al. 2001 (EWA splatting), Kerbl et al. 2023 (3D Gaussian Splatting). The constants are those of
gsplat, so that pictures agree: 0.3 px^2 is added to the diagonal of every 2D covariance, alpha is clamped to 0.999 and
cut below 1/255, a pixel is finished when less than 1e-4 of the light would pass, and pixel (row i, column j)
has its centre at u = j + 0.5, v = i + 0.5. Beyond sqrt(2 ln(255 o)) standard deviations a Gaussian of opacity o lies
under the cut, so that the boxes used for binning lose nothing.

Arrays only: float32, C-contiguous, n Gaussians, c feature channels, h x w pixels. The torch functions on top of this
module are in `splatting_torch`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from fluidlift.errors import require
from fluidlift.numerics.splatting_kernels import (
    TILE,
    bin_kernel,
    gather_kernel,
    project_backward_kernel,
    project_kernel,
    raster_backward_kernel,
    raster_kernel,
)
from fluidlift.types.camera import PinholeCamera

PAIRS_MAX = 60_000_000
"""largest number of (tile, Gaussian) pairs held at once: about 0.5 GB"""


@dataclass(frozen=True)
class View:
    """A pinhole camera as plain numbers: x_cam = rotation @ x + translation, u = fx x/z + cx."""

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    focal: tuple[float, float]
    """px"""
    center: tuple[float, float]
    """px"""
    size: tuple[int, int]
    """width, height in px"""
    near: float = 1e-3
    """Gaussians whose centre is nearer than this (camera z, m) are not drawn"""

    @classmethod
    def of(cls, camera: PinholeCamera, near: float = 1e-3) -> View:
        """The numbers of a camera."""
        pose = camera.camera_from_world
        return cls(pose.rotation, pose.translation, camera.focal, camera.center, camera.size, near)

    def flat(self) -> Float[np.ndarray, "19"]:
        """One array for the kernels."""
        numbers = [*np.ravel(self.rotation), *self.translation, *self.focal, *self.center, *self.size, self.near]
        return np.asarray(numbers, np.float32)


@dataclass(frozen=True)
class Projected:
    """Gaussians in the picture. `extents` is 0 for those that are not drawn."""

    means: Float[np.ndarray, "n 2"]
    """centres u, v in px"""
    conics: Float[np.ndarray, "n 3"]
    """a, b, c of the inverse covariance [[a, b], [b, c]], 1/px^2"""
    depths: Float[np.ndarray, "n"]
    """camera z, m"""
    extents: Float[np.ndarray, "n 2"]
    """half width and height of the box outside which alpha < 1/255, px"""


@dataclass(frozen=True)
class Bins:
    """Which Gaussians meet which tile, front to back."""

    starts: Int[np.ndarray, "tiles+1"]
    gaussians: Int[np.ndarray, "pairs"]
    """index of the Gaussian of every pair, tile by tile"""
    slots: Int[np.ndarray, "pairs"]
    """place in `gaussians` of the pairs of Gaussian `order[k]`: slots[offsets[k]:offsets[k + 1]]"""
    offsets: Int[np.ndarray, "m+1"]
    order: Int[np.ndarray, "m"]
    """drawn Gaussians, nearest first"""


def project(
    view: View,
    means: Float[np.ndarray, "n 3"],
    quats: Float[np.ndarray, "n 4"],
    scales: Float[np.ndarray, "n 3"],
    opacities: Float[np.ndarray, "n"],
) -> Projected:
    """Gaussians (m) to ellipses in the picture (px), by the local affine approximation of the pinhole map (EWA).

    Those behind the near plane, outside the picture, under the alpha cut or with any non-finite number are not drawn.
    """
    n = len(means)
    uv, conics = np.empty((n, 2), np.float32), np.empty((n, 3), np.float32)
    depths, extents = np.empty(n, np.float32), np.empty((n, 2), np.float32)
    project_kernel(view.flat(), means, quats, scales, opacities, uv, conics, depths, extents)
    return Projected(uv, conics, depths, extents)


def project_backward(
    view: View,
    means: Float[np.ndarray, "n 3"],
    quats: Float[np.ndarray, "n 4"],
    scales: Float[np.ndarray, "n 3"],
    projected: Projected,
    g_uv: Float[np.ndarray, "n 2"],
    g_conics: Float[np.ndarray, "n 3"],
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 4"], Float[np.ndarray, "n 3"]]:
    """Gradients of means, quats and scales from those of the picture's means and conics."""
    gradients = np.zeros_like(means), np.zeros_like(quats), np.zeros_like(scales)
    p = projected
    project_backward_kernel(view.flat(), means, quats, scales, p.conics, p.extents, g_uv, g_conics, *gradients)
    return gradients


def bin_tiles(projected: Projected, size: tuple[int, int]) -> Bins:
    """Deal the drawn Gaussians to the tiles of a picture of `size` (width, height), nearest first; ties by index.

    Raises:
        ValueError: more than `PAIRS_MAX` pairs (many Gaussians as large as the picture).
    """
    tiles_x, tiles_y = (-(-s // TILE) for s in size)
    drawn = np.flatnonzero(projected.extents[:, 0] > 0)
    # the bits of positive floats sort like the floats; the index below them breaks ties
    keys = (projected.depths[drawn].view(np.int32).astype(np.int64) << 32) | drawn
    keys.sort()
    order = (keys & 0xFFFFFFFF).astype(np.int32)
    counts = np.zeros(tiles_x * tiles_y, np.int64)
    offsets = np.empty(len(order) + 1, np.int64)
    none = np.empty(0, np.int32)
    uv, extents = projected.means, projected.extents
    total = bin_kernel(uv, extents, order, tiles_x, tiles_y, counts, offsets, none, none, False)
    require(
        total <= PAIRS_MAX,
        f"{total} pairs of tile and Gaussian",
        f"at most {PAIRS_MAX}",
        "prune or shrink Gaussians that are as large as the picture",
    )
    starts = np.concatenate([[0], np.cumsum(counts)])
    gaussians, slots = np.empty(total, np.int32), np.empty(total, np.int32)
    bin_kernel(uv, extents, order, tiles_x, tiles_y, starts[:-1].copy(), offsets, gaussians, slots, True)
    return Bins(starts, gaussians, slots, offsets, order)


def _stride(tiles: int) -> int:
    """A step near the golden section that visits every tile once."""
    step = max(1, round(0.618 * tiles))
    while math.gcd(step, tiles) != 1:
        step += 1
    return step


def rasterize(
    projected: Projected,
    opacities: Float[np.ndarray, "n"],
    features: Float[np.ndarray, "n c"],
    bins: Bins,
    size: tuple[int, int],
) -> tuple[Float[np.ndarray, "h w c"], Float[np.ndarray, "h w"]]:
    """Composite front to back: sum of weight x feature (black behind), and the transmittance that is left."""
    width, height = size
    image = np.empty((height, width, features.shape[1]), np.float32)
    light = np.empty((height, width), np.float32)
    p = projected
    stride = _stride(len(bins.starts) - 1)
    raster_kernel(
        p.means, p.conics, opacities, features, p.extents, bins.starts, bins.gaussians, width, height, stride,
        image, light,
    )  # fmt: skip
    return image, light


def rasterize_backward(
    projected: Projected,
    opacities: Float[np.ndarray, "n"],
    features: Float[np.ndarray, "n c"],
    bins: Bins,
    image: Float[np.ndarray, "h w c"],
    light: Float[np.ndarray, "h w"],
    g_image: Float[np.ndarray, "h w c"],
    g_light: Float[np.ndarray, "h w"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Gradients of means [n,2], conics [n,3], opacities [n] and features [n,c] from those of picture and light."""
    p = projected
    n, channels = features.shape
    records = np.zeros((len(bins.gaussians), 6 + channels), np.float32)
    stride = _stride(len(bins.starts) - 1)
    raster_backward_kernel(
        p.means, p.conics, opacities, features, p.extents, bins.starts, bins.gaussians, stride,
        image, light, g_image, g_light, records,
    )  # fmt: skip
    gradients = (np.zeros((n, 2), np.float32), np.zeros((n, 3), np.float32), np.zeros(n, np.float32),
                 np.zeros((n, channels), np.float32))  # fmt: skip
    gather_kernel(p.conics, opacities, bins.order, bins.offsets, bins.slots, records, *gradients)
    return gradients
