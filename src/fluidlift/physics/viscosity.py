"""Implicit viscosity (backward Euler), components coupled by the full stress (paper: `eq::v`, second term).

After Batty and Bridson 2008, "Accurate viscous free surfaces for buckling, coiling, and rotating liquids". The new
velocity v minimises

    1/2 sum over faces V (v - v*)^2  +  dt sum over stresses V nu S : S,     S = (grad v + grad v^T) / 2,

where v* is the velocity before and V the liquid inside the control volume of each face (velocity), cell centre
(S_xx, S_yy, S_zz) and edge (S_xy, S_xz, S_yz). That is backward Euler for dv/dt = div(2 nu S), stable for any step,
symmetric and positive definite. A free surface without stress is its natural boundary condition: a free body keeps
its rotation, since S vanishes, and without walls linear and angular momentum are kept.

Pressure is not part of the minimum. Where nu dt is not small against h^2, subtract the pressure gradient of the step
before first and project the rest afterwards (incremental pressure correction, van Kan 1986): a thread under tension
then stretches as it should, with three times its viscosity. Without, it stretches 1.1 (nu dt / h^2 = 1/4) to 1.5 times
too fast, since pressure acts only when the viscous step is over.

Free rigid bodies join in the minimum with their own energy (`diffuse_with_bodies`, see `viscous_bodies`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fluidlift.errors import require
from fluidlift.numerics.sharing import shared
from fluidlift.physics import stress_kernels as kernels
from fluidlift.physics.liquid_fractions import octant_shares
from fluidlift.physics.stress_multigrid import StressSystem, assemble, build_levels, fitting_threads, v_cycle
from fluidlift.physics.viscous_bodies import BodyUnknowns, DraggedBody
from fluidlift.types import FaceVelocity, SolveReport

NEGLIGIBLE = 1e-4
"""dt nu / h^2 below which the step is left out: it would take 0.1 % from the finest waves of the grid, far less than
the transfers do"""

CYCLES_FROM = 5.0
"""dt nu / h^2 above which V-cycles precondition better than the diagonal, for their cost"""


@dataclass(frozen=True)
class FaceRoles:
    """What each face does in the viscous solve, and where the surface and the walls pass between faces.

    One bool array per component. Faces in none of the three are air.
    """

    solved: tuple[np.ndarray, np.ndarray, np.ndarray]
    """velocities that are sought; all that border liquid and have a velocity"""
    fixed: tuple[np.ndarray, np.ndarray, np.ndarray]
    """given velocities that act on their neighbours (inflow, moving solids, walls that are hit head-on)"""
    walls: tuple[np.ndarray, np.ndarray, np.ndarray]
    """faces inside a wall beside the flow, which drags by its share"""
    liquid_distance: Float[np.ndarray, "nx ny nz"] | None = None
    """m, signed distance to the liquid's surface at cell centres, negative inside, continued into solids. None: cells
    are full of liquid if none of their six faces is air"""
    solid_distance: Float[np.ndarray, "nx+1 ny+1 nz+1"] | None = None
    """m, at nodes, positive outside. With it, walls lie where they are, and faces whose centre is in the solid count as
    walls. None: walls lie half way between faces"""
    solid_velocity: FaceVelocity | None = None
    """m/s, of the solid at those faces; None: at rest"""
    bodies: tuple[DraggedBody, ...] = ()
    """free bodies, for `diffuse_with_bodies`; their faces are among the fixed and the walls"""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Cells of the grid."""
        return (self.solved[0].shape[0] - 1, *self.solved[0].shape[1:])

    def __post_init__(self) -> None:
        shape = self.shape
        for masks in (self.solved, self.fixed, self.walls):
            sizes = [m.shape for m in masks]
            expected = [tuple(n + (b == a) for b, n in enumerate(shape)) for a in range(3)]
            require(sizes == expected, f"roles of faces {sizes}", str(expected))
        liquid, solid = self.liquid_distance, self.solid_distance
        require(liquid is None or liquid.shape == shape, "a liquid distance of another shape", str(shape))
        nodes = tuple(n + 1 for n in shape)
        require(solid is None or solid.shape == nodes, "a solid distance of another shape", str(nodes))


@dataclass(frozen=True)
class SolvedBox:
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

    def paste(self, array: np.ndarray, box_values: np.ndarray, where: np.ndarray) -> np.ndarray:
        """A copy of the array, float32, with the values of the box in it where the mask (of the box) says so."""
        out = np.array(array, np.float32)
        grid, box = self.overlap(out.shape)
        np.copyto(out[grid], box_values[box], where=where[box], casting="same_kind")
        return out


def _region(solved: tuple[np.ndarray, ...]) -> SolvedBox | None:
    """The box around the solved faces with two layers of nodes on each side."""
    low, high = [np.iinfo(int).max] * 3, [-1] * 3
    for mask in solved:
        for axis in range(3):
            hit = np.flatnonzero(mask.any(axis=tuple(a for a in range(3) if a != axis)))
            if len(hit):
                low[axis], high[axis] = min(low[axis], int(hit[0])), max(high[axis], int(hit[-1]))
    if high[0] < 0:
        return None
    return SolvedBox(tuple(a - 2 for a in low), tuple(b - a + 5 for a, b in zip(low, high)))


