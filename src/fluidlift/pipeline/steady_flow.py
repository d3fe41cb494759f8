"""The measured flow as it would be at a steady frame rate.

What was measured is a displacement between two frames. Where these lie farther apart in time than others (a variable
frame rate, frames left out), it is scaled to the clip's interval: equal values are equal velocities then.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from fluidlift.io.collect import is_variable
from fluidlift.types import PixelFlow, VideoClip

MOST_PAIRS = 600
"""of a clip from which its mean motion is taken, evenly spread where there are more"""
TRUSTED = 0.3
"""confidence from which flow counts as measured"""


def spans_of(clip: VideoClip) -> np.ndarray:
    """Time that each pair of frames spans, in `clip.interval`, float32 [T-1]; rounded time stamps count as even."""
    steps = np.diff(clip.times)
    return (steps / clip.interval if is_variable(clip.times) else np.ones(len(steps))).astype(np.float32)


def pairs_of(clip: VideoClip, flow: PixelFlow) -> Callable[[int, int], PixelFlow]:
    """Reads the flow of the pairs first to last - 1, float32, px per `clip.interval`."""
    read = _rows(clip, flow)
    return lambda first, last: read(range(first, last), slice(None))


def mean_motion(clip: VideoClip, flow: PixelFlow, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean flow of the whole clip (px per `clip.interval`) and its confidence, in bands of rows to bound memory."""
    from fluidlift.motion.optical_flow import mean_flow

    read, (pairs, height, width) = _rows(clip, flow), flow.confidence.shape
    pick = np.unique(np.linspace(0, pairs - 1, min(pairs, MOST_PAIRS)).round().astype(int))
    rows = max(1, int(2**21 // (len(pick) * width)))
    mean, trust = np.zeros((height, width, 2), np.float32), np.zeros((height, width), np.float32)
    for top in range(0, height, rows):
        band = slice(top, top + rows)
        mean[band], trust[band] = mean_flow(read(pick, band), mask[band])
    return mean, trust


def _rows(clip: VideoClip, flow: PixelFlow) -> Callable[[Iterable[int], slice], PixelFlow]:
    """Reads rows of the flow of some pairs."""
    spans = spans_of(clip)

    def read(pairs: Iterable[int], rows: slice) -> PixelFlow:
        chosen = list(pairs)
        return PixelFlow(
            np.stack([np.asarray(flow.displacement[t, rows], np.float32) / spans[t] for t in chosen]),
            np.stack([np.asarray(flow.confidence[t, rows], np.float32) for t in chosen]),
        )

    return read
