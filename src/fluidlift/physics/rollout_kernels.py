"""Numba kernels of the differentiable rollout and of their adjoints, on compact lists of faces.

All release the interpreter's lock and run on one thread: rollouts run side by side in threads instead. Sums are kept
in double precision and in a fixed order, so results do not depend on how many threads there are.

Arrays of faces are flat: u, then v, then w. A run is a stretch of faces along z: `runs` [n,4] holds i, j, the first k
and the count, `planes` where the runs of each i begin. A face component goes by (start, shape): where it begins in the
flat vector, and the numbers of its faces along x, y, z.
"""

from __future__ import annotations

import numpy as np
from numba import njit

FAST = {"contract", "nsz", "reassoc"}
"""sums may be reordered for vector registers; not-a-number stays what it is"""
U = np.uint64


@njit(cache=True, nogil=True)
def find_runs(mask, split_ends):
    """Runs of a bool [a,b,c] along its last axis, and where the runs of each plane begin.

    split_ends: the first and the last face of a row stand alone (their neighbours lie on one side only).
    """
    a, b, c = mask.shape
    runs = np.empty((a * b * (c // 2 + 2), 4), np.int32)
    planes = np.zeros(a + 1, np.int32)
    n = 0
    for i in range(a):
        planes[i] = n
        for j in range(b):
            k = 0
            while k < c:
                if not mask[i, j, k]:
                    k += 1
                    continue
                begin = k
                while k < c and mask[i, j, k]:
                    k += 1
                    if split_ends and (k == 1 or k == c - 1):
                        break
                runs[n, 0], runs[n, 1], runs[n, 2], runs[n, 3] = i, j, begin, k - begin
                n += 1
    planes[a] = n
    return runs[:n].copy(), planes


@njit(cache=True, nogil=True)
def _neighbours(f, shape, out):
    """Flat indices of the neighbours of entry f of an array, in out; returns how many there are."""
    a, b, c = shape
    i, j, k = f // (b * c), f // c % b, f % c
    n = 0
    if i > 0:
        out[n] = f - b * c
        n += 1
    if i < a - 1:
        out[n] = f + b * c
        n += 1
    if j > 0:
        out[n] = f - c
        n += 1
    if j < b - 1:
        out[n] = f + c
        n += 1
    if k > 0:
        out[n] = f - 1
        n += 1
    if k < c - 1:
        out[n] = f + 1
        n += 1
    return n


@njit(cache=True, nogil=True)
def extrapolation_lists(known, shape, start, sweeps):
    """Unknown entries in the order in which sweeps reach them, and the neighbours whose mean each takes.

    Returns faces [m], first [m+1], neighbours: entry faces[n] takes neighbours[first[n]:first[n+1]], all counted from
    `start` on.
    """
    size = known.size
    level = np.full(size, -1, np.int16)
    unknown = 0
    for f in range(size):
        if known[f]:
            level[f] = 0
        else:
            unknown += 1
    faces = np.empty(unknown, np.int32)
    around, beyond = np.empty(6, np.int64), np.empty(6, np.int64)
    count, before = 0, 0
    for sweep in range(1, sweeps + 1):
        begin = count
        if sweep == 1:
            for f in range(size):
                if level[f] < 0:
                    for m in range(_neighbours(f, shape, around)):
                        if level[around[m]] == 0:
                            faces[count] = f
                            count += 1
                            break
            for n in range(count):
                level[faces[n]] = 1
        else:
            for n in range(before, begin):
                for m in range(_neighbours(np.int64(faces[n]), shape, around)):
                    if level[around[m]] < 0:
                        level[around[m]] = sweep
                        faces[count] = around[m]
                        count += 1
        before = begin
    first = np.zeros(count + 1, np.int32)
    neighbours = np.empty(6 * count, np.int32)
    used = 0
    for n in range(count):
        f = np.int64(faces[n])
        for m in range(_neighbours(f, shape, beyond)):
            if 0 <= level[beyond[m]] < level[f]:
                neighbours[used] = beyond[m] + start
                used += 1
        first[n + 1] = used
        faces[n] += start
    return faces[:count].copy(), first, neighbours[:used].copy()


@njit(cache=True, nogil=True)
def extrapolate(x, known, faces, first, neighbours, out):
    """out = x at known faces, means of the neighbours at `faces` in turn, 0 elsewhere."""
    zero = x.dtype.type(0)
    for f in range(len(x)):
        out[f] = x[f] if known[f] else zero
    for n in range(len(faces)):
        total = zero
        for m in range(first[n], first[n + 1]):
            total += out[neighbours[m]]
        out[faces[n]] = total / x.dtype.type(first[n + 1] - first[n])


@njit(cache=True, nogil=True)
def extrapolate_adjoint(g, known, faces, first, neighbours, out):
    """The transposed sweeps, last face first."""
    zero = g.dtype.type(0)
    for f in range(len(g)):
        out[f] = g[f]
    for n in range(len(faces) - 1, -1, -1):
        share = out[faces[n]] / g.dtype.type(first[n + 1] - first[n])
        for m in range(first[n], first[n + 1]):
            out[neighbours[m]] += share
    for f in range(len(g)):
        out[f] = out[f] if known[f] else zero


@njit(cache=True, nogil=True)
def walls(v, faces, layout, damping, bounce, reach, arrived):
    """Friction along walls and bounce across them, in place; `arrived` [n] keeps the values before.

    layout = (share, below, above) of `faces`; reach = time step / spacing.
    """
    share, below, above = layout
    for n in range(len(faces)):
        before = v[faces[n]]
        arrived[n] = before
        y = before * (1 - 0.5 * damping * share[n])
        ahead = below[n] if y < 0 else above[n]
        v[faces[n]] = y * (1 - bounce * ahead * min(abs(y) * reach, 1.0))


@njit(cache=True, nogil=True)
def walls_adjoint(g, faces, layout, damping, bounce, reach, arrived):
    """g becomes the gradient before the walls; returns those of damping, bounce and reach."""
    share, below, above = layout
    to_damping, to_bounce, to_reach = 0.0, 0.0, 0.0
    for n in range(len(faces)):
        friction = 1 - 0.5 * damping * share[n]
        y = np.float64(arrived[n]) * friction
        ahead = np.float64(below[n] if y < 0 else above[n])
        size = abs(y)
        arriving = min(size * reach, 1.0)
        s = np.float64(g[faces[n]])
        back = s * (1 - bounce * ahead * arriving)
        to_bounce -= s * y * ahead * arriving
        if size * reach <= 1.0:
            back -= s * bounce * ahead * size * reach
            to_reach -= s * y * bounce * ahead * size
        to_damping -= back * arrived[n] * 0.5 * share[n]
        g[faces[n]] = back * friction
    return to_damping, to_bounce, to_reach


@njit(cache=True, nogil=True, fastmath=FAST)
def push(v, component, runs, share, change):
    """v += change * share over runs of faces."""
    start, shape = component
    for r in range(len(runs)):
        o = U(start + (np.int64(runs[r, 0]) * shape[1] + runs[r, 1]) * shape[2] + runs[r, 2])
        for t in range(U(runs[r, 3])):
            v[o + t] += change * share[o + t]


@njit(cache=True, nogil=True, fastmath=FAST)
def weighted_sum(g, component, runs, share):
    """Sum of g * share over runs of faces."""
    start, shape = component
    total = 0.0
    for r in range(len(runs)):
        o = U(start + (np.int64(runs[r, 0]) * shape[1] + runs[r, 1]) * shape[2] + runs[r, 2])
        part = share.dtype.type(0)
        for t in range(U(runs[r, 3])):
            part += g[o + t] * share[o + t]
        total += part
    return total


@njit(cache=True, nogil=True)
def cells_from_faces(v, weight, unknown, scale, out):
    """out = scale * (sum over the faces of a cell of weight v, upper sides less lower sides); 0 off unknown cells."""
    nx, ny, nz = unknown.shape
    v_start = (nx + 1) * ny * nz
    w_start = v_start + nx * (ny + 1) * nz
    zero = v.dtype.type(0)
    for i in range(nx):
        for j in range(ny):
            a, b = U((i * ny + j) * nz), U(((i + 1) * ny + j) * nz)
            c, d = U(v_start + (i * (ny + 1) + j) * nz), U(v_start + (i * (ny + 1) + j + 1) * nz)
            e = U(w_start + (i * ny + j) * (nz + 1))
            for k in range(U(nz)):
                total = weight[b + k] * v[b + k] - weight[a + k] * v[a + k]
                total += weight[d + k] * v[d + k] - weight[c + k] * v[c + k]
                total += weight[e + k + U(1)] * v[e + k + U(1)] - weight[e + k] * v[e + k]
                out[i, j, k] = scale * total if unknown[i, j, k] else zero


@njit(cache=True, nogil=True)
def faces_from_cells(q, weight, unknown, scale, out):
    """out += scale * weight * (q of the cell above - q of the cell below) at every face; q counts in unknown cells."""
    nx, ny, nz = unknown.shape
    v_start = (nx + 1) * ny * nz
    w_start = v_start + nx * (ny + 1) * nz
    zero = q.dtype.type(0)
    line = np.zeros(nz, q.dtype)
    for i in range(nx):
        for j in range(ny):
            some = False
            for k in range(nz):
                line[k] = scale * q[i, j, k] if unknown[i, j, k] else zero
                some |= unknown[i, j, k]
            if not some:
                continue
            a, b = U((i * ny + j) * nz), U(((i + 1) * ny + j) * nz)
            c, d = U(v_start + (i * (ny + 1) + j) * nz), U(v_start + (i * (ny + 1) + j + 1) * nz)
            e = U(w_start + (i * ny + j) * (nz + 1))
            for k in range(U(nz)):
                out[a + k] += weight[a + k] * line[k]
            for k in range(U(nz)):
                out[b + k] -= weight[b + k] * line[k]
            for k in range(U(nz)):
                out[c + k] += weight[c + k] * line[k]
            for k in range(U(nz)):
                out[d + k] -= weight[d + k] * line[k]
            for k in range(U(nz)):
                out[e + k] += weight[e + k] * line[k]
            for k in range(U(nz)):
                out[e + k + U(1)] -= weight[e + k + U(1)] * line[k]


@njit(cache=True, nogil=True)
def count_couplings(dynamic, prescribed, wall, axis, start):
    """What `viscous_matrices` puts on the diagonal, in units of 1/h^2, and the pairs (dynamic, prescribed neighbour).

    Masks are bool [a,b,c] of one component that starts at `start`. Returns uint8 [a,b,c], rows, cols.
    """
    a, b, c = dynamic.shape
    out = np.zeros((a, b, c), np.uint8)
    pairs = 0
    rows, cols = np.empty(0, np.int32), np.empty(0, np.int32)
    for fill in range(2):
        if fill:
            rows, cols = np.empty(pairs, np.int32), np.empty(pairs, np.int32)
            pairs = 0
        for i in range(a):
            for j in range(b):
                for k in range(c):
                    if not dynamic[i, j, k]:
                        continue
                    total = 0
                    for direction in range(3):
                        for side in range(-1, 2, 2):
                            x = i + side if direction == 0 else i
                            y = j + side if direction == 1 else j
                            z = k + side if direction == 2 else k
                            if x < 0 or y < 0 or z < 0 or x >= a or y >= b or z >= c:
                                continue
                            if prescribed[x, y, z]:
                                if fill:
                                    rows[pairs] = start + (i * b + j) * c + k
                                    cols[pairs] = start + (x * b + y) * c + z
                                pairs += 1
                                total += 1
                            elif dynamic[x, y, z] or (direction == axis and wall[x, y, z]):
                                total += 1
                    out[i, j, k] = total
    return out, rows, cols
