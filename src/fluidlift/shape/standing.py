"""A body of liquid that stands on level ground and is let go (a dam break), and the basin that it spreads in.

Liquid that was held had a level top and upright sides: it is a prism, as tall as its silhouette allows. A flat puddle
would fit the same silhouette, but could not collapse. Later the same volume lies level in its basin, whose outline is
taken to be convex; what hides level water there is an upright solid. All in a frame whose z axis is up.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from fluidlift.errors import InputRejected
from fluidlift.messages import Notice
from fluidlift.shape.ground_mesh import ground_mesh
from fluidlift.shape.prism import (
    FARTHEST,
    GROUND,
    LEVELS,
    Raster,
    columns_within,
    convex,
    meet,
    raster_over,
    silhouette,
    tallest,
    whole_piece,
)
from fluidlift.shape.surface import FrontSurface
from fluidlift.shape.terrain import at_cells, to_corners, unit
from fluidlift.types import GRAVITY, CellType, Grid, MetricScale, PinholeCamera, Setting, Similarity3, Terrain, triple

STILL = 0.02
"""share of the outline's area that changes while the body is still held: noise of the mask"""
CALM = 0.85
"""share of the clip's last part in which ground of the basin is under water: less often only waves are seen there"""
SMALLEST = 0.004
"""share of the water's pixels from which what hides it is a solid"""
FRONT = 1.55
"""speed of the front over sqrt(g height), once it runs: between the 1.33 of an experiment (Martin and Moyce 1952, table
2) and the 2 of a long column without friction (Ritter 1892)"""
FRONT_ERROR = 0.25
"""relative standard error of a scale from it, which goes with its square"""
HOLLOW = 1.2
"""area of a body's convex hull over its own from which its outline is not convex"""
NEARLY = 0.9
"""share of a rectangle from which a footprint is one"""
AT_THE_WALL = 0.06
"""share of its width by which a body may stand off a wall that it touches"""
HEADROOM = 1.7
"""height of the box over that of the body: a front that meets a wall climbs"""


@dataclass(frozen=True)
class Pillar:
    """A solid that stands upright in the water."""

    center: tuple[float, float]
    radius: float
    top: float
    """z"""


@dataclass(frozen=True)
class StandingBody:
    """What was found; lengths in the units in which the camera is 1 above the ground, origin at the camera."""

    raster: Raster
    footprint: Bool[np.ndarray, "n m"]
    height: float
    basin: Bool[np.ndarray, "n m"]
    """where the liquid lies in the end, the footprint with it"""
    level: float
    """height of the liquid there, if it lay still"""
    pillars: tuple[Pillar, ...]
    solid: Bool[np.ndarray, "h w"]
    """pixels that show the pillars"""

    @property
    def direction(self) -> Float[np.ndarray, "3"]:
        """From the body to the middle of its basin, level."""
        at = self.raster.centers()
        way = at[self.basin].mean(axis=0) - at[self.footprint].mean(axis=0)
        return unit(np.array([way[0], way[1], 0.0]))


def held_until(area_of_change: Callable[[int], float], frames: int) -> int:
    """The last frame before the body is let go.

    Args:
        area_of_change: share of the first outline by which that of a frame differs.
        frames: of the clip.
    """
    last = 0
    while last + 1 < frames and area_of_change(last + 1) < STILL:
        last += 1
    return last if last + 1 < frames else 0


def find_standing(
    camera: PinholeCamera,
    first: Bool[np.ndarray, "h w"],
    often: Float[np.ndarray, "h w"],
) -> StandingBody:
    """The prism, its basin and what stands in it.

    Args:
        camera: canonical, z up, at the origin.
        first: the body before it is let go.
        often: share of the clip's last part in which a pixel is wet.

    Raises:
        InputRejected: the camera does not look down on the ground.
    """
    first = _outline(first)
    raster = raster_over(camera, first | (often > CALM))
    height = tallest(camera, raster, first)
    footprint = _squared(whole_piece(columns_within(camera, raster, first, height)))
    if footprint.sum() < 4:
        raise InputRejected("no upright body fits the outline of the fluid", "a body that stands on level ground",
                            "give --pitch, or another --kind")  # fmt: skip
    basin, level = _basin(camera, raster, often > CALM, footprint, height)
    pillars, solid = _pillars(camera, raster, often > 0.5, ~first & (often <= 0.5), (basin, level, height))
    return StandingBody(raster, footprint, height, basin, level, pillars, solid)


