"""What hangs or stands plumb (posts, walls, trunks, vessels) shows where down is.

The images of plumb lines meet in the vanishing point of the vertical. Each line segment that is nearly upright in the
picture either is one, seen with the lean that trunks and walls have, or says nothing (a mixture with a uniform part).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from fluidlift.types import PinholeCamera

SHORTEST = 0.05
"""of the picture's longer side, length of a segment that is looked at"""
FULL = 0.2
"""of the same: longer ones count no more than one of this length"""
UPRIGHT = 35.0
"""degrees in the picture from its vertical; others are no plumb lines or seen from straight above"""
LEAN = 3.0
"""degrees, standard deviation of how far plumb things lean (trunks more, walls less), with the segment's error"""
PLUMB = 0.3
"""prior share of such segments that are plumb"""
BELIEF = 0.5
"""power that the evidence is taken to: segments of one thing are not independent. As they stand, the error of the pitch
on the clips with many is twice what the posterior says"""
MOST = 15.0
"""segments that count at most: a mesh or a facade repeats one observation (of a sieve 85 are upright, none is plumb)"""


@dataclass(frozen=True)
class PlumbLines:
    """Nearly upright line segments of what stands still."""

    middle: Float[np.ndarray, "n 2"]
    """px"""
    angle: Float[np.ndarray, " n"]
    """degrees from the picture's vertical, positive where the lower end lies to the right"""
    weight: Float[np.ndarray, " n"]


def plumb_lines(picture: UInt8[np.ndarray, "h w 3"], still: Bool[np.ndarray, "h w"]) -> PlumbLines | None:
    """Upright segments (LSD: von Gioi et al. 2010) of what stands still; None for fewer than three.

    Args:
        picture: sRGB, typical for the clip.
        still: pixels that show no fluid.
    """
    found = cv2.createLineSegmentDetector().detect(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY))[0]
    if found is None:
        return None
    ends = found.reshape(-1, 4).astype(float)
    way = ends[:, 2:] - ends[:, :2]
    length, middle = np.linalg.norm(way, axis=1), 0.5 * (ends[:, 2:] + ends[:, :2])
    angle = (np.degrees(np.arctan2(way[:, 0], way[:, 1])) + 90.0) % 180.0 - 90.0
    longest = max(picture.shape[:2])
    column, row = (np.clip(middle[:, a].astype(int), 0, n - 1) for a, n in ((0, still.shape[1]), (1, still.shape[0])))
    kept = (length > SHORTEST * longest) & (np.abs(angle) < UPRIGHT) & still[row, column]
    if kept.sum() < 3:
        return None
    weight = np.minimum(length[kept] / (FULL * longest), 1.0)
    return PlumbLines(middle[kept], angle[kept], weight * min(1.0, MOST / kept.sum()))


def plumb_evidence(camera: PinholeCamera, lines: PlumbLines) -> float:
    """Log likelihood of a camera's tilt given upright segments.

    Args:
        camera: level frame, z up, with the tilt that is asked about.
        lines: of the picture.
    """
    down = -camera.camera_from_world.rotation[:, 2]
    x = (lines.middle - np.asarray(camera.center)) / np.asarray(camera.focal)
    way = down[:2] - x * down[2]
    seen = np.degrees(np.arctan2(way[:, 0], way[:, 1]))
    off = (lines.angle - seen + 90.0) % 180.0 - 90.0
    plumb = np.log(PLUMB) - 0.5 * (off / LEAN) ** 2 - np.log(LEAN * np.sqrt(2.0 * np.pi))
    other = np.log((1.0 - PLUMB) / (2.0 * UPRIGHT))
    return BELIEF * float((lines.weight * np.logaddexp(plumb, other)).sum())
