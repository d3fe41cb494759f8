"""Bed, banks and rocks of a fluid that lies on something, from where it is seen and from its surface."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from fluidlift.errors import required
from fluidlift.shape import cross_section
from fluidlift.shape.cross_section import distance_inside
from fluidlift.shape.depth_surface import solid_heights
from fluidlift.shape.ground_mesh import ground_mesh
from fluidlift.shape.looked_into import OVER_RIM, Bowl
from fluidlift.shape.plan import Extent, Plan, PlanEvidence, dry_columns, extent_of, plan_of, wide_ends, with_seen
from fluidlift.shape.terrain import at_cells, signed_distance_from, to_corners, unit
from fluidlift.types import CellType, FluidKind, Grid, Label, PinholeCamera, Setting, Terrain, kind_of, triple

INLET = 2.5
"""cells along the flow that an inlet is long"""
EDGE = 2.0
"""1 / cosine of 60 degrees: what is steeper in a stream is the side of a chute, not a sheet"""
SHALLOWEST = 8.0
"""cells, depth of a sea at its far end, at least: of 1 to 3 cells, as its profile had them, its level rose by a quarter
of one and more; of 10 it stays"""
LOWEST = 0.25
"""cells by which ground stands above the water beside it, however flat it is looked at"""
BANK = 0.9
"""slope of a bank above the water: 42 degrees, soil that plants hold"""
FLAT = 0.3
"""slope at which a surface says as much as the bulk flow about where its water runs"""


OUTLET = 5.0
"""cells before the end of a stream from which on the ground beside it is no wall: the section in which it leaves is
thinner than the stream, and needs room"""
BEYOND = 0.25
"""cells from the rim of the wet columns to the wall beside them: none was thinner than the stream, whole ones wider"""
MARGIN = 2.0
"""cells by which such a wall stands above the water: waves of a stream of some four cells' depth stay below"""


LIP, SIDE = 3.0, 2.0
"""cells, width of the rim of a vessel, and of its side seen from above: narrower ones are ragged on their way between
columns"""


TABLE = 1.2
"""radii of its rim that the box around a vessel goes to, beside four cells: the side of the vessel, and some table"""


@dataclass(frozen=True)
class _Ground:
    """Heights of the columns, m."""

    bed: np.ndarray
    """with the wall that closes the channel behind its inlet"""
    shown: np.ndarray
    """without it"""
    water: np.ndarray
    """True where there is water"""


@dataclass(frozen=True)
class ChannelConfig:
    """How a fluid that lies on something is built."""

    kind: str | FluidKind
    """of the fluid, a channel flow"""
    longest: int
    """cells along the longest side"""
    cell_limit: int
    """most cells of the grid"""
    depth_ratio: float | None = None
    """greatest depth over the full width; None: usual for the kind, and of a stream in metres for its width"""
    in_metres: bool = False
    """whether the width is known in metres, and not that of an assumed size"""