def standing_front(camera: PinholeCamera, found: StandingBody) -> FrontSurface:
    """The visible side of the prism and of the ground around it."""
    rays = camera.rays(camera.pixel_grid())
    down = -rays[..., 2]
    depth = np.where(down > 1.0 / (4.0 * FARTHEST), 1.0 / np.maximum(down, 1e-6), 0.0)
    # from the top down: the highest section that a ray meets is where it enters, unless it looks up
    nearest = np.full(depth.shape, np.inf)
    for z in np.linspace(found.height, 0.0, 4 * LEVELS):
        t, xy = meet(rays, GROUND + z)
        nearest = np.where(found.raster.at(found.footprint, xy) & (t < nearest), t, nearest)
    depth = np.where(np.isfinite(nearest), nearest, depth)
    return FrontSurface(depth.astype(np.float32), np.zeros(depth.shape, np.float32), None)


UNKNOWN_SIZE = (
    "the size of the fluid is unknown (its front was not seen to run): 1 m across is assumed; give --size METRES (or a "
    "camera file with a pose) for true units"
)
"""what is said where nothing tells the scale"""


def standing_scale(
    found: StandingBody, *, size: float | None, height: float | None, speed: Callable[[], float]
) -> MetricScale:
    """Metres per unit: as given, from the camera's height above the ground, or from the speed of the front.

    Args:
        found: the body.
        size: metres across it, where the user says.
        height: metres of the camera above the ground, where surveyed.
        speed: gives that of the front (`front_speed`) per second; asked where nothing else is known.
    """
    at = found.raster.centers()[found.footprint]
    across = max(float(np.ptp(at, axis=0).max()), found.height)
    if size is not None:
        return MetricScale(size / across, "size", across=size)
    if height is not None and height > 0:
        return MetricScale(height, "camera", across=height * across)
    front = speed()
    if front > 0:
        # s v_c = FRONT sqrt(g s h_c), for the scale s
        value = (front / FRONT) ** -2 * GRAVITY * found.height
        return MetricScale(value, "front", relative_error=FRONT_ERROR, across=value * across)
    return MetricScale(1.0 / across, "assumed", Notice("size-unknown", UNKNOWN_SIZE), across=1.0)


def standing_setting(found: StandingBody, to_world: Similarity3, mainstream, *, longest: int, limit: int) -> Setting:
    """Level ground in a box as wide as the basin, closed on all sides, with the pillars and the body in it.

    Args:
        found: the body.
        to_world: world_from_canonical; it turns about z alone.
        mainstream: direction in which the body collapses, world.
        longest: cells along the longest side.
        limit: most cells of the grid.
    """
    s, at = to_world.scale, found.raster.centers()
    flat = np.concatenate([at[found.basin], np.full((int(found.basin.sum()), 1), GROUND)], axis=1)
    points = to_world.points(flat)
    ground, tall = float(points[0, 2]), s * found.height
    edge = 0.5 * s * found.raster.step
    low, high = points[:, :2].min(axis=0) - edge, points[:, :2].max(axis=0) + edge
    held = to_world.points(np.concatenate([at[found.footprint], np.zeros((int(found.footprint.sum()), 1))], axis=1))
    low, high, both, behind = _at_walls(low, high, held[:, :2].min(axis=0) - edge, held[:, :2].max(axis=0) + edge)
    spacing = max(float((high - low).max()), HEADROOM * tall) / longest
    for _ in range(80):
        if both is not None:  # a whole number of cells between both walls
            spacing = float((high - low)[both]) / max(int((high - low)[both] / spacing), 4)
        size = (*(high - low), HEADROOM * tall + 3 * spacing)
        shape = triple(max(int(np.ceil(v / spacing - 1e-6)), 4) for v in size)
        if np.prod(shape) <= limit:
            break
        spacing *= 1.05
    low = np.where(behind, high - spacing * np.array(shape[:2]), low)
    grid = Grid(shape, spacing, (float(low[0]), float(low[1]), ground - 3 * spacing))
    nodes, centers = grid.nodes(), grid.centers()
    phi = nodes[..., 2] - ground
    bed = np.full(grid.shape[:2], ground)
    columns = centers[:, :, 0, :2]
    for pillar in found.pillars:
        x, y, _ = to_world.points(np.array([[*pillar.center, 0.0]]))[0]
        top = float(to_world.points(np.array([[0.0, 0.0, pillar.top]]))[0, 2])
        away = np.hypot(nodes[..., 0] - x, nodes[..., 1] - y) - s * pillar.radius
        phi = np.minimum(phi, np.maximum(away, nodes[..., 2] - top))
        bed = np.where(np.hypot(*np.moveaxis(columns - [x, y], -1, 0)) < s * pillar.radius, top, bed)
    local = (columns - to_world.translation[:2]) @ to_world.rotation[:2, :2] / s
    body = found.raster.at(found.footprint, local)
    surface = np.where(body, ground + tall, ground)
    solid = at_cells(phi) < 0
    cells = np.where(solid, CellType.SOLID, CellType.EMPTY).astype(np.uint8)
    cells[~solid & body[..., None] & (centers[..., 2] < ground + tall)] = CellType.FLUID
    mesh = ground_mesh(grid, to_corners(bed))
    return Setting(Terrain(grid, phi.astype(np.float32), unit(mainstream), mesh), cells, surface, bed)


