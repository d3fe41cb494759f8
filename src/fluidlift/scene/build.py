"""What is simulated: an asset's body in its terrain, with what a person changed."""

from __future__ import annotations

import hashlib
import math
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fluidlift import __version__
from fluidlift.config import JobConfig
from fluidlift.errors import InputRejected
from fluidlift.look.appearance import SteadyShading
from fluidlift.machine import available_memory
from fluidlift.messages import Notice
from fluidlift.physics.inflow_schedule import InflowSchedule
from fluidlift.scene.footage import Footage
from fluidlift.scene.force_weight import following
from fluidlift.scene.reshaping import changed_parameters, with_emitters, with_terrain
from fluidlift.types import (
    FaceVelocity,
    Filmed,
    FilmedMotion,
    FluidAsset,
    FluidParameters,
    Gaussians,
    Particles,
    PinholeCamera,
    Terrain,
    kind_of,
)

if TYPE_CHECKING:
    from fluidlift.io.obstacles import Obstacle
    from fluidlift.io.scene import SceneEdits
    from fluidlift.physics.emitter import Emitter

LOOP_FADE = (0.8, 1.5)
"""s: a shorter fade changes too much of the fluid in each frame, a longer one makes the clip one long fade"""

FOAMS_UP_TO = 1e-3
"""m^2/s: a thousand times water's, with the room that a fit leaves; chocolate, honey and lava are thicker, and the air
that they trap does not come out of them as foam"""


@dataclass(frozen=True)
class SimulationRequest:
    """What one run of a simulation is asked for, beside settings and scene.yaml."""

    duration: float | None = None
    """s; None: as scene.yaml, the settings or the clip say"""
    fps: float | None = None
    """frames per second; None: those of the clip"""
    extend_downstream: float | None = None
    """m by which the channel goes on; None: as scene.yaml says"""
    meshes: Path | None = None
    """folder of the obstacles' mesh files; None: the asset"""
    resume: bool = False
    """go on from the checkpoint, or say why not"""
    restart: bool = False
    """begin again, although a checkpoint fits"""


@dataclass(frozen=True)
class SceneSettings:
    """What a scene takes from the job, beside its asset and its edits."""

    frames: int | None
    follow: float
    guide: float
    seed: int
    skin: bool = True
    """whether the surface plays the clip's film"""

    @classmethod
    def of(cls, config: JobConfig) -> SceneSettings:
        """From those of a job."""
        c = config.simulate
        return cls(c.frames, c.follow, c.guide, config.seed, c.skin)