def channel_setting(seen: PlanEvidence, config: ChannelConfig) -> Setting:
    """A fluid that lies on something: water depth grows from the banks, rocks stand out, the ends are open.

    Banks and rocks are as high as the scene's depth shows them, where there is one; else banks rise from the water and
    rocks are domes.

    Args:
        seen: the picture, the surface and the flow.
        config: how it is built.

    Raises:
        ValueError: no fluid on the ground, or a kind that runs in no channel.
    """
    extent, kind = extent_of(seen), kind_of(config.kind)
    ratio = kind.depth_ratio if config.depth_ratio is None else config.depth_ratio
    share = required(ratio, f"the kind '{kind}'", "a channel flow")
    depth = share * extent.width
    if config.in_metres and config.depth_ratio is None and kind.runs_nearly_level and not seen.closed:
        depth = cross_section.usual_depth(extent.width, share)
    beach = seen.reaches_horizon and config.depth_ratio is None
    if beach:  # a guess for pools would be a bay as deep as a fifth of what is seen of it
        across = float(np.linalg.norm(extent.high - extent.low))
        depth = float(cross_section.shelving(np.array([across]))[0])
        depth = max(depth, SHALLOWEST * float((extent.high - extent.low).max()) / config.longest)
    spacing = max((extent.high - extent.low).max() / config.longest, depth / 10)
    spacing = min(spacing, depth / 4)  # fewer than four cells hold no velocity profile
    low, high = extent.low.copy(), extent.high.copy()
    if seen.bowl is not None:
        center, reach = np.asarray(seen.bowl.rim.center), TABLE * seen.bowl.rim.radius
        low[:2], high[:2] = np.minimum(low, center - reach)[:2], np.maximum(high, center + reach)[:2]
        high[2] = max(high[2], center[2])
    for _ in range(60):
        grid = _channel_grid(seen.surface, low, high, depth, spacing)
        if grid.cells <= config.cell_limit:
            break
        spacing *= 1.05
    plan = with_seen(plan_of(seen, grid, extent), extent.visible, grid)
    if plan.beyond.any():  # a sea ends where its horizon is: the box as well
        grid = _within_horizon(grid, plan)
        plan = with_seen(plan_of(seen, grid, extent), extent.visible, grid)
    thin = seen.surface.sheet(grid.centers()[:, :, 0, :2])
    rim = np.zeros_like(plan.wet)
    if kind.enters_over_rim or seen.surface.steps:
        foot_of_bank = int(np.ceil(depth / (cross_section.REPOSE * spacing)))
        rim = above_rim(plan.wet, plan.level, seen.along, spacing, foot_of_bank)
        if not kind.enters_over_rim:  # the back edge of the pool below a chute is a bank
            rim &= _upper(plan.wet, plan.level)
    ground = _bed_and_banks(plan, grid, (depth, thin), extent, kind, rim, beach=beach)
    shown = np.minimum(ground.shown, np.maximum(_sight_lines(plan, grid, seen.camera), plan.level + LOWEST * spacing))
    ground = _as_seen(_Ground(shown, shown, ground.water), plan, grid, seen, extent)
    if seen.bowl is not None:
        ground = _within_bowl(ground, grid, seen.bowl)
    return _fill_channel(grid, plan, ground, extent.reach, seen, kind)


def _within_bowl(ground: _Ground, grid: Grid, bowl: Bowl) -> _Ground:
    """The ground beside the water as wall and rim of the vessel that it stands in, and around that a table as low as
    the bed."""
    h, away = grid.spacing, bowl.away(grid.centers()[:, :, 0, :2])
    water = ground.water & (away < OVER_RIM * bowl.rim.radius)
    if not water.any():
        return ground
    table, farthest = float(ground.shown[water].min()), float(away[water].max())
    # a pixel or two of water beyond the rim are within it
    wide = replace(bowl, rim=replace(bowl.rim, radius=max(bowl.rim.radius, farthest + 0.5 * h)))
    around = wide.height(away, LIP * h, SIDE * h, table)
    shown = np.where(water, ground.shown, around)
    return _Ground(shown, shown, water)


def _channel_grid(surface, low, high, depth, spacing) -> Grid:
    margin = max(4 * spacing, 0.25 * depth)
    ground = _ground_samples(low, high)
    z = surface.height(ground)
    lowest = min(z.min(), low[2]) - depth - 3 * spacing
    # a level surface lies between two layers of cells, not somewhere in one that is then full or empty
    middle = float(np.median(z))
    bottom = middle - np.ceil((middle - lowest) / spacing) * spacing
    top = max(z.max(), high[2]) + max(5 * spacing, 0.6 * depth)
    origin = (low[0] - margin, low[1] - margin, bottom)
    size = (high[0] - low[0] + 2 * margin, high[1] - low[1] + 2 * margin, top - bottom)
    return Grid(triple(int(np.ceil(s / spacing)) for s in size), spacing, origin)


