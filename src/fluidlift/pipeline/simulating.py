"""The stage that simulates: from a scene to frames, with a checkpoint every few of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fluidlift.config import JobConfig
from fluidlift.errors import FluidliftError, InputRejected
from fluidlift.io.frames import FIRST_FRAME
from fluidlift.pipeline.dressing import Dressing, lends_look
from fluidlift.pipeline.looping import close_loop
from fluidlift.pipeline.reshaping import closed_inlet, in_words, sides_open_to_air
from fluidlift.pipeline.scene import Scene, SimulationRequest, simulation_step
from fluidlift.pipeline.story import Result, available_memory
from fluidlift.types import CellType, Gaussians, Particles, kind_of

if TYPE_CHECKING:
    from fluidlift.look.inflow import InflowLook
    from fluidlift.physics.guidance import BodyForce
    from fluidlift.physics.numba_particles import ParticleWork
    from fluidlift.physics.stepping import ParticleSimulator

BYTES_PER_SPLAT = 80
"""of disk, in a frame's file"""


def particle_work(device: str) -> ParticleWork:
    """The back end that moves particles on a device, "cpu" or "cuda".

    Raises:
        MissingPackage: NVIDIA Warp is not installed.
        FluidliftError: there is no such GPU.
    """
    from fluidlift.physics.numba_particles import ParticleWork

    if device == "cpu":
        return ParticleWork()
    from fluidlift.backends.warp_particles import WarpMover, WarpTransfer

    return ParticleWork(WarpTransfer(device), WarpMover(device))


def simulator_of(scene: Scene, device: str = "cpu", forces: Sequence[BodyForce] = ()) -> ParticleSimulator:
    """The simulator at the first instant. Smoke is simulated on the CPU, without `forces`."""
    from fluidlift.physics.emitter import Supply

    parameters = simulation_step(scene)
    own = scene.rest.select(np.arange(len(scene.rest) - sum(map(len, scene.emitter_looks))))
    look = inflow_look(scene, own, float(np.linalg.norm(parameters.inflow_velocity)))
    grid, supply = scene.terrain.grid, Supply(scene.inflow, scene.emitters, scene.emitter_looks)
    if kind_of(scene.kind).is_gas:
        from fluidlift.physics.gas import GasSimulator

        return GasSimulator(
            grid, scene.terrain, parameters, scene.body, cell_types=scene.cell_types, inflow_profile=scene.velocity,
            velocity=scene.velocity, seed=scene.seed, emit_source=look,
            buoyancy=float(np.linalg.norm(parameters.gravity)), supply=supply,
        )  # fmt: skip
    from fluidlift.physics.apic import LiquidSimulator
    from fluidlift.physics.guidance import SteadyForce

    if scene.force is not None:
        forces = (*forces, SteadyForce(scene.force))
    cells, body = within_outlet(scene)
    return LiquidSimulator(
        grid, scene.terrain, parameters, body, cell_types=cells, inflow_profile=scene.velocity,
        seed=scene.seed, emit_source=look, bodies=scene.bodies, work=particle_work(device), supply=supply,
        open_sides=sides_open_to_air(parameters.gravity), forces=forces,
    )  # fmt: skip


def inflow_look(scene: Scene, own: Gaussians, speed: float) -> InflowLook:
    """What flows in at a speed (m/s) looks like the body's own Gaussians; of what lies, as the clip shows it away from
    rocks and banks."""
    from fluidlift.look.inflow import InflowLook

    # a sheet that falls has no level to keep to
    terrain, lying, usable = scene.terrain, kind_of(scene.kind).nearly_level, None
    spacing = 0.5 * terrain.grid.spacing
    if lying and len(own):
        usable = lends_look(scene, own)
    return InflowLook(own, terrain.mainstream, speed, spacing, usable=usable, run=scene.inflow.run, lying=lying)


