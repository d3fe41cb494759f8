"""What is found of a clip before anything is made of it: mask, kind, tilt, flow, scale, for a person to correct."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.config import JobConfig
from fluidlift.io.atomic import disk_errors
from fluidlift.io.hints_file import content_hash
from fluidlift.io.video import probe
from fluidlift.messages import Notice, as_plain
from fluidlift.pipeline import begin
from fluidlift.pipeline.found_parts import FoundPart, Line, lines_of, outlines, parts_of
from fluidlift.pipeline.inputs import GivenFiles, Inputs
from fluidlift.pipeline.runner import Runner
from fluidlift.pipeline.settings import GeometrySettings, GivenView, ReadSettings
from fluidlift.pipeline.sight import sighted
from fluidlift.pipeline.stages.read import read
from fluidlift.pipeline.work import Work
from fluidlift.seams import Progress, Silence
from fluidlift.shape.kind import level_camera
from fluidlift.shape.view import Ellipse, horizon_line
from fluidlift.types import KindEvidence, Label, MetricScale, PinholeCamera, UpEvidence
from fluidlift.types.flow import TRUSTED
from fluidlift.types.hints import NOTHING_SAID, ClipHints, ClipIdentity
from fluidlift.types.stages import Flow, Read, Segmentation

FIND_STAGES = ("read", "flow", "segment", "view")
ARROWS = 9
"""along the longer side of the picture, of which those on the fluid are told"""
PATH_POINTS = 60
"""of the camera's path that are told"""
STILL_PX = 1.0
"""camera motion below this (`motion.stabilize.STEADY_DRIFT_PX`) counts as none"""


@dataclass(frozen=True)
class FoundView:
    """How the fluid stands before the camera: what geometry begins with, without ground and cells."""

    kind: str
    kind_evidence: KindEvidence
    up: UpEvidence
    scale: MetricScale
    scale_sentence: str
    camera: PinholeCamera
    """level, in units of its own"""
    mask: Bool[np.ndarray, "h w"]
    mean_flow: Float[np.ndarray, "h w 2"]
    """px per frame"""
    mean_confidence: Float[np.ndarray, "h w"]
    rest_frame: int
    parts: tuple[FoundPart, ...] = ()
    lines: tuple[Line, ...] = ()
    level_share: float | None = None
    """probability that a stream runs level; None: nothing was asked"""
    slope: float = 0.0
    """degrees that it falls along its way"""
    warnings: tuple[Notice, ...] = ()
    rims: tuple[Ellipse, ...] = ()
    """of vessels"""


def view(
    read: Read, flow: Flow, segmentation: Segmentation, given: GivenView, config: GeometrySettings, *, work: Work
) -> FoundView:
    """Kind, tilt, flow and scale.

    Raises:
        InputRejected: as `pipeline.sight.sighted`.
    """
    s = sighted(read, flow, segmentation, given, config, work=work)
    seen, slope = s.seen, s.front.slope
    return FoundView(
        seen.kind.name, seen.evidence, s.up, s.scale, s.sentence, s.canonical, seen.mask, np.asarray(seen.motion),
        np.asarray(seen.trust), seen.start, parts_of(s), lines_of(s), None if slope is None else slope.level_share,
        0.0 if slope is None else slope.slope, tuple(s.warnings),
        seen.rims,
    )  # fmt: skip


