"""The compiled loops of `screen_space` that smooth a surface, and those of meshes (Numba). Camera axes, metres,
float32.

What one thread writes no other one reads: pictures are the same bits with any number of threads.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from fluidlift.numerics.sharing import PIECES, shared

_FUSED = {"contract"}
LARGEST_WINDOW = 40
"""pairs of pixels that one pass of the smoothing averages, however near the liquid is"""
LEAST = np.float32(0.3)
"""px: a narrower bell averages nothing"""
NEARER = np.float32(1e18)
"""1/m, nearer than anything: what lies beyond the picture's rim. Not infinite: no weight times it must be nothing"""
LANES = 32
"""pixels side by side that are smoothed at a time, with pairs equally far apart"""
HIGH, WEIGHT, FADE, FADING, BEFORE, AFTER = (np.uint64(k * LANES) for k in range(1, 7))
SUMS, SUMS_K, SUMS_KK, SUMS_D, SUMS_KD = (np.uint64(k * LANES) for k in range(7, 12))
"""places in the state of `_take_pair`, after the lowest at 0"""


@shared(lambda depth, ground, near, behind, q: (0, q.shape[0]), error_model="numpy")
def inverse_depths(begin, end, depth, ground, near, behind, q):
    """Inverse depth (1/m) of the nearest spheres (m; infinite: none), also of those that lie more than `behind` (m)
    behind the ground that hides them, as a pond does behind a rock; else the negative one of the ground (m; 0: none),
    or 0: what the smoothing takes."""
    one = np.float32(1.0)
    for row in range(begin, end):
        for col in range(q.shape[1]):
            z, bed = depth[row, col], ground[row, col]
            if z < np.inf and (bed <= 0 or z < bed or z > bed + behind):
                q[row, col] = one / max(z, near)
            elif bed > 0:
                q[row, col] = -one / max(bed, near)
            else:
                q[row, col] = 0.0


@nb.njit(cache=True, fastmath=_FUSED, error_model="numpy")
def _begin(own, stride, factor, limit, state):
    """What `_take_pair` goes on from, for some pixels side by side: see the offsets there."""
    zero, one, three = np.float32(0.0), np.float32(1.0), np.float32(1.0 / 3.0)
    for k in range(np.uint64(own.shape[0])):
        bell = max(factor * own[k], LEAST) / stride
        # exp(-1 / (2 bell^2)) as a power of 64, without a call: lanes side by side
        x = np.float32(0.5 / 64.0) / (bell * bell)
        fade = one - x * (one - np.float32(0.5) * x * (one - three * x))
        for _ in range(6):
            fade = fade * fade
        narrow = limit * own[k] * own[k]
        goes = one if factor * own[k] > LEAST else zero
        state[k] = own[k] - narrow
        state[k + HIGH] = own[k] + narrow
        state[k + WEIGHT] = one
        state[k + FADE] = fade
        state[k + FADING] = fade * fade
        state[k + BEFORE] = goes
        state[k + AFTER] = goes
        state[k + SUMS] = one
        for n in range(np.uint64(1), np.uint64(5)):
            state[k + SUMS + n * np.uint64(LANES)] = zero


@nb.njit(cache=True, fastmath=_FUSED, error_model="numpy")
def _take_pair(before, after, own, distance, limit, fall, state):
    """One pair of neighbours of each of some pixels side by side. state: lowest and highest inverse depth met, the last
    weight and its factor, and that one's: exp(-k^2 / (2 bell^2)) from the one before; whether the window is open (1) on
    either side; and the sums of the weights w, of w k, w k^2, w d and w k d over what was met, at k pairs (`distance`),
    d above the pixel's own. One buffer with fixed offsets: the compiler sees that lanes do not touch.
    """
    zero = np.float32(0.0)
    for k in range(np.uint64(own.shape[0])):
        narrow, dropped = limit * own[k] * own[k], -fall * own[k] * own[k]
        one, two = abs(before[k]), abs(after[k])
        low, high = state[k], state[k + HIGH]
        weight = state[k + WEIGHT] * state[k + FADE]
        state[k + WEIGHT] = weight
        state[k + FADE] = state[k + FADE] * state[k + FADING]
        first, second = state[k + BEFORE] if one <= high else zero, state[k + AFTER] if two <= high else zero
        state[k + BEFORE], state[k + AFTER] = first, second
        is_one, is_two = one > low, two > low
        # what falls off on one side says nothing of how far the surface itself goes on
        both = (is_one or first == zero) and (is_two or second == zero)
        top = max(one if first > zero else low, two if second > zero else low)
        bottom = min(one if first > zero else high, two if second > zero else high)
        state[k + HIGH] = max(high, top + narrow) if both else high
        state[k] = min(low, bottom - narrow) if both else low
        one, two = one - own[k] if is_one else dropped, two - own[k] if is_two else dropped
        first, second = weight * first, weight * second
        state[k + SUMS] += first + second
        state[k + SUMS_K] += distance * (second - first)
        state[k + SUMS_KK] += distance * distance * (first + second)
        first, second = first * one, second * two
        state[k + SUMS_D] += first + second
        state[k + SUMS_KD] += distance * (second - first)


