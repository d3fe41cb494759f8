"""Where light inside a liquid leaves it, from pictures of its near and its far side (Numba; camera axes, metres).

The near side is a depth, the far side lies `thickness` behind it, each with its normal: between the two is liquid
(Wyman 2005 knows the far side of the straight line alone). A ray is first brought to the far side by Newton's steps;
where that mirrors it, it is marched on between both until it gets out.
"""

from __future__ import annotations

import math

import numba as nb

NEWTON = 4
"""steps towards the far side: each one looks there how far away it is and how it leans"""
STEEP = 0.1
"""cosine between a ray and the far side's normal under which the plane through it says nothing"""
LONGEST = 4.0
"""straight lines of sight that a bent ray may be long"""
MARCH, GROWS, HALVED = 28, 1.15, 5
"""steps of a mirrored ray, by how much each is longer than the one before, and halvings of the last"""
STRIDE = 0.12
"""first step, of the thickness"""
STRIDE_PX = 1.5
"""and of a pixel, at least"""

GLANCING = 0.1
"""least cosine under which light that fans out is taken to leave: under less hardly any does"""


@nb.njit(cache=True, inline="always")
def seen_from(normals, i, j, rotation):
    """A normal of the picture in camera axes."""
    x, y, z = normals[i, j, 0], normals[i, j, 1], normals[i, j, 2]
    return (
        rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z,
        rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z,
        rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z,
    )


@nb.njit(cache=True, inline="always")
def between(x, y, z, sides, lens):
    """Row, column, and z of the near and the far side (0, 0: no liquid) in the pixel of a point. sides: pictures
    of the near side's depth, of the thickness and of the depth of what lies behind."""
    depth, thickness, behind = sides
    if z < 1e-6:
        return -1, -1, 0.0, 0.0
    u, v = lens[0] * x / z + lens[2], lens[1] * y / z + lens[3]
    if not (0.0 <= u < depth.shape[1] and 0.0 <= v < depth.shape[0]):
        return -1, -1, 0.0, 0.0
    i, j = int(v), int(u)
    near = depth[i, j]
    if near <= 0.0:
        return i, j, 0.0, 0.0
    a, b = (j + 0.5 - lens[2]) / lens[0], (i + 0.5 - lens[3]) / lens[1]
    far = near + thickness[i, j] / math.sqrt(a * a + b * b + 1.0)
    if behind[i, j] > 0.0:
        far = min(far, max(behind[i, j], near))
    return i, j, near, far


@nb.njit(cache=True, inline="always")
def _plane(p, t, i, j, z, nx, ny, nz, lens):
    """Metres from p along t to the plane with normal n through the middle of a pixel at depth z."""
    a, b = (j + 0.5 - lens[2]) / lens[0], (i + 0.5 - lens[3]) / lens[1]
    along = t[0] * nx + t[1] * ny + t[2] * nz
    return ((a * z - p[0]) * nx + (b * z - p[1]) * ny + (z - p[2]) * nz) / along


@nb.njit(cache=True, error_model="numpy")
def far_side(p, t, way, first, sides, back_normals, eye):
    """Metres from p, on the near side, along the unit direction t to the far side, and the outward normal there.

    way: a guess; first: the normal where it ends. Where the far side is not known, the last guess stays. sides: as of
    `between`; eye: lens (fx, fy, cx, cy) and rotation.
    """
    lens, rotation = eye
    bx, by, bz = first
    most = LONGEST * max(way, 1e-9)
    for _ in range(NEWTON):
        i, j, near, far = between(p[0] + way * t[0], p[1] + way * t[1], p[2] + way * t[2], sides, lens)
        if near <= 0.0:
            break
        nx, ny, nz = seen_from(back_normals, i, j, rotation)
        if nx * nx + ny * ny + nz * nz < 0.5 or nx * t[0] + ny * t[1] + nz * t[2] < STEEP:
            break
        longer = _plane(p, t, i, j, far, nx, ny, nz, lens)
        if not 0.0 <= longer <= most:
            break
        done = abs(longer - way) < 1e-3 * longer
        way, bx, by, bz = longer, nx, ny, nz
        if done:
            break
    return way, bx, by, bz


