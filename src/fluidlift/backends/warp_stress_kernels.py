"""Warp kernels of implicit viscosity: its operator and conjugate gradients (formulas and twins: `physics.viscosity`,
`physics.stress_kernels`).

Arrays are flat: component by component, each a box of nodes (nx, ny, nz) with two more layers than the grid on each
side, so that no face of the grid needs a check for its neighbours. u[i,j,k] lies between the cells i-1 and i, the edge
along z number (i, j) between u[i,j-1] and u[i,j] and between v[i-1,j] and v[i,j]; likewise for the others. A cell or an
edge has the index of its node. What is said of blocks and of `DONE` in `warp_poisson_kernels` holds here too.
"""

# pyright: reportArgumentType=false, reportCallIssue=false, reportIndexIssue=false, reportInvalidTypeForm=false
# pyright: reportOperatorIssue=false, reportReturnType=false, reportAttributeAccessIssue=false
# pyright: reportGeneralTypeIssues=false, reportAssignmentType=false
# what is written here is Warp's own language: Python's types of it are no types of the kernels

# Warp reads the annotations of kernels: they must not become strings
import warp as wp

from fluidlift.backends.warp_poisson_kernels import CHUNK, block_sum, sum_partials

wp.set_module_options({"enable_backward": False})  # no gradients: halves the compile time

RING = wp.constant(2)
"""layers of nodes round those of the grid"""

DONE = wp.constant(0)
ITERATIONS = wp.constant(1)
R2 = wp.constant(2)
"""|r|^2"""
SIZE2 = wp.constant(3)
"""the larger of |momentum|^2 before and now: what the residual is measured by"""
BEFORE2 = wp.constant(4)
RZ = wp.constant(5)
ALPHA = wp.constant(6)
BETA = wp.constant(7)
SCALE = wp.constant(8)
TOLERANCE = wp.constant(9)
LIMIT = wp.constant(10)
SCALARS = 11


@wp.struct
class Stress:
    """The operator: flat arrays of three components."""

    mass: wp.array(dtype=float)
    """liquid share of the faces that are solved, 0 elsewhere"""
    inverse: wp.array(dtype=float)
    """1 / diagonal"""
    normal: wp.array(dtype=float)
    """weights of the stresses xx, yy, zz at cells"""
    shear: wp.array(dtype=float)
    """weights of the stresses yz, xz, xy at edges"""
    nodes: wp.vec3i


@wp.struct
class Search:
    """The state of the conjugate gradients."""

    x: wp.array(dtype=wp.float64)
    """velocities, m/s, the given ones included"""
    r: wp.array(dtype=wp.float64)
    q: wp.array(dtype=wp.float64)
    z: wp.array(dtype=float)
    """the scaled residual over the diagonal"""
    scalars: wp.array(dtype=wp.float64)
    partials: wp.array(dtype=wp.float64)
    """[3 blocks]"""
    going: wp.array(dtype=int)
    """[1], 0 when `DONE` is set: the condition of graphs that loop"""
    blocks: int


@wp.func
def node_count(nodes: wp.vec3i):
    return nodes[0] * nodes[1] * nodes[2]


@wp.func
def is_within(nodes: wp.vec3i, n: int):
    """Whether a node has all its neighbours."""
    k = n % nodes[2]
    row = n // nodes[2]
    j = row % nodes[1]
    i = row // nodes[1]
    return i > 0 and j > 0 and k > 0 and i < nodes[0] - 1 and j < nodes[1] - 1 and k < nodes[2] - 1


@wp.func
def axis_step(nodes: wp.vec3i, axis: int):
    """Elements from a node to the next along an axis."""
    if axis == 0:
        return nodes[1] * nodes[2]
    if axis == 1:
        return nodes[2]
    return 1


