"""Pressure projection to a divergence-free face velocity, with cut cells (paper: `eq::v`, first term; `divProj`).

With q = p dt / density (m^2/s) the projection solves -div(w grad q) = -div(w v) and subtracts grad q from the open
faces. w is the open fraction of each face, after Batty, Bertails and Bridson 2007, "A fast variational framework
for accurate solid-fluid coupling"; the closed share of a face moves with the solid.

Between liquid and air q is known at the surface, a share `gap` of a cell away from the liquid cell's centre, and not
at the centre of the cell of air: ghost fluid, second order (Gibou et al. 2002, "A second-order-accurate symmetric
discretization of the Poisson equation on irregular domains"; Enright et al. 2003). It stays symmetric: the weight of
such a face is w / gap. Surface tension enters as a jump of q there (Kang, Fedkiw, Liu 2000).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fluidlift.errors import require
from fluidlift.numerics.poisson import LowRankTerm, PoissonSystem, solve
from fluidlift.physics.boundaries import face_fractions
from fluidlift.physics.pressure_kernels import accelerated, outflow
from fluidlift.types import CellType, FaceVelocity, Grid, SolveReport, Terrain, triple

Faces = tuple[np.ndarray, np.ndarray, np.ndarray]
"""one array per axis: [nx+1,ny,nz], [nx,ny+1,nz], [nx,ny,nz+1]"""

NO_GAP = np.zeros((0, 0, 0), np.float32)
"""the surface passes through the centres of the cells of air"""


@dataclass(frozen=True)
class PressureSystem(PoissonSystem):
    """A Poisson system that also knows which share of each face lets fluid through.

    The two differ where a velocity is prescribed (inflow: weight 0, since pressure must not change it, but open), and
    at the surface of a liquid where it lies nearer than the centre of the cell of air: weight = opening / gap.
    """

    open_x: Float[np.ndarray, "nx+1 ny nz"]
    """0 (wall) to 1 (open), prescribed faces included"""
    open_y: Float[np.ndarray, "nx ny+1 nz"]
    open_z: Float[np.ndarray, "nx ny nz+1"]
    gap_x: Float[np.ndarray, "nx+1 ny nz"] | None = None
    """cells from the liquid cell's centre to the surface, in (0, 1]; 1 away from the surface; None: 1 everywhere"""
    gap_y: Float[np.ndarray, "nx ny+1 nz"] | None = None
    gap_z: Float[np.ndarray, "nx ny nz+1"] | None = None

    @property
    def gaps(self) -> tuple[np.ndarray | None, np.ndarray | None, np.ndarray | None]:
        """Distances to the surface across x, y, z."""
        return (self.gap_x, self.gap_y, self.gap_z)

    @property
    def openings(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Open fractions across x, y, z."""
        return (self.open_x, self.open_y, self.open_z)


def _beside(mask: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Whether the cell on the low and on the high side of each face across `axis` is in the mask (False outside)."""
    pad = [(0, 0)] * 3
    pad[axis] = (1, 1)
    wide = np.pad(mask, pad)
    low, high = [slice(None)] * 3, [slice(None)] * 3
    low[axis], high[axis] = slice(None, -1), slice(1, None)
    return wide[tuple(low)], wide[tuple(high)]


def build_system(
    cell_types: np.ndarray,
    terrain_or_fractions: Terrain | tuple[np.ndarray, np.ndarray, np.ndarray] | None,
    grid: Grid,
    *,
    open_border: bool = False,
    gaps: Faces | None = None,
) -> PressureSystem:
    """The pressure system of a cell layout.

    FLUID cells are unknown (save those without any open face: buried); EMPTY and OUTFLOW cells hold p = 0
    (Dirichlet); SOLID cells are closed on all faces and faces of INFLOW cells have a prescribed velocity
    (Neumann). Without a terrain, faces are open or closed by cell type alone.

    Args:
        cell_types: u8 [nx,ny,nz], `CellType`.
        terrain_or_fractions: the terrain, or open fractions from `face_fractions`, or None.
        grid: the grid of the cells.
        open_border: False: the sides of the box are walls; True: p = 0 outside the box.
        gaps: from `free_surface.surface_gaps`; None: the surface passes through the centres of the cells of air.
    """
    types = np.asarray(cell_types)
    require(types.shape == grid.shape, f"cell types {types.shape}", str(grid.shape))
    if isinstance(terrain_or_fractions, Terrain):
        terrain_or_fractions = face_fractions(terrain_or_fractions.signed_distance)
    unknown = types == CellType.FLUID
    weights, openings = [], []
    for axis in range(3):
        shape = grid.face_shape(axis)
        given = None if terrain_or_fractions is None else terrain_or_fractions[axis]
        require(given is None or given.shape == shape, "face fractions of the wrong shape", str(shape))
        opening = np.ones(shape, np.float32) if given is None else np.array(given, np.float32)
        solid_low, solid_high = _beside(types == CellType.SOLID, axis)
        opening[solid_low | solid_high] = 0.0
        inflow_low, inflow_high = _beside(types == CellType.INFLOW, axis)
        if not open_border:
            border = [slice(None)] * 3
            border[axis] = slice(None, None, shape[axis] - 1)
            # the outer faces of in- and outflow cells stay open: fluid passes there
            through_low, through_high = _beside((types == CellType.OUTFLOW) | (types == CellType.INFLOW), axis)
            opening[tuple(border)] *= (through_low | through_high)[tuple(border)]
        unknown_low, unknown_high = _beside(unknown, axis)
        prescribed = inflow_low | inflow_high
        weight = np.where((unknown_low | unknown_high) & ~prescribed, opening, 0.0).astype(np.float32)
        if gaps is not None:
            require(gaps[axis].shape == shape, f"gaps {gaps[axis].shape}", str(shape))
            require(bool((gaps[axis] > 0).all()), "gaps that are not positive", "0 to 1 cells, 0 excluded")
            weight /= gaps[axis]
        weights.append(weight)
        openings.append(opening)
    reached = np.zeros(grid.shape, bool)
    for axis, w in enumerate(weights):
        low, high = [slice(None)] * 3, [slice(None)] * 3
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        reached |= (w[tuple(low)] > 0) | (w[tuple(high)] > 0)
    return PressureSystem(unknown & reached, *triple(weights), grid.spacing, *triple(openings), *(gaps or ()))


def divergence(
    velocity: FaceVelocity,
    grid: Grid,
    system: PoissonSystem | None = None,
    *,
    solid_velocity: FaceVelocity | None = None,
) -> Float[np.ndarray, "nx ny nz"]:
    """Net outflow per volume, 1/s.

    With a `PressureSystem` each face counts with its open share, its closed share moves with the solid (at rest without
    `solid_velocity`), and cells that are not unknown give 0. With a plain `PoissonSystem` a closed face counts in full
    with the velocity given there (prescribed; 0 at a wall).
    """
    h = grid.spacing
    if isinstance(system, PressureSystem) and solid_velocity is None and _plain_numbers(velocity, system):
        out = np.empty(system.unknown.shape)
        outflow(system.unknown, *velocity.components, *system.openings, float(h), out)
        return out
    flux = [c.astype(np.float64) for c in velocity.components]
    if isinstance(system, PressureSystem):
        flux = [f * w for f, w in zip(flux, system.openings)]
        if solid_velocity is not None:
            solids = zip(flux, system.openings, solid_velocity.components)
            flux = [f + (1.0 - w.astype(np.float64)) * s for f, w, s in solids]
    elif system is not None:
        flux = [f * np.where(w > 0, w, 1.0) for f, w in zip(flux, system.weights)]
    total = np.asarray(sum(np.diff(f, axis=axis) for axis, f in enumerate(flux))) / h
    if system is None:
        return total
    return np.where(system.unknown, total, 0.0)


def _signed_jump(jump: np.ndarray, unknown: np.ndarray, axis: int) -> np.ndarray:
    """The jump as part of the difference of q (high less low side) across each face; 0 but between liquid and other."""
    low, high = _beside(unknown, axis)
    return np.where(low & ~high, jump, np.where(high & ~low, -jump, 0.0))


def jump_term(system: PoissonSystem, jumps: Faces) -> Float[np.ndarray, "nx ny nz"]:
    """What jumps of q at the surface add to the right side, as `PoissonSystem.boundary_term` does for known cells."""
    out = np.zeros(system.unknown.shape)
    for axis, (weight, jump) in enumerate(zip(system.weights, jumps)):
        pull = np.moveaxis(weight * _signed_jump(jump, system.unknown, axis), axis, 0)
        along = np.moveaxis(out, axis, 0)
        along += pull[1:]
        along -= pull[:-1]
    return np.where(system.unknown, out, 0.0) / system.spacing**2


def subtract_gradient(
    velocity: FaceVelocity,
    system: PoissonSystem,
    q: np.ndarray,
    known: np.ndarray | None = None,
    *,
    jumps: Faces | None = None,
    solid_velocity: FaceVelocity | None = None,
) -> FaceVelocity:
    """v - grad q on the open faces of unknown cells; walls of a `PressureSystem` take the solid's velocity (0 without
    one); other faces stay.

    `known` is q in the cells that are not unknown (default 0), `jumps` what q is above that on the liquid's side of
    the surface (per face).
    """
    usual = known is None and jumps is None and solid_velocity is None
    if isinstance(system, PressureSystem) and usual and _plain_numbers(velocity, system) and _contiguous(q):
        return _accelerated(velocity, system, q)
    q = np.where(system.unknown, q, 0.0 if known is None else known)
    exact = isinstance(system, PressureSystem)
    out = []
    for axis, (component, w) in enumerate(zip(velocity.components, system.weights)):
        pad = [(0, 0)] * 3
        pad[axis] = (1, 1)
        change = np.diff(np.pad(q, pad), axis=axis) / system.spacing
        if jumps is not None:
            change += _signed_jump(jumps[axis], system.unknown, axis) / system.spacing
        gap = system.gaps[axis] if exact else None
        if gap is not None:
            change /= gap
        new = np.where(w > 0, component - change, component)
        if exact:
            wall = 0.0 if solid_velocity is None else solid_velocity.components[axis]
            new = np.where(system.openings[axis] > 0, new, wall)
        out.append(np.ascontiguousarray(new, component.dtype))
    return FaceVelocity(*out)


def _accelerated(velocity: FaceVelocity, system: PressureSystem, q: np.ndarray) -> FaceVelocity:
    """`subtract_gradient` as it mostly is: air at p = 0, walls at rest."""
    out = []
    for axis, (component, weight, opening) in enumerate(zip(velocity.components, system.weights, system.openings)):
        gap, new = system.gaps[axis], np.empty_like(component)
        none = gap is None
        accelerated(
            component, weight, opening, NO_GAP if none else gap, system.unknown, q, axis, float(system.spacing), new
        )
        out.append(new)
    return FaceVelocity(*out)


def _plain_numbers(velocity: FaceVelocity, system: PressureSystem) -> bool:
    """Whether all arrays are as simulators have them: one kind of array, so that kernels are compiled once."""
    faces = (*velocity.components, *system.weights, *system.openings, *(g for g in system.gaps if g is not None))
    return all(a.dtype == np.float32 and a.flags.c_contiguous for a in faces) and system.unknown.flags.c_contiguous


def _contiguous(q: np.ndarray) -> bool:
    return q.dtype in (np.float32, np.float64) and q.flags.c_contiguous


def project(
    velocity: FaceVelocity,
    system: PoissonSystem,
    *,
    tolerance: float = 1e-5,
    initial: Float[np.ndarray, "nx ny nz"] | None = None,
    method: str = "multigrid",
    max_iterations: int = 200,
    source: Float[np.ndarray, "nx ny nz"] | None = None,
    known: Float[np.ndarray, "nx ny nz"] | None = None,
    jumps: Faces | None = None,
    solid_velocity: FaceVelocity | None = None,
    low_rank: Sequence[LowRankTerm] = (),
) -> tuple[FaceVelocity, Float[np.ndarray, "nx ny nz"], SolveReport]:
    """Pressure projection: the velocity without its divergence (paper: `divProj`, all constraints at once).

    Args:
        velocity: m/s.
        system: from `build_system`.
        tolerance: relative residual of the solve, which is the share of the divergence that may stay.
        initial: first guess of q.
        method: see `numerics.poisson.solve`.
        max_iterations: iterations of the method.
        source: wanted divergence, 1/s (default 0).
        known: q in the cells that are not unknown, m^2/s (default 0: air and free outflow).
        jumps: per face, how much q on the liquid's side of its surface exceeds `known`, m^2/s (surface tension:
            `free_surface.surface_tension_jumps`). Only faces between unknown and other cells count.
        solid_velocity: of the solid, on all faces, m/s; needs a `PressureSystem`. None: solids at rest.
        low_rank: rigid bodies that give way to the pressure: J^T M^-1 J of each is added to the operator, and
            `solid_velocity` holds their velocity before the pressure acts (Batty et al. 2007, section 4).

    Returns:
        the projected velocity, q = pressure / density * dt (float32, m^2/s), and the report of the solve.
    """
    grid = Grid(system.unknown.shape, system.spacing)
    require(
        solid_velocity is None or isinstance(system, PressureSystem), "moving solids in a plain Poisson system",
        "a PressureSystem, which knows the closed share of each face",
    )  # fmt: skip
    rhs = -divergence(velocity, grid, system, solid_velocity=solid_velocity)
    if source is not None:
        rhs = rhs + np.where(system.unknown, source, 0.0)
    if known is not None:
        rhs = rhs + system.boundary_term(known)
    if jumps is not None:
        rhs = rhs + jump_term(system, jumps)
    q, report = solve(
        system, rhs, method=method, tolerance=tolerance, max_iterations=max_iterations, initial=initial,
        low_rank=tuple(low_rank),
    )  # fmt: skip
    new = subtract_gradient(velocity, system, q, known, jumps=jumps, solid_velocity=solid_velocity)
    return new, q.astype(np.float32), report
