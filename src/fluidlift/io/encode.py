"""H.264 previews."""

from __future__ import annotations

import math
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import cast

import av
import av.container
import av.error
import numpy as np
from jaxtyping import UInt8

from fluidlift.errors import InputRejected, require, required
from fluidlift.io.atomic import atomic_path

_ITU709, _MPEG_RANGE = 1, 1


def write_video(
    path: Path | str,
    frames: Iterable[UInt8[np.ndarray, "h w 3"]],
    fps: float,
    *,
    quality: float = 18.0,
    repeatable: bool = False,
) -> Path:
    """Write sRGB frames as H.264 (yuv420p, BT.709), which everything plays; the file appears when it is whole.

    Args:
        path: ends in .mp4 or .mov.
        frames: u8 [H,W,3] of one size, or float in [0, 1]; taken one by one. An odd last row or column is doubled,
            because 4:2:0 needs even sizes.
        fps: frames per second.
        quality: constant rate factor, 0 (lossless) to 51.
        repeatable: the same file whatever the processors and their number, for clips that are measured on; slower.

    Raises:
        InputRejected: the disk is full or may not be written.
        ValueError: no frames, or frames of several sizes.
    """
    require(math.isfinite(fps) and fps > 0, f"fps {fps}", "a positive number")
    path = Path(path)
    with (
        atomic_path(path) as temporary,
        av.open(str(temporary), "w", options={"movflags": "+faststart"}) as container,
    ):
        stream, shape = None, None
        for frame in frames:
            picture = _even(frame)
            if stream is None:
                shape = picture.shape
                stream = _new_stream(container, shape, fps, quality, repeatable)
            require(picture.shape == shape, f"a frame {picture.shape} after frames {shape}", "one size")
            video_frame = av.VideoFrame.from_ndarray(picture, "rgb24")
            video_frame = video_frame.reformat(format="yuv420p", dst_colorspace=_ITU709)
            video_frame.pts = None
            for packet in stream.encode(video_frame):
                container.mux(packet)
        for packet in required(stream, "no frames to write").encode():
            container.mux(packet)
    return path


def _even(frame: np.ndarray) -> np.ndarray:
    frame = np.asarray(frame)
    if frame.dtype != np.uint8:
        frame = np.round(255.0 * np.clip(np.nan_to_num(frame), 0.0, 1.0)).astype(np.uint8)
    require(frame.ndim == 3 and frame.shape[2] == 3, f"a frame {frame.shape}", "[H,W,3]")
    pad = [(0, frame.shape[0] % 2), (0, frame.shape[1] % 2), (0, 0)]
    return np.ascontiguousarray(np.pad(frame, pad, mode="edge"))


def _new_stream(
    container: av.container.OutputContainer, shape: tuple[int, ...], fps: float, quality: float, repeatable: bool
) -> av.VideoStream:
    rate = Fraction(fps).limit_denominator(1001)
    # x264 takes as many threads as there are processors, and what it looks ahead with changes what it writes; its
    # macroblock tree rounds as the vector instructions of the processor do, with AVX-512 not even twice alike
    alone = {"x264-params": "threads=1:lookahead-threads=1:cpu-independent=1"} if repeatable else {}
    for name, options in (("libx264", {"crf": str(quality), "preset": "medium"} | alone), ("mpeg4", {"qscale": "3"})):
        try:
            stream = cast(av.VideoStream, container.add_stream(name, rate=rate, options=options))
            break
        except (av.error.FFmpegError, ValueError):  # FFmpeg without x264 (an LGPL build)
            continue
    else:
        raise InputRejected("an FFmpeg without an H.264 or MPEG-4 encoder", "PyAV from PyPI", "pip install av")
    stream.height, stream.width, stream.pix_fmt = shape[0], shape[1], "yuv420p"
    context = stream.codec_context
    context.colorspace = context.color_primaries = context.color_trc = _ITU709
    context.color_range = _MPEG_RANGE
    return stream
