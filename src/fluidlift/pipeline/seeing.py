"""Stages that look at the pictures: read, flow, segment."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.config import JobConfig
from fluidlift.errors import InputRejected
from fluidlift.pipeline.story import Result, Story
from fluidlift.types import PixelFlow, PixelLabels, VideoClip


@dataclass(frozen=True)
class Inputs:
    """Files of a job. All but the clip are optional."""

    clip: Path
    mask: Path | None = None
    camera: Path | None = None
    depth: Path | None = None
    geometry: Path | None = None
    """folder of Gaussian PLY files and camera.json"""

    def existing(self) -> dict[str, Path]:
        """Those that were given."""
        return {k: v for k, v in vars(self).items() if v is not None}


def read(inputs: Inputs, config: JobConfig) -> Result:
    """Decode, steady, look for cuts."""
    from fluidlift.io.limits import ReadLimits
    from fluidlift.io.sequences import is_sequence
    from fluidlift.io.video import read_clip
    from fluidlift.motion.stabilize import stabilise

    r = config.read
    clip = read_clip(
        inputs.clip,
        start=r.start,
        duration=r.duration,
        max_size=r.max_size,
        fps=r.fps if is_sequence(inputs.clip) else None,
        limits=ReadLimits(max_pixels=r.max_pixels, max_frames=r.max_frames),
    )
    clip = _without_distortion(clip, inputs)
    warnings = list(clip.warnings)
    arrays: dict[str, np.ndarray] = {}
    meta: dict[str, Any] = {"source": clip.source}
    steady, shake = stabilise(clip) if r.stabilise else stabilise(clip, max_correction_px=0.0)
    warnings += [w for w in shake.warnings if w not in warnings]
    if shake.cuts:
        # what comes after a cut is another scene: the longest stretch without one is kept
        edges = [0, *shake.cuts, len(steady)]
        longest = max(range(len(edges) - 1), key=lambda i: edges[i + 1] - edges[i])
        first, last = edges[longest], edges[longest + 1]
        if last - first < 2:
            raise InputRejected(
                f"'{clip.source}' has a cut at nearly every frame", "a stretch of at least 2 frames from one camera",
                "trim it with --start and --duration",
            )  # fmt: skip
        steady = VideoClip(
            steady.frames[first:last], steady.times[first:last], steady.source,
            None if steady.alpha is None else steady.alpha[first:last], steady.warnings,
        )  # fmt: skip
        warnings.append(
            f"the clip has {len(shake.cuts)} cut(s), at frame {', '.join(map(str, shake.cuts))}: "
            f"only frames {first} to {last - 1} are used"
        )
        meta["first_frame_of_file"] = first
    arrays |= {"frames": steady.frames, "times": steady.times}
    if steady.alpha is not None:
        arrays["alpha"] = steady.alpha
    meta |= {
        "warnings": warnings,
        "shake_px": float(shake.shake_px),
        "stabilised": bool(shake.stabilised),
        "cuts": [int(c) for c in shake.cuts],
    }
    return Result(arrays, meta)


def _without_distortion(clip: VideoClip, inputs: Inputs) -> VideoClip:
    """Lines that are straight in the world made straight in the picture, where a camera file knows the lens."""
    from fluidlift.io.images import read_camera, read_distortion, undistort_clip

    distortion = read_distortion(inputs.camera) if inputs.camera is not None else None
    if inputs.camera is None or distortion is None:
        return clip
    return undistort_clip(clip, read_camera(inputs.camera, clip.size), distortion)


def clip_of(story: Story) -> VideoClip:
    """The clip that later stages see."""
    r = story["read"]
    return VideoClip(r.arrays["frames"], r.arrays["times"], r.meta["source"], r.arrays.get("alpha"))


def flow(story: Story, config: JobConfig) -> Result:
    """Optical flow of every pair of frames."""
    from fluidlift.motion.optical_flow import estimate_flow

    clip = clip_of(story)
    found = estimate_flow(clip.frames, method=config.motion.method, progress=story.step)
    return Result(
        {
            "displacement": found.displacement.astype(np.float16),
            "confidence": found.confidence.astype(np.float16),
        }
    )


def flow_of(story: Story) -> PixelFlow:
    """The flow that later stages see."""
    r = story["flow"].arrays
    return PixelFlow(r["displacement"].astype(np.float32), r["confidence"].astype(np.float32))


def segment(story: Story, inputs: Inputs, config: JobConfig) -> Result:
    """What each pixel shows."""
    from fluidlift.io.images import read_camera, read_distortion, read_mask, undistort_mask
    from fluidlift.shape.segment import segment as segment_clip

    clip = clip_of(story)
    user_mask = None
    if inputs.mask is not None:
        user_mask = read_mask(inputs.mask, clip.size, len(clip), start=config.read.start, duration=config.read.duration)
        distortion = read_distortion(inputs.camera) if inputs.camera is not None else None
        if inputs.camera is not None and distortion is not None:
            user_mask = undistort_mask(user_mask, read_camera(inputs.camera, clip.size), distortion)
    labels = segment_clip(clip, flow_of(story), user_mask=user_mask, progress=story.step)
    fluid = labels.fluid
    if not fluid.any():
        raise InputRejected(
            f"no fluid was found in '{clip.source}'", "a region that moves", "draw it and pass it with --mask"
        )
    warnings = list(labels.warnings)
    trusted = float((flow_of(story).confidence[:, fluid.any(axis=0)] > 0.3).mean())
    if trusted < 0.1:
        warnings.append(
            f"optical flow failed on {100 * (1 - trusted):.0f} % of the fluid: velocities there are filled in from the "
            "mainstream; a clip with more texture or a higher frame rate would help"
        )
    return Result(
        {"labels": labels.labels, "confidence": labels.confidence.astype(np.float16)},
        {
            "warnings": warnings,
            "fluid_share": float(fluid.mean()),
            "confidence_mean": float(labels.confidence[fluid].astype(np.float32).mean()),
            "flow_trusted": trusted,
            "user_mask": inputs.mask is not None,
        },
    )


def labels_of(story: Story) -> PixelLabels:
    """The labels that later stages see."""
    r = story["segment"].arrays
    return PixelLabels(r["labels"], r["confidence"])
