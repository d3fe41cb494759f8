"""The stage that simulates: from the rest body and the fitted physics to frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.config import JobConfig
from fluidlift.errors import InputRejected
from fluidlift.pipeline.body import camera_of, rest_of, setting_of
from fluidlift.pipeline.moving import parameters_of, targets_of
from fluidlift.pipeline.seeing import clip_of, labels_of
from fluidlift.pipeline.story import Result, Story
from fluidlift.types import CellType, FluidParameters, Gaussians, Particles

MAX_STRETCH = 3.0
"""longest axis over the mean one before a Gaussian starts again round: longer ones show as hair"""


def emission_look(rest: Gaussians, direction: np.ndarray, speed: float) -> Callable[[np.ndarray, float], np.ndarray]:
    """Which rest Gaussian lends its look to a particle that enters at a place and time.

    The fluid that enters later is taken to look like the body further downstream, mirrored at its ends: the pattern
    goes on without a seam at the inlet and never shows one colour for long.
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(rest.means)
    reach = rest.means @ direction
    # the ends of a body are often shaded by what stands there (a gate, a lip): the pattern comes from between them
    low, high = np.percentile(reach, [12, 90])
    length = max(float(high - low), 1e-9)

    def source(positions: np.ndarray, time: float) -> np.ndarray:
        run = (speed * time) % (2 * length)
        shift = run if run < length else 2 * length - run
        inlet = positions @ direction
        target = np.clip(inlet + shift, low, high)
        return tree.query(positions + (target - inlet)[:, None] * direction)[1].astype(np.int64)

    return source


def scene_of(folder: Path) -> dict[str, Any]:
    """What a person changed in scene.yaml that the re-simulation heeds: `parameters` and `duration` (s).

    Raises:
        InputRejected: entries that this version cannot apply (nothing is ignored in silence), or wrong values.
    """
    from fluidlift.io.scene import read_scene

    scene = {k: v for k, v in read_scene(folder).items() if v not in (None, {}, [], "")}
    unknown = sorted(set(scene) - {"parameters", "duration"})
    if unknown:
        raise InputRejected(
            f"scene.yaml asks for {', '.join(unknown)}, which this version cannot simulate",
            "parameters and duration only",
            "remove the entry, or leave it empty",
        )
    duration = scene.get("duration")
    if duration is not None and not (isinstance(duration, int | float) and duration > 0):
        raise InputRejected(f"scene.yaml: duration {duration!r}", "seconds, more than 0")
    if not isinstance(scene.get("parameters", {}), dict):
        raise InputRejected("scene.yaml: parameters is no mapping", "name: value lines")
    return scene


def simulation_step(parameters: FluidParameters, story: Story) -> FluidParameters:
    """The same physics with the simulator's own longest step.

    The fit's step is that of its grid, which must resolve a gravity wave over one cell. The simulator adapts
    to the flow and only needs steps in which a wave does not cross more than a cell or so. Wall damping is a share
    per step and is converted, so that walls take the same share per second.
    """
    setting, interval = setting_of(story), clip_of(story).interval
    h = setting.terrain.grid.spacing
    wet = (setting.cell_types == CellType.FLUID).sum(axis=2)
    depth = h * float(np.percentile(wet[wet > 0], 90)) if (wet > 0).any() else h
    wave = float(np.sqrt(np.linalg.norm(parameters.gravity) * depth))
    longest = interval if story["geometry"].meta["kind"] == "plume" else h / max(wave, 1e-6)
    step = float(np.clip(longest, interval / 8, interval))
    damping = 1.0 - (1.0 - parameters.wall_damping) ** (step / parameters.time_step)
    return replace(parameters, time_step=step, wall_damping=float(np.clip(damping, 0.0, 1.0)))


def simulator_of(story: Story, folder: Path, config: JobConfig, rest: Gaussians) -> Any:
    """The simulator at the first instant."""
    from fluidlift.numerics.sampling import sample_faces

    setting, kind = setting_of(story), story["geometry"].meta["kind"]
    changes = scene_of(folder).get("parameters", {})
    parameters, grid = parameters_of(story).updated(changes), setting.terrain.grid
    parameters = simulation_step(parameters, story)
    velocity = targets_of(story)[0]
    start = sample_faces(velocity, grid, rest.means)
    # all Gaussians of a cell share its mass
    cell = np.ravel_multi_index(tuple(np.clip(grid.cell_of(rest.means), 0, np.array(grid.shape) - 1).T), grid.shape)
    count = np.bincount(cell, minlength=grid.cells)
    masses = parameters.density * grid.spacing**3 / np.maximum(count[cell], 1)
    particles = Particles.at_rest(rest.means, masses, np.arange(len(rest)), start)
    direction = setting.terrain.mainstream
    look = emission_look(rest, direction, float(np.linalg.norm(parameters.inflow_velocity)))
    if kind == "plume":
        from fluidlift.physics.gas import GasSimulator

        return GasSimulator(
            grid, setting.terrain, parameters, particles, cell_types=setting.cell_types, inflow_profile=velocity,
            velocity=velocity, seed=config.seed, emit_source=look,
            buoyancy=float(np.linalg.norm(parameters.gravity)),
        )  # fmt: skip
    from fluidlift.physics.apic import LiquidSimulator

    return LiquidSimulator(
        grid, setting.terrain, parameters, particles, cell_types=setting.cell_types, inflow_profile=velocity,
        seed=config.seed, emit_source=look,
    )  # fmt: skip


