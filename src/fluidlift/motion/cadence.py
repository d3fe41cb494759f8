"""Frames that repeat: frame-rate conversion (telecine, GIFs played as video) and stretches where the picture stands.

A repeated frame looks like a fluid at rest for one frame and twice as fast in the next. Two neighbours count as the
same picture when even their liveliest blocks differ by far less than those of the other neighbours: what stays behind
is compression, and a moving fluid never repeats itself.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from fluidlift.errors import require
from fluidlift.messages import Notice
from fluidlift.types.clip import VideoClip

WORKING_SIZE = 256
"""px, longer side of the pictures that are compared"""
BLOCK = 8
"""px, side of the blocks whose mean difference counts: sensor noise averages out, a moving ripple does not"""
LIVELIEST = 99.0
"""percentile over blocks: a jet may fill a hundredth of the picture"""
SAME = 2.0
"""grey levels: two codings of one picture differ by less in every block"""
GAP = 4.0
"""repeats are calmer than all other pairs by at least this factor (a clip of slow honey knows no such gap)"""
LEAST_LIVE = 0.04
"""part of the pairs that must be live, and never fewer than four: a flash or a cut is no yardstick for motion"""
FROZEN_SECONDS = 0.5
"""a picture that stands longer than that, and three times longer than the clip's usual repeats, is frozen"""
LEAST_BEATS = 3
"""repeats that make a beat; fewer are hiccups"""


@dataclass(frozen=True)
class CadenceReport:
    """Which frames bring nothing new."""

    frames: int
    """in the clip"""
    duplicates: tuple[int, ...]
    """frames that repeat the one before"""
    frozen: tuple[tuple[int, int], ...]
    """first and last frame of stretches that show one picture"""
    source_rate: float | None
    """frames per second before conversion, where the repeats come at its beat"""
    kept: tuple[int, ...]
    """frames worth keeping: without repeats, of the longest stretch between frozen ones"""
    warnings: tuple[Notice, ...] = ()


def examine_cadence(frames: UInt8[np.ndarray, "t h w 3"], times: Float[np.ndarray, " t"]) -> CadenceReport:
    """Repeated frames and frozen stretches of a clip.

    Args:
        frames: sRGB; read one after the other, so they may lie in a file.
        times: s.

    Raises:
        ValueError: as many times as frames are needed.
    """
    require(len(frames) == len(times), f"{len(times)} times for {len(frames)} frames", "one each")
    everything = tuple(range(len(frames)))
    same = repeats(differences(frames))
    if not same.any():
        return CadenceReport(len(frames), (), (), None, everything)
    duplicates = np.flatnonzero(same) + 1
    interval = float(np.median(np.diff(times)))
    frozen = frozen_stretches(same, interval)
    kept = _longest_live(len(frames), set(duplicates.tolist()), frozen)
    rate = (
        None
        if frozen or len(duplicates) < LEAST_BEATS
        else source_rate(np.asarray(kept), np.asarray(times, np.float64))
    )
    warnings = [
        Notice("frozen-stretch", f"frames {a} to {b} show one picture: only frames {kept[0]} to {kept[-1]} are used")
        for a, b in frozen
    ]
    single = [int(d) for d in duplicates if not any(a < d <= b for a, b in frozen)]
    if single:
        named = ", ".join(map(str, single[:6])) + (", ..." if len(single) > 6 else "")
        why = f", as {rate:.4g} frames per second do when played at {1 / interval:.4g}" if rate else ""
        warnings.append(
            Notice(
                "repeated-frames",
                f"{len(single)} of {len(frames)} frames repeat the one before{why}; left out: frame {named}",
            )
        )
    return CadenceReport(len(frames), tuple(duplicates.tolist()), frozen, rate, kept, tuple(warnings))


def without_duplicates(clip: VideoClip, report: CadenceReport) -> VideoClip:
    """The clip with the kept frames alone.

    Times stay those of presentation, except where the repeats keep the beat of a frame-rate conversion: the frames
    were taken at equal intervals then, and are given them back.

    Raises:
        ValueError: a report of another clip.
    """
    require(report.frames == len(clip), f"a report of another clip ({report.frames} frames)", f"{len(clip)} frames")
    if len(report.kept) == len(clip):
        return clip
    kept = np.asarray(report.kept)
    times = clip.times[kept]
    if report.source_rate is not None:
        times = times[0] + np.arange(len(kept)) / report.source_rate
    alpha = None if clip.alpha is None else clip.alpha[kept]
    return replace(clip, frames=clip.frames[kept], times=times, alpha=alpha)


