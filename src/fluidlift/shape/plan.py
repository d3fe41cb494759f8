"""A fluid that lies on something, seen from above: which columns of a grid are water, rock or bank."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage
from scipy.spatial import cKDTree

from fluidlift.errors import require, required
from fluidlift.shape.cross_section import distance_inside
from fluidlift.shape.heights import HeightModel
from fluidlift.shape.looked_into import Bowl
from fluidlift.types import Grid, Label, PinholeCamera

COARSE = 96
"""columns along the longer side of the plan that extent and width are taken from"""

TAIL = 0.05
"""of the width: what is thinner than twice this is a tail of the mask, not a part of the stream"""

AWAY = 0.04
"""of the longer side of the picture: the ends of masks are taken to be nearer than that to where the fluid ends (a
choice: four times what masks err by that are drawn by hand)"""

AT_HORIZON = 2
"""px from the horizon's line to the outline of what ends there: that of a mask is a pixel or two inside"""

GRAZING = 8.0
"""a column's pixel may be so many times longer along the view than the median one: beyond, rows of pixels on the far
side decide on metres of water"""


@dataclass(frozen=True)
class PlanEvidence:
    """What the picture says about a fluid that lies on something."""

    surface: HeightModel
    """height of the free surface, world"""
    labels: UInt8[np.ndarray, "h w"]
    """what each pixel shows"""
    visible: Float[np.ndarray, "n 3"]
    """points on the visible fluid, world"""
    camera: PinholeCamera
    """in the world"""
    mainstream: Float[np.ndarray, "3"]
    """direction of the bulk flow, world"""
    speed: Float[np.ndarray, "h w"] | None = None
    """of the seen surface, m/s; nan where it is not known"""
    scene_depth: Float[np.ndarray, "h w"] | None = None
    """camera depth of the whole picture, m; nan where it is not known"""
    closed: bool = False
    """a puddle: it ends where it is seen to end, on all sides"""
    goes_on: bool = False
    """standing water, closed, of which the picture may cut a part off: it goes on there"""
    ever: Bool[np.ndarray, "h w"] | None = None
    """pixels that show fluid at some time of the clip; None: not known"""
    horizon: tuple[tuple[float, float], tuple[float, float]] | None = None
    """px (u, v), where it crosses the left and the right edge of the picture, or beyond; None: not known. A camera that
    was raised for a relief looks down on a plane there and above, where the picture shows the sky"""
    bowl: Bowl | None = None
    """in which it stands, where a rim shows that"""

    @cached_property
    def reaches_horizon(self) -> bool:
        """Whether this is a sea: its water goes on to the horizon in half of the picture's columns, or more."""
        if self.horizon is None or not self.goes_on:
            return False
        wet = self.labels != Label.BACKGROUND
        line = self._horizon_at(np.arange(wet.shape[1]) + 0.5)
        return float(np.mean(wet.any(axis=0) & (wet.argmax(axis=0) <= line + AT_HORIZON))) >= 0.5

    def beyond_horizon(self, uv: Float[np.ndarray, "*n 2"]) -> Bool[np.ndarray, "*n"]:
        """Which points (px) of a sea's plane lie where the picture, or what goes on beside it, shows the sky."""
        if not self.reaches_horizon:
            return np.zeros(uv.shape[:-1], bool)
        return uv[..., 1] < self._horizon_at(uv[..., 0])

    def _horizon_at(self, u: np.ndarray) -> np.ndarray:
        (left, first), (right, last) = required(self.horizon, "no horizon")
        return first + (u - left) * (last - first) / (right - left)

    @cached_property
    def along(self) -> Float[np.ndarray, "2"]:
        """Horizontal direction of the flow; straight downhill for what falls."""
        flat = np.asarray(self.mainstream[:2], float)
        if np.linalg.norm(flat) < 0.3:
            low, high = np.percentile(self.visible, 0.5, axis=0), np.percentile(self.visible, 99.5, axis=0)
            h = 0.1 * max(float((high - low).max()), 1e-6)
            steps = np.array([[h, 0], [-h, 0], [0, h], [0, -h]])
            z = self.surface.height(0.5 * (low + high)[:2] + steps)
            flat = -np.array([z[0] - z[1], z[2] - z[3]])
        norm = np.linalg.norm(flat)
        return flat / norm if norm > 1e-9 else np.array([1.0, 0.0])


