"""Triangle rasterisation (z-buffer): the face that each pixel sees, where and how far; and how deep closed bodies are.

Homogeneous rasterisation (Olano and Greer 1997): a pixel's ray r lies in the triangle a, b, c (camera axes) where
(b x c) r, (c x a) r and (a x b) r have the sign of the determinant of a, b, c. Their shares are the perspective-correct
barycentrics, and their sum over the determinant is 1/z, so nothing has to be clipped: triangles may pass the camera.
The cross product of a shared edge is the same number with the other sign in both faces, and a ray that meets an edge
exactly goes to one of them: a closed mesh has neither gaps nor overlaps, and every ray leaves it as often as it enters.

The loops run on all cores over bands of rows; each pixel is written by one of them in the order of the faces, so that
pictures are the same bits with any number of threads. A plain twin is `triangles_plain`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba as nb
import numpy as np
from jaxtyping import Float, Int

from fluidlift.errors import require
from fluidlift.numerics.sharing import PIECES, shared
from fluidlift.types.camera import PinholeCamera

NEAR = 1e-3
"""m: what is nearer to the camera (its z) is not drawn"""
BAND = 16
"""rows that one thread draws at a time"""
WIDE = 6
"""px from which it is faster to find the columns of a face in a row than to ask all of its box"""
_ROOM = 2**31 - 1
_NUMBERS = 12
"""of a triangle: three edges of three coefficients, signed so that the inside is positive, and those of 1/z"""


@dataclass(frozen=True)
class Fragments:
    """The nearest face in every pixel."""

    face: Int[np.ndarray, "h w"]
    """-1: none"""
    barycentric: Float[np.ndarray, "h w 3"]
    """shares of the face's corners (sum 1), perspective-correct; 0 where there is none"""
    depth: Float[np.ndarray, "h w"]
    """camera z, m; 0 where there is none"""

    @property
    def hit(self) -> np.ndarray:
        """bool [h,w]: a face is seen."""
        return self.face >= 0


@dataclass(frozen=True)
class ClosedFragments:
    """A closed body in every pixel."""

    front: Fragments
    """the nearest face seen from outside"""
    back: Fragments
    """the nearest face seen from within"""
    inside: Float[np.ndarray, "h w"]
    """camera z (m) that the ray spends in the body: depths where it leaves minus depths where it enters. What lies
    behind the camera does not count: from within the body, its far wall counts alone"""


def rasterize_triangles(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], camera: PinholeCamera, *, facing: str = "both"
) -> Fragments:
    """The nearest face in every pixel's centre.

    Args:
        vertices: m, world. Faces with a number that is not finite are left out.
        faces: counter-clockwise seen from outside.
        camera: who looks.
        facing: "front": only faces whose outside is seen; "back": only the others; "both".

    Raises:
        ValueError: arrays of the wrong shape, or indices that are no vertices.
    """
    require(facing in ("front", "back", "both"), f"facing '{facing}'", "front, back or both")
    prepared, box = _prepared(vertices, faces, camera)
    side = {"front": 1, "back": -1, "both": 0}[facing]
    width, height = camera.size
    starts, listed = banded(box, height, side)
    face = np.full((height, width), -1, np.int32)
    inverse = np.full((height, width), -1.0, np.float64)
    _nearest(prepared, box, starts, listed, _lens(camera), face, inverse)
    return _resolved(prepared, face, camera)


def rasterize_closed(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], camera: PinholeCamera
) -> ClosedFragments:
    """Where every pixel's centre ray enters and leaves a closed mesh; arguments as of `rasterize_triangles`."""
    prepared, box = _prepared(vertices, faces, camera)
    width, height = camera.size
    starts, listed = banded(box, height, 0)
    face, inverse = np.full((2, height, width), -1, np.int32), np.full((2, height, width), -1.0, np.float64)
    inside = np.zeros((height, width), np.float64)
    _closed(prepared, box, starts, listed, _lens(camera), face, inverse, inside)
    front, back = (_resolved(prepared, found, camera) for found in face)
    return ClosedFragments(front, back, inside.astype(np.float32))


def _resolved(prepared: np.ndarray, face: np.ndarray, camera: PinholeCamera) -> Fragments:
    barycentric, depth = np.zeros((*face.shape, 3), np.float32), np.zeros(face.shape, np.float32)
    _resolve(prepared, face, _lens(camera), barycentric, depth)
    return Fragments(face, barycentric, depth)


