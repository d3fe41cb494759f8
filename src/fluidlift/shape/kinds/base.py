"""What a kind of fluid has to say about the construction of its body."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from jaxtyping import Bool, Float

if TYPE_CHECKING:
    from fluidlift.shape.depth_surface import DepthSlope
    from fluidlift.shape.given_depth import SceneDepth
    from fluidlift.shape.heights import HeightModel
    from fluidlift.shape.slope import SlopePrior
    from fluidlift.shape.standing import StandingBody
    from fluidlift.shape.surface import FrontSurface
    from fluidlift.shape.view.roundness import Ellipse
    from fluidlift.types import PinholeCamera


@dataclass(frozen=True)
class Observation:
    """What one view shows of the fluid, in the canonical frame (origin at the camera, z up)."""

    camera: PinholeCamera
    """its tilt as known or estimated"""
    mask: Bool[np.ndarray, "h w"]
    """fluid pixels, without the jets that fall onto it"""
    motion: Float[np.ndarray, "h w 2"]
    """mean optical flow, px per frame"""
    trust: Float[np.ndarray, "h w"]
    """of it, 0 to 1"""
    interval: float
    """s per frame"""
    camera_height: float | None
    """of a surveyed camera above the water, m"""
    tilt_known: bool
    """whether the tilt is surveyed or the user's"""
    slopes: SlopePrior
    """of such channel flows"""
    roll: float
    """degrees that the picture is turned clockwise"""
    standing: StandingBody | None
    """of a fluid that starts at rest"""
    ledges: Bool[np.ndarray, "h w"] | None = None
    """pixels of what comes down steeply onto the rest, as a person marked them"""
    rims: tuple[Ellipse, ...] = ()
    """of vessels, px"""
    ever: Bool[np.ndarray, "h w"] | None = None
    """pixels that are fluid in at least one frame; None: those of the mask"""


class BodyBuilder(Protocol):
    """Construction of a body of one kind."""

    def front_surface(self, seen: Observation) -> FrontSurface:
        """The visible side, from the outline and the motion."""
        ...

    def depth_surface(
        self, scene: SceneDepth, seen: Observation, slopes: tuple[tuple[float, float, float], ...],
        usual: HeightModel | None,
    ) -> tuple[FrontSurface, DepthSlope | None]:  # fmt: skip
        """The visible side, from the depth of the scene, and how steep it was found to run.

        Args:
            scene: depth of the whole picture, canonical.
            seen: the fluid.
            slopes: mixture (share, mean, sigma) of slopes, degrees, that its motion allows (`slopes_by_motion`).
            usual: surface that it would have without depth.
        """
        ...

    def mainstream(self, bulk: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        """Direction of the bulk flow (of any length), canonical, from the mean of the surface velocities."""
        ...


class AirborneBuilder(BodyBuilder, Protocol):
    """Construction of a body in the air, and of what is around it (`airborne.airborne_setting`)."""

    side: float
    """free space beside the body, of its larger width"""
    above: float
    """free space above it, of its height"""

    def inlet(
        self, fluid: Bool[np.ndarray, "nx ny nz"], z: Float[np.ndarray, "nx ny nz"], spacing: float
    ) -> Bool[np.ndarray, "nx ny nz"]:
        """Cells through which it enters, in the solid as well; z of cell centres and spacing in m."""
        ...

    def outlet(self, shape: tuple[int, int, int]) -> Bool[np.ndarray, "nx ny nz"]:
        """Cells at the faces of the box through which fluid leaves."""
        ...
