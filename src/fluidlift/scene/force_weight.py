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
from fluidlift.types import (
    FaceVelocity,
    Filmed,
    FilmedMotion,
    FluidAsset,
    Grid,
    TriangleMesh,
    kind_of,
    matrix_from_quat,
)

if TYPE_CHECKING:
    from fluidlift.scene.build import Scene, SceneSettings

TOUCHED = 0.1
"""cells by which edited terrain differs from the filmed one, from which its place counts as touched"""

WAKE = 3.0
"""widths of what was put in over which the force comes back: the near wake of a bluff body, in which the flow turns
back, is one to three long"""


PULL = 3.0
"""cells that a wave crosses in the time constant of a pull: it has to be faster than what it corrects, and no faster,
for then its mean holds the noise of single cells (river of 20 cm, cells of 4.4 cm: time constants of 0.05 and 0.1 s
leave planar errors of 1.76 and 1.74 px, with forces 1.6 times as strong for the shorter one)"""


def following(scene: Scene, asset: FluidAsset, filmed: Filmed, settings: SceneSettings) -> Scene:
    """The scene with shares of what the asset knows of the filmed flow: its force, cells that stay dry or wet, and
    motion as a guide.

    They fade out around what was put in or dug out, and cells there may get wet or dry. All are left out, with a note,
    where the fluid itself, its inflow or the box is another one.

    Args:
        scene: with all edits.
        asset: that it comes from, as it was or on a coarser grid.
        filmed: of the asset on its own grid.
        settings: how much of force and guide.

    Raises:
        InputRejected: of another grid.
    """
    if settings.guide > 0 and filmed.motion is None and kind_of(scene.kind).is_channel_flow:
        text = "the flow is not guided: the asset has no motion of each frame; make it with --set simulate.guide=1"
        scene = replace(scene, notes=(*scene.notes, Notice("guide-missing", text)))
    force = filmed.force if settings.follow > 0 else None
    motion = filmed.motion if settings.guide > 0 else None
    if force is None and motion is None:
        return scene
    kept = replace(filmed, motion=motion) if force is not None else Filmed(motion=motion)
    kept = _on_grid_of(asset, kept)
    force, motion = kept.force, kept.motion
    if scene.changes or scene.inflow != InflowSchedule() or scene.terrain.grid != asset.grid:
        note = Notice(
            "force-left-out",
            "the force that keeps the filmed flow is left out, since this scene has another fluid, inflow or box",
        )
        return replace(scene, notes=(*scene.notes, note))
    untouched = _untouched(scene, asset)
    if force is not None:
        weight = settings.follow * untouched
        faded = FaceVelocity(*(_on_faces(weight, axis) * c for axis, c in enumerate(force.components)))
        dry, wet = (None if cells is None else cells & (untouched >= 1.0) for cells in (kept.dry, kept.wet))
        scene = replace(scene, force=faded, dry=dry, dry_for=kept.dry_for, wet=wet, inlet=kept.inlet)
    if motion is None:
        return scene
    weight = settings.guide * pull_rate(scene, _typical_speed(motion)) * untouched
    return replace(scene, guide=motion, guide_rates=tuple(_on_faces(weight, axis) for axis in range(3)))


def pull_rate(scene: Scene, speed: float) -> float:
    """1/s of a pull towards a flow of this speed (m/s)."""
    from fluidlift.scene.simulator import wave_speed

    return max(speed, wave_speed(scene)) / (PULL * scene.terrain.grid.spacing)


def _typical_speed(motion: FilmedMotion) -> float:
    """Root mean square where anything moves, m/s."""
    squares = [np.square(c[c != 0], dtype=np.float32).mean() if c.any() else 0.0 for c in motion.components]
    return float(np.sqrt(sum(squares)))


def _on_grid_of(asset: FluidAsset, filmed: Filmed) -> Filmed:
    """What was filmed, of which something is known, on the grid of a copy of the asset with wider cells.

    Raises:
        InputRejected: it is of another grid.
    """
    from fluidlift.fit.coarsen import coarsen_velocity

    fine = [part.shape for part in (filmed.force, filmed.motion, filmed.dry, filmed.wet) if part is not None]
    if any(part != fine[0] for part in fine):
        raise InputRejected(f"a filmed flow on {fine} cells", "one grid", "make the asset again")
    shape = fine[0]
    while max(shape) > max(asset.grid.shape) and min(shape) > 1:
        filmed = Filmed(
            None if filmed.force is None else coarsen_velocity(filmed.force),
            None if filmed.dry is None else _coarser(filmed.dry),
            filmed.dry_for,
            None if filmed.wet is None else _coarser(filmed.wet),
            None if filmed.motion is None else _coarser_motion(filmed.motion),
            filmed.inlet,
        )
        shape = tuple(-(-n // 2) for n in shape)
    if shape != asset.grid.shape:
        raise InputRejected(f"a filmed flow on {shape} cells", f"{asset.grid.shape} cells", "make the asset again")
    return filmed


def _coarser_motion(motion: FilmedMotion) -> FilmedMotion:
    """On cells twice as wide."""
    from fluidlift.fit.coarsen import coarsen_velocity

    frames = [coarsen_velocity(FaceVelocity(*(c.astype(np.float32) for c in each))) for each in zip(*motion.components)]
    u, v, w = (np.stack(c).astype(np.float16) for c in zip(*(f.components for f in frames)))
    return FilmedMotion(u, v, w, motion.interval, motion.start)


def _coarser(cells: Bool[np.ndarray, "nx ny nz"]) -> Bool[np.ndarray, "mx my mz"]:
    """Cells twice as wide that are so throughout; an odd last layer goes as `coarsen_velocity` has it."""
    even = np.pad(cells, [(0, n % 2) for n in cells.shape], mode="edge")
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
