"""The pressure on a device: conjugate gradients preconditioned by the V-cycle of `numerics.multigrid`, in Warp.

The hierarchy, the smoother and the precision are those of the CPU (Krylov space in double precision, V-cycle in
single), but for the grid of the coarse cells, which begins at the first cell of the box. The numbers that steer the
iteration stay on the device; the host looks at them every `ITERATIONS_PER_GRAPH` iterations at most.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from fluidlift.backends.warp_launches import Launches
from fluidlift.errors import require
from fluidlift.numerics.multigrid import Solution
from fluidlift.numerics.multigrid_assembly import COARSEST_CELLS
from fluidlift.numerics.multigrid_cycle import COARSEST_SWEEPS, RESTARTS
from fluidlift.numerics.poisson import judged
from fluidlift.types import SolveReport

if TYPE_CHECKING:
    import warp

ITERATIONS_PER_GRAPH = 2
"""directions alternate between two arrays, so that an iteration needs one pass less; the smallest whole is two"""
SMALL_BLOCK = 512
"""threads of the one block that visits the small levels"""
SMALL_CELLS = 4096
"""levels of as many cells are visited by one block: a launch more costs as much as that block takes for them"""


class WarpPoisson:
    """Solves systems of one shape, see `numerics.poisson.PoissonSystem`; no memory is taken after the constructor.

    Args:
        shape: cells along x, y, z.
        spacing: cell width, m.
        device: where the arrays lie.
        graphs: replay two iterations as a CUDA graph; None: on a GPU.
        loops: the graph also holds the loop of the iteration, see `Launches`.
        sweeps: of the smoother, before and after each coarse correction.
    """

    def __init__(
        self, shape: tuple[int, int, int], spacing: float, device: warp.Device, *, graphs: bool | None = None,
        loops: bool = False, sweeps: int = 2,
    ) -> None:  # fmt: skip
        import warp as wp

        from fluidlift.backends import warp_poisson_assembly as assembly
        from fluidlift.backends import warp_poisson_kernels as kernels

        require(min(shape) > 0, f"a grid of {shape} cells", "1 or more along each axis")
        self.shape, self.spacing, self.device = shape, spacing, device
        self._sweeps = sweeps
        self._levels, elements = _levels_of(shape)
        require(elements < 2**31, f"a grid of {shape} cells", "1e9 cells at most")
        self._small = next((n for n, level in enumerate(self._levels) if n > 0 and _cells(level) <= SMALL_CELLS), 0)
        fine = int(np.prod([n + 2 for n in shape]))
        blocks = -(-int(np.prod(shape)) // int(kernels.CHUNK))
        self._pair_blocks = -(-_pairs(self._levels[0]) // int(kernels.CHUNK))

        def zeros(size: int, dtype: Any = wp.float64) -> warp.array:
            return wp.zeros(size, dtype=dtype, device=device)

        self._op, self._krylov, self._components = kernels.Operator(), kernels.Krylov(), assembly.Components()
        for name in ("x", "rhs", "inverse", "cx", "cy", "cz"):
            setattr(self._op, name, zeros(elements, wp.float32))
        self._op.air = zeros(elements)
        for name in ("p", "b", "r", "q"):
            setattr(self._krylov, name, zeros(fine))
        self._krylov.scalars, self._krylov.partials = zeros(kernels.SCALARS), zeros(3 * blocks)
        self._krylov.going, self._krylov.blocks = zeros(1, wp.int32), blocks
        for name in ("label", "parent", "grounded", "touched", "size"):
            setattr(self._components, name, zeros(fine, wp.int32))
        self._components.sum_b, self._components.sum_p = zeros(fine), zeros(fine)
        self._directions = wp.zeros((2, fine), dtype=wp.float32, device=device)
        self._geometry = wp.array([wp.vec4i(*level) for level in self._levels], dtype=wp.vec4i, device=device)
        cells, starts = _cells_by_color(self._levels, self._small)
        self._colors = [wp.array(v, dtype=wp.int32, device=device) for v in (cells, starts)]
        self._none, self._no_sizes = wp.zeros((0, 0, 0), dtype=wp.float32, device=device), zeros(0, wp.int32)
        self._out = wp.zeros(shape, dtype=wp.float32, device=device)
        self._rows = (self._directions[0], self._directions[1])
        self._expected = 0
        self._launch = Launches(device, graphs, loops, self._krylov.scalars)

    def solve(
        self, unknown: warp.array, weights: tuple[warp.array, warp.array, warp.array], rhs: warp.array,
        initial: warp.array | None = None, *, tolerance: float, max_iterations: int = 200,
    ) -> tuple[warp.array, SolveReport]:  # fmt: skip
        """p with A p = rhs, as `numerics.poisson.solve` does.

        Args:
            unknown: uint8 [nx,ny,nz], not 0 where the pressure is solved.
            weights: float32 on the faces across x, y, z: [nx+1,ny,nz], [nx,ny+1,nz], [nx,ny,nz+1].
            rhs: float32 [nx,ny,nz], p / m^2; values outside the unknown cells are ignored.
            initial: first guess, float32 [nx,ny,nz]; the array of the last solve is allowed.
            tolerance: relative residual in the 2-norm.
            max_iterations: of the conjugate gradients.

        Returns:
            p, float32 [nx,ny,nz], 0 outside the unknown cells: the solver's own memory, which its next call writes to;
            and the report with the true residual of the solution before it is rounded to single precision.

        Raises:
            ValueError: an array of another shape.
        """
        from fluidlift.backends import warp_poisson_kernels as kernels

        given = [unknown, *weights, rhs, *([] if initial is None else [initial])]
        self._require_shapes(given)
        key = ("start", *(a.ptr for a in given), tolerance, max_iterations)
        start = self._none if initial is None else initial
        self._launch.run(
            key, lambda: self._start(unknown, weights, rhs, start, tolerance=tolerance, limit=max_iterations)
        )
        before = np.inf
        for _ in range(RESTARTS):
            if self._launch.loops:
                self._launch.loop(self._krylov.going, self._two_iterations, self._finish)
            else:
                self._iterate(max_iterations)
                self._launch.run("finish", self._finish)
            numbers = self._launch.numbers()
            residual2 = numbers[kernels.R2]
            # rounding has parted the residual of the recurrence from the true one: it begins again
            if numbers[kernels.DONE] or not residual2 < 0.25 * before:
                break
            before = residual2
            self._components.sum_p.zero_()
            self._descend(0)
        self._expected = int(numbers[kernels.ITERATIONS])
        return self._out, judged(_found(numbers), tolerance, "multigrid")

    @property
    def launches(self) -> int:
        """Kernels launched so far, those of graphs not counted."""
        return self._launch.count

    def _require_shapes(self, given: list[warp.array]) -> None:
        faces = [tuple(n + (a == axis) for a, n in enumerate(self.shape)) for axis in range(3)]
        names = ("unknown", "weights across x", "weights across y", "weights across z", "rhs", "first guess")
        for name, array, shape in zip(names, given, [self.shape, *faces, self.shape, self.shape]):
            require(array.shape == shape, f"{name} {array.shape}", str(shape))
            require(array.is_contiguous, f"{name} with gaps in memory", "a contiguous array")

    def _iterate(self, max_iterations: int) -> None:
        """Iterate until the device says that it is done. First as often as the last solve took, then step by step."""
        from fluidlift.backends import warp_poisson_kernels as kernels

        pairs = max(1, self._expected // ITERATIONS_PER_GRAPH)
        for _ in range(max_iterations // ITERATIONS_PER_GRAPH + 2):
            for _ in range(pairs):
                self._launch.run("iterate", self._two_iterations)
            if self._launch.numbers()[kernels.DONE]:
                return
            pairs = 1

    def _start(
        self, unknown: warp.array, weights: tuple[warp.array, ...], rhs: warp.array, initial: warp.array, *,
        tolerance: float, limit: int,
    ) -> None:  # fmt: skip
        """Levels, closed components, the first residual."""
        from fluidlift.backends import warp_poisson_assembly as assembly
        from fluidlift.backends import warp_poisson_kernels as kernels

        op, krylov, fine, parts = self._op, self._krylov, self._levels[0], self._components
        cells, scalars = _cells(fine), krylov.scalars
        self._launch.cells(assembly.clear, kernels.SCALARS, [scalars])
        system = [unknown, *weights, rhs, initial, float(self.spacing) ** 2]
        self._launch.cells(assembly.assemble_finest, cells, [*system, op, fine, krylov, self._directions])
        for one, next_one in zip(self._levels[: self._small], self._levels[1 : self._small + 1]):
            self._launch.cells(assembly.assemble_coarse, _cells(next_one), [op, one, next_one])
        if self._small < len(self._levels) - 1:
            self._launch.blocks(assembly.assemble_small, 1, [op, self._geometry, self._small])
        self._launch.cells(assembly.find_runs, self.shape[:2], [op, fine, parts, scalars])
        self._launch.cells(assembly.join_runs, cells, [op, fine, parts, scalars])
        self._launch.cells(assembly.ground_components, cells, [op, fine, parts, scalars])
        self._launch.cells(assembly.sum_closed, cells, [op, fine, parts, krylov.b, parts.sum_b, parts.size, scalars])
        self._residual(fresh=1)
        self._launch.blocks(assembly.begin, 1, [krylov, tolerance, float(limit), 1])
        self._descend(0)

    def _finish(self) -> None:
        """The true residual, the means of closed components, and p."""
        from fluidlift.backends import warp_poisson_assembly as assembly

        op, krylov, fine, parts = self._op, self._krylov, self._levels[0], self._components
        sums = [krylov.p, parts.sum_p, self._no_sizes, krylov.scalars]
        self._launch.cells(assembly.sum_closed, _cells(fine), [op, fine, parts, *sums])
        self._residual(fresh=0)
        self._launch.blocks(assembly.begin, 1, [krylov, 0.0, 0.0, 0])
        self._launch.cells(assembly.store, _cells(fine), [op, fine, krylov, parts, self._out])

    def _residual(self, fresh: int) -> None:
        from fluidlift.backends import warp_poisson_assembly as assembly

        inputs = [self._op, self._levels[0], self._krylov, self._components, fresh]
        self._launch.blocks(assembly.residual, self._krylov.blocks, inputs)

    def _descend(self, direction: int) -> None:
        from fluidlift.backends import warp_poisson_kernels as kernels

        inputs = [self._op, self._levels[0], self._krylov, self._rows[direction]]
        self._launch.blocks(kernels.descend, self._krylov.blocks, inputs)

    def _two_iterations(self) -> None:
        for direction in (0, 1):
            self._iteration(direction)

    def _iteration(self, direction: int) -> None:
        """V-cycle, new direction, step; writes `_rows[direction]`."""
        from fluidlift.backends import warp_poisson_kernels as kernels

        op, krylov, fine, blocks = self._op, self._krylov, self._levels[0], self._krylov.blocks
        self._v_cycle()
        self._launch.blocks(kernels.choose_beta, 1, [krylov, self._pair_blocks])
        old, new = self._rows[1 - direction], self._rows[direction]
        self._launch.blocks(kernels.turn, blocks, [op, fine, krylov, old, new])
        self._launch.blocks(kernels.choose_alpha, 1, [krylov])
        self._descend(direction)
        self._launch.blocks(kernels.judge, 1, [krylov])

    def _v_cycle(self) -> None:
        """From rhs and the red half sweep on the finest level to x, and the parts of x . rhs."""
        from fluidlift.backends import warp_poisson_kernels as kernels
        from fluidlift.backends import warp_poisson_small as small

        op, krylov, scalars = self._op, self._krylov, self._krylov.scalars
        pairs = list(zip(self._levels[: self._small], self._levels[1 : self._small + 1]))
        for fine, coarse in pairs:
            for half in range(1, 2 * self._sweeps):
                self._launch.cells(kernels.relax, _pairs(fine), [op, fine, half & 1, scalars])
            self._launch.cells(kernels.restrict, _cells(coarse), [op, fine, coarse, scalars])
        rest = [op, self._geometry, *self._colors, self._small, self._sweeps, COARSEST_SWEEPS, scalars]
        self._launch.blocks(small.cycle_small, 1, rest, SMALL_BLOCK)
        for fine, coarse in reversed(pairs):
            self._launch.cells(kernels.prolong, _pairs(fine), [op, fine, coarse, scalars])
            for half in range(1, 2 * self._sweeps):
                if fine is not self._levels[0] or half < 2 * self._sweeps - 1:
                    self._launch.cells(kernels.relax, _pairs(fine), [op, fine, 1 - (half & 1), scalars])
        # where all levels are small, the last half sweep comes twice, which changes nothing
        self._launch.blocks(kernels.relax_dot, self._pair_blocks, [op, self._levels[0], krylov])


def _found(numbers: np.ndarray) -> Solution:
    """What the scalars say at the end; the solution itself stays on the device."""
    from fluidlift.backends import warp_poisson_kernels as kernels

    iterations, closed = int(numbers[kernels.ITERATIONS]), int(numbers[kernels.CLOSED])
    size, residual, removed = np.sqrt(numbers[[kernels.B2, kernels.R2, kernels.REMOVED2]])
    if not np.isfinite(residual) or not np.isfinite(size):
        return Solution(np.zeros(0), iterations, float("nan"), closed, 0.0)
    if size == 0.0:
        return Solution(np.zeros(0), 0, 0.0, closed, float(removed))
    return Solution(np.zeros(0), iterations, float(residual / size), closed, float(removed / size))


def _levels_of(shape: tuple[int, int, int]) -> tuple[list[tuple[int, int, int, int]], int]:
    """(nx, ny, nz, index of the first element) of each level, finest first; the number of elements of all."""
    levels, used = [], 0
    nx, ny, nz = shape
    while True:
        levels.append((nx, ny, nz, used))
        used += (nx + 2) * (ny + 2) * (nz + 2)
        if max(nx, ny, nz) <= COARSEST_CELLS:
            return levels, used
        nx, ny, nz = (nx + 1) // 2, (ny + 1) // 2, (nz + 1) // 2


def _cells_by_color(levels: list[tuple[int, int, int, int]], first: int) -> tuple[np.ndarray, np.ndarray]:
    """Elements of the red and of the black cells of each level from `first` on, and where they start (for all levels).

    The block that visits them would take longer to compute these than to look them up.
    """
    parts: list[np.ndarray] = []
    for n, (nx, ny, nz, base) in enumerate(levels):
        if n < first:
            parts += [np.zeros(0, np.int64)] * 2
            continue
        i, j, k = np.indices((nx, ny, nz)) + 1
        elements = base + (i * (ny + 2) + j) * (nz + 2) + k
        parts += [elements[(i + j + k) % 2 == color] for color in (0, 1)]
    return np.concatenate(parts).astype(np.int32), np.cumsum([0, *map(len, parts)]).astype(np.int32)


def _cells(level: tuple[int, int, int, int]) -> int:
    return level[0] * level[1] * level[2]


def _pairs(level: tuple[int, int, int, int]) -> int:
    """Pairs along z: one red and one black cell each, but for the last of a row of odd length."""
    return level[0] * level[1] * ((level[2] + 1) // 2)
