"""Smoothing in time that keeps what the fluid really does.

The flow of a single pair is noisy, and its neighbours in time know more. There are two ways to ask them. At a fixed
pixel an eddy that is carried past is lost in the mean; along the fluid's own path it stays, but so do the errors that
go with the texture, and a wrong path asks the wrong fluid. The two means are weighted with the inverse of the scatter
of what they average: where the stream is steady the pixel wins, where eddies are carried past the path.

Where neither is trusted, the pixel's mean over a longer time is at hand: foam that passed by a moment ago was carried
by the same stream. It is a guess for the mainstream to weigh, not an observation.

On a simulated turbulent river, where flow is trusted, before filling (single pairs, five pairs at fixed pixels, this):

    flow            end-point error, px    fluctuation's variance, true 1    change per frame, true 1
    multi-frame     0.74  0.72  0.70       0.62  0.49  0.53                  1.01  0.41  0.54
    plain pairs     0.93  0.85  0.85       0.88  0.49  0.58                  1.57  0.51  0.78

The fluctuation of "this" has correlations of 0.78 and 0.73 with the true one; the best estimate of that correlation
would show its square of the variance, 0.61 and 0.53: single pairs show noise beyond it.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float
from numba import njit

from fluidlift.errors import require
from fluidlift.motion.confidence import ROUND_TRIP_FLOOR, ROUND_TRIP_SHARE
from fluidlift.motion.mainstream import OBSERVED_CONFIDENCE
from fluidlift.motion.multiframe import EVIDENCE, LEAST_SPREAD, NO_TRUST, TRIM
from fluidlift.types import PixelFlow

OTHER_TIMES = 0.5
"""Trust in the longer mean over that in the near pairs. What was seen at other times is evidence for the filling, below
the threshold of the mainstream, and no observation of this frame. 0.3 to 0.7 give the same error within 1 % on eight
simulated clips; with 1 it is from 0.5 % smaller to 2 % larger (a pour)."""
SMALLEST_SCATTER = 0.15
"""px: of good flow, below which scatter says nothing"""
ROUNDS = 3
"""fixed-point rounds for a step back in time; each shrinks the error by the flow's gradient, which is below 1/2 px/px
wherever pixels do not fold over each other"""


def smoothed_flow(
    window: PixelFlow, at: int, mask: Bool[np.ndarray, "h w"], *, half_window: int = 1, along_paths: bool = True
) -> tuple[Float[np.ndarray, "h w 2"], Float[np.ndarray, "h w"]]:
    """The motion of one pair from those around it.

    Args:
        window: pairs in a row, px/frame. Those further than `half_window` only serve where the near ones fail.
        at: index in the window of the pair that is wanted.
        mask: the fluid at that pair.
        half_window: pairs on either side that are averaged; 0 takes the pair alone.
        along_paths: follow the fluid as well; False averages at fixed pixels alone, over the near pairs.

    Returns:
        displacement float32 [H,W,2] px/frame and confidence float32 [H,W], see `multiframe.mean_flow`; 0 outside
        the mask.

    Raises:
        ValueError: an index outside the window, a negative half window, or a mask of another shape.
    """
    require(0 <= at < len(window), f"pair {at}", f"0 to {len(window) - 1}")
    require(half_window >= 0, f"half window of {half_window} frames", "0 or more")
    mask = np.asarray(mask, bool)
    require(mask.shape == window.displacement.shape[1:3], f"mask {mask.shape}", str(window.displacement.shape[1:3]))
    rows, cols = np.nonzero(mask)
    part = slice(max(at - half_window, 0), at + half_window + 1)
    near = PixelFlow(window.displacement[part], window.confidence[part])
    fixed = mean_of_samples(*listed(near, rows, cols))
    values, trust = fixed[:2]
    if along_paths and half_window > 0:
        values, trust = _joined(fixed, mean_of_samples(*listed(along_path(window, at, mask, half_window), rows, cols)))
    # those that the mainstream trusts stand alone; at half of its threshold and below the longer mean takes their place
    failed = np.flatnonzero(trust < OBSERVED_CONFIDENCE)
    if along_paths and len(window) > len(near) and len(failed):
        long, long_trust, _ = mean_of_samples(*listed(window, rows[failed], cols[failed]))
        share = np.clip(2.0 * trust[failed] / OBSERVED_CONFIDENCE - 1.0, 0.0, 1.0)[:, None]
        values[failed] = share * values[failed] + (1.0 - share) * long
        trust[failed] = np.maximum(trust[failed], OTHER_TIMES * long_trust)
    mean, confidence = np.zeros((*mask.shape, 2), np.float32), np.zeros(mask.shape, np.float32)
    mean[rows, cols], confidence[rows, cols] = values, trust
    return mean, confidence


def listed(flow: PixelFlow, rows: np.ndarray, cols: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The flow of some pixels: [t,n,2] px/frame and confidence [t,n], float32."""
    return (
        np.ascontiguousarray(flow.displacement[:, rows, cols], np.float32),
        np.ascontiguousarray(flow.confidence[:, rows, cols], np.float32),
    )