def interpolated(
    fragments: Fragments, values: Float[np.ndarray, "v c"], faces: Int[np.ndarray, "f 3"]
) -> Float[np.ndarray, "h w c"]:
    """Values of vertices at the pixels; 0 where no face is seen."""
    require(np.ndim(values) == 2, f"values of shape {np.shape(values)}", "[v, c]")
    table = np.ascontiguousarray(values, np.float32)
    out = np.zeros((*fragments.face.shape, table.shape[1]), np.float32)
    _interpolate(fragments.face, fragments.barycentric, table, _indices(faces, len(table)), out)
    return out


def _indices(faces: np.ndarray, count: int) -> np.ndarray:
    f = np.ascontiguousarray(faces)
    require(f.ndim == 2 and f.shape[1] == 3, f"faces of shape {f.shape}", "[f, 3]")
    require(len(f) < _ROOM, f"{len(f)} faces", f"fewer than {_ROOM}")
    fine = len(f) == 0 or (int(f.min()) >= 0 and int(f.max()) < count)
    require(fine, "faces of vertices that are not there", f"indices of 0 to {count - 1}")
    return np.ascontiguousarray(f, np.int32)


def _lens(camera: PinholeCamera) -> np.ndarray:
    return np.array([*camera.focal, *camera.center], np.float64)


def _prepared(vertices: np.ndarray, faces: np.ndarray, camera: PinholeCamera) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients of the faces, and columns and rows that each may reach, with the side that it shows."""
    v = np.asarray(vertices, np.float64)
    require(v.ndim == 2 and v.shape[1] == 3, f"vertices of shape {v.shape}", "[v, 3]")
    f = _indices(faces, len(v))
    pose = camera.camera_from_world
    seen = np.empty((len(v), 3))
    _to_camera(v, np.asarray(pose.rotation, np.float64), np.asarray(pose.translation, np.float64), seen)
    prepared, box = np.empty((len(f), _NUMBERS), np.float64), np.empty((len(f), 5), np.int32)
    _prepare(seen, f, _lens(camera), np.array(camera.size, np.int64), NEAR, prepared, box)
    return prepared, box


def banded(box: Int[np.ndarray, "n 5"], height: int, side: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Lists of the things that meet each band of `BAND` rows, in order, one after the other, and where each begins.

    Args:
        box: first and last column, first and last row, and a side, 0: not drawn.
        height: of the picture, rows.
        side: 1 or -1: only things of that side; 0: all.
    """
    bands = (height + BAND - 1) // BAND
    starts = np.zeros(bands + 1, np.int64)
    _count(box, side, starts)
    np.cumsum(starts, out=starts)
    listed = np.empty(int(starts[-1]), np.int32)
    _list(box, side, starts[:-1].copy(), listed)
    return starts, listed


@shared(lambda points, *_: (0, points.shape[0]))
def _to_camera(begin, end, points, rotation, translation, seen):
    for i in range(begin, end):
        for k in range(3):
            along = rotation[k, 0] * points[i, 0] + rotation[k, 1] * points[i, 1] + rotation[k, 2] * points[i, 2]
            seen[i, k] = along + translation[k]


@nb.njit(cache=True, inline="always")
def _cross(a, b, c, i, out, at):
    """Coefficients of an edge's plane through the camera: rows b and c of vertex array a."""
    out[i, at] = a[b, 1] * a[c, 2] - a[b, 2] * a[c, 1]
    out[i, at + 1] = a[b, 2] * a[c, 0] - a[b, 0] * a[c, 2]
    out[i, at + 2] = a[b, 0] * a[c, 1] - a[b, 1] * a[c, 0]


@nb.njit(cache=True, inline="always")
def _reach(seen, corners, lens, near):
    """Smallest and largest u and v (px) of the part of a triangle beyond the near plane; infinite if there is none."""
    u0, u1, v0, v1 = math.inf, -math.inf, math.inf, -math.inf
    for k in range(3):
        p, q = corners[k], corners[(k + 1) % 3]
        zp, zq = seen[p, 2], seen[q, 2]
        if zp >= near:
            u, v = lens[0] * seen[p, 0] / zp + lens[2], lens[1] * seen[p, 1] / zp + lens[3]
            u0, u1, v0, v1 = min(u0, u), max(u1, u), min(v0, v), max(v1, v)
        if (zp >= near) != (zq >= near):
            t = (near - zp) / (zq - zp)
            u = lens[0] * (seen[p, 0] + t * (seen[q, 0] - seen[p, 0])) / near + lens[2]
            v = lens[1] * (seen[p, 1] + t * (seen[q, 1] - seen[p, 1])) / near + lens[3]
            u0, u1, v0, v1 = min(u0, u), max(u1, u), min(v0, v), max(v1, v)
    return u0, u1, v0, v1


