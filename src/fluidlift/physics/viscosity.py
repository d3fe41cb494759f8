"""Viscosity: implicit, with all components coupled by the full stress (paper: `eq::v`, second term).

After Batty and Bridson 2008, "Accurate viscous free surfaces for buckling, coiling, and rotating liquids". The new
velocity v minimises

    1/2 sum over faces V (v - v*)^2  +  dt sum over stresses V nu S : S,     S = (grad v + grad v^T) / 2,

where v* is the velocity before and V the liquid inside the control volume of each face (velocity), cell centre
(S_xx, S_yy, S_zz) and edge (S_xy, S_xz, S_yz). That is backward Euler for dv/dt = div(2 nu S), stable for any step,
symmetric and positive definite. A free surface without stress is its natural boundary condition: a free body keeps
its rotation, since S vanishes, and without walls linear and angular momentum are kept.

Pressure is not part of the minimum. Where nu dt is much larger than h^2, project before and after: otherwise the part
of gravity that pressure balances enters the stress.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.errors import require
from fluidlift.numerics import multigrid
from fluidlift.physics import viscosity_kernels as kernels
from fluidlift.physics.liquid_fractions import octant_shares
from fluidlift.types import FaceVelocity, SolveReport

NEGLIGIBLE = 1e-4
"""dt nu / h^2 below which the step is left out: it would take 0.1 % from the finest waves of the grid, far less than
the transfers do"""

LEAST_SHARE = 0.01
"""of a face's control volume: faces that hold less liquid get the mass of this much"""

CYCLES_FROM = 2.0
"""dt nu / h^2 above which V-cycles precondition better than the diagonal, for their cost"""

INNER = (slice(1, -1),) * 3


@dataclass(frozen=True)
class FaceRoles:
    """What each face does in the viscous solve, one bool array per component. Faces in none of the three are air."""

    solved: tuple[np.ndarray, np.ndarray, np.ndarray]
    """velocities that are sought; all that border liquid and have a velocity"""
    fixed: tuple[np.ndarray, np.ndarray, np.ndarray]
    """given velocities that act on their neighbours (inflow, moving solids, walls that are hit head-on)"""
    walls: tuple[np.ndarray, np.ndarray, np.ndarray]
    """faces inside a wall beside the flow: the given velocity holds half a cell away, times `wall_share`"""


@dataclass(frozen=True)
class StressSystem:
    """The operator on a box around the solved faces; layout as in `viscosity_kernels`."""

    low: tuple[int, int, int]
    """index of the first node of the box, ghosts included, in the whole grid"""
    roles: np.ndarray
    mass: np.ndarray
    """float32 [3,...]: liquid share of the faces that are solved, 0 elsewhere"""
    inverse: np.ndarray
    """1 / diagonal"""
    normal: np.ndarray
    """float32 [3,...]: weights of the stresses xx, yy, zz at cells"""
    shear: np.ndarray
    """float32 [3,...]: weights of the stresses yz, xz, xy at edges"""
    first: np.ndarray
    last: np.ndarray

    @property
    def shape(self) -> tuple[int, int, int]:
        """Nodes of the box."""
        return self.roles.shape[1:]


def _crop(array: np.ndarray, low: tuple[int, ...], shape: tuple[int, ...], fill: float) -> np.ndarray:
    """The box of `shape` that starts at `low`, `fill` beyond the array."""
    out = np.full(shape, fill, array.dtype)
    source, target = [], []
    for start, length, size in zip(low, shape, array.shape):
        a, b = max(start, 0), min(start + length, size)
        source.append(slice(a, b))
        target.append(slice(a - start, b - start))
    out[tuple(target)] = array[tuple(source)]
    return out


def _clamped_crop(array: np.ndarray, low: tuple[int, ...], shape: tuple[int, ...]) -> np.ndarray:
    """The box of `shape` that starts at `low`, the outermost values repeated beyond the array."""
    index = [np.clip(np.arange(start, start + n), 0, size - 1) for start, n, size in zip(low, shape, array.shape)]
    return array[np.ix_(*index)]


def _box(solved: tuple[np.ndarray, ...]) -> tuple[tuple[int, ...], tuple[int, ...]] | None:
    """First node and shape of the box around the solved faces, with two layers of nodes on each side."""
    low, high = [np.iinfo(int).max] * 3, [-1] * 3
    for mask in solved:
        for axis in range(3):
            hit = np.flatnonzero(mask.any(axis=tuple(a for a in range(3) if a != axis)))
            if len(hit):
                low[axis], high[axis] = min(low[axis], int(hit[0])), max(high[axis], int(hit[-1]))
    if high[0] < 0:
        return None
    return tuple(a - 2 for a in low), tuple(b - a + 5 for a, b in zip(low, high))