@wp.func
def pull(
    stress: Stress, n: int, a: int, before: wp.array(dtype=float), z: wp.array(dtype=float), beta: float
):  # fmt: skip
    """What the stresses take from the momentum of face n of component a, for the velocities z + beta before."""
    count = node_count(stress.nodes)
    b = (a + 1) % 3
    c = (a + 2) % 3
    sa = axis_step(stress.nodes, a)
    sb = axis_step(stress.nodes, b)
    sc = axis_step(stress.nodes, c)
    own = a * count + n
    ob = b * count + n
    oc = c * count + n
    here = wp.float64(z[own] + beta * before[own])
    # the edges around a face: along c towards b, along b towards c
    total = wp.float64(stress.normal[own - sa]) * (here - fresh(z, before, beta, own - sa))
    total -= wp.float64(stress.normal[own]) * (fresh(z, before, beta, own + sa) - here)
    total += wp.float64(stress.shear[oc]) * (
        here - fresh(z, before, beta, own - sb) + (fresh(z, before, beta, ob) - fresh(z, before, beta, ob - sa))
    )
    total -= wp.float64(stress.shear[oc + sb]) * (
        fresh(z, before, beta, own + sb) - here
        + (fresh(z, before, beta, ob + sb) - fresh(z, before, beta, ob + sb - sa))
    )  # fmt: skip
    total += wp.float64(stress.shear[ob]) * (
        here - fresh(z, before, beta, own - sc) + (fresh(z, before, beta, oc) - fresh(z, before, beta, oc - sa))
    )
    total -= wp.float64(stress.shear[ob + sc]) * (
        fresh(z, before, beta, own + sc) - here
        + (fresh(z, before, beta, oc + sc) - fresh(z, before, beta, oc + sc - sa))
    )  # fmt: skip
    return total


@wp.func
def fresh(z: wp.array(dtype=float), before: wp.array(dtype=float), beta: float, o: int):
    return wp.float64(z[o] + beta * before[o])


@wp.func
def pull_exact(stress: Stress, n: int, a: int, x: wp.array(dtype=wp.float64)):
    """`pull` for velocities in double precision."""
    count = node_count(stress.nodes)
    b = (a + 1) % 3
    c = (a + 2) % 3
    sa = axis_step(stress.nodes, a)
    sb = axis_step(stress.nodes, b)
    sc = axis_step(stress.nodes, c)
    own = a * count + n
    ob = b * count + n
    oc = c * count + n
    here = x[own]
    total = wp.float64(stress.normal[own - sa]) * (here - x[own - sa])
    total -= wp.float64(stress.normal[own]) * (x[own + sa] - here)
    total += wp.float64(stress.shear[oc]) * (here - x[own - sb] + (x[ob] - x[ob - sa]))
    total -= wp.float64(stress.shear[oc + sb]) * (x[own + sb] - here + (x[ob + sb] - x[ob + sb - sa]))
    total += wp.float64(stress.shear[ob]) * (here - x[own - sc] + (x[oc] - x[oc - sa]))
    total -= wp.float64(stress.shear[ob + sc]) * (x[own + sc] - here + (x[oc + sc] - x[oc + sc - sa]))
    return total


