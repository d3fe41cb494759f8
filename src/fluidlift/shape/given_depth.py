"""Depth that comes from elsewhere, a file or a learned model: one picture of several frames, made comparable.

What such pictures hold differs: metres, depth up to a factor, or disparity (inverse depth up to a factor and an
offset). Between frames factor and offset flicker, edges are smeared, and slow errors bend what is flat. This module
takes out what can be taken out without knowing the fluid; `depth_surface` makes the fluid's surface of the rest.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from fluidlift.errors import InputRejected, require
from fluidlift.shape.heights import FARTHEST

Holds = Literal["metres", "relative", "disparity"]
"""what a depth picture holds: metres; depth up to a factor; inverse depth up to a factor and an offset"""

FEWEST = 64
"""px that two pictures must share, and the fluid must have, to be compared"""
EMPTY = 0.5
"""share of the fluid without depth from which the picture says nothing about it"""
INVERTED = -0.5
"""rank correlation with the depth that is expected, below which near and far are taken to be exchanged"""
JUMP = 0.04
"""relative change of depth from pixel to pixel, beyond what a plane shows, that is an edge"""


@dataclass(frozen=True)
class DepthPictures:
    """Depth of some frames as a file or a model gave it."""

    values: Float[np.ndarray, "n h w"]
    """nan where it says nothing"""
    frames: tuple[int, ...]
    """of the clip, one for each"""
    holds: Holds
    source: str
    """for messages: `depth file` or the name of the model"""
    floor: float = 0.003
    """relative error that slow changes over the picture have at least"""
    field_of_view: float | None = None
    """degrees across the longer side, where a model says it"""
    normals: Float[np.ndarray, "n h w 3"] | None = None
    """unit normals of the surfaces in camera axes, where a model gives them; nan elsewhere"""

    def __post_init__(self) -> None:
        require(self.values.ndim == 3, f"depth of shape {self.values.shape}", "[n,H,W]")
        require(len(self.values) == len(self.frames) > 0, f"{len(self.frames)} frame numbers", "one for each picture")


@dataclass(frozen=True)
class FusedDepth:
    """The median over frames."""

    values: Float[np.ndarray, "h w"]
    """what the pictures hold; nan where they say nothing"""
    holds: Holds
    frames: int
    """that it was made of"""
    flicker: float
    """standard deviation of the factor between frames, relative"""
    source: str
    floor: float


@dataclass(frozen=True)
class SceneDepth:
    """Camera depth of the whole picture."""

    depth: Float[np.ndarray, "h w"]
    """median 1 on the fluid; nan where nothing is known, and at smeared edges"""
    unit: float | None
    """m per unit, where the pictures hold metres"""
    source: str
    floor: float
    """relative error that slow changes over the picture have at least"""
    frames: int = 1
    flicker: float = 0.0


def fuse(pictures: DepthPictures, fluid: Bool[np.ndarray, "n h w"], area: Bool[np.ndarray, "h w"]) -> FusedDepth:
    """The median over frames, after factor (and offset, of disparity) were made those of one frame.

    Factor and offset come from what all frames show: the solids if there are enough, for the fluid moves. Of a pixel of
    `area` those frames count in which it is fluid, of other pixels those in which it is not.

    Args:
        pictures: of some frames.
        fluid: mask of each of them.
        area: the fluid that the surface is wanted of.

    Raises:
        InputRejected: no numbers, or a picture whose numbers are all alike.
    """
    values = np.asarray(pictures.values, np.float32)
    values = np.where(np.isfinite(values) & ((values > 0) | (pictures.holds == "disparity")), values, np.nan)
    known = np.isfinite(values)
    if known.reshape(len(known), -1).sum(axis=1).min() < FEWEST:
        raise InputRejected(f"a {pictures.source} that is empty", "positive numbers", "look at it, or leave it out")
    spread = [np.ptp(np.percentile(v[k], [2, 98])) / max(abs(float(np.median(v[k]))), 1e-12)
              for v, k in zip(values, known)]  # fmt: skip
    if max(spread) < 1e-4:
        raise InputRejected(
            f"a {pictures.source} that is the same everywhere", "depth that differs from pixel to pixel",
            "look at it, or leave it out",
        )  # fmt: skip
    inverse = values if pictures.holds == "disparity" else 1.0 / values
    first = int(np.argmax(known.reshape(len(known), -1).sum(axis=1)))
    factors, aligned = [], np.empty_like(inverse)
    for t, picture in enumerate(inverse):
        both = known[t] & known[first]
        still = both & ~fluid[t] & ~fluid[first]
        use = still if still.sum() >= max(FEWEST, 0.05 * still.size) else both
        factor, offset = (1.0, 0.0) if t == first or use.sum() < FEWEST else _matched(
            picture[use], inverse[first][use], with_offset=pictures.holds == "disparity"
        )  # fmt: skip
        aligned[t] = factor * picture + offset
        factors.append(factor)
    chosen = np.where(fluid == area, aligned, np.nan)
    with np.errstate(all="ignore"):
        some = np.isfinite(chosen).any(axis=0)
        median = np.nanmedian(np.where(some, chosen, aligned), axis=0) if len(aligned) > 1 else aligned[0]
    if pictures.holds != "disparity":
        median = 1.0 / median
    flicker = float(np.std(np.log(factors))) if len(factors) > 1 else 0.0
    return FusedDepth(median.astype(np.float32), pictures.holds, len(values), flicker, pictures.source, pictures.floor)


def _matched(values: np.ndarray, wanted: np.ndarray, *, with_offset: bool) -> tuple[float, float]:
    """Factor and offset that bring values to those wanted: of a line through medians, then Tukey's biweight."""
    if not with_offset:
        ratio = wanted[values > 0] / values[values > 0]
        return float(np.median(ratio)), 0.0
    line = robust_line(values, wanted)
    return (float(line[1]), float(line[0])) if line[1] > 0 else (1.0, float(np.median(wanted - values)))


