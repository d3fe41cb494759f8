"""All that a clip's pictures say of the camera's tilt beside the motion of the fluid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, UInt8

from fluidlift.shape.texture_gradient import WhitenedSpectra
from fluidlift.shape.view.habit import ViewContext, habit_prior, runs_out
from fluidlift.shape.view.horizon import MISTAKEN, Skyline, farthest_elevation, skyline, skyline_evidence, upper_outline
from fluidlift.shape.view.learned import LearnedTilt
from fluidlift.shape.view.open_horizon import OpenHorizon, open_horizon
from fluidlift.shape.view.plumb import PlumbLines, plumb_evidence, plumb_lines
from fluidlift.shape.view.rims import find_rims
from fluidlift.shape.view.roundness import (
    IN_VESSEL,
    JET_LIKENESS,
    Ellipse,
    round_pool,
    roundness_evidence,
    wide_part,
)
from fluidlift.types import FluidKind, PinholeCamera

WATER_SLOPE = 3.0
"""degrees, standard deviation between the plane of some water and the level: half of all streams fall by less than 2,
and on made clips the plane is found to 1"""


@dataclass(frozen=True)
class MeasuredPlane:
    """The plane of the water, where a camera that goes somewhere has measured it."""

    up: Float[np.ndarray, "3"]
    """its unit normal in camera axes (x right, y down, z forward)"""

    def tilt(self, camera: PinholeCamera) -> float:
        """Log likelihood of a camera's tilt (level frame, z up)."""
        off = np.degrees(np.arccos(np.clip(camera.camera_from_world.rotation[:, 2] @ self.up, -1.0, 1.0)))
        log = -0.5 * (off / WATER_SLOPE) ** 2 - np.log(WATER_SLOPE * np.sqrt(2.0 * np.pi))
        return float(np.logaddexp(np.log1p(-MISTAKEN) + log, np.log(MISTAKEN / 90.0)))


@dataclass(frozen=True)
class PictureEvidence:
    """What was found in the pictures; None or nothing where there is no such thing."""

    sky: Skyline | None = None
    lines: PlumbLines | None = None
    pool: Ellipse | None = None
    """a fluid that lies, where its outline is an ellipse"""
    rims: tuple[Ellipse, ...] = ()
    """of vessels"""
    waterline: Float[np.ndarray, "n 2"] | None = None
    """px, upper outline of a fluid that lies"""
    texture: WhitenedSpectra | None = None
    """the fluid's own pattern, where it lies in one plane"""
    scene: ViewContext = field(default_factory=ViewContext)
    contained: bool = False
    """the fluid is a round pool, or in a vessel: it stirs in one place, and its motion and far edge are no stream's"""
    plane: MeasuredPlane | None = None
    """of the water"""
    horizon: OpenHorizon | None = None
    """on which standing water ends"""
    learned: LearnedTilt | None = None
    """by a learned model of the view; not in `tilt`: it is asked of pitch and roll themselves (`with_learned`)"""

    def with_learned(
        self, log: Float[np.ndarray, "p r"], pitches: Float[np.ndarray, " p"], rolls: Float[np.ndarray, " r"]
    ) -> Float[np.ndarray, "p r"]:
        """A log posterior of pitches and rolls (degrees), with what a learned model says where there is one."""
        return log if self.learned is None else log + self.learned.log(pitches, rolls)

    def tilt(self, camera: PinholeCamera) -> float:
        """Log likelihood of a camera (level frame, z up) given sky, plumb lines and what is round."""
        log = 0.0 if self.sky is None else skyline_evidence(camera, self.sky)
        if self.lines is not None:
            log += plumb_evidence(camera, self.lines)
        if self.plane is not None:
            log += self.plane.tilt(camera)
        rounds = self.rims if self.pool is None else (*self.rims, self.pool)
        return log + roundness_evidence(camera, rounds)

    def lying(
        self, kind: FluidKind, pitches: Float[np.ndarray, " p"], cameras: Sequence[Sequence[PinholeCamera]],
        rise: Float[np.ndarray, "p r s"],
    ) -> Float[np.ndarray, "p r s"]:  # fmt: skip
        """Log prior of the pitch over what lies, with what its upper outline says, for pitches, rolls and planes.

        Args:
            kind: of the fluid.
            pitches: degrees.
            cameras: level frame, z up, by pitch and roll.
            rise: degrees that the planes' vanishing lines lie above the horizon (0: level).
        """
        if self.waterline is None:
            return np.broadcast_to(habit_prior(kind, pitches, self.scene)[:, None, None], rise.shape)
        top = np.array([[farthest_elevation(c, self.waterline) for c in row] for row in cameras])
        return habit_prior(kind, pitches, self.scene, rise - top[..., None])

    @property
    def speaks(self) -> bool:
        """Whether anything says how the camera is tilted."""
        found = (self.sky, self.lines, self.pool, self.plane, self.horizon, self.learned)
        return any(f is not None for f in found) or bool(self.rims)

    @property
    def words(self) -> list[str]:
        """Names of what speaks for the tilt, for the report."""
        named = {
            "horizon of open water": self.horizon, "path of the camera": self.plane, "sky": self.sky,
            "plumb lines": self.lines,
            "roundness of the pool": self.pool,
            "rims of vessels": self.rims or None,
            "upper end of the water": self.waterline if self.horizon is None else None,
        }  # fmt: skip
        words = [name for name, found in named.items() if found is not None]
        return words if self.learned is None else [*words, self.learned.words]


def look_at(
    kind: FluidKind, picture: UInt8[np.ndarray, "h w 3"], ever: Bool[np.ndarray, "h w"],
    fluid: Bool[np.ndarray, "h w"], texture: WhitenedSpectra | None = None, *, stays: bool = False,
    drawn_sky: Skyline | None = None, rims: tuple[Ellipse, ...] | None = None,
) -> PictureEvidence:  # fmt: skip
    """Sky, plumb lines, rims, the shape of a pool and its waterline.

    Args:
        kind: of the fluid.
        picture: sRGB, typical for the clip.
        ever: pixels that show fluid at some time.
        fluid: its pixels, without the jets that fall onto it.
        texture: of that fluid.
        stays: it has no downstream: a puddle.
        drawn_sky: as a person marked it; it takes the place of what is found.
        rims: of vessels, as a person drew them or as they were found before; None: they are looked for.
    """
    sky, rims = drawn_sky or skyline(picture, ever), find_rims(picture) if rims is None else rims
    lies = kind.nearly_level and bool(fluid.any())
    pool = round_pool(fluid) if lies else None
    if kind.fills_vessel:
        pool = round_pool(wide_part(fluid), JET_LIKENESS)
    contained = stays or pool is not None or any(rim.share_inside(fluid) > IN_VESSEL for rim in rims)
    scene = ViewContext(runs_out(fluid) if lies else None, sky is not None, pool is not None or bool(rims))
    waterline = upper_outline(fluid) if lies and not contained else None
    # what runs on may fall over a brink, which looks the same
    horizon = open_horizon(picture, ever) if kind.is_standing_water and not contained else None
    return PictureEvidence(
        sky, plumb_lines(picture, ~ever), pool, rims, waterline, texture, scene, contained, horizon=horizon
    )