@wp.kernel
def residual(stress: Stress, search: Search, momentum: wp.array(dtype=wp.float64), threads: int):
    """r = momentum - A x, z from it unscaled; the squares of r, of the momentum and of mass times x."""
    block, t = wp.tid()
    squared, before, after = wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
    count = node_count(stress.nodes)
    o = block * CHUNK + t
    end = wp.min((block + 1) * CHUNK, 3 * count)
    while o < end:
        mass = wp.float64(stress.mass[o])
        if mass > wp.float64(0.0):
            moved = mass * search.x[o]
            given = momentum[o]
            r = given - moved - pull_exact(stress, o % count, o // count, search.x)
            search.r[o] = r
            squared += r * r
            before += given * given
            after += moved * moved
        o += threads
    block_sum(squared, search.partials, block)
    block_sum(before, search.partials, block + search.blocks)
    block_sum(after, search.partials, block + 2 * search.blocks)


@wp.func
def stop(search: Search):
    search.scalars[DONE] = wp.float64(1.0)
    search.going[0] = 0


@wp.kernel
def begin(search: Search, tolerance: wp.float64, limit: wp.float64, threads: int):
    """After `residual`: whether there is something to do."""
    _, t = wp.tid()
    s = search.scalars
    squared = sum_partials(search.partials, 0, search.blocks, t, threads)
    before = sum_partials(search.partials, search.blocks, search.blocks, t, threads)
    after = sum_partials(search.partials, 2 * search.blocks, search.blocks, t, threads)
    if t == 0:
        s[R2] = squared
        s[BEFORE2] = before
        s[SIZE2] = wp.max(before, after)
        if limit > wp.float64(0.0):  # 0: at the end, to learn the true residual
            s[ITERATIONS] = wp.float64(0.0)
            s[TOLERANCE] = tolerance
            s[LIMIT] = limit
        s[ALPHA] = wp.float64(0.0)
        s[BETA] = wp.float64(0.0)
        s[RZ] = wp.float64(0.0)
        stop(search)
        s[SCALE] = wp.float64(1.0)
        # not a number compares false: nothing is done then
        if squared > s[TOLERANCE] * s[TOLERANCE] * s[SIZE2]:
            s[DONE] = wp.float64(0.0)
            search.going[0] = 1
            s[SCALE] = wp.float64(1.0) / wp.sqrt(squared)


@wp.kernel
def turn(stress: Stress, search: Search, before: wp.array(dtype=float), direction: wp.array(dtype=float), threads: int):
    """direction = z + beta before, q = A direction, and direction . q."""
    block, t = wp.tid()
    if search.scalars[DONE] != wp.float64(0.0):
        return
    beta = float(search.scalars[BETA])
    count = node_count(stress.nodes)
    total = wp.float64(0.0)
    o = block * CHUNK + t
    end = wp.min((block + 1) * CHUNK, 3 * count)
    while o < end:
        mass = wp.float64(stress.mass[o])
        if mass > wp.float64(0.0):
            here = search.z[o] + beta * before[o]
            value = mass * wp.float64(here) + pull(stress, o % count, o // count, before, search.z, beta)
            direction[o] = here
            search.q[o] = value
            total += wp.float64(here) * value
        o += threads
    block_sum(total, search.partials, block)


@wp.kernel
def choose_alpha(search: Search, threads: int):
    """After `turn`."""
    _, t = wp.tid()
    s = search.scalars
    if s[DONE] != wp.float64(0.0):
        return
    curvature = sum_partials(search.partials, 0, search.blocks, t, threads)
    if t == 0:
        if curvature > wp.float64(0.0):
            s[ALPHA] = s[RZ] / (s[SCALE] * curvature)
        else:
            stop(search)


@wp.kernel
def descend(stress: Stress, search: Search, direction: wp.array(dtype=float), threads: int):
    """One step of x and r; z; the products r . z, r . r and |mass x|^2."""
    block, t = wp.tid()
    if search.scalars[DONE] != wp.float64(0.0):
        return
    alpha, scale = search.scalars[ALPHA], search.scalars[SCALE]
    steep, squared, after = wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
    o = block * CHUNK + t
    end = wp.min((block + 1) * CHUNK, 3 * node_count(stress.nodes))
    while o < end:
        mass = wp.float64(stress.mass[o])
        if mass > wp.float64(0.0):
            x = search.x[o] + alpha * wp.float64(direction[o])
            r = search.r[o] - alpha * search.q[o]
            z = float(scale * r) * stress.inverse[o]
            search.x[o] = x
            search.r[o] = r
            search.z[o] = z
            steep += scale * r * wp.float64(z)
            squared += r * r
            after += mass * x * mass * x
        o += threads
    block_sum(steep, search.partials, block)
    block_sum(squared, search.partials, block + search.blocks)
    block_sum(after, search.partials, block + 2 * search.blocks)


@wp.kernel
def judge(search: Search, steps: int, threads: int):
    """After `descend`: whether the goal is reached, and beta. `steps`: 0 for the one that only makes z."""
    _, t = wp.tid()
    s = search.scalars
    if s[DONE] != wp.float64(0.0):
        return
    rz = sum_partials(search.partials, 0, search.blocks, t, threads)
    squared = sum_partials(search.partials, search.blocks, search.blocks, t, threads)
    after = sum_partials(search.partials, 2 * search.blocks, search.blocks, t, threads)
    if t == 0:
        s[R2] = squared
        s[SIZE2] = wp.max(s[BEFORE2], after)
        s[ITERATIONS] = s[ITERATIONS] + wp.float64(steps)
        s[BETA] = wp.where(s[RZ] > wp.float64(0.0), rz / wp.max(s[RZ], wp.float64(1.0e-300)), wp.float64(0.0))
        s[RZ] = rz
        unfinished = squared > s[TOLERANCE] * s[TOLERANCE] * s[SIZE2]
        if not (unfinished and s[ITERATIONS] < s[LIMIT] and rz > wp.float64(0.0)):
            stop(search)
