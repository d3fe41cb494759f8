"""A fit as a least-squares problem: windows of frames, rolled out and compared with the frames along them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from fluidlift.fit.inlet import inflow_patterns
from fluidlift.fit.loss import VelocityLossWeights, cell_velocity, grid_mask, residuals, velocity_loss
from fluidlift.fit.scene import FitScene, WindowPlan, build_scene, plan_windows
from fluidlift.fit.states import divergence_free, fill_hidden, smooth_in_time
from fluidlift.physics import rollout_torch
from fluidlift.physics.rollout import Rollout, RolloutParameters, rollout, unflatten
from fluidlift.physics.rollout_domain import RolloutDomain
from fluidlift.physics.rollout_pressure import RolloutOptions
from fluidlift.physics.rollout_torch_domain import TorchDomain, box_to_flat, flat_to_box
from fluidlift.types import SolveReport

__all__ = ["FitProblem", "RolloutWindow", "Run", "build_problem", "build_scene", "plan_windows"]

UNSEEN = 0.05
"""weight of the fill of a hidden face, relative to that of a seen one. What a fill misses is one error for a whole
hidden region and not one per face: trusted like measured faces it would outvote what the flow around it says"""


@dataclass(frozen=True)
class RolloutWindow:
    """One rollout to be compared with targets along it."""

    start: Float[Tensor, " f"]
    """open-face velocity; the rollout begins with its divergence-free part"""
    measured: Float[Tensor, " f"]
    """the start as it was measured"""
    trust: Float[Tensor, " f"]
    """weight of the measured start per face, in units of the loss over (m/s)^2; 0 where it was not seen"""
    domains: tuple[RolloutDomain, ...]
    """one per step"""
    patterns: tuple[Tensor | None, ...]
    """one per step"""
    marks: tuple[int, ...]
    """numbers of steps after which it is compared, ascending"""
    targets: tuple[Float[Tensor, "m 3"], ...]
    """one per mark, at its cells"""
    masks: tuple[Float[Tensor, " m"], ...]
    """weights, summing to 1"""
    cells: tuple[Int[Tensor, " m"], ...]
    """flat indices of the cells with a weight"""


@dataclass(frozen=True)
class Run:
    """A window rolled out."""

    velocities: tuple[Float[Tensor, "m 3"], ...]
    """one per mark, at its cells, m/s"""
    potentials: tuple[np.ndarray, ...]
    """of all steps: first guesses for a neighbouring rollout"""
    reports: tuple[SolveReport, ...]


@dataclass(frozen=True)
class FitProblem:
    """All windows, and the scale of the flow."""

    windows: tuple[RolloutWindow, ...]
    speed: float
    """U, mean speed of the targets in the fluid, m/s"""
    weights: VelocityLossWeights
    options: RolloutOptions
    device: str = "cpu"
    """"cpu": compiled kernels; any other of torch's: `rollout_torch`"""
    error: float = 0.0
    """standard deviation of the error of a component of a cell's target velocity, m/s"""
    placed: dict[int, TorchDomain] = field(default_factory=dict)
    """layouts on the device, by `id`; empty on "cpu" """
    begun: dict[int, tuple[Tensor, Tensor]] = field(default_factory=dict)
    """the start of a window and its divergence-free part, by number: what dozens of rollouts begin with"""

    @property
    def work(self) -> float:
        """Cells times steps of one rollout of all windows."""
        return float(sum(int(d.system.unknown.sum()) for w in self.windows for d in w.domains))

    def roll(
        self,
        index: int,
        parameters: RolloutParameters,
        guesses: Sequence[np.ndarray] | None = None,
        start: Float[Tensor, " f"] | None = None,
    ) -> Run:
        """DiffSim^n of one window, cut at its marks; differentiable in the parameters and in `start`."""
        w = self.windows[index]
        flat = self._begun(index) if start is None else self._divergence_free(start, w.domains[0])
        velocities, potentials, reports, begin = [], [], [], 0
        for mark, cells in zip(w.marks, w.cells):
            part = slice(begin, mark)
            known = None if guesses is None else guesses[part]
            result = self._rollout(flat, w.domains[part], parameters, w.patterns[part], known)
            flat, begin = result.velocity, mark
            velocities.append(cell_velocity(result.faces()).reshape(-1, 3)[cells])
            potentials += result.potentials
            reports += result.reports
        return Run(tuple(velocities), tuple(potentials), tuple(reports))

    def _rollout(
        self, flat: Tensor, domains: Sequence[RolloutDomain], parameters: RolloutParameters,
        patterns: Sequence[Tensor | None], guesses: Sequence[np.ndarray] | None,
    ) -> Rollout:  # fmt: skip
        """On the device; the result is back on the host."""
        given = {"steps": len(domains), "patterns": patterns, "options": self.options, "guesses": guesses}
        if not self.placed:
            return rollout(flat, domains, parameters, **given)
        layouts = [self.placed[id(d)] for d in domains]
        return rollout_torch.rollout_on_device(flat, layouts, parameters, device=self.device, **given)

    def _begun(self, index: int) -> Float[Tensor, " f"]:
        """The divergence-free part of a window's own start: no parameter acts on it, so it is found once."""
        start = self.windows[index].start
        known = self.begun.get(index)
        if known is None or known[0] is not start:  # problems with other windows share what is known
            known = self.begun[index] = (start, self._divergence_free(start, self.windows[index].domains[0]))
        return known[1]

    def _divergence_free(self, flat: Tensor, domain: RolloutDomain) -> Tensor:
        if not self.placed:
            return divergence_free(flat, domain, self.options)
        layout = self.placed[id(domain)]
        box = flat_to_box(flat.to(layout.device, layout.dtype), domain)
        is_open = torch.maximum(layout.dynamic, (layout.inflow > 0).to(layout.dtype))
        return box_to_flat(rollout_torch.project(box * is_open, layout, options=self.options), domain).to(flat.device)

    def residual(self, index: int, run: Run) -> Float[Tensor, "m 6"]:
        """Marks one after another; squares add up to the window's share of the loss; differentiable."""
        w = self.windows[index]
        parts = [
            residuals(v, t, m, speed=self.speed, weights=self.weights, error=self.error)
            for v, t, m in zip(run.velocities, w.targets, w.masks)
        ]
        return torch.cat(parts) / math.sqrt(len(self.windows) * len(w.marks))

    def loss(self, index: int, run: Run) -> Tensor:
        """The window's share of the loss; differentiable."""
        w = self.windows[index]
        parts = [
            velocity_loss(v, t, m, speed=self.speed, weights=self.weights, error=self.error)
            for v, t, m in zip(run.velocities, w.targets, w.masks)
        ]
        return torch.stack(parts).mean() / len(self.windows)

    def start_weight(self, index: int) -> Float[Tensor, " f"]:
        """What a square of 1 (m/s)^2 between a face's start and its measured value adds to the loss."""
        w = self.windows[index]
        return w.trust / (len(self.windows) * len(w.marks))

    def departure(self, index: int, start: Float[Tensor, " f"]) -> Tensor:
        """What leaving the measured start costs, in units of the loss; differentiable."""
        return (self.start_weight(index) * (start - self.windows[index].measured) ** 2).sum()

    def loss_at_rest(self) -> float:
        """The loss of a simulation that does not move: what a fit must beat."""
        parts = [
            velocity_loss(torch.zeros_like(t), t, m, speed=self.speed, weights=self.weights)
            for w in self.windows
            for t, m in zip(w.targets, w.masks)
        ]
        return float(torch.stack(parts).mean())

    def with_starts(self, starts: Sequence[Float[Tensor, " f"]]) -> FitProblem:
        """The same windows from other states."""
        return replace(self, windows=tuple(replace(w, start=s) for w, s in zip(self.windows, starts)))


