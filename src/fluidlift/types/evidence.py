"""What the clip says about a fluid and its camera, and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool

from fluidlift.messages import NONE, Notice
from fluidlift.types.parameters import Estimate

UNSURE = 12.0
"""degrees, error of the pitch from which the user is asked: a quarter of what lies between level and straight down, by
which lengths along the view come out wrong by half and more"""


@dataclass(frozen=True)
class KindEvidence:
    """Why a kind was chosen."""

    kind: str
    scores: dict[str, float]
    """share of belief per kind, sums to 1"""
    features: dict[str, float]
    """the measured figures behind the scores"""


@dataclass(frozen=True)
class UpEvidence:
    """Which way is up, as seen by the camera."""

    pitch: float
    """degrees that the camera looks below the horizon"""
    roll: float
    """degrees that the picture is turned clockwise"""
    source: str
    """user, camera file, or what it was estimated from"""
    confidence: float
    """0 (prior alone) to 1 (given)"""
    error: float = 0.0
    """degrees, standard deviation of what the pitch may be; 0: given, or not known"""
    raised: float = 0.0
    """degrees that the pitch is above what was seen, so that the far water does not take the cells of the near"""

    @property
    def warnings(self) -> list[Notice]:
        """What the user should know of a tilt that little is known of, or that is not what was seen."""
        found = []
        if self.raised >= 1.0:
            seen = self.pitch - self.raised
            found.append(
                Notice(
                    "view-as-relief",
                    f"the camera looks {seen:.0f} degrees down, and the scene is built as from {self.pitch:.0f}: "
                    f"a relief, "
                    "whose far shore is nearer than it is, since its near water would have too few cells; "
                    f"--pitch {seen:.0f} builds it true",
                )
            )
        if self.error <= UNSURE:
            return found
        return [
            *found,
            Notice(
                "tilt-unsure",
                f"how far the camera looks down is known to {self.error:.0f} degrees only: "
                f"{self.pitch - self.raised:.0f} is the middle "
                f"of what it may be ({self.source}); give --pitch, or a camera file, for a better shape",
            ),
        ]


@dataclass(frozen=True)
class SlopeEvidence:
    """What the motion says about the slope of a stream."""

    slope: float
    """degrees that the surface falls along the stream; 0 where the evidence is weak"""
    standard_error: float
    """degrees, of a slope that is not level (of the likeliest one, where level is taken)"""
    heading: float
    """degrees from the canonical x axis towards y, where the stream runs to"""
    level_share: float
    """probability that the stream is level"""
    likeliest: float
    """degrees, mean over the slopes that are not level"""
    source: str
    """what the slope was taken from"""
    chute: float = 0.0
    """degrees of the steepest chute that comes down onto it; 0: there is none"""

    @property
    def error(self) -> float:
        """Degrees that `slope` is off, root mean square over both models: level, and falling by `likeliest` give or
        take `standard_error`. A slope of 5 between a level one and one of 10 is not known to a degree."""
        falling = self.standard_error**2 + (self.likeliest - self.slope) ** 2
        return float((self.level_share * self.slope**2 + (1.0 - self.level_share) * falling) ** 0.5)


@dataclass(frozen=True)
class BedEvidence:
    """Where a stream's bed is seen through its water, and what that tells of the water."""

    seen: Bool[np.ndarray, "h w"]
    """pixels that show it"""
    share: float
    """of the fluid's pixels, 0 to 1"""
    estimates: dict[str, Estimate] = field(default_factory=dict)
    """the share, and what the water absorbs per channel, 1/m"""


@dataclass(frozen=True)
class MetricScale:
    """Metres per canonical unit and where that came from."""

    value: float
    source: str
    """size, ruler, depth, camera, free fall, chute, front, or assumed"""
    warning: Notice = NONE
    relative_error: float | None = None
    """standard error over value; None: not known (nothing was measured, or what was given is taken as it is)"""
    across: float = 0.0
    """m across the fluid, along the longest side of its box"""
    refusal: str = ""
    """why free fall was not used, where it was looked for"""

    @property
    def sentence(self) -> str:
        """For people: `scale: 0.42 m across the fluid, from free fall, ± 12 %`."""
        words = {"size": "as given", "ruler": "by the ruler laid along it",
                 "depth": "from the given depth", "camera": "from the surveyed camera",
                 "free fall": "from free fall", "front": "from the speed of its front",
                 "chute": "from the speed on its chute",
                 "assumed": "assumed"}  # fmt: skip
        error = "" if self.relative_error is None else f", ± {100 * 1.96 * self.relative_error:.0f} % (95 %)"
        return f"scale: {self.across:.3g} m across the fluid, {words[self.source]}{error}"
