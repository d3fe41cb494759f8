"""The stage of a long clip, before all others: a part of it that stands for the whole.

What is simulated and drawn again frame by frame is bounded (`read.max_frames`), so of a longer clip a part is made that
is as the whole is. All of it is looked through in small pictures, which lie on disk, and of its longest shot the window
is taken whose pieces are most as the shot usually is: its mean picture, and how much moves.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from fluidlift.errors import InputRejected
from fluidlift.messages import Notice
from fluidlift.pipeline.inputs import BESIDE, GivenFile
from fluidlift.pipeline.work import Work
from fluidlift.types.stages import Window

LAYOUT = (32, 18)
"""px, width and height of mean pictures, as in `motion.stabilize`"""
PLACES = 8
"""at which a window may begin, per length of a window"""
LEAST_MOTION = 0.05
"""grey levels from frame to frame that are no motion: noise of a camera on a tripod is more"""
ELSEWHERE = 4
"""parts of equal length of a long shot, each of which lends its motion by the stretch of it that is most as usual; with
the window that lies in one of them as many times are looked at"""
LIKE = 1.0
"""how far a stretch may be from usual, to count: pictures by `LEVELS`, or motion e times as strong"""
LEVELS = 10.0
"""grey levels of difference between mean pictures that count as much as motion that is e times as strong"""


@dataclass(frozen=True)
class WindowSettings:
    """How long it may be."""

    frames: int
    start: float
    """s into the clip, before which nothing is taken"""
    duration: float | None
    """s behind that, after which nothing is taken"""
    fps: float
    sample: int
    """frames of each of the parts at other times"""
    max_pixels: int = field(metadata=BESIDE)


def window(clip: GivenFile, config: WindowSettings, *, work: Work) -> Window:
    """Look through the clip and choose.

    Args:
        clip: video file or image sequence.
        config: how long.
        work: room for small frames.

    Raises:
        InputRejected: a clip that cannot be used.
    """
    from fluidlift.io.video import before_frame, look_through
    from fluidlift.motion.stabilize import GreyFrames, find_cuts

    seen = look_through(
        clip.path, work.scratch, start=config.start, duration=config.duration, fps=config.fps,
        max_pixels=config.max_pixels,
    )  # fmt: skip
    edges = (0, *find_cuts(GreyFrames(seen.frames)), len(seen))
    first, last = max(pairwise(edges), key=lambda shot: shot[1] - shot[0])
    length = min(config.frames, last - first)
    if length < 2:
        raise InputRejected(f"'{seen.source}' is cut at every frame", "a stretch of one view", "trim it with --start")
    pieces = _unlike(seen.frames[first:last], max(length // PLACES, 1))
    begin, levels, motion = _nearest(pieces, last - first, length)
    others = [first + k for k in _others(pieces, range(begin, begin + length), config.sample)]
    begin += first
    times = np.append(seen.times, seen.times[-1] + seen.interval)

    def span(at: int, frames: int) -> tuple[float, float]:
        start = config.start if at == 0 else before_frame(times, at)
        return start, round(before_frame(times, at + frames) - start, 6)

    start, duration = span(begin, length)
    end = start + duration
    whole = "its longest shot" if len(edges) > 2 else "all"
    told = Notice(
        "window-of-a-long-clip",
        f"the clip has {len(seen)} frames: the {length} from {start:.2f} to {end:.2f} s stand for it (their "
        f"pictures differ from those of {whole} by {levels:.1f} levels of 255, and move {motion:.2f} times as much). "
        "Another part: --start and --duration; more frames: --set read.max_frames=NUMBER",
    )
    return Window(start, duration, tuple(span(at, config.sample) for at in others), (told,))


@dataclass(frozen=True)
class _Pieces:
    """How far the pieces of a shot are from what is usual in it."""

    step: int
    """frames of each"""
    levels: Float[np.ndarray, " n"]
    """grey levels between mean pictures"""
    ratios: Float[np.ndarray, " n"]
    """of motion"""

    @property
    def unlike(self) -> Float[np.ndarray, " n"]:
        """Both in one number, 0 for what is as usual."""
        return self.levels / LEVELS + np.abs(np.log(self.ratios))


def _unlike(frames: UInt8[np.ndarray, "t h w 3"], step: int) -> _Pieces:
    """Of each piece of so many frames, which are read one after the other."""
    pictures, moved = _pieces(frames, step)
    levels = np.abs(pictures - np.median(pictures, axis=0)).mean(axis=(1, 2))
    return _Pieces(step, levels, (moved + LEAST_MOTION) / (np.median(moved) + LEAST_MOTION))


def _nearest(pieces: _Pieces, frames: int, length: int) -> tuple[int, float, float]:
    """First frame of the window that is most as the clip usually is, piece by piece; how far its pieces' mean pictures
    are from the usual one, in levels, and its motion over the usual one."""
    unlike = pieces.unlike
    per = max(min(length // pieces.step, len(unlike)), 1)
    k = int(np.argmin([unlike[i : i + per].sum() for i in range(len(unlike) - per + 1)]))
    window = slice(k, k + per)
    first = min(k * pieces.step, frames - length)
    return first, float(pieces.levels[window].mean()), float(pieces.ratios[window].mean())


def _others(pieces: _Pieces, window: range, sample: int) -> list[int]:
    """First frames of stretches of so many frames at other times: of each of `ELSEWHERE` parts of the shot the one that
    is most as usual, where it is near enough to that and beside the window."""
    unlike, step = pieces.unlike, pieces.step
    per = -(-sample // step)
    found = []
    for part in np.array_split(np.arange(len(unlike)), ELSEWHERE):
        if not len(part) or part[0] * step <= window[len(window) // 2] < (part[-1] + 1) * step:
            continue  # the window stands for this part
        places = [int(k) for k in part[: len(part) - per + 1]]
        places = [k for k in places if (k + per) * step <= window.start or k * step >= window.stop]
        if places:
            best = min(places, key=lambda k: float(unlike[k : k + per].mean()))
            if unlike[best : best + per].mean() <= LIKE:
                found.append(best * step)
    return found


def _pieces(
    frames: UInt8[np.ndarray, "t h w 3"], step: int
) -> tuple[Float[np.ndarray, "n h w"], Float[np.ndarray, " n"]]:
    """Of each piece of so many frames, without what is left over: mean of the grey pictures (`LAYOUT`), and of how
    much (levels) each frame differs from the one before."""
    count = len(frames) // step
    sums, moved = np.zeros((count, *LAYOUT[::-1])), np.zeros(count)
    before = None
    for t in range(count * step):
        grey = cv2.cvtColor(np.ascontiguousarray(frames[t]), cv2.COLOR_RGB2GRAY).astype(np.float32)
        sums[t // step] += cv2.resize(grey, LAYOUT, interpolation=cv2.INTER_AREA)
        if before is not None:
            moved[t // step] += float(np.abs(grey - before).mean())
        before = grey
    return sums / step, moved / step
