"""The compiled loops of `liquid`: where the light of each pixel comes from, and how bright it is (Numba). Camera axes,
metres, float32 out. `shade` in NumPy is `liquid.shaded_plain`.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from fluidlift.look.environment_lookup import picture_place, picture_value

STEPS = 3
"""times that the ray behind the liquid looks up how far away what it meets is"""
FACING = 0.02
"""cosine that a normal keeps towards the viewer, however the surface is interpolated"""
LEAST = 0.15
"""cosine below which a ray is less and less bent or mirrored at the far side: it would run along in it"""
ROOM = 16.0
"""px: a liquid that is less than this and its thickness from what lies behind it rests on it, in part"""
SHARE, MIRROR, THROUGH, PATH, OUTSIDE, TURNED, INWARD, COLOR, SPREAD = 0, 1, 4, 7, 8, 9, 10, 13, 16
"""places in the numbers of a ray: see `follow`"""
NUMBERS = 17
"""of a ray"""


@nb.njit(cache=True, inline="always")
def reflectance(cos, index):
    """Share reflected from outside (see `optics.fresnel`), for 0 < cos <= 1."""
    far = math.sqrt(max(1.0 - (1.0 - cos * cos) / (index * index), 0.0))
    across = (cos - index * far) / (cos + index * far)
    along = (index * cos - far) / (index * cos + far)
    return 0.5 * (across * across + along * along)


@nb.njit(cache=True, inline="always")
def _onto(x, y, z, lens):
    """Picture coordinates (px) of a point or direction in front of the camera."""
    return lens[0] * x / z + lens[2], lens[1] * y / z + lens[3]


@nb.njit(cache=True)
def _fetch(image, u, v, out, at):
    """Bilinear, held at the rim."""
    h, w = image.shape[0], image.shape[1]
    x, y = min(max(u - 0.5, 0.0), w - 1.0), min(max(v - 0.5, 0.0), h - 1.0)
    j, i = min(int(x), max(w - 2, 0)), min(int(y), max(h - 2, 0))
    a, b = x - j, y - i
    j1, i1 = min(j + 1, w - 1), min(i + 1, h - 1)
    for k in range(3):
        upper = (1.0 - a) * image[i, j, k] + a * image[i, j1, k]
        lower = (1.0 - a) * image[i1, j, k] + a * image[i1, j1, k]
        out[at + k] = (1.0 - b) * upper + b * lower


@nb.njit(cache=True)
def _behind(q, o, start, depth, front, lens, up):
    """Where a ray that leaves the liquid at q towards o meets what lies behind: u, v (px) and whether the picture holds
    it. `start`: u, v of the straight line; `front`: z of the liquid; `up`: world z in camera axes."""
    h, w = depth.shape
    u, v = start
    for _ in range(STEPS):
        row, col = min(max(int(v), 0), h - 1), min(max(int(u), 0), w - 1)
        z = depth[row, col]
        if z > 0.0:
            if o[2] < 0.05:
                return u, v, False
            s = max(z - q[2], 0.0) / o[2]
            u, v = _onto(q[0] + s * o[0], q[1] + s * o[1], max(q[2] + s * o[2], 1e-6), lens)
        else:
            if o[2] < 0.05:
                return u, v, False
            u, v = _onto(o[0], o[1], o[2], lens)
    row, col = min(max(int(v), 0), h - 1), min(max(int(u), 0), w - 1)
    z = depth[row, col]
    if z > 0.0 and z < front:  # something before the liquid: the straight line's
        return start[0], start[1], True
    # beyond the rim ground goes on, and the sky is known all around
    outside = u < 0.0 or v < 0.0 or u > w or v > h
    upward = o[0] * up[0] + o[1] * up[1] + o[2] * up[2] > 0.0
    return u, v, not (outside and (z == 0.0 or upward))


@nb.njit(cache=True)
def _turned(rotation, x, y, z, out, at):
    """A direction of camera axes in the world."""
    for k in range(3):
        out[at + k] = rotation[0, k] * x + rotation[1, k] * y + rotation[2, k] * z


@nb.njit(cache=True, inline="always")
def _towards_viewer(nx, ny, nz, vx, vy, vz):
    """A normal turned just far enough to face the viewer, and its cosine to the line of sight."""
    cos = -(nx * vx + ny * vy + nz * vz)
    if cos < FACING:
        more = FACING - cos
        nx, ny, nz = nx - more * vx, ny - more * vy, nz - more * vz
        norm = max(math.sqrt(nx * nx + ny * ny + nz * nz), 1e-6)
        nx, ny, nz = nx / norm, ny / norm, nz / norm
        cos = max(-(nx * vx + ny * vy + nz * vz), FACING)
    return nx, ny, nz, min(cos, 1.0)


@nb.njit(cache=True, inline="always")
def _spread(surface_depth, normals, i, j):
    """How much the normal turns from this pixel to the next ones of the same surface, as GGX's alpha."""
    h, w = surface_depth.shape
    turn, known = 0.0, 0
    for k in range(4):
        r, c = i + (k == 0) - (k == 1), j + (k == 2) - (k == 3)
        if r < 0 or c < 0 or r >= h or c >= w or surface_depth[r, c] <= 0.0:
            continue
        dot = 0.0
        for n in range(3):
            dot += normals[i, j, n] * normals[r, c, n]
        turn += max(2.0 - 2.0 * dot, 0.0)
        known += 1
    return min(0.5 * math.sqrt(turn / max(known, 1)), 0.5)


