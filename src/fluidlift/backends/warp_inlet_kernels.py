"""Warp kernels that find where an inlet lacks particles, and count what the host reports (model: `physics.inlet`).

Imported only by adapters that have found Warp.
"""

# pyright: reportArgumentType=false, reportCallIssue=false, reportIndexIssue=false, reportInvalidTypeForm=false
# pyright: reportOperatorIssue=false, reportGeneralTypeIssues=false, reportAssignmentType=false
# what is written here is Warp's own language: Python's types of it are no types of the kernels

# Warp reads the annotations of kernels: they must not become strings
import warp as wp

from fluidlift.backends.warp_faces import cell_or
from fluidlift.backends.warp_velocity_kernels import sampled
from fluidlift.types import CellType

wp.set_module_options({"enable_backward": False})

real = wp.float64
EMPTY = wp.constant(int(CellType.EMPTY))
INFLOW = wp.constant(int(CellType.INFLOW))


@wp.struct
class Lattice:
    """Of `physics.inlet.InletLattice`, and the box around it."""

    start: wp.vec3d
    spacing: wp.float64
    first: wp.vec3i
    counts: wp.vec3i
    along: int
    turns: wp.vec3d
    phases: wp.vec2d
    reach: wp.float64
    clear: wp.float64
    low: wp.vec3d
    """m, of the box whose particles count; its bins are `reach` wide"""
    bins: wp.vec3i
    grid_low: wp.vec3d
    grid_high: wp.vec3d
    grid_spacing: wp.float64


@wp.func
def bin_of(lattice: Lattice, x: wp.vec3d):
    """Indices of the bin that holds a place; perhaps outside of all."""
    s = (x - lattice.low) / lattice.reach
    return wp.vec3i(int(wp.floor(s[0])), int(wp.floor(s[1])), int(wp.floor(s[2])))


@wp.func
def bin_number(lattice: Lattice, i: int, j: int, k: int):
    """-1 outside."""
    if i < 0 or j < 0 or k < 0 or i >= lattice.bins[0] or j >= lattice.bins[1] or k >= lattice.bins[2]:
        return -1
    return (i * lattice.bins[1] + j) * lattice.bins[2] + k


@wp.kernel
def put_in_bins(
    lattice: Lattice, positions: wp.array(dtype=wp.vec3), heads: wp.array(dtype=int), others: wp.array(dtype=int)
):
    """Chains of the particles of each bin: `heads` (-1: none) and what follows each."""
    p = wp.tid()
    b = bin_of(lattice, wp.vec3d(positions[p]))
    number = bin_number(lattice, b[0], b[1], b[2])
    if number >= 0:
        others[p] = wp.atomic_exch(heads, number, p)


@wp.func
def is_lacking(
    lattice: Lattice,
    x: wp.vec3d,
    regions: wp.array3d(dtype=wp.uint8),
    distance: wp.array3d(dtype=float),
    positions: wp.array(dtype=wp.vec3),
    heads: wp.array(dtype=int),
    others: wp.array(dtype=int),
):
    """Whether a place is in the inlet, out of the solid and away from all particles."""
    s = (x - lattice.grid_low) / lattice.grid_spacing
    for a in range(3):
        if x[a] < lattice.grid_low[a] or x[a] >= lattice.grid_high[a]:
            return False
    if cell_or(regions, int(wp.floor(s[0])), int(wp.floor(s[1])), int(wp.floor(s[2])), EMPTY) != INFLOW:
        return False
    if sampled(distance, s) <= lattice.clear:
        return False
    b = bin_of(lattice, x)
    for i in range(b[0] - 1, b[0] + 2):
        for j in range(b[1] - 1, b[1] + 2):
            for k in range(b[2] - 1, b[2] + 2):
                number = bin_number(lattice, i, j, k)
                p = wp.int32(-1)
                if number >= 0:
                    p = heads[number]
                while p >= 0:
                    if wp.length_sq(wp.vec3d(positions[p]) - x) < lattice.reach * lattice.reach:
                        return False
                    p = others[p]
    return True


