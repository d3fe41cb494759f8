"""Bed, banks, rocks, floors: the solid that a fluid rests in, as a signed distance on the nodes of a grid, together
with which cells hold fluid and where it enters and leaves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from fluidlift.errors import require
from fluidlift.numerics.isosurface import surface_nets
from fluidlift.shape.kind import Kind
from fluidlift.shape.surface import HeightModel
from fluidlift.types import CellType, Grid, Label, PinholeCamera, Terrain, TriangleMesh

DEPTH_SHARE: dict[str, float] = {"stream": 0.2, "fall": 0.1}
"""greatest water depth over the full width: a single view does not show the bed (a choice; --depth-ratio overrides)"""


@dataclass(frozen=True)
class Setting:
    """A fluid in its place at the first instant."""

    terrain: Terrain
    cell_types: UInt8[np.ndarray, "nx ny nz"]
    """values of `CellType`"""
    surface_height: Float[np.ndarray, "nx ny"] | None
    """z of the free surface over each column, m (fluids that lie on something)"""
    bed_height: Float[np.ndarray, "nx ny"]
    """z of the ground under each column, m"""
    pool_level: float | None = None
    """z below which a pour stands in its vessel, m"""


@dataclass(frozen=True)
class _Plan:
    """Maps seen from above, one entry per column."""

    label: np.ndarray
    level: np.ndarray
    along: np.ndarray


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
    """
    low, high = np.percentile(visible, 0.5, axis=0), np.percentile(visible, 99.5, axis=0)
    along = _ground_direction(surface, mainstream, 0.5 * (low + high), high - low)
    reach = np.percentile(visible[:, :2] @ along, [0.5, 99.5])
    ratio = DEPTH_SHARE[kind] if depth_ratio is None else depth_ratio
    width = _channel_width(surface, labels, camera, low, high, along, reach)
    depth = ratio * width
    spacing = max((high - low).max() / longest, depth / 10)
    spacing = min(spacing, depth / 4)  # fewer than four cells hold no velocity profile
    for _ in range(60):
        grid = _channel_grid(surface, low, high, depth, spacing)
        if grid.cells <= cell_limit:
            break
        spacing *= 1.05
    plan = _with_seen(_plan(surface, labels, camera, grid, along, reach), visible, grid)
    bed, water = _bed_and_banks(plan, surface, grid, depth, reach)
    return _fill_channel(grid, plan, bed, water, along, reach, mainstream, kind)


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
    bottom = min(z.min(), low[2]) - depth - 3 * spacing
    top = max(z.max(), high[2]) + max(5 * spacing, 0.6 * depth)
    origin = (low[0] - margin, low[1] - margin, bottom)
    size = (high[0] - low[0] + 2 * margin, high[1] - low[1] + 2 * margin, top - bottom)
    return Grid(tuple(int(np.ceil(s / spacing)) for s in size), spacing, origin)


def _ground_samples(low, high, n: int = 24) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(low[0], high[0], n), np.linspace(low[1], high[1], n), indexing="ij")
    return np.stack([x, y], -1)


def _plan(surface, labels, camera, grid: Grid, along, reach) -> _Plan:
    """Look up each column of the grid in the picture. The picture's edge pixels stand for what lies beyond it."""
    ground = grid.centers()[:, :, 0, :2]
    s = ground @ along
    # near its ends the channel goes on straight, as it is three cells before them
    start, stop = reach[0] + 3 * grid.spacing, reach[1] - 3 * grid.spacing
    inner = ground + (np.clip(s, min(start, stop), max(start, stop)) - s)[..., None] * along
    level = surface.height(ground)
    row, col, z = camera.nearest_pixels(np.concatenate([inner, surface.height(inner)[..., None]], axis=-1))
    label = np.where(z > 0, labels[row, col], Label.BACKGROUND)
    return _Plan(label, level, s)


def _with_seen(plan: _Plan, visible, grid: Grid) -> _Plan:
    """Every column in which fluid is seen is wet, although its centre may be on the bank: nothing that is seen may be
    inside the terrain. Rocks stay."""
    cell = grid.cell_of(visible)[:, :2]
    cell = cell[((cell >= 0) & (cell < grid.shape[:2])).all(axis=1)]
    label = plan.label.copy()
    seen = np.zeros(label.shape, bool)
    seen[tuple(cell.T)] = True
    label[seen & (label == Label.BACKGROUND)] = Label.FLUID
    return replace(plan, label=label)


