"""From a first guess of the fluid to the few clicks that a promptable network starts from, and from masks to labels."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from fluidlift.errors import InputRejected
from fluidlift.types import Label, PixelLabels

CLICKS = 4
"""points on the fluid, and as many beside it: networks are trained with up to about eight clicks"""
SMALLEST_HOLE = 4e-4
"""share of the picture: smaller holes in the fluid are noise, as in `shape.segment`"""


class PointPrompts(NamedTuple):
    """What a person would click on one frame."""

    frame: int
    points: Float[np.ndarray, "n 2"]
    """px, column and row of pixel centres counted from 0"""
    fluid: Bool[np.ndarray, " n"]
    """True on the fluid, False beside it"""


def clicks_from(labels: PixelLabels) -> PointPrompts:
    """Points deep inside what a first guess is surest of, on the frame where it is surest.

    The frame is the one with the largest sum of confidence over its fluid. Of its fluid, and of what is not, the
    surer half counts; the first point is the deepest inside it, each next one the deepest that stays away from those
    before (the smaller of its distances to the border and to them is largest).

    Raises:
        InputRejected: no fluid in any frame.
    """
    surest = [float(c[l == Label.FLUID].sum(dtype=np.float64)) for l, c in zip(labels.labels, labels.confidence)]
    frame = int(np.argmax(surest))
    fluid = np.asarray(labels.labels[frame] == Label.FLUID)
    confidence = np.asarray(labels.confidence[frame], np.float32)
    if not fluid.any():
        raise InputRejected("no fluid was found that a network could be shown", "a region that moves", "draw a mask")
    on, beside = (_deep_points(_surer_half(region, confidence)) for region in (fluid, ~fluid))
    return PointPrompts(frame, np.concatenate([on, beside]), np.arange(len(on) + len(beside)) < len(on))


def _surer_half(region: np.ndarray, confidence: np.ndarray) -> np.ndarray:
    if not region.any():
        return region
    return region & (confidence >= np.median(confidence[region]))


def _deep_points(region: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "n 2"]:
    depth = cv2.distanceTransform(np.pad(region, 1).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    v, u = np.mgrid[: region.shape[0], : region.shape[1]].astype(np.float32)
    points, free = [], depth.copy()
    while len(points) < CLICKS and free.max() >= 1.0:
        row, column = np.unravel_index(np.argmax(free), free.shape)
        points.append((float(column), float(row)))
        free = np.minimum(free, np.hypot(u - column, v - row))
    return np.array(points, np.float32).reshape(-1, 2)


def labels_of_frame(fluid: Bool[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    """FLUID, and SOLID where something is enclosed by it, BACKGROUND else."""
    count, parts, stats, _ = cv2.connectedComponentsWithStats((~fluid).astype(np.uint8), connectivity=4)
    height, width = fluid.shape
    left, top, wide, high, area = (np.asarray(stats[:, k], int) for k in range(5))
    inner = (left > 0) & (top > 0) & (left + wide < width) & (top + high < height)
    label = np.full(count, Label.BACKGROUND, np.uint8)
    label[inner & (area < SMALLEST_HOLE * fluid.size)] = Label.FLUID
    label[inner & (area >= SMALLEST_HOLE * fluid.size)] = Label.SOLID
    label[0] = Label.FLUID  # part 0 is the fluid itself
    return label[np.asarray(parts, int)]


def ordered_from(frame: int, count: int) -> tuple[Int[np.ndarray, " a"], Int[np.ndarray, " b"]]:
    """Frames from `frame` on to the end, and from the one before it back to the first."""
    return np.arange(frame, count), np.arange(frame - 1, -1, -1)
