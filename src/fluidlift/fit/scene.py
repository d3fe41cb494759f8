"""What a fit is given: targets, layouts and scales of the flow, and how the frames are cut into windows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float

from fluidlift.errors import require
from fluidlift.fit.states import noise_of, seen_faces
from fluidlift.numerics.poisson import PoissonSystem
from fluidlift.physics.pressure import build_system
from fluidlift.physics.rollout import flatten
from fluidlift.physics.rollout_domain import RolloutDomain, prepare_domain
from fluidlift.types import CellType, FaceVelocity, FluidKind, Grid, Terrain, kind_of

LONGEST_WINDOW = 25
"""steps; the paper's longest"""
SWEEPS = 5
"""cells that velocity is extrapolated beyond the fluid, for a front that crosses some within a window"""


@dataclass(frozen=True)
class WindowPlan:
    """How frames are cut into windows."""

    starts: tuple[int, ...]
    """first frames"""
    frames: int
    """length n: frame i is rolled out to frame i + n"""
    steps_per_frame: int
    steady: bool
    """one target only: it must stay as it is"""


@dataclass(frozen=True)
class FitScene:
    """Targets and layouts at the resolution of the fit."""

    targets: tuple[FaceVelocity, ...]
    cell_types: tuple[np.ndarray, ...]
    """one per target"""
    domains: tuple[RolloutDomain, ...]
    """one per target; frames of equal layout share one"""
    grid: Grid
    mainstream: np.ndarray
    speed: float
    """U, m/s"""
    fast: float
    """95th percentile of the speed, m/s"""
    observed: tuple[np.ndarray | None, ...]
    """bool [nx,ny,nz] per target; None: all cells are seen"""
    flat: tuple[Float[np.ndarray, " f"], ...]
    """targets as flat vectors, m/s; 0 on faces that were not seen"""
    seen: tuple[Bool[np.ndarray, " f"], ...]
    noise: float
    """standard deviation of the error of one face in one target, m/s"""
    firsts: tuple[int, ...] = (0,)
    """targets with which a stretch of consecutive frames begins"""

    def stretches(self) -> list[range]:
        """Targets that follow each other in time."""
        return [range(a, b) for a, b in pairwise((*self.firsts, len(self.targets)))]

    def stretch(self, frame: int) -> range:
        """The one that a target belongs to."""
        return next(r for r in self.stretches() if frame in r)

    def inflow_values(self) -> Float[np.ndarray, "t f"]:
        """Targets as flat vectors, NaN off the inflow faces and where they were not seen."""
        return np.stack(
            [np.where((d.inflow > 0) & seen, f, np.nan) for f, d, seen in zip(self.flat, self.domains, self.seen)]
        )

    def counted(self, frame: int) -> Bool[np.ndarray, "nx ny nz"]:
        """FLUID cells of a target that were seen."""
        fluid = self.cell_types[frame] == CellType.FLUID
        observed = self.observed[frame]
        return fluid if observed is None else fluid & observed


def gas_layout(cell_types: np.ndarray) -> np.ndarray:
    """Air beside smoke moves as well: EMPTY cells are solved."""
    return np.where(cell_types == CellType.EMPTY, CellType.FLUID, cell_types).astype(np.uint8)


def build_scene(
    targets: Sequence[FaceVelocity],
    cell_types: Sequence[np.ndarray],
    system_or_terrain: PoissonSystem | Terrain | None,
    grid: Grid,
    *,
    kind: str | FluidKind,
    mainstream: np.ndarray | None = None,
    observed: Sequence[np.ndarray | None] | None = None,
    firsts: Sequence[int] = (0,),
) -> FitScene:
    """Layouts, operators and scales of the targets.

    Raises:
        ValueError: stretches without targets, shapes that do not match, or targets at rest.
    """
    kind, views = kind_of(kind), [None] * len(targets) if observed is None else list(observed)
    centers = [np.asarray(t.at_centers(), float) for t in targets]
    fluid = [np.asarray(c) == CellType.FLUID for c in cell_types]
    fluid = [f if v is None else f & v for f, v in zip(fluid, views)]
    ends = (*firsts, len(targets))
    require(ends[0] == 0 and all(a < b for a, b in pairwise(ends)), f"stretches from {tuple(firsts)}", "0, ascending")
    inside = np.concatenate([c[f] for c, f in zip(centers, fluid)])
    speeds = np.linalg.norm(inside, axis=-1)
    require(speeds.size > 0, "no FLUID cell that was seen in any frame", "cell types with fluid")
    require(bool(np.isfinite(speeds).all()), "target velocities that are not finite", "finite m/s")
    require(float(speeds.mean()) > 0, "targets at rest", "a flow that moves")
    if mainstream is None and isinstance(system_or_terrain, Terrain):
        mainstream = system_or_terrain.mainstream
    if mainstream is None:
        mean = inside.mean(axis=0)
        mainstream = mean / max(float(np.linalg.norm(mean)), 1e-12)
    along = np.asarray(mainstream, float)
    known: dict[bytes, RolloutDomain] = {}
    domains = []
    for types in cell_types:
        types = np.ascontiguousarray(types, np.uint8)
        key = types.tobytes()
        if key not in known:
            known[key] = _layout(types, system_or_terrain, grid, kind, along)
        domains.append(known[key])
    seen = [seen_faces(d, np.asarray(c), v) for d, c, v in zip(domains, cell_types, views)]
    flat = [np.where(s, flatten(t, torch.float64).numpy(), 0.0) for t, s in zip(targets, seen)]
    noise = noise_of(flat, seen, firsts)
    # errors add 3 / 2 of their square to that of a cell's velocity: taken out of the mean speed
    share = max(1 - 1.5 * noise**2 / float(np.square(speeds).mean()), 0.04)
    return FitScene(
        targets=tuple(targets), cell_types=tuple(cell_types), domains=tuple(domains), grid=grid,
        mainstream=along, speed=math.sqrt(share) * float(speeds.mean()),
        fast=float(np.percentile(speeds, 95)), observed=tuple(views), flat=tuple(flat), seen=tuple(seen), noise=noise,
        firsts=tuple(firsts),
    )  # fmt: skip


