"""The Gaussians that particles carry, on a Warp device, where the particles are."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from fluidlift.backends.warp_device import empty, on_device
from fluidlift.errors import require
from fluidlift.seams import CarriedSplats
from fluidlift.types import Gaussians

if TYPE_CHECKING:
    import warp


class WarpSplats:
    """Rest Gaussians on a device, and what becomes of them with the particles (`physics.deform.deform_gaussians`).

    Args:
        rest: the undeformed Gaussians.
        device: where the particles lie.
    """

    def __init__(self, rest: Gaussians, device: warp.Device) -> None:
        import warp as wp

        self.rest, self._device = rest, device
        self._turns, self._sizes = on_device(rest.quats, wp.vec4, device), on_device(rest.scales, wp.vec3, device)

    def carried(
        self, arrays: dict[str, warp.array], count: int, *, max_stretch: float, max_size: float
    ) -> CarriedSplats:
        """Of the first `count` particles of `ParticleStore` arrays, in new arrays: they outlive the particles' step.

        Args:
            arrays: positions, deformation and source.
            count: how many.
            max_stretch, max_size: see `deform_gaussians`.

        Raises:
            ValueError: a source outside the rest Gaussians.
        """
        import warp as wp

        from fluidlift.backends import warp_splat_kernels as kernels

        device = self._device
        types: tuple[Any, ...] = (wp.vec3, wp.vec4, wp.vec3, wp.int64)
        out = [empty(count, kind, device) for kind in types]
        if count:
            strays = wp.zeros(1, dtype=wp.int32, device=device)
            inputs = [arrays[name] for name in ("positions", "deformation", "source")]
            inputs += [self._turns, self._sizes, float(max_stretch), float(max_size)]
            wp.launch(kernels.carry_splats, count, inputs, [*out, strays], device=device)
            last = max(len(self.rest) - 1, 0)
            require(int(strays.numpy()[0]) == 0, "a particle whose source is no rest Gaussian", f"0 to {last}")
        return CarriedSplats(*out)