@dataclass(frozen=True)
class Plan:
    """Maps seen from above, one entry per column."""

    label: UInt8[np.ndarray, "nx ny"]
    """values of `Label`"""
    level: Float[np.ndarray, "nx ny"]
    """z of the free surface, m"""
    along: Float[np.ndarray, "nx ny"]
    """distance along the stream, m"""
    speed: Float[np.ndarray, "nx ny"]
    """of the surface, m/s; nan where it is not known"""
    known: Bool[np.ndarray, "nx ny"]
    """in the picture; the others go on as the nearest of these along the stream"""
    beyond: Bool[np.ndarray, "nx ny"]
    """beyond the horizon of a sea: neither water nor bank"""

    @property
    def wet(self) -> Bool[np.ndarray, "nx ny"]:
        """Water, and the rocks that stand in it."""
        return self.label != Label.BACKGROUND


@dataclass(frozen=True)
class Extent:
    """Where the stream is, without the tails of its mask."""

    low: Float[np.ndarray, "3"]
    high: Float[np.ndarray, "3"]
    """corners of the box around its surface, m"""
    reach: tuple[float, float]
    """its ends along the stream, m"""
    width: float
    """typical, m"""
    visible: Float[np.ndarray, "n 3"]
    """the seen points in it"""


def extent_of(seen: PlanEvidence) -> Extent:
    """Extent of a stream from a coarse plan, opened by a disc of a twentieth of its width.

    Threads at the rim of a mask, and what a grazing view stretches, would otherwise decide how large the box is.

    Raises:
        ValueError: no fluid on the ground.
    """
    low, high = np.percentile(seen.visible, 0.5, axis=0), np.percentile(seen.visible, 99.5, axis=0)
    h = max(float((high - low)[:2].max()), 1e-9) / COARSE
    columns, rows = (int(np.ceil((high[a] - low[a]) / h)) + 8 for a in (0, 1))
    grid = Grid((columns, rows, 1), h, (low[0] - 4 * h, low[1] - 4 * h, low[2]))
    plan = plan_of(seen, grid)
    wet = plan.wet & plan.known & _not_grazing(seen, plan, grid)
    require(bool(wet.any()), "no fluid on the ground")
    whole = ndimage.binary_fill_holes(ndimage.binary_closing(np.pad(wet, 2), iterations=2))[2:-2, 2:-2]
    whole &= plan.known
    stream = _without_tails(whole, TAIL * _width(whole, h, seen.closed) / h)
    width = _width(stream if seen.closed else _continued(stream, plan.known, grid, seen.along), h, seen.closed)
    cell = grid.cell_of(seen.visible)[:, :2]
    inside = np.all((cell >= 0) & (cell < grid.shape[:2]), axis=1)
    cell = np.clip(cell, 0, np.array(grid.shape[:2]) - 1)
    near = ndimage.binary_dilation(stream, iterations=1)
    kept = inside & near[tuple(cell.T)]
    require(bool(kept.any()), "no fluid on the ground")
    points = seen.visible[kept]
    # the box of the columns is a column wide too large, that of the points misses what few pixels show
    ground = grid.centers()[:, :, 0, :2][stream]
    corner = np.stack([ground.min(axis=0) - 0.5 * h, ground.max(axis=0) + 0.5 * h])
    z = np.percentile(points[:, 2], [0.5, 99.5])
    s = plan.along[stream]
    return Extent(
        np.array([*np.maximum(corner[0], points[:, :2].min(axis=0)), z[0]]),
        np.array([*np.minimum(corner[1], points[:, :2].max(axis=0)), z[1]]),
        (float(max(s.min(), (points[:, :2] @ seen.along).min())), float(s.max())),
        width,
        points,
    )


