"""Nudging and other body forces that depend on place: a pull towards a known flow, and a steady one that keeps it.

Nudging (Newtonian relaxation, Hoke and Anthes 1976) adds dv/dt = (v_target - v) / tau. Its time mean is what the
model lacks to keep the target by itself (flux adjustment): applied alone, it is a force like gravity, and waves, wakes
and obstacles are free.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import final

import numpy as np
from jaxtyping import Float

from fluidlift.errors import require
from fluidlift.physics.active_region import Box, face_box
from fluidlift.types import FaceVelocity

Masses = tuple[Float[np.ndarray, "..."], ...]
"""kg of liquid at the faces of each component"""


class BodyForce(ABC):
    """An acceleration in each place."""

    @abstractmethod
    def applied(self, velocity: FaceVelocity, masses: Masses, box: Box, dt: float) -> FaceVelocity:
        """The velocity (m/s) after dt (s), on the faces of the window `box` of the simulator's grid."""

    @property
    def largest(self) -> float:
        """m/s^2, for the time step; 0: not known"""
        return 0.0


@final
class SteadyForce(BodyForce):
    """The same acceleration at all times.

    Args:
        acceleration: m/s^2, on the faces of the simulator's grid.
    """

    def __init__(self, acceleration: FaceVelocity) -> None:
        self._acceleration = acceleration
        squares = [float(np.square(c).max(initial=0.0)) for c in acceleration.components]
        self._largest = float(np.sqrt(sum(squares)))

    def applied(self, velocity: FaceVelocity, masses: Masses, box: Box, dt: float) -> FaceVelocity:
        """v + a dt."""
        pairs = zip(velocity.components, self._acceleration.components)
        return FaceVelocity(*(v + np.float32(dt) * a[face_box(box, axis)] for axis, (v, a) in enumerate(pairs)))

    @property
    def largest(self) -> float:
        """m/s^2 at most"""
        return self._largest


@final
class Nudging(BodyForce):
    """A pull towards a velocity, and the mean of what it took.

    Args:
        target: m/s, on the faces of the simulator's grid.
        rates: 1/s per component, of its faces; 0 where nothing is known.
        after: s of the simulation that do not count in the mean.
    """

    def __init__(
        self,
        target: FaceVelocity,
        rates: tuple[Float[np.ndarray, "..."], ...],
        *,
        after: float = 0.0,
    ) -> None:
        for rate, component in zip(rates, target.components):
            require(rate.shape == component.shape, f"rates {rate.shape}", str(component.shape))
        self._target, self._rates = target, rates
        self._sum = [np.zeros(c.shape, np.float32) for c in target.components]
        self._time = [np.zeros(c.shape, np.float32) for c in target.components]
        self._passed, self._after = 0.0, after

    def applied(self, velocity: FaceVelocity, masses: Masses, box: Box, dt: float) -> FaceVelocity:
        """v + (1 - exp(-dt / tau)) (v_target - v): the exact decay, which does not overshoot for any dt."""
        out = []
        for axis, (v, mass) in enumerate(zip(velocity.components, masses)):
            faces = face_box(box, axis)
            share = -np.expm1(-np.float32(dt) * self._rates[axis][faces])
            change = share * (self._target.components[axis][faces] - v)
            wet = (mass > 0) & (self._passed >= self._after)
            self._sum[axis][faces] += np.where(wet, change, np.float32(0))
            self._time[axis][faces] += np.where(wet, np.float32(dt), np.float32(0))
            out.append(v + change)
        self._passed += dt
        return FaceVelocity(*out)

    def mean(self) -> FaceVelocity:
        """The mean acceleration (m/s^2) that this took while faces held liquid; 0 where they seldom did.

        Where liquid comes by only now and then, the pull is that of splashes.
        """
        least = 0.5 * max(self._passed - self._after, 0.0)
        pairs = zip(self._sum, self._time)
        return FaceVelocity(*(np.where(t > least, s / np.maximum(t, 1e-9), 0).astype(np.float32) for s, t in pairs))
