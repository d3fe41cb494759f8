"""What a job can be told: typed sections, presets, YAML files and single overrides."""

from __future__ import annotations

import dataclasses
import re
import types
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from fluidlift.errors import InputRejected


@dataclass(frozen=True)
class ReadConfig:
    """Decoding."""

    start: float = 0.0
    """s into the clip"""
    duration: float | None = None
    """s to read; None reads to the end"""
    max_size: int = 512
    """longer side of the working pictures, px"""
    fps: float = 25.0
    """frame rate of image sequences, which carry none"""
    max_pixels: int = 50_000_000
    """largest picture accepted, px"""
    max_frames: int = 600
    """most frames accepted"""
    stabilise: bool = True
    """take out mild camera shake"""


@dataclass(frozen=True)
class ShapeConfig:
    """Geometry."""

    kind: Literal["auto", "stream", "fall", "pour", "plume"] = "auto"
    """what the fluid does; auto decides from evidence"""
    fov: float | None = None
    """field of view across the longer side, degrees; None: camera file, lens metadata, else 50"""
    pitch: float | None = None
    """degrees that the camera looks below the horizon; None estimates it"""
    roll: float | None = None
    """degrees that the picture is turned clockwise; None estimates it"""
    size: float | None = None
    """m across the fluid (longest side of its box); None: camera file, free fall, or 1 m"""
    depth_ratio: float | None = None
    """greatest depth of a stream over its width; None: 0.2 (stream), 0.1 (fall)"""
    cells: int = 64
    """grid cells along the longest side"""
    cell_limit: int = 120_000
    """most grid cells"""
    stride: int = 2
    """px between front Gaussians"""
    refine_iterations: int = 30
    """steps of the single-view optimisation"""
    max_gaussians: int = 120_000
    """most rest Gaussians"""
    rays: int = 9
    """random rays of the inside test"""
    longest_union: int = 6
    """most frames united into one body"""
    rasterizer: Literal["auto", "cpu", "gsplat"] = "auto"
    """what draws while Gaussians are refined; auto takes gsplat where it runs, on an NVIDIA GPU"""


@dataclass(frozen=True)
class DepthConfig:
    """Depth from a file (`--depth`) or from a learned model."""

    model: Literal["none", "moge", "depth-anything", "depth-anything-3", "depth-pro"] = "none"
    """which model looks at the pictures; they need weights"""
    weights: str | None = None
    """file or folder (or name on the hub, where a download is allowed) of the weights of a model"""
    device: str = "cpu"
    """where a model runs: cpu, or cuda"""
    download: bool = False
    """whether weights may be fetched"""
    frames: int = 7
    """pictures that a model looks at; their median counts"""
    holds: Literal["auto", "metres", "relative", "disparity"] = "auto"
    """what a depth file holds: metres, depth up to a factor, or inverse depth up to factor and offset; auto: metres"""
    scale: float | None = None
    """m per stored unit of a depth file; None: 0.001 (millimetres) for 16-bit pictures, 1 for floats"""


@dataclass(frozen=True)
class GenerateConfig:
    """Bodies by a third-party generator (`fluidlift generators` lists them)."""

    name: str | None = None
    """of the generator; none: the embedded one, which needs nothing"""
    python: str | None = None
    """of the environment in which it is installed; none: this one"""
    code: str | None = None
    """folder of its own code, where that is a checkout"""
    weights: str | None = None
    """file or folder of its weights; none: what it takes from the hub's cache"""
    device: str = "auto"
    """cpu, cuda, or cuda:1; auto: a GPU where there is one"""
    download: bool = False
    """whether it may fetch weights"""
    accept_licence: tuple[str, ...] = ()
    """names of generators whose licence you have read and accept"""
    use: Literal["research", "commercial"] | None = None
    """what the asset is for, where a generator's terms forbid commercial use"""
    frame_seconds: float = 1800.0
    """s that one frame may take in a process of its own, the loading of the weights with the first"""
    runner: str | None = None
    """script of your own that speaks the runner protocol (docs/generators/index.md)"""


