"""All that a clip's pictures say of the camera's tilt beside the motion of the fluid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from fluidlift.shape.texture_gradient import TexturePatches
from fluidlift.shape.view.habit import habit, runs_out
from fluidlift.shape.view.horizon import Skyline, farthest_elevation, skyline, skyline_evidence, upper_outline
from fluidlift.shape.view.plumb import PlumbLines, plumb_evidence, plumb_lines
from fluidlift.types import PinholeCamera


@dataclass(frozen=True)
class PictureEvidence:
    """What was found in the pictures; None where there is no such thing."""

    sky: Skyline | None = None
    lines: PlumbLines | None = None
    waterline: Float[np.ndarray, "n 2"] | None = None
    """px, upper outline of a fluid that lies"""
    texture: TexturePatches | None = None
    """the fluid's own pattern, where it lies in one plane"""
    open_ended: bool = True
    """the fluid runs out of the picture at its sides or below"""

    def tilt(self, camera: PinholeCamera) -> float:
        """Log likelihood of a camera (level frame, z up) given sky and plumb lines."""
        log = 0.0 if self.sky is None else skyline_evidence(camera, self.sky)
        return log if self.lines is None else log + plumb_evidence(camera, self.lines)

    def lying(
        self, pitches: Float[np.ndarray, " p"], cameras: Sequence[Sequence[PinholeCamera]],
        rise: Float[np.ndarray, "p r s"],
    ) -> Float[np.ndarray, "p r s"]:  # fmt: skip
        """Log prior of the pitch over what lies, with what its upper outline says, for pitches, rolls and planes.

        Args:
            pitches: degrees.
            cameras: level frame, z up, by pitch and roll.
            rise: degrees that the planes' vanishing lines lie above the horizon (0: level).
        """
        below = None
        if self.waterline is not None:
            top = np.array([[farthest_elevation(c, self.waterline) for c in row] for row in cameras])
            below = rise - top[..., None]
        log = habit(pitches, below, open_ended=self.open_ended, sky=self.sky is not None)
        return log if below is not None else np.broadcast_to(log[:, None, None], rise.shape)

    @property
    def words(self) -> list[str]:
        """Names of what speaks for the tilt, for the report."""
        named = {"sky": self.sky, "plumb lines": self.lines, "upper end of the water": self.waterline}
        return [name for name, found in named.items() if found is not None]


def look_at(
    picture: UInt8[np.ndarray, "h w 3"], ever: Bool[np.ndarray, "h w"], lying: Bool[np.ndarray, "h w"] | None,
    texture: TexturePatches | None = None,
) -> PictureEvidence:  # fmt: skip
    """Sky, plumb lines and waterline of a clip.

    Args:
        picture: sRGB, typical for the clip.
        ever: pixels that show fluid at some time.
        lying: pixels of fluid that lies on a plane; None: none does.
        texture: of that fluid.
    """
    return PictureEvidence(
        skyline(picture, ever), plumb_lines(picture, ~ever),
        None if lying is None or not lying.any() else upper_outline(lying), texture,
        True if lying is None else runs_out(lying),
    )  # fmt: skip