def _outline(mask: np.ndarray) -> np.ndarray:
    """A body's outline without the roughness of its mask: convex, as those of convex prisms are, or as it is."""
    body = whole_piece(ndimage.binary_opening(mask) if ndimage.binary_opening(mask).any() else mask)
    hull = convex(body)
    return hull if hull.sum() < HOLLOW * body.sum() else body


def _squared(columns: np.ndarray) -> np.ndarray:
    """The rectangle around columns that nearly fill it: masks round off corners, and liquid would shoot up there."""
    if not columns.any():
        return columns
    corners = cv2.boxPoints(cv2.minAreaRect(np.argwhere(columns)[:, ::-1].astype(np.float32)))
    filled = np.zeros(columns.shape, np.uint8)
    cv2.fillConvexPoly(filled, np.round(corners).astype(np.int32), 1)
    return filled.astype(bool) if columns.sum() > NEARLY * filled.sum() else columns


def _narrowed(columns: np.ndarray) -> np.ndarray:
    """Less a column all around, about the pixel by which an outline was widened."""
    fewer = ndimage.binary_erosion(columns)
    return fewer if fewer.any() else columns


def _at_walls(low: np.ndarray, high: np.ndarray, first: np.ndarray, last: np.ndarray):
    """The box from `low` to `high` with those walls moved to the body (from `first` to `last`) that it nearly touches:
    into a gap of a cell liquid of that height would shoot as a jet. Then the axis with two of them, or None; and which
    axes have only the one behind, from which cells are counted.
    """
    near = AT_THE_WALL * (last - first)
    before, behind = first - low < near, high - last < near
    both = np.flatnonzero(before & behind)
    low, high = np.where(before, first, low), np.where(behind, last, high)
    return low, high, int(both[0]) if len(both) else None, behind & ~before


def _basin(camera, raster: Raster, settled: np.ndarray, footprint: np.ndarray, height: float):
    """Where the liquid lies level in the end, and how high: as high as its volume says."""
    volume, basin = float(footprint.sum()) * height, footprint
    wide = ndimage.binary_dilation(settled)  # a rough edge would cost a column at each of its sections
    for level in np.geomspace(0.02 * height, 0.8 * height, 32):  # the lowest that holds it: no column of its own
        columns = whole_piece(columns_within(camera, raster, wide, level))
        basin = convex(_narrowed(columns) | footprint)
        if float(basin.sum()) * level >= volume:
            break
    basin = _walled(raster, basin, footprint)
    return basin, volume / float(basin.sum())


def _walled(raster: Raster, basin: np.ndarray, footprint: np.ndarray) -> np.ndarray:
    """The basin no wider than a body that stands at one of its sides: that one is a dam, from wall to wall.

    The far side of the basin is the least sure: waves hide it. So is the end of such a channel, where the front climbs
    the wall: the ground behind that water seems wet, but for the near side, where the eye passes by it.
    """
    at = raster.centers()
    way = at[basin].mean(axis=0) - at[footprint].mean(axis=0)
    edges = cv2.boxPoints(cv2.minAreaRect(np.argwhere(footprint).astype(np.float32)))
    sides = [edges[1] - edges[0], edges[2] - edges[1]]
    across = min(sides, key=lambda v: abs(float(v @ way)) / max(float(np.linalg.norm(v)), 1e-9))
    across = across / max(float(np.linalg.norm(across)), 1e-9)
    place = at @ across
    (low, high), (left, right) = (np.percentile(place[part], [0.5, 99.5]) for part in (footprint, basin))
    width = high - low
    if min(low - left, right - high) > AT_THE_WALL * width:
        return basin
    basin = basin & (place >= place[footprint].min()) & (place <= place[footprint].max())
    # from the side that is nearer to the eye
    depth = place if abs(low) < abs(high) else -place
    station = np.round((at @ [-across[1], across[0]]) / raster.step).astype(int)
    station -= station.min()
    begins = np.full(station.max() + 1, np.inf)
    np.minimum.at(begins, station[basin], depth[basin])
    seen = np.flatnonzero(np.isfinite(begins))
    slope, level = _line_through(seen, begins[seen])  # it seems askew where the tilt is not known well
    reach, _ = ndimage.label(begins < slope * np.arange(len(begins)) + level + AT_THE_WALL * width)
    return basin & (reach == reach[int(np.median(station[footprint]))])[station] | footprint


