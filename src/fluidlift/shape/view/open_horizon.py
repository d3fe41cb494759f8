"""Open water: its surface ends at the horizon, a straight line from side to side of the picture.

A level plane without a far bank ends where the sky begins: a pinhole camera sees that border as a straight line (the
earth's curvature bends it by a tenth of a pixel). Over a river a bank stands between water and sky, with an outline of
its own. What lies is all below the line.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

LONGEST = 256
"""px of the longer side of the picture that the line is looked for in"""
LEANS = np.arange(-8.0, 8.01, 0.5)
"""degrees of the line against the picture's rows: as hands turn cameras"""
BLOCKS = 20
"""side by side, in which the border's step is taken"""
STRAIGHT = 0.9
"""of them that show at least half of the usual step, in its direction: ships and piers stand before the rest. Of 34
real clips both that show the sea's horizon have all of them, eleven others something up to 0.9"""
STEP = 4.0
"""Lab units (0 to 255) at least, from water to sky: twice what coding leaves of a faint border"""
APART = 4
"""rows, from a border to where its step is over: the sky's own gradient goes on, and more so along a leaning line"""
BAND = 0.05
"""part of the picture's height above the line that is sky alone"""
PLAIN = (4.0, 8.0)
"""Lab lightness per px along the line, which 95 % of that band stay below: up to which it is sky (1 and 2 in the two
clips), and from which there are trees, rocks or houses (8 to 70 above other straight lines)"""
SPANS = (0.5, 0.7)
"""share of the picture's columns with water below the line from which it may go from side to side, and from which it
does: a tray lies on a table whose edge is straight, too. Of a breaker on a beach 0.77 is found, the rest is calm"""
ABOVE = 0.02
"""share of the water above the line, at most: errors of its outline"""


@dataclass(frozen=True)
class OpenHorizon:
    """The line on which open water ends."""

    ends: tuple[tuple[float, float], tuple[float, float]]
    """px (u, v) of the picture, at its left and its right edge"""
    share: float
    """how far it is one, 0 to 1"""

    def below(self, shape: tuple[int, ...]) -> Float[np.ndarray, "h w"]:
        """px that each pixel's centre lies below the line in a picture of `shape`, rows and columns; above: negative.

        The picture has the size in which the line was looked for, or is that at another scale.
        """
        (left, first), (right, last) = self.ends
        k = shape[1] / (right - left)
        u, v = np.arange(shape[1]) + 0.5, np.arange(shape[0])[:, None] + 0.5
        return v - k * (first + (last - first) / (right - left) * u / k)


def open_horizon(picture: UInt8[np.ndarray, "h w 3"], fluid: Bool[np.ndarray, "h w"]) -> OpenHorizon | None:
    """The line on which water ends that reaches the horizon; None where a picture shows none.

    Args:
        picture: sRGB, typical for the clip.
        fluid: pixels that are known to be fluid.
    """
    total = int(fluid.sum())
    spans = float(np.clip((fluid.any(axis=0).mean() - SPANS[0]) / (SPANS[1] - SPANS[0]), 0.0, 1.0))
    if total == 0 or spans == 0.0:
        return None
    scale = min(LONGEST / max(fluid.shape), 1.0)
    width, height = (max(round(n * scale), BLOCKS) for n in (fluid.shape[1], fluid.shape[0]))
    small = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
    lab = cv2.cvtColor(small, cv2.COLOR_RGB2LAB).astype(np.float32)
    wet = cv2.resize(fluid.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
    seen = [_shown(_turned(lab, lean), _turned(wet, lean)) for lean in LEANS]
    share = max(seen)[0]
    if share == 0.0:
        return None
    # neighbouring leans see it as well: the one along which the border is sharpest
    lean, (_, _, row) = max(zip(LEANS, seen, strict=True), key=lambda found: (found[1][0] >= share, found[1][1]))
    rise = 0.5 * width * np.tan(np.radians(lean))
    k = fluid.shape[1] / width
    return OpenHorizon(
        ((0.0, float(k * (row - rise))), (float(fluid.shape[1]), float(k * (row + rise)))), spans * share
    )


def _shown(lab: np.ndarray, wet: np.ndarray) -> tuple[float, float, int]:
    """Whether some row of a picture is the horizon, 0 to 1, its sharpness (Lab units), and the row below it.

    Args:
        lab: float32 [h,w,3].
        wet: float32 [h,w], share of fluid.
    """
    height = len(lab)
    band = max(round(BAND * height), 3)
    step = np.zeros_like(lab)  # from the two rows above the border of rows v-1 and v to the two below
    step[2:-1] = 0.5 * (lab[2:-1] + lab[3:] - lab[1:-2] - lab[:-3])
    blocks = np.stack([part.mean(axis=1) for part in np.array_split(step, BLOCKS, axis=1)], axis=1)
    usual = np.median(blocks, axis=1)
    size = np.linalg.norm(usual, axis=-1)
    near = np.pad(usual, ((APART, APART), (0, 0)), mode="edge")
    goes_on = ((near[: -2 * APART] + near[2 * APART :]) * usual).sum(axis=-1) / np.maximum(size, 1e-6)
    sharp = size - 0.5 * goes_on
    along = (blocks * usual[:, None]).sum(axis=-1)
    straight = (along > 0.5 * np.square(size)[:, None]).mean(axis=1)
    rows = np.flatnonzero((straight >= STRAIGHT) & (size >= STEP) & (usual[:, 0] < 0))  # sky is brighter
    above = np.cumsum(wet.sum(axis=1)) - wet.sum(axis=1)
    detail = np.abs(np.diff(lab[..., 0], axis=1))
    best = (0.0, 0.0, 0)
    for v in rows[(rows >= band + 2) & (rows < height - band)]:
        if above[v - 1] > ABOVE * above[-1]:
            break
        rough = float(np.percentile(detail[v - band : v - 2], 95.0))
        plain = float(np.clip((PLAIN[1] - rough) / (PLAIN[1] - PLAIN[0]), 0.0, 1.0))
        best = max(best, (plain, float(sharp[v]), int(v)))
    return best


def _turned(picture: np.ndarray, lean: float) -> np.ndarray:
    """What lay on a line that leans by so many degrees lies on a row."""
    slope, width = np.tan(np.radians(lean)), picture.shape[1]
    shear = np.array([[1.0, 0.0, 0.0], [slope, 1.0, -0.5 * slope * width]], np.float32)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(picture, shear, picture.shape[1::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE)
