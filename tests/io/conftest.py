"""Small videos and a small asset, made on the spot."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from small_asset import random_gaussians, small_asset, small_mesh

from fluidlift.types import FluidAsset, Gaussians, TriangleMesh


def pictures(count: int, size: tuple[int, int] = (64, 48), channels: int = 3) -> np.ndarray:
    """u8 [T,H,W,C]: red upper half, green left half, and a white square that walks 2 px per frame along the middle."""
    w, h = size
    out = np.zeros((count, h, w, channels), np.uint8)
    out[:, : h // 2, :, 0] = 200
    out[:, :, : w // 2, 1] = 90
    for t in range(count):
        out[t, h // 2 - 4 : h // 2 + 4, 4 + 2 * t : 12 + 2 * t, :3] = 255
    if channels == 4:
        out[:, 10:30, 10:30, 3] = 255
    return out


@pytest.fixture
def make_video(tmp_path: Path) -> Callable[..., Path]:
    """Encode frames with time stamps in milliseconds."""

    def make(
        name: str = "clip.mp4",
        frames: np.ndarray | None = None,
        times_ms: Sequence[int] | None = None,
        codec: str = "libx264",
        pix_fmt: str = "yuv420p",
        options: dict[str, str] | None = None,
        tags: dict[str, int] | None = None,
        aspect: Fraction | None = None,
    ) -> Path:
        frames = pictures(10) if frames is None else frames
        times_ms = [40 * i for i in range(len(frames))] if times_ms is None else times_ms
        path = tmp_path / name
        kind = {1: "gray", 3: "rgb24", 4: "rgba"}[frames.shape[-1]]
        if frames.dtype == np.uint16:
            kind = "rgb48le"
        with av.open(str(path), "w") as container:
            stream = container.add_stream(codec, rate=25)
            stream.height, stream.width, stream.pix_fmt = frames.shape[1], frames.shape[2], pix_fmt
            stream.codec_context.time_base = Fraction(1, 1000)
            stream.options = options or {}
            if aspect is not None:
                stream.codec_context.sample_aspect_ratio = aspect
            for key, value in (tags or {}).items():
                setattr(stream.codec_context, key, value)
            for picture, time in zip(frames, times_ms):
                frame = av.VideoFrame.from_ndarray(picture, kind)
                frame.pts, frame.time_base = time, Fraction(1, 1000)
                for packet in stream.encode(frame):
                    container.mux(packet)
            for packet in stream.encode():
                container.mux(packet)
        return path

    return make


@pytest.fixture
def gaussians() -> Callable[..., Gaussians]:
    """`random_gaussians`."""
    return random_gaussians


@pytest.fixture
def clip_frames() -> Callable[..., np.ndarray]:
    """`pictures`."""
    return pictures


@pytest.fixture
def mesh() -> TriangleMesh:
    """`small_mesh`."""
    return small_mesh()


@pytest.fixture
def asset() -> FluidAsset:
    """`small_asset`."""
    return small_asset()
