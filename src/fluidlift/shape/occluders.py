"""What stands before a fall and hides it (a plant, a post, a parapet), told from ground by what the water does there.

No water passes through ground. At a rock that stands in a sheet the water slows to nothing or turns aside, and below it
there is a wake: close to a round body it flows as the potential flow around a cylinder does, on its upstream half, and
hardly at all behind it. What is nearer to the camera is none of the water's concern: at its upper edge the water goes
in as fast as the sheet falls beside it, at its lower edge it comes out so, and beside it the water does not turn aside.
Both are models of the same measurements, and the odds between them decide.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from fluidlift.shape.region import SMALLEST_SOLID
from fluidlift.types.flow import TRUSTED

FALLING = 0.3
"""of the sheet's fast part (its 90th percentile): what is slower lies in a pool or comes over the rim"""
MEASURED = 0.1
"""of the fluid at least that is seen to fall: with less there is no sheet to compare with"""
GAP = 0.015
"""of the picture's longer side, from an outline to where the water beside it is looked at, up to twice as far: optical
flow is smooth, and what stands drags the flow around it within a patch of DIS (8 px of 512) towards nothing"""
SPREAD = 0.2
"""of the sheet's speed: by how much a place of a sheet differs from the mean of its height, and flow errs (a choice:
clear flow errs by 5 to 35 % on scenes with truth)"""
WAKE = 0.2
"""of the sheet's speed, behind a solid within its own width (mean of the near wake of a cylinder: it turns back, and
has 0.3 to 0.5 one width behind)"""
PRIOR = 1.0 / 3.0
"""odds that something dry within a sheet stands before it: rocks are in most falls, plants before some (a choice)"""
SURE = 0.9
"""probability from which it is taken to stand before the water"""
ROUGH = 0.006
"""of the longer side: gaps between the outlines of the fluid and of what is dry that are no gaps"""
KNOWN = 0.3
"""of the places at an outline that must be measured, and of the heights"""
FEWEST = 8
"""px of a sheet at a height, from which its speed there is known"""


@dataclass(frozen=True)
class _Sheet:
    """Falling water, in a picture that is turned so that it falls straight down."""

    wet: Bool[np.ndarray, "h w"]
    falling: Bool[np.ndarray, "h w"]
    dry: Bool[np.ndarray, "h w"]
    """in the picture, and never fluid"""
    measured: Bool[np.ndarray, "h w"]
    down: Float[np.ndarray, "h w"]
    """px per frame"""
    right: Float[np.ndarray, "h w"]
    gap: float
    """px"""


@dataclass(frozen=True)
class OutlineFlow:
    """What the water does at the outline of something dry, in speeds of the sheet at the same height; nan: not seen."""

    enters: float
    """speed into its upper edge"""
    leaves: float
    """speed out of its lower edge"""
    parts: float
    """speed away from it to both sides, beside its upper half"""
    narrow: float
    """(a / r)^2 of where that is measured: a its half width, r the distance from its middle"""

    @property
    def probability(self) -> float:
        """That it stands before the water; that of a sheet without any measurement at its upper edge is 0."""
        if not np.isfinite(self.enters):
            return 0.0
        # a cylinder of radius a: 1 - (a/r)^2 on the stagnation line; (a/r)^2 sin 2t aside, 2/pi of it in the mean
        # the wake fills up with a / r
        solid = (1.0 - self.narrow, 1.0 - (1.0 - WAKE) * np.sqrt(self.narrow), 2.0 / np.pi * self.narrow)
        odds = np.log(PRIOR)
        for seen, before, within in zip((self.enters, self.leaves, self.parts), (1.0, 1.0, 0.0), solid, strict=True):
            if np.isfinite(seen):
                # beyond what either expects a measurement says no more: faster than the sheet is as good as the sheet
                value = np.clip(seen, min(before, within), max(before, within))
                odds += ((value - within) ** 2 - (value - before) ** 2) / (2.0 * SPREAD**2)
        return float(1.0 / (1.0 + np.exp(-odds)))


def occluders(
    fluid: Bool[np.ndarray, "h w"],
    ever: Bool[np.ndarray, "h w"],
    motion: Float[np.ndarray, "h w 2"],
    trust: Float[np.ndarray, "h w"],
) -> Bool[np.ndarray, "h w"]:
    """Pixels in which something stands before a falling sheet, which goes on behind it.

    Args:
        fluid: where the fluid usually is.
        ever: where it is at some time.
        motion: mean optical flow, px per frame.
        trust: of it, 0 to 1.
    """
    none = np.zeros(fluid.shape, bool)
    turn = _turn_down(fluid, motion, trust)
    if turn is None:
        return none
    sheet = _sheet(turn, fluid, ever, motion, trust)
    if sheet is None:
        return none
    found = np.zeros(sheet.wet.shape, bool)
    label, count = ndimage.label(_enclosed(sheet))
    for part in range(1, count + 1):
        piece = label == part
        if piece.sum() >= SMALLEST_SOLID * fluid.size and at_outline(sheet, piece).probability > SURE:
            found |= piece
    return none if not found.any() else _turned_back(found, turn, fluid.shape) & ~ever


