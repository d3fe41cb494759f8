"""The multigrid solver for many right sides of one system: levels are assembled once.

One prepared system may be used by several threads at a time; each borrows vectors of its own. A solve on one thread
releases the interpreter's lock.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numba import get_num_threads

from fluidlift.numerics import components, multigrid, multigrid_cycle
from fluidlift.numerics.multigrid_assembly import load, store
from fluidlift.numerics.multigrid_cycle import Hierarchy
from fluidlift.numerics.multigrid_kernels import CELLS, PARTS, PLANES

_ASSEMBLING = threading.Lock()


class _Vectors(NamedTuple):
    """What one solve writes to."""

    x: np.ndarray
    rhs: np.ndarray
    b: np.ndarray
    p: np.ndarray
    q: np.ndarray
    r: np.ndarray
    direction: np.ndarray


class _Assembled(NamedTuple):
    hierarchy: Hierarchy
    means: multigrid._Means
    closed: int


@dataclass
class PreparedSystem:
    """-div(w grad .) of `multigrid.solve`, whose arrays must not change any more."""

    unknown: np.ndarray
    weights: tuple[np.ndarray, np.ndarray, np.ndarray]
    spacing: float
    _assembled: _Assembled | None = field(default=None, repr=False)
    _free: list[_Vectors] = field(default_factory=list, repr=False)

    def solve(
        self, rhs: np.ndarray, *, tolerance: float, max_iterations: int, initial: np.ndarray | None = None
    ) -> multigrid.Solution:
        """`multigrid.solve` without low-rank terms."""
        out = np.zeros(self.unknown.shape, rhs.dtype)
        assembled = self._assemble()
        if assembled is None:
            return multigrid.Solution(out, 0, 0.0, 0, 0.0)
        h, means, closed = assembled
        g, corner = h.fine
        with self._vectors(h) as v:
            squares = load(g, corner, np.ascontiguousarray(rhs), float(self.spacing) ** 2, h.cells, v.b)
            v.p.fill(0.0)
            if initial is not None:
                guess = np.ascontiguousarray(initial)
                squares += 0.0 * load(g, corner, guess, 1.0, h.cells, v.p)  # not finite if the guess is not
            if not np.isfinite(squares):
                return multigrid.Solution(out, 0, float("nan"), closed, 0.0)
            removed = means.remove(v.b)
            size = float(np.sqrt(np.square(v.b).sum() if removed > 0 else squares))
            if size == 0.0:
                return multigrid.Solution(out, 0, 0.0, closed, removed)
            iterations, residual = _conjugate_gradients(h, v, tolerance * size, max_iterations)
            means.remove(v.p)
            store(g, corner, v.p, h.cells, out)
        return multigrid.Solution(out, iterations, residual / size, closed, removed / size)

    def _assemble(self) -> _Assembled | None:
        """The levels, assembled by the first who asks; None where no cell is unknown."""
        if self._assembled is None:
            with _ASSEMBLING:
                if self._assembled is None:
                    unknown = np.ascontiguousarray(self.unknown)
                    box = multigrid.bounding_box(unknown)
                    if box is None:
                        return None
                    x, y, z = (np.ascontiguousarray(w, np.float32) for w in self.weights)
                    h = multigrid.assemble(unknown, (x, y, z), box)
                    closed = components.closed_components(unknown, (x, y, z), h.beside_known, box)
                    means = multigrid._Means(h, closed, multigrid.NO_TERMS, unknown.shape)
                    self._assembled = _Assembled(h, means, len(closed.sizes))
        return self._assembled

    @contextmanager
    def _vectors(self, h: Hierarchy) -> Iterator[_Vectors]:
        try:
            vectors = self._free.pop()
        except IndexError:
            b, p, q, r = np.zeros((4, h.size))
            x, rhs = np.zeros_like(h.work[0]), np.zeros_like(h.work[1])
            vectors = _Vectors(x, rhs, b, p, q, r, np.zeros(h.size, np.float32))
        try:
            yield vectors
        finally:
            self._free.append(vectors)


def _conjugate_gradients(h: Hierarchy, v: _Vectors, goal: float, max_iterations: int) -> tuple[int, float]:
    work = (v.x, v.rhs, h.work[2])
    threads = get_num_threads()
    if threads > 1 and h.geometry[0, CELLS] >= multigrid.SERIAL_CELLS:
        geometry = h.geometry.copy()
        for g in geometry:
            some = g[CELLS] >= multigrid.SERIAL_CELLS
            g[PARTS] = max(1, min(threads, (g[PLANES] - 2) // multigrid_cycle.LEAST_PLANES)) if some else 1
        own = replace(h, geometry=geometry, work=work)
        none = multigrid.NO_TERMS
        terms = (none.cells[:, 0], none.values, none.starts, none.inverse_mass)
        return multigrid_cycle.conjugate_gradients(own, v.p, v.b, goal, max_iterations, terms)
    v.direction.fill(0.0)
    levels = (h.geometry, h.common, work, h.operator, h.rows, h.segments)
    return multigrid_cycle.conjugate_gradients_alone(levels, v.p, v.b, goal, max_iterations, (v.q, v.r, v.direction))