def _line_through(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Slope and level at 0 of the line that most points agree on (Theil and Sen): the median slope of all pairs.

    As `scipy.stats.theilslopes`, whose package takes half a second of processor time to import.
    """
    first, second = np.nonzero(np.subtract.outer(x, x) > 0)
    slope = float(np.median((y[first] - y[second]) / (x[first] - x[second])))
    return slope, float(np.median(y) - slope * np.median(x))


def _pillars(camera, raster: Raster, settled, dry, body) -> tuple[tuple[Pillar, ...], np.ndarray]:
    """What hides level water, by pixels of its surface that are mostly dry; and all pixels that show it."""
    basin, level, height = body
    hidden = dry & silhouette(camera, raster, ndimage.binary_erosion(basin, iterations=2), level)
    hidden = ndimage.binary_opening(hidden, iterations=2)
    parts, count = ndimage.label(hidden)
    rays, out, shown = camera.rays(camera.pixel_grid()), [], np.zeros(dry.shape, bool)
    for k in range(1, count + 1):
        part = parts == k
        widths = part.sum(axis=1)
        rows, columns = np.nonzero(part)
        if part.sum() < SMALLEST * settled.sum() or not _in_water(part, settled):
            continue
        lowest = int(np.median([_foot(settled[:, c], rows[columns == c].max()) for c in np.unique(columns)]))
        t, xy = meet(rays[lowest, round(columns.mean())], GROUND + level)
        if not np.isfinite(t):
            continue
        radius = 0.5 * float(np.median(widths[widths > 0])) * float(t) / camera.focal[0]
        ahead = xy / max(float(np.linalg.norm(xy)), 1e-9)
        # the ray of its highest pixel, over the place of its front
        high = rays[int(rows.min()), round(columns.mean())]
        top = float(np.linalg.norm(xy) / max(np.linalg.norm(high[:2]), 1e-9) * high[2])
        center = xy + radius * ahead
        # where it stands out over the far edge of the water its top is not seen: it is taken to be dry
        out.append(Pillar((float(center[0]), float(center[1])), radius, max(top, GROUND + height)))
        disc = np.hypot(*np.moveaxis(raster.centers() - out[-1].center, -1, 0)) < radius
        shown |= silhouette(camera, raster, disc, top - GROUND)
        shown |= dry & silhouette(camera, raster, disc, out[-1].top - GROUND)
    return tuple(out), shown


def _in_water(part: np.ndarray, wet: np.ndarray) -> bool:
    """Whether there is water close by on both sides of most rows of a part: else it is the edge of the basin.

    Close is less than the part's own width: drops that run down a solid leave dry pixels beside it.
    """
    rows, columns = np.nonzero(part)
    wide = int(np.ptp(columns)) + 1
    beside = []
    for row in np.unique(rows):
        first, last = columns[rows == row][[0, -1]]
        beside.append(wet[row, max(first - wide, 0) : first].any() and wet[row, last + 1 : last + 1 + wide].any())
    return float(np.mean(beside)) > 0.5


def _foot(wet: np.ndarray, row: int) -> int:
    """The first row from `row` on, downwards, below which there usually is water."""
    below = np.flatnonzero(wet[row:])
    return row + (int(below[0]) if len(below) else 0)


def front_speed(camera: PinholeCamera, found: StandingBody, outlines: Iterable[Bool[np.ndarray, "h w"]]) -> float:
    """Speed, units per frame, of the furthest wet ground on its way to the end of the basin; 0: not seen to run.

    Args:
        camera: canonical.
        found: the body.
        outlines: of the frames after the first, in order.
    """
    at, way = found.raster.centers(), found.direction[:2]
    end = float(np.percentile(at[found.basin] @ way, 99.0))
    start = float(np.percentile(at[found.footprint] @ way, 99.0))
    reached = []
    for mask in outlines:
        wet = columns_within(camera, found.raster, mask, 0.1 * found.height) & found.basin
        reached.append(float(np.percentile(at[wet] @ way, 99.0)) if wet.any() else start)
        if reached[-1] > start + 0.9 * (end - start):
            break
    run = np.array(reached)
    if len(run) < 4 or run[-1] - start < 0.3 * (end - start):
        return 0.0
    middle = (run > start + 0.15 * (end - start)) & (run < start + 0.9 * (end - start))
    index = np.flatnonzero(middle)
    if len(index) < 3:
        return 0.0
    return max(float(np.polyfit(index, run[index], 1)[0]), 0.0)
