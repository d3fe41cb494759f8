"""Motion segmentation cues for fluid: change against the clip's own noise, and motion that goes somewhere.

Nothing here but `CARRIED` was fitted to data. All thresholds are relative to the noise of the clip, which is read from
the quietest part of the picture, separately for flat and for sharply drawn places: where an edge is sharp, the
slightest tremble of the camera or of the codec changes the brightness.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

from fluidlift.numerics.short_axis import summed
from fluidlift.shape.frame_pictures import (
    FramePictures,
    burst_length,
    sampled_frames,
    shown,
    shrink,
    working_scale,
)
from fluidlift.types.clip import VideoClip
from fluidlift.types.flow import PixelFlow

PairReader = Callable[[int], tuple[np.ndarray, np.ndarray]]
"""displacement [H,W,2] (px) and confidence [H,W] from frame t to t + 1"""


def pair_reader(flow: PixelFlow | PairReader) -> PairReader:
    """What reads the flow of a pair, of either form."""
    return flow if callable(flow) else (lambda t: (flow.displacement[t], flow.confidence[t]))


def in_order(flow: PairReader, pairs: Iterable[int]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """The flow of some pairs, one after the other; a reader with a method of this name measures several at a time."""
    ahead = getattr(flow, "in_order", None)
    return map(flow, pairs) if ahead is None else ahead(pairs)


USUAL_RATE = 30.0
"""1/s, frame rate of the clips that the numbers here were seen on (24 to 30). Of a clip with twice as many frames or
more, frames that lie as far apart are compared: from one to the next too little moves to tell it from noise"""
QUANTISATION = 0.3
"""mean absolute change between two 8-bit readings of the same brightness, grey levels: a floor for the noise"""
QUIET_QUANTILE = 0.2
"""the part of the picture that is assumed to show no fluid, at each sharpness of edges"""

POOLING = 0.008
"""radius over which evidence is shared between neighbours, parts of the longer side"""
LARGEST_TREMBLE = 0.25
"""px, mean displacement of a still thing between frames of a stabilised clip"""
LEAST_STEP = 0.1
"""px per frame: typical motion of a place below which its course is that of the noise"""
CARRIED, PER_CARRIED = 0.35, 30.0
"""share of change above which it speaks for a solid, and log odds against fluid per unit above it (logistic regression
on both over 28 real clips, in units of the score's: `benchmarks/masks_fit.py`). Where the score speaks for fluid, real
fluids have 0.01 to 0.25 (80th percentile, moving cameras apart), hands, jugs, kettles and a passer-by 0.4 to 0.7"""
UNLIKELY = -3.0
"""log odds below which being carried puts no place: spray that drifts with its fall may be, and colours and edges tell
it from a hand, which they cannot once it is beyond doubt"""


@dataclass(frozen=True)
class Evidence:
    """Maps at working size [h,w], smaller than the clip by `scale`."""

    source: FramePictures
    """picture of any frame"""
    lively: float
    """mean change between neighbouring frames over the picture, in units of the noise; less than a tenth of it is a
    frame that was repeated"""
    activity: np.ndarray
    """float32 [h,w], log of the mean change in units of the noise, pooled over neighbours"""
    fine_activity: np.ndarray
    """float32 [h,w], the same, hardly pooled"""
    swaying: np.ndarray
    """float32 [h,w] in [0,1], change that is explained by motion that goes nowhere"""
    streaming: np.ndarray
    """float32 [h,w] in [0,1], motion that goes somewhere, where there is change"""
    carried: np.ndarray
    """float32 [h,w] in [0,1], change that is explained by motion of a place that does not go on the same way"""
    level: float
    """activity that separates still from moving"""
    noise: np.ndarray
    """float32 [h,w], mean absolute change that a still thing would show, grey levels"""
    scale: float

    @property
    def pictures(self) -> np.ndarray:
        """float16 [S,h,w,3], brightness and two colour differences of the sampled frames, global flicker removed."""
        return self.source.kept

    @property
    def typical(self) -> np.ndarray:
        """float32 [h,w,3], median of at most 31 of the pictures, not to be written into."""
        return self.source.typical

    @property
    def colours(self) -> np.ndarray:
        """u8 [h,w,3], sRGB, of the same."""
        return shown(self.typical)

    def without_carried(self) -> Evidence:
        """The same, where nothing is held to be carried through the picture."""
        return replace(self, carried=np.zeros_like(self.carried))


def distance_of_pictures(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """float32 [h,w]: absolute difference, colour counted as brightness is."""
    return summed(np.abs(first.astype(np.float32) - second.astype(np.float32)))


def pool(log_ratio: np.ndarray, sigma: float) -> np.ndarray:
    """Local mean (Gaussian, `sigma` px) of a log ratio taken of its square root: single sparks count less."""
    return 2.0 * np.log(cv2.GaussianBlur(np.exp(0.5 * log_ratio), (0, 0), sigma))


def sharpness(picture: np.ndarray) -> np.ndarray:
    """Gradient magnitude of float32 [h,w,3], summed over channels, spread by a pixel (what a tremble would reach)."""
    steep = np.zeros(picture.shape[:2], np.float32)
    for channel in range(3):
        plane = np.ascontiguousarray(picture[..., channel], np.float32)
        steep += np.hypot(
            cv2.Sobel(plane, cv2.CV_32F, 1, 0, scale=0.125), cv2.Sobel(plane, cv2.CV_32F, 0, 1, scale=0.125)
        )
    return cv2.dilate(steep, np.ones((3, 3), np.uint8))


def noise_map(change: np.ndarray, steep: np.ndarray, *, bins: int = 10) -> np.ndarray:
    """Change that a still thing of this sharpness shows, float32 [h,w], grey levels.

    base + tremble * steep, where tremble is a displacement in px. In each of `bins` classes of sharpness the quiet
    quantile of the change is read; the base is that of the quietest class. A class that the fluid fills would make
    the fluid its own noise, so the tremble is the least that any class shows, and below `LARGEST_TREMBLE`.
    """
    edges = np.geomspace(0.5, max(float(steep.max()), 1.0), bins)
    classes = np.digitize(steep, edges)
    base, trembles = np.inf, [LARGEST_TREMBLE]
    for number in range(bins + 1):
        inside = classes == number
        if inside.mean() < 0.005:
            continue
        quiet = float(np.quantile(change[inside], QUIET_QUANTILE))
        base = min(base, quiet)
        if number > bins // 3:
            trembles.append(max(quiet - base, 0.0) / float(np.median(steep[inside])))
    return (max(base, QUANTISATION) + min(trembles) * steep).astype(np.float32)


def lagged_change(pictures: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """float32 [h,w]: mean absolute difference of pairs (int [n,2]) of pictures."""
    total = np.zeros(pictures.shape[1:3], np.float32)
    for first, second in pairs:
        total += distance_of_pictures(pictures[first], pictures[second])
    return total / max(len(pairs), 1)


def change_between(first: np.ndarray, second: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """float32 [h,w]: change in units of the noise, at least those of its own quiet part (a hand that trembles)."""
    ratio = distance_of_pictures(first, second) / noise
    return np.minimum(ratio / max(1.0, float(np.quantile(ratio, QUIET_QUANTILE))), 1e4)


def change_over_time(evidence: Evidence) -> Iterator[np.ndarray]:
    """float32 [h,w] for every frame: mean change over the intervals before and after it, in units of the noise.

    A repeated frame (an interval without any change) takes the change of the interval before.
    """
    source = evidence.source
    before = None
    here = source[0]
    for t in range(len(source)):
        after = before
        if t + 1 < len(source):
            following = source[t + 1]
            after = change_between(here, following, evidence.noise)
            here = following
            if before is not None and float(after.mean()) < 0.1 * evidence.lively:
                after = before
        if after is None:
            raise ValueError("a single frame has no change")
        yield after if before is None else 0.5 * (before + after)
        before = after


def flow_evidence(
    source: FramePictures, flow: PairReader, scale: float, noise: np.ndarray, lag: int = 1
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Swaying, streaming and being carried, each float32 [h,w] in [0,1], over the sampled frames, `lag` apart.

    A leaf moves to and fro: its flow explains the change of brightness well (small residual after warping) but sums
    to nearly nothing. A stream either goes somewhere (large sum) or changes in ways that no motion explains. A hand, a
    jug or a passer-by is carried: its flow explains the change too, but is not the same at a place for long, where a
    current that keeps its look keeps its course.
    """
    height, width = noise.shape
    sigma = 0.012 * max(height, width)
    rows, columns = np.mgrid[0:height, 0:width].astype(np.float32)
    walked = np.zeros((height, width, 2), np.float32)
    farthest, path = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    before, after = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    total, squares = np.zeros((height, width, 2), np.float32), np.zeros((height, width), np.float32)
    pairs = source.pairs(lag)
    pairs = pairs[source.sampled[pairs[:, 0]] % lag == 0]
    flows = in_order(flow, [int(source.sampled[one]) + k for one, _ in pairs for k in range(lag)])
    for one, other in pairs:
        # what a place sees in all of these frames: it moves by less than it is pooled over
        steps = [next(flows) for _ in range(lag)]
        displacement = np.sum([np.nan_to_num(np.asarray(d, np.float32)) for d, _ in steps], axis=0)
        confidence = np.min([np.asarray(c, np.float32) for _, c in steps], axis=0)
        sure, step = shrink(confidence, scale)[..., None], shrink(displacement, scale) * scale
        first, second = source.kept[one].astype(np.float32), source.kept[other].astype(np.float32)
        warped = cv2.remap(
            second, columns + step[..., 0], rows + step[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        before += distance_of_pictures(second, first)
        after += distance_of_pictures(warped, first)
        walked += step * np.clip(sure, 0.0, 1.0)
        path += np.hypot(step[..., 0], step[..., 1])
        total += step
        squares += summed(step**2)
        np.maximum(farthest, np.hypot(walked[..., 0], walked[..., 1]), out=farthest)
    floor = noise * len(pairs)
    before, after = (cv2.GaussianBlur(np.maximum(x - floor, 0.0), (0, 0), sigma) for x in (before, after))
    explained = np.clip(1.0 - after / (before + 0.2 * floor), 0.0, 1.0)
    gone = farthest / (0.04 * max(height, width))
    direct = farthest / (path + 0.5)
    swaying = explained * np.exp(-(gone**2)) * (1.0 - direct)
    streaming = direct * (1.0 - np.exp(-(gone**2))) * (before > floor)
    count = max(len(pairs), 1)
    mean, typical = np.hypot(total[..., 0], total[..., 1]) / count, np.sqrt(squares / count)
    moves = np.minimum(typical / LEAST_STEP, 1.0) * (before > 0.5 * floor)
    carried = explained * moves * (1.0 - np.minimum(mean / np.maximum(typical, LEAST_STEP), 1.0))
    return swaying.astype(np.float32), streaming.astype(np.float32), carried.astype(np.float32)


def gather_evidence(clip: VideoClip, flow: PixelFlow | PairReader) -> Evidence:
    """All maps of one clip of at least 2 frames; a long clip is looked at in bursts (`sampled_frames`)."""
    pair = pair_reader(flow)
    frames, height, width = clip.frames.shape[:3]
    scale = working_scale(height, width)
    source = FramePictures(clip.frames, sampled_frames(frames, clip.interval), scale)
    pictures = source.kept
    steep = sharpness(source.typical)
    longest = max(1, burst_length(frames, clip.interval) // 3)
    slow_lag = int(np.clip(round(0.2 / clip.interval), 1, longest))
    lag = int(np.clip(round(1.0 / (USUAL_RATE * clip.interval)), 1, slow_lag))
    quick, slow = lagged_change(pictures, source.pairs(lag)), lagged_change(pictures, source.pairs(slow_lag))
    noise, slow_noise = noise_map(quick, steep), noise_map(slow, steep)
    fine = 0.5 * (np.log(np.maximum(quick, 1e-3) / noise) + np.log(np.maximum(slow, 1e-3) / slow_noise))
    fine = np.maximum(fine, 0.0).astype(np.float32)
    pooled = pool(fine, POOLING * max(noise.shape))
    swaying, streaming, carried = flow_evidence(source, pair, scale, noise, lag)
    energy = [float(change_between(pictures[i], pictures[j], noise).mean()) for i, j in source.pairs(1)]
    return Evidence(
        source=source,
        lively=float(np.median(energy)),
        activity=pooled,
        fine_activity=pool(fine, 1.0),
        swaying=swaying,
        streaming=streaming,
        carried=carried,
        level=separating_level(pooled),
        noise=noise,
        scale=scale,
    )


def fluid_score(evidence: Evidence) -> np.ndarray:
    """Log odds of fluid for the whole clip, float32 [h,w].

    The divisor is the spread of the log activity of still things about their own mean, seen in clips of still rooms.
    """
    height, width = evidence.noise.shape
    both = 0.5 * (evidence.activity + evidence.fine_activity) - evidence.level
    score = both / 0.3 + 1.5 * evidence.streaming - 2.5 * evidence.swaying
    carried = score - PER_CARRIED * np.maximum(evidence.carried - CARRIED, 0.0)
    score = np.maximum(carried, np.minimum(score, UNLIKELY))
    return np.clip(score, -12.0, 12.0).astype(np.float32).reshape(height, width)


def solids_by_flow(evidence: Evidence) -> np.ndarray:
    """bool [h,w]: what is carried so clearly that change does not speak for fluid there."""
    return PER_CARRIED * (evidence.carried - CARRIED) > 4.0


def separating_level(activity: np.ndarray, *, lowest: float = np.log(1.8), highest: float = np.log(10.0)) -> float:
    """Otsu's threshold of the activity, held between factors of the noise that cannot be doubted."""
    top = min(max(float(activity.max()), 1e-3), float(np.log(100.0)))
    return float(np.clip(otsu_threshold(np.minimum(activity, np.log(100.0)), 0.0, top), lowest, highest))


def otsu_threshold(values: np.ndarray, lowest: float, highest: float) -> float:
    """What parts values between two bounds into two classes that differ most (Otsu 1979), over 128 bins."""
    counts, edges = np.histogram(values, bins=128, range=(lowest, highest))
    centres = 0.5 * (edges[1:] + edges[:-1])
    weight = np.cumsum(counts)
    mass = np.cumsum(counts * centres)
    rest = weight[-1] - weight
    with np.errstate(divide="ignore", invalid="ignore"):
        between = weight * rest * (mass / weight - (mass[-1] - mass) / rest) ** 2
    between = np.nan_to_num(between)
    return float(centres[between >= (1.0 - 1e-3) * between.max()].mean())  # the middle of a gap between two classes
