"""The stage that reads the clip: decoded, without lens distortion, repeated frames, shake and cuts.

Frames go to disk as they are decoded and are mapped from there on: memory does not grow with the clip.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.config import JobConfig
from fluidlift.errors import InputRejected
from fluidlift.io.collect import is_variable
from fluidlift.io.stage_cache import Scratch, parts_of
from fluidlift.pipeline.story import Result, Story
from fluidlift.types import VideoClip


@dataclass(frozen=True)
class Inputs:
    """Files of a job. All but the clip are optional."""

    clip: Path
    mask: Path | None = None
    camera: Path | None = None
    depth: Path | None = None
    geometry: Path | None = None
    """folder of Gaussian PLY files and camera.json"""
    flow: Path | None = None
    """optical flow of the clip: a folder of .flo, .exr or .npz files, or one .npz"""

    def existing(self) -> dict[str, Path]:
        """Those that were given."""
        return {k: v for k, v in vars(self).items() if v is not None}


def read(story: Story, inputs: Inputs, config: JobConfig) -> Result:
    """Decode, steady, look for repeated frames and cuts."""
    from fluidlift.io.limits import ReadLimits
    from fluidlift.io.sequences import is_sequence
    from fluidlift.io.video import read_clip

    r, scratch = config.read, story.scratch
    clip = read_clip(
        inputs.clip,
        start=r.start,
        duration=r.duration,
        max_size=r.max_size,
        fps=r.fps if is_sequence(inputs.clip) else None,
        limits=ReadLimits(max_pixels=r.max_pixels, max_frames=r.max_frames),
        store=scratch,
    )
    decoded = len(clip)
    clip = _without_distortion(clip, inputs, scratch)
    clip, kept = _without_repeats(clip, scratch)
    steady, meta = _steady(clip, scratch, correct=r.stabilise)
    first, last, warnings = _longest_shot(meta["cuts"], len(steady), clip.source, kept)
    frames, alpha = steady.frames, steady.alpha
    if last - first < len(steady):
        frames, kept = frames[first:last], kept[first:last]
        alpha = None if alpha is None else alpha[first:last]
    arrays = {"frames": scratch.keep("frames", frames), "times": steady.times[first:last], "kept": kept}
    if alpha is not None:
        arrays["alpha"] = scratch.keep("alpha", alpha)
    left_out = np.setdiff1d(np.arange(decoded), kept)
    meta["warnings"] = [*clip.warnings, *(w for w in meta["warnings"] if w not in clip.warnings), *warnings]
    meta |= {"source": clip.source, "decoded_frames": decoded, "dropped_frames": left_out.tolist()}
    return Result(arrays, meta)


def _without_distortion(clip: VideoClip, inputs: Inputs, scratch: Scratch) -> VideoClip:
    """Lines that are straight in the world made straight in the picture, where a camera file knows the lens."""
    from fluidlift.io.images import read_camera, read_distortion, undistort_clip

    distortion = read_distortion(inputs.camera) if inputs.camera is not None else None
    if inputs.camera is None or distortion is None:
        return clip
    camera = read_camera(inputs.camera, clip.size)
    frames, alpha, before = scratch.array("straight", clip.frames.shape, np.uint8), None, clip.alpha
    if before is not None:
        alpha = scratch.array("straight_alpha", before.shape, np.uint8)
    straight = clip
    for part in parts_of(clip.frames):
        piece = replace(
            clip, frames=clip.frames[part], times=clip.times[part], alpha=None if before is None else before[part]
        )
        straight = undistort_clip(piece, camera, distortion)
        frames[part] = straight.frames
        if alpha is not None:
            alpha[part] = straight.alpha
    return replace(clip, frames=frames, alpha=alpha, warnings=straight.warnings)


def _without_repeats(clip: VideoClip, scratch: Scratch) -> tuple[VideoClip, np.ndarray]:
    """The clip without frames that bring nothing new, and which frames (int [T]) it has kept."""
    from fluidlift.motion.cadence import examine_cadence, without_duplicates

    report = examine_cadence(clip.frames, clip.times)
    kept = np.asarray(report.kept)
    if len(kept) == len(clip):
        return replace(clip, warnings=_told(clip.warnings, report.warnings)), kept
    if len(kept) < 2:
        raise InputRejected(
            f"'{clip.source}' shows one picture all the time", "at least two different frames", "choose another stretch"
        )
    # what lies on disk is chosen part by part; the times do not depend on the pictures
    hollow = replace(clip, frames=np.zeros((len(clip), 1, 1, 3), np.uint8), alpha=None)
    times = without_duplicates(hollow, report).times
    frames = _chosen(clip.frames, kept, "without_repeats", scratch)
    alpha = None if clip.alpha is None else _chosen(clip.alpha, kept, "alpha_without_repeats", scratch)
    # the reader counts exact repeats as well: said once is enough
    said = tuple(w for w in clip.warnings if "repeat the one before" not in w)
    return replace(clip, frames=frames, times=times, alpha=alpha, warnings=_told(said, report.warnings)), kept


def _chosen(array: np.ndarray, kept: np.ndarray, name: str, scratch: Scratch) -> np.ndarray:
    out = scratch.array(name, (len(kept), *array.shape[1:]), array.dtype)
    for part in parts_of(out):
        out[part] = array[kept[part]]
    return out


def _told(before: tuple[str, ...], more: tuple[str, ...]) -> tuple[str, ...]:
    return (*before, *(w for w in more if w not in before))


def _steady(clip: VideoClip, scratch: Scratch, *, correct: bool) -> tuple[VideoClip, dict[str, Any]]:
    """The clip as from a camera that stands still, and how the camera moved."""
    from fluidlift.motion.stabilize import GreyFrames, find_cuts, stabilise

    if not correct:
        cuts = find_cuts(GreyFrames(clip.frames))
        return clip, {"shake_px": 0.0, "stabilised": False, "cuts": [int(c) for c in cuts], "warnings": []}
    steady, shake = stabilise(clip, out=scratch.array("steady", clip.frames.shape, np.uint8))
    # cuts are told below, with what follows from them
    warnings = [w for w in shake.warnings if not w.startswith("the clip is cut at")]
    cuts = [int(c) for c in shake.cuts]
    return steady, {
        "shake_px": float(shake.shake_px), "stabilised": bool(shake.stabilised), "cuts": cuts, "warnings": warnings,
    }  # fmt: skip


def _longest_shot(cuts: list[int], frames: int, source: str, kept: np.ndarray) -> tuple[int, int, list[str]]:
    """First frame and end of the longest stretch without a cut; what comes after one is another scene."""
    if not cuts:
        return 0, frames, []
    edges = [0, *cuts, frames]
    longest = max(range(len(edges) - 1), key=lambda i: edges[i + 1] - edges[i])
    first, last = edges[longest], edges[longest + 1]
    if last - first < 2:
        raise InputRejected(
            f"'{source}' has a cut at nearly every frame", "a stretch of at least 2 frames from one camera",
            "trim it with --start and --duration",
        )  # fmt: skip
    where = ", ".join(str(kept[c]) for c in cuts)
    return (
        first,
        last,
        [f"the clip has {len(cuts)} cut(s), at frame {where}: only frames {kept[first]} to {kept[last - 1]} are used"],
    )


def spans_of(clip: VideoClip) -> np.ndarray:
    """Time that each pair of frames spans, in `clip.interval`, float32 [T-1]; rounded time stamps count as even."""
    steps = np.diff(clip.times)
    return (steps / clip.interval if is_variable(clip.times) else np.ones(len(steps))).astype(np.float32)


def clip_of(story: Story) -> VideoClip:
    """The clip that later stages see; its frames are mapped."""
    r = story["read"]
    return VideoClip(r.arrays["frames"], r.arrays["times"], r.meta["source"], r.arrays.get("alpha"))