@shared(lambda seen, faces, *_: (0, faces.shape[0]), error_model="numpy")
def _prepare(begin, end, seen, faces, lens, size, near, prepared, box):
    for i in range(begin, end):
        a, b, c = faces[i, 0], faces[i, 1], faces[i, 2]
        _cross(seen, b, c, i, prepared, 0)
        _cross(seen, c, a, i, prepared, 3)
        _cross(seen, a, b, i, prepared, 6)
        volume = seen[a, 0] * prepared[i, 0] + seen[a, 1] * prepared[i, 1] + seen[a, 2] * prepared[i, 2]
        box[i, 4] = 0
        # neither seen edge-on nor spoilt: comparisons with a number that is not finite are false
        if not (abs(volume) > 0.0 and abs(volume) < math.inf):
            continue
        u0, u1, v0, v1 = _reach(seen, faces[i], lens, near)
        # pixel j has its centre at j + 0.5; a rim against rounding
        u0, u1 = math.ceil(max(u0 - 0.501, 0.0)), math.floor(min(u1 - 0.499, size[0] - 1.0))
        v0, v1 = math.ceil(max(v0 - 0.501, 0.0)), math.floor(min(v1 - 0.499, size[1] - 1.0))
        if not (u0 <= u1 and v0 <= v1):
            continue
        box[i, 0], box[i, 1], box[i, 2], box[i, 3] = u0, u1, v0, v1
        # with y down and z forward, faces wound counter-clockwise towards the camera have a negative volume
        box[i, 4] = 1 if volume < 0 else -1
        sign = -1.0 if volume < 0 else 1.0
        for k in range(9):
            prepared[i, k] *= sign
        for k in range(3):
            prepared[i, 9 + k] = (prepared[i, k] + prepared[i, 3 + k] + prepared[i, 6 + k]) / abs(volume)


