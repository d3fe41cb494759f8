"""The whole substep of a liquid on a Warp device: particles and grid stay there from step to step.

It takes the steps of `physics.apic.LiquidSimulator` and `physics.liquid_grid.LiquidGrid` in single precision. The host
hears of it in two short copies a substep (extent and speed before, displacements and leaving particles after), in
the norms that the pressure solver looks at, and when it asks for the particles.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from fluidlift.backends.warp_device import empty, warp_device
from fluidlift.backends.warp_drag import WarpDrag
from fluidlift.backends.warp_forces import WarpForces
from fluidlift.backends.warp_inflow import WarpInlet
from fluidlift.backends.warp_liquid_grid import WarpOutlet, continue_velocity, deposit, lay_out
from fluidlift.backends.warp_particle_store import ParticleStore
from fluidlift.backends.warp_projection import WarpProjection
from fluidlift.backends.warp_region import WarpBox, WarpRegion
from fluidlift.backends.warp_splats import WarpSplats
from fluidlift.physics.active_region import Box, moved_to, region_of_extent
from fluidlift.physics.boundaries import CLEARANCE
from fluidlift.physics.device_liquid import DeviceLiquid, DeviceSetup
from fluidlift.physics.liquid_grid import STRONG
from fluidlift.physics.position_correction import LARGEST_MOVE
from fluidlift.physics.reseed import LIGHTEST_PARENT, SPLIT_DISTANCE
from fluidlift.physics.viscosity import NEGLIGIBLE
from fluidlift.seams import CONTACT, CarriedSplats, LiquidStepper, Stepped
from fluidlift.types import Gaussians, Particles, SolveReport

if TYPE_CHECKING:
    import warp


class WarpLiquids(DeviceLiquid):
    """Liquids on a device.

    Args:
        device: "cuda", "cuda:1"... or "cpu", see `warp_device`.
    """

    def __init__(self, device: str = "cuda") -> None:
        self._device = warp_device(device)

    def begin(self, setup: DeviceSetup) -> LiquidStepper:
        """See `DeviceLiquid`."""
        return WarpLiquid(setup, self._device)


class WarpLiquid(LiquidStepper):
    """A liquid on a device.

    Args:
        setup: walls, inlet, parameters and settings.
        device: where.
    """

    def __init__(self, setup: DeviceSetup, device: warp.Device) -> None:

        s = setup.surroundings
        self._setup, self._device, self._store = setup, device, ParticleStore(device)
        self._grid, self._parameters, self._settings = s.grid, s.parameters, s.settings
        self._whole = WarpBox(s.walls, s.capacity, setup.solids, device)
        self._inlet = WarpInlet(s.inlet, self._whole)
        gravity = s.parameters.gravity
        self._forces = WarpForces(setup.forces, gravity, device)
        levels, pull = setup.start_levels, max(-gravity[2], 0.0)
        self._outlet = None if levels is None else WarpOutlet(levels, pull, device)
        self._has_outlet = setup.start_levels is not None
        self._splats: WarpSplats | None = None
        self._pressure: WarpProjection
        self._drag: WarpDrag | None = None
        self._box: Box | None = None
        self._region: WarpRegion | None = None
        self._last: tuple[tuple[int, int, int], np.ndarray] | None = None
        self._has_rate = False
        self._found: tuple[np.ndarray, np.ndarray, float] | None = None
        self._gone_count = 0
        self._dt = 0.0
        self._box_of_step = self._walls()
        self.told: Callable[[str], None] = lambda part: None
        """told the name of each part of a substep when all of it is on its way to the device"""

    @property
    def count(self) -> int:
        """See `LiquidStepper`."""
        return self._store.count

    def upload(self, particles: Particles) -> None:
        """See `LiquidStepper`."""
        self._store.upload(particles)
        self._found = None

    def download(self, *, by_id: bool = False) -> Particles:
        """See `LiquidStepper`."""
        return self._store.download(by_id=by_id)

    def splats(self, rest: Gaussians, *, max_stretch: float, max_size: float, by_id: bool = False) -> CarriedSplats:
        """See `LiquidStepper`."""
        if self._splats is None or self._splats.rest is not rest:
            self._splats = WarpSplats(rest, self._device)
        arrays = self._store.arrays(by_id=by_id)
        return self._splats.carried(arrays, self._store.count, max_stretch=max_stretch, max_size=max_size)

    def append(self, particles: Particles) -> None:
        """See `LiquidStepper`."""
        self._store.append(particles)
        self._found = None

    def lacking(self) -> np.ndarray:
        """See `LiquidStepper`."""
        store = self._store
        store.reserve(1)  # the arrays are there, for a tank that begins empty
        return self._inlet.lacking(store.field("positions"), store.scratch, store.count)

    def carry(self, time: float) -> None:
        """See `LiquidStepper`."""
        if not self._store.count:
            return
        fields = [self._store.field(name) for name in ("positions", "velocities", "affine")]
        self._inlet.carry(*fields, count=self._store.count, time=time)
        self._found = None

    def max_speed(self) -> float:
        """See `LiquidStepper`."""
        return self._summary()[2] if self._store.count else 0.0

    def mass(self) -> float:
        """See `LiquidStepper`."""
        return self._store.mass() if self.count else 0.0

    def wet_cells(self) -> int:
        """See `LiquidStepper`."""
        return self._store.filled_cells(self._grid) if self.count else 0

    def take_out(self, cells: np.ndarray) -> tuple[int, float]:
        """See `LiquidStepper`."""
        import warp as wp

        from fluidlift.backends import warp_sorting_kernels as kernels

        store = self._store
        marked = wp.array(np.ascontiguousarray(cells, np.uint8), dtype=wp.uint8, device=self._device)
        inputs = [store.field("positions"), marked, wp.vec3d(*self._grid.low), float(self._grid.spacing), store.gone]
        wp.launch(kernels.in_cells, store.count, inputs, device=self._device)
        gone = store.gone[: store.count].numpy() != 0
        number = int(gone.sum())
        if not number:
            return 0, 0.0
        mass = float(store.field("masses")[: store.count].numpy()[gone].sum(dtype=np.float64))
        store.keep(store.gone, number)
        self._found = None
        return number, mass

    def prepare(self, first_id: int, draw: Callable[[int], np.ndarray] | None) -> int:
        """See `LiquidStepper`."""
        region = self._look()
        self.told("region")
        counts, ends = self._store.sort(region.grid)
        self.told("sort")
        made = 0
        if draw is not None:
            leaving, made = self._reseed(region, ends, first_id, draw)
            if leaving or made:
                counts, ends = self._store.sort(region.grid, self._store.gone, leaving)
                self._found = None
            self.told("reseeding")
        self._cells = counts, ends
        return made

    def step(self, dt: float, time: float) -> Stepped:
        """See `LiquidStepper`."""
        region = self._region
        assert region is not None  # `prepare` was called
        self._dt = dt
        pressure, viscosity = self._grid_step(region, dt, time)
        self._gather(region, dt, time)
        self.told("grid to particles")
        self._spread(region)
        self.told("crowds")
        farthest, self._gone_count = self._move(region, dt)
        self.told("moving")
        return Stepped(farthest, self._gone_count, pressure, viscosity)

    def adopt(self) -> None:
        """See `LiquidStepper`."""
        self._store.advance()
        if self._gone_count:
            self._store.keep(self._store.gone, self._gone_count)
        self._found = None
        self._pressure.keep_rate(self._dt)
        self._has_rate = True

    @property
    def head_rate(self) -> tuple[tuple[int, int, int], np.ndarray] | None:
        """See `LiquidStepper`."""
        if self._region is None or not self._has_rate:
            return self._last
        return self._region.first, self._region.rate.numpy().copy()

    def restore_head_rate(self, rate: tuple[tuple[int, int, int], np.ndarray] | None) -> None:
        """See `LiquidStepper`."""
        self._last, self._has_rate = rate, False
        self._box = self._region = None

    def _summary(self) -> tuple[np.ndarray, np.ndarray, float]:
        if self._found is None:
            self._found = self._store.summary()
        return self._found

    def _look(self) -> WarpRegion:
        """The region around the particles and the inlet."""
        low, high, _ = self._summary()
        s = self._setup.surroundings
        box = region_of_extent(low, high, self._grid, s.inlet.cell_range if s.inlet.active else None)
        if self._region is None or box != self._box:
            region = WarpRegion(self._whole, box)
            if self._region is not None and self._has_rate:
                region.take_rate(self._region)
            elif self._last is not None:
                first, rate = self._last
                region.rate.assign(moved_to(rate.astype(np.float32), first, region.first, region.grid.shape))
                self._has_rate = True
            self._box, self._region = box, region
            self._pressure = WarpProjection(region, self._settings, self._parameters.gravity)
            p, self._drag = self._parameters, None
            if p.kinematic_viscosity * p.time_step / self._grid.spacing**2 >= NEGLIGIBLE:
                self._drag = WarpDrag(region, p, self._settings.viscosity_tolerance)
        return self._region

    def _reseed(
        self, region: WarpRegion, ends: warp.array, first_id: int, draw: Callable[[int], np.ndarray]
    ) -> tuple[int, int]:
        """Split and merge (`physics.reseed`): how many places are gone now, marked in the store, and how many are new.

        `ends` is that of the sort, and the particles are in its order.
        """
        import warp as wp

        from fluidlift.backends import warp_sorting_kernels as kernels

        store, grid, device = self._store, self._grid, self._device
        cells, density = region.grid.cells, self._parameters.density
        nominal = density * grid.spacing**3 / 8.0
        splits, merges, ranks = region.splits, region.merges, region.ranks
        inputs = [ends, region.solid, store.field("masses"), float(LIGHTEST_PARENT * nominal)]
        wp.launch(kernels.choose, region.grid.shape, inputs, [splits, merges], device=device)
        wp.utils.array_scan(merges, ranks, inclusive=True)
        merged = int(ranks[cells - 1 :].numpy()[0])
        wp.utils.array_scan(splits, ranks, inclusive=True)
        parents = int(ranks[cells - 1 :].numpy()[0])
        directions = draw(parents) if parents or merged else np.zeros((0, 3))
        if not parents and not merged:
            return 0, 0
        count = store.count
        store.reserve(count + parents)
        store.gone.zero_()
        if merged:
            inputs = [ends, merges, store.scratch, store.state(), store.gone]
            wp.launch(kernels.merge_pairs, cells, inputs, device=device)
        if not parents:
            return merged, 0
        directions = directions / np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
        given = wp.array(directions, dtype=wp.vec3d, device=device)
        fits, places = (empty(parents, wp.int32, device) for _ in range(2))
        h = grid.spacing
        inputs = [ends, splits, ranks, given, self._whole.nodes, wp.vec3d(*grid.low), wp.vec3d(*grid.high), float(h)]
        inputs += [float(SPLIT_DISTANCE * h), float(CLEARANCE * h), count, store.state(), store.gone, fits]
        wp.launch(kernels.split_parents, cells, inputs, device=device)
        wp.utils.array_scan(fits, places, inclusive=True)
        wp.launch(kernels.name_children, parents, [fits, places, count, first_id, store.field("ids")], device=device)
        made = int(places[parents - 1 :].numpy()[0])
        store.count = count + parents
        return merged + parents - made, made

    def _grid_step(self, region: WarpRegion, dt: float, time: float) -> tuple[SolveReport, tuple[SolveReport, ...]]:
        """From the particles to `region.final`; the reports of pressure and viscosity."""
        from fluidlift.backends import warp_step_kernels as kernels

        r, store, (counts, ends) = region, self._store, self._cells
        positions, masses = store.field("positions"), store.field("masses")
        inputs = [positions, *store.rows(), masses, ends, r.low, r.spacing, r.shape]
        r.launch(kernels.sum_over_particles, inputs, [r.carried, r.masses], faces=True)
        self.told("particles to grid")
        deposit(r, positions, masses, ends, self._parameters.density)
        self.told("volumes")
        emitters = self._inlet.running
        r.replay("layout", (counts.ptr, *map(id, emitters)), lambda: lay_out(r, counts, emitters))
        self.told("surface and layout")
        self._forces.apply(r, dt, time)
        self._inlet.impose(r, r.velocity, time)
        if self._outlet is not None:
            self._outlet.find(r, dt)
        self.told("forces")
        outlet = self._outlet is not None
        self._pressure.build()
        viscosity: tuple[SolveReport, ...] = ()
        if self._drag is not None:
            number = self._parameters.kinematic_viscosity * dt / self._grid.spacing**2
            eager = self._has_rate and number >= STRONG
            viscosity = self._drag.apply(self._pressure, self._inlet, dt, eager=eager, outlet=outlet)
            self.told("viscosity")
        report = self._pressure.project(dt, guessed=self._has_rate, outlet=outlet)
        self.told("pressure")
        if self._outlet is not None:
            self._outlet.hold(r, r.velocity, dt)
        self._inlet.impose(r, r.velocity, time)
        reach = min(1.0, float(np.sqrt(self._parameters.kinematic_viscosity * dt)) / self._grid.spacing)
        taken = self._parameters.wall_damping * reach
        held = taken if taken >= 1e-3 else 0.0
        r.replay("continuation", held, lambda: continue_velocity(r, r.velocity, held))
        self.told("continuation")
        return report, viscosity

    def _gather(self, region: WarpRegion, dt: float, time: float) -> None:
        """Velocities and affine matrices of the next state, and the displacements."""
        import warp as wp

        from fluidlift.backends import warp_step_kernels as kernels
        from fluidlift.backends.warp_transfer_kernels import gather_particles

        store, device, f = self._store, self._device, region.final
        positions = store.field("positions")
        velocities, affine = (store.following(name) for name in ("velocities", "affine"))
        inputs = [positions, region.low, region.spacing, f.x, f.y, f.z]
        wp.launch(gather_particles, store.count, inputs, [velocities, affine], device=device)
        # walls beside the inlet would hold back its rim
        self._inlet.carry(positions, velocities, affine, count=store.count, time=time)
        inputs = [velocities, affine, float(dt), float(0.5 * dt)]
        wp.launch(kernels.displace, store.count, inputs, [store.moves, store.total], device=device)

    def _spread(self, region: WarpRegion) -> None:
        """Particles of crowded cells are spread (`physics.position_correction`)."""
        import warp as wp

        from fluidlift.backends import warp_step_kernels as kernels

        if not self._settings.spread_crowds:
            return
        self._pressure.spread()
        store = self._store
        limit = float(LARGEST_MOVE * self._grid.spacing)
        inputs = [store.field("positions"), region.low, region.spacing, region.field, limit]
        wp.launch(kernels.add_spread, store.count, inputs, [store.total], device=self._device)

    def _move(self, region: WarpRegion, dt: float) -> tuple[float, int]:
        """Move, collide, deform; which leave is marked. The farthest displacement, and how many leave."""
        import warp as wp

        from fluidlift.backends import warp_motion_kernels, warp_sorting_kernels
        from fluidlift.backends import warp_step_kernels as kernels

        store, device, grid = self._store, self._device, self._grid
        n, old, new = store.count, store.field("positions"), store.following("positions")
        box = self._box_of_step
        box.dt, box.keep = dt, (1.0 - self._parameters.wall_damping) ** (dt / self._parameters.time_step)
        inputs = [box, old, store.field("velocities"), store.total, store.following("velocities")]
        wp.launch(warp_motion_kernels.move_particles, n, inputs, [new], device=device)
        inputs = [store.following("affine"), float(dt), float(self._settings.max_stretch), store.field("deformation")]
        wp.launch(warp_motion_kernels.deform_particles, n, inputs, [store.following("deformation")], device=device)
        store.gone.zero_()
        mainstream = wp.vec3d(*(float(x) for x in self._setup.surroundings.mainstream))
        place = [wp.vec3d(*grid.low), wp.vec3d(*grid.high), float(grid.spacing)]
        inputs = [old, new, self._whole.cells["regions"], *place, mainstream]
        wp.launch(kernels.mark_leaving, n, inputs, [store.gone], device=device)
        if self._has_outlet:
            full = float(self._parameters.density * grid.spacing**3)
            inputs = [region.regions, self._cells[1], store.field("masses"), full, store.scratch]
            region.launch(warp_sorting_kernels.mark_surplus, inputs, [store.gone])
        return store.judged(store.moves, store.gone)

    def _walls(self) -> Any:
        """What particles run into; `dt` and `keep` are those of the step."""
        import warp as wp

        from fluidlift.backends import warp_motion_kernels

        grid, walls, p = self._grid, self._setup.surroundings.walls, self._parameters
        box = warp_motion_kernels.Box()
        box.low, box.high, box.spacing = wp.vec3d(*grid.low), wp.vec3d(*grid.high), grid.spacing
        box.clearance, box.contact = CLEARANCE * grid.spacing, CONTACT * grid.spacing
        box.distance, box.regions = self._whole.nodes, self._whole.cells["regions"]
        box.open_low, box.open_high = (wp.vec3i(*(int(o) for o in walls.open_sides[:, side])) for side in range(2))
        box.restitution = p.restitution
        return box