@dataclass(frozen=True)
class Scene:
    """A simulation at its first instant."""

    kind: str
    """name of a `FluidKind` (`kind_of`)"""
    rest: Gaussians
    """world, m"""
    body: Particles
    """at the first instant; `source` indexes `rest`"""
    terrain: Terrain
    cell_types: np.ndarray
    """u8 [nx,ny,nz]"""
    velocity: FaceVelocity
    """at the first instant, m/s"""
    parameters: FluidParameters
    """fitted, with what scene.yaml changes; `time_step` and `wall_damping` are those of the fit"""
    camera: PinholeCamera
    interval: float
    """s between frames"""
    clip_interval: float
    """s between frames of the clip"""
    frames: int
    """to show, the first (at rest) counted"""
    seed: int
    obstacles: tuple[Obstacle, ...] = ()
    shading: SteadyShading | None = None
    """what of the look stays in place; None: nothing"""
    extended: float = 0.0
    """m"""
    longest_step: float | None = None
    """s, of the simulator, where scene.yaml gives a `time_step`"""
    inflow: InflowSchedule = field(default_factory=InflowSchedule)
    emitters: tuple[Emitter, ...] = ()
    emitter_looks: tuple[np.ndarray, ...] = ()
    """indices into `rest` of the Gaussians that each emitter's particles take their look from"""
    painted: np.ndarray | None = None
    """[n,3] m: where the colours of `rest` were taken, not a number where no shade changes them; None: its means"""
    reshaped: bool = False
    """whether scene.yaml edits the terrain: the clip's picture no longer shows it"""
    changes: tuple[str, ...] = ()
    """parameters that scene.yaml changes, in words"""
    notes: tuple[Notice, ...] = ()
    """what was done to what scene.yaml gives, for whom it concerns"""
    overlap: int = 0
    """frames simulated beyond `frames`, that a loop is closed with"""
    film: Path | None = None
    """of the fluid, which its surface plays; None, or a file that cannot be played: it looks as it did at rest"""
    film_start: int = 0
    """frame of the film that the body at rest shows"""
    skin: bool = True
    """whether the film, or what was seen at rest, lies on a skin over the particles; else they alone are shown"""
    force: FaceVelocity | None = None
    """m/s^2 on the faces of the terrain's grid, beside gravity"""
    dry: np.ndarray | None = None
    """bool [nx,ny,nz]: cells that the clip shows dry throughout, from which fluid is taken out"""
    dry_for: float = math.inf
    """s for which it is"""
    wet: np.ndarray | None = None
    """bool [nx,ny,nz]: cells that the clip shows wet throughout, which are filled where they run dry"""
    inlet: np.ndarray | None = None
    """[T,3], m that the inlet stands beside its place at rest in each frame of the film; None: it stays"""
    guide: FilmedMotion | None = None
    """on the faces of the terrain's grid, towards which the flow is drawn; None: it runs free"""
    guide_rates: tuple[np.ndarray, ...] = ()
    """1/s, how fast, on the faces of each component"""
    whitewater: float = 0.0
    """times as much white water as the clip shows; 0: none is simulated"""
    whitewater_everywhere: bool = False
    """also where the clip shows it"""
    as_lifted: Scene | None = None
    """the same without edits, by which white water is measured; None where there is none"""

    @property
    def simulated(self) -> int:
        """Frames to simulate."""
        return self.frames + self.overlap

    @property
    def edited(self) -> bool:
        """Whether a person changed how the fluid flows."""
        moved = self.inflow != InflowSchedule() or self.extended > 0
        return bool(self.obstacles or self.emitters or self.changes or self.reshaped or moved)

    @property
    def outline_goes_on(self) -> bool:
        """Whether an outline that grew in the clip goes on to after it: not where what is dry is so for good."""
        return self.dry is None or math.isfinite(self.dry_for)

    @cached_property
    def parts(self) -> dict[str, str]:
        """A hash of each part that decides how the simulation goes: two scenes with the same ones go the same way."""
        t, v = self.terrain, self.velocity
        found = {
            "version": _hash(__version__),
            "kind": _hash(self.kind),
            "grid": _hash(t.grid),
            "terrain": _hash(t.signed_distance, t.mainstream, self.cell_types),
            "velocity": _hash(*v.components),
            "body": _hash(self.body.positions, self.body.velocities, self.body.source, self.rest.means),
            "look": _hash(self.rest.quats, self.rest.scales, self.rest.opacities, self.rest.sh,
                          b"" if self.shading is None else self.shading.image,
                          b"" if self.film is None else self.film, self.film_start),
            "parameters": _hash(self.parameters, self.longest_step),
            "frame interval": _hash(self.interval),
            "seed": _hash(self.seed),
        }  # fmt: skip
        if self.obstacles:
            found["obstacles"] = _hash(*(x for o in self.obstacles for x in o.plain()))
        if self.emitters:
            found["emitters"] = _hash(*(x for e in self.emitters for x in e.plain()))
        if self.inflow != InflowSchedule():
            found["inflow"] = _hash(self.inflow)
        if self.force is not None:
            found["force"] = _hash(*self.force.components)
        if self.guide is not None:
            found["guide"] = _hash(*self.guide.components, self.guide.interval, self.guide.start, *self.guide_rates)
        if self.dry is not None:
            found["dry cells"] = _hash(self.dry, *[self.dry_for] * math.isfinite(self.dry_for))
        if self.wet is not None:
            found["wet cells"] = _hash(self.wet)
        if self.inlet is not None:
            found["inlet"] = _hash(self.inlet)
        if self.whitewater > 0:
            found["white water"] = _hash(self.whitewater, *["everywhere"] * self.whitewater_everywhere)
        if not self.skin:
            found["skin"] = _hash(self.skin)
        if self.overlap:
            found["loop"] = _hash(self.frames, self.overlap)
        return found

    @property
    def cache_key(self) -> list[Any]:
        """What the keys of stages know of it: how it goes, and how long and from where it is seen."""
        return [self.parts, self.frames, self.clip_interval, self.camera.to_dict()]


def _hash(*values: Any) -> str:
    """SHA-256 of arrays (with shape and type), of the content of files, and of the text of anything else."""
    digest = hashlib.sha256()
    for value in values:
        if isinstance(value, np.ndarray):
            digest.update(f"{value.dtype.str}{value.shape}".encode())
            digest.update(np.ascontiguousarray(value).tobytes())
        elif isinstance(value, Path):
            _update(digest, value)
        else:
            digest.update(value if isinstance(value, bytes) else repr(value).encode())
        digest.update(b"\0")
    return digest.hexdigest()