def frame_file(folder: Path, number: int) -> Path:
    """Splats of one frame; numbers start at 1001."""
    return folder / "frames" / "splats" / f"{number:04d}.ply"


def simulate(story: Story, folder: Path, config: JobConfig) -> Result:
    """Frames of the re-simulation, as splats with ids and velocities."""
    from fluidlift.io.atomic import require_free_space
    from fluidlift.io.ply import write_gaussians
    from fluidlift.look.appearance import SteadyShading
    from fluidlift.numerics.sampling import sample_nodes
    from fluidlift.physics.deform import deform_gaussians

    rest, setting = rest_of(story), setting_of(story)
    clip = clip_of(story)
    start = story["geometry"].meta["rest_frame"]
    duration = scene_of(folder).get("duration")
    wanted = None if duration is None else max(2, round(duration / clip.interval))
    frames = wanted or config.simulate.frames or (len(clip) - start)
    require_free_space(folder, frames * len(rest) * 80)
    simulator = simulator_of(story, folder, config, rest)
    grid = setting.terrain.grid
    shading = None
    if setting.surface_height is not None:  # bodies in the air change their outline: nothing about them is steady
        mask = labels_of(story).fluid.mean(axis=0) > 0.5
        shading = SteadyShading.of(clip.frames, mask, camera_of(story)) if mask.any() else None
    volumes, leaks, counts, substeps = [], [], [], []
    for old in (folder / "frames" / "splats").glob("*.ply"):
        old.unlink()
    for k in range(frames):
        story.step(k, frames)
        if k:
            step = simulator.advance(clip.interval)
            substeps.append(int(step.substeps))
        p = simulator.particles
        if k and len(p) > config.simulate.max_particles * 2:
            break
        shown = deform_gaussians(rest, p, max_stretch=MAX_STRETCH, max_size=1.2 * grid.spacing)
        if shading is not None:
            shown = shading.moved(shown, rest.means[p.source])
        write_gaussians(frame_file(folder, 1001 + k), shown, ids=p.ids, velocities=p.velocities)
        occupied = np.unique(np.floor((p.positions - grid.low) / grid.spacing).astype(np.int64), axis=0)
        volumes.append(len(occupied) * grid.spacing**3)
        inside = grid.contains(p.positions)
        distance = sample_nodes(setting.terrain.signed_distance, grid, p.positions[inside])
        leaks.append(float((distance < -0.1 * grid.spacing).mean()) if inside.any() else 0.0)
        counts.append(len(p))
    stopped = []
    if len(counts) < frames:
        stopped.append(
            f"the re-simulation stopped after {len(counts)} of {frames} frames, at twice the number of particles that "
            f"--set simulate.max_particles={config.simulate.max_particles} allows"
        )
    return Result(
        {"volume": np.array(volumes, np.float32), "leak": np.array(leaks, np.float32), "count": np.array(counts)},
        {
            "frames": len(counts),
            "substeps": substeps,
            "warnings": stopped + _simulation_warnings(story["geometry"].meta["kind"], volumes, leaks),
        },
    )


def _simulation_warnings(kind: str, volumes: list[float], leaks: list[float]) -> list[str]:
    warnings = []
    drift = volumes[-1] / max(volumes[0], 1e-12) - 1
    if drift < -0.5 or (drift > 0.5 and kind in ("stream", "fall")):  # pours fill and smoke spreads
        word = "lost" if drift < 0 else "gained"
        warnings.append(f"the re-simulation {word} {100 * abs(drift):.0f} % of its volume by its last frame")
    if max(leaks) > 0.01:
        warnings.append(f"up to {100 * max(leaks):.1f} % of the particles are inside the terrain")
    return warnings


def frames_still_there(folder: Path) -> Callable[[Result], bool]:
    """Whether the splat files of a cached simulation are complete."""
    return lambda result: all(frame_file(folder, 1001 + k).is_file() for k in range(result.meta["frames"]))
