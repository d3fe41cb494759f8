"""Warp kernels of the particle-grid transfers (formulas: `fluidlift.physics.transfer`).

Launches are flat: one thread per particle or per face. Coordinates are in cells, such that sample i of a component
lies at coordinate i. Imported only by adapters that have found Warp.
"""

# pyright: reportArgumentType=false, reportCallIssue=false, reportIndexIssue=false, reportInvalidTypeForm=false
# pyright: reportOperatorIssue=false
# what is written here is Warp's own language: Python's types of it are no types of the kernels

# Warp reads the annotations of kernels: they must not become strings
import warp as wp

wp.set_module_options({"enable_backward": False})  # no gradients: halves the compile time


@wp.func
def spline(r: float):
    """The quadratic B-spline of a distance in cells."""
    d = wp.abs(r)
    if d < 0.5:
        return 0.75 - d * d
    if d < 1.5:
        return 0.5 * (1.5 - d) * (1.5 - d)
    return 0.0


@wp.func
def spline_weights(x: float):
    """Weights of the three samples from floor(x - 1/2) on."""
    r = x - wp.floor(x - 0.5)
    return wp.vec3(0.5 * (1.5 - r) * (1.5 - r), 0.75 - (r - 1.0) * (r - 1.0), 0.5 * (r - 0.5) * (r - 0.5))


@wp.func
def half_shift(axis: int):
    """Cells from the low corner of the box to the first sample of a component."""
    shift = wp.vec3(0.5, 0.5, 0.5)
    shift[axis] = 0.0
    return shift


@wp.func
def scatter_component(
    mass: wp.array3d(dtype=float), momentum: wp.array3d(dtype=float), x: wp.vec3, m: float, v: float, c: wp.vec3
):
    base = wp.vec3i(int(wp.floor(x[0] - 0.5)), int(wp.floor(x[1] - 0.5)), int(wp.floor(x[2] - 0.5)))
    wx, wy, wz = spline_weights(x[0]), spline_weights(x[1]), spline_weights(x[2])
    for a in range(3):
        for b in range(3):
            for k_ in range(3):
                i, j, k = base[0] + a, base[1] + b, base[2] + k_
                if i >= 0 and j >= 0 and k >= 0 and i < mass.shape[0] and j < mass.shape[1] and k < mass.shape[2]:
                    weight = wx[a] * wy[b] * wz[k_] * m
                    offset = wp.vec3(float(i), float(j), float(k)) - x
                    wp.atomic_add(mass, i, j, k, weight)
                    wp.atomic_add(momentum, i, j, k, weight * (v + wp.dot(c, offset)))


@wp.kernel
def scatter_particles(
    positions: wp.array(dtype=wp.vec3),
    velocities: wp.array(dtype=wp.vec3),
    affine: wp.array(dtype=wp.mat33),
    masses: wp.array(dtype=float),
    low: wp.vec3,
    spacing: float,
    mass_u: wp.array3d(dtype=float),
    mass_v: wp.array3d(dtype=float),
    mass_w: wp.array3d(dtype=float),
    momentum_u: wp.array3d(dtype=float),
    momentum_v: wp.array3d(dtype=float),
    momentum_w: wp.array3d(dtype=float),
):
    """One thread per particle; the order of the sums is that of the threads' arrival."""
    p = wp.tid()
    x = (positions[p] - low) * (1.0 / spacing)
    v, c, m = velocities[p], affine[p] * spacing, masses[p]
    scatter_component(mass_u, momentum_u, x - half_shift(0), m, v[0], c[0])
    scatter_component(mass_v, momentum_v, x - half_shift(1), m, v[1], c[1])
    scatter_component(mass_w, momentum_w, x - half_shift(2), m, v[2], c[2])


@wp.func
def cell_number(position: wp.vec3, low: wp.vec3, spacing: float, shape: wp.vec3i):
    """Number of the cell (x slowest) that holds a position, the nearest one outside the box."""
    x = (position - low) * (1.0 / spacing)
    i = wp.clamp(int(wp.floor(x[0])), 0, shape[0] - 1)
    j = wp.clamp(int(wp.floor(x[1])), 0, shape[1] - 1)
    k = wp.clamp(int(wp.floor(x[2])), 0, shape[2] - 1)
    return (i * shape[1] + j) * shape[2] + k


@wp.kernel
def number_cells(
    positions: wp.array(dtype=wp.vec3),
    low: wp.vec3,
    spacing: float,
    shape: wp.vec3i,
    cells: wp.array(dtype=int),
    order: wp.array(dtype=int),
    counts: wp.array(dtype=int),
):
    """Cell of each particle, the particles' own order, and how many particles each cell holds."""
    p = wp.tid()
    cell = cell_number(positions[p], low, spacing, shape)
    cells[p] = cell
    order[p] = p
    wp.atomic_add(counts, cell, 1)