def _update(digest: hashlib._Hash, file: Path) -> None:
    """Add a file to a hash, piece by piece; one that is gone or may not be read adds nothing."""
    with suppress(OSError), file.open("rb") as stream:
        while piece := stream.read(2**20):
            digest.update(piece)


def scene_of(
    asset: FluidAsset,
    folder: Path,
    request: SimulationRequest,
    config: JobConfig,
    *,
    footage: Footage | None,
    start: int,
    edits: SceneEdits | None = None,
) -> Scene:
    """The scene that an asset, its scene.yaml and a request describe: `edited_scene` with what lies in the folder.

    Args:
        asset: as `load_asset` gives it.
        folder: of the asset.
        request: of this run.
        config: seed, and frames where neither request nor scene.yaml say.
        footage: the clip, where it is at hand.
        start: frame of the clip that the first simulated one shows.
        edits: the folder's scene.yaml, where it was read already.

    Raises:
        InputRejected: a scene.yaml or a request that does not fit, or a damaged file.
    """
    from fluidlift.io.force_file import read_filmed
    from fluidlift.io.scene import read_edits

    edits = read_edits(folder, meshes=request.meshes) if edits is None else edits
    # edits that are tried out lie elsewhere than their asset
    home = folder if request.meshes is None or (folder / "manifest.json").is_file() else request.meshes
    settings = SceneSettings.of(config)
    filmed = read_filmed(home, motion=settings.guide > 0) if max(settings.follow, settings.guide) > 0 else None
    return edited_scene(
        asset, edits, request, settings, footage=footage, start=start, film=film_of(home), filmed=filmed
    )


def edited_scene(
    asset: FluidAsset,
    edits: SceneEdits,
    request: SimulationRequest | None = None,
    settings: SceneSettings | None = None,
    *,
    footage: Footage | None = None,
    start: int = 0,
    film: Path | None = None,
    filmed: Filmed | None = None,
) -> Scene:
    """The scene that an asset, edits of it and a request describe. No file is looked at.

    The channel is made longer first, then its terrain is edited, then emitters are put into it: each in the world as
    the one before left it.

    Args:
        asset: at rest.
        edits: what scene.yaml says; `SceneEdits()` says nothing.
        request: of this run.
        settings: seed, and frames where neither request nor edits say; None: as by default.
        footage: the clip, where it is at hand.
        start: frame of the clip that the first simulated one shows.
        film: that the fluid's surface plays.
        filmed: what keeps the filmed flow; None: nothing does.

    Raises:
        InputRejected: edits or a request that do not fit.
    """
    from fluidlift.io.scene import SceneEdits
    from fluidlift.numerics.sampling import sample_faces

    request, settings = request or SimulationRequest(), settings or SceneSettings.of(JobConfig())
    interval = asset.interval if request.fps is None else 1.0 / request.fps
    duration = edits.duration if request.duration is None else request.duration
    clip_frames = max(1, round((asset.frame_count - start) * asset.interval / interval))
    wanted = None if duration is None else max(2, round(duration / interval))
    rest, grid, velocity = asset.rest, asset.grid, beyond_surface(asset)
    body = Particles.at_rest(rest.means, 1.0, np.arange(len(rest)), sample_faces(velocity, grid, rest.means))
    shading = None
    # bodies in the air change their outline: nothing is steady
    if footage is not None and kind_of(asset.kind).lies_on_ground:
        shading = SteadyShading.of(footage.clip.frames, footage.labels.fluid, asset.camera)
    changes = dict(edits.parameters)
    longest_step = changes.pop("time_step", None)
    scene = Scene(
        asset.kind, rest, body, asset.terrain, asset.cell_types, velocity,
        asset.parameters.updated(changes), asset.camera, interval, asset.interval,
        wanted or settings.frames or clip_frames, settings.seed, edits.obstacles, shading,
        longest_step=longest_step, inflow=edits.inflow, changes=changed_parameters(asset.parameters, changes),
        film=film, film_start=start - first_of_film(start, asset.frame_count), skin=settings.skin,
    )  # fmt: skip
    longer = edits.extend_downstream if request.extend_downstream is None else request.extend_downstream
    if longer > 0:
        scene = extended(scene, longer)
    scene = with_emitters(with_terrain(scene, edits.terrain), edits.emitters)
    scene = following(scene, asset, filmed or Filmed(), settings)
    amount = whitewater_amount(scene, edits.whitewater)
    if amount > 0:
        plain = SimulationRequest(fps=request.fps)
        lifted = edited_scene(
            asset, SceneEdits(), plain, settings, footage=footage, start=start, film=film, filmed=filmed
        )  # fmt: skip
        scene = replace(scene, whitewater=amount, as_lifted=lifted, whitewater_everywhere=edits.whitewater_everywhere)
    return replace(scene, overlap=loop_overlap(scene)) if edits.loop else scene


