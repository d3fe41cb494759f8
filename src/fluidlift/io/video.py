"""Clips in and previews out.

`read_clip` takes a video file, a GIF, a folder of pictures or a pattern such as frames/%04d.png. Times are the real
presentation times: phones record at a variable frame rate. Frames are upright, with square pixels, in sRGB.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from itertools import chain, islice
from pathlib import Path
from typing import Any

import av
import av.container
import av.error
import numpy as np

from fluidlift.errors import InputRejected, require
from fluidlift.io.bars import PictureWindow
from fluidlift.io.collect import MIN_SIDE, Collector, FrameSelection, FrameStore
from fluidlift.io.decode import (
    Notes,
    decode_frames,
    has_alpha,
    is_hdr,
    open_video,
    picture_of,
    quarter_turns,
)
from fluidlift.io.encode import write_video
from fluidlift.io.interlace import first_field, is_combed
from fluidlift.io.limits import ReadLimits
from fluidlift.io.pictures import eight_bit, read_picture
from fluidlift.io.sequences import is_sequence, list_sequence
from fluidlift.messages import Notice, as_plain
from fluidlift.types import VideoClip
from fluidlift.types.clip import is_variable

__all__ = [
    "ClipInfo", "ReadLimits", "before_frame", "frame_times", "frames_before", "look_through", "probe", "read_clip",
    "write_video",
]  # fmt: skip


def read_clip(
    path: Path | str,
    *,
    start: float = 0.0,
    duration: float | None = None,
    max_size: int = 512,
    fps: float | None = None,
    limits: ReadLimits | None = None,
    store: FrameStore | None = None,
    window: PictureWindow | None = None,
) -> VideoClip:
    """Decode a clip, scaled down so that its long side has at most `max_size` px (area average).

    Args:
        path: a video file, a folder of pictures, or a pattern (frames/%04d.png, frames/####.png).
        start: s from the first frame; earlier frames are skipped.
        duration: s to keep; None keeps all.
        max_size: px.
        fps: frames per second of pictures. Not used for videos, which have their own times.
        limits: on frame size, number of frames and memory.
        store: where frames and alpha are collected, under the names decoded and alpha; None: in memory. In a store, the
            limit on memory does not count.
        window: the part of each picture that is decoded; None: all of it.

    Returns:
        A clip whose `times` count from the first frame of the file.

    Raises:
        InputRejected: not a video, damaged, too large, fewer than two frames, or `start` past the end.
    """
    limits = limits or ReadLimits()
    if not (math.isfinite(start) and start >= 0):
        raise InputRejected(f"a start of {start} s", "0 or more seconds", "change --start")
    if duration is not None and not duration > 0:
        raise InputRejected(f"a duration of {duration} s", "more than 0 seconds", "change --duration")
    require(max_size >= MIN_SIDE, f"max_size {max_size}", f"at least {MIN_SIDE} px")
    path, notes = Path(path), Notes()
    wanted = FrameSelection(path.name, start, math.inf if duration is None else start + duration, max_size, window)
    collector = Collector(wanted, limits, notes, store)
    if is_sequence(path):
        _read_sequence(path, fps, limits, collector, notes)
    else:
        if fps is not None:
            notes.add(Notice("fps-not-used", "--fps is for pictures and was not used: a video has its own times"))
        _read_video(path, limits, collector, notes)
    return collector.clip()


INTERLACED_HEIGHT = 1088
"""px: interlaced formats have at most so many rows (1080, in whole blocks); taller videos are not looked at"""
LOOKED_AT = 12
"""frames at the beginning of which combing is looked for"""
COMBED_NOTE = Notice(
    "interlaced",
    "the video is interlaced (two instants in each frame): the rows of the first one are used; a deinterlaced copy "
    "(ffmpeg -vf bwdif) has finer pictures",
)


def _is_interlaced(path: Path, limits: ReadLimits, start: float) -> bool:
    """Whether the first frames from `start` (s) on are combed; what the file says of itself is often wrong."""
    with open_video(path, limits) as (container, stream):
        if stream.codec_context.height > INTERLACED_HEIGHT:
            return False
        if start > 10.0 and stream.time_base:
            with contextlib.suppress(av.error.FFmpegError):
                container.seek(int(start / stream.time_base) + (stream.start_time or 0), stream=stream)
        frames = islice(decode_frames(container, stream, limits, Notes()), LOOKED_AT)
        first = next(frames, None)
        if first is None or quarter_turns(first[1], Notes()) % 2 or has_alpha(first[1]):
            return False
        return bool(is_combed(picture_of(frame, Notes())[0] for _, frame in chain([first], frames)))


def _read_video(path: Path, limits: ReadLimits, collector: Collector, notes: Notes) -> None:
    combed = _is_interlaced(path, limits, collector.start)
    if combed:
        notes.add(COMBED_NOTE)
    with open_video(path, limits) as (container, stream):
        rate, tick = stream.average_rate or stream.guessed_rate, stream.time_base
        origin = None if stream.start_time is None or tick is None else stream.start_time * tick
        if collector.start > 10.0 and origin is not None and tick is not None:
            with contextlib.suppress(av.error.FFmpegError):  # a file without an index is decoded from its beginning
                container.seek(int((collector.start + float(origin)) / tick), stream=stream)
        for time, frame in decode_frames(container, stream, limits, notes):
            if time is None:
                step = float(1 / rate) if rate else 1.0 / 25.0
                seconds = 0.0 if collector.last_seen == -math.inf else collector.last_seen + step
                notes.add(Notice("no-time-stamps", "frames without time stamps: the nominal frame rate is used"))
            else:
                origin = time if origin is None else origin
                seconds = float(time - origin)
            if seconds >= collector.end:
                break
            if collector.wants(seconds):
                rgb, alpha = picture_of(frame, notes)
                shape = _square(rgb, _pixel_aspect(stream), quarter_turns(frame, notes))
                collector.add(seconds, first_field(rgb) if combed else rgb, alpha, shape)


def _pixel_aspect(stream: av.VideoStream) -> Fraction:
    """Width of a pixel over its height; nonsense counts as square."""
    aspect = stream.sample_aspect_ratio
    return Fraction(aspect) if aspect and Fraction(1, 4) <= aspect <= 4 else Fraction(1)


def _square(rgb: np.ndarray, aspect: Fraction, turns: int) -> tuple[int, int]:
    """(width, height) with square pixels of an upright picture."""
    height, width = rgb.shape[:2]
    if turns % 2:
        return width, round(height * aspect)
    return round(width * aspect), height


def _read_sequence(path: Path, fps: float | None, limits: ReadLimits, collector: Collector, notes: Notes) -> None:
    files = list_sequence(path)
    if fps is None:
        raise InputRejected(f"pictures ('{path.name}') without a frame rate", "frames per second", "give --fps 25")
    if not 0 < fps <= 100000:
        raise InputRejected(f"--fps {fps}", "a positive number of frames per second")
    first = files[0][0]
    if files[-1][0] - first + 1 > len(files):
        notes.add(
            Notice(
                "numbers-missing", "numbers are missing in the sequence; the time between their neighbours is longer"
            )
        )
    for number, file in files:
        seconds = (number - first) / fps
        if seconds >= collector.end:
            break
        if collector.wants(seconds):
            rgb, alpha = eight_bit(read_picture(file, limits=limits))
            collector.add(seconds, rgb, alpha, rgb.shape[1::-1])


@dataclass(frozen=True)
class ClipInfo:
    """What a file holds, without decoding more than its first frame."""

    source: str
    """name of the file, without its folder"""
    size: tuple[int, int]
    """width, height in px, upright, with square pixels"""
    frame_count: int
    fps: float
    """one over the median time between frames"""
    duration: float
    """s, with the last frame's share"""
    variable_frame_rate: bool
    rotation: int
    """degrees counter-clockwise that set the stored picture upright"""
    codec: str
    pixel_format: str
    hdr: bool
    alpha: bool
    warnings: tuple[Notice, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain data for --json."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in vars(self).items()} | as_plain(self.warnings)


def probe(path: Path | str, *, fps: float | None = None, limits: ReadLimits | None = None) -> ClipInfo:
    """Look at a clip as `read_clip` would, quickly.

    Raises:
        InputRejected: as `read_clip`, for what shows before decoding.
    """
    limits = limits or ReadLimits()
    path = Path(path)
    if is_sequence(path):
        return _probe_sequence(path, fps, limits)
    notes = Notes()
    with open_video(path, limits) as (container, stream):
        codec = stream.codec_context.name
        aspect = _pixel_aspect(stream)
        first = next((frame for _, frame in decode_frames(container, stream, limits, notes)), None)
        if first is None:
            raise InputRejected(f"no frame of '{path.name}' decodes", "an undamaged video", "export it again")
        rgb, _ = picture_of(first, notes)
        turns = quarter_turns(first, notes)
        alpha = has_alpha(first) or stream.metadata.get("alpha_mode") == "1"
        info = {"pixel_format": first.format.name, "hdr": is_hdr(first), "alpha": alpha, "rotation": 90 * turns}
        size = _square(rgb, aspect, turns)
    if _is_interlaced(path, limits, 0.0):
        notes.add(COMBED_NOTE)
    with open_video(path, limits) as (container, stream):  # again from the start: seeking is not always possible
        times = sorted({float(p.pts * p.time_base) for p in _packets(container, stream, notes) if p.pts is not None})
        rate = stream.average_rate or stream.guessed_rate
    steps = np.diff(times)
    step = float(np.median(steps)) if len(steps) else (float(1 / rate) if rate else 0.0)
    variable = is_variable(np.asarray(times))
    if variable:
        notes.add(
            Notice(
                "variable-frame-rate",
                f"variable frame rate: {1000 * steps.min():.1f} to {1000 * steps.max():.1f} ms between frames",
            )
        )
    if len(times) < 2:
        notes.add(Notice("one-frame", "fewer than two frames: motion cannot be measured"))
    return ClipInfo(
        source=path.name,
        size=size,
        frame_count=len(times),
        fps=round(1.0 / step, 6) if step > 0 else 0.0,
        duration=round(times[-1] - times[0] + step, 6) if times else 0.0,
        variable_frame_rate=variable,
        codec=codec,
        warnings=tuple(notes.lines),
        **info,
    )


LOOKED_AT = 128
"""px, longer side of the pictures that a clip is looked through in: layouts (`motion.stabilize`) are 32 x 18"""
MOST_LOOKED_AT = 200_000
"""frames: two hours at 25 per second, and 5 GB of small pictures"""


def look_through(
    path: Path | str, store: FrameStore, *, start: float = 0.0, duration: float | None = None,
    fps: float | None = None, max_pixels: int = ReadLimits.max_pixels,
) -> VideoClip:  # fmt: skip
    """All of a clip, however long, in small pictures that lie in a file.

    Args:
        path: as in `read_clip`.
        store: where they lie.
        start: s into the clip.
        duration: s; None: to the end.
        fps: frames per second of pictures; not looked at for a video.
        max_pixels: largest picture accepted, px.

    Raises:
        InputRejected: as in `read_clip`.
    """
    return read_clip(
        path, start=start, duration=duration, max_size=LOOKED_AT, fps=fps if is_sequence(path) else None,
        limits=ReadLimits(max_pixels=max_pixels, max_frames=MOST_LOOKED_AT), store=store,
    )  # fmt: skip


def before_frame(times: np.ndarray, number: int) -> float:
    """s halfway between a frame (not the first) and the one before, so that rounding of times takes it from no part."""
    return round(float(times[number - 1] + times[number]) / 2.0, 6)


def frames_before(path: Path | str, start: float, fps: float, limits: ReadLimits | None = None) -> int:
    """Number of frames of a clip before `start` (s), by their time stamps alone.

    Args:
        path: as in `read_clip`.
        start: s from the first frame.
        fps: frames per second of pictures.
        limits: as in `read_clip`.
    """
    return sum(time < start - 5e-7 for time in frame_times(path, fps, limits))


def frame_times(path: Path | str, fps: float, limits: ReadLimits | None = None) -> list[float]:
    """Times of the frames of a clip, s from the first one, by their time stamps alone; frames without one are left out.

    Args:
        path: as in `read_clip`.
        fps: frames per second of pictures.
        limits: as in `read_clip`.
    """
    path = Path(path)
    if is_sequence(path):
        numbers = [number for number, _ in list_sequence(path)]
        return [(number - numbers[0]) / fps for number in numbers]
    with open_video(path, limits or ReadLimits()) as (container, stream):
        stamps = sorted({float(p.pts * p.time_base) for p in _packets(container, stream, Notes()) if p.pts is not None})
    return [stamp - stamps[0] for stamp in stamps]


def _packets(container: av.container.InputContainer, stream: av.VideoStream, notes: Notes) -> Iterator[av.Packet]:
    try:
        yield from container.demux(stream)
    except (av.error.FFmpegError, OSError):
        notes.add(Notice("file-cut-off", "the file ends early: it is damaged or cut off"))


def _probe_sequence(path: Path, fps: float | None, limits: ReadLimits) -> ClipInfo:
    files = list_sequence(path)
    picture = read_picture(files[0][1], limits=limits)
    notes = Notes()
    if fps is None:
        notes.add(Notice("no-frame-rate", "pictures have no frame rate of their own: give --fps"))
    span = files[-1][0] - files[0][0] + 1
    if span > len(files):
        notes.add(Notice("numbers-missing", f"{span - len(files)} numbers are missing in the sequence"))
    return ClipInfo(
        source=path.name,
        size=picture.shape[1::-1],
        frame_count=len(files),
        fps=fps or 0.0,
        duration=span / fps if fps else 0.0,
        variable_frame_rate=span > len(files),
        rotation=0,
        codec=files[0][1].suffix.lower().lstrip("."),
        pixel_format=f"{picture.dtype} x {1 if picture.ndim == 2 else picture.shape[2]}",
        hdr=False,
        alpha=picture.ndim == 3 and picture.shape[2] == 4,
        warnings=tuple(notes.lines),
    )
