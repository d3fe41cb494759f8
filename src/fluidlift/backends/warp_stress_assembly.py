"""Warp kernels that set implicit viscosity up and hand its result back (layout: `warp_stress_kernels`; formulas and
twins: `physics.viscosity`, `physics.stress_kernels`, `physics.liquid_fractions`). One liquid of one viscosity, solids
at rest."""

# pyright: reportArgumentType=false, reportCallIssue=false, reportIndexIssue=false, reportInvalidTypeForm=false
# pyright: reportOperatorIssue=false, reportReturnType=false, reportAttributeAccessIssue=false
# pyright: reportGeneralTypeIssues=false, reportAssignmentType=false
# what is written here is Warp's own language: Python's types of it are no types of the kernels

# Warp reads the annotations of kernels: they must not become strings
import warp as wp

from fluidlift.backends.warp_faces import Faces, Marks, face, is_face, put
from fluidlift.backends.warp_stress_kernels import RING, Search, Stress, axis_step, is_within, node_count

wp.set_module_options({"enable_backward": False})  # no gradients: halves the compile time

AIR = wp.constant(0)
SOLVED = wp.constant(1)
FIXED = wp.constant(2)
WALL = wp.constant(3)
"""roles of a face"""
LEAST_GAP = wp.constant(0.05)
"""cells, see `physics.stress_kernels`"""
LEAST_SHARE = wp.constant(0.01)
"""see `physics.stress_multigrid`"""
LEAST_SLOPE = wp.constant(wp.float64(1e-3))
"""see `physics.liquid_fractions`"""


@wp.struct
class Given:
    """What a viscous step begins with."""

    solved: Marks
    fixed: Marks
    walls: Marks
    liquid: wp.array3d(dtype=float)
    """[nx,ny,nz], m, distance from the surface at cell centres, negative inside"""
    solid: wp.array3d(dtype=float)
    """[nx+1,ny+1,nz+1], m, at nodes, positive outside"""
    spacing: float
    wall_share: float


@wp.struct
class NodeArrays:
    """Of the box of nodes."""

    roles: wp.array(dtype=wp.int8)
    buried: wp.array(dtype=wp.uint8)
    """faces that count as wall although they are partly open, since their centre lies in the solid"""
    clearance: wp.array(dtype=float)
    """cells from the faces to the solid"""
    octants: wp.array2d(dtype=float)
    """[nodes, 8]: liquid in the octants of cells"""
    cells: wp.array(dtype=float)
    """liquid in cells, -1 in those in which nothing can flow"""
    momentum: wp.array(dtype=wp.float64)


