"""Extrapolation of the channel: the terrain goes on downstream of the outlet as it is there.

The box grows along the horizontal axis of the grid that is nearest to the mainstream. The last cross-section of the
bed is continued, lowered by the slope of the bed before the outlet, as a prismatic channel in uniform flow (bed, water
surface and energy line parallel). What is further down in reality is not in the clip: this is the simplest continuation
that neither holds the water up nor lets it fall.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from fluidlift.errors import InputRejected, require
from fluidlift.numerics.ground_block import ground_mesh
from fluidlift.numerics.sampling import sample_faces, sample_nodes
from fluidlift.types import CellType, FaceVelocity, Grid, Particles, Terrain, TriangleMesh, triple

STEEPEST = 0.5
"""m of drop per metre that is continued; steeper ends are falls, whose next metres nobody knows"""

OUTLET_CELLS = 3
"""layers of OUTFLOW cells at the new end"""


@dataclass(frozen=True)
class Outlet:
    """Where a channel leaves its box, and how steeply."""

    grid: Grid
    axis: int
    """0 or 1: across the outlet"""
    sign: int
    """+1: at the high end of the axis, -1: at the low end"""
    slope: float
    """m of drop per metre, 0 or more"""

    @property
    def end(self) -> float:
        """m along the axis: the side of the box that the water leaves through."""
        return float((self.grid.high if self.sign > 0 else self.grid.low)[self.axis])

    def beyond(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """m that points lie downstream of the end; negative before it."""
        return self.sign * (np.asarray(points, np.float64)[:, self.axis] - self.end)

    def image(self, points: Float[np.ndarray, "n 3"], reach: float, start: float = 0.0) -> Float[np.ndarray, "n 3"]:
        """The place before `start` (m downstream of the end, mostly negative) that each point after it repeats.

        The last `reach` metres are mirrored to and fro, so that what is repeated has no seam; heights follow the slope.
        """
        out = np.array(points, np.float64)
        past = self.beyond(out) - start
        turn = np.mod(past, 2.0 * reach)
        back = past + np.where(turn < reach, turn, 2.0 * reach - turn)  # metres upstream to its image
        move = past > 0
        out[move, self.axis] -= self.sign * back[move]
        out[move, 2] += self.slope * back[move]
        return out


def find_outlet(terrain: Terrain, cell_types: np.ndarray) -> Outlet:
    """The outlet of a channel.

    Raises:
        InputRejected: no mainstream along the ground, or no OUTFLOW cells at that end of the box.
    """
    grid, along = terrain.grid, np.asarray(terrain.mainstream, np.float64)
    axis = int(np.abs(along[:2]).argmax())
    if abs(along[axis]) < 1e-3:
        raise InputRejected("a mainstream that runs straight up or down", "a stream or a fall", "do not extend it")
    sign = 1 if along[axis] > 0 else -1
    last = np.take(cell_types, -1 if sign > 0 else 0, axis=axis)
    if not (last == CellType.OUTFLOW).any():
        raise InputRejected(
            f"no outlet at the {'high' if sign > 0 else 'low'} end of the {'xy'[axis]} axis, where the stream leaves",
            "OUTFLOW cells there", "only a stream or a fall that leaves its box can be extended",
        )  # fmt: skip
    return Outlet(grid, axis, sign, _bed_slope(terrain, axis, sign))


def _bed_slope(terrain: Terrain, axis: int, sign: int) -> float:
    """Drop per metre of the lowest ground of each layer before the outlet: median over pairs (Theil 1950, Sen 1968),
    which a rock does not move. The third of rows with the lowest bed counts: banks run otherwise."""
    height = _ground_height(terrain)
    height = height if axis == 0 else height.T
    height = height[::sign][-min(len(height), max(10, len(height) // 4)) :]
    lowest = np.argsort(height.mean(axis=0), kind="stable")[: max(1, height.shape[1] // 3)]
    bed = height[:, lowest].mean(axis=1)
    i, j = np.triu_indices(len(bed), 1)
    drop = -np.median((bed[j] - bed[i]) / ((j - i) * terrain.grid.spacing))
    return float(np.clip(drop, 0.0, STEEPEST))


def _ground_height(terrain: Terrain) -> Float[np.ndarray, "nx+1 ny+1"]:
    """z of the ground over each node column, m: the highest change from solid to open; the floor of the box without."""
    phi, h = terrain.signed_distance.astype(np.float64), terrain.grid.spacing
    rises = (phi[..., :-1] <= 0) & (phi[..., 1:] > 0)
    top = rises.shape[2] - 1 - np.argmax(rises[..., ::-1], axis=2)
    below, above = (np.take_along_axis(phi, (top + s)[..., None], axis=2)[..., 0] for s in (0, 1))
    share = np.divide(-below, above - below, out=np.zeros_like(below), where=above > below)
    z = terrain.grid.origin[2] + (top + share) * h
    return np.where(rises.any(axis=2), z, terrain.grid.origin[2])


def extended_grid(outlet: Outlet, length: float) -> Grid:
    """The box with at least `length` metres more downstream, and deeper by the drop of the bed over them."""
    require(np.isfinite(length) and length > 0, f"length {length}", "positive metres")
    grid, h = outlet.grid, outlet.grid.spacing
    more, deeper = math.ceil(length / h - 1e-9), math.ceil(outlet.slope * length / h - 1e-9)
    shape, origin = list(grid.shape), list(grid.origin)
    shape[outlet.axis] += more
    shape[2] += deeper
    origin[outlet.axis] -= h * more * (outlet.sign < 0)
    origin[2] -= h * deeper
    return Grid(triple(shape), h, triple(origin))


def extended_downstream(terrain: Terrain, cell_types: np.ndarray, length: float) -> tuple[Terrain, np.ndarray]:
    """The same channel, longer.

    Cells before the old outlet keep their type; those of the outlet and beyond are FLUID up to the level of the last
    water before it, continued with the slope; the last three layers are OUTFLOW.

    Args:
        terrain: of the channel.
        cell_types: u8 [nx,ny,nz] on its grid.
        length: m to add.

    Returns:
        The terrain (its mesh made anew, with the colours of the place that is repeated) and its cell types.

    Raises:
        InputRejected: there is no outlet to extend.
        ValueError: a length that is not positive.
    """
    outlet = find_outlet(terrain, cell_types)
    grid = extended_grid(outlet, length)
    distance = _extended_distance(terrain, outlet, grid)
    mesh = _extended_mesh(terrain, outlet, grid, distance)
    longer = Terrain(grid, distance.astype(np.float32), terrain.mainstream, mesh)
    return longer, _extended_cells(cell_types, outlet, longer)


def _extended_distance(terrain: Terrain, outlet: Outlet, grid: Grid) -> np.ndarray:
    """Signed distance at the new nodes: that of the end's cross-section, at the height it had there."""
    nodes = grid.nodes().reshape(-1, 3)
    past = np.maximum(outlet.beyond(nodes), 0.0)
    nodes[:, outlet.axis] -= outlet.sign * past
    nodes[:, 2] += outlet.slope * past
    distance = sample_nodes(terrain.signed_distance.astype(np.float64), terrain.grid, nodes)
    # under the old box the ground goes on where it was ground; over it the air does
    below = np.maximum(terrain.grid.low[2] - nodes[:, 2], 0.0)
    above = np.maximum(nodes[:, 2] - terrain.grid.high[2], 0.0)
    distance = np.where(distance < 0, distance - below, distance + above)
    return distance.reshape(tuple(n + 1 for n in grid.shape))