def within_outlet(scene: Scene) -> tuple[np.ndarray, Particles]:
    """Cells and body of what lies on something, without what is behind its outlet and with an inlet that takes in all
    that flows in; all of those of other fluids."""
    from fluidlift.physics.inlet import inlet_along_rim, inlet_to_surface
    from fluidlift.physics.outlet import thin_outlet

    kind = kind_of(scene.kind)
    if not kind.is_channel_flow:
        return scene.cell_types, scene.body
    cells, grid = thin_outlet(scene.cell_types), scene.terrain.grid
    if kind.nearly_level:
        cells = inlet_to_surface(cells, scene.body.positions, grid)
    elif kind.enters_over_rim:
        gravity = np.asarray(scene.parameters.gravity)
        cells = inlet_along_rim(cells, scene.body.positions, scene.velocity, grid, gravity)
    behind = (scene.cell_types == CellType.OUTFLOW) & (cells != CellType.OUTFLOW)
    at = np.clip(grid.cell_of(scene.body.positions), 0, np.asarray(grid.shape) - 1)
    return cells, scene.body.select(~behind[tuple(at.T)])


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


def frame_file(folder: Path, number: int) -> Path:
    """Splats of one frame; numbers start at 1001."""
    return folder / "frames" / "splats" / f"{number:04d}.ply"


def require_room(folder: Path, frames: int, splats: int) -> None:
    """Raise `InputRejected` where the disk cannot hold so many frames of so many splats."""
    from fluidlift.io.atomic import require_free_space

    require_free_space(folder, frames * splats * BYTES_PER_SPLAT)


def simulated_poses(folder: Path, bodies: int | None = None, frames: int = 0) -> np.ndarray | None:
    """[k,b,7] of the obstacles in the k frames that were simulated last: position (m) and orientation (w, x, y, z).

    None where they are not at hand, not of so many `bodies` (None: any number), or of fewer than `frames`.
    """
    from fluidlift.io.stage_cache import load_stage, owner_of

    key = owner_of(folder, "simulate")
    found = None if key is None else load_stage(folder, "simulate", key)
    poses = None if found is None else found[0].get("poses")
    if poses is None or len(poses) < frames:
        return None
    return poses if bodies is None or poses.shape[1:] == (bodies, 7) else None


def checkpoint_file(folder: Path) -> Path:
    """Where the state of the simulation is kept whose frames are in the folder."""
    return folder / "work" / "checkpoint" / "simulation.npz"


@dataclass
class History:
    """Figures of each frame so far."""

    volume: list[float] = field(default_factory=list)
    """m^3 of the cells that hold particles"""
    leak: list[float] = field(default_factory=list)
    """share of the particles inside the terrain"""
    count: list[int] = field(default_factory=list)
    """particles"""
    substeps: list[int] = field(default_factory=list)
    """of the step that led to the frame; 0 for the first"""
    poses: list[np.ndarray] = field(default_factory=list)
    """[b,7] of the obstacles: position (m) and orientation (w, x, y, z)"""

    def __len__(self) -> int:
        return len(self.count)

    def add(self, scene: Scene, simulator: ParticleSimulator, particles: Particles, substeps: int) -> None:
        """One more frame."""
        from fluidlift.numerics.sampling import sample_nodes

        bodies = simulator.bodies if scene.obstacles else None
        pose = np.zeros((0, 7)) if bodies is None else np.concatenate([bodies.position, bodies.orientation], axis=1)
        self.poses.append(pose)
        grid = scene.terrain.grid
        occupied = np.unique(np.floor((particles.positions - grid.low) / grid.spacing).astype(np.int64), axis=0)
        inside = grid.contains(particles.positions)
        distance = sample_nodes(scene.terrain.signed_distance, grid, particles.positions[inside])
        self.volume.append(len(occupied) * grid.spacing**3)
        self.leak.append(float((distance < -0.1 * grid.spacing).mean()) if inside.any() else 0.0)
        self.count.append(len(particles))
        self.substeps.append(substeps)

    def arrays(self) -> dict[str, np.ndarray]:
        """One entry per frame."""
        return {
            "volume": np.array(self.volume, np.float32),
            "leak": np.array(self.leak, np.float32),
            "count": np.array(self.count, np.int64),
            "substeps": np.array(self.substeps, np.int64),
            "poses": np.array(self.poses, np.float64),
        }

    @classmethod
    def of(cls, arrays: dict[str, np.ndarray], frames: int) -> History:
        """The first frames of `arrays`."""
        figures = (arrays[name][:frames].tolist() for name in ("volume", "leak", "count", "substeps"))
        return cls(*figures, list(arrays["poses"][:frames]))