def _not_grazing(seen: PlanEvidence, plan: Plan, grid: Grid) -> np.ndarray:
    """Columns that are seen steeply enough."""
    points = np.concatenate([grid.centers()[:, :, 0, :2], plan.level[..., None]], axis=-1)
    # of the surface at large: its waves do not decide
    gx, gy = np.gradient(ndimage.gaussian_filter(plan.level, COARSE / 12), grid.spacing)
    normal = np.stack([-gx, -gy, np.ones_like(gx)], -1) / np.sqrt(1 + gx**2 + gy**2)[..., None]
    view = points - seen.camera.position
    distance = np.linalg.norm(view, axis=-1)
    # length of a pixel along the view on the surface: distance / focal length / cosine to the normal
    length = distance**2 / np.maximum(np.abs((view * normal).sum(-1)), 1e-9 * distance)
    wet = plan.wet & plan.known
    return length <= GRAZING * float(np.median(length[wet])) if wet.any() else wet


def _without_tails(wet: np.ndarray, radius: float) -> np.ndarray:
    """Opened by a disc (columns); pieces of at least a tenth of the largest."""
    reach = int(np.ceil(radius))
    pad = reach + 1
    padded = np.pad(wet, pad, mode="edge")  # the map's edge cuts no tail
    inner = ndimage.distance_transform_edt(padded) > radius
    opened = (ndimage.distance_transform_edt(~inner) <= radius)[pad:-pad, pad:-pad] & wet if inner.any() else wet
    label, count = ndimage.label(opened, structure=np.ones((3, 3)))
    sizes = np.bincount(label.ravel(), minlength=count + 1)
    sizes[0] = 0
    return (sizes >= 0.1 * sizes.max())[label] & opened


def _width(wet: np.ndarray, spacing: float, closed: bool) -> float:
    """Typical width across the stream or the pool, m. In a channel of half width a the distances to the bank are spread
    evenly over 0 to a, whose 90th percentile is 0.9 a; that holds on when a bank is ragged or an island stands in the
    stream. In a round pool of radius a more of them are short, (1 - d / a)^2 lie beyond d: 0.9 a is their 99th."""
    share = 99.0 if closed else 90.0
    return 2.0 / 0.9 * float(np.percentile(distance_inside(wet, spacing)[wet], share))


def plan_of(seen: PlanEvidence, grid: Grid, extent: Extent | None = None) -> Plan:
    """Look up each column of a grid in the picture.

    Args:
        seen: the picture and the surface.
        grid: its columns are looked up.
        extent: of the stream. Its mask is cleaned, and near its ends the channel goes on straight, as it is three cells
            before them, or further inside where it has its width (a pointed or ragged end of the mask is no funnel).
    """
    ground = grid.centers()[:, :, 0, :2]
    s = ground @ seen.along
    level = seen.surface.height(ground)
    points = np.concatenate([ground, level[..., None]], axis=-1)
    uv, _ = seen.camera.project(points)
    row, col, z = seen.camera.nearest_pixels(points)
    size = np.array(seen.camera.size)
    known = (z > 0) & (uv >= 0).all(axis=-1) & (uv < size).all(axis=-1)
    beyond = (z > 0) & seen.beyond_horizon(uv)
    # what stands at the horizon of a sea is no far bank: the water goes on to it
    known &= ~seen.beyond_horizon(uv - np.array([0.0, AT_HORIZON]))
    label = np.where(known, seen.labels[row, col], Label.BACKGROUND).astype(np.uint8)
    speed = np.full(label.shape, np.nan)
    if seen.speed is not None:
        speed = np.where(known & (label == Label.FLUID), seen.speed[row, col], np.nan)
    source = known
    if extent is not None and not seen.closed:
        reach = extent.reach
        start, stop = wide_ends(known & (label != Label.BACKGROUND), s, reach, grid.spacing, share=0.8)
        start, stop = max(start, reach[0] + 3 * grid.spacing), min(stop, reach[1] - 3 * grid.spacing)
        source = known & (s >= min(start, stop)) & (s <= max(start, stop))
        source |= known & _far_from_fluid(seen.labels)[row, col]
    if seen.goes_on:
        label = _continued(label, known, grid, seen.along, across=1.0)
    elif not seen.closed:
        label = _continued(label, source, grid, seen.along)
    if extent is not None:
        label = cleaned(label, extent.width, grid.spacing)
        if not seen.closed:
            label = _without_corners(label, source)
    label[beyond] = Label.BACKGROUND
    return Plan(label, level, s, speed, known, beyond)


