"""Terrain and rigid bodies as one solid on the grid of a region: `Walls` for the present poses.

Bodies and terrain do not overlap (contact sees to it), so the share of a face that a body covers comes from the body's
distance field alone and is taken off what the terrain leaves open. That is exact for gaps much thinner than a cell,
where the minimum of the two distances at the nodes would close them.
Only the boxes of cells around the bodies are computed; what they hid in the step before is put back first.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numba import njit

from fluidlift.numerics.sharing import shared
from fluidlift.numerics.signed_distance import distance_and_gradient
from fluidlift.physics.active_region import ActiveRegion
from fluidlift.physics.boundaries import SMALLEST_OPENING
from fluidlift.physics.rigid_shapes import Shapes, body_distance
from fluidlift.types import CellType, triple

RAISED = 1e-3
"""cells by which a body's surface is raised, as the terrain's is (see `boundaries.face_fractions`)"""
PARTS = 2
"""pieces of a face's side between which a body's distance is linear"""
CUT = 1e-3
"""share of a body's cover of a cell's faces from which on its being cut off by terrain counts"""
PADDING = 3
"""cells around a body's box in which the union differs from the terrain"""


@dataclass(frozen=True)
class Cover:
    """What one body covers, on the faces of its box of cells."""

    body: int
    low: tuple[int, int, int]
    """first cell"""
    high: tuple[int, int, int]
    """one past the last"""
    distance: Float[np.ndarray, "bx+1 by+1 bz+1"]
    """m at the nodes"""
    share: tuple[np.ndarray, np.ndarray, np.ndarray]
    """float32 per axis: covered share of each face, 0 to 1; at most what the terrain leaves open"""
    offset: tuple[np.ndarray, np.ndarray, np.ndarray]
    """float32 [...,2] per axis: centre of the covered part less the face's centre along the face's two axes, m"""
    volume: Float[np.ndarray, "bx by bz"]
    """float32: share of each cell that the body fills; the sum is the body's true volume where it is in the grid"""
    middle: Float[np.ndarray, "bx by bz 3"]
    """float32: centre of that part less the cell's centre, m"""

    def faces(self, axis: int) -> tuple[slice, slice, slice]:
        """Where the box's faces across `axis` lie in an array of the grid."""
        return triple(slice(a, b + (d == axis)) for d, (a, b) in enumerate(zip(self.low, self.high)))

    @property
    def cells(self) -> tuple[slice, slice, slice]:
        """Where the box's cells lie in an array of the grid."""
        return triple(slice(a, b) for a, b in zip(self.low, self.high))

    @property
    def nodes(self) -> tuple[slice, slice, slice]:
        """Where the box's nodes lie in an array of the grid."""
        return triple(slice(a, b + 1) for a, b in zip(self.low, self.high))


@shared(lambda shapes, body, low, h, out: (0, out.shape[0]))
def _node_distances(begin, end, shapes, body, low, h, out):
    for i in range(begin, end):
        for j in range(out.shape[1]):
            for k in range(out.shape[2]):
                value, _, _, _ = body_distance(shapes, body, low[0] + i * h, low[1] + j * h, low[2] + k * h)
                out[i, j, k] = value


@njit(cache=True)
def _solid_part(ax, ay, a, bx, by, b, cx, cy, c):
    """Area, and area times centre, of the part of a triangle where the linear function with values a, b, c is < 0."""
    area = 0.5 * abs((bx - ax) * (cy - ay) - (cx - ax) * (by - ay))
    mx, my = (ax + bx + cx) / 3.0, (ay + by + cy) / 3.0
    count = (a < 0.0) + (b < 0.0) + (c < 0.0)
    if count == 0:
        return 0.0, 0.0, 0.0
    if count == 3:
        return area, area * mx, area * my
    # turn so that the corner that differs from the other two comes first
    if (b < 0.0) != (a < 0.0) and (b < 0.0) != (c < 0.0):
        ax, ay, a, bx, by, b, cx, cy, c = bx, by, b, cx, cy, c, ax, ay, a
    elif (c < 0.0) != (a < 0.0) and (c < 0.0) != (b < 0.0):
        ax, ay, a, bx, by, b, cx, cy, c = cx, cy, c, ax, ay, a, bx, by, b
    s, t = a / (a - b), a / (a - c)
    tip = area * s * t
    tx, ty = ax + (s * (bx - ax) + t * (cx - ax)) / 3.0, ay + (s * (by - ay) + t * (cy - ay)) / 3.0
    if count == 1:
        return tip, tip * tx, tip * ty
    return area - tip, area * mx - tip * tx, area * my - tip * ty


