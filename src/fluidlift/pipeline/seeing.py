"""Stages that look at the pictures: flow, segment. What they find is written to disk frame by frame."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from fluidlift.backends.learned import FLOW_METHODS, MASK_METHODS, ModelChoice, make_estimator, make_segmenter
from fluidlift.config import JobConfig
from fluidlift.errors import InputRejected
from fluidlift.io.stage_cache import parts_of
from fluidlift.pipeline.reading import Inputs, clip_of, spans_of
from fluidlift.pipeline.story import Result, Story
from fluidlift.seams import FlowEstimator, Segmenter
from fluidlift.types import Label, PixelFlow, PixelLabels, VideoClip

if TYPE_CHECKING:
    from fluidlift.shape.evidence import PairReader

MOST_PAIRS = 600
"""of a clip from which its mean motion is taken, evenly spread where there are more"""
TRUSTED = 0.3
"""confidence from which flow counts as measured"""


@dataclass(frozen=True)
class Hints:
    """What a person says about where the fluid is, in px of the working picture."""

    roi: tuple[int, int, int, int] | None = None
    """x, y, width, height: fluid is only looked for inside"""
    points: tuple[tuple[float, float, bool], ...] = ()
    """x, y, and whether there is fluid there"""

    @classmethod
    def of(cls, roi: str | None, here: Sequence[str], not_here: Sequence[str]) -> Hints:
        """From texts such as "10,20,300,200" and "64,48".

        Raises:
            InputRejected: a text that is no list of so many numbers.
        """
        box = None if roi is None else _numbers(roi, 4, "--roi", "x,y,width,height")
        points = [(*_numbers(text, 2, "--click", "x,y"), True) for text in here]
        points += [(*_numbers(text, 2, "--not-here", "x,y"), False) for text in not_here]
        return cls(None if box is None else tuple(round(v) for v in box), tuple(points))  # type: ignore[arg-type]

    def clicks(self) -> list[tuple[float, float, int]]:
        """The points as `shape.segment` takes them."""
        return [(x, y, int(there)) for x, y, there in self.points]

    def plain(self) -> list[Any] | None:
        """For the cache; None where nothing is said."""
        return None if self == NO_HINTS else [self.roi, self.points]


NO_HINTS = Hints()


def _numbers(text: str, count: int, option: str, form: str) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not np.isfinite(values).all():
        raise InputRejected(
            f"{option} {text}", f"{form} in px", f"such as {option} {','.join(['64', '48', '320', '200'][:count])}"
        )
    return values


class FluidMasks:
    """The fluid of each frame, bool [T,H,W], read from the labels when it is asked for."""

    def __init__(self, labels: np.ndarray) -> None:
        self.labels, self.shape, self.ndim = labels, labels.shape, 3

    def __len__(self) -> int:
        return len(self.labels)

    def __getitem__(self, index: Any) -> np.ndarray:
        return np.asarray(self.labels[index]) == Label.FLUID

    def any_frame(self) -> np.ndarray:
        """bool [H,W]: fluid at some time."""
        seen = np.zeros(self.shape[1:], bool)
        for part in parts_of(self.labels):
            seen |= self[part].any(axis=0)
        return seen

    def areas(self) -> np.ndarray:
        """float [T]: px of each frame."""
        parts = [self[part].sum(axis=(1, 2)) for part in parts_of(self.labels)]
        return np.concatenate(parts).astype(float)


def flow(story: Story, inputs: Inputs, config: JobConfig) -> Result:
    """Optical flow of every pair of frames: the user's, or estimated."""
    from fluidlift.motion.optical_flow import estimate_flow
    from fluidlift.pipeline.given_flow import given_flow

    clip = clip_of(story)
    count, (width, height) = len(clip) - 1, clip.size
    # float16 ends at 65504, far beyond any picture
    displacement = story.scratch.array("displacement", (count, height, width, 2), np.float16)
    confidence = story.scratch.array("confidence", (count, height, width), np.float16)
    warnings: list[str] = []
    as_given = False
    if inputs.flow is None:
        estimate_flow(clip.frames, method=flow_method(config), progress=story.step, out=(displacement, confidence))
    else:
        pairs, sure, warnings = given_flow(story, inputs, config)
        as_given = not sure
        for t, pair in enumerate(pairs):
            displacement[t], confidence[t] = pair
            story.step(t + 1, count)
    meta = {"warnings": warnings, "trusted_as_given": as_given}
    return Result({"displacement": displacement, "confidence": confidence}, meta)


