"""The loss between a simulated and a target velocity (paper, `optLoss`).

    gridMask o ( alpha (1 - cos(v_sim, v_target)) + beta |v_sim - v_target|^2 / U^2 )

U is the mean speed of the target, so that both terms are of order one. The mask weighs cells by type: surface (fluid
beside EMPTY; what a video shows), occupied (fluid below; inferred), empty. Since |a - b|^2 = 2 (1 - cos) for unit
vectors, the loss is a sum of squares: `residuals` gives its terms to a least-squares method.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from fluidlift.errors import require
from fluidlift.physics.advection import Faces
from fluidlift.types import CellType


@dataclass(frozen=True)
class VelocityLossWeights:
    """alpha, beta and the mask of the paper (which states no values)."""

    direction: float = 0.5
    """alpha"""
    magnitude: float = 1.0
    """beta"""
    surface: float = 1.0
    occupied: float = 0.5
    empty: float = 0.0
    stagnant: float = 0.1
    """share of U below which a direction is noise: unit vectors are v / sqrt(|v|^2 + (stagnant U)^2)"""


def surface_cells(cell_types: np.ndarray) -> np.ndarray:
    """bool [nx,ny,nz]: FLUID cells with an EMPTY neighbour across a face."""
    fluid, empty = cell_types == CellType.FLUID, cell_types == CellType.EMPTY
    beside = np.zeros(fluid.shape, bool)
    for axis in range(3):
        low, high = [slice(None)] * 3, [slice(None)] * 3
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        beside[tuple(low)] |= empty[tuple(high)]
        beside[tuple(high)] |= empty[tuple(low)]
    return fluid & beside


def grid_mask(
    cell_types: np.ndarray, weights: VelocityLossWeights | None = None, observed: np.ndarray | None = None
) -> Float[np.ndarray, "nx ny nz"]:
    """Weight of each cell (paper: gridMask), summing to 1; SOLID, INFLOW, OUTFLOW and hidden cells count 0.

    Raises:
        ValueError: no cell has a weight.
    """
    weights = weights or VelocityLossWeights()
    fluid = cell_types == CellType.FLUID
    mask = np.where(fluid, weights.occupied, 0.0)
    mask = np.where(surface_cells(cell_types), weights.surface, mask)
    mask = np.where(cell_types == CellType.EMPTY, weights.empty, mask)
    if observed is not None:
        mask = np.where(observed, mask, 0.0)
    require(mask.sum() > 0, "no fluid cell to compare velocities in", "at least one FLUID cell")
    return (mask / mask.sum()).astype(np.float32)


def cell_velocity(faces: Faces) -> Float[Tensor, "nx ny nz 3"]:
    """Averages of opposite faces; differentiable."""
    u, v, w = faces
    return torch.stack(
        [0.5 * (u[1:] + u[:-1]), 0.5 * (v[:, 1:] + v[:, :-1]), 0.5 * (w[:, :, 1:] + w[:, :, :-1])], dim=-1
    )


def _unit(velocity: Tensor, floor: float, error: float = 0.0) -> Tensor:
    """v / sqrt(|v|^2 + floor^2); with an error, its mean over v + n, n of variance error^2 per component.

    To second order, mean u(v + n) = u + error^2 / 2 lap u, which a floor^2 larger by
    error^2 (5 - 3 |v|^2 / (|v|^2 + floor^2)) gives, and gives without overshoot where the error is large.
    """
    square = (velocity**2).sum(-1, keepdim=True)
    shorter = square + floor**2
    if error > 0:
        shorter = shorter + error**2 * (5 - 3 * square / shorter)
    return velocity / torch.sqrt(shorter)


def velocity_loss(
    simulated: Float[Tensor, "*n 3"],
    target: Float[Tensor, "*n 3"],
    mask: Float[Tensor, "*n"],
    *,
    speed: float,
    weights: VelocityLossWeights | None = None,
    error: float = 0.0,
) -> Tensor:
    """The loss: 0 where equal; alpha / 2 + beta or more for a simulation at rest.

    Args:
        simulated: m/s.
        target: m/s.
        mask: weight per cell, summing to 1.
        speed: U, m/s.
        weights: alpha, beta and the stagnation floor.
        error: standard deviation of the error of a component of the target, m/s.
    """
    weights = weights or VelocityLossWeights()
    floor = weights.stagnant * speed
    a, b = _unit(simulated, floor, error), _unit(target, floor)
    # 1 - cos, in the form that stays exact when the floor makes a and b shorter than 1
    misdirection = 0.5 * ((a - b) ** 2).sum(-1)
    difference = ((simulated - target) ** 2).sum(-1) / speed**2
    return (mask * (weights.direction * misdirection + weights.magnitude * difference)).sum()


def residuals(
    simulated: Float[Tensor, "*n 3"],
    target: Float[Tensor, "*n 3"],
    mask: Float[Tensor, "*n"],
    *,
    speed: float,
    weights: VelocityLossWeights | None = None,
    error: float = 0.0,
) -> Float[Tensor, "*n 6"]:
    """Terms whose squares add up to `velocity_loss`: three of direction, three of magnitude per cell."""
    weights = weights or VelocityLossWeights()
    floor = weights.stagnant * speed
    root = torch.sqrt(mask)[..., None]
    turn = (0.5 * weights.direction) ** 0.5 * (_unit(simulated, floor, error) - _unit(target, floor))
    change = weights.magnitude**0.5 / speed * (simulated - target)
    return root * torch.cat([turn, change], dim=-1)
