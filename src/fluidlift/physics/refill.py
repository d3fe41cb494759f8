"""Cells that are kept from running dry, since fluid is known to be in them at all times.

A sheet that falls gets thinner as it gets faster; fed at its rim alone it tears where it is thinner than a few
particles. What is filmed there all the time is fed otherwise: by a rim that is wider, thicker or faster than the one
that was found, or by the air that falling water takes along. So where the camera would see through the fluid, beside
all that is left of it, the cells that have run dry get new fluid, which moves as the filmed one does there. A sheet
that has come nearer or gone further off is no hole.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage
from scipy.spatial import cKDTree

from fluidlift.errors import require
from fluidlift.numerics.sampling import sample_faces, sample_nodes
from fluidlift.physics.boundaries import CLEARANCE
from fluidlift.types import FaceVelocity, Particles, PinholeCamera, Terrain

JITTER = 0.1
"""of the spacing of particles: so far along each axis are new ones off their lattice at most, as at an inlet"""


class Refill:
    """Which cells are kept from running dry, and what they get.

    Args:
        cells: bool [nx,ny,nz]; those that hold nothing of the body (an outlet) are left out.
        velocity: of the fluid there, m/s.
        body: the fluid at rest, whose nearest particle lends a new one its look.
        terrain: solid ground, on the grid.
        camera: that knows the cells to be wet.

    Raises:
        ValueError: cells or velocities of another grid.
    """

    def __init__(
        self,
        cells: Bool[np.ndarray, "nx ny nz"],
        velocity: FaceVelocity,
        body: Particles,
        terrain: Terrain,
        camera: PinholeCamera,
    ) -> None:
        grid = terrain.grid
        require(cells.shape == grid.shape == velocity.shape, f"cells {cells.shape}", f"{grid.shape}, as the velocity")
        self._terrain, self._velocity, self._camera = terrain, velocity, camera
        held = np.zeros(grid.shape, bool)
        held[tuple(np.clip(grid.cell_of(body.positions), 0, np.asarray(grid.shape) - 1).T)] = True
        self._cells = np.argwhere(cells & held)
        self._middles = grid.low + (self._cells + 0.5) * grid.spacing
        self._nearest, self._source = cKDTree(body.positions), body.source
        depth = camera.project(self._middles)[1]
        self._width = grid.spacing * camera.focal[0] / max(float(np.median(depth)), 1e-6) if len(depth) else 1.0

    def missing(
        self, positions: Float[np.ndarray, "n 3"], spacing: float, rng: np.random.Generator
    ) -> Float[np.ndarray, "m 3"]:
        """Places (m) for the particles that are missing.

        Args:
            positions: of all particles, m.
            spacing: of new particles, m; a cell is as wide as one or several.
            rng: of the jitter.
        """
        grid = self._terrain.grid
        dry = self._cells[~self._before(positions)]
        if not len(dry):
            return np.zeros((0, 3), np.float32)
        step = (np.arange(max(round(grid.spacing / spacing), 1)) + 0.5) * spacing
        lattice = np.stack(np.meshgrid(step, step, step, indexing="ij"), axis=-1).reshape(-1, 3)
        places = (grid.low + dry[:, None] * grid.spacing + lattice).reshape(-1, 3)
        places = places + rng.uniform(-JITTER, JITTER, places.shape) * spacing
        clear = sample_nodes(self._terrain.signed_distance, grid, places) > CLEARANCE * grid.spacing
        return places[clear].astype(np.float32)

    def particles(self, places: Float[np.ndarray, "m 3"], mass: float, first_id: int) -> Particles:
        """New ones of a mass (kg), numbered from an id on."""
        moves = sample_faces(self._velocity, self._terrain.grid, places).astype(np.float32)
        source = self._source[self._nearest.query(places)[1]].astype(np.int64)
        return Particles.at_rest(places, np.full(len(places), mass, np.float32), source, moves, first_id=first_id)

    def _before(self, positions: np.ndarray) -> Bool[np.ndarray, " m"]:
        """Which cells are seen less than two cells beside a particle."""
        shape = np.ceil(np.array(self._camera.size) / self._width).astype(int) + 1
        seen = np.zeros(shape, bool)
        seen[tuple(self._place(positions, shape).T)] = True
        seen = ndimage.binary_dilation(seen, np.ones((3, 3), bool))
        return seen[tuple(self._place(self._middles, shape).T)]

    def _place(self, points: np.ndarray, shape: np.ndarray) -> np.ndarray:
        """Cells of the picture in which points (m) are seen; those beside it are in its nearest one."""
        uv, depth = self._camera.project(points)
        ahead = np.where((depth > 0)[:, None], uv, 0.0)
        return np.clip(np.floor(ahead / self._width), 0, shape - 1).astype(int)
