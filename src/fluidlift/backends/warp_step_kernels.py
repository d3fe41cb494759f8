"""Warp kernels of one substep on particles that lie in the order of their cells: to the grid, displacement, crowds,
leaving, and what the host needs to know (model: `physics.transfer`, `.advect_particles`, `.position_correction`).

Imported only by adapters that have found Warp.
"""

# pyright: reportArgumentType=false, reportCallIssue=false, reportIndexIssue=false, reportInvalidTypeForm=false
# pyright: reportOperatorIssue=false, reportGeneralTypeIssues=false, reportAssignmentType=false
# what is written here is Warp's own language: Python's types of it are no types of the kernels

# Warp reads the annotations of kernels: they must not become strings
import warp as wp

from fluidlift.backends.warp_faces import Faces, cell_or, face, is_face, put, step
from fluidlift.backends.warp_sorting_kernels import first_of
from fluidlift.backends.warp_transfer_kernels import spline
from fluidlift.physics import position_correction as cpu
from fluidlift.types import CellType

wp.set_module_options({"enable_backward": False})

real = wp.float64
OUTFLOW = wp.constant(int(CellType.OUTFLOW))
TOLERATED = wp.constant(float(cpu.TOLERATED))
RELAXATION = wp.constant(float(cpu.RELAXATION))
LARGEST_EXCESS = wp.constant(float(cpu.LARGEST_EXCESS))
LARGEST_LACK = wp.constant(float(cpu.LARGEST_LACK))
FAR = wp.constant(1.0e30)
"""m and m/s: what is beyond is no number that a step may go on with"""


@wp.kernel
def sum_over_particles(
    positions: wp.array(dtype=wp.vec3),
    velocities: wp.array2d(dtype=float),
    affine: wp.array2d(dtype=wp.vec3),
    masses: wp.array(dtype=float),
    ends: wp.array(dtype=int),
    low: wp.vec3,
    spacing: float,
    shape: wp.vec3i,
    carried: Faces,
    face_masses: Faces,
):
    """Velocity (m/s, 0 where no particle reaches) and mass (kg) of each face: the particles of the cells around it are
    added in their order, so nothing is left to chance.

    `affine` holds the rows of the matrices; cell c holds the particles ends[c-1] to ends[c]-1.
    """
    axis, i, j, k = wp.tid()
    if not is_face(shape, axis, i, j, k):
        return
    s = step(axis)  # faces across the axis lie between two cells: four cells along it are in reach
    at = wp.vec3(float(i) + 0.5, float(j) + 0.5, float(k) + 0.5) - 0.5 * wp.vec3(float(s[0]), float(s[1]), float(s[2]))
    total, sum_m = wp.float32(0.0), wp.float32(0.0)
    k0, k1 = wp.max(k - 1 - s[2], 0), wp.min(k + 1, shape[2] - 1)
    for ci in range(wp.max(i - 1 - s[0], 0), wp.min(i + 1, shape[0] - 1) + 1):
        for cj in range(wp.max(j - 1 - s[1], 0), wp.min(j + 1, shape[1] - 1) + 1):
            row = (ci * shape[1] + cj) * shape[2]
            n = first_of(ends, row + k0)
            last = ends[row + k1]
            while n < last:
                offset = at - (positions[n] - low) * (1.0 / spacing)
                weight = spline(offset[0]) * spline(offset[1]) * spline(offset[2])
                if weight > 0.0:
                    weight *= masses[n]
                    sum_m += weight
                    total += weight * (velocities[n, axis] + wp.dot(affine[n, axis], offset) * spacing)
                n += 1
    put(face_masses, axis, i, j, k, sum_m)
    v = float(0.0)
    if sum_m > 1.0e-30:
        v = total / sum_m
    put(carried, axis, i, j, k, v)


@wp.kernel
def scale(values: wp.array3d(dtype=float), factor: float, out: wp.array3d(dtype=float)):
    """Values times a factor."""
    i, j, k = wp.tid()
    out[i, j, k] = values[i, j, k] * factor


