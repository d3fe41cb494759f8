"""Warp kernels that set the pressure solver up and end it: levels, closed components, residuals (memory and twins:
`warp_poisson_kernels`, `numerics.multigrid_assembly`, `numerics.components`).

Closed components: cells above each other that are joined by open faces are runs, each known by its first cell. A run
beside air is grounded. Only the others are joined with the runs beside them (union-find with atomics, after Playne and
Hawick 2018, "A new algorithm for parallel connected-component labelling on GPUs"); where a component of theirs touches
a grounded run it is no closed one.
"""

# pyright: reportArgumentType=false, reportCallIssue=false, reportIndexIssue=false, reportInvalidTypeForm=false
# pyright: reportOperatorIssue=false, reportReturnType=false, reportAttributeAccessIssue=false
# pyright: reportGeneralTypeIssues=false, reportAssignmentType=false
# what is written here is Warp's own language: Python's types of it are no types of the kernels

# Warp reads the annotations of kernels: they must not become strings
import warp as wp

from fluidlift.backends.warp_poisson_kernels import (
    AIR_LIMIT,
    AIR_SHARE,
    ALPHA,
    B2,
    CHUNK,
    CLOSED,
    DONE,
    FRESH,
    GOAL2,
    ITERATIONS,
    LIMIT,
    R2,
    REMOVED2,
    SCALE,
    UNGROUNDED,
    Krylov,
    Operator,
    block_sum,
    cell_count,
    element,
    place,
    stop,
    sum_partials,
    wait_for_block,
)

wp.set_module_options({"enable_backward": False})  # no gradients: halves the compile time


@wp.struct
class Components:
    """Arrays of the finest level; all but `label` hold at the first cell of a run."""

    label: wp.array(dtype=int)
    """first cell of the run of each cell"""
    parent: wp.array(dtype=int)
    grounded: wp.array(dtype=int)
    touched: wp.array(dtype=int)
    """1: an ungrounded run beside a grounded one; at the root: its component has one"""
    size: wp.array(dtype=int)
    """cells, at the root"""
    sum_b: wp.array(dtype=wp.float64)
    sum_p: wp.array(dtype=wp.float64)


@wp.func
def holds(unknown: wp.array3d(dtype=wp.uint8), i: int, j: int, k: int):
    """Whether a cell is inside the box and unknown."""
    if i < 0 or j < 0 or k < 0 or i >= unknown.shape[0] or j >= unknown.shape[1] or k >= unknown.shape[2]:
        return False
    return unknown[i, j, k] != wp.uint8(0)


