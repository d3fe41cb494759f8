"""The compiled loops of `screen_space` (Numba). Camera axes, metres, float32.

Pictures are drawn in bands of rows, each by one thread and in the order of the particles: they are the same bits with
any number of threads.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from fluidlift.numerics.triangles import BAND, scattered

_FUSED = {"contract"}
LARGEST_WINDOW = 40
"""pairs of pixels that one pass of the smoothing averages, however near the liquid is"""
APART = 2.6
"""pairs per standard deviation of the smoothing: of wide bells every second, third ... pixel is enough"""


@nb.njit(cache=True, parallel=True, error_model="numpy")
def place_spheres(points, rotation, translation, radius, lens, size, near, centres, box):
    """Centres in camera axes, and the columns and rows that each sphere may reach: exact bounds of its outline."""
    for i in nb.prange(points.shape[0]):
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


@nb.njit(cache=True, parallel=True, nogil=True, error_model="numpy", fastmath=_FUSED)
def sphere_depths(centres, box, starts, listed, radius, across, down, depth):
    """Camera z of the nearest sphere; infinite where there is none. across, down: x / z and y / z of pixel centres.

    The ray r meets the sphere c where |r x c|^2 <= |r|^2 R^2: differences of nearby numbers stay exact in float32.
    """
    count = starts.shape[0] - 1
    square = np.float32(radius * radius)
    zero, far = np.float32(0.0), np.float32(np.inf)
    for t in nb.prange(count):
        band = scattered(np.int64(t), count)
        low, high = band * BAND, min(band * BAND + BAND, depth.shape[0]) - 1
        for n in range(starts[band], starts[band + 1]):
            i = listed[n]
            x, y, z = centres[i, 0], centres[i, 1], centres[i, 2]
            first = np.uint64(box[i, 0])
            lanes = np.uint64(box[i, 1] - box[i, 0] + 1)
            for row in range(max(low, box[i, 2]), min(high, box[i, 3]) + 1):
                b = down[row]
                p = b * z - y
                line = depth[row]
                for k in range(lanes):
                    a = across[first + k]
                    q, s = x - a * z, a * y - b * x
                    rr = a * a + b * b + np.float32(1.0)
                    left = rr * square - (p * p + q * q + s * s)
                    along = a * x + b * y + z
                    d = (along - math.sqrt(max(left, zero))) / rr
                    d = d if left > zero else far
                    line[first + k] = min(line[first + k], d)


@nb.njit(cache=True, parallel=True, nogil=True, error_model="numpy", fastmath=_FUSED)
def sphere_chords(centres, box, starts, listed, radius, across, down, depth, colors, sums):
    """Five pictures: the sum of the lengths (m, along the ray) in all spheres, then colours of those less than a
    diameter behind the nearest surface, weighted with their lengths, and these weights.

    depth: as `sphere_depths` gives it, at `step` times the resolution of `sums`.
    """
    count = starts.shape[0] - 1
    square, reach = np.float32(radius * radius), np.float32(2.0 * radius)
    zero, one = np.float32(0.0), np.float32(1.0)
    step = depth.shape[0] // sums.shape[1]
    for t in nb.prange(count):
        band = scattered(np.int64(t), count)
        low, high = band * BAND, min(band * BAND + BAND, sums.shape[1]) - 1
        for n in range(starts[band], starts[band + 1]):
            i = listed[n]
            x, y, z = centres[i, 0], centres[i, 1], centres[i, 2]
            first, last = box[i, 0], box[i, 1]
            middle = depth[step * ((box[i, 2] + box[i, 3]) // 2), step * ((first + last) // 2)]
            seen = z - middle < reach or middle == np.inf
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
                    if seen:
                        for c in range(3):
                            sums[1 + c, row, k] += chord * colors[i, c]
                        sums[4, row, k] += chord


@nb.njit(cache=True, inline="always")
def _evened(q, row, col, down, across, width, limit, fall):
    """Mean of the inverse depths about a pixel in one direction, weighted with a bell; see `narrow_range`."""
    own = q[row, col]
    narrow, drop = limit * own * own, fall * own * own
    low, high = own - narrow, own + narrow
    total, weights = own, np.float32(1.0)
    stride = max(np.int64(width / APART), 1)
    bell = width / np.float32(stride)
    steps = min(max(int(2.0 * bell), 1), LARGEST_WINDOW)
    # exp(-k^2 / (2 bell^2)) from the one before: by a factor that itself shrinks by a factor
    w = np.float32(1.0)
    fade = np.float32(math.exp(np.float32(-0.5) / (bell * bell)))
    fading = fade * fade
    down, across = stride * down, stride * across
    for k in range(1, steps + 1):
        r0, c0, r1, c1 = row - k * down, col - k * across, row + k * down, col + k * across
        if r0 < 0 or c0 < 0 or r1 >= q.shape[0] or c1 >= q.shape[1]:
            break
        one, two = q[r0, c0], q[r1, c1]
        if one > high or two > high:
            break
        if one > low and two > low:
            high = max(high, max(one, two) + narrow)
            low = min(low, min(one, two) - narrow)
        else:
            one = one if one > low else own - drop
            two = two if two > low else own - drop
        w *= fade
        fade *= fading
        total += w * (one + two)
        weights += w + w
    return total / weights


@nb.njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def narrow_range(q, out, down, across, focal, width, limit, fall):
    """One pass of smoothing along rows (across = 1) or columns (down = 1) of inverse depth q (1/m; 0: nothing there).

    After the narrow-range filter of Truong and Yuksel 2018: depths within `limit` (m) of what was met so far are
    averaged; what lies nearer ends the window; what lies farther counts as if it fell off by `fall` (m), which rounds
    outlines. Two changes: inverse depth is averaged, which is linear across the picture of a plane, and pixels come in
    pairs from both sides, so that planes stay as they are. `width` (m) is the standard deviation of the weights.
    """
    for row in nb.prange(q.shape[0]):
        for col in range(q.shape[1]):
            own = q[row, col]
            wide = np.float32(focal * width * own)
            if own > 0 and wide > np.float32(0.3):
                out[row, col] = _evened(q, np.int64(row), col, down, across, wide, limit, fall)
            else:
                out[row, col] = own


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


@nb.njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def plane_normals(q, lens, rotation, limit, normal):
    """Unit normals (world, towards the viewer) of the surface of inverse depth q (1/m; 0: none).

    On the plane n . p = 1 the inverse depth is n . (x/z, y/z, 1): its slopes in the picture are n, without error.
    limit: m, steps from pixel to pixel beyond which they belong to different surfaces.
    """
    h, w = q.shape
    for row in nb.prange(h):
        b = (np.int64(row) + 0.5 - lens[3]) / lens[1]
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


@nb.njit(cache=True, parallel=True, error_model="numpy")
def unit_rows(vectors):
    """Vectors [n,3] made unit, in place; those of length 0 stay."""
    for i in nb.prange(vectors.shape[0]):
        length = math.sqrt(vectors[i, 0] ** 2 + vectors[i, 1] ** 2 + vectors[i, 2] ** 2)
        if length > 0:
            vectors[i, 0] /= length
            vectors[i, 1] /= length
            vectors[i, 2] /= length


@nb.njit(cache=True, parallel=True, error_model="numpy")
def spread_edges(hit, depth, normal, thickness, albedo, back_normal, covered):
    """Share of the pixels that is covered, from their neighbours (1 2 1 both ways), and values for pixels just outside
    an outline, which are those of their nearest neighbour inside: what they cover in part looks like it."""
    h, w = hit.shape
    for row in nb.prange(h):
        i = np.int64(row)
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
