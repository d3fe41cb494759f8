"""A small clip of a stream whose truth is known, and the asset that is made from it once for all tests."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

INTERVAL = 0.04
"""s between frames of the small clip"""

QUICK = (
    "--set", "shape.cells=24", "--set", "shape.refine_iterations=2", "--set", "motion.targets=2",
    "--set", "fit.max_seconds=60",
)  # fmt: skip
"""coarse; the fit may take the time that it needs (a few seconds), because one that is cut off by the clock depends on
how fast the machine is"""

HASTY = (
    "--set", "shape.cells=12", "--set", "shape.refine_iterations=0", "--set", "motion.targets=1",
    "--set", "fit.max_seconds=0.5", "--set", "simulate.frames=2", "--set", "show.usd=false",
)  # fmt: skip
"""for tests that only ask what is said on the way"""

FOREIGN = {"backends", "blender"}
"""folders whose tests run a large package of others; tests that ask for `visitor` run a browser"""

ASSET = {"made", "story", "finished_tank", "tank_folder"}
"""fixtures that make an asset, which takes seconds"""


def tier_of(item: pytest.Item) -> str:
    """One of the markers in pyproject.toml, by the test's folder, its fixtures and what its module calls."""
    room = item.path.relative_to(Path(__file__).parent).parts[0]
    fixtures = set(item.fixturenames)
    if room in FOREIGN or "visitor" in fixtures:
        return "foreign"
    if room == "validation":
        return "ladder"
    calls = "fluidlift.cli import main" in item.path.read_text()
    return "asset" if calls or ASSET & fixtures else "unit"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Every test gets its tier."""
    for item in items:
        item.add_marker(tier_of(item))


def stream_pictures(count: int = 10, size: tuple[int, int] = (96, 64), step: int = 2, seed: int = 0) -> np.ndarray:
    """u8 [T,H,W,3]: blue texture that runs `step` px per frame to the right between still brown banks, round a rock."""
    width, height = size
    rng = np.random.default_rng(seed)

    def texture(shape: tuple[int, int], colour: tuple[int, int, int], contrast: float) -> np.ndarray:
        noise = cv2.GaussianBlur(rng.standard_normal(shape).astype(np.float32), (0, 0), 1.1)
        return np.clip(np.asarray(colour) + contrast * (noise / noise.std())[..., None], 0, 255)

    ground = texture((height, width), (120, 95, 60), 22)
    water = texture((height, width + step * count), (70, 105, 120), 25)
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    # a trapezoid: a channel that is a little wider on the near side
    channel = (v > 0.28 * height) & (v < (0.78 + 0.04 * u / width) * height)
    rock = ((u - 0.6 * width) / 7) ** 2 + ((v - 0.55 * height) / 5) ** 2 < 1
    frames = []
    for t in range(count):
        moved = water[:, step * (count - t) : step * (count - t) + width]
        picture = np.where((channel & ~rock)[..., None], moved, ground)
        frames.append(np.where(rock[..., None], 0.7 * ground, picture))
    return np.stack(frames).astype(np.uint8)


def write_clip(path: Path, frames: np.ndarray) -> Path:
    """Encode frames at 25 per second."""
    from fluidlift.io.video import write_video

    return write_video(path, frames, 1.0 / INTERVAL)


@dataclass(frozen=True)
class Job:
    """What one run of the command line left."""

    clip: Path
    folder: Path
    code: int


@pytest.fixture
def pictures() -> Callable[..., np.ndarray]:
    """`stream_pictures`."""
    return stream_pictures


@pytest.fixture
def clip_file() -> Callable[[Path, np.ndarray], Path]:
    """`write_clip`."""
    return write_clip


@pytest.fixture
def quick() -> tuple[str, ...]:
    """Options under which the small clip takes seconds."""
    return QUICK


@pytest.fixture
def hasty() -> tuple[str, ...]:
    """Options under which the small clip takes no time, and the result is worth nothing."""
    return HASTY


@pytest.fixture(scope="session")
def stream_clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small clip."""
    return write_clip(tmp_path_factory.mktemp("clip") / "stream.mp4", stream_pictures())


@pytest.fixture(scope="session")
def made(stream_clip: Path, tmp_path_factory: pytest.TempPathFactory) -> Job:
    """The small clip as an asset. Tests read it; those that change it work on a copy."""
    from fluidlift.cli import main

    folder = tmp_path_factory.mktemp("made") / "stream.fluid"
    code = main(["make", str(stream_clip), "-o", str(folder), "--size", "2", *QUICK])
    return Job(stream_clip, folder, code)


@pytest.fixture
def patience_ends(monkeypatch):
    """Lets the time that a generator may take pass once a file is there, however long it takes until then."""
    from fluidlift.backends import generator_process

    def end(when: Path) -> None:
        clock = SimpleNamespace(sleep=time.sleep, monotonic=lambda: time.monotonic() + 1e6 * when.exists())
        monkeypatch.setattr(generator_process, "time", clock)

    return end


@pytest.fixture(scope="module")
def single_thread():
    """Small arrays, torch and Numba in turn: their thread pools would only wait for each other."""
    import numba
    import torch

    before = numba.get_num_threads(), torch.get_num_threads()
    numba.set_num_threads(1)
    torch.set_num_threads(1)
    yield
    numba.set_num_threads(before[0])
    torch.set_num_threads(before[1])