@nb.njit(cache=True, inline="always")
def _stride_and_steps(own, factor, apart):
    """Pixels between pairs, at least `apart` of which there are per standard deviation, and how many pairs, for some
    pixels side by side; none where nothing is to be smoothed."""
    least, most = np.float32(np.inf), np.float32(0.0)
    for k in range(own.shape[0]):
        wide = factor * own[k]
        if wide > LEAST:
            least, most = min(least, wide), max(most, wide)
    if most <= 0:
        return 1, 0
    stride = max(int(least / apart), 1)
    return stride, min(max(int(np.float32(2.0) * most / np.float32(stride)), 1), LARGEST_WINDOW)


@shared(lambda q, *_: (0, q.shape[0]), error_model="numpy", fastmath=_FUSED, pieces=PIECES)
def narrow_range(begin, end, q, out, across, focal, width, apart, limit, fall):
    """One pass of smoothing along rows (`across`) or columns of inverse depth q (1/m; negative: of ground beside the
    liquid, 0: nothing there).

    After the narrow-range filter of Truong and Yuksel 2018: depths within `limit` (m) of what was met so far are
    averaged; what lies nearer ends the window on its side; what lies farther counts as if it fell off by `fall` (m),
    which rounds outlines. Three things differ from the paper:

    - inverse depth is averaged, which is linear across the picture of a plane;
    - a straight line is fitted to it (local linear regression), so that planes stay planes, also where the window is
      open on one side alone;
    - ground close behind an outline is averaged like liquid, so that the surface runs out on it without a rim.

    `width` (m) is the standard deviation of the Gaussian weights; wide ones skip pixels, but take `apart` samples per
    standard deviation at least.
    """
    h, w = q.shape
    factor = np.float32(focal * width)
    for row in range(begin, end):
        state = np.empty(12 * LANES, np.float32)
        outside = np.full(LANES, NEARER, np.float32)
        line = np.full(3 * w if across else 1, NEARER, np.float32)
        if across:
            line[w : 2 * w] = q[row]
        for first in range(0, w, LANES):
            last = min(first + LANES, w)
            own = q[row, first:last]
            out[row, first:last] = own
            stride, steps = _stride_and_steps(own, factor, apart)
            if steps == 0:
                continue
            _begin(own, np.float32(stride), factor, limit, state)
            for k in range(1, steps + 1):
                d = k * stride
                if d >= (w if across else h):
                    break
                if across:
                    before, after = line[w + first - d : w + last - d], line[w + first + d : w + last + d]
                else:
                    before = q[row - d, first:last] if row >= d else outside[: last - first]
                    after = q[row + d, first:last] if row + d < h else outside[: last - first]
                _take_pair(before, after, own, np.float32(k), limit, fall, state)
            for n in range(last - first):
                k = np.uint64(n)
                s, sk, skk = state[k + SUMS], state[k + SUMS_K], state[k + SUMS_KK]
                most = s * skk - sk * sk
                if own[n] > 0 and most > 0:
                    out[row, first + n] = own[n] + (skk * state[k + SUMS_D] - sk * state[k + SUMS_KD]) / most


@shared(lambda inverse, *_: (0, inverse.shape[0]), error_model="numpy")
def filled_notches(begin, end, inverse, closed, least):
    """Inverse depths (1/m; 0 or less: no liquid) raised to those of `closed` where that is more than `least` (m)
    nearer, in place."""
    for row in range(begin, end):
        for col in range(inverse.shape[1]):
            own, other = abs(inverse[row, col]), closed[row, col]
            if other - own > least * other * own:
                inverse[row, col] = other


@nb.njit(cache=True, inline="always")
def _slope(before, own, after, limit):
    """Difference per pixel: of both sides where both belong to the surface, else of the one that does."""
    left, right = own - before, after - own
    has_left, has_right = before > 0 and abs(left) < limit, after > 0 and abs(right) < limit
    if has_left and has_right:
        return np.float32(0.5) * (left + right)
    if has_left:
        return left
    if has_right:
        return right
    return np.float32(0.0)


