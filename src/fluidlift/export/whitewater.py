"""White water for other tools: points with velocity and kind beside the meshes, and densities in the volumes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fluidlift.io.frames import FluidFrame
from fluidlift.io.output_files import cleared, numbered
from fluidlift.look.whitewater_splats import kinds_of
from fluidlift.types import Gaussians, Grid, Similarity3

if TYPE_CHECKING:
    from fluidlift.io.volume_grid import VolumeGrid

FOLDER = "whitewater"
"""of the points, beside the meshes"""
KINDS = ("spray", "foam", "bubbles")
"""by their numbers, and the names of their grids"""


def has_whitewater(manifest: Mapping[str, Any]) -> bool:
    """Whether the frames of an asset were simulated with white water; there may be none in them all the same."""
    parts = manifest.get("simulation", {}).get("parts")
    return isinstance(parts, Mapping) and "white water" in parts


def with_kinds(frame: FluidFrame | tuple, cell: float) -> FluidFrame:
    """A frame that tells which of its splats are white water, simulated with cells of that width (m)."""
    frame = FluidFrame.of(frame)
    return frame._replace(kinds=kinds_of(frame.gaussians, cell))


def whitewater_of(frame: FluidFrame) -> FluidFrame | None:
    """The white water of a frame; None where the fluid has none in any frame."""
    return None if frame.kinds is None else frame.part(np.asarray(frame.kinds) >= 0)


class WhitewaterFiles:
    """whitewater/####.ply in a folder: points with velocity, kind, id, radius and opacity."""

    def __init__(self, out: Path, place: Similarity3, comment: str) -> None:
        """
        Args:
            out: folder of the export; files of an earlier run are removed.
            place: file_from_world.
            comment: which axes and units that makes, for the header.
        """
        self._folder, self._place, self._comment = out / FOLDER, place, comment
        if self._folder.is_dir() and not self._folder.is_symlink():
            cleared(self._folder, [".ply"])
            if not any(self._folder.iterdir()):
                self._folder.rmdir()

    def write(self, number: int, frame: FluidFrame) -> None:
        """The points of a frame: also where there are none, as long as the fluid has white water at all, because a
        sequence with gaps is none to most tools."""
        from fluidlift.io.ply import write_points

        white = whitewater_of(frame)
        if white is None or white.kinds is None:
            return
        g = white.gaussians
        radius = np.cbrt(np.prod(g.scales.astype(np.float64), axis=1)) * self._place.scale
        speeds = self._place.vectors(white.velocities.astype(np.float64)).astype(np.float32)
        extras = dict(zip(("vx", "vy", "vz"), speeds.T)) | {
            "kind": white.kinds.astype(np.int32), "id": white.ids.astype(np.int32),
            "radius": radius.astype(np.float32), "opacity": g.opacities.astype(np.float32),
        }  # fmt: skip
        points = self._place.points(g.means.astype(np.float64)).astype(np.float32)
        path = numbered(self._folder, number, ".ply")
        write_points(path, points, colors=np.clip(g.rgb, 0.0, 1.0), extras=extras, comment=self._comment)


def whitewater_grids(frame: FluidFrame, cells: Grid) -> list[VolumeGrid]:
    """A grid `spray`, `foam` and `bubbles` each, on voxels that lie on the cells; none where the fluid has none in any
    frame.

    A value is the extinction (1/m) at which a fog weakens light as the splats do: a splat of standard deviation s and
    opacity a takes 2 pi s^2 a away from a beam, shared among the eight voxels around it by how near they are.
    *Assumption:* no splat stands in the shadow of another within a voxel.
    """
    from fluidlift.io.volume_grid import VolumeGrid

    white, h = whitewater_of(frame), cells.spacing
    if white is None or white.kinds is None:
        return []
    grids = []
    for number, name in enumerate(KINDS):
        g = white.gaussians.select(white.kinds == number)
        values, first = spread((g.means - cells.low) / h, shadow_of(g, g.opacities) / h**3)
        x, y, z = (cells.low + h * first).tolist()
        grids.append(VolumeGrid(name, values, h, (x, y, z), values > 0))
    return grids


def shadow_of(gaussians: Gaussians, opacities: np.ndarray) -> np.ndarray:
    """m^2 [n] that splats of some opacities take out of a beam: 2 pi s^2 a."""
    return 2.0 * np.pi * np.cbrt(np.prod(gaussians.scales.astype(np.float64), axis=1)) ** 2 * opacities


def spread(places: np.ndarray, amounts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Amounts [n] at places [n,3] (cells), shared among the middles of the eight cells around each: float32
    [nx,ny,nz], and the cell that its first one is."""
    if not len(places):
        return np.zeros((1, 1, 1), np.float32), np.zeros(3, np.int64)
    low = np.floor(places - 0.5).astype(np.int64)
    part, first = places - 0.5 - low, low.min(axis=0)
    shape = tuple((low.max(axis=0) - first + 2).tolist())
    values = np.zeros(int(np.prod(shape)))
    for corner in np.ndindex(2, 2, 2):
        weight = np.where(np.array(corner), part, 1.0 - part).prod(axis=1)
        flat = np.ravel_multi_index(tuple((low - first + corner).T), shape)
        values += np.bincount(flat, weights=amounts * weight, minlength=len(values))
    return values.reshape(shape).astype(np.float32), first