@wp.kernel
def find_lacking(
    lattice: Lattice,
    regions: wp.array3d(dtype=wp.uint8),
    distance: wp.array3d(dtype=float),
    positions: wp.array(dtype=wp.vec3),
    heads: wp.array(dtype=int),
    others: wp.array(dtype=int),
    places: wp.array(dtype=wp.vec3d),
    lacking: wp.array(dtype=int),
):
    """The places of the lattice, in their order, and 1 for each that lacks a particle."""
    i, j, k = wp.tid()
    n = (i * lattice.counts[1] + j) * lattice.counts[2] + k
    index = wp.vec3d(real(i + lattice.first[0]), real(j + lattice.first[1]), real(k + lattice.first[2]))
    x = lattice.start + lattice.spacing * index
    back = index - lattice.turns
    phase = real(0.0)
    if lattice.along == 0:
        phase = back[1] * lattice.phases[0] + back[2] * lattice.phases[1]
    elif lattice.along == 1:
        phase = back[0] * lattice.phases[0] + back[2] * lattice.phases[1]
    else:
        phase = back[0] * lattice.phases[0] + back[1] * lattice.phases[1]
    x[lattice.along] = x[lattice.along] + lattice.spacing * (phase - wp.floor(phase))
    places[n] = x
    lacking[n] = wp.where(is_lacking(lattice, x, regions, distance, positions, heads, others), 1, 0)


@wp.kernel
def take_lacking(
    places: wp.array(dtype=wp.vec3d),
    lacking: wp.array(dtype=int),
    ranks: wp.array(dtype=int),
    out: wp.array(dtype=wp.vec3d),
):
    """The places that lack a particle, close together; `ranks`: inclusive sums of `lacking`."""
    n = wp.tid()
    if lacking[n] == 1:
        out[ranks[n] - 1] = places[n]


@wp.kernel
def fill_emitter(
    cells: wp.array(dtype=wp.vec3i),
    first: wp.vec3i,
    holding: wp.array3d(dtype=wp.uint8),
    types: wp.array3d(dtype=wp.uint8),
    wet: wp.array3d(dtype=wp.uint8),
):
    """Cells (of the whole box) become INFLOW, and wet."""
    c = cells[wp.tid()] - first
    holding[c[0], c[1], c[2]] = wp.uint8(INFLOW)
    types[c[0], c[1], c[2]] = wp.uint8(INFLOW)
    wet[c[0], c[1], c[2]] = wp.uint8(1)


@wp.kernel
def carry_emitter(
    distance: wp.array3d(dtype=float),
    low: wp.vec3d,
    high: wp.vec3d,
    spacing: wp.float64,
    velocity: wp.vec3,
    positions: wp.array(dtype=wp.vec3),
    velocities: wp.array(dtype=wp.vec3),
    affine: wp.array(dtype=wp.mat33),
):
    """Particles where a distance is negative move with a velocity."""
    p = wp.tid()
    x = wp.vec3d(positions[p])
    inside = x[0] > low[0] and x[1] > low[1] and x[2] > low[2]
    inside = inside and x[0] < high[0] and x[1] < high[1] and x[2] < high[2]
    if inside and sampled(distance, (x - low) / spacing) < real(0.0):
        velocities[p] = velocity
        affine[p] = wp.mat33(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@wp.kernel
def add_up(count: int, lanes: int, masses: wp.array(dtype=float), sums: wp.array(dtype=wp.float64)):
    """Per lane: a part of the sum."""
    lane = wp.tid()
    total = wp.float64(0.0)
    p = wp.int32(lane)
    while p < count:
        total += wp.float64(masses[p])
        p += lanes
    sums[lane] = total


@wp.kernel
def count_filled(count: int, lanes: int, counts: wp.array(dtype=int), sums: wp.array(dtype=int)):
    """Per lane: how many numbers are above 0."""
    lane = wp.tid()
    total = wp.int32(0)
    p = wp.int32(lane)
    while p < count:
        if counts[p] > 0:
            total += 1
        p += lanes
    sums[lane] = total
