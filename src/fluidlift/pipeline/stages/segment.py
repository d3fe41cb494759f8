"""The stage that finds the fluid. Labels are written to disk frame by frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from fluidlift.backends.learned import MASK_METHODS, make_segmenter
from fluidlift.backends.registry import ModelChoice
from fluidlift.errors import InputRejected
from fluidlift.messages import Notice
from fluidlift.pipeline.hints import NO_HINTS, MaskHints
from fluidlift.pipeline.settings import GivenMask, SegmentSettings
from fluidlift.pipeline.work import Work
from fluidlift.seams import Segmenter
from fluidlift.shape.fluid_found import fluid_figures
from fluidlift.types import Label, PixelFlow, PixelLabels, VideoClip
from fluidlift.types.fluid_masks import parts_of
from fluidlift.types.stages import Flow, Read, Segmentation

if TYPE_CHECKING:
    from fluidlift.shape.evidence import PairReader
    from fluidlift.shape.segment import Clues


def segment(
    read: Read, flow: Flow, mask: GivenMask | None, config: SegmentSettings | None, hints: MaskHints, *, work: Work
) -> Segmentation:
    """What each pixel shows.

    Args:
        read: the clip.
        flow: of it.
        mask: the user's, which is taken as it is.
        config: who finds the fluid; None where the mask is the user's.
        hints: of a person.
        work: room for the labels.

    Raises:
        InputRejected: no fluid, or a mask that does not fit.
    """
    from fluidlift.shape.segment import segment as segment_clip

    clip, shape = read.clip, read.clip.frames.shape[:3]
    out = work.scratch.array("labels", shape, np.uint8), work.scratch.array("confidence", shape, np.float16)
    if config is not None and config.method in MASK_METHODS:
        labels = _learned(clip, config, hints, work).segment(clip, flow.flow, out=out)
    else:
        drawn = None if mask is None else drawn_mask(clip, mask)
        labels = segment_clip(
            clip, _flow_for_masks(clip, flow), user_mask=drawn, roi=hints.roi, points=hints.points,
            progress=lambda part, _: work.step(round(100 * part), 100), out=out,
            clues=lambda: work.remembered("clues", clues, read, flow, hints.roi),
        )  # fmt: skip
    whole = None if read.unseen is None else _beyond_edges(clip, read.unseen, labels, work, drawn=mask is not None)
    found = fluid_figures(labels, flow.flow)
    if found is None:
        raise InputRejected(
            f"no fluid was found in '{clip.source}'", "a region that moves", "draw it and pass it with --mask"
        )
    warnings = list(labels.warnings)
    if found.trusted < 0.1:
        warnings.append(
            Notice(
                "flow-failed",
                f"optical flow failed on {100 * (1 - found.trusted):.0f} % of the fluid: velocities there are filled "
                "in from the mainstream; a clip with more texture or a higher frame rate would help",
            )
        )
    kept = work.scratch.keep("labels", labels.labels), work.scratch.keep("confidence", _halved(work, labels.confidence))
    share, sure, trusted, likely = found
    return Segmentation(PixelLabels(*kept), share, sure, trusted, mask is not None, tuple(warnings), likely, whole)


def _beyond_edges(
    clip: VideoClip, unseen: Bool[np.ndarray, "t a b"], labels: PixelLabels, work: Work, *, drawn: bool
) -> UInt8[np.ndarray, "t h w 3"] | None:
    """The clip's frames in which the fluid goes on where a steadied frame does not see it, and the labels with it, in
    place, where a person has not `drawn` them; None where that changes nothing."""
    from fluidlift.motion.full_frame import lent

    frames, whole = clip.frames, None
    for t, donor, weight in lent(unseen, clip.size):
        fluid = labels.labels[donor] == Label.FLUID
        share = weight * cv2.blur(fluid.astype(np.float32), (3, 3))
        there = share > 0
        if not there.any():
            continue
        if whole is None:
            whole = work.scratch.array("whole", frames.shape, np.uint8)
            for part in parts_of(whole):
                whole[part] = frames[part]
        own, picture = frames[t][there].astype(np.float32), whole[t].copy()
        picture[there] = np.rint(own + share[there][:, None] * (frames[donor][there] - own)).astype(np.uint8)
        whole[t] = picture
        if not drawn:
            taken = fluid & (weight > 0.5)
            labels.labels[t][taken] = Label.FLUID
            labels.confidence[t][taken] = labels.confidence[donor][taken]
    return None if whole is None else work.scratch.keep("whole", whole)


def clues(read: Read, flow: Flow, roi: tuple[int, int, int, int] | None) -> Clues:
    """What the clip shows of its fluid before a person says anything."""
    from fluidlift.shape.segment import clues_of

    return clues_of(read.clip, _flow_for_masks(read.clip, flow), roi, read.fluid_evidence)


def require_usable(clip: VideoClip, mask: GivenMask | None, config: SegmentSettings, hints: MaskHints) -> None:
    """Look at what is given, before the flow is computed for nothing.

    Raises:
        InputRejected: a hint outside the picture, a mask that cannot be used, a learned segmentation without weights or
            with hints that it does not take.
    """
    from fluidlift.shape.hints import clicks_at
    from fluidlift.shape.segment import region_of_interest

    width, height = clip.size
    region_of_interest(hints.roi, height, width)
    clicks_at(hints.points, clip.size, (height, width))
    if mask is not None:
        drawn_mask(clip, mask)
    elif config.method in MASK_METHODS:
        _require_hints(config, hints)
        if config.weights is None:
            make_segmenter(config.method, ModelChoice())  # says which are needed


def _require_hints(config: SegmentSettings, hints: MaskHints) -> None:
    if hints != NO_HINTS and config.method == "sam3":
        raise InputRejected(
            "--roi, --click or --not-here with sam3, which goes by words", "hints for segment.method=auto or sam2",
            "leave them out, or choose another method",
        )  # fmt: skip


def _flow_for_masks(clip: VideoClip, flow: Flow) -> PixelFlow | PairReader:
    """Flow of single pairs as they are, where ours is blind to what stands still: to a mask, rest is a finding."""
    from fluidlift.motion.optical_flow import DenseInverseSearch, PairsAsTheyAre

    return flow.flow if flow.method != "multiframe" else PairsAsTheyAre(clip.frames, DenseInverseSearch())


def _learned(clip: VideoClip, config: SegmentSettings, hints: MaskHints, work: Work) -> Segmenter:
    """A learned segmentation with its weights; one that starts from our own is given the hints through it."""
    from fluidlift.shape.segment import segment as segment_clip

    shape = clip.frames.shape[:3]
    _require_hints(config, hints)

    def guess(clip: VideoClip, flow: PixelFlow) -> PixelLabels:
        room = work.scratch.array("guess", shape, np.uint8), work.scratch.array("guess_trust", shape, np.float16)
        return segment_clip(clip, flow, roi=hints.roi, points=hints.points, out=room)

    weights = None if config.weights is None else config.weights.name
    choice = ModelChoice(weights, config.device, config.download)
    return make_segmenter(config.method, choice, words=config.words, guess=guess, progress=work.step)


def _halved(work: Work, confidence: np.ndarray) -> np.ndarray:
    """Confidence as float16; as it is where it is already."""
    if confidence.dtype == np.float16:
        return confidence
    out = work.scratch.array("halved", confidence.shape, np.float16)
    for part in parts_of(confidence):
        out[part] = confidence[part]
    return out


def drawn_mask(clip: VideoClip, given: GivenMask) -> np.ndarray:
    """bool [T,H,W]: the user's mask of the frames that are used.

    Raises:
        InputRejected: a mask that cannot be read, or of other frames.
    """
    from fluidlift.io.images import read_camera, read_distortion, read_mask, undistort_mask
    from fluidlift.pipeline.mask_facts import is_straight

    file, camera = given.file.path, None if given.camera is None else given.camera.path
    mask = read_mask(file, clip.size, len(clip), start=given.start, duration=given.duration)
    distortion = read_distortion(camera) if camera is not None else None
    if camera is not None and distortion is not None and not is_straight(file):
        mask = undistort_mask(mask, read_camera(camera, clip.size), distortion)
    return mask
