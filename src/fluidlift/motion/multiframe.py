"""Flow from more than two frames: what stands still is taken out of the pictures, slow motion is measured over a gap.

A pair of frames shows the moving texture of a fluid and, on top of it, what does not move with it: the rim of a jet,
shading by standing waves, reflections, the bed seen through water, the banks. Estimators follow both and return a
compromise, 10 to 20 % too slow on textured water and nothing at all inside a jet. A running mean over a few frames,
subtracted from each, takes the still part away and leaves the moving part moving as before: a filter in time that is
the same at every frame commutes with translation. (The mean of the whole clip does not: what it keeps of the moving
texture stands still.) This is the minimum or mean background of particle image velocimetry (Honkanen, Nobach 2005) in
the logarithm of brightness, where still shading and albedo are sums and not factors (Stockham 1972).

What moves less than its own size over the filter is weakened by it, finally below the noise. Such places are measured
once more over a gap of several frames, without the filter.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from fluidlift.errors import require
from fluidlift.machine import cores
from fluidlift.motion.confidence import (
    ROUND_TRIP_FLOOR,
    ROUND_TRIP_SHARE,
    SHARED_FAILURE,
    TEXTURE_FLOOR,
    agreement_over_time,
    finite,
    grey,
    photometric_agreement,
    round_trip,
    texture_strength,
    there_and_back,
)
from fluidlift.numerics.short_axis import summed
from fluidlift.seams import FlowEstimator
from fluidlift.types import PixelFlow

T = TypeVar("T")
Progress = Callable[[int, int], None]
"""called with (steps done, steps in all)"""

REACH = 4
"""frames on either side that make the running mean. 3 to 8 are alike on seven simulated clips (mean error within 5 %);
2 loses an eighth, 1 fails: the mean of three frames is mostly the picture itself"""
SHORTEST = 5
"""frames of the shortest running mean (`REACH` 2); shorter clips are measured as they are"""
GAP = 4
"""frames over which slow motion is measured"""
SLOW = 1.0
"""px/frame: motion up to this is slow; from here on the running mean leaves enough of a texture some pixels large"""
DARK = 20.0
"""grey levels added before the logarithm: below, noise and black level are larger than what light does. 7 and 40 give
the same error within 1 %"""
TRIM = 2.5
"""standard deviations of a pixel's own spread beyond which a frame is left out of its mean"""
EVIDENCE = 0.5
"""sum of confidences at which a mean deserves a confidence of one half: a pixel that is textured in a few frames only,
as foam passes, is known from those frames"""
LEAST_SPREAD = 0.05
"""px; frames that agree better than that are not told apart"""
NOISE_GRADIENT = 0.5
"""grey levels per px: root mean square gradient, smoothed as `texture_strength` does, of white noise of 2.5 levels"""
STILL_SHARE = 0.25
"""of the texture of a picture: less moving detail than this may be left over from a still thing that trembles"""
NEAR = 12.0
"""px: standard deviation of the surroundings in which moving detail makes rest doubtful"""
NO_TRUST = 1e-4
"""weight of a frame without confidence in a mean over time: that of a confidence of one hundredth"""
MOST_AT_ONCE = 4
"""pairs that are measured side by side: each needs some thirty pictures' worth of arrays"""
HALVED_FROM = 200
"""px of the shorter side from which slow motion is measured at half the resolution: with 208 errors are the same, on
a made clip of 64 px the first frame of its asset came out 7 % further from the clip"""
WORTH_A_LOOK = 0.01
"""share of the picture with texture and no detail that moves, from which slow motion is searched"""


@dataclass(frozen=True)
class Reading:
    """Flow between two pictures of moving detail, and what speaks for it."""

    displacement: Float[np.ndarray, "h w 2"]
    """px per frame"""
    moving: Float[np.ndarray, "h w"]
    """0 to 1: moving detail against noise and what trembles"""
    confidence: Float[np.ndarray, "h w"]
    """0 to 1"""