def flow_method(config: JobConfig) -> str | FlowEstimator:
    """Name of a classical method, or a learned estimator with its weights."""
    m = config.motion
    if m.method in FLOW_METHODS:
        return make_estimator(m.method, ModelChoice(m.weights, m.device, m.download))
    return m.method


def flow_of(story: Story) -> PixelFlow:
    """The flow between neighbouring frames, px, float16, mapped; `pairs_of` gives parts of it at a steady rate."""
    r = story["flow"].arrays
    return PixelFlow(r["displacement"], r["confidence"])


def pairs_of(story: Story) -> Callable[[int, int], PixelFlow]:
    """Reads the flow of the pairs first to last - 1, float32, px per `clip.interval`, as `_steady_flow` gives it."""
    read = _steady_flow(story)
    return lambda first, last: read(range(first, last), slice(None))


def _steady_flow(story: Story) -> Callable[[Iterable[int], slice], PixelFlow]:
    """Reads rows of the flow of some pairs, float32, as it would be at a steady frame rate.

    What was measured is a displacement between two frames. Where these lie farther apart in time than others (a
    variable frame rate, frames left out), it is scaled to the clip's interval: equal values are equal velocities then.
    """
    r, spans = story["flow"].arrays, spans_of(clip_of(story))

    def read(pairs: Iterable[int], rows: slice) -> PixelFlow:
        chosen = list(pairs)
        return PixelFlow(
            np.stack([np.asarray(r["displacement"][t, rows], np.float32) / spans[t] for t in chosen]),
            np.stack([np.asarray(r["confidence"][t, rows], np.float32) for t in chosen]),
        )

    return read


