"""How far a scene keeps the force that holds the filmed flow: where a person changed it, the flow finds its own way."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from fluidlift.errors import InputRejected
from fluidlift.messages import Notice
from fluidlift.physics.inflow_schedule import InflowSchedule
from fluidlift.types import FaceVelocity, Filmed, FluidAsset, Grid, TriangleMesh, matrix_from_quat

if TYPE_CHECKING:
    from fluidlift.scene.build import Scene

TOUCHED = 0.1
"""cells by which edited terrain differs from the filmed one, from which its place counts as touched"""

WAKE = 3.0
"""widths of what was put in over which the force comes back: the near wake of a bluff body, in which the flow turns
back, is one to three long"""


def following(scene: Scene, asset: FluidAsset, filmed: Filmed, share: float) -> Scene:
    """The scene with a share of the asset's force, and its dry cells.

    The force fades out around what was put in or dug out, and cells there may get wet. Both are left out, with a note,
    where the fluid itself, its inflow or the box is another one.

    Args:
        scene: with all edits.
        asset: that it comes from, as it was or on a coarser grid.
        filmed: of the asset on its own grid.
        share: 0 to 1.

    Raises:
        InputRejected: of another grid.
    """
    from fluidlift.fit.coarsen import coarsen_velocity

    force, dry = filmed.force, filmed.dry
    if force is None or share <= 0:
        return scene
    if dry is not None and dry.shape != force.shape:
        raise InputRejected(f"dry cells {dry.shape}", f"{force.shape}, as the force", "make the asset again")
    while max(force.shape) > max(asset.grid.shape) and min(force.shape) > 1:
        force, dry = coarsen_velocity(force), None if dry is None else _coarser(dry)
    if force.shape != asset.grid.shape:
        raise InputRejected(f"a force on {force.shape} cells", f"{asset.grid.shape} cells", "make the asset again")
    if scene.changes or scene.inflow != InflowSchedule() or scene.terrain.grid != asset.grid:
        note = Notice(
            "force-left-out",
            "the force that keeps the filmed flow is left out, since this scene has another fluid, inflow or box",
        )
        return replace(scene, notes=(*scene.notes, note))
    untouched = _untouched(scene, asset)
    weight = share * untouched
    kept = FaceVelocity(*(_on_faces(weight, axis) * c for axis, c in enumerate(force.components)))
    return replace(scene, force=kept, dry=None if dry is None else dry & (untouched >= 1.0))


def _coarser(dry: Bool[np.ndarray, "nx ny nz"]) -> Bool[np.ndarray, "mx my mz"]:
    """Cells twice as wide that are dry throughout; an odd last layer goes as `coarsen_velocity` has it."""
    even = np.pad(dry, [(0, n % 2) for n in dry.shape], mode="edge")
    return np.logical_and.reduce([even[i::2, j::2, k::2] for i, j, k in np.ndindex(2, 2, 2)])


def _untouched(scene: Scene, asset: FluidAsset) -> Float[np.ndarray, "nx ny nz"]:
    """0 where a person put something in or dug something out, to 1 away from it."""
    grid, change = asset.grid, scene.terrain.signed_distance - asset.terrain.signed_distance
    touched = np.zeros(grid.shape, bool)
    for corner in np.ndindex(2, 2, 2):
        part = tuple(slice(c, c + n) for c, n in zip(corner, grid.shape))
        touched |= np.abs(change[part]) > TOUCHED * grid.spacing
    for o in scene.obstacles:
        touched |= _box(grid, o.mesh, matrix_from_quat(o.rotation), np.asarray(o.position))
    for e in scene.emitters:
        touched |= _box(grid, e.mesh, np.eye(3), np.zeros(3))
    if not touched.any():
        return np.ones(grid.shape, np.float32)
    labels, count = ndimage.label(touched)
    weight = np.ones(grid.shape, np.float32)
    for part in range(1, count + 1):
        piece = labels == part
        wide = np.cbrt(float(piece.sum()))
        away = ndimage.distance_transform_edt(~piece)
        weight = np.minimum(weight, np.clip((away - 1.0) / (WAKE * wide), 0.0, 1.0)).astype(np.float32)
    return weight


def _box(grid: Grid, mesh: TriangleMesh, rotation: np.ndarray, position: np.ndarray) -> Bool[np.ndarray, "nx ny nz"]:
    """Cells of the box around a mesh, at least the one in its middle."""
    vertices = mesh.vertices @ rotation.T + position
    low = np.clip(np.floor((vertices.min(axis=0) - grid.low) / grid.spacing), 0, np.array(grid.shape) - 1).astype(int)
    high = np.clip(np.ceil((vertices.max(axis=0) - grid.low) / grid.spacing), low + 1, grid.shape).astype(int)
    cells = np.zeros(grid.shape, bool)
    cells[tuple(slice(a, b) for a, b in zip(low, high))] = True
    return cells


def _on_faces(cells: Float[np.ndarray, "nx ny nz"], axis: int) -> np.ndarray:
    """The smaller value of the two cells beside each face across `axis`."""
    wide = np.pad(cells, [(int(a == axis),) * 2 for a in range(3)], mode="edge")
    n = cells.shape[axis]
    return np.minimum(np.take(wide, range(n + 1), axis), np.take(wide, range(1, n + 2), axis))