@njit(cache=True)
def _solid_part_of_square(x, y, side, d00, d10, d01, d11):
    """`_solid_part` of a square with low corner (x, y): mean of the two ways to cut it into triangles."""
    x1, y1 = x + side, y + side
    area, mx, my = _solid_part(x, y, d00, x1, y, d10, x1, y1, d11)
    more, sx, sy = _solid_part(x, y, d00, x1, y1, d11, x, y1, d01)
    area, mx, my = area + more, mx + sx, my + sy
    more, sx, sy = _solid_part(x, y, d00, x1, y, d10, x, y1, d01)
    area, mx, my = area + more, mx + sx, my + sy
    more, sx, sy = _solid_part(x1, y, d10, x1, y1, d11, x, y1, d01)
    return 0.5 * (area + more), 0.5 * (mx + sx), 0.5 * (my + sy)


@shared(lambda shapes, body, low, axis, h, distance, share, *_: (0, share.shape[0]))
def _cover_faces(begin, end, shapes, body, low, axis, h, distance, share, offset):
    """Covered share of each face and its centre, from the body's distance at `PARTS` + 1 points along each side."""
    a0, a1, a2 = (0, 1, 0) if axis == 0 else (1, 0, 0)  # first axis of the face
    b0, b1, b2 = (0, 1, 0) if axis == 2 else (0, 0, 1)  # second axis of the face
    raised, side = RAISED * h, 1.0 / PARTS
    for i in range(begin, end):
        for j in range(share.shape[1]):
            for k in range(share.shape[2]):
                share[i, j, k] = 0.0
                offset[i, j, k, 0] = 0.0
                offset[i, j, k, 1] = 0.0
                corner = distance[i, j, k]
                if abs(corner) > 1.5 * h:  # longer than the diagonal: the surface does not reach the face
                    share[i, j, k] = 1.0 if corner < 0.0 else 0.0
                    continue
                d = np.empty((PARTS + 1, PARTS + 1))
                for s in range(PARTS + 1):
                    for t in range(PARTS + 1):
                        d[s, t], _, _, _ = body_distance(
                            shapes,
                            body,
                            low[0] + (i + side * (s * a0 + t * b0)) * h,
                            low[1] + (j + side * (s * a1 + t * b1)) * h,
                            low[2] + (k + side * (s * a2 + t * b2)) * h,
                        )
                        d[s, t] -= raised
                area, x, y = 0.0, 0.0, 0.0
                for s in range(PARTS):
                    for t in range(PARTS):
                        part, mx, my = _solid_part_of_square(
                            s * side, t * side, side, d[s, t], d[s + 1, t], d[s, t + 1], d[s + 1, t + 1]
                        )
                        area, x, y = area + part, x + mx, y + my
                if area > 0.0:
                    share[i, j, k] = min(area, 1.0)
                    offset[i, j, k, 0] = (x / area - 0.5) * h
                    offset[i, j, k, 1] = (y / area - 0.5) * h


