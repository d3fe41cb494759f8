"""A multigrid V-cycle for the coupled viscous stress, the preconditioner of its conjugate gradients.

Every level is the same minimum of energy as on the finest grid, written down anew for cells twice as wide: rigid motion
then costs no energy on any level, and masses and stresses keep their ratio. A solver per component would know nothing
of rotation and bending, which are what viscosity leaves of a free body. Faces are smoothed by Gauss-Seidel sweeps over
all components, two colours each. Corrections are interpolated linearly between the coarse faces that are solved, and
residuals are gathered with the transpose; so the cycle is symmetric and positive.

A coarse face is solved if one of the fine faces on it is (Aanjaneya, Han, Goldade and Batty 2019, "An efficient
geometric multigrid solver for viscous liquids", whose extra smoothing at surfaces is not needed inside conjugate
gradients).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numba import get_num_threads, njit, set_num_threads

from fluidlift.numerics.sharing import shared
from fluidlift.physics import stress_kernels as kernels
from fluidlift.physics.liquid_fractions import cell_shares

LEAST_SHARE = 0.01
"""of a face's control volume: faces that hold less liquid get the mass of this much"""
SWEEPS = 2
"""before and after each coarse correction"""
COARSEST_SWEEPS = 10
COARSEST_NODES = 4
"""coarsening stops when the longest side has this many nodes with solved faces"""
SMALL = 30_000
"""nodes: smaller grids are left to one thread, since waiting for others costs more than they gain"""


CHILDREN = np.array([[0.5, 1.0, 0.5, 0.0], [0.25, 0.75, 0.75, 0.25]], np.float32)
"""weights of the fine faces 2n-3, 2n-2, ... that are interpolated from the coarse face n: across it, along it"""
ONE, TWO, THREE = np.uint64(1), np.uint64(2), np.uint64(3)
ZERO, EIGHTH = np.float32(0.0), np.float32(0.125)
"""as in `stress_kernels`"""