def differences(frames: UInt8[np.ndarray, "t h w 3"]) -> Float[np.ndarray, " t-1"]:
    """How much the liveliest blocks of neighbouring frames differ, grey levels."""
    found = np.zeros(max(len(frames) - 1, 0))
    before = None
    for t in range(len(frames)):
        small = _small_grey(frames[t])
        if before is not None:
            blocks = cv2.resize(
                cv2.absdiff(before, small),
                (max(small.shape[1] // BLOCK, 1), max(small.shape[0] // BLOCK, 1)),
                interpolation=cv2.INTER_AREA,
            )
            found[t - 1] = np.percentile(blocks, LIVELIEST)
        before = small
    return found


def repeats(difference: Float[np.ndarray, " n"]) -> np.ndarray:
    """bool [n]: pairs of one and the same picture, from what `differences` says of all pairs.

    The differences fall into two classes with a gap between them, or there are no repeats.
    """
    if len(difference) < 2:
        return np.zeros(len(difference), bool)
    order = np.sort(np.maximum(difference, 0.02))
    jumps = order[1:] / order[:-1]
    allowed = (order[:-1] < SAME) & (len(order) - 1 - np.arange(len(jumps)) >= max(4.0, LEAST_LIVE * len(order)))
    if not allowed.any():
        return np.zeros(len(difference), bool)
    at = int(np.argmax(np.where(allowed, jumps, 0.0)))
    if jumps[at] < GAP:
        return np.zeros(len(difference), bool)
    return np.maximum(difference, 0.02) <= order[at]


def frozen_stretches(same: np.ndarray, interval: float) -> tuple[tuple[int, int], ...]:
    """First and last frame of runs of repeats, bool [T-1], that are too long for a frame-rate conversion."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]).astype(np.int8)))
    starts, stops = edges[::2], edges[1::2]  # frames: the run shows frames start..stop
    lengths = stops - starts
    usual = np.median(lengths) if len(lengths) > 2 else 0.0
    long = (lengths * interval >= FROZEN_SECONDS) & (lengths > 3.0 * usual)
    return tuple((int(a), int(b)) for a, b in zip(starts[long], stops[long]))


def source_rate(kept: Int[np.ndarray, " k"], times: Float[np.ndarray, " t"]) -> float | None:
    """Frames per second before conversion, or None where the kept frames do not keep a beat.

    A converter shows frame k of the source at the display instant next to k / rate: the display times of the kept
    frames are then a straight line in k to within one display interval.
    """
    if len(kept) < 6:
        return None
    shown, k = times[kept], np.arange(len(kept))
    slope, start = np.polyfit(k, shown, 1)
    display = float(np.median(np.diff(times)))
    return float(1.0 / slope) if np.abs(shown - (start + slope * k)).max() <= display else None


def _longest_live(frames: int, duplicates: set[int], frozen: tuple[tuple[int, int], ...]) -> tuple[int, ...]:
    """Frames without repeats of the longest stretch between frozen ones, which lend it their last and first frame."""
    starts = [0, *(b for _, b in frozen)]
    stops = [*(a for a, _ in frozen), frames - 1]
    inside = {f for a, b in frozen for f in range(a + 1, b)}
    best: list[int] = []
    for start, stop in zip(starts, stops):
        first = start if start else 0
        live = [f for f in range(first, stop + 1) if f not in inside and (f == first or f not in duplicates)]
        best = max(best, live, key=len)
    return tuple(best)


def _small_grey(frame: np.ndarray) -> np.ndarray:
    grey = cv2.cvtColor(np.ascontiguousarray(frame), cv2.COLOR_RGB2GRAY).astype(np.float32)
    scale = WORKING_SIZE / max(grey.shape)
    if scale >= 1.0:
        return grey
    size = (max(round(grey.shape[1] * scale), BLOCK), max(round(grey.shape[0] * scale), BLOCK))
    return cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
