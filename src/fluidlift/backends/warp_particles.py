"""Particle-grid transfers by NVIDIA Warp, on the GPU or (slow, for tests) on the CPU."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Int

from fluidlift.backends.warp_device import empty, on_device, warp_device
from fluidlift.seams import CLEARANCE, CONTACT, GroupedByCell, MoveRules, ParticleMover, ParticleTransfer, WallShape
from fluidlift.types import FaceVelocity, Grid, Particles, triple

if TYPE_CHECKING:
    import warp


class WarpTransfer(ParticleTransfer):
    """The pair of transfers with float32 sums; NumPy arrays go in and come out.

    Args:
        device: "cuda", "cuda:1"... or "cpu", see `warp_device`.
        ordered: True: each face adds its particles in their order: the same bits every time. False: particles add
            to the faces with atomics: on a GPU the last bits change from call to call.
    """

    def __init__(self, device: str = "cuda", *, ordered: bool = True) -> None:
        self._device = warp_device(device)
        self._ordered = ordered

    def particles_to_grid(
        self, particles: Particles, grid: Grid, order: GroupedByCell | None = None
    ) -> tuple[FaceVelocity, tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """See `ParticleTransfer`; `order` is not used: the device sorts faster than a copy takes."""
        velocities, masses = self.scattered(self.upload(particles), grid)
        return FaceVelocity(*(v.numpy() for v in velocities)), triple(m.numpy() for m in masses)

    def grid_to_particles(
        self,
        velocity: FaceVelocity,
        grid: Grid,
        positions: Float[np.ndarray, "n 3"],
        order: GroupedByCell | None = None,
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 3"]]:
        """See `ParticleTransfer`."""
        import warp as wp

        components = [on_device(c, wp.float32, self._device) for c in velocity.components]
        velocities, affine = self.gathered(components, grid, on_device(positions, wp.vec3, self._device))
        return velocities.numpy(), affine.numpy()

    def upload(self, particles: Particles) -> list[warp.array]:
        """Positions, velocities, affine matrices and masses on the device."""
        import warp as wp

        p = particles
        arrays = ((p.positions, wp.vec3), (p.velocities, wp.vec3), (p.affine, wp.mat33), (p.masses, wp.float32))
        return [on_device(values, dtype, self._device) for values, dtype in arrays]

    def scattered(self, state: list[warp.array], grid: Grid) -> tuple[list[warp.array], list[warp.array]]:
        """Face velocities and face masses on the device, from the arrays of `upload`."""
        import warp as wp

        from fluidlift.backends import warp_transfer_kernels as kernels

        device, place = self._device, [wp.vec3(*grid.low), float(grid.spacing)]
        masses, momenta = (
            [wp.zeros(grid.face_shape(a), dtype=wp.float32, device=device) for a in range(3)] for _ in range(2)
        )
        if self._ordered:
            order, ends = self._sorted(state[0], grid)
            for axis in range(3):
                inputs = [axis, *state, order, ends, *place, wp.vec3i(*grid.shape)]
                outputs = [masses[axis], momenta[axis]]
                wp.launch(kernels.sum_over_particles, masses[axis].size, inputs, outputs, device=device)
        else:
            wp.launch(kernels.scatter_particles, len(state[0]), [*state, *place], [*masses, *momenta], device=device)
        for mass, momentum in zip(masses, momenta):
            wp.launch(kernels.divide, mass.size, [mass.flatten(), momentum.flatten()], device=device)
        return momenta, masses

    def gathered(
        self, components: list[warp.array], grid: Grid, positions: warp.array
    ) -> tuple[warp.array, warp.array]:
        """Velocities and affine matrices on the device."""
        import warp as wp

        from fluidlift.backends import warp_transfer_kernels as kernels

        n, device = len(positions), self._device
        velocities, affine = (empty(n, t, device) for t in (wp.vec3, wp.mat33))
        inputs = [positions, wp.vec3(*grid.low), float(grid.spacing), *components]
        wp.launch(kernels.gather_particles, n, inputs, [velocities, affine], device=device)
        return velocities, affine

    def sort_by_cell(
        self, positions: Float[np.ndarray, "n 3"], grid: Grid
    ) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " cells+1"]]:
        """Particle indices cell by cell (x slowest, stable), and where each cell begins."""
        import warp as wp

        order, ends = self._sorted(on_device(positions, wp.vec3, self._device), grid)
        return order.numpy()[: len(positions)], np.concatenate([[0], ends.numpy()])

    def _sorted(self, positions: warp.array, grid: Grid) -> tuple[warp.array, warp.array]:
        import warp as wp

        from fluidlift.backends import warp_transfer_kernels as kernels

        n, device = len(positions), self._device
        # the sort needs the same room again
        cells, order = (empty(2 * n, wp.int32, device) for _ in range(2))
        counts, ends = (wp.zeros(grid.cells, dtype=wp.int32, device=device) for _ in range(2))
        inputs = [positions, wp.vec3(*grid.low), float(grid.spacing), wp.vec3i(*grid.shape)]
        wp.launch(kernels.number_cells, n, inputs, [cells, order, counts], device=device)
        wp.utils.radix_sort_pairs(cells, order, n)
        wp.utils.array_scan(counts, ends, inclusive=True)
        return order, ends


class WarpMover(ParticleMover):
    """Displacement, walls and deformation; NumPy arrays go in and come out.

    Args:
        device: "cuda", "cuda:1"... or "cpu", see `warp_device`.
    """

    def __init__(self, device: str = "cuda") -> None:
        self._device = warp_device(device)

    def moved(
        self,
        particles: Particles,
        moves: Float[np.ndarray, "n 3"],
        velocities: Float[np.ndarray, "n 3"],
        affine: Float[np.ndarray, "n 3 3"],
        walls: WallShape,
        rules: MoveRules,
    ) -> Particles:
        """See `ParticleMover`."""
        import warp as wp

        from fluidlift.backends import warp_motion_kernels as kernels

        n, device = len(particles), self._device
        old, incoming, displacements = (
            on_device(a, wp.vec3, device) for a in (particles.positions, particles.velocities, moves)
        )
        new_velocities = on_device(np.array(velocities, np.float32), wp.vec3, device)
        positions, deformation = (empty(n, t, device) for t in (wp.vec3, wp.mat33))
        inputs = [self._box(walls, rules), old, incoming, displacements, new_velocities]
        wp.launch(kernels.move_particles, n, inputs, [positions], device=device)
        inputs = [on_device(affine, wp.mat33, device), float(rules.dt), float(rules.max_stretch)]
        inputs.append(on_device(particles.deformation, wp.mat33, device))
        wp.launch(kernels.deform_particles, n, inputs, [deformation], device=device)
        return replace(
            particles, positions=positions.numpy(), velocities=new_velocities.numpy(),
            affine=np.ascontiguousarray(affine, np.float32), deformation=deformation.numpy(),
        )  # fmt: skip

    def _box(self, walls: WallShape, rules: MoveRules) -> Any:
        import warp as wp

        from fluidlift.backends import warp_motion_kernels as kernels

        grid, box = walls.grid, kernels.Box()
        box.low, box.high, box.spacing = wp.vec3d(*grid.low), wp.vec3d(*grid.high), grid.spacing
        box.clearance, box.contact = CLEARANCE * grid.spacing, CONTACT * grid.spacing
        box.distance = on_device(walls.signed_distance, wp.float32, self._device)
        box.regions = wp.array(np.ascontiguousarray(walls.regions), dtype=wp.uint8, device=self._device, copy=False)
        box.open_low, box.open_high = (wp.vec3i(*(int(o) for o in walls.open_sides[:, side])) for side in range(2))
        box.dt, box.restitution, box.keep = rules.dt, rules.restitution, rules.tangential_share
        return box
