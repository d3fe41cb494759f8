"""Reconstruction of the free surface (a level set) from particles, to a few hundredths of a cell.

The volumes of the particles, shared among cells by quadratic splines and smoothed by a binomial filter, are the fill F
around each cell centre: the liquid's shape blurred with variance s^2 = 3/4 h^2. At the distance d from a flat surface
F = erfc(d / (sqrt(2) s)) / 2, which gives d. Where the surface is curved, the blur moves it by s^2 / 2 times the sum of
its principal curvatures, which is taken back. Volumes count, not numbers, so particles may differ in mass.

There are no particles in solids. The liquid is continued into them by its distance, linearly, so that a level surface
stays level up to a sloping bed, and this virtual liquid counts in F (the variational method of Batty, Bertails and
Bridson 2007 wants the liquid extended into the solid). The sides of the box mirror the liquid.

Averaged spheres (Zhu and Bridson 2005) were measured beside it: three times as noisy, and 0.04 to 0.1 cells too low.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from fluidlift.errors import require
from fluidlift.physics import boundaries, surface_kernels
from fluidlift.physics.transfer import CellOrder
from fluidlift.types import CellType, FaceVelocity, Grid

Faces = tuple[np.ndarray, np.ndarray, np.ndarray]
"""one array per axis: [nx+1,ny,nz], [nx,ny+1,nz], [nx,ny,nz+1]"""

BAND = 1.5
"""cells: distances are cut there; farther away the noise of the fill outweighs them"""
LAYERS = 3
"""of cells into the solid that virtual liquid may fill"""
ROUNDS = 3
"""how often the virtual liquid in solids is improved; what is left are some hundredths of a cell"""
SMOOTHINGS = 2
"""binomial filters before the curvature is taken: its noise on a flat surface becomes 0.01 / h"""
MORE_SMOOTHINGS = 2
"""binomial filters more, to find out what smoothing takes from the curvature"""
SPRAY_DEPTH = 0.1
"""cells: how deep in the liquid the centres of cells of spray count"""
SKIN = 0.75
"""cells: farther above the surface no partly filled cell has its centre (0.5 where level, 0.87 at a corner)"""
SMALLEST_GAP = 1e-3
"""cells: a surface nearer to the centre of a cell is put there. The solver does not mind (3 iterations, as with 0.25),
but the water does: with 0.05 a pool at rest in a tilted box moves at 0.05 m/s and more, with this at 0.01 m/s"""
SURE_OPENING = 0.25
"""open share of faces whose velocity is continued beyond the liquid. Particles hardly reach what is below it: its
velocity is extrapolated by their affine matrices, and fed back to them it would grow"""


@dataclass(frozen=True)
class SolidShares:
    """How much of the spline around each cell centre is solid."""

    open_share: Float[np.ndarray, "nx ny nz"]
    """0 (solid) to 1"""
    layer: UInt8[np.ndarray, "nx ny nz"]
    """0: open; 1: mostly open; 2: more solid, beside one of 0 or 1; 3: beside one of 2; ...; `LAYERS` + 1: deep"""
    clear: Float[np.ndarray, "nx ny nz"]
    """0 within a cell of a wall, where no curvature is taken back, to 1 at three cells from it"""

    def inside(self, box: tuple[slice, slice, slice]) -> SolidShares:
        """Those of a box of cells."""
        return SolidShares(*(np.ascontiguousarray(a[box]) for a in (self.open_share, self.layer, self.clear)))


@dataclass(frozen=True)
class LiquidSurface:
    """The surface of the liquid, at cell centres."""

    distance: Float[np.ndarray, "nx ny nz"]
    """m, negative inside the liquid, within `BAND` cells of the surface; continued into solids"""
    curvature: Float[np.ndarray, "nx ny nz"] | None
    """1/m, sum of the principal curvatures (2 / R for a drop), 0 away from the surface; None where not asked for"""


def solid_shares(signed_distance: Float[np.ndarray, "nx+1 ny+1 nz+1"], grid: Grid) -> SolidShares:
    """Prepare the search for the surface: once for solids at rest, again when they have moved.

    Args:
        signed_distance: m, at the nodes, positive outside the solid.
        grid: of the simulation.

    Raises:
        ValueError: a distance of the wrong shape.
    """
    nodes = np.ascontiguousarray(signed_distance, np.float32)
    require(nodes.shape == tuple(n + 1 for n in grid.shape), f"distance {nodes.shape}", "one value per node")
    volume, share = np.empty(grid.shape, np.float32), np.empty(grid.shape, np.float32)
    surface_kernels.open_volumes(nodes, grid.low, grid.spacing, volume)
    # the spline is the cell's box, blurred with the variance 1/6
    surface_kernels.three_point(volume, 1.0 / 12.0, share)
    reached = share > 0.5
    layer = np.where(reached, np.where(share > 0.999, 0, 1), LAYERS + 1).astype(np.uint8)
    for number in range(2, LAYERS + 1):
        wider = ndimage.binary_dilation(reached, np.ones((3, 3, 3), bool))
        layer[wider & ~reached] = number
        reached = wider
    wide = share
    for _ in range(SMOOTHINGS + 1):
        wide = _binomial(wide)
    return SolidShares(share, layer, np.maximum(1.0 - 4.0 * (1.0 - wide), 0.0).astype(np.float32))


def liquid_surface(
    positions: Float[np.ndarray, "n 3"],
    volumes: Float[np.ndarray, " n"],
    grid: Grid,
    order: CellOrder,
    solids: SolidShares,
    *,
    curved: bool = False,
) -> LiquidSurface:
    """The surface around the particles.

    Args:
        positions: m, inside the box.
        volumes: m^3, mass / density of each particle.
        grid: of the simulation.
        order: from `transfer.sort_by_cell`.
        solids: from `solid_shares`.
        curved: find the curvature, too (for surface tension).

    Drops and sheets thinner than about 1.2 cells reach F = 1/2 nowhere: their distance is positive everywhere (see
    `pressure_cells`).

    Raises:
        ValueError: arrays of the wrong shape.
    """
    require(solids.layer.shape == grid.shape, f"solid shares {solids.layer.shape}", str(grid.shape))
    require(volumes.shape == (len(positions),), f"volumes {volumes.shape}", str((len(positions),)))
    nx, ny, nz = grid.shape
    share = np.zeros(grid.shape, np.float32)
    amounts = np.asarray(volumes / grid.spacing**3, np.float32)
    slab_start = order.start[np.minimum(np.arange(0, nx + surface_kernels.SLAB, surface_kernels.SLAB), nx) * ny * nz]
    points = np.ascontiguousarray(positions, np.float32)
    surface_kernels.deposit(points, amounts, order.order, slab_start, grid.low, grid.spacing, share)
    fill = _fill(share, solids)
    smooth = fill
    for _ in range(SMOOTHINGS):
        smooth = _binomial(smooth)
    bend = mean_curvature(fill, smooth)
    distance = np.empty_like(fill)
    surface_kernels.distance(fill, bend * solids.clear, BAND, distance)
    h = np.float32(grid.spacing)
    if curved:
        bend = _sharpened(bend, fill, smooth)
    return LiquidSurface(distance * h, bend / h if curved else None)


def _binomial(field: np.ndarray) -> np.ndarray:
    out = np.empty_like(field)
    surface_kernels.three_point(field, 0.25, out)
    return out


def _fill(share: Float[np.ndarray, "nx ny nz"], solids: SolidShares) -> Float[np.ndarray, "nx ny nz"]:
    """Share of liquid around each cell centre, virtual liquid in solids included, from the deposited shares."""
    fill = _binomial(share)
    layer, open_share = solids.layer, solids.open_share
    if not layer.any():
        return fill
    around = _binomial(open_share)
    virtual = np.where((layer > 0) & (around > 0.05), np.minimum(fill / np.maximum(around, 0.05), 1.0), 0.0)
    virtual = virtual.astype(np.float32)
    distance, normal = np.zeros_like(share), np.zeros((*share.shape, 3), np.float32)
    for _ in range(ROUNDS):
        fill = _binomial(share + (1.0 - open_share) * virtual)
        for want in range(1, LAYERS + 1):
            surface_kernels.continue_into_solid(layer, want, open_share, fill, distance, normal)
        surface_kernels.fill_solid(layer, LAYERS, open_share, distance, normal, virtual)
    return _binomial(share + (1.0 - open_share) * virtual)


def mean_curvature(
    fill: Float[np.ndarray, "nx ny nz"], smooth: Float[np.ndarray, "nx ny nz"]
) -> Float[np.ndarray, "nx ny nz"]:
    """Sum of the principal curvatures (1 / cells, at most 1) of the smoothed fill, near the surface; 0 elsewhere."""
    out = np.empty_like(smooth)
    surface_kernels.curvature(smooth, fill, out)
    return out


def _sharpened(bend: np.ndarray, fill: np.ndarray, smooth: np.ndarray) -> np.ndarray:
    """Curvature without what the blur takes from it.

    A bent surface becomes flatter in proportion to the variance of the blur: the values of two blurs are extrapolated
    to none. A drop of 4 cells' radius would swing 20 % too slowly without that, 9 % with it.
    """
    for _ in range(MORE_SMOOTHINGS):
        smooth = _binomial(smooth)
    gain = (surface_kernels.VARIANCE + 0.5 * SMOOTHINGS) / (0.5 * MORE_SMOOTHINGS)
    largest = surface_kernels.LARGEST_CURVATURE
    return np.clip(bend + np.float32(gain) * (bend - mean_curvature(fill, smooth)), -largest, largest)


def _beside_liquid(types: np.ndarray, below: np.ndarray, openings: Faces) -> np.ndarray:
    """Cells joined through an open face with one that holds liquid and has its centre below the surface."""
    inside = below & ((types == CellType.FLUID) | (types == CellType.INFLOW) | (types == CellType.OUTFLOW))
    out = np.zeros(types.shape, bool)
    for axis, opening in enumerate(openings):
        here, there = np.moveaxis(inside, axis, 0), np.moveaxis(out, axis, 0)
        passable = np.moveaxis(opening, axis, 0)[1:-1] > 0
        there[1:] |= passable & here[:-1]
        there[:-1] |= passable & here[1:]
    return out


def pressure_cells(
    types: UInt8[np.ndarray, "nx ny nz"],
    distance: Float[np.ndarray, "nx ny nz"],
    openings: Faces,
    spacing: float,
) -> tuple[UInt8[np.ndarray, "nx ny nz"], Float[np.ndarray, "nx ny nz"]]:
    """Which cells have a pressure of their own, and the distance that goes with them.

    A FLUID cell whose centre lies above the surface of liquid beside it is the liquid's skin: it holds particles but
    counts as air (EMPTY), since p = 0 lies below its centre. Without such a neighbour it is spray or a thin film, which
    stays FLUID. EMPTY cells beside liquid whose centre lies below the surface are gaps between particles: FLUID.

    Args:
        types: from `boundaries.liquid_cells`.
        distance: of `LiquidSurface`, m.
        openings: open share of the faces.
        spacing: cell width, m.

    Returns:
        the types, and the distance, negative in all FLUID cells (-`SPRAY_DEPTH` cells in spray).
    """
    below = distance < 0
    new = types.copy()
    new[(types == CellType.EMPTY) & below & _beside_liquid(types, below, openings)] = CellType.FLUID
    near = ~below & (distance < SKIN * spacing)
    new[(types == CellType.FLUID) & near & _beside_liquid(new, below, openings)] = CellType.EMPTY
    spray = (new == CellType.FLUID) & ~below
    return new, np.where(spray, np.float32(-SPRAY_DEPTH * spacing), distance)


def surface_gaps(distance: Float[np.ndarray, "nx ny nz"], types: UInt8[np.ndarray, "nx ny nz"]) -> Faces:
    """Cells from the centre of a FLUID cell to the surface on the way to an EMPTY one; 1 on all other faces.

    Args:
        distance: from `pressure_cells`, m.
        types: from `pressure_cells`.
    """
    liquid, air = types == CellType.FLUID, (types == CellType.EMPTY) & (distance > 0)
    out = []
    for axis in range(3):
        gap = np.ones(tuple(n + (a == axis) for a, n in enumerate(types.shape)), np.float32)
        inner = np.moveaxis(gap, axis, 0)[1:-1]
        d, wet, dry = (np.moveaxis(f, axis, 0) for f in (distance, liquid, air))
        for one, other in ((slice(None, -1), slice(1, None)), (slice(1, None), slice(None, -1))):
            surface = wet[one] & dry[other]
            a, b = d[one][surface], d[other][surface]
            inner[surface] = np.clip(a / (a - b), SMALLEST_GAP, 1.0)
        out.append(gap)
    return tuple(out)


def continue_velocity(
    velocity: FaceVelocity, carried: FaceVelocity, masses: Faces, wet: Faces, skin: Bool[np.ndarray, "nx ny nz"],
    openings: Faces,
) -> FaceVelocity:  # fmt: skip
    """The velocity of the liquid continued into its skin and the air.

    In the skin the particles' own velocity takes part in what forces and pressure do to the liquid beside it: so the
    skin of a pool at rest does not fall, a spinning body is not braked, and a drop keeps its momentum until it is in.

    Args:
        velocity: after the projection, m/s.
        carried: from the particles, before forces and pressure.
        masses: of the faces, from `transfer.particles_to_grid`.
        wet: bool, open faces of cells of liquid.
        skin: cells that `pressure_cells` made EMPTY.
        openings: open share of the faces.
    """
    fields, sources, kept = [], [], []
    for axis, beside in enumerate(boundaries.touching_faces(skin)):
        new = velocity.components[axis]
        field, known = np.empty_like(new), np.empty(new.shape, bool)
        valid = wet[axis] & (openings[axis] >= SURE_OPENING)
        surface_kernels.carry(
            new, carried.components[axis], masses[axis], wet[axis], beside, openings[axis], valid, field, known
        )
        fields.append(field)
        kept.append(known)
        sources.append(known & (openings[axis] >= SURE_OPENING))
    continued = boundaries.extrapolate(FaceVelocity(*fields), tuple(sources))
    return FaceVelocity(*(np.where(k, f, c) for k, f, c in zip(kept, fields, continued.components)))
