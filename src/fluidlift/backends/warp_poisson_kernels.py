"""Warp kernels of the pressure solver: operator, V-cycle and conjugate gradients (twin: `numerics.multigrid_plain`).

All levels lie one after the other in flat arrays; a level is (nx, ny, nz, index of its first element) and has a ring
of ghost cells whose couplings are 0, so that no neighbour needs a check. Couplings join a cell with its neighbour on
the low side. Cell (1, 1, 1) is black. Kernels of the iteration return at once when `DONE` is set, so that a graph may
be replayed past the end. Kernels that add up run in blocks of `threads` threads (1 on the CPU) that go through
`CHUNK` elements each: the order of the sums does not depend on how blocks arrive.
"""

# pyright: reportArgumentType=false, reportCallIssue=false, reportIndexIssue=false, reportInvalidTypeForm=false
# pyright: reportOperatorIssue=false, reportReturnType=false, reportAttributeAccessIssue=false
# pyright: reportGeneralTypeIssues=false, reportAssignmentType=false
# what is written here is Warp's own language: Python's types of it are no types of the kernels

# Warp reads the annotations of kernels: they must not become strings
import warp as wp

wp.set_module_options({"enable_backward": False})  # no gradients: halves the compile time

CHUNK = wp.constant(1024)
"""elements per block of a sum: as many as four per thread"""

DONE = wp.constant(0)
"""1: the recurrence has reached the goal or cannot go on"""
ITERATIONS = wp.constant(1)
B2 = wp.constant(2)
"""|b|^2 without what no p can answer"""
R2 = wp.constant(3)
REMOVED2 = wp.constant(4)
CLOSED = wp.constant(5)
"""closed components"""
GOAL2 = wp.constant(6)
SCALE = wp.constant(7)
"""brings the residual near one before it becomes single precision"""
RZ = wp.constant(8)
ALPHA = wp.constant(9)
BETA = wp.constant(10)
FRESH = wp.constant(11)
"""1: the next direction takes nothing from the one before"""
UNGROUNDED = wp.constant(12)
"""runs of cells that have no air beside them"""
LIMIT = wp.constant(13)
"""iterations at most"""
SCALARS = 14

AIR_SHARE = wp.constant(wp.float64(0.8))
"""see `numerics.multigrid_assembly`, as for the next"""
AIR_LIMIT = wp.constant(wp.float64(3.0))


@wp.struct
class Operator:
    """Flat arrays of all levels."""

    x: wp.array(dtype=float)
    rhs: wp.array(dtype=float)
    inverse: wp.array(dtype=float)
    """1 / diagonal, 0 where there is no equation"""
    cx: wp.array(dtype=float)
    cy: wp.array(dtype=float)
    cz: wp.array(dtype=float)
    air: wp.array(dtype=wp.float64)
    """what the diagonal holds beyond the couplings"""


@wp.struct
class Krylov:
    """Arrays of the finest level, and the numbers that steer the iteration."""

    p: wp.array(dtype=wp.float64)
    b: wp.array(dtype=wp.float64)
    r: wp.array(dtype=wp.float64)
    q: wp.array(dtype=wp.float64)
    scalars: wp.array(dtype=wp.float64)
    partials: wp.array(dtype=wp.float64)
    """[3 blocks]"""
    going: wp.array(dtype=int)
    """[1], 0 when `DONE` is set: the condition of graphs that loop"""
    blocks: int


@wp.func_native("""
#if defined(__CUDA_ARCH__)
__syncthreads();
#endif
""")
def wait_for_block(): ...


@wp.func
def place(level: wp.vec4i, i: int, j: int, k: int):
    """Element of a cell, counted from the ring of ghost cells."""
    return level[3] + (i * (level[1] + 2) + j) * (level[2] + 2) + k


@wp.func
def cell_count(level: wp.vec4i):
    return level[0] * level[1] * level[2]


