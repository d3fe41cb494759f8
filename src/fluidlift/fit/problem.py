"""A fit as a least-squares problem: windows of frames, rolled out and compared with their last frame."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from fluidlift.errors import require
from fluidlift.fit.loss import LossWeights, cell_velocity, grid_mask, residuals, velocity_loss
from fluidlift.numerics.poisson import PoissonSystem
from fluidlift.physics.pressure import build_system
from fluidlift.physics.rollout import Rollout, RolloutParameters, flatten, rollout, unflatten
from fluidlift.physics.rollout_domain import RolloutDomain, prepare_domain
from fluidlift.physics.rollout_pressure import RolloutOptions
from fluidlift.types import CellType, FaceVelocity, FluidParameters, Grid, Terrain

LONGEST_WINDOW = 25
"""steps; the paper's longest"""


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
class Window:
    """One rollout to be compared with one target."""

    start: Float[Tensor, "f"]
    domains: tuple[RolloutDomain, ...]
    """one per step"""
    patterns: tuple[Tensor | None, ...]
    """one per step"""
    target: Float[Tensor, "nx ny nz 3"]
    mask: Float[Tensor, "nx ny nz"]


@dataclass(frozen=True)
class FitProblem:
    """All windows, and the scale of the flow."""

    windows: tuple[Window, ...]
    speed: float
    """U, mean speed of the targets in the fluid, m/s"""
    weights: LossWeights
    options: RolloutOptions

    def roll(self, index: int, parameters: RolloutParameters, guesses: Sequence[np.ndarray] | None = None) -> Rollout:
        """DiffSim^n of one window."""
        w = self.windows[index]
        return rollout(
            w.start, w.domains, parameters, steps=len(w.domains), patterns=w.patterns, options=self.options,
            guesses=guesses,
        )  # fmt: skip

    def residual(self, index: int, result: Rollout) -> Float[np.ndarray, "nx ny nz 6"]:
        """float64; squares add up to the window's share of the loss."""
        w = self.windows[index]
        r = residuals(cell_velocity(result.faces()), w.target, w.mask, speed=self.speed, weights=self.weights)
        return r.detach().double().numpy() / math.sqrt(len(self.windows))

    def loss(self, index: int, result: Rollout) -> Tensor:
        """The window's share of the loss; differentiable."""
        w = self.windows[index]
        value = velocity_loss(cell_velocity(result.faces()), w.target, w.mask, speed=self.speed, weights=self.weights)
        return value / len(self.windows)

    def loss_at_rest(self) -> float:
        """The loss of a simulation that does not move: what a fit must beat."""
        parts = [
            velocity_loss(torch.zeros_like(w.target), w.target, w.mask, speed=self.speed, weights=self.weights)
            for w in self.windows
        ]
        return float(torch.stack(parts).mean())


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

    def inflow_values(self) -> Float[np.ndarray, "t f"]:
        """Targets as flat vectors, NaN off the inflow faces."""
        rows = []
        for target, domain in zip(self.targets, self.domains):
            flat = flatten(target, torch.float64).numpy()
            rows.append(np.where(domain.inflow > 0, flat, np.nan))
        return np.stack(rows)


def gas_layout(cell_types: np.ndarray) -> np.ndarray:
    """Air beside smoke moves as well: EMPTY cells are solved."""
    return np.where(cell_types == CellType.EMPTY, CellType.FLUID, cell_types).astype(np.uint8)


def build_scene(
    targets: Sequence[FaceVelocity],
    cell_types: Sequence[np.ndarray],
    system_or_terrain: PoissonSystem | Terrain | None,
    grid: Grid,
    *,
    kind: str,
    mainstream: np.ndarray | None = None,
    sweeps: int = 5,
) -> FitScene:
    """Layouts, operators and scales of the targets.

    Raises:
        ValueError: shapes that do not match, or targets at rest.
    """
    centers = [np.asarray(t.at_centers(), float) for t in targets]
    fluid = [np.asarray(c) == CellType.FLUID for c in cell_types]
    inside = np.concatenate([c[f] for c, f in zip(centers, fluid)])
    speeds = np.linalg.norm(inside, axis=-1)
    require(speeds.size > 0, "no FLUID cell in any frame", "cell types with fluid")
    require(bool(np.isfinite(speeds).all()), "target velocities that are not finite", "finite m/s")
    speed = float(speeds.mean())
    require(speed > 0, "targets at rest", "a flow that moves")
    if mainstream is None and isinstance(system_or_terrain, Terrain):
        mainstream = system_or_terrain.mainstream
    if mainstream is None:
        mean = inside.mean(axis=0)
        mainstream = mean / max(float(np.linalg.norm(mean)), 1e-12)
    known: dict[bytes, RolloutDomain] = {}
    domains = []
    for types in cell_types:
        types = np.ascontiguousarray(types, np.uint8)
        key = types.tobytes()
        if key not in known:
            known[key] = _layout(types, system_or_terrain, grid, kind, mainstream, sweeps)
        domains.append(known[key])
    fast = float(np.percentile(speeds, 95))
    return FitScene(tuple(targets), tuple(cell_types), tuple(domains), grid, np.asarray(mainstream, float), speed, fast)


