"""The grid half of a liquid's substep on a Warp device: the twin of `physics.liquid_grid.LiquidGrid.step`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from fluidlift.backends.warp_emission import WarpEmission
from fluidlift.backends.warp_region import WarpRegion
from fluidlift.physics.free_surface import BAND, LAYERS, ROUNDS, SMOOTHINGS

if TYPE_CHECKING:
    import warp


def deposit(region: WarpRegion, positions: warp.array, masses: warp.array, ends: warp.array, density: float) -> None:
    """`region.share` and `region.crowd` (cells of volume around each centre), from sorted particles."""
    from fluidlift.backends import warp_surface_kernels as kernels

    r = region
    per_mass = 1.0 / (density * r.grid.spacing**3)
    inputs = [positions, masses, ends, r.low, r.spacing, float(per_mass)]
    r.launch(kernels.deposit_volumes, inputs, [r.share, r.crowd])


def find_surface(region: WarpRegion) -> None:
    """`region.surface` (m) from `region.share`."""
    from fluidlift.backends import warp_surface_kernels as kernels

    r = region

    def blurred(field: warp.array, out: warp.array) -> None:
        r.launch(kernels.three_point, [field, 0.25], [out])

    blurred(r.share, r.fill)
    if r.has_solid:
        r.continued_distance.zero_()
        r.normal.zero_()
        inputs = [r.layer, r.open_share, r.around, r.share, r.fill]
        r.launch(kernels.begin_virtual, inputs, [r.filling, r.mixed])
        for _ in range(ROUNDS):
            blurred(r.mixed, r.fill)
            for want in range(1, LAYERS + 1):
                inputs = [r.layer, want, r.open_share, r.fill]
                r.launch(kernels.continue_into_solid, inputs, [r.continued_distance, r.normal])
            inputs = [r.layer, LAYERS, r.open_share, r.share, r.continued_distance, r.normal]
            r.launch(kernels.fill_solid, inputs, [r.filling, r.mixed])
        blurred(r.mixed, r.fill)
    source = r.fill
    for turn in range(SMOOTHINGS):
        target = r.smooth if (SMOOTHINGS - turn) % 2 == 1 else r.scratch
        blurred(source, target)
        source = target
    r.launch(kernels.surface_distance, [r.fill, source, r.clear, float(BAND), r.spacing], [r.surface])


def lay_out(region: WarpRegion, counts: warp.array, emitters: Sequence[WarpEmission] = ()) -> None:
    """`surface`, `holding`, `types`, `distance`, `wet` and `gaps` of the region.

    They follow from `share`, the counts of particles per cell, and the emitters that are on.
    """
    from fluidlift.backends import warp_layout_kernels as kernels

    r = region
    find_surface(r)
    r.launch(kernels.fill_gaps, [counts, r.solid], [r.full])
    r.launch(kernels.holding_cells, [r.full, r.regions, r.buried, r.openings], [r.holding])
    r.launch(kernels.fill_below_surface, [r.holding, r.surface, r.openings], [r.filled])
    inputs = [r.holding, r.filled, r.surface, r.openings, r.buried, counts, r.spacing]
    r.launch(kernels.pressure_cells, inputs, [r.types, r.distance, r.wet])
    for emission in emitters:
        emission.fill(r)
    r.launch(kernels.surface_gaps, [r.shape, r.distance, r.types], [r.gaps], faces=True)


def continue_velocity(region: WarpRegion, velocity: Any, held: float) -> None:
    """`region.final`: a velocity continued into skin, air and walls; `held`: share that walls take of it."""
    from fluidlift.backends import warp_velocity_kernels as kernels

    r = region
    r.launch(kernels.mark_wet_faces, [r.shape, r.wet, r.openings], [r.wet_faces], faces=True)
    inputs = [r.shape, r.holding, r.types, r.openings, r.masses, r.carried, velocity, r.wet_faces]
    r.launch(kernels.carry_skin, inputs, [r.marks, r.field, r.grown, r.layers], faces=True)
    for number in range(2, CONTINUED_LAYERS + 2):
        r.launch(kernels.grow, [r.shape, number, r.grown, r.layers], faces=True)
    inputs = [r.shape, r.openings, r.normals, r.marks, r.field, r.grown, float(held)]
    r.launch(kernels.slide, inputs, [r.final], faces=True)


CONTINUED_LAYERS = 3
"""of faces beyond those with a velocity of their own, as in `boundaries.extrapolate`"""


class WarpOutlet:
    """Columns of liquid that stand in the outlet.

    Args:
        levels: float [nx,ny] of the whole box, cells: the water levels at the start, -1 where there was none.
        pull: m/s^2, downward gravity.
        device: where.
    """

    def __init__(self, levels: np.ndarray, pull: float, device: warp.Device) -> None:
        import warp as wp

        self._levels = wp.array(np.ascontiguousarray(levels, np.float32), dtype=wp.float32, device=device)
        self._pull = pull

    def find(self, region: WarpRegion, dt: float) -> None:
        """`region.known`: q (m^2/s) there, 0 elsewhere."""
        import warp as wp

        from fluidlift.backends import warp_layout_kernels as kernels

        r = region
        inputs = [r.regions, r.wet, r.buried, r.openings, r.surface, self._levels, wp.vec2i(*r.first[:2])]
        inputs += [float(r.first[2]), r.spacing, float(self._pull * dt)]
        wp.launch(kernels.outlet_heads, r.grid.shape[:2], inputs, [r.known], device=r.device)

    def hold(self, region: WarpRegion, velocity: Any, dt: float) -> None:
        """The gradient of `region.known` is subtracted between OUTFLOW cells, in place."""
        from fluidlift.backends import warp_layout_kernels as kernels

        r = region
        weight = float(self._pull * r.spacing * dt)
        inputs = [r.shape, r.regions, r.openings, r.known, r.spacing, weight, velocity]
        r.launch(kernels.hold_columns, inputs, faces=True)