def _channel_width(surface, labels, camera, low, high, along, reach) -> float:
    """Typical width of the fluid across the stream, m."""
    spacing = max(high[0] - low[0], high[1] - low[1]) / 96
    margin = 4 * spacing
    shape = (
        int(np.ceil((high[0] - low[0] + 2 * margin) / spacing)),
        int(np.ceil((high[1] - low[1] + 2 * margin) / spacing)),
        1,
    )
    grid = Grid(shape, spacing, (low[0] - margin, low[1] - margin, low[2]))
    plan = _plan(surface, labels, camera, grid, along, reach)
    wet = (plan.label != Label.BACKGROUND) & (plan.along >= reach[0]) & (plan.along <= reach[1])
    require(bool(wet.any()), "no fluid on the ground")
    distance = _distance(plan.label != Label.BACKGROUND, spacing)
    ridge = wet & (distance >= ndimage.maximum_filter(distance, size=5) - 1e-9)
    return 2.0 * float(np.median(distance[ridge]))


def _distance(inside: np.ndarray, spacing: float) -> np.ndarray:
    """Distance (m) of each true cell to the nearest false one; the map's edge is no bank."""
    if inside.all():
        return np.full(inside.shape, spacing * max(inside.shape) / 2)
    pad = max(inside.shape)
    return ndimage.distance_transform_edt(np.pad(inside, pad, mode="edge"))[pad:-pad, pad:-pad] * spacing


def _bed_and_banks(plan: _Plan, surface, grid: Grid, depth: float, reach) -> tuple[np.ndarray, np.ndarray]:
    """Ground height (m) and where there is water, per column."""
    h = grid.spacing
    wet = plan.label != Label.BACKGROUND  # rocks stand in the water: its banks are further out
    gx, gy = np.gradient(plan.level, h)
    steep = np.sqrt(1 + gx**2 + gy**2)  # thickness is meant across the sheet, columns are vertical
    to_bank = _distance(wet, h)
    half = max(float(np.percentile(to_bank[wet], 90)), 2 * h) if wet.any() else h
    share = np.clip(to_bank / half, 0.0, 1.0)
    thickness = np.maximum(depth * (1 - (1 - share) ** 2), 0.7 * h)
    outside = _distance(~wet, h)
    bank = plan.level + steep * np.minimum(0.4 * h + 0.9 * outside, 0.5 * depth + 2.5 * h)
    bed = np.where(wet, plan.level - thickness * steep, bank)
    rock = plan.label == Label.SOLID
    if rock.any():
        to_water = _distance(rock, h)
        bed = np.where(rock, plan.level + np.minimum(1.5 * h + 1.0 * to_water, depth + 1.5 * h), bed)
    upstream = plan.along < reach[0]
    bed = np.where(upstream, np.maximum(bed, plan.level + 2.5 * h * steep), bed)  # closes the channel behind the inlet
    # one pass of smoothing in the water: steps of single cells are of the map, not of the bed
    smooth = ndimage.gaussian_filter(bed, 0.7)
    return np.where(wet & ~rock & ~upstream, smooth, bed), wet & ~rock & ~upstream


def _fill_channel(grid, plan, bed, water, along, reach, mainstream, kind) -> Setting:
    h = grid.spacing
    gx, gy = np.gradient(bed, h)
    nodes = grid.nodes()
    corner = _to_corners(bed)
    slope = _to_corners(np.sqrt(1 + gx**2 + gy**2))
    phi = signed_distance_from(nodes[..., 2] - corner[..., None], h, slope[..., None])
    z = grid.centers()[..., 2]
    solid = _at_cells(phi) < 0
    fluid = ~solid & water[..., None] & (z < plan.level[..., None])
    s = np.broadcast_to(plan.along[..., None], grid.shape)
    cells = np.full(grid.shape, CellType.EMPTY, np.uint8)
    cells[solid] = CellType.SOLID
    cells[fluid] = CellType.FLUID
    start, stop = _wide_ends(water, plan.along, reach, h)
    entry = s < start + 2.5 * h
    if kind == "fall":
        entry = entry | _upper_rim(water, plan.level, along)[..., None]
    cells[fluid & entry] = CellType.INFLOW
    cells[~solid & (s > stop - 2.5 * h)] = CellType.OUTFLOW
    terrain = Terrain(grid, phi.astype(np.float32), _unit(mainstream), _mesh(grid, phi))
    return Setting(terrain, cells, plan.level, bed)


