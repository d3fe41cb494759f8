"""The compiled loops of `screen_space` over spheres (Numba). Camera axes, metres, float32.

Pictures are drawn in bands of rows, each by one thread and in an order of its particles that is always the same: they
are the same bits with any number of threads.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from fluidlift.numerics.sharing import PIECES, shared
from fluidlift.numerics.triangles import BAND, scattered

_FUSED = {"contract"}
SIDE = 8
"""pixels side by side that are dealt with at a time; columns of a block of which the farthest depth is known"""
BUCKETS = 64
"""by depth, of the spheres of a band: drawn from the front, so that those behind are seen to be hidden"""
FRESH = 128
"""spheres drawn until the farthest depths are looked for again"""


@shared(lambda points, *_: (0, points.shape[0]), error_model="numpy")
def place_spheres(begin, end, points, rotation, translation, radius, lens, size, near, centres, box):
    """Centres in camera axes, and the columns and rows that each sphere may reach: exact bounds of its outline."""
    for i in range(begin, end):
        x = rotation[0, 0] * points[i, 0] + rotation[0, 1] * points[i, 1] + rotation[0, 2] * points[i, 2]
        y = rotation[1, 0] * points[i, 0] + rotation[1, 1] * points[i, 1] + rotation[1, 2] * points[i, 2]
        z = rotation[2, 0] * points[i, 0] + rotation[2, 1] * points[i, 1] + rotation[2, 2] * points[i, 2]
        x, y, z = x + translation[0], y + translation[1], z + translation[2]
        centres[i, 0], centres[i, 1], centres[i, 2] = x, y, z
        box[i, 4] = 0
        if not (z > radius + near and z < math.inf):
            continue
        wide = z * z - radius * radius
        dx, dy = radius * math.sqrt(x * x + wide), radius * math.sqrt(y * y + wide)
        u0 = math.ceil(max(lens[0] * (x * z - dx) / wide + lens[2] - 0.5, 0.0))
        u1 = math.floor(min(lens[0] * (x * z + dx) / wide + lens[2] - 0.5, size[0] - 1.0))
        v0 = math.ceil(max(lens[1] * (y * z - dy) / wide + lens[3] - 0.5, 0.0))
        v1 = math.floor(min(lens[1] * (y * z + dy) / wide + lens[3] - 0.5, size[1] - 1.0))
        if u0 <= u1 and v0 <= v1:
            box[i, 0], box[i, 1], box[i, 2], box[i, 3], box[i, 4] = u0, u1, v0, v1, 1


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _front_to_back(centres, box, listed, order):
    """x, y, z, first and last column, first and last row of the spheres of a band, sorted into `BUCKETS` slices of its
    depth, nearest first; within one as they come. Copied, not pointed at: to look each up would wait for memory."""
    nearest, farthest = np.float32(np.inf), np.float32(0.0)
    for n in range(listed.shape[0]):
        z = centres[listed[n], 2]
        nearest, farthest = min(nearest, z), max(farthest, z)
    scale = np.float32(BUCKETS - 1) / max(farthest - nearest, np.float32(1e-9))
    at = np.zeros(BUCKETS + 1, np.int64)
    for n in range(listed.shape[0]):
        at[np.int64((centres[listed[n], 2] - nearest) * scale) + 1] += 1
    for k in range(BUCKETS):
        at[k + 1] += at[k]
    for n in range(listed.shape[0]):
        k = np.int64((centres[listed[n], 2] - nearest) * scale)
        for c in range(3):
            order[at[k], c] = centres[listed[n], c]
        for c in range(4):
            order[at[k], 3 + c] = box[listed[n], c]
        at[k] += 1


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _farthest(buf, rows, wide, far):
    """The farthest depth in every block of `SIDE` columns of a band's rows."""
    for b in range(far.shape[0]):
        far[b] = 0.0
    for r in range(rows):
        for b in range(far.shape[0]):
            most = far[b]
            base = np.uint64(r * wide + b * SIDE)
            for k in range(np.uint64(SIDE)):
                most = max(most, buf[base + k])
            far[b] = most


@nb.njit(cache=True, nogil=True, error_model="numpy", fastmath=_FUSED)
def _draw_sphere(x, y, z, square, rows, first, last, wide, low, across, down, buf):
    """One sphere into the rows (of the picture) and columns that it may reach; beside it nothing changes."""
    zero, one, far = np.float32(0.0), np.float32(1.0), np.float32(np.inf)
    for begin in range(first, last + 1, SIDE):
        start, step = across[begin], across[begin + 1] - across[begin]
        for row in range(rows[0], rows[1] + 1):
            b = down[row]
            p, bb, by = b * z - y, b * b + one, b * y + z
            base = np.uint64((row - low) * wide + begin)
            for k in range(np.uint64(SIDE)):
                a = start + np.float32(np.int32(k)) * step
                q, s = x - a * z, a * y - b * x
                rr = a * a + bb
                left = rr * square - (p * p + q * q + s * s)
                d = (a * x + by - math.sqrt(max(left, zero))) / rr
                d = d if left > zero else far
                buf[base + k] = min(buf[base + k], d)


