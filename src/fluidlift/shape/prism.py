"""Prisms that stand on level ground, and their silhouettes.

In a frame with its origin at the camera, z up, and lengths in which the camera is 1 above the ground.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float
from scipy import ndimage

from fluidlift.errors import InputRejected
from fluidlift.types import PinholeCamera

GROUND = -1.0
"""z of the ground"""
COLUMNS = 160
"""of the raster along its longer side"""
LEVELS = 24
"""horizontal sections of a prism that are looked up"""
FARTHEST = 5.0
"""ground further away than this many times the nearest wet one is not looked at: there a pixel is metres long"""
OUTSIDE = 0.1
"""share of the picture's width by which a body may reach beyond its edge"""
EDGE = 0.1
"""share of a mask, between its pixels, from which a point is in it: low, as corners of masks are rounder than those of
prisms"""
LOST, MORE = 0.05, 0.15
"""shares of the silhouette that prisms which are too tall leave uncovered: the line through both, back to none, gives
the height"""
HEIGHTS = (0.02, 2.0)
"""between which a body's height is looked for"""


@dataclass(frozen=True)
class Raster:
    """Columns over the ground."""

    low: Float[np.ndarray, "2"]
    step: float
    shape: tuple[int, int]

    def centers(self) -> Float[np.ndarray, "n m 2"]:
        """Positions of the columns."""
        axes = [self.low[a] + (np.arange(self.shape[a]) + 0.5) * self.step for a in (0, 1)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), -1)

    def at(self, values: np.ndarray, xy: Float[np.ndarray, "*n 2"]) -> np.ndarray:
        """The value of the column at each position; 0 outside."""
        with np.errstate(invalid="ignore"):
            index = np.floor((np.clip(np.nan_to_num(xy, nan=-1e9), -1e9, 1e9) - self.low) / self.step)
        inside = ((index >= 0) & (index < np.array(self.shape))).all(axis=-1)
        i, j = np.moveaxis(np.where(inside[..., None], index, 0).astype(int), -1, 0)
        return np.where(inside, values[i, j], np.zeros((), values.dtype))


def meet(rays: np.ndarray, z: float) -> tuple[np.ndarray, np.ndarray]:
    """Camera depth at which rays from the origin reach a height (inf: never), and the ground position there."""
    with np.errstate(divide="ignore", invalid="ignore"):
        t = z / rays[..., 2]
    t = np.where(np.isfinite(t) & (t > 0), t, np.inf)
    with np.errstate(invalid="ignore"):
        return t, rays[..., :2] * t[..., None]


def raster_over(camera: PinholeCamera, wet: np.ndarray) -> Raster:
    """Columns over the ground that some pixels show.

    Raises:
        InputRejected: they show none.
    """
    t, xy = meet(camera.rays(camera.pixel_grid()[wet]), GROUND)
    if not np.isfinite(t).any():
        raise InputRejected("the camera looks above the horizon at every fluid pixel",
                            "a tilt that sees the ground from above", "give --pitch with a larger value")  # fmt: skip
    xy = xy[t < FARTHEST * np.percentile(t, 1)]
    low, high = xy.min(axis=0), xy.max(axis=0)
    margin = 0.1 * (high - low)
    size = high - low + 2 * margin
    step = float(size.max()) / COLUMNS
    return Raster(low - margin, step, (int(np.ceil(size[0] / step)), int(np.ceil(size[1] / step))))


def columns_within(camera: PinholeCamera, raster: Raster, mask: np.ndarray, height: float) -> np.ndarray:
    """bool [n,m]: columns from the ground up to a height of which the picture shows nothing beside the mask."""
    h, w = mask.shape
    shown = mask.astype(np.float32)
    at, ok = raster.centers(), np.ones(raster.shape, bool)
    beyond = OUTSIDE * max(h, w)
    for z in np.linspace(0.0, height, LEVELS):
        uv, depth = camera.project(np.concatenate([at, np.full((*at.shape[:2], 1), GROUND + z)], axis=-1))
        uv = np.nan_to_num(uv, nan=-1e9, posinf=1e9, neginf=-1e9)
        near = (uv > -beyond).all(-1) & (uv < np.array([w, h]) + beyond).all(-1) & (depth > 0)
        share = ndimage.map_coordinates(shown, [uv[..., 1] - 0.5, uv[..., 0] - 0.5], order=1, mode="nearest")
        ok &= near & (share > EDGE)
    return ok


def silhouette(camera: PinholeCamera, raster: Raster, footprint: np.ndarray, height: float) -> np.ndarray:
    """bool [h,w]: pixels that see a prism."""
    rays = camera.rays(camera.pixel_grid())
    seen = np.zeros(rays.shape[:2], bool)
    for z in np.linspace(0.0, height, LEVELS):
        seen |= raster.at(footprint, meet(rays, GROUND + z)[1])
    return seen


def tallest(camera: PinholeCamera, raster: Raster, mask: np.ndarray) -> float:
    """Of the tallest prism that the silhouette allows."""
    total = max(int(mask.sum()), 1)

    def uncovered(height: float) -> float:
        seen = silhouette(camera, raster, columns_within(camera, raster, mask, height), height)
        return 1.0 - float((seen & mask).sum()) / total

    heights, least, fits = np.geomspace(*HEIGHTS, 24), 1.0, HEIGHTS[0]
    for height in heights:
        lost = uncovered(height)
        least = min(least, lost)
        if lost - least > MORE:
            fine = np.linspace(fits, height, 16)
            a, b = np.interp((LOST, MORE), np.maximum.accumulate([uncovered(x) - least for x in fine]), fine)
            return max(float(a - (b - a) * LOST / (MORE - LOST)), HEIGHTS[0])
        if lost - least < LOST:
            fits = float(height)
    return HEIGHTS[1]


def largest_piece(columns: np.ndarray) -> np.ndarray:
    """The largest piece, without holes."""
    parts, count = ndimage.label(columns)
    if count == 0:
        return columns
    sizes = ndimage.sum_labels(columns, parts, np.arange(1, count + 1))
    return ndimage.binary_fill_holes(parts == 1 + int(np.argmax(sizes)))


def convex(columns: np.ndarray) -> np.ndarray:
    """The convex hull of columns."""
    points = np.argwhere(columns)[:, ::-1].astype(np.int32)
    filled = np.zeros(columns.shape, np.uint8)
    if len(points):
        cv2.fillConvexPoly(filled, cv2.convexHull(points), 1)
    return filled.astype(bool)