def continued(
    simulator: ParticleSimulator,
    dressing: Dressing,
    scene: Scene,
    folder: Path,
    request: SimulationRequest,
    config: JobConfig,
) -> History:
    """Bring the simulator, and what floats on its surface, to the last checkpoint of this scene.

    Returns:
        The history up to it; empty where the simulation starts at the first frame.

    Raises:
        InputRejected: `request.resume`, and there is no checkpoint that fits; the message says what differs.
    """
    from fluidlift.io.checkpoint import differing_parts, read_checkpoint, read_parts
    from fluidlift.physics.preflight import simulation_bytes

    if request.restart:
        return History()
    path = checkpoint_file(folder)
    try:
        frames, parts = read_parts(path)
        other = differing_parts(parts, scene.parts)
        if other:
            raise InputRejected(
                f"the checkpoint of '{folder.name}' is of a simulation with another {', another '.join(other)}",
                "the scene, settings and version that it was made with",
                "undo the change, or leave out --resume to start at the first frame",
            )
        missing = [k for k in range(frames) if not frame_file(folder, FIRST_FRAME + k).is_file()]
        if missing:
            raise InputRejected(
                f"frame {FIRST_FRAME + missing[0]}, after which the checkpoint goes on, is not there any more",
                f"all {frames} frames before the checkpoint", "leave out --resume to start at the first frame",
            )  # fmt: skip
        most = len(scene.body) + 2 * config.simulate.max_particles
        found = read_checkpoint(path, max_bytes=4 * simulation_bytes(scene.terrain.grid, most))
        if found.history["poses"].shape != (found.frames, len(scene.obstacles), 7):
            raise InputRejected(f"the checkpoint of '{folder.name}' holds other obstacles", "a whole checkpoint")
        history = History.of(found.history, scene.simulated)
        if found.frames <= scene.simulated:
            dressing.restore(found.state)
            simulator.restore(found.state)
        return history
    except (InputRejected, KeyError) as error:
        if not request.resume:
            return History()
        if isinstance(error, KeyError):
            raise InputRejected(f"the checkpoint of '{folder.name}' lacks {error}", "a whole checkpoint") from None
        raise


