"""Bed, banks and rocks of a fluid that lies on something, from where it is seen and from its surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from scipy import ndimage

from fluidlift.shape import cross_section
from fluidlift.shape.cross_section import distance_inside
from fluidlift.shape.ground_mesh import ground_mesh
from fluidlift.shape.kind import Kind
from fluidlift.shape.plan import Extent, Footage, Plan, extent_of, plan_of, wide_ends, with_seen
from fluidlift.shape.surface import HeightModel
from fluidlift.shape.terrain import Setting, at_cells, signed_distance_from, to_corners, unit
from fluidlift.types import CellType, Grid, Label, PinholeCamera, Terrain


@dataclass(frozen=True)
class _Ground:
    """Heights of the columns, m."""

    bed: np.ndarray
    """with the wall that closes the channel behind its inlet"""
    shown: np.ndarray
    """without it"""
    water: np.ndarray
    """True where there is water"""


def channel_setting(
    surface: HeightModel,
    labels: UInt8[np.ndarray, "h w"],
    visible: Float[np.ndarray, "n 3"],
    camera: PinholeCamera,
    mainstream: Float[np.ndarray, "3"],
    *,
    kind: Kind,
    longest: int,
    cell_limit: int,
    depth_ratio: float | None = None,
    speed: Float[np.ndarray, "h w"] | None = None,
) -> Setting:
    """A fluid that lies on something: water depth grows from the banks, rocks stand out, the ends are open.

    Args:
        surface: height of the free surface, world.
        labels: what each pixel shows (fluid and the solids in it over the united frames).
        visible: points on the visible fluid, world.
        camera: in the world.
        mainstream: direction of the bulk flow, world.
        kind: stream or fall.
        longest: cells along the longest side.
        cell_limit: most cells of the grid.
        depth_ratio: greatest depth over the full width.
        speed: of the seen surface, m/s; nan where it is not known.
    """
    low, high = np.percentile(visible, 0.5, axis=0), np.percentile(visible, 99.5, axis=0)
    along = _ground_direction(surface, mainstream, 0.5 * (low + high), high - low)
    seen = Footage(surface, labels, visible, camera, along, speed)
    extent = extent_of(seen)
    depth = (cross_section.DEPTH_SHARE[kind] if depth_ratio is None else depth_ratio) * extent.width
    spacing = max((extent.high - extent.low).max() / longest, depth / 10)
    spacing = min(spacing, depth / 4)  # fewer than four cells hold no velocity profile
    for _ in range(60):
        grid = _channel_grid(surface, extent.low, extent.high, depth, spacing)
        if grid.cells <= cell_limit:
            break
        spacing *= 1.05
    plan = with_seen(plan_of(seen, grid, extent), extent.visible, grid)
    ground = _bed_and_banks(plan, grid, depth, extent, kind)
    return _fill_channel(grid, plan, ground, along, extent.reach, mainstream, kind)


def _ground_direction(surface, mainstream, centre, extent) -> np.ndarray:
    """Horizontal direction of the flow; straight downhill for what falls."""
    flat = np.asarray(mainstream[:2], float)
    if np.linalg.norm(flat) < 0.3:
        h = 0.1 * max(float(extent.max()), 1e-6)
        steps = np.array([[h, 0], [-h, 0], [0, h], [0, -h]])
        z = surface.height(centre[:2] + steps)
        flat = -np.array([z[0] - z[1], z[2] - z[3]])
    norm = np.linalg.norm(flat)
    return flat / norm if norm > 1e-9 else np.array([1.0, 0.0])


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
    return Grid(tuple(int(np.ceil(s / spacing)) for s in size), spacing, origin)


def _ground_samples(low, high, n: int = 24) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(low[0], high[0], n), np.linspace(low[1], high[1], n), indexing="ij")
    return np.stack([x, y], -1)


def _bed_and_banks(plan: Plan, grid: Grid, depth: float, extent: Extent, kind: Kind) -> _Ground:
    """Ground height and where there is water, per column."""
    h = grid.spacing
    wet, rock = plan.wet, plan.label == Label.SOLID  # rocks stand in the water: its banks are further out
    reach = cross_section.Reach(wet, rock, plan.level, plan.along, plan.speed, h)
    gx, gy = np.gradient(plan.level, h)
    steep = np.sqrt(1 + gx**2 + gy**2)  # thickness is meant across the sheet, columns are vertical
    section = cross_section.depth_along(reach, depth, extent.width, kind)
    below = np.maximum(cross_section.thickness(reach, section, extent.width), 0.7 * h)
    outside = distance_inside(~wet, h)
    bank = plan.level + steep * np.minimum(0.4 * h + 0.9 * outside, 0.5 * depth + 2.5 * h)
    shown = np.where(wet, plan.level - below * steep, bank)
    # one pass of smoothing in the water: steps of single cells are of the map, not of the bed
    smooth = np.minimum(ndimage.gaussian_filter(shown, 0.7), plan.level - 0.5 * h * steep)
    shown = np.where(wet & ~rock, smooth, shown)
    shown = np.where(rock, plan.level + cross_section.rock_height(reach), shown)
    upstream = plan.along < extent.reach[0]
    bed = np.where(upstream, np.maximum(shown, plan.level + 2.5 * h * steep), shown)  # closes it behind the inlet
    return _Ground(bed, shown, wet & ~rock & ~upstream)


def _fill_channel(grid, plan, ground: _Ground, along, reach, mainstream, kind) -> Setting:
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
    start, stop = wide_ends(water, plan.along, reach, h, share=0.4)
    entry = s < start + 2.5 * h
    if kind == "fall":
        entry = entry | _upper_rim(water, plan.level, along)[..., None]
    cells[fluid & entry] = CellType.INFLOW
    cells[~solid & (s > stop - 2.5 * h)] = CellType.OUTFLOW
    terrain = Terrain(grid, phi.astype(np.float32), unit(mainstream), ground_mesh(grid, to_corners(ground.shown)))
    return Setting(terrain, cells, plan.level, bed)


def _upper_rim(water: np.ndarray, level: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Columns where a curtain begins: wet, dry two cells upstream, and in the upper part of the drop (the back edge of
    a pool is dry upstream as well). A ragged curtain is fed along its whole upper edge, not at its highest point."""
    if not water.any():
        return water
    step = np.round(2.0 * along / np.abs(along).max()).astype(int)
    upstream = ndimage.shift(water.astype(np.uint8), step, order=0, cval=0).astype(bool)
    low, high = level[water].min(), level[water].max()
    return water & ~upstream & (level > low + 0.4 * (high - low))