def _extended_mesh(terrain: Terrain, outlet: Outlet, grid: Grid, distance: np.ndarray) -> TriangleMesh:
    """The block of the longer ground, in the colours of the place that is repeated.

    It is as high as the solid, but not higher than the old mesh: the wall that closes the channel behind its inlet is
    solid, and not shown.
    """
    longer = Terrain(grid, distance.astype(np.float32), terrain.mainstream, terrain.mesh)
    old, heights = terrain.mesh, _ground_height(longer)
    if len(old.vertices):
        heights = np.minimum(heights, _shown_height(old, outlet, grid))
    block = ground_mesh(grid, heights)
    if old.colors is None or not len(old.vertices):
        return block
    side = terrain.grid.shape[outlet.axis] * terrain.grid.spacing
    nearest = cKDTree(old.vertices).query(outlet.image(block.vertices, 0.5 * side))[1]
    return TriangleMesh(block.vertices, block.faces, old.colors[nearest])


def _shown_height(mesh: TriangleMesh, outlet: Outlet, grid: Grid) -> Float[np.ndarray, "nx+1 ny+1"]:
    """z of the top of the old mesh over each node column, and of its end beyond, lowered with the slope; m."""
    top = mesh.vertices[np.argsort(-mesh.vertices[:, 2], kind="stable")].astype(np.float64)
    columns = np.round((top[:, :2] - outlet.grid.low[:2]) / grid.spacing).astype(np.int64)
    highest = top[np.unique(columns, axis=0, return_index=True)[1]]
    nodes = grid.nodes()[:, :, 0].reshape(-1, 3)
    past = np.maximum(outlet.beyond(nodes), 0.0)
    nodes[:, outlet.axis] -= outlet.sign * past
    nearest = cKDTree(highest[:, :2]).query(nodes[:, :2])[1]
    return (highest[nearest, 2] - outlet.slope * past).reshape(grid.shape[0] + 1, grid.shape[1] + 1)


