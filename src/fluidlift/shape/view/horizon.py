"""Where the horizon can be: above all water that lies level, below all sky.

The horizon is where a level plane through the camera meets the picture. Sky is always above it, by what hills and trees
hide; water that lies is always below it, by the angle under which its far shore is seen. Neither needs the horizon
itself to be in the picture.

The sky is found without learned weights by the border that tells two regions best apart (Shen and Wang 2013, "Sky
region detection in a single image for autonomous ground robot navigation": the border is the first strong gradient
below the upper edge, its threshold maximises the inverse of the summed scatter of the colours above and below).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from fluidlift.shape.view.open_horizon import OpenHorizon
from fluidlift.types import PinholeCamera

LONGEST = 256
"""px of the longer side of the picture that the sky is looked for in"""
THRESHOLDS = np.geomspace(0.8, 12.0, 25)
"""gradients of the Lab picture (0 to 255) per px that a border of the sky may have"""
SKY_WEIGHT = 2.0
"""how much more the sky's scatter counts than that of the ground (Shen and Wang 2013)"""
BRIGHTER = 55.0
"""Lab lightness (0 to 255) that sky has more than the ground under it, at least. Of 34 real clips the 7 that show it
have 67 to 166 in the median, and what else is taken for sky (walls, dark rooms, blurred background) -101 to 41"""
UNEVEN = 26.0
"""Lab lightness, standard deviation within a sky, at most: 7 to 22 on the same clips, more with a facade before it"""
LEAST_WIDTH = 0.3
"""share of the picture's width over which there is sky, at least: less is a gap between leaves or a lamp"""
SKYLINE = 6.0
"""degrees, mean height of the lowest part of a skyline above the horizon (exponential): woods at a bend, hills"""
AMISS = 1.5
"""degrees, how far an outline may be on the wrong side of the horizon: errors of the outline and of the lens"""
ON_LINE = 0.7
"""degrees, errors of pitch and roll by the line on which open water ends: a row of 256 px is 0.2, half a step of the
leans it is looked for at 0.25, distortion of a phone's lens a few px of the picture; from the deck of a ship and from a
cliff of 50 m the sea's horizon lies 0.1 to 0.2 below the level (dip, 0.03 degrees times the root of the metres)"""
MISTAKEN = 0.06
"""probability that what was taken for sky or for level water is none (1 of 9 skies of 34 clips: tiles of a kitchen)"""


@dataclass(frozen=True)
class Skyline:
    """The lower border of the sky in a picture."""

    border: Float[np.ndarray, "n 2"]
    """px (u, v) of the picture, one point per column that shows sky"""
    share: float
    """of the picture that is sky"""


