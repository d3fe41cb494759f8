"""The simulator of a scene, at its first instant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.machine import available_memory
from fluidlift.messages import Notice
from fluidlift.scene.build import Scene
from fluidlift.types import CellType, FluidParameters, Gaussians, Particles, kind_of

if TYPE_CHECKING:
    from fluidlift.look.inflow import InflowLook
    from fluidlift.physics.guidance import BodyForce
    from fluidlift.physics.numba_particles import ParticleWork
    from fluidlift.physics.stepping import ParticleSimulator

SOURCE = 3.0
"""cells from the inlet within which smoke looks as it does when it comes in: it has hardly spread there, and is wide
enough to differ from place to place"""

CROSSED = 2.0
"""cells that the fastest particle of a liquid may cross in a substep where nothing thin stands in its way: particles
carry the flow, so no step is unstable. Of pours, a fountain and falls none got into a wall, with two thirds of the
substeps that one cell takes (docs/experiments/2026-11-clips.md)"""
BESIDE_OBSTACLES = 1.0
"""the same among obstacles: a particle meets a wall where its step ends, and could pass a plate that is thinner than
the step is long"""

SPRAY = 0.02
"""share of the water in the air over a fountain that is liquid: what looks white is drops far apart, and a nozzle is
much thinner than the cells that stand for it (a choice). With 0.1 a pool of 60 m^3 is thrown up within 20 s"""

TURNED = 0.7
"""share of gravity along an axis from which its side of the box is one that liquid falls out of: from 45 degrees
on it is as much below as the floor; a tank that is tilted less stays a tank"""


def particle_work(device: str) -> ParticleWork:
    """The back end that simulates liquids, or moves their particles, on a device, "cpu" or "cuda".

    Raises:
        MissingPackage: NVIDIA Warp is not installed.
        FluidliftError: there is no such GPU.
    """
    from fluidlift.physics.numba_particles import ParticleWork

    if device == "cpu":
        return ParticleWork()
    from fluidlift.backends.warp_liquid import WarpLiquids
    from fluidlift.backends.warp_particles import WarpMover, WarpTransfer

    return ParticleWork(WarpTransfer(device), WarpMover(device), WarpLiquids(device))


def left_to_the_cpu(simulator: ParticleSimulator, device: str) -> list[Notice]:
    """What to say of a device that was asked for and does not do all of the simulation."""
    from fluidlift.physics.apic import LiquidSimulator

    if device == "cpu":
        return []
    if not isinstance(simulator, LiquidSimulator):
        return [Notice("device-not-used", f"simulate.device={device}: smoke is simulated on the CPU")]
    if not simulator.on_host_because:
        return []
    return [Notice("device-not-used", f"simulate.device={device} moves the particles alone, and the CPU does the rest, "
                   f"which takes longer, because of {simulator.on_host_because}")]  # fmt: skip


def simulator_of(
    scene: Scene, device: str = "cpu", forces: Sequence[BodyForce] = (), *, deform: bool = True
) -> ParticleSimulator:
    """The simulator at the first instant. Smoke is simulated on the CPU, without `forces`.

    Args:
        scene: that is simulated.
        device: that moves particles, "cpu" or "cuda".
        forces: beside those of the scene.
        deform: False where nobody looks at how particles are drawn out.
    """
    from fluidlift.physics.emitter import Supply
    from fluidlift.physics.surroundings import SimulationSettings
    from fluidlift.scene.filmed_inlet import inlet_path

    crossed = BESIDE_OBSTACLES if scene.obstacles else CROSSED
    parameters, discharge = as_fast_as_filmed(scene, simulation_step(scene))
    settings, level = SimulationSettings(deform=deform, discharge_speed=discharge), pool_level(scene)
    if level is not None:
        settings = replace(settings, airy_above=level, airy=SPRAY)
    own = scene.rest.select(np.arange(len(scene.rest) - sum(map(len, scene.emitter_looks))))
    look = inflow_look(scene, own, float(np.linalg.norm(parameters.inflow_velocity)))
    supply = Supply(scene.inflow, scene.emitters, scene.emitter_looks, inlet_path(scene))
    grid = scene.terrain.grid
    if kind_of(scene.kind).is_gas:
        from fluidlift.physics.gas import GasSimulator

        return GasSimulator(
            grid, scene.terrain, parameters, scene.body, cell_types=scene.cell_types, inflow_profile=scene.velocity,
            velocity=scene.velocity, seed=scene.seed, emit_source=look,
            buoyancy=float(np.linalg.norm(parameters.gravity)), supply=supply, settings=settings,
        )  # fmt: skip
    from fluidlift.physics.apic import LiquidSimulator
    from fluidlift.physics.guidance import Guiding, SteadyForce
    from fluidlift.physics.refill import Refill

    if scene.force is not None:
        forces = (*forces, SteadyForce(scene.force))
    if scene.guide is not None:
        forces = (*forces, Guiding(scene.guide, scene.guide_rates))
    cells, body = within_outlet(scene)
    bodies = tuple(o.body((scene.simulated - 1) * scene.interval) for o in scene.obstacles)
    simulator = LiquidSimulator(
        grid, scene.terrain, parameters, body, cell_types=cells, inflow_profile=scene.velocity,
        seed=scene.seed, emit_source=look, bodies=bodies, work=particle_work(device), supply=supply,
        open_sides=sides_open_to_air(parameters.gravity), forces=forces,
        settings=replace(settings, courant=crossed),
    )  # fmt: skip
    simulator.drains, simulator.drains_until = scene.dry, scene.dry_for
    if level is not None:
        simulator.keep_volume(_top_of_pool(scene, level))
    if scene.wet is not None and scene.wet.any():
        simulator.refill = Refill(scene.wet, scene.velocity, body, scene.terrain, scene.camera)
    return simulator


def pool_level(scene: Scene) -> float | None:
    """z (m) of the pool that a fountain rises from, whose nozzles begin with the cell over it; None of other fluids."""
    inlet = scene.cell_types == CellType.INFLOW
    if not kind_of(scene.kind).rises_from_pool or not inlet.any():
        return None
    grid = scene.terrain.grid
    return float(grid.low[2] + grid.spacing * np.nonzero(inlet)[2].min())


def _top_of_pool(scene: Scene, level: float) -> np.ndarray:
    """bool [nx,ny,nz]: the layer of cells below the level, beside what stands above it; all of it where that is all."""
    grid, cells = scene.terrain.grid, scene.cell_types
    z = grid.centers()[..., 2]
    layer = (cells == CellType.FLUID) & (z < level) & (z > level - grid.spacing)
    under = np.isin(cells, (CellType.FLUID, CellType.INFLOW)) & (z > level)
    beside = layer & ~under.any(axis=2, keepdims=True)
    return beside if beside.any() else layer


def as_fast_as_filmed(scene: Scene, parameters: FluidParameters) -> tuple[FluidParameters, float | None]:
    """The parameters of what pours with an inflow that is as fast as the jet was filmed, and the speed (m/s) that its
    discharge has over its section; None where that is no slower.

    How much a vessel gains says what flows in, and the mask of a jet is wider than the jet: over its section the
    discharge would creep, and a jet that begins to fall from that speed is a thread after its own width (A v is
    constant along it), so that it tears below its inlet. What is seen of it is as wide as it was filmed, falls as it
    was filmed, and brings what its vessel gains: a share of it is liquid.
    """
    given = float(np.linalg.norm(parameters.inflow_velocity))
    inlet = scene.cell_types == CellType.INFLOW
    if not kind_of(scene.kind).fills_vessel or given <= 0 or not inlet.any():
        return parameters, None
    filmed = float(np.linalg.norm(scene.velocity.at_centers()[inlet].mean(axis=0)))
    if filmed <= given:
        return parameters, None
    faster = tuple(float(v) * filmed / given for v in parameters.inflow_velocity)
    return parameters.updated({"inflow_velocity": faster}), given


def wave_speed(scene: Scene) -> float:
    """Of a long gravity wave on the fluid where it is deep, m/s."""
    h, wet = scene.terrain.grid.spacing, (scene.cell_types == CellType.FLUID).sum(axis=2)
    depth = h * float(np.percentile(wet[wet > 0], 90)) if (wet > 0).any() else h
    return float(np.sqrt(np.linalg.norm(scene.parameters.gravity) * depth))


def simulation_step(scene: Scene) -> FluidParameters:
    """The same physics with the simulator's own longest step.

    The fit's step is that of its grid, which must resolve a gravity wave over one cell. The simulator adapts
    to the flow and only needs steps in which a wave does not cross more than a cell or so; a `time_step` in scene.yaml
    is taken instead. Wall damping is a share per step and is converted, so that walls take the same share per second.
    """
    parameters, interval = scene.parameters, min(scene.interval, scene.clip_interval)
    h = scene.terrain.grid.spacing
    longest = interval if kind_of(scene.kind).is_gas else h / max(wave_speed(scene), 1e-6)
    step = float(np.clip(longest, interval / 8, interval))
    if scene.longest_step is not None:
        step = min(float(scene.longest_step), scene.interval)
    damping = 1.0 - (1.0 - parameters.wall_damping) ** (step / parameters.time_step)
    return replace(parameters, time_step=step, wall_damping=float(np.clip(damping, 0.0, 1.0)))


def inflow_look(scene: Scene, own: Gaussians, speed: float) -> InflowLook:
    """What flows in at a speed (m/s) looks like the body's own Gaussians; of what lies, as the clip shows it away from
    rocks and banks; of smoke, which thins as it rises, as it is at its source."""
    from fluidlift.look.inflow import InflowLook
    from fluidlift.physics.inlet import beside_inlet

    # a sheet that falls has no level to keep to
    terrain, lying, usable = scene.terrain, kind_of(scene.kind).is_level_throughout, None
    spacing = 0.5 * terrain.grid.spacing
    if lying and len(own):
        usable = lends_look(scene, own)
    elif kind_of(scene.kind).is_gas:
        usable = beside_inlet(own.means, scene.cell_types, terrain.grid, SOURCE)
    return InflowLook(own, terrain.mainstream, speed, spacing, usable=usable, run=scene.inflow.run, lying=lying)


def lends_look(scene: Scene, own: Gaussians) -> np.ndarray:
    """Which of the body's own Gaussians show the fluid as such: in the picture, away from rocks and banks."""
    from fluidlift.look.inflow import surface_level
    from fluidlift.physics.inlet import clear_of_shore
    from fluidlift.shape.off_picture import in_picture

    level = surface_level(own.means, 0.5 * scene.terrain.grid.spacing)(own.means[:, :2])
    return in_picture(own.means, scene.camera) & clear_of_shore(own.means, level, scene.terrain)