def _within_horizon(grid: Grid, plan: Plan) -> Grid:
    """The box without the columns at its sides that all lie beyond the horizon."""
    kept = [np.flatnonzero((~plan.beyond).any(axis=1 - axis)) for axis in (0, 1)]
    first, last = np.array([k[0] for k in kept]), np.array([k[-1] for k in kept])
    low = np.array([*(grid.low[:2] + first * grid.spacing), grid.low[2]])
    return Grid((*(last - first + 1).tolist(), grid.shape[2]), grid.spacing, triple(low.tolist()))


def _ground_samples(low, high) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(low[0], high[0], 24), np.linspace(low[1], high[1], 24), indexing="ij")
    return np.stack([x, y], -1)


def _bed_and_banks(
    plan: Plan, grid: Grid, depths: tuple[float, Float[np.ndarray, "nx ny"]], extent: Extent, kind: FluidKind,
    rim: Bool[np.ndarray, "nx ny"], *, beach: bool = False,
) -> _Ground:  # fmt: skip
    """Ground height and where there is water, per column; `depths`: the greatest, and the most that each column has;
    `rim`: what comes over it is as deep there as anywhere, it is no bank; `beach`: it shelves as sand does."""
    h, (depth, thin) = grid.spacing, depths
    wet, rock = plan.wet, plan.label == Label.SOLID  # rocks stand in the water: its banks are further out
    reach = cross_section.Reach(wet, rock, plan.level, plan.along, plan.speed, h)
    gx, gy = np.gradient(plan.level, h)
    steep = np.sqrt(1 + gx**2 + gy**2)  # thickness is meant across the sheet, columns are vertical
    steep = steep if kind.enters_over_rim else np.minimum(steep, EDGE)
    if beach:
        sea = distance_inside(wet | plan.beyond, h)
        below = cross_section.shelving(sea)
        below = cross_section.beside_rocks(reach, below * max(1.0, depth / below.max()))
        rise = cross_section.FORESHORE
    else:
        section = cross_section.depth_along(reach, depth, extent.width, kind)
        reach = replace(reach, wet=wet | rim)
        below, rise = cross_section.thickness(reach, section, extent.width), BANK
    below = np.maximum(np.minimum(below, thin), 0.7 * h)
    outside = distance_inside(~wet, h)
    bank = plan.level + steep * np.minimum(0.4 * h + rise * outside, 0.5 * depth + 2.5 * h)
    shown = np.where(wet | plan.beyond, plan.level - below * steep, bank)
    # one pass of smoothing in the water: steps of single cells are of the map, not of the bed
    smooth = np.minimum(ndimage.gaussian_filter(shown, 0.7), plan.level - 0.5 * h * steep)
    shown = np.where(wet & ~rock, smooth, shown)
    shown = np.where(rock, plan.level + cross_section.rock_height(reach), shown)
    return _Ground(shown, shown, wet & ~rock)


def _sight_lines(plan: Plan, grid: Grid, camera: PinholeCamera) -> Float[np.ndarray, "nx ny"]:
    """z (m) of the lowest line of sight above each column, from the camera to water that it sees; inf without any.

    What is seen is hidden by nothing: so high at most are the bank before the water, and the rock before the water
    behind it.
    """
    h = grid.spacing
    points = np.concatenate([grid.centers()[:, :, 0, :2], plan.level[..., None]], axis=-1)
    target = points[plan.known & (plan.label == Label.FLUID)]
    way = camera.position - target
    level = np.linalg.norm(way[:, :2], axis=1)
    lowest = np.full(plan.label.shape, np.inf)
    # samples every half column, from the edge of the next one; a line that leaves the box does not come back
    for step in np.arange(1.0, 2.0 * np.hypot(*plan.label.shape)) * 0.5 * h + 0.5 * h:
        at = target + way * (step / np.maximum(level, 1e-9))[:, None]
        column = grid.cell_of(at)[:, :2]
        inside = (step < level) & ((column >= 0) & (column < plan.label.shape)).all(axis=1)
        if not inside.any():
            break
        np.minimum.at(lowest, tuple(column[inside].T), at[inside, 2])
    return lowest


