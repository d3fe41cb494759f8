"""Where a moving camera was in each frame, and what it saw standing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from fluidlift.errors import require


@dataclass(frozen=True)
class CameraPath:
    """Poses of all frames of a clip, and a sparse cloud of what stands. The unit of length is unknown."""

    rotations: Float[np.ndarray, "t 3 3"]
    """of each camera (x right, y down, z forward) from the world"""
    translations: Float[np.ndarray, "t 3"]
    focal: float
    """px, with the principal point in the middle of the picture"""
    focal_error: float
    """standard deviation of the focal length, as a part of it; 0: it was given"""
    points: Float[np.ndarray, "n 3"]
    """of the cloud, in the world"""
    tracks: Int[np.ndarray, " n"]
    """which track each of them is"""
    error_px: float
    """median distance between where points are seen and where they should be, px"""

    def __post_init__(self) -> None:
        require(len(self.rotations) == len(self.translations), "a rotation for each translation")
        require(len(self.points) == len(self.tracks), f"{len(self.tracks)} tracks for {len(self.points)} points")

    @property
    def centers(self) -> Float[np.ndarray, "t 3"]:
        """Where the camera was, in the world."""
        return -np.einsum("tji,tj->ti", self.rotations, self.translations)

    def from_frame(self, reference: int) -> CameraPath:
        """The same with the camera of one frame as the world."""
        turn, shift = self.rotations[reference], self.translations[reference]
        rotations = self.rotations @ turn.T
        translations = self.translations - np.einsum("tij,j->ti", rotations, shift)
        return CameraPath(
            rotations, translations, self.focal, self.focal_error, self.points @ turn.T + shift, self.tracks,
            self.error_px,
        )  # fmt: skip


@dataclass(frozen=True)
class MeasuredView:
    """What the path of a camera tells of how it stood over the water, in the frame that all are laid on."""

    pitch: float
    """degrees that it looks below the horizon of the water's plane"""
    roll: float
    """degrees that the picture is turned clockwise"""
    focal: float
    """px"""
    focal_error: float
    """standard deviation of the focal length, as a part of it; 0: it was given; infinite: it was assumed"""
    support: float
    """share of the shore that lies on the plane, 0 to 1"""
    points: int
    """of what stands, in the path's cloud"""
    error_px: float
    """median distance between where they are seen and where they should be, px"""
