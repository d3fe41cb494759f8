"""The clip that an asset comes from, where it is still at hand."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fluidlift.types import PixelLabels, VideoClip
from fluidlift.types.stages import Geometry, Read, Segmentation


@dataclass(frozen=True)
class Footage:
    """The clip that an asset comes from, where it is still at hand."""

    clip: VideoClip
    labels: PixelLabels
    plate: np.ndarray
    """u8 [H,W,3], the picture without the fluid"""
    start: int
    """frame of the clip that the first simulated one shows"""
    rocks: np.ndarray
    """bool [H,W], pixels in which something solid stands in or before the fluid"""
    before: np.ndarray | None = None
    """bool [H,W], pixels in which something that is no part of the ground hides all fluid; None: nothing does"""
    unseen: np.ndarray | None = None
    """bool [T,h,w], cells of the picture that each frame did not see itself, where it was steadied
    (`motion.full_frame`)"""


def footage_of(read: Read, segmentation: Segmentation, geometry: Geometry) -> Footage:
    """The clip as the first stages saw it."""
    labels = segmentation.labels
    rocks = geometry.rocks if geometry.rocks is not None else labels.solid.mean(axis=0) > 0.5
    clip = read.clip if segmentation.whole is None else replace(read.clip, frames=segmentation.whole)
    return Footage(clip, labels, geometry.plate, geometry.rest_frame, rocks, geometry.hidden, read.unseen)
