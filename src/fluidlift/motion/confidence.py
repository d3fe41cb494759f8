"""How far optical flow can be trusted, pixel by pixel, without knowing the scene.

Flow fails where the picture is smooth: it then returns something near zero, or what its smoothness term makes up. It
fails where something hides what moved, and it is sure of itself where it follows a thing that stands still (the bed
seen through water, a reflection, the rim of a jet). Every test here is soft, of the form
tolerance^2 / (tolerance^2 + error^2), so that their product falls gradually and has no knee that a clip could sit on.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from fluidlift.numerics.short_axis import summed
from fluidlift.seams import FlowEstimator

ROUND_TRIP_FLOOR = 0.3
"""px: forward-backward error that even good flow shows (noise, compression)"""
ROUND_TRIP_SHARE = 0.2
"""part of the motion by which forward and backward flow may disagree: a fluid deforms within a frame"""
TEXTURE_FLOOR = 1.5
"""grey levels per px: gradients of this size are compression and camera noise"""
TEXTURE_WINDOW = 15
"""px, side of the window in which texture is gathered; about the patch that the estimators look at"""
SHARED_FAILURE = 2.0 / 3.0
"""exponent of a product of three tests. One failure is seen by more than one of them; a product would count it as if
they were independent (exponent 1), their geometric mean as if they were the same (1/3)"""


def grey(image: np.ndarray) -> np.ndarray:
    """Luma u8 [H,W] of an sRGB picture; a picture that is grey already is returned as it is."""
    return image if image.ndim == 2 else cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)


def there_and_back(
    estimator: FlowEstimator, first: np.ndarray, second: np.ndarray
) -> tuple[Float[np.ndarray, "h w 2"], Float[np.ndarray, "h w 2"], Float[np.ndarray, "h w"]]:
    """Flow from `first` to `second`, back again (px), and what the estimator says of the former (0 to 1), float32.

    What is not finite becomes rest, and forward it is not trusted. An estimator without an opinion says 1.
    """
    forward, own = estimator.estimate(first, second)
    trust = np.asarray(np.isfinite(forward).all(axis=-1), np.float32)
    return finite(forward), finite(estimator.displacement(second, first)), trust if own is None else trust * own


def finite(displacement: Float[np.ndarray, "h w 2"]) -> Float[np.ndarray, "h w 2"]:
    """What is not a number, or infinite, put to 0."""
    return np.nan_to_num(displacement, nan=0.0, posinf=0.0, neginf=0.0)


def flow_confidence(
    first: UInt8[np.ndarray, "h w 3"] | UInt8[np.ndarray, "h w"],
    forward: Float[np.ndarray, "h w 2"],
    backward: Float[np.ndarray, "h w 2"],
) -> Float[np.ndarray, "h w"]:
    """Trust in `forward`, float32 from 0 (failed) to 1: the product of its round trip and of the texture at hand.

    Flow that leaves the picture has confidence 0.
    """
    texture = texture_strength(first) ** 2
    return (round_trip(forward, backward) * texture / (texture + TEXTURE_FLOOR**2)).astype(np.float32)


def round_trip(forward: Float[np.ndarray, "h w 2"], backward: Float[np.ndarray, "h w 2"]) -> Float[np.ndarray, "h w"]:
    """1 where following the flow forward and then backward leads home (Sundaram, Brox, Keutzer 2010), 0 where not.

    The tolerance grows with the motion. What leaves the picture cannot be checked and counts as 0; what is hidden in
    the second picture does not lead home.
    """
    h, w = forward.shape[:2]
    u, v = np.meshgrid(np.arange(w, dtype=np.float32), np.arange(h, dtype=np.float32))
    u, v = u + forward[..., 0], v + forward[..., 1]
    back = cv2.remap(np.ascontiguousarray(backward), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    error = summed((forward + back) ** 2)
    tolerance = ROUND_TRIP_FLOOR**2 + ROUND_TRIP_SHARE**2 * summed(forward**2)
    inside = (u >= -0.5) & (u <= w - 0.5) & (v >= -0.5) & (v <= h - 0.5)
    return (inside * tolerance / (tolerance + error)).astype(np.float32)


def texture_strength(image: np.ndarray) -> Float[np.ndarray, "h w"]:
    """Root mean square gradient in the direction with least texture, units of the picture per px, float32.

    It is the root of the smaller eigenvalue of the structure tensor over a window (Shi, Tomasi 1994); an edge without
    texture along it counts as nothing (aperture problem).

    Args:
        image: u8 sRGB [H,W,3], or one channel [H,W] of any real type.
    """
    smooth = cv2.GaussianBlur(grey(image), (0, 0), 1.0).astype(np.float32)
    gx = cv2.Scharr(smooth, cv2.CV_32F, 1, 0, scale=1 / 32)
    gy = cv2.Scharr(smooth, cv2.CV_32F, 0, 1, scale=1 / 32)
    xx, yy, xy = (cv2.boxFilter(p, cv2.CV_32F, (TEXTURE_WINDOW, TEXTURE_WINDOW)) for p in (gx * gx, gy * gy, gx * gy))
    smaller = 0.5 * (xx + yy - np.sqrt((xx - yy) ** 2 + 4 * xy**2))
    return np.sqrt(np.maximum(smaller, 0.0))


def photometric_agreement(
    first: Float[np.ndarray, "h w"], second: Float[np.ndarray, "h w"], flow: Float[np.ndarray, "h w 2"]
) -> Float[np.ndarray, "h w"]:
    """Share of the local contrast of `first` that `flow` finds again in `second`, 0 to 1, float32.

    1 - var(I2(x + d) - I1(x)) / (var I1 + var I2) over a window: 1 where the two agree, 0 where they are as different
    as two unrelated pictures. Variances, so that a change of light that is even over the window does not count.
    """
    h, w = first.shape
    u, v = np.meshgrid(np.arange(w, dtype=np.float32), np.arange(h, dtype=np.float32))
    moved = cv2.remap(second, u + flow[..., 0], v + flow[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    side = (TEXTURE_WINDOW, TEXTURE_WINDOW)

    def variance(p: np.ndarray) -> np.ndarray:
        return cv2.boxFilter(p * p, cv2.CV_32F, side) - cv2.boxFilter(p, cv2.CV_32F, side) ** 2

    contrast = variance(moved) + variance(first)
    return np.clip(1.0 - variance(moved - first) / np.maximum(contrast, 1e-12), 0.0, 1.0)


def agreement_over_time(
    before: Float[np.ndarray, "h w 2"] | None,
    flow: Float[np.ndarray, "h w 2"],
    after: Float[np.ndarray, "h w 2"] | None,
) -> Float[np.ndarray, "h w"]:
    """1 where the flow of the pairs before and after is like that of the pair between them, 0 where not; float32.

    Like at the same place (a standing wave, a jet) or along the path (an eddy that drifts), whichever is closer: real
    fluctuation is one or the other, failures are neither. The tolerance is that of the round trip.
    """
    h, w = flow.shape[:2]
    u, v = np.meshgrid(np.arange(w, dtype=np.float32), np.arange(h, dtype=np.float32))
    distances = []
    for side, other in ((-1, before), (1, after)):
        if other is None:
            continue
        along = cv2.remap(
            other, u + side * flow[..., 0], v + side * flow[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        here = summed((other - flow) ** 2)
        distances.append(np.sqrt(np.minimum(here, summed((along - flow) ** 2))))
    if not distances:
        return np.ones((h, w), np.float32)
    tolerance = ROUND_TRIP_FLOOR**2 + ROUND_TRIP_SHARE**2 * summed(flow**2)
    return (tolerance / (tolerance + np.mean(distances, axis=0) ** 2)) ** SHARED_FAILURE