def simulate(
    scene: Scene,
    folder: Path,
    config: JobConfig,
    *,
    request: SimulationRequest | None = None,
    step: Callable[[int, int], None] = lambda done, total: None,
) -> Result:
    """Frames of a scene, as splats with ids and velocities.

    A simulation that was stopped goes on from its last checkpoint; one that is finished can be made longer. Frames that
    are there already are not computed again. Where the simulation breaks down, the frames before stay, and the result
    says why in `meta["failed"]`.

    Args:
        scene: at the first instant.
        folder: of the asset.
        config: its `simulate` section.
        request: whether to go on from a checkpoint.
        step: told (frames done, all frames).

    Raises:
        InputRejected: a scene that cannot be simulated, said before anything is written; or the disk is full.
    """
    preflight(scene)
    simulator = simulator_of(scene, config.simulate.device)
    closed = closed_inlet(scene, simulator)
    dressing = Dressing(scene)
    history = continued(simulator, dressing, scene, folder, request or SimulationRequest(), config)
    first = len(history)
    require_room(folder, scene.simulated - first, len(scene.body))
    for old in (folder / "frames" / "splats").glob("*.ply"):
        if not (old.stem.isdigit() and 0 <= int(old.stem) - FIRST_FRAME < first):
            old.unlink()
    if first == 0:
        checkpoint_file(folder).unlink(missing_ok=True)
    failed = _advance(simulator, dressing, scene, folder, config, history, step)
    warnings = [*scene.notes, *dressing.warnings, *closed] + (
        list(simulator.bodies.warnings) if scene.obstacles else []
    )
    if failed is None and len(history) < scene.simulated:
        warnings.append(
            f"the re-simulation stopped after {len(history)} of {scene.simulated} frames, at twice the number of "
            f"particles that --set simulate.max_particles={config.simulate.max_particles} allows"
        )
    if scene.overlap:
        warnings += close_loop(scene, history, lambda k: frame_file(folder, FIRST_FRAME + k), checkpoint_file(folder))
    arrays = history.arrays()
    meta: dict[str, Any] = {
        "frames": len(history),
        "resumed_at": first,
        "substeps": history.substeps[1:],
        "warnings": warnings + _simulation_warnings(scene.kind, history.volume, history.leak),
    }
    if failed is not None:
        meta["failed"] = failed
    return Result({name: arrays[name] for name in ("volume", "leak", "count", "poses")}, meta)


def _advance(
    simulator: ParticleSimulator,
    dressing: Dressing,
    scene: Scene,
    folder: Path,
    config: JobConfig,
    history: History,
    step: Callable[[int, int], None],
) -> str | None:
    """Simulate and write the frames that are missing; why it broke down, if it did."""
    from fluidlift.io.ply import write_gaussians

    for k in range(len(history), scene.simulated):
        step(k, scene.simulated)
        substeps = 0
        if k:
            try:
                substeps = int(simulator.advance(scene.interval).substeps)
            except InputRejected:
                raise
            except FluidliftError as error:
                return f"frame {FIRST_FRAME + k} ({k} of {scene.simulated}): {error} {in_words(scene)}".rstrip()
        p = simulator.particles
        if k and len(p) > config.simulate.max_particles * 2:
            return None
        dressing.advance(p, k)
        shown = dressing.dressed(p, k, simulator.bodies.inside if scene.obstacles else None)
        write_gaussians(
            frame_file(folder, FIRST_FRAME + k), shown.gaussians, ids=shown.ids, velocities=shown.velocities
        )
        history.add(scene, simulator, p, substeps)
        # the first one says whose frames these are
        if len(history) % config.simulate.checkpoint_every == 0 or len(history) in (1, scene.simulated):
            _save(simulator, dressing, scene, folder, history)
    step(scene.simulated, scene.simulated)
    return None


def _save(simulator: ParticleSimulator, dressing: Dressing, scene: Scene, folder: Path, history: History) -> None:
    from fluidlift.io.checkpoint import Checkpoint, write_checkpoint

    kept = Checkpoint(len(history), scene.parts, simulator.state() | dressing.state(), history.arrays())
    write_checkpoint(checkpoint_file(folder), kept)


def _simulation_warnings(kind: str, volumes: Sequence[float], leaks: Sequence[float]) -> list[str]:
    warnings = []
    drift = volumes[-1] / max(volumes[0], 1e-12) - 1
    if drift < -0.5 or (drift > 0.5 and kind_of(kind).is_channel_flow):  # pours fill and smoke spreads
        word = "lost" if drift < 0 else "gained"
        warnings.append(f"the re-simulation {word} {100 * abs(drift):.0f} % of its volume by its last frame")
    if max(leaks) > 0.01:
        warnings.append(f"up to {100 * max(leaks):.1f} % of the particles are inside the terrain")
    return warnings


def frames_still_there(folder: Path) -> Callable[[Result], bool]:
    """Whether the splat files of a cached simulation are complete; one that broke down is tried again."""
    return lambda result: (
        "failed" not in result.meta
        and all(frame_file(folder, FIRST_FRAME + k).is_file() for k in range(result.meta["frames"]))
    )
