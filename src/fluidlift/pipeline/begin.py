"""The stages that every command on a clip begins with: read, flow, segment, geometry."""

from __future__ import annotations

from fluidlift.config import JobConfig
from fluidlift.pipeline import depths, given_body
from fluidlift.pipeline.hints import NO_HINTS, Hints
from fluidlift.pipeline.inputs import GivenFiles
from fluidlift.pipeline.runner import Runner
from fluidlift.pipeline.settings import (
    FlowSettings,
    GeometrySettings,
    GivenDepth,
    GivenFlow,
    GivenMask,
    GivenView,
    ReadSettings,
    SegmentSettings,
    taken,
)
from fluidlift.pipeline.stages.flow import estimated_flow, given_flow
from fluidlift.pipeline.stages.geometry import geometry
from fluidlift.pipeline.stages.read import read
from fluidlift.pipeline.stages.segment import require_usable, segment
from fluidlift.types.stages import Flow, Geometry, Read, Segmentation


def look(
    runner: Runner, given: GivenFiles, config: JobConfig, hints: Hints = NO_HINTS
) -> tuple[Read, Flow, Segmentation]:
    """Run read, flow and segment; what later stages are given is looked at before the slow ones.

    Raises:
        InputRejected: an input that cannot be used.
    """
    depths.require_weights(config.depth)
    mask, finder = GivenMask.of(given, config), SegmentSettings.of(config)
    clip = runner.run("read", read, given.clip, given.camera, taken(ReadSettings, config.read))

    def first() -> None:
        require_usable(clip.clip, mask, finder, hints)
        if given.depth is not None:
            depths.require_file(clip, taken(GivenDepth, config.depth, file=given.depth))
        if given.geometry is not None:
            given_body.given_bodies(given.geometry.path, clip.clip.size, [0])

    own = GivenFlow.of(given, config)
    if own is None:
        flow = runner.run("flow", estimated_flow, clip, FlowSettings.of(config), before=first)
    else:
        flow = runner.run("flow", given_flow, clip, own, before=first)
    found = runner.run("segment", segment, clip, flow, mask, None if mask is not None else finder, hints)
    return clip, flow, found


def shape(runner: Runner, seen: tuple[Read, Flow, Segmentation], given: GivenFiles, config: JobConfig) -> Geometry:
    """Run geometry."""
    settings = taken(GeometrySettings, config.shape)
    return runner.run("geometry", geometry, *seen, GivenView.of(given, config), settings)