def _as_seen(ground: _Ground, plan: Plan, grid: Grid, seen: PlanEvidence, extent: Extent) -> _Ground:
    """Banks and rocks as high as the scene's depth shows them, and the wall that closes the channel behind its inlet.

    Beside what is seen, the difference to the usual ground fades away over two cells. What stands higher over the
    water than that is wide (trees, people) is cut there.
    """
    h, shown = grid.spacing, ground.shown
    gx, gy = np.gradient(plan.level, h)
    steep = np.sqrt(1 + gx**2 + gy**2)
    dry = ~ground.water
    if seen.scene_depth is not None:
        found = solid_heights(seen.scene_depth, seen.labels, seen.camera, grid)
        least = plan.level + np.where(plan.label == Label.SOLID, 1.0, 0.3) * h * steep
        change = np.clip(found, least, plan.level + extent.width) - shown
        known = dry & np.isfinite(change)
        share = ndimage.gaussian_filter(known.astype(float), 2.0)
        spread = ndimage.gaussian_filter(np.where(known, change, 0.0), 2.0) / (share + 0.05)
        shown = np.where(known, shown + change, np.where(dry, np.maximum(shown + spread, least), shown))
    if seen.closed:
        return _Ground(shown, shown, ground.water)
    upstream = plan.along < extent.reach[0]
    bed = np.where(upstream, np.maximum(shown, plan.level + 2.5 * h * steep), shown)
    return _Ground(bed, shown, ground.water & ~upstream)


def _fill_channel(grid, plan, ground: _Ground, reach, seen: PlanEvidence, kind) -> Setting:
    h, bed, water = grid.spacing, ground.bed, ground.water
    gx, gy = np.gradient(bed, h)
    nodes = grid.nodes()
    corner = to_corners(bed)
    slope = to_corners(np.sqrt(1 + gx**2 + gy**2))
    phi = signed_distance_from(nodes[..., 2] - corner[..., None], h, slope[..., None])
    z = grid.centers()[..., 2]
    solid = at_cells(phi) < 0
    fluid = ~solid & water[..., None] & (z < plan.level[..., None])
    s = np.broadcast_to(plan.along[..., None], grid.shape)
    cells = np.full(grid.shape, CellType.EMPTY, np.uint8)
    cells[solid] = CellType.SOLID
    cells[fluid] = CellType.FLUID
    terrain = Terrain(grid, phi.astype(np.float32), unit(seen.mainstream), ground_mesh(grid, to_corners(ground.shown)))
    if seen.goes_on:
        terrain = _walled(terrain, _kept_dry(grid, plan, dry_columns(seen, plan, grid)))
    if seen.closed:
        return Setting(terrain, cells, plan.level, bed)
    start, stop = wide_ends(water, plan.along, reach, h, share=0.4)
    # on a curtain that much of its plan may be most of its height, full of faster and faster water
    rim = kind.enters_over_rim or seen.surface.steps
    entry = upper_rim(water, plan.level, seen.along, h)[..., None] if rim else s < start + INLET * h
    cells[fluid & entry] = CellType.INFLOW
    cells[~solid & (s > stop - 2.5 * h)] = CellType.OUTFLOW
    # before the outlet the water spreads as it likes
    wall = _kept_dry(grid, plan, dry_columns(seen, plan, grid) & (plan.along < stop - OUTLET * h))
    return Setting(_walled(terrain, wall), cells, plan.level, bed)


def _walled(terrain: Terrain, wall: Float[np.ndarray, "nx+1 ny+1 nz+1"]) -> Terrain:
    """The terrain with a wall (signed distance, m, on the nodes) as ground."""
    return replace(terrain, signed_distance=np.minimum(terrain.signed_distance, wall).astype(np.float32))


