"""Simulation while somebody edits: a coarse copy of the scene, frame by frame, the newest wish first.

The copy has cells twice as wide as often as it takes to follow a hand on this machine, and its particles are thinned
with them. It is a sketch: thin films and small drops are below its cells, and what is kept comes from `resimulate`.
"""

from __future__ import annotations

import contextlib
import logging
import math
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import yaml

from fluidlift.config import JobConfig
from fluidlift.errors import FluidliftError, InputRejected
from fluidlift.scene.build import Scene, SimulationRequest, first_of_film, scene_of
from fluidlift.scene.coarse_copy import PreviewSize, bears_coarser, coarse_asset, coarser, thinned
from fluidlift.scene.simulator import preflight, simulator_of
from fluidlift.scene.surface_appearance import SurfaceAppearance
from fluidlift.types import FluidAsset, Gaussians, TriangleMesh

if TYPE_CHECKING:
    from fluidlift.io.obstacles import Obstacle

__all__ = [
    "LivePreview", "PreviewFrame", "PreviewRequest", "PreviewSize", "Take", "coarse_asset", "obstacles_of",
    "preview_frames", "preview_scene", "thinned",
]  # fmt: skip

LOG = logging.getLogger(__name__)
MOST_SUBSTEPS = 60
"""of one frame: more than that is a blow-up, or too slow to be called live"""
SUBSTEPS_AT_ONCE = 3
"""between two looks at whether somebody wants something else"""
TIMED = 3
"""frames, at the start, by whose time the copy's size is chosen"""


class PreviewFrame(NamedTuple):
    """One instant of the copy."""

    number: int
    """counted from 0, the body at rest"""
    gaussians: Gaussians
    """world, m"""
    velocities: np.ndarray
    """[n,3], m/s"""
    poses: np.ndarray
    """[b,7] of the obstacles: position (m) and orientation (w, x, y, z)"""
    cell: float = math.nan
    """m, of the copy's cells; not a number: not known"""


@contextlib.contextmanager
def _written(edits: dict[str, Any]) -> Iterator[Path]:
    """A folder with a scene.yaml that holds some edits, all but the look, which may name files of the asset."""
    physical = {k: v for k, v in edits.items() if k != "look"}
    with tempfile.TemporaryDirectory(prefix="fluidlift-preview-") as name:
        (Path(name) / "scene.yaml").write_text(yaml.safe_dump(physical, sort_keys=False), encoding="utf-8")
        yield Path(name)


def obstacles_of(folder: Path, edits: dict[str, Any]) -> tuple[Obstacle, ...]:
    """The obstacles of edits that need not be written anywhere yet, with their meshes.

    Args:
        folder: of the asset, where mesh files lie.
        edits: what scene.yaml would hold.

    Raises:
        InputRejected: an entry that does not fit.
    """
    from fluidlift.io.scene import read_edits

    with _written({"obstacles": edits.get("obstacles") or []}) as place:
        return read_edits(place, meshes=folder).obstacles


def preview_scene(asset: FluidAsset, folder: Path, edits: dict[str, Any], frames: int) -> Scene:
    """The scene of an asset with edits that need not be written anywhere yet.

    Args:
        asset: as `coarse_asset` gives it.
        folder: of the asset, where mesh files lie.
        edits: what scene.yaml would hold.
        frames: at most; the clip's length or the edits' duration may be shorter.

    Raises:
        InputRejected: edits that do not fit.
    """
    from fluidlift.io.asset_folder import read_manifest
    from fluidlift.scene.recall import rest_frame_of

    with _written(edits) as place:
        scene = scene_of(asset, place, SimulationRequest(meshes=folder), JobConfig(), footage=None, start=0)
    if scene.film is not None:
        start = rest_frame_of(read_manifest(folder), None)
        scene = replace(scene, film_start=start - first_of_film(start, asset.frame_count))
    # one step per frame where the flow allows it: waves are damped more than in frames that are kept
    step = scene.interval if scene.longest_step is None else scene.longest_step
    scene = replace(scene, frames=min(scene.frames, frames), longest_step=step)
    preflight(scene)
    return scene


def preview_frames(scene: Scene, cancelled: Callable[[], bool] = lambda: False) -> Iterator[PreviewFrame]:
    """Frames of a scene one after the other, the body at rest first. Ends early where `cancelled` says so.

    Raises:
        FluidliftError: the simulation broke down; the frames before it were good.
    """
    simulator, appearance = simulator_of(scene), SurfaceAppearance(scene)
    simulator.settings = replace(simulator.settings, max_substeps=MOST_SUBSTEPS)
    yield _shown(scene, simulator, appearance, 0)
    for number in range(1, scene.frames):
        parts = _parts(scene, simulator)
        for _ in range(parts):
            if cancelled():
                return
            simulator.advance(scene.interval / parts)
        frame = _shown(scene, simulator, appearance, number)
        if not np.isfinite(frame.gaussians.means).all():
            raise FluidliftError(f"frame {number}: positions that are not finite")
        yield frame


