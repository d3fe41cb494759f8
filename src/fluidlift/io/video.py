"""Clips in and previews out.

`read_clip` takes a video file, a GIF, a folder of pictures or a pattern such as frames/%04d.png. Times are the real
presentation times: phones record at a variable frame rate. Frames are upright, with square pixels, in sRGB.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np

from fluidlift.errors import InputRejected, require
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
from fluidlift.io.limits import ReadLimits
from fluidlift.io.pictures import eight_bit, fitted_size, read_picture, resample_with_alpha, same_shape
from fluidlift.io.sequences import is_sequence, list_sequence
from fluidlift.types import VideoClip

__all__ = ["ClipInfo", "ReadLimits", "probe", "read_clip", "write_video"]

MIN_SIDE = 16
"""px; below it nothing can be seen to move"""


def read_clip(
    path: Path | str,
    *,
    start: float = 0.0,
    duration: float | None = None,
    max_size: int = 512,
    fps: float | None = None,
    limits: ReadLimits | None = None,
) -> VideoClip:
    """Decode a clip, scaled down so that its long side has at most `max_size` px (area average).

    Args:
        path: a video file, a folder of pictures, or a pattern (frames/%04d.png, frames/####.png).
        start: s from the first frame; earlier frames are skipped.
        duration: s to keep; None keeps all.
        max_size: px.
        fps: frames per second of pictures. Not used for videos, which have their own times.
        limits: on frame size, number of frames and memory.

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
    collector = _Collector(path.name, start, duration, max_size, limits, notes)
    if is_sequence(path):
        _read_sequence(path, fps, limits, collector, notes)
    else:
        if fps is not None:
            notes.add("--fps is for pictures and was not used: a video has its own times")
        _read_video(path, limits, collector, notes)
    return collector.clip()


class _Collector:
    """Keeps the wanted frames, small; everything else passes by."""

    def __init__(
        self, name: str, start: float, duration: float | None, max_size: int, limits: ReadLimits, notes: Notes
    ) -> None:
        self.name, self.start, self.limits, self.notes = name, start, limits, notes
        self.end = math.inf if duration is None else start + duration
        self.max_size = max_size
        self.frames: list[np.ndarray] = []
        self.alphas: list[np.ndarray] = []
        self.times: list[float] = []
        self.last_seen = -math.inf
        self.size: tuple[int, int] | None = None
        self.repeated = 0

    def wants(self, time: float) -> bool:
        """Whether the frame at `time` (s) is to be kept. Half a microsecond absorbs the rounding of time stamps."""
        if time <= self.last_seen:
            self.notes.add("frames with times that do not increase were left out")
            return False
        self.last_seen = time
        return self.start - 5e-7 <= time < self.end - 5e-7

    def add(self, time: float, rgb: np.ndarray, alpha: np.ndarray | None, shape: tuple[int, int]) -> None:
        """Keep a frame; `shape` is its size (width, height) with square pixels."""
        if self.size is None:
            self.size = fitted_size(shape, self.max_size)
            if min(self.size) < MIN_SIDE:
                raise InputRejected(f"the frames of '{self.name}' are {shape[0]} x {shape[1]} px", f"{MIN_SIDE} px")
        elif not same_shape(shape, self.size):
            self.notes.add("the frame size changes inside the clip; later frames were stretched to the first size")
        self._require_room()
        rgb, alpha = resample_with_alpha(rgb, alpha, self.size)
        self.repeated += bool(self.frames) and np.array_equal(rgb, self.frames[-1])
        self.frames.append(rgb)
        self.times.append(time)
        if alpha is not None:
            self.alphas.append(alpha)

    def _require_room(self) -> None:
        n = len(self.frames) + 1
        advice = "cut the clip with --start and --duration"
        if n > self.limits.max_frames:
            raise InputRejected(
                f"'{self.name}' has more than {self.limits.max_frames} frames",
                f"at most {self.limits.max_frames} frames",
                f"{advice}, or raise the limit with --max-frames",
            )
        if n * self.size[0] * self.size[1] * 4 > self.limits.max_bytes:
            raise InputRejected(
                f"the frames of '{self.name}' need more than {self.limits.max_bytes / 1e6:.0f} MB",
                "less",
                f"{advice}, lower --max-size, or raise the limit with --max-bytes",
            )

    def clip(self) -> VideoClip:
        """All that was kept."""
        if self.start > 0 and self.last_seen < self.start:
            last = f" (last frame at {self.last_seen:.3f} s)" if math.isfinite(self.last_seen) else ""
            raise InputRejected(
                f"a start of {self.start:g} s, past the end of '{self.name}'{last}",
                "a start inside the clip",
                "lower --start",
            )
        if len(self.frames) < 2:
            found = "no frame" if not self.frames else "only one frame"
            raise InputRejected(
                f"{found} that decodes in '{self.name}' between {self.start:g} s and "
                + ("its end" if math.isinf(self.end) else f"{self.end:g} s"),
                "at least two frames, because motion is measured between frames",
                "give a longer clip, or change --start and --duration",
            )
        times = np.asarray(self.times, np.float64)
        if _is_variable(times):
            steps = np.diff(times)
            self.notes.add(
                f"variable frame rate: {1000 * steps.min():.1f} to {1000 * steps.max():.1f} ms between frames; "
                "the real times are used"
            )
        if self.repeated:
            self.notes.add(f"{self.repeated} of {len(times)} frames repeat the one before (a converted frame rate?)")
        alpha = self._stacked(self.alphas) if len(self.alphas) == len(times) else None
        if alpha is not None and int(alpha.min()) == 255:
            alpha = None  # an alpha channel that hides nothing says nothing
        return VideoClip(self._stacked(self.frames), times, self.name, alpha, tuple(self.notes.lines))

    @staticmethod
    def _stacked(pictures: list[np.ndarray]) -> np.ndarray:
        """One array; each picture is let go as soon as it is copied, so that memory is not needed twice."""
        out = np.empty((len(pictures), *pictures[0].shape), np.uint8)
        for i in range(len(pictures)):
            out[i], pictures[i] = pictures[i], None
        return out


def _is_variable(times: np.ndarray) -> bool:
    """Steps that differ by more than the rounding of time stamps to milliseconds explains."""
    if len(times) < 3:
        return False
    steps = np.diff(times)
    return bool(steps.max() - steps.min() > max(0.1 * np.median(steps), 0.0021))


def _read_video(path: Path, limits: ReadLimits, collector: _Collector, notes: Notes) -> None:
    with open_video(path, limits) as (container, stream):
        rate = stream.average_rate or stream.guessed_rate
        origin = None if stream.start_time is None else stream.start_time * stream.time_base
        if collector.start > 10.0 and origin is not None:
            with contextlib.suppress(av.error.FFmpegError):  # a file without an index is decoded from its beginning
                container.seek(int((collector.start + float(origin)) / stream.time_base), stream=stream)
        for time, frame in decode_frames(container, stream, limits, notes):
            if time is None:
                step = float(1 / rate) if rate else 1.0 / 25.0
                seconds = 0.0 if collector.last_seen == -math.inf else collector.last_seen + step
                notes.add("frames without time stamps: the nominal frame rate is used")
            else:
                origin = time if origin is None else origin
                seconds = float(time - origin)
            if seconds >= collector.end:
                break
            if collector.wants(seconds):
                rgb, alpha = picture_of(frame, notes)
                collector.add(seconds, rgb, alpha, _square(rgb, _pixel_aspect(stream), quarter_turns(frame, notes)))


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


def _read_sequence(path: Path, fps: float | None, limits: ReadLimits, collector: _Collector, notes: Notes) -> None:
    files = list_sequence(path)
    if fps is None:
        raise InputRejected(f"pictures ('{path.name}') without a frame rate", "frames per second", "give --fps 25")
    if not 0 < fps <= 100000:
        raise InputRejected(f"--fps {fps}", "a positive number of frames per second")
    first = files[0][0]
    if files[-1][0] - first + 1 > len(files):
        notes.add("numbers are missing in the sequence; the time between their neighbours is longer")
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
    warnings: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain data for --json."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items()}


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
    with open_video(path, limits) as (container, stream):  # again from the start: seeking is not always possible
        times = sorted({float(p.pts * p.time_base) for p in _packets(container, stream, notes) if p.pts is not None})
        rate = stream.average_rate or stream.guessed_rate
    steps = np.diff(times)
    step = float(np.median(steps)) if len(steps) else (float(1 / rate) if rate else 0.0)
    variable = _is_variable(np.asarray(times))
    if variable:
        notes.add(f"variable frame rate: {1000 * steps.min():.1f} to {1000 * steps.max():.1f} ms between frames")
    if len(times) < 2:
        notes.add("fewer than two frames: motion cannot be measured")
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


def _packets(container: av.container.InputContainer, stream: av.VideoStream, notes: Notes) -> Iterator[av.Packet]:
    try:
        yield from container.demux(stream)
    except (av.error.FFmpegError, OSError):
        notes.add("the file ends early: it is damaged or cut off")


def _probe_sequence(path: Path, fps: float | None, limits: ReadLimits) -> ClipInfo:
    files = list_sequence(path)
    picture = read_picture(files[0][1], limits=limits)
    notes = Notes()
    if fps is None:
        notes.add("pictures have no frame rate of their own: give --fps")
    span = files[-1][0] - files[0][0] + 1
    if span > len(files):
        notes.add(f"{span - len(files)} numbers are missing in the sequence")
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