def _layout(
    types: np.ndarray,
    system_or_terrain: PoissonSystem | Terrain | None,
    grid: Grid,
    kind: str,
    mainstream: np.ndarray,
    sweeps: int,
) -> RolloutDomain:
    gas = kind == "plume"
    if isinstance(system_or_terrain, PoissonSystem):
        system = system_or_terrain
    else:
        system = build_system(gas_layout(types) if gas else types, system_or_terrain, grid, open_border=gas)
    smoke = (types == CellType.FLUID).astype(float) if gas else None
    outlet = mainstream if (types == CellType.OUTFLOW).any() else None
    return prepare_domain(types, system, mainstream=outlet, smoke=smoke, sweeps=sweeps)


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
    velocity by twice its size at most.
    """
    h = scene.grid.spacing
    courant = scene.fast * interval / h
    kick = fall * interval / scene.speed
    steps = steps_per_frame or min(max(math.ceil(courant / 1.5), math.ceil(kick), 1), 8)
    count = len(scene.targets)
    changes = [
        np.linalg.norm(b.at_centers() - a.at_centers(), axis=-1)[t == CellType.FLUID].mean()
        for a, b, t in zip(scene.targets[:-1], scene.targets[1:], scene.cell_types)
    ]
    change = float(np.mean(changes)) / scene.speed if changes else 0.0
    extent = np.ptp(np.argwhere(scene.cell_types[0] == CellType.FLUID), axis=0).max() + 1
    # that one frame stays as it is, is an assumption: less time to be wrong
    crossing = (0.5 if count > 1 else 0.25) * extent * h / max(scene.speed * interval, 1e-12)
    longest = max(LONGEST_WINDOW // steps, 1)
    if fall > 0:
        longest = max(min(longest, round(2 * scene.speed / (fall * interval))), 1)
    length = max(1, min(round(crossing), round(1 / max(change, 1e-3)), longest))
    if count > 1:
        # half of the clip at most, so that windows differ
        length = min(length, count // 2)
    length = frames or length
    if count == 1:
        return WindowPlan((0,), length, steps, True)
    require(length < count, f"windows of {length} frames in {count} targets", "shorter windows")
    last = count - 1 - length
    starts = sorted({round(x) for x in np.linspace(0, last, min(windows, last + 1))})
    return WindowPlan(tuple(starts), length, steps, False)


def boundary_prior(scene: FitScene, initial: FluidParameters) -> FluidParameters:
    """Inlet and outlet values read off the targets where `initial` gives none (paper: "reasonable initialization").

    Bulk inflow is the mean over inlet and time of each component, the fluctuation the root mean square about it, the
    outflow the mean speed through the outlet along the mainstream.
    """
    changes: dict[str, object] = {}
    values = scene.inflow_values()
    if any(d.inflow.any() for d in scene.domains):
        o = scene.domains[0].offsets
        parts = [values[:, o[a] : o[a + 1]] for a in range(3)]
        bulk = [float(np.nanmean(p)) if np.isfinite(p).any() else 0.0 for p in parts]
        if not any(initial.inflow_velocity):
            changes["inflow_velocity"] = tuple(bulk)
        if initial.inflow_fluctuation == 0:
            changes["inflow_fluctuation"] = _inflow_deviation(scene)[1]
    if initial.outflow_velocity == 0:
        through = []
        for target, domain in zip(scene.targets, scene.domains):
            at = domain.outflow != 0
            flat = flatten(target, torch.float64).numpy()
            if at.any():
                through.append(float((flat * domain.outflow)[at].sum() / (domain.outflow[at] ** 2).sum()))
        if through:
            changes["outflow_velocity"] = float(np.mean(through))
    return initial.updated(changes)


def inflow_patterns(scene: FitScene) -> tuple[Tensor | None, ...]:
    """Deviation of the inlet velocity from its bulk, per frame, scaled to a root mean square of one.

    None where the inlet is uniform and steady.
    """
    rest, size = _inflow_deviation(scene)
    if size < 1e-6 * scene.speed:
        return (None,) * len(scene.targets)
    return tuple(torch.from_numpy((row / size).astype(np.float32)) for row in rest)


def _inflow_deviation(scene: FitScene) -> tuple[Float[np.ndarray, "t f"], float]:
    """Inlet velocity less the mean of each component over inlet and time (0 off the inlet), and its size.

    The size is that of the vector: the root of the components' mean squares added up.
    """
    values = scene.inflow_values()
    o = scene.domains[0].offsets
    rest, power = np.zeros_like(values), 0.0
    for a in range(3):
        part = values[:, o[a] : o[a + 1]]
        if np.isfinite(part).any():
            change = part - np.nanmean(part)
            power += float(np.nanmean(change**2))
            rest[:, o[a] : o[a + 1]] = np.nan_to_num(change)
    return rest, math.sqrt(power)


def build_problem(
    scene: FitScene, plan: WindowPlan, *, weights: LossWeights | None = None, options: RolloutOptions | None = None
) -> FitProblem:
    """The windows of a plan."""
    weights = weights or LossWeights()
    patterns = inflow_patterns(scene)
    windows = []
    for start in plan.starts:
        frames = [start if plan.steady else start + i for i in range(plan.frames)]
        end = start if plan.steady else start + plan.frames
        steps = [f for f in frames for _ in range(plan.steps_per_frame)]
        target = flatten(scene.targets[end])
        windows.append(
            Window(
                start=flatten(scene.targets[start]),
                domains=tuple(scene.domains[f] for f in steps),
                patterns=tuple(patterns[f] for f in steps),
                target=cell_velocity(unflatten(target, scene.domains[end])),
                mask=torch.from_numpy(grid_mask(scene.cell_types[end], weights)),
            )
        )
    return FitProblem(tuple(windows), scene.speed, weights, options or RolloutOptions())