def _joined(
    fixed: tuple[np.ndarray, np.ndarray, np.ndarray], paths: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """The means at fixed pixels and along paths, each weighted with its trust over the scatter of its samples."""
    weights = [trust**2 / (scatter + SMALLEST_SCATTER**2) for _, trust, scatter in (fixed, paths)]
    total = np.maximum(weights[0] + weights[1], 1e-12)
    mean = (weights[0][:, None] * fixed[0] + weights[1][:, None] * paths[0]) / total[:, None]
    return np.where((total > 1e-12)[:, None], mean, fixed[0]).astype(np.float32), np.maximum(fixed[1], paths[1])


@njit(cache=True, nogil=True)
def mean_of_samples(
    displacement: np.ndarray, confidence: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # pragma: no cover (compiled)
    """`multiframe.mean_flow` of listed pixels, all rounds of a pixel at once: mean [n,2], confidence [n], scatter [n].

    Scatter is the mean squared distance of the samples from their mean, px^2, weighted with the confidence squared.
    """
    count, n = confidence.shape
    mean, trust, scatter = np.zeros((n, 2), np.float32), np.zeros(n, np.float32), np.zeros(n, np.float32)
    kept, weight, distance = np.empty(count), np.empty(count), np.empty(count)
    for i in range(n):
        for k in range(count):
            weight[k] = confidence[k, i] ** 2 + NO_TRUST
            kept[k] = weight[k]
        mx = my = 0.0
        for turn in range(3):
            total = sx = sy = 0.0
            for k in range(count):
                total += kept[k]
                sx += kept[k] * displacement[k, i, 0]
                sy += kept[k] * displacement[k, i, 1]
            mx, my = sx / max(total, 1e-6), sy / max(total, 1e-6)
            spread = whole = 0.0
            for k in range(count):
                distance[k] = (displacement[k, i, 0] - mx) ** 2 + (displacement[k, i, 1] - my) ** 2
                spread += weight[k] * distance[k]
                whole += weight[k]
            spread /= max(whole, 1e-6)
            if turn < 2:
                for k in range(count):
                    kept[k] = weight[k] if distance[k] <= TRIM**2 * max(spread, LEAST_SPREAD**2) else 0.0
        total = squares = typical = deviation = 0.0
        for k in range(count):
            total += kept[k]
            squares += kept[k] ** 2
            typical += kept[k] * confidence[k, i]
            deviation += kept[k] * distance[k]
        held = max(total, 1e-6)
        frames = max(total**2 / max(squares, 1e-6), 1.0)
        tolerance = ROUND_TRIP_FLOOR**2 + ROUND_TRIP_SHARE**2 * (mx**2 + my**2)
        certain = tolerance / (tolerance + deviation / held / frames)
        mean[i, 0], mean[i, 1] = mx, my
        trust[i] = typical / held * certain * total / (total + EVIDENCE**2)
        scatter[i] = spread
    return mean, trust, scatter


def along_path(window: PixelFlow, at: int, mask: Bool[np.ndarray, "h w"], half_window: int) -> PixelFlow:
    """The flow of the pairs around `at` where the fluid that is at each pixel then was, or will be.

    Confidence is 0 where the path has left the picture or the mask.
    """
    inside = mask.astype(np.float32)
    samples = {at: (np.asarray(window.displacement[at], np.float32), window.confidence[at].astype(np.float32) * inside)}
    for direction in (-1, 1):
        place = pixel_indices(mask.shape)
        for k in range(at + direction, at + direction * (half_window + 1), direction):
            if not 0 <= k < len(window):
                break
            step = np.asarray(window.displacement[k - 1 if direction > 0 else k], np.float32)
            place = forward(place, step) if direction > 0 else backward(place, step)
            trust = sampled(window.confidence[k].astype(np.float32) * inside, place)
            samples[k] = sampled(np.asarray(window.displacement[k], np.float32), place), trust
    keys = sorted(samples)
    return PixelFlow(np.stack([samples[k][0] for k in keys]), np.stack([samples[k][1] for k in keys]))


def forward(place: Float[np.ndarray, "h w 2"], step: Float[np.ndarray, "h w 2"]) -> Float[np.ndarray, "h w 2"]:
    """Where fluid at `place` (px, column and row) is one frame later."""
    return place + sampled(step, place, beyond=cv2.BORDER_REPLICATE)


def backward(place: Float[np.ndarray, "h w 2"], step: Float[np.ndarray, "h w 2"]) -> Float[np.ndarray, "h w 2"]:
    """Where fluid that has come to `place` was one frame earlier: p with p + step(p) = place."""
    moved = sampled(step, place, beyond=cv2.BORDER_REPLICATE)
    for _ in range(ROUNDS):
        moved = sampled(step, place - moved, beyond=cv2.BORDER_REPLICATE)
    return place - moved


def pixel_indices(shape: tuple[int, ...]) -> Float[np.ndarray, "h w 2"]:
    """Column and row of every pixel, float32: places as `sampled` takes them (a pixel's centre is its index)."""
    columns, rows = np.meshgrid(np.arange(shape[1], dtype=np.float32), np.arange(shape[0], dtype=np.float32))
    return np.stack([columns, rows], axis=-1)


def sampled(
    image: Float[np.ndarray, "h w *c"], place: Float[np.ndarray, "h w 2"], *, beyond: int = cv2.BORDER_CONSTANT
) -> Float[np.ndarray, "h w *c"]:
    """The picture at places (px), linear between pixels; 0 beyond the border."""
    columns, rows = np.ascontiguousarray(place[..., 0]), np.ascontiguousarray(place[..., 1])
    return cv2.remap(np.ascontiguousarray(image), columns, rows, cv2.INTER_LINEAR, borderMode=beyond)