@dataclass(frozen=True)
class Found:
    """What was found."""

    identity: ClipIdentity
    read: Read
    segmentation: Segmentation
    view: FoundView
    warnings: tuple[Notice, ...] = ()

    def facts(self) -> dict[str, Any]:
        """Plain data for the section `found` of a hints file, in px of the clip's own picture."""
        g, (width, height) = self.view, self.read.clip.size
        k = self.scaling
        up = replace(g.up, pitch=g.up.pitch - g.up.raised)  # as it was seen, not as a relief is built
        scores = sorted(g.kind_evidence.scores.items(), key=lambda item: -item[1])
        level = level_camera(g.camera, up)
        frame = g.rest_frame
        return {
            "kind": g.kind,
            "probability": {name: round(share, 3) for name, share in scores},
            "horizon": [_px(p, k) for p in horizon_line(level)],
            "pitch": round(up.pitch, 1),
            "pitch_error": round(up.error, 1),
            "roll": round(up.roll, 1),
            "tilt_from": up.source,
            "field_of_view": round(float(2 * np.degrees(np.arctan(0.5 * max(width, height) / max(g.camera.focal)))), 1),
            "scale": g.scale_sentence,
            "metres_across": float(f"{g.scale.across:.3g}"),
            "flow": [{"at": _px(a, k), "to": _px(b, k)} for a, b in arrows(g)],
            "rims": [
                {"center": _px(r.center, k), "axes": _px(r.axes, k), "turned": round(_turned(r.covariance), 1)}
                for r in g.rims
            ],
            "parts": [_part_data(part, k) for part in g.parts],
            "lines": [{"is": line.what, "line": [_px(p, k) for p in line.points]} for line in g.lines],
            "camera": camera_facts(self.read, self.identity.size),
            **_slope_facts(g),
            **fluid_facts(self.segmentation),
            "mask": [
                {"is": "fluid", "area": [_px(p, k) for p in line], "time": round(float(self.read.clip.times[frame]), 4)}
                for line in outlines(np.asarray(self.segmentation.labels.labels[frame]) == Label.FLUID)
            ],
        } | as_plain(self.warnings)

    @property
    def scaling(self) -> float:
        """px of the clip's own picture per px of the working one."""
        return self.identity.size[0] / self.read.clip.size[0]

    def lines(self) -> list[str]:
        """For people."""
        g = self.view
        scores = sorted(g.kind_evidence.scores.items(), key=lambda item: -item[1])
        return [
            f"kind: {g.kind} ({', '.join(f'{name} {share:.2f}' for name, share in scores[:3])})",
            f"the camera looks {g.up.pitch:.0f} ± {g.up.error:.0f} degrees below the horizon (from {g.up.source})",
            g.scale_sentence,
            f"fluid covers {100 * self.segmentation.fluid_share:.0f} % of the picture",
            camera_facts(self.read, self.identity.size)["words"],
            *(f"{part.what}: {part.probability:.2f}" for part in g.parts[1:]),
        ]


def camera_facts(read: Read, size: tuple[int, int]) -> dict[str, Any]:
    """How the camera moved, in px of a picture of `size`: in words, how far, and where it looked over time.

    The path is that of the picture's middle on the picture that all frames are laid on.
    """
    k, moved = size[0] / read.clip.size[0], read.moved_px
    if read.path is None:
        return {"words": "whether the camera moves was not asked", "moves": None}
    if moved <= STILL_PX and read.shake_px <= STILL_PX:
        return {"words": "the camera stands still", "moves": 0.0}
    done = "taken out" if read.stabilised else "left as it is"
    pick = np.unique(np.linspace(0, len(read.path) - 1, min(len(read.path), PATH_POINTS)).round().astype(int))
    middle = 0.5 * np.asarray(size, float)
    return {
        "words": f"the camera moves by {k * moved:.0f} px, and shakes by {k * read.shake_px:.1f} px per frame: {done}",
        "moves": round(k * moved, 1),
        "shakes": round(k * read.shake_px, 2),
        "taken_out": read.stabilised,
        "path": [_px(middle / k + p, k) for p in read.path[pick]],
        "times": [round(float(t), 3) for t in read.clip.times[pick]],
    }


def fluid_facts(segmentation: Segmentation) -> dict[str, Any]:
    """How much of the picture is fluid, and how sure that is."""
    return {
        "fluid_share": round(segmentation.fluid_share, 4), "fluid_sure": round(segmentation.confidence_mean, 2),
    }  # fmt: skip


def _slope_facts(g: FoundView) -> dict[str, Any]:
    if g.level_share is None:
        return {}
    return {"slope": round(g.slope, 1), "level_probability": round(g.level_share, 2)}


def _part_data(part: FoundPart, k: float) -> dict[str, Any]:
    area = {"area": [_px(p, k) for p in part.area]} if part.area else {}
    return {"is": part.what, "probability": round(part.probability, 2)} | area