@nb.njit(cache=True, inline="always")
def _leaving(tx, ty, tz, bx, by, bz, vx, vy, vz, index, free):
    """What a ray t does where it leaves the liquid with outward normal b: the direction in which it goes on, the share
    that is mirrored back (Fresnel's from inside: it rises to all of it without a step), and where to.

    free: 0 to 1; where the liquid rests on something there is no far side: the line of sight v goes straight on.
    """
    leaving = tx * bx + ty * by + tz * bz
    near = min(max(leaving / LEAST, 0.0), 1.0)
    free *= near * near * (3.0 - 2.0 * near)
    if free <= 0.0:
        return vx, vy, vz, 0.0, tx, ty, tz
    mx, my, mz = tx - 2.0 * leaving * bx, ty - 2.0 * leaving * by, tz - 2.0 * leaving * bz
    left = 1.0 - index * index * (1.0 - leaving * leaving)
    if left <= 0.0:
        return vx, vy, vz, free, mx, my, mz
    out = math.sqrt(left)
    bend = out - index * leaving
    ox = vx + free * (index * tx + bend * bx - vx)
    oy = vy + free * (index * ty + bend * by - vy)
    oz = vz + free * (index * tz + bend * bz - vz)
    norm = max(math.sqrt(ox * ox + oy * oy + oz * oz), 1e-6)
    back = free * reflectance(min(out, 1.0), index)  # the same seen from either side
    return ox / norm, oy / norm, oz / norm, back, mx, my, mz


