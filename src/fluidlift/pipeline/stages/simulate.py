"""The stage that simulates: from a scene to frames, with a checkpoint every few of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from fluidlift.errors import FluidliftError, InputRejected
from fluidlift.io.frames import FIRST_FRAME
from fluidlift.pipeline.dressing import Dressing
from fluidlift.pipeline.looping import close_loop
from fluidlift.pipeline.reshaping import closed_inlet, in_words
from fluidlift.pipeline.scene import Scene, SimulationRequest
from fluidlift.pipeline.settings import SimulateSettings
from fluidlift.pipeline.simulated_history import History
from fluidlift.pipeline.simulator import preflight, simulator_of
from fluidlift.pipeline.source import source_hash
from fluidlift.pipeline.splat_files import checkpoint_file, frame_file, require_room
from fluidlift.pipeline.work import Work
from fluidlift.types import kind_of
from fluidlift.types.stages import Simulation

if TYPE_CHECKING:
    from fluidlift.physics.stepping import ParticleSimulator


def state_parts(scene: Scene) -> dict[str, str]:
    """A hash of each part that the state of a simulation depends on: those of its scene, and the source."""
    return scene.parts | {"version": source_hash(__name__)}


def continued(
    simulator: ParticleSimulator,
    dressing: Dressing,
    scene: Scene,
    folder: Path,
    request: SimulationRequest,
    max_particles: int,
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
        other = differing_parts(parts, state_parts(scene))
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
        most = len(scene.body) + 2 * max_particles
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
    config: SimulateSettings,
    *,
    folder: Path,
    request: SimulationRequest | None = None,
    work: Work | None = None,
) -> Simulation:
    """Frames of a scene, as splats with ids and velocities.

    A simulation that was stopped goes on from its last checkpoint; one that is finished can be made longer. Frames that
    are there already are not computed again. Where the simulation breaks down, the frames before stay, and the value
    says why in `failed`.

    Args:
        scene: at the first instant.
        config: how many particles, where they are moved.
        folder: of the asset, where the frames go.
        request: whether to go on from a checkpoint.
        work: told how many frames are done.

    Raises:
        InputRejected: a scene that cannot be simulated, said before anything is written; or the disk is full.
    """
    preflight(scene)
    simulator = simulator_of(scene, config.device)
    closed = closed_inlet(scene, simulator)
    dressing = Dressing(scene)
    history = continued(simulator, dressing, scene, folder, request or SimulationRequest(), config.max_particles)
    first = len(history)
    require_room(folder, scene.simulated - first, len(scene.body))
    for old in (folder / "frames" / "splats").glob("*.ply"):
        if not (old.stem.isdigit() and 0 <= int(old.stem) - FIRST_FRAME < first):
            old.unlink()
    if first == 0:
        checkpoint_file(folder).unlink(missing_ok=True)
    step = (lambda done, total: None) if work is None else work.step
    failed = _advance(simulator, dressing, scene, folder, config, history, step)
    warnings = [*scene.notes, *dressing.warnings, *closed]
    warnings += [] if simulator.bodies is None else simulator.bodies.warnings
    if failed is None and len(history) < scene.simulated:
        warnings.append(
            f"the re-simulation stopped after {len(history)} of {scene.simulated} frames, at twice the number of "
            f"particles that --set simulate.max_particles={config.max_particles} allows"
        )
    if scene.overlap:
        warnings += close_loop(scene, history, lambda k: frame_file(folder, FIRST_FRAME + k), checkpoint_file(folder))
    arrays = history.arrays()
    warnings += _simulation_warnings(scene.kind, history.volume, history.leak)
    return Simulation(
        volume=arrays["volume"],
        leak=arrays["leak"],
        count=arrays["count"],
        poses=arrays["poses"],
        substeps=tuple(history.substeps[1:]),
        resumed_at=first,
        failed=failed,
        warnings=tuple(warnings),
    )


def _advance(
    simulator: ParticleSimulator,
    dressing: Dressing,
    scene: Scene,
    folder: Path,
    config: SimulateSettings,
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
        if k and len(p) > config.max_particles * 2:
            return None
        dressing.advance(p, k)
        shown = dressing.dressed(p, k, None if simulator.bodies is None else simulator.bodies.inside)
        write_gaussians(
            frame_file(folder, FIRST_FRAME + k), shown.gaussians, ids=shown.ids, velocities=shown.velocities
        )
        history.add(scene, simulator, p, substeps)
        # the first one says whose frames these are
        if len(history) % config.checkpoint_every == 0 or len(history) in (1, scene.simulated):
            _save(simulator, dressing, scene, folder, history)
    step(scene.simulated, scene.simulated)
    return None


def _save(simulator: ParticleSimulator, dressing: Dressing, scene: Scene, folder: Path, history: History) -> None:
    from fluidlift.io.checkpoint import Checkpoint, write_checkpoint

    kept = Checkpoint(len(history), state_parts(scene), simulator.state() | dressing.state(), history.arrays())
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


def frames_still_there(folder: Path) -> Callable[[Simulation], bool]:
    """Whether the splat files of a cached simulation are complete; one that broke down is tried again."""
    return lambda done: (
        done.failed is None and all(frame_file(folder, FIRST_FRAME + k).is_file() for k in range(done.frames))
    )
