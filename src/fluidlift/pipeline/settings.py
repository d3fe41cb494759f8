"""What each stage is told: the settings that it reads, and no others, so that none can be forgotten in its key.

A stage gets one of these in place of the job's settings. What does not change its result (a device, a limit that guards
the reading) is marked `BESIDE` and stays out of the key.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field, fields
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, TypeVar

from fluidlift.backends.registry import module_name, names
from fluidlift.config import JobConfig
from fluidlift.pipeline.inputs import BESIDE, GivenFile, GivenFiles, Weights
from fluidlift.source import source_hash
from fluidlift.types.hints import DrawnView

T = TypeVar("T")


def taken(kind: type[T], section: Any, **more: Any) -> T:
    """The settings of a stage from those of a section with the same names; `more` are given or replace them."""
    names = [f.name for f in fields(kind) if f.name not in more]  # type: ignore[arg-type]
    return kind(**{n: getattr(section, n) for n in names}, **more)


def _source_of(purpose: str, name: str) -> str:
    """Hash of the source of a back end; empty where the name is none."""
    return source_hash(module_name(purpose, name)) if name in names(purpose) else ""


@dataclass(frozen=True)
class ReadSettings:
    """Decoding."""

    start: float
    duration: float | None
    max_size: int
    fps: float
    stabilise: bool
    crop: str
    poses: bool
    """whether the path of a camera that goes somewhere can be found: with the extra installed, it is read anew"""
    max_pixels: int = field(metadata=BESIDE)
    max_frames: int = field(metadata=BESIDE)

    @classmethod
    def of(cls, config: JobConfig) -> ReadSettings:
        """From those of a job."""
        return taken(cls, config.read, poses=find_spec("pycolmap") is not None)


@dataclass(frozen=True)
class FlowSettings:
    """Who estimates the flow."""

    method: str
    weights: Weights | None
    source: str
    """hash of the source of a learned one, which is chosen by name; empty of our own"""
    device: str = field(metadata=BESIDE)
    download: bool = field(metadata=BESIDE)

    @classmethod
    def of(cls, config: JobConfig) -> FlowSettings:
        """From those of a job."""
        m = config.motion
        return taken(cls, m, weights=Weights.of(m.weights), source=_source_of("flow method", m.method))


@dataclass(frozen=True)
class GivenFlow:
    """The user's own flow, and what its numbers mean."""

    files: GivenFile
    clip: GivenFile
    camera: GivenFile | None
    start: float
    """s into the clip"""
    fps: float
    """of image sequences"""
    flow_channels: tuple[str, ...]
    flow_v_up: bool | None
    flow_scale: float

    @classmethod
    def of(cls, given: GivenFiles, config: JobConfig) -> GivenFlow | None:
        """Where there is one."""
        if given.flow is None:
            return None
        m, r = config.motion, config.read
        return cls(given.flow, given.clip, given.camera, r.start, r.fps, m.flow_channels, m.flow_v_up, m.flow_scale)


@dataclass(frozen=True)
class GivenMask:
    """The user's own mask, and which stretch of the clip it belongs to."""

    file: GivenFile
    camera: GivenFile | None
    start: float
    duration: float | None

    @classmethod
    def of(cls, given: GivenFiles, config: JobConfig) -> GivenMask | None:
        """Where there is one."""
        if given.mask is None:
            return None
        return cls(given.mask, given.camera, config.read.start, config.read.duration)


@dataclass(frozen=True)
class SegmentSettings:
    """Who finds the fluid."""

    method: str
    weights: Weights | None
    words: tuple[str, ...]
    source: str
    """hash of the source of a learned one, which is chosen by name; empty of our own"""
    device: str = field(metadata=BESIDE)
    download: bool = field(metadata=BESIDE)

    @classmethod
    def of(cls, config: JobConfig) -> SegmentSettings:
        """From those of a job."""
        s = config.segment
        return taken(cls, s, weights=Weights.of(s.weights), source=_source_of("mask method", s.method))


@dataclass(frozen=True)
class LookSettings:
    """What the stages that look at the clip are told."""

    read: ReadSettings
    flow: FlowSettings | GivenFlow
    mask: GivenMask | None
    segment: SegmentSettings

    @classmethod
    def of(cls, given: GivenFiles, config: JobConfig) -> LookSettings:
        """Of a job.

        Raises:
            InputRejected: weights that are not there.
        """
        flow = GivenFlow.of(given, config) or FlowSettings.of(config)
        return cls(ReadSettings.of(config), flow, GivenMask.of(given, config), SegmentSettings.of(config))


@dataclass(frozen=True)
class GivenDepth:
    """The user's depth file, and what its numbers mean."""

    file: GivenFile
    holds: Literal["auto", "metres", "relative", "disparity"]
    scale: float | None
    frames: int

    @classmethod
    def of(cls, given: GivenFiles, config: JobConfig) -> GivenDepth | None:
        """Where there is one that counts: a body that is given has its own depth."""
        if given.depth is None or given.geometry is not None:
            return None
        return taken(cls, config.depth, file=given.depth)