@nb.njit(cache=True, error_model="numpy")
def _follow(
    i, j, surface_depth, normals, back_normals, has_back, thickness, picture, depth, lens, rotation, index, ray
):
    """One pixel of `follow`."""
    x, y = (j + 0.5 - lens[2]) / lens[0], (i + 0.5 - lens[3]) / lens[1]
    length = math.sqrt(x * x + y * y + 1.0)
    vx, vy, vz = x / length, y / length, 1.0 / length
    wx, wy, wz = normals[i, j, 0], normals[i, j, 1], normals[i, j, 2]
    nx = rotation[0, 0] * wx + rotation[0, 1] * wy + rotation[0, 2] * wz
    ny = rotation[1, 0] * wx + rotation[1, 1] * wy + rotation[1, 2] * wz
    nz = rotation[2, 0] * wx + rotation[2, 1] * wy + rotation[2, 2] * wz
    nx, ny, nz, cos = _towards_viewer(nx, ny, nz, vx, vy, vz)
    ray[SHARE] = reflectance(cos, index)
    _turned(rotation, vx + 2.0 * cos * nx, vy + 2.0 * cos * ny, vz + 2.0 * cos * nz, ray, MIRROR)
    # into the liquid
    far = math.sqrt(max(1.0 - (1.0 - cos * cos) / (index * index), 0.0))
    bend = cos / index - far
    tx, ty, tz = vx / index + bend * nx, vy / index + bend * ny, vz / index + bend * nz
    # the far side: a plane through the straight line's end
    bx, by, bz = -nx, -ny, -nz
    if has_back:
        wx, wy, wz = back_normals[i, j, 0], back_normals[i, j, 1], back_normals[i, j, 2]
        if wx * wx + wy * wy + wz * wz > 0.5:
            bx = rotation[0, 0] * wx + rotation[0, 1] * wy + rotation[0, 2] * wz
            by = rotation[1, 0] * wx + rotation[1, 1] * wy + rotation[1, 2] * wz
            bz = rotation[2, 0] * wx + rotation[2, 1] * wy + rotation[2, 2] * wz
    straight = max(vx * bx + vy * by + vz * bz, 0.0)
    leaving = tx * bx + ty * by + tz * bz
    z0, thick, behind = surface_depth[i, j], thickness[i, j], depth[i, j]
    if behind > 0.0:
        thick = min(thick, max(behind - z0, 0.0) * length)
    way = thick
    if leaving > LEAST and straight > 0.0:
        way = min(thick * straight / leaving, 2.0 * thick)
    ray[PATH] = way
    q = (x * z0 + way * tx, y * z0 + way * ty, z0 + way * tz)
    # out again; where the liquid rests on something, light meets that at once, and there is no other surface
    free = 1.0
    if behind > 0.0:
        gap = (behind - q[2]) - 0.5 * thick
        free = min(max(gap / max(thick + ROOM * z0 / lens[0], 1e-9), 0.0), 1.0)
    ox, oy, oz, back, mx, my, mz = _leaving(tx, ty, tz, bx, by, bz, vx, vy, vz, index, free)
    ray[TURNED] = back if has_back else 0.0
    u, v, held = _behind(q, (ox, oy, oz), (j + 0.5, i + 0.5), depth, z0, lens, rotation[:, 2])
    ray[OUTSIDE] = 0.0 if held else 1.0
    _turned(rotation, ox, oy, oz, ray, THROUGH)
    _turned(rotation, mx, my, mz, ray, INWARD)
    if held:
        _fetch(picture, u, v, ray, COLOR)
    ray[SPREAD] = _spread(surface_depth, normals, i, j)


@nb.njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def follow(
    pixels, surface_depth, normals, back_normals, has_back, thickness, picture, depth, lens, rotation, index, rays
):
    """The numbers [n, NUMBERS] of every pixel of `pixels` (row, column): the share of light mirrored; the directions
    (world) of the mirrored ray and of the one that comes through; metres in the liquid; whether the latter's light is
    the environment's (1) or the picture's (0); the share of it that is mirrored at the far side instead, and the
    direction from which that comes; the picture's colour; and the spread of normals, in the units of GGX's alpha."""
    for m in nb.prange(pixels.shape[0]):
        _follow(
            pixels[m, 0], pixels[m, 1], surface_depth, normals, back_normals, has_back, thickness, picture, depth, lens,
            rotation, index, rays[m],
        )  # fmt: skip


@nb.njit(cache=True, inline="always")
def _looked_up(picture, x, y, z):
    across, down = picture_place(x, y, z)
    return picture_value(picture, across, down)


@nb.njit(cache=True)
def _mirrored(pictures, steps, roughness, x, y, z):
    """`Environment.blurred` for one direction."""
    last = len(pictures) - 1
    k = 0
    while k < last - 1 and roughness >= steps[k + 1]:
        k += 1
    share = min(max((roughness - steps[k]) / (steps[k + 1] - steps[k]), 0.0), 1.0)
    across, down = picture_place(x, y, z)
    if share <= 0.0:
        return picture_value(pictures[k], across, down)
    r0, g0, b0 = picture_value(pictures[k], across, down)
    r1, g1, b1 = picture_value(pictures[k + 1], across, down)
    s = np.float32(share)
    return r0 + s * (r1 - r0), g0 + s * (g1 - g0), b0 + s * (b1 - b0)


