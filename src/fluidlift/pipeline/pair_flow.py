"""Flow of a clip of any length, pair by pair: what `motion.optical_flow.estimate_flow` finds, not held in memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from fluidlift.motion.optical_flow import estimate_flow
from fluidlift.seams import FlowEstimator

Pair = tuple[np.ndarray, np.ndarray]
"""displacement float32 [H,W,2], px, and confidence [H,W]"""

WINDOW_BYTES = 160_000_000
"""of flow that is in memory at a time: 100 pairs of 512 x 288 px"""
BYTES_PER_PIXEL = 10
"""displacement in float32 and confidence in float16"""
HALO = 12
"""pairs on either side of a window that are estimated with it and dropped: a pair is measured with its neighbours in
time. A clip that fits into one window is measured as a whole"""


def each_pair(
    frames: np.ndarray, method: str | FlowEstimator, progress: Callable[[int, int], None] | None = None
) -> Iterator[Pair]:
    """Displacement and confidence of every neighbouring pair, in order.

    Args:
        frames: u8 [T,H,W,3], sRGB; may be mapped, a few are read at a time.
        method: as in `estimate_flow`.
        progress: told pairs done and pairs in all.
    """
    pairs, (height, width) = len(frames) - 1, frames.shape[1:3]
    for first, last in windows(pairs, WINDOW_BYTES // (BYTES_PER_PIXEL * height * width)):
        low, high = max(first - HALO, 0), min(last + HALO, pairs)

        def tell(done: int, steps: int, begun: int = first, count: int = last - first) -> None:
            if progress is not None:
                progress(begun + round(count * done / steps), pairs)

        found = estimate_flow(frames[low : high + 1], method=method, progress=tell)
        for t in range(first - low, last - low):
            # copies, and no view of the window: it must be gone before the next one is estimated
            yield found.displacement[t].copy(), found.confidence[t].copy()
        del found


def windows(pairs: int, room: int) -> list[tuple[int, int]]:
    """First pair and end of windows that cover `pairs`; each has, with its halo, at most `room` (3 halos at least)."""
    if pairs <= room:
        return [(0, pairs)]
    step = max(room - 2 * HALO, HALO)
    return [(first, min(first + step, pairs)) for first in range(0, pairs, step)]
