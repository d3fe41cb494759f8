"""Gaussian splatting on the CPU: projection, binning, front-to-back compositing and the exact derivatives of all.

Sources: Zwicker et al. 2001 (EWA splatting), Kerbl et al. 2023 (3D Gaussian Splatting). The constants are those of
gsplat, so that pictures agree: 0.3 px^2 is added to the diagonal of every 2D covariance, alpha is clamped to 0.999 and
cut below 1/255, a pixel is finished when less than 1e-4 of the light would pass, and pixel (row i, column j)
has its centre at u = j + 0.5, v = i + 0.5. Beyond sqrt(2 ln(255 o)) standard deviations, at most 3.33, a Gaussian of
opacity o lies under the cut, so that the ellipses used for binning lose nothing.

Arrays only: float32 (or all float64, for exact comparisons), C-contiguous, n Gaussians, c feature channels, h x w
pixels. The torch functions on top of this module are in `splatting_torch`, the compiled loops in
`splatting_projection`, `splatting_binning` and `splatting_kernels`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from fluidlift.errors import require
from fluidlift.numerics.splatting_binning import (
    LEAD,
    count_kernel,
    fill_kernel,
    met_kernel,
    pack_kernel,
    places_kernel,
    sketch_kernel,
)
from fluidlift.numerics.splatting_kernels import (
    SUMS,
    TILE,
    gather_kernel,
    raster_backward_kernel,
    raster_kernel,
)
from fluidlift.numerics.splatting_projection import project_backward_kernel, project_kernel
from fluidlift.types.camera import PinholeCamera

PAIRS_MAX = 16_000_000
"""largest number of (tile, Gaussian) pairs held at once, about 0.8 GB with their gradients; a picture that needs more
is drawn in bands of tiles"""


@dataclass(frozen=True)
class SplatCamera:
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
    def of(cls, camera: PinholeCamera, near: float = 1e-3) -> SplatCamera:
        """The numbers of a camera."""
        pose = camera.camera_from_world
        return cls(pose.rotation, pose.translation, camera.focal, camera.center, camera.size, near)

    def flat(self) -> Float[np.ndarray, "19"]:
        """One array (float64) for the kernels."""
        numbers = [*np.ravel(self.rotation), *self.translation, *self.focal, *self.center, *self.size, self.near]
        return np.asarray(numbers, np.float64)


@dataclass(frozen=True)
class Projected:
    """Gaussians in the picture. `extents` is 0 for those that are not drawn."""

    means: Float[np.ndarray, "n 2"]
    """centres u, v in px"""
    conics: Float[np.ndarray, "n 3"]
    """a, b, c of the inverse covariance [[a, b], [b, c]], 1/px^2"""
    depths: Float[np.ndarray, " n"]
    """camera z, m"""
    extents: Float[np.ndarray, "n 2"]
    """half width and height of the box outside which alpha < 1/255, px"""


@dataclass(frozen=True)
class Pairs:
    """The lists of the tiles of one band, one after the other."""

    first: int
    last: int
    """tiles first <= t < last"""
    gaussians: Int[np.ndarray, " pairs"]
    """place in `Bins.order` of the Gaussian of every pair, tile by tile, nearest first"""
    slots: Int[np.ndarray, " slots"]
    """where in `gaussians` the pairs of the k-th drawn Gaussian are: slots[offsets[k]:offsets[k + 1]]; empty if nobody
    asked for them"""
    offsets: Int[np.ndarray, " m+1"]


@dataclass(frozen=True)
class Bins:
    """Which Gaussians meet which tile, front to back."""

    tile: int
    """px"""
    tiles: tuple[int, int]
    """across, down"""
    starts: Int[np.ndarray, " tiles+1"]
    """where each tile's list begins, tiles row by row"""
    order: Int[np.ndarray, " m"]
    """drawn Gaussians, nearest first"""
    sketch: Float[np.ndarray, "m 8"]
    """their ellipses, as `sketch_kernel` writes them"""
    bands: tuple[tuple[int, int], ...]
    """tiles first <= t < last that are held in memory together"""
    whole: Pairs | None = None
    """the lists, if there is but one band"""

    @property
    def pairs(self) -> int:
        """How many there are."""
        return int(self.starts[-1])