@nb.njit(cache=True, parallel=True, nogil=True, error_model="numpy")
def shade(
    covered, surface_depth, normals, back_normals, has_back, thickness, carried, image, depth, lens, rotation,
    pictures, steps, dim, diffuse, numbers, luminance, waves, out,
):  # fmt: skip
    """Adds the liquid to `out`, a copy of `image`; what the numbers are says `liquid.shaded_plain`.

    pictures, steps: of the environment, ever duller, and their roughnesses; dim: of them the one that is seen by what
    was mirrored at the far side. numbers: index, roughness, scattering, straight, dull, carried share, sharp, usual,
    cool, hot, warm, contrast, then absorption, albedo and emission. waves: second radiation constant over wavelengths.
    """
    index, roughness, scattering, straight, dull, keeps, sharp = numbers[:7]
    usual, cool, hot, warm, contrast = numbers[7:12]
    for row in nb.prange(covered.shape[0]):
        i = np.int64(row)
        ray, light = np.empty(NUMBERS), np.empty(3)
        for j in range(covered.shape[1]):
            part, z = covered[i, j], surface_depth[i, j]
            if not (part > 0.0 and z > 0.0 and (depth[i, j] <= 0.0 or z < depth[i, j])):
                continue
            _follow(
                i, j, surface_depth, normals, back_normals, has_back, thickness, image, depth, lens, rotation, index,
                ray,
            )  # fmt: skip
            back = ray[TURNED]
            light[0], light[1], light[2] = ray[COLOR], ray[COLOR + 1], ray[COLOR + 2]
            if ray[OUTSIDE] > 0.0 and back < 1.0:
                light[0], light[1], light[2] = _looked_up(
                    pictures[0], np.float32(ray[THROUGH]), np.float32(ray[THROUGH + 1]), np.float32(ray[THROUGH + 2])
                )
            if back > 0.0:
                r, g, b = _looked_up(
                    pictures[dim], np.float32(ray[INWARD]), np.float32(ray[INWARD + 1]), np.float32(ray[INWARD + 2])
                )
                if back >= 1.0:
                    light[0], light[1], light[2] = r, g, b
                else:
                    light[0] += back * (r - light[0])
                    light[1] += back * (g - light[1])
                    light[2] += back * (b - light[2])
            for k in range(3):
                light[k] *= math.exp(-(numbers[12 + k] + scattering) * ray[PATH])
            if scattering > 0.0:
                seen = -math.expm1(-scattering * ray[PATH])
                given = _looked_up(diffuse, normals[i, j, 0], normals[i, j, 1], normals[i, j, 2])
                bright = 0.0
                for k in range(3):
                    albedo = numbers[15 + k] * (1.0 - keeps) + keeps * carried[i, j, k]
                    light[k] += seen * albedo * given[k]
                    bright += luminance[k] * carried[i, j, k]
                if numbers[18] + numbers[19] + numbers[20] > 0.0:
                    warmth = 1.0 - (1.0 - warm) ** ((max(bright, 0.0) / usual) ** contrast)
                    kelvin = cool + (hot - cool) * warmth
                    for k in range(3):
                        light[k] += seen * numbers[18 + k] * math.exp((1.0 / hot - 1.0 / kelvin) * waves[k])
            spread = max(ray[SPREAD] - sharp, 0.0)
            wide = roughness if spread == 0.0 else math.sqrt(math.sqrt(roughness**4 + spread * spread))
            mirror = _mirrored(
                pictures, steps, wide, np.float32(ray[MIRROR]), np.float32(ray[MIRROR + 1]), np.float32(ray[MIRROR + 2])
            )
            share = straight + (ray[SHARE] - straight) * (1.0 - dull * roughness)
            for k in range(3):
                value = share * mirror[k] + (1.0 - share) * light[k]
                out[i, j, k] += part * (value - out[i, j, k])