def _embedded(cells: np.ndarray, outlet: Outlet, grid: Grid) -> tuple[np.ndarray, tuple[slice, ...]]:
    """EMPTY cells of the new grid with the old ones at their place, and where that is."""
    first = np.round((outlet.grid.low - grid.low) / grid.spacing).astype(int)
    place = tuple(slice(a, a + n) for a, n in zip(first, outlet.grid.shape))
    out = np.full(grid.shape, CellType.EMPTY, np.uint8)
    out[place] = cells
    return out, place


def _extended_cells(cell_types: np.ndarray, outlet: Outlet, longer: Terrain) -> np.ndarray:
    grid = longer.grid
    out, _ = _embedded(cell_types, outlet, grid)
    centers = grid.centers()
    solid = sample_nodes(longer.signed_distance, grid, centers.reshape(-1, 3)).reshape(grid.shape) < 0
    old = out.copy()
    new = np.broadcast_to(outlet.beyond(centers.reshape(-1, 3)).reshape(grid.shape) > 0, grid.shape)
    wet = centers[..., 2] < _levels(old, outlet, grid)
    changed = new | (old == CellType.OUTFLOW)
    out[changed] = np.where(wet, CellType.FLUID, CellType.EMPTY)[changed]
    out[solid & (changed | (old == CellType.EMPTY))] = CellType.SOLID
    end = np.moveaxis(out, outlet.axis, 0)[:: outlet.sign]
    closed = np.moveaxis(solid, outlet.axis, 0)[:: outlet.sign]
    end[-OUTLET_CELLS:][~closed[-OUTLET_CELLS:]] = CellType.OUTFLOW
    return out