@dataclass(frozen=True)
class SegmentConfig:
    """What is fluid."""

    method: Literal["auto", "sam2", "sam3"] = "auto"
    """auto: evidence of change and motion; sam2, sam3: learned, started from that evidence; they need weights"""
    weights: str | None = None
    """folder (or name on the hub, where a download is allowed) of the weights of a learned method"""
    device: str = "cpu"
    """where a learned method runs: cpu, or cuda"""
    download: bool = False
    """whether weights may be fetched"""
    words: tuple[str, ...] = ("water",)
    """what sam3 looks for"""


@dataclass(frozen=True)
class MotionConfig:
    """Velocities."""

    method: Literal["multiframe", "dis", "farneback", "raft", "sea-raft"] = "multiframe"
    """optical flow: of what moves over several frames, of single pairs (dis, farneback), or learned (raft, sea-raft)"""
    weights: str | None = None
    """file with the weights of a learned method"""
    device: str = "cpu"
    """where a learned method runs: cpu, or cuda"""
    download: bool = False
    """whether weights may be fetched, where a package knows where from"""
    flow_channels: tuple[str, ...] = ()
    """names of the two OpenEXR channels of a flow that is given, such as R,G; none: those that are known"""
    flow_v_up: bool | None = None
    """whether v of a flow that is given points up; null: as its format has it"""
    flow_scale: float = 1.0
    """px of its own picture per stored unit of a flow that is given, such as 0.04 for px per second at 25 per second"""
    half_window: int = 1
    """frames on either side whose flow is averaged into one frame's motion"""
    reach: int = 6
    """frames on either side that are asked where the near ones fail"""
    along_paths: bool = True
    """average along the fluid's paths too; false: at fixed pixels, over half_window alone"""
    wall: Literal["cubic", "log", "film"] = "cubic"
    """how the velocity falls off towards the bed: third-order, the log law of rivers, or a laminar film"""
    divergence: Literal["paper", "exact"] = "exact"
    """form of the screen-divergence constraint"""
    targets: int = 8
    """consecutive frames whose volume velocity is computed"""
    complete_every: int = 6
    """frames between completed flow fields outside the targets"""


@dataclass(frozen=True)
class FitConfig:
    """Parameters."""

    max_work: float = 1e9
    """cells times steps of all rollouts: what it spends at most; the result is the same on a slow machine"""
    max_seconds: float = 180.0
    """s, the last resort: what the clock ends is not reproducible"""
    device: str = "cpu"
    """where the flow is rolled out: cpu, or cuda"""
    method: Literal["lm", "adam"] = "lm"
    """Levenberg-Marquardt, or Adam as in the paper"""
    free: tuple[str, ...] = ()
    """parameters to fit, such as gravity,viscosity; none: all that the clip can tell something about"""
    hold: tuple[str, ...] = ()
    """values that are known, such as viscosity=1e-6: they are taken as they are"""
    restarts: int = 0
    """further fits from other initial values, 4 at most, whose spread is reported"""


@dataclass(frozen=True)
class SimulateConfig:
    """Re-simulation."""

    frames: int | None = None
    """frames to simulate; None: as many as the clip has"""
    max_particles: int = 150_000
    """most particles"""
    device: Literal["cpu", "cuda"] = "cpu"
    """who moves the particles of a liquid: the CPU (Numba), or a GPU (NVIDIA Warp, `pip install "fluidlift[cuda]"`)"""
    checkpoint_every: int = 10
    """frames between checkpoints, from which a stopped simulation goes on"""


@dataclass(frozen=True)
class ShowConfig:
    """Pictures and files."""

    width: int = 512
    """longer side of one preview panel, px"""
    usd: bool = True
    """write asset.usda"""


