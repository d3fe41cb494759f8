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
from jaxtyping import Float

from fluidlift.errors import require
from fluidlift.physics import stress_kernels as kernels
from fluidlift.physics.liquid_fractions import octant_shares
from fluidlift.physics.stress_multigrid import StressSystem, assemble, build_levels, v_cycle
from fluidlift.types import FaceVelocity, SolveReport

NEGLIGIBLE = 1e-4
"""dt nu / h^2 below which the step is left out: it would take 0.1 % from the finest waves of the grid, far less than
the transfers do"""

CYCLES_FROM = 2.0
"""dt nu / h^2 above which V-cycles precondition better than the diagonal, for their cost"""


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
class Region:
    """The box around the solved faces."""

    low: tuple[int, ...]
    """index of its first node, ghosts included, in the whole grid"""
    shape: tuple[int, ...]

    def overlap(self, shape: tuple[int, ...]) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
        """Slices of an array of `shape` over the whole grid, and of the box, that are the same nodes."""
        grid, box = [], []
        for start, length, size in zip(self.low, self.shape, shape):
            a, b = max(start, 0), min(start + length, size)
            grid.append(slice(a, b))
            box.append(slice(a - start, b - start))
        return tuple(grid), tuple(box)

    def crop(self, array: np.ndarray, fill: float, dtype: type | None = None) -> np.ndarray:
        """The values in the box, `fill` beyond the array."""
        out = np.full(self.shape, fill, dtype or array.dtype)
        grid, box = self.overlap(array.shape)
        out[box] = array[grid]
        return out

    def crop_repeated(self, array: np.ndarray) -> np.ndarray:
        """The values in the box, the outermost ones repeated beyond the array."""
        index = [np.clip(np.arange(a, a + n), 0, size - 1) for a, n, size in zip(self.low, self.shape, array.shape)]
        return array[np.ix_(*index)]


def _region(solved: tuple[np.ndarray, ...]) -> Region | None:
    """The box around the solved faces with two layers of nodes on each side."""
    low, high = [np.iinfo(int).max] * 3, [-1] * 3
    for mask in solved:
        for axis in range(3):
            hit = np.flatnonzero(mask.any(axis=tuple(a for a in range(3) if a != axis)))
            if len(hit):
                low[axis], high[axis] = min(low[axis], int(hit[0])), max(high[axis], int(hit[-1]))
    if high[0] < 0:
        return None
    return Region(tuple(a - 2 for a in low), tuple(b - a + 5 for a, b in zip(low, high)))


def _face_roles(roles: FaceRoles, region: Region) -> np.ndarray:
    out = np.zeros((3, *region.shape), np.int8)
    for a in range(3):
        for code, masks in ((kernels.WALL, roles.walls), (kernels.FIXED, roles.fixed), (kernels.SOLVED, roles.solved)):
            out[a][region.crop(masks[a], False)] = code
    return out


def _on_border(mask: np.ndarray, axis: int) -> np.ndarray:
    """The part of the mask on the two sides of the grid that the component crosses."""
    out = np.zeros_like(mask)
    along, inner = np.moveaxis(out, axis, 0), np.moveaxis(mask, axis, 0)
    along[0], along[-1] = inner[0], inner[-1]
    return out