def mean_motion(story: Story, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean flow of the whole clip (px per `clip.interval`) and its confidence, in bands of rows to bound memory."""
    from fluidlift.motion.optical_flow import mean_flow

    read, (pairs, height, width) = _steady_flow(story), story["flow"].arrays["confidence"].shape
    pick = np.unique(np.linspace(0, pairs - 1, min(pairs, MOST_PAIRS)).round().astype(int))
    rows = max(1, int(2**21 // (len(pick) * width)))
    mean, trust = np.zeros((height, width, 2), np.float32), np.zeros((height, width), np.float32)
    for top in range(0, height, rows):
        band = slice(top, top + rows)
        mean[band], trust[band] = mean_flow(read(pick, band), mask[band])
    return mean, trust


def segment(story: Story, inputs: Inputs, config: JobConfig, hints: Hints = NO_HINTS) -> Result:
    """What each pixel shows."""
    from fluidlift.shape.segment import segment as segment_clip

    clip = clip_of(story)
    mask, shape = _user_mask(story, inputs, config), clip.frames.shape[:3]
    out = story.scratch.array("labels", shape, np.uint8), story.scratch.array("confidence", shape, np.float16)
    if mask is None and config.segment.method in MASK_METHODS:
        labels = _learned(story, config, hints).segment(clip, flow_of(story), out=out)
    else:
        labels = segment_clip(
            clip, _flow_for_masks(story, inputs, config), user_mask=mask, roi=hints.roi, points=hints.clicks(),
            progress=lambda part, _: story.step(round(100 * part), 100), out=out,
        )  # fmt: skip
    fluid = FluidMasks(labels.labels)
    areas = fluid.areas()
    if not areas.any():
        raise InputRejected(
            f"no fluid was found in '{clip.source}'", "a region that moves", "draw it and pass it with --mask"
        )
    warnings = list(labels.warnings)
    trusted, sure = _trusted(story, fluid.any_frame()), _sureness(labels, areas.sum())
    if trusted < 0.1:
        warnings.append(
            f"optical flow failed on {100 * (1 - trusted):.0f} % of the fluid: velocities there are filled in from the "
            "mainstream; a clip with more texture or a higher frame rate would help"
        )
    return Result(
        {
            "labels": story.scratch.keep("labels", labels.labels),
            "confidence": story.scratch.keep("confidence", _halved(story, labels.confidence)),
        },
        {
            "warnings": warnings,
            "fluid_share": float(areas.mean() / (clip.size[0] * clip.size[1])),
            "confidence_mean": sure,
            "flow_trusted": trusted,
            "user_mask": inputs.mask is not None,
        },
    )


def require_usable(story: Story, inputs: Inputs, config: JobConfig, hints: Hints) -> None:
    """Look at everything that is given, before the flow is computed for nothing.

    Raises:
        InputRejected: a hint outside the picture, a mask or a depth map that cannot be used, a learned segmentation
            without weights or with hints that it does not take.
    """
    from fluidlift.io.images import read_depth
    from fluidlift.shape.hints import clicks_at
    from fluidlift.shape.segment import region_of_interest

    width, height = size = clip_of(story).size
    region_of_interest(hints.roi, height, width)
    clicks_at(hints.clicks(), size, (height, width))
    if inputs.depth is not None:
        read_depth(inputs.depth, size, scale=config.depth.scale, positive=config.depth.holds != "disparity")
    if inputs.mask is not None:
        _user_mask(story, inputs, config)
    elif config.segment.method in MASK_METHODS:
        _require_hints(config, hints)
        if config.segment.weights is None:
            make_segmenter(config.segment.method, ModelChoice())  # says which are needed


def _require_hints(config: JobConfig, hints: Hints) -> None:
    if hints != NO_HINTS and config.segment.method == "sam3":
        raise InputRejected(
            "--roi, --click or --not-here with sam3, which goes by words", "hints for segment.method=auto or sam2",
            "leave them out, or choose another method",
        )  # fmt: skip


def _flow_for_masks(story: Story, inputs: Inputs, config: JobConfig) -> PixelFlow | PairReader:
    """Flow of single pairs as they are, where ours is blind to what stands still: to a mask, rest is a finding."""
    from fluidlift.motion.optical_flow import DenseInverseSearch, flow_of_pair

    if inputs.flow is not None or config.motion.method != "multiframe":
        return flow_of(story)
    frames, estimator = clip_of(story).frames, DenseInverseSearch()
    return lambda t: flow_of_pair(frames[t], frames[t + 1], estimator)


def _learned(story: Story, config: JobConfig, hints: Hints) -> Segmenter:
    """A learned segmentation with its weights; one that starts from our own is given the hints through it."""
    from fluidlift.shape.segment import segment as segment_clip

    s, shape = config.segment, clip_of(story).frames.shape[:3]
    _require_hints(config, hints)

    def guess(clip: VideoClip, flow: PixelFlow) -> PixelLabels:
        room = story.scratch.array("guess", shape, np.uint8), story.scratch.array("guess_trust", shape, np.float16)
        return segment_clip(clip, flow, roi=hints.roi, points=hints.clicks(), out=room)

    choice = ModelChoice(s.weights, s.device, s.download)
    return make_segmenter(s.method, choice, words=s.words, guess=guess, progress=story.step)


def _halved(story: Story, confidence: np.ndarray) -> np.ndarray:
    """Confidence as float16; as it is where it is already."""
    if confidence.dtype == np.float16:
        return confidence
    out = story.scratch.array("halved", confidence.shape, np.float16)
    for part in parts_of(confidence):
        out[part] = confidence[part]
    return out


def _user_mask(story: Story, inputs: Inputs, config: JobConfig) -> np.ndarray | None:
    from fluidlift.io.images import read_camera, read_distortion, read_mask, undistort_mask
    from fluidlift.pipeline.mask_files import is_straight

    if inputs.mask is None:
        return None
    clip = clip_of(story)
    mask = read_mask(inputs.mask, clip.size, len(clip), start=config.read.start, duration=config.read.duration)
    distortion = read_distortion(inputs.camera) if inputs.camera is not None else None
    if inputs.camera is not None and distortion is not None and not is_straight(inputs.mask):
        mask = undistort_mask(mask, read_camera(inputs.camera, clip.size), distortion)
    return mask


def _trusted(story: Story, wet: np.ndarray) -> float:
    """Share of the fluid's pixels and pairs whose flow is trusted."""
    confidence, count = story["flow"].arrays["confidence"], 0
    for part in parts_of(confidence):
        count += int((confidence[part][:, wet] > TRUSTED).sum())
    return count / (len(confidence) * int(wet.sum()))


def _sureness(labels: PixelLabels, area: float) -> float:
    """Mean confidence of what was taken for fluid."""
    total = 0.0
    for part in parts_of(labels.labels):
        fluid = labels.labels[part] == Label.FLUID
        total += float(labels.confidence[part][fluid].sum(dtype=np.float64))
    return total / area


def labels_of(story: Story) -> PixelLabels:
    """The labels that later stages see, mapped."""
    r = story["segment"].arrays
    return PixelLabels(r["labels"], r["confidence"])


def masks_of(story: Story) -> FluidMasks:
    """The fluid frame by frame."""
    return FluidMasks(story["segment"].arrays["labels"])
