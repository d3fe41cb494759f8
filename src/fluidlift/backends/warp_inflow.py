"""The inlet on a Warp device: the prescribed velocity of faces and particles (twin of `physics.inlet.Inlet`)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from fluidlift.backends.warp_device import empty
from fluidlift.backends.warp_emission import WarpEmission
from fluidlift.backends.warp_region import WarpBox, WarpRegion, faces_of
from fluidlift.physics.emitter import PHASES
from fluidlift.physics.inlet import Inlet
from fluidlift.types import Grid

if TYPE_CHECKING:
    import warp


class WarpInflow:
    """What an inlet prescribes. It has INFLOW cells, and no emitters.

    Args:
        inlet: of the simulation.
        grid: of the whole box.
        device: where.
    """

    def __init__(self, inlet: Inlet, grid: Grid, device: warp.Device) -> None:
        import warp as wp

        from fluidlift.backends import warp_velocity_kernels as kernels

        steady = inlet.steady
        assert steady is not None  # who asks for this has INFLOW cells
        self._inlet, self._grid = inlet, grid
        self._schedule, self._device = inlet.supply.schedule, device
        profile = steady.profile if steady.gain > 0 else None
        nothing = tuple(np.zeros((1, 1, 1), np.float32) for _ in range(3))
        waves, own = steady.fluctuation, kernels.Inflow()
        own.offset, own.gain = wp.vec3d(*steady.offset), float(steady.gain) if profile is not None else 0.0
        own.amplitude = float(steady.amplitude * np.sqrt(2.0 / len(waves.phases)))
        own.low, own.spacing = wp.vec3d(*grid.low), float(grid.spacing)
        own.profile = faces_of(nothing if profile is None else profile.components, device)
        for name, values in (("waves", waves.wave_vectors), ("directions", waves.directions)):
            setattr(own, name, wp.array(np.ascontiguousarray(values, np.float64), dtype=wp.vec3d, device=device))
        for name, values in (("frequencies", waves.frequencies), ("phases", waves.phases)):
            setattr(own, name, wp.array(np.ascontiguousarray(values, np.float64), dtype=wp.float64, device=device))
        self._own = own
        index = [np.column_stack([np.full(len(f), axis), f]) for axis, f in enumerate(steady.faces)]
        self._faces = wp.array(np.concatenate(index).astype(np.int32), dtype=wp.vec4i, device=device)
        self._points = wp.array(np.concatenate(steady.points).astype(np.float64), dtype=wp.vec3d, device=device)
        self._lattice = self._new_lattice()
        bins, places = int(np.prod(self._lattice.bins)), int(np.prod(inlet.lattice.counts))
        self._heads = empty(bins, wp.int32, device)
        self._lacking, self._ranks = (empty(places, wp.int32, device) for _ in range(2))
        self._places, self._chosen = (empty(places, wp.vec3d, device) for _ in range(2))

    def _new_lattice(self) -> Any:
        """What is the same at all times of the lattice for kernels."""
        import warp as wp

        from fluidlift.backends.warp_inlet_kernels import Lattice

        inlet, grid, given, own = self._inlet, self._grid, self._inlet.lattice, Lattice()
        own.spacing, own.reach, own.clear = given.spacing, given.reach, given.clear
        own.first, own.counts, own.along = wp.vec3i(*given.first), wp.vec3i(*given.counts), given.along
        own.phases = wp.vec2d(*PHASES)
        low, high = (grid.low + c * grid.spacing for c in inlet.cell_range)
        # a bin more on each side: places are within a spacing of the cells, and particles within reach of places
        low, high = low - 2 * given.spacing, high + 2 * given.spacing
        own.low, own.bins = wp.vec3d(*low), wp.vec3i(*(int(n) for n in np.ceil((high - low) / given.reach)))
        own.grid_low, own.grid_high, own.grid_spacing = wp.vec3d(*grid.low), wp.vec3d(*grid.high), grid.spacing
        return own

    def lacking(self, whole: WarpBox, positions: warp.array, others: warp.array, count: int) -> np.ndarray:
        """float64 [m,3], m: places of the inlet's lattice that lack a particle (`Inlet.missing`).

        Args:
            whole: walls.
            positions: of particles.
            others: int32, room for as many.
            count: of particles.
        """
        import warp as wp

        from fluidlift.backends import warp_inlet_kernels as kernels

        given, own, device = self._inlet.lattice, self._lattice, self._device
        own.start, own.turns = wp.vec3d(*given.start), wp.vec3d(*given.turns)
        self._heads.fill_(-1)
        wp.launch(kernels.put_in_bins, count, [own, positions, self._heads, others], device=device)
        inputs = [own, whole.cells["regions"], whole.nodes, positions, self._heads, others]
        wp.launch(kernels.find_lacking, given.counts, inputs, [self._places, self._lacking], device=device)
        wp.utils.array_scan(self._lacking, self._ranks, inclusive=True)
        inputs = [self._places, self._lacking, self._ranks]
        wp.launch(kernels.take_lacking, len(self._lacking), inputs, [self._chosen], device=device)
        number = int(self._ranks[-1:].numpy()[0])
        return self._chosen[:number].numpy().copy() if number else np.zeros((0, 3))

    def _at(self, time: float) -> Any:
        self._own.factor, self._own.time = float(self._schedule.factor(time)), float(time)
        return self._own

    def impose(self, region: WarpRegion, velocity: Any, time: float) -> None:
        """Set the prescribed faces of a velocity on a region, in place."""
        import warp as wp

        from fluidlift.backends import warp_velocity_kernels as kernels

        inputs = [self._at(time), self._faces, self._points, wp.vec3i(*region.first)]
        wp.launch(kernels.impose_inflow, len(self._faces), inputs, [velocity], device=self._device)

    def mark(self, region: WarpRegion, marks: Any) -> None:
        """1 on the prescribed faces (`Marks` of the region)."""
        import warp as wp

        from fluidlift.backends import warp_velocity_kernels as kernels

        inputs = [self._faces, wp.vec3i(*region.first)]
        wp.launch(kernels.mark_faces, len(self._faces), inputs, [marks], device=self._device)

    def carry(
        self, regions: warp.array, positions: warp.array, velocities: warp.array, affine: warp.array, *, count: int,
        time: float,
    ) -> None:  # fmt: skip
        """Particles in INFLOW cells (`regions`, of the whole box) move as prescribed, in place."""
        import warp as wp

        from fluidlift.backends import warp_velocity_kernels as kernels

        inputs = [self._at(time), regions, positions]
        wp.launch(kernels.carry_inflow, count, inputs, [velocities, affine], device=self._device)


class WarpInlet:
    """All that flows in: INFLOW cells, and the emitters that are on.

    Args:
        inlet: of the simulation.
        whole: the box.
    """

    def __init__(self, inlet: Inlet, whole: WarpBox) -> None:
        self._inlet, self._whole = inlet, whole
        self._steady = WarpInflow(inlet, whole.grid, whole.device) if inlet.has_cells else None
        self._emissions: dict[int, WarpEmission] = {}
        """by the number of the emitter"""

    @property
    def running(self) -> list[WarpEmission]:
        """Emitters that are on."""
        out = []
        for number, emission in enumerate(self._inlet.emissions):
            if any(emission is e for e in self._inlet.running):
                if number not in self._emissions:
                    self._emissions[number] = WarpEmission(emission, self._whole.device)
                out.append(self._emissions[number])
        return out

    def lacking(self, positions: warp.array, others: warp.array, count: int) -> np.ndarray:
        """See `WarpInflow`; nothing without INFLOW cells."""
        if self._steady is None:
            return np.zeros((0, 3))
        return self._steady.lacking(self._whole, positions, others, count)

    def impose(self, region: WarpRegion, velocity: Any, time: float) -> None:
        """Set the prescribed faces of a velocity on a region, in place."""
        if self._steady is not None:
            self._steady.impose(region, velocity, time)
        for emission in self.running:
            emission.impose(region, velocity)

    def mark(self, region: WarpRegion, marks: Any) -> None:
        """1 on the prescribed faces (`Marks` of the region), 0 on all others."""
        for name in "xyz":
            getattr(marks, name).zero_()
        if self._steady is not None:
            self._steady.mark(region, marks)
        for emission in self.running:
            emission.mark(region, marks)

    def carry(
        self, positions: warp.array, velocities: warp.array, affine: warp.array, *, count: int, time: float
    ) -> None:
        """Particles in the inlet move as prescribed, in place."""
        if self._steady is not None:
            regions = self._whole.cells["regions"]
            self._steady.carry(regions, positions, velocities, affine, count=count, time=time)
        for emission in self.running:
            emission.carry(positions, velocities, affine, count)
