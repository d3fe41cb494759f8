"""The Poisson equation on irregular cell domains: system, plain solvers, and the door to the fast one.

Discretisation: cell-centred p, -div(w grad p) = b with open face fractions w (Batty, Bertails, Bridson 2007);
a closed face (w = 0) is a Neumann wall, a known neighbour behind an open face holds p = 0 (air).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from fluidlift.errors import require
from fluidlift.numerics import multigrid
from fluidlift.types import SolveReport


@dataclass(frozen=True)
class PoissonSystem:
    """A = -div(w grad .), symmetric positive semidefinite."""

    unknown: Bool[np.ndarray, "nx ny nz"]
    """cells whose pressure is solved"""
    weight_x: Float[np.ndarray, "nx+1 ny nz"]
    """open fraction of each face, 0 (wall, or velocity prescribed) to 1"""
    weight_y: Float[np.ndarray, "nx ny+1 nz"]
    weight_z: Float[np.ndarray, "nx ny nz+1"]
    spacing: float
    """cell width, m"""

    @property
    def weights(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Face fractions across x, y, z."""
        return (self.weight_x, self.weight_y, self.weight_z)

    def diagonal(self) -> Float[np.ndarray, "nx ny nz"]:
        """Sum of the face fractions of each cell over h^2."""
        x, y, z = self.weights
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


def _norm(values: np.ndarray) -> float:
    # not numpy.linalg.norm: threaded BLAS stalls on busy machines
    return float(np.sqrt(np.square(values).sum()))


def label_components(system: PoissonSystem) -> tuple[Int[np.ndarray, "nx ny nz"], Bool[np.ndarray, "c"]]:
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


def remove_component_means(
    values: Float[np.ndarray, "nx ny nz"], labels: Int[np.ndarray, "nx ny nz"], closed: Bool[np.ndarray, "c"]
) -> Float[np.ndarray, "nx ny nz"]:
    """Values less their mean over each closed component; the others unchanged."""
    if not closed.any():
        return values
    inside = labels >= 0
    group = labels[inside]
    totals = np.bincount(group, weights=values[inside], minlength=len(closed))
    means = np.where(closed, totals / np.maximum(np.bincount(group, minlength=len(closed)), 1), 0.0)
    out = values.copy()
    out[inside] -= means[group]
    return out


def jacobi(
    system: PoissonSystem, rhs: np.ndarray, *, tolerance: float, max_iterations: int, initial: np.ndarray
) -> tuple[np.ndarray, int]:
    """Simultaneous constraint projection (paper: `divProj`): the plain reference.

    The step is 0.9 of the full one (the paper's relaxation): the full step never damps the checkerboard of a closed
    component.
    """
    diagonal = system.diagonal()
    inverse = np.divide(1.0, diagonal, out=np.zeros_like(diagonal), where=diagonal > 0)
    goal = tolerance * _norm(rhs)
    p = initial
    for iteration in range(max_iterations):
        residual = rhs - system.apply(p)
        if _norm(residual) <= goal:
            return p, iteration
        p = p + 0.9 * inverse * residual
    return p, max_iterations


def conjugate_gradient(
    system: PoissonSystem, rhs: np.ndarray, *, tolerance: float, max_iterations: int, initial: np.ndarray
) -> tuple[np.ndarray, int]:
    """Conjugate gradients with the diagonal as preconditioner: plain, converges where Jacobi crawls."""
    diagonal = system.diagonal()
    inverse = np.divide(1.0, diagonal, out=np.zeros_like(diagonal), where=diagonal > 0)
    goal = tolerance * _norm(rhs)
    p = initial.copy()
    residual = rhs - system.apply(p)
    z = inverse * residual
    direction = z.copy()
    rz = float((residual * z).sum())
    for iteration in range(max_iterations):
        if _norm(residual) <= goal:
            return p, iteration
        q = system.apply(direction)
        curvature = float((direction * q).sum())
        if curvature <= 0:
            return p, iteration
        p += (rz / curvature) * direction
        residual -= (rz / curvature) * q
        z = inverse * residual
        rz, previous = float((residual * z).sum()), rz
        direction = z + (rz / previous) * direction
    return p, max_iterations