@wp.func
def pair_count(level: wp.vec4i):
    return level[0] * level[1] * ((level[2] + 1) // 2)


@wp.func
def element(level: wp.vec4i, n: int):
    """Element of the n-th inner cell."""
    k = n % level[2]
    row = n // level[2]
    return place(level, row // level[1] + 1, row % level[1] + 1, k + 1)


@wp.func
def is_red(level: wp.vec4i, n: int):
    row = n // level[2]
    return ((row // level[1] + row % level[1] + n % level[2]) & 1) == 1


@wp.func
def neighbour_sum(op: Operator, level: wp.vec4i, o: int):
    """Sum of coupling times x over the neighbours."""
    row = level[2] + 2
    plane = row * (level[1] + 2)
    return (
        op.cx[o] * op.x[o - plane]
        + op.cx[o + plane] * op.x[o + plane]
        + op.cy[o] * op.x[o - row]
        + op.cy[o + row] * op.x[o + row]
        + op.cz[o] * op.x[o - 1]
        + op.cz[o + 1] * op.x[o + 1]
    )


@wp.func
def cell_of_pair(level: wp.vec4i, n: int, color: int):
    """The cell of `color` (i, j, k from the ring) of the n-th pair along z; k may lie beyond the last."""
    half = (level[2] + 1) // 2
    row = n // half
    i = row // level[1]
    j = row % level[1]
    return wp.vec3i(i + 1, j + 1, 2 * (n % half) + ((i + j + color + 1) & 1) + 1)


@wp.func
def relax_pair(op: Operator, level: wp.vec4i, n: int, color: int):
    """Gauss-Seidel at the cell of one colour of a pair."""
    c = cell_of_pair(level, n, color)
    if c[2] <= level[2]:
        o = place(level, c[0], c[1], c[2])
        inverse = op.inverse[o]
        if inverse > 0.0:
            op.x[o] = (op.rhs[o] + neighbour_sum(op, level, o)) * inverse


@wp.func
def corrected(op: Operator, fine: wp.vec4i, coarse: wp.vec4i, i: int, j: int, k: int):
    """x of a fine cell with the correction of the coarse cell around it."""
    return op.x[place(fine, i, j, k)] + op.x[place(coarse, (i + 1) // 2, (j + 1) // 2, (k + 1) // 2)]


@wp.func
def corrected_sum(op: Operator, fine: wp.vec4i, coarse: wp.vec4i, c: wp.vec3i):
    """Sum of coupling times corrected x over the neighbours of a fine cell (counted from the ring)."""
    i, j, k = c[0], c[1], c[2]
    o = place(fine, i, j, k)
    row = fine[2] + 2
    plane = row * (fine[1] + 2)
    return (
        op.cx[o] * corrected(op, fine, coarse, i - 1, j, k)
        + op.cx[o + plane] * corrected(op, fine, coarse, i + 1, j, k)
        + op.cy[o] * corrected(op, fine, coarse, i, j - 1, k)
        + op.cy[o + row] * corrected(op, fine, coarse, i, j + 1, k)
        + op.cz[o] * corrected(op, fine, coarse, i, j, k - 1)
        + op.cz[o + 1] * corrected(op, fine, coarse, i, j, k + 1)
    )


@wp.func
def prolong_pair(op: Operator, fine: wp.vec4i, coarse: wp.vec4i, n: int):
    """Gauss-Seidel at the black cell of a pair, whose neighbours are corrected; they are relaxed anew themselves."""
    c = cell_of_pair(fine, n, 1)
    if c[2] <= fine[2]:
        o = place(fine, c[0], c[1], c[2])
        inverse = op.inverse[o]
        if inverse > 0.0:
            op.x[o] = (op.rhs[o] + corrected_sum(op, fine, coarse, c)) * inverse


@wp.func
def restrict_cell(op: Operator, fine: wp.vec4i, coarse: wp.vec4i, n: int):
    """rhs of a coarse cell: the residuals of its red fine cells (black ones, relaxed last, have none).

    x becomes the first half sweep from 0.
    """
    o = element(coarse, n)
    row = n // coarse[2]
    i = row // coarse[1] + 1
    j = row % coarse[1] + 1
    k = n % coarse[2] + 1
    total = float(0.0)
    for a in range(2):
        for b in range(2):
            fi = 2 * i - 1 + a
            fj = 2 * j - 1 + b
            fk = 2 * k - ((fi + fj) & 1)
            if fi <= fine[0] and fj <= fine[1] and fk <= fine[2]:
                f = place(fine, fi, fj, fk)
                inverse = op.inverse[f]
                if inverse > 0.0:
                    total += op.rhs[f] - op.x[f] / inverse + neighbour_sum(op, fine, f)
    op.rhs[o] = total
    op.x[o] = wp.where(is_red(coarse, n), total * op.inverse[o], 0.0)


@wp.kernel
def relax(op: Operator, level: wp.vec4i, color: int, scalars: wp.array(dtype=wp.float64)):
    """One half sweep."""
    n = wp.tid()
    if scalars[DONE] == wp.float64(0.0):
        relax_pair(op, level, n, color)


@wp.kernel
def prolong(op: Operator, fine: wp.vec4i, coarse: wp.vec4i, scalars: wp.array(dtype=wp.float64)):
    """The coarse correction and the black half sweep after it."""
    n = wp.tid()
    if scalars[DONE] == wp.float64(0.0):
        prolong_pair(op, fine, coarse, n)


@wp.kernel
def restrict(op: Operator, fine: wp.vec4i, coarse: wp.vec4i, scalars: wp.array(dtype=wp.float64)):
    """The residual on the coarse level, and the red half sweep from 0 there."""
    n = wp.tid()
    if scalars[DONE] == wp.float64(0.0):
        restrict_cell(op, fine, coarse, n)


@wp.func
def block_sum(value: wp.float64, out: wp.array(dtype=wp.float64), at: int):
    """The sum over the threads of a block becomes out[at]."""
    wp.tile_store(out, wp.tile_sum(wp.tile(value)), offset=at)


@wp.kernel
def relax_dot(op: Operator, level: wp.vec4i, krylov: Krylov, threads: int):
    """The last half sweep (red) of the V-cycle, and x . rhs."""
    block, t = wp.tid()
    if krylov.scalars[DONE] != wp.float64(0.0):
        return
    total = wp.float64(0.0)
    n = block * CHUNK + t
    end = wp.min((block + 1) * CHUNK, pair_count(level))
    while n < end:
        relax_pair(op, level, n, 0)
        for color in range(2):
            c = cell_of_pair(level, n, color)
            if c[2] <= level[2]:
                o = place(level, c[0], c[1], c[2])
                total += wp.float64(op.x[o]) * wp.float64(op.rhs[o])
        n += threads
    block_sum(total, krylov.partials, block)


@wp.kernel
def turn(
    op: Operator,
    level: wp.vec4i,
    krylov: Krylov,
    before: wp.array(dtype=float),
    direction: wp.array(dtype=float),
    threads: int,
):
    """direction = x + beta before, q = A direction, and direction . q."""
    block, t = wp.tid()
    if krylov.scalars[DONE] != wp.float64(0.0):
        return
    beta = float(krylov.scalars[BETA])
    row = level[2] + 2
    plane = row * (level[1] + 2)
    total = wp.float64(0.0)
    n = block * CHUNK + t
    end = wp.min((block + 1) * CHUNK, cell_count(level))
    while n < end:
        o = element(level, n)
        if op.inverse[o] > 0.0:
            own = op.x[o] + beta * before[o]
            here = wp.float64(own)
            value = op.air[o] * here
            value += wp.float64(op.cx[o]) * (here - wp.float64(op.x[o - plane] + beta * before[o - plane]))
            value += wp.float64(op.cx[o + plane]) * (here - wp.float64(op.x[o + plane] + beta * before[o + plane]))
            value += wp.float64(op.cy[o]) * (here - wp.float64(op.x[o - row] + beta * before[o - row]))
            value += wp.float64(op.cy[o + row]) * (here - wp.float64(op.x[o + row] + beta * before[o + row]))
            value += wp.float64(op.cz[o]) * (here - wp.float64(op.x[o - 1] + beta * before[o - 1]))
            value += wp.float64(op.cz[o + 1]) * (here - wp.float64(op.x[o + 1] + beta * before[o + 1]))
            direction[o] = own
            krylov.q[o] = value
            total += here * value
        n += threads
    block_sum(total, krylov.partials, block)


@wp.kernel
def descend(op: Operator, level: wp.vec4i, krylov: Krylov, direction: wp.array(dtype=float), threads: int):
    """One step of p and r along the direction; the right side of the next V-cycle with its first half sweep; |r|^2."""
    block, t = wp.tid()
    if krylov.scalars[DONE] != wp.float64(0.0):
        return
    alpha, scale = krylov.scalars[ALPHA], krylov.scalars[SCALE]
    total = wp.float64(0.0)
    n = block * CHUNK + t
    end = wp.min((block + 1) * CHUNK, cell_count(level))
    while n < end:
        o = element(level, n)
        inverse = op.inverse[o]
        if inverse > 0.0:
            krylov.p[o] += alpha * wp.float64(direction[o])
            r = krylov.r[o] - alpha * krylov.q[o]
            krylov.r[o] = r
            rhs = float(scale * r)
            op.rhs[o] = rhs
            op.x[o] = wp.where(is_red(level, n), rhs * inverse, 0.0)
            total += r * r
        n += threads
    block_sum(total, krylov.partials, block)


@wp.func
def sum_partials(partials: wp.array(dtype=wp.float64), first: int, count: int, t: int, threads: int):
    """Sum of `count` partial sums, known to all threads of the block."""
    total = wp.float64(0.0)
    n = int(t)
    while n < count:
        total += partials[first + n]
        n += threads
    return wp.tile_extract(wp.tile_sum(wp.tile(total)), 0)


@wp.func
def stop(krylov: Krylov):
    krylov.scalars[DONE] = wp.float64(1.0)
    krylov.going[0] = 0


@wp.kernel
def choose_beta(krylov: Krylov, blocks: int, threads: int):
    """After `relax_dot`, which ran in `blocks` blocks."""
    _, t = wp.tid()
    s = krylov.scalars
    if s[DONE] != wp.float64(0.0):
        return
    rz = sum_partials(krylov.partials, 0, blocks, t, threads)
    if t == 0:
        if rz > wp.float64(0.0):
            s[BETA] = wp.where(s[FRESH] != wp.float64(0.0), wp.float64(0.0), rz / s[RZ])
            s[RZ] = rz
            s[FRESH] = wp.float64(0.0)
        else:
            stop(krylov)


@wp.kernel
def choose_alpha(krylov: Krylov, threads: int):
    """After `turn`."""
    _, t = wp.tid()
    s = krylov.scalars
    if s[DONE] != wp.float64(0.0):
        return
    curvature = sum_partials(krylov.partials, 0, krylov.blocks, t, threads)
    if t == 0:
        if curvature > wp.float64(0.0):
            s[ALPHA] = s[RZ] / (s[SCALE] * curvature)
        else:
            stop(krylov)


@wp.kernel
def judge(krylov: Krylov, threads: int):
    """After `descend`: whether the goal is reached."""
    _, t = wp.tid()
    s = krylov.scalars
    if s[DONE] != wp.float64(0.0):
        return
    squared = sum_partials(krylov.partials, 0, krylov.blocks, t, threads)
    if t == 0:
        s[R2] = squared
        s[ITERATIONS] += wp.float64(1.0)
        if not (squared > s[GOAL2] and s[ITERATIONS] < s[LIMIT]):
            stop(krylov)
