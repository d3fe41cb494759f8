"""Warp kernels that say what each cell holds (model: `physics.boundaries.liquid_cells`, `physics.free_surface`,
`physics.outlet`).

Imported only by adapters that have found Warp.
"""

# pyright: reportArgumentType=false, reportCallIssue=false, reportIndexIssue=false, reportInvalidTypeForm=false
# pyright: reportOperatorIssue=false, reportGeneralTypeIssues=false, reportAssignmentType=false
# what is written here is Warp's own language: Python's types of it are no types of the kernels

# Warp reads the annotations of kernels: they must not become strings
import warp as wp

from fluidlift.backends.warp_faces import Faces, cell_or, face, is_face, put, step
from fluidlift.physics import free_surface as cpu
from fluidlift.types import CellType

wp.set_module_options({"enable_backward": False})

EMPTY = wp.constant(int(CellType.EMPTY))
FLUID = wp.constant(int(CellType.FLUID))
INFLOW = wp.constant(int(CellType.INFLOW))
SOLID = wp.constant(int(CellType.SOLID))
OUTFLOW = wp.constant(int(CellType.OUTFLOW))
SPRAY_DEPTH = wp.constant(float(cpu.SPRAY_DEPTH))
SKIN = wp.constant(float(cpu.SKIN))
SMALLEST_GAP = wp.constant(float(cpu.SMALLEST_GAP))
ENCLOSED = wp.constant(5)
"""of six neighbours hold liquid or are solid around a sampling gap"""
LIQUID_BESIDE = wp.constant(3)


@wp.func
def holds_particles(counts: wp.array(dtype=int), solid: wp.array3d(dtype=wp.uint8), i: int, j: int, k: int):
    """Whether a cell that is not solid holds particles; beyond the sides of the box none does."""
    if cell_or(solid, i, j, k, 1) != 0:
        return 0
    return wp.where(counts[(i * solid.shape[1] + j) * solid.shape[2] + k] > 0, 1, 0)


@wp.kernel
def fill_gaps(counts: wp.array(dtype=int), solid: wp.array3d(dtype=wp.uint8), full: wp.array3d(dtype=wp.uint8)):
    """`full`: cells that hold particles, and single empty cells that they enclose."""
    i, j, k = wp.tid()
    if holds_particles(counts, solid, i, j, k) == 1:
        full[i, j, k] = wp.uint8(1)
        return
    full[i, j, k] = wp.uint8(0)
    if solid[i, j, k] != wp.uint8(0):
        return
    around, liquid = int(0), int(0)
    for axis in range(3):
        s = step(axis)
        for side in range(2):
            sign = 2 * side - 1
            a, b, c = i + sign * s[0], j + sign * s[1], k + sign * s[2]
            wet = holds_particles(counts, solid, a, b, c)
            liquid += wet
            around += wp.max(wet, cell_or(solid, a, b, c, 0))
    if around >= ENCLOSED and liquid >= LIQUID_BESIDE:
        full[i, j, k] = wp.uint8(1)


@wp.func
def passage(openings: Faces, axis: int, side: int, i: int, j: int, k: int):
    """Opening between a cell and its neighbour along an axis, on its low (0) or high (1) side."""
    s = step(axis)
    return face(openings, axis, i + side * s[0], j + side * s[1], k + side * s[2])


@wp.kernel
def holding_cells(
    full: wp.array3d(dtype=wp.uint8),
    regions: wp.array3d(dtype=wp.uint8),
    buried: wp.array3d(dtype=wp.uint8),
    openings: Faces,
    holding: wp.array3d(dtype=wp.uint8),
):
    """See `boundaries.liquid_cells`: FLUID also in slivers of open space above the bed that lie beside liquid."""
    i, j, k = wp.tid()
    own = int(regions[i, j, k])
    if own == EMPTY:
        fluid = bool(full[i, j, k] != wp.uint8(0))
        if not fluid and buried[i, j, k] != wp.uint8(0):
            for axis in range(3):
                s = step(axis)
                for side in range(2):
                    sign = 2 * side - 1
                    beside = cell_or(full, i + sign * s[0], j + sign * s[1], k + sign * s[2], 0)
                    if beside != 0 and passage(openings, axis, side, i, j, k) > 0.0:
                        fluid = True
        if fluid:
            own = FLUID
    holding[i, j, k] = wp.uint8(own)


@wp.func
def deep_liquid(types: wp.array3d(dtype=wp.uint8), distance: wp.array3d(dtype=float), i: int, j: int, k: int):
    """Whether a cell holds liquid and has its centre below the surface."""
    own = cell_or(types, i, j, k, EMPTY)
    return own != EMPTY and own != SOLID and distance[i, j, k] < 0.0


@wp.func
def beside_liquid(
    types: wp.array3d(dtype=wp.uint8), distance: wp.array3d(dtype=float), openings: Faces, i: int, j: int, k: int
):
    """Whether an open face joins a cell with deep liquid."""
    out = bool(False)
    for axis in range(3):
        s = step(axis)
        for side in range(2):
            sign = 2 * side - 1
            deep = deep_liquid(types, distance, i + sign * s[0], j + sign * s[1], k + sign * s[2])
            if deep and passage(openings, axis, side, i, j, k) > 0.0:
                out = True
    return out


@wp.kernel
def fill_below_surface(
    holding: wp.array3d(dtype=wp.uint8),
    distance: wp.array3d(dtype=float),
    openings: Faces,
    out: wp.array3d(dtype=wp.uint8),
):
    """EMPTY cells beside liquid whose centre lies below the surface become FLUID: gaps between particles."""
    i, j, k = wp.tid()
    own = int(holding[i, j, k])
    if own == EMPTY and distance[i, j, k] < 0.0 and beside_liquid(holding, distance, openings, i, j, k):
        own = FLUID
    out[i, j, k] = wp.uint8(own)