@wp.func
def node_of(nodes: wp.vec3i, n: int):
    """Indices in the grid of a node of the box."""
    row = n // nodes[2]
    return wp.vec3i(row // nodes[1] - RING, row % nodes[1] - RING, n % nodes[2] - RING)


@wp.func
def cells_of(nodes: wp.vec3i):
    """Cells of the grid along each axis."""
    return wp.vec3i(nodes[0] - 2 * RING - 1, nodes[1] - 2 * RING - 1, nodes[2] - 2 * RING - 1)


@wp.func
def is_grid_face(cells: wp.vec3i, axis: int, c: wp.vec3i):
    if c[0] < 0 or c[1] < 0 or c[2] < 0 or c[0] > cells[0] or c[1] > cells[1] or c[2] > cells[2]:
        return False
    return is_face(cells, axis, c[0], c[1], c[2])


@wp.func
def mark_at(marks: Marks, axis: int, c: wp.vec3i):
    if axis == 0:
        return marks.x[c[0], c[1], c[2]] != wp.uint8(0)
    if axis == 1:
        return marks.y[c[0], c[1], c[2]] != wp.uint8(0)
    return marks.z[c[0], c[1], c[2]] != wp.uint8(0)


@wp.func
def given_role(given: Given, cells: wp.vec3i, axis: int, c: wp.vec3i):
    if not is_grid_face(cells, axis, c):
        return AIR
    if mark_at(given.solved, axis, c):
        return SOLVED
    if mark_at(given.fixed, axis, c):
        return FIXED
    if mark_at(given.walls, axis, c):
        return WALL
    return AIR


@wp.func
def solid_at(given: Given, cells: wp.vec3i, c: wp.vec3i):
    i = wp.clamp(c[0], 0, cells[0])
    j = wp.clamp(c[1], 0, cells[1])
    k = wp.clamp(c[2], 0, cells[2])
    return given.solid[i, j, k] / given.spacing


@wp.func
def unit(axis: int):
    step = wp.vec3i()
    step[axis] = 1
    return step


@wp.kernel
def assign_roles(given: Given, stress: Stress, parts: NodeArrays, search: Search, directions: wp.array2d(dtype=float)):
    """Roles and clearances of the faces of a node; whether something can flow in its cell; vectors cleared."""
    n = wp.tid()
    nodes = stress.nodes
    count = node_count(nodes)
    cells = cells_of(nodes)
    c = node_of(nodes, n)
    open_cell = int(0)
    for a in range(3):
        role = given_role(given, cells, a, c)
        if role < FIXED or given_role(given, cells, a, c + unit(a)) < FIXED:
            open_cell = 1
        b, d = unit((a + 1) % 3), unit((a + 2) % 3)
        clearance = 0.5 * (solid_at(given, cells, c) + solid_at(given, cells, c + b))
        clearance += 0.5 * (solid_at(given, cells, c + d) + solid_at(given, cells, c + b + d))
        clearance *= 0.5
        if role == SOLVED and (c[a] == 0 or c[a] == cells[a]):
            role = AIR  # it lacks its outer neighbour: see `carry_out`
        buried = wp.uint8(0)
        if role == SOLVED and clearance <= 0.0 and given.wall_share > 0.0:
            role = WALL
            buried = wp.uint8(1)
        o = a * count + n
        parts.roles[o] = wp.int8(role)
        parts.buried[o] = buried
        parts.clearance[o] = clearance
        stress.mass[o] = 0.0
        stress.inverse[o] = 0.0
        stress.normal[o] = 0.0
        stress.shear[o] = 0.0
        search.r[o] = wp.float64(0.0)
        search.q[o] = wp.float64(0.0)
        search.z[o] = 0.0
        directions[0, o] = 0.0
        directions[1, o] = 0.0
    in_grid = c[0] >= 0 and c[1] >= 0 and c[2] >= 0 and c[0] < cells[0] and c[1] < cells[1] and c[2] < cells[2]
    parts.cells[n] = wp.where(in_grid and open_cell == 1, 0.0, -1.0)


@wp.func
def cube(value: wp.float64):
    return value * value * value


@wp.func
def beyond_cubed(value: wp.float64):
    return cube(wp.max(value, wp.float64(0.0)))


@wp.func
def cut_share(value: wp.float64, gx: wp.float64, gy: wp.float64, gz: wp.float64):
    """Share of a unit cube in which value + g . x < 0, with x from its centre."""
    a, b, c = wp.abs(gx), wp.abs(gy), wp.abs(gz)
    total = a + b + c
    if wp.float64(2.0) * wp.abs(value) >= total:
        return wp.where(value < wp.float64(0.0), wp.float64(1.0), wp.float64(0.0))
    least = LEAST_SLOPE * total
    a, b, c = wp.max(a, least), wp.max(b, least), wp.max(c, least)
    reach = wp.float64(0.5) * (a + b + c) - wp.abs(value)
    part = cube(reach) - beyond_cubed(reach - a) - beyond_cubed(reach - b) - beyond_cubed(reach - c)
    part += beyond_cubed(reach - a - b) + beyond_cubed(reach - b - c) + beyond_cubed(reach - c - a)
    part /= wp.float64(6.0) * a * b * c
    return wp.where(value < wp.float64(0.0), wp.float64(1.0) - part, part)


@wp.func
def liquid_at(given: Given, i: int, j: int, k: int):
    x = wp.clamp(i, 0, given.liquid.shape[0] - 1)
    y = wp.clamp(j, 0, given.liquid.shape[1] - 1)
    z = wp.clamp(k, 0, given.liquid.shape[2] - 1)
    return given.liquid[x, y, z] / given.spacing


@wp.func
def octant_share(given: Given, cell: wp.vec3i, si: int, sj: int, sk: int):
    """Share of liquid in the octant of a cell towards (si, sj, sk) = +-1: the trilinear distance at its centre."""
    value = wp.float64(0.0)
    gx, gy, gz = wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
    for a in range(2):
        for b in range(2):
            for c in range(2):
                wx = wp.float64(0.75 - 0.5 * float(a))
                wy = wp.float64(0.75 - 0.5 * float(b))
                wz = wp.float64(0.75 - 0.5 * float(c))
                q = wp.float64(liquid_at(given, cell[0] + a * si, cell[1] + b * sj, cell[2] + c * sk))
                value += wx * wy * wz * q
                gx += wy * wz * q * wp.float64(2 * a - 1)
                gy += wx * wz * q * wp.float64(2 * b - 1)
                gz += wx * wy * q * wp.float64(2 * c - 1)
    half = wp.float64(0.5)
    return float(cut_share(value, half * gx, half * gy, half * gz))


@wp.kernel
def fill_cells(given: Given, stress: Stress, parts: NodeArrays):
    """Liquid in the octants of a cell, and in the cell."""
    n = wp.tid()
    c = node_of(stress.nodes, n)
    if parts.cells[n] < 0.0:
        for o in range(8):
            parts.octants[n, o] = 0.0
        return
    negative = int(0)
    for a in range(27):
        if liquid_at(given, c[0] + a // 9 - 1, c[1] + (a // 3) % 3 - 1, c[2] + a % 3 - 1) < 0.0:
            negative += 1
    total = float(0.0)
    for i in range(2):
        for j in range(2):
            for k in range(2):
                share = float(0.0)
                if negative == 27:
                    share = 1.0
                elif negative > 0:
                    share = octant_share(given, c, 2 * i - 1, 2 * j - 1, 2 * k - 1)
                parts.octants[n, 4 * i + 2 * j + k] = share
                total += share
    parts.cells[n] = 0.125 * total


@wp.func
def control_share(parts: NodeArrays, nodes: wp.vec3i, n: int, x: int, y: int, z: int):
    """Liquid share of the volume of cell n, moved down by half a cell along the axes given by 1."""
    total = float(0.0)
    count = int(0)
    for i in range(2):
        for j in range(2):
            for k in range(2):
                cell = n - x * (1 - i) * axis_step(nodes, 0) - y * (1 - j) * axis_step(nodes, 1) - z * (1 - k)
                if parts.cells[cell] >= 0.0:
                    count += 1
                    total += parts.octants[cell, 4 * (i ^ x) + 2 * (j ^ y) + (k ^ z)]
    return wp.where(count > 0, total / float(wp.max(count, 1)), 0.0)


@wp.func
def gap_between(role_a: int, role_b: int, a: float, b: float):
    """Cells from a face to the wall that its neighbour lies in, by their clearances; 1 with no wall between them."""
    if (role_a == WALL) == (role_b == WALL):
        return float(1.0)
    outside = wp.where(role_a == WALL, b, a)
    behind = wp.where(role_a == WALL, a, b)
    if outside <= behind:
        return float(0.5)
    return wp.clamp(outside / (outside - behind), LEAST_GAP, 1.0)


@wp.func
def normal_factor(parts: NodeArrays, o: int, next_o: int, wall_share: float):
    """Of the normal stress between two faces of a component; 0 unless it acts on a solved one."""
    r, s = int(parts.roles[o]), int(parts.roles[next_o])
    if r == AIR or s == AIR or (r != SOLVED and s != SOLVED):
        return float(0.0)
    if r != WALL and s != WALL:
        return float(1.0)
    return wall_share / gap_between(r, s, parts.clearance[o], parts.clearance[next_o])


@wp.func
def shear_factor(parts: NodeArrays, oa: int, next_a: int, ob: int, next_b: int, wall_share: float):
    """Of the shear stress between two faces of component a, and two of b."""
    p, q, r, s = int(parts.roles[oa]), int(parts.roles[next_a]), int(parts.roles[ob]), int(parts.roles[next_b])
    if p == AIR or q == AIR or r == AIR or s == AIR:
        return float(0.0)
    if p != SOLVED and q != SOLVED and r != SOLVED and s != SOLVED:
        return float(0.0)
    if p != WALL and q != WALL and r != WALL and s != WALL:
        return float(1.0)
    gap = wp.min(
        gap_between(p, q, parts.clearance[oa], parts.clearance[next_a]),
        gap_between(r, s, parts.clearance[ob], parts.clearance[next_b]),
    )
    return wall_share / gap


@wp.kernel
def weigh_stresses(stress: Stress, parts: NodeArrays, number: float, wall_share: float):
    """normal = 2 V nu dt / h^2 at cells, shear = V nu dt / h^2 at edges, where number = nu dt / h^2."""
    n = wp.tid()
    nodes = stress.nodes
    if not is_within(nodes, n):
        return
    count = node_count(nodes)
    for a in range(3):
        o = a * count + n
        factor = normal_factor(parts, o, o + axis_step(nodes, a), wall_share)
        if factor > 0.0:
            stress.normal[o] = 2.0 * number * factor * control_share(parts, nodes, n, 0, 0, 0)
        # the edge along a, between the faces of b that follow each other along c, and those of c along b
        b = (a + 1) % 3
        c = (a + 2) % 3
        ob = b * count + n
        oc = c * count + n
        factor = shear_factor(parts, ob, ob - axis_step(nodes, c), oc, oc - axis_step(nodes, b), wall_share)
        if factor > 0.0:
            share = control_share(parts, nodes, n, 1 - unit(a)[0], 1 - unit(a)[1], 1 - unit(a)[2])
            stress.shear[o] = number * factor * share


@wp.kernel
def weigh_faces(
    velocity: Faces, stress: Stress, parts: NodeArrays, search: Search
):  # fmt: skip
    """Mass and inverse diagonal of the solved faces, the first guess (the velocity before) and its momentum."""
    n = wp.tid()
    nodes = stress.nodes
    count = node_count(nodes)
    cells = cells_of(nodes)
    c = node_of(nodes, n)
    for a in range(3):
        o = a * count + n
        role = int(parts.roles[o])
        x = wp.float64(0.0)
        momentum = wp.float64(0.0)
        if role != AIR and is_grid_face(cells, a, c) and parts.buried[o] == wp.uint8(0):
            x = wp.float64(face(velocity, a, c[0], c[1], c[2]))
        if role == SOLVED:
            b = (a + 1) % 3
            d = (a + 2) % 3
            ob = b * count + n
            od = d * count + n
            stiffness = stress.normal[o] + stress.normal[o - axis_step(nodes, a)]
            stiffness += stress.shear[ob] + stress.shear[ob + axis_step(nodes, d)]
            stiffness += stress.shear[od] + stress.shear[od + axis_step(nodes, b)]
            share = control_share(parts, nodes, n, unit(a)[0], unit(a)[1], unit(a)[2])
            if share > 0.0 or stiffness > 0.0:
                mass = wp.max(share, LEAST_SHARE)
                stress.mass[o] = mass
                stress.inverse[o] = 1.0 / (mass + stiffness)
                momentum = wp.float64(mass) * x
        search.x[o] = x
        parts.momentum[o] = momentum


@wp.kernel
def continue_behind_walls(stress: Stress, parts: NodeArrays, search: Search, wall_share: float):
    """Velocities of buried faces, linear through the wall's (0) from those beside them in the liquid."""
    n = wp.tid()
    nodes = stress.nodes
    if not is_within(nodes, n):
        return
    count = node_count(nodes)
    for a in range(3):
        o = a * count + n
        if parts.buried[o] != wp.uint8(0):
            here = parts.clearance[o]
            total, weight = wp.float64(0.0), wp.float64(0.0)
            for side in range(6):
                other = o + (2 * (side % 2) - 1) * axis_step(nodes, side // 2)
                there = parts.clearance[other]
                if stress.mass[other] > 0.0 and there > here and there > 0.0:
                    kept = 1.0 - wall_share * (1.0 - wp.max(here / there, -1.0))
                    total += wp.float64((there - here) * kept) * search.x[other]
                    weight += wp.float64(there - here)
            if weight > wp.float64(0.0):
                search.x[o] = total / weight


@wp.func
def new_velocity(velocity: Faces, stress: Stress, parts: NodeArrays, search: Search, a: int, c: wp.vec3i):
    nodes = stress.nodes
    n = ((c[0] + RING) * nodes[1] + c[1] + RING) * nodes[2] + c[2] + RING
    o = a * node_count(nodes) + n
    if stress.mass[o] > 0.0 or parts.buried[o] != wp.uint8(0):
        return float(search.x[o])
    return face(velocity, a, c[0], c[1], c[2])


@wp.kernel
def carry_out(given: Given, velocity: Faces, stress: Stress, parts: NodeArrays, search: Search, left: float):
    """Solved faces on open sides of the grid follow the next inner ones; `left` of their difference stays."""
    n = wp.tid()
    cells = cells_of(stress.nodes)
    c = node_of(stress.nodes, n)
    for a in range(3):
        if is_grid_face(cells, a, c) and (c[a] == 0 or c[a] == cells[a]):
            inner = c + unit(a)
            if c[a] > 0:
                inner = c - unit(a)
            if mark_at(given.solved, a, c) and mark_at(given.solved, a, inner):
                new = new_velocity(velocity, stress, parts, search, a, inner)
                old = face(velocity, a, inner[0], inner[1], inner[2])
                value = new + left * (face(velocity, a, c[0], c[1], c[2]) - old)
                put(velocity, a, c[0], c[1], c[2], value)


@wp.kernel
def store(velocity: Faces, stress: Stress, parts: NodeArrays, search: Search):
    """The new velocities of the faces that were solved or lie behind walls; after `carry_out`."""
    n = wp.tid()
    cells = cells_of(stress.nodes)
    c = node_of(stress.nodes, n)
    for a in range(3):
        if is_grid_face(cells, a, c):
            put(velocity, a, c[0], c[1], c[2], new_velocity(velocity, stress, parts, search, a, c))
