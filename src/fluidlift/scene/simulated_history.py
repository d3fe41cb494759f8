"""Figures of each simulated frame, as they come."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Int

from fluidlift.numerics.short_axis import highest, lowest
from fluidlift.scene.build import Scene
from fluidlift.types import Particles
from fluidlift.types.rows import rows

if TYPE_CHECKING:
    from fluidlift.physics.stepping import ParticleSimulator

MARKED = 64
"""cells of the box around all that is there, for each of them, up to which they are marked: a byte each"""


@dataclass
class FrameHistory:
    """Figures of each frame so far."""

    volume: list[float] = field(default_factory=list)
    """m^3 of the cells that hold particles"""
    leak: list[float] = field(default_factory=list)
    """share of the particles inside the terrain"""
    count: list[int] = field(default_factory=list)
    """particles"""
    substeps: list[int] = field(default_factory=list)
    """of the step that led to the frame; 0 for the first"""
    poses: list[np.ndarray] = field(default_factory=list)
    """[b,7] of the obstacles: position (m) and orientation (w, x, y, z)"""

    def __len__(self) -> int:
        return len(self.count)

    def add(self, scene: Scene, simulator: ParticleSimulator, particles: Particles, substeps: int) -> None:
        """One more frame."""
        from fluidlift.numerics.sampling import sample_nodes

        bodies = simulator.bodies
        pose = np.zeros((0, 7)) if bodies is None else np.concatenate([bodies.position, bodies.orientation], axis=1)
        self.poses.append(pose)
        grid = scene.terrain.grid
        occupied = _distinct(np.floor((particles.positions - grid.low) / grid.spacing).astype(np.int64))
        inside = grid.contains(particles.positions)
        distance = sample_nodes(scene.terrain.signed_distance, grid, rows(particles.positions, inside))
        self.volume.append(occupied * grid.spacing**3)
        self.leak.append(float((distance < -0.1 * grid.spacing).mean()) if inside.any() else 0.0)
        self.count.append(len(particles))
        self.substeps.append(substeps)

    def arrays(self) -> dict[str, np.ndarray]:
        """One entry per frame."""
        return {
            "volume": np.array(self.volume, np.float32),
            "leak": np.array(self.leak, np.float32),
            "count": np.array(self.count, np.int64),
            "substeps": np.array(self.substeps, np.int64),
            "poses": np.array(self.poses, np.float64),
        }

    @classmethod
    def of(cls, arrays: dict[str, np.ndarray], frames: int) -> FrameHistory:
        """The first frames of `arrays`."""
        figures = {name: arrays[name][:frames].tolist() for name in ("volume", "leak", "count", "substeps")}
        return cls(**figures, poses=list(arrays["poses"][:frames]))


def _distinct(cells: Int[np.ndarray, "n 3"]) -> int:
    """How many different cells there are. Marked in their box where that is small, and numbered one by one where that
    fits: rows are sorted ten times as slowly as numbers, and these as slowly as a mark is set."""
    if not len(cells):
        return 0
    low = lowest(cells)
    shape = tuple(int(n) + 1 for n in highest(cells) - low)
    if math.prod(shape) > 2**62:
        return len(np.unique(cells, axis=0))
    number = ((cells[:, 0] - low[0]) * shape[1] + (cells[:, 1] - low[1])) * shape[2] + (cells[:, 2] - low[2])
    if math.prod(shape) > MARKED * len(cells):
        return len(np.unique(number))
    there = np.zeros(math.prod(shape), bool)
    there[number] = True
    return int(np.count_nonzero(there))