def multigrid_conjugate_gradient(
    system: PoissonSystem, rhs: np.ndarray, *, tolerance: float, max_iterations: int, initial: np.ndarray
) -> tuple[np.ndarray, int]:
    """Conjugate gradients with a multigrid V-cycle as preconditioner: the default (see `numerics.multigrid`)."""
    p, iterations, _ = multigrid.solve(
        system.unknown,
        system.weights,
        system.spacing,
        rhs,
        tolerance=tolerance,
        max_iterations=max_iterations,
        initial=initial,
    )
    return p, iterations


def solve(
    system: PoissonSystem,
    rhs: Float[np.ndarray, "nx ny nz"],
    *,
    method: str = "multigrid",
    tolerance: float = 1e-5,
    max_iterations: int = 200,
    initial: Float[np.ndarray, "nx ny nz"] | None = None,
) -> tuple[Float[np.ndarray, "nx ny nz"], SolveReport]:
    """p with A p = rhs to |rhs - A p| <= tolerance |rhs|.

    Closed components (no p = 0 anywhere behind an open face) determine p up to a constant and only admit a right
    side of zero mean: the mean is removed from the right side and from p, and the report says so.

    Args:
        system: the operator.
        rhs: right side in units of p / m^2; values outside the unknown cells are ignored.
        method: "multigrid" (preconditioned conjugate gradients), "conjugate_gradient" or "jacobi".
        tolerance: relative residual in the 2-norm.
        max_iterations: iterations of the chosen method.
        initial: first guess, for instance the pressure of the step before.

    Returns:
        p (dtype of rhs; solved in double precision, zero outside the unknown cells) and the report with the true
        residual of the solution before it is rounded to that dtype.

    Raises:
        ValueError: wrong shapes or an unknown method.
    """
    require(rhs.shape == system.unknown.shape, f"rhs {rhs.shape}", str(system.unknown.shape))
    methods = {"jacobi": jacobi, "conjugate_gradient": conjugate_gradient}
    require(method in (*methods, "multigrid"), f"method '{method}'", "multigrid, conjugate_gradient or jacobi")
    active = system.unknown & (system.diagonal() > 0)
    b = np.where(active, rhs, 0.0).astype(np.float64)
    start = np.zeros_like(b) if initial is None else np.where(active, initial, 0.0).astype(np.float64)
    if not np.isfinite(b).all() or not np.isfinite(start).all():
        report = SolveReport(False, 0, float("nan"), method, "the right side or the first guess is not finite")
        return np.zeros_like(rhs), report
    labels, closed = label_components(system)
    consistent = np.where(active, remove_component_means(b, labels, closed), 0.0)
    removed = _norm(consistent - b)
    norm = _norm(consistent)
    if norm == 0.0:
        return np.zeros_like(rhs), SolveReport(True, 0, 0.0, method, "")
    run = methods.get(method, multigrid_conjugate_gradient)
    p, iterations = run(system, consistent, tolerance=tolerance, max_iterations=max_iterations, initial=start)
    p = remove_component_means(p, labels, closed)
    residual = _norm(consistent - system.apply(p)) / norm
    advice = ""
    if removed > 1e-6 * norm:
        advice = (
            f"{int(closed.sum())} closed component(s) whose in- and outflow do not balance: "
            "the mean of the right side was removed there"
        )
    converged = bool(np.isfinite(residual) and residual <= tolerance * (1 + 1e-6))
    if not converged:
        advice = "; ".join(filter(None, [advice, "raise max_iterations or the tolerance"]))
    return p.astype(rhs.dtype), SolveReport(converged, iterations, residual, method, advice)