@wp.kernel
def sum_over_particles(
    axis: int,
    positions: wp.array(dtype=wp.vec3),
    velocities: wp.array(dtype=wp.vec3),
    affine: wp.array(dtype=wp.mat33),
    masses: wp.array(dtype=float),
    order: wp.array(dtype=int),
    ends: wp.array(dtype=int),
    low: wp.vec3,
    spacing: float,
    shape: wp.vec3i,
    mass: wp.array3d(dtype=float),
    momentum: wp.array3d(dtype=float),
):
    """One thread per face: it visits the particles of the cells around it in their order, so nothing is left to
    chance. Cell c holds the particles order[ends[c-1]] to order[ends[c]-1]."""
    face = wp.tid()
    k = face % mass.shape[2]
    j = (face // mass.shape[2]) % mass.shape[1]
    i = face // (mass.shape[2] * mass.shape[1])
    first, last = wp.vec3i(i - 1, j - 1, k - 1), wp.vec3i(i + 1, j + 1, k + 1)
    first[axis] = first[axis] - 1  # faces across the axis lie between two cells: four cells along it are in reach
    shift = half_shift(axis)
    total, sum_m = wp.float32(0.0), wp.float32(0.0)
    for ci in range(wp.max(first[0], 0), wp.min(last[0], shape[0] - 1) + 1):
        for cj in range(wp.max(first[1], 0), wp.min(last[1], shape[1] - 1) + 1):
            row = (ci * shape[1] + cj) * shape[2]
            start = row + wp.max(first[2], 0)
            end = row + wp.min(last[2], shape[2] - 1)
            n = wp.int32(0)
            if start > 0:
                n = ends[start - 1]
            while n < ends[end]:
                p = order[n]
                x = (positions[p] - low) * (1.0 / spacing) - shift
                offset = wp.vec3(float(i), float(j), float(k)) - x
                weight = spline(offset[0]) * spline(offset[1]) * spline(offset[2])
                if weight > 0.0:
                    weight *= masses[p]
                    sum_m += weight
                    total += weight * (velocities[p][axis] + wp.dot(affine[p][axis], offset) * spacing)
                n += 1
    mass[i, j, k] = sum_m
    momentum[i, j, k] = total


@wp.kernel
def divide(mass: wp.array(dtype=float), momentum: wp.array(dtype=float)):
    """Momentum becomes velocity, 0 where there is no mass."""
    n = wp.tid()
    if mass[n] > 1.0e-30:
        momentum[n] = momentum[n] / mass[n]
    else:
        momentum[n] = 0.0


@wp.func
def gather_component(field: wp.array3d(dtype=float), x: wp.vec3):
    """Velocity and its three moments (per cell): sum of w f and of w f (x_i - x_p)."""
    base = wp.vec3i(int(wp.floor(x[0] - 0.5)), int(wp.floor(x[1] - 0.5)), int(wp.floor(x[2] - 0.5)))
    wx, wy, wz = spline_weights(x[0]), spline_weights(x[1]), spline_weights(x[2])
    total = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for a in range(3):
        for b in range(3):
            for c in range(3):
                i = wp.clamp(base[0] + a, 0, field.shape[0] - 1)
                j = wp.clamp(base[1] + b, 0, field.shape[1] - 1)
                k = wp.clamp(base[2] + c, 0, field.shape[2] - 1)
                value = wx[a] * wy[b] * wz[c] * field[i, j, k]
                total += value * wp.vec4(
                    1.0, float(base[0] + a) - x[0], float(base[1] + b) - x[1], float(base[2] + c) - x[2]
                )
    return total


@wp.kernel
def gather_particles(
    positions: wp.array(dtype=wp.vec3),
    low: wp.vec3,
    spacing: float,
    u: wp.array3d(dtype=float),
    v: wp.array3d(dtype=float),
    w: wp.array3d(dtype=float),
    velocities: wp.array(dtype=wp.vec3),
    affine: wp.array(dtype=wp.mat33),
):
    """One thread per particle."""
    p = wp.tid()
    x = (positions[p] - low) * (1.0 / spacing)
    a = gather_component(u, x - half_shift(0))
    b = gather_component(v, x - half_shift(1))
    c = gather_component(w, x - half_shift(2))
    velocities[p] = wp.vec3(a[0], b[0], c[0])
    affine[p] = (4.0 / spacing) * wp.mat33(a[1], a[2], a[3], b[1], b[2], b[3], c[1], c[2], c[3])