@shared(lambda shapes, body, low, h, distance, volume, *_: (0, volume.shape[0]))
def _fill_cells(begin, end, shapes, body, low, h, distance, volume, middle):
    """Share of each cell inside the body and the centre of that part: eight parts, cut by a plane each.

    The share of a cube below a plane is taken as linear in the plane's distance, and the centre of what is below as
    on the normal; both are exact for planes along the grid.
    """
    for i in range(begin, end):
        for j in range(volume.shape[1]):
            for k in range(volume.shape[2]):
                corner = distance[i, j, k]
                middle[i, j, k, 0], middle[i, j, k, 1], middle[i, j, k, 2] = 0.0, 0.0, 0.0
                if abs(corner) > 2.0 * h:
                    volume[i, j, k] = 1.0 if corner < 0.0 else 0.0
                    continue
                total, mx, my, mz = 0.0, 0.0, 0.0, 0.0
                for part in range(8):
                    fx = 0.25 if part & 1 == 0 else 0.75
                    fy = 0.25 if part & 2 == 0 else 0.75
                    fz = 0.25 if part & 4 == 0 else 0.75
                    value, gx, gy, gz = body_distance(
                        shapes, body, low[0] + (i + fx) * h, low[1] + (j + fy) * h, low[2] + (k + fz) * h
                    )
                    wide = max(abs(gx) + abs(gy) + abs(gz), 0.1)
                    share = min(max(0.5 - value / (0.5 * h * wide), 0.0), 1.0)
                    length = max(np.sqrt(gx * gx + gy * gy + gz * gz), 0.1)
                    back = -0.25 * h * (1.0 - share) * (wide / length) / length
                    total += share
                    mx += share * ((fx - 0.5) * h + back * gx)
                    my += share * ((fy - 0.5) * h + back * gy)
                    mz += share * ((fz - 0.5) * h + back * gz)
                volume[i, j, k] = 0.125 * total
                if total > 0.0:
                    middle[i, j, k, 0], middle[i, j, k, 1], middle[i, j, k, 2] = mx / total, my / total, mz / total


@shared(lambda shapes, bodies, axis, low, h, first, last, *_: (first[0], last[0]))
def _wall_normals(begin, end, shapes, bodies, axis, low, h, first, last, opening, before, closed_by, normals):
    """Unit normals on faces that bodies close, from the nearest body; `closed_by` gets its number."""
    for i in range(begin, end):
        for j in range(first[1], last[1]):
            for k in range(first[2], last[2]):
                closed_by[i, j, k] = -1
                if opening[i, j, k] > 0.0 or before[i, j, k] == 0.0:
                    continue
                x = low[0] + (i + (0.0 if axis == 0 else 0.5)) * h
                y = low[1] + (j + (0.0 if axis == 1 else 0.5)) * h
                z = low[2] + (k + (0.0 if axis == 2 else 0.5)) * h
                best, nx, ny, nz = np.inf, 0.0, 0.0, 0.0
                for b in bodies:
                    value, gx, gy, gz = body_distance(shapes, b, x, y, z)
                    if value < best:
                        best, nx, ny, nz = value, gx, gy, gz
                        closed_by[i, j, k] = b
                length = np.sqrt(nx * nx + ny * ny + nz * nz)
                if length > 1e-3:
                    nx, ny, nz = nx / length, ny / length, nz / length
                else:
                    nx, ny, nz = 1.0 * (axis == 0), 1.0 * (axis == 1), 1.0 * (axis == 2)
                normals[i, j, k, 0], normals[i, j, k, 1], normals[i, j, k, 2] = nx, ny, nz


@shared(lambda distance, ox, oy, oz, first, last, *_: (first[0], last[0]))
def _cell_facts(
    begin, end, distance, ox, oy, oz, first, last, low, h, solid_code, solid, buried, regions, beside, capacity
):
    """Per cell: solid, buried, region, beside a mostly closed face, open share of the kernel (see `cell_capacity`)."""
    inverse = 1.0 / h
    for i in range(begin, end):
        for j in range(first[1], last[1]):
            for k in range(first[2], last[2]):
                mean = 0.0
                for a in range(2):
                    for b in range(2):
                        mean += distance[i + a, j + b, k] + distance[i + a, j + b, k + 1]
                mean *= 0.125
                widest = max(ox[i, j, k], ox[i + 1, j, k], oy[i, j, k], oy[i, j + 1, k], oz[i, j, k], oz[i, j, k + 1])
                narrowest = min(
                    ox[i, j, k], ox[i + 1, j, k], oy[i, j, k], oy[i, j + 1, k], oz[i, j, k], oz[i, j, k + 1]
                )
                if widest == 0.0:
                    solid[i, j, k] = True
                    regions[i, j, k] = solid_code
                buried[i, j, k] = not solid[i, j, k] and mean < 0.25 * h
                beside[i, j, k] = not solid[i, j, k] and narrowest < 0.5
                if abs(mean) >= 2.0 * h:
                    capacity[i, j, k] = 1.0 if mean > 0.0 else 0.0
                    continue
                total = 0.0
                for a in range(4):
                    for b in range(4):
                        for c in range(4):
                            sx, sy, sz = 0.5 * a - 0.75, 0.5 * b - 0.75, 0.5 * c - 0.75
                            value, _, _, _ = distance_and_gradient(
                                distance,
                                low,
                                inverse,
                                low[0] + (i + 0.5 + sx) * h,
                                low[1] + (j + 0.5 + sy) * h,
                                low[2] + (k + 0.5 + sz) * h,
                            )
                            if value > 0.0:
                                total += 0.125 * (1.0 - abs(sx)) * (1.0 - abs(sy)) * (1.0 - abs(sz))
                capacity[i, j, k] = total