def identity_of(clip: Path, fps: float | None = None) -> ClipIdentity:
    """Which clip it is.

    Raises:
        InputRejected: as `io.video.probe`.
    """
    info = probe(clip, fps=fps)
    return ClipIdentity(clip.name, info.size, info.frame_count, content_hash(clip))


def read_alone(inputs: Inputs, folder: Path, config: JobConfig, *, progress: Progress | None = None) -> Read:
    """The clip as `make` would read it, and no more.

    Args:
        inputs: the clip.
        folder: for its frames, which are mapped from there.
        config: of the job.
        progress: where progress is told.

    Raises:
        InputRejected: a clip that cannot be used.
    """
    given = GivenFiles.of(inputs)
    runner = Runner(folder, ("read",), progress=progress or Silence())
    with disk_errors(folder):
        config = begin.within(runner, given.clip, config)
        found = runner.run("read", read, given.clip, given.camera, ReadSettings.of(config))
    return replace(found, warnings=tuple(runner.warnings))  # with that of a long clip


def find_hints(
    inputs: Inputs, folder: Path, config: JobConfig, hints: ClipHints = NOTHING_SAID, *,
    progress: Progress | None = None, told: Callable[[str, Any], None] = lambda name, value: None,
    memory: dict[str, tuple[str, Any]] | None = None,
) -> Found:  # fmt: skip
    """Read, flow, segment and view, with the hints that there are.

    Args:
        inputs: the clip.
        folder: where stages are kept; what has not changed since an earlier call is not done again.
        config: of the job.
        hints: of a person, with the clip's identity.
        progress: where progress is told.
        told: gets the name and the value of each stage as it ends.
        memory: given to each call of one process, it saves what a click does not change (`Runner`).

    Raises:
        InputRejected: an input that cannot be used.
    """
    stages = begin.stages_of(FIND_STAGES, hints)
    runner = Runner(folder, stages, progress=progress or Silence(), value_told=told, memory=memory)
    given = GivenFiles.of(inputs)
    with disk_errors(folder):
        config = begin.within(runner, given.clip, begin.uncropped(config))
        seen = begin.look(runner, given, config, said=hints)
        found = runner.run(
            "view", view, *seen, GivenView.of(given, config), begin.geometry_settings(seen[0], config, hints)
        )
    identity = hints.clip or identity_of(inputs.clip, config.read.fps)
    return Found(identity, seen[0], seen[2], found, tuple(runner.warnings))


def arrows(g: FoundView) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    """Where the fluid moves and where to, px of the working picture: begin and end, the fastest a step long."""
    height, width = g.mask.shape
    step = max(height, width) / ARROWS
    found = []
    for v in np.arange(0.5 * step, height, step):
        for u in np.arange(0.5 * step, width, step):
            part = np.s_[int(max(v - step / 2, 0)) : int(v + step / 2), int(max(u - step / 2, 0)) : int(u + step / 2)]
            seen = g.mask[part] & (g.mean_confidence[part] > TRUSTED)
            if seen.sum() < 0.1 * step * step:
                continue
            rows, columns = np.nonzero(seen)
            at = (part[1].start + columns.mean() + 0.5, part[0].start + rows.mean() + 0.5)
            found.append((at, np.median(g.mean_flow[part][seen], axis=0)))
    fastest = max((float(np.linalg.norm(way)) for _, way in found), default=0.0)
    if fastest < 1e-6:
        return []
    length = step / fastest
    return [((float(a[0]), float(a[1])), (float(a[0] + length * w[0]), float(a[1] + length * w[1]))) for a, w in found]


def _px(point: Any, k: float) -> list[float]:
    return [round(float(v) * k, 1) for v in point]


def _turned(covariance: np.ndarray) -> float:
    """Degrees clockwise from the picture's horizontal to the longer axis."""
    axis = np.linalg.eigh(covariance)[1][:, 1]
    return float((np.degrees(np.arctan2(axis[1], axis[0])) + 90.0) % 180.0 - 90.0)
