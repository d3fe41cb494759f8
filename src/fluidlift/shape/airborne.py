"""The place of a body that moves through the air: a jet above its pool, a plume above a floor."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.errors import require
from fluidlift.shape.filled_vessel import FilledVessel
from fluidlift.shape.heap import THICKEST, Heap
from fluidlift.shape.jet_column import Jet
from fluidlift.shape.kinds import AirborneBuilder, builder_of
from fluidlift.shape.terrain import at_cells, terrain_mesh, unit
from fluidlift.types import CellType, Coat, FluidKind, Grid, PinholeCamera, Setting, Terrain, kind_of

PASSING = 0.25
"""speed along the stream at one of its ends over that of its swift part (90th percentile), above which fluid enters or
leaves there. On the cases at hand dead ends have 0.1 to 0.2 of it, live ones 0.4 and more"""
WALL = 2.4
"""cells that the wall of a vessel is thick: one leaves no gap for steps from cell to cell, the rest is for a distance
that is of the first order (a choice)"""
FILM = 2.0
"""cells of liquid on what a heap covers: one is no layer that can flow"""
NOZZLE, NARROWEST = 0.25, 1.2
"""radius of what a fountain rises out of over that of what it lands in, and in cells: what rises takes a sixteenth of
the section that what falls has (a choice, real nozzles are thinner than any cell); a cell alone lets nothing through"""
MOUTH = 2.0
"""cells over the surface that are its mouth: of one alone particles leave gaps"""
AT_THE_END = 0.25
"""share of the length of the lying part within which a jet stands at its upstream end: what moves there spreads from
it"""


def airborne_setting(
    front: Float[np.ndarray, "h w"],
    back: Float[np.ndarray, "h w"],
    mask: Bool[np.ndarray, "h w"],
    camera: PinholeCamera,
    body: Float[np.ndarray, "n 3"],
    mainstream: Float[np.ndarray, "3"],
    *,
    kind: str | FluidKind,
    longest: int,
    cell_limit: int,
    vessel: FilledVessel | None = None,
    heap: Heap | None = None,
) -> Setting:
    """A jet or a plume: free in the air above a floor, and the vessel in which its lower part stands, or what it coats.

    Args:
        front: camera depth of the near side, m.
        back: of the far side, m.
        mask: fluid pixels of the first instant.
        camera: in the world.
        body: points of the fluid over the whole clip, world (the box must hold all of it).
        mainstream: direction of the bulk flow, world.
        kind: of the fluid, which is in the air.
        longest: cells along the longest side.
        cell_limit: most cells of the grid.
        vessel: in the world, m; it stands on the floor.
        heap: in the world, m; what it covers stands on the floor.

    Raises:
        ValueError: a kind that is not in the air.
    """
    require(kind_of(kind).airborne, f"the kind '{kind}'", "a fluid in the air")
    builder = cast(AirborneBuilder, builder_of(kind))
    low, high = np.percentile(body, 0.2, axis=0), np.percentile(body, 99.8, axis=0)
    if vessel is not None:  # what is seen lowest is its near side
        low[2] = vessel.floor
        if vessel.mouth is not None:
            around = vessel.mouth.radius * np.array([1.0, 1.0, 0.0])
            low, high = np.minimum(low, vessel.mouth.center - around), np.maximum(high, vessel.mouth.center + around)
    extent = high - low
    spacing = extent.max() / longest
    for _ in range(80):
        side = builder.side * max(extent[0], extent[1]) + 4 * spacing
        above = builder.above * extent[2] + 3 * spacing
        origin = (low[0] - side, low[1] - side, low[2] - 3 * spacing)
        size = (extent[0] + 2 * side, extent[1] + 2 * side, extent[2] + above + 3 * spacing)
        nx, ny, nz = (int(np.ceil(v / spacing)) for v in size)
        grid = Grid((nx, ny, nz), spacing, origin)
        if grid.cells <= cell_limit:
            break
        spacing *= 1.05
    h = grid.spacing
    nodes, centers = grid.nodes(), grid.centers()
    floor = low[2] if vessel is not None else low[2] - 0.5 * h
    phi = nodes[..., 2] - floor
    coat, body_cells = None, inside_body(centers.reshape(-1, 3), front, back, mask, camera).reshape(grid.shape)
    if vessel is not None:
        phi = np.minimum(phi, vessel.wall(nodes, WALL * h))
        body_cells |= vessel.holds(centers)
    if heap is not None:
        phi = np.minimum(phi, heap.core(nodes, FILM * h))
        coat = Coat(float(heap.heights[-1]), float(heap.radii[0]), min(FILM * h, THICKEST * float(heap.radii[0])))
    solid = at_cells(phi) < 0
    fluid = body_cells & ~solid
    cells = np.full(grid.shape, CellType.EMPTY, np.uint8)
    cells[solid] = CellType.SOLID
    cells[fluid] = CellType.FLUID
    if fluid.any():
        cells[builder.inlet(fluid, centers[..., 2], h) & ~solid] = CellType.INFLOW
    cells[builder.outlet(grid.shape) & ~solid] = CellType.OUTFLOW
    opaque = coat is not None or (vessel is not None and vessel.looked_into)
    terrain = Terrain(grid, phi.astype(np.float32), unit(mainstream), terrain_mesh(grid, phi), opaque)
    bed = np.full(grid.shape[:2], floor)
    level, mouth = (None, None) if vessel is None else (vessel.level, vessel.mouth)
    return Setting(terrain, cells, None, bed, level, mouth, coat)


def inside_body(
    points: Float[np.ndarray, "n 3"], front: np.ndarray, back: np.ndarray, mask: np.ndarray, camera: PinholeCamera
) -> Bool[np.ndarray, " n"]:
    """Which world points lie between the near and the far side of the body seen by the camera."""
    uv, z = camera.project(points)
    height, width = mask.shape
    col, row = np.floor(uv[:, 0]).astype(int), np.floor(uv[:, 1]).astype(int)
    ok = (col >= 0) & (col < width) & (row >= 0) & (row < height) & (z > 0)
    col, row = np.clip(col, 0, width - 1), np.clip(row, 0, height - 1)
    return ok & mask[row, col] & (z >= front[row, col]) & (z <= back[row, col])


def with_jets(
    setting: Setting,
    jets: list[Jet],
    points: Float[np.ndarray, "n 3"],
    velocities: Float[np.ndarray, "n 3"],
    camera: PinholeCamera,
) -> Setting:
    """A lying fluid with jets above it: cells for them, and the inlet at their tops.

    The upstream end of the lying part stays an inlet where the picture's edge cuts it, or where fluid moves in
    (`PASSING`) and no jet stands there; else it is a dead end that the jets feed. What is fed by jets alone and hardly
    moves at its downstream end is a puddle, and closed.

    Args:
        setting: of the lying part.
        jets: world, m.
        points: of the lying part's visible surface, world, m.
        velocities: there, m/s.
        camera: in the world.
    """
    grid = setting.terrain.grid
    h = grid.spacing
    jets = [j for j in jets if (j.radius.max() > 0.5 * h) & grid.contains(np.array([[*j.axis, grid.low[2] + h]]))[0]]
    if not jets:
        return setting
    top = max(j.top for j in jets)
    # a jet that would make the box taller than it is long is cut
    extra = int(np.clip(np.ceil((top - grid.high[2]) / h) + 3, 0, max(max(grid.shape) - grid.shape[2], grid.shape[2])))
    taller = Grid((grid.shape[0], grid.shape[1], grid.shape[2] + extra), h, grid.origin)
    above = setting.terrain.signed_distance[..., -1:] + h * np.arange(1, extra + 1, dtype=np.float32)
    phi = np.concatenate([setting.terrain.signed_distance, above], axis=2).astype(np.float32)
    lid = np.where(setting.cell_types[..., -1:] == CellType.OUTFLOW, CellType.OUTFLOW, CellType.EMPTY)
    cells = np.concatenate([setting.cell_types, np.repeat(lid, extra, axis=2)], axis=2).astype(np.uint8)
    centers = taller.centers()
    below = centers[..., 2] < np.asarray(setting.surface_height)[..., None]
    rising = any(jet.nozzle is not None for jet in jets)
    for kind in () if rising else (CellType.INFLOW, CellType.OUTFLOW):
        if _is_open(setting, kind, jets, (points, velocities), camera):
            break
        cells = np.where(cells == kind, np.where(below, CellType.FLUID, CellType.EMPTY), cells).astype(np.uint8)
    for jet in jets:
        inside = jet.contains(centers, least=0.75 * h) & np.isin(cells, (CellType.EMPTY, CellType.FLUID))
        if not inside.any():
            continue
        end = centers[inside][:, 2].max()
        cells[inside] = CellType.FLUID
        if jet.nozzle is None:
            cells[inside & (centers[..., 2] > end - 2.5 * h)] = CellType.INFLOW
        else:
            level = np.asarray(setting.surface_height)
            aside = np.hypot(*(centers[..., a] - jet.nozzle[a] for a in (0, 1)))
            above = centers[..., 2] - level[..., None]
            pipe = _pipe(jet, taller, level)
            phi = np.minimum(phi, pipe).astype(np.float32)
            cells[at_cells(pipe) < 0] = CellType.SOLID
            mouth = (aside <= nozzle_radius(jet, h)) & (above > 0) & (above < MOUTH * h)
            cells[mouth & (cells != CellType.SOLID)] = CellType.INFLOW
    solid = setting.terrain
    terrain = replace(solid, grid=taller, signed_distance=phi)
    return replace(setting, terrain=terrain, cell_types=cells)


def nozzle_radius(jet: Jet, h: float) -> float:
    """Radius (m) of what a jet rises out of, on cells h wide."""
    return max(NOZZLE * float(jet.radius.max()), NARROWEST * h)


def _pipe(jet: Jet, grid: Grid, level: np.ndarray) -> Float[np.ndarray, "nx+1 ny+1 nz+1"]:
    """Signed distance (m, on the nodes) to the pipe that a jet comes out of, up to the surface of its pool (m, per
    column): through an open foot it would draw up the pool itself."""
    assert jet.nozzle is not None
    nodes = grid.nodes()
    aside = np.hypot(nodes[..., 0] - jet.nozzle[0], nodes[..., 1] - jet.nozzle[1])
    column = np.clip(grid.cell_of(np.array([[*jet.nozzle, grid.low[2]]]))[0, :2], 0, np.array(grid.shape[:2]) - 1)
    return np.maximum(aside - nozzle_radius(jet, grid.spacing), nodes[..., 2] - float(level[tuple(column)]))


def _is_open(setting: Setting, kind: CellType, jets: list[Jet], seen, camera: PinholeCamera) -> bool:
    """Whether fluid passes through the end of a lying fluid: it is cut by the picture's edge, or moves there."""
    grid = setting.terrain.grid
    z = grid.centers()[..., 2]
    low = (setting.cell_types == kind) & (z < np.asarray(setting.surface_height)[..., None])
    columns = low.any(axis=2)
    if not columns.any():
        return False
    place = np.concatenate([grid.centers()[:, :, 0, :2], np.asarray(setting.surface_height)[..., None]], axis=-1)[
        columns
    ]
    uv, _ = camera.project(place)
    size = np.array(camera.size)
    margin = 0.01 * size
    if kind == CellType.INFLOW and ((uv < margin) | (uv > size - margin)).any(axis=1).mean() > 0.3:
        return True
    points, velocities = seen
    flow = unit(setting.terrain.mainstream[:2]) if np.any(setting.terrain.mainstream[:2]) else np.array([1.0, 0.0])
    s = points[:, :2] @ flow
    first = min(float(np.asarray(j.axis) @ flow) for j in jets)
    if kind == CellType.INFLOW and first < s.min() + AT_THE_END * np.ptp(s):
        return False
    known = np.isfinite(velocities).all(axis=1)
    along = velocities[known] @ setting.terrain.mainstream
    gap = np.linalg.norm(points[known][:, None, :2] - place[None, :: max(len(place) // 60, 1), :2], axis=-1).min(axis=1)
    near = gap < 3.0 * grid.spacing
    return not near.any() or float(np.median(along[near])) > PASSING * float(np.percentile(along, 90))
