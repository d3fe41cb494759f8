"""The particles of a simulation on a Warp device, in the order of their cells."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from fluidlift.backends.warp_device import empty
from fluidlift.types import Grid, Particles

if TYPE_CHECKING:
    import warp

HEADROOM = 1.25
"""of the memory for particles over their number, so that not every new one moves all"""
LANES = 1024
"""threads of a reduction whose last part the host does: few numbers to copy, enough threads to read at full speed"""
FIELDS = ("positions", "velocities", "affine", "deformation", "masses", "source", "ids")
"""of `Particles`, in its order"""
MOVING = FIELDS[:4]
"""what changes in a substep"""


class ParticleStore:
    """Two sets of arrays: the present state, and one to write the next to. All have room for `capacity` particles.

    Args:
        device: where they lie.
    """

    def __init__(self, device: warp.Device) -> None:
        self._device = device
        self.count = self.capacity = 0
        self._states: dict[tuple[int, ...], Any] = {}
        """structs for kernels, by the arrays that they hold: to make one takes as long as a launch"""
        self._now: dict[str, warp.array] = {}
        self._next: dict[str, warp.array] = {}

    def upload(self, particles: Particles) -> None:
        """Replace the state."""
        self._reserve(len(particles), keep=False)
        self._write(particles, 0)
        self.count = len(particles)

    def append(self, particles: Particles) -> None:
        """Put particles behind the others."""
        self.reserve(self.count + len(particles))
        self._write(particles, self.count)
        self.count += len(particles)

    def download(self, *, by_id: bool = False) -> Particles:
        """A copy for the host, in the present order or in that of the ids."""
        arrays = self.arrays(by_id=by_id)
        found = [arrays[name][: self.count].numpy() for name in FIELDS]
        # on the CPU these are the arrays themselves
        return Particles(*(found if self._device.is_cuda else [values.copy() for values in found]))

    def arrays(self, *, by_id: bool = False) -> dict[str, warp.array]:
        """The present state by `FIELDS`, in the present order or, until the next step, in that of the ids."""
        return self._by_id() if by_id and self.count else self._now

    def _by_id(self) -> dict[str, warp.array]:
        """The particles in the order of their ids, where the next state will be written: a host would take as long to
        sort them as a few substeps do."""
        import warp as wp

        from fluidlift.backends import warp_sorting_kernels as kernels

        n = self.count
        keys: Any = empty(2 * n, wp.int64, self._device)  # the sort needs the same room again
        wp.launch(kernels.number_ids, n, [self._now["ids"]], [keys, self._order], device=self._device)
        wp.utils.radix_sort_pairs(keys, self._order, n)
        states = [self._state(self._now), self._state(self._next)]
        wp.launch(kernels.take, n, [self._order, *states], device=self._device)
        return self._next

    def field(self, name: str) -> warp.array:
        """One array of the present state, with room behind the last particle."""
        return self._now[name]

    def following(self, name: str) -> warp.array:
        """The array that the next state of a field goes to."""
        return self._next[name]

    def advance(self) -> None:
        """What was written as the next state of the `MOVING` fields becomes the present one."""
        for name in MOVING:
            self._now[name], self._next[name] = self._next[name], self._now[name]

    def reserve(self, count: int) -> None:
        """Make room for so many particles, those that are there included."""
        self._reserve(count, keep=True)

    def sort(self, grid: Grid, gone: warp.array | None = None, leaving: int = 0) -> tuple[warp.array, warp.array]:
        """Put the particles in the order of their cells (x slowest, stable), without those that are `gone`.

        Args:
            grid: those outside count for the nearest cell.
            gone: u8 per particle.
            leaving: how many of them are set.

        Returns:
            int32 [cells]: how many particles each cell holds, and where each cell ends.
        """
        import warp as wp

        from fluidlift.backends import warp_sorting_kernels as kernels

        n, device = self.count, self._device
        if grid.cells != len(self._counts):
            self._counts, self._ends = (empty(grid.cells, wp.int32, device) for _ in range(2))
        self._counts.zero_()
        if gone is None:
            gone = self.gone
            gone.zero_()
        inputs = [self._state(self._now), gone, wp.vec3(*grid.low), float(grid.spacing), wp.vec3i(*grid.shape)]
        wp.launch(kernels.number_particles, n, inputs, [self._keys, self._order, self._counts], device=device)
        wp.utils.radix_sort_pairs(self._keys, self._order, n)
        wp.utils.array_scan(self._counts, self._ends, inclusive=True)
        self._take(n - leaving)
        return self._counts, self._ends

    def keep(self, gone: warp.array, leaving: int) -> None:
        """Take out the particles that are `gone` (u8; `leaving` of them are set); the others keep their order."""
        self.chosen(gone)
        self._take(self.count - leaving)

    def chosen(self, gone: warp.array) -> warp.array:
        """int32: the indices of those that are not `gone`, in their order, and their number behind all sums.

        Returns:
            int32 [capacity], inclusive sums: the last of `count` is how many were chosen.
        """
        import warp as wp

        from fluidlift.backends import warp_sorting_kernels as kernels

        kept: Any = self._keys[: self.count]
        places: Any = self._places[: self.count]
        wp.launch(kernels.kept_flags, self.count, [gone, kept], device=self._device)
        wp.utils.array_scan(kept, places, inclusive=True)
        wp.launch(kernels.kept_order, self.count, [gone, places, self._order], device=self._device)
        return places

    def mass(self) -> float:
        """kg of all particles."""
        import warp as wp

        from fluidlift.backends import warp_inlet_kernels as kernels

        sums = empty(LANES, wp.float64, self._device)
        inputs = [self.count, LANES, self._now["masses"]]
        wp.launch(kernels.add_up, LANES, inputs, [sums], device=self._device)
        return float(sums.numpy().sum())

    def filled_cells(self, grid: Grid) -> int:
        """How many cells hold particles."""
        import warp as wp

        from fluidlift.backends import warp_inlet_kernels as kernels

        sums = empty(LANES, wp.int32, self._device)
        inputs = [grid.cells, LANES, self._counted(grid)]
        wp.launch(kernels.count_filled, LANES, inputs, [sums], device=self._device)
        return int(sums.numpy().sum())

    def summary(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Least and largest position (float32 [3], m), and the largest speed (m/s, not a number where one is not)."""
        import warp as wp

        from fluidlift.backends import warp_step_kernels as kernels

        inputs = [self.count, LANES, self._now["positions"], self._now["velocities"], self._summary]
        wp.launch(kernels.summarize, LANES, inputs, device=self._device)
        rows = self._summary.numpy()
        return rows[:, :3].min(axis=0), rows[:, 3:6].max(axis=0), float(np.sqrt(rows[:, 6].max()))

    def judged(self, moves: warp.array, gone: warp.array) -> tuple[float, int]:
        """The largest component of the displacements (m, not a number where one is not), and how many are `gone`."""
        import warp as wp

        from fluidlift.backends import warp_step_kernels as kernels

        wp.launch(kernels.judge, LANES, [self.count, LANES, moves, gone, self._verdict], device=self._device)
        rows = self._verdict.numpy()
        farthest = float("nan") if rows[:, 2].any() else float(rows[:, 0].max())
        return farthest, int(rows[:, 1].sum(dtype=np.float64))

    def rows(self) -> tuple[warp.array, warp.array]:
        """Velocities [n,3] as numbers, and affine matrices [n,3] as rows: kernels read one component of each."""
        import warp as wp

        velocities, affine = self._now["velocities"], self._now["affine"]
        shape, device = (self.capacity, 3), self._device
        return (
            wp.array(ptr=velocities.ptr, dtype=wp.float32, shape=shape, device=device),
            wp.array(ptr=affine.ptr, dtype=wp.vec3, shape=shape, device=device),
        )

    def _counted(self, grid: Grid) -> warp.array:
        """int32 [cells]: how many particles each cell holds."""
        import warp as wp

        from fluidlift.backends import warp_sorting_kernels as kernels

        counts = wp.zeros(grid.cells, dtype=wp.int32, device=self._device)
        self.gone.zero_()
        inputs = [self._state(self._now), self.gone, wp.vec3(*grid.low), float(grid.spacing), wp.vec3i(*grid.shape)]
        wp.launch(kernels.number_particles, self.count, inputs, [self._keys, self._order, counts], device=self._device)
        return counts

    def state(self) -> Any:
        """The present state for kernels."""
        return self._state(self._now)

    def _take(self, count: int) -> None:
        """The first of `_order` become the particles."""
        import warp as wp

        from fluidlift.backends import warp_sorting_kernels as kernels

        states = [self._state(self._now), self._state(self._next)]
        wp.launch(kernels.take, count, [self._order, *states], device=self._device)
        self._now, self._next, self.count = self._next, self._now, count

    def _state(self, arrays: dict[str, warp.array]) -> Any:
        from fluidlift.backends import warp_sorting_kernels as kernels

        known = self._states.get(key := tuple(id(arrays[name]) for name in FIELDS))
        if known is not None:
            return known
        out = self._states[key] = kernels.State()
        for name in FIELDS:
            setattr(out, name, arrays[name])
        return out

    def _write(self, particles: Particles, first: int) -> None:
        import warp as wp

        if not len(particles):
            return
        for name in FIELDS:
            target = self._now[name]
            kind = np.int64 if name in ("source", "ids") else np.float32
            values = np.ascontiguousarray(getattr(particles, name), kind)
            source = wp.array(values, dtype=target.dtype, device="cpu", copy=False)
            wp.copy(target, source, dest_offset=first, count=len(particles))
        wp.synchronize_device(self._device)  # the host may free its arrays now

    def _reserve(self, count: int, *, keep: bool) -> None:
        import warp as wp

        if count <= self.capacity:
            return
        capacity = max(int(HEADROOM * count), LANES)
        types = dict(zip(FIELDS, (wp.vec3, wp.vec3, wp.mat33, wp.mat33, wp.float32, wp.int64, wp.int64)))
        device = self._device
        self._states.clear()
        old = self._now
        self._now, self._next = ({name: empty(capacity, t, device) for name, t in types.items()} for _ in range(2))
        if keep and self.count:
            for name in FIELDS:
                wp.copy(self._now[name], old[name], count=self.count)
        # the sort needs the same room again
        self._keys, self._order = (empty(2 * capacity, wp.int32, device) for _ in range(2))
        self._places = empty(capacity, wp.int32, device)
        self._counts = self._ends = empty(0, wp.int32, device)
        self.gone = wp.zeros(capacity, dtype=wp.uint8, device=device)
        self.moves, self.total = (empty(capacity, wp.vec3, device) for _ in range(2))
        self._summary, self._verdict = (empty((LANES, columns), wp.float32, device) for columns in (7, 3))
        self.scratch = empty(capacity, wp.int32, device)
        self.capacity = capacity
