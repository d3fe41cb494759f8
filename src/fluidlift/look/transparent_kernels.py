"""The compiled loop of `transparent`: from sums along the rays to a surface (Numba). In NumPy it is
`transparent.rated_plain`."""

from __future__ import annotations

import math

import numba as nb

from fluidlift.look.smoothstep import eased
from fluidlift.numerics.sharing import shared


@nb.njit(cache=True, inline="always")
def _facing(x, y, z, tx, ty, tz, leaning):
    """A vector's direction, turned as little as need be towards a viewer at t (unit) for a cosine of at least
    `leaning`, and its own cosine; t itself for a vector of no length."""
    length = math.sqrt(x * x + y * y + z * z)
    if not length > 1e-9:
        return tx, ty, tz, tx * tx + ty * ty + tz * tz
    x, y, z = x / length, y / length, z / length
    own = x * tx + y * ty + z * tz
    if own >= leaning:
        return x, y, z, own
    cosine = max(own, -1.0)
    ax, ay, az = x - cosine * tx, y - cosine * ty, z - cosine * tz
    length = math.sqrt(ax * ax + ay * ay + az * az)
    across = math.sqrt(1.0 - leaning * leaning) / length if length > 1e-9 else 0.0
    return leaning * tx + across * ax, leaning * ty + across * ay, leaning * tz + across * az, own


@nb.njit(cache=True, inline="always")
def _toward(i, j, lens, rotation):
    """Unit direction (world) from what is seen in a pixel to the viewer, and metres of its ray per metre of camera z.
    lens: fx, fy, cx, cy."""
    x, y = (j + 0.5 - lens[2]) / lens[0], (i + 0.5 - lens[3]) / lens[1]
    away = math.sqrt(x * x + y * y + 1.0)
    rx = x * rotation[0, 0] + y * rotation[1, 0] + rotation[2, 0]
    ry = x * rotation[0, 1] + y * rotation[1, 1] + rotation[2, 1]
    rz = x * rotation[0, 2] + y * rotation[1, 2] + rotation[2, 2]
    return -rx / away, -ry / away, -rz / away, away


@shared(lambda total, *_: (0, total.shape[0]), error_model="numpy")
def rated(begin, end, total, skin, eye, numbers, covered, depth, normal, albedo):
    """Cover, depth (m; negative where the surface would lie behind the camera), normal and colour of a surface.

    total: m of liquid; skin: m found of its first part, and the sums over it of depth, normal and colour, times m.
    eye: fx, fy, cx, cy, and the camera's rotation. numbers: `COVERED` (m), `AWAY`, `LEANING`.
    """
    lens, rotation = eye
    thin, full, hidden, shown, leaning = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]
    for i in range(begin, end):
        for j in range(total.shape[1]):
            tx, ty, tz, away = _toward(i, j, lens, rotation)
            nx, ny, nz, own = _facing(skin[i, j, 2], skin[i, j, 3], skin[i, j, 4], tx, ty, tz, leaning)
            normal[i, j, 0], normal[i, j, 1], normal[i, j, 2] = nx, ny, nz
            part = eased((total[i, j] - thin) / (full - thin)) * eased((own - hidden) / (shown - hidden))
            covered[i, j], depth[i, j] = part, 0.0
            albedo[i, j, 0], albedo[i, j, 1], albedo[i, j, 2] = 0.0, 0.0, 0.0
            if part > 0.0:
                found = max(skin[i, j, 0], 1e-12)
                depth[i, j] = skin[i, j, 1] / found - 0.5 * skin[i, j, 0] / away
                for k in range(3):
                    albedo[i, j, k] = min(max(skin[i, j, 5 + k] / found, 0.0), 1.0)


@shared(lambda skin, *_: (0, skin.shape[0]), error_model="numpy")
def far_normals(begin, end, skin, eye, leaning, normal):
    """Normals of a far side, away from the viewer; arguments as of `rated`."""
    lens, rotation = eye
    for i in range(begin, end):
        for j in range(skin.shape[1]):
            tx, ty, tz, _ = _toward(i, j, lens, rotation)
            nx, ny, nz, _ = _facing(skin[i, j, 2], skin[i, j, 3], skin[i, j, 4], -tx, -ty, -tz, leaning)
            normal[i, j, 0], normal[i, j, 1], normal[i, j, 2] = nx, ny, nz