class UnionWalls:
    """Keeps an `ActiveRegion` of terrain and bodies up to date. All arrays it gives out change at the next `update`."""

    def __init__(self, static: ActiveRegion) -> None:
        walls, grid = static.walls, static.grid
        self.static = static
        self.covers: tuple[Cover, ...] = ()
        self.walls = replace(
            walls, signed_distance=walls.signed_distance.copy(), openings=tuple(o.copy() for o in walls.openings),
            normals=tuple(n.copy() for n in walls.normals), solid=walls.solid.copy(), buried=walls.buried.copy(),
            regions=walls.regions.copy(),
        )  # fmt: skip
        self.region = replace(
            static, walls=self.walls, capacity=static.capacity.copy(), wall_cells=static.wall_cells.copy()
        )
        self.closed_by = tuple(np.full(grid.face_shape(a), -1, np.int16) for a in range(3))
        """number of the body that closes a face which the terrain leaves open; else -1"""
        self._covered = tuple(np.zeros(grid.face_shape(a), np.float32) for a in range(3))

    def update(self, shapes: Shapes, volumes: Float[np.ndarray, " b"], centers: Float[np.ndarray, "b 3"]) -> None:
        """Walls for the poses of `shapes`; the bodies' true volumes (m^3) and centres of mass (m) correct `Cover`."""
        for cover in self.covers:
            self._put_back(cover)
        covers = [self._measured(shapes, b, float(volumes[b]), centers[b]) for b in range(len(shapes.start))]
        covers = [c for c in covers if c is not None]
        for cover in covers:
            nodes = self.walls.signed_distance[cover.nodes]
            np.minimum(nodes, cover.distance, out=nodes)
            for axis in range(3):
                self._covered[axis][cover.faces(axis)] += cover.share[axis]
        for cover in covers:
            for axis in range(3):
                at = cover.faces(axis)
                opening = self.static.walls.openings[axis][at] - self._covered[axis][at]
                self.walls.openings[axis][at] = np.where(
                    (self._covered[axis][at] > 0) & (opening < SMALLEST_OPENING), np.float32(0), opening
                )
        self.covers = tuple(self._fitted(cover) for cover in covers)
        for cover in covers:
            self._derive(cover, shapes)

    def _put_back(self, cover: Cover) -> None:
        walls, static = self.walls, self.static.walls
        walls.signed_distance[cover.nodes] = static.signed_distance[cover.nodes]
        for axis in range(3):
            at = cover.faces(axis)
            walls.openings[axis][at] = static.openings[axis][at]
            walls.normals[axis][at] = static.normals[axis][at]
            self.closed_by[axis][at] = -1
            self._covered[axis][at] = 0.0
        at = cover.cells
        for name in ("solid", "buried", "regions"):
            getattr(walls, name)[at] = getattr(static, name)[at]
        self.region.wall_cells[at] = self.static.wall_cells[at]
        self.region.capacity[at] = self.static.capacity[at]

    def _measured(self, shapes: Shapes, body: int, true_volume: float, center: np.ndarray) -> Cover | None:
        """Distance and covered shares on the faces around a body; None where it is out of the box."""
        grid, h = self.static.grid, self.static.grid.spacing
        limits = np.asarray(grid.shape)
        low = np.floor((shapes.box_low[body] - grid.low) / h)
        high = np.ceil((shapes.box_high[body] - grid.low) / h)
        if not (np.isfinite(low).all() and (high > 0).all() and (low < limits).all()):
            return None
        first = np.clip(low - PADDING, 0, limits).astype(np.int64)
        last = np.clip(high + PADDING, 0, limits).astype(np.int64)
        size = last - first
        distance = np.empty(tuple(size + 1), np.float32)
        _node_distances(shapes, body, grid.low + first * h, h, distance)
        shares, offsets = [], []
        for axis in range(3):
            shape = tuple(size + (np.arange(3) == axis))
            share, offset = np.empty(shape, np.float32), np.empty((*shape, 2), np.float32)
            _cover_faces(shapes, body, grid.low + first * h, axis, h, distance, share, offset)
            shares.append(share)
            offsets.append(offset)
        volume, middle = np.empty(tuple(size), np.float32), np.empty((*size, 3), np.float32)
        _fill_cells(shapes, body, grid.low + first * h, h, distance, volume, middle)
        if (low >= 0).all() and (high <= limits).all():
            # as a whole the body is known exactly: it neither rises nor turns for what cells make of its edges
            seen = float(volume.sum(dtype=np.float64))
            if seen > 0.5 * true_volume / h**3:
                cells = [grid.low[a] + (np.arange(first[a], last[a]) + 0.5) * h - center[a] for a in range(3)]
                arms = np.stack(np.meshgrid(*cells, indexing="ij"), axis=-1) + middle
                shift = (volume[..., None] * arms).sum(axis=(0, 1, 2)) / seen
                middle -= shift.astype(np.float32)
                volume *= np.float32(true_volume / (h**3 * seen))
        ends = triple(int(x) for x in first), triple(int(x) for x in last)
        return Cover(body, *ends, distance, tuple(shares), tuple(offsets), volume, middle)

    def _fitted(self, cover: Cover) -> Cover:
        """Shares scaled so that bodies and liquid together fill what the terrain leaves open.

        Of a body that overlaps the terrain the part inside it displaces no liquid: each cell's volume counts as far as
        its faces do. Otherwise it would lift the body as if it were under water, with up to its whole buoyancy.
        """
        shares = []
        before, after = np.zeros_like(cover.volume), np.zeros_like(cover.volume)
        for axis, share in enumerate(cover.share):
            at = cover.faces(axis)
            taken = self.static.walls.openings[axis][at] - self.walls.openings[axis][at]
            covered = self._covered[axis][at]
            fitted = share * np.divide(taken, covered, out=np.zeros_like(share), where=covered > 0)
            for side in range(2):
                cells = tuple(slice(side, n + side) if d == axis else slice(n) for d, n in enumerate(before.shape))
                before += share[cells]
                after += fitted[cells]
            shares.append(fitted)
        # a body that only touches the terrain, or closes a narrow gap beside it, keeps its volume to the last digit
        lost = after < (1.0 - CUT) * before
        volume = np.where(lost, cover.volume * after / np.maximum(before, 1e-6), cover.volume)
        return replace(cover, share=tuple(shares), volume=volume.astype(np.float32, copy=False))

    def _derive(self, cover: Cover, shapes: Shapes) -> None:
        walls, grid = self.walls, self.static.grid
        bodies = np.array([c.body for c in self.covers], np.int64)
        first, last = np.array(cover.low), np.array(cover.high)
        for axis in range(3):
            _wall_normals(
                shapes, bodies, axis, grid.low, grid.spacing, first, last + (np.arange(3) == axis),
                walls.openings[axis], self.static.walls.openings[axis], self.closed_by[axis], walls.normals[axis],
            )  # fmt: skip
        _cell_facts(
            walls.signed_distance, *walls.openings, first, last, grid.low, grid.spacing, np.uint8(CellType.SOLID),
            walls.solid, walls.buried, walls.regions, self.region.wall_cells, self.region.capacity,
        )  # fmt: skip