def _parts(scene: Scene, simulator: Any) -> int:
    """Into how many calls a frame is cut, each of a few substeps.

    Raises:
        FluidliftError: the fluid moves faster than a preview can follow.
    """
    fastest = float(np.sqrt(np.square(simulator.particles.velocities).sum(axis=1).max(initial=0.0)))
    gain = float(np.linalg.norm(simulator.parameters.gravity)) * scene.interval
    crossed = (fastest + gain) * scene.interval / scene.terrain.grid.spacing
    steps = max(crossed, scene.interval / simulator.parameters.time_step)
    if not np.isfinite(steps) or steps > MOST_SUBSTEPS:
        raise FluidliftError(f"the fluid reaches {fastest:.3g} m/s, {crossed:.0f} cells in one frame")
    return max(1, int(np.ceil(steps / SUBSTEPS_AT_ONCE)))


def _shown(scene: Scene, simulator: Any, appearance: SurfaceAppearance, number: int) -> PreviewFrame:
    appearance.advance(simulator.particles, number)
    inside = simulator.bodies.inside if scene.obstacles else None
    shown = appearance.dressed(simulator.particles, number, inside)
    poses = np.zeros((0, 7))
    if scene.obstacles:
        poses = np.concatenate([simulator.bodies.position, simulator.bodies.orientation], axis=1)
    return PreviewFrame(number, shown.gaussians, shown.velocities, poses, scene.terrain.grid.spacing)


def rehearsals(asset: FluidAsset) -> tuple[dict[str, Any], ...]:
    """Edits that between them take a live preview through what no scene needs unless it is edited: viscosity that
    counts on any grid, and a body that floats."""
    grid = asset.terrain.grid
    thick = 0.01 * grid.spacing**2 / asset.interval
    place = np.median(asset.rest.means, axis=0).tolist()
    ball = {"shape": "sphere", "radius": 2.5 * grid.spacing, "position": place, "motion": "free", "density": 500.0}
    return {"parameters": {"kinematic_viscosity": thick}}, {"obstacles": [ball]}


@dataclass(frozen=True)
class PreviewRequest:
    """What somebody wants to see."""

    edits: dict[str, Any]
    """what scene.yaml would hold"""
    told: str = ""
    """the last edit in words, for messages"""


@dataclass
class Take:
    """Frames of one wish, as far as they are there. Only the worker adds to it."""

    wish: PreviewRequest
    frames: list[Any] = field(default_factory=list)
    """as `keep` of the preview made them, the body at rest first"""
    total: int = 0
    interval: float = 0.0
    """s between frames"""
    spacing: float = 0.0
    """m, of the copy's cells"""
    ground: TriangleMesh | None = None
    """with what the edits change of it"""
    complete: bool = False
    broken: str = ""
    """why it ended early, in words"""