def project(
    view: SplatCamera,
    means: Float[np.ndarray, "n 3"],
    quats: Float[np.ndarray, "n 4"],
    scales: Float[np.ndarray, "n 3"],
    opacities: Float[np.ndarray, " n"],
) -> Projected:
    """Gaussians (m) to ellipses in the picture (px), by the local affine approximation of the pinhole map (EWA).

    Those behind the near plane, outside the picture, under the alpha cut or with any non-finite number are not drawn.
    """
    n, dtype = len(means), means.dtype
    uv, conics = np.empty((n, 2), dtype), np.empty((n, 3), dtype)
    depths, extents = np.empty(n, dtype), np.empty((n, 2), dtype)
    project_kernel(view.flat(), means, quats, scales, opacities, uv, conics, depths, extents)
    return Projected(uv, conics, depths, extents)


def project_backward(
    view: SplatCamera,
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


def bin_tiles(projected: Projected, size: tuple[int, int], tile: int = TILE, *, slots: bool = True) -> Bins:
    """Deal the drawn Gaussians to the tiles of a picture of `size` (width, height), nearest first; ties by index.

    Without `slots`, which only gradients need, the lists are good for `rasterize` alone.

    Raises:
        ValueError: a tile of less than a pixel.
    """
    require(tile >= 1, f"tiles of {tile} px", "1 px or more")
    order = _order(projected)
    sketch = np.empty((len(order), 8), np.float32)
    sketch_kernel(projected.means, projected.conics, projected.extents, order, sketch)
    tiles_x, tiles_y = (-(-s // tile) for s in size)
    counts, pairs = _count(sketch, tile, (tiles_x, tiles_y), (0, tiles_x * tiles_y))
    starts = np.concatenate([[0], np.cumsum(counts[:, :-1].sum(0, dtype=np.int64))])
    bins = Bins(tile, (tiles_x, tiles_y), starts, order, sketch, _bands(starts))
    return replace(bins, whole=_dealt(bins, bins.bands[0], counts, pairs, slots)) if len(bins.bands) == 1 else bins


def tiles_met(projected: Projected, size: tuple[int, int]) -> float:
    """About how many pairs of tile and Gaussian a picture has (an upper bound, nearly)."""
    return float(met_kernel(projected.extents, TILE, *size))


def _order(projected: Projected) -> Int[np.ndarray, " m"]:
    drawn = np.flatnonzero(projected.extents[:, 0] > 0)
    depths = projected.depths[drawn]
    if depths.dtype != np.float32:
        return drawn[np.argsort(depths, kind="stable")].astype(np.int32)
    # the bits of positive floats sort like the floats; the index below them breaks ties
    keys = (depths.view(np.int32).astype(np.int64) << 32) | drawn
    keys.sort()
    return (keys & 0xFFFFFFFF).astype(np.int32)


def _count(
    sketch: np.ndarray, tile: int, tiles: tuple[int, int], band: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Gaussians per chunk and tile, and tiles per Gaussian, of a band of tiles."""
    chunks = min(64, len(sketch) // 2048 + 1)  # by the number of Gaussians alone: the same for any number of threads
    counts, pairs = np.zeros((chunks, tiles[0] * tiles[1] + 1), np.int32), np.empty(len(sketch), np.int32)
    count_kernel(sketch, tile, *tiles, *band, counts, pairs)
    return counts, pairs


def _bands(starts: Int[np.ndarray, " tiles+1"]) -> tuple[tuple[int, int], ...]:
    """Runs of tiles of at most `PAIRS_MAX` pairs (a single tile may have more)."""
    bands, first = [], 0
    while first < len(starts) - 1:
        last = int(np.searchsorted(starts, starts[first] + PAIRS_MAX, side="right")) - 1
        last = min(max(last, first + 1), len(starts) - 1)
        bands.append((first, last))
        first = last
    return tuple(bands)


def _dealt(bins: Bins, band: tuple[int, int], counts: np.ndarray, pairs: np.ndarray, slots: bool) -> Pairs:
    """The lists of one band, of which `counts` and `pairs` were counted."""
    first, last = band
    low, high = bins.starts[first], bins.starts[last]
    places_kernel(counts, np.clip(bins.starts[:-1], low, high) - low)
    offsets = np.concatenate([[0], np.cumsum(pairs, dtype=np.int64)])
    gaussians, places = np.empty(high - low, np.int32), np.empty(high - low if slots else 0, np.int32)
    fill_kernel(bins.sketch, bins.tile, *bins.tiles, first, last, counts, offsets, gaussians, places)
    return Pairs(first, last, gaussians, places, offsets)


def _each_band(bins: Bins, *, slots: bool) -> Iterator[Pairs]:
    if bins.whole is not None:
        yield bins.whole
        return
    for band in bins.bands:
        yield _dealt(bins, band, *_count(bins.sketch, bins.tile, bins.tiles, band), slots)


def _packed(
    projected: Projected, opacities: np.ndarray, features: np.ndarray, bins: Bins, drawn_only: bool = False
) -> np.ndarray:
    """What the loops over pixels read, in order of depth; never fewer than four channels (those added are 0)."""
    p = projected
    packed = np.empty((len(bins.order), LEAD + max(features.shape[1], 4)), p.means.dtype)
    pack_kernel(p.means, p.conics, opacities, p.extents, features, bins.order, drawn_only, packed)
    return packed


def _stride(tiles: int) -> int:
    """A step near the golden section that visits every tile once."""
    step = max(1, round(0.618 * tiles))
    while math.gcd(step, tiles) != 1:
        step += 1
    return step


def rasterize(
    projected: Projected,
    opacities: Float[np.ndarray, " n"],
    features: Float[np.ndarray, "n c"],
    bins: Bins,
    size: tuple[int, int],
) -> tuple[Float[np.ndarray, "h w c"], Float[np.ndarray, "h w"]]:
    """Composite front to back: sum of weight x feature (black behind), and the transmittance that is left."""
    packed = _packed(projected, opacities, features, bins)
    image, _, light = _composited(packed, bins, size, features.shape[1], 0)
    return image, light


def rasterize_drawn(
    projected: Projected,
    opacities: Float[np.ndarray, " n"],
    features: Float[np.ndarray, "m c"],
    bins: Bins,
    size: tuple[int, int],
) -> tuple[Float[np.ndarray, "h w c-1"], Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """As `rasterize`, for features of the drawn Gaussians alone, in the order of `bins.order`, and with the last
    channel in an array of its own, before the transmittance."""
    packed = _packed(projected, opacities, features, bins, drawn_only=True)
    return _composited(packed, bins, size, features.shape[1] - 1, 1)


def _composited(
    packed: np.ndarray, bins: Bins, size: tuple[int, int], channels: int, apart: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The first channels, the one after them (`apart` 1; 0: empty), and the transmittance."""
    width, height = size
    image, last = np.zeros((height, width, channels), packed.dtype), np.zeros((apart * height, width), packed.dtype)
    light = np.ones((height, width), packed.dtype)
    for band in _each_band(bins, slots=False):
        span = band.first, band.last, bins.tile, _stride(band.last - band.first)
        raster_kernel(packed, bins.starts, band.gaussians, *span, image, last, light)
    return image, last, light


def rasterize_backward(
    projected: Projected,
    opacities: Float[np.ndarray, " n"],
    features: Float[np.ndarray, "n c"],
    bins: Bins,
    image: Float[np.ndarray, "h w c"],
    light: Float[np.ndarray, "h w"],
    g_image: Float[np.ndarray, "h w c"],
    g_light: Float[np.ndarray, "h w"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Gradients of means [n,2], conics [n,3], opacities [n] and features [n,c] from those of picture and light."""
    packed = _packed(projected, opacities, features, bins)
    n, channels = features.shape
    gradients = (np.zeros((n, 2), packed.dtype), np.zeros((n, 3), packed.dtype), np.zeros(n, packed.dtype),
                 np.zeros((n, channels), packed.dtype))  # fmt: skip
    for band in _each_band(bins, slots=True):
        records = np.zeros((len(band.gaussians), SUMS + channels), packed.dtype)
        span = band.first, band.last, bins.tile, _stride(band.last - band.first)
        raster_backward_kernel(packed, bins.starts, band.gaussians, *span, image, light, g_image, g_light, records)
        gather_kernel(packed, bins.order, band.offsets, band.slots, records, *gradients)
    return gradients
