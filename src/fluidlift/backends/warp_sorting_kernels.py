"""Warp kernels that keep particles in the order of their cells, take them out and let them in, split and merge (model:
`physics.transfer`, `physics.reseed`, `physics.outlet.surplus`).

Imported only by adapters that have found Warp.
"""

# pyright: reportArgumentType=false, reportCallIssue=false, reportIndexIssue=false, reportInvalidTypeForm=false
# pyright: reportOperatorIssue=false, reportGeneralTypeIssues=false, reportAssignmentType=false
# what is written here is Warp's own language: Python's types of it are no types of the kernels

# Warp reads the annotations of kernels: they must not become strings
import warp as wp

from fluidlift.backends.warp_faces import cell_or, step
from fluidlift.backends.warp_transfer_kernels import cell_number
from fluidlift.backends.warp_velocity_kernels import sampled
from fluidlift.physics import reseed as cpu
from fluidlift.physics.outlet import OVERFULL as CPU_OVERFULL
from fluidlift.types import CellType

wp.set_module_options({"enable_backward": False})

real = wp.float64
ONE = wp.constant(real(1.0))
OUTFLOW = wp.constant(int(CellType.OUTFLOW))
FEWEST = wp.constant(int(cpu.FEWEST))
MOST = wp.constant(int(cpu.MOST))
OVERFULL = wp.constant(real(CPU_OVERFULL))


@wp.struct
class State:
    """All that a particle has."""

    positions: wp.array(dtype=wp.vec3)
    velocities: wp.array(dtype=wp.vec3)
    affine: wp.array(dtype=wp.mat33)
    deformation: wp.array(dtype=wp.mat33)
    masses: wp.array(dtype=wp.float32)
    source: wp.array(dtype=wp.int64)
    ids: wp.array(dtype=wp.int64)


@wp.kernel
def number_particles(
    state: State,
    gone: wp.array(dtype=wp.uint8),
    low: wp.vec3,
    spacing: float,
    shape: wp.vec3i,
    keys: wp.array(dtype=int),
    order: wp.array(dtype=int),
    counts: wp.array(dtype=int),
):
    """Cell of each particle (one past the last for those that are gone), and how many each cell holds."""
    p = wp.tid()
    order[p] = p
    if gone[p] != wp.uint8(0):
        keys[p] = shape[0] * shape[1] * shape[2]
    else:
        cell = cell_number(state.positions[p], low, spacing, shape)
        keys[p] = cell
        wp.atomic_add(counts, cell, 1)


@wp.kernel
def number_ids(ids: wp.array(dtype=wp.int64), keys: wp.array(dtype=wp.int64), order: wp.array(dtype=int)):
    """Ids as keys to sort by, and the particles' own order."""
    p = wp.tid()
    keys[p] = ids[p]
    order[p] = p


@wp.kernel
def take(order: wp.array(dtype=int), old: State, out: State):
    """Particle order[n] of the old becomes particle n."""
    n = wp.tid()
    p = order[n]
    out.positions[n] = old.positions[p]
    out.velocities[n] = old.velocities[p]
    out.affine[n] = old.affine[p]
    out.deformation[n] = old.deformation[p]
    out.masses[n] = old.masses[p]
    out.source[n] = old.source[p]
    out.ids[n] = old.ids[p]


@wp.kernel
def kept_flags(gone: wp.array(dtype=wp.uint8), kept: wp.array(dtype=int)):
    """1 for each particle that stays."""
    p = wp.tid()
    kept[p] = wp.where(gone[p] == wp.uint8(0), 1, 0)


@wp.kernel
def kept_order(gone: wp.array(dtype=wp.uint8), places: wp.array(dtype=int), order: wp.array(dtype=int)):
    """`places`: inclusive sums of `kept_flags`; `order` then lists those that stay."""
    p = wp.tid()
    if gone[p] == wp.uint8(0):
        order[places[p] - 1] = p