@dataclass(frozen=True)
class StressSystem:
    """The operator on one grid, with all it follows from; layout as in `stress_kernels`."""

    roles: np.ndarray
    """int8 [3,...]; solved faces lie at least two nodes from the ends of the box"""
    octants: np.ndarray
    """float32 [...,8]: see `liquid_fractions`"""
    excluded: np.ndarray
    """bool: cells in which nothing can flow"""
    resistance: np.ndarray
    """float32: 1 / viscosity, s/m^2"""
    number: float
    """dt / h^2"""
    wall_share: float
    clearance: np.ndarray
    """float32 [3,...]: distance of the faces from walls in cells, negative inside"""
    mass: np.ndarray
    """float32 [3,...]: liquid share of the faces that are solved, 0 elsewhere"""
    inverse: np.ndarray
    """1 / diagonal"""
    normal: np.ndarray
    """float32 [3,...]: weights of the stresses xx, yy, zz at cells"""
    shear: np.ndarray
    """float32 [3,...]: weights of the stresses yz, xz, xy at edges"""
    first: np.ndarray
    last: np.ndarray
    """int32 per column: the solved faces lie in first <= k < last"""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Nodes of the box."""
        return self.excluded.shape

    @property
    def columns(self) -> tuple[np.ndarray, np.ndarray]:
        """`first` and `last`."""
        return self.first, self.last

    @property
    def operator(self) -> tuple[np.ndarray, ...]:
        """What the kernels need to apply it."""
        return self.mass, self.normal, self.shear, self.first, self.last


@dataclass(frozen=True)
class StressLevel:
    """A system and its work space, float32 [3,...]."""

    system: StressSystem
    x: np.ndarray
    rhs: np.ndarray
    rest: np.ndarray
    reach: np.ndarray
    """1 / the sum of the weights of the coarse faces that each face is interpolated from; 0: no correction"""


def assemble(
    roles: np.ndarray,
    octants: np.ndarray,
    excluded: np.ndarray,
    resistance: np.ndarray,
    number: float,
    wall_share: float,
    clearance: np.ndarray | None = None,
) -> StressSystem:
    """The operator; arguments as in `StressSystem`. Without `clearance` walls lie half way between faces."""
    if clearance is None:
        clearance = np.where(roles == kernels.WALL, np.float32(-0.5), np.float32(0.5))
    mass, inverse, normal, shear = (np.zeros(roles.shape, np.float32) for _ in range(4))
    cells = cell_shares(octants, excluded)
    kernels.weigh_stresses(roles, clearance, octants, cells, resistance, number, wall_share, normal, shear)
    kernels.weigh_faces(roles, octants, cells, resistance, normal, shear, LEAST_SHARE, mass, inverse)
    some = np.any(mass > 0, axis=0)
    columns = np.any(some, axis=2)
    first = np.where(columns, some.argmax(axis=2), 1).astype(np.int32)
    last = np.where(columns, some.shape[2] - some[:, :, ::-1].argmax(axis=2), 1).astype(np.int32)
    return StressSystem(
        roles, octants, excluded, resistance, number, wall_share, clearance, mass, inverse, normal, shear, first, last
    )


@shared(lambda roles, out: (1, out.shape[1] - 1))
def _merge_roles(begin, end, roles, out):
    """Solved if one of the four fine faces is; else fixed, else wall, else air. The fine plane 2 is the coarse 2."""
    _, fx, fy, fz = roles.shape
    _, _, ny, nz = out.shape
    for i in range(begin, end):
        for a in range(3):
            for j in range(1, ny - 1):
                for k in range(1, nz - 1):
                    role = 0
                    for di in range(2 * i - 2, min(2 * i - (a == 0), fx)):
                        for dj in range(2 * j - 2, min(2 * j - (a == 1), fy)):
                            for dk in range(2 * k - 2, min(2 * k - (a == 2), fz)):
                                fine = roles[a, di, dj, dk]
                                if fine != 0 and (role == 0 or fine < role):
                                    role = fine
                    out[a, i, j, k] = role


@shared(lambda octants, excluded, resistance, out, out_excluded, *_: (1, out_excluded.shape[0] - 1))
def _merge_cells(begin, end, octants, excluded, resistance, out, out_excluded, out_resistance):
    """Fine cells become the octants of coarse ones. Where a part of a coarse cell is excluded, the rest fills it."""
    fx, fy, fz = excluded.shape
    _, ny, nz = out_excluded.shape
    for i in range(begin, end):
        for j in range(1, ny - 1):
            for k in range(1, nz - 1):
                count = 0
                total = 0.0
                slack = 0.0
                for o in range(8):
                    di, dj, dk = 2 * i - 2 + (o >> 2), 2 * j - 2 + ((o >> 1) & 1), 2 * k - 2 + (o & 1)
                    out[i, j, k, o] = -1.0
                    if di < fx and dj < fy and dk < fz and not excluded[di, dj, dk]:
                        share = 0.0
                        for p in range(8):
                            share += 0.125 * octants[di, dj, dk, p]
                        out[i, j, k, o] = share
                        count += 1
                        total += share
                        slack += share * resistance[di, dj, dk]
                out_excluded[i, j, k] = count == 0
                if total > 0.0:
                    out_resistance[i, j, k] = slack / total
                mean = total / count if count > 0 else 0.0
                for o in range(8):
                    if out[i, j, k, o] < 0.0:
                        out[i, j, k, o] = mean


def coarser(fine: StressSystem) -> StressSystem:
    """The system on cells twice as wide."""
    shape = tuple((n - 2) // 2 + 4 for n in fine.shape)
    roles = np.zeros((3, *shape), np.int8)
    _merge_roles(fine.roles, roles)
    octants, excluded = np.zeros((*shape, 8), np.float32), np.ones(shape, bool)
    resistance = np.ones(shape, np.float32)
    _merge_cells(fine.octants, fine.excluded, fine.resistance, octants, excluded, resistance)
    return assemble(roles, octants, excluded, resistance, fine.number / 4.0, fine.wall_share)


@njit(cache=True)
def _parents(n, across):
    """The two coarse indices that fine index n lies between, and the weight of the second."""
    if across:
        low = (n + 2) // 2
        return low, low + 1, 0.5 * (n & 1)
    return n // 2 + 1, n // 2 + 2 * (n & 1), 0.25


@shared(lambda mass, *_: (1, mass.shape[1] - 1))
def _measure_reach(begin, end, mass, coarse_mass, reach):
    _, _, ny, nz = mass.shape
    for i in range(begin, end):
        for a in range(3):
            i0, i1, wi = _parents(i, a == 0)
            for j in range(1, ny - 1):
                j0, j1, wj = _parents(j, a == 1)
                for k in range(1, nz - 1):
                    if mass[a, i, j, k] <= 0.0:
                        continue
                    k0, k1, wk = _parents(k, a == 2)
                    total = 0.0
                    for s in range(8):
                        weight = (wi if s & 4 else 1 - wi) * (wj if s & 2 else 1 - wj) * (wk if s & 1 else 1 - wk)
                        if (
                            weight > 0.0
                            and coarse_mass[a, i1 if s & 4 else i0, j1 if s & 2 else j0, k1 if s & 1 else k0] > 0
                        ):
                            total += weight
                    if total > 0.0:
                        reach[a, i, j, k] = 1.0 / total


@shared(lambda x, *_: (1, x.shape[1] - 1))
def _add_coarse(begin, end, x, reach, coarse_x, first, last):
    """x += the coarse correction, interpolated linearly."""
    ny = x.shape[2]
    for i in range(begin, end):
        for a in range(3):
            i0, i1, wi = _parents(i, a == 0)
            for j in range(1, ny - 1):
                j0, j1, wj = _parents(j, a == 1)
                w00, w01 = np.float32((1 - wi) * (1 - wj)), np.float32((1 - wi) * wj)
                w10, w11 = np.float32(wi * (1 - wj)), np.float32(wi * wj)
                c00, c01, c10, c11 = coarse_x[a, i0, j0], coarse_x[a, i0, j1], coarse_x[a, i1, j0], coarse_x[a, i1, j1]
                for k in range(np.int64(first[i, j]), np.int64(last[i, j])):
                    k0, k1, wk = _parents(k, a == 2)
                    low = w00 * c00[k0] + w01 * c01[k0] + w10 * c10[k0] + w11 * c11[k0]
                    high = w00 * c00[k1] + w01 * c01[k1] + w10 * c10[k1] + w11 * c11[k1]
                    x[a, i, j, k] += reach[a, i, j, k] * (low + np.float32(wk) * (high - low))


@shared(lambda rest, reach, coarse_mass, coarse_rhs, *_: (1, coarse_rhs.shape[1] - 1))
def _gather(begin, end, rest, reach, coarse_mass, coarse_rhs, coarse_x, first, last):
    """The transpose of the interpolation, over 8 for the larger volume; the coarse guess becomes 0."""
    ny = coarse_rhs.shape[2]
    for i_ in range(begin, end):
        i = np.uint64(i_)
        for a in range(3):
            ni, nj, nk = np.uint64(3 + (a != 0)), np.uint64(3 + (a != 1)), np.uint64(3 + (a != 2))
            wi, wj, wk = CHILDREN[int(a != 0)], CHILDREN[int(a != 1)], CHILDREN[int(a != 2)]
            for j in range(ONE, np.uint64(ny - 1)):
                for k in range(np.uint64(first[i, j]), np.uint64(last[i, j])):
                    total = ZERO
                    if coarse_mass[a, i, j, k] > ZERO:
                        # solved coarse faces lie two nodes from the ends: all their children are there
                        k0 = TWO * k - THREE
                        for p in range(ni):
                            fi = TWO * i + p - THREE
                            for q in range(nj):
                                fj = TWO * j + q - THREE
                                line = ZERO
                                for r in range(nk):
                                    line += wk[r] * reach[a, fi, fj, k0 + r] * rest[a, fi, fj, k0 + r]
                                total += wi[p] * wj[q] * line
                    coarse_rhs[a, i, j, k] = EIGHTH * total
                    coarse_x[a, i, j, k] = ZERO


@contextmanager
def fitting_threads(nodes: int) -> Iterator[None]:
    """One thread for small grids. The results do not depend on their number."""
    before = get_num_threads()
    if nodes < SMALL:
        set_num_threads(1)
    try:
        yield
    finally:
        set_num_threads(before)


def build_levels(system: StressSystem, *, coarsen: bool = True) -> list[StressLevel]:
    """The system on ever coarser grids, finest first; only the finest without `coarsen`."""
    systems = [system]
    while coarsen and max(systems[-1].shape) - 4 > COARSEST_NODES:
        systems.append(coarser(systems[-1]))
    levels = [StressLevel(s, *(np.zeros(s.mass.shape, np.float32) for _ in range(4))) for s in systems]
    for fine, coarse in pairwise(levels):
        _measure_reach(fine.system.mass, coarse.system.mass, fine.reach)
    return levels


def _sweep(level: StressLevel, count: int, *, forward: bool) -> None:
    s = level.system
    if s.excluded.size < SMALL:
        kernels.sweeps_alone(
            level.x, level.rhs, s.mass, s.inverse, s.normal, s.shear, count, forward, *s.columns
        )  # fmt: skip
        return
    order = [(a, color) for a in range(3) for color in range(2)]
    for _ in range(count):
        for a, color in order if forward else reversed(order):
            kernels.half_sweep(
                level.x, level.rhs, s.mass, s.inverse, s.normal, s.shear, a, color, *s.columns
            )  # fmt: skip


def _descend(fine: StressLevel, coarse: StressLevel) -> None:
    _sweep(fine, SWEEPS, forward=True)
    kernels.residual(fine.x, fine.rhs, fine.rest, *fine.system.operator)
    _gather(fine.rest, fine.reach, coarse.system.mass, coarse.rhs, coarse.x, *coarse.system.columns)


def v_cycle(levels: list[StressLevel]) -> None:
    """levels[0].x, 0 before, becomes an approximate solution for levels[0].rhs: linear, symmetric, positive."""
    for fine, coarse in pairwise(levels):
        with fitting_threads(fine.system.excluded.size):
            _descend(fine, coarse)
    _sweep(levels[-1], COARSEST_SWEEPS, forward=True)
    _sweep(levels[-1], COARSEST_SWEEPS, forward=False)
    for fine, coarse in zip(levels[-2::-1], levels[:0:-1]):
        with fitting_threads(fine.system.excluded.size):
            _add_coarse(fine.x, fine.reach, coarse.x, *fine.system.columns)
            _sweep(fine, SWEEPS, forward=False)
