"""Stages that make it move: motion (velocity targets), fit (parameters), simulate (frames)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.config import JobConfig
from fluidlift.errors import InputRejected
from fluidlift.pipeline.body import camera_of, rest_of, setting_of
from fluidlift.pipeline.seeing import clip_of, flow_of, labels_of
from fluidlift.pipeline.story import Result, Story, one_torch_thread
from fluidlift.types import (
    CellType,
    Estimate,
    FaceVelocity,
    FluidParameters,
    Gaussians,
    Particles,
    PixelFlow,
)

HALF_WINDOW = 2
"""frames on either side whose flow is averaged into one target: turbulence of single pairs is mostly flow noise"""

MAX_STRETCH = 3.0
"""longest axis over the mean one before a Gaussian starts again round: longer ones show as hair"""

VISCOSITY_PRIOR = {"stream": 1e-5, "fall": 1e-5, "pour": 1e-4, "plume": 1e-5}
"""m^2/s, where the fit starts"""

WALL_DAMPING_PRIOR = {"stream": 0.05, "fall": 0.05, "pour": 0.2, "plume": 0.02}
"""share of the tangential velocity that a wall takes per step of the fit, where the fit starts: water runs nearly free
over a bed that the grid cannot resolve"""


def motion(story: Story, config: JobConfig) -> Result:
    """Completed flow of many frames, volume velocity of the target frames."""
    from fluidlift.motion.air import with_air
    from fluidlift.motion.free_fall import with_free_fall
    from fluidlift.motion.front import front_factor
    from fluidlift.motion.lift import lift_flow
    from fluidlift.motion.volume import volume_velocity

    clip, flow, g = clip_of(story), flow_of(story), story["geometry"]
    camera, setting = camera_of(story), setting_of(story)
    grid, kind = setting.terrain.grid, g.meta["kind"]
    pairs, start = len(flow), min(g.meta["rest_frame"], len(flow) - 1)
    targets = list(range(start, min(start + config.motion.targets, pairs)))
    wanted = sorted(set(targets) | set(range(0, pairs, config.motion.complete_every)))
    completed = np.full((pairs, *clip.frames.shape[1:3], 2), np.nan, np.float16)
    observed = np.zeros((pairs, *clip.frames.shape[1:3]), bool)
    arrays: dict[str, np.ndarray] = {}
    reports: list[dict[str, Any]] = []
    replaced: list[float] = []
    factors: list[float] = []
    fluid = labels_of(story).fluid
    depth = g.arrays["depth"]
    for done, t in enumerate(wanted):
        story.step(done, len(wanted))
        mask = fluid[t]
        if not mask.any():
            continue
        full, seen = _completed(flow, t, mask, depth, camera, config)
        if kind == "plume":
            factor = front_factor(full, fluid, t)
            full, factors = full * factor, [*factors, factor]
        completed[t], observed[t] = full, seen
        if t not in targets:
            continue
        on_body = mask & (depth > 0)
        lifted = lift_flow(full, seen, on_body, depth, depth, camera, clip.interval)
        if kind in ("fall", "pour"):
            lifted, share = with_free_fall(lifted, downhill_of(setting, lifted.points), kind=kind)
            replaced.append(share)
        velocity, report = volume_velocity(
            lifted, setting.terrain, setting.cell_types, grid, kind=kind, mainstream=setting.terrain.mainstream
        )
        if kind == "plume":
            velocity, _ = with_air(velocity, setting.cell_types, setting.terrain, grid)
        k = len(reports)
        for name, component in zip("uvw", velocity.components):
            arrays[f"target_{k:03d}_{name}"] = component.astype(np.float32)
        reports.append({"frame": t, **_plain(report)})
    warnings = []
    if reports and not all(r.get("solve", {}).get("converged", True) for r in reports):
        warnings.append("the divergence-free solve of the target velocity did not converge on every frame")
    if replaced and max(replaced) > 0.3:
        warnings.append(
            f"the {kind} moves faster than optical flow can follow: on {100 * max(replaced):.0f} % of its steep part "
            "the speed comes from free fall at the given size"
        )
    arrays |= {"completed": completed, "observed": np.packbits(observed, axis=-1)}
    return Result(arrays, {"warnings": warnings, "targets": [r["frame"] for r in reports], "reports": reports,
                           "front_factor": float(np.median(factors)) if factors else 1.0,
                           "free_fall_share": max(replaced, default=0.0)})  # fmt: skip


def downhill_of(setting: Any, points: np.ndarray) -> np.ndarray:
    """Unit direction of steepest descent of the surface at points; straight down for bodies in the air."""
    if setting.surface_height is None:
        down = np.tile([0.0, 0.0, -1.0], (len(points), 1))
        pool = setting.pool_level
        if pool is not None:  # what stands in a vessel does not fall
            down[points[:, 2] < pool] = [1.0, 0.0, 0.0]
        return down
    grid = setting.terrain.grid
    gx, gy = np.gradient(setting.surface_height, grid.spacing)
    cell = np.clip(grid.cell_of(points)[:, :2], 0, np.array(grid.shape[:2]) - 1)
    slope = np.stack([gx[cell[:, 0], cell[:, 1]], gy[cell[:, 0], cell[:, 1]]], axis=-1)
    squared = (slope**2).sum(axis=1)
    steepest = np.concatenate([-slope, -squared[:, None]], axis=1)
    return steepest / np.maximum(np.linalg.norm(steepest, axis=1, keepdims=True), 1e-12)


def _completed(flow: PixelFlow, t: int, mask, depth, camera, config: JobConfig) -> tuple[np.ndarray, np.ndarray]:
    """Mean of the flow around frame t, failed regions filled in along the mainstream."""
    from fluidlift.motion.mainstream import complete_flow, mainstream_direction, project_screen_divergence
    from fluidlift.motion.optical_flow import mean_flow

    window = slice(max(t - HALF_WINDOW, 0), min(t + HALF_WINDOW + 1, len(flow)))
    mean, trust = mean_flow(PixelFlow(flow.displacement[window], flow.confidence[window]), mask)
    direction = mainstream_direction(mean, trust, mask)
    with_depth = bool((depth[mask] > 0).all())
    full, seen = complete_flow(mean, trust, mask, direction, depth if with_depth else None)
    on_body = mask & (depth > 0)
    if on_body.any() and (on_body & ~seen).any():
        projected, _ = project_screen_divergence(
            full, on_body, seen & on_body, np.where(on_body, depth, 1.0), np.zeros_like(depth), camera,
            form=config.motion.divergence,
        )  # fmt: skip
        full = np.where(on_body[..., None], projected, full)
    return full, seen


def _plain(report: Any) -> dict[str, Any]:
    """A report as plain values for JSON."""
    return {k: v for k, v in asdict(report).items() if isinstance(v, int | float | str | bool | dict)}


def targets_of(story: Story) -> list[FaceVelocity]:
    """Target velocities of consecutive frames."""
    a = story["motion"].arrays
    count = len(story["motion"].meta["targets"])
    return [FaceVelocity(*(a[f"target_{k:03d}_{name}"] for name in "uvw")) for k in range(count)]


def fit(story: Story, config: JobConfig) -> Result:
    """Physical parameters that make the grid move like the targets."""
    from fluidlift.fit.optimize import DEFAULT_FREE, fit_parameters

    setting, kind = setting_of(story), story["geometry"].meta["kind"]
    targets = targets_of(story)
    initial = first_guess(story, targets)
    # speeds that come from free fall were not measured: they say nothing about friction inside or at the walls
    assumed = story["motion"].meta["free_fall_share"] > 0.3
    free = ("inflow_velocity", "inflow_fluctuation", "outflow_velocity") if assumed else DEFAULT_FREE
    if filling_rate(story) is not None:  # the level in the vessel says how much enters
        free = tuple(name for name in free if name != "inflow_velocity")
    with one_torch_thread():
        found = fit_parameters(
            targets, setting.cell_types, setting.terrain, setting.terrain.grid, clip_of(story).interval, initial,
            kind=kind, method=config.fit.method, max_seconds=config.fit.max_seconds, progress=story.step,
            mainstream=setting.terrain.mainstream, prior_sigmas=gravity_prior(story), free=free,
        )  # fmt: skip
    warnings = []
    if not found.converged:
        warnings.append(
            "the parameter fit stopped before it converged: its values are the best found so far "
            "(--set fit.max_seconds=... gives it more time)"
        )
    return Result(
        {"loss_history": np.asarray(found.loss_history, np.float64)},
        {
            "warnings": warnings,
            "parameters": found.parameters.to_dict(),
            "estimates": {k: asdict(e) for k, e in found.estimates.items()},
            "initial": initial.to_dict(),
            "converged": found.converged,
            "rollouts": found.rollouts,
            "notes": list(found.notes)
            + ["viscosity, restitution and wall damping keep their priors: the steep part was too fast to be measured"]
            * assumed,
            "extra": {k: float(v) for k, v in found.extra.items()},
        },
    )


def gravity_prior(story: Story) -> dict[str, float] | None:
    """How free gravity is, relative to 9.81 m/s^2: 2 %, for it is what it is everywhere.

    Under an assumed size it could stand for the unknown scale as well. Freed, it goes to nearly nothing wherever the
    motion is slow for the assumed size, because the rollout's free surface is then noisier than the flow; and water
    without weight leaves its bed. A plume's buoyancy is free.
    """
    return None if story["geometry"].meta["kind"] == "plume" else {"gravity": 0.02}


def filling_rate(story: Story) -> float | None:
    """Volume (m^3/s) that a vessel gains over the clip, from its rounded silhouette; None where nothing fills.

    What a jet brings is seen better in the vessel than in the jet, whose speed is a blur and whose mask is too wide.
    """
    from fluidlift.shape.surface import rounded_volume

    g, clip = story["geometry"], clip_of(story)
    if g.meta["kind"] != "pour" or g.meta["pool_level"] is None:
        return None
    camera, fluid, start = camera_of(story), labels_of(story).fluid, g.meta["rest_frame"]
    distance = float(np.median(g.arrays["depth"][g.arrays["depth"] > 0]))
    times, volumes = [], []
    for t in np.unique(np.linspace(start, len(clip) - 1, 8).astype(int)):
        if not fluid[t].any():
            continue
        volumes.append(rounded_volume(camera, fluid[t], distance))
        times.append(float(clip.times[t]))
    if len(times) < 4:
        return None
    rate = float(np.polyfit(times, volumes, 1)[0])
    return rate if rate > 0 else None


def first_guess(story: Story, targets: list[FaceVelocity]) -> FluidParameters:
    """Where the fit starts: velocities measured at the ends, the rest from what such a fluid usually has."""
    setting, kind = setting_of(story), story["geometry"].meta["kind"]
    cells, direction = setting.cell_types, setting.terrain.mainstream
    mean = np.mean([t.at_centers() for t in targets], axis=0)
    inlet = cells == CellType.INFLOW
    wet = inlet | (cells == CellType.FLUID)
    bulk = mean[inlet].mean(axis=0) if inlet.any() else mean[wet].mean(axis=0)
    spread = np.std([t.at_centers()[inlet] for t in targets], axis=0).mean() if inlet.any() else 0.0
    outlet = np.zeros(cells.shape, bool)
    if (cells == CellType.OUTFLOW).any():
        from scipy import ndimage

        outlet = ndimage.binary_dilation(cells == CellType.OUTFLOW, iterations=2) & (cells == CellType.FLUID)
    out = float((mean[outlet] @ direction).mean()) if outlet.any() else float((mean[wet] @ direction).mean())
    speed = float(np.linalg.norm(mean[wet], axis=1).max()) if wet.any() else 0.0
    filling = filling_rate(story)
    if filling is not None and inlet.any():
        # the mouth of the inlet is its cross-section across the stream, one layer of its cells
        layer = setting.terrain.grid.spacing**2 * float(inlet.any(axis=int(np.argmax(np.abs(direction)))).sum())
        bulk = direction * min(filling / layer, float(np.linalg.norm(bulk)))
    interval = clip_of(story).interval
    courant = setting.terrain.grid.spacing / max(speed, 1e-6)
    return FluidParameters(
        kinematic_viscosity=VISCOSITY_PRIOR[kind],
        inflow_velocity=tuple(float(x) for x in bulk),
        inflow_fluctuation=float(spread),
        outflow_velocity=max(out, 0.0),
        restitution=0.05,
        wall_damping=WALL_DAMPING_PRIOR[kind],
        time_step=float(np.clip(min(interval, 2.0 * courant), interval / 20, interval)),
    )


def parameters_of(story: Story) -> FluidParameters:
    """The fitted parameters."""
    p = dict(story["fit"].meta["parameters"])
    return FluidParameters(**{k: tuple(v) if isinstance(v, list) else v for k, v in p.items()})


def estimates_of(story: Story) -> dict[str, Estimate]:
    """The fitted parameters with their uncertainties."""
    found = {}
    for name, e in story["fit"].meta["estimates"].items():
        sigma = float("inf") if e["sigma"] is None else e["sigma"]  # JSON has no infinity
        found[name] = Estimate(e["value"], sigma, e["identifiable"], e["prior"], e["unit"])
    return found


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
