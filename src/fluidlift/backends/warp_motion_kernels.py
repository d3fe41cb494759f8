"""Warp kernels that move particles: displacement, walls (model: `fluidlift.physics.boundaries`), deformation.

What decides whether a particle is inside the solid is computed in double precision, as on the CPU. Launches are flat.
Imported only by adapters that have found Warp.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportCallIssue=false
# pyright: reportGeneralTypeIssues=false, reportIndexIssue=false, reportInvalidTypeForm=false
# pyright: reportOperatorIssue=false
# what is written here is Warp's own language: Python's types of it are no types of the kernels

# Warp reads the annotations of kernels: they must not become strings
import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 3})  # no gradients, no long unrolled loops

real = wp.float64
ZERO, HALF, ONE, TWO = (wp.constant(real(x)) for x in (0.0, 0.5, 1.0, 2.0))
FIRST_THROUGH = wp.constant(3)
"""INFLOW and OUTFLOW of `CellType`: fluid passes there"""
SWEEPS = wp.constant(8)
"""of Jacobi: three usually do in double precision"""


@wp.struct
class Box:
    """The boundaries and the rules of one step."""

    low: wp.vec3d
    high: wp.vec3d
    spacing: wp.float64
    clearance: wp.float64
    """m: how far outside the solid a particle is put"""
    contact: wp.float64
    """m: a free flight that ends closer to the wall is an impact"""
    distance: wp.array3d(dtype=wp.float32)
    regions: wp.array3d(dtype=wp.uint8)
    open_low: wp.vec3i
    open_high: wp.vec3i
    dt: wp.float64
    restitution: wp.float64
    keep: wp.float64


@wp.func
def lerp64(a: real, b: real, t: real):
    return a * (ONE - t) + b * t


@wp.func
def distance_and_gradient(box: Box, x: wp.vec3d):
    """(gradient, value) of the trilinear interpolant; outside the box the nearest value goes on."""
    f = box.distance
    s = (x - box.low) / box.spacing
    s = wp.vec3d(
        wp.clamp(s[0], ZERO, real(f.shape[0] - 1)),
        wp.clamp(s[1], ZERO, real(f.shape[1] - 1)),
        wp.clamp(s[2], ZERO, real(f.shape[2] - 1)),
    )
    i, j, k = wp.min(int(s[0]), f.shape[0] - 2), wp.min(int(s[1]), f.shape[1] - 2), wp.min(int(s[2]), f.shape[2] - 2)
    t = s - wp.vec3d(real(i), real(j), real(k))
    a, b, c, d = real(f[i, j, k]), real(f[i, j, k + 1]), real(f[i, j + 1, k]), real(f[i, j + 1, k + 1])
    e, g = real(f[i + 1, j, k]), real(f[i + 1, j, k + 1])
    m, n = real(f[i + 1, j + 1, k]), real(f[i + 1, j + 1, k + 1])
    slope_low, slope_high = lerp64(e - a, m - c, t[1]), lerp64(g - b, n - d, t[1])
    a, b, c, d = lerp64(a, e, t[0]), lerp64(b, g, t[0]), lerp64(c, m, t[0]), lerp64(d, n, t[0])
    low_z, high_z = lerp64(a, c, t[1]), lerp64(b, d, t[1])
    gx = lerp64(slope_low, slope_high, t[2])
    gy = lerp64(c - a, d - b, t[2])
    gradient = wp.vec3d(gx, gy, high_z - low_z) / box.spacing
    return wp.vec4d(gradient[0], gradient[1], gradient[2], lerp64(low_z, high_z, t[2]))


@wp.func
def rounded(x: wp.vec3d):
    """As it will be stored."""
    return wp.vec3d(wp.vec3(float(x[0]), float(x[1]), float(x[2])))


@wp.func
def flows_through(box: Box, x: wp.vec3d):
    """Whether the cell is an inlet or an outlet."""
    s = (x - box.low) / box.spacing
    i = wp.clamp(int(s[0]), 0, box.regions.shape[0] - 1)
    j = wp.clamp(int(s[1]), 0, box.regions.shape[1] - 1)
    k = wp.clamp(int(s[2]), 0, box.regions.shape[2] - 1)
    return int(box.regions[i, j, k]) >= FIRST_THROUGH


@wp.func
def off_the_walls(box: Box, v: wp.vec3d, incoming: wp.vec3d, old: wp.vec3d, there: wp.vec4d):
    """The velocity after damping along the wall and bouncing off it."""
    gradient = wp.vec3d(there[0], there[1], there[2])
    length = wp.length(gradient)
    if length <= real(1e-3):
        return v
    out = gradient / length
    normal = wp.dot(v, out)
    share = wp.clamp(ONE - there[3] / box.spacing, ZERO, ONE)
    back = normal
    if there[3] < box.clearance:
        back = wp.max(normal, ZERO)
    before = wp.dot(incoming, out)
    if before < ZERO and box.restitution > ZERO:
        flight = distance_and_gradient(box, old + box.dt * incoming)
        if flight[3] < box.contact:
            back = wp.max(back, -box.restitution * before)
    return (ONE - (ONE - box.keep) * share) * (v - normal * out) + back * out


@wp.func
def pushed_out(box: Box, x: wp.vec3d, there: wp.vec4d, old: wp.vec3d):
    """The place moved along the gradient until it is clear of the solid, or the old one where that fails."""
    low = box.low + wp.vec3d(box.clearance, box.clearance, box.clearance)
    high = box.high - wp.vec3d(box.clearance, box.clearance, box.clearance)
    for _ in range(6):
        gradient = wp.vec3d(there[0], there[1], there[2])
        squared = wp.dot(gradient, gradient)
        if there[3] < box.clearance and squared >= real(1e-6):
            x = x + real(1.01) * (box.clearance - there[3]) / squared * gradient
            x = wp.min(wp.max(x, low), high)
            there = distance_and_gradient(box, x)
    x = rounded(x)
    there = distance_and_gradient(box, x)
    if there[3] > ZERO:
        return x
    return old


@wp.kernel
def move_particles(
    box: Box,
    positions: wp.array(dtype=wp.vec3),
    incoming: wp.array(dtype=wp.vec3),
    moves: wp.array(dtype=wp.vec3),
    velocities: wp.array(dtype=wp.vec3),
    new_positions: wp.array(dtype=wp.vec3),
):
    """Displace and collide; `velocities` change at walls."""
    p = wp.tid()
    old, before, v = wp.vec3d(positions[p]), wp.vec3d(incoming[p]), wp.vec3d(velocities[p])
    x = wp.vec3d(positions[p] + moves[p])
    if not flows_through(box, old):
        for a in range(3):
            lowest, highest = box.low[a] + box.clearance, box.high[a] - box.clearance
            flight = old[a] + box.dt * before[a]
            if box.open_low[a] == 0:
                if flight < lowest and before[a] < ZERO:
                    v[a] = wp.max(v[a], -box.restitution * before[a])
                x[a] = wp.max(x[a], lowest)
            if box.open_high[a] == 0:
                if flight > highest and before[a] > ZERO:
                    v[a] = wp.min(v[a], -box.restitution * before[a])
                x[a] = wp.min(x[a], highest)
    x = rounded(x)
    v = rounded(v)
    # no terrain is known out of the box
    inside = x[0] >= box.low[0] and x[1] >= box.low[1] and x[2] >= box.low[2]
    inside = inside and x[0] < box.high[0] and x[1] < box.high[1] and x[2] < box.high[2]
    there = distance_and_gradient(box, x)
    if inside and there[3] < box.spacing:
        v = off_the_walls(box, v, before, old, there)
        if there[3] < box.clearance:
            x = pushed_out(box, x, there, old)
    new_positions[p] = wp.vec3(float(x[0]), float(x[1]), float(x[2]))
    velocities[p] = wp.vec3(float(v[0]), float(v[1]), float(v[2]))


@wp.func
def rotation(a: wp.mat33d, p: int, q: int):
    """The rotation r for which r^T a r has nothing at (p, q) (Jacobi)."""
    r = wp.identity(n=3, dtype=real)
    if a[p, q] != ZERO:
        theta = (a[q, q] - a[p, p]) / (TWO * a[p, q])
        t = ONE / (wp.abs(theta) + wp.sqrt(theta * theta + ONE))
        if theta < ZERO:
            t = -t
        c = ONE / wp.sqrt(t * t + ONE)
        r[p, p] = c
        r[q, q] = c
        r[p, q] = t * c
        r[q, p] = -t * c
    return r


@wp.func
def limited(f: wp.mat33d, largest: real):
    """Singular values brought into [1/largest, largest], by the eigenvectors of f f^T (Jacobi sweeps)."""
    a = f * wp.transpose(f)
    v = wp.identity(n=3, dtype=real)
    for sweep in range(3 * SWEEPS):
        p, q = (sweep % 3) // 2, (sweep % 3 + 3) // 2  # (0, 1), (0, 2), (1, 2)
        r = rotation(a, p, q)
        a = wp.transpose(r) * a * r
        v = v * r
    g = wp.transpose(v) * f
    for e in range(3):
        stretch = wp.sqrt(wp.max(a[e, e], real(1e-12)))
        g[e] = g[e] * (wp.clamp(stretch, ONE / largest, largest) / stretch)
    return v * g


@wp.kernel
def deform_particles(
    affine: wp.array(dtype=wp.mat33),
    dt: wp.float64,
    max_stretch: wp.float64,
    deformation: wp.array(dtype=wp.mat33),
    new_deformation: wp.array(dtype=wp.mat33),
):
    """(I + dt C) F with determinant 1 and limited stretches (see `fluidlift.physics.deform`)."""
    p = wp.tid()
    before = wp.mat33d(deformation[p])
    f = before + dt * (wp.mat33d(affine[p]) * before)
    det = wp.determinant(f)
    if not (det > real(1e-6) and det < real(1e6)):
        new_deformation[p] = wp.identity(n=3, dtype=float)
    else:
        f = f * wp.pow(det, real(-1.0 / 3.0))
        squared = wp.ddot(f, f)
        # with det F = 1 and a limit s >= 2, a sum of squared stretches up to 2 s keeps all within [1/s, s]
        if squared > TWO * max_stretch or max_stretch < TWO:
            f = limited(f, max_stretch)
        new_deformation[p] = wp.mat33(f)
