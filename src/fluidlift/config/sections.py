"""Everything about one job that is not its input: typed sections with their defaults."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any, Literal

from fluidlift.types.kind import KindChoice


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
    """most frames taken; of a longer clip a part of so many stands for it"""
    stabilise: bool = True
    """take out mild camera shake"""
    crop: Literal["auto", "none"] = "auto"
    """auto: `make` cuts off black bars beside the picture (letterbox, pillarbox), where nothing but the clip is given:
    hints and files hold for the whole picture, bars and all"""


@dataclass(frozen=True)
class ShapeConfig:
    """Geometry."""

    kind: KindChoice = "auto"
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
    """most rest Gaussians; a body whose cells hold fewer than six inside gets more"""
    rays: int = 9
    """random rays of the inside test"""
    longest_union: int = 6
    """most frames united into one body"""
    rasterizer: Literal["auto", "cpu", "gsplat"] = "auto"
    """what draws while Gaussians are refined; auto takes gsplat where it runs, on an NVIDIA GPU"""


@dataclass(frozen=True)
class DepthConfig:
    """Depth from a file (`--depth`) or from a learned model."""

    model: Literal["none", "moge", "moge-onnx", "depth-anything", "depth-anything-3", "depth-pro"] = "none"
    """which model looks at the pictures; they need weights"""
    weights: str | None = None
    """file or folder (or name on the hub, where a download is allowed) of the weights of a model"""
    device: str = "cpu"
    """where a model runs: cpu, or cuda"""
    download: bool = False
    """whether weights may be fetched"""
    python: str | None = None
    """Python of the environment in which a model is installed, where it cannot be in this one; none: this one"""
    seconds: float = 600.0
    """s that one picture may take there, the loading of the weights with the first"""
    frames: int = 7
    """pictures that a model looks at; their median counts"""
    holds: Literal["auto", "metres", "relative", "disparity"] = "auto"
    """what a depth file holds: metres, depth up to a factor, or inverse depth up to factor and offset; auto: metres"""
    scale: float | None = None
    """m per stored unit of a depth file; None: 0.001 (millimetres) for 16-bit pictures, 1 for floats"""


@dataclass(frozen=True)
class ViewConfig:
    """Tilt and focal length of the camera by a learned model, as one more witness."""

    model: Literal["none", "geocalib"] = "none"
    """which model looks at the pictures; it needs weights"""
    weights: str | None = None
    """file or folder of its weights, or model:NAME of the cache"""
    device: str = "cpu"
    """where it runs: cpu, or cuda"""
    frames: int = 5
    """pictures that it looks at; their median counts, and their spread"""


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
    filling: Literal["diffusion", "sum"] = "diffusion"
    """how failed pixels take their neighbours' motion: diffusion inside the mask, or the paper's sum"""
    divergence: Literal["paper", "exact"] = "exact"
    """form of the screen-divergence constraint"""
    constraint: Literal["validated", "hard", "none"] = "validated"
    """how strictly it is met: as hidden patches of the clip bear it out, exactly (the paper), or not at all"""
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
    """where the flow is rolled out: cpu, or cuda where that is faster"""
    method: Literal["lm", "adam"] = "lm"
    """Levenberg-Marquardt, or Adam as in the paper"""
    pressure: Literal["implicit", "jacobi", "recurrent"] = "implicit"
    """way through the pressure: solved, a hundred sweeps, or the paper's recurrent convolution, fitted to this flow"""
    advection_gradient: Literal["exact", "upwind"] = "exact"
    """of advection in the analytic gradient; upwind: the paper's surrogate"""
    compare: Literal["all", "last"] = "all"
    """frames of a window that count: all, or its last alone as in the paper"""
    start_rounds: int = 2
    """times that the first frame of a window is corrected; 0: it is what the video gave, as in the paper"""
    free: tuple[str, ...] = ()
    """parameters to fit, such as gravity,viscosity, or all; none: those that the clip can tell something about"""
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
    """who simulates a liquid: the CPU (Numba), or a GPU (NVIDIA Warp, `pip install "fluidlift[cuda]"`)"""
    follow: float = 1.0
    """how far it keeps to the filmed flow where geometry does not explain it: 0 pure physics, 1 as filmed"""
    guide: float = 0.0
    """how far it is drawn to the filmed velocity of each frame besides, over and over: 0 not at all, 1 as filmed"""
    skin: bool = True
    """play the clip's film on a skin over what lies, falls or is poured; false (the paper): deformed splats alone"""
    checkpoint_every: int = 10
    """frames between checkpoints, from which a stopped simulation goes on"""


@dataclass(frozen=True)
class ShowConfig:
    """Pictures and files."""

    width: int = 512
    """longer side of one preview panel, px"""
    usd: bool = True
    """write asset.usda: terrain, camera, parameters and the first frame"""
    usd_frames: bool = False
    """all frames in it, which takes as much disk again as they do; fluidlift export --to usd writes them when needed"""
    preview: bool = True
    """write preview.mp4; of minutes of simulation it takes as long as they do"""


@dataclass(frozen=True)
class JobConfig:
    """Everything about one job that is not its input."""

    preset: Literal["draft", "standard", "hero", "paper"] = "draft"
    seed: int = 0
    read: ReadConfig = field(default_factory=ReadConfig)
    shape: ShapeConfig = field(default_factory=ShapeConfig)
    depth: DepthConfig = field(default_factory=DepthConfig)
    view: ViewConfig = field(default_factory=ViewConfig)
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