def near_occluders(hidden: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels whose flow is that of what stands before the fluid, or is dragged along by it."""
    return np.asarray(ndimage.distance_transform_edt(~hidden)) <= GAP * max(hidden.shape)


@dataclass(frozen=True)
class HiddenFluid:
    """What hidden fluid is taken to look like: as what is seen beside it, mirrored at the outline of what hides it."""

    hidden: Bool[np.ndarray, "h w"]
    lent: Int[np.ndarray, "2 n"]
    """row and column that lends its look to each hidden pixel, in the order of `numpy.nonzero`"""

    @classmethod
    def of(cls, hidden: Bool[np.ndarray, "h w"], fluid: Bool[np.ndarray, "h w"]) -> HiddenFluid:
        """Of the seen fluid at the same height, on the nearer side; of the nearest fluid where there is none."""
        clear = fluid & ~near_occluders(hidden)
        clear = clear if clear.any() else fluid & ~hidden
        if not clear.any():
            return cls(hidden, np.stack(np.nonzero(hidden)))
        y, x = np.nonzero(hidden)
        gap, column, width = round(GAP * max(hidden.shape)), np.arange(hidden.shape[1]), hidden.shape[1]
        before = np.maximum.accumulate(np.where(hidden, -1, column), axis=1)[y, x]
        after = np.minimum.accumulate(np.where(hidden, width, column)[:, ::-1], axis=1)[:, ::-1][y, x]
        sides = np.stack([2 * before - x - gap, 2 * after - x + gap])
        far = np.stack([x - before, after - x])
        there = (sides >= 0) & (sides < width)
        good = there & clear[y, np.clip(sides, 0, width - 1)]
        nearest = ndimage.distance_transform_edt(~clear, return_distances=False, return_indices=True)[:, y, x]
        side = np.where(good, far, 2 * width).argmin(axis=0)
        own = np.take_along_axis(sides, side[None], axis=0)[0]
        found = good.any(axis=0)
        return cls(hidden, np.where(found, np.stack([y, own]), nearest))

    def pictures(self, frames: np.ndarray) -> Pictures:
        """Pictures or masks [T,H,W,...] as they would be without what stands before the fluid."""
        return Pictures(frames, self)


@dataclass(frozen=True)
class Pictures:
    """Pictures [T,H,W,...], completed one by one when they are asked for."""

    frames: np.ndarray
    behind: HiddenFluid

    def __len__(self) -> int:
        return len(self.frames)

    def __iter__(self) -> Iterator[np.ndarray]:
        return (self[t] for t in range(len(self)))

    def __getitem__(self, frame: int) -> np.ndarray:
        picture = np.array(self.frames[frame])
        picture[self.behind.hidden] = picture[tuple(self.behind.lent)]
        return picture


def _turn_down(fluid: np.ndarray, motion: np.ndarray, trust: np.ndarray) -> np.ndarray | None:
    """Affine [2,3] that turns the picture so that the fluid falls down in it; None where it falls nowhere."""
    speed = np.linalg.norm(motion, axis=-1)
    x, y = ((np.where(fluid & (trust > TRUSTED), speed, 0.0))[..., None] * motion).sum(axis=(0, 1))
    if y <= abs(x):  # more across than down
        return None
    height, width = fluid.shape
    lean = np.degrees(np.arctan2(x, y))
    turn = cv2.getRotationMatrix2D((width / 2, height / 2), -lean, 1.0)
    size = np.abs(turn[:, :2]) @ (width, height)
    turn[:, 2] += 0.5 * size - (width / 2, height / 2)
    return turn


def _sheet(
    turn: np.ndarray, fluid: np.ndarray, ever: np.ndarray, motion: np.ndarray, trust: np.ndarray
) -> _Sheet | None:
    """The fluid in the turned picture; None where too little of it is seen to fall."""
    height, width = fluid.shape
    size = tuple(int(np.ceil(v)) for v in np.abs(turn[:, :2]) @ (width, height))

    def turned(values: np.ndarray) -> np.ndarray:
        return cv2.warpAffine(np.ascontiguousarray(values, np.float32), turn, size, flags=cv2.INTER_NEAREST)

    moved = motion @ turn[:, :2].T
    wet, inside = turned(fluid) > 0, turned(np.ones_like(fluid)) > 0
    down, right, measured = turned(moved[..., 1]), turned(moved[..., 0]), wet & (turned(trust) > TRUSTED)
    if not measured.any():
        return None
    falling = measured & (down > FALLING * max(float(np.percentile(down[measured], 90)), 1e-6))
    if falling.sum() < MEASURED * wet.sum():
        return None
    return _Sheet(wet, falling, inside & (turned(ever) == 0), measured, down, right, GAP * max(height, width))


def _enclosed(sheet: _Sheet) -> np.ndarray:
    """Dry pixels with the sheet above them, and with the sheet on both sides, or again below them."""
    seen = [
        np.maximum.accumulate(sheet.falling, axis=0),
        np.maximum.accumulate(sheet.falling[::-1], axis=0)[::-1],
        np.maximum.accumulate(sheet.falling, axis=1),
        np.maximum.accumulate(sheet.falling[:, ::-1], axis=1)[:, ::-1],
    ]
    above, below, left, right = seen
    return sheet.dry & above & ((left & right) | below)


def at_outline(sheet: _Sheet, piece: Bool[np.ndarray, "h w"]) -> OutlineFlow:
    """What the water does at the outline of a dry piece of the turned picture."""
    rows, columns = np.nonzero(piece)
    half = 0.5 * float(np.ptp(columns) + 1)
    usual = _usual(sheet, piece, half + 2.0 * sheet.gap)
    away = np.arange(round(sheet.gap), round(2.0 * sheet.gap) + 1)
    across = np.unique(columns)
    first, last = piece[:, across].argmax(axis=0), len(piece) - 1 - piece[::-1, across].argmax(axis=0)
    enters = _typical(sheet, usual, first[:, None] - away, across[:, None] + 0 * away)[0]
    leaves = _typical(sheet, usual, last[:, None] + away, across[:, None] + 0 * away)[0]
    # the upstream half of something round
    upper = np.arange(rows.min(), int(np.ceil(min(rows.min() + half, rows.max()))) + 1)
    upper = upper[piece[upper].any(axis=1)]
    begins, ends = piece[upper].argmax(axis=1), piece.shape[1] - 1 - piece[upper][:, ::-1].argmax(axis=1)
    beside = upper[:, None] + 0 * away
    sides = (
        -_typical(sheet, usual, beside, begins[:, None] - away)[1],
        _typical(sheet, usual, beside, ends[:, None] + away)[1],
    )
    seen = [s for s in sides if np.isfinite(s)]
    narrow = (half / (half + 1.5 * sheet.gap)) ** 2
    return OutlineFlow(enters, leaves, float(np.mean(seen)) if seen else float("nan"), float(narrow))


def _usual(sheet: _Sheet, piece: np.ndarray, reach: float) -> np.ndarray:
    """Speed down and to the right [h,2] of the sheet at each height, `reach` px from a piece or more; nan: no sheet."""
    beside = sheet.falling & (ndimage.distance_transform_edt(~piece) > reach)
    usual = np.full((len(piece), 2), np.nan)
    for y in np.flatnonzero(beside.sum(axis=1) >= FEWEST):
        usual[y] = np.median(sheet.down[y, beside[y]]), np.median(sheet.right[y, beside[y]])
    return usual


def _typical(sheet: _Sheet, usual: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> tuple[float, float]:
    """Median speed down, and to the right beyond the usual, at places of the picture, in usual speeds of their heights;
    nan where fewer than `KNOWN` of them are measured."""
    inside = (rows >= 0) & (rows < usual.shape[0]) & (columns >= 0) & (columns < sheet.wet.shape[1])
    y, x = rows[inside], columns[inside]
    known = sheet.measured[y, x] & np.isfinite(usual[y, 0])
    if known.sum() < max(KNOWN * rows.size, FEWEST):
        return float("nan"), float("nan")
    y, x = y[known], x[known]
    down, right = sheet.down[y, x] / usual[y, 0], (sheet.right[y, x] - usual[y, 1]) / usual[y, 0]
    return float(np.median(down)), float(np.median(right))


def _turned_back(found: np.ndarray, turn: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """The picture as it was, bool [h,w]; gaps at outlines closed."""
    back = cv2.warpAffine(
        found.astype(np.uint8), turn, shape[::-1], flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    )  # fmt: skip
    size = 2 * round(ROUGH * max(shape)) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return cv2.dilate(back, disc) > 0