@wp.kernel
def assemble_finest(
    unknown: wp.array3d(dtype=wp.uint8),
    wx: wp.array3d(dtype=float),
    wy: wp.array3d(dtype=float),
    wz: wp.array3d(dtype=float),
    rhs: wp.array3d(dtype=float),
    initial: wp.array3d(dtype=float),
    squared_spacing: wp.float64,
    op: Operator,
    level: wp.vec4i,
    krylov: Krylov,
    directions: wp.array2d(dtype=float),
):
    """Couplings between unknown cells, weights towards known ones, right side and first guess (empty: 0)."""
    n = wp.tid()
    o = element(level, n)
    k = n % level[2]
    j = (n // level[2]) % level[1]
    i = n // (level[2] * level[1])
    low, high = wp.vec3(), wp.vec3()
    air = wp.float64(0.0)
    if unknown[i, j, k] != wp.uint8(0):
        low_faces = wp.vec3(wx[i, j, k], wy[i, j, k], wz[i, j, k])
        high_faces = wp.vec3(wx[i + 1, j, k], wy[i, j + 1, k], wz[i, j, k + 1])
        for axis in range(3):
            step = wp.vec3i()
            step[axis] = 1
            if holds(unknown, i - step[0], j - step[1], k - step[2]):
                low[axis] = low_faces[axis]
            else:
                air += wp.float64(low_faces[axis])
            if holds(unknown, i + step[0], j + step[1], k + step[2]):
                high[axis] = high_faces[axis]
            else:
                air += wp.float64(high_faces[axis])
    total = float(air) + low[0] + low[1] + low[2] + high[0] + high[1] + high[2]
    op.cx[o] = low[0]
    op.cy[o] = low[1]
    op.cz[o] = low[2]
    op.air[o] = air
    op.inverse[o] = wp.where(total > 0.0, 1.0 / total, 0.0)
    op.x[o] = 0.0
    op.rhs[o] = 0.0
    directions[0, o] = 0.0
    directions[1, o] = 0.0
    b, p = wp.float64(0.0), wp.float64(0.0)
    if total > 0.0:
        b = squared_spacing * wp.float64(rhs[i, j, k])
        if initial.shape[0] > 0:
            p = wp.float64(initial[i, j, k])
    krylov.b[o] = b
    krylov.p[o] = p
    krylov.q[o] = wp.float64(0.0)
    krylov.r[o] = wp.float64(0.0)


@wp.func
def couplings_x(op: Operator, fine: wp.vec4i, i: int, j: int, k: int):
    """Sum of the fine couplings across the low x side of a coarse cell."""
    total = float(0.0)
    if 2 * i - 1 <= fine[0]:
        for b in range(2):
            for c in range(2):
                total += op.cx[place(fine, 2 * i - 1, 2 * j - 1 + b, 2 * k - 1 + c)]
    return total


@wp.func
def couplings_y(op: Operator, fine: wp.vec4i, i: int, j: int, k: int):
    total = float(0.0)
    if 2 * j - 1 <= fine[1]:
        for a in range(2):
            for c in range(2):
                total += op.cy[place(fine, 2 * i - 1 + a, 2 * j - 1, 2 * k - 1 + c)]
    return total


@wp.func
def couplings_z(op: Operator, fine: wp.vec4i, i: int, j: int, k: int):
    total = float(0.0)
    if 2 * k - 1 <= fine[2]:
        for a in range(2):
            for b in range(2):
                total += op.cz[place(fine, 2 * i - 1 + a, 2 * j - 1 + b, 2 * k - 1)]
    return total


@wp.func
def limited_air(op: Operator, fine: wp.vec4i, o: int):
    """What a fine cell adds to the air of its coarse cell."""
    air = op.air[o]
    if air > wp.float64(0.0):
        row = fine[2] + 2
        plane = row * (fine[1] + 2)
        largest = wp.max(wp.max(op.cx[o], op.cx[o + plane]), wp.max(op.cy[o], op.cy[o + row]))
        largest = wp.max(largest, wp.max(op.cz[o], op.cz[o + 1]))
        if largest > 0.0:
            air = wp.min(air, AIR_LIMIT * wp.float64(largest))
    return air


@wp.func
def assemble_cell(op: Operator, fine: wp.vec4i, coarse: wp.vec4i, n: int):
    """A cell of a coarser level."""
    i = n // (coarse[2] * coarse[1]) + 1
    j = (n // coarse[2]) % coarse[1] + 1
    k = n % coarse[2] + 1
    o = place(coarse, i, j, k)
    air = wp.float64(0.0)
    for a in range(2):
        for b in range(2):
            for c in range(2):
                if 2 * i - a <= fine[0] and 2 * j - b <= fine[1] and 2 * k - c <= fine[2]:
                    air += limited_air(op, fine, place(fine, 2 * i - a, 2 * j - b, 2 * k - c))
    air *= AIR_SHARE
    op.cx[o] = 0.5 * couplings_x(op, fine, i, j, k)
    op.cy[o] = 0.5 * couplings_y(op, fine, i, j, k)
    op.cz[o] = 0.5 * couplings_z(op, fine, i, j, k)
    op.air[o] = air
    far = couplings_x(op, fine, i + 1, j, k) + couplings_y(op, fine, i, j + 1, k) + couplings_z(op, fine, i, j, k + 1)
    total = float(air) + op.cx[o] + op.cy[o] + op.cz[o] + 0.5 * far
    op.inverse[o] = wp.where(total > 0.0, 1.0 / total, 0.0)
    op.x[o] = 0.0
    op.rhs[o] = 0.0


@wp.kernel
def assemble_coarse(op: Operator, fine: wp.vec4i, coarse: wp.vec4i):
    """A coarser level."""
    assemble_cell(op, fine, coarse, wp.tid())


@wp.kernel
def assemble_small(op: Operator, levels: wp.array(dtype=wp.vec4i), first: int, threads: int):
    """The levels after `first`, in one block."""
    _, t = wp.tid()
    for l in range(first, levels.shape[0] - 1):
        n = int(t)
        while n < cell_count(levels[l + 1]):
            assemble_cell(op, levels[l], levels[l + 1], n)
            n += threads
        wait_for_block()


@wp.func
def end_run(components: Components, head: int, ground: int, scalars: wp.array(dtype=wp.float64)):
    components.grounded[head] = ground
    if ground == 0:
        wp.atomic_add(scalars, UNGROUNDED, wp.float64(1.0))


@wp.kernel
def find_runs(op: Operator, level: wp.vec4i, components: Components, scalars: wp.array(dtype=wp.float64)):
    """The runs of a column of cells (thread), and which are grounded."""
    i, j = wp.tid()
    head = int(-1)
    ground = int(0)
    for k in range(level[2]):
        o = place(level, i + 1, j + 1, k + 1)
        if op.inverse[o] > 0.0:
            if head < 0 or op.cz[o] == 0.0:
                if head >= 0:
                    end_run(components, head, ground, scalars)
                head = o
                ground = 0
                components.parent[o] = o
                components.touched[o] = 0
                components.size[o] = 0
                components.sum_b[o] = wp.float64(0.0)
                components.sum_p[o] = wp.float64(0.0)
            components.label[o] = head
            if op.air[o] > wp.float64(0.0):
                ground = 1
        elif head >= 0:
            end_run(components, head, ground, scalars)
            head = -1
    if head >= 0:
        end_run(components, head, ground, scalars)


@wp.func
def root_of(parent: wp.array(dtype=int), o: int):
    r = int(o)
    while parent[r] != r:
        r = parent[r]
    return r


@wp.func
def join(components: Components, own: int, coupling: float, other: int):
    """Join an ungrounded run with the one of a cell beside it, or note that this is grounded."""
    if coupling > 0.0:
        head = components.label[other]
        if components.grounded[head] != 0:
            components.touched[own] = 1
            return
        a = int(own)
        b = int(head)
        busy = int(1)
        while busy == 1:
            a = root_of(components.parent, a)
            b = root_of(components.parent, b)
            if a == b:
                busy = 0
            else:
                low = wp.min(a, b)
                high = wp.max(a, b)
                old = wp.atomic_min(components.parent, high, low)
                if old == high:
                    busy = 0
                else:
                    a, b = low, old


@wp.kernel
def join_runs(op: Operator, level: wp.vec4i, components: Components, scalars: wp.array(dtype=wp.float64)):
    """Components of ungrounded runs; one thread per cell."""
    n = wp.tid()
    if scalars[UNGROUNDED] == wp.float64(0.0):
        return
    o = element(level, n)
    if op.inverse[o] > 0.0:
        own = components.label[o]
        if components.grounded[own] == 0:
            row = level[2] + 2
            plane = row * (level[1] + 2)
            join(components, own, op.cx[o], o - plane)
            join(components, own, op.cx[o + plane], o + plane)
            join(components, own, op.cy[o], o - row)
            join(components, own, op.cy[o + row], o + row)


@wp.kernel
def ground_components(op: Operator, level: wp.vec4i, components: Components, scalars: wp.array(dtype=wp.float64)):
    """Roots learn that a run of theirs is beside a grounded one."""
    n = wp.tid()
    if scalars[UNGROUNDED] == wp.float64(0.0):
        return
    o = element(level, n)
    if op.inverse[o] == 0.0 or components.label[o] != o or components.grounded[o] != 0:
        return
    if components.touched[o] != 0:
        components.touched[root_of(components.parent, o)] = 1


@wp.func
def closed_root(components: Components, o: int):
    """Root of the closed component of a cell that has an equation, -1 where there is none."""
    head = components.label[o]
    if components.grounded[head] != 0:
        return -1
    root = root_of(components.parent, head)
    return wp.where(components.touched[root] != 0, -1, root)


@wp.kernel
def sum_closed(
    op: Operator,
    level: wp.vec4i,
    components: Components,
    values: wp.array(dtype=wp.float64),
    sums: wp.array(dtype=wp.float64),
    sizes: wp.array(dtype=int),
    scalars: wp.array(dtype=wp.float64),
):
    """Sums of values over closed components; their sizes and their number where `sizes` is not empty."""
    n = wp.tid()
    if scalars[UNGROUNDED] == wp.float64(0.0):
        return
    o = element(level, n)
    if op.inverse[o] > 0.0:
        root = closed_root(components, o)
        if root >= 0:
            wp.atomic_add(sums, root, values[o])
            if sizes.shape[0] > 0:
                wp.atomic_add(sizes, root, 1)
                if root == o:
                    wp.atomic_add(scalars, CLOSED, wp.float64(1.0))


@wp.func
def closed_mean(components: Components, sums: wp.array(dtype=wp.float64), scalars: wp.array(dtype=wp.float64), o: int):
    """Mean over the closed component of a cell; 0 where there is none."""
    if scalars[UNGROUNDED] == wp.float64(0.0):
        return wp.float64(0.0)
    root = closed_root(components, o)
    if root < 0:
        return wp.float64(0.0)
    return sums[root] / wp.float64(components.size[root])


@wp.func
def applied(op: Operator, level: wp.vec4i, p: wp.array(dtype=wp.float64), o: int):
    """A p in double precision, by differences: a constant leaves no rounding."""
    row = level[2] + 2
    plane = row * (level[1] + 2)
    here = p[o]
    return (
        op.air[o] * here
        + wp.float64(op.cx[o]) * (here - p[o - plane])
        + wp.float64(op.cx[o + plane]) * (here - p[o + plane])
        + wp.float64(op.cy[o]) * (here - p[o - row])
        + wp.float64(op.cy[o + row]) * (here - p[o + row])
        + wp.float64(op.cz[o]) * (here - p[o - 1])
        + wp.float64(op.cz[o + 1]) * (here - p[o + 1])
    )


@wp.kernel
def residual(op: Operator, level: wp.vec4i, krylov: Krylov, components: Components, fresh: int, threads: int):
    """r = b - A p, |r|^2 and |b|^2; first, if `fresh`, b without its means over closed components."""
    block, t = wp.tid()
    squared, size, removed = wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
    n = block * CHUNK + t
    end = wp.min((block + 1) * CHUNK, cell_count(level))
    while n < end:
        o = element(level, n)
        if op.inverse[o] > 0.0:
            b = krylov.b[o]
            if fresh == 1:
                mean = closed_mean(components, components.sum_b, krylov.scalars, o)
                removed += mean * mean
                b -= mean
                krylov.b[o] = b
            r = b - applied(op, level, krylov.p, o)
            krylov.r[o] = r
            squared += r * r
            size += b * b
        n += threads
    block_sum(squared, krylov.partials, block)
    block_sum(size, krylov.partials, block + krylov.blocks)
    block_sum(removed, krylov.partials, block + 2 * krylov.blocks)


@wp.kernel
def clear(scalars: wp.array(dtype=wp.float64)):
    scalars[wp.tid()] = wp.float64(0.0)


@wp.kernel
def begin(krylov: Krylov, tolerance: wp.float64, limit: wp.float64, fresh: int, threads: int):
    """After `residual`: goal and scale. `fresh`: of a new system, otherwise the recurrence begins again."""
    _, t = wp.tid()
    s = krylov.scalars
    squared = sum_partials(krylov.partials, 0, krylov.blocks, t, threads)
    size = sum_partials(krylov.partials, krylov.blocks, krylov.blocks, t, threads)
    removed = sum_partials(krylov.partials, 2 * krylov.blocks, krylov.blocks, t, threads)
    if t == 0:
        s[R2] = squared
        if fresh == 1:
            s[B2] = size
            s[REMOVED2] = removed
            s[GOAL2] = tolerance * tolerance * size
            s[LIMIT] = limit
            s[ITERATIONS] = wp.float64(0.0)
        s[ALPHA] = wp.float64(0.0)
        s[FRESH] = wp.float64(1.0)
        stop(krylov)
        s[SCALE] = wp.float64(1.0)
        # not a number compares false: nothing is done then
        if squared > s[GOAL2] and size > wp.float64(0.0) and s[ITERATIONS] < s[LIMIT]:
            s[DONE] = wp.float64(0.0)
            krylov.going[0] = 1
            s[SCALE] = wp.float64(1.0) / wp.sqrt(squared)


@wp.kernel
def store(op: Operator, level: wp.vec4i, krylov: Krylov, components: Components, out: wp.array3d(dtype=float)):
    """p without its means over closed components, 0 where there is no equation or no finite right side."""
    n = wp.tid()
    o = element(level, n)
    k = n % level[2]
    j = (n // level[2]) % level[1]
    i = n // (level[2] * level[1])
    value = wp.float64(0.0)
    size = krylov.scalars[B2]
    # an infinite or undefined right side or first guess: no solution
    if op.inverse[o] > 0.0 and size > wp.float64(0.0) and krylov.scalars[R2] < wp.float64(1.0e300):
        value = krylov.p[o] - closed_mean(components, components.sum_p, krylov.scalars, o)
    out[i, j, k] = float(value)