@nb.njit(cache=True, error_model="numpy")
def onward(q, m, thick, sides, normals, back_normals, eye):
    """Whether a ray that is mirrored at q, inside, into the unit direction m is seen to get out, metres to there and
    the outward normal. sides, eye: as of `far_side`."""
    lens, rotation = eye
    stride = max(STRIDE * thick, STRIDE_PX * q[2] / lens[0])
    low, high, row, col, near, far = 0.0, 0.0, -1, -1, 0.0, 0.0
    inside = True
    for _ in range(MARCH):
        high = low + stride
        z = q[2] + high * m[2]
        i, j, zn, zf = between(q[0] + high * m[0], q[1] + high * m[1], z, sides, lens)
        inside = zn > 0.0 and zn <= z <= zf
        if not inside:
            break
        low, row, col, near, far = high, i, j, zn, zf
        stride *= GROWS
    if inside:
        return False, 0.0, 0.0, 0.0, 0.0
    for _ in range(HALVED):
        s = 0.5 * (low + high)
        z = q[2] + s * m[2]
        i, j, zn, zf = between(q[0] + s * m[0], q[1] + s * m[1], z, sides, lens)
        if zn > 0.0 and zn <= z <= zf:
            low, row, col, near, far = s, i, j, zn, zf
        else:
            high = s
    if row < 0:  # no step was inside: it leaves where it is
        row, col, near, far = between(q[0], q[1], q[2], sides, lens)
        if near <= 0.0:
            return False, 0.0, 0.0, 0.0, 0.0
    z = q[2] + high * m[2]
    front = z - near < far - z
    if front:
        nx, ny, nz = seen_from(normals, row, col, rotation)
    else:
        nx, ny, nz = seen_from(back_normals, row, col, rotation)
    if nx * nx + ny * ny + nz * nz < 0.5 or nx * m[0] + ny * m[1] + nz * m[2] < STEEP:
        return False, 0.0, 0.0, 0.0, 0.0
    s = _plane(q, m, row, col, near if front else far, nx, ny, nz, lens)
    return True, min(max(s, low), high), nx, ny, nz


@nb.njit(cache=True, inline="always")
def turned_normals(surface_depth, normals, i, j):
    """How much the normal turns from this pixel to the next ones of the same surface, as GGX's alpha: in rows and in
    columns to the side where it turns less, for across an edge there is another face and nothing is bent in between."""
    h, w = surface_depth.shape
    turn = 0.0
    for axis in range(2):
        least = math.inf
        for side in (-1, 1):
            r, c = i + side * (axis == 0), j + side * (axis == 1)
            if r < 0 or c < 0 or r >= h or c >= w or surface_depth[r, c] <= 0.0:
                continue
            dot = 0.0
            for n in range(3):
                dot += normals[i, j, n] * normals[r, c, n]
            least = min(least, max(2.0 - 2.0 * dot, 0.0))
        turn += least if least < math.inf else 0.0
    return min(0.5 * math.sqrt(turn / 2.0), 0.5)


@nb.njit(cache=True, inline="always")
def fanned(bend, leaving, near, far, index):
    """How wide the light of one pixel leaves the far side, as alpha of the mirror that would fan it out as wide.

    Differentials of both refractions (Igehy 1999): the normals turn by `near` at the front and by `far` at the back
    within the pixel; t = v / n + bend n on the way in, where it meets the outward normal under the cosine `leaving`.
    Light that leaves at a slant is fanned out ever more. A mirror turns its light by twice what its normals turn.
    """
    out = math.sqrt(max(1.0 - index * index * (1.0 - leaving * leaving), GLANCING * GLANCING))
    inside = abs(bend) * near
    aslant = inside + math.sqrt(max(1.0 - leaving * leaving, 0.0)) * far
    turn = index * inside + abs(out - index * leaving) * far + (index * index * leaving / out - index) * aslant
    return 0.5 * min(max(turn, 0.0), 1.0)