def running_window(pair: int, frames: int) -> tuple[int, int] | None:
    """Frames before and after each of the frames `pair` and `pair + 1` that make its running mean.

    Both have the same window, or their means would differ for another reason than motion. It is centred where the clip
    allows and shifted at its ends. None where fewer than `SHORTEST` frames fit.
    """
    before, after = pair, frames - 2 - pair
    length = min(2 * REACH + 1, before + after + 1)
    if length < SHORTEST:
        return None
    left = min(REACH, before, length - 1)
    right = min(length - 1 - left, after)
    return length - 1 - right, right


def moving_detail(
    frames: UInt8[np.ndarray, "t h w 3"], pair: int
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]] | None:
    """Log brightness of the frames `pair` and `pair + 1` less their running means, float32.

    Args:
        frames: sRGB, or grey [T,H,W]; only the frames of the window are read, one after the other.
        pair: number of the first frame.

    Returns:
        Two pictures; None where the clip is too short for a running mean.
    """
    window = running_window(pair, len(frames))
    if window is None:
        return None
    before, after = window
    samples = [log_brightness(frames[pair + k]) for k in (-before, after + 1, 0, 1)]
    shared = np.zeros_like(samples[0])
    for k in range(1 - before, after + 1):
        shared += samples[2] if k == 0 else samples[3] if k == 1 else log_brightness(frames[pair + k])
    count = before + after + 1
    return samples[2] - (shared + samples[0]) / count, samples[3] - (shared + samples[1]) / count


def log_brightness(image: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
    """log(luma + `DARK`), float32."""
    return cv2.LUT(grey(image), _LOGARITHM)


_LOGARITHM = np.log(np.arange(256, dtype=np.float32) + DARK).reshape(1, 256)


def flow_of_detail(
    detail: tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]],
    picture: UInt8[np.ndarray, "h w 3"],
    estimator: FlowEstimator,
    step: int = 1,
) -> Reading:
    """Flow between two pictures of moving detail.

    Confidence is the product of three tests, see `motion.confidence`: the round trip, the agreement of the pictures,
    and texture against noise.

    Args:
        detail: from `moving_detail`.
        picture: the first of the frames.
        estimator: of flow between two pictures.
        step: frames from the first to the second.
    """
    first, second = as_pictures(detail)
    forward, backward, own = there_and_back(estimator, first, second)
    texture = _texture_in_grey_levels(detail[0], picture)
    tests = (
        round_trip(forward, backward)
        * photometric_agreement(*detail, forward)
        * (texture / (texture + NOISE_GRADIENT**2))
    )
    return Reading(forward / step, _moving_share(texture, picture), own * tests**SHARED_FAILURE)


def moving_share(detail: Float[np.ndarray, "h w"], picture: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
    """0 to 1: texture of what moves against noise and against what trembles, float32."""
    return _moving_share(_texture_in_grey_levels(detail, picture), picture)


def _moving_share(texture: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """As `moving_share`, of the squared texture of what moves, in grey levels per px."""
    still = (STILL_SHARE * texture_strength(picture)) ** 2
    return _decided(texture / (texture + still + NOISE_GRADIENT**2))


def _decided(evidence: np.ndarray) -> np.ndarray:
    """The odds squared: a half stays a half, but little evidence becomes next to none.

    What no evidence speaks for is arbitrary and may be many pixels long; a few per cent of it would be seen.
    """
    return evidence**2 / (evidence**2 + (1.0 - evidence) ** 2)


def as_pictures(
    detail: tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]],
) -> tuple[UInt8[np.ndarray, "h w"], UInt8[np.ndarray, "h w"]]:
    """Detail stretched to 8 bits around 128, both alike, the strongest hundredth of the first clipped.

    Sparks and highlights are the strongest detail of water and move in their own ways. Each picture is measured from
    its own median: a lamp that flickers adds the same to the logarithm everywhere.
    """
    first, second = (d - np.median(d[::4, ::4]) for d in detail)
    scale = 110.0 / max(float(np.percentile(np.abs(first[::2, ::2]), 99)), 1e-3)
    first, second = (np.clip(np.rint(d * scale) + 128, 18, 238).astype(np.uint8) for d in (first, second))
    return first, second


