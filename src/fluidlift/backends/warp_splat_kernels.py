"""Warp kernel of the Gaussians that particles carry (model: `fluidlift.physics.deform.deform_gaussians`).

Products and rotations are in double precision, as on the CPU, and Gaussians are stored in single. Launches are flat.
Imported only by adapters that have found Warp.
"""

# pyright: reportArgumentType=false, reportAssignmentType=false, reportCallIssue=false
# pyright: reportGeneralTypeIssues=false, reportIndexIssue=false, reportInvalidTypeForm=false
# pyright: reportOperatorIssue=false
# what is written here is Warp's own language: Python's types of it are no types of the kernels

# Warp reads the annotations of kernels: they must not become strings
import warp as wp

from fluidlift.backends.warp_motion_kernels import rotation

wp.set_module_options({"enable_backward": False, "max_unroll": 3})  # no gradients, no long unrolled loops

real = wp.float64
ZERO, HALF, ONE, TWO = (wp.constant(real(x)) for x in (0.0, 0.5, 1.0, 2.0))
THIRD = wp.constant(real(1.0 / 3.0))
SWEEPS = wp.constant(12)
"""of Jacobi, at most; four usually do"""
DIAGONAL = wp.constant(real(1e-18))
"""squares off the diagonal over those on it: angles to 1e-9, since the results are kept in single precision"""
FLATTEST = wp.constant(real(1e-3))
"""shortest axis over the mean one"""
TINIEST = wp.constant(real(1e-18))
"""m^2, of a standard deviation: the logarithms of none are infinite"""


@wp.func
def axes(turn: wp.vec4, sizes: wp.vec3):
    """R S of a splat, from its quaternion (w, x, y, z) and its standard deviations."""
    w, x, y, z = real(turn[0]), real(turn[1]), real(turn[2]), real(turn[3])
    k = TWO / wp.max(w * w + x * x + y * y + z * z, real(1e-24))
    a, b, c = real(sizes[0]), real(sizes[1]), real(sizes[2])
    return wp.mat33d(
        a * (ONE - k * (y * y + z * z)), b * k * (x * y - w * z), c * k * (x * z + w * y),
        a * k * (x * y + w * z), b * (ONE - k * (x * x + z * z)), c * k * (y * z - w * x),
        a * k * (x * z - w * y), b * k * (y * z + w * x), c * (ONE - k * (x * x + y * y)),
    )  # fmt: skip


@wp.func
def quaternion(v: wp.mat33d):
    """w, x, y, z of a rotation: the largest of the four squared components is safe to divide by."""
    d = v[0, 0] + v[1, 1] + v[2, 2]
    if d >= v[0, 0] and d >= v[1, 1] and d >= v[2, 2]:
        w = TWO * wp.sqrt(wp.max(ONE + d, ZERO))
        return wp.vec4d(w / real(4.0), (v[2, 1] - v[1, 2]) / w, (v[0, 2] - v[2, 0]) / w, (v[1, 0] - v[0, 1]) / w)
    if v[0, 0] >= v[1, 1] and v[0, 0] >= v[2, 2]:
        x = TWO * wp.sqrt(wp.max(ONE + v[0, 0] - v[1, 1] - v[2, 2], ZERO))
        return wp.vec4d((v[2, 1] - v[1, 2]) / x, x / real(4.0), (v[1, 0] + v[0, 1]) / x, (v[0, 2] + v[2, 0]) / x)
    if v[1, 1] >= v[2, 2]:
        y = TWO * wp.sqrt(wp.max(ONE - v[0, 0] + v[1, 1] - v[2, 2], ZERO))
        return wp.vec4d((v[0, 2] - v[2, 0]) / y, (v[1, 0] + v[0, 1]) / y, y / real(4.0), (v[2, 1] + v[1, 2]) / y)
    z = TWO * wp.sqrt(wp.max(ONE - v[0, 0] - v[1, 1] + v[2, 2], ZERO))
    return wp.vec4d((v[1, 0] - v[0, 1]) / z, (v[0, 2] + v[2, 0]) / z, (v[2, 1] + v[1, 2]) / z, z / real(4.0))


@wp.kernel
def carry_splats(
    positions: wp.array(dtype=wp.vec3),
    deformation: wp.array(dtype=wp.mat33),
    source: wp.array(dtype=wp.int64),
    turns: wp.array(dtype=wp.vec4),
    sizes: wp.array(dtype=wp.vec3),
    max_ratio: wp.float64,
    max_size: wp.float64,
    means: wp.array(dtype=wp.vec3),
    quats: wp.array(dtype=wp.vec4),
    scales: wp.array(dtype=wp.vec3),
    sources: wp.array(dtype=wp.int64),
    strays: wp.array(dtype=int),
):
    """Axes and standard deviations of F A0 F^T = (F R S) (F R S)^T, and where they are; `strays` counts the particles
    whose source is no rest Gaussian."""
    p = wp.tid()
    means[p] = positions[p]
    sources[p] = source[p]
    at = int(source[p])
    if at < 0 or at >= turns.shape[0]:
        wp.atomic_add(strays, 0, 1)
        return
    own = axes(turns[at], sizes[at])
    m = wp.mat33d(deformation[p]) * own
    a = m * wp.transpose(m)
    sound = wp.isfinite(a)
    if not sound:
        a = own * wp.transpose(own)
    v = wp.identity(n=3, dtype=real)
    for _ in range(SWEEPS):
        off = a[0, 1] * a[0, 1] + a[0, 2] * a[0, 2] + a[1, 2] * a[1, 2]
        if off <= DIAGONAL * (a[0, 0] * a[0, 0] + a[1, 1] * a[1, 1] + a[2, 2] * a[2, 2]):
            break
        r = rotation(a, 0, 1)
        a, v = wp.transpose(r) * a * r, v * r
        r = rotation(a, 0, 2)
        a, v = wp.transpose(r) * a * r, v * r
        r = rotation(a, 1, 2)
        a, v = wp.transpose(r) * a * r, v * r
    s = wp.vec3d(
        wp.sqrt(wp.max(a[0, 0], TINIEST)), wp.sqrt(wp.max(a[1, 1], TINIEST)), wp.sqrt(wp.max(a[2, 2], TINIEST))
    )
    size = wp.pow(s[0] * s[1] * s[2], THIRD)
    turn = quaternion(v)
    if not sound or wp.max(s) > max_ratio * size:
        s = wp.vec3d(size, size, size)
        turn = wp.vec4d(ONE, ZERO, ZERO, ZERO)
    least = FLATTEST * size
    for e in range(3):
        s[e] = wp.min(wp.max(s[e], least), max_size)
    quats[p] = wp.vec4(turn)
    scales[p] = wp.vec3(s)
