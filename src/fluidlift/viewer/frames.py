"""Frames as the browser takes them, read when they are wanted and forgotten when there are too many."""

from __future__ import annotations

import math
import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, Protocol, TypeVar

import numpy as np

from fluidlift.errors import FluidliftError, InputRejected, require
from fluidlift.io.frames import FIRST_FRAME
from fluidlift.look.surface_skin import of_skin
from fluidlift.types import Gaussians

CACHE_BYTES = 192 * 2**20
"""of frames that are kept, in memory"""


class FrameMissing(FluidliftError):
    """A frame that is not there, or cannot be read."""


class Sized(Protocol):
    """What a cache can hold."""

    @property
    def nbytes(self) -> int:
        """Of memory."""
        ...


@dataclass(frozen=True)
class SplatFrame:
    """The splats of one frame."""

    centers: np.ndarray
    """f32 [n,3], m"""
    covariances: np.ndarray
    """f32 [n,3,3], m^2"""
    rgb: np.ndarray
    """u8 [n,3], sRGB: the part of the colour that does not depend on the view"""
    opacities: np.ndarray
    """u8 [n,1]"""
    velocities: np.ndarray
    """f32 [n,3], m/s"""
    poses: np.ndarray | None = None
    """[b,7] of the obstacles: position (m), orientation (w, x, y, z); None: not known"""
    skin: np.ndarray | None = None
    """bool [n]: those that are paint on the surface and no liquid; None: none of them"""

    @property
    def liquid(self) -> np.ndarray:
        """f32 [m,3]: centres of the splats that stand for liquid, m."""
        return self.centers if self.skin is None else self.centers[~self.skin]

    @property
    def nbytes(self) -> int:
        """Of memory."""
        parts = (self.centers, self.covariances, self.rgb, self.opacities, self.velocities, self.skin)
        return sum(a.nbytes for a in parts if a is not None)

    @property
    def fastest(self) -> float:
        """m/s that 99 % of the splats do not exceed."""
        if not len(self.velocities):
            return 0.0
        return float(np.percentile(np.sqrt(np.square(self.velocities).sum(axis=1)), 99))


def splat_frame(
    gaussians: Gaussians, velocities: np.ndarray, poses: np.ndarray | None = None, *, cell: float = math.nan
) -> SplatFrame:
    """What is shown of splats; those that are not finite are left out.

    Args:
        gaussians: n splats.
        velocities: [n,3], m/s.
        poses: [b,7] of the obstacles.
        cell: m, of the simulator's cells, by which a skin is told; not a number: there is none.
    """
    sound = np.all(np.isfinite(gaussians.means) & np.isfinite(gaussians.scales), axis=1)
    if not sound.all():
        gaussians, velocities = gaussians.select(sound), velocities[sound]
    skin = of_skin(gaussians, cell)
    return SplatFrame(
        gaussians.means,
        gaussians.covariances().astype(np.float32),
        np.round(255 * gaussians.rgb).astype(np.uint8),
        np.round(255 * np.clip(gaussians.opacities, 0, 1)).astype(np.uint8)[:, None],
        np.asarray(velocities, np.float32),
        poses,
        skin if skin.any() else None,
    )


def read_frame(folder: Path, index: int, *, cell: float = math.nan) -> SplatFrame:
    """Frame `index` (from 0) of an asset, whose simulation had cells so wide (m).

    Raises:
        FrameMissing: it is not there, or not (yet) whole.
    """
    from fluidlift.scene import splat_files

    try:
        frame = splat_files.read_frame(splat_files.frame_file(folder, FIRST_FRAME + index))
    except (InputRejected, OSError) as error:
        raise FrameMissing(f"Frame {FIRST_FRAME + index} is not there: {error}") from None
    return splat_frame(frame.gaussians, frame.velocities, cell=cell)


T = TypeVar("T", bound=Sized)


class FrameCache(Generic[T]):
    """The frames that were wanted last, as many as fit into `most_bytes`. Safe to use from several threads.

    Args:
        load: makes frame `index`; what it raises is passed on, and nothing is kept of it.
        most_bytes: of memory; a single larger frame is kept all the same.
    """

    def __init__(self, load: Callable[[int], T], most_bytes: int = CACHE_BYTES) -> None:
        require(most_bytes > 0, f"{most_bytes} bytes", "a positive number")
        self._load, self._most = load, most_bytes
        self._kept: OrderedDict[int, T] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()
        self._loading = threading.Lock()

    def __len__(self) -> int:
        return len(self._kept)

    @property
    def nbytes(self) -> int:
        """Of what is kept."""
        return self._bytes

    def get(self, index: int) -> T:
        """Frame `index`, from memory or loaded."""
        found = self._seen(index)
        if found is not None:
            return found
        with self._loading:  # one at a time: two threads that want the same frame read it once
            found = self._seen(index)
            if found is not None:
                return found
            frame = self._load(index)
        with self._lock:
            self._kept[index] = frame
            self._bytes += frame.nbytes
            while self._bytes > self._most and len(self._kept) > 1:
                self._bytes -= self._kept.popitem(last=False)[1].nbytes
        return frame

    def _seen(self, index: int) -> T | None:
        with self._lock:
            if index in self._kept:
                self._kept.move_to_end(index)
            return self._kept.get(index)

    def clear(self) -> None:
        """Forget all of them."""
        with self._lock:
            self._kept.clear()
            self._bytes = 0