@wp.kernel
def wanted_spread(
    unknown: wp.array3d(dtype=wp.uint8),
    weights: Faces,
    crowd: wp.array3d(dtype=float),
    capacity: wp.array3d(dtype=float),
    out: wp.array3d(dtype=float),
):
    """Divergence that spreads the particles of crowded cells, and draws some into thin ones away from the air."""
    i, j, k = wp.tid()
    wanted = float(0.0)
    if unknown[i, j, k] != wp.uint8(0):
        room = capacity[i, j, k]
        ratio = crowd[i, j, k] / wp.max(room, 0.25)
        wanted = RELAXATION * wp.clamp(ratio - 1.0 - TOLERATED, 0.0, LARGEST_EXCESS)
        lack = wp.clamp(ratio - 1.0 + TOLERATED, -LARGEST_LACK, 0.0)
        if room >= 0.5 and lack < 0.0:
            surface = bool(False)
            for axis in range(3):
                s = step(axis)
                for side in range(2):
                    sign = 2 * side - 1
                    beside = cell_or(unknown, i + sign * s[0], j + sign * s[1], k + sign * s[2], 0)
                    if beside == 0 and face(weights, axis, i + side * s[0], j + side * s[1], k + side * s[2]) > 0.0:
                        surface = True
            if not surface:
                wanted += 0.5 * RELAXATION * lack
        wanted *= room
    out[i, j, k] = wanted


@wp.func
def trilinear(f: wp.array3d(dtype=float), s: wp.vec3):
    """Value at a place in cells of the field's own lattice, the outermost one continued."""
    x = wp.clamp(s[0], 0.0, float(f.shape[0] - 1))
    y = wp.clamp(s[1], 0.0, float(f.shape[1] - 1))
    z = wp.clamp(s[2], 0.0, float(f.shape[2] - 1))
    i = wp.max(wp.min(int(x), f.shape[0] - 2), 0)
    j = wp.max(wp.min(int(y), f.shape[1] - 2), 0)
    k = wp.max(wp.min(int(z), f.shape[2] - 2), 0)
    i1, j1, k1 = wp.min(i + 1, f.shape[0] - 1), wp.min(j + 1, f.shape[1] - 1), wp.min(k + 1, f.shape[2] - 1)
    fx, fy, fz = x - float(i), y - float(j), z - float(k)
    low = (f[i, j, k] * (1.0 - fz) + f[i, j, k1] * fz) * (1.0 - fy)
    low += (f[i, j1, k] * (1.0 - fz) + f[i, j1, k1] * fz) * fy
    high = (f[i1, j, k] * (1.0 - fz) + f[i1, j, k1] * fz) * (1.0 - fy)
    high += (f[i1, j1, k] * (1.0 - fz) + f[i1, j1, k1] * fz) * fy
    return low * (1.0 - fx) + high * fx


@wp.kernel
def displace(
    velocities: wp.array(dtype=wp.vec3),
    affine: wp.array(dtype=wp.mat33),
    dt: float,
    half: float,
    moves: wp.array(dtype=wp.vec3),
    total: wp.array(dtype=wp.vec3),
):
    """dt (v + dt/2 C v), m: RK2 by the affine matrix. `total` is the same, and 0 where that is no number."""
    p = wp.tid()
    v = velocities[p]
    move = dt * (v + half * (affine[p] * v))
    moves[p] = move
    size = wp.abs(move)
    if not (size[0] <= FAR and size[1] <= FAR and size[2] <= FAR):
        move = wp.vec3(0.0, 0.0, 0.0)
    total[p] = move


