"""Round things that lie level (rims of vessels, pools) look flat from the side: an ellipse shows the angle of the view.

The conic of an outline is carried onto a level plane under each camera that is asked about. How far it is from a circle
there, as the logarithm of its length over its width, is compared with how far such things are out of round. That
logarithm is the distance between shapes of ellipses under all affine maps, so no camera is preferred beforehand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from fluidlift.shape.region import largest_piece
from fluidlift.types import PinholeCamera

POOL_SPREAD = 0.25
"""standard deviation of the logarithm of a pool's length over its width (a choice: bowls have 0, puddles up to 2)"""
POOL_LIKENESS = 0.85
"""IoU of a pool's outline with the ellipse of its moments, at least: a rectangle has 0.83, a glass from the side less.
What waves and a jet in front take away from a true ellipse is under a tenth"""
NARROW = 0.35
"""width of jets over that of the pool that they end in, at most, to be told from it"""
JET_LIKENESS = 0.9
"""`POOL_LIKENESS` where jets were taken away so: a square whose corners that rounds has 0.86"""
CUT = 0.12
"""share of the picture's border that a pool may meet and count as whole: more moves the ellipse of its moments"""
LEVEL = 20.0
"""degrees from the picture's horizontal to the longer axis of what lies level and is round: three times how far people
hold a camera off it, and a lens's distortion"""
NEARLY_ROUND = 0.85
"""width over length from which an ellipse has no longer axis"""
TALLEST = 1.05
"""height over width of a pool, at most: a level circle is as tall as it is wide from straight above, and nowhere
taller; outlines err by a twentieth (a choice). What a glass holds is, from the side (1.12 to 1.36 as it fills)"""
NOT_ROUND = 0.25
"""prior probability that what looks like an ellipse is none of a level circle: a lid on edge, a bent wire, a lake"""
SHAPES = 11.0
"""area of the shapes that an ellipse can have (pi log(6.5)^2: the flattest that are told from lines): what is none of a
circle has any of them"""
IN_VESSEL = 0.9
"""share of a fluid that a rim encloses, at least, where the fluid is in that vessel: foam and hands are beside it"""


