"""P2G and G2P: affine particle-in-cell (APIC) transfers on the MAC grid (paper: `particle_map`; Jiang et al. 2015).

Each velocity component lives on its own faces, so row a of a particle's affine matrix belongs to component a:

    m_i v_i = sum_p w_ip m_p (v_pa + C_pa . (x_i - x_p)),      m_i = sum_p w_ip m_p,
    v_pa = sum_i w_ip v_i,      C_pa = 4 / h^2 sum_i w_ip v_i (x_i - x_p).

The fast kernels are in `physics.transfer_kernels`; the plain twins here are torch, for any device and precision.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numba
import numpy as np
from jaxtyping import Float, Int

from fluidlift.physics import transfer_kernels as kernels
from fluidlift.physics.transfer_kernels import BLOCK, GHOST
from fluidlift.seams import GroupedByCell
from fluidlift.types import FaceVelocity, Grid, Particles, triple

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True)
class CellOrder:
    """Particles grouped by cell."""

    order: Int[np.ndarray, " n"]
    """particle indices, cell by cell (x slowest), stable"""
    start: Int[np.ndarray, " cells+1"]
    """where each cell begins in `order`"""


def sort_by_cell(positions: Float[np.ndarray, "n 3"], grid: Grid) -> CellOrder:
    """Group particles by cell; those outside the box count for the nearest cell."""
    return CellOrder(*kernels.count_sort(positions, grid.low, 1.0 / grid.spacing, *grid.shape))


def _blocks_by_color(start: np.ndarray, grid: Grid) -> list[np.ndarray]:
    """Blocks of columns that hold particles, int64 [b,2] for each of the four colours.

    Threads take equal runs of the list: the blocks are dealt to them by load, the largest first.
    """
    nx, ny, nz = grid.shape
    load = np.diff(start[::nz]).reshape(nx, ny)
    load = np.add.reduceat(load, np.arange(0, nx, BLOCK), axis=0)
    load = np.add.reduceat(load, np.arange(0, ny, BLOCK), axis=1)
    threads = numba.get_num_threads()
    colors = []
    for i, j in np.ndindex(2, 2):
        here = load[i::2, j::2]
        by_load = np.argsort(-here[here > 0], kind="stable")
        dealt = np.concatenate([by_load[t::threads] for t in range(threads)])
        colors.append(2 * np.argwhere(here > 0)[dealt] + [i, j])
    return [blocks for blocks in colors if len(blocks)]


def _padded_shape(grid: Grid, axis: int) -> tuple[int, int, int]:
    i, j, k = grid.face_shape(axis)
    return (i + 2 * GHOST, j + 2 * GHOST, k + 2 * GHOST + 1)


def _float32(array: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(array, np.float32)


def particles_to_grid(
    particles: Particles, grid: Grid, order: GroupedByCell | None = None
) -> tuple[FaceVelocity, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """P2G: face velocity (m/s, 0 where no particle reaches) and face masses (kg), float32.

    Args:
        particles: inside the box of the grid.
        grid: the staggered grid.
        order: of these very positions, from `sort_by_cell` (made here when missing): that of older ones would let
            threads meet on a face.
    """
    order = order or sort_by_cell(particles.positions, grid)
    sums = triple(np.zeros((*_padded_shape(grid, axis), 2), np.float32) for axis in range(3))
    positions, affine = _float32(particles.positions), _float32(particles.affine)
    carried, weights = _float32(particles.velocities), _float32(particles.masses)
    for blocks in _blocks_by_color(order.start, grid):
        kernels.scatter(
            positions, carried, affine, weights, order.order, order.start, blocks, grid.low, grid.spacing, grid.shape,
            *sums,
        )  # fmt: skip
    velocities, masses = (triple(np.empty(grid.face_shape(a), np.float32) for a in range(3)) for _ in range(2))
    for padded, velocity, mass in zip(sums, velocities, masses):
        kernels.divide(padded, velocity, mass)
    return FaceVelocity(*velocities), masses


def grid_to_particles(
    velocity: FaceVelocity, grid: Grid, positions: Float[np.ndarray, "n 3"], order: GroupedByCell | None = None
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 3"]]:
    """G2P: velocities (m/s) and affine matrices (1/s) at positions, float32. Beyond the outer faces the outer value
    goes on.

    `order` only makes it faster where the positions are in no order.
    """
    velocities = np.empty((len(positions), 3), np.float32)
    affine = np.empty((len(positions), 3, 3), np.float32)
    index = order.order if order is not None else np.arange(len(positions))
    padded = triple(np.empty(_padded_shape(grid, axis), np.float32) for axis in range(3))
    for component, out in zip(velocity.components, padded):
        kernels.pad(_float32(component), out)
    kernels.gather(_float32(positions), index, grid.low, grid.spacing, *padded, velocities, affine)
    return velocities, affine


def deposit_to_cells(
    positions: Float[np.ndarray, "n 3"], amounts: Float[np.ndarray, " n"], grid: Grid, order: CellOrder
) -> Float[np.ndarray, "nx ny nz"]:
    """Amounts shared among the eight nearest cell centres by trilinear weights; the total is kept."""
    out = np.zeros(grid.shape, np.float32)
    state = _float32(positions), _float32(amounts), order.order, order.start
    for blocks in _blocks_by_color(order.start, grid):
        kernels.deposit(*state, blocks, grid.low, grid.spacing, out)
    return out


def select_particles(particles: Particles, index: Int[np.ndarray, " m"]) -> Particles:
    """`Particles.select` for whole numbers, by all threads."""
    p, m = particles, len(index)
    state = [_float32(a) for a in (p.positions, p.velocities, p.affine, p.deformation, p.masses)]
    chosen = [np.empty((m, *a.shape[1:]), np.float32) for a in state]
    labels = [np.ascontiguousarray(a, np.int64) for a in (p.source, p.ids)]
    chosen_labels = [np.empty(m, np.int64) for _ in labels]
    kernels.select(np.asarray(index, np.int64), *state, *labels, *chosen, *chosen_labels)
    return Particles(*chosen, *chosen_labels)


def _footprints(positions: Tensor, grid: Grid, axis: int) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """For each of the 27 faces around each particle: index [n,3], weight [n], x_i - x_p [n,3] in m."""
    import torch

    first = grid.low + 0.5 * grid.spacing * (np.arange(3) != axis)
    coordinates = (positions - positions.new_tensor(first)) / grid.spacing
    base = torch.floor(coordinates - 0.5)
    r = coordinates - base
    weights = torch.stack([0.5 * (1.5 - r) ** 2, 0.75 - (r - 1.0) ** 2, 0.5 * (r - 0.5) ** 2])
    for step in np.ndindex(3, 3, 3):
        index = base + base.new_tensor(step)
        weight = weights[step[0], :, 0] * weights[step[1], :, 1] * weights[step[2], :, 2]
        yield index.long(), weight, (index - coordinates) * grid.spacing


def _flat(index: Tensor, shape: tuple[int, int, int]) -> Tensor:
    return (index[:, 0] * shape[1] + index[:, 1]) * shape[2] + index[:, 2]


def particles_to_grid_plain(
    particles: Particles, grid: Grid, *, device: str = "cpu", dtype: str = "float64"
) -> tuple[FaceVelocity, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """`particles_to_grid` as the formula reads, in torch on `device` with numbers of `dtype`."""
    import torch

    p = particles
    arrays = (p.positions, p.velocities, p.affine, p.masses)
    x, v, c, m = (torch.as_tensor(a, device=device, dtype=getattr(torch, dtype)) for a in arrays)
    velocities, masses = [], []
    for axis in range(3):
        shape = grid.face_shape(axis)
        momentum, mass = x.new_zeros(shape).ravel(), x.new_zeros(shape).ravel()
        for index, weight, offset in _footprints(x, grid, axis):
            inside = ((index >= 0) & (index < index.new_tensor(shape))).all(dim=1)
            faces = _flat(index[inside], shape)
            value = v[:, axis] + (c[:, axis] * offset).sum(dim=1)
            mass.index_add_(0, faces, (weight * m)[inside])
            momentum.index_add_(0, faces, (weight * m * value)[inside])
        velocity = torch.where(mass > 1e-30, momentum / mass, 0.0)
        velocities.append(velocity.reshape(shape).numpy(force=True))
        masses.append(mass.reshape(shape).numpy(force=True))
    return FaceVelocity(*velocities), tuple(masses)


def grid_to_particles_plain(
    velocity: FaceVelocity, grid: Grid, positions: Float[np.ndarray, "n 3"], *, device: str = "cpu",
    dtype: str = "float64",
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 3"]]:  # fmt: skip
    """`grid_to_particles` as the formula reads, in torch on `device` with numbers of `dtype`."""
    import torch

    x = torch.as_tensor(positions, device=device, dtype=getattr(torch, dtype))
    velocities, affine = x.new_zeros(len(x), 3), x.new_zeros(len(x), 3, 3)
    for axis, component in enumerate(velocity.components):
        shape = component.shape
        field = torch.as_tensor(component, device=device, dtype=x.dtype).ravel()
        for index, weight, offset in _footprints(x, grid, axis):
            nearest = index.clamp(min=index.new_zeros(3), max=index.new_tensor(shape) - 1)
            value = weight * field[_flat(nearest, shape)]
            velocities[:, axis] += value
            affine[:, axis] += 4.0 / grid.spacing**2 * value[:, None] * offset
    return velocities.numpy(force=True), affine.numpy(force=True)