def _levels(cells: np.ndarray, outlet: Outlet, grid: Grid) -> np.ndarray:
    """z of the water over each column, m: of the last FLUID column before the outlet in its row, and from there down
    with the slope; -inf in rows without water."""
    fluid = np.moveaxis(cells == CellType.FLUID, outlet.axis, 0)[:: outlet.sign]
    columns = fluid.any(axis=2)
    last = len(columns) - 1 - np.argmax(columns[::-1], axis=0)
    rows = np.arange(columns.shape[1])
    top = fluid.shape[2] - np.argmax(fluid[last, rows][:, ::-1], axis=1)
    level = np.where(columns.any(axis=0), grid.origin[2] + top * grid.spacing, -np.inf)
    downstream = (np.arange(len(columns))[:, None] - last) * grid.spacing
    out = (level - outlet.slope * downstream)[:: outlet.sign, :, None]
    return np.moveaxis(out, 0, outlet.axis)


def extended_velocity(velocity: FaceVelocity, outlet: Outlet, grid: Grid) -> FaceVelocity:
    """A velocity on the longer grid: that of the nearest face of the old one (m/s)."""
    out = []
    for axis in range(3):
        points = grid.faces(axis)
        values = sample_faces(velocity, outlet.grid, outlet.image(points.reshape(-1, 3), _reach(outlet)))
        out.append(values[:, axis].reshape(points.shape[:3]).astype(np.float32))
    return FaceVelocity(*out)


def _reach(outlet: Outlet) -> float:
    """m before the end that are repeated after it."""
    return 0.5 * outlet.grid.shape[outlet.axis] * outlet.grid.spacing


def extended_body(
    particles: Particles,
    velocity: FaceVelocity,
    channel: tuple[Terrain, np.ndarray],
    longer: tuple[Terrain, np.ndarray],
    *,
    seed: int = 0,
) -> Particles:
    """The particles, and more of them that fill the water of the added part.

    The new ones stand on a jittered lattice, move as the place that they repeat, and look like the particle nearest to
    it. They are at least as dense as the old ones, of which a cell may hold any number.

    Args:
        particles: of the body before.
        velocity: of that body, on the old grid.
        channel: terrain and cell types before.
        longer: those of `extended_downstream`.
        seed: of the jitter.
    """
    if not len(particles):
        return particles
    outlet = find_outlet(*channel)
    terrain, cells = longer
    grid = terrain.grid
    index = np.clip(grid.cell_of(particles.positions), 0, np.asarray(grid.shape) - 1)
    count = np.bincount(np.ravel_multi_index(tuple(index.T), grid.shape), minlength=grid.cells).reshape(grid.shape)
    per_side = max(2, math.ceil(np.cbrt(np.median(count[count > 0])) - 1e-9))
    before, _ = _embedded(channel[1], outlet, grid)
    under_water = grid.centers()[..., 2] < _levels(cells, outlet, grid)
    wet = (cells == CellType.FLUID) | ((cells == CellType.OUTFLOW) & under_water)
    places = _lattice(wet & (count == 0) & (before != CellType.FLUID), grid, per_side, np.random.default_rng(seed))
    places = places[sample_nodes(terrain.signed_distance, grid, places) > 0.25 * grid.spacing / per_side]
    if not len(places):
        return particles
    # what is repeated lies before the last cross-section that the body fills
    end = min(float(np.percentile(outlet.beyond(particles.positions), 99)), 0.0)
    image = outlet.image(places, _reach(outlet), end)
    source = particles.source[cKDTree(particles.positions).query(image)[1]]
    first = int(particles.ids.max()) + 1
    added = Particles.at_rest(
        places, float(np.median(particles.masses)), source, sample_faces(velocity, outlet.grid, image), first_id=first
    )
    return particles.joined(added)


def _lattice(cells: np.ndarray, grid: Grid, per_side: int, rng: np.random.Generator) -> Float[np.ndarray, "n 3"]:
    step = (np.arange(per_side) + 0.5) / per_side
    offsets = np.stack(np.meshgrid(step, step, step, indexing="ij"), axis=-1).reshape(-1, 3)
    places = (np.argwhere(cells)[:, None] + offsets[None]).reshape(-1, 3)
    places = places + rng.uniform(-0.25, 0.25, places.shape) / per_side
    return (grid.low + places * grid.spacing).astype(np.float32)