def sides_open_to_air(gravity: tuple[float, float, float]) -> np.ndarray:
    """bool [3,2] (axis, low/high): sides of an asset's box without a wall.

    The sky of the clip, which is the side that gravity points away from (the top where there is none), and, once
    gravity is turned, those that it points to: no ground was seen there, and what falls must not pile up at an
    invisible wall. The low side of z is the ground.
    """
    from fluidlift.physics.apic import open_sky

    g = np.asarray(gravity, np.float64)
    if not g.any():
        return open_sky((0.0, 0.0, -1.0))
    out = open_sky(gravity)
    for axis in range(3):
        down = int(g[axis] > 0)
        if abs(g[axis]) > TURNED * np.linalg.norm(g) and (axis, down) != (2, 0):
            out[axis, down] = True
            out[2, 1] = True  # the sky stays open, whatever falls
    return out


def within_outlet(scene: Scene) -> tuple[np.ndarray, Particles]:
    """Cells and body of what lies on something, without what is behind its outlet or in dry cells, and with an inlet
    that takes in all that flows in; all of those of other fluids."""
    from fluidlift.physics.inlet import inlet_along_rim, inlet_to_surface
    from fluidlift.physics.outlet import thin_outlet

    kind = kind_of(scene.kind)
    if not kind.is_channel_flow:
        return scene.cell_types, scene.body
    dry = np.zeros(scene.cell_types.shape, bool) if scene.dry is None else scene.dry
    cells, grid = thin_outlet(scene.cell_types), scene.terrain.grid
    behind = dry | ((scene.cell_types == CellType.OUTFLOW) & (cells != CellType.OUTFLOW))
    at = np.clip(grid.cell_of(scene.body.positions), 0, np.asarray(grid.shape) - 1)
    body = scene.body.select(~behind[tuple(at.T)])
    if kind.nearly_level:
        cells = _undrained(inlet_to_surface(cells, scene.body.positions, grid), dry)
    elif kind.enters_over_rim:
        # where its rim is dry, a sheet begins below it
        cells, gravity = _undrained(cells, dry), np.asarray(scene.parameters.gravity)
        cells = np.where(dry & (cells == CellType.FLUID), np.uint8(CellType.EMPTY), cells)
        cells = inlet_along_rim(cells, body.positions, scene.velocity, grid, gravity)
        cells = _undrained(cells, dry)
    return cells, body