@dataclass(frozen=True)
class DepthModelSettings:
    """A learned model of depth."""

    model: str
    weights: Weights | None
    source: str
    """hash of the source of the model, which is chosen by name"""
    frames: int
    python: Path | None = field(metadata=BESIDE)
    seconds: float = field(metadata=BESIDE)
    device: str = field(metadata=BESIDE)
    download: bool = field(metadata=BESIDE)

    @classmethod
    def of(cls, given: GivenFiles, config: JobConfig) -> DepthModelSettings | None:
        """Where one is to look at the pictures: nothing better was given."""
        if config.depth.model == "none" or given.depth is not None or given.geometry is not None:
            return None
        d = config.depth
        python = None if d.python is None else Path(os.path.expanduser(d.python))
        source = _source_of("depth model", d.model)
        return taken(cls, d, weights=Weights.of(d.weights), source=source, python=python)


@dataclass(frozen=True)
class ViewModelSettings:
    """A learned model of the camera's tilt and focal length."""

    model: str
    weights: Weights | None
    source: str
    """hash of the source of the model, which is chosen by name"""
    frames: int
    device: str = field(metadata=BESIDE)

    @classmethod
    def of(cls, config: JobConfig) -> ViewModelSettings | None:
        """Where one is to look at the pictures."""
        v = config.view
        if v.model == "none":
            return None
        return taken(cls, v, weights=Weights.of(v.weights), source=_source_of("view model", v.model))


@dataclass(frozen=True)
class GivenView:
    """What a person has of the camera, the body and the depth."""

    clip: GivenFile
    """its file may tell of the lens"""
    camera: GivenFile | None = None
    bodies: GivenFile | None = None
    """folder of Gaussian PLY files, the user's or a generator's"""
    depth: GivenDepth | None = None
    model: DepthModelSettings | None = None
    view: ViewModelSettings | None = None

    @classmethod
    def of(cls, given: GivenFiles, config: JobConfig) -> GivenView:
        """Of a job."""
        return cls(
            given.clip, given.camera, given.geometry, GivenDepth.of(given, config),
            DepthModelSettings.of(given, config), ViewModelSettings.of(config),
        )  # fmt: skip


@dataclass(frozen=True)
class GenerateSettings:
    """Which third-party generator makes bodies. Where it is installed does not change them."""

    name: str
    weights: Weights | None
    runner: Weights | None
    """a script of the user's own, by its content"""
    source: str
    """hash of the source that talks to it, which is chosen by name"""
    seed: int
    longest_union: int
    fov: float | None
    python: Path | None = field(metadata=BESIDE)
    code: Path | None = field(metadata=BESIDE)
    device: str = field(metadata=BESIDE)
    download: bool = field(metadata=BESIDE)
    frame_seconds: float = field(metadata=BESIDE)

    @classmethod
    def of(cls, config: JobConfig) -> GenerateSettings:
        """From those of a job; needs `generate.name`."""
        from fluidlift.backends.generators import require_known

        def path(text: str | None) -> Path | None:
            return None if text is None else Path(os.path.expanduser(text))

        c, s, name = config.generate, config.shape, require_known(str(config.generate.name))
        source = source_hash(module_name("generator", name))
        return taken(
            cls, c, name=name, source=source, weights=Weights.of(c.weights), runner=Weights.of(c.runner),
            seed=config.seed, longest_union=s.longest_union, fov=s.fov, python=path(c.python), code=path(c.code),
        )  # fmt: skip


@dataclass(frozen=True)
class GeometrySettings:
    """Kind, camera, size and cells."""

    kind: str
    fov: float | None
    pitch: float | None
    roll: float | None
    size: float | None
    depth_ratio: float | None
    cells: int
    cell_limit: int
    longest_union: int
    drawn: DrawnView | None = None
    """horizon, ruler, rims and sky of a hints file, in px of the working picture"""


@dataclass(frozen=True)
class RefineSettings:
    """The Gaussians of the body."""

    stride: int
    refine_iterations: int
    max_gaussians: int
    rays: int
    rasterizer: str
    seed: int


@dataclass(frozen=True)
class MotionSettings:
    """From flow to velocities."""

    half_window: int
    reach: int
    along_paths: bool
    wall: str
    filling: str
    divergence: str
    constraint: str
    targets: int
    complete_every: int
    every_frame: bool
    """whether the volume velocity of all frames is wanted, to guide a simulation"""
    of_whole: bool
    """whether the volume velocity of the mean motion is wanted, for the force that keeps it"""

    @classmethod
    def of(cls, config: JobConfig, *, simulated: bool = False) -> MotionSettings:
        """From those of a job; `simulated` asks for the velocities that a simulation needs, where it wants them."""
        wanted = config.simulate
        return taken(
            cls, config.motion, every_frame=simulated and wanted.guide > 0, of_whole=simulated and wanted.follow > 0
        )


@dataclass(frozen=True)
class SimulateSettings:
    """The re-simulation, beside what its scene says."""

    max_particles: int
    device: str = field(metadata=BESIDE)
    checkpoint_every: int = field(metadata=BESIDE)


@dataclass(frozen=True)
class ShowSettings:
    """Pictures and files."""

    width: int
    usd: bool
    usd_frames: bool
    preview: bool
