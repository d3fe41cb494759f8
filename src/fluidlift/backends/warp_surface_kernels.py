"""Warp kernels of the free surface (model and plain form: `fluidlift.physics.free_surface`, `.surface_kernels`).

Imported only by adapters that have found Warp.
"""

# pyright: reportArgumentType=false, reportCallIssue=false, reportIndexIssue=false, reportInvalidTypeForm=false
# pyright: reportOperatorIssue=false, reportGeneralTypeIssues=false, reportAssignmentType=false
# what is written here is Warp's own language: Python's types of it are no types of the kernels

import math

# Warp reads the annotations of kernels: they must not become strings
import warp as wp

from fluidlift.backends.warp_transfer_kernels import spline
from fluidlift.physics import surface_kernels as cpu

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

DEPTH = wp.constant(float(cpu.DEPTH))
LEAST_FILL = wp.constant(float(cpu.LEAST_FILL))
WIDTH = wp.constant(math.sqrt(2.0 * cpu.VARIANCE))
HALF_VARIANCE = wp.constant(0.5 * cpu.VARIANCE)
LARGEST_CURVATURE = wp.constant(float(cpu.LARGEST_CURVATURE))
RELAXATION = wp.constant(float(cpu.RELAXATION))
SOLID_DEPTH = wp.constant(float(cpu.SOLID_DEPTH))


@wp.func
def mirrored_spline(i: int, count: int, x: float):
    """Weight of cell i at x (cells, cell centres at whole numbers); what falls beyond the sides is mirrored."""
    w = spline(float(i) - x)
    if i == 0:
        w += spline(-1.0 - x)
    if i == count - 1:
        w += spline(float(count) - x)
    return w


@wp.func
def hat(d: float):
    """The linear B-spline of a distance in cells."""
    return wp.max(0.0, 1.0 - wp.abs(d))


@wp.func
def kept_hat(i: int, count: int, x: float):
    """Linear weight of cell i at x; what falls beyond the sides goes to the outermost cell."""
    w = hat(float(i) - x)
    if i == 0:
        w += hat(-1.0 - x)
    if i == count - 1:
        w += hat(float(count) - x)
    return w


@wp.kernel
def deposit_volumes(
    positions: wp.array(dtype=wp.vec3),
    masses: wp.array(dtype=float),
    ends: wp.array(dtype=int),
    low: wp.vec3,
    spacing: float,
    per_mass: float,
    share: wp.array3d(dtype=float),
    crowd: wp.array3d(dtype=float),
):
    """Volumes (cells) of the particles around each cell centre: by quadratic splines, and by linear ones.

    One thread per cell; the particles are in the order of the cells, cell c holds those from ends[c-1] to ends[c]-1.
    """
    i, j, k = wp.tid()
    nx, ny, nz = share.shape[0], share.shape[1], share.shape[2]
    total, near = wp.float32(0.0), wp.float32(0.0)
    for a in range(wp.max(i - 1, 0), wp.min(i + 2, nx)):
        for b in range(wp.max(j - 1, 0), wp.min(j + 2, ny)):
            row = (a * ny + b) * nz
            start = row + wp.max(k - 1, 0)
            n = wp.int32(0)
            if start > 0:
                n = ends[start - 1]
            last = ends[row + wp.min(k + 1, nz - 1)]
            while n < last:
                x = (positions[n] - low) * (1.0 / spacing) - wp.vec3(0.5, 0.5, 0.5)
                amount = masses[n] * per_mass
                total += amount * (
                    mirrored_spline(i, nx, x[0]) * mirrored_spline(j, ny, x[1]) * mirrored_spline(k, nz, x[2])
                )
                near += amount * kept_hat(i, nx, x[0]) * kept_hat(j, ny, x[1]) * kept_hat(k, nz, x[2])
                n += 1
    share[i, j, k] = total
    crowd[i, j, k] = near


@wp.func
def along_x(f: wp.array3d(dtype=float), side: float, i: int, j: int, k: int):
    a, b = wp.max(i - 1, 0), wp.min(i + 1, f.shape[0] - 1)
    return side * (f[a, j, k] + f[b, j, k]) + (1.0 - 2.0 * side) * f[i, j, k]


@wp.func
def along_xy(f: wp.array3d(dtype=float), side: float, i: int, j: int, k: int):
    c, d = wp.max(j - 1, 0), wp.min(j + 1, f.shape[1] - 1)
    return side * (along_x(f, side, i, c, k) + along_x(f, side, i, d, k)) + (1.0 - 2.0 * side) * along_x(
        f, side, i, j, k
    )


