"""The grid's heavy work by NVIDIA Warp: the Poisson solve, and continuing a velocity beyond the liquid."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.backends.warp_device import on_device, warp_device
from fluidlift.errors import required
from fluidlift.seams import PoissonSolver, VelocityContinuation
from fluidlift.types import FaceVelocity

SWEEPS = 2
"""red-black Gauss-Seidel sweeps before and after each coarse correction"""
COARSEST_SWEEPS = 12
COARSEST_CELLS = 4
"""coarsening stops when the longest side has this many cells"""


class WarpPoissonSolver(PoissonSolver):
    """Conjugate gradients in double precision with a multigrid V-cycle in single as preconditioner.

    Args:
        device: "cuda", "cuda:1"... or "cpu", see `warp_device`.
    """

    def __init__(self, device: str = "cuda") -> None:
        self._device = warp_device(device)

    def solve(
        self,
        unknown: Bool[np.ndarray, "nx ny nz"],
        weights: tuple[np.ndarray, np.ndarray, np.ndarray],
        spacing: float,
        rhs: Float[np.ndarray, "nx ny nz"],
        *,
        initial: Float[np.ndarray, "nx ny nz"],
        tolerance: float,
        max_iterations: int,
    ) -> tuple[Float[np.ndarray, "nx ny nz"], int, float]:
        """See `PoissonSolver`."""
        box = _bounding_box(unknown)
        if box is None:
            return np.zeros_like(rhs, np.float64), 0, 0.0
        cut = []
        for axis, w in enumerate(weights):
            faces = list(box)
            faces[axis] = slice(box[axis].start, box[axis].stop + 1)
            cut.append(w[tuple(faces)])
        levels = self._levels(unknown[box], cut, spacing)
        p, iterations, residual = self._descend(levels, rhs[box], initial[box], tolerance, max_iterations)
        out = np.zeros(rhs.shape)
        out[box] = p
        return out, iterations, residual

    def _level(self, cells: tuple[int, ...]) -> Any:
        import warp as wp

        from fluidlift.backends import warp_grid_kernels as kernels

        level = kernels.Level()
        shape = [n + 2 for n in cells]
        level.shape, level.steps = wp.vec3i(*shape), wp.vec3i(shape[1] * shape[2], shape[2], 1)
        size = shape[0] * shape[1] * shape[2]
        for name in ("diagonal", "coupling_x", "coupling_y", "coupling_z", "x", "rhs"):
            setattr(level, name, wp.zeros(size, dtype=wp.float32, device=self._device))
        level.color = wp.zeros(size, dtype=wp.uint8, device=self._device)
        return level

    def _levels(self, unknown: np.ndarray, weights: list[np.ndarray], spacing: float) -> list[Any]:
        import warp as wp

        from fluidlift.backends import warp_grid_kernels as kernels

        device, cells = self._device, unknown.shape
        mask = wp.array(np.ascontiguousarray(unknown, np.uint8), dtype=wp.uint8, device=device)
        inputs = [1.0 / spacing**2, mask, *(on_device(w, wp.float32, device) for w in weights)]
        levels = [self._level(cells)]
        wp.launch(kernels.build_finest, unknown.size, [levels[0], *inputs], device=device)
        wp.launch(kernels.finish_level, levels[0].x.size, [levels[0], 0.0], device=device)
        largest = 6.0 / spacing**2
        while max(cells) > COARSEST_CELLS:
            cells = tuple((n + 1) // 2 for n in cells)
            levels.append(self._level(cells))
            fine, coarse = levels[-2:]
            wp.launch(kernels.build_coarser, coarse.x.size, [fine, coarse], device=device)
            wp.launch(kernels.finish_level, coarse.x.size, [coarse, 1e-5 * largest], device=device)
            largest *= 2.0  # half of a sum over the four faces of each side of a coarse cell
        return levels

    def _descend(
        self, levels: list[Any], rhs: np.ndarray, initial: np.ndarray, tolerance: float, max_iterations: int
    ) -> tuple[np.ndarray, int, float]:
        import warp as wp

        from fluidlift.backends import warp_grid_kernels as kernels

        device, fine = self._device, levels[0]
        size = fine.x.size
        p, r, q, z, direction, b = (wp.zeros(size, dtype=wp.float64, device=device) for _ in range(6))

        def dot(one: Any, other: Any) -> float:
            inner: Any = wp.utils.array_inner(one, other)
            return float(inner)

        def run(kernel: Any, *inputs: Any, dim: int = size) -> None:
            wp.launch(kernel, dim, list(inputs), device=device)

        shape = wp.vec3i(*rhs.shape)
        for values, out in ((initial, p), (rhs, b)):
            flat = wp.array(np.ascontiguousarray(values, np.float64).ravel(), dtype=wp.float64, device=device)
            run(kernels.load_padded, fine, shape, flat, out, dim=rhs.size)
        with wp.ScopedCapture(device) as capture:
            self._cycle(levels)
        norm = float(np.sqrt(dot(b, b)))
        scale = 1.0 / max(float(np.abs(rhs).max()), 1e-300)
        run(kernels.apply_operator, fine, p, q)
        wp.copy(r, b)
        run(kernels.step_from, -1.0, q, r)
        iterations, rz, goal = 0, 1.0, (tolerance * norm) ** 2
        while iterations < max_iterations and dot(r, r) > goal:
            run(kernels.to_cycle, fine, scale, r)
            wp.capture_launch(required(capture.graph, "no graph of a cycle"))
            run(kernels.from_cycle, fine, z)
            rz, previous = dot(r, z), rz
            if not rz > 0:
                break
            run(kernels.turn, z, rz / previous if iterations else 0.0, direction)
            run(kernels.apply_operator, fine, direction, q)
            curvature = dot(direction, q)
            if not curvature > 0:
                break
            run(kernels.step_from, rz / curvature, direction, p)
            run(kernels.step_from, -rz / curvature, q, r)
            iterations += 1
        # the true residual: the one that the iteration carries drifts
        run(kernels.apply_operator, fine, p, q)
        run(kernels.step_from, -1.0, b, q)
        residual = float(np.sqrt(dot(q, q))) / norm if norm > 0 else 0.0
        padded = p.numpy().reshape([n + 2 for n in rhs.shape])
        return padded[1:-1, 1:-1, 1:-1].copy(), iterations, residual

    def _cycle(self, levels: list[Any]) -> None:
        """levels[0].x, 0 before, becomes an approximate solution for levels[0].rhs: linear, symmetric, positive."""
        import warp as wp

        from fluidlift.backends import warp_grid_kernels as kernels

        def sweep(level: Any, colors: tuple[int, int], count: int) -> None:
            for color in colors * count:
                wp.launch(kernels.smooth, level.x.size, [level, wp.uint8(color)], device=self._device)

        for fine, coarse in pairwise(levels):
            sweep(fine, (1, 2), SWEEPS)
            wp.launch(kernels.restrict_residual, coarse.x.size, [fine, coarse], device=self._device)
        sweep(levels[-1], (1, 2), COARSEST_SWEEPS)
        sweep(levels[-1], (2, 1), COARSEST_SWEEPS)
        for fine, coarse in zip(levels[-2::-1], levels[:0:-1]):
            wp.launch(kernels.add_coarse, fine.x.size, [fine, coarse], device=self._device)
            sweep(fine, (2, 1), SWEEPS)


def _bounding_box(mask: np.ndarray) -> tuple[slice, ...] | None:
    box = []
    for axis in range(3):
        hit = np.flatnonzero(mask.any(axis=tuple(a for a in range(3) if a != axis)))
        if len(hit) == 0:
            return None
        box.append(slice(int(hit[0]), int(hit[-1]) + 1))
    return tuple(box)


class WarpContinuation(VelocityContinuation):
    """Layer by layer, as on the CPU.

    Args:
        device: "cuda", "cuda:1"... or "cpu", see `warp_device`.
    """

    def __init__(self, device: str = "cuda") -> None:
        self._device = warp_device(device)

    def continued(
        self, velocity: FaceVelocity, valid: tuple[np.ndarray, np.ndarray, np.ndarray], layers: int = 3
    ) -> FaceVelocity:
        """See `VelocityContinuation`."""
        import warp as wp

        from fluidlift.backends import warp_grid_kernels as kernels

        device, out = self._device, []
        for component, known in zip(velocity.components, valid):
            field = on_device(np.where(known, component, 0).ravel(), wp.float32, device)
            mask = wp.array(np.ascontiguousarray(known, np.uint8).ravel(), dtype=wp.uint8, device=device)
            for _ in range(layers):
                new_field, new_mask = wp.empty_like(field), wp.empty_like(mask)
                inputs = [wp.vec3i(*component.shape), field, mask]
                wp.launch(kernels.grow, field.size, inputs, [new_field, new_mask], device=device)
                field, mask = new_field, new_mask
            out.append(field.numpy().reshape(component.shape))
        return FaceVelocity(*out)
