"""Edits of the world around a fluid, before it is simulated: terrain, emitters, and what was changed in words."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.messages import Notice
from fluidlift.types import FluidParameters, Gaussians, Grid, concatenate, sh_from_rgb

if TYPE_CHECKING:
    from fluidlift.io.obstacles import Obstacle
    from fluidlift.physics.emitter import Emitter
    from fluidlift.physics.inflow_schedule import InflowSchedule
    from fluidlift.physics.stepping import ParticleSimulator
    from fluidlift.physics.terrain_edit import TerrainEdit
    from fluidlift.scene.build import Scene

INSIDE = 0.42
"""standard deviation of a splat of the inside, cells"""
SHADES = 16
"""Gaussians that an emitter's particles take their look from"""
SHADE = 0.04
"""by which they are lighter or darker than the colour: water without any pattern does not show that it moves"""
HIGHEST = 2.0
"""longest sides of the box above it at which an emitter may be"""
SLOW = 20.0
"""steps from one frame to the next from which a simulation takes many times as long as usual: two or three"""


def with_terrain(scene: Scene, edits: Sequence[TerrainEdit]) -> Scene:
    """The scene on its edited terrain: water, inlet, outlet and velocities have followed it.

    Raises:
        InputRejected: edits that do not fit, or a box that memory cannot hold.
    """
    from fluidlift.machine import available_memory
    from fluidlift.physics.preflight import check_memory
    from fluidlift.physics.terrain_edit import Replace
    from fluidlift.physics.terrain_reshape import reshaped, reshaped_body, reshaped_gaussians, reshaped_velocity
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
        notes=scene.notes + tuple(Notice("terrain-mended", e.note) for e in edits if isinstance(e, Replace) and e.note),
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


class Asked(NamedTuple):
    """What decides how many steps a scene needs from one frame to the next."""

    parameters: FluidParameters
    interval: float
    """s, between frames"""
    grid: Grid
    emitters: Sequence[Emitter]
    obstacles: Sequence[Obstacle]
    inflow: InflowSchedule
    longest_step: float | None
    """s, where scene.yaml gives one"""
    changes: tuple[str, ...]
    """parameters that scene.yaml changes, in words that begin with their names"""


def demands(asked: Asked) -> list[tuple[float, str]]:
    """What scene.yaml asks of the clock: (steps from one frame to the next, in words), the most demanding first."""
    from fluidlift.physics.surface_tension import capillary_time_step

    p, interval, h = asked.parameters, asked.interval, asked.grid.spacing
    changed = {text.partition(" ")[0] for text in asked.changes}
    speeds = [(_size(e.velocity), f"emitter '{e.name}'") for e in asked.emitters]
    for o in asked.obstacles:
        size = _size(np.ptp(np.asarray(o.mesh.vertices), axis=0))
        speeds.append((_size(o.velocity) + 0.5 * size * _size(o.angular_velocity), f"obstacle '{o.name}'"))
    if "inflow_velocity" in changed or asked.inflow != type(asked.inflow)():
        surge = max(f for _, f in asked.inflow.keyframes) * (1.0 + 2.0 * asked.inflow.fluctuation)
        speeds.append((_size(p.inflow_velocity) * surge, "the inflow"))
    found = [(v * interval / h, f"{what} at {v:.3g} m/s") for v, what in speeds]
    if "gravity" in changed:
        pull, high = _size(p.gravity), asked.grid.shape[2] * h
        found.append((math.sqrt(2.0 * pull * high) * interval / h, f"gravity of {pull:.3g} m/s^2"))
    if asked.longest_step is not None:
        found.append((interval / asked.longest_step, f"time_step {asked.longest_step:.3g} s"))
    if p.surface_tension > 0 and changed & {"surface_tension", "density"}:
        step = capillary_time_step(p.density, p.surface_tension, h)
        found.append((interval / step, f"surface_tension {p.surface_tension:.3g} N/m on cells of {h:.3g} m"))
    return sorted(found, key=lambda d: -d[0])


def slow_edits(scene: Scene | Asked) -> list[Notice]:
    """A word about edits that make a simulation take far longer than usual, before it begins.

    Args:
        scene: that is to be simulated, or what of it decides.

    Raises:
        InputRejected: one that needs more steps from one frame to the next than the simulator takes.
    """
    from fluidlift.physics.stepping import SimulationSettings

    if not isinstance(scene, Asked):
        scene = Asked(
            scene.parameters, scene.interval, scene.terrain.grid, scene.emitters, scene.obstacles, scene.inflow,
            scene.longest_step, scene.changes,
        )  # fmt: skip
    most = SimulationSettings().max_substeps
    steps, what = next(iter(demands(scene)), (0.0, ""))
    if steps > most:
        raise InputRejected(
            f"{what} needs {steps:,.0f} steps from one frame to the next", f"at most {most:,}",
            "weaken it in scene.yaml, or give a higher --fps",
        )  # fmt: skip
    if steps < SLOW:
        return []
    text = (
        f"{what} needs about {steps:.0f} steps from one frame to the next, where two or three are usual: this may take "
        "very long"
    )
    return [Notice("edit-takes-long", text)]


def closed_inlet(scene: Scene, simulator: ParticleSimulator) -> list[Notice]:
    """See that the obstacles leave the fluid a place and a way in; warnings where they close the inlet.

    Raises:
        InputRejected: they take the place of all of the fluid; the message names their lines.
    """
    from fluidlift.numerics.sampling import sample_nodes
    from fluidlift.types import CellType

    if not scene.obstacles:
        return []
    named = ", ".join(f"{o.line}: obstacle '{o.name}'" for o in scene.obstacles)
    if len(scene.body) and not len(simulator.particles):
        raise InputRejected(
            f"{named} in the place of all of the fluid", "room for the fluid", "make it smaller, or move it"
        )
    grid = scene.terrain.grid
    inlet = grid.low + (np.argwhere(scene.cell_types == CellType.INFLOW) + 0.5) * grid.spacing
    inlet = inlet[sample_nodes(scene.terrain.signed_distance, grid, inlet) > 0]
    bodies = simulator.bodies
    if not len(inlet) or bodies is None or not bodies.inside(inlet).all():
        return []
    return [Notice("inlet-closed", f"{named} over the whole inlet: nothing flows in while it is there")]


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