@wp.kernel
def three_point(field: wp.array3d(dtype=float), side: float, out: wp.array3d(dtype=float)):
    """Weights side, 1 - 2 side, side along each axis; the outermost cells are repeated (a mirror)."""
    i, j, k = wp.tid()
    e, g = wp.max(k - 1, 0), wp.min(k + 1, field.shape[2] - 1)
    out[i, j, k] = side * (along_xy(field, side, i, j, e) + along_xy(field, side, i, j, g)) + (
        1.0 - 2.0 * side
    ) * along_xy(field, side, i, j, k)


@wp.func
def inverse_error_function(x: float):
    """Giles 2012, "Approximating the erfinv function"."""
    w = -wp.log((1.0 - x) * (1.0 + x))
    p = float(0.0)
    if w < 5.0:
        w -= 2.5
        p = 2.81022636e-08
        p = 3.43273939e-07 + p * w
        p = -3.5233877e-06 + p * w
        p = -4.39150654e-06 + p * w
        p = 0.00021858087 + p * w
        p = -0.00125372503 + p * w
        p = -0.00417768164 + p * w
        p = 0.246640727 + p * w
        p = 1.50140941 + p * w
    else:
        w = wp.sqrt(w) - 3.0
        p = -0.000200214257
        p = 0.000100950558 + p * w
        p = 0.00134934322 + p * w
        p = -0.00367342844 + p * w
        p = 0.00573950773 + p * w
        p = -0.0076224613 + p * w
        p = 0.00943887047 + p * w
        p = 1.00167406 + p * w
        p = 2.83297682 + p * w
    return p * x


@wp.func
def flat_distance(fill: float):
    """Distance (cells) of the surface, were it flat; within `DEPTH`."""
    if fill <= LEAST_FILL:
        return DEPTH
    if fill >= 1.0 - LEAST_FILL:
        return -DEPTH
    return -WIDTH * inverse_error_function(2.0 * fill - 1.0)


@wp.func
def slopes(f: wp.array3d(dtype=float), i: int, j: int, k: int):
    """Central differences, mirrored at the border."""
    x = f[wp.min(i + 1, f.shape[0] - 1), j, k] - f[wp.max(i - 1, 0), j, k]
    y = f[i, wp.min(j + 1, f.shape[1] - 1), k] - f[i, wp.max(j - 1, 0), k]
    z = f[i, j, wp.min(k + 1, f.shape[2] - 1)] - f[i, j, wp.max(k - 1, 0)]
    return 0.5 * wp.vec3(x, y, z)


@wp.func
def outward(fill: wp.array3d(dtype=float), i: int, j: int, k: int):
    """Normal out of the liquid, of length 1; shorter where the fill hardly changes."""
    s = slopes(fill, i, j, k)
    return s * (-1.0 / wp.max(wp.length(s), 1.0e-3))


@wp.kernel
def begin_virtual(
    layer: wp.array3d(dtype=wp.uint8),
    open_share: wp.array3d(dtype=float),
    around: wp.array3d(dtype=float),
    share: wp.array3d(dtype=float),
    fill: wp.array3d(dtype=float),
    filling: wp.array3d(dtype=float),
    mixed: wp.array3d(dtype=float),
):
    """First guess of the virtual liquid in solids; `mixed` is the share of real and virtual liquid."""
    i, j, k = wp.tid()
    v = float(0.0)
    if layer[i, j, k] > wp.uint8(0) and around[i, j, k] > 0.05:
        v = wp.min(fill[i, j, k] / wp.max(around[i, j, k], 0.05), 1.0)
    filling[i, j, k] = v
    mixed[i, j, k] = share[i, j, k] + (1.0 - open_share[i, j, k]) * v