def _texture_in_grey_levels(detail: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """Squared: gradients of log brightness times brightness are in grey levels per px, as noise is."""
    return (texture_strength(detail) * (grey(picture).astype(np.float32) + DARK)) ** 2


def result_arrays(
    frames: UInt8[np.ndarray, "t h w 3"], out: tuple[np.ndarray, np.ndarray] | None
) -> tuple[np.ndarray, np.ndarray]:
    """Where the flow of a clip goes: displacement [T-1,H,W,2] and confidence [T-1,H,W], `out` or new arrays.

    Raises:
        ValueError: `out` of another shape, or not of a floating type.
    """
    shape = (len(frames) - 1, *frames.shape[1:3])
    if out is None:
        return np.empty((*shape, 2), np.float32), np.empty(shape, np.float16)
    for array, name, wanted in zip(out, ("displacement", "confidence"), ((*shape, 2), shape), strict=True):
        require(
            array.shape == wanted and np.issubdtype(array.dtype, np.floating),
            f"{name} to fill {array.shape} {array.dtype}",
            f"a floating type, {wanted}",
        )
    return out


def multiframe_flow(
    frames: UInt8[np.ndarray, "t h w 3"],
    estimator: FlowEstimator,
    progress: Progress | None = None,
    *,
    out: tuple[np.ndarray, np.ndarray] | None = None,
) -> PixelFlow:
    """Flow of every neighbouring pair, each measured with its neighbours in time.

    First `flow_with_rest` of every pair by itself; then each pair once more in a frame that moves with the mean of its
    neighbours (`refined`); then trust is lowered where a pair disagrees with the pairs before and after it.

    Args:
        frames: sRGB, possibly memory-mapped; a few are read at a time.
        estimator: of flow between two pictures.
        progress: called after each step.
        out: as for `optical_flow.estimate_flow`; it holds what is still to be refined, so that nothing else grows with
            the clip. float16 rounds that by 1/2000.

    Raises:
        ValueError: fewer than `SHORTEST` + 1 frames, or an `out` that does not fit.
    """
    require(running_window(0, len(frames)) is not None, f"{len(frames)} frames", f"at least {SHORTEST + 1}")
    displacement, confidence = result_arrays(frames, out)
    pairs = len(displacement)
    each = ((frames, t, estimator) for t in range(pairs))
    for t, found in enumerate(each_pair(flow_with_rest, each, estimator)):
        displacement[t], confidence[t] = found
        if progress is not None:
            progress(t + 1, 2 * pairs)

    def with_surroundings() -> Iterator[tuple[np.ndarray, int, np.ndarray, np.ndarray, FlowEstimator]]:
        window: deque[_Weighed] = deque(maxlen=2 * REACH + 1)  # copies: what the array holds is overwritten below
        for t in range(-REACH, pairs):
            if t + REACH < pairs:
                window.append(_Weighed.of(displacement[t + REACH], confidence[t + REACH]))
            elif t > REACH:
                window.popleft()
            if t >= 0:
                yield frames, t, window[min(t, REACH)].displacement, _trusted_mean(window), estimator

    for t, better in enumerate(each_pair(refined, with_surroundings(), estimator)):
        displacement[t] = better
        if progress is not None:
            progress(pairs + t + 1, 2 * pairs)
    for t in range(pairs):
        before, here, after = (
            np.asarray(displacement[k], np.float32) if 0 <= k < pairs else None for k in (t - 1, t, t + 1)
        )
        assert here is not None
        confidence[t] *= agreement_over_time(before, here, after).astype(np.float16)
    return PixelFlow(displacement, confidence)


def each_pair(measured: Callable[..., T], calls: Iterable[tuple], estimator: FlowEstimator) -> Iterator[T]:
    """What `measured` finds for each of the calls' arguments, in order.

    Pairs are measured side by side where the estimator bears it: OpenCV's search itself uses hardly more than one
    thread. No more calls are begun ahead than there are threads, so memory stays that of a few pictures.
    """
    threads = min(cores(), MOST_AT_ONCE)
    if threads < 2 or not estimator.any_thread:
        for arguments in calls:
            yield measured(*arguments)
        return
    begun: deque[Future[T]] = deque()
    with ThreadPoolExecutor(threads, "flow") as pool:
        try:
            for arguments in calls:
                begun.append(pool.submit(measured, *arguments))
                if len(begun) > threads:
                    yield begun.popleft().result()
            while begun:
                yield begun.popleft().result()
        finally:
            for call in begun:
                call.cancel()


def flow_with_rest(
    frames: UInt8[np.ndarray, "t h w 3"], pair: int, estimator: FlowEstimator
) -> tuple[Float[np.ndarray, "h w 2"], Float[np.ndarray, "h w"]]:
    """Displacement (px/frame) and confidence of one pair, both float32.

    Two answers, each where it has evidence: motion of the detail between the two frames; and, where the picture has
    texture but next to none of it moves within the running mean, slow motion or rest, from the pictures as they are
    `GAP` frames apart. Rest beside moving fluid is doubtful, it may be the bed seen through it: there the estimator's
    own filling stays, with little confidence.
    """
    detail = moving_detail(frames, pair)
    assert detail is not None, "the clip was found long enough"
    fast = flow_of_detail(detail, frames[pair], estimator)
    texture = texture_strength(frames[pair]) ** 2
    texture = texture / (texture + TEXTURE_FLOOR**2)
    apart = 1.0 - cv2.GaussianBlur(fast.moving, (0, 0), NEAR)
    share = (1.0 - fast.moving) * _decided(texture * apart)
    if float(share.mean()) < WORTH_A_LOOK:
        return fast.displacement, fast.confidence * fast.moving
    gap = min(GAP, len(frames) - 1)
    start = int(np.clip(pair - (gap - 1) // 2, 0, len(frames) - 1 - gap))
    ends = log_brightness(frames[start]), log_brightness(frames[start + gap])
    # an error of half a pixel over the gap is an eighth per frame
    coarser = estimator.halved if min(frames.shape[1:3]) >= HALVED_FROM else estimator
    slow = flow_of_detail(ends, frames[start], coarser, gap)
    speed = summed(slow.displacement**2)
    share = share / (1.0 + (speed / SLOW**2) ** 2)
    displacement = fast.displacement + share[..., None] * (slow.displacement - fast.displacement)
    # little detail moves, but it moves as the pictures do: the two support each other, unless both say rest
    between = summed((slow.displacement - fast.displacement) ** 2)
    tolerance = ROUND_TRIP_FLOOR**2 + ROUND_TRIP_SHARE**2 * speed
    agreed = tolerance / (tolerance + between) * speed / (speed + ROUND_TRIP_FLOOR**2)
    support = np.maximum(fast.moving, slow.confidence * agreed)
    return displacement, support * fast.confidence + (1.0 - support) * slow.confidence * share * apart**4


def refined(
    frames: UInt8[np.ndarray, "t h w 3"],
    pair: int,
    displacement: Float[np.ndarray, "h w 2"],
    mean: Float[np.ndarray, "h w 2"],
    estimator: FlowEstimator,
) -> Float[np.ndarray, "h w 2"]:
    """The flow of a pair measured once more in a frame that moves with the mean of its neighbours; float32, px/frame.

    The second picture is drawn back by `mean`, and what is still to do is measured: small motion, which no estimator
    loses on the way from coarse to fine, and whose smoothness term pulls towards the mean and not towards zero. A
    remainder is believed where it is small or where the pair by itself had said the same: two measurements that agree
    are a fluctuation, others more often a wrong match. The tolerance is that of the round trip.

    Args:
        frames: sRGB.
        pair: number of the first frame.
        displacement: of the pair so far, kept where nothing but slow motion was seen.
        mean: of the pairs around it.
        estimator: of flow between two pictures.
    """
    detail = moving_detail(frames, pair)
    assert detail is not None, "the clip was found long enough"
    h, w = detail[0].shape
    u, v = np.meshgrid(np.arange(w, dtype=np.float32), np.arange(h, dtype=np.float32))
    back = cv2.remap(detail[1], u + mean[..., 0], v + mean[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    first, second = as_pictures((detail[0], back))
    remainder = finite(estimator.displacement(first, second))
    found = mean + remainder
    tolerance = ROUND_TRIP_FLOOR**2 + ROUND_TRIP_SHARE**2 * summed(mean**2)
    doubt = np.minimum(summed(remainder**2), summed((found - displacement) ** 2))
    found = mean + (tolerance / (tolerance + doubt))[..., None] * remainder
    moving = moving_share(detail[0], frames[pair])[..., None]
    return (moving * found + (1.0 - moving) * displacement).astype(np.float32)


@dataclass(frozen=True)
class _Weighed:
    """The flow of a pair in the mean of its neighbours: worked out once, and asked for by each of them."""

    displacement: Float[np.ndarray, "h w 2"]
    """px/frame"""
    weight: Float[np.ndarray, "h w"]
    """as in `mean_flow`"""
    moved: Float[np.ndarray, "h w 2"]
    """displacement times weight"""

    @classmethod
    def of(cls, displacement: np.ndarray, confidence: np.ndarray) -> _Weighed:
        """Of a pair; float32."""
        own, weight = np.array(displacement, np.float32), confidence.astype(np.float32) ** 2 + NO_TRUST
        return cls(own, weight, weight[..., None] * own)


def _trusted_mean(window: Iterable[_Weighed]) -> np.ndarray:
    """Mean of displacements, float32 [H,W,2]; without any trust the plain mean."""
    total = moved = np.float32(0)
    for pair in window:
        total = total + pair.weight
        moved = moved + pair.moved
    return moved / np.asarray(total)[..., None]


def mean_flow(
    flow: PixelFlow,
    mask: Bool[np.ndarray, "*t h w"] | None = None,
) -> tuple[Float[np.ndarray, "h w 2"], Float[np.ndarray, "h w"]]:
    """The mean motion of a steady fluid over all pairs of `flow`, robust against failures of single frames.

    The mean at a pixel is weighted with confidence; then frames further than `TRIM` times the pixel's own spread from
    it are left out, and the mean is taken once more. Spread, and not a fixed distance, decides: real fluctuation
    widens the spread and stays in, so a turbulent mean is not dragged to its mode.

    Args:
        flow: the window of frames.
        mask: the fluid [H,W] or [T',H,W] with T' at least the number of pairs; where absent the pixel counts nothing.

    Returns:
        displacement float32 [H,W,2] px/frame and confidence float32 [H,W]: that of the frames which count, lowered
        where they add up to little evidence and where the standard error of the mean is large.
    """
    d = flow.displacement
    # failures are many and alike (near zero motion): squaring keeps a crowd of them from outvoting good frames. Where
    # no frame is trusted the mean is the plain one
    weight = flow.confidence.astype(np.float32) ** 2 + NO_TRUST
    if mask is not None:
        mask = np.asarray(mask, bool)
        weight = weight * (mask[: len(d)] if mask.ndim == 3 else mask[None])
    mean = _weighted_mean(d, weight)
    for _ in range(2):
        distance = summed((d - mean) ** 2)
        total = np.maximum(weight.sum(axis=0), 1e-6)
        spread = (weight * distance).sum(axis=0) / total
        kept = np.where(distance <= TRIM**2 * np.maximum(spread, LEAST_SPREAD**2), weight, 0.0)
        mean = _weighted_mean(d, kept)
    total = kept.sum(axis=0)
    held = np.maximum(total, 1e-6)
    typical = (kept * flow.confidence).sum(axis=0) / held
    deviation = (kept * summed((d - mean) ** 2)).sum(axis=0) / held
    frames = total**2 / np.maximum((kept**2).sum(axis=0), 1e-6)
    tolerance = ROUND_TRIP_FLOOR**2 + ROUND_TRIP_SHARE**2 * summed(mean**2)
    certain = tolerance / (tolerance + deviation / np.maximum(frames, 1.0))
    return mean, (typical * certain * total / (total + EVIDENCE**2)).astype(np.float32)


def _weighted_mean(d: np.ndarray, weight: np.ndarray) -> np.ndarray:
    total = np.maximum(weight.sum(axis=0), 1e-6)
    return np.stack([(weight * d[..., c]).sum(axis=0) / total for c in (0, 1)], axis=-1).astype(np.float32)
