"""The Poisson equation on irregular cell domains (Dirichlet and Neumann): system, plain solvers, the fast one.

Discretisation: cell-centred p, -div(w grad p) = b with open face fractions w (Batty, Bertails, Bridson 2007);
a closed face (w = 0) is a Neumann wall, a known neighbour behind an open face holds p = 0 (air). Where air begins
nearer than the neighbour's centre, the weight of that face is the open fraction over the distance in cells (ghost
fluid): weights towards known cells may exceed 1.

Rigid bodies that give way to the pressure add J^T M^-1 J each (Batty, Bertails, Bridson 2007): `LowRankTerm`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from fluidlift.errors import require
from fluidlift.numerics import multigrid
from fluidlift.numerics.components import FreeConstants, free_constants
from fluidlift.numerics.multigrid_prepared import PreparedSystem
from fluidlift.types import SolveReport


@dataclass(frozen=True)
class PoissonSystem:
    """A = -div(w grad .), symmetric positive semidefinite."""

    unknown: Bool[np.ndarray, "nx ny nz"]
    """cells whose pressure is solved"""
    weight_x: Float[np.ndarray, "nx+1 ny nz"]
    """open fraction of each face, 0 (wall, or velocity prescribed) to 1; towards known cells any weight >= 0"""
    weight_y: Float[np.ndarray, "nx ny+1 nz"]
    weight_z: Float[np.ndarray, "nx ny nz+1"]
    spacing: float
    """cell width, m"""
    _prepared: ClassVar[PreparedSystem | None] = None

    def prepared(self) -> Self:
        """The same system for many solves: the multigrid solver keeps its levels. The arrays must not change."""
        out = replace(self)
        object.__setattr__(out, "_prepared", PreparedSystem(self.unknown, self.weights, self.spacing))
        return out

    @property
    def weights(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Face fractions across x, y, z."""
        return (self.weight_x, self.weight_y, self.weight_z)

    def diagonal(self) -> Float[np.ndarray, "nx ny nz"]:
        """Sum of the face weights of each cell over h^2, in double precision as all that the operator does."""
        x, y, z = (np.asarray(w, np.float64) for w in self.weights)
        total = x[1:] + x[:-1] + y[:, 1:] + y[:, :-1] + z[:, :, 1:] + z[:, :, :-1]
        return np.where(self.unknown, total, 0.0) / self.spacing**2

    def neighbour_sum(self, p: Float[np.ndarray, "nx ny nz"]) -> Float[np.ndarray, "nx ny nz"]:
        """Sum over faces of w times the unknown neighbour's p, over h^2."""
        return self._weighted_neighbours(np.where(self.unknown, p, 0.0))

    def boundary_term(self, known: Float[np.ndarray, "nx ny nz"]) -> Float[np.ndarray, "nx ny nz"]:
        """What known values outside the unknown cells add to the right side: A p = rhs + boundary_term(known)."""
        return self._weighted_neighbours(np.where(self.unknown, 0.0, known))

    def _weighted_neighbours(self, p: np.ndarray) -> np.ndarray:
        out = np.zeros_like(p)
        for axis, w in enumerate(self.weights):
            inner = [slice(None)] * 3
            inner[axis] = slice(1, -1)
            low, high = [slice(None)] * 3, [slice(None)] * 3
            low[axis], high[axis] = slice(None, -1), slice(1, None)
            out[tuple(low)] += w[tuple(inner)] * p[tuple(high)]
            out[tuple(high)] += w[tuple(inner)] * p[tuple(low)]
        return np.where(self.unknown, out, 0.0) / self.spacing**2

    def apply(self, p: Float[np.ndarray, "nx ny nz"]) -> Float[np.ndarray, "nx ny nz"]:
        """A p, zero outside the unknown cells."""
        return self.diagonal() * p - self.neighbour_sum(p)