@dataclass(frozen=True)
class JobConfig:
    """Everything about one job that is not its input."""

    preset: Literal["draft", "standard", "hero"] = "draft"
    seed: int = 0
    read: ReadConfig = field(default_factory=ReadConfig)
    shape: ShapeConfig = field(default_factory=ShapeConfig)
    depth: DepthConfig = field(default_factory=DepthConfig)
    segment: SegmentConfig = field(default_factory=SegmentConfig)
    generate: GenerateConfig = field(default_factory=GenerateConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    simulate: SimulateConfig = field(default_factory=SimulateConfig)
    show: ShowConfig = field(default_factory=ShowConfig)

    def section(self, name: str) -> dict[str, Any]:
        """One section as plain values."""
        return dataclasses.asdict(getattr(self, name))

    def to_dict(self) -> dict[str, Any]:
        """Plain values, nested."""
        return dataclasses.asdict(self)


PRESETS: dict[str, dict[str, dict[str, Any]]] = {
    "draft": {},
    "standard": {
        "shape": {"cells": 96, "cell_limit": 300_000, "stride": 1, "refine_iterations": 100, "max_gaussians": 250_000},
        "motion": {"targets": 12, "complete_every": 3},
        "fit": {"max_work": 4e9, "max_seconds": 900.0},
        "simulate": {"max_particles": 300_000},
    },
    "hero": {
        "read": {"max_size": 768},
        "shape": {"cells": 128, "cell_limit": 900_000, "stride": 1, "refine_iterations": 300, "max_gaussians": 600_000},
        "motion": {"targets": 16, "complete_every": 2},
        "fit": {"max_work": 2e10, "max_seconds": 3600.0},
        "simulate": {"max_particles": 900_000},
        "show": {"width": 768},
    },
}


RANGES: dict[str, tuple[float, float]] = {
    "seed": (0, 2**63 - 1),
    "read.start": (0, 1e9),
    "read.duration": (1e-6, 1e9),
    "read.max_size": (16, 16384),
    "read.fps": (1e-3, 1e5),
    "read.max_pixels": (256, 1e12),
    "read.max_frames": (2, 1e9),
    "shape.fov": (2, 165),
    "shape.pitch": (-90, 90),
    "shape.roll": (-180, 180),
    "shape.size": (1e-4, 1e5),
    "shape.depth_ratio": (0.01, 10),
    "shape.cells": (4, 2048),
    "shape.cell_limit": (500, 1e9),
    "shape.stride": (1, 64),
    "shape.refine_iterations": (0, 1e6),
    "shape.max_gaussians": (100, 1e9),
    "shape.rays": (1, 1001),
    "shape.longest_union": (1, 1000),
    "depth.frames": (1, 1000),
    "depth.scale": (1e-9, 1e9),
    "generate.frame_seconds": (0.01, 1e7),
    "motion.flow_scale": (-1e9, 1e9),
    "motion.half_window": (0, 50),
    "motion.reach": (0, 200),
    "motion.targets": (1, 1e6),
    "motion.complete_every": (1, 1e6),
    "fit.max_work": (0, 1e18),
    "fit.max_seconds": (0, 1e9),
    "fit.restarts": (0, 4),
    "simulate.frames": (1, 1e6),
    "simulate.max_particles": (100, 1e9),
    "simulate.checkpoint_every": (1, 1e6),
    "show.width": (16, 16384),
}
"""least and greatest value of each number that has a meaning: wider than what is wise"""


def build_config(
    preset: str | None = None,
    file: Path | None = None,
    overrides: typing.Sequence[str] = (),
    flat: dict[str, Any] | None = None,
    *,
    base: dict[str, Any] | None = None,
) -> JobConfig:
    """Base, preset, then file, then flat options, then `section.name=value` overrides; later ones win.

    Args:
        preset: draft, standard or hero; None: the file's, or draft.
        file: YAML with the sections of `JobConfig`.
        overrides: texts such as "fit.max_seconds=60".
        flat: values by dotted name, from command-line options; None values are left out.
        base: values by dotted name that a command starts from where others have another default.

    Raises:
        InputRejected: an unknown name or a value of the wrong type.
    """
    values: dict[str, Any] = {}
    if file is not None:
        values.update(_flatten(_read_yaml(file)))
    last: dict[str, Any] = {}
    for text in overrides:
        name, sign, value = text.partition("=")
        if not sign:
            raise InputRejected(f"override '{text}'", "section.name=value, such as fit.max_seconds=60")
        last[name.strip()] = _parse(value.strip())
    in_file = values.pop("preset", "draft")
    preset = str(last.pop("preset", preset or in_file))
    if preset not in PRESETS:
        raise InputRejected(f"unknown preset '{preset}'", "one of " + ", ".join(PRESETS))
    merged = (base or {}) | _flatten(PRESETS[preset]) | values
    merged |= {k: v for k, v in (flat or {}).items() if v is not None} | last
    config: Any = JobConfig(preset=typing.cast(Any, preset))
    for name, value in merged.items():
        config = _with(config, name.split("."), value, name)
    return config


def _read_yaml(path: Path) -> dict[str, Any]:
    import yaml

    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        reason = " ".join(str(error).split())  # YAML draws its complaint over several lines
        raise InputRejected(f"config file {path.name} cannot be read: {reason}", "a YAML file") from None
    if not isinstance(data, dict):
        raise InputRejected(f"config file {path.name} holds no sections", "read:, shape:, motion:, fit:, ...")
    return data


def _flatten(data: dict[str, Any]) -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in data.items():
        if isinstance(value, dict):
            flat |= {f"{key}.{k}": v for k, v in value.items()}
        else:
            flat[str(key)] = value
    return flat


def _parse(text: str) -> Any:
    import yaml

    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        raise InputRejected(f"the value '{text}'", "a number, a word, true, false or null") from None


def _with(config: Any, path: list[str], value: Any, name: str) -> Any:
    fields = typing.get_type_hints(type(config))
    if path[0] not in fields:
        known = ", ".join(fields)
        raise InputRejected(f"unknown option '{name}'", f"one of {known}", "see --print-config for all names")
    if len(path) > 1:
        inner = getattr(config, path[0])
        if not dataclasses.is_dataclass(inner):
            raise InputRejected(f"unknown option '{name}'", f"{path[0]} has no parts")
        return dataclasses.replace(config, **{path[0]: _with(inner, path[1:], value, name)})
    return dataclasses.replace(config, **{path[0]: _checked(value, fields[path[0]], name)})


def _checked(value: Any, kind: Any, name: str) -> Any:
    several = isinstance(kind, types.UnionType) or typing.get_origin(kind) is typing.Union  # the latter with Literal
    options = typing.get_args(kind) if several else (kind,)
    for option in options:
        if option is type(None) and value is None:
            return None
        if typing.get_origin(option) is Literal and value in typing.get_args(option):
            return value
        if option is float and _is_number(value):
            return _in_range(float(value), name)
        if typing.get_origin(option) is tuple:
            return _words(value, name)
        if option in (int, bool, str) and type(value) is option:
            return _in_range(value, name) if option is int else value
    wanted = ", ".join(
        "/".join(map(str, typing.get_args(o))) if typing.get_origin(o) is Literal else getattr(o, "__name__", str(o))
        for o in options
    )
    raise InputRejected(f"option {name} = {value!r}", f"a value of type {wanted}")


def _words(value: Any, name: str) -> tuple[str, ...]:
    """A list of words, words between commas (those in brackets stay together), or names with values."""
    if isinstance(value, dict):
        value = [f"{k}={v}" for k, v in value.items()]
    parts = re.split(r",(?![^\[(]*[\])])", value) if isinstance(value, str) else value or ()
    if not isinstance(parts, list | tuple) or not all(isinstance(p, str) for p in parts):
        raise InputRejected(f"option {name} = {value!r}", "words with commas between them, or a list of words")
    return tuple(p.strip() for p in parts if p.strip())


def _is_number(value: Any) -> bool:
    """YAML takes 1e3 for a word: it is a number here."""
    if isinstance(value, str):
        try:
            float(value)
        except ValueError:
            return False
        return True
    return isinstance(value, int | float) and not isinstance(value, bool)


def _in_range(value: Any, name: str) -> Any:
    low, high = RANGES.get(name, (float("-inf"), float("inf")))
    if not low <= value <= high:
        raise InputRejected(f"option {name} = {value:g}", f"{low:g} to {high:g}")
    return value
