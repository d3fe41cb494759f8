"""Body forces in a liquid's substep on a Warp device (twins of `physics.forces`, `physics.guidance`)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from fluidlift.backends.warp_region import WarpRegion, faces_of
from fluidlift.physics.guidance import BodyForce, Guiding, Nudging, SteadyForce

if TYPE_CHECKING:
    import warp


class WarpForce(ABC):
    """One force on a device."""

    @abstractmethod
    def apply(self, region: WarpRegion, velocity: Any, dt: float, time: float) -> None:
        """`region.velocity` from a velocity (`Faces`), which may be the same, from `time` (s) on for dt (s)."""


class WarpForces:
    """Forces in their order, and gravity after them.

    Args:
        forces: `SteadyForce`, `Nudging` or `Guiding`.
        gravity: m/s^2.
        device: where.
    """

    def __init__(self, forces: Sequence[BodyForce], gravity: tuple[float, float, float], device: warp.Device) -> None:
        self._forces, self._gravity = [_on_device(force, device) for force in forces], gravity

    def apply(self, region: WarpRegion, dt: float, time: float) -> None:
        """`region.velocity` from `region.carried`."""
        import warp as wp

        from fluidlift.backends import warp_force_kernels as kernels

        r, velocity = region, region.carried
        for force in self._forces:
            force.apply(r, velocity, dt, time)
            velocity = r.velocity
        gain = wp.vec3(*(float(g * dt) for g in self._gravity))
        r.launch(kernels.push, [r.shape, velocity, gain], [r.velocity], faces=True)


def _on_device(force: BodyForce, device: warp.Device) -> WarpForce:
    if isinstance(force, SteadyForce):
        return _Steady(force, device)
    if isinstance(force, Nudging):
        return _Nudging(force, device)
    if isinstance(force, Guiding):
        return _Guiding(force, device)
    raise TypeError(f"a force of type {type(force).__name__}")  # `device_liquid.left_to_the_host` lets none through


class _Steady(WarpForce):
    def __init__(self, force: SteadyForce, device: warp.Device) -> None:
        self._acceleration = faces_of(force.acceleration.components, device)

    def apply(self, region: WarpRegion, velocity: Any, dt: float, time: float) -> None:
        """See `WarpForce`."""
        import warp as wp

        from fluidlift.backends import warp_force_kernels as kernels

        r = region
        inputs = [r.shape, wp.vec3i(*r.first), velocity, self._acceleration, float(dt)]
        r.launch(kernels.push_steadily, inputs, [r.velocity], faces=True)


class _Guiding(WarpForce):
    def __init__(self, force: Guiding, device: warp.Device) -> None:
        self._film, self._device = force.film, device
        self._rates = faces_of(force.rates, device)
        self._frames: dict[int, Any] = {}
        """the frames before and after, by number"""

    def apply(self, region: WarpRegion, velocity: Any, dt: float, time: float) -> None:
        """See `WarpForce`."""
        import warp as wp

        from fluidlift.backends import warp_force_kernels as kernels

        before, after, way = self._film.around(time + 0.5 * dt)
        for number in (before, after):
            if number not in self._frames:
                frame = faces_of(tuple(c[number] for c in self._film.components), self._device)
                self._frames = {n: f for n, f in self._frames.items() if n in (before, after)} | {number: frame}
        r = region
        inputs = [r.shape, wp.vec3i(*r.first), velocity, self._rates, self._frames[before], self._frames[after]]
        r.launch(kernels.guide, [*inputs, float(way), float(dt)], [r.velocity], faces=True)


class _Nudging(WarpForce):
    def __init__(self, force: Nudging, device: warp.Device) -> None:
        from fluidlift.backends.warp_force_kernels import NudgingState

        self._force, self._memory = force, NudgingState()
        if force.fetch is not None:  # it has acted on a device before
            force.fetch()
        self._memory.target = faces_of(force.target.components, device)
        self._memory.rates = faces_of(force.rates, device)
        for name, components in zip(("learnt", "change", "behind", "time"), force.memory):
            setattr(self._memory, name, faces_of(tuple(components), device))
        force.fetch = self._fetch

    def apply(self, region: WarpRegion, velocity: Any, dt: float, time: float) -> None:
        """See `WarpForce`."""
        import warp as wp

        from fluidlift.backends import warp_force_kernels as kernels

        r, force = region, self._force
        part, counts = float(-np.expm1(-dt / force.learning)), int(force.passed >= force.after)
        inputs = [r.shape, wp.vec3i(*r.first), velocity, r.masses, self._memory, float(force.gain / dt)]
        r.launch(kernels.nudge, [*inputs, part, counts, float(dt)], [r.velocity], faces=True)
        force.passed += dt

    def _fetch(self) -> None:
        """To the host's arrays of the force."""
        for name, components in zip(("learnt", "change", "behind", "time"), self._force.memory):
            faces = getattr(self._memory, name)
            for axis, component in enumerate(components):
                component[...] = getattr(faces, "xyz"[axis]).numpy()
