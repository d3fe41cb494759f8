"""Motion seen in pictures and motion in the world."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.errors import require

TRUSTED = 0.3
"""confidence from which the flow of a pixel counts as measured, wherever that is asked"""


@dataclass(frozen=True)
class PixelFlow:
    """Optical flow between neighbouring frames of a clip of T frames."""

    displacement: Float[np.ndarray, "t-1 h w 2"]
    """px per frame, (+x right, +y down), from frame t to t+1"""
    confidence: Float[np.ndarray, "t-1 h w"]
    """0 (flow failed) to 1"""

    def __post_init__(self) -> None:
        d = self.displacement
        require(d.ndim == 4 and d.shape[-1] == 2, f"displacement {d.shape}", "[T-1,H,W,2]")
        require(self.confidence.shape == d.shape[:-1], f"confidence {self.confidence.shape}", str(d.shape[:-1]))

    def __len__(self) -> int:
        return len(self.displacement)


@dataclass(frozen=True)
class SaidFlow:
    """What a person says of the direction of the flow, as a change of what was measured; the same for all frames."""

    turn: Float[np.ndarray, "h w 2 2"]
    """what a measured displacement is multiplied by"""
    kept: Float[np.ndarray, "h w"]
    """share of its confidence that it keeps; 0 where its direction says nothing, and the mainstream takes its place"""
    way: Float[np.ndarray, "h w 2"]
    """unit vector of what was said, times how far it counts there, 0 to 1"""

    def __post_init__(self) -> None:
        shape = self.kept.shape
        found = self.turn.shape, self.way.shape
        require(found == ((*shape, 2, 2), (*shape, 2)), f"turn and way {found}", f"those of {shape} pixels")

    @property
    def counts(self) -> Bool[np.ndarray, "h w"]:
        """Pixels for which an arrow speaks more than what was measured."""
        return np.linalg.norm(self.way, axis=-1) > 0.5

    def turned(self, flow: PixelFlow) -> PixelFlow:
        """Measured flow as it is then, float32."""
        displacement = np.einsum("hwij,thwj->thwi", self.turn, np.asarray(flow.displacement, np.float32))
        return PixelFlow(displacement.astype(np.float32), (flow.confidence * self.kept).astype(np.float32))


@dataclass(frozen=True)
class SurfaceMotion:
    """Velocity of points on the visible surface at one instant."""

    points: Float[np.ndarray, "n 3"]
    """m"""
    velocities: Float[np.ndarray, "n 3"]
    """m/s"""
    observed: Bool[np.ndarray, " n"]
    """False where the mainstream filled in"""

    def __post_init__(self) -> None:
        n = len(self.points)
        require(
            self.points.shape == (n, 3) and self.velocities.shape == (n, 3) and self.observed.shape == (n,),
            f"points {self.points.shape}, velocities {self.velocities.shape}, observed {self.observed.shape}",
            "[n,3], [n,3], [n]",
        )