@wp.kernel
def in_cells(
    positions: wp.array(dtype=wp.vec3),
    cells: wp.array3d(dtype=wp.uint8),
    low: wp.vec3d,
    spacing: wp.float64,
    gone: wp.array(dtype=wp.uint8),
):
    """1 for each particle in a marked cell; one outside the box counts for the nearest cell."""
    p = wp.tid()
    s = (wp.vec3d(positions[p]) - low) / spacing
    i = wp.clamp(int(wp.floor(s[0])), 0, cells.shape[0] - 1)
    j = wp.clamp(int(wp.floor(s[1])), 0, cells.shape[1] - 1)
    k = wp.clamp(int(wp.floor(s[2])), 0, cells.shape[2] - 1)
    gone[p] = cells[i, j, k]


@wp.func
def first_of(ends: wp.array(dtype=int), cell: int):
    """Where the particles of a cell begin."""
    if cell > 0:
        return int(ends[cell - 1])
    return 0


@wp.func
def sort_by_mass(index: wp.array(dtype=int), start: int, end: int, masses: wp.array(dtype=float)):
    """A part of a list, in place; equal ones stay in their order."""
    for n in range(start, end):
        own, m = int(index[n]), int(n)
        while m > start and masses[index[wp.max(m - 1, start)]] > masses[own]:
            index[m] = index[m - 1]
            m -= 1
        index[m] = own


@wp.kernel
def choose(
    ends: wp.array(dtype=int),
    solid: wp.array3d(dtype=wp.uint8),
    masses: wp.array(dtype=float),
    lightest: float,
    splits: wp.array(dtype=int),
    merges: wp.array(dtype=int),
):
    """For each inner cell: 1 where its heaviest particle is to split, and how many pairs are to merge."""
    i, j, k = wp.tid()
    cell = (i * solid.shape[1] + j) * solid.shape[2] + k
    start, end = first_of(ends, cell), int(ends[cell])
    split, merge, inner = int(0), int(0), bool(end > start)
    if inner:
        for axis in range(3):
            s = step(axis)
            for side in range(2):
                sign = 2 * side - 1
                a, b, c = i + sign * s[0], j + sign * s[1], k + sign * s[2]
                if cell_or(solid, a, b, c, 1) == 0:
                    beside = (a * solid.shape[1] + b) * solid.shape[2] + c
                    inner = inner and ends[beside] > first_of(ends, beside)
    if inner and end - start < FEWEST:
        heaviest = float(masses[start])
        for p in range(start + 1, end):
            heaviest = wp.max(heaviest, masses[p])
        split = wp.where(heaviest >= lightest, 1, 0)
    elif inner and end - start > MOST:
        merge = (end - start - MOST + 1) / 2
    splits[cell] = split
    merges[cell] = merge


@wp.kernel
def merge_pairs(
    ends: wp.array(dtype=int),
    merges: wp.array(dtype=int),
    by_mass: wp.array(dtype=int),
    state: State,
    gone: wp.array(dtype=wp.uint8),
):
    """The lightest particles of a crowded cell merge in pairs, the heavier of each keeps its name."""
    cell = wp.tid()
    pairs = merges[cell]
    if pairs == 0:
        return
    start, end = first_of(ends, cell), ends[cell]
    for p in range(start, end):
        by_mass[p] = p
    sort_by_mass(by_mass, start, end, state.masses)
    for pair in range(pairs):
        light, heavy = by_mass[start + 2 * pair], by_mass[start + 2 * pair + 1]
        a, b = real(state.masses[heavy]), real(state.masses[light])
        share = b / (a + b)
        x = (ONE - share) * wp.vec3d(state.positions[heavy]) + share * wp.vec3d(state.positions[light])
        v = (ONE - share) * wp.vec3d(state.velocities[heavy]) + share * wp.vec3d(state.velocities[light])
        c = (ONE - share) * wp.mat33d(state.affine[heavy]) + share * wp.mat33d(state.affine[light])
        state.positions[heavy] = wp.vec3(x)
        state.velocities[heavy] = wp.vec3(v)
        state.affine[heavy] = wp.mat33(c)
        state.masses[heavy] = float(a + b)
        gone[light] = wp.uint8(1)


