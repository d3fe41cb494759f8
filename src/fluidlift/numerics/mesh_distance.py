"""Signed distance of a closed triangle mesh on a grid of its own frame.

Within two cells of the surface the distance is exact: the nearest triangle of every node is found among all that reach
it. Farther away a node takes the nearest triangle of the closest such node or of its neighbours (an upper bound, and
close to it). The sign follows the number of times that a line along x enters and leaves the surface before it gets to
the node (the winding number of consistently oriented shells: shells that overlap unite, reversed shells inside are
cavities). Lines that meet edges or corners follow a fixed rule that gives each crossing to exactly one triangle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numba import njit
from scipy import ndimage

from fluidlift.errors import require
from fluidlift.messages import NONE, Notice
from fluidlift.numerics.sharing import shared
from fluidlift.types import Grid, TriangleMesh

BAND = 2.0
"""cells around each triangle whose nodes are measured against it"""
FAR_PASSES = 3
"""in which the other nodes try the triangles of their six neighbours"""
LARGEST_GRID = 20_000_000
"""nodes"""


@dataclass(frozen=True)
class MeshDistance:
    """Signed distance around a solid, in its own frame."""

    grid: Grid
    distance: Float[np.ndarray, "nx+1 ny+1 nz+1"]
    """float32, m at the nodes, positive outside"""

    @property
    def thickness(self) -> float:
        """m: diameter of the largest ball inside, as the grid sees it (0: the grid sees nothing)."""
        return max(0.0, -2.0 * float(self.distance.min()))


def thin_warning(name: str, distance: MeshDistance, spacing: float) -> Notice:
    """What to tell about a solid thinner than a cell of the simulation (`spacing`, m); empty where it is thick."""
    if distance.thickness >= spacing:
        return NONE
    return Notice(
        "body-thin",
        f"{name}: its thickest part measures {distance.thickness:.3g} m, less than a cell ({spacing:.3g} m): the "
        "liquid hardly sees it. Use a finer grid or a thicker body.",
    )


def mesh_distance(mesh: TriangleMesh, spacing: float, *, margin: float | None = None) -> MeshDistance:
    """Signed distance at the nodes of a grid around the mesh.

    Args:
        mesh: closed, counter-clockwise seen from outside (see `numerics.solid_mesh.closed_mesh`).
        spacing: m, of the grid.
        margin: m around the mesh that the grid covers at least (default: three cells).

    Raises:
        ValueError: a spacing that is not positive, or one too fine for the size of the mesh.
    """
    require(np.isfinite(spacing) and spacing > 0, f"spacing {spacing}", "positive metres")
    triangles = np.ascontiguousarray(np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)])
    margin = 3.0 * spacing if margin is None else margin
    low, high = triangles.min(axis=(0, 1)) - margin, triangles.max(axis=(0, 1)) + margin
    cells = np.maximum(np.ceil((high - low) / spacing), 1).astype(np.int64)
    nodes = float(np.prod(cells + 1.0))
    require(nodes <= LARGEST_GRID, f"{nodes:.3g} nodes around the mesh", f"{LARGEST_GRID}", "use a coarser spacing")
    origin = 0.5 * (low + high) - 0.5 * cells * spacing
    shape = (int(cells[0]), int(cells[1]), int(cells[2]))
    start, order = _triangles_of_planes(triangles, origin[0], spacing, shape[0] + 1)
    nearest = np.full(tuple(n + 1 for n in shape), -1, np.int64)
    squared = np.full(nearest.shape, np.inf)
    _measure_band(triangles, start, order, origin, spacing, BAND * spacing, nearest, squared)
    i, j, k = np.asarray(ndimage.distance_transform_edt(nearest < 0, return_distances=False, return_indices=True))
    nearest = np.where(nearest < 0, nearest[i, j, k], nearest)
    for _ in range(FAR_PASSES):
        best = np.empty_like(nearest)
        _measure_far(triangles, origin, spacing, nearest, squared, best)
        nearest = best
    crossings = np.zeros(nearest.shape, np.int32)
    _count_crossings(triangles, origin, spacing, crossings)
    inside = np.cumsum(crossings, axis=0) > 0
    distance = np.sqrt(squared)
    return MeshDistance(Grid(shape, spacing, tuple(origin)), np.where(inside, -distance, distance).astype(np.float32))


def _triangles_of_planes(triangles: np.ndarray, low: float, spacing: float, planes: int) -> tuple[np.ndarray, ...]:
    """Triangles whose band reaches each plane of nodes across x: where each list begins, and the lists."""
    first = np.ceil((triangles[:, :, 0].min(axis=1) - low) / spacing - BAND).astype(np.int64).clip(0, planes)
    last = np.floor((triangles[:, :, 0].max(axis=1) - low) / spacing + BAND).astype(np.int64).clip(-1, planes - 1)
    counts = np.maximum(last - first + 1, 0)
    owner = np.repeat(np.arange(len(triangles)), counts)
    plane = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts) + np.repeat(first, counts)
    order = np.argsort(plane, kind="stable")
    start = np.zeros(planes + 1, np.int64)
    start[1:] = np.cumsum(np.bincount(plane, minlength=planes))
    return start, owner[order]


@njit(cache=True)
def _to_segment(px, py, pz, ax, ay, az, bx, by, bz):
    """Squared distance of a point to a segment."""
    dx, dy, dz = bx - ax, by - ay, bz - az
    length = dx * dx + dy * dy + dz * dz
    t = ((px - ax) * dx + (py - ay) * dy + (pz - az) * dz) / length if length > 0.0 else 0.0
    t = min(max(t, 0.0), 1.0)
    ex, ey, ez = px - ax - t * dx, py - ay - t * dy, pz - az - t * dz
    return ex * ex + ey * ey + ez * ez


@njit(cache=True)
def squared_distance_to_triangle(t, px, py, pz):
    """m^2 from a point to a triangle [3,3]: to its plane where the foot lies inside, else to the nearest edge."""
    ax, ay, az = t[0, 0], t[0, 1], t[0, 2]
    ux, uy, uz = t[1, 0] - ax, t[1, 1] - ay, t[1, 2] - az
    vx, vy, vz = t[2, 0] - ax, t[2, 1] - ay, t[2, 2] - az
    wx, wy, wz = px - ax, py - ay, pz - az
    uu, uv, vv = ux * ux + uy * uy + uz * uz, ux * vx + uy * vy + uz * vz, vx * vx + vy * vy + vz * vz
    wu, wv = wx * ux + wy * uy + wz * uz, wx * vx + wy * vy + wz * vz
    determinant = uu * vv - uv * uv
    s, r = vv * wu - uv * wv, uu * wv - uv * wu
    if determinant > 0.0 and s >= 0.0 and r >= 0.0 and s + r <= determinant:
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        height = wx * nx + wy * ny + wz * nz
        return height * height / (nx * nx + ny * ny + nz * nz)
    return min(
        _to_segment(px, py, pz, ax, ay, az, t[1, 0], t[1, 1], t[1, 2]),
        _to_segment(px, py, pz, ax, ay, az, t[2, 0], t[2, 1], t[2, 2]),
        _to_segment(px, py, pz, t[1, 0], t[1, 1], t[1, 2], t[2, 0], t[2, 1], t[2, 2]),
    )


@shared(lambda triangles, start, order, low, h, band, nearest, *_: (0, nearest.shape[0]))
def _measure_band(begin, end, triangles, start, order, low, h, band, nearest, squared):
    """Nearest triangle of every node within `band` of the box around a triangle; planes across x are independent."""
    _, ny, nz = nearest.shape
    for i in range(begin, end):
        x = low[0] + i * h
        for n in range(start[i], start[i + 1]):
            f = order[n]
            t = triangles[f]
            y0, y1 = min(t[0, 1], t[1, 1], t[2, 1]), max(t[0, 1], t[1, 1], t[2, 1])
            z0, z1 = min(t[0, 2], t[1, 2], t[2, 2]), max(t[0, 2], t[1, 2], t[2, 2])
            j0 = max(np.int64(np.ceil((y0 - band - low[1]) / h)), 0)
            j1 = min(np.int64(np.floor((y1 + band - low[1]) / h)), ny - 1)
            k0 = max(np.int64(np.ceil((z0 - band - low[2]) / h)), 0)
            k1 = min(np.int64(np.floor((z1 + band - low[2]) / h)), nz - 1)
            for j in range(j0, j1 + 1):
                for k in range(k0, k1 + 1):
                    d = squared_distance_to_triangle(t, x, low[1] + j * h, low[2] + k * h)
                    if d < squared[i, j, k]:
                        squared[i, j, k] = d
                        nearest[i, j, k] = f


@shared(lambda triangles, low, h, nearest, *_: (0, nearest.shape[0]))
def _measure_far(begin, end, triangles, low, h, nearest, squared, best):
    """Nodes are measured against their own triangle and those of their neighbours; best: the nearest ones."""
    nx, ny, nz = nearest.shape
    for i in range(begin, end):
        for j in range(ny):
            for k in range(nz):
                x, y, z = low[0] + i * h, low[1] + j * h, low[2] + k * h
                own = nearest[i, j, k]
                best[i, j, k] = own
                distance = squared[i, j, k]
                if distance == np.inf:
                    distance = squared_distance_to_triangle(triangles[own], x, y, z)
                last = own
                for n in range(6):
                    a = i + (1 if n == 0 else (-1 if n == 1 else 0))
                    b = j + (1 if n == 2 else (-1 if n == 3 else 0))
                    c = k + (1 if n == 4 else (-1 if n == 5 else 0))
                    if a < 0 or b < 0 or c < 0 or a >= nx or b >= ny or c >= nz:
                        continue
                    f = nearest[a, b, c]
                    if f in (own, last):
                        continue
                    last = f
                    d = squared_distance_to_triangle(triangles[f], x, y, z)
                    if d < distance:
                        distance = d
                        best[i, j, k] = f
                squared[i, j, k] = distance


@njit(cache=True)
def _turn(ax, ay, bx, by):
    """1 or -1: on which side of a the vector b lies; parallel vectors by a fixed rule, 0 only for equal ones."""
    area = ay * bx - ax * by
    if area != 0.0:
        return 1 if area > 0.0 else -1
    if by != ay:
        return 1 if by > ay else -1
    if ax != bx:
        return 1 if ax > bx else -1
    return 0


@njit(cache=True)
def _count_crossings(triangles, low, h, crossings):
    """+1 at the first node behind each entry along x and -1 behind each exit."""
    nx, ny, nz = crossings.shape
    for f in range(len(triangles)):
        t = triangles[f]
        # a node more than the division says on either side: rounded, it may leave out one that lies on a vertex
        j0 = max(np.int64(np.floor((min(t[0, 1], t[1, 1], t[2, 1]) - low[1]) / h)), 0)
        j1 = min(np.int64(np.ceil((max(t[0, 1], t[1, 1], t[2, 1]) - low[1]) / h)), ny - 1)
        k0 = max(np.int64(np.floor((min(t[0, 2], t[1, 2], t[2, 2]) - low[2]) / h)), 0)
        k1 = min(np.int64(np.ceil((max(t[0, 2], t[1, 2], t[2, 2]) - low[2]) / h)), nz - 1)
        for j in range(j0, j1 + 1):
            for k in range(k0, k1 + 1):
                y, z = low[1] + j * h, low[2] + k * h
                ay, az, by, bz, cy, cz = t[0, 1] - y, t[0, 2] - z, t[1, 1] - y, t[1, 2] - z, t[2, 1] - y, t[2, 2] - z
                side = _turn(by, bz, cy, cz)
                if side == 0 or _turn(cy, cz, ay, az) != side or _turn(ay, az, by, bz) != side:
                    continue
                a, b, c = bz * cy - by * cz, cz * ay - cy * az, az * by - ay * bz
                total = a + b + c
                if total == 0.0:
                    continue
                x = (a * t[0, 0] + b * t[1, 0] + c * t[2, 0]) / total
                i = max(np.int64(np.ceil((x - low[0]) / h)), 0)
                if i < nx:
                    crossings[i, j, k] += side


def mesh_distance_plain(mesh: TriangleMesh, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Signed distance (m) by comparing every point with every triangle; the sign from solid angles.

    The winding number is the sum of the signed solid angles over 4 pi (van Oosterom, Strackee 1983).
    """
    triangles = np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)]
    out = np.empty(len(points))
    for n, point in enumerate(np.asarray(points, np.float64)):
        squared = min(squared_distance_to_triangle(t, *point) for t in triangles)
        a, b, c = (triangles[:, i] - point for i in range(3))
        la, lb, lc = (np.sqrt(np.square(v).sum(axis=1)) for v in (a, b, c))
        volume = np.einsum("ni,ni->n", a, np.cross(b, c))
        dots = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
        winding = np.arctan2(volume, dots).sum() / (2 * np.pi)
        out[n] = np.sqrt(squared) * (-1.0 if winding > 0.5 else 1.0)
    return out