def build_problem(
    scene: FitScene,
    plan: WindowPlan,
    *,
    weights: VelocityLossWeights | None = None,
    options: RolloutOptions | None = None,
    compare: str = "all",
    device: str = "cpu",
) -> FitProblem:
    """The windows of a plan.

    Args:
        scene: targets and layouts.
        plan: of the windows.
        weights: of the loss.
        options: of the rollout.
        compare: "all" frames of a window count, or its "last" (paper).
        device: of the rollouts: "cpu" (compiled kernels), or a device of torch's.
    """
    weights, options = weights or VelocityLossWeights(), options or RolloutOptions()
    # a direction within the errors is noise
    floor = max(weights.stagnant, 2 * scene.noise / scene.speed)
    weights = replace(weights, stagnant=floor)
    patterns = inflow_patterns(scene)
    windows = [_window(scene, plan, start, patterns, weights, compare) for start in plan.starts]
    layouts = {} if device == "cpu" else {id(d): d for w in windows for d in w.domains}
    placed = {key: TorchDomain.of(domain, device) for key, domain in layouts.items()}
    # a cell's velocity is the mean of two faces
    error = scene.noise / math.sqrt(2)
    return FitProblem(tuple(windows), scene.speed, weights, options, device, error, placed)


def _window(
    scene: FitScene,
    plan: WindowPlan,
    start: int,
    patterns: tuple[Tensor | None, ...],
    weights: VelocityLossWeights,
    compare: str,
) -> RolloutWindow:
    frames = [start if plan.steady else start + i for i in range(plan.frames + 1)]
    steps = [f for f in frames[:-1] for _ in range(plan.steps_per_frame)]
    compared = range(1, plan.frames + 1) if compare == "all" else [plan.frames]
    targets, masks, cells = [], [], []
    for i in compared:
        f = frames[i]
        mask = grid_mask(scene.cell_types[f], weights, scene.observed[f]).ravel()
        at = np.flatnonzero(mask > 0)
        velocity = cell_velocity(unflatten(torch.from_numpy(scene.flat[f]).float(), scene.domains[f]))
        cells.append(torch.from_numpy(at))
        targets.append(velocity.reshape(-1, 3)[cells[-1]])
        masks.append(torch.from_numpy(mask[at]))
    smooth, known = (
        smooth_in_time(scene.flat, scene.seen, start, within=scene.stretch(start))
        if scene.noise > 0.02 * scene.speed
        else (scene.flat[start], scene.seen[start])
    )
    domain = scene.domains[start]
    return RolloutWindow(
        start=torch.from_numpy(fill_hidden(smooth, known, domain)).float(),
        measured=torch.from_numpy(fill_hidden(scene.flat[start], scene.seen[start], domain)).float(),
        trust=torch.from_numpy(_trust(scene, start, weights)).float(),
        domains=tuple(scene.domains[f] for f in steps),
        patterns=tuple(patterns[f] for f in steps),
        marks=tuple(i * plan.steps_per_frame for i in compared),
        targets=tuple(targets),
        masks=tuple(masks),
        cells=tuple(cells),
    )


def _trust(scene: FitScene, frame: int, weights: VelocityLossWeights) -> Float[np.ndarray, " f"]:
    """Weight of the measured start: that of the loss for the cells beside the face.

    So a smooth error costs the same in the start as in a target, whether or not faces err independently. A direction
    adds about half of its weight.
    """
    mask = grid_mask(scene.cell_types[frame], weights, scene.observed[frame])
    typical = float(mask[mask > 0].mean())
    mask = np.where(mask > 0, mask, typical)
    out = []
    for axis in range(3):
        wide = np.pad(mask, [(int(a == axis),) * 2 for a in range(3)], mode="edge")
        n = mask.shape[axis]
        out.append(0.5 * (np.take(wide, range(n + 1), axis) + np.take(wide, range(1, n + 2), axis)).ravel())
    face = np.concatenate(out) * (weights.magnitude + 0.5 * weights.direction)
    domain, seen = scene.domains[frame], scene.seen[frame]
    is_open = domain.dynamic | (domain.inflow > 0)
    return np.where(seen, 1.0, UNSEEN * is_open) * face / scene.speed**2