@dataclass(frozen=True)
class LowRankTerm:
    """J^T M^-1 J of one rigid body: pressure p exerts the force J p on it, and it gives way with M^-1 J p."""

    cells: Int[np.ndarray, "n 3"]
    """cells where J is not zero, each once"""
    values: Float[np.ndarray, "n 6"]
    """J^T at these cells: force (3) and torque (3) of unit pressure"""
    inverse_mass: Float[np.ndarray, "6 6"]
    """M^-1, symmetric, positive semidefinite; zero rows for motions that are held"""

    def __post_init__(self) -> None:
        n = len(self.cells)
        require(self.cells.shape == (n, 3), f"cells {self.cells.shape}", "[n, 3]")
        require(self.values.shape == (n, 6), f"values {self.values.shape}", f"[{n}, 6], one row per cell")
        require(self.inverse_mass.shape == (6, 6), f"inverse mass {self.inverse_mass.shape}", "[6, 6]")

    def apply(self, p: Float[np.ndarray, "nx ny nz"]) -> Float[np.ndarray, "nx ny nz"]:
        """J^T M^-1 J p."""
        place = tuple(self.cells.T)
        force = (self.values * p[place][:, None]).sum(axis=0)
        out = np.zeros_like(p)
        out[place] = (self.values * (self.inverse_mass * force).sum(axis=1)).sum(axis=1)
        return out

    def diagonal(self, shape: tuple[int, ...]) -> Float[np.ndarray, "nx ny nz"]:
        """The diagonal of J^T M^-1 J."""
        out = np.zeros(shape)
        out[tuple(self.cells.T)] = np.einsum("nm,ml,nl->n", self.values, self.inverse_mass, self.values)
        return out

    def row_sums(self, shape: tuple[int, ...]) -> Float[np.ndarray, "nx ny nz"]:
        """At least the sums of the sizes in each row of J^T M^-1 J."""
        out = np.zeros(shape)
        sizes = np.abs(self.values)
        out[tuple(self.cells.T)] = np.einsum("nm,ml,l->n", sizes, np.abs(self.inverse_mass), sizes.sum(axis=0))
        return out


def _apply(system: PoissonSystem, low_rank: Sequence[LowRankTerm], p: np.ndarray) -> np.ndarray:
    return system.apply(p) + sum(term.apply(p) for term in low_rank)


def _norm(values: np.ndarray) -> float:
    # not numpy.linalg.norm: threaded BLAS stalls on busy machines
    return float(np.sqrt(np.square(values).sum()))


def label_components(system: PoissonSystem) -> tuple[Int[np.ndarray, "nx ny nz"], Bool[np.ndarray, " c"]]:
    """Groups of unknown cells that are joined through open faces.

    Returns:
        labels: -1 outside the unknown cells, else 0 to c-1.
        closed: True where no open face of the group leads to a known cell or out of the box (p has a free constant).
    """
    unknown = system.unknown
    index = np.full(unknown.shape, -1, np.int64)
    index[unknown] = np.arange(np.count_nonzero(unknown))
    pairs = []
    touches_air = np.zeros(unknown.shape, bool)
    for axis, w in enumerate(system.weights):
        w = np.moveaxis(w, axis, 0) > 0
        cell, air = np.moveaxis(index, axis, 0), np.moveaxis(touches_air, axis, 0)
        low, high = cell[:-1], cell[1:]
        joined = w[1:-1] & (low >= 0) & (high >= 0)
        pairs.append(np.stack([low[joined], high[joined]]))
        air[:-1] |= w[1:-1] & (high < 0)
        air[1:] |= w[1:-1] & (low < 0)
        air[0] |= w[0]
        air[-1] |= w[-1]
    n = int(index.max()) + 1
    if n == 0:
        return index, np.zeros(0, bool)
    a, b = np.concatenate(pairs, axis=1)
    count, group = connected_components(coo_matrix((np.ones(len(a), bool), (a, b)), shape=(n, n)), directed=False)
    closed = np.bincount(group, weights=touches_air[unknown], minlength=count) == 0
    labels = np.full(unknown.shape, -1, np.int64)
    labels[unknown] = group
    return labels, closed


def constants_left_free(
    labels: Int[np.ndarray, "nx ny nz"], closed: Bool[np.ndarray, " c"], low_rank: Sequence[LowRankTerm] = ()
) -> FreeConstants:
    """The constants of the closed components that bodies leave free; the other components count as if of no cell."""
    sizes = np.where(closed, np.bincount(labels[labels >= 0], minlength=len(closed)), 0)
    forces, magnitudes = np.zeros((2, len(low_rank), len(closed), 6))
    for b, term in enumerate(low_rank):
        group = labels[tuple(term.cells.T)]
        inside = (group >= 0) & np.append(closed, False)[group]
        np.add.at(forces[b], group[inside], term.values[inside])
        np.add.at(magnitudes[b], group[inside], np.abs(term.values[inside]))
    masses = np.array([term.inverse_mass for term in low_rank]).reshape(-1, 6, 6)
    return free_constants(sizes, forces, magnitudes, masses)


