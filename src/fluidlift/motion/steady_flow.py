"""The measured flow as it would be at a steady frame rate.

What was measured is a displacement between two frames. Where these lie farther apart in time than others (a variable
frame rate, frames left out), it is scaled to the clip's interval: equal values are equal velocities then.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from fluidlift.types import PixelFlow, VideoClip
from fluidlift.types.clip import is_variable

MOST_PAIRS = 600
"""of a clip from which its mean motion is taken, evenly spread where there are more"""


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


def bulk_motion(
    clip: VideoClip, flow: PixelFlow, fluid: Callable[[int], np.ndarray], ever: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean motion of the whole fluid, and of what is never fluid, in each pair of frames, px per `clip.interval`.

    A stream has the same in every pair, since what comes in goes out. Waves pass, and swing to and fro. So does all of
    the picture in a hand that trembles, the ground with it.

    Args:
        clip: for its times.
        flow: of all pairs.
        fluid: bool [h,w] of a frame.
        ever: bool [h,w], fluid in any frame.

    Returns:
        two arrays float64 [n,2]; nan where nothing was measured.
    """
    read, pairs = _rows(clip, flow), len(flow.confidence)
    pick = np.unique(np.linspace(0, pairs - 1, min(pairs, MOST_PAIRS)).round().astype(int))
    water, ground = np.full((2, len(pick), 2), np.nan)
    for row, t in enumerate(pick):
        found = read([t], slice(None))
        for out, part in ((water, fluid(int(t))), (ground, ~ever)):
            weight = found.confidence[0] * part
            total = float(weight.sum())
            if total > 0:
                out[row] = (weight[..., None] * found.displacement[0]).sum(axis=(0, 1)) / total
    return water, ground


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
