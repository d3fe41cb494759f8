"""Warp kernels round the pressure solve: weights, right side, gradient (formulas and twins: `physics.pressure`).

One thread per cell of a grid that is one larger along each axis; it writes the faces on the low sides of its cell.
Optional arrays are of size 0 where they are not given.
"""

# pyright: reportArgumentType=false, reportCallIssue=false, reportIndexIssue=false, reportInvalidTypeForm=false
# pyright: reportOperatorIssue=false, reportReturnType=false, reportAttributeAccessIssue=false
# pyright: reportGeneralTypeIssues=false, reportAssignmentType=false
# what is written here is Warp's own language: Python's types of it are no types of the kernels

# Warp reads the annotations of kernels: they must not become strings
import warp as wp

from fluidlift.backends.warp_faces import Faces, Marks, cell_or, face, is_face, mark_of, put
from fluidlift.types import CellType

wp.set_module_options({"enable_backward": False})  # no gradients: halves the compile time

EMPTY = wp.constant(int(CellType.EMPTY))
FLUID = wp.constant(int(CellType.FLUID))
SOLID = wp.constant(int(CellType.SOLID))
INFLOW = wp.constant(int(CellType.INFLOW))
OUTFLOW = wp.constant(int(CellType.OUTFLOW))
OUTSIDE = wp.constant(-1)
"""no cell: beyond the box"""


@wp.func
def inside(cells: wp.vec3i, i: int, j: int, k: int):
    return i >= 0 and j >= 0 and k >= 0 and i < cells[0] and j < cells[1] and k < cells[2]


@wp.func
def shape_of(cells: wp.array3d(dtype=wp.uint8)):
    return wp.vec3i(cells.shape[0], cells.shape[1], cells.shape[2])


@wp.func
def is_held(held: Marks, axis: int, i: int, j: int, k: int):
    """Whether the velocity of a face is prescribed though no cell of inflow is beside it."""
    if held.x.shape[0] == 0:
        return False
    return mark_of(held, axis, i, j, k) != 0


@wp.func
def beyond(axis: int, i: int, j: int, k: int, step: int):
    """The cell `step` cells further along an axis."""
    cell = wp.vec3i(i, j, k)
    cell[axis] = cell[axis] + step
    return cell


@wp.func
def opening_and_weight(
    types: wp.array3d(dtype=wp.uint8), openings: Faces, gaps: Faces, open_border: int, axis: int, i: int, j: int, k: int
):
    """Of the face on the low side of cell i, j, k."""
    c = beyond(axis, i, j, k, -1)
    low = cell_or(types, c[0], c[1], c[2], OUTSIDE)
    high = cell_or(types, i, j, k, OUTSIDE)
    opening = float(1.0)
    if openings.x.shape[0] > 0:
        opening = face(openings, axis, i, j, k)
    if low == SOLID or high == SOLID:
        opening = 0.0
    if open_border == 0 and (low == OUTSIDE or high == OUTSIDE):
        within = wp.max(low, high)
        if within != OUTFLOW and within != INFLOW:  # their outer faces stay open: fluid passes there
            opening = 0.0
    weight = float(0.0)
    if (low == FLUID or high == FLUID) and low != INFLOW and high != INFLOW:
        weight = opening
        if gaps.x.shape[0] > 0:
            weight = weight / face(gaps, axis, i, j, k)
    return wp.vec2(opening, weight)


@wp.kernel
def build(
    types: wp.array3d(dtype=wp.uint8),
    given: Faces,
    gaps: Faces,
    held: Marks,
    open_border: int,
    unknown: wp.array3d(dtype=wp.uint8),
    weights: Faces,
    openings: Faces,
):
    """The system of a cell layout."""
    i, j, k = wp.tid()
    cells = shape_of(types)
    reached = float(0.0)
    for axis in range(3):
        if is_face(cells, axis, i, j, k):
            pair = opening_and_weight(types, given, gaps, open_border, axis, i, j, k)
            reached = wp.max(reached, pair[1])
            put(openings, axis, i, j, k, pair[0])
            put(weights, axis, i, j, k, wp.where(is_held(held, axis, i, j, k), 0.0, pair[1]))
    if inside(cells, i, j, k):
        fluid = int(types[i, j, k]) == FLUID
        for axis in range(3):
            if fluid and reached == 0.0:
                c = beyond(axis, i, j, k, 1)
                pair = opening_and_weight(types, given, gaps, open_border, axis, c[0], c[1], c[2])
                reached = wp.max(reached, pair[1])
        unknown[i, j, k] = wp.where(fluid and reached > 0.0, wp.uint8(1), wp.uint8(0))


