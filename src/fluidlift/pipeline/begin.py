"""The stages that every command on a clip begins with: read, flow, segment, geometry."""

from __future__ import annotations

import math
from dataclasses import replace

from fluidlift.config import JobConfig
from fluidlift.errors import InputRejected
from fluidlift.pipeline import depths, given_body
from fluidlift.pipeline.hints import NO_HINTS, MaskHints, laid_on, require_no_contradiction
from fluidlift.pipeline.inputs import GivenFile, GivenFiles
from fluidlift.pipeline.models import require_weights
from fluidlift.pipeline.runner import Runner
from fluidlift.pipeline.settings import (
    GeometrySettings,
    GivenDepth,
    GivenFlow,
    GivenView,
    LookSettings,
    taken,
)
from fluidlift.pipeline.stages.correct import correct, nothing_found
from fluidlift.pipeline.stages.flow import estimated_flow, given_flow
from fluidlift.pipeline.stages.geometry import geometry
from fluidlift.pipeline.stages.read import read
from fluidlift.pipeline.stages.segment import require_usable, segment
from fluidlift.pipeline.stages.window import WindowSettings, window
from fluidlift.types.hints import NOTHING_SAID, ClipHints
from fluidlift.types.stages import Flow, Geometry, Read, Segmentation

WINDOW = "window"
"""the stage that a job on a long clip has before read"""
CORRECT = "correct"
"""the stage that a job with regions in its hints has after segment"""


def stages_of(stages: tuple[str, ...], hints: ClipHints) -> tuple[str, ...]:
    """The stages of a job: with `correct` after segment where a person drew regions."""
    if not hints.regions:
        return stages
    at = stages.index("segment") + 1
    return (*stages[:at], CORRECT, *stages[at:])


def uncropped(config: JobConfig) -> JobConfig:
    """The settings of a job on the whole picture: what is said and given in px of it, or written for it, stays true."""
    return replace(config, read=replace(config.read, crop="none"))


SAMPLE = 16
"""frames of a stretch at another time, beside those whose velocity is wanted: eight on either side are asked where
these fail (`motion.reach` of six, and the flow of neighbours)"""


def within(runner: Runner, clip: GivenFile, config: JobConfig) -> JobConfig:
    """As `windows`, of the part that is made."""
    return windows(runner, clip, config)[0]


def windows(runner: Runner, clip: GivenFile, config: JobConfig) -> tuple[JobConfig, tuple[JobConfig, ...]]:
    """The settings of a job, for a clip of more frames than it takes with a part of the clip that stands for it.

    The part stands in the settings as if it had been given by --start and --duration, for masks and flow as well. The
    others are those of short stretches at other times, whose motion may count too; none of a clip that is made whole.

    Args:
        runner: of the job, which gets one stage more then.
        clip: video file or image sequence.
        config: of the job.

    Raises:
        InputRejected: a clip that cannot be used.
    """
    from fluidlift.io.limits import ReadLimits
    from fluidlift.io.video import frame_times

    read = config.read
    end = math.inf if read.duration is None else read.start + read.duration
    times = frame_times(clip.path, read.fps, ReadLimits(max_pixels=read.max_pixels))
    if sum(read.start - 5e-7 <= time < end - 5e-7 for time in times) <= read.max_frames:
        return config, ()
    runner.stages = (WINDOW, *runner.stages)
    sample = config.motion.targets + SAMPLE
    part = runner.run(WINDOW, window, clip, taken(WindowSettings, read, frames=read.max_frames, sample=sample))
    parts = [replace(config, read=replace(read, start=s, duration=d)) for s, d in
             ((part.start, part.duration), *part.elsewhere)]  # fmt: skip
    return parts[0], tuple(parts[1:])


def look(
    runner: Runner, given: GivenFiles, config: JobConfig, hints: MaskHints = NO_HINTS, said: ClipHints = NOTHING_SAID
) -> tuple[Read, Flow, Segmentation]:
    """Run read, flow, segment and, where regions were drawn, correct; what later stages are given is looked at first.

    Args:
        runner: of the job.
        given: its files.
        config: of it.
        hints: of the command line, in px of the working picture.
        said: those of a hints file, which take the place of `hints` where there are some.

    Raises:
        InputRejected: an input that cannot be used.
    """
    require_weights(config)
    require_no_contradiction(said, config, given)
    told = LookSettings.of(given, config)
    clip = runner.run("read", read, given.clip, given.camera, told.read)

    drawn, notice = laid_on(said, clip)
    if notice:
        runner.warn(notice)
    if drawn.roi is not None or drawn.clicks:
        hints = MaskHints.drawn(drawn)

    def first() -> None:
        require_usable(clip.clip, told.mask, told.segment, hints)
        if given.depth is not None:
            depths.require_file(clip, taken(GivenDepth, config.depth, file=given.depth))
        if given.geometry is not None:
            given_body.given_bodies(given.geometry.path, clip.clip.size, [0])

    if isinstance(told.flow, GivenFlow):
        flow = runner.run("flow", given_flow, clip, told.flow, before=first)
    else:
        flow = runner.run("flow", estimated_flow, clip, told.flow, before=first)
    finder = None if told.mask is not None else told.segment
    try:
        found = runner.run("segment", segment, clip, flow, told.mask, finder, hints)
    except InputRejected:
        if not any(r.what == "fluid" for r in drawn.regions):
            raise
        found = runner.run("segment", nothing_found, clip)
    if drawn.regions:
        found = runner.run(CORRECT, correct, clip, flow, found, drawn.regions)
    return clip, flow, found


def shape(
    runner: Runner, seen: tuple[Read, Flow, Segmentation], given: GivenFiles, config: JobConfig,
    said: ClipHints = NOTHING_SAID,
) -> Geometry:  # fmt: skip
    """Run geometry, with what a hints file says of the view."""
    settings = geometry_settings(seen[0], config, said)
    return runner.run("geometry", geometry, *seen, GivenView.of(given, config), settings)


def geometry_settings(read: Read, config: JobConfig, said: ClipHints) -> GeometrySettings:
    """What geometry is told."""
    return taken(GeometrySettings, config.shape, drawn=laid_on(said, read)[0].view)