@shared(lambda centres, box, starts, *_: (0, (starts.shape[0] - 1)), error_model="numpy", pieces=PIECES)
def sphere_depths(begin, end, centres, box, starts, listed, radius, across, down, depth):
    """Camera z of the nearest sphere; infinite where there is none. across, down: x / z and y / z of pixel centres;
    `across` goes on for `SIDE` columns beyond the picture.

    The ray r meets the sphere c where |r x c|^2 <= |r|^2 R^2: differences of nearby numbers stay exact in float32.
    Spheres come from the front, and those whose nearest point is farther than all that is drawn there are left out.
    """
    count = starts.shape[0] - 1
    square, reach = np.float32(radius * radius), np.float32(radius)
    height, width = depth.shape
    blocks = (width + SIDE - 1) // SIDE
    wide = (blocks + 1) * SIDE
    for t in range(begin, end):
        band = scattered(t, count)
        low, high = band * BAND, min(band * BAND + BAND, height) - 1
        order = np.empty((starts[band + 1] - starts[band], 7), np.float32)
        if order.shape[0] == 0:
            depth[low : high + 1] = np.float32(np.inf)
            continue
        _front_to_back(centres, box, listed[starts[band] : starts[band + 1]], order)
        buf = np.full(BAND * wide, np.float32(np.inf))
        far = np.full(blocks + 1, np.float32(np.inf))
        drawn = 0
        for n in range(order.shape[0]):
            x, y, z, first, last = order[n, 0], order[n, 1], order[n, 2], np.int64(order[n, 3]), np.int64(order[n, 4])
            hidden = True
            for b in range(first // SIDE, last // SIDE + 1):
                hidden = hidden and far[b] <= z - reach
            if hidden:
                continue
            rows = max(low, np.int64(order[n, 5])), min(high, np.int64(order[n, 6]))
            _draw_sphere(x, y, z, square, rows, first, last, wide, low, across, down, buf)
            drawn += 1
            if drawn % FRESH == 0:
                _farthest(buf, high - low + 1, wide, far)
        for row in range(low, high + 1):
            depth[row] = buf[(row - low) * wide : (row - low) * wide + width]


@shared(
    lambda centres, box, starts, *_: (0, (starts.shape[0] - 1)), error_model="numpy", fastmath=_FUSED, pieces=PIECES
)
def sphere_chords(begin, end, centres, box, starts, listed, radius, across, down, depth, colors, sums):
    """Five pictures `sums`: thickness, three of weighted colour, and their weight.

    The thickness is the sum of the ray's lengths (m) in all spheres. The colours are those of spheres less than a
    diameter from the nearest surface, weighted with their length and (1 - (distance / diameter)^2)^3: so a colour lies
    on a surface seen at a slant as flat as the surface itself, and what is deeper, and seen elsewhere, fades. Without
    `colors` (an empty array) the thickness alone.

    depth: as `sphere_depths` gives it, at `step` times the resolution of `sums`.
    """
    count = starts.shape[0] - 1
    square, reach = np.float32(radius * radius), np.float32(2.0 * radius)
    zero, one, support = np.float32(0.0), np.float32(1.0), np.float32(4.0) * square
    step = depth.shape[0] // sums.shape[1]
    for t in range(begin, end):
        band = scattered(t, count)
        low, high = band * BAND, min(band * BAND + BAND, sums.shape[1]) - 1
        for n in range(starts[band], starts[band + 1]):
            i = listed[n]
            x, y, z = centres[i, 0], centres[i, 1], centres[i, 2]
            first, last = box[i, 0], box[i, 1]
            middle = depth[step * ((box[i, 2] + box[i, 3]) // 2), step * ((first + last) // 2)]
            seen = colors.shape[0] > 0 and (z - middle < reach or middle == np.inf)
            for row in range(max(low, box[i, 2]), min(high, box[i, 3]) + 1):
                b = down[row]
                p = b * z - y
                line = sums[0, row]
                for k in range(np.uint64(first), np.uint64(last + 1)):
                    a = across[k]
                    q, s = x - a * z, a * y - b * x
                    rr = a * a + b * b + one
                    chord = math.sqrt(max(rr * square - (p * p + q * q + s * s), zero) / rr)
                    line[k] += chord + chord
                    d = depth[step * row, step * k]
                    if seen and d < np.inf:
                        away = (a * d - x) ** 2 + (b * d - y) ** 2 + (d - z) ** 2
                        weight = chord * max(one - away / support, zero) ** 3
                        for c in range(3):
                            sums[1 + c, row, k] += weight * colors[i, c]
                        sums[4, row, k] += weight
