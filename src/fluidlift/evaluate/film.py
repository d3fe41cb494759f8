"""What a film of a fluid is like over time: statistics of its pictures, place by place. Pure functions on arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from fluidlift.motion.optical_flow import DenseInverseSearch, each_pair
from fluidlift.types.fluid_masks import outline_grows

BANDS = 4
"""of the Laplacian pyramid, the finest first: details of 1, 2, 4 and 8 px"""
ZONES = 4
"""along each side of the fluid's bounding box, in which colours are compared"""
MOST = 16
"""frames, and pairs of them, that a costly figure is taken from, evenly spread: more change it in its third digit"""
LATE = 2.0 / 3.0
"""share of the frames before the last third, whose current, bands and colours count: there a re-simulation has left
what it was given"""
LAGS = (0.2, 0.5, 1.0)
"""s after which the picture is looked for downstream: less than, about and more than the life of a ripple"""
STARTS = 8
"""frames from which it is followed"""
LEAST = 64
"""px: of fewer, a mean says nothing"""
RING = (2.0 / 512.0, 12.0 / 512.0)
"""begin and end of the ring around the fluid, over the longer side of the picture: beyond the blur of the edge, and no
further than where a wrong level shows"""
CELL = 1.0 / 32.0
"""side of the places in which foam is counted, over the longer side of the picture"""

SURE_GROWTH = 2.0
"""standard errors by which a fluid's area must grow over a clip"""
STILL = 0.2
"""of what a fluid has grown from the first quarter of a clip to the last, that it grows within the second half at
least: at one rate it is a third; of a wave that comes back, 0"""
FEWEST_ALONE = 3.0
"""frames that count as independent at least: a straight line must explain 0.8 of what varies then; of a whole wave,
which comes back, it explains 6 / pi^2 = 0.61"""

NO_MAP: Any = None
"""OpenCV takes the rows from a second map unless there is none, which its stub does not know"""


@dataclass(frozen=True)
class Places:
    """Where in the picture the fluid of a clip is."""

    fluid: Bool[np.ndarray, "h w"]
    """in more than half of the frames"""
    steady: Bool[np.ndarray, "h w"]
    """in more than half of the frames of either half of the clip"""
    always: Bool[np.ndarray, "h w"]
    never: Bool[np.ndarray, "h w"]
    ring: Bool[np.ndarray, "h w"]
    """around all that was ever fluid"""
    zones: Int[np.ndarray, "h w"]
    """number of the zone in the bounding box of `fluid`"""

    @staticmethod
    def of(masks: Bool[np.ndarray, "t h w"]) -> Places:
        """From where fluid was filmed in each frame."""
        half = max(len(masks) // 2, 1)
        first, second = masks[:half].mean(axis=0) > 0.5, masks[-half:].mean(axis=0) > 0.5
        fluid, ever, always = masks.mean(axis=0) > 0.5, np.any(masks, axis=0), np.all(masks, axis=0)
        longer = max(fluid.shape)
        near, far = (_grown(ever, max(round(r * longer), least)) for r, least in zip(RING, (1, 3)))
        return Places(fluid, first & second, always, ~ever, far & ~near, _zones(fluid))

    @property
    def stays(self) -> float:
        """Share of what is mostly fluid in one half of the clip that is so in both: 1 where the outline stays."""
        return float(self.steady.sum() / max(int((self.fluid | self.steady).sum()), 1))


def growth(masks: Bool[np.ndarray, "t h w"]) -> float:
    """Share of its mean area by which a fluid grows from frame to frame (negative: shrinks), as in a vessel that fills.

    Least squares over the frames; 0 where it is less than `SURE_GROWTH` standard errors, as with waves on a beach. What
    is left over of neighboring frames is alike: of n with a correlation r, n (1 - r) / (1 + r) are independent. A
    vessel need not fill at one rate: an outline that grows counts as well where it still does at the end.
    """
    areas = masks.reshape(len(masks), -1).sum(axis=1).astype(float)
    if len(masks) < 3 or areas.std() <= 1e-9 * areas.mean():
        return 0.0
    time = np.arange(len(masks)) - 0.5 * (len(masks) - 1)
    slope = float(time @ areas / (time @ time))
    rest = areas - areas.mean() - slope * time
    power = float(rest @ rest)
    alike = min(max(float(rest[1:] @ rest[:-1]) / power, 0.0), 1.0) if power > 0 else 0.0
    alone = max(len(masks) * (1.0 - alike) / (1.0 + alike), FEWEST_ALONE)
    surely = slope * slope * float(time @ time) * (alone - 2.0) > SURE_GROWTH**2 * power
    return slope / float(areas.mean()) if surely or _still_grows(masks, areas) else 0.0


def _still_grows(masks: Bool[np.ndarray, "t h w"], areas: Float[np.ndarray, " t"]) -> bool:
    """Whether an outline grows, and does so in the last quarter of a clip: what comes back has grown before."""
    quarter = max(len(areas) // 4, 1)
    first, before, last = (float(part.mean()) for part in (areas[:quarter], areas[-2 * quarter : -quarter],
                                                           areas[-quarter:]))  # fmt: skip
    return last - before > STILL * (last - first) > 0.0 and outline_grows(masks)


def _grown(mask: np.ndarray, radius: int) -> np.ndarray:
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)).astype(bool)