def _face_roles(roles: FaceRoles, low: tuple[int, ...], shape: tuple[int, ...]) -> np.ndarray:
    out = np.zeros((3, *shape), np.int8)
    for a in range(3):
        for code, masks in ((kernels.WALL, roles.walls), (kernels.FIXED, roles.fixed), (kernels.SOLVED, roles.solved)):
            out[a][_crop(masks[a], low, shape, False)] = code
    return out


def _all_six(faces: np.ndarray) -> np.ndarray:
    """bool [nx,ny,nz]: cells whose six faces are all in `faces` [3,...]; False in the last layer."""
    out = np.zeros(faces.shape[1:], bool)
    core = (slice(None, -1),) * 3
    out[core] = True
    for axis in range(3):
        upper = list(core)
        upper[axis] = slice(1, None)
        out[core] &= faces[axis][core] & faces[axis][tuple(upper)]
    return out


def build_system(
    roles: FaceRoles,
    *,
    viscosity: float | Float[np.ndarray, "nx ny nz"],
    number: float,
    wall_share: float,
    liquid_distance: Float[np.ndarray, "nx ny nz"] | None = None,
) -> StressSystem | None:
    """Weights of the stresses and masses of the faces; None where nothing is solved. Arguments as for `diffuse`.

    Args:
        number: dt / h^2.
    """
    box = _box(roles.solved)
    if box is None:
        return None
    low, shape = box
    nx, ny, nz = roles.solved[0].shape[0] - 1, *roles.solved[0].shape[1:]
    faces = _face_roles(roles, low, shape)
    inside = _crop(np.broadcast_to(True, (nx, ny, nz)), low, shape, False)
    excluded = _all_six(faces >= kernels.FIXED) | ~inside
    if liquid_distance is None:
        wet = _all_six(faces != kernels.AIR) & ~excluded
        octants = np.repeat(wet[..., None].astype(np.float32), 8, axis=-1)
    else:
        octants = octant_shares(_clamped_crop(np.asarray(liquid_distance, np.float32), low, shape), excluded)
    slack = 1.0 / np.maximum(np.asarray(viscosity, np.float32), np.float32(1e-30))
    resistance = _crop(np.broadcast_to(slack, (nx, ny, nz)), low, shape, 1.0)
    mass, inverse, normal, shear = (np.zeros((3, *shape), np.float32) for _ in range(4))
    kernels.weigh_stresses(faces, octants, excluded, resistance, number, wall_share, normal, shear)
    kernels.weigh_faces(faces, octants, excluded, resistance, normal, shear, LEAST_SHARE, mass, inverse)
    some = (mass > 0).any(axis=0)
    columns = some.any(axis=2)
    first = np.where(columns, some.argmax(axis=2), 1).astype(np.int32)
    last = np.where(columns, shape[2] - some[:, :, ::-1].argmax(axis=2), 1).astype(np.int32)
    return StressSystem(low, faces, mass, inverse, normal, shear, first, last)


def _levels(system: StressSystem) -> list[list[multigrid.Level]]:
    """A multigrid hierarchy per component, of the operator without the couplings between components."""
    out = []
    for a in range(3):
        weights = []
        for axis in range(3):
            cut = [slice(1, -1)] * 3
            if axis == a:
                cut[axis] = slice(0, -1)
                weights.append(system.normal[a][tuple(cut)])
            else:
                cut[axis] = slice(1, None)
                weights.append(system.shear[3 - a - axis][tuple(cut)])
        mass = system.mass[a][INNER]
        out.append(multigrid.build_levels(mass > 0, tuple(weights), 1.0, added_diagonal=mass))
    return out