@wp.func
def is_unknown(unknown: wp.array3d(dtype=wp.uint8), i: int, j: int, k: int):
    if inside(shape_of(unknown), i, j, k):
        return unknown[i, j, k] != wp.uint8(0)
    return False


@wp.func
def known_at(unknown: wp.array3d(dtype=wp.uint8), known: wp.array3d(dtype=float), i: int, j: int, k: int):
    """q of a cell that is not unknown: 0 where nothing is given, and outside the box."""
    if known.shape[0] == 0 or not inside(shape_of(unknown), i, j, k):
        return float(0.0)
    return wp.where(unknown[i, j, k] == wp.uint8(0), known[i, j, k], 0.0)


@wp.kernel
def right_side(
    velocity: Faces,
    openings: Faces,
    weights: Faces,
    unknown: wp.array3d(dtype=wp.uint8),
    known: wp.array3d(dtype=float),
    spacing: wp.float64,
    rhs: wp.array3d(dtype=float),
):
    """-div(w v) with solids at rest, and what known cells add; summed in double precision, as differences cancel."""
    i, j, k = wp.tid()
    total = wp.float64(0.0)
    if unknown[i, j, k] != wp.uint8(0):
        pull = wp.float64(0.0)
        for axis in range(3):
            low = beyond(axis, i, j, k, -1)
            high = beyond(axis, i, j, k, 1)
            flux = wp.float64(face(velocity, axis, high[0], high[1], high[2]))
            total -= flux * wp.float64(face(openings, axis, high[0], high[1], high[2]))
            flux = wp.float64(face(velocity, axis, i, j, k))
            total += flux * wp.float64(face(openings, axis, i, j, k))
            if known.shape[0] > 0:
                q = wp.float64(known_at(unknown, known, low[0], low[1], low[2]))
                pull += q * wp.float64(face(weights, axis, i, j, k))
                q = wp.float64(known_at(unknown, known, high[0], high[1], high[2]))
                pull += q * wp.float64(face(weights, axis, high[0], high[1], high[2]))
        total = total / spacing + pull / (spacing * spacing)
    rhs[i, j, k] = float(total)


@wp.func
def full_q(
    unknown: wp.array3d(dtype=wp.uint8), q: wp.array3d(dtype=float), known: wp.array3d(dtype=float),
    i: int, j: int, k: int,
):  # fmt: skip
    if is_unknown(unknown, i, j, k):
        return q[i, j, k]
    return known_at(unknown, known, i, j, k)


@wp.kernel
def subtract_gradient(
    velocity: Faces,
    openings: Faces,
    weights: Faces,
    unknown: wp.array3d(dtype=wp.uint8),
    known: wp.array3d(dtype=float),
    q: wp.array3d(dtype=float),
    spacing: float,
    out: Faces,
):
    """v - grad q on faces with a weight, 0 on closed ones; `out` may be `velocity`. weight / opening = 1 / gap."""
    i, j, k = wp.tid()
    cells = shape_of(unknown)
    for axis in range(3):
        if is_face(cells, axis, i, j, k):
            value = float(0.0)
            opening = face(openings, axis, i, j, k)
            if opening > 0.0:
                value = face(velocity, axis, i, j, k)
                weight = face(weights, axis, i, j, k)
                if weight > 0.0:
                    c = beyond(axis, i, j, k, -1)
                    change = full_q(unknown, q, known, i, j, k) - full_q(unknown, q, known, c[0], c[1], c[2])
                    value -= change / spacing * (weight / opening)
            put(out, axis, i, j, k, value)


@wp.kernel
def release(
    walls: wp.array3d(dtype=wp.uint8),
    q: wp.array3d(dtype=float),
    limit: float,
    unknown: wp.array3d(dtype=wp.uint8),
    count: wp.array(dtype=int),
):
    """Cells at walls whose q lies below the limit become air."""
    i, j, k = wp.tid()
    if unknown[i, j, k] != wp.uint8(0) and walls[i, j, k] != wp.uint8(0) and q[i, j, k] < limit:
        unknown[i, j, k] = wp.uint8(0)
        wp.atomic_add(count, 0, 1)
