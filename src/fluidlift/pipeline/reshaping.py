"""Edits of the world around a fluid, before it is simulated: terrain, emitters, and what was changed in words."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from fluidlift.types import FluidParameters, Gaussians, Grid, concatenate, sh_from_rgb

if TYPE_CHECKING:
    from fluidlift.physics.emitter import Emitter
    from fluidlift.physics.terrain_edit import TerrainEdit
    from fluidlift.pipeline.scene import Scene

INSIDE = 0.42
"""standard deviation of a splat of the inside, cells"""
SHADES = 16
"""Gaussians that an emitter's particles take their look from"""
SHADE = 0.04
"""by which they are lighter or darker than the colour: water without any pattern does not show that it moves"""
HIGHEST = 2.0
"""longest sides of the box above it at which an emitter may be"""


def with_terrain(scene: Scene, edits: Sequence[TerrainEdit]) -> Scene:
    """The scene on its edited terrain: water, inlet, outlet and velocities have followed it.

    Raises:
        InputRejected: edits that do not fit, or a box that memory cannot hold.
    """
    from fluidlift.physics.preflight import check_memory
    from fluidlift.physics.terrain_edit import Replace
    from fluidlift.physics.terrain_reshape import reshaped, reshaped_body, reshaped_gaussians, reshaped_velocity
    from fluidlift.pipeline.story import available_memory
    from fluidlift.types import CellType

    if not edits:
        return scene

    def check(grid: Grid) -> None:
        check_memory(grid, len(scene.body), available_memory())

    new = reshaped(scene.terrain, scene.cell_types, edits, check=check)
    inlet = np.argwhere(scene.cell_types == CellType.INFLOW)
    old = scene.terrain.grid
    middle = old.low + (inlet.mean(axis=0) + 0.5) * old.spacing if len(inlet) else 0.5 * (old.low + old.high)
    inflow = new.place.directions(middle[None], np.array([scene.parameters.inflow_velocity]))[0]
    return replace(
        scene,
        terrain=new.terrain,
        cell_types=new.cell_types,
        velocity=reshaped_velocity(scene.velocity, old, new),
        body=reshaped_body(scene.body, new),
        rest=reshaped_gaussians(scene.rest, new.place),
        painted=scene.rest.means,
        parameters=replace(scene.parameters, inflow_velocity=tuple(inflow)),
        reshaped=True,
        notes=scene.notes + tuple(e.note for e in edits if isinstance(e, Replace) and e.note),
    )


def with_emitters(scene: Scene, emitters: Sequence[Emitter]) -> Scene:
    """The scene with emitters, in a box high enough for them, and with the Gaussians that their particles look like.

    Raises:
        InputRejected: an emitter that is no solid, beside or below the box, far above it, or inside the ground.
    """
    if not emitters:
        return scene
    scene = _raised(scene, emitters)
    looks, rest, painted = [], [scene.rest], [scene.rest.means if scene.painted is None else scene.painted]
    first = len(scene.rest)
    for emitter in emitters:
        own, origin = emitter_look(emitter, scene.rest, INSIDE * scene.terrain.grid.spacing)
        looks.append(np.arange(first, first + len(own)))
        first += len(own)
        rest.append(own)
        painted.append(origin)
    return replace(
        scene,
        rest=concatenate(rest),
        painted=np.concatenate(painted),
        emitters=tuple(emitters),
        emitter_looks=tuple(looks),
    )


def _raised(scene: Scene, emitters: Sequence[Emitter]) -> Scene:
    from fluidlift.physics.preflight import check_emitters
    from fluidlift.physics.terrain_reshape import raised_box, reshaped_velocity

    grid = scene.terrain.grid
    limit = grid.high[2] + HIGHEST * float((grid.high - grid.low).max())
    top = max(float(np.asarray(e.mesh.vertices)[:, 2].max()) for e in emitters)
    if grid.high[2] < top + 3 * grid.spacing and top < limit:
        new = raised_box(scene.terrain, scene.cell_types, top + 3 * grid.spacing)
        velocity = reshaped_velocity(scene.velocity, grid, new)
        scene = replace(scene, terrain=new.terrain, cell_types=new.cell_types, velocity=velocity)
    check_emitters(emitters, scene.terrain)
    return scene


def emitter_look(emitter: Emitter, rest: Gaussians, size: float) -> tuple[Gaussians, np.ndarray]:
    """Gaussians that an emitter's particles look like, and where their colours were taken.

    Args:
        emitter: its own colour, or None: the colours of the rest Gaussians nearest to it.
        rest: of the body; its median opacity is taken.
        size: standard deviation, m.

    Returns:
        Round Gaussians, and [n,3] m: not a number where the colour is the emitter's own, which no shade changes.
    """
    from scipy.spatial import cKDTree

    middle = np.asarray(emitter.mesh.vertices, np.float64).mean(axis=0)
    opacity = float(np.median(rest.opacities)) if len(rest) else 0.9
    if emitter.color is None and len(rest):
        nearest = np.atleast_1d(cKDTree(rest.means).query(middle, k=min(SHADES, len(rest)))[1])
        own = Gaussians.isotropic(np.broadcast_to(middle, (len(nearest), 3)), size, rest.rgb[nearest], opacity)
        return replace(own, sh=rest.sh[nearest]), rest.means[nearest]
    color = np.array(emitter.color or (0.5, 0.5, 0.5))
    shades = 1.0 + SHADE * np.linspace(-1.0, 1.0, SHADES)[:, None]
    own = Gaussians.isotropic(np.broadcast_to(middle, (SHADES, 3)), size, np.clip(color * shades, 0, 1), opacity)
    sh = np.zeros((SHADES, rest.sh.shape[1], 3), np.float32)
    sh[:, :1] = sh_from_rgb(np.clip(color * shades, 0.0, 1.0))
    return replace(own, sh=sh), np.full((SHADES, 3), np.nan, np.float32)


def changed_parameters(fitted: FluidParameters, changes: dict[str, Any]) -> tuple[str, ...]:
    """What scene.yaml changes, in words, the farthest from the fitted value first."""
    before, words = asdict(fitted), []
    for name, value in changes.items():
        if (
            name not in before
            or value == before[name]
            or list(np.atleast_1d(value)) == list(np.atleast_1d(before[name]))
        ):
            continue
        far = abs(math.log((_size(value) + 1e-9) / (_size(before[name]) + 1e-9)))
        words.append((far, f"{name} {_shown(value)} (fitted: {_shown(before[name])})"))
    return tuple(text for _, text in sorted(words, key=lambda w: -w[0]))


def _size(value: Any) -> float:
    return float(np.linalg.norm(np.asarray(value, np.float64)))


def _shown(value: Any) -> str:
    numbers = [f"{v:.3g}" for v in np.atleast_1d(value)]
    return numbers[0] if len(numbers) == 1 else f"[{', '.join(numbers)}]"


def in_words(scene: Scene) -> str:
    """The edits of a scene, for a message about a simulation that broke down; empty where there are none."""
    found = list(scene.changes)
    if not scene.inflow.steady or scene.inflow.factor(0.0) != 1.0:
        found.append(f"inflow {max(f for _, f in scene.inflow.keyframes):.3g} times as fast")
    found += [f"emitter '{e.name}' at {_size(e.velocity):.3g} m/s" for e in scene.emitters]
    found += [f"obstacle '{o.name}'" for o in scene.obstacles]
    if scene.reshaped:
        found.append("the terrain")
    if not found:
        return ""
    return f"Edited in scene.yaml: {'; '.join(found)}. Undo or weaken these, the first one first."
