"""The stage that puts a person's regions over the labels that were found."""

from __future__ import annotations

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.pipeline.work import Work
from fluidlift.shape.drawn import LABELS, carried, drawn_pixels, frame_at
from fluidlift.shape.fluid_found import fluid_figures
from fluidlift.types import Label, PixelLabels
from fluidlift.types.hints import Region
from fluidlift.types.stages import Flow, Read, Segmentation


def correct(
    read: Read, flow: Flow, segmentation: Segmentation, regions: tuple[Region, ...], *, work: Work
) -> Segmentation:
    """The labels as a person corrected them, with confidence 1 there; later regions lie over earlier ones.

    Args:
        read: the clip.
        flow: of it, which carries what moves.
        segmentation: as it was found.
        regions: px of the working picture.
        work: room for the labels.

    Raises:
        InputRejected: a region outside the picture, or no fluid is left.
    """
    found, shape = segmentation.labels, segmentation.labels.labels.shape
    labels = work.scratch.array("labels", shape, np.uint8)
    confidence = work.scratch.array("confidence", shape, np.float16)
    labels[:], confidence[:] = found.labels, found.confidence
    for number, region in enumerate(regions, 1):
        work.step(number, len(regions))
        mask = drawn_pixels(region.line, region.width, shape[1:])
        if not mask.any():
            raise InputRejected(
                f"region {number} ({region.what}) lies outside the {shape[2]} x {shape[1]} picture",
                "points inside the picture", "move it, or take it out of the hints",
            )  # fmt: skip
        held = _frames_of(region, read.clip.times)
        if not region.moves:
            for t in np.flatnonzero(held):
                labels[t, mask], confidence[t, mask] = LABELS[region.what], 1.0
            continue
        for t, there in carried(mask, flow.flow.displacement, frame_at(read.clip.times, region.time)):
            if held[t]:
                labels[t, there], confidence[t, there] = LABELS[region.what], 1.0
    figures = fluid_figures(PixelLabels(labels, confidence), flow.flow)
    if figures is None:
        taken = [str(k) for k, r in enumerate(regions, 1) if LABELS[r.what] != Label.FLUID]
        raise InputRejected(
            f"the regions of the hints leave no fluid (region {', '.join(taken)} takes it away)",
            "at least one pixel of fluid", "take one of them back, or draw fluid",
        )  # fmt: skip
    kept = PixelLabels(work.scratch.keep("labels", labels), work.scratch.keep("confidence", confidence))
    share, sure, trusted, likely = figures
    asked = None if segmentation.likely_overlap is None else likely  # None: a person drew all of it
    return Segmentation(
        kept, share, sure, trusted, segmentation.user_mask, likely_overlap=asked, whole=segmentation.whole
    )


def _frames_of(region: Region, times: np.ndarray) -> np.ndarray:
    """bool [T]: in which frames, s into the clip, a region is there."""
    begins, ends = (v if v is not None else k * np.inf for v, k in ((region.begins, -1.0), (region.ends, 1.0)))
    slack = 1e-3  # s: files hold tenths of milliseconds
    return (times >= begins - slack) & (times < ends - slack)


def nothing_found(read: Read, *, work: Work) -> Segmentation:
    """Labels without any fluid, where a person drew all of it."""
    shape = read.clip.frames.shape[:3]
    labels = work.scratch.array("labels", shape, np.uint8)
    confidence = work.scratch.array("confidence", shape, np.float16)
    labels[:], confidence[:] = Label.BACKGROUND, 0.0
    kept = PixelLabels(work.scratch.keep("labels", labels), work.scratch.keep("confidence", confidence))
    return Segmentation(kept, 0.0, 0.0, 0.0, False)
