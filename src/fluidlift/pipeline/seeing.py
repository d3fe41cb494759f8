"""Stages that look at the pictures: flow, segment. What they find is written to disk frame by frame."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fluidlift.backends.learned import FLOW_METHODS, MASK_METHODS, ModelChoice, make_estimator, make_segmenter
from fluidlift.config import JobConfig
from fluidlift.errors import InputRejected
from fluidlift.io.stage_cache import parts_of
from fluidlift.pipeline.reading import Inputs, clip_of
from fluidlift.pipeline.story import Result, Story
from fluidlift.seams import FlowEstimator, Segmenter
from fluidlift.types import Label, PixelFlow, PixelLabels

MOST_PAIRS = 600
"""of a clip from which its mean motion is taken, evenly spread where there are more"""
TRUSTED = 0.3
"""confidence from which flow counts as measured"""


Pair = tuple[np.ndarray, np.ndarray]
"""displacement [H,W,2], px, and confidence [H,W]"""


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
    clip = clip_of(story)
    count, (width, height) = len(clip) - 1, clip.size
    found, warnings = _pairs(story, inputs, config)
    displacement = story.scratch.array("displacement", (count, height, width, 2), np.float16)
    confidence = story.scratch.array("confidence", (count, height, width), np.float16)
    for t, pair in enumerate(found):
        # float16 ends at 65504, far beyond any picture
        displacement[t], confidence[t] = pair
        if inputs.flow is not None:
            story.step(t + 1, count)
    return Result({"displacement": displacement, "confidence": confidence}, {"warnings": warnings})


def _pairs(story: Story, inputs: Inputs, config: JobConfig) -> tuple[Iterable[Pair], list[str]]:
    """Displacement and confidence of each pair, and what the user should know of them."""
    if inputs.flow is not None:
        from fluidlift.pipeline.given_flow import given_flow

        return given_flow(story, inputs, config)
    from fluidlift.pipeline.pair_flow import each_pair

    return each_pair(clip_of(story).frames, flow_method(config), story.step), []


def flow_method(config: JobConfig) -> str | FlowEstimator:
    """Name of a classical method, or a learned estimator with its weights."""
    m = config.motion
    if m.method in FLOW_METHODS:
        return make_estimator(m.method, ModelChoice(m.weights, m.device, m.download))
    return m.method


def flow_of(story: Story) -> PixelFlow:
    """The flow that later stages see, float16, mapped; `pairs_of` gives parts of it as float32."""
    r = story["flow"].arrays
    return PixelFlow(r["displacement"], r["confidence"])


def pairs_of(story: Story) -> Callable[[int, int], PixelFlow]:
    """Reads the flow of the pairs first to last - 1, float32."""
    r = story["flow"].arrays

    def read(first: int, last: int) -> PixelFlow:
        part = slice(first, last)
        return PixelFlow(np.asarray(r["displacement"][part], np.float32), np.asarray(r["confidence"][part], np.float32))

    return read


def mean_motion(story: Story, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean flow of the whole clip (px per frame) and its confidence, in bands of rows to bound memory."""
    from fluidlift.motion.optical_flow import mean_flow

    whole = flow_of(story)
    pairs, height, width = whole.confidence.shape
    pick = np.unique(np.linspace(0, pairs - 1, min(pairs, MOST_PAIRS)).round().astype(int))
    rows = max(1, int(2**21 // (len(pick) * width)))
    mean, trust = np.zeros((height, width, 2), np.float32), np.zeros((height, width), np.float32)
    for top in range(0, height, rows):
        band = slice(top, top + rows)
        part = PixelFlow(
            np.stack([np.asarray(whole.displacement[t, band], np.float32) for t in pick]),
            np.stack([np.asarray(whole.confidence[t, band], np.float32) for t in pick]),
        )
        mean[band], trust[band] = mean_flow(part, mask[band])
    return mean, trust


def segment(story: Story, inputs: Inputs, config: JobConfig, hints: Hints = NO_HINTS) -> Result:
    """What each pixel shows."""
    from fluidlift.shape.segment import segment as segment_clip

    clip = clip_of(story)
    mask, shape = _user_mask(story, inputs, config), clip.frames.shape[:3]
    out = story.scratch.array("labels", shape, np.uint8), story.scratch.array("confidence", shape, np.float16)
    if mask is None and config.segment.method in MASK_METHODS:
        labels = _learned(config, hints).segment(clip, flow_of(story), out=out)
    else:
        labels = segment_clip(
            clip, flow_of(story), user_mask=mask, roi=hints.roi,
            points=[(x, y, int(there)) for x, y, there in hints.points],
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


def _learned(config: JobConfig, hints: Hints) -> Segmenter:
    """A learned segmentation with its weights."""
    s = config.segment
    if hints != NO_HINTS:
        raise InputRejected(
            f"--roi, --click or --not-here with {s.method}", "hints for segment.method=auto alone",
            "leave them out, or the method",
        )  # fmt: skip
    return make_segmenter(s.method, ModelChoice(s.weights, s.device, s.download), words=s.words)


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