def _far_from_fluid(labels: UInt8[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels that show no fluid, and none within `AWAY` of them: it is dry there, wherever a channel may go on."""
    away = np.asarray(ndimage.distance_transform_edt(labels == Label.BACKGROUND))
    return away > AWAY * max(labels.shape)


def dry_columns(seen: PlanEvidence, plan: Plan, grid: Grid) -> Bool[np.ndarray, "nx ny"]:
    """Columns that are seen, and that no water covers in the whole clip; and what lies beyond a horizon."""
    if seen.ever is None:
        return plan.beyond
    points = np.concatenate([grid.centers()[:, :, 0, :2], plan.level[..., None]], axis=-1)
    row, col, _ = seen.camera.nearest_pixels(points)
    return plan.beyond | (plan.known & ~seen.ever[row, col] & (plan.label != Label.FLUID))


def wide_ends(
    water: Bool[np.ndarray, "nx ny"],
    along: Float[np.ndarray, "nx ny"],
    reach: tuple[float, float],
    spacing: float,
    *,
    share: float,
) -> tuple[float, float]:
    """Where along the stream its ends have at least a share of its typical width: a slanted or pointed end of the mask
    must not become a nozzle. At most 15 % of the length is given up at each end."""
    length = reach[1] - reach[0]
    bins = max(int(length / spacing), 1)
    width, edges = np.histogram(along[water], bins=bins, range=(reach[0], reach[1]))
    if not width.any():
        return float(reach[0]), float(reach[1])
    wide = np.where(width >= share * np.median(width[width > 0]))[0]
    start = min(edges[wide[0]], reach[0] + 0.15 * length)
    stop = max(edges[wide[-1] + 1], reach[1] - 0.15 * length)
    return float(start), float(stop)


def cleaned(label: UInt8[np.ndarray, "nx ny"], width: float, spacing: float) -> UInt8[np.ndarray, "nx ny"]:
    """Labels without the tails of the mask, and without dry spots thinner than a fifth of the width (m): these are gaps
    in the mask, not islands, and become water."""
    wet = label != Label.BACKGROUND
    if wet.any():
        label = np.where(wet & ~_without_tails(wet, TAIL * width / spacing), Label.BACKGROUND, label)
    radius = width / 10 / spacing
    if radius >= 1.0 and wet.any():
        pad = int(np.ceil(radius)) + 1
        grown = ndimage.distance_transform_edt(~np.pad(label != Label.BACKGROUND, pad, mode="edge")) <= radius
        closed = (ndimage.distance_transform_edt(grown) > radius)[pad:-pad, pad:-pad]
        label = np.where(closed & (label == Label.BACKGROUND), Label.FLUID, label)
    return label.astype(np.uint8)


def _continued(label: np.ndarray, source: np.ndarray, grid: Grid, along: np.ndarray, across: float = 4.0) -> np.ndarray:
    """Columns outside `source` get the label of the nearest one inside it, nearness across the stream counting `across`
    times as much: a channel goes on along the stream."""
    if source.all() or not source.any():
        return label
    ground = grid.centers()[:, :, 0, :2]
    aside = np.array([-along[1], along[0]])
    place = np.stack([ground @ along, across * (ground @ aside)], axis=-1)
    nearest = cKDTree(place[source]).query(place[~source])[1]
    out = label.copy()
    out[~source] = label[source][nearest]
    return out


def _without_corners(label: np.ndarray, source: np.ndarray) -> np.ndarray:
    """A bank goes on from a seen one: a dry corner of its own beyond the ends of the stream is water."""
    piece, count = ndimage.label(label == Label.BACKGROUND, structure=np.ones((3, 3)))
    begun = np.zeros(count + 1, bool)
    begun[piece[source]] = True
    return np.where((piece > 0) & ~begun[piece], Label.FLUID, label).astype(np.uint8)


def with_seen(plan: Plan, visible: Float[np.ndarray, "n 3"], grid: Grid) -> Plan:
    """Every column in which fluid is seen is wet, although its centre may be on the bank: nothing that is seen may be
    inside the terrain. Rocks stay."""
    cell = grid.cell_of(visible)[:, :2]
    cell = cell[((cell >= 0) & (cell < grid.shape[:2])).all(axis=1)]
    label = plan.label.copy()
    seen = np.zeros(label.shape, bool)
    seen[tuple(cell.T)] = True
    label[seen & (label == Label.BACKGROUND)] = Label.FLUID
    return replace(plan, label=label)