def remove_constants(
    values: Float[np.ndarray, "nx ny nz"], labels: Int[np.ndarray, "nx ny nz"], constants: FreeConstants
) -> Float[np.ndarray, "nx ny nz"]:
    """Values less their free constants: over a closed component that no body touches, less their mean."""
    if not constants.sizes.any():
        return values
    inside = labels >= 0
    group = labels[inside]
    sums = np.where(constants.sizes > 0, np.bincount(group, weights=values[inside], minlength=len(constants.sizes)), 0)
    out = values.copy()
    out[inside] -= constants.means(sums)[group]
    return out


def jacobi(
    system: PoissonSystem,
    rhs: np.ndarray,
    *,
    tolerance: float,
    max_iterations: int,
    initial: np.ndarray,
    low_rank: Sequence[LowRankTerm] = (),
) -> tuple[np.ndarray, int]:
    """Simultaneous constraint projection (paper: `divProj`): the plain reference.

    The step is 0.9 of the full one (the paper's relaxation): the full step never damps the checkerboard of a closed
    component. Cells of a body count the whole of its rows, without which the iteration diverges for a light one.
    """
    diagonal = system.diagonal() + sum(np.where(system.unknown, t.row_sums(rhs.shape), 0.0) for t in low_rank)
    inverse = np.divide(1.0, diagonal, out=np.zeros_like(diagonal), where=system.diagonal() > 0)
    goal = tolerance * _norm(rhs)
    p = initial
    for iteration in range(max_iterations):
        residual = rhs - _apply(system, low_rank, p)
        if _norm(residual) <= goal:
            return p, iteration
        p = p + 0.9 * inverse * residual
    return p, max_iterations


def conjugate_gradient(
    system: PoissonSystem,
    rhs: np.ndarray,
    *,
    tolerance: float,
    max_iterations: int,
    initial: np.ndarray,
    low_rank: Sequence[LowRankTerm] = (),
) -> tuple[np.ndarray, int]:
    """Conjugate gradients with the diagonal as preconditioner: plain, converges where Jacobi crawls."""
    diagonal = system.diagonal() + sum(np.where(system.unknown, t.diagonal(rhs.shape), 0.0) for t in low_rank)
    inverse = np.divide(1.0, diagonal, out=np.zeros_like(diagonal), where=system.diagonal() > 0)
    goal = tolerance * _norm(rhs)
    p = initial.copy()
    residual = rhs - _apply(system, low_rank, p)
    z = inverse * residual
    direction = z.copy()
    rz = float((residual * z).sum())
    for iteration in range(max_iterations):
        if _norm(residual) <= goal:
            return p, iteration
        q = _apply(system, low_rank, direction)
        curvature = float((direction * q).sum())
        if curvature <= 0:
            return p, iteration
        p += (rz / curvature) * direction
        residual -= (rz / curvature) * q
        z = inverse * residual
        rz, previous = float((residual * z).sum()), rz
        direction = z + (rz / previous) * direction
    return p, max_iterations


def _solve_plain(
    system: PoissonSystem,
    rhs: np.ndarray,
    method: str,
    *,
    tolerance: float,
    max_iterations: int,
    initial: np.ndarray | None,
    low_rank: Sequence[LowRankTerm],
) -> multigrid.Solution:
    """`multigrid.solve` with a plain method."""
    active = system.unknown & (system.diagonal() > 0)
    b = np.where(active, rhs, 0.0).astype(np.float64)
    start = np.zeros_like(b) if initial is None else np.where(active, initial, 0.0).astype(np.float64)
    labels, closed = label_components(system)
    if not np.isfinite(b).all() or not np.isfinite(start).all():
        return multigrid.Solution(np.zeros_like(rhs), 0, float("nan"), int(closed.sum()), 0.0)
    inside = tuple(_restricted(term, active) for term in low_rank)
    constants = constants_left_free(labels, closed, inside)
    consistent = np.where(active, remove_constants(b, labels, constants), 0.0)
    removed, norm = _norm(consistent - b), _norm(consistent)
    if norm == 0.0:
        return multigrid.Solution(np.zeros_like(rhs), 0, 0.0, int(closed.sum()), removed)
    run = {"jacobi": jacobi, "conjugate_gradient": conjugate_gradient}[method]
    p, iterations = run(
        system, consistent, tolerance=tolerance, max_iterations=max_iterations, initial=start, low_rank=inside
    )
    p = remove_constants(p, labels, constants)
    residual = _norm(consistent - _apply(system, inside, p)) / norm
    return multigrid.Solution(p.astype(rhs.dtype), iterations, residual, int(closed.sum()), removed / norm)


