"""What a learned model says of the camera's tilt, as one more witness beside what the pictures themselves show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

MISTAKEN_MODEL = 0.09
"""probability that a model's angle is nothing but mistaken. On the benchmark where GeoCalib is worst, 18 % of pitches
are off by more than 5 to 10 degrees (mean over that stretch, by the areas under its recall up to 5 and to 10: 53.3 and
67.5 %), where a Gaussian error of 4.5 degrees leaves 11"""
ANY = 90.0
"""degrees over which a mistaken angle may lie anywhere"""


@dataclass(frozen=True)
class LearnedTilt:
    """Pitch and roll by a learned model, with standard errors, degrees."""

    model: str
    pitch: float
    roll: float
    pitch_error: float
    roll_error: float

    def log(self, pitches: Float[np.ndarray, " p"], rolls: Float[np.ndarray, " r"]) -> Float[np.ndarray, "p r"]:
        """Log likelihood of each pitch and roll: either may be mistaken without the other."""
        of_pitch = _mixed((pitches - self.pitch) / self.pitch_error, self.pitch_error)
        return of_pitch[:, None] + _mixed((rolls - self.roll) / self.roll_error, self.roll_error)[None]

    def rolls(self, habit: float) -> Float[np.ndarray, "3"]:
        """Three evenly spaced rolls that stand for the posterior, with people's habit (standard deviation of the roll,
        degrees) as its prior."""
        mean, error = _pooled((0.0, habit), self.roll, self.roll_error)
        return mean + 1.6 * error * np.array([-1.0, 0.0, 1.0])

    def pooled_roll(self, habit: float) -> float:
        """Mean roll with people's habit, degrees."""
        return _pooled((0.0, habit), self.roll, self.roll_error)[0]

    def pooled_pitch(self, usual: tuple[float, float]) -> tuple[float, float]:
        """Mean and standard deviation of the pitch, degrees, with those that are usual before."""
        return _pooled(usual, self.pitch, self.pitch_error)

    @property
    def words(self) -> str:
        """For the report."""
        return f"{self.model} ({self.pitch:.0f} degrees, within {self.pitch_error:.0f})"


def _mixed(off: np.ndarray, error: float) -> np.ndarray:
    meant = np.log1p(-MISTAKEN_MODEL) - 0.5 * off**2 - np.log(error * np.sqrt(2.0 * np.pi))
    return np.logaddexp(meant, np.log(MISTAKEN_MODEL / ANY))


def _pooled(usual: tuple[float, float], value: float, error: float) -> tuple[float, float]:
    """Mean and standard deviation of both Gaussians; the usual one where the value is more likely mistaken than not."""
    mean, spread = usual
    together = float(np.hypot(spread, error))
    likely = -0.5 * ((value - mean) / together) ** 2 - np.log(together * np.sqrt(2.0 * np.pi))
    if np.log1p(-MISTAKEN_MODEL) + likely < np.log(MISTAKEN_MODEL / ANY):
        return usual
    ours, theirs = spread**-2.0, error**-2.0
    return (ours * mean + theirs * value) / (ours + theirs), float((ours + theirs) ** -0.5)