@wp.kernel
def pressure_cells(
    holding: wp.array3d(dtype=wp.uint8),
    filled: wp.array3d(dtype=wp.uint8),
    surface: wp.array3d(dtype=float),
    openings: Faces,
    buried: wp.array3d(dtype=wp.uint8),
    counts: wp.array(dtype=int),
    spacing: float,
    types: wp.array3d(dtype=wp.uint8),
    distance: wp.array3d(dtype=float),
    wet: wp.array3d(dtype=wp.uint8),
):
    """The skin of the liquid becomes air, spray and slivers above the bed stay liquid, with a distance inside it."""
    i, j, k = wp.tid()
    own, held = int(filled[i, j, k]), int(holding[i, j, k])
    d = float(surface[i, j, k])
    spray = -SPRAY_DEPTH * spacing
    if own == FLUID and d >= 0.0 and d < SKIN * spacing and beside_liquid(filled, surface, openings, i, j, k):
        own = EMPTY
    if own == FLUID and d >= 0.0:
        d = spray
    if held == FLUID and buried[i, j, k] != wp.uint8(0) and own != FLUID:
        # p = 0 in a sliver of open space above the bed would suck the liquid into it
        own = FLUID
        d = wp.min(d, spray)
    types[i, j, k] = wp.uint8(own)
    distance[i, j, k] = d
    here = counts[(i * types.shape[1] + j) * types.shape[2] + k] > 0
    full = own != EMPTY and own != SOLID and (own != OUTFLOW or here)
    wet[i, j, k] = wp.where(full, wp.uint8(1), wp.uint8(0))


@wp.kernel
def surface_gaps(shape: wp.vec3i, distance: wp.array3d(dtype=float), types: wp.array3d(dtype=wp.uint8), gaps: Faces):
    """Cells from the centre of a FLUID cell to the surface on the way to an EMPTY one; 1 on all other faces."""
    axis, i, j, k = wp.tid()
    if not is_face(shape, axis, i, j, k):
        return
    s = step(axis)
    a, b, c = i - s[0], j - s[1], k - s[2]
    gap = float(1.0)
    low, high = cell_or(types, a, b, c, -1), cell_or(types, i, j, k, -1)
    if low >= 0 and high >= 0:
        d, e = distance[a, b, c], distance[i, j, k]
        if low == FLUID and high == EMPTY and e > 0.0:
            gap = wp.clamp(d / (d - e), SMALLEST_GAP, 1.0)
        if high == FLUID and low == EMPTY and d > 0.0:
            gap = wp.clamp(e / (e - d), SMALLEST_GAP, 1.0)
    put(gaps, axis, i, j, k, gap)


@wp.kernel
def outlet_heads(
    regions: wp.array3d(dtype=wp.uint8),
    wet: wp.array3d(dtype=wp.uint8),
    buried: wp.array3d(dtype=wp.uint8),
    openings: Faces,
    distance: wp.array3d(dtype=float),
    start: wp.array2d(dtype=float),
    first: wp.vec2i,
    lowest: float,
    spacing: float,
    weight: float,
    known: wp.array3d(dtype=float),
):
    """q (m^2/s) in OUTFLOW cells of columns of liquid that stand on the ground, one thread per column; else 0.

    `start`: cells, the levels at the start above the bottom of the whole box (negative: none); `lowest`: cells from
    there to the bottom of the region; `weight`: q below 1 m of liquid.
    """
    i, j = wp.tid()
    nz = wet.shape[2]
    level, below, outlet = int(-1), bool(False), bool(False)
    for k in range(nz):
        outlet = outlet or int(regions[i, j, k]) == OUTFLOW
        grounded = below or openings.z[i, j, k] == 0.0
        stands = wet[i, j, k] != wp.uint8(0) and grounded
        if stands:
            level = k + 1
        below = stands or buried[i, j, k] != wp.uint8(0)
    stage = float(-1.0)
    if outlet and level >= 0:
        top = level - 1
        stage = float(top) + 0.5 - wp.clamp(distance[i, j, top] / spacing, -0.5, 0.5)
        at_start = start[first[0] + i, first[1] + j]
        if at_start >= 0.0:
            stage = wp.max(at_start - lowest, 0.0)
    for k in range(nz):
        head = float(0.0)
        if int(regions[i, j, k]) == OUTFLOW:
            head = wp.max(stage - (float(k) + 0.5), 0.0) * spacing
        known[i, j, k] = head * weight


@wp.kernel
def hold_columns(
    shape: wp.vec3i,
    regions: wp.array3d(dtype=wp.uint8),
    openings: Faces,
    known: wp.array3d(dtype=float),
    spacing: float,
    weight: float,
    velocity: Faces,
):
    """Subtract the gradient of the given q on open faces between OUTFLOW cells; `weight`: q below a cell of liquid."""
    axis, i, j, k = wp.tid()
    s = step(axis)
    a, b, c = i - s[0], j - s[1], k - s[2]
    if not is_face(shape, axis, i, j, k) or cell_or(regions, a, b, c, EMPTY) != OUTFLOW:
        return
    if cell_or(regions, i, j, k, EMPTY) != OUTFLOW or face(openings, axis, i, j, k) <= 0.0:
        return
    change = known[i, j, k] - known[a, b, c]
    if axis == 2 and weight > 0.0 and known[a, b, c] > 0.0 and known[i, j, k] == 0.0:
        change = -weight
    put(velocity, axis, i, j, k, face(velocity, axis, i, j, k) - change / spacing)
