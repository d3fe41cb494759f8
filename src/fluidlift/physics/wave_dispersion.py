"""Linear waves on a liquid's free surface: how frequency and wavenumber belong together (gravity and capillarity).

sigma^2 = (g k + (T / rho) k^3) tanh(k h), on water at rest (Lamb 1932, section 267). A current U carries them along:
omega = sigma(k) + k . U. Waves that a current holds in place have omega = 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from fluidlift.errors import require
from fluidlift.types import GRAVITY

STEEPEST = 0.44
"""a k at which waves break: amplitude times wavenumber of the highest steady wave on deep water (Stokes 1880)"""


@dataclass(frozen=True)
class WaveMedium:
    """What waves run on. The default is deep clean water."""

    depth: float = 1e3
    """h, m"""
    gravity: float = GRAVITY
    """g, m/s^2"""
    tension: float = 7.28e-5
    """T / rho, m^3/s^2: 0.0728 N/m over 1000 kg/m^3, water at 20 degrees Celsius"""

    def __post_init__(self) -> None:
        good = self.depth > 0 and self.gravity > 0 and self.tension >= 0
        require(good, f"depth {self.depth} m, gravity {self.gravity} m/s^2, T/rho {self.tension}", "positive numbers")

    def frequency(self, k: Any) -> Any:
        """sigma (rad/s) on water at rest, of a wavenumber k (rad/m)."""
        k = np.asarray(k, np.float64)
        return np.sqrt((self.gravity * k + self.tension * k**3) * np.tanh(np.minimum(k * self.depth, 50.0)))

    def group_speed(self, k: Any) -> Any:
        """d sigma / d k, m/s, of a wavenumber k > 0 (rad/m)."""
        k = np.asarray(k, np.float64)
        step = 1e-4 * k
        return (self.frequency(k + step) - self.frequency(k - step)) / (2.0 * step)

    def standing(self, speed: float) -> float | None:
        """Wavenumber (rad/m) of the gravity wave that stands against a current of some speed (m/s): sigma(k) = k U.

        None: the current is slower than all waves (0.23 m/s on water), or faster than all gravity waves (sqrt(g h)).
        """
        # above this one the wave's own speed grows again: ripples
        most = np.sqrt(self.gravity / self.tension) if self.tension > 0 else 1e6
        low, high = 1e-4 / self.depth, float(most)

        def excess(k: float) -> float:
            return float(self.frequency(k)) - k * speed

        if speed <= 0 or excess(low) <= 0 or excess(high) >= 0:
            return None
        for _ in range(100):
            middle = float(np.sqrt(low * high))
            low, high = (middle, high) if excess(middle) > 0 else (low, middle)
        return float(np.sqrt(low * high))
