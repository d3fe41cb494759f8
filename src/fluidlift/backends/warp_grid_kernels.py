"""Warp kernels on the grid: continuing a velocity, and the multigrid V-cycle for the cell Poisson equation.

Launches are flat. Levels of the multigrid carry a ring of ghost cells, so a neighbour is a fixed step away:
`n - steps[axis]` and `n + steps[axis]`. The method is that of `fluidlift.numerics.multigrid` (McAdams, Sifakis,
Teran 2010; coarse operators scaled by one half, Braess 1995). Imported only by adapters that have found Warp.
"""

# pyright: reportArgumentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportInvalidTypeForm=false, reportOperatorIssue=false
# what is written here is Warp's own language: Python's types of it are no types of the kernels

# Warp reads the annotations of kernels: they must not become strings
import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def unflatten(n: int, shape: wp.vec3i):
    """Index (i, j, k) of the n-th sample, z fastest."""
    return wp.vec3i(n // (shape[1] * shape[2]), (n // shape[2]) % shape[1], n % shape[2])


@wp.kernel
def grow(
    shape: wp.vec3i,
    field: wp.array(dtype=float),
    valid: wp.array(dtype=wp.uint8),
    new_field: wp.array(dtype=float),
    new_valid: wp.array(dtype=wp.uint8),
):
    """One layer: samples without a value take the mean of their neighbours that have one."""
    n = wp.tid()
    at = unflatten(n, shape)
    value, known = float(field[n]), wp.uint8(valid[n])
    if known == wp.uint8(0):
        total, count = wp.float32(0.0), wp.int32(0)
        step = wp.int32(1)
        for axis_ in range(3):
            axis = 2 - axis_
            for side in range(2):
                m = n + (2 * side - 1) * step
                inside = (side == 0 and at[axis] > 0) or (side == 1 and at[axis] < shape[axis] - 1)
                if inside and valid[m] != wp.uint8(0):
                    total += field[m]
                    count += 1
            step *= shape[axis]
        if count > 0:
            value = total / float(count)
            known = wp.uint8(1)
    new_field[n] = value
    new_valid[n] = known


@wp.struct
class Level:
    """The operator on one grid; all arrays padded by one ghost cell and flat."""

    shape: wp.vec3i
    """padded"""
    steps: wp.vec3i
    diagonal: wp.array(dtype=float)
    """0 outside the unknown cells"""
    coupling_x: wp.array(dtype=float)
    """weight / h^2 to the neighbour at n - steps[0]"""
    coupling_y: wp.array(dtype=float)
    coupling_z: wp.array(dtype=float)
    color: wp.array(dtype=wp.uint8)
    """0 outside the unknown cells, else 1 or 2 like a checkerboard"""
    x: wp.array(dtype=float)
    rhs: wp.array(dtype=float)


@wp.kernel
def build_finest(
    level: Level,
    inverse_square: float,
    unknown: wp.array3d(dtype=wp.uint8),
    weight_x: wp.array3d(dtype=float),
    weight_y: wp.array3d(dtype=float),
    weight_z: wp.array3d(dtype=float),
):
    """One thread per cell: diagonal = sum of weights / h^2, couplings only between unknown cells."""
    c = unflatten(wp.tid(), wp.vec3i(unknown.shape[0], unknown.shape[1], unknown.shape[2]))
    i, j, k = c[0], c[1], c[2]
    if unknown[i, j, k] != wp.uint8(0):
        n = (i + 1) * level.steps[0] + (j + 1) * level.steps[1] + k + 1
        total = weight_x[i, j, k] + weight_x[i + 1, j, k] + weight_y[i, j, k] + weight_y[i, j + 1, k]
        level.diagonal[n] = (total + weight_z[i, j, k] + weight_z[i, j, k + 1]) * inverse_square
        if i > 0 and unknown[i - 1, j, k] != wp.uint8(0):
            level.coupling_x[n] = weight_x[i, j, k] * inverse_square
        if j > 0 and unknown[i, j - 1, k] != wp.uint8(0):
            level.coupling_y[n] = weight_y[i, j, k] * inverse_square
        if k > 0 and unknown[i, j, k - 1] != wp.uint8(0):
            level.coupling_z[n] = weight_z[i, j, k] * inverse_square


@wp.kernel
def build_coarser(fine: Level, coarse: Level):
    """One thread per padded coarse cell: half the Galerkin product with piecewise constant transfer."""
    n = wp.tid()
    c = unflatten(n, coarse.shape)
    if wp.min(c) > 0 and c[0] < coarse.shape[0] - 1 and c[1] < coarse.shape[1] - 1 and c[2] < coarse.shape[2] - 1:
        diagonal, x, y, z = wp.float32(0.0), wp.float32(0.0), wp.float32(0.0), wp.float32(0.0)
        for part in range(8):
            i, j, k = 2 * c[0] - 1 + part // 4, 2 * c[1] - 1 + (part // 2) % 2, 2 * c[2] - 1 + part % 2
            if i < fine.shape[0] - 1 and j < fine.shape[1] - 1 and k < fine.shape[2] - 1:
                m = i * fine.steps[0] + j * fine.steps[1] + k
                diagonal += fine.diagonal[m]
                # a coupling across the face of the coarse cell stays one; inside it counts for both of its cells
                if part // 4 == 0:
                    x += fine.coupling_x[m]
                else:
                    diagonal -= 2.0 * fine.coupling_x[m]
                if (part // 2) % 2 == 0:
                    y += fine.coupling_y[m]
                else:
                    diagonal -= 2.0 * fine.coupling_y[m]
                if part % 2 == 0:
                    z += fine.coupling_z[m]
                else:
                    diagonal -= 2.0 * fine.coupling_z[m]
        coarse.diagonal[n] = 0.5 * diagonal
        coarse.coupling_x[n] = 0.5 * x
        coarse.coupling_y[n] = 0.5 * y
        coarse.coupling_z[n] = 0.5 * z


@wp.kernel
def finish_level(level: Level, smallest: float):
    """Colours; a cell whose diagonal is only the rounding of its couplings (all of a closed component) is dropped."""
    n = wp.tid()
    if level.diagonal[n] > 0.0:
        strength = level.coupling_x[n] + level.coupling_x[n + level.steps[0]]
        strength += level.coupling_y[n] + level.coupling_y[n + level.steps[1]]
        strength += level.coupling_z[n] + level.coupling_z[n + 1]
        diagonal = wp.max(level.diagonal[n], strength)
        if diagonal < smallest:
            diagonal = 0.0
        level.diagonal[n] = diagonal
        if diagonal > 0.0:
            c = unflatten(n, level.shape)
            level.color[n] = wp.uint8(1 + (c[0] + c[1] + c[2]) % 2)


@wp.func
def neighbours(level: Level, n: int):
    """Sum of the neighbours' x times their couplings."""
    sx, sy = level.steps[0], level.steps[1]
    total = level.coupling_x[n] * level.x[n - sx] + level.coupling_x[n + sx] * level.x[n + sx]
    total += level.coupling_y[n] * level.x[n - sy] + level.coupling_y[n + sy] * level.x[n + sy]
    return total + level.coupling_z[n] * level.x[n - 1] + level.coupling_z[n + 1] * level.x[n + 1]


@wp.kernel
def smooth(level: Level, color: wp.uint8):
    """Half a sweep of Gauss-Seidel: the cells of one colour."""
    n = wp.tid()
    if level.color[n] == color:
        level.x[n] = (level.rhs[n] + neighbours(level, n)) / level.diagonal[n]


@wp.kernel
def restrict_residual(fine: Level, coarse: Level):
    """Sum of the fine residuals in each coarse cell; the coarse guess becomes 0."""
    n = wp.tid()
    c = unflatten(n, coarse.shape)
    total = wp.float32(0.0)
    if coarse.color[n] != wp.uint8(0):
        for part in range(8):
            i, j, k = 2 * c[0] - 1 + part // 4, 2 * c[1] - 1 + (part // 2) % 2, 2 * c[2] - 1 + part % 2
            if i < fine.shape[0] - 1 and j < fine.shape[1] - 1 and k < fine.shape[2] - 1:
                m = i * fine.steps[0] + j * fine.steps[1] + k
                if fine.color[m] != wp.uint8(0):
                    total += fine.rhs[m] - fine.diagonal[m] * fine.x[m] + neighbours(fine, m)
    coarse.rhs[n] = total
    coarse.x[n] = 0.0


@wp.kernel
def add_coarse(fine: Level, coarse: Level):
    """x += the coarse correction, constant over each coarse cell."""
    n = wp.tid()
    if fine.color[n] != wp.uint8(0):
        c = unflatten(n, fine.shape)
        i, j, k = (c[0] + 1) // 2, (c[1] + 1) // 2, (c[2] + 1) // 2
        fine.x[n] = fine.x[n] + coarse.x[i * coarse.steps[0] + j * coarse.steps[1] + k]


@wp.kernel
def apply_operator(level: Level, p: wp.array(dtype=wp.float64), out: wp.array(dtype=wp.float64)):
    """out = A p in double precision."""
    n = wp.tid()
    total = wp.float64(0.0)
    if level.color[n] != wp.uint8(0):
        sx, sy = level.steps[0], level.steps[1]
        total = wp.float64(level.diagonal[n]) * p[n]
        total -= wp.float64(level.coupling_x[n]) * p[n - sx] + wp.float64(level.coupling_x[n + sx]) * p[n + sx]
        total -= wp.float64(level.coupling_y[n]) * p[n - sy] + wp.float64(level.coupling_y[n + sy]) * p[n + sy]
        total -= wp.float64(level.coupling_z[n]) * p[n - 1] + wp.float64(level.coupling_z[n + 1]) * p[n + 1]
    out[n] = total


@wp.kernel
def load_padded(level: Level, shape: wp.vec3i, values: wp.array(dtype=wp.float64), out: wp.array(dtype=wp.float64)):
    """Copy a cell field to the unknown cells of the padded one."""
    n = wp.tid()
    c = unflatten(n, shape)
    m = (c[0] + 1) * level.steps[0] + (c[1] + 1) * level.steps[1] + c[2] + 1
    if level.color[m] != wp.uint8(0):
        out[m] = values[n]


@wp.kernel
def step_from(scale: wp.float64, change: wp.array(dtype=wp.float64), base: wp.array(dtype=wp.float64)):
    """base += scale change."""
    n = wp.tid()
    base[n] = base[n] + scale * change[n]


@wp.kernel
def turn(z: wp.array(dtype=wp.float64), keep: wp.float64, direction: wp.array(dtype=wp.float64)):
    """direction = z + keep direction."""
    n = wp.tid()
    direction[n] = z[n] + keep * direction[n]


@wp.kernel
def to_cycle(level: Level, scale: wp.float64, residual: wp.array(dtype=wp.float64)):
    """The right side of the V-cycle, scaled near one for single precision; the guess becomes 0."""
    n = wp.tid()
    level.rhs[n] = float(scale * residual[n])
    level.x[n] = 0.0


@wp.kernel
def from_cycle(level: Level, z: wp.array(dtype=wp.float64)):
    """The result of the V-cycle in double precision."""
    n = wp.tid()
    z[n] = wp.float64(level.x[n])