def robust_line(x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"]) -> Float[np.ndarray, "2"]:
    """(a, b) of y = a + b x by iterated least squares with Tukey's biweight, started from quantiles (Brown, Mood)."""
    low, high = x <= np.quantile(x, 1 / 3), x >= np.quantile(x, 2 / 3)
    run = np.median(x[high]) - np.median(x[low])
    slope = (np.median(y[high]) - np.median(y[low])) / run if abs(run) > 1e-12 else 0.0
    line = np.array([np.median(y - slope * x), slope])
    return _reweighted(np.stack([np.ones_like(x), x], axis=1), y, line, 8)


def robust_plane(
    x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"] | None, values: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " k"]:
    """(a, b, c) of values = a + b x + c y (a and b alone without y), by Tukey's biweight from least squares."""
    columns = np.stack([np.ones_like(x), x] + ([] if y is None else [y]), axis=1)
    pick = np.linspace(0, len(x) - 1, min(len(x), 20000)).astype(int)
    columns, values = columns[pick], values[pick]
    start, *_ = np.linalg.lstsq(columns, values, rcond=None)
    return _reweighted(columns, values, start, 12)


def _reweighted(columns: np.ndarray, y: np.ndarray, start: np.ndarray, steps: int) -> np.ndarray:
    """Coefficients of a linear model under Tukey's biweight."""
    line = start
    for _ in range(steps):
        rest = y - columns @ line
        scale = 4.685 * max(1.4826 * float(np.median(np.abs(rest))), 1e-9 * float(np.abs(y).max()) + 1e-30)
        weight = np.square(1.0 - np.clip(rest / scale, -1.0, 1.0) ** 2)
        weighted = columns * weight[:, None]
        line, *_ = np.linalg.lstsq(weighted.T @ columns, weighted.T @ y, rcond=None)
    return line


def scene_depth(fused: FusedDepth, expected: Float[np.ndarray, "h w"], area: Bool[np.ndarray, "h w"]) -> SceneDepth:
    """Camera depth of the whole picture, in units of the fluid's median.

    Disparity lacks an offset, which tilts planes: it is taken from the surface that is expected without the picture
    (level water under the camera's tilt), by least squares on the fluid, within what is possible: nothing lies beyond
    infinity, and a fluid is at most `FARTHEST` times as far as it is near.

    Args:
        fused: picture.
        expected: depth of the fluid's surface as it would be taken to be otherwise, any unit; 0 or nan: unknown.
        area: the fluid.

    Raises:
        InputRejected: no depth on most of the fluid, or near and far exchanged.
    """
    known = area & np.isfinite(fused.values)
    if known.sum() < EMPTY * area.sum() or known.sum() < FEWEST:
        raise InputRejected(
            f"a {fused.source} that is empty on {100 * (1 - known.sum() / max(area.sum(), 1)):.0f} % of the fluid",
            "positive camera depths on the fluid pixels", "check that it belongs to this clip",
        )  # fmt: skip
    _require_order(fused, expected, known)
    depth = fused.values.astype(np.float64)
    if fused.holds == "disparity":
        depth = 1.0 / _with_offset(depth, expected, known)
    depth = np.where(depth > 0, depth, np.nan)
    middle = float(np.nanmedian(depth[known]))
    clean = np.where(_smeared(depth), np.nan, depth / middle)
    unit = middle if fused.holds == "metres" else None
    return SceneDepth(clean.astype(np.float32), unit, fused.source, fused.floor, fused.frames, fused.flicker)


def _require_order(fused: FusedDepth, expected: np.ndarray, known: np.ndarray) -> None:
    """Refuse pictures in which near and far are exchanged, as far as a plain surface tells them apart."""
    compared = known & np.isfinite(expected) & (expected > 0)
    if compared.sum() < FEWEST:
        return
    should, have = expected[compared], fused.values[compared]
    if np.ptp(np.percentile(should, [5, 95])) < 0.05 * np.median(should):
        return  # facing the camera: it could be either
    have = 1.0 / have if fused.holds == "disparity" else have
    ranks = [np.argsort(np.argsort(v)).astype(float) for v in (should, have)]
    agreement = float(np.corrcoef(ranks[0], ranks[1])[0, 1])
    if agreement > INVERTED:
        return
    if fused.holds == "disparity":
        raise InputRejected(
            f"a {fused.source} in which the far end of the fluid has the larger numbers", "disparity, larger when near",
            "--set depth.holds=relative if it is depth, or depth.holds=metres",
        )  # fmt: skip
    raise InputRejected(
        f"a {fused.source} in which the far end of the fluid has the smaller numbers: it looks like disparity "
        "(inverse depth)", "depth, larger when far", "--set depth.holds=disparity, or invert it",
    )  # fmt: skip


def _with_offset(disparity: np.ndarray, expected: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Inverse depth of a disparity, in units in which it is about that of the expected surface."""
    compared = known & np.isfinite(expected) & (expected > 0)
    low, near = np.percentile(disparity[known], [1, 99])
    everywhere = disparity[np.isfinite(disparity)]
    # nothing is beyond infinity; on the fluid the ratio of far to near is bounded
    most = -min(float(np.percentile(everywhere, 0.5)), float((FARTHEST * low - near) / (FARTHEST - 1.0)))
    offset = most
    if compared.sum() >= FEWEST:
        wanted = 1.0 / expected[compared]
        line = robust_line(disparity[compared].astype(float), wanted.astype(float))
        if line[1] > 0:
            offset = max(line[0] / line[1], most)
        spread = np.ptp(np.percentile(wanted, [5, 95])) / np.median(wanted)
        if line[1] <= 0 or spread < 0.05:  # nothing to go by: as if it ended at infinity
            offset = most
    return np.maximum(disparity + offset, 1e-3 * (near + offset))


def _smeared(depth: np.ndarray) -> np.ndarray:
    """Pixels between two surfaces: models and filters draw edges over some pixels, where nothing is in truth."""
    log = np.log(np.where(np.isfinite(depth) & (depth > 0), depth, np.nanmax(depth)))
    log = cv2.medianBlur(log.astype(np.float32), 5)
    gx, gy = np.gradient(log)
    steep = np.hypot(gx, gy)
    usual = ndimage.uniform_filter(steep, max(21, depth.shape[1] // 5))
    return steep > np.maximum(JUMP, 2.5 * usual)


def without_rim(known: Bool[np.ndarray, "h w"], share: float = 0.012) -> Bool[np.ndarray, "h w"]:
    """A mask without its rim of `share` of the picture's longer side, where depth is mixed with what is beside it; what
    is slender is kept. The picture's border is no rim."""
    reach = max(1, round(share * max(known.shape)))
    padded = np.pad(known, reach + 1, mode="edge")
    inner = np.asarray(ndimage.distance_transform_edt(padded))[reach + 1 : -reach - 1, reach + 1 : -reach - 1]
    inner = inner > reach
    return inner if inner.sum() >= max(FEWEST, 0.3 * known.sum()) else known
