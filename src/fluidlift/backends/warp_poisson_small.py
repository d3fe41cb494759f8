"""The part of the V-cycle of the pressure solver that visits all small levels in one block of threads.

It stands apart because Warp compiles a module once for each block size. What counts here is how long one thread waits
for memory: nothing is loaded only after something else has been looked at, cells without equation are computed too
(their inverse diagonal is 0).
"""

# pyright: reportArgumentType=false, reportCallIssue=false, reportIndexIssue=false, reportInvalidTypeForm=false
# pyright: reportOperatorIssue=false, reportReturnType=false, reportAttributeAccessIssue=false
# pyright: reportGeneralTypeIssues=false, reportAssignmentType=false
# what is written here is Warp's own language: Python's types of it are no types of the kernels

# Warp reads the annotations of kernels: they must not become strings
import warp as wp

from fluidlift.backends.warp_poisson_kernels import (
    DONE,
    Operator,
    cell_count,
    cell_of_pair,
    corrected_sum,
    pair_count,
    place,
    restrict_cell,
    wait_for_block,
)

wp.set_module_options({"enable_backward": False})  # no gradients: halves the compile time


@wp.func
def relax_all(op: Operator, level: wp.vec4i, cells: wp.array(dtype=int), first: int, count: int, t: int, threads: int):
    """One half sweep; `cells` holds the elements of its colour from `first` on."""
    row = level[2] + 2
    plane = row * (level[1] + 2)
    n = int(t)
    while n < count:
        o = cells[first + n]
        total = op.rhs[o] + op.cx[o] * op.x[o - plane] + op.cx[o + plane] * op.x[o + plane]
        total += op.cy[o] * op.x[o - row] + op.cy[o + row] * op.x[o + row]
        total += op.cz[o] * op.x[o - 1] + op.cz[o + 1] * op.x[o + 1]
        op.x[o] = total * op.inverse[o]
        n += threads
    wait_for_block()


@wp.func
def relax_color(
    op: Operator, levels: wp.array(dtype=wp.vec4i), cells: wp.array(dtype=int), starts: wp.array(dtype=int),
    l: int, color: int, t: int, threads: int,
):  # fmt: skip
    """One half sweep of level l; the elements of colour c of it are starts[2 l + c] to starts[2 l + c + 1] - 1."""
    first = starts[2 * l + color]
    relax_all(op, levels[l], cells, first, starts[2 * l + color + 1] - first, t, threads)


@wp.func
def prolong_small(op: Operator, fine: wp.vec4i, coarse: wp.vec4i, n: int):
    """As `warp_poisson_kernels.prolong_pair`."""
    c = cell_of_pair(fine, n, 1)
    if c[2] <= fine[2]:
        o = place(fine, c[0], c[1], c[2])
        op.x[o] = (op.rhs[o] + corrected_sum(op, fine, coarse, c)) * op.inverse[o]


@wp.kernel
def cycle_small(
    op: Operator,
    levels: wp.array(dtype=wp.vec4i),
    cells: wp.array(dtype=int),
    starts: wp.array(dtype=int),
    first: int,
    sweeps: int,
    coarsest_sweeps: int,
    scalars: wp.array(dtype=wp.float64),
    threads: int,
):
    """The V-cycle of the levels from `first` on, in one block. The red half sweep on the first of them is done."""
    _, t = wp.tid()
    if scalars[DONE] != wp.float64(0.0):
        return
    last = levels.shape[0] - 1
    for l in range(first, last):
        for s in range(1, 2 * sweeps):
            relax_color(op, levels, cells, starts, l, s & 1, t, threads)
        n = int(t)
        while n < cell_count(levels[l + 1]):
            restrict_cell(op, levels[l], levels[l + 1], n)
            n += threads
        wait_for_block()
    # forth and back: the sweep back begins with the colour that the other ended with, which changes nothing
    for s in range(1, 4 * coarsest_sweeps - 1):
        relax_color(op, levels, cells, starts, last, s & 1, t, threads)
    for down in range(first, last):
        l = last - 1 - (down - first)
        n = int(t)
        while n < pair_count(levels[l]):
            prolong_small(op, levels[l], levels[l + 1], n)
            n += threads
        wait_for_block()
        for s in range(1, 2 * sweeps):
            relax_color(op, levels, cells, starts, l, 1 - (s & 1), t, threads)