def _face_roles(roles: FaceRoles, region: SolvedBox) -> np.ndarray:
    out = np.zeros((3, *region.shape), np.int8)
    for a in range(3):
        for code, masks in ((kernels.WALL, roles.walls), (kernels.FIXED, roles.fixed), (kernels.SOLVED, roles.solved)):
            out[a][region.crop(masks[a], False)] = code
    return out


def _stacked(velocity: FaceVelocity, region: SolvedBox) -> np.ndarray:
    """float64 [3,...]: the components in the box."""
    return np.stack([region.crop(c, 0.0, np.float64) for c in velocity.components])


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


def _clearance(solid_distance: np.ndarray, region: SolvedBox) -> np.ndarray:
    """float32 [3,...]: distance of the faces' centres from the solid, the mean of their corners."""

    def mean_with_next(field: np.ndarray, axis: int) -> np.ndarray:
        size = field.shape[axis]
        return 0.5 * (field + np.take(field, np.minimum(np.arange(size) + 1, size - 1), axis))

    nodes = region.crop_repeated(solid_distance)
    return np.stack([mean_with_next(mean_with_next(nodes, (a + 1) % 3), (a + 2) % 3) for a in range(3)])


@shared(lambda x, *_: (1, x.shape[1] - 1))
def _continue_behind_walls(begin, end, x, clearance, mass, wall_share, buried):
    """Velocities of the `buried` faces (bool [3,...], role WALL), linear through the wall's; in place.

    Before, they hold the velocity of the wall. Without friction they take over that of the liquid beside them.
    """
    _, _, ny, nz = x.shape
    for i in range(begin, end):
        for a in range(3):
            for j in range(1, ny - 1):
                for k in range(1, nz - 1):
                    if not buried[a, i, j, k]:
                        continue
                    here, wall = clearance[a, i, j, k], x[a, i, j, k]
                    total, weight = 0.0, 0.0
                    for n in range(6):
                        step = 1 if n & 1 else -1
                        p, q, r = i + step * (n // 2 == 0), j + step * (n // 2 == 1), k + step * (n // 2 == 2)
                        there = clearance[a, p, q, r]
                        if mass[a, p, q, r] > 0.0 and there > here and there > 0.0:
                            kept = 1.0 - wall_share * (1.0 - max(here / there, -1.0))
                            total += (there - here) * kept * (x[a, p, q, r] - wall)
                            weight += there - here
                    if weight > 0.0:
                        x[a, i, j, k] = wall + total / weight


def build_system(
    roles: FaceRoles, *, viscosity: float | Float[np.ndarray, "nx ny nz"], dt: float, spacing: float, wall_share: float
) -> tuple[StressSystem, SolvedBox, np.ndarray] | None:
    """The operator in a box around the solved faces, the box, and the faces in it that count as wall although they are
    partly open, since their centre lies in the solid; None where nothing is solved. Arguments as for `diffuse`.
    """
    region = _region(roles.solved)
    if region is None:
        return None
    faces = _face_roles(roles, region)
    inside = region.crop(np.broadcast_to(True, roles.shape), False)
    excluded = _all_six(faces >= kernels.FIXED) | ~inside
    if roles.liquid_distance is None:
        wet = _all_six(faces != kernels.AIR) & ~excluded
        octants = np.repeat(wet[..., None].astype(np.float32), 8, axis=-1)
    else:
        octants = octant_shares(region.crop_repeated(np.asarray(roles.liquid_distance, np.float32) / spacing), excluded)
    for a in range(3):
        faces[a][region.crop(_on_border(roles.solved[a], a), False)] = kernels.AIR
    clearance, buried = None, np.zeros(faces.shape, bool)
    if roles.solid_distance is not None:
        clearance = _clearance(np.asarray(roles.solid_distance, np.float32) / spacing, region)
        if wall_share > 0.0:
            buried = (faces == kernels.SOLVED) & (clearance <= 0.0)
            faces[buried] = kernels.WALL
    slack = 1.0 / np.maximum(np.asarray(viscosity, np.float32), np.float32(1e-30))
    resistance = region.crop(np.broadcast_to(slack, roles.shape), 1.0)
    system = assemble(faces, octants, excluded, resistance, dt / spacing**2, wall_share, clearance)
    return system, region, buried


def solve(
    system: StressSystem,
    x: np.ndarray,
    momentum: np.ndarray,
    bodies: BodyUnknowns,
    *,
    tolerance: float,
    max_iterations: int,
    cycles: bool,
) -> tuple[int, float]:
    """Conjugate gradients for A x = momentum, in place; the number of iterations and the relative residual.

    The residual counts relative to the momentum of the fluid, before or after: relative to the right-hand side, which
    holds the huge forces of fixed faces nearby, bodies that fly freely would not be solved.

    Args:
        x: float64 [3,...], first guess on the solved faces, given velocities on the others.
        momentum: float64 [3,...], mass times the velocity before.
        bodies: that move with the liquid; of this x.
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
    squared += bodies.start(x)
    iterations, rz = 0, 1.0
    while iterations < max_iterations and squared > tolerance**2 * max(before, after):
        # near one, so that single precision neither over- nor underflows; the scale drops out of the directions
        scale = 1.0 / max(float(np.sqrt(squared)), 1e-300)
        kernels.scale_into(r, scale, system.inverse, cycles, rhs, z, *system.columns)
        if cycles:
            v_cycle(levels)
        rz, previous = kernels.dot(r, z, *system.columns) + bodies.steepness(scale), rz
        if not rz > 0:
            break
        factor = rz / previous if iterations else 0.0
        kernels.turn(direction, z, factor, *system.columns)
        bodies.turn(direction, factor, scale)
        curvature = kernels.apply(direction, q, *system.operator) + bodies.curvature(direction)
        if not curvature > 0:
            break
        squared, after = kernels.descend(x, r, direction, q, rz / curvature, system.mass, *system.columns)
        squared += bodies.descend(x, rz / curvature)
        iterations += 1
    kernels.apply(x, q, *system.operator)
    r[...] = momentum - q
    direction[...] = 0.0
    squared, after = kernels.descend(x, r, direction, direction, 0.0, system.mass, *system.columns)
    squared += bodies.start(x)
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
    initial: FaceVelocity | None = None,
    tolerance: float = 1e-5,
) -> tuple[FaceVelocity, tuple[SolveReport, ...]]:
    """The velocity after dt (s) of viscosity; solids move as given.

    Below `NEGLIGIBLE` nothing is done and no report given.

    Args:
        velocity: m/s; on fixed and wall faces what is prescribed there.
        roles: where the liquid is and what bounds it.
        viscosity: kinematic, m^2/s; one number or per cell.
        dt: s.
        spacing: cell width, m.
        wall_share: 0 (free slip) to 1 (no slip).
        initial: first guess (default: `velocity`).
        tolerance: residual relative to the momentum of the fluid.

    Raises:
        ValueError: arguments of wrong shape or range.
    """
    require(not roles.bodies, "bodies, whose motion would be lost", "diffuse_with_bodies")
    new, _, reports = diffuse_with_bodies(
        velocity, roles, viscosity=viscosity, dt=dt, spacing=spacing, wall_share=wall_share, initial=initial,
        tolerance=tolerance,
    )  # fmt: skip
    return new, reports


def diffuse_with_bodies(
    velocity: FaceVelocity,
    roles: FaceRoles,
    *,
    viscosity: float | Float[np.ndarray, "nx ny nz"],
    dt: float,
    spacing: float,
    wall_share: float,
    initial: FaceVelocity | None = None,
    tolerance: float = 1e-5,
) -> tuple[FaceVelocity, Float[np.ndarray, "b 6"], tuple[SolveReport, ...]]:
    """As `diffuse`, while the liquid drags `roles.bodies` along.

    On the bodies' faces `velocity` holds their motion before. Also returned: how much the velocity (m/s) and angular
    velocity (rad/s) of each body have changed.
    """
    shape, field = velocity.shape, np.asarray(viscosity)
    require(roles.shape == shape, f"roles of faces for {roles.shape} cells", str(shape))
    require(field.shape in ((), shape), f"viscosity {field.shape}", f"a number or {shape}")
    require(bool((field >= 0).all()) and bool(np.isfinite(field).all()), "a viscosity that is negative or not finite")
    require(0.0 <= wall_share <= 1.0, f"wall share {wall_share}", "0 to 1")
    number = np.broadcast_to(field * (dt / spacing**2), shape)
    largest = float(field.max(initial=0.0)) * dt / spacing**2
    built = None
    if largest >= NEGLIGIBLE:
        built = build_system(roles, viscosity=viscosity, dt=dt, spacing=spacing, wall_share=wall_share)
    if built is None:
        return velocity, np.zeros((len(roles.bodies), 6)), ()
    system, region, buried = built
    given = _stacked(velocity, region)
    given[buried] = 0.0 if roles.solid_velocity is None else _stacked(roles.solid_velocity, region)[buried]
    x = np.where(system.roles != kernels.AIR, given, 0.0)
    momentum = np.where(system.mass > 0, system.mass * given, 0.0)
    if initial is not None:
        np.copyto(x, _stacked(initial, region), where=system.mass > 0)
    bodies = BodyUnknowns(roles.bodies, region.low, system.roles >= kernels.FIXED, system.operator, x)
    with fitting_threads(system.excluded.size):
        iterations, residual = solve(
            system, x, momentum, bodies, tolerance=tolerance, max_iterations=300, cycles=largest > CYCLES_FROM
        )
        if buried.any():
            _continue_behind_walls(x, system.clearance, system.mass, wall_share, buried)
    report = SolveReport(residual <= tolerance * 1.01, iterations, residual, "viscosity")
    changed, out = (system.mass > 0) | buried, []
    bodies.mark(changed)
    for a, component in enumerate(velocity.components):
        new = region.paste(component, x[a], changed[a])
        _carry_out(new, component, roles.solved[a], a, number)
        out.append(new)
    return FaceVelocity(*out), bodies.change, (report,)
