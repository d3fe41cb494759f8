"""The stage that simulates: from a scene to frames, with a checkpoint every few of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from fluidlift.io.frames import FIRST_FRAME
from fluidlift.messages import Notice
from fluidlift.pipeline.settings import SimulateSettings
from fluidlift.pipeline.work import Work
from fluidlift.present.looping import close_loop
from fluidlift.scene.build import Scene, SimulationRequest
from fluidlift.scene.filmed_numbers import WatchedFlow, film_estimates
from fluidlift.scene.reshaping import closed_inlet
from fluidlift.scene.simulated_history import FrameHistory
from fluidlift.scene.simulation import advance, continued
from fluidlift.scene.simulator import left_to_the_cpu, preflight, simulator_of
from fluidlift.scene.splat_files import checkpoint_file, frame_file, frame_files, require_room
from fluidlift.scene.surface_appearance import SurfaceAppearance
from fluidlift.scene.whitewater import MeasuredWhitewater, SceneWhitewater, kept_measure
from fluidlift.types import Estimate, kind_of
from fluidlift.types.stages import Simulation

if TYPE_CHECKING:
    from fluidlift.physics.stepping import ParticleSimulator

STRAYED = 0.25
"""of the fluid per second, from which that which leaves the filmed places is a warning: with as much the surface sinks
within a few seconds where no inlet makes up for it; and that which is put in where it ran dry, likewise"""


def simulate(
    scene: Scene,
    config: SimulateSettings,
    *,
    folder: Path,
    request: SimulationRequest | None = None,
    work: Work | None = None,
    told: Callable[[int], None] = lambda splats: None,
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
        told: gets how many splats a frame will have, about, before the first one is simulated.

    Raises:
        InputRejected: a scene that cannot be simulated, said before anything is written; or the disk is full.
    """
    preflight(scene)
    white, known = None, None
    if scene.whitewater > 0 and scene.as_lifted is not None:
        part = (work or Work.alone(folder)).part  # once for each asset
        known = part("whitewater", kept_measure, scene.as_lifted, config.device).found
        white = SceneWhitewater(scene, known)
    simulator = simulator_of(scene, config.device)
    closed = closed_inlet(scene, simulator)
    watch = WatchedFlow.of(scene) if white is None else None
    appearance = SurfaceAppearance(scene, white or watch)
    simulator.deforms = appearance.draws_out
    history = continued(simulator, appearance, scene, folder, request or SimulationRequest(), config.max_particles)
    first = len(history)
    told(appearance.splats)
    require_room(folder, scene.simulated - first, appearance.splats)
    for old in frame_files(folder):
        if not (old.stem.isdigit() and 0 <= int(old.stem) - FIRST_FRAME < first):
            old.unlink()
    if first == 0:
        checkpoint_file(folder).unlink(missing_ok=True)
    step = (lambda done, total: None) if work is None else work.step
    failed = advance(
        simulator, appearance, scene, folder, history, step, max_particles=config.max_particles,
        checkpoint_every=config.checkpoint_every,
    )  # fmt: skip
    warnings = [*scene.notes, *appearance.warnings, *closed, *left_to_the_cpu(simulator, config.device)] + (
        list(simulator.bodies.warnings) if scene.obstacles else []
    )
    if failed is None and len(history) < scene.simulated:
        warnings.append(
            Notice(
                "simulation-too-many-particles",
                f"the re-simulation stopped after {len(history)} of {scene.simulated} frames, at twice the number of "
                f"particles that --set simulate.max_particles={config.max_particles} allows",
            )
        )
    if scene.overlap:
        warnings += close_loop(scene, history, folder)
    arrays = history.arrays()
    warnings += _simulation_warnings(scene, simulator, history)
    estimates = _estimates(scene, known)
    if watch is not None and failed is None:
        estimates |= watch.estimates
    return Simulation(
        volume=arrays["volume"],
        leak=arrays["leak"],
        count=arrays["count"],
        poses=arrays["poses"],
        substeps=tuple(history.substeps[1:]),
        resumed_at=first,
        failed=failed,
        warnings=tuple(warnings),
        estimates=estimates,
    )


def _estimates(scene: Scene, known: MeasuredWhitewater | None) -> dict[str, Estimate]:
    """What the film says of foam and waves, and with white water what was measured of it in the scene as lifted."""
    if scene.whitewater > 0 and scene.as_lifted is not None:
        return film_estimates(scene.as_lifted) | ({} if known is None else known.estimates)
    return {} if scene.edited else film_estimates(scene)


def _simulation_warnings(scene: Scene, simulator: ParticleSimulator, history: FrameHistory) -> list[Notice]:
    """What to say of volume that was lost or gained, of particles in the ground, in dry cells, and put in."""
    warnings, volumes, leaks, lies = [], history.volume, history.leak, kind_of(scene.kind).lies_on_ground
    drift = volumes[-1] / max(volumes[0], 1e-12) - 1
    if drift < -0.5 or (drift > 0.5 and lies):  # pours fill and smoke spreads
        word = "lost" if drift < 0 else "gained"
        warnings.append(
            Notice(
                "volume-drifts", f"the re-simulation {word} {100 * abs(drift):.0f} % of its volume by its last frame"
            )
        )
    if max(leaks) > 0.01:
        warnings.append(
            Notice("particles-in-ground", f"up to {100 * max(leaks):.1f} % of the particles are inside the terrain")
        )
    there = max(simulator.volume * scene.interval * (len(history) - 1), 1e-12)
    if lies:  # what is poured, and spreads no further, runs off in any case
        warnings += _strayed(simulator.drained / there)
    return warnings + _refilled(simulator.refilled / there)


def _strayed(share: float) -> list[Notice]:
    """What to say of the water that got into dry cells: 1/s, of what is left."""
    if share <= STRAYED:
        return []
    return [Notice("strayed", f"in each second {100 * share:.0f} % of the fluid got where the clip shows none, and was "
                   "taken out: shape or inflow is wrong there; correct the mask (fluidlift mask), or give --kind or "
                   "--pitch")]  # fmt: skip


def _refilled(share: float) -> list[Notice]:
    """What to say of the water that was put into cells that had run dry: 1/s, of what is there at the end."""
    if share <= STRAYED:
        return []
    return [Notice("refilled", f"in each second {100 * share:.0f} % of the fluid was put in where the clip shows some "
                   "at all times and the simulation ran dry: less flows in than out; give --size or --pitch, or --set "
                   "simulate.follow=0 to see it without")]  # fmt: skip


def frames_still_there(folder: Path) -> Callable[[Simulation], bool]:
    """Whether the splat files of a cached simulation are complete; one that broke down is tried again."""
    return lambda done: (
        done.failed is None and all(frame_file(folder, FIRST_FRAME + k).is_file() for k in range(done.frames))
    )