def _wide_ends(water: np.ndarray, along: np.ndarray, reach, spacing: float) -> tuple[float, float]:
    """Where along the stream its ends are at least 0.4 of its typical width: a slanted or pointed end of the mask must
    not become a nozzle. At most 15 % of the length is given up at each end."""
    length = reach[1] - reach[0]
    bins = max(int(length / spacing), 1)
    width, edges = np.histogram(along[water], bins=bins, range=(reach[0], reach[1]))
    if not width.any():
        return float(reach[0]), float(reach[1])
    wide = np.where(width >= 0.4 * np.median(width[width > 0]))[0]
    start = min(edges[wide[0]], reach[0] + 0.15 * length)
    stop = max(edges[wide[-1] + 1], reach[1] - 0.15 * length)
    return float(start), float(stop)


def _upper_rim(water: np.ndarray, level: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Columns where a curtain begins: wet, dry two cells upstream, and in the upper part of the drop (the back edge of
    a pool is dry upstream as well). A ragged curtain is fed along its whole upper edge, not at its highest point."""
    if not water.any():
        return water
    step = np.round(2.0 * along / np.abs(along).max()).astype(int)
    upstream = ndimage.shift(water.astype(np.uint8), step, order=0, cval=0).astype(bool)
    low, high = level[water].min(), level[water].max()
    return water & ~upstream & (level > low + 0.4 * (high - low))


def airborne_setting(
    front: Float[np.ndarray, "h w"],
    back: Float[np.ndarray, "h w"],
    mask: Bool[np.ndarray, "h w"],
    camera: PinholeCamera,
    body: Float[np.ndarray, "n 3"],
    mainstream: Float[np.ndarray, "3"],
    *,
    kind: Kind,
    longest: int,
    cell_limit: int,
) -> Setting:
    """A jet or a plume: free in the air above a floor; a jet that ends in a wider pool gets a vessel to hold it.

    Args:
        front: camera depth of the near side, m.
        back: of the far side, m.
        mask: fluid pixels of the first instant.
        camera: in the world.
        body: points of the fluid over the whole clip, world (the box must hold all of it).
        mainstream: direction of the bulk flow, world.
        kind: pour or plume.
        longest: cells along the longest side.
        cell_limit: most cells of the grid.
    """
    low, high = np.percentile(body, 0.2, axis=0), np.percentile(body, 99.8, axis=0)
    extent = high - low
    spacing = extent.max() / longest
    for _ in range(80):
        side = (0.35 if kind == "pour" else 0.2) * max(extent[0], extent[1]) + 4 * spacing
        above = (0.1 if kind == "pour" else 0.2) * extent[2] + 3 * spacing
        origin = (low[0] - side, low[1] - side, low[2] - 3 * spacing)
        size = (extent[0] + 2 * side, extent[1] + 2 * side, extent[2] + above + 3 * spacing)
        grid = Grid(tuple(int(np.ceil(v / spacing)) for v in size), spacing, origin)
        if grid.cells <= cell_limit:
            break
        spacing *= 1.05
    h = grid.spacing
    nodes, centers = grid.nodes(), grid.centers()
    phi = nodes[..., 2] - low[2] + 0.5 * h
    vessel = _vessel(body) if kind == "pour" else None
    if vessel is not None:
        (cx, cy), radius, level = vessel
        rim = level + 0.5 * (level - low[2])
        r = np.hypot(nodes[..., 0] - cx, nodes[..., 1] - cy)
        wall = np.maximum(np.abs(r - (radius + 1.5 * h)) - 1.2 * h, nodes[..., 2] - rim)
        phi = np.minimum(phi, wall)
    solid = _at_cells(phi) < 0
    fluid = inside_body(centers.reshape(-1, 3), front, back, mask, camera).reshape(grid.shape) & ~solid
    cells = np.full(grid.shape, CellType.EMPTY, np.uint8)
    cells[solid] = CellType.SOLID
    cells[fluid] = CellType.FLUID
    if fluid.any():
        z = centers[..., 2]
        if kind == "pour":
            cells[fluid & (z > z[fluid].max() - 2.0 * h)] = CellType.INFLOW
        else:
            cells[fluid & (z < z[fluid].min() + 3.0 * h)] = CellType.INFLOW
    border = np.ones(grid.shape, bool)
    border[2:-2, 2:-2, :-2] = False
    if kind == "pour":
        border[:, :, -2:] = False  # what pours leaves sideways over the floor
        border[2:-2, 2:-2] = False
    cells[border & ~solid] = CellType.OUTFLOW
    terrain = Terrain(grid, phi.astype(np.float32), _unit(mainstream), _mesh(grid, phi))
    bed = np.full(grid.shape[:2], low[2] - 0.5 * h)
    return Setting(terrain, cells, None, bed, None if vessel is None else vessel[2])


def inside_body(
    points: Float[np.ndarray, "n 3"], front: np.ndarray, back: np.ndarray, mask: np.ndarray, camera: PinholeCamera
) -> Bool[np.ndarray, "n"]:
    """Which world points lie between the near and the far side of the body seen by the camera."""
    uv, z = camera.project(points)
    height, width = mask.shape
    col, row = np.floor(uv[:, 0]).astype(int), np.floor(uv[:, 1]).astype(int)
    ok = (col >= 0) & (col < width) & (row >= 0) & (row < height) & (z > 0)
    col, row = np.clip(col, 0, width - 1), np.clip(row, 0, height - 1)
    return ok & mask[row, col] & (z >= front[row, col]) & (z <= back[row, col])


def _vessel(body: np.ndarray) -> tuple[tuple[float, float], float, float] | None:
    """Axis, radius and filling height of a container around the lower part of a body, if that is much wider than the
    upper part and holds its width (a pool that a jet falls into)."""
    z = body[:, 2]
    edges = np.linspace(z.min(), z.max(), 13)
    widths = np.zeros(12)
    for i in range(12):
        layer = (z >= edges[i]) & (z <= edges[i + 1])
        if layer.sum() > 5:
            widths[i] = np.ptp(np.percentile(body[layer, 0], [2, 98]))
    widest = np.percentile(widths, 90)
    wide = widths > 0.6 * widest
    first_narrow = int(np.argmin(wide)) if not wide.all() else 12
    if first_narrow < 2 or first_narrow > 10 or np.median(widths[first_narrow:]) > 0.55 * widest:
        return None
    pool = body[z <= edges[first_narrow]]
    centre = 0.5 * (np.percentile(pool[:, :2], 2, axis=0) + np.percentile(pool[:, :2], 98, axis=0))
    return (float(centre[0]), float(centre[1])), 0.5 * float(widest), float(edges[first_narrow])


def signed_distance_from(
    above: Float[np.ndarray, "nx ny nz"], spacing: float, slope: Float[np.ndarray, "nx ny nz"] | float = 1.0
) -> Float[np.ndarray, "nx ny nz"]:
    """Distance (m, positive where `above` > 0) to the zero set of a height above ground.

    Near the surface the height over the slope's length is exact for a plane; away from it the distance transform of
    the sign takes over.
    """
    near = above / slope
    outside = above > 0
    if outside.all() or not outside.any():
        return near
    far = (ndimage.distance_transform_edt(outside) - ndimage.distance_transform_edt(~outside)) * spacing
    far = far - np.sign(far) * 0.5 * spacing
    return np.where(np.abs(far) > 2.0 * spacing, far, near)


def _to_corners(cells: np.ndarray) -> np.ndarray:
    """Column values averaged to the corners between columns."""
    p = np.pad(cells, 1, mode="edge")
    return 0.25 * (p[:-1, :-1] + p[1:, :-1] + p[:-1, 1:] + p[1:, 1:])


def _at_cells(nodes: np.ndarray) -> np.ndarray:
    """Node values averaged to cell centres."""
    a = 0.5 * (nodes[1:] + nodes[:-1])
    a = 0.5 * (a[:, 1:] + a[:, :-1])
    return 0.5 * (a[:, :, 1:] + a[:, :, :-1])


def _unit(direction) -> np.ndarray:
    d = np.asarray(direction, float)
    norm = np.linalg.norm(d)
    return d / norm if norm > 1e-12 else np.array([1.0, 0.0, 0.0])


def _mesh(grid: Grid, phi: np.ndarray) -> TriangleMesh:
    vertices, faces = surface_nets(phi, spacing=grid.spacing, origin=grid.origin)
    return TriangleMesh(vertices, faces)