def solve(
    system: StressSystem, x: np.ndarray, momentum: np.ndarray, *, tolerance: float, max_iterations: int, cycles: bool
) -> tuple[int, float]:
    """Conjugate gradients for A x = momentum, in place; the number of iterations and the relative residual.

    The residual counts relative to the momentum of the fluid, before or after: relative to the right-hand side, which
    holds the huge forces of fixed faces nearby, bodies that fly freely would not be solved.

    Args:
        x: float64 [3,...], first guess on the solved faces, given velocities on the others.
        momentum: float64 [3,...], mass times the velocity before.
        tolerance: relative residual in the 2-norm.
        max_iterations: of the conjugate gradients.
        cycles: precondition with V-cycles; False: with the diagonal.
    """
    columns = (system.first, system.last)
    operator = (system.mass, system.normal, system.shear, *columns)
    r, q, direction = momentum.copy(), np.zeros_like(x), np.zeros_like(x)
    if cycles:
        levels = _levels(system)
        z = tuple(hierarchy[0].x for hierarchy in levels)
    else:
        levels, scaled = [], np.zeros_like(x)
        z = tuple(scaled)

    def precondition() -> None:
        if not cycles:
            kernels.scale_by(r, system.inverse, scaled, *columns)
            return
        # near one: single precision neither over- nor underflows
        scale = 1.0 / max(float(np.sqrt(squared)), 1e-300)
        for a, hierarchy in enumerate(levels):
            kernels.scale_into(r, a, scale, hierarchy[0].rhs, hierarchy[0].x, *columns)
            multigrid.v_cycle(hierarchy)

    before = float(np.square(momentum).sum())
    kernels.apply(x, q, *operator)
    squared, after = kernels.descend(x, r, direction, q, 1.0, system.mass, *columns)
    iterations, rz = 0, 1.0
    while iterations < max_iterations and squared > tolerance**2 * max(before, after):
        precondition()
        rz, previous = kernels.dot(r, *z, *columns), rz
        if not rz > 0:
            break
        kernels.turn(direction, *z, rz / previous if iterations else 0.0, *columns)
        curvature = kernels.apply(direction, q, *operator)
        if not curvature > 0:
            break
        squared, after = kernels.descend(x, r, direction, q, rz / curvature, system.mass, *columns)
        iterations += 1
    kernels.apply(x, q, *operator)
    r[...] = momentum - q
    direction[...] = 0.0
    squared, after = kernels.descend(x, r, direction, direction, 0.0, system.mass, *columns)
    size = max(before, after)
    return iterations, float(np.sqrt(squared / size)) if size > 0 else 0.0


def diffuse(
    velocity: FaceVelocity,
    roles: FaceRoles,
    *,
    viscosity: float | Float[np.ndarray, "nx ny nz"],
    dt: float,
    spacing: float,
    wall_share: float,
    liquid_distance: Float[np.ndarray, "nx ny nz"] | None = None,
    initial: FaceVelocity | None = None,
    tolerance: float = 1e-5,
) -> tuple[FaceVelocity, tuple[SolveReport, ...]]:
    """The velocity after dt (s) of viscosity.

    Below `NEGLIGIBLE` nothing is done and no report given.

    Args:
        velocity: m/s; on fixed and wall faces what is prescribed there.
        roles: see `FaceRoles`.
        viscosity: kinematic, m^2/s; one number or per cell.
        dt: s.
        spacing: cell width, m.
        wall_share: 0 (free slip) to 1 (no slip).
        liquid_distance: signed distance to the liquid's surface at cell centres, m, negative inside, continued into
            solids. None: cells are full if none of their six faces is air.
        initial: first guess (default: `velocity`).
        tolerance: residual relative to the momentum of the fluid.

    Raises:
        ValueError: arguments of wrong shape or range.
    """
    shape = velocity.shape
    field = np.asarray(viscosity)
    require(field.shape in ((), shape), f"viscosity {field.shape}", f"a number or {shape}")
    require(bool((field >= 0).all()) and bool(np.isfinite(field).all()), "a viscosity that is negative or not finite")
    require(0.0 <= wall_share <= 1.0, f"wall share {wall_share}", "0 to 1")
    require(liquid_distance is None or liquid_distance.shape == shape, "a liquid distance of another shape", str(shape))
    number = dt / spacing**2
    if float(field.max(initial=0.0)) * number < NEGLIGIBLE:
        return velocity, ()
    scaled = None if liquid_distance is None else np.asarray(liquid_distance) / spacing
    system = build_system(
        roles, viscosity=viscosity, number=number, wall_share=wall_share, liquid_distance=scaled
    )  # fmt: skip
    if system is None:
        return velocity, ()
    given = np.stack([_crop(np.asarray(c, np.float64), system.low, system.shape, 0.0) for c in velocity.components])
    x = given * (system.roles != kernels.AIR)
    if initial is not None:
        for a, c in enumerate(initial.components):
            guess = _crop(np.asarray(c, np.float64), system.low, system.shape, 0.0)
            np.copyto(x[a], guess, where=system.mass[a] > 0)
    iterations, residual = solve(
        system, x, system.mass * given, tolerance=tolerance, max_iterations=300,
        cycles=float(field.max()) * number > CYCLES_FROM,
    )  # fmt: skip
    report = SolveReport(residual <= tolerance * 1.01, iterations, residual, "viscosity")
    return FaceVelocity(*(_pasted(c, x[a], system, a) for a, c in enumerate(velocity.components))), (report,)


def _pasted(component: np.ndarray, x: np.ndarray, system: StressSystem, axis: int) -> np.ndarray:
    """The component with its solved faces replaced."""
    out = np.array(component, np.float32)
    target, source = [], []
    for start, length, size in zip(system.low, system.shape, out.shape):
        a, b = max(start, 0), min(start + length, size)
        target.append(slice(a, b))
        source.append(slice(a - start, b - start))
    solved = system.mass[axis][tuple(source)] > 0
    np.copyto(out[tuple(target)], x[tuple(source)].astype(np.float32), where=solved)
    return out