class LivePreview:
    """A worker that simulates the newest wish and drops all others.

    The take that is shown stays until the first frame after rest of a newer one is there; where the newer one fails
    before that, it stays for good, and `problem` says which edit is to blame.

    Args:
        asset: of full resolution; it is coarsened by the worker.
        folder: of the asset.
        keep: makes of a frame what is to be kept of it.
        told: is called, from the worker, after each change.
    """

    def __init__(
        self,
        asset: FluidAsset,
        folder: Path,
        *,
        size: PreviewSize | None = None,
        keep: Callable[[PreviewFrame], Any] = lambda frame: frame,
        told: Callable[[], None] = lambda: None,
    ) -> None:
        self._asset, self._folder, self._size = asset, folder, size or PreviewSize()
        self._keep, self._told = keep, told
        self._news = threading.Condition()
        self._wish: PreviewRequest | None = None
        self._asked = self._done = 0
        self._held = self._closed = False
        self.shown: Take | None = None
        self.phase = "warming up"
        """warming up, ready, preparing, running or held"""
        self.problem = ""
        """why the newest wish cannot be shown to its end; empty where it can"""
        self.particles = 0
        """of the copy, at rest"""
        self._thread = threading.Thread(target=self._work, name="preview", daemon=True)

    def start(self) -> None:
        """Begin: kernels are compiled or read, and one frame is made, so that the first wish need not wait for it."""
        self._thread.start()

    def ask(self, wish: PreviewRequest) -> int:
        """Want something else than before; the number of the wish."""
        with self._news:
            self._wish = wish
            self._asked += 1
            self._news.notify_all()
            return self._asked

    def stop(self) -> None:
        """Want nothing more; what is there stays."""
        with self._news:
            self._wish = None
            self._asked += 1
            self._news.notify_all()

    def hold(self, held: bool) -> None:
        """Leave the machine to somebody else for a while. A wish that was not finished begins again afterwards."""
        with self._news:
            self._held = held
            if held and self._asked != self._done:
                self._asked += 1
            self._news.notify_all()

    def close(self) -> None:
        """End the worker; returns when it has ended, or after a few seconds."""
        with self._news:
            self._closed = True
            self._asked += 1
            self._news.notify_all()
        if self._thread.is_alive():
            self._thread.join(timeout=10.0)

    @property
    def busy(self) -> bool:
        """Whether a wish is being worked on or waits."""
        with self._news:
            return self._wish is not None and self._asked != self._done

    def _tell(self, phase: str) -> None:
        self.phase = phase
        self._told()

    def _work(self) -> None:
        coarse = coarse_asset(self._asset, self._size)
        self._warm(coarse)
        while bears_coarser(coarse) and self._slow(coarse):
            coarse = coarser(coarse)
        self.particles = len(coarse.rest)
        self._rehearse(coarse)
        while True:
            self._tell("held" if self._held else "ready")
            with self._news:
                self._news.wait_for(
                    lambda: self._closed or (not self._held and self._wish is not None and self._asked != self._done)
                )
                if self._closed:
                    return
                wish, number = self._wish, self._asked
            assert wish is not None
            self._serve(coarse, wish, number)

    def _warm(self, coarse: FluidAsset) -> None:
        """One frame of the unedited scene: kernels come from the cache, or are compiled."""
        try:
            for _ in preview_frames(preview_scene(coarse, self._folder, {}, 2), lambda: self._closed):
                pass
        except Exception as error:
            if not isinstance(error, FluidliftError):
                LOG.exception("live preview")
            self.problem = f"this asset cannot be simulated live: {error}"

    def _rehearse(self, coarse: FluidAsset) -> None:
        """Two frames each of what the scene may lack now and an edit may bring, until somebody wants something: where
        its kernels are not compiled yet, the first such edit would wait for a compiler."""
        self._tell("held" if self._held else "ready")
        for edits in rehearsals(coarse):
            if self._unwanted():
                return
            try:
                for _ in preview_frames(preview_scene(coarse, self._folder, edits, 2), self._unwanted):
                    pass
            except FluidliftError:  # what this asset does not bear is refused when it is asked for
                continue
            except Exception:  # a wish meets it as well, and tells it
                LOG.exception("getting ready for edits")

    def _unwanted(self) -> bool:
        """Whether there is more to do than to get ready."""
        return self._closed or self._held or self._wish is not None

    def _slow(self, coarse: FluidAsset) -> bool:
        """Whether this machine, as busy as it is now, takes longer for a frame than a live preview may."""
        if self._size.seconds is None or self.problem or self._closed:
            return False
        ends = []
        try:
            for frame in preview_frames(preview_scene(coarse, self._folder, {}, 1 + TIMED), lambda: self._closed):
                self._keep(frame)
                ends.append(time.perf_counter())
        except Exception:  # a wish meets it as well, and tells it
            LOG.exception("time of a live frame")
        return len(ends) > 1 and float(np.median(np.diff(ends))) > self._size.seconds

    def _serve(self, coarse: FluidAsset, wish: PreviewRequest, number: int) -> None:
        """Work on a wish until it is done, or another one is there."""

        def other() -> bool:
            return self._asked != number

        take = Take(wish)
        self._tell("preparing")
        try:
            scene = preview_scene(coarse, self._folder, wish.edits, self._size.frames)
            take.total, take.interval = scene.frames, scene.interval
            take.spacing, take.ground = scene.terrain.grid.spacing, scene.terrain.mesh
            for frame in preview_frames(scene, other):
                if other():
                    return
                take.frames.append(self._keep(frame))
                if len(take.frames) == 2 or take.total == 1:
                    self.shown, self.problem = take, ""
                self._tell("running")
            take.complete = len(take.frames) == take.total
        except (FluidliftError, ValueError, FloatingPointError, np.linalg.LinAlgError) as error:
            if not other():
                self._failed(take, error)
        except Exception as error:  # the worker lives on for the next wish
            LOG.exception("live preview")
            self._failed(take, error)
        with self._news:
            if self._asked == number:
                self._done = number

    def _failed(self, take: Take, error: Exception) -> None:
        edit = f"'{take.wish.told}'" if take.wish.told else "the last edit"
        refused = isinstance(error, InputRejected)
        if refused or len(take.frames) < 2:
            self.problem = f"After {edit} this cannot be simulated: {error} What is shown is from before."
        else:
            take.broken = f"After {edit} the simulation broke down at frame {1000 + len(take.frames) + 1}: {error}"
            self.problem = f"{take.broken} The {len(take.frames)} frames before it are shown."
