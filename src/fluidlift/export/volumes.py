"""OpenVDB files of frames: velocity, density and, of liquids, the level set and white water."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from fluidlift.export.job import (
    ExportJob,
    ExportOutcome,
)
from fluidlift.export.whitewater import shadow_of, whitewater_grids
from fluidlift.io.frames import FluidFrame
from fluidlift.io.output_files import cleared, numbered
from fluidlift.types import FaceVelocity, Grid, TriangleMesh, kind_of

if TYPE_CHECKING:
    from fluidlift.io.volume_grid import VolumeGrid


BAND = 3.0
"""half width of the level set, voxels: what OpenVDB's own tools expect"""


FULL = 50.0
"""percentile of the cells' amounts that counts as a full cell"""


def write_volumes(job: ExportJob, frames: Iterator[FluidFrame]) -> ExportOutcome:
    """Numbered OpenVDB files: `vel` (m/s) and `density` on cells of the simulation, `surface` (m) on half of them, and
    `spray`, `foam` and `bubbles` (1/m) on whole ones."""
    from fluidlift.io.volume_grid import VolumeGrid, velocity_grid, write_vdb

    cleared(job.out, [".vdb"])
    h = job.asset.grid.spacing
    for k, frame in zip(job.numbers, frames, strict=True):
        velocity, density, grid = gridded(frame, job.asset.grid, smoke=kind_of(job.asset.kind).is_gas)
        filled = density > 0
        grids = [velocity_grid(velocity, grid, active=filled), VolumeGrid("density", density, h, grid.origin, filled)]
        if frame.surface is not None and len(frame.surface.faces):
            grids.append(level_set(frame.surface, 0.5 * h))
        grids += whitewater_grids(frame, job.asset.grid)
        write_vdb(numbered(job.out, k, ".vdb"), grids)
    return ExportOutcome()


def level_set(mesh: TriangleMesh, spacing: float) -> VolumeGrid:
    """Signed distance (m) of a closed mesh as OpenVDB's tools take it: cut at three voxels, the inside stored as well,
    because the writer knows no tiles and what is not stored counts as outside."""
    from fluidlift.io.volume_grid import VolumeGrid
    from fluidlift.numerics.mesh_distance import mesh_distance

    found, band = mesh_distance(mesh, spacing), BAND * spacing
    x, y, z = (float(v) - 0.5 * spacing for v in found.grid.origin)  # the voxels' middles lie on the nodes
    values, stored = np.clip(found.distance, -band, band), found.distance < band
    return VolumeGrid("surface", values, spacing, (x, y, z), stored, grid_class="level set", background=band)


def gridded(frame: FluidFrame, cells: Grid, *, smoke: bool = False) -> tuple[FaceVelocity, np.ndarray, Grid]:
    """Velocity and density of a frame on cells that lie on those of the simulation, as far as its particles reach.

    Density is the opacity of the splats in a cell next to that of a full one, at most 1: the share of a cell that a
    liquid fills. A skin is no liquid. Of smoke it is the extinction, 1/m: what the splats of a cell take out of a beam,
    without what they have for a rasteriser that draws nothing below a least opacity.
    """
    from fluidlift.look.smoke_splats import DRAWN
    from fluidlift.look.surface_skin import of_skin
    from fluidlift.physics.transfer import particles_to_grid
    from fluidlift.types import Particles

    h, liquid = cells.spacing, ~of_skin(frame.gaussians, cells.spacing)
    points = frame.gaussians.means[liquid].astype(np.float64)
    first = np.floor((points.min(axis=0) - cells.low) / h).astype(int) - 1
    last = np.floor((points.max(axis=0) - cells.low) / h).astype(int) + 2
    (nx, ny, nz), (x, y, z) = (last - first).tolist(), (cells.low + first * h).tolist()
    grid = Grid((nx, ny, nz), h, (x, y, z))
    velocity, _ = particles_to_grid(Particles.at_rest(points, 1.0, velocities=frame.velocities[liquid]), grid)
    flat = np.ravel_multi_index(tuple(grid.cell_of(points).T), grid.shape)
    splats = frame.gaussians.select(liquid)
    if smoke:
        taken = shadow_of(splats, np.maximum(splats.opacities.astype(np.float64) - DRAWN, 0.0))
        found = np.bincount(flat, weights=taken / h**3, minlength=grid.cells).reshape(grid.shape)
        return velocity, found.astype(np.float32), grid
    amount = np.bincount(flat, weights=splats.opacities, minlength=grid.cells).reshape(grid.shape)
    full = np.percentile(amount[amount > 0], FULL)
    return velocity, np.clip(amount / max(float(full), 1e-12), 0.0, 1.0).astype(np.float32), grid
