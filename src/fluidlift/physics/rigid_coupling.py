"""Two-way coupling of rigid bodies and liquid by cut cells in the pressure projection.

After Batty, Bertails, Bridson 2007, "A fast variational framework for accurate solid-fluid coupling", section 4. The
share a of a face that a body covers moves with the body, so that cell c loses (sum over faces +-a u_body) / h of its
volume per second = J_c V, with V = (velocity of the centre of mass, angular velocity). The pressure q (m^2/s) gives the
body the impulse density h^3 J^T q. With the same J in the divergence and in the impulse, liquid and bodies exchange
momentum and energy without loss.

What J leaves out is where in its cell the surface lies: J takes the pressure of the cell's centre. Over a whole body
in liquid at rest that is the weight of the volume between the surface and the next faces, up to half a cell of draught
for a flat bottom. `surface_force` is that part, from the gradient of the pressure of the step before.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from fluidlift.numerics.sharing import shared
from fluidlift.physics.boundaries import Walls
from fluidlift.physics.rigid_walls import Cover, UnionWalls
from fluidlift.types import CellType, FaceVelocity, triple


@dataclass(frozen=True)
class BodyRows:
    """J of one body on the unknown cells."""

    body: int
    cells: Int[np.ndarray, "n 3"]
    values: Float[np.ndarray, "n 6"]
    """divergence (1/s) per velocity (m/s; first three) and angular velocity (rad/s) of the body"""


@shared(lambda axis, first, low, h, share, *_: (0, share.shape[0]))
def _add_flux(begin, end, axis, first, low, h, share, offset, center, velocity, spin, out):
    """out += share x normal velocity of the body at the centre of the covered part."""
    for i in range(begin, end):
        for j in range(share.shape[1]):
            for k in range(share.shape[2]):
                if share[i, j, k] == 0.0:
                    continue
                rx, ry, rz = _arm(axis, i + first[0], j + first[1], k + first[2], low, h, offset[i, j, k], center)
                if axis == 0:
                    speed = velocity[0] + spin[1] * rz - spin[2] * ry
                elif axis == 1:
                    speed = velocity[1] + spin[2] * rx - spin[0] * rz
                else:
                    speed = velocity[2] + spin[0] * ry - spin[1] * rx
                out[i + first[0], j + first[1], k + first[2]] += share[i, j, k] * speed


@njit(cache=True)
def _arm(axis, i, j, k, low, h, offset, center):
    """From the centre of mass to the centre of the covered part of a face."""
    x = low[0] + (i + (0.0 if axis == 0 else 0.5)) * h - center[0]
    y = low[1] + (j + (0.0 if axis == 1 else 0.5)) * h - center[1]
    z = low[2] + (k + (0.0 if axis == 2 else 0.5)) * h - center[2]
    if axis == 0:
        return x, y + offset[0], z + offset[1]
    if axis == 1:
        return x + offset[0], y, z + offset[1]
    return x + offset[0], y + offset[1], z


class SolidVelocity:
    """Velocity of the solid on all faces, kept up to date around the bodies."""

    def __init__(self, union: UnionWalls) -> None:
        self._union = union
        self._flux, self._mean = (FaceVelocity.zeros(union.static.grid) for _ in range(2))
        self._filled: tuple[Cover, ...] = ()

    def update(
        self, center: Float[np.ndarray, "b 3"], velocity: Float[np.ndarray, "b 3"], spin: Float[np.ndarray, "b 3"]
    ) -> FaceVelocity:
        """m/s, mean over the closed share of each face; the terrain rests. The arrays change at the next call."""
        grid, covers = self._union.static.grid, self._union.covers
        for axis, (flux, mean) in enumerate(zip(self._flux.components, self._mean.components)):
            for cover in self._filled:
                flux[cover.faces(axis)] = 0.0
                mean[cover.faces(axis)] = 0.0
            for c in covers:
                _add_flux(
                    axis, np.array(c.low), grid.low, grid.spacing, c.share[axis], c.offset[axis], center[c.body],
                    velocity[c.body], spin[c.body], flux,
                )  # fmt: skip
            for c in covers:
                at = c.faces(axis)
                closed = 1.0 - self._union.walls.openings[axis][at]
                mean[at] = np.divide(flux[at], closed, out=np.zeros_like(closed), where=closed > 0)
        self._filled = covers
        return self._mean


@shared(lambda unknown, first, low, h, sx, sy, sz, fx, fy, fz, center, rows: (0, rows.shape[0]))
def _gather_rows(begin, end, unknown, first, low, h, sx, sy, sz, fx, fy, fz, center, rows):
    """rows [bx,by,bz,6]: per cell of the box, sum over its faces of +-share (e, r x e) / h."""
    inverse = 1.0 / h
    for i in range(begin, end):
        for j in range(rows.shape[1]):
            for k in range(rows.shape[2]):
                for m in range(6):
                    rows[i, j, k, m] = 0.0
                if not unknown[i + first[0], j + first[1], k + first[2]]:
                    continue
                for side in range(2):
                    sign = inverse if side == 1 else -inverse
                    a = sign * sx[i + side, j, k]
                    if a != 0.0:
                        at = fx[i + side, j, k]
                        _, y, z = _arm(0, i + side + first[0], j + first[1], k + first[2], low, h, at, center)
                        rows[i, j, k, 0] += a
                        rows[i, j, k, 4] += a * z
                        rows[i, j, k, 5] -= a * y
                    a = sign * sy[i, j + side, k]
                    if a != 0.0:
                        at = fy[i, j + side, k]
                        x, _, z = _arm(1, i + first[0], j + side + first[1], k + first[2], low, h, at, center)
                        rows[i, j, k, 1] += a
                        rows[i, j, k, 3] -= a * z
                        rows[i, j, k, 5] += a * x
                    a = sign * sz[i, j, k + side]
                    if a != 0.0:
                        at = fz[i, j, k + side]
                        x, y, _ = _arm(2, i + first[0], j + first[1], k + side + first[2], low, h, at, center)
                        rows[i, j, k, 2] += a
                        rows[i, j, k, 3] += a * y
                        rows[i, j, k, 4] -= a * x


def body_rows(cover: Cover, unknown: np.ndarray, walls: Walls, center: Float[np.ndarray, "3"]) -> BodyRows:
    """J of a body with the centre of mass `center` (m) on the cells `unknown` (bool [nx,ny,nz])."""
    shape = tuple(b - a for a, b in zip(cover.low, cover.high))
    rows = np.empty((*shape, 6))
    _gather_rows(
        unknown, np.array(cover.low), walls.grid.low, walls.grid.spacing, *cover.share, *cover.offset, center, rows
    )
    cells = np.argwhere((rows != 0).any(axis=-1))
    return BodyRows(cover.body, cells + np.array(cover.low), rows[tuple(cells.T)])


@njit(cache=True)
def _add_moving_faces(axis, first, low, h, share, offset, opening, distance, center, spin, faces, rows, shift):
    """Rows of the faces that the body covers and that are closed or have their centre inside; their number."""
    b, c, count = (axis + 1) % 3, (axis + 2) % 3, 0
    near, middle = 1e-3 * h, np.zeros(2, offset.dtype)
    for i in range(share.shape[0]):
        for j in range(share.shape[1]):
            for k in range(share.shape[2]):
                if share[i, j, k] == 0.0:
                    continue
                p, q, r = i + first[0], j + first[1], k + first[2]
                if opening[p, q, r] > 0.0:
                    mean = 0.0
                    for s in range(2):
                        for t in range(2):
                            dq = s if axis != 1 else 0
                            dr = t if axis != 2 else 0
                            dp = 0 if axis == 0 else (s if axis == 1 else t)
                            mean += 0.25 * distance[p + dp, q + dq, r + dr]
                    if mean > near:
                        continue
                arm, own = (
                    _arm(axis, p, q, r, low, h, middle, center),
                    _arm(axis, p, q, r, low, h, offset[i, j, k], center),
                )
                part = share[i, j, k] / (1.0 - opening[p, q, r])
                faces[count, 0], faces[count, 1], faces[count, 2], faces[count, 3] = axis, p, q, r
                rows[count, axis] = part
                rows[count, 3 + b] = part * arm[c]
                rows[count, 3 + c] = -part * arm[b]
                shift[count] = part * (spin[b] * (arm[c] - own[c]) - spin[c] * (arm[b] - own[b]))
                count += 1
    return count


def moving_faces(
    cover: Cover, walls: Walls, center: Float[np.ndarray, "3"], spin: Float[np.ndarray, "3"]
) -> tuple[Int[np.ndarray, "n 4"], Float[np.ndarray, "n 6"], Float[np.ndarray, " n"]]:
    """Faces that count as solid and are covered by a body, and how their centres move with it: see `DraggedBody`.

    `center` of mass (m), `spin` in rad/s.
    """
    found = []
    for axis in range(3):
        size = cover.share[axis].size
        faces, rows, shift = np.zeros((size, 4), np.int64), np.zeros((size, 6)), np.zeros(size)
        count = _add_moving_faces(
            axis, np.array(cover.low), walls.grid.low, walls.grid.spacing, cover.share[axis], cover.offset[axis],
            walls.openings[axis], walls.signed_distance, center, spin, faces, rows, shift,
        )  # fmt: skip
        found.append((faces[:count], rows[:count], shift[:count]))
    return triple(np.concatenate(parts) for parts in zip(*found))


def mass_matrix(mass: float, inertia: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "6 6"]:
    """Of velocity and angular velocity about the centre of mass."""
    out = np.zeros((6, 6))
    out[:3, :3], out[3:, 3:] = mass * np.eye(3), inertia
    return out


@njit(cache=True)
def _slope(rate, openings, axis, i, j, k, h):
    """d rate / dx_axis from the neighbours with liquid behind open faces; the last value: how many there are."""
    a, b, c = 1 if axis == 0 else 0, 1 if axis == 1 else 0, 1 if axis == 2 else 0
    here, total, count = rate[i, j, k], 0.0, 0
    index = i if axis == 0 else (j if axis == 1 else k)
    if index > 0 and openings[i, j, k] > 0.0:
        there = rate[i - a, j - b, k - c]
        if there != 0.0:
            total += (here - there) / h
            count += 1
    if index + 1 < rate.shape[axis] and openings[i + a, j + b, k + c] > 0.0:
        there = rate[i + a, j + b, k + c]
        if there != 0.0:
            total += (there - here) / h
            count += 1
    return (total / count if count > 0 else 0.0), count


@njit(cache=True)
def _add_surface_force(rate, solid, openings, axis, first, low, h, share, offset, volume, middle, center, out):
    a, b, c = 1 if axis == 0 else 0, 1 if axis == 1 else 0, 1 if axis == 2 else 0
    arm = np.zeros(3)
    d0, d1 = (1, 2) if axis == 0 else ((0, 2) if axis == 1 else (0, 1))
    mean, known = 0.0, 0
    for sweep in range(2):
        for i in range(volume.shape[0]):
            for j in range(volume.shape[1]):
                for k in range(volume.shape[2]):
                    wet = rate[i + first[0], j + first[1], k + first[2]] != 0.0
                    if not wet and not solid[i + first[0], j + first[1], k + first[2]]:
                        continue
                    below, above, filled = share[i, j, k], share[i + a, j + b, k + c], volume[i, j, k]
                    if filled == 0.0 and below == 0.0 and above == 0.0:
                        continue
                    if sweep == 0:
                        if not wet:
                            continue
                        slope, count = _slope(rate, openings, axis, i + first[0], j + first[1], k + first[2], h)
                        mean += slope
                        known += min(count, 1)
                        continue
                    # volume less half of both faces, and its first moments about the centre of mass
                    force = -mean * h**3 * (filled - 0.5 * (below + above))
                    for d in range(3):
                        cell = (i + first[0]) if d == 0 else ((j + first[1]) if d == 1 else (k + first[2]))
                        arm[d] = (low[d] + (cell + 0.5) * h - center[d]) * force
                        arm[d] += -mean * h**3 * filled * middle[i, j, k, d]
                    for n in range(2):
                        d = d0 if n == 0 else d1
                        shifted = below * offset[i, j, k, n] + above * offset[i + a, j + b, k + c, n]
                        arm[d] += 0.5 * mean * h**3 * shifted
                    out[axis] += force
                    # arm x e_axis
                    out[3 + (axis + 1) % 3] += arm[(axis + 2) % 3]
                    out[3 + (axis + 2) % 3] -= arm[(axis + 1) % 3]
        mean = mean / known if known > 0 else 0.0


def surface_force(
    cover: Cover, rate: Float[np.ndarray, "nx ny nz"], walls: Walls, center: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "6"]:
    """Force and torque over the liquid's density (m^4/s^2, m^5/s^2) that J^T q leaves out; see the module's text.

    By the divergence theorem over the body's part of cell c, of volume V_c: force j = - sum over c of
    dp/dx_j (V_c - h^3 mean of the shares covered of its two faces across j), and its torque with the centres of these
    parts. The slope of the pressure is its mean over the liquid cells at the body, since the parts of single cells
    cancel only under a uniform one.

    Args:
        cover: of the body.
        rate: q / dt (m^2/s^2) of the last solve, 0 in cells without liquid.
        walls: union of terrain and bodies.
        center: of mass, m.
    """
    out = np.zeros(6)
    for axis in range(3):
        _add_surface_force(
            np.asarray(rate, np.float32), walls.solid, walls.openings[axis], axis, np.array(cover.low), walls.grid.low,
            walls.grid.spacing, cover.share[axis], cover.offset[axis], cover.volume, cover.middle, center, out,
        )  # fmt: skip
    return out


@shared(lambda u, v, w, axis, body, first, last, *_: (first[0], last[0]))
def _slide(begin, end, u, v, w, axis, body, first, last, low, h, closed_by, normals, center, velocity, spin, out):
    """Faces closed by one body lose the part of the local velocity, relative to the body, that is normal to it."""
    for i in range(begin, end):
        for j in range(first[1], last[1]):
            for k in range(first[2], last[2]):
                if closed_by[i, j, k] != body:
                    continue
                x = low[0] + (i + (0.0 if axis == 0 else 0.5)) * h - center[0]
                y = low[1] + (j + (0.0 if axis == 1 else 0.5)) * h - center[1]
                z = low[2] + (k + (0.0 if axis == 2 else 0.5)) * h - center[2]
                s0 = velocity[0] + spin[1] * z - spin[2] * y
                s1 = velocity[1] + spin[2] * x - spin[0] * z
                s2 = velocity[2] + spin[0] * y - spin[1] * x
                own, away = 0.0, 0.0
                for b in range(3):
                    other = u if b == 0 else (v if b == 1 else w)
                    solid = s0 if b == 0 else (s1 if b == 1 else s2)
                    if b == axis:
                        own = other[i, j, k]
                        away += normals[i, j, k, b] * (other[i, j, k] - solid)
                        continue
                    # mean of the four faces of component b around this face
                    mx, my, mz = other.shape
                    total = 0.0
                    for s in range(2):
                        for t in range(2):
                            ii = i - s if axis == 0 else (i + t if b == 0 else i)
                            jj = j - s if axis == 1 else (j + t if b == 1 else j)
                            kk = k - s if axis == 2 else (k + t if b == 2 else k)
                            total += other[min(max(ii, 0), mx - 1), min(max(jj, 0), my - 1), min(max(kk, 0), mz - 1)]
                    away += normals[i, j, k, b] * (0.25 * total - solid)
                out[i, j, k] = own - normals[i, j, k, axis] * away


def slide_along_bodies(
    velocity: FaceVelocity,
    slid: FaceVelocity,
    union: UnionWalls,
    center: Float[np.ndarray, "b 3"],
    speeds: tuple[np.ndarray, np.ndarray],
) -> FaceVelocity:
    """`slid` with the faces that bodies close made tangential to them in the bodies' own motion (free slip).

    Args:
        velocity: continued into the solids, m/s.
        slid: the same after `boundaries.slide_along_walls`, which takes all walls to be at rest.
        union: walls of terrain and bodies.
        center: of mass of each body, m.
        speeds: velocity [b,3] m/s and angular velocity [b,3] rad/s.
    """
    grid = union.static.grid
    fields = triple(np.ascontiguousarray(c, np.float32) for c in velocity.components)
    out = [c.copy() for c in slid.components]
    for c in union.covers:
        for axis in range(3):
            _slide(
                *fields, axis, c.body, np.array(c.low), np.array(c.high) + (np.arange(3) == axis), grid.low,
                grid.spacing, union.closed_by[axis], union.walls.normals[axis], center[c.body],
                speeds[0][c.body], speeds[1][c.body], out[axis],
            )  # fmt: skip
    return FaceVelocity(*out)


def fill_films(types: np.ndarray, union: UnionWalls, gravity: Float[np.ndarray, "3"]) -> np.ndarray:
    """Cell types in which thin gaps between bodies and other solids hold liquid where they are joined to liquid.

    Particles do not fit into such gaps (cells mostly in the solid, see `Walls.buried`), and as air they would hold no
    pressure: a light body would stick to the bed. Liquid spreads along them from cell to cell, but not upwards.
    """
    types = types.copy()
    walls = union.walls
    steps = [(axis, sign) for axis in range(3) for sign in (1, -1) if sign * gravity[axis] >= -1e-9]
    for cover in union.covers:
        at = tuple(slice(max(a - 1, 0), min(b + 1, n)) for a, b, n in zip(cover.low, cover.high, types.shape))
        here = types[at]  # a view
        candidates = walls.buried[at] & (here == CellType.EMPTY)
        openings = [
            walls.openings[axis][tuple(slice(s.start, s.stop + (d == axis)) for d, s in enumerate(at))] > 0
            for axis in range(3)
        ]
        for _ in range(sum(here.shape)):
            liquid = here == CellType.FLUID
            reached = np.zeros(here.shape, bool)
            for axis, sign in steps:
                source, target = np.moveaxis(liquid, axis, 0), np.moveaxis(reached, axis, 0)
                passable = np.moveaxis(openings[axis], axis, 0)[1:-1]
                if sign > 0:
                    target[1:] |= source[:-1] & passable
                else:
                    target[:-1] |= source[1:] & passable
            new = reached & candidates
            if not new.any():
                break
            here[new] = CellType.FLUID
            candidates &= ~new
    return types
