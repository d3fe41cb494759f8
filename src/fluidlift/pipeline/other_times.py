"""What moved at other times of a long clip: short stretches go through read, flow and motion, one after the other.

A part of a long clip is made. What its fluid does at other times counts as well where it can be laid on the same body:
of what runs through its bed all the time, before a camera that stands. Memory is that of one stretch, however long the
clip is.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from fluidlift.config import JobConfig
from fluidlift.errors import InputRejected
from fluidlift.motion.align import refined_similarity
from fluidlift.pipeline.inputs import GivenFiles
from fluidlift.pipeline.runner import Runner
from fluidlift.pipeline.settings import FlowSettings, GivenFlow, MotionSettings, ReadSettings
from fluidlift.pipeline.stages.elsewhere import elsewhere
from fluidlift.pipeline.stages.flow import estimated_flow, given_flow
from fluidlift.pipeline.stages.motion import motion
from fluidlift.pipeline.stages.read import read as read_part
from fluidlift.types import Label, PixelLabels, kind_of
from fluidlift.types.stages import Elsewhere, Geometry, Motion, Read, Segmentation

STAGE = "elsewhere"
STILL = 2.0
"""px that a camera may go somewhere; what is drawn as from one place is drawn anew for each stretch"""
OFF = 1.0
"""px of the working picture by which the ground of a stretch may lie elsewhere: a cell is as wide as several"""
AGREE = 6
"""of the 48 cells of a picture that must say where the ground lies: fewer may be a rim that moves with the fluid"""
SEEN = 0.5
"""of the share of the fluid whose motion was measured in the part that is made, from which a stretch counts"""


def moved_elsewhere(
    runner: Runner, given: GivenFiles, parts: tuple[JobConfig, ...], made: tuple[Read, Segmentation, Geometry, Motion]
) -> Elsewhere | None:
    """Velocities at other times; None where there are none that can be used.

    Args:
        runner: of the job, which gets more stages then.
        given: files of the job.
        parts: settings of the stretches.
        made: values of the part that is made.
    """
    read, _, geometry, moving = made
    kind = kind_of(geometry.kind)
    if (
        not parts
        or parts[0].motion.targets < 2
        or not kind.is_channel_flow
        or kind.starts_at_rest
        or read.moved_px > STILL
        or not moving.targets
    ):
        return None
    at = runner.stages.index("motion") + 1
    names = [f"{stage}_{k}" for k in range(2, len(parts) + 2) for stage in ("read", "flow", "motion")]
    runner.stages = (*runner.stages[:at], *names, STAGE, *runner.stages[at:])
    told = list(runner.warnings)
    found: list[tuple[float, Motion]] = []
    for k, part in enumerate(parts, 2):
        other = _moved(runner, given, part, k, made)
        if other is not None:
            found.append((part.read.start, other))
    runner.warnings[:] = told  # what is wrong with a stretch is none of the asset's
    if not found:
        return None
    starts, others = zip(*found)
    return runner.run(STAGE, elsewhere, geometry, moving, others, starts)


def _moved(
    runner: Runner, given: GivenFiles, part: JobConfig, k: int, made: tuple[Read, Segmentation, Geometry, Motion]
) -> Motion | None:
    """Of one stretch; None where it does not show the same view, or too little of its motion."""
    read, segmentation, geometry, moving = made
    try:
        there = runner.run(f"read_{k}", read_part, given.clip, given.camera, ReadSettings.of(part))
        if not same_view(read, there):
            return None
        own = GivenFlow.of(given, part)
        if own is None:
            flow = runner.run(f"flow_{k}", estimated_flow, there, FlowSettings.of(part))
        else:
            flow = runner.run(f"flow_{k}", given_flow, there, own)
    except InputRejected:
        return None
    count, wanted = len(there.clip), min(part.motion.targets, len(there.clip) - 1)
    wet = np.where(geometry.mask, Label.FLUID, Label.BACKGROUND).astype(np.uint8)
    wet = np.broadcast_to(wet, (count, *wet.shape))
    labels = PixelLabels(wet, np.broadcast_to(np.float16(1.0), wet.shape))
    fluid = runner.follows(replace(segmentation, labels=labels), segmentation, geometry, there)
    placed = runner.follows(replace(geometry, rest_frame=max((count - wanted) // 2, 0)), geometry, there)
    found = runner.run(f"motion_{k}", motion, there, flow, fluid, placed, MotionSettings.of(part))
    return found if len(found.targets) > 1 and _share(found) >= SEEN * _share(moving) else None


def same_view(read: Read, there: Read) -> bool:
    """Whether a stretch shows the view of the part that is made, at its rate."""
    a, b = read.clip, there.clip
    if a.size != b.size or abs(b.interval / a.interval - 1.0) > 0.01 or there.cuts or there.moved_px > STILL:
        return False
    still, moved = (cv2.cvtColor(np.ascontiguousarray(clip.frames[0]), cv2.COLOR_RGB2GRAY) for clip in (a, b))
    laid, _, cells = refined_similarity(still, moved, np.eye(2, 3))
    width, height = a.size
    corners = np.array([(u, v, 1.0) for u in (0, width) for v in (0, height)])
    return cells >= AGREE and float(np.abs(corners @ laid.T - corners[:, :2]).max()) <= OFF


def _share(motion: Motion) -> float:
    """Of the fluid's pixels, on which motion was measured."""
    return float(np.mean([t.observed_share or 0.0 for t in motion.targets]))
