"""The input video beside the fluid: from the stages' cache, else from the preview film, else gone."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.errors import FluidliftError
from fluidlift.types import PinholeCamera

WIDTH = 480
"""px of the picture that is sent, at most"""
PANELS = 3
"""of the preview film, where it shows the input: the first of them does"""
QUALITY = 85
"""of JPEG pictures that are kept in memory"""
MOST_PICTURES = 2000
"""of the preview film: about 40 MB"""

GONE = (
    "The input video is no longer at hand: neither the folder work/ nor a preview with the input in it is there. "
    "`fluidlift make` writes both."
)


@dataclass(frozen=True)
class InputPictures:
    """The pictures that belong to the frames of a simulation, by its time."""

    source: str
    """in words, where they come from"""
    frames: Any
    """u8 [T,h,w,3] sRGB, mapped from disk; or a list of JPEG files in memory"""
    interval: float
    """s between pictures"""
    start: int = 0
    """picture of the first simulated frame"""

    def at(self, time: float) -> tuple[np.ndarray, bool]:
        """u8 [h,w,3] sRGB at a time (s from the first frame), at most `WIDTH` wide, and whether the clip has ended
        before that: then it is its last picture."""
        import cv2

        wanted = self.start + round(time / self.interval)
        k = min(max(wanted, 0), len(self.frames) - 1)
        found = self.frames[k]
        if isinstance(found, bytes):
            picture = cv2.imdecode(np.frombuffer(found, np.uint8), cv2.IMREAD_COLOR)
            assert picture is not None  # we wrote it
            return np.ascontiguousarray(picture[..., ::-1]), wanted > k
        return narrowed(np.asarray(found)), wanted > k


def narrowed(picture: np.ndarray) -> np.ndarray:
    """u8 [h,w,3], scaled down to at most `WIDTH` px across."""
    import cv2

    height, width = picture.shape[:2]
    if width <= WIDTH:
        return np.ascontiguousarray(picture)
    size = (WIDTH, max(1, round(height * WIDTH / width)))
    return np.ascontiguousarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))


def input_pictures(
    folder: Path, manifest: dict[str, Any], camera: PinholeCamera, interval: float
) -> InputPictures | None:
    """The input video of an asset, or None where it is gone.

    Args:
        folder: of the asset.
        manifest: of it.
        camera: of the video.
        interval: s between simulated frames, with which the preview film was made.
    """
    return _of_stages(folder, manifest) or _of_preview(folder, camera, interval)


def _of_stages(folder: Path, manifest: dict[str, Any]) -> InputPictures | None:
    from fluidlift.pipeline.recall import footage_of_asset

    try:
        footage = footage_of_asset(folder, manifest)
    except (FluidliftError, OSError, ValueError, KeyError):  # a cache that is damaged is as good as none
        return None
    if footage is None or not len(footage.clip):
        return None
    return InputPictures("the clip", footage.clip.frames, footage.clip.interval, footage.start)


def _of_preview(folder: Path, camera: PinholeCamera, interval: float) -> InputPictures | None:
    import cv2

    from fluidlift.io.limits import ReadLimits
    from fluidlift.io.video import read_clip

    film = folder / "preview.mp4"
    if not film.is_file() or film.is_symlink():
        return None
    try:
        limits = ReadLimits(max_frames=MOST_PICTURES)
        clip = read_clip(film, max_size=PANELS * WIDTH, limits=limits)
    except (FluidliftError, OSError):
        return None
    width, height = clip.size
    panels = (width / height) / (camera.size[0] / camera.size[1])
    if round(panels) != PANELS:
        return None  # made without the clip
    kept = []
    for frame in clip.frames:
        panel = np.ascontiguousarray(frame[:, : width // PANELS, ::-1])
        kept.append(cv2.imencode(".jpg", panel, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes())
    return InputPictures("preview.mp4", kept, interval)
