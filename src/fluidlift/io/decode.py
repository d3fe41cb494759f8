"""Video files through PyAV, with the doors shut: no playlists, no networks, no frames beyond the limits."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any, cast

import av
import av.container
import av.error
import numpy as np
from av.video.codeccontext import VideoCodecContext

from fluidlift.errors import InputRejected
from fluidlift.io.color import HLG, PQ, tone_map
from fluidlift.io.limits import ReadLimits, require_file
from fluidlift.io.pictures import PICTURE_SUFFIXES
from fluidlift.messages import Notice

CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg,gif,mxf"
"""A text file that begins with 'ffconcat' or '#EXTM3U' is a playlist to FFmpeg, whatever its name, and opens other
files. Only containers that hold their own data are let in."""

_WHITELIST = {"format_whitelist": CONTAINERS, "protocol_whitelist": "file"}
_TOLERANT: dict[str, Any] = {"metadata_errors": "replace"} if int(av.__version__.split(".")[0]) < 19 else {}
"""a title that is no UTF-8 is no reason to refuse a video (PyAV 19 has no such word any more)"""
_ITU709, _UNSPECIFIED = 1, 2


CUT_OFF = Notice("file-cut-off", "the file ends early: it is damaged or cut off; what was there is used")
"""of a file whose end does not decode"""


@dataclass
class Notes:
    """What a reader noticed; the same remark is kept once."""

    lines: list[Notice] = field(default_factory=list)

    def add(self, line: Notice) -> None:
        """Keep a remark."""
        if line not in self.lines:
            self.lines.append(line)


@contextmanager
def open_video(path: Path | str, limits: ReadLimits) -> Iterator[tuple[av.container.InputContainer, av.VideoStream]]:
    """The container and its first video stream.

    Raises:
        InputRejected: no such file, not a video of a known container, damaged, no video stream, or frames with more
            pixels than `limits.max_pixels`.
    """
    path = require_file(path, "video")
    try:
        container = av.open(str(path.resolve()), container_options=_WHITELIST, **_TOLERANT)
    except (av.error.FFmpegError, OSError):
        raise _not_a_video(path) from None
    with container:
        if not container.streams.video:
            if not container.streams:
                raise _damaged(path)
            kinds = ", ".join(sorted({s.type for s in container.streams}))
            raise InputRejected(f"'{path.name}' has no video stream (only {kinds})", "a file with pictures")
        stream = container.streams.video[0]
        if stream.codec_context is None:
            raise InputRejected(
                f"'{path.name}' uses a codec that cannot be decoded here",
                "H.264, VP9, ProRes, ...",
                "convert it to mp4",
            )
        width, height = stream.codec_context.width, stream.codec_context.height
        if width * height > limits.max_pixels:
            raise InputRejected(
                f"the frames of '{path.name}' are {width} x {height} = {width * height} pixels",
                f"at most {limits.max_pixels} pixels",
                "scale the video down, or raise the limit with --set read.max_pixels=NUMBER",
            )
        yield container, stream


def _not_a_video(path: Path) -> InputRejected:
    """Why FFmpeg refused, as far as the first bytes tell."""
    try:
        with path.open("rb") as file:
            head = file.read(512)
    except OSError as error:  # another process has taken it away, or may read it alone
        return InputRejected(f"'{path.name}' cannot be read ({error.strerror or error})", "a video that stays there")
    accepted = "a video (mp4, mov, mkv, webm, avi, mpeg, mxf, gif) or numbered pictures"
    if path.suffix.lower() in PICTURE_SUFFIXES:
        return InputRejected(f"'{path.name}' is one picture", accepted, "give the folder of the frames, and --fps")
    if b"\0" not in head and not any(byte > 0xF4 for byte in head):
        start = head.lstrip().lower()
        playlist = start.startswith((b"ffconcat", b"#extm3u", b"[playlist]", b"v=0", b"<?xml", b"#!"))
        kind = "a playlist or script with a video's name" if playlist else "a text file, not a video"
        return InputRejected(f"'{path.name}' is {kind}", accepted, "give the video itself")
    if head[4:8] in (b"ftyp", b"moov", b"mdat") or head[:4] in (b"RIFF", b"\x1a\x45\xdf\xa3", b"GIF8"):
        return _damaged(path)
    return InputRejected(f"'{path.name}' is not a video of a known kind", accepted, "convert it to mp4")


def _damaged(path: Path) -> InputRejected:
    return InputRejected(
        f"'{path.name}' is damaged or cut off (its index is missing)",
        "a complete video file",
        "copy, download or export it again",
    )


def _decoder(stream: av.VideoStream, limits: ReadLimits) -> VideoCodecContext:
    """The stream's decoder; libvpx where WebM carries alpha, which FFmpeg's own VP8 and VP9 decoders drop."""
    own = stream.codec_context
    name = {"vp8": "libvpx", "vp9": "libvpx-vp9"}.get(own.name)
    if stream.metadata.get("alpha_mode") == "1" and name is not None:
        try:
            other = av.CodecContext.create(name, "r")
            other.extradata = own.extradata
            own = cast(VideoCodecContext, other)
        except (av.error.FFmpegError, ValueError):
            pass  # this build of FFmpeg has no libvpx: the pictures come without alpha
    own.options = {"max_pixels": str(limits.max_pixels)}
    own.thread_type = "AUTO"
    return own


def decode_frames(
    container: av.container.InputContainer, stream: av.VideoStream, limits: ReadLimits, notes: Notes
) -> Iterator[tuple[Fraction | None, av.VideoFrame]]:
    """(presentation time in s, frame) of every frame that decodes; what does not is counted in `notes`."""
    decoder = _decoder(stream, limits)
    bad = 0
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets)
        except StopIteration:
            break
        except (av.error.FFmpegError, OSError):
            notes.add(CUT_OFF)
            break
        if packet.is_corrupt:  # FFmpeg marks the packet that the end of the file cuts through
            notes.add(CUT_OFF)
        try:
            frames = decoder.decode(packet if packet.size else None)
        except av.error.EOFError:
            break
        except av.error.FFmpegError:
            bad += 1
            continue
        for frame in frames:
            if frame.is_corrupt:
                bad += 1
                continue
            tick = frame.time_base or stream.time_base
            time = None if frame.pts is None or tick is None else frame.pts * tick
            yield time, frame
    if bad:
        notes.add(Notice("frames-damaged", f"{bad} damaged frames or packets were left out"))


def has_alpha(frame: av.VideoFrame) -> bool:
    """Whether the frame's pixel format has an alpha channel."""
    return any(component.is_alpha for component in frame.format.components)