@nb.njit(cache=True)
def _count(box, side, starts):
    for i in range(box.shape[0]):
        if box[i, 4] != 0 and (side == 0 or box[i, 4] == side):
            for band in range(box[i, 2] // BAND, box[i, 3] // BAND + 1):
                starts[band + 1] += 1


@nb.njit(cache=True)
def _list(box, side, at, listed):
    for i in range(box.shape[0]):
        if box[i, 4] != 0 and (side == 0 or box[i, 4] == side):
            for band in range(box[i, 2] // BAND, box[i, 3] // BAND + 1):
                listed[at[band]] = i
                at[band] += 1


@nb.njit(cache=True, inline="always")
def _owns(p, i, k):
    """Whether a ray exactly on edge k belongs to this face: its neighbour there has the same coefficients negated."""
    x, y, z = p[i, k], p[i, k + 1], p[i, k + 2]
    return x > 0.0 or (x == 0.0 and (y > 0.0 or (y == 0.0 and z > 0.0)))


@nb.njit(cache=True, inline="always")
def _inside(p, i, e0, e1, e2):
    if e0 < 0.0 or e1 < 0.0 or e2 < 0.0:
        return False
    return (e0 > 0.0 or _owns(p, i, 0)) and (e1 > 0.0 or _owns(p, i, 3)) and (e2 > 0.0 or _owns(p, i, 6))


@nb.njit(cache=True, inline="always")
def scattered(t, count):
    """Bands dealt out in turns, so that each thread gets full and empty ones."""
    half = (count + 1) // 2
    return 2 * t if t < half else 2 * (t - half) + 1


@nb.njit(cache=True, inline="always")
def _reached(a, c, low, high, lens):
    """Columns from low to high between which a x + c may be 0 or more, with one to spare on each side: there each pixel
    is asked itself, so that nothing depends on how this is rounded."""
    if a > 0.0:
        low = max(low, np.int64(math.floor(min(max(-c / a * lens[0] + lens[2], 0.0), 1e9))) - 2)
    elif a < 0.0:
        high = min(high, np.int64(math.floor(min(max(-c / a * lens[0] + lens[2], -9.0), 1e9))) + 2)
    elif c < 0.0:
        high = low - 1
    return low, high


@nb.njit(cache=True, inline="always")
def _span(p, i, c0, c1, c2, low, high, lens):
    """Columns from low to high that face i may have in a row. Of walls seen from above, and of ground at a flat angle,
    a face takes a twentieth of its box."""
    if high - low >= WIDE:
        low, high = _reached(p[i, 0], c0, low, high, lens)
        low, high = _reached(p[i, 3], c1, low, high, lens)
        low, high = _reached(p[i, 6], c2, low, high, lens)
    return low, high


@shared(lambda prepared, box, starts, *_: (0, (starts.shape[0] - 1)), error_model="numpy", pieces=PIECES)
def _nearest(begin, end, prepared, box, starts, listed, lens, face, inverse):
    height = face.shape[0]
    count = starts.shape[0] - 1
    for t in range(begin, end):
        band = scattered(t, count)
        low, high = band * BAND, min(band * BAND + BAND, height) - 1
        for n in range(starts[band], starts[band + 1]):
            i = listed[n]
            p = prepared
            for row in range(max(low, box[i, 2]), min(high, box[i, 3]) + 1):
                y = (row + 0.5 - lens[3]) / lens[1]
                c0 = p[i, 1] * y + p[i, 2]
                c1 = p[i, 4] * y + p[i, 5]
                c2 = p[i, 7] * y + p[i, 8]
                cw = p[i, 10] * y + p[i, 11]
                first, last = _span(p, i, c0, c1, c2, np.int64(box[i, 0]), np.int64(box[i, 1]), lens)
                for col in range(first, last + 1):
                    x = (col + 0.5 - lens[2]) / lens[0]
                    e0, e1, e2 = p[i, 0] * x + c0, p[i, 3] * x + c1, p[i, 6] * x + c2
                    if _inside(p, i, e0, e1, e2):
                        w = p[i, 9] * x + cw
                        if w > inverse[row, col] and w * NEAR <= 1.0:
                            inverse[row, col] = w
                            face[row, col] = i


@shared(lambda prepared, box, starts, *_: (0, (starts.shape[0] - 1)), error_model="numpy", pieces=PIECES)
def _closed(begin, end, prepared, box, starts, listed, lens, face, inverse, inside):
    height = inside.shape[0]
    count = starts.shape[0] - 1
    for t in range(begin, end):
        band = scattered(t, count)
        low, high = band * BAND, min(band * BAND + BAND, height) - 1
        for n in range(starts[band], starts[band + 1]):
            i = listed[n]
            p = prepared
            back = 1 if box[i, 4] < 0 else 0
            for row in range(max(low, box[i, 2]), min(high, box[i, 3]) + 1):
                y = (row + 0.5 - lens[3]) / lens[1]
                c0 = p[i, 1] * y + p[i, 2]
                c1 = p[i, 4] * y + p[i, 5]
                c2 = p[i, 7] * y + p[i, 8]
                cw = p[i, 10] * y + p[i, 11]
                first, last = _span(p, i, c0, c1, c2, np.int64(box[i, 0]), np.int64(box[i, 1]), lens)
                for col in range(first, last + 1):
                    x = (col + 0.5 - lens[2]) / lens[0]
                    e0, e1, e2 = p[i, 0] * x + c0, p[i, 3] * x + c1, p[i, 6] * x + c2
                    if _inside(p, i, e0, e1, e2):
                        w = p[i, 9] * x + cw
                        if w > 0.0 and w * NEAR <= 1.0:
                            inside[row, col] -= box[i, 4] / w
                            if w > inverse[back, row, col]:
                                inverse[back, row, col] = w
                                face[back, row, col] = i


@shared(lambda p, face, *_: (0, face.shape[0]), error_model="numpy")
def _resolve(begin, end, p, face, lens, barycentric, depth):
    for row in range(begin, end):
        y = (row + 0.5 - lens[3]) / lens[1]
        for col in range(face.shape[1]):
            i = face[row, col]
            if i < 0:
                continue
            x = (col + 0.5 - lens[2]) / lens[0]
            e0 = p[i, 0] * x + (p[i, 1] * y + p[i, 2])
            e1 = p[i, 3] * x + (p[i, 4] * y + p[i, 5])
            e2 = p[i, 6] * x + (p[i, 7] * y + p[i, 8])
            total = e0 + e1 + e2
            barycentric[row, col, 0] = e0 / total
            barycentric[row, col, 1] = e1 / total
            barycentric[row, col, 2] = e2 / total
            depth[row, col] = 1.0 / (p[i, 9] * x + (p[i, 10] * y + p[i, 11]))


@shared(lambda face, *_: (0, face.shape[0]))
def _interpolate(begin, end, face, barycentric, values, faces, out):
    for row in range(begin, end):
        for col in range(face.shape[1]):
            i = face[row, col]
            if i < 0:
                continue
            for k in range(3):
                share, v = barycentric[row, col, k], faces[i, k]
                for c in range(values.shape[1]):
                    out[row, col, c] += share * values[v, c]
