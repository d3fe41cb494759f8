"""Emitters on a Warp device: cells, faces and particles that move as they say (twin of `physics.emitter.Emission`)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from fluidlift.backends.warp_region import WarpRegion
from fluidlift.physics.emitter import Emission

if TYPE_CHECKING:
    import warp


class WarpEmission:
    """One emitter that is on.

    Args:
        emission: on the grid of the simulation.
        device: where.
    """

    def __init__(self, emission: Emission, device: warp.Device) -> None:
        import warp as wp

        self._device, (faces, values) = device, emission.prescribed
        index = [np.column_stack([np.full(len(f), axis), f]) for axis, f in enumerate(faces)]
        self._faces = wp.array(np.concatenate(index).astype(np.int32), dtype=wp.vec4i, device=device)
        self._values = wp.array(np.concatenate(values).astype(np.float32), dtype=wp.float32, device=device)
        self._cells = wp.array(np.asarray(emission.cells, np.int32), dtype=wp.vec3i, device=device)
        own = emission.field
        self._distance = wp.array(np.ascontiguousarray(own.distance, np.float32), dtype=wp.float32, device=device)
        self._place = [wp.vec3d(*own.grid.low), wp.vec3d(*own.grid.high), float(own.grid.spacing)]
        self._velocity = wp.vec3(*(float(v) for v in emission.velocity))

    def fill(self, region: WarpRegion) -> None:
        """Its cells are INFLOW in `holding` and `types`, and wet."""
        import warp as wp

        from fluidlift.backends import warp_inlet_kernels as kernels

        inputs = [self._cells, wp.vec3i(*region.first), region.holding, region.types, region.wet]
        wp.launch(kernels.fill_emitter, len(self._cells), inputs, device=self._device)

    def impose(self, region: WarpRegion, velocity: Any) -> None:
        """Set its faces of a velocity on a region, in place."""
        import warp as wp

        from fluidlift.backends import warp_velocity_kernels as kernels

        inputs = [self._faces, self._values, wp.vec3i(*region.first)]
        wp.launch(kernels.set_faces, len(self._faces), inputs, [velocity], device=self._device)

    def mark(self, region: WarpRegion, marks: Any) -> None:
        """1 on its faces (`Marks` of the region)."""
        import warp as wp

        from fluidlift.backends import warp_velocity_kernels as kernels

        inputs = [self._faces, wp.vec3i(*region.first)]
        wp.launch(kernels.mark_faces, len(self._faces), inputs, [marks], device=self._device)

    def carry(self, positions: warp.array, velocities: warp.array, affine: warp.array, count: int) -> None:
        """Particles inside it move as it does, in place."""
        import warp as wp

        from fluidlift.backends import warp_inlet_kernels as kernels

        inputs = [self._distance, *self._place, self._velocity, positions]
        wp.launch(kernels.carry_emitter, count, inputs, [velocities, affine], device=self._device)