def skyline(picture: UInt8[np.ndarray, "h w 3"], fluid: Bool[np.ndarray, "h w"]) -> Skyline | None:
    """The sky of a picture; None where none is seen.

    Args:
        picture: sRGB, typical for the clip.
        fluid: pixels that are known to be fluid, so no sky.
    """
    scale = min(LONGEST / max(fluid.shape), 1.0)
    size = (max(round(fluid.shape[1] * scale), 8), max(round(fluid.shape[0] * scale), 8))
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    lab = cv2.GaussianBlur(cv2.cvtColor(small, cv2.COLOR_RGB2LAB).astype(np.float32), (0, 0), 1.0)
    wet = cv2.resize(fluid.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    border = _best_border(lab)
    if border is None:
        return None
    rows = np.arange(size[1])[:, None]
    # narrow spikes run down between trunks and along walls
    sky = ndimage.binary_opening(rows < border, structure=np.ones((1, max(3, size[0] // 32)), bool)) & ~wet
    columns = sky[0] & (sky.sum(axis=0) >= 2)
    if columns.mean() < LEAST_WIDTH:
        return None
    ground = (rows >= border) & ~wet
    light = lab[..., 0]
    if not ground.any() or np.median(light[sky]) - np.median(light[ground]) < BRIGHTER or light[sky].std() > UNEVEN:
        return None
    lowest = np.argmin(sky, axis=0)  # first row that is no sky
    u = (np.flatnonzero(columns) + 0.5) / scale
    return Skyline(np.stack([u, lowest[columns] / scale], -1), float(sky.mean()))


def sky_of(pixels: Bool[np.ndarray, "h w"]) -> Skyline | None:
    """The sky that a person marked: the lowest marked row of each column; None where nothing is."""
    columns = np.flatnonzero(pixels.any(axis=0))
    if not len(columns):
        return None
    lowest = len(pixels) - pixels[::-1].argmax(axis=0)[columns]
    return Skyline(np.stack([columns + 0.5, lowest.astype(float)], -1), float(pixels.mean()))


def tilt_of_horizon(
    camera: PinholeCamera, ends: tuple[tuple[float, float], tuple[float, float]]
) -> tuple[float, float]:
    """Pitch (degrees below the horizon) and roll (degrees clockwise) of a camera that sees the horizon on a line.

    Args:
        camera: for its lens; its pose is not used.
        ends: px, two points of the line, the left one first.
    """
    at = (np.asarray(ends, float) - np.asarray(camera.center)) / np.asarray(camera.focal)
    rays = np.concatenate([at, np.ones((2, 1))], axis=1)
    up = np.cross(rays[1], rays[0])  # y is down: from right to left the normal points up
    up = up / np.linalg.norm(up)
    return float(np.degrees(np.arcsin(np.clip(-up[2], -1.0, 1.0)))), float(np.degrees(np.arctan2(up[0], -up[1])))


def horizon_evidence(
    camera: PinholeCamera, horizon: OpenHorizon, pitches: Float[np.ndarray, " p"], rolls: Float[np.ndarray, " r"]
) -> Float[np.ndarray, "p r"]:
    """Log likelihood of pitches and rolls (degrees) given the line on which open water ends.

    Args:
        camera: for its lens; its pose is not used.
        horizon: of the picture.
        pitches: degrees below the horizon.
        rolls: degrees clockwise.
    """
    pitch, roll = tilt_of_horizon(camera, horizon.ends)
    off = np.square(pitches - pitch)[:, None] + np.square(rolls - roll)
    log = -0.5 * off / ON_LINE**2 - np.log(2.0 * np.pi * ON_LINE**2)
    right = horizon.share * (1.0 - MISTAKEN)
    return np.logaddexp(np.log(right) + log, np.log1p(-right) - 2.0 * np.log(90.0))


def horizon_line(camera: PinholeCamera) -> tuple[tuple[float, float], tuple[float, float]]:
    """px, where a camera (z up) sees the horizon at the left and at the right edge of its picture, or beyond."""
    up = camera.camera_from_world.rotation[:, 2]
    x = (np.array([0.0, camera.size[0]]) - camera.center[0]) / camera.focal[0]
    # up . (x, y, 1) = 0; a camera that looks straight down sees it infinitely far above
    steep = up[1] if abs(up[1]) > 1e-3 else np.copysign(1e-3, up[1])
    v = camera.center[1] - camera.focal[1] * (up[0] * x + up[2]) / steep
    return (0.0, float(v[0])), (float(camera.size[0]), float(v[1]))


def _best_border(lab: np.ndarray) -> np.ndarray | None:
    """Per column the first row with a strong gradient, for the threshold that tells both sides best apart."""
    gradient = np.zeros(lab.shape[:2], np.float32)
    for c in range(3):
        plane = np.ascontiguousarray(lab[..., c])
        steep = np.hypot(
            cv2.Sobel(plane, cv2.CV_32F, 1, 0, scale=0.125), cv2.Sobel(plane, cv2.CV_32F, 0, 1, scale=0.125)
        )
        np.maximum(gradient, steep, out=gradient)
    height = len(lab)
    best, found = 0.0, None
    for threshold in THRESHOLDS:
        over = gradient > threshold
        border = np.where(over.any(axis=0), over.argmax(axis=0), height)
        sky = np.arange(height)[:, None] < border
        if not 0.01 < sky.mean() < 0.97:
            continue
        above, below = (np.cov(lab[part].T) + np.eye(3) for part in (sky, ~sky))
        scatter = SKY_WEIGHT * (np.linalg.det(above) + np.linalg.eigvalsh(above)[-1])
        scatter += np.linalg.det(below) + np.linalg.eigvalsh(below)[-1]
        if 1.0 / scatter > best:
            best, found = 1.0 / scatter, border
    return found


def elevation(camera: PinholeCamera, at: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
    """Degrees above the horizon at which points of the picture (px) are seen."""
    rays = camera.rays(at)
    return np.degrees(np.arctan2(rays[..., 2], np.hypot(rays[..., 0], rays[..., 1])))


def skyline_evidence(camera: PinholeCamera, sky: Skyline) -> float:
    """Log likelihood of a camera's tilt given the skyline: the horizon is at its lowest part, or below.

    Args:
        camera: level frame, z up, with the tilt that is asked about.
        sky: of the picture.
    """
    height = float(np.percentile(elevation(camera, sky.border), 10.0))
    log = -max(height, 0.0) / SKYLINE - 0.5 * (min(height, 0.0) / AMISS) ** 2 - np.log(SKYLINE)
    return float(np.logaddexp(np.log1p(-MISTAKEN) + log, np.log(MISTAKEN / 90.0)))


def farthest_elevation(camera: PinholeCamera, top: Float[np.ndarray, "n 2"]) -> float:
    """Degrees above the horizon (below: negative) at which the farthest water is seen, errors of its outline left out.

    Args:
        camera: level frame, z up, with the tilt that is asked about.
        top: px, upper outline of the water, point by point.
    """
    return float(np.percentile(elevation(camera, top), 95.0))


def upper_outline(mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "n 2"]:
    """px, the topmost pixel of each column of a mask."""
    columns = np.flatnonzero(mask.any(axis=0))
    return np.stack([columns + 0.5, mask.argmax(axis=0)[columns].astype(float)], -1)