@wp.func
def is_free(x: wp.vec3d, distance: wp.array3d(dtype=float), low: wp.vec3d, high: wp.vec3d, spacing: real, clear: real):
    """Whether a particle may be put there: in the box and out of the solid."""
    out = sampled(distance, (x - low) / spacing) > clear
    for a in range(3):
        out = out and x[a] >= low[a] + clear and x[a] < high[a] - clear
    return out


@wp.kernel
def split_parents(
    ends: wp.array(dtype=int),
    splits: wp.array(dtype=int),
    ranks: wp.array(dtype=int),
    directions: wp.array(dtype=wp.vec3d),
    distance: wp.array3d(dtype=float),
    low: wp.vec3d,
    high: wp.vec3d,
    spacing: wp.float64,
    reach: wp.float64,
    clear: wp.float64,
    count: int,
    state: State,
    gone: wp.array(dtype=wp.uint8),
    fits: wp.array(dtype=int),
):
    """The heaviest particle of a thin cell splits; its other half is written to place `count` + rank.

    `ranks`: inclusive sums of `splits`. Where a half would lie in the solid nothing changes, and that place is gone.
    """
    cell = wp.tid()
    if splits[cell] == 0:
        return
    start, end = first_of(ends, cell), ends[cell]
    p = wp.int32(start)
    for n in range(start + 1, end):
        if state.masses[n] > state.masses[p]:
            p = n
    rank = ranks[cell] - 1
    child = count + rank
    shift = reach * directions[rank]
    x = wp.vec3d(state.positions[p])
    if not (
        is_free(x + shift, distance, low, high, spacing, clear)
        and is_free(x - shift, distance, low, high, spacing, clear)
    ):
        fits[rank] = 0
        gone[child] = wp.uint8(1)
        return
    fits[rank] = 1
    gone[child] = wp.uint8(0)
    gained = wp.mat33d(state.affine[p]) * shift
    v, half = wp.vec3d(state.velocities[p]), 0.5 * float(state.masses[p])
    state.masses[p] = half
    state.positions[p] = wp.vec3(x + shift)
    state.velocities[p] = wp.vec3(v + gained)
    state.masses[child] = half
    state.positions[child] = wp.vec3(x - shift)
    state.velocities[child] = wp.vec3(v - gained)
    state.affine[child] = state.affine[p]
    state.deformation[child] = state.deformation[p]
    state.source[child] = state.source[p]


@wp.kernel
def name_children(
    fits: wp.array(dtype=int),
    places: wp.array(dtype=int),
    count: int,
    first_id: wp.int64,
    ids: wp.array(dtype=wp.int64),
):
    """Ids of the children that fit, in their order; `places`: inclusive sums of `fits`."""
    n = wp.tid()
    if fits[n] == 1:
        ids[count + n] = first_id + wp.int64(places[n] - 1)


@wp.kernel
def mark_surplus(
    regions: wp.array3d(dtype=wp.uint8),
    ends: wp.array(dtype=int),
    masses: wp.array(dtype=float),
    full: wp.float64,
    scratch: wp.array(dtype=int),
    gone: wp.array(dtype=wp.uint8),
):
    """Particles that OUTFLOW cells hold beyond `OVERFULL`, the heaviest first: clumps merge."""
    i, j, k = wp.tid()
    if int(regions[i, j, k]) != OUTFLOW:
        return
    cell = (i * regions.shape[1] + j) * regions.shape[2] + k
    start, end = first_of(ends, cell), ends[cell]
    held, most = real(0.0), OVERFULL * full
    for p in range(start, end):
        held += real(masses[p])
    if held <= most:
        return
    for n in range(start, end):
        scratch[n] = end - 1 - (n - start)
    sort_by_mass(scratch, start, end, masses)
    n = wp.int32(end - 1)
    while n >= start and held > most:
        p = scratch[n]
        gone[p] = wp.uint8(1)
        held -= real(masses[p])
        n -= 1
