"""Viscosity: implicit diffusion of each velocity component (paper: `eq::v`, second term).

For an incompressible fluid of constant viscosity div(2 nu S) = nu lap(v), and the components decouple inside the
liquid. Backward Euler, (1 - dt nu lap) v_new = v, is stable for any step. At the free surface the normal derivative
vanishes (a simplification of the stress-free condition that couples the components: it damps the rotation of small
free bodies too strongly); a wall beside a face takes v = 0 at half a cell's distance, times `wall_damping`.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.numerics import multigrid
from fluidlift.types import FaceVelocity, SolveReport

NEGLIGIBLE = 1e-4
"""dt nu / h^2 below which the step is left out: it would take 0.1 % from the finest waves of the grid, far less than
the transfers do"""


def _along(array: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Neighbours on the low and high side along `axis`, 0 or False beyond the array."""
    pad = [(0, 0)] * 3
    pad[axis] = (1, 1)
    wide = np.pad(array, pad)
    low, high = [slice(None)] * 3, [slice(None)] * 3
    low[axis], high[axis] = slice(0, -2), slice(2, None)
    return wide[tuple(low)], wide[tuple(high)]


def diffuse_component(
    component: Float[np.ndarray, "..."],
    solved: Bool[np.ndarray, "..."],
    fixed: Bool[np.ndarray, "..."],
    walls: Bool[np.ndarray, "..."],
    number: float,
    *,
    wall_share: float,
    tolerance: float = 1e-5,
) -> tuple[np.ndarray, SolveReport]:
    """One backward Euler step of diffusion on the faces of one component.

    Args:
        component: velocity on the faces, m/s.
        solved: faces that diffuse.
        fixed: faces whose given velocity acts on their neighbours (inflow, walls that are hit head-on).
        walls: faces inside a wall beside the flow.
        number: dt nu / h^2.
        wall_share: 0 (free slip) to 1 (no slip).
        tolerance: relative residual.

    Faces in none of the three masks are air: no exchange.
    """
    weights = []
    source = np.zeros(component.shape)
    extra = np.ones(component.shape)  # the unit matrix
    for axis in range(3):
        pad = [(0, 0)] * 3
        pad[axis] = (1, 1)
        inner = np.moveaxis(np.pad(solved, pad), axis, 0)
        weights.append(np.ascontiguousarray(np.moveaxis((inner[1:] & inner[:-1]) * np.float32(number), 0, axis)))
        for near_fixed, value, near_wall in zip(
            _along(fixed, axis), _along(np.where(fixed, component, 0.0), axis), _along(walls & ~fixed, axis)
        ):
            source += number * value
            extra += number * near_fixed + 2.0 * number * wall_share * near_wall
    rhs = np.where(solved, component + source, 0.0)
    start = np.where(solved, component, 0.0).astype(np.float64)
    norm = float(np.abs(rhs).max(initial=0.0))
    if norm == 0.0:
        return component, SolveReport(True, 0, 0.0, "conjugate_gradient")
    result, iterations, residual = multigrid.solve(
        solved, tuple(weights), 1.0, rhs, tolerance=tolerance, max_iterations=300, initial=start,
        added_diagonal=extra.astype(np.float32), cycles=number > 2.0,
    )  # fmt: skip
    report = SolveReport(residual <= tolerance * 1.01, iterations, residual, "viscosity")
    return np.where(solved, result, component).astype(np.float32), report


def diffuse(
    velocity: FaceVelocity,
    solved: tuple[np.ndarray, np.ndarray, np.ndarray],
    fixed: tuple[np.ndarray, np.ndarray, np.ndarray],
    walls: tuple[np.ndarray, np.ndarray, np.ndarray],
    *,
    viscosity: float,
    dt: float,
    spacing: float,
    wall_share: float,
    tolerance: float = 1e-5,
) -> tuple[FaceVelocity, tuple[SolveReport, ...]]:
    """The velocity after dt (s) of diffusion with `viscosity` (m^2/s).

    Masks per component as in `diffuse_component`. Below `NEGLIGIBLE` nothing is done and no report given.
    """
    number = viscosity * dt / spacing**2
    if number < NEGLIGIBLE:
        return velocity, ()
    out = [
        diffuse_component(c, s, f, w, number, wall_share=wall_share, tolerance=tolerance)
        for c, s, f, w in zip(velocity.components, solved, fixed, walls)
    ]
    return FaceVelocity(*(c for c, _ in out)), tuple(r for _, r in out)
