"""Nudging and other body forces that depend on place: a pull towards a known flow, a steady one that keeps it, and one
that goes through a film.

Nudging (Newtonian relaxation, Hoke and Anthes 1976) adds dv/dt = (v_target - v) / tau. Its time mean is what the
model lacks to keep the target by itself (flux adjustment): applied alone, it is a force like gravity, and waves, wakes
and obstacles are free.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import final

import numpy as np
from jaxtyping import Float

from fluidlift.errors import require
from fluidlift.physics.active_region import Box, face_box
from fluidlift.types import FaceVelocity, FilmedMotion

Masses = tuple[Float[np.ndarray, "..."], ...]
"""kg of liquid at the faces of each component"""


class BodyForce(ABC):
    """An acceleration in each place."""

    @abstractmethod
    def applied(self, velocity: FaceVelocity, masses: Masses, box: Box, dt: float, time: float = 0.0) -> FaceVelocity:
        """The velocity (m/s) after dt (s), on the faces of the window `box` of the simulator's grid, from `time` (s) of
        the simulation on."""

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
        self._acceleration = self.acceleration = acceleration
        squares = [float(np.square(c).max(initial=0.0)) for c in acceleration.components]
        self._largest = float(np.sqrt(sum(squares)))

    def applied(self, velocity: FaceVelocity, masses: Masses, box: Box, dt: float, time: float = 0.0) -> FaceVelocity:
        """v + a dt."""
        pairs = zip(velocity.components, self._acceleration.components)
        return FaceVelocity(*(v + np.float32(dt) * a[face_box(box, axis)] for axis, (v, a) in enumerate(pairs)))

    @property
    def largest(self) -> float:
        """m/s^2 at most"""
        return self._largest


@final
class Nudging(BodyForce):
    """A pull towards a velocity, a force that is learnt from it, and the mean of what both took.

    A pull alone stays behind: where drag or gravity act against it, the flow under it is as far from the target as the
    pull has to be strong, and its mean, applied alone, keeps that flow and not the target. So a force follows the pull,
    dF/dt = (gain pull - F) / learning (the integral part of a controller, with a leak): in a steady state the flow
    stays behind 1 + gain times less. Without the leak it would grow for ever where no force can help, as across walls.

    Args:
        target: m/s, on the faces of the simulator's grid.
        rates: 1/s per component, of its faces; 0 where nothing is known.
        after: s of the simulation that do not count in the mean.
        gain: of the learnt force over the pull in the long run; 0: none is learnt.
        learning: s over which it is learnt.
    """

    def __init__(
        self,
        target: FaceVelocity,
        rates: tuple[Float[np.ndarray, "..."], ...],
        *,
        after: float = 0.0,
        gain: float = 0.0,
        learning: float = 1.0,
    ) -> None:
        for rate, component in zip(rates, target.components):
            require(rate.shape == component.shape, f"rates {rate.shape}", str(component.shape))
        require(gain >= 0 and learning > 0, f"gain {gain}, learning {learning} s", "0 or more, above 0 s")
        self.target, self.rates, self.gain, self.learning = target, rates, gain, learning
        self._learnt = [np.zeros(c.shape, np.float32) for c in target.components]
        self._sum = [np.zeros(c.shape, np.float32) for c in target.components]
        self._behind = [np.zeros(c.shape, np.float32) for c in target.components]
        self._time = [np.zeros(c.shape, np.float32) for c in target.components]
        self.passed, self.after = 0.0, after
        """s that it has acted, and that it has to until it counts"""
        self.fetch: Callable[[], None] | None = None
        """brings `memory` and `passed` here from where the force acts, such as a GPU"""

    @property
    def memory(self) -> tuple[list[np.ndarray], ...]:
        """Per component: the learnt force (m/s^2), and the sums of change (m/s), of target - v (m) and of time (s)."""
        return self._learnt, self._sum, self._behind, self._time

    def applied(self, velocity: FaceVelocity, masses: Masses, box: Box, dt: float, time: float = 0.0) -> FaceVelocity:
        """v + (1 - exp(-dt / tau)) (v_target - v) + F dt: the decay is exact, and does not overshoot for any dt."""
        out, part = [], np.float32(-np.expm1(-dt / self.learning))
        for axis, (v, mass) in enumerate(zip(velocity.components, masses)):
            faces = face_box(box, axis)
            share = -np.expm1(-np.float32(dt) * self.rates[axis][faces])
            behind = self.target.components[axis][faces] - v
            pull = share * behind
            held, learnt = mass > 0, self._learnt[axis][faces]
            if self.gain > 0:
                wanted = np.float32(self.gain / dt) * pull
                learnt += np.where(held, part * (wanted - learnt), np.float32(0))
            change = pull + np.float32(dt) * learnt
            wet = held & (self.passed >= self.after)
            self._sum[axis][faces] += np.where(wet, change, np.float32(0))
            self._behind[axis][faces] += np.where(wet, np.float32(dt) * behind, np.float32(0))
            self._time[axis][faces] += np.where(wet, np.float32(dt), np.float32(0))
            out.append(v + change)
        self.passed += dt
        return FaceVelocity(*out)

    def mean(self) -> FaceVelocity:
        """The mean acceleration (m/s^2) that this took while faces held liquid; 0 where they seldom did.

        Where liquid comes by only now and then, the pull is that of splashes.
        """
        return self._mean(self._sum)

    def behind(self) -> FaceVelocity:
        """The mean of target - v (m/s) over the same time: what stayed in spite of all."""
        return self._mean(self._behind)

    def _mean(self, sums: list[np.ndarray]) -> FaceVelocity:
        if self.fetch is not None:
            self.fetch()
        least = 0.5 * max(self.passed - self.after, 0.0)
        pairs = zip(sums, self._time)
        return FaceVelocity(*(np.where(t > least, s / np.maximum(t, 1e-9), 0).astype(np.float32) for s, t in pairs))


@final
class Guiding(BodyForce):
    """A pull towards the velocity of each frame of a film, over and over; linear in time between its frames.

    Args:
        film: on the faces of the simulator's grid.
        rates: 1/s per component, of its faces; 0 where it does not count.
    """

    def __init__(self, film: FilmedMotion, rates: tuple[Float[np.ndarray, "..."], ...]) -> None:
        for rate, component in zip(rates, film.components):
            require(rate.shape == component.shape[1:], f"rates {rate.shape}", str(component.shape[1:]))
        self.film, self.rates = film, rates

    def applied(self, velocity: FaceVelocity, masses: Masses, box: Box, dt: float, time: float = 0.0) -> FaceVelocity:
        """v + (1 - exp(-dt / tau)) (v_target - v), with the target half a step later."""
        before, after, way = self.film.around(time + 0.5 * dt)
        out = []
        for axis, (v, rate, frames) in enumerate(zip(velocity.components, self.rates, self.film.components)):
            faces = face_box(box, axis)
            first, second = (frames[k][faces].astype(np.float32) for k in (before, after))
            target = first + np.float32(way) * (second - first)
            out.append(v - np.expm1(-np.float32(dt) * rate[faces]) * (target - v))
        return FaceVelocity(*out)
