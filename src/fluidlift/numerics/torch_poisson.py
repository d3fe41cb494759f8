"""The Poisson system of `poisson` and its coarser levels as tensors on one device (solver: `torch_multigrid`).

The levels are those of `multigrid_plain` (the factors are derived in `multigrid_assembly`), assembled on the host.
Arrays lie in memory with a ring of ghost cells and are worked on as flat vectors: the neighbour along an axis is one
slice further. In the V-cycle the unknowns are scaled so that the diagonal is 1 (x = s y with s = 1 / sqrt(diagonal)).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from fluidlift.errors import require
from fluidlift.numerics.multigrid import bounding_box
from fluidlift.numerics.multigrid_plain import PlainLevel, coarser_level, finest_level
from fluidlift.numerics.poisson import PoissonSystem, label_components

COARSEST_CELLS = 216
"""coarsening stops at as many: the pseudo-inverse is a dense matrix"""


@dataclass(frozen=True)
class ScaledLevel:
    """One level, scaled to a diagonal of 1: y - sum over neighbours of coupling times their y."""

    shape: tuple[int, int, int]
    """with the ring; even"""
    couplings: tuple[Tensor, Tensor, Tensor]
    """float32, flat; with the neighbour on the low side across x, y, z"""
    scale: Tensor
    """float32, flat: 1 / sqrt(diagonal), 0 where there is no equation"""
    unscale: Tensor
    """float32, flat: sqrt(diagonal)"""
    parent: Tensor
    """int32, flat: cell of the next coarser level"""

    @property
    def strides(self) -> tuple[int, int, int]:
        """Distance of neighbours across x, y, z."""
        return (self.shape[1] * self.shape[2], self.shape[2], 1)

    @property
    def size(self) -> int:
        """Cells, ring included."""
        return math.prod(self.shape)


@dataclass(frozen=True)
class DeviceSystem:
    """A Poisson system and its coarser levels on one device."""

    shape: tuple[int, int, int]
    spacing: float
    low: tuple[int, int, int]
    """first unknown cell along each axis"""
    cells: tuple[int, int, int]
    """size of the box around the unknown cells; one cell where there are none"""
    active: Tensor
    """bool, flat with the ring: cells that have an equation"""
    diagonal: Tensor
    """float64, flat, in units of 1 / h^2"""
    couplings: tuple[Tensor, Tensor, Tensor]
    """float64, flat, in units of 1 / h^2"""
    levels: tuple[ScaledLevel, ...]
    inverse: Tensor
    """float32 [n,n]: pseudo-inverse of the scaled operator on the coarsest level"""
    closed_cells: Int[Tensor, " m"]
    """cells of closed components, flat with the ring"""
    closed_labels: Int[Tensor, " m"]
    closed_sizes: Float[Tensor, " c"]

    @classmethod
    def of(cls, system: PoissonSystem, device: torch.device | str) -> DeviceSystem:
        """Assemble on the host (NumPy) and move to the device.

        Raises:
            ValueError: a device that is not there, or that has no double precision.
        """
        device = torch.device(device)
        there = device.type != "cuda" or torch.cuda.is_available()
        require(there, "device 'cuda'", "a CUDA device that torch sees", "install torch with CUDA, or choose 'cpu'")
        require(device.type != "mps", "device 'mps'", "a device with double precision: 'cpu' or 'cuda'")
        box = bounding_box(np.ascontiguousarray(system.unknown))
        low, high = (np.zeros(3, int), np.ones(3, int)) if box is None else box
        inside = tuple(slice(int(a), int(b)) for a, b in zip(low, high))
        weights = [np.asarray(w, np.float64) for w in system.weights]
        cut = [w[tuple(slice(s.start, s.stop + (a == d)) for d, s in enumerate(inside))] for a, w in enumerate(weights)]
        plain = [finest_level(system.unknown[inside], (cut[0], cut[1], cut[2]))]
        while math.prod(plain[-1].air.shape) > COARSEST_CELLS:
            plain.append(coarser_level(plain[-1]))
        levels = tuple(_level(p, device) for p in plain)
        shape = levels[0].shape
        diagonal = plain[0].diagonal()
        labels, closed = label_components(system)
        group = np.where(diagonal > 0, labels[inside], -1)
        chosen = (group >= 0) & np.append(closed, False)[group]
        _, label, size = np.unique(group[chosen], return_inverse=True, return_counts=True)
        return cls(
            shape=system.unknown.shape,
            spacing=float(system.spacing),
            low=(int(low[0]), int(low[1]), int(low[2])),
            cells=diagonal.shape,
            active=torch.from_numpy(_ringed(diagonal > 0, shape).ravel()).to(device),
            diagonal=torch.from_numpy(_ringed(diagonal, shape).ravel()).to(device),
            couplings=_on_device([_ringed(c[1:-1, 1:-1, 1:-1], shape) for c in plain[0].couplings], device),
            levels=levels,
            inverse=torch.from_numpy(_pseudo_inverse(plain[-1])).to(device),
            closed_cells=torch.from_numpy(np.flatnonzero(_ringed(chosen, shape))).to(device),
            closed_labels=torch.from_numpy(label.astype(np.int64)).to(device),
            closed_sizes=torch.from_numpy(size.astype(np.float64)).to(device),
        )

    def load(self, values: Float[Tensor, "nx ny nz"]) -> Float[Tensor, " n"]:
        """Values of the unknown cells as a flat float64 vector with the ring."""
        shape = self.levels[0].shape
        out = torch.zeros(shape, dtype=torch.float64, device=self.diagonal.device)
        box = values
        for axis, (start, count) in enumerate(zip(self.low, self.cells)):
            box = box.narrow(axis, start, count)
        interior(out, self.cells).copy_(box)
        # not a product: what lies outside the unknown cells need not be finite
        return torch.where(self.active, out.view(-1), 0.0)

    def store(self, flat: Float[Tensor, " n"], dtype: torch.dtype) -> Float[Tensor, "nx ny nz"]:
        """The reverse; 0 outside the unknown cells."""
        out = torch.zeros(self.shape, dtype=dtype, device=flat.device)
        box = out
        for axis, (start, count) in enumerate(zip(self.low, self.cells)):
            box = box.narrow(axis, start, count)
        box.copy_(interior(flat.view(self.levels[0].shape), self.cells))
        return out

    def apply(self, p: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        """h^2 A p of flat vectors."""
        out = torch.mul(self.diagonal, p)
        add_neighbours(p, self.couplings, self.levels[0], out, -1.0)
        return out

    def remove_means(self, values: Float[Tensor, " n"]) -> Tensor:
        """Take the mean of every closed component, in place; returns the squared norm of what was taken (0-d)."""
        if not self.closed_cells.numel():
            return torch.zeros((), dtype=values.dtype, device=values.device)
        sums = torch.zeros_like(self.closed_sizes).index_add_(0, self.closed_labels, values[self.closed_cells])
        means = sums / self.closed_sizes
        values[self.closed_cells] -= means[self.closed_labels]
        return (self.closed_sizes * means**2).sum()


def _ringed(cells: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    """Cells inside a ring of zeros; more zeros behind them up to `shape`."""
    out = np.zeros(shape, cells.dtype)
    out[tuple(slice(1, n + 1) for n in cells.shape)] = cells
    return out


def _on_device(arrays: list[np.ndarray], device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    x, y, z = (torch.from_numpy(a.ravel()).to(device) for a in arrays)
    return (x, y, z)


def _inverse_root(diagonal: np.ndarray) -> np.ndarray:
    return np.divide(1.0, np.sqrt(diagonal), out=np.zeros_like(diagonal), where=diagonal > 0)


def _level(plain: PlainLevel, device: torch.device) -> ScaledLevel:
    """Scale a level and lay it out; the box is made even so that every coarse cell has eight."""
    diagonal = plain.diagonal()
    nx, ny, nz = (2 * ((n + 1) // 2) + 2 for n in diagonal.shape)
    shape = (nx, ny, nz)
    scale = _ringed(_inverse_root(diagonal), shape)
    # the ring is zero, so what rolls over the end does not count
    couplings = [
        _ringed(c[1:-1, 1:-1, 1:-1], shape) * scale * np.roll(scale, 1, axis) for axis, c in enumerate(plain.couplings)
    ]
    coarse = [2 * ((n // 2 + 1) // 2) + 2 for n in (nx - 2, ny - 2, nz - 2)]
    i, j, k = (np.where((np.arange(n) > 0) & (np.arange(n) < n - 1), (np.arange(n) + 1) // 2, 0) for n in shape)
    parent = (i[:, None, None] * coarse[1] + j[:, None]) * coarse[2] + k
    return ScaledLevel(
        shape=shape,
        couplings=_on_device([c.astype(np.float32) for c in couplings], device),
        scale=torch.from_numpy(scale.astype(np.float32).ravel()).to(device),
        unscale=torch.from_numpy(_ringed(np.sqrt(diagonal), shape).astype(np.float32).ravel()).to(device),
        parent=torch.from_numpy(parent.astype(np.int32).ravel()).to(device),
    )


def _pseudo_inverse(plain: PlainLevel) -> np.ndarray:
    """Of the scaled operator of a small level, float32 [n,n]; closed components keep their mean 0."""
    diagonal = plain.diagonal()
    scale = _inverse_root(diagonal).ravel()
    index = np.arange(diagonal.size).reshape(diagonal.shape)
    matrix = np.diag((scale > 0).astype(np.float64))
    for axis, c in enumerate(plain.couplings):
        n = diagonal.shape[axis]
        here, before = np.take(index, range(1, n), axis).ravel(), np.take(index, range(n - 1), axis).ravel()
        across = np.take(c[1:-1, 1:-1, 1:-1], range(1, n), axis).ravel() * scale[here] * scale[before]
        matrix[here, before] = matrix[before, here] = -across
    values, vectors = np.linalg.eigh(matrix)
    kept = values > 1e-6
    return ((vectors[:, kept] / values[kept]) @ vectors[:, kept].T).astype(np.float32)


def interior(grid: Tensor, cells: tuple[int, int, int]) -> Tensor:
    """Without the ring."""
    nx, ny, nz = cells
    return grid[1 : nx + 1, 1 : ny + 1, 1 : nz + 1]


def add_neighbours(
    x: Tensor, couplings: tuple[Tensor, Tensor, Tensor], level: ScaledLevel, out: Tensor, sign: float
) -> None:
    """out += sign times the sum over neighbours of coupling times x, without the first and last plane."""
    first, last = level.strides[0], level.size - level.strides[0]
    core = out[first:last]
    for coupling, stride in zip(couplings, level.strides):
        core.addcmul_(coupling[first:last], x[first - stride : last - stride], value=sign)
        core.addcmul_(coupling[first + stride : last + stride], x[first + stride : last + stride], value=sign)
