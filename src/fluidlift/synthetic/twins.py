"""Twin experiments: flows that the rollout itself made with known parameters, to be found again from a wrong start.

Three flows on a layout of cells that stays fixed: a `river` (a winding channel with rocks), a `pour` (a jet that falls
into a draining basin) and `honey` (a viscous film on a tilted plane). Each starts slow and speeds up, so that body
force, friction and viscosity show, and is nearly steady at the end. Grids lie along the bed: a slope is in the
direction of gravity.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from fluidlift.errors import require
from fluidlift.physics.pressure import build_system
from fluidlift.physics.rollout import RolloutParameters, flatten, rollout, unflatten
from fluidlift.physics.rollout_domain import RolloutDomain, prepare_domain
from fluidlift.physics.rollout_pressure import RolloutOptions
from fluidlift.types import GRAVITY, CellType, FaceVelocity, FluidParameters, Grid

BLOB = 1.5
"""cells: standard deviation of the smooth noise whose lowest part is hidden"""
SWEEPS = 5
"""cells that velocity is extrapolated beyond the fluid, as many as the fit does"""
EXACT = RolloutOptions(tolerance=1e-6)
"""tighter than the fit, so that the targets are not what limits it"""


@dataclass(frozen=True, eq=False)
class Twin:
    """Frames of a flow, and the parameters that made them."""

    name: str
    grid: Grid
    cell_types: UInt8[np.ndarray, "nx ny nz"]
    """of all frames"""
    frames: tuple[FaceVelocity, ...]
    """what a fit is given, m/s: with noise, and 0 where hidden"""
    observed: tuple[Bool[np.ndarray, "nx ny nz"], ...] | None
    """cells that are seen, one array per frame; None: all are"""
    interval: float
    """s between frames"""
    truth: FluidParameters
    start: FluidParameters
    """a wrong but plausible first guess"""
    mainstream: Float[np.ndarray, "3"]
    """unit direction of the outflow"""
    kind: str
    """of the fit"""
    steps_per_frame: int
    pattern: Float[np.ndarray, " f"] | None
    """flat fluctuation of the inlet of unit root mean square, steady; None: uniform inflow"""
    exact: tuple[FaceVelocity, ...]
    """the frames as they were rolled out"""

    @property
    def speed(self) -> float:
        """U: mean speed of the exact frames in the fluid, m/s."""
        fluid = self.cell_types == CellType.FLUID
        return float(np.mean([np.linalg.norm(f.at_centers()[fluid], axis=-1).mean() for f in self.exact]))

    def domain(self) -> RolloutDomain:
        """The operators of the layout, assembled once."""
        return self._domain

    @cached_property
    def _domain(self) -> RolloutDomain:
        system = build_system(self.cell_types, None, self.grid)
        return prepare_domain(self.cell_types, system, mainstream=self.mainstream, sweeps=SWEEPS)

    def continued(self, parameters: FluidParameters, start: FaceVelocity, frames: int) -> tuple[FaceVelocity, ...]:
        """The frames after `start` under some parameters."""
        step = self.interval / self.steps_per_frame
        return _frames(
            self.domain(), replace(parameters, time_step=step), start, frames, self.steps_per_frame, self.pattern
        )


@dataclass(frozen=True)
class _Plan:
    """A scene before its seed is drawn."""

    layout: Callable[[tuple[int, int, int], np.random.Generator], UInt8[np.ndarray, "nx ny nz"]]
    cells: tuple[int, int, int]
    length: float
    """m, of the first axis"""
    interval: float
    """s, at the default resolution"""
    steps_per_frame: int
    truth: FluidParameters
    slope: float
    """degrees between gravity and -z, towards +x"""
    start: FluidParameters
    start_slope: float
    mainstream: tuple[float, float, float]
    early: float
    """share of the inflow velocity that all the fluid moves with before the first frame"""


def make_twin(
    name: str,
    *,
    seed: int,
    noise: float = 0.0,
    hidden: float = 0.0,
    cells: tuple[int, int, int] | None = None,
    frames: int = 10,
    steps_per_frame: int | None = None,
) -> Twin:
    """A twin experiment. Noise and hidden cells change what is given, never the flow of a seed.

    Args:
        name: "river", "pour" or "honey".
        seed: of the true parameters (uniform within 30 % of the scene's; gravity within 10 % and 3 degrees), the
            details of the layout, the noise and the hidden cells.
        noise: standard deviation of the error of every open face, in units of U; independent per frame.
        hidden: share of the FLUID cells that no frame shows, in blobs of a few cells.
        cells: nx, ny, nz instead of the scene's; the length of the first axis stays and so does the Courant number.
        frames: number of frames.
        steps_per_frame: of the rollout that makes the frames, instead of the scene's.

    Raises:
        ValueError: an unknown name, or shares out of range.
    """
    require(name in PLANS, f"twin '{name}'", ", ".join(sorted(PLANS)))
    require(noise >= 0, f"noise {noise}", "0 or more")
    require(0 <= hidden < 1, f"hidden share {hidden}", "0 to 1")
    require(steps_per_frame is None or steps_per_frame >= 1, f"{steps_per_frame} steps per frame", "one or more")
    require(frames >= 2, f"{frames} frames", "two or more")
    plan = PLANS[name]
    shape = plan.cells if cells is None else cells
    draw, errors, cover = (np.random.default_rng([seed, part]) for part in range(3))
    grid = Grid(shape, plan.length / shape[0])
    interval = plan.interval * plan.cells[0] / shape[0]
    steps = steps_per_frame or plan.steps_per_frame
    step = interval / steps
    truth = replace(_drawn(plan, draw), time_step=step)
    types = _reached(plan.layout(shape, draw))
    mainstream = np.asarray(plan.mainstream, float)
    domain = prepare_domain(types, build_system(types, None, grid), mainstream=mainstream, sweeps=SWEEPS)
    pattern = inflow_pattern(domain, draw) if truth.inflow_fluctuation > 0 else None
    before = FaceVelocity(
        *(np.full(grid.face_shape(a), plan.early * v, np.float32) for a, v in enumerate(truth.inflow_velocity))
    )
    # the first rollout only makes the uniform motion fit the walls: it is no frame
    exact = _frames(domain, truth, before, frames, steps, pattern)
    twin = Twin(
        name=name, grid=grid, cell_types=types, frames=exact, observed=None, interval=interval, truth=truth,
        start=_tilted(replace(plan.start, time_step=step), plan.start_slope), mainstream=mainstream, kind="stream",
        steps_per_frame=steps, pattern=pattern, exact=exact,
    )  # fmt: skip
    seen = None if hidden == 0 else ~hidden_cells(types, hidden, cover)
    given = [degraded(f, domain, noise * twin.speed, errors) for f in exact] if noise > 0 else list(exact)
    if seen is not None:
        given = [without_hidden(f, types, seen) for f in given]
    return replace(twin, frames=tuple(given), observed=None if seen is None else (seen,) * frames)


def _drawn(plan: _Plan, rng: np.random.Generator) -> FluidParameters:
    """True parameters around the scene's."""
    p = plan.truth
    factor = dict(zip(("density", "nu", "in", "fluctuation", "out", "b", "d"), rng.uniform(0.7, 1.3, 7)))
    pull, slope, turn = GRAVITY * rng.uniform(0.9, 1.1), plan.slope + rng.uniform(-3, 3), rng.uniform(-3, 3)
    across = math.sin(math.radians(turn)) * pull
    drawn = replace(
        p,
        density=p.density * factor["density"],
        kinematic_viscosity=p.kinematic_viscosity * factor["nu"],
        inflow_velocity=tuple(v * factor["in"] for v in p.inflow_velocity),
        inflow_fluctuation=p.inflow_fluctuation * factor["fluctuation"],
        outflow_velocity=p.outflow_velocity * factor["out"],
        restitution=p.restitution * factor["b"],
        wall_damping=min(p.wall_damping * factor["d"], 0.97),
    )
    tilted = _tilted(drawn, slope, pull * math.cos(math.radians(turn)))
    return replace(tilted, gravity=(tilted.gravity[0], across, tilted.gravity[2]))


def _tilted(parameters: FluidParameters, degrees: float, pull: float = GRAVITY) -> FluidParameters:
    """With gravity turned from -z towards +x."""
    angle = math.radians(degrees)
    return replace(parameters, gravity=(pull * math.sin(angle), 0.0, -pull * math.cos(angle)))


def _frames(
    domain: RolloutDomain,
    parameters: FluidParameters,
    start: FaceVelocity,
    count: int,
    steps: int,
    pattern: np.ndarray | None,
) -> tuple[FaceVelocity, ...]:
    """`count` frames after `start`, each from the one before as a fit sees it (single precision)."""
    known = RolloutParameters.of(parameters)
    patterns = None if pattern is None else torch.from_numpy(pattern)
    out, flat = [], flatten(start)
    with torch.no_grad():
        for _ in range(count):
            flat = rollout(flat, domain, known, steps=steps, patterns=patterns, options=EXACT).velocity
            out.append(FaceVelocity(*(c.numpy().copy() for c in unflatten(flat, domain))))
    return tuple(out)


def inflow_pattern(domain: RolloutDomain, rng: np.random.Generator) -> Float[np.ndarray, " f"]:
    """Smooth noise over the inlet, float32: mean 0 per component, mean squares of the components add up to 1."""
    o, out, power = domain.offsets, np.zeros(domain.offsets[3]), 0.0
    for a, shape in enumerate(domain.face_shapes):
        at = domain.inflow[o[a] : o[a + 1]] > 0
        if at.sum() < 2:
            continue
        field = ndimage.gaussian_filter(rng.standard_normal(shape), 1.0, mode="nearest").ravel()[at]
        field = field - field.mean()
        out[o[a] : o[a + 1]][at] = field
        power += float(np.mean(field**2))
    return (out / math.sqrt(max(power, 1e-300))).astype(np.float32)


def hidden_cells(cell_types: np.ndarray, share: float, rng: np.random.Generator) -> Bool[np.ndarray, "nx ny nz"]:
    """The given share of the FLUID cells (to one cell), where smooth noise is lowest: blobs of a few cells."""
    fluid = cell_types == CellType.FLUID
    field = ndimage.gaussian_filter(rng.standard_normal(cell_types.shape), BLOB, mode="wrap")
    order = np.argsort(field[fluid])
    chosen = np.zeros(order.size, bool)
    chosen[order[: round(share * order.size)]] = True
    out = np.zeros(cell_types.shape, bool)
    out[fluid] = chosen
    return out


def degraded(frame: FaceVelocity, domain: RolloutDomain, sigma: float, rng: np.random.Generator) -> FaceVelocity:
    """The frame with Gaussian errors of `sigma` m/s on all open faces (walls stay at 0)."""
    o, out = domain.offsets, []
    for a, part in enumerate(frame.components):
        is_open = (domain.dynamic | (domain.inflow > 0))[o[a] : o[a + 1]].reshape(part.shape)
        out.append((part + sigma * is_open * rng.standard_normal(part.shape)).astype(np.float32))
    return FaceVelocity(*out)


def without_hidden(frame: FaceVelocity, cell_types: np.ndarray, seen: np.ndarray) -> FaceVelocity:
    """The frame with 0 on all faces that touch no seen cell of FLUID, INFLOW or OUTFLOW."""
    wet = np.isin(cell_types, (CellType.FLUID, CellType.INFLOW, CellType.OUTFLOW)) & seen
    out = []
    for a, part in enumerate(frame.components):
        pad = [(1, 1) if axis == a else (0, 0) for axis in range(3)]
        wide = np.pad(wet, pad)
        n = wet.shape[a]
        touched = np.take(wide, range(n + 1), a) | np.take(wide, range(1, n + 2), a)
        out.append(np.where(touched, part, 0).astype(np.float32))
    return FaceVelocity(*out)


def _reached(types: UInt8[np.ndarray, "nx ny nz"]) -> UInt8[np.ndarray, "nx ny nz"]:
    """The layout with fluid that no inlet reaches taken out.

    Raises:
        ValueError: the inlet reaches no outlet.
    """
    wet = np.isin(types, (CellType.FLUID, CellType.INFLOW, CellType.OUTFLOW))
    reached = np.asarray(ndimage.binary_propagation(types == CellType.INFLOW, mask=wet), bool)
    require(bool((reached & (types == CellType.OUTFLOW)).any()), "an inlet that reaches no outlet", "a connected flow")
    return np.where(wet & ~reached, CellType.EMPTY, types).astype(np.uint8)


def _shares(shape: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cell centres as shares of the box."""
    x, y, z = np.meshgrid(*((np.arange(n) + 0.5) / n for n in shape), indexing="ij")
    return x, y, z


def _fed_along_x(types: np.ndarray) -> UInt8[np.ndarray, "nx ny nz"]:
    """Fluid of the first layer becomes the inlet, that of the last the outlet."""
    types = types.astype(np.uint8)
    types[0][types[0] == CellType.FLUID] = CellType.INFLOW
    types[-1][types[-1] == CellType.FLUID] = CellType.OUTFLOW
    return types


def _river(shape: tuple[int, int, int], rng: np.random.Generator) -> UInt8[np.ndarray, "nx ny nz"]:
    """A channel that winds across the box over an uneven bed, with two rocks that break the surface or do not."""
    x, y, z = _shares(shape)
    phase, swing, rise = rng.uniform(0, 2 * np.pi), rng.uniform(0.05, 0.1), rng.uniform(0.05, 0.12)
    middle = 0.5 + swing * np.sin(2 * np.pi * x + phase)
    bed = 0.12 + rise * (1 + np.sin(3 * np.pi * x + phase)) / 2
    types = np.where(z < 0.75, CellType.FLUID, CellType.EMPTY)
    types = np.where((np.abs(y - middle) > 0.36) | (z < bed), CellType.SOLID, types)
    ratio = shape[1] / shape[0]
    for at in (rng.uniform(0.28, 0.4), rng.uniform(0.6, 0.72)):
        side, radius, top = rng.uniform(-0.12, 0.12), rng.uniform(0.1, 0.14), rng.uniform(0.5, 0.9)
        round_rock = ((x - at) / ratio) ** 2 + (y - middle - side) ** 2 < radius**2
        types = np.where(round_rock & (z < top), CellType.SOLID, types)
    return _fed_along_x(types)


def _pour(shape: tuple[int, int, int], rng: np.random.Generator) -> UInt8[np.ndarray, "nx ny nz"]:
    """A round jet from the top into a basin that drains through a slot in its far wall."""
    x, y, z = _shares(shape)
    wall = 1.2 / min(shape[:2])
    level, radius = rng.uniform(0.3, 0.36), rng.uniform(0.15, 0.18)
    at = rng.uniform(0.38, 0.5), rng.uniform(0.42, 0.58)
    rim = (x < wall) | (x > 1 - wall) | (y < wall) | (y > 1 - wall)
    types = np.where(z < level, CellType.FLUID, CellType.EMPTY)
    jet = (x - at[0]) ** 2 + (y - at[1]) ** 2 < radius**2
    types = np.where(jet & (z >= level), CellType.FLUID, types)
    types = np.where((rim & (z < level + 0.08)) | (z < 1.2 / shape[2]), CellType.SOLID, types)
    slot = (x > 1 - wall) & (np.abs(y - 0.5) < 0.3) & (z >= 1.2 / shape[2]) & (z < 0.6 * level)
    types = np.where(slot, CellType.OUTFLOW, types).astype(np.uint8)
    types[:, :, -1][types[:, :, -1] == CellType.FLUID] = CellType.INFLOW
    return types


def _honey(shape: tuple[int, int, int], rng: np.random.Generator) -> UInt8[np.ndarray, "nx ny nz"]:
    """A film on a plane between low walls, with a bump in the plane, fed at the top."""
    x, y, z = _shares(shape)
    thick, at, side = rng.uniform(0.52, 0.62), rng.uniform(0.35, 0.65), rng.uniform(0.35, 0.65)
    bump = 0.1 + 0.17 * np.exp(-(((x - at) / 0.12) ** 2) - ((y - side) / 0.2) ** 2)
    types = np.where(z < 0.1 + thick, CellType.FLUID, CellType.EMPTY)
    types = np.where((y < 1.0 / shape[1]) | (y > 1 - 1.0 / shape[1]) | (z < bump), CellType.SOLID, types)
    return _fed_along_x(types)


PLANS = {
    "river": _Plan(
        layout=_river, cells=(24, 12, 12), length=1.2, interval=0.04, steps_per_frame=2, slope=8.0, start_slope=0.0,
        truth=FluidParameters(
            kinematic_viscosity=4e-3, inflow_velocity=(1.5, 0.15, 0.0), inflow_fluctuation=0.3, outflow_velocity=1.8,
            restitution=0.2, wall_damping=0.1,
        ),
        start=FluidParameters(
            kinematic_viscosity=4e-4, inflow_velocity=(0.9, 0.0, 0.0), inflow_fluctuation=0.15, outflow_velocity=1.1,
            restitution=0.05, wall_damping=0.3,
        ),
        mainstream=(1.0, 0.0, 0.0), early=0.5,
    ),
    "pour": _Plan(
        layout=_pour, cells=(12, 12, 24), length=0.24, interval=0.03, steps_per_frame=3, slope=0.0, start_slope=0.0,
        truth=FluidParameters(
            kinematic_viscosity=1e-3, inflow_velocity=(0.08, 0.0, -0.8), outflow_velocity=0.5, restitution=0.2,
            wall_damping=0.3,
        ),
        start=FluidParameters(
            kinematic_viscosity=1e-4, inflow_velocity=(0.0, 0.0, -0.5), outflow_velocity=0.3, restitution=0.05,
            wall_damping=0.1,
        ),
        mainstream=(1.0, 0.0, 0.0), early=0.5,
    ),
    "honey": _Plan(
        layout=_honey, cells=(24, 12, 12), length=0.096, interval=0.012, steps_per_frame=2, slope=45.0,
        start_slope=45.0,
        truth=FluidParameters(
            density=1400.0, kinematic_viscosity=5e-3, inflow_velocity=(0.2, 0.0, 0.0), outflow_velocity=0.3,
            restitution=0.0, wall_damping=0.75,
        ),
        start=FluidParameters(
            density=1400.0, kinematic_viscosity=1e-3, inflow_velocity=(0.1, 0.0, 0.0), outflow_velocity=0.15,
            restitution=0.0, wall_damping=0.5,
        ),
        mainstream=(1.0, 0.0, 0.0), early=0.4,
    ),
}  # fmt: skip
"""river and pour: water whose eddies are smaller than cells. honey: ten times as viscous as the grid itself is"""