def _kept_dry(grid: Grid, plan: Plan, dry: Bool[np.ndarray, "nx ny"]) -> Float[np.ndarray, "nx+1 ny+1 nz+1"]:
    """Signed distance (m, on the nodes) to ground that stands above the water wherever the clip stays dry.

    A bank of cells slopes; water that swells by half a cell runs up it by one, which is seven pixels of a clip. That
    the clip stays dry there says that the ground stands higher: a wall, `BEYOND` cells outside of the wet columns.
    """
    h = grid.spacing
    if not dry.any() or dry.all():
        return np.full(tuple(n + 1 for n in grid.shape), np.inf)
    # on columns, then on the corners between them; half a column from the middle of one to its edge
    outside = ndimage.distance_transform_edt(dry) - 0.5
    inside = ndimage.distance_transform_edt(~dry) - 0.5
    away = to_corners(h * (np.where(dry, -outside, inside) + BEYOND))
    top = to_corners(plan.level + MARGIN * h)
    return np.maximum(away[..., None], grid.nodes()[..., 2] - top[..., None])


def above_rim(
    water: Bool[np.ndarray, "nx ny"], level: Float[np.ndarray, "nx ny"], along: Float[np.ndarray, "2"], spacing: float,
    reach: int,
) -> Bool[np.ndarray, "nx ny"]:  # fmt: skip
    """Dry columns from which the way down leads to water within `reach` columns.

    Args:
        water, level, along, spacing: as of `upper_rim`.
        reach: columns.
    """
    down = _down(level, along, spacing)[0]
    here, found = np.moveaxis(np.indices(water.shape), 0, -1), np.zeros(water.shape, bool)
    for steps in range(1, reach + 1):
        below = np.moveaxis(here + np.rint(down * steps), -1, 0)
        found |= ndimage.map_coordinates(water.astype(np.uint8), below, order=0, cval=0) > 0
    return found & ~water


def _down(
    level: Float[np.ndarray, "nx ny"], along: Float[np.ndarray, "2"], spacing: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Horizontal direction [nx,ny,2] in which water runs from each column, and the slopes of its surface."""
    gx, gy = np.gradient(ndimage.gaussian_filter(level, 1.0), spacing)
    down = FLAT * np.asarray(along, float) - np.stack([gx, gy], axis=-1)
    return down / np.maximum(np.linalg.norm(down, axis=-1, keepdims=True), 1e-12), gx, gy


def upper_rim(
    water: Bool[np.ndarray, "nx ny"], level: Float[np.ndarray, "nx ny"], along: Float[np.ndarray, "2"], spacing: float
) -> Bool[np.ndarray, "nx ny"]:
    """Columns where a curtain begins: wet, and dry `INLET` cells further up, in the upper part of the drop (the back
    edge of a pool is dry upstream as well). A ragged curtain is fed along its whole upper edge, not at its highest
    point.

    The way up is measured on the surface: a steep curtain is only a few columns deep. As an inlet it must be no longer
    than a cross-section is thick: cells are kept full there, and water that falls thins.

    Args:
        water: wet columns.
        level: z of the surface, m.
        along: horizontal direction of the bulk flow, taken where the surface is flat; where it is steep, water runs
            down it.
        spacing: width of a column, m.
    """
    if not water.any():
        return water
    down, gx, gy = _down(level, along, spacing)
    columns = np.maximum(INLET / np.sqrt(1 + gx**2 + gy**2), 1.0)
    up = np.moveaxis(np.indices(water.shape), 0, -1) - np.rint(down * columns[..., None])
    upstream = ndimage.map_coordinates(water.astype(np.uint8), np.moveaxis(up, -1, 0), order=0, cval=0) > 0
    return water & ~upstream & _upper(water, level)


def _upper(water: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Columns in the upper part of the drop, where a curtain or a chute begins."""
    low, high = level[water].min(), level[water].max()
    return level > low + 0.4 * (high - low)
