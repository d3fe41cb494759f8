"""What the stages leave: one frozen value per stage, which checks itself.

A stage is a function from such values to the next one. Between runs they lie in the cache (`io.stage_codec`). The
`warnings` of each are what the user should know of it, said again whenever the value is used.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from fluidlift.errors import require
from fluidlift.messages import Notice
from fluidlift.types.camera import PinholeCamera
from fluidlift.types.camera_path import MeasuredView
from fluidlift.types.clip import PixelLabels, VideoClip
from fluidlift.types.evidence import BedEvidence, KindEvidence, MetricScale, SlopeEvidence, UpEvidence
from fluidlift.types.filmed import FilmedMotion
from fluidlift.types.flow import PixelFlow, SaidFlow
from fluidlift.types.gaussians import Gaussians
from fluidlift.types.grid import FaceVelocity, Grid
from fluidlift.types.parameters import Estimate, FluidParameters
from fluidlift.types.terrain import Setting
from fluidlift.types.transforms import Similarity3


@dataclass(frozen=True)
class Window:
    """Which part of a long clip stands for it."""

    start: float
    """s into the clip"""
    duration: float
    """s"""
    elsewhere: tuple[tuple[float, float], ...] = ()
    """s into the clip and s: short parts at other times whose motion may count as well"""
    warnings: tuple[Notice, ...] = ()

    def __post_init__(self) -> None:
        for start, duration in ((self.start, self.duration), *self.elsewhere):
            require(start >= 0 and duration > 0, f"a window of {duration} s at {start} s")


@dataclass(frozen=True)
class Read:
    """The clip as it is worked on: without lens distortion, repeated frames, shake and cuts."""

    clip: VideoClip
    kept: Int[np.ndarray, " t"]
    """number of each of its frames among those that were decoded"""
    decoded: int
    """frames of the file"""
    shake_px: float
    """px per frame that the camera shook"""
    stabilised: bool
    """whether the shake was taken out"""
    cuts: tuple[int, ...] = ()
    """frames before which a cut was found"""
    warnings: tuple[Notice, ...] = ()
    path: Float[np.ndarray, "t 2"] | None = None
    """px from the middle of the steady picture: where the middle of each frame lay, as the camera moved; None: it was
    not looked for"""
    view: MeasuredView | None = None
    """how the camera stood over the water, where it went somewhere and its path tells that"""
    fluid_evidence: Float[np.ndarray, "h w"] | None = None
    """log odds of fluid of the whole picture, at a size of its own, where the camera's path tells what stands"""
    unseen: Bool[np.ndarray, "t a b"] | None = None
    """cells of the picture that each frame did not see itself, where the shake was taken out
    (`motion.full_frame.UnseenEdges`)"""

    def __post_init__(self) -> None:
        require(self.path is None or len(self.path) == len(self.clip), "a path of other frames")
        require(len(self.kept) == len(self.clip), f"{len(self.kept)} numbers for {len(self.clip)} frames")
        require(self.decoded >= len(self.kept), f"{len(self.kept)} of {self.decoded} frames kept")

    @property
    def dropped(self) -> list[int]:
        """Numbers of the decoded frames that were left out."""
        return np.setdiff1d(np.arange(self.decoded), self.kept).tolist()

    @property
    def moved_px(self) -> float:
        """Largest distance between two places that the camera looked at, px; 0 where that is not known."""
        if self.path is None or not len(self.path):
            return 0.0
        return float(
            np.linalg.norm(self.path[:, None] - self.path[None, :: max(1, len(self.path) // 100)], axis=-1).max()
        )


@dataclass(frozen=True)
class Flow:
    """Optical flow of every pair of neighbouring frames."""

    flow: PixelFlow
    """px, float16, mapped from disk"""
    method: str
    """that estimated it, or `GIVEN`"""
    trusted_as_given: bool = False
    """it came from a file without confidence, and is trusted everywhere"""
    warnings: tuple[Notice, ...] = ()


GIVEN = "given"
"""`Flow.method` of the user's own"""


@dataclass(frozen=True)
class Segmentation:
    """What each pixel shows."""

    labels: PixelLabels
    fluid_share: float
    """of the picture, 0 to 1"""
    confidence_mean: float
    """on what was taken for fluid"""
    flow_trusted: float
    """share of the fluid on which optical flow is trusted"""
    user_mask: bool
    """whether the user gave it"""
    warnings: tuple[Notice, ...] = ()
    likely_overlap: float | None = None
    """intersection over union with what is fluid, as the labels' confidence has it, 0 to 1; None: not known, or a
    person drew all of it"""
    whole: UInt8[np.ndarray, "t h w 3"] | None = None
    """frames of a steadied clip whose fluid goes on where they do not see it (`motion.full_frame`); None: the clip's"""


@dataclass(frozen=True)
class Bodies:
    """Which frames a third-party generator has made bodies of; they lie in files of their own."""

    name: str
    """of the generator"""
    frames: tuple[int, ...]
    warnings: tuple[Notice, ...] = ()


@dataclass(frozen=True)
class DepthGuess:
    """What a learned model says of some pictures' depth."""

    values: Float[np.ndarray, "k h w"]
    holds: str
    """metres, relative or disparity"""
    field_of_view: float | None
    """degrees across the longer side, where the model says it"""
    normals: Float[np.ndarray, "k h w 3"] | None = None
    """unit normals in camera axes, where the model gives them; nan elsewhere"""


@dataclass(frozen=True)
class ViewGuesses:
    """What a learned model says of the camera of some pictures: those of which it says something."""

    model: str
    pitch: Float[np.ndarray, " k"]
    """degrees below the horizon"""
    roll: Float[np.ndarray, " k"]
    """degrees that the picture is turned clockwise"""
    focal: Float[np.ndarray, " k"]
    """px of the picture"""
    errors: Float[np.ndarray, "k 3"]
    """standard errors: pitch and roll, degrees, and focal length, relative (0 where it was told)"""
    pitch_by_focal: Float[np.ndarray, " k"]
    """degrees that the pitch rises by with the logarithm of the focal length"""


@dataclass(frozen=True)
class Geometry:
    """Kind, camera, front surface, scale and terrain of the body at rest."""

    kind: str
    """stream, fall, pour, plume, dam, basin or fountain"""
    kind_source: str
    """evidence, or user"""
    kind_evidence: KindEvidence
    up: UpEvidence
    scale: MetricScale
    scale_sentence: str
    """the scale in words, with what was assumed"""
    camera: PinholeCamera
    """of the clip, in the world"""
    world_from_canonical: Similarity3
    setting: Setting
    """terrain and cells, float32; the ground in the colours of the plate"""
    mask: Bool[np.ndarray, "h w"]
    """fluid of the united frames"""
    depth: Float[np.ndarray, "h w"]
    """m from the camera to the visible surface; 0 where there is none"""
    half_thickness: Float[np.ndarray, "h w"]
    """m"""
    sighted_depth: Float[np.ndarray, "h w"]
    """m, of what the camera sees, a thin sheet before the body, too"""
    mean_flow: Float[np.ndarray, "h w 2"]
    """px per frame, mean over the clip"""
    mean_confidence: Float[np.ndarray, "h w"]
    plate: UInt8[np.ndarray, "h w 3"]
    """sRGB, the picture without the fluid"""
    rest_frame: int
    """frame of the clip that the body shows"""
    united_frames: int
    """frames from there on that become one body"""
    rocks: Bool[np.ndarray, "h w"] | None = None
    """pixels in which something solid stands in a dam's fluid; None: the labels say it"""
    hidden: Bool[np.ndarray, "h w"] | None = None
    """pixels in which something stands before the fluid, which goes on behind it; None: nothing does"""
    known_scale: float | None = None
    """m per canonical unit, where depth came in metres"""
    depth_source: dict[str, Any] | None = None
    """what is known of the depth that was given, for the report"""
    jets: tuple[dict[str, Any], ...] = ()
    """jets above what lies, in the world, m"""
    slope: SlopeEvidence | None = None
    said_flow: SaidFlow | None = None
    """what a person says of the direction of the flow; `mean_flow` holds it"""
    bed: BedEvidence | None = None
    """of a stream's bed; None: it is not seen through the water"""
    warnings: tuple[Notice, ...] = ()

    def __post_init__(self) -> None:
        shape = self.mask.shape
        for name in ("depth", "half_thickness", "sighted_depth", "mean_confidence"):
            found = getattr(self, name).shape
            require(found == shape, f"{name} {found}", f"the mask's {shape}")
        require(self.plate.shape == (*shape, 3), f"plate {self.plate.shape}", f"{(*shape, 3)}")
        require(self.camera.size == shape[::-1], f"a camera of {self.camera.size} px", f"{shape[::-1]}")
        require(self.rest_frame >= 0 and self.united_frames >= 1, f"frames {self.rest_frame}, {self.united_frames}")

    @property
    def grid(self) -> Grid:
        """Of the simulation."""
        return self.setting.terrain.grid


@dataclass(frozen=True)
class Refined:
    """The body at rest, and what it was made of."""

    body: Gaussians
    """world, m"""
    front: int
    """Gaussians that are seen"""
    hull: int
    filled: int
    """Gaussians inside"""
    pruned: int
    psnr_before: float | None = None
    """dB against the picture, before the refinement; None where nothing was refined"""
    psnr_after: float | None = None
    kept: bool = True
    """whether the refinement passed the guard of the depth"""
    warnings: tuple[Notice, ...] = ()


@dataclass(frozen=True)
class TargetVelocity:
    """Velocity in the volume at one frame."""

    frame: int
    velocity: FaceVelocity
    """m/s"""
    seen: Bool[np.ndarray, "nx ny nz"]
    """cells in which the surface was observed"""
    observed_share: float | None = None
    """of the fluid's pixels, on which motion was measured"""
    report: dict[str, Any] = field(default_factory=dict)
    """figures of the divergence-free solve"""

    def plain(self) -> dict[str, Any]:
        """A row for reports."""
        return {"frame": self.frame, "observed_share": self.observed_share, **self.report}


@dataclass(frozen=True)
class Motion:
    """Velocities of the target frames, and completed flow."""

    targets: tuple[TargetVelocity, ...]
    """of consecutive frames"""
    completed: Float[np.ndarray, "p h w 2"]
    """px between two frames, filled in along the mainstream; NaN for frames that were not asked for; float16, mapped"""
    observed_bits: UInt8[np.ndarray, "p h w8"]
    """packed along the rows (`observed`); mapped"""
    front_factor: float
    """median over the targets, of what a moving front was sped up by"""
    free_fall_share: float
    """of the steep part, whose speed is that of free fall, at most"""
    filmed: FilmedMotion | None = None
    """of all frames, continued into air and walls, to guide a simulation; None: not asked for"""
    mean: FaceVelocity | None = None
    """m/s, of the mean motion of all frames; None: not asked for, or nothing lasts in this kind of fluid"""
    warnings: tuple[Notice, ...] = ()

    def __post_init__(self) -> None:
        pairs, height, width = self.completed.shape[:3]
        packed = (pairs, height, -(-width // 8))
        require(self.observed_bits.shape == packed, f"observed {self.observed_bits.shape}", str(packed))

    def observed(self, pairs: Any = slice(None)) -> np.ndarray:
        """bool [p,h,w]: where the motion of these pairs was measured, not filled in."""
        bits = np.asarray(self.observed_bits[pairs])
        return np.unpackbits(bits, axis=-1, count=self.completed.shape[2]).astype(bool)

    @property
    def velocities(self) -> list[FaceVelocity]:
        """m/s, of consecutive frames."""
        return [t.velocity for t in self.targets]

    @property
    def frames(self) -> list[int]:
        """Of the targets."""
        return [t.frame for t in self.targets]

    @property
    def reports(self) -> list[dict[str, Any]]:
        """One row per target."""
        return [t.plain() for t in self.targets]


@dataclass(frozen=True)
class Stretch:
    """What moved at another time of a long clip."""

    start: float
    """s into the clip"""
    targets: tuple[TargetVelocity, ...]
    """of consecutive frames, in the same cells"""
    apart: float
    """root mean square difference of its mean velocity in the fluid to that of the part that is made, over that"""


@dataclass(frozen=True)
class Elsewhere:
    """Velocities of other times of a long clip, of the same fluid in the same view."""

    stretches: tuple[Stretch, ...]
    warnings: tuple[Notice, ...] = ()

    @property
    def velocities(self) -> list[list[FaceVelocity]]:
        """m/s, of each stretch."""
        return [[t.velocity for t in stretch.targets] for stretch in self.stretches]


@dataclass(frozen=True)
class Fit:
    """Physical parameters, and how well they are known."""

    parameters: FluidParameters
    initial: FluidParameters
    """where the fit started"""
    estimates: dict[str, Estimate]
    """by label (`gravity_z`, `size`, ...)"""
    table: tuple[dict[str, Any], ...]
    """one row per number, as `fit.outcome.table` makes it"""
    converged: bool
    status: str
    """fitted, unfinished, failed or left"""
    reason: str
    rollouts: int
    notes: tuple[str, ...]
    extra: dict[str, float]
    """figures for the report"""
    loss_history: Float[np.ndarray, " n"]
    warnings: tuple[Notice, ...] = ()


@dataclass(frozen=True)
class Lift:
    """All that is found in a clip: the values of the stages from the clip to the parameters."""

    read: Read
    flow: Flow
    segmentation: Segmentation
    geometry: Geometry
    refined: Refined
    motion: Motion
    fit: Fit
    elsewhere: Elsewhere | None = None
    """of a long clip"""

    @property
    def clip(self) -> VideoClip:
        """As it was worked on."""
        return self.read.clip

    @property
    def labels(self) -> PixelLabels:
        """Of the clip."""
        return self.segmentation.labels


@dataclass(frozen=True)
class Calibration:
    """The steady force that keeps the filmed flow, and where that flow never is."""

    force: FaceVelocity | None = None
    """m/s^2; None where there is none"""
    acceleration: float | None = None
    """m/s^2, root mean square in the liquid"""
    speed: float | None = None
    """m/s, likewise, of the filmed flow"""
    left: float | None = None
    """difference to the filmed flow that stays under the pull, over its speed"""
    frames: int | None = None
    """of the run"""
    warnings: tuple[Notice, ...] = ()
    dry: Bool[np.ndarray, "nx ny nz"] | None = None
    """cells that the clip shows dry throughout; None where that is not known"""
    dry_for: float = math.inf
    """s from the body at rest for which they stay so"""
    wet: Bool[np.ndarray, "nx ny nz"] | None = None
    """those that it shows wet throughout, likewise"""


@dataclass(frozen=True)
class Simulation:
    """Figures of the frames of a simulation; their splats lie in files of their own."""

    volume: Float[np.ndarray, " k"]
    """m^3 of the cells that hold particles"""
    leak: Float[np.ndarray, " k"]
    """share of the particles inside the terrain"""
    count: Int[np.ndarray, " k"]
    """particles"""
    poses: Float[np.ndarray, "k b 7"]
    """of the obstacles: position (m) and orientation (w, x, y, z)"""
    substeps: tuple[int, ...] = ()
    """of each frame after the first"""
    resumed_at: int = 0
    """first frame that this run simulated"""
    failed: str | None = None
    """why it broke down after its last frame; None where it did not"""
    warnings: tuple[Notice, ...] = ()
    estimates: dict[str, Estimate] = field(default_factory=dict)
    """foam and waves that the film of the asset shows, and the law of its white water; empty where it was edited"""

    def __post_init__(self) -> None:
        k = len(self.count)
        require(len(self.volume) == len(self.leak) == len(self.poses) == k, f"figures of {k} frames", "one of each")
        require(self.poses.ndim == 3 and self.poses.shape[2] == 7, f"poses {self.poses.shape}", "[k,b,7]")

    @property
    def frames(self) -> int:
        """Simulated, the first (at rest) counted."""
        return len(self.count)


@dataclass(frozen=True)
class Shown:
    """What was measured on the frames as the clip's camera sees them."""

    frames: int
    """that were drawn"""
    as_filmed: dict[str, Any]
    """how near they stay to the clip (`evaluate.as_filmed`), or why that is not known, as the manifest has it"""
    pictures: UInt8[np.ndarray, "k h w 3"] | None = None
    """sRGB, of frames that have a counterpart in the clip"""
    coverage: Bool[np.ndarray, "k h w"] | None = None
    """where they show fluid"""
    flow: Float[np.ndarray, "k h w 2"] | None = None
    """px per frame, float16; NaN where they show no fluid"""
    warnings: tuple[Notice, ...] = ()


@dataclass(frozen=True)
class MaskFiles:
    """Masks that were written for a person."""

    frames: int
    size: tuple[int, int]
    """px"""
    warnings: tuple[Notice, ...] = ()


@dataclass(frozen=True)
class VelocityFiles:
    """Motion that was written for other tools."""

    rows: tuple[dict[str, Any], ...]
    """what is known of each frame"""
    warnings: tuple[Notice, ...] = ()
