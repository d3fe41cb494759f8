"""A scene played frame by frame, with a checkpoint every few frames that another run goes on from."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fluidlift.errors import FluidliftError, InputRejected
from fluidlift.io.frames import FIRST_FRAME
from fluidlift.scene.build import Scene, SimulationRequest
from fluidlift.scene.reshaping import in_words
from fluidlift.scene.simulated_history import FrameHistory
from fluidlift.scene.splat_files import checkpoint_file, frame_file, write_frame
from fluidlift.scene.surface_appearance import Dressed, SurfaceAppearance
from fluidlift.source import source_hash
from fluidlift.types import Particles, kind_of

if TYPE_CHECKING:
    from fluidlift.physics.stepping import ParticleSimulator, StepReport


def state_parts(scene: Scene) -> dict[str, str]:
    """A hash of each part that the state of a simulation depends on: those of its scene, and the source."""
    return scene.parts | {"version": source_hash(__name__)}


def continued(
    simulator: ParticleSimulator,
    appearance: SurfaceAppearance,
    scene: Scene,
    folder: Path,
    request: SimulationRequest,
    max_particles: int,
) -> FrameHistory:
    """Bring the simulator, and what floats on its surface, to the last checkpoint of this scene.

    Returns:
        The history up to it; empty where the simulation starts at the first frame.

    Raises:
        InputRejected: `request.resume`, and there is no checkpoint that fits; the message says what differs.
    """
    from fluidlift.io.checkpoint import differing_parts, read_checkpoint, read_parts
    from fluidlift.physics.preflight import simulation_bytes

    if request.restart:
        return FrameHistory()
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
        most = len(scene.body) + 2 * max(max_particles, len(scene.body))
        found = read_checkpoint(path, max_bytes=4 * simulation_bytes(scene.terrain.grid, most))
        if found.history["poses"].shape != (found.frames, len(scene.obstacles), 7):
            raise InputRejected(f"the checkpoint of '{folder.name}' holds other obstacles", "a whole checkpoint")
        history = FrameHistory.of(found.history, scene.simulated)
        if found.frames <= scene.simulated:
            appearance.restore(found.state)
            simulator.restore(found.state)
        return history
    except (InputRejected, KeyError) as error:
        if not request.resume:
            return FrameHistory()
        if isinstance(error, KeyError):
            raise InputRejected(f"the checkpoint of '{folder.name}' lacks {error}", "a whole checkpoint") from None
        raise


def advance(
    simulator: ParticleSimulator,
    appearance: SurfaceAppearance,
    scene: Scene,
    folder: Path,
    history: FrameHistory,
    step: Callable[[int, int], None],
    *,
    max_particles: int,
    checkpoint_every: int,
) -> str | None:
    """Simulate and write the frames that are missing; why it broke down, if it did.

    While what floats on a frame's surface is carried along, another thread simulates the next frame, and a third one
    gives the frame before its look and writes it.

    Args:
        simulator: at the last frame of `history`.
        appearance: at the same.
        scene: that is simulated.
        folder: of the asset.
        history: of the frames that are there; the others are added.
        step: told (done, all).
        max_particles: beyond twice as many, of smoke or twice those at rest, the simulation ends.
        checkpoint_every: frames.

    Raises:
        InputRejected: the disk is full.
    """
    from fluidlift.io.checkpoint import Checkpoint, write_checkpoint
    from fluidlift.physics.gas import GasSimulator

    most = max(max_particles, len(scene.rest) if kind_of(scene.kind).is_gas else 0)  # smoke spreads, a liquid does not
    if isinstance(simulator, GasSimulator):
        simulator.most = most
    with ThreadPoolExecutor(1, "simulation") as beside, Written() as written:
        coming: Future[StepReport] | None = None
        for k in range(len(history), scene.simulated):
            step(k, scene.simulated)
            substeps = 0
            if k:
                try:
                    report = simulator.advance(scene.interval) if coming is None else coming.result()
                    substeps = int(report.substeps)
                except InputRejected:
                    raise
                except FluidliftError as error:
                    return f"frame {FIRST_FRAME + k} ({k} of {scene.simulated}): {error} {in_words(scene)}".rstrip()
            p, coming = simulator.particles, None
            if k and len(p) > 2 * most:
                return None
            # the first one says whose frames these are
            due = (k + 1) % checkpoint_every == 0 or k + 1 in (1, scene.simulated)
            state = simulator.state() if due else {}  # copies
            ahead = simulator.any_thread and not scene.obstacles  # these move on with the simulator
            if ahead and k + 1 < scene.simulated:
                coming = beside.submit(simulator.advance, scene.interval)
            history.add(scene, simulator, p, substeps)
            appearance.advance(p, k)
            if ahead and appearance.any_thread:
                written.begin(_dress_and_write, folder, simulator, appearance.as_now(), scene, p, k)
            else:
                written.begin(_write, folder, k, _dressed(simulator, appearance, scene, p, k))
            if due or not ahead:  # a checkpoint says that its frames are there; what a device holds may change
                written.wait()
            if due:
                kept = Checkpoint(len(history), state_parts(scene), state | appearance.state(), history.arrays())
                write_checkpoint(checkpoint_file(folder), kept)
    step(scene.simulated, scene.simulated)
    return None


class Written:
    """Writes frames beside other work, one at a time, so that no more than one waits in memory.

    At the end of a `with` block all is written; what went wrong with a frame is raised there, or by the next one.
    """

    def __init__(self) -> None:
        self._beside = ThreadPoolExecutor(1, "writing")
        self._last: Future[Any] | None = None

    def __enter__(self) -> Written:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._beside.shutdown()
        if kind is None:  # what ended the block is what counts
            self.wait()

    def begin(self, write: Callable[..., Any], *args: Any, **named: Any) -> None:
        """Write the next one, with a function that other threads bear, once the one before is written."""
        self.wait()
        self._last = self._beside.submit(write, *args, **named)

    def wait(self) -> None:
        """Until all that was begun is written."""
        last, self._last = self._last, None
        if last is not None:
            last.result()


def _dressed(
    simulator: ParticleSimulator, appearance: SurfaceAppearance, scene: Scene, p: Particles, k: int
) -> Dressed:
    """The splats of frame k, whose particles are p; the simulator may be on its way to later ones."""
    inside = simulator.bodies.inside if scene.obstacles else None
    return appearance.dressed(p, k, inside, simulator.deformed)


def _write(folder: Path, k: int, shown: Dressed) -> None:
    write_frame(folder, FIRST_FRAME + k, shown.gaussians, ids=shown.ids, velocities=shown.velocities)


def _dress_and_write(
    folder: Path, simulator: ParticleSimulator, appearance: SurfaceAppearance, scene: Scene, p: Particles, k: int
) -> None:
    _write(folder, k, _dressed(simulator, appearance, scene, p, k))
