"""Prisms that stand on level ground, and their silhouettes.

In a frame with its origin at the camera, z up, and lengths in which the camera is 1 above the ground.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float
from scipy import ndimage

from fluidlift.errors import InputRejected
from fluidlift.shape.region import largest_piece
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
STRAIGHT = 1.5
"""px by which an outline may stray from the straight edges that it is made of"""
EDGE_NOISE = 2.0
"""px by which one end of an edge may lie beside the other: masks round off corners, and liquid has round edges"""
OBLIQUE = 3.0
"""standard errors from which an edge is taken to lie along the ground, or the top, and says nothing of the upright"""
TILTS = np.arange(0.0, 80.5, 0.5)
"""that are tried, degrees below the horizon"""


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
        inside = np.all((index >= 0) & (index < np.array(self.shape)), axis=-1)
        i, j = np.moveaxis(np.where(inside[..., None], index, 0).astype(int), -1, 0)
        return np.where(inside, values[i, j], np.zeros((), values.dtype))


def meet(rays: np.ndarray, z: float) -> tuple[np.ndarray, np.ndarray]:
    """Camera depth at which rays from the origin reach a height (inf: never), and the ground position there."""
    with np.errstate(divide="ignore", invalid="ignore"):
        t = z / rays[..., 2]
    t = np.where(np.isfinite(t) & (t > 0), t, np.inf)
    with np.errstate(invalid="ignore"):
        return t, rays[..., :2] * t[..., None]


def upright_tilt(
    body: np.ndarray, pose: Callable[[float], PinholeCamera], usual: tuple[float, float]
) -> tuple[float, float]:
    """The camera's tilt from the upright edges of a body: they point to what lies straight below the camera.

    Args:
        body: bool [h,w], its pixels.
        pose: the camera at the origin of a frame with z up, at a tilt in degrees below the horizon.
        usual: mean and standard deviation of the tilt, before the picture is looked at, degrees.

    Returns:
        Mean and standard deviation of the tilt, degrees.
    """
    outlines, _ = cv2.findContours(body.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    hull = cv2.convexHull(max(outlines, key=cv2.contourArea))
    corners = cv2.approxPolyDP(hull, STRAIGHT, True)[:, 0].astype(float) + 0.5
    edges = np.roll(corners, -1, axis=0) - corners
    middles, error = corners + 0.5 * edges, EDGE_NOISE / np.maximum(np.linalg.norm(edges, axis=1), 1.0)

    def unlikely(tilt: float) -> float:
        camera = pose(tilt)
        x, y = ((middles - camera.center) / camera.focal).T
        down = -camera.camera_from_world.rotation[:, 2]
        along = np.stack([down[0] - x * down[2], down[1] - y * down[2]], axis=1) * camera.focal
        sine = along[:, 0] * edges[:, 1] - along[:, 1] * edges[:, 0]
        away = np.arctan(sine / np.where(np.abs(d := (along * edges).sum(axis=1)) > 1e-9, d, 1e-9))
        return float(np.minimum((away / error) ** 2, OBLIQUE**2).sum() + ((tilt - usual[0]) / usual[1]) ** 2)

    odds = np.array([unlikely(float(t)) for t in TILTS])
    weight = np.exp(-0.5 * (odds - odds.min()))
    mean = float((weight * TILTS).sum() / weight.sum())
    return mean, float(np.sqrt((weight * (TILTS - mean) ** 2).sum() / weight.sum()))


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
    shown, beyond = mask.astype(np.float32), OUTSIDE * max(h, w)
    i, j = np.meshgrid(*(np.arange(n) for n in raster.shape), indexing="ij")
    index, ok = np.stack([j, i, np.ones_like(i)], axis=-1).astype(float), np.ones(raster.shape, bool)
    for z in np.linspace(0.0, height, LEVELS):
        seen = index @ _pixel_from_column(camera, raster, z).T
        depth = np.where(seen[..., 2] > 1e-9, seen[..., 2], np.nan)
        u, v = (np.nan_to_num(seen[..., k] / depth, nan=-2.0 * beyond).clip(-1e4, 1e4) for k in (0, 1))
        ok &= (u > -beyond) & (u < w + beyond) & (v > -beyond) & (v < h + beyond)
        at = (u.astype(np.float32), v.astype(np.float32))
        ok &= cv2.remap(shown, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) > EDGE
    return ok


def silhouette(camera: PinholeCamera, raster: Raster, footprint: np.ndarray, height: float) -> np.ndarray:
    """bool [h,w]: pixels that see a prism."""
    upwards = camera.rays(camera.pixel_grid())[..., 2]
    columns, seen = footprint.astype(np.uint8), np.zeros(upwards.shape, bool)
    nearest = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    for z in np.linspace(0.0, height, LEVELS):
        if abs(z + GROUND) < 1e-6:  # the camera is in that plane, and sees it as a line
            continue
        back = np.linalg.inv(_pixel_from_column(camera, raster, z))
        seen |= (cv2.warpPerspective(columns, back, upwards.shape[::-1], flags=nearest) > 0) & (
            upwards * (z + GROUND) > 0
        )
    return seen


def _pixel_from_column(camera: PinholeCamera, raster: Raster, z: float) -> np.ndarray:
    """[3,3]: from (j, i, 1), a column at a height over the ground, to (u, v, 1) times its depth; both count the centre
    of the first as 0."""
    rotation, first = camera.camera_from_world.rotation, raster.low + 0.5 * raster.step
    origin = rotation @ [*first, z + GROUND] + camera.camera_from_world.translation
    lens = np.array([[camera.focal[0], 0.0, camera.center[0] - 0.5], [0.0, camera.focal[1], camera.center[1] - 0.5],
                     [0.0, 0.0, 1.0]])  # fmt: skip
    return lens @ np.stack([raster.step * rotation[:, 1], raster.step * rotation[:, 0], origin], axis=1)


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


def whole_piece(columns: np.ndarray) -> np.ndarray:
    """The largest piece, without holes."""
    return ndimage.binary_fill_holes(largest_piece(columns))


def convex(columns: np.ndarray) -> np.ndarray:
    """The convex hull of columns."""
    points = np.argwhere(columns)[:, ::-1].astype(np.int32)
    filled = np.zeros(columns.shape, np.uint8)
    if len(points):
        cv2.fillConvexPoly(filled, cv2.convexHull(points), 1)
    return filled.astype(bool)
