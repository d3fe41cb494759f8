"""What edits of the terrain make of it: solid, cells, water and its Gaussians in their new places."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from fluidlift.errors import InputRejected
from fluidlift.numerics.mesh_distance import mesh_distance
from fluidlift.numerics.sampling import gradient_nodes, sample_faces, sample_nodes
from fluidlift.physics.terrain_edit import Move, Place, Replace, TerrainEdit, gradient_of, place_of, solid_ground
from fluidlift.types import (
    CellType,
    FaceVelocity,
    Gaussians,
    Grid,
    Particles,
    Terrain,
    TriangleMesh,
    decompose_covariances,
    triple,
)

NEAR = 1.0
"""longest sides of the box that it grows by, at most, to hold a new solid"""
MOST_NODES = 8_000_000
"""of the signed distance of a new solid"""

_THROUGH = (CellType.INFLOW, CellType.OUTFLOW)


@dataclass(frozen=True)
class Reshaped:
    """A terrain after its edits."""

    terrain: Terrain
    cell_types: np.ndarray
    """u8 [nx,ny,nz] on its grid"""
    place: Place
    replaced: bool
    """whether another solid stands where the old one was"""


def reshaped(
    terrain: Terrain,
    cell_types: np.ndarray,
    edits: Sequence[TerrainEdit],
    *,
    check: Callable[[Grid], None] = lambda grid: None,
) -> Reshaped:
    """A terrain and its cells after edits, in order.

    The box grows to hold all of the old one, and of a new solid up to its own length more on each side. Beside the old
    box is air: water that comes over the edge of the ground falls and leaves. Inlet and outlet go where their places go
    and stay open there; cells that are now in the solid are SOLID, those that have come out of it EMPTY.

    Args:
        terrain: as it was lifted, or extended.
        cell_types: u8 [nx,ny,nz] on its grid.
        edits: what to do.
        check: told the new grid before arrays of its size are made; may raise.

    Raises:
        InputRejected: a mesh that bounds no solid, or edits after which nothing flows in where something did.
    """
    place = place_of(terrain, cell_types, edits)
    solid, line = _new_solid(terrain, cell_types, edits)
    if solid is None and all(isinstance(e, Move) for e in edits):
        grid = Grid(terrain.grid.shape, terrain.grid.spacing, tuple(place.points(terrain.grid.low[None])[0]))
        mesh = replace(terrain.mesh, vertices=place.points(terrain.mesh.vertices))
        return Reshaped(replace(terrain, grid=grid, mesh=mesh), cell_types, place, False)
    grid = _grown(terrain.grid, place, solid)
    check(grid)
    distance = _resampled(terrain, cell_types, grid, place) if solid is None else _distance_of(solid, grid)
    mesh = (
        replace(terrain.mesh, vertices=place.points(terrain.mesh.vertices))
        if solid is None
        else _coloured(solid, terrain)
    )
    new = replace(terrain, grid=grid, signed_distance=distance, mainstream=place.mainstream, mesh=mesh)
    cells = _moved_cells(terrain.grid, cell_types, new, place)
    outside = ~terrain.grid.contains(place.origin(grid.centers().reshape(-1, 3))).reshape(grid.shape)
    cells = _with_drains(cells, outside | (solid is not None))
    if (cell_types == CellType.INFLOW).any() and not (cells == CellType.INFLOW).any():
        line = line or next((e.line for e in edits if e.line), "")
        raise InputRejected(
            f"{line + ': ' if line else ''}after the edit of the terrain nothing flows in: all of the inlet lies "
            "inside the ground", "an inlet with open cells", "lower the terrain where the stream comes in",
        )  # fmt: skip
    return Reshaped(new, cells, place, solid is not None)


def _new_solid(
    terrain: Terrain, cell_types: np.ndarray, edits: Sequence[TerrainEdit]
) -> tuple[TriangleMesh | None, str]:
    """The mesh of the last `Replace`, moved by the edits after it, and the line that it stands on."""
    found = [(i, e) for i, e in enumerate(edits) if isinstance(e, Replace)]
    if not found:
        return None, ""
    at, edit = found[-1]
    try:
        mesh, _ = solid_ground(edit.mesh)
    except InputRejected as error:
        raise InputRejected(f"{edit.line}: {error.got}", error.needed, error.do) from None
    before = place_of(terrain, cell_types, edits[:at])
    whole = place_of(terrain, cell_types, edits)
    after = Place(whole.forth[len(before.forth) :], whole.back[len(before.back) :])
    return replace(mesh, vertices=after.points(mesh.vertices)), edit.line


def _grown(grid: Grid, place: Place, solid: TriangleMesh | None) -> Grid:
    """The box around the places of the old one, and of a new solid as far as it is near, on the old lattice."""
    sides = [np.linspace(a, b, 17) for a, b in zip(grid.low, grid.high)]
    corners = place.points(np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3))
    low, high = corners.min(axis=0), corners.max(axis=0)
    if solid is not None:
        reach = NEAR * float((high - low).max())
        low = np.minimum(low, np.maximum(solid.vertices.min(axis=0), low - reach))
        high = np.maximum(high, np.minimum(solid.vertices.max(axis=0), high + reach))
    return box_around(grid, low, high)


def box_around(grid: Grid, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]) -> Grid:
    """The smallest grid on the same lattice that holds a box (m)."""
    h = grid.spacing
    first = np.floor((low - grid.low) / h + 1e-6).astype(int)
    last = np.maximum(np.ceil((high - grid.low) / h - 1e-6).astype(int), first + 1)
    return Grid(triple(int(n) for n in last - first), h, triple(float(x) for x in grid.low + first * h))


def _resampled(terrain: Terrain, cell_types: np.ndarray, grid: Grid, place: Place) -> np.ndarray:
    """Signed distance on the new grid. Where the edits stretch, what was a distance before is divided by how far a step
    across the surface has grown: exact beside the surface, to first order away from it."""
    nodes = grid.nodes().reshape(-1, 3)
    before = place.origin(nodes)
    values = sample_nodes(terrain.signed_distance, terrain.grid, before)
    slope = gradient_nodes(terrain.signed_distance, terrain.grid, before)
    length = np.linalg.norm(slope, axis=1, keepdims=True)
    normal = slope / np.maximum(length, 1e-9)
    grown = np.linalg.norm(np.einsum("nij,ni->nj", gradient_of(place.origin, nodes), normal), axis=1)
    values = values / np.where(length[:, 0] > 0.1, np.maximum(grown, 1e-3), 1.0)
    values = _around_the_block(values, before, terrain.grid, cell_types)
    return values.reshape(tuple(n + 1 for n in grid.shape)).astype(np.float32)


def _around_the_block(values: np.ndarray, before: np.ndarray, old: Grid, cell_types: np.ndarray) -> np.ndarray:
    """Signed distances of places (m before the edits) with those outside the old box as what a person sees there.

    Beside the block of ground is air, and water that comes over its edge falls. Where water stood against a side of the
    box, the wall that held it stays. Below, the block goes on; above there is air as at its top.
    """
    within = np.clip(before, old.low, old.high)
    beside = np.linalg.norm((before - within)[:, :2], axis=1)
    below = old.low[2] - before[:, 2]
    i, j, _ = np.clip(old.cell_of(within), 0, np.asarray(old.shape) - 1).T
    held = (cell_types == CellType.FLUID).any(axis=2) & ~np.isin(cell_types, _THROUGH).any(axis=2)
    out = np.where((below > 0) & (values > 0), -below, values)
    return np.where(beside > 1e-9, np.where(held[i, j], -beside, np.maximum(values, beside)), out)


def _distance_of(solid: TriangleMesh, grid: Grid) -> np.ndarray:
    """Signed distance of a mesh on the nodes of a grid; its spacing only as fine as memory allows."""
    extent = np.ptp(np.asarray(solid.vertices, np.float64), axis=0) + 6 * grid.spacing
    spacing = max(grid.spacing, float(np.prod(extent) / MOST_NODES) ** (1 / 3))
    found = mesh_distance(solid, spacing)
    nodes = grid.nodes().reshape(-1, 3)
    values = sample_nodes(found.distance, found.grid, nodes)
    out = ~found.grid.contains(nodes)
    away = np.linalg.norm(nodes - np.clip(nodes, found.grid.low, found.grid.high), axis=1)
    values = np.where(out, np.maximum(values, 0.0) + away, values)
    return values.reshape(tuple(n + 1 for n in grid.shape)).astype(np.float32)


def _coloured(solid: TriangleMesh, terrain: Terrain) -> TriangleMesh:
    """A solid without colours takes those of the old ground below or above it."""
    old = terrain.mesh
    if solid.colors is not None or solid.texture is not None or old.colors is None or not len(old.vertices):
        return solid
    nearest = cKDTree(np.asarray(old.vertices)[:, :2]).query(np.asarray(solid.vertices)[:, :2])[1]
    return replace(solid, colors=np.asarray(old.colors)[nearest])


def _moved_cells(old: Grid, cell_types: np.ndarray, terrain: Terrain, place: Place) -> np.ndarray:
    grid = terrain.grid
    centers = grid.centers().reshape(-1, 3)
    before = place.origin(centers)
    index = np.clip(old.cell_of(before), 0, np.asarray(old.shape) - 1)
    cells = np.where(old.contains(before), cell_types[tuple(index.T)], np.uint8(CellType.EMPTY))
    cells = np.where(cells == CellType.SOLID, np.uint8(CellType.EMPTY), cells)
    solid = sample_nodes(terrain.signed_distance, grid, centers) < 0
    # an inlet keeps the cells that the bed cuts: what is open of them lets water in
    through = np.isin(cells, _THROUGH)
    buried = sample_nodes(terrain.signed_distance, grid, centers) < -0.87 * grid.spacing
    cells = np.where(buried | (solid & ~through), np.uint8(CellType.SOLID), cells)
    return cells.reshape(grid.shape).astype(np.uint8)


def _with_drains(cells: np.ndarray, outside: np.ndarray) -> np.ndarray:
    """What has fallen beside the ground leaves at the sides and the bottom of the box, where no water stands at rest.

    Args:
        cells: u8 [nx,ny,nz].
        outside: bool [nx,ny,nz], cells that do not belong to the old box.
    """
    rim = np.ones(cells.shape, bool)
    rim[1:-1, 1:-1, 1:] = False
    dry = ~(cells == CellType.FLUID).any(axis=2, keepdims=True)
    return np.where(rim & outside & dry & (cells == CellType.EMPTY), np.uint8(CellType.OUTFLOW), cells)


def reshaped_velocity(velocity: FaceVelocity, old: Grid, new: Reshaped) -> FaceVelocity:
    """The velocity (m/s) where its places are now, turned with them."""
    grid, out = new.terrain.grid, []
    if velocity.shape == grid.shape and not _moves_unevenly(new, old):
        return velocity
    for axis in range(3):
        faces = grid.faces(axis)
        before = new.place.origin(faces.reshape(-1, 3))
        turned = new.place.directions(before, sample_faces(velocity, old, before))[:, axis]
        out.append(turned.reshape(faces.shape[:3]).astype(np.float32))
    return FaceVelocity(*out)


def _moves_unevenly(new: Reshaped, old: Grid) -> bool:
    """Whether anything but a shift of the whole box happened."""
    corners = np.array([old.low, old.high, [*old.low[:2], old.high[2]]])
    shifted = new.place.points(corners) - corners
    return bool(np.ptp(shifted, axis=0).max() > 1e-9) or not np.allclose(shifted[0], new.terrain.grid.low - old.low)


def reshaped_body(particles: Particles, new: Reshaped) -> Particles:
    """The particles where their places are now; those that another solid has swallowed are gone.

    Raises:
        InputRejected: none is left.
    """
    if not len(particles):
        return particles
    before = particles.positions.astype(np.float64)
    positions = new.place.points(before)
    grid = new.terrain.grid
    limit = 0.0 if new.replaced else -grid.spacing  # what the bed has only brushed is pushed out later
    moved = replace(
        particles,
        positions=positions.astype(np.float32),
        velocities=new.place.directions(before, particles.velocities).astype(np.float32),
    )
    kept = sample_nodes(new.terrain.signed_distance, grid, positions) > limit
    if not kept.any() and not (new.cell_types == CellType.INFLOW).any():
        raise InputRejected(
            "after the edit of the terrain all of the water lies inside the ground",
            "water above it",
            "lower the terrain",
        )
    return moved.select(kept)


def reshaped_gaussians(rest: Gaussians, place: Place) -> Gaussians:
    """Gaussians where their places are now, stretched and turned with them. Colours that depend on the direction of
    view keep to the world."""
    if not len(rest) or not place.forth:
        return rest
    gradient = place.gradient(rest.means)
    covariances = gradient @ rest.covariances().astype(np.float64) @ np.swapaxes(gradient, 1, 2)
    quats, scales = decompose_covariances(covariances)
    return replace(rest, means=place.points(rest.means), quats=quats, scales=scales)


def raised_box(terrain: Terrain, cell_types: np.ndarray, top: float) -> Reshaped:
    """The same terrain in a box that reaches up to a height (m): air above it, and ground that goes on where it reached
    the old top."""
    grid = terrain.grid
    high = np.array([*grid.high[:2], max(top, float(grid.high[2]))])
    larger = box_around(grid, grid.low, high)
    nodes = larger.nodes().reshape(-1, 3)
    distance = sample_nodes(terrain.signed_distance, grid, nodes).reshape(tuple(n + 1 for n in larger.shape))
    new = replace(terrain, grid=larger, signed_distance=distance.astype(np.float32))
    return Reshaped(new, _moved_cells(grid, cell_types, new, Place()), Place(), False)