@wp.kernel
def continue_into_solid(
    layer: wp.array3d(dtype=wp.uint8),
    want: int,
    open_share: wp.array3d(dtype=float),
    fill: wp.array3d(dtype=float),
    distance: wp.array3d(dtype=float),
    normal: wp.array3d(dtype=wp.vec3),
):
    """Distance and normal in the cells of one layer, by linear extrapolation from the layers before it."""
    i, j, k = wp.tid()
    if int(layer[i, j, k]) != want:
        return
    if want == 1:
        distance[i, j, k] = flat_distance(fill[i, j, k])
        normal[i, j, k] = outward(fill, i, j, k)
        return
    total, weights, sums = float(0.0), float(0.0), wp.vec3(0.0, 0.0, 0.0)
    for a in range(wp.max(i - 1, 0), wp.min(i + 2, fill.shape[0])):
        for b in range(wp.max(j - 1, 0), wp.min(j + 2, fill.shape[1])):
            for c in range(wp.max(k - 1, 0), wp.min(k + 2, fill.shape[2])):
                number = int(layer[a, b, c])
                if number < want:
                    d, n = float(distance[a, b, c]), wp.vec3(normal[a, b, c])
                    if number == 0:
                        d = flat_distance(fill[a, b, c])
                        n = outward(fill, a, b, c)
                    offset = wp.vec3(float(i - a), float(j - b), float(k - c))
                    weight = 1.0 / (1.0 + wp.length_sq(offset))
                    if want == 2:
                        weight *= open_share[a, b, c] * open_share[a, b, c]
                    total += weight * (d + wp.dot(n, offset))
                    sums += weight * n
                    weights += weight
    if weights > 0.0:
        distance[i, j, k] = total / weights
        normal[i, j, k] = sums / weights


@wp.kernel
def fill_solid(
    layer: wp.array3d(dtype=wp.uint8),
    deepest: int,
    open_share: wp.array3d(dtype=float),
    share: wp.array3d(dtype=float),
    distance: wp.array3d(dtype=float),
    normal: wp.array3d(dtype=wp.vec3),
    filling: wp.array3d(dtype=float),
    mixed: wp.array3d(dtype=float),
):
    """Virtual liquid: the share of each cell's solid part that lies below the continued surface."""
    i, j, k = wp.tid()
    number = int(layer[i, j, k])
    if number == 0 or number > deepest:
        return
    s = slopes(open_share, i, j, k)
    reach = SOLID_DEPTH * open_share[i, j, k] / wp.max(wp.length(s), 1.0e-3)
    d = distance[i, j, k] - reach * wp.dot(normal[i, j, k], s)
    below = 0.5 * wp.erfc(d / wp.sqrt(0.5))
    old = float(filling[i, j, k])
    new = wp.clamp(old + RELAXATION * (below - old), 0.0, 1.0)
    filling[i, j, k] = new
    mixed[i, j, k] = share[i, j, k] + (1.0 - open_share[i, j, k]) * new


@wp.func
def curvature_at(f: wp.array3d(dtype=float), i: int, j: int, k: int):
    """div(n) with n = -grad f / |grad f|, central differences."""
    s = slopes(f, i, j, k)
    squared = wp.length_sq(s)
    if squared < 1.0e-6:
        return float(0.0)
    a, b = wp.max(i - 1, 0), wp.min(i + 1, f.shape[0] - 1)
    c, d = wp.max(j - 1, 0), wp.min(j + 1, f.shape[1] - 1)
    e, g = wp.max(k - 1, 0), wp.min(k + 1, f.shape[2] - 1)
    here = f[i, j, k]
    xx = f[b, j, k] - 2.0 * here + f[a, j, k]
    yy = f[i, d, k] - 2.0 * here + f[i, c, k]
    zz = f[i, j, g] - 2.0 * here + f[i, j, e]
    xy = 0.25 * (f[b, d, k] - f[b, c, k] - f[a, d, k] + f[a, c, k])
    xz = 0.25 * (f[b, j, g] - f[b, j, e] - f[a, j, g] + f[a, j, e])
    yz = 0.25 * (f[i, d, g] - f[i, d, e] - f[i, c, g] + f[i, c, e])
    total = (yy + zz) * s[0] * s[0] + (xx + zz) * s[1] * s[1] + (xx + yy) * s[2] * s[2]
    total -= 2.0 * (s[0] * s[1] * xy + s[0] * s[2] * xz + s[1] * s[2] * yz)
    return -total / (squared * wp.sqrt(squared))


@wp.kernel
def surface_distance(
    fill: wp.array3d(dtype=float),
    smooth: wp.array3d(dtype=float),
    clear: wp.array3d(dtype=float),
    band: float,
    spacing: float,
    out: wp.array3d(dtype=float),
):
    """Distance (m) with the shift by the blur taken back, at most `band` cells."""
    i, j, k = wp.tid()
    f = fill[i, j, k]
    bend = float(0.0)
    if f > LEAST_FILL and f < 1.0 - LEAST_FILL:
        bend = wp.clamp(curvature_at(smooth, i, j, k), -LARGEST_CURVATURE, LARGEST_CURVATURE)
    d = flat_distance(f) - HALF_VARIANCE * bend * clear[i, j, k]
    out[i, j, k] = wp.clamp(d, -band, band) * spacing
