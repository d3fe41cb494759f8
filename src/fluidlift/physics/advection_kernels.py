"""The back-trace of `advection` and its adjoint in Numba, over runs of faces along z (see `rollout_kernels`).

Displacements are split into whole cells and fractions before the position of the face is added: so single precision
keeps all its digits in the weights. Loops without branches or scattered writes are written apart, for vector registers.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from fluidlift.physics.rollout_kernels import FAST, U


@njit(cache=True, nogil=True, forceinline=True)
def _shifts(axis, other, place, shapes):
    """Where the four faces of component `other` around a face across `axis` lie: flat index less k of the face.

    place = (i, j, k): only a k at the end of the row matters, see `find_runs`. Returns the low and the high cell's
    first face, and the step to its second one.
    """
    shape, cells = shapes[other], shapes[axis][axis] - 1
    steps = (shape[1] * shape[2], shape[2], 1)
    start = place[0] * steps[0] + place[1] * steps[1]
    index = place[axis]
    low, high = max(index - 1, 0) - index, min(index, cells - 1) - index
    return start + low * steps[axis], start + high * steps[axis], steps[other]


@njit(cache=True, nogil=True, fastmath=FAST, forceinline=True)
def _mean_of_four(v, low, high, step, k, count, out):
    """out[t] = mean of the four faces around face k + t."""
    a, b = U(low + k), U(high + k)
    c, d = U(low + step + k), U(high + step + k)
    quarter = v.dtype.type(0.25)
    for t in range(U(count)):
        out[t] = quarter * ((v[a + t] + v[b + t]) + (v[c + t] + v[d + t]))


@njit(cache=True, nogil=True, forceinline=True)
def _split(way, below, above, most):
    """Whole cells and fraction of a displacement that is clamped to [-below, above]; the cells stay below `most`."""
    clamped = min(max(way, -below), above)
    whole = min(np.floor(clamped), most)
    return whole, clamped - whole


@njit(cache=True, nogil=True, fastmath={"contract", "nsz"})
def advect_component(axis, velocity, shapes, k, runs, out):
    """out = the component across `axis` carried along the velocity, at the runs' faces. k = time step / spacing."""
    q, shape = velocity[axis], shapes[axis]
    b, c = (axis + 1) % 3, (axis + 2) % 3
    real = q.dtype.type
    vb, vc = np.empty(shape[2], q.dtype), np.empty(shape[2], q.dtype)
    one = real(1)
    sx, sy = np.int32(shape[1] * shape[2]), np.int32(shape[2])
    dx, dy, dz = min(shape[0] - 1, 1) * sx, min(shape[1] - 1, 1) * sy, np.int32(min(shape[2] - 1, 1))
    for r in range(len(runs)):
        i, j, k0, count = np.int64(runs[r, 0]), np.int64(runs[r, 1]), np.int64(runs[r, 2]), np.int64(runs[r, 3])
        place = (i, j, k0)
        low, high, step = _shifts(axis, b, place, shapes)
        _mean_of_four(velocity[b], low, high, step, k0, count, vb)
        low, high, step = _shifts(axis, c, place, shapes)
        _mean_of_four(velocity[c], low, high, step, k0, count, vc)
        row = np.int32((i * shape[1] + j) * shape[2] + k0)
        xm, ym = real(max(shape[0] - 2, 0) - i), real(max(shape[1] - 2, 0) - j)
        xl, yl, xh, yh = real(i), real(j), real(shape[0] - 1 - i), real(shape[1] - 1 - j)
        for t in range(U(count)):
            here = row + np.int32(t)
            va = q[U(here)]
            vx = va if axis == 0 else (vc[t] if axis == 1 else vb[t])
            vy = va if axis == 1 else (vb[t] if axis == 0 else vc[t])
            vz = va if axis == 2 else (vc[t] if axis == 0 else vb[t])
            z = real(np.int32(k0) + np.int32(t))
            wx, fx = _split(-k * vx, xl, xh, xm)
            wy, fy = _split(-k * vy, yl, yh, ym)
            wz, fz = _split(-k * vz, z, real(shape[2] - 1) - z, real(max(shape[2] - 2, 0)) - z)
            o = here + np.int32(wx) * sx + np.int32(wy) * sy + np.int32(wz)
            p = o + dx
            ey, ez = one - fy, one - fz
            near = (q[U(o)] * ey + q[U(o + dy)] * fy) * ez + (q[U(o + dz)] * ey + q[U(o + dy + dz)] * fy) * fz
            far = (q[U(p)] * ey + q[U(p + dy)] * fy) * ez + (q[U(p + dz)] * ey + q[U(p + dy + dz)] * fy) * fz
            out[U(here)] = near * (one - fx) + far * fx


@njit(cache=True, nogil=True, fastmath=FAST, forceinline=True)
def _add(g, start, count, change):
    first = U(start)
    for t in range(U(count)):
        g[first + t] += change[t]


@njit(cache=True, nogil=True, fastmath=FAST, forceinline=True)
def _spread(g, low, high, step, k, count, change):
    """The transpose of `_mean_of_four`, without its quarter."""
    for o in (low + k, high + k, low + step + k, high + step + k):
        _add(g, o, count, change)


