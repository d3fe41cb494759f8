"""Pictures of what the stages of a make leave, as they come."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fluidlift.io.atomic import write_bytes
from fluidlift.studio.clips import jpeg
from fluidlift.types.stages import Flow, Geometry, Motion, Read, Segmentation

WIDTH = 320
"""px, of a picture"""


class StagePictures:
    """Writes NAME.jpg of each stage that has something to show.

    Args:
        folder: to write to; pictures of an earlier make there are replaced.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        for old in folder.glob("*.jpg"):
            old.unlink()
        self._frame: np.ndarray | None = None

    def told(self, name: str, value: Any) -> None:
        """A stage has ended."""
        if isinstance(value, Read):
            self._frame = np.asarray(value.clip.frames[len(value.clip) // 2])
        picture = picture_of(value, self._frame)
        if picture is not None:
            height = max(1, round(WIDTH * picture.shape[0] / picture.shape[1]))
            small = cv2.resize(picture, (WIDTH, height), interpolation=cv2.INTER_AREA)
            write_bytes(self._folder / f"{name}.jpg", jpeg(small))


def picture_of(value: Any, frame: np.ndarray | None) -> np.ndarray | None:
    """u8 [h,w,3] of a stage's value; None where there is nothing to see.

    Args:
        value: of the stage.
        frame: u8 [h,w,3], in the middle of the clip.
    """
    if frame is None:
        return None
    if isinstance(value, Read):
        return frame
    if isinstance(value, Flow):
        return flow_picture(np.asarray(value.flow.displacement[len(value.flow) // 2], np.float32))
    if isinstance(value, Segmentation):
        from fluidlift.shape.segment import overlay

        labels = value.labels.labels
        return overlay(frame, np.asarray(labels[len(labels) // 2]))
    if isinstance(value, Geometry):
        return value.plate
    if isinstance(value, Motion):
        known = np.flatnonzero(np.isfinite(np.asarray(value.completed[:, 0, 0, 0])))
        return flow_picture(np.asarray(value.completed[known[len(known) // 2]], np.float32)) if len(known) else None
    return None


def flow_picture(way: np.ndarray) -> np.ndarray:
    """u8 [h,w,3] of a flow [h,w,2]: colour is direction, brightness speed, up to the 99th percentile."""
    speed = np.linalg.norm(way, axis=-1)
    top = max(float(np.percentile(speed, 99.0)), 1e-6)
    angle = (np.degrees(np.arctan2(way[..., 1], way[..., 0])) % 360.0) / 2.0
    hsv = np.dstack([angle, np.full_like(angle, 200.0), 255.0 * np.minimum(speed / top, 1.0)]).astype(np.uint8)
    return cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)