@dataclass(frozen=True)
class Ellipse:
    """The ellipse with the moments of a region."""

    center: tuple[float, float]
    """(u, v), px"""
    covariance: Float[np.ndarray, "2 2"]
    """px^2"""
    likeness: float
    """share of it that is seen: IoU with the region, or share of its outline that is an edge"""
    spread: float = POOL_SPREAD
    """standard deviation of the logarithm of its length over its width, were it seen from straight above"""

    @property
    def flatness(self) -> float:
        """Its height over its width, along the picture's axes."""
        return float(np.sqrt(self.covariance[1, 1] / self.covariance[0, 0]))

    @property
    def axes(self) -> tuple[float, float]:
        """Half its length and half its width, px."""
        small, large = 2.0 * np.sqrt(np.linalg.eigvalsh(self.covariance))
        return float(large), float(small)

    @property
    def lies(self) -> bool:
        """Whether it can be a circle that lies level: its longer axis is nearly level in the picture."""
        axis = np.linalg.eigh(self.covariance)[1][:, 1]
        return bool(self.axes[1] > NEARLY_ROUND * self.axes[0] or abs(axis[1]) < np.sin(np.radians(LEVEL)))

    @property
    def conic(self) -> Float[np.ndarray, "3 3"]:
        """C with (u, v, 1) C (u, v, 1)' = 0 on the outline, negative inside."""
        shape = np.linalg.inv(4.0 * self.covariance)
        c = np.asarray(self.center)
        linear = -shape @ c
        return np.block([[shape, linear[:, None]], [linear[None], np.array([[c @ shape @ c - 1.0]])]])

    def encloses(self, points: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
        """Which points (u, v) lie within it."""
        offset = points - self.center
        return np.einsum("ni,ij,nj->n", offset, np.linalg.inv(self.covariance), offset) <= 4.0

    def pixels(self, shape: tuple[int, ...]) -> Bool[np.ndarray, "h w"]:
        """Those of a picture that it encloses."""
        grid = np.stack(np.meshgrid(np.arange(shape[1]), np.arange(shape[0])), -1) + 0.5
        return self.encloses(grid.reshape(-1, 2)).reshape(shape[0], shape[1])

    def share_inside(self, region: Bool[np.ndarray, "h w"]) -> float:
        """Share of a region's pixels that it encloses."""
        rows, cols = np.nonzero(region)
        return float(self.encloses(np.stack([cols, rows], -1) + 0.5).mean()) if len(rows) else 0.0


def fit_ellipse(region: Bool[np.ndarray, "h w"]) -> Ellipse | None:
    """The ellipse whose area and axes fit a region; None for less than 40 pixels."""
    rows, cols = np.nonzero(region)
    if len(rows) < 40:
        return None
    points = np.stack([cols + 0.5, rows + 0.5], -1)
    center, covariance = points.mean(0), np.cov(points.T)
    if np.linalg.eigvalsh(covariance)[0] < 0.1:
        return None
    offset = np.stack(np.meshgrid(np.arange(region.shape[1]), np.arange(region.shape[0])), -1) + 0.5 - center
    inside = np.einsum("...i,ij,...j->...", offset, np.linalg.inv(covariance), offset) <= 4.0
    likeness = float((inside & region).sum() / (inside | region).sum())
    return Ellipse((float(center[0]), float(center[1])), covariance, likeness)


def round_pool(lying: Bool[np.ndarray, "h w"], likeness: float = POOL_LIKENESS) -> Ellipse | None:
    """The ellipse of a pool whose outline is one, and closed inside the picture; None where there is no such pool.

    Args:
        lying: its pixels.
        likeness: IoU with its ellipse, at least.
    """
    edges = np.concatenate([lying[0], lying[-1], lying[:, 0], lying[:, -1]])
    pool = fit_ellipse(lying)
    if pool is None or pool.likeness < likeness or edges.mean() > CUT or not pool.lies or pool.flatness > TALLEST:
        return None
    return pool


def wide_part(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The largest piece of a fluid without what is much narrower than its widest place: a pool without its jets."""
    inside = np.pad(mask, 1)
    away = cv2.distanceTransform(inside.astype(np.uint8), cv2.DIST_L2, 5)
    radius = NARROW * float(away.max())
    core = away > radius
    if not core.any():
        return np.zeros_like(mask)
    near = cv2.distanceTransform((~core).astype(np.uint8), cv2.DIST_L2, 5) <= radius
    return largest_piece((near & inside)[1:-1, 1:-1])


def out_of_round(camera: PinholeCamera, ellipse: Ellipse) -> float:
    """Logarithm of length over width of what lies level and is seen as an ellipse; infinite where nothing level is.

    Args:
        camera: level frame, z up, with the tilt that is asked about.
        ellipse: of the picture.
    """
    conic = conic_below(camera, ellipse)
    if conic is None:
        return np.inf
    small, large = np.linalg.eigvalsh(conic[:2, :2])
    return float(0.5 * np.log(large / small))


def conic_below(camera: PinholeCamera, ellipse: Ellipse) -> Float[np.ndarray, "3 3"] | None:
    """C with (x, y, 1) C (x, y, 1)' = 0 where an ellipse of the picture meets the level plane one below the camera, x
    and y from it, negative inside; None where it does not lie below the horizon as a whole.

    Args:
        camera: z up, with its tilt.
        ellipse: of the picture.
    """
    rotation = camera.camera_from_world.rotation
    (fx, fy), (cx, cy) = camera.focal, camera.center
    lens = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    # (x, y, 1) of the plane z = -1 to the picture
    plane = lens @ rotation @ np.diag([1.0, 1.0, -1.0])
    ray = np.array([(ellipse.center[0] - cx) / fx, (ellipse.center[1] - cy) / fy, 1.0]) @ rotation
    found = plane.T @ ellipse.conic @ plane
    return None if ray[2] >= 0.0 or np.linalg.eigvalsh(found[:2, :2])[0] <= 0.0 else found


def roundness_evidence(camera: PinholeCamera, ellipses: Sequence[Ellipse]) -> float:
    """Log likelihood of a camera's tilt given outlines that may be circles that lie level.

    Args:
        camera: level frame, z up, with the tilt that is asked about.
        ellipses: of the picture.
    """
    log = 0.0
    for ellipse in ellipses:
        variance = ellipse.spread**2
        level = np.exp(-0.5 * out_of_round(camera, ellipse) ** 2 / variance) / (2.0 * np.pi * variance)
        log += np.log((1.0 - NOT_ROUND) * level + NOT_ROUND / SHAPES)
    # rim, level and saucer of one cup are not as many observations
    return float(log) / np.sqrt(max(len(ellipses), 1))