@njit(cache=True, nogil=True, forceinline=True)
def _scatter(g, base, corners, count, steps):
    """Adds the eight values of each face to the corners of the cell that starts at `base`.

    One plane after the other: addresses a multiple of 4096 bytes apart in turn would hinder each other.
    """
    ux, uy, uz = steps
    for half in range(2):
        shift, column = U(half) * ux, U(4 * half)
        for t in range(U(count)):
            o, m = U(base[t]) + shift, U(8) * t + column
            g[o] += corners[m]
            g[o + uy] += corners[m + U(1)]
            g[o + uz] += corners[m + U(2)]
            g[o + uy + uz] += corners[m + U(3)]


@njit(cache=True, nogil=True, fastmath={"contract", "nsz"})
def advect_component_adjoint(axis, velocity, shapes, k, runs, g, totals):
    """Adds the adjoint of `advect_component` to totals (one array per component); returns the derivative by k."""
    q, shape, gq = velocity[axis], shapes[axis], totals[axis]
    b, c = (axis + 1) % 3, (axis + 2) % 3
    real = q.dtype.type
    n = shape[2]
    vb, vc, tb, tc, ta = (np.empty(n, q.dtype), np.empty(n, q.dtype), np.empty(n, q.dtype), np.empty(n, q.dtype),
                          np.empty(n, q.dtype))  # fmt: skip
    corners, base = np.empty(8 * n, q.dtype), np.empty(n, np.int32)
    one, zero, gk = real(1), real(0), 0.0
    sx, sy = np.int32(shape[1] * shape[2]), np.int32(shape[2])
    dx, dy, dz = min(shape[0] - 1, 1) * sx, min(shape[1] - 1, 1) * sy, np.int32(min(shape[2] - 1, 1))
    for r in range(len(runs)):
        i, j, k0, count = np.int64(runs[r, 0]), np.int64(runs[r, 1]), np.int64(runs[r, 2]), np.int64(runs[r, 3])
        place = (i, j, k0)
        low_b, high_b, step_b = _shifts(axis, b, place, shapes)
        _mean_of_four(velocity[b], low_b, high_b, step_b, k0, count, vb)
        low_c, high_c, step_c = _shifts(axis, c, place, shapes)
        _mean_of_four(velocity[c], low_c, high_c, step_c, k0, count, vc)
        row = np.int32((i * shape[1] + j) * shape[2] + k0)
        xm, ym = real(max(shape[0] - 2, 0) - i), real(max(shape[1] - 2, 0) - j)
        xl, yl, xh, yh = real(i), real(j), real(shape[0] - 1 - i), real(shape[1] - 1 - j)
        part = zero
        for t in range(U(count)):
            here = row + np.int32(t)
            s, va = g[U(here)], q[U(here)]
            vx = va if axis == 0 else (vc[t] if axis == 1 else vb[t])
            vy = va if axis == 1 else (vb[t] if axis == 0 else vc[t])
            vz = va if axis == 2 else (vc[t] if axis == 0 else vb[t])
            z = real(np.int32(k0) + np.int32(t))
            rx, ry, rz, zh = -k * vx, -k * vy, -k * vz, real(shape[2] - 1) - z
            wx, fx = _split(rx, xl, xh, xm)
            wy, fy = _split(ry, yl, yh, ym)
            wz, fz = _split(rz, z, zh, real(max(shape[2] - 2, 0)) - z)
            o = here + np.int32(wx) * sx + np.int32(wy) * sy + np.int32(wz)
            p = o + dx
            ex, ey, ez = one - fx, one - fy, one - fz
            q000, q010, q001, q011 = q[U(o)], q[U(o + dy)], q[U(o + dz)], q[U(o + dy + dz)]
            q100, q110, q101, q111 = q[U(p)], q[U(p + dy)], q[U(p + dz)], q[U(p + dy + dz)]
            base[t] = o
            snear, sfar = s * ex, s * fx
            m = U(8) * t
            corners[m], corners[m + U(1)] = snear * ey * ez, snear * fy * ez
            corners[m + U(2)], corners[m + U(3)] = snear * ey * fz, snear * fy * fz
            corners[m + U(4)], corners[m + U(5)] = sfar * ey * ez, sfar * fy * ez
            corners[m + U(6)], corners[m + U(7)] = sfar * ey * fz, sfar * fy * fz
            tx = ((q100 - q000) * ey + (q110 - q010) * fy) * ez + ((q101 - q001) * ey + (q111 - q011) * fy) * fz
            ty = ((q010 - q000) * ex + (q110 - q100) * fx) * ez + ((q011 - q001) * ex + (q111 - q101) * fx) * fz
            tz = ((q001 - q000) * ex + (q101 - q100) * fx) * ey + ((q011 - q010) * ex + (q111 - q110) * fx) * fy
            # a clamped coordinate does not move with the velocity
            tx = s * tx if -xl <= rx and rx <= xh else zero
            ty = s * ty if -yl <= ry and ry <= yh else zero
            tz = s * tz if -z <= rz and rz <= zh else zero
            part -= tx * vx + ty * vy + tz * vz
            ta[t] = -k * (tx if axis == 0 else (ty if axis == 1 else tz))
            tb[t] = real(-0.25) * k * (ty if axis == 0 else (tz if axis == 1 else tx))
            tc[t] = real(-0.25) * k * (tz if axis == 0 else (tx if axis == 1 else ty))
        gk += part
        _scatter(gq, base, corners, count, (U(dx), U(dy), U(dz)))
        _add(gq, np.int64(row), count, ta)
        _spread(totals[b], low_b, high_b, step_b, k0, count, tb)
        _spread(totals[c], low_c, high_c, step_c, k0, count, tc)
    return gk
