"""Small videos and a small asset, made on the spot."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from fluidlift.types import (
    CellType,
    Estimate,
    FaceVelocity,
    FluidAsset,
    FluidParameters,
    Gaussians,
    Grid,
    PinholeCamera,
    Similarity3,
    Terrain,
    TriangleMesh,
)


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


def random_gaussians(n: int, coefficients: int = 4, seed: int = 0) -> Gaussians:
    """Gaussians with every number different."""
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(n, 4))
    return Gaussians(
        rng.normal(size=(n, 3)),
        quats / np.linalg.norm(quats, axis=1, keepdims=True),
        rng.uniform(0.005, 0.05, (n, 3)),
        rng.uniform(0.01, 0.99, n),
        0.3 * rng.normal(size=(n, coefficients, 3)),
    )


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
    """One quarter of an octahedron, with colours."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], np.float32)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    return TriangleMesh(vertices, faces, np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.5, 0.5, 0.5]], np.float32))


@pytest.fixture
def asset(mesh: TriangleMesh) -> FluidAsset:
    """A fluid with every field filled."""
    rng = np.random.default_rng(7)
    grid = Grid((6, 5, 4), 0.1, (-0.3, 0.2, -1.0))
    cells = rng.integers(0, len(CellType), grid.shape).astype(np.uint8)
    velocity = FaceVelocity(*(rng.normal(size=grid.face_shape(a)).astype(np.float32) for a in range(3)))
    distance = rng.normal(size=(7, 6, 5)).astype(np.float32)
    return FluidAsset(
        kind="stream",
        rest=random_gaussians(40),
        terrain=Terrain(grid, distance, np.array([1.0, 0.0, 0.0]), mesh),
        grid=grid,
        cell_types=cells,
        velocity=velocity,
        parameters=FluidParameters(kinematic_viscosity=3e-5, inflow_velocity=(0.4, 0.1, 0.0)),
        estimates={
            "kinematic_viscosity": Estimate(3e-5, 1e-6, True, 1e-6, "m^2/s"),
            "density": Estimate(1000.0, np.inf, False, 1000.0, "kg/m^3"),
        },
        camera=PinholeCamera.looking(np.array([3.0, -2.0, 2.0]), np.zeros(3), 50, (512, 288)),
        world_from_canonical=Similarity3(2.5, np.eye(3), np.array([0.1, 0.2, 0.3])),
        interval=1001 / 30000,
        frame_count=90,
        provenance={"seed": 3, "input": {"name": "river.mp4", "sha256": "00"}},
    )