def _carry_out(
    new: np.ndarray, old: np.ndarray, solved: np.ndarray, axis: int, number: Float[np.ndarray, "nx ny nz"]
) -> None:
    """Faces on open sides of the grid, which lack their outer neighbours, follow the next inner ones; in place.

    Their difference decays by the normal stress between them, with `number` = nu dt / h^2 per cell; they hold half a
    cell of liquid.
    """
    new, old, solved, number = (np.moveaxis(x, axis, 0) for x in (new, old, solved, number))
    for border, inner in ((0, 1), (-1, -2)):
        both = solved[border] & solved[inner]
        left = 0.5 / (0.5 + 2.0 * number[border])
        new[border][both] = (new[inner] + left * (old[border] - old[inner]))[both]


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
) -> tuple[StressSystem, Region] | None:
    """The operator in a box around the solved faces; None where nothing is solved. Arguments as for `diffuse`.

    Args:
        number: dt / h^2.
    """
    region = _region(roles.solved)
    if region is None:
        return None
    shape = (roles.solved[0].shape[0] - 1, *roles.solved[0].shape[1:])
    faces = _face_roles(roles, region)
    inside = region.crop(np.broadcast_to(True, shape), False)
    excluded = _all_six(faces >= kernels.FIXED) | ~inside
    if liquid_distance is None:
        wet = _all_six(faces != kernels.AIR) & ~excluded
        octants = np.repeat(wet[..., None].astype(np.float32), 8, axis=-1)
    else:
        octants = octant_shares(region.crop_repeated(np.asarray(liquid_distance, np.float32)), excluded)
    for a in range(3):
        faces[a][region.crop(_on_border(roles.solved[a], a), False)] = kernels.AIR
    slack = 1.0 / np.maximum(np.asarray(viscosity, np.float32), np.float32(1e-30))
    resistance = region.crop(np.broadcast_to(slack, shape), 1.0)
    return assemble(faces, octants, excluded, resistance, number, wall_share), region


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
    levels = build_levels(system, coarsen=cycles)
    z, rhs = levels[0].x, levels[0].rhs
    r, q, direction = momentum.copy(), np.zeros_like(x), np.zeros_like(x)
    before = float(np.square(momentum).sum())
    kernels.apply(x, q, *system.operator)
    squared, after = kernels.descend(x, r, direction, q, 1.0, system.mass, *system.columns)
    iterations, rz = 0, 1.0
    while iterations < max_iterations and squared > tolerance**2 * max(before, after):
        # near one, so that single precision neither over- nor underflows; the scale drops out of the directions
        scale = 1.0 / max(float(np.sqrt(squared)), 1e-300)
        kernels.scale_into(r, scale, system.inverse, cycles, rhs, z, *system.columns)
        if cycles:
            v_cycle(levels)
        rz, previous = kernels.dot(r, z, *system.columns), rz
        if not rz > 0:
            break
        kernels.turn(direction, z, rz / previous if iterations else 0.0, *system.columns)
        curvature = kernels.apply(direction, q, *system.operator)
        if not curvature > 0:
            break
        squared, after = kernels.descend(x, r, direction, q, rz / curvature, system.mass, *system.columns)
        iterations += 1
    kernels.apply(x, q, *system.operator)
    r[...] = momentum - q
    direction[...] = 0.0
    squared, after = kernels.descend(x, r, direction, direction, 0.0, system.mass, *system.columns)
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
    built = build_system(
        roles, viscosity=viscosity, number=number, wall_share=wall_share, liquid_distance=scaled
    )  # fmt: skip
    if built is None:
        return velocity, ()
    system, region = built
    given = np.stack([region.crop(c, 0.0, np.float64) for c in velocity.components])
    x = given * (system.roles != kernels.AIR)
    if initial is not None:
        for a, c in enumerate(initial.components):
            np.copyto(x[a], region.crop(c, 0.0), where=system.mass[a] > 0)
    iterations, residual = solve(
        system, x, system.mass * given, tolerance=tolerance, max_iterations=300,
        cycles=float(field.max()) * number > CYCLES_FROM,
    )  # fmt: skip
    report = SolveReport(residual <= tolerance * 1.01, iterations, residual, "viscosity")
    out = []
    for a, component in enumerate(velocity.components):
        new = np.array(component, np.float32)
        grid, box = region.overlap(new.shape)
        np.copyto(new[grid], x[a][box], where=system.mass[a][box] > 0, casting="same_kind")
        _carry_out(new, component, roles.solved[a], a, number * np.broadcast_to(field, shape))
        out.append(new)
    return FaceVelocity(*out), (report,)
