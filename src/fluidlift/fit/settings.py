"""How a fit is done, as one value."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from fluidlift.errors import require
from fluidlift.fit.loss import VelocityLossWeights
from fluidlift.physics.rollout_pressure import RolloutOptions
from fluidlift.types.parameter_table import FITTABLE

DEFAULT_FREE = tuple(FITTABLE)
"""All of the paper's. The time step has a narrow prior: the interval between frames is known, its division a choice."""

SCALES = ((1.0, 1.0), (0.05, 0.5), (20.0, 2.0), (0.2, 1.5), (5.0, 0.7))
"""factors of viscosity and of the velocities at the ends, of restarts"""

DEVICE_FROM = 100_000
"""unknown cells for each worker from which a device rolls out faster than the CPU. Ten steps and their gradient take a
GPU 0.5 to 0.8 s from 2,000 cells to 170,000, since thousands of launches wait for each other. One thread of the CPU
beside it takes as long for 70,000 cells (beside an H100) and for 130,000 (beside an H200), and each worker has a
rollout of its own"""


def there(device: str) -> bool:
    """Whether torch computes in double precision on the device."""
    try:
        return float(torch.zeros((), dtype=torch.float64, device=device)) == 0.0
    except (RuntimeError, AssertionError, TypeError, NotImplementedError):
        return False


@dataclass(frozen=True)
class FitOptions:
    """Everything about a fit that is not data."""

    method: str = "lm"
    """"lm" (Levenberg-Marquardt, finite differences) or "adam" (analytic gradient; the paper's way)"""
    free: Sequence[str] = DEFAULT_FREE
    """parameters to fit"""
    prior_sigmas: dict[str, float] | None = None
    """raw prior widths instead of those of `types.parameter_table`"""
    weights: VelocityLossWeights | None = None
    """of the loss"""
    options: RolloutOptions | None = None
    """of the rollout: way through the pressure solve and gradient of advection"""
    windows: int = 3
    """most windows; fewer where the work does not allow them"""
    frames_per_window: int | None = None
    """n; default from the dynamics (`problem.plan_windows`)"""
    steps_per_frame: int | None = None
    """default from the Courant number"""
    compare: str = "all"
    """"all" frames of a window count, or its "last" (paper)"""
    start_rounds: int = 2
    """times that the starts of windows are corrected where targets have errors or hidden cells; 0 trusts them"""
    precise_within: float = 0.05
    """standard deviation, relative to the value (a vector's component: to its size; a value of about 0: to its natural
    scale), up to which a parameter that the data determine is called identifiable: its 95 % interval is within 10 %.
    Ones known less well, "known loosely", have their fitted value all the same"""
    restarts: int = 1
    """starts from this many initial scales; the best end counts"""
    most_cells: int = 300_000
    """layouts with more cells are coarsened by two, as often as needed"""
    coarse_first: int = 30_000
    """layouts with more cells are first fitted on cells twice as wide"""
    max_rollouts: int = 5000
    """rollouts of one window, all told"""
    max_work: float = 4e9
    """cells times steps, all told: minutes on two cores. A fit that ends by it ends at the same point everywhere"""
    max_seconds: float = 600.0
    """wall clock, the last resort: a fit that it ends is not reproducible"""
    workers: int | None = None
    """threads that roll windows out side by side; default: the cores. On the CPU results do not depend on it"""
    device: str = "cpu"
    """"cpu" rolls out in compiled kernels; any other device of torch's ("cuda", "cuda:1"), where it is faster, in torch
    operations, one window at a time, with the projections "implicit" and "jacobi" """
    device_from: int = DEVICE_FROM
    """unknown cells for each worker from which another device than the CPU is used; 0: it always is"""

    def __post_init__(self) -> None:
        require(
            there(self.device), f"device '{self.device}'", "'cpu', or a device with double precision that torch sees"
        )
        route = "implicit" if self.options is None else self.options.projection
        known = self.device == "cpu" or route in ("implicit", "jacobi")
        require(known, f"projection '{route}' on device '{self.device}'", "'implicit' or 'jacobi'")
        require(self.method in ("lm", "adam"), f"method '{self.method}'", "'lm' or 'adam'")
        require(self.compare in ("all", "last"), f"comparison of '{self.compare}' frames", "'all' or 'last'")
        require(self.windows >= 1, f"{self.windows} windows", "one or more")
        require(1 <= self.restarts <= len(SCALES), f"{self.restarts} starts", f"1 to {len(SCALES)}")
        require(self.workers is None or self.workers >= 1, f"{self.workers} workers", "one or more")