def whitewater_amount(scene: Scene, asked: float) -> float:
    """How much white water a scene is simulated with, times what its clip shows: as much as is asked for.

    Args:
        scene: with all of its edits.
        asked: what scene.yaml says.

    Raises:
        InputRejected: it is asked of smoke, or of what is too thick to foam.
    """
    thick = scene.parameters.kinematic_viscosity > FOAMS_UP_TO
    if asked > 0 and (thick or kind_of(scene.kind).is_gas):
        what = "a gas, which has no surface" if kind_of(scene.kind).is_gas else (
            f"a liquid of {scene.parameters.kinematic_viscosity:.2g} m^2/s"
        )  # fmt: skip
        raise InputRejected(
            f"whitewater.amount {asked:g} of {what}", f"a liquid of at most {FOAMS_UP_TO:g} m^2/s",
            "set whitewater.amount to 0, or leave it out",
        )  # fmt: skip
    return asked


def film_of(folder: Path) -> Path | None:
    """The film of the fluid that the manifest of an asset lists, though it may be gone; None where it lists none.

    Raises:
        InputRejected: a broken manifest, or a film that is a link or lies elsewhere.
    """
    from fluidlift.io.asset_folder import read_manifest
    from fluidlift.io.asset_paths import asset_file

    if not (folder / "manifest.json").is_file():  # not finished yet
        return None
    name = read_manifest(folder)["files"].get("film")
    return None if name is None else asset_file(folder, name)


def first_of_film(start: int, frames: int) -> int:
    """Frame of the clip that the film begins with, of a clip of some frames whose body at rest is that of `start`."""
    from fluidlift.io.footage_file import MOST_FRAMES

    return min(start, max(frames - MOST_FRAMES, 0))


def beyond_surface(asset: FluidAsset) -> FaceVelocity:
    """The velocity at the first instant, continued from the liquid into air and walls, where it is stored as 0.

    The body's surface lies inside a layer of cells: what is there would take up to half of its speed from the air, and
    a stream of five cells would lose a fifth of its momentum before it moves. The air around smoke has its own.
    """
    from fluidlift.physics.boundaries import continued

    return asset.velocity if kind_of(asset.kind).is_gas else continued(asset.velocity, asset.cell_types)


def extended(scene: Scene, length: float) -> Scene:
    """The same river, `length` metres longer downstream.

    Raises:
        InputRejected: a fluid that lies on nothing, that does not leave its box, or a length that memory cannot hold.
    """
    from fluidlift.physics.channel_extension import (
        extended_body,
        extended_downstream,
        extended_grid,
        extended_velocity,
        find_outlet,
    )
    from fluidlift.physics.preflight import check_memory

    if not kind_of(scene.kind).is_channel_flow:
        raise InputRejected(
            f"a {scene.kind} cannot be extended downstream", "a stream or a fall", "leave out --extend-downstream"
        )
    channel = (scene.terrain, scene.cell_types)
    outlet = find_outlet(*channel)
    check_memory(extended_grid(outlet, length), len(scene.body), available_memory())
    longer = extended_downstream(*channel, length)
    return replace(
        scene,
        terrain=longer[0],
        cell_types=longer[1],
        body=extended_body(scene.body, scene.velocity, channel, longer, seed=scene.seed),
        velocity=extended_velocity(scene.velocity, outlet, longer[0].grid),
        extended=length,
    )


def loop_overlap(scene: Scene) -> int:
    """Frames over which a loop's end fades into its beginning.

    A quarter of the time that the fluid takes to pass, within `LOOP_FADE`, and not more than half of the clip.

    Raises:
        InputRejected: fewer than four frames.
    """
    if scene.frames < 4:
        raise InputRejected(f"a loop of {scene.frames} frames", "4 frames or more", "give a longer duration")
    along = scene.body.positions @ np.asarray(scene.terrain.mainstream, np.float32)
    length = float(np.ptp(np.percentile(along, [5, 95]))) if len(along) else 0.0
    speed = float(np.linalg.norm(scene.body.velocities, axis=1).mean()) if len(along) else 0.0
    speed = max(speed, float(np.linalg.norm(scene.parameters.inflow_velocity)), 1e-6)
    fade = float(np.clip(0.25 * length / speed, *LOOP_FADE))
    return int(np.clip(round(fade / scene.interval), 2, scene.frames // 2))
