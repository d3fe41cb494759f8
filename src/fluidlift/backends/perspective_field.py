"""Tilt and focal length of a camera from its perspective field (Jin et al. 2023; fitted as Veicht et al. 2024 do).

A perspective field says at each pixel in which direction of the picture "up" lies, and how far its ray rises above the
horizon (latitude). With up = (a, b, c) in camera axes (x right, y down, z forward), and a ray (u, v, 1) / n, n its
length, up lies along (a - c u, b - c v), and the sine of the latitude is (a u + b v + c) / n: three numbers, pitch,
roll and focal length, give the whole field. They are found by Levenberg and Marquardt's method.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fluidlift.errors import require

SCALE = 0.01
"""difference of a unit vector's end, or of a sine, from which on a pixel counts less (Huber), the authors'"""
STEPS, DAMPING, ENOUGH = 40, 0.1, 1e-9
"""of the search at most, its first damping (the authors'), and the relative decrease of the cost at which it ends"""
START_FOCAL = 0.7
"""focal length over the longer side, which the search starts from, on the level: the authors'. Of 81 made fields with
noise (pitches of -40 to 88 degrees, rolls of -20 to 8, views of 25 to 110) all were found from there"""
NARROWEST, WIDEST = 5.0, 150.0
"""degrees of the vertical field of view that are looked for: the authors'"""
EVERY = 4
"""px between the pixels that are looked at: the field was made at a quarter of the picture's size"""


@dataclass(frozen=True)
class PerspectiveField:
    """What is seen of up, at each pixel."""

    up: Float[np.ndarray, "h w 2"]
    """unit vectors in the picture (x right, y down)"""
    up_trust: Float[np.ndarray, "h w"]
    """0 to 1"""
    latitude: Float[np.ndarray, "h w"]
    """sine of the angle of the ray above the horizon"""
    latitude_trust: Float[np.ndarray, "h w"]

    def every(self, step: int) -> tuple[np.ndarray, ...]:
        """x, y [n] px of pixel centres from the middle, up [n,2], latitude [n], and both trusts [n]."""
        h, w = self.latitude.shape
        rows, columns = np.mgrid[step // 2 : h : step, step // 2 : w : step]
        at = rows.ravel(), columns.ravel()
        x, y = at[1] + 0.5 - 0.5 * w, at[0] + 0.5 - 0.5 * h
        taken = (self.up[at], self.latitude[at], self.up_trust[at], self.latitude_trust[at])
        return (x, y, *(np.asarray(t, np.float64) for t in taken))


@dataclass(frozen=True)
class FittedView:
    """The camera that a field fits best."""

    pitch: float
    """degrees below the horizon"""
    roll: float
    """degrees that the picture is turned clockwise"""
    focal: float
    """px"""
    covariance: Float[np.ndarray, "3 3"]
    """of pitch, roll (degrees) and the logarithm of the focal length, as the authors define it: the inverse of the
    weighted normal matrix, with all pixels; zero for a focal length that was given"""


def field_of_camera(pitch: float, roll: float, focal: float, size: tuple[int, int]) -> PerspectiveField:
    """The field of a camera, trusted everywhere.

    Args:
        pitch: degrees below the horizon.
        roll: degrees that the picture is turned clockwise.
        focal: px.
        size: of the picture: width, height; its middle is the principal point.
    """
    w, h = size
    rows, columns = np.mgrid[:h, :w]
    x, y = columns.ravel() + 0.5 - 0.5 * w, rows.ravel() + 0.5 - 0.5 * h
    up, latitude = _field(np.array([np.radians(pitch), np.radians(roll), np.log(focal)]), x, y)
    sure = np.ones((h, w))
    return PerspectiveField(up.reshape(h, w, 2), sure, latitude.reshape(h, w), sure)


def fitted_view(field: PerspectiveField, focal: float | None = None) -> FittedView | None:
    """The camera of a field; None where the field says nothing.

    Args:
        field: of a picture whose middle is the principal point.
        focal: px, where it is known: then the tilt alone is looked for.
    """
    h, w = field.latitude.shape
    require(h > 1 and w > 1, f"a field of {w} x {h} px", "a picture")
    free = 3 if focal is None else 2
    ends = tuple(0.5 * h / np.tan(np.radians(0.5 * a)) for a in (WIDEST, NARROWEST))
    step = max(1, min(EVERY, min(h, w) // 16))
    pixels = field.every(step)
    if not all(np.isfinite(part).all() for part in pixels) or pixels[4].sum() + pixels[5].sum() <= 0.0:
        return None
    first = float(np.clip(START_FOCAL * max(h, w) if focal is None else focal, *ends))
    best = _search(np.array([0.0, 0.0, np.log(first)]), pixels, free, ends)
    normal = _normal(best, pixels, free)[0] * step**2
    try:
        inverse = np.linalg.inv(normal)
    except np.linalg.LinAlgError:
        return None
    if not np.isfinite(inverse).all() or (np.diagonal(inverse) <= 0.0).any():
        return None
    covariance = np.zeros((3, 3))
    covariance[:free, :free] = inverse
    units = np.array([np.degrees(1.0), np.degrees(1.0), 1.0])
    pitch, roll = _folded(best[0], best[1])
    return FittedView(
        float(np.degrees(pitch)), float(np.degrees(roll)), float(np.exp(best[2])), covariance * np.outer(units, units)
    )


def _folded(pitch: float, roll: float) -> tuple[float, float]:
    """The same tilt with a pitch within a quarter turn, radians."""
    a, b, c = np.sin(roll) * np.cos(pitch), -np.cos(roll) * np.cos(pitch), -np.sin(pitch)
    return float(np.arctan2(-c, np.hypot(a, b))), float(np.arctan2(a, -b))


def _field(view: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Up [n,2] and sine of the latitude [n]; `view` is pitch, roll (radians) and the logarithm of the focal length."""
    pitch, roll, focal = view[0], view[1], np.exp(view[2])
    a, b, c = np.sin(roll) * np.cos(pitch), -np.cos(roll) * np.cos(pitch), -np.sin(pitch)
    u, v = x / focal, y / focal
    up = np.stack([a - c * u, b - c * v], axis=-1)
    up /= np.maximum(np.linalg.norm(up, axis=-1, keepdims=True), 1e-9)
    return up, (a * u + b * v + c) / np.sqrt(1.0 + u**2 + v**2)


def _residuals(view: np.ndarray, pixels: tuple[np.ndarray, ...]) -> tuple[np.ndarray, np.ndarray]:
    x, y, up, latitude = pixels[:4]
    seen_up, seen_latitude = _field(view, x, y)
    return seen_up - up, seen_latitude - latitude


def _cost(view: np.ndarray, pixels: tuple[np.ndarray, ...]) -> float:
    off_up, off_latitude = _residuals(view, pixels)
    return float(pixels[4] @ _huber(np.linalg.norm(off_up, axis=-1)) + pixels[5] @ _huber(np.abs(off_latitude)))


def _huber(length: np.ndarray) -> np.ndarray:
    return np.where(length <= SCALE, length**2, SCALE * (2.0 * length - SCALE))


def _normal(view: np.ndarray, pixels: tuple[np.ndarray, ...], free: int) -> tuple[np.ndarray, np.ndarray]:
    """Weighted normal matrix and gradient of the first `free` numbers, by central differences."""
    off_up, off_latitude = _residuals(view, pixels)
    weights = [
        trust * SCALE / np.maximum(length, SCALE)
        for trust, length in ((pixels[4], np.linalg.norm(off_up, axis=-1)), (pixels[5], np.abs(off_latitude)))
    ]
    h, columns = 1e-5, []
    for k in range(free):
        step = np.zeros(3)
        step[k] = h
        ahead, behind = _residuals(view + step, pixels), _residuals(view - step, pixels)
        columns.append([(a - b) / (2.0 * h) for a, b in zip(ahead, behind, strict=True)])
    normal, gradient = np.zeros((free, free)), np.zeros(free)
    for i in range(free):
        gradient[i] = weights[0] @ (columns[i][0] * off_up).sum(-1) + weights[1] @ (columns[i][1] * off_latitude)
        for j in range(i, free):
            both = (columns[i][0] * columns[j][0]).sum(-1), columns[i][1] * columns[j][1]
            normal[i, j] = normal[j, i] = weights[0] @ both[0] + weights[1] @ both[1]
    return normal, gradient


def _search(view: np.ndarray, pixels: tuple[np.ndarray, ...], free: int, ends: tuple[float, float]) -> np.ndarray:
    """Where the cost is least near `view`."""
    damping, cost = DAMPING, _cost(view, pixels)
    for _ in range(STEPS):
        normal, gradient = _normal(view, pixels, free)
        damped = normal + np.diag(np.maximum(damping * np.diagonal(normal), 1e-9))
        ahead = view.copy()
        ahead[:free] -= np.linalg.solve(damped, gradient)
        ahead[2] = np.clip(ahead[2], *np.log(ends))
        after = _cost(ahead, pixels)
        if after < cost:
            done = cost - after <= ENOUGH * cost
            view, cost, damping = ahead, after, max(0.1 * damping, 1e-6)
            if done:
                break
        else:
            damping *= 10.0
            if damping > 1e6:
                break
    return view