@wp.kernel
def add_spread(
    positions: wp.array(dtype=wp.vec3),
    low: wp.vec3,
    spacing: float,
    field: Faces,
    limit: float,
    total: wp.array(dtype=wp.vec3),
):
    """A displacement on faces (m), shortened to at most `limit` (m), is added."""
    p = wp.tid()
    s = (positions[p] - low) * (1.0 / spacing)
    a = trilinear(field.x, s - wp.vec3(0.0, 0.5, 0.5))
    b = trilinear(field.y, s - wp.vec3(0.5, 0.0, 0.5))
    c = trilinear(field.z, s - wp.vec3(0.5, 0.5, 0.0))
    spread = wp.vec3(a, b, c)
    length = wp.length(spread)
    if length > limit:
        spread = spread * (limit / length)
    total[p] = total[p] + spread


@wp.func
def in_outflow(regions: wp.array3d(dtype=wp.uint8), s: wp.vec3d):
    """Whether a place (cells) is in the outlet; one outside the box counts for the nearest cell."""
    i = wp.clamp(int(wp.floor(s[0])), 0, regions.shape[0] - 1)
    j = wp.clamp(int(wp.floor(s[1])), 0, regions.shape[1] - 1)
    k = wp.clamp(int(wp.floor(s[2])), 0, regions.shape[2] - 1)
    return int(regions[i, j, k]) == OUTFLOW


@wp.kernel
def mark_leaving(
    before: wp.array(dtype=wp.vec3),
    after: wp.array(dtype=wp.vec3),
    regions: wp.array3d(dtype=wp.uint8),
    low: wp.vec3d,
    high: wp.vec3d,
    spacing: wp.float64,
    mainstream: wp.vec3d,
    gone: wp.array(dtype=wp.uint8),
):
    """Particles that are now out of the box, or have left the OUTFLOW cells along the mainstream; others keep their
    mark."""
    p = wp.tid()
    a, b = wp.vec3d(before[p]), wp.vec3d(after[p])
    inside = b[0] >= low[0] and b[1] >= low[1] and b[2] >= low[2]
    inside = inside and b[0] < high[0] and b[1] < high[1] and b[2] < high[2]
    if not inside:
        gone[p] = wp.uint8(1)
    elif wp.dot(b - a, mainstream) > real(0.0):
        was, now = in_outflow(regions, (a - low) / spacing), in_outflow(regions, (b - low) / spacing)
        if was and not now:
            gone[p] = wp.uint8(1)


@wp.kernel
def summarize(
    count: int,
    lanes: int,
    positions: wp.array(dtype=wp.vec3),
    velocities: wp.array(dtype=wp.vec3),
    out: wp.array2d(dtype=float),
):
    """Per lane: least and largest position (6 numbers) and the largest squared speed, not a number where one is not."""
    lane = wp.tid()
    low, high = wp.vec3(FAR, FAR, FAR), wp.vec3(-FAR, -FAR, -FAR)
    fastest = wp.float32(0.0)
    p = wp.int32(lane)
    while p < count:
        x, v = positions[p], velocities[p]
        low, high = wp.min(low, x), wp.max(high, x)
        squared = wp.dot(v, v)
        if squared > fastest or squared != squared:
            fastest = squared
        p += lanes
    for a in range(3):
        out[lane, a] = low[a]
        out[lane, 3 + a] = high[a]
    out[lane, 6] = fastest


@wp.kernel
def judge(
    count: int,
    lanes: int,
    moves: wp.array(dtype=wp.vec3),
    gone: wp.array(dtype=wp.uint8),
    out: wp.array2d(dtype=float),
):
    """Per lane: the largest component of the displacements (m), not a number where one is not, and how many leave."""
    lane = wp.tid()
    farthest, leaving, broken = wp.float32(0.0), wp.int32(0), wp.int32(0)
    p = wp.int32(lane)
    while p < count:
        move = wp.abs(moves[p])
        largest = wp.max(move[0], wp.max(move[1], move[2]))
        if not (move[0] <= FAR and move[1] <= FAR and move[2] <= FAR):
            broken += 1
        farthest = wp.max(farthest, largest)
        leaving += int(gone[p])
        p += lanes
    out[lane, 0] = farthest
    out[lane, 1] = float(leaving)
    out[lane, 2] = float(broken)
