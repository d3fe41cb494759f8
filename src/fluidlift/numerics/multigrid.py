"""Conjugate gradients preconditioned by a geometric multigrid V-cycle, for the cell Poisson equation.

After McAdams, Sifakis, Teran 2010, "A parallel multigrid Poisson solver for fluids simulation on large grids". The
Krylov space is kept in double precision, the V-cycle in single. `multigrid_assembly` holds the operators,
`multigrid_kernels` the memory and its kernels, `multigrid_cycle` the iteration.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import get_num_threads, set_num_threads

from fluidlift.numerics import components, multigrid_assembly, multigrid_cycle
from fluidlift.numerics.multigrid_cycle import Hierarchy
from fluidlift.numerics.multigrid_kernels import BASE, CELLS, HALF, PARTS, PLANES, ROW_BASE, ROWS, SEGMENT_BASE

SERIAL_CELLS = 65536
"""levels of which fewer cells are visited have one thread: waking another costs more"""


class LowRank(NamedTuple):
    """Terms J_b^T M_b^-1 J_b of the operator, b = 0 to n-1, one after the other."""

    cells: np.ndarray
    """int64 [m,3]"""
    values: np.ndarray
    """float64 [m,6]: J_b^T at these cells"""
    starts: np.ndarray
    """int64 [n+1]: term b has the lines starts[b] to starts[b+1] - 1"""
    inverse_mass: np.ndarray
    """float64 [n,6,6]"""


NO_TERMS = LowRank(np.zeros((0, 3), np.int64), np.zeros((0, 6)), np.zeros(1, np.int64), np.zeros((0, 6, 6)))


class Solution(NamedTuple):
    """What the solver found, and how."""

    p: np.ndarray
    """[nx,ny,nz], 0 outside the unknown cells"""
    iterations: int
    residual: float
    """|b - A p| / |b|, b without its means over closed components; not finite where an input is not"""
    closed: int
    """closed components whose constant is free or was removed"""
    removed: float
    """|part of the right side that no p can answer| / |b|"""


@contextmanager
def _threads(cells: int) -> Iterator[None]:
    """One thread for few cells."""
    threads = get_num_threads()
    if cells < SERIAL_CELLS:
        set_num_threads(1)
    try:
        yield
    finally:
        set_num_threads(threads)


def bounding_box(unknown: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """First index and last + 1 of the unknown cells along each axis; None where there are none."""
    planes = multigrid_assembly.bounds(unknown)
    some = np.flatnonzero(planes[:, 1])
    if len(some) == 0:
        return None
    low = np.array([some[0], planes[some, 0].min(), planes[some, 2].min()])
    return low, np.array([some[-1] + 1, planes[:, 1].max(), planes[:, 3].max()])


def assemble(
    unknown: np.ndarray,
    weights: tuple[np.ndarray, ...],
    box: tuple[np.ndarray, np.ndarray],
    added_diagonal: np.ndarray | None = None,
) -> Hierarchy:
    """All levels of the operator on the `bounding_box`; arrays contiguous, weights float32."""
    low, high = box
    geometry = multigrid_assembly.geometry_of(tuple(int(n) for n in high - low))
    last_level = geometry[-1]
    cells = int(last_level[BASE] + 2 * last_level[HALF] * last_level[PLANES])
    x, rhs, inverse, cx, cy, cz = (np.zeros(cells, np.float32) for _ in range(6))
    air = np.zeros(cells)
    count = int(last_level[ROW_BASE] + last_level[PLANES] * last_level[ROWS])
    first, last, same = np.zeros(count, np.int32), np.zeros(count, np.int32), np.zeros(count, bool)
    common = np.zeros((len(geometry), 3), np.float32)
    blocks = [np.zeros((g[PLANES], g[HALF] // multigrid_assembly.BLOCK), np.uint8) for g in geometry]
    offset = np.zeros(int(last_level[SEGMENT_BASE] + last_level[PLANES] + 1), np.int32)
    most = sum(b.size for b in blocks)
    start, stop, segment_same = np.empty(most, np.int32), np.empty(most, np.int32), np.empty(most, bool)
    beside = np.zeros(unknown.shape, bool)
    added = np.zeros((0, 0, 0), np.float32) if added_diagonal is None else _single(added_diagonal)
    operator, ranges, work = (air, cx, cy, cz), (first, last), (x, rhs, inverse)
    for level, g in enumerate(geometry):
        if level == 0:
            multigrid_assembly.assemble_finest(g, low, unknown, tuple(weights), added, operator, ranges, beside)
        else:
            multigrid_assembly.assemble_coarse(geometry[level - 1], g, inverse, operator, ranges)
        multigrid_assembly.invert_diagonal(g, operator, ranges, inverse, common[level])
        multigrid_assembly.classify(g, common[level], inverse, operator, ranges, same, blocks[level])
        g[CELLS] = multigrid_assembly.find_segments(g, blocks[level], offset, start, stop, segment_same)
        if g[CELLS] >= SERIAL_CELLS:
            g[PARTS] = max(1, min(get_num_threads(), (g[PLANES] - 2) // multigrid_cycle.LEAST_PLANES))
    used = offset[-1]
    segments = (offset, start[:used].copy(), stop[:used].copy(), segment_same[:used].copy())
    return Hierarchy(geometry, common, low, work, operator, (*ranges, same), segments, beside)


def _single(array: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(array, np.float32)


@dataclass(frozen=True)
class Level:
    """The finest level of a hierarchy as arrays [nx+2,ny+2,nz+2] with a ring of ghost cells, for `v_cycle`."""

    inverse: np.ndarray
    """1 / diagonal, 0 outside the unknown cells"""
    x: np.ndarray
    rhs: np.ndarray
    hierarchy: Hierarchy | None
    """None where no cell is unknown"""


def build_levels(
    unknown: np.ndarray,
    weights: tuple[np.ndarray, np.ndarray, np.ndarray],
    spacing: float,
    *,
    added_diagonal: np.ndarray | None = None,
) -> list[Level]:
    """What `v_cycle` needs to solve (added_diagonal - div(weights grad)) x = rhs roughly.

    Args:
        unknown: bool [nx,ny,nz].
        weights: face weights across x, y, z.
        spacing: cell width, m.
        added_diagonal: [nx,ny,nz] added to the operator (the unit matrix of implicit diffusion).
    """
    inverse, x, rhs = (np.zeros(tuple(n + 2 for n in unknown.shape), np.float32) for _ in range(3))
    box = bounding_box(np.ascontiguousarray(unknown))
    if box is None:
        return [Level(inverse, x, rhs, None)]
    scaled = tuple(_single(w) / np.float32(spacing**2) for w in weights)
    with _threads(int(np.prod(box[1] - box[0]))):
        hierarchy = assemble(np.ascontiguousarray(unknown), scaled, box, added_diagonal)
        g, corner = hierarchy.fine
        multigrid_assembly.store(g, corner + 1, hierarchy.work[2], hierarchy.cells, inverse)
    return [Level(inverse, x, rhs, hierarchy)]


def v_cycle(levels: Sequence[Level]) -> None:
    """levels[0].x becomes an approximate solution for levels[0].rhs: linear, symmetric, positive."""
    level, hierarchy = levels[0], levels[0].hierarchy
    if hierarchy is None:
        return
    g, corner = hierarchy.fine
    with _threads(int(g[CELLS])):
        multigrid_assembly.load(g, corner + 1, level.rhs, 1.0, hierarchy.cells, hierarchy.work[1])
        multigrid_cycle.cycle(hierarchy, np.zeros(g[PLANES]))
        multigrid_assembly.store(g, corner + 1, hierarchy.work[0], hierarchy.cells, level.x)


def _packed(hierarchy: Hierarchy, terms: LowRank, spacing: float) -> tuple[np.ndarray, ...]:
    """The terms as `multigrid_cycle.add_low_rank` takes them, without cells that have no equation."""
    g, corner = hierarchy.fine
    _, nz, length, half = g[:4]
    shape = np.array([g[PLANES] - 2, length - 2, nz - 2])
    i, k, j = (terms.cells - corner + 1).T
    inside = ((terms.cells >= corner) & (terms.cells < corner + shape)).all(axis=1)
    m = j * length + k
    places = np.where(inside, (2 * i + (m & 1)) * half + (m >> 1), 0)
    values = np.where((hierarchy.work[2][places] > 0)[:, None], terms.values, 0.0)
    return places, values, terms.starts, terms.inverse_mass * spacing**2


class _Means:
    """Takes the free constants of closed components from right sides and solutions."""

    def __init__(self, hierarchy: Hierarchy, closed: components.ClosedComponents, terms: LowRank, shape: tuple) -> None:
        self.place = hierarchy.fine
        self.closed = closed
        count, bodies = len(closed.sizes), len(terms.inverse_mass)
        forces, magnitudes = np.zeros((2, bodies, count, 6))
        if count and bodies:
            component = components.component_of_cells(closed, terms.cells, shape)
            for b in range(bodies):
                part = slice(terms.starts[b], terms.starts[b + 1])
                inside = component[part] >= 0
                np.add.at(forces[b], component[part][inside], terms.values[part][inside])
                np.add.at(magnitudes[b], component[part][inside], np.abs(terms.values[part][inside]))
        self.constants = components.free_constants(closed.sizes, forces, magnitudes, terms.inverse_mass)

    def remove(self, values: np.ndarray) -> float:
        """values less their free constants, in place; returns the norm of what was removed."""
        count = len(self.closed.sizes)
        if count == 0:
            return 0.0
        group = (*self.place, self.closed.runs, self.closed.labels)
        means = self.constants.means(multigrid_assembly.component_sums(*group, count, values))
        multigrid_assembly.shift_components(*group, -means, values)
        return float(np.sqrt((self.closed.sizes * np.square(means)).sum()))


def solve(
    unknown: np.ndarray,
    weights: tuple[np.ndarray, np.ndarray, np.ndarray],
    spacing: float,
    rhs: np.ndarray,
    *,
    tolerance: float,
    max_iterations: int,
    initial: np.ndarray | None = None,
    low_rank: LowRank = NO_TERMS,
) -> Solution:
    """p with |b - A p| <= tolerance |b|, where b is rhs without what no p can answer.

    Args:
        unknown: bool [nx,ny,nz].
        weights: face weights across x, y, z, >= 0; between unknown cells open fractions, towards known cells any.
        spacing: cell width, m.
        rhs: [nx,ny,nz], p / m^2; values outside the unknown cells are ignored.
        tolerance: relative residual in the 2-norm.
        max_iterations: of the conjugate gradients.
        initial: first guess [nx,ny,nz].
        low_rank: terms that are added to A.
    """
    out = np.zeros(unknown.shape, rhs.dtype)
    unknown = np.ascontiguousarray(unknown)
    box = bounding_box(unknown)
    if box is None:
        return Solution(out, 0, 0.0, 0, 0.0)
    single = (_single(weights[0]), _single(weights[1]), _single(weights[2]))
    with _threads(int(np.prod(box[1] - box[0]))):
        h = assemble(unknown, single, box)
        closed = components.closed_components(unknown, single, h.beside_known, box)
        count = len(closed.sizes)
        means = _Means(h, closed, low_rank, unknown.shape)
        b, p = np.zeros(h.size), np.zeros(h.size)
        squares = multigrid_assembly.load(*h.fine, np.ascontiguousarray(rhs), float(spacing) ** 2, h.cells, b)
        if initial is not None:
            guess = np.ascontiguousarray(initial)
            squares += 0.0 * multigrid_assembly.load(*h.fine, guess, 1.0, h.cells, p)  # not finite if the guess is not
        if not np.isfinite(squares):
            return Solution(out, 0, float("nan"), count, 0.0)
        removed = means.remove(b)
        size = float(np.sqrt(np.square(b).sum() if removed > 0 else squares))
        if size == 0.0:
            return Solution(out, 0, 0.0, count, removed)
        terms = _packed(h, low_rank, spacing)
        iterations, residual = multigrid_cycle.conjugate_gradients(h, p, b, tolerance * size, max_iterations, terms)
        means.remove(p)
        multigrid_assembly.store(*h.fine, p, h.cells, out)
    return Solution(out, iterations, residual / size, count, removed / size)