def _undrained(cells: np.ndarray, dry: np.ndarray) -> np.ndarray:
    """The cells without inlets in dry ones, but where all of the inlet is dry."""
    inlet = cells == CellType.INFLOW
    return np.where(inlet & dry, np.uint8(CellType.EMPTY), cells) if (inlet & ~dry).any() else cells


def preflight(scene: Scene) -> None:
    """What would fail on the way, said before anything is written.

    Raises:
        InputRejected: too little memory, too many frames, an inlet that lets nothing in, or obstacles in smoke.
    """
    from fluidlift.physics.preflight import check_frames, check_inlet, check_memory
    from fluidlift.physics.stepping import SimulationSettings
    from fluidlift.physics.surface_tension import capillary_time_step

    if scene.obstacles and kind_of(scene.kind).is_gas:
        raise InputRejected(
            f"{scene.obstacles[0].line}: an obstacle in a {scene.kind}", "obstacles in a liquid",
            "remove it from scene.yaml",
        )  # fmt: skip
    p, step = scene.parameters, simulation_step(scene).time_step
    if p.surface_tension > 0:
        step = min(step, capillary_time_step(p.density, p.surface_tension, scene.terrain.grid.spacing))
    check_frames(scene.simulated, scene.interval, step, SimulationSettings().max_substeps)
    check_memory(scene.terrain.grid, len(scene.body), available_memory())
    check_inlet(scene.terrain, scene.cell_types, np.array(p.inflow_velocity))