def _zones(fluid: np.ndarray) -> np.ndarray:
    """int32 [H,W] in 0 to ZONES^2 - 1; what is outside of the box belongs to the nearest."""
    found = []
    for axis, size in enumerate(fluid.shape):
        on = np.flatnonzero(fluid.any(axis=1 - axis))
        low, high = (int(on[0]), int(on[-1]) + 1) if len(on) else (0, size)
        found.append(np.clip((np.arange(size) - low) * ZONES // (high - low), 0, ZONES - 1))
    return (found[0][:, None] * ZONES + found[1]).astype(np.int32)


@dataclass(frozen=True)
class Foam:
    """What counts as foam in a clip: brighter than most of its water, and no more coloured than half of it."""

    brightness: float
    """level, 0 to 255"""
    saturation: float
    """(max - min) / max of the channels"""

    @staticmethod
    def of(frames: UInt8[np.ndarray, "t h w 3"], masks: Bool[np.ndarray, "t h w"]) -> Foam:
        """From the clip: its mean brightness and one standard deviation above it, and its median saturation."""
        pixels = np.concatenate([frames[t][masks[t]][::7] for t in spread(0, len(frames), MOST)])
        if len(pixels) < LEAST:
            return Foam(np.inf, 0.0)
        bright = pixels.max(axis=1).astype(np.float32)
        saturation = (bright - pixels.min(axis=1)) / np.maximum(bright, 1.0)
        return Foam(float(bright.mean() + bright.std()), float(np.median(saturation)))

    def share(self, picture: UInt8[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
        """Pixels that are foam."""
        # cv2 on whole channels: a reduction over an axis of three is slow
        channels = cv2.split(np.ascontiguousarray(picture))
        bright = cv2.max(cv2.max(channels[0], channels[1]), channels[2])
        dark = cv2.min(cv2.min(channels[0], channels[1]), channels[2])
        return (bright > self.brightness) & (bright.astype(np.float32) * (1.0 - self.saturation) <= dark)


@dataclass(frozen=True)
class FilmStatistics:
    """Of a film, in the fluid of each frame, and all of it where never is any."""

    mean: Float[np.ndarray, "h w 3"]
    """over time, levels 0 to 255; NaN where there never was a weight"""
    deviation: Float[np.ndarray, "h w"]
    """standard deviation of the brightness over time, levels"""
    bands: Float[np.ndarray, " b"]
    """mean absolute value of each band of the Laplacian pyramid in the last third, levels"""
    colours: Int[np.ndarray, "z 3 256"]
    """histograms of zones and channels in the last third"""
    foam: Float[np.ndarray, "h w"]
    """share of the time in which a pixel is foam"""
    flow: Float[np.ndarray, "h w 2"]
    """mean optical flow in the last third, px/frame; NaN where no pair shows fluid"""
    along: dict[float, float]
    """correlation of the picture, less its mean over time, with itself downstream after so many seconds"""


def spread(first: int, last: int, most: int) -> list[int]:
    """At most so many whole numbers from first to last (excluded), evenly spread."""
    return sorted({int(t) for t in np.linspace(first, last - 1, min(most, last - first)).round()})


def film_statistics(
    frames: UInt8[np.ndarray, "t h w 3"],
    masks: Bool[np.ndarray, "t h w"],
    places: Places,
    foam: Foam,
    *,
    interval: float,
    late: float = LATE,
    flow: Float[np.ndarray, "h w 2"] | None = None,
) -> FilmStatistics:
    """Statistics of a film.

    Args:
        frames: may be mapped from a file; one or two are read at a time.
        masks: pixels that count in each of them.
        places: of the clip.
        foam: of the clip.
        interval: s between frames.
        late: share of the frames before those that count for current, bands and colours.
        flow: its mean flow, where that is known (`mean_flows` of its `late_pairs`); None: it is measured.
    """
    shape = frames.shape[1:3]
    total, weight = np.zeros((*shape, 3), np.float64), np.zeros(shape, np.float64)
    grey, square, white = (np.zeros(shape, np.float64) for _ in range(3))
    for t in range(len(frames)):
        here = (masks[t] | places.never).astype(np.uint8)
        picture = np.ascontiguousarray(frames[t])
        brightness = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
        cv2.accumulate(picture, total, here)
        cv2.accumulate(brightness, grey, here)
        cv2.accumulateSquare(brightness, square, here)
        weight += here
        white += foam.share(picture) & here.astype(bool)
    with np.errstate(invalid="ignore"):
        mean, middle = total / weight[..., None], grey / weight
        deviation = np.sqrt(np.maximum(square / weight - middle**2, 0.0))
        share = white / weight
    flow = mean_flow(frames, masks, late_pairs(len(frames), late)) if flow is None else flow
    picks = spread(_first_late(len(frames), late), len(frames), MOST)
    lags = {lag: round(lag / interval) for lag in LAGS}
    along = along_the_flow(frames, masks, np.nan_to_num(middle), flow, lags)
    bands, colours = pyramid_bands(frames, masks, picks), colour_histograms(frames, masks, places.zones, picks)
    return FilmStatistics(mean, deviation, bands, colours, share, flow, along)


def late_pairs(frames: int, late: float = LATE) -> list[int]:
    """First frames of the pairs that the current of a film is taken from."""
    return spread(_first_late(frames, late), frames - 1, MOST)


def _first_late(frames: int, late: float) -> int:
    return min(int(late * frames), frames - 2)


def mean_flow(frames: np.ndarray, masks: np.ndarray, pairs: Sequence[int]) -> Float[np.ndarray, "h w 2"]:
    """Mean displacement from the frames `pairs` to those after them, px/frame, where they show fluid; else NaN."""
    return mean_flows(frames, masks, [pairs])[0]


def mean_flows(
    frames: np.ndarray, masks: np.ndarray, parts: Sequence[Sequence[int]]
) -> list[Float[np.ndarray, "h w 2"]]:
    """`mean_flow` of several parts of a film, each pair of which is measured once, in whichever parts it is."""
    estimator, pairs = DenseInverseSearch(), sorted({t for part in parts for t in part})
    totals, weights = ([np.zeros((*frames.shape[1:3], *more)) for _ in parts] for more in ((2,), ()))
    calls = ((frames[t], frames[t + 1]) for t in pairs)
    for t, move in zip(pairs, each_pair(estimator.displacement, calls, estimator)):
        moved = move * masks[t][..., None]
        for k, part in enumerate(parts):
            if t in part:
                totals[k] += moved
                weights[k] += masks[t]
    with np.errstate(invalid="ignore"):
        return [total / weight[..., None] for total, weight in zip(totals, weights)]


def pyramid_bands(frames: np.ndarray, masks: np.ndarray, picks: Sequence[int]) -> Float[np.ndarray, " b"]:
    """Mean absolute value of the bands of the brightness in the masks of some frames, levels; NaN without pixels."""
    total, weight = np.zeros(BANDS), np.zeros(BANDS)
    for t in picks:
        picture = cv2.cvtColor(np.ascontiguousarray(frames[t]), cv2.COLOR_RGB2GRAY).astype(np.float32)
        inside = masks[t].astype(np.float32)
        for band in range(BANDS):
            coarse = cv2.pyrDown(picture)
            fine = np.abs(picture - cv2.pyrUp(coarse, dstsize=picture.shape[1::-1]))
            on = inside > 0.5
            total[band] += fine[on].sum(dtype=np.float64)
            weight[band] += on.sum()
            picture, inside = coarse, cv2.resize(inside, coarse.shape[1::-1], interpolation=cv2.INTER_AREA)
    with np.errstate(invalid="ignore"):
        return total / weight


def colour_histograms(
    frames: np.ndarray, masks: np.ndarray, zones: Int[np.ndarray, "h w"], picks: Sequence[int]
) -> Int[np.ndarray, "z 3 256"]:
    """How often each level occurs in the masks of some frames, by zone and channel."""
    count = np.zeros((3, ZONES**2 * 256), np.int64)
    for t in picks:
        place = 256 * zones[masks[t]]
        pixels = frames[t][masks[t]]
        for channel in range(3):
            count[channel] += np.bincount(place + pixels[:, channel], minlength=count.shape[1])
    return count.reshape(3, ZONES**2, 256).transpose(1, 0, 2)


def along_the_flow(
    frames: np.ndarray,
    masks: np.ndarray,
    mean: Float[np.ndarray, "h w"],
    flow: Float[np.ndarray, "h w 2"],
    lags: dict[float, int],
) -> dict[float, float]:
    """How much of a picture is found again downstream after some time.

    Each point is carried with the mean flow, which does not change in time, and the brightness less its mean over time
    is correlated with that at its new place: 1 for a pattern that is only moved, 0 for one that is replaced.

    Args:
        frames: u8 [T,H,W,3].
        masks: bool [T,H,W], both ends of a path must lie in them.
        mean: of the brightness over time, levels.
        flow: px/frame, NaN where unknown.
        lags: frames per name of a time.

    Returns:
        By name; NaN where the film is too short, or shows nothing that changes.
    """
    known = np.isfinite(flow[..., 0])
    move = np.nan_to_num(flow).astype(np.float32)
    start = np.stack(np.meshgrid(*(np.arange(n, dtype=np.float32) for n in flow.shape[1::-1])), -1)
    place, done, found = start.copy(), 0, {}
    for name, lag in sorted(lags.items(), key=lambda item: item[1]):
        if not 1 <= lag < len(frames):
            found[name] = float("nan")
            continue
        for _ in range(lag - done):
            halfway = place + 0.5 * cv2.remap(move, place, NO_MAP, cv2.INTER_LINEAR)
            place = place + cv2.remap(move, halfway, NO_MAP, cv2.INTER_LINEAR)
        done = lag
        found[name] = _correlation_at(frames, masks, np.where(known, mean, np.nan).astype(np.float32), place, lag)
    return found


def _correlation_at(frames, masks, mean: np.ndarray, place: np.ndarray, lag: int) -> float:
    """Of the pictures less their mean (NaN: do not look here) with those `lag` frames later at other places (px)."""
    own = later = both = 0.0
    count = 0
    for t in spread(0, len(frames) - lag, STARTS):
        here, there = (cv2.cvtColor(np.ascontiguousarray(frames[k]), cv2.COLOR_RGB2GRAY) - mean for k in (t, t + lag))
        moved = cv2.remap(there, place, NO_MAP, cv2.INTER_LINEAR)
        inside = cv2.remap(masks[t + lag].astype(np.uint8), place, NO_MAP, cv2.INTER_NEAREST) > 0
        on = masks[t] & inside & np.isfinite(here) & np.isfinite(moved)
        a, b = here[on].astype(np.float64), moved[on].astype(np.float64)
        own, later, both = own + (a * a).sum(), later + (b * b).sum(), both + (a * b).sum()
        count += len(a)
    # a film that stands still has no change to follow: less than half a level is rounding
    if count < LEAST or min(own, later) < 0.25 * count:
        return float("nan")
    return float(both / np.sqrt(own * later))
