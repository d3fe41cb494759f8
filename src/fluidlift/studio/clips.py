"""The clips of a folder: which there are, how a new one comes in, and small pictures of one."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fluidlift.errors import FluidliftError, InputRejected

VIDEOS = frozenset({".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".mpg", ".mpeg", ".mxf", ".gif"})
THUMBS = 10
"""pictures of the strip"""
THUMB_SIZE, FIRST_SIZE = 120, 640
"""px, longer sides of the strip's pictures and of the first large one"""
LARGEST = 8 * 2**30
"""bytes of a clip that is dropped on the page"""


def clips_in(folder: Path) -> list[str]:
    """Names of the videos in a folder."""
    return sorted(p.name for p in folder.iterdir() if p.suffix.lower() in VIDEOS and p.is_file() and not p.is_symlink())


def clip_at(folder: Path, name: str) -> Path:
    """The clip of a name.

    Raises:
        InputRejected: there is none.
    """
    if name not in clips_in(folder):
        raise InputRejected(f"no clip '{name[:80]}' in {folder}", "one of those that are shown", "load the page again")
    return folder / name


def name_for(folder: Path, given: str) -> Path:
    """Where a clip that comes in is written: its own name without what a file system or a shell minds, not yet taken.

    Raises:
        InputRejected: a file that is no video by its name.
    """
    plain = re.sub(r"[^\w.-]+", "_", Path(given.replace("\\", "/")).name).strip("._")[-120:]
    stem, suffix = Path(plain).stem, Path(plain).suffix.lower()
    if suffix not in VIDEOS:
        raise InputRejected(f"'{given[:80]}' is no video by its name", ", ".join(sorted(VIDEOS)), "choose a video file")
    number, path = 1, folder / f"{stem}{suffix}"
    while path.exists():
        number += 1
        path = folder / f"{stem}-{number}{suffix}"
    return path


def jpeg(picture: np.ndarray, quality: int = 88) -> bytes:
    """u8 [h,w,3], sRGB, as JPEG."""
    return cv2.imencode(".jpg", np.ascontiguousarray(picture[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, quality])[
        1
    ].tobytes()


class Strip:
    """The first picture of a clip, and a strip of small ones, read in a thread; the first one at once.

    Args:
        clip: video file.
        info: of `io.video.probe`.
        changed: called when there is one more.
    """

    def __init__(self, clip: Path, info: Any, changed: Callable[[], None]) -> None:
        self.clip, self._info, self._changed = clip, info, changed
        self.pictures: list[bytes] = []
        self.first = b""
        self.closed = False
        threading.Thread(target=self._read, name="strip", daemon=True).start()

    def _read(self) -> None:
        duration = self._info.duration
        try:
            self.first = jpeg(self._one(0.0, FIRST_SIZE))
            self._changed()
            for k in range(THUMBS):
                if self.closed:
                    return
                self.pictures = [*self.pictures, jpeg(self._one((k + 0.5) / THUMBS * duration, THUMB_SIZE), 75)]
                self._changed()
        except FluidliftError:
            return  # what is wrong with the clip is said where all of it is read

    def _one(self, time: float, size: int) -> np.ndarray:
        from fluidlift.io.video import read_clip

        step = 1.0 / max(self._info.fps, 1.0)
        start = max(0.0, min(time, self._info.duration - 4.0 * step))
        return read_clip(self.clip, start=start, duration=4.0 * step, max_size=size).frames[0]
