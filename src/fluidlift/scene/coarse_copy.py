"""An asset on wider cells and with fewer Gaussians, for a simulation that follows a hand."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fluidlift.types import FluidAsset, Gaussians

PER_CELL = 8
"""Gaussians of a coarse cell that are kept: what the inlet fills its cells with"""
SECONDS_PER_FRAME = 0.2
"""that the copy is to take at most: five frames per second"""
FEWEST_PARTICLES = 1000
"""of a copy that is made coarser because this machine is slow: fewer show no flow"""
FEWEST_LAYERS = 6
"""cells of the thinnest side of such a copy: with fewer a stream is one cell deep"""


@dataclass(frozen=True)
class PreviewSize:
    """How coarse the copy is."""

    particles: int = 20_000
    """at most, at the first instant"""
    cells: int = 40_000
    """at most, of the grid"""
    frames: int = 120
    """at most; the state of a longer simulation is not shown live"""
    seconds: float | None = SECONDS_PER_FRAME
    """that a frame may take on this machine before cells double once more; None: the clock does not count"""


def coarse_asset(asset: FluidAsset, size: PreviewSize | None = None) -> FluidAsset:
    """The asset on cells so wide, and with so few Gaussians, that it can be simulated live.

    Cells double until both limits hold. Where they do, of the Gaussians in each cell at most `PER_CELL` stay, and grow
    so that together they fill the space of all.
    """
    size = size or PreviewSize()
    while len(asset.rest) > size.particles or asset.grid.cells > size.cells:
        if min(asset.grid.shape) < 4:
            break
        asset = coarser(asset)
    return asset


def coarser(asset: FluidAsset) -> FluidAsset:
    """The asset on cells twice as wide."""
    from fluidlift.fit.coarsen import coarsen_cells, coarsen_terrain, coarsen_velocity

    terrain = coarsen_terrain(asset.terrain)
    return replace(
        asset, terrain=terrain, grid=terrain.grid, cell_types=coarsen_cells(asset.cell_types),
        velocity=coarsen_velocity(asset.velocity), rest=thinned(asset.rest, terrain.grid, PER_CELL),
    )  # fmt: skip


def bears_coarser(asset: FluidAsset) -> bool:
    """Whether a copy on cells twice as wide would still show a flow."""
    return len(asset.rest) >= 8 * FEWEST_PARTICLES and min(asset.grid.shape) >= 2 * FEWEST_LAYERS


def thinned(rest: Gaussians, grid: Any, per_cell: int) -> Gaussians:
    """At most `per_cell` Gaussians of each cell of the grid, drawn evenly and with a fixed seed; what stays grows by
    the cube root of how many it stands for."""
    if not len(rest):
        return rest
    cells = np.clip(grid.cell_of(rest.means), 0, np.asarray(grid.shape) - 1)
    key = np.asarray(np.ravel_multi_index(tuple(cells.T), grid.shape))
    order = np.random.default_rng(0).permutation(len(key))
    order = order[np.argsort(key[order], kind="stable")]
    _, first, count = np.unique(key[order], return_index=True, return_counts=True)
    rank = np.arange(len(key)) - np.repeat(first, count)
    kept = order[rank < per_cell]
    stands_for = (
        np.repeat(count, count)[rank < per_cell] / np.minimum(np.repeat(count, count), per_cell)[rank < per_cell]
    )
    grown = rest.select(kept)
    return replace(grown, scales=grown.scales * np.cbrt(stands_for)[:, None].astype(np.float32))