@shared(lambda q, *_: (0, q.shape[0]), error_model="numpy")
def plane_normals(begin, end, q, lens, rotation, limit, normal):
    """Unit normals (world, towards the viewer) of the surface of inverse depth q (1/m; 0 or less: none).

    On the plane n . p = 1 the inverse depth is n . (x/z, y/z, 1): its slopes in the picture are n, without error.
    limit: m, steps from pixel to pixel beyond which they belong to different surfaces.
    """
    h, w = q.shape
    for row in range(begin, end):
        b = (row + 0.5 - lens[3]) / lens[1]
        for col in range(w):
            own = q[row, col]
            if own <= 0:
                continue
            most = limit * own * own
            x = lens[0] * _slope(q[row, max(col - 1, 0)], own, q[row, min(col + 1, w - 1)], most)
            y = lens[1] * _slope(q[max(row - 1, 0), col], own, q[min(row + 1, h - 1), col], most)
            if col == 0 or col == w - 1:
                x *= 2.0  # one of both sides is the pixel itself
            if row == 0 or row == h - 1:
                y *= 2.0
            a = (col + 0.5 - lens[2]) / lens[0]
            z = own - a * x - b * y
            length = -math.sqrt(x * x + y * y + z * z)
            x, y, z = x / length, y / length, z / length
            for k in range(3):
                normal[row, col, k] = rotation[0, k] * x + rotation[1, k] * y + rotation[2, k] * z


@shared(lambda q, *_: (0, q.shape[0]), error_model="numpy")
def depths_and_cover(begin, end, q, ground, thickness, near, limits, depth, covered):
    """Depth (m; 0: no liquid) of inverse depths q that the ground (m; 0: none) does not hide, and the share of each
    pixel that liquid of this thickness covers.

    near: share of what is around that spheres cover. limits: thickness (m) of full cover, and shares `near` of none and
    of full cover.
    """
    zero, one = np.float32(0.0), np.float32(1.0)
    thin, none, whole = limits[0], limits[1], limits[2]
    for row in range(begin, end):
        for col in range(q.shape[1]):
            bed = ground[row, col]
            there = q[row, col] > zero and (bed <= zero or q[row, col] * bed > one)
            depth[row, col] = one / q[row, col] if there else zero
            share = min(thickness[row, col] / thin, (near[row, col] - none) / (whole - none))
            covered[row, col] = min(max(share, zero), one) if there else zero


@nb.njit(cache=True)
def smooth_normals(vertices, faces, normals):
    """Sum of the faces' normals, weighted with their areas, in every vertex."""
    for i in range(faces.shape[0]):
        a, b, c = faces[i, 0], faces[i, 1], faces[i, 2]
        x, y, z = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
        u, v, w = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
        nx, ny, nz = y * w - z * v, z * u - x * w, x * v - y * u
        for k in range(3):
            at = faces[i, k]
            normals[at, 0] += nx
            normals[at, 1] += ny
            normals[at, 2] += nz


@shared(lambda vectors: (0, vectors.shape[0]), error_model="numpy")
def unit_rows(begin, end, vectors):
    """Vectors [n,3] made unit, in place; those of length 0 stay."""
    for i in range(begin, end):
        length = math.sqrt(vectors[i, 0] ** 2 + vectors[i, 1] ** 2 + vectors[i, 2] ** 2)
        if length > 0:
            vectors[i, 0] /= length
            vectors[i, 1] /= length
            vectors[i, 2] /= length


@shared(lambda hit, *_: (0, hit.shape[0]), error_model="numpy")
def spread_edges(begin, end, hit, depth, normal, thickness, albedo, back_normal, covered):
    """Share of the pixels that is covered, from their neighbours (1 2 1 both ways), and values for pixels just outside
    an outline, which are those of their nearest neighbour inside: what they cover in part looks like it."""
    h, w = hit.shape
    for i in range(begin, end):
        for j in range(w):
            total, best, best_i, best_j = 0, 0, -1, -1
            for di in range(-1, 2):
                for dj in range(-1, 2):
                    r, c = min(max(i + di, 0), h - 1), min(max(j + dj, 0), w - 1)
                    if hit[r, c]:
                        share = (2 - abs(di)) * (2 - abs(dj))
                        total += share
                        if share > best:
                            best, best_i, best_j = share, r, c
            covered[i, j] = total / 16.0
            if total > 0 and not hit[i, j]:
                depth[i, j] = depth[best_i, best_j]
                thickness[i, j] = thickness[best_i, best_j]
                for k in range(3):
                    normal[i, j, k] = normal[best_i, best_j, k]
                    albedo[i, j, k] = albedo[best_i, best_j, k]
                    back_normal[i, j, k] = back_normal[best_i, best_j, k]