def _layout(
    types: np.ndarray,
    system_or_terrain: PoissonSystem | Terrain | None,
    grid: Grid,
    kind: FluidKind,
    mainstream: np.ndarray,
) -> RolloutDomain:
    gas = kind.is_gas
    if isinstance(system_or_terrain, PoissonSystem):
        system = system_or_terrain
    else:
        system = build_system(gas_layout(types) if gas else types, system_or_terrain, grid, open_border=gas)
    smoke = (types == CellType.FLUID).astype(float) if gas else None
    outlet = mainstream if (types == CellType.OUTFLOW).any() else None
    return prepare_domain(types, system, mainstream=outlet, smoke=smoke, sweeps=SWEEPS)


def plan_windows(
    scene: FitScene,
    interval: float,
    *,
    windows: int,
    steps_per_frame: int | None = None,
    frames: int | None = None,
    fall: float = 0.0,
) -> WindowPlan:
    """Steps, length and starts of the windows from the dynamics of the targets.

    A step moves the fast fluid by at most 1.5 cells, and `fall` adds at most U in it (8 steps a frame at most). A
    window is long where the flow is steady and short where it changes: until the velocity would change by its own
    size, but no longer than fluid needs to cross half of the layout (a quarter, for one frame), half of the clip, nor
    25 steps (paper: "longer for steady-state, shorter for highly dynamic fluids"). The layout is frozen within a
    window: where a free surface is not quite in balance, `fall` (m/s^2) acts on it all along, so it may change the
    velocity by twice its size at most. Each window lies in one stretch, and each stretch has one or more.
    """
    h = scene.grid.spacing
    courant = scene.fast * interval / h
    kick = fall * interval / scene.speed
    steps = steps_per_frame or min(max(math.ceil(courant / 1.5), math.ceil(kick), 1), 8)
    count = len(scene.targets)
    change = _change(scene) / scene.speed
    extent = np.ptp(np.argwhere(scene.cell_types[0] == CellType.FLUID), axis=0).max() + 1
    # that one frame stays as it is, is an assumption: less time to be wrong
    crossing = (0.5 if count > 1 else 0.25) * extent * h / max(scene.speed * interval, 1e-12)
    longest = max(LONGEST_WINDOW // steps, 1)
    if fall > 0:
        longest = max(min(longest, round(2 * scene.speed / (fall * interval))), 1)
    length = max(1, min(round(crossing), round(1 / max(change, 1e-3)), longest))
    if count > 1:
        # half of the clip at most, so that windows differ
        length = min(length, *(max(len(r) // 2, 1) for r in scene.stretches()))
    length = frames or length
    if count == 1:
        return WindowPlan((0,), length, steps, True)
    shortest = min(len(r) for r in scene.stretches())
    require(length < shortest, f"windows of {length} frames in {shortest} targets", "shorter windows")
    each = max(windows // len(scene.firsts), 1)
    starts = sorted({f for r in scene.stretches() for f in _spread(r, length, each)})
    return WindowPlan(tuple(starts), length, steps, False)


def _spread(stretch: range, length: int, count: int) -> set[int]:
    """First frames of so many windows of a stretch, from its first to its last."""
    last = len(stretch) - 1 - length
    return {stretch[0] + round(x) for x in np.linspace(0, last, min(count, last + 1))}


def _change(scene: FitScene) -> float:
    """Root mean square change of a cell's velocity from frame to frame, less what errors make of it, m/s."""
    power = []
    for i in (i for r in scene.stretches() for i in r[:-1]):
        both = scene.counted(i) & scene.counted(i + 1)
        difference = scene.targets[i + 1].at_centers() - scene.targets[i].at_centers()
        if both.any():
            power.append(float(np.square(difference[both]).sum(axis=-1).mean()))
    # two targets, three components, each the mean of two faces
    return math.sqrt(max(float(np.mean(power)) - 3 * scene.noise**2, 0.0)) if power else 0.0