def _restricted(term: LowRankTerm, active: np.ndarray) -> LowRankTerm:
    """The term at cells that have an equation."""
    some = active[tuple(term.cells.T)]
    return LowRankTerm(term.cells[some], term.values[some], term.inverse_mass)


def _packed(terms: Sequence[LowRankTerm]) -> multigrid.LowRank:
    if not terms:
        return multigrid.NO_TERMS
    return multigrid.LowRank(
        np.concatenate([t.cells for t in terms]).astype(np.int64),
        np.concatenate([t.values for t in terms]).astype(np.float64),
        np.cumsum([0] + [len(t.cells) for t in terms]).astype(np.int64),
        np.array([t.inverse_mass for t in terms], np.float64),
    )


def solve(
    system: PoissonSystem,
    rhs: Float[np.ndarray, "nx ny nz"],
    *,
    method: str = "multigrid",
    tolerance: float = 1e-5,
    max_iterations: int = 200,
    initial: Float[np.ndarray, "nx ny nz"] | None = None,
    low_rank: Sequence[LowRankTerm] = (),
) -> tuple[Float[np.ndarray, "nx ny nz"], SolveReport]:
    """p with A p = rhs to |rhs - A p| <= tolerance |rhs|, where A = -div(w grad .) and the terms of rigid bodies.

    Closed components (no p = 0 anywhere behind an open face) determine p up to a constant and only admit a right
    side of zero mean: the mean is removed from the right side and from p, and the report says so. A body that closes
    off a component, such as a piston, determines the constant; one that floats within does not.

    Args:
        system: the operator.
        rhs: right side in units of p / m^2; values outside the unknown cells are ignored.
        method: "multigrid" (preconditioned conjugate gradients), "conjugate_gradient" or "jacobi".
        tolerance: relative residual in the 2-norm.
        max_iterations: iterations of the chosen method.
        initial: first guess, for instance the pressure of the step before.
        low_rank: rigid bodies that give way. Each costs conjugate gradients a few iterations.

    Returns:
        p (dtype of rhs; solved in double precision, zero outside the unknown cells) and the report with the true
        residual of the solution before it is rounded to that dtype.

    Raises:
        ValueError: wrong shapes or an unknown method.
    """
    shape = system.unknown.shape
    require(rhs.shape == shape, f"rhs {rhs.shape}", str(shape))
    require(initial is None or initial.shape == shape, "a first guess of another shape", str(shape))
    for axis, w in enumerate(system.weights):
        wanted = tuple(n + (a == axis) for a, n in enumerate(shape))
        require(w.shape == wanted, f"weights across axis {axis} {w.shape}", str(wanted))
    known = ("multigrid", "conjugate_gradient", "jacobi")
    require(method in known, f"method '{method}'", "multigrid, conjugate_gradient or jacobi")
    for term in low_rank:
        cells = term.cells
        require(bool(((cells >= 0) & (cells < shape)).all()), "cells of a body outside the grid", f"within {shape}")
    rhs = rhs if np.issubdtype(rhs.dtype, np.floating) else rhs.astype(np.float64)
    options = {"tolerance": tolerance, "max_iterations": max_iterations, "initial": initial}
    if method == "multigrid" and system._prepared is not None and not low_rank:
        found = system._prepared.solve(rhs, **options)
    elif method == "multigrid":
        terms = _packed(low_rank)
        found = multigrid.solve(system.unknown, system.weights, system.spacing, rhs, **options, low_rank=terms)
    else:
        found = _solve_plain(system, rhs, method, **options, low_rank=tuple(low_rank))
    return found.p, judged(found, tolerance, method)


def judged(found: multigrid.Solution, tolerance: float, method: str) -> SolveReport:
    """The report on what a solver found."""
    advice = []
    if not np.isfinite(found.residual) and found.iterations == 0:
        advice.append("the right side or the first guess is not finite")
    elif found.removed > 1e-6:
        advice.append(
            f"{found.closed} closed component(s) whose in- and outflow do not balance: "
            "the mean of the right side was removed there"
        )
    converged = bool(np.isfinite(found.residual) and found.residual <= tolerance * (1 + 1e-6))
    if not converged and np.isfinite(found.residual):
        advice.append("raise max_iterations or the tolerance")
    return SolveReport(converged, found.iterations, found.residual, method, "; ".join(advice))