def is_hdr(frame: av.VideoFrame) -> bool:
    """Whether the frame has a high dynamic range transfer curve."""
    return int(frame.color_trc) in (PQ, HLG)


def picture_of(frame: av.VideoFrame, notes: Notes) -> tuple[np.ndarray, np.ndarray | None]:
    """u8 [H,W,3] sRGB and u8 [H,W] alpha (or None), turned upright by the rotation metadata."""
    space = int(frame.colorspace)
    if space == _UNSPECIFIED and frame.height >= 720 and not frame.format.is_rgb:
        space = _ITU709  # what players assume for untagged high definition
    options = {} if frame.format.is_rgb or space == _UNSPECIFIED else {"src_colorspace": space}
    alpha = None
    if is_hdr(frame):
        notes.add(
            Notice("tone-mapped", "high dynamic range (PQ or HLG) was tone-mapped to sRGB; colours are approximate")
        )
        rgb = tone_map(frame.reformat(format="rgb48le", **options).to_ndarray(), int(frame.color_trc))
    elif has_alpha(frame):
        rgba = frame.reformat(format="rgba", **options).to_ndarray()
        rgb, alpha = rgba[..., :3], rgba[..., 3]
    else:
        rgb = frame.reformat(format="rgb24", **options).to_ndarray()
    turns = quarter_turns(frame, notes)
    rgb = np.ascontiguousarray(np.rot90(rgb, turns))
    return rgb, None if alpha is None else np.ascontiguousarray(np.rot90(alpha, turns))


def quarter_turns(frame: av.VideoFrame, notes: Notes) -> int:
    """Counter-clockwise quarter turns that set the picture upright."""
    turns = round(frame.rotation / 90)
    if abs(frame.rotation - 90 * turns) > 1:
        notes.add(
            Notice("rotation-rounded", f"rotation metadata of {frame.rotation} degrees was rounded to {90 * turns}")
        )
    return turns % 4
