"""From the transfer curves of high dynamic range video to 8-bit sRGB."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8, UInt16

from fluidlift.numerics.srgb import srgb_from_linear

PQ, HLG = 16, 18
"""transfer characteristics of ITU-T H.273: SMPTE ST 2084 and ARIB STD-B67"""

REFERENCE_WHITE = 203.0
"""cd/m^2 of diffuse white in HDR programmes (ITU-R BT.2408)"""

REC709_FROM_REC2020 = np.array(
    [[1.660491, -0.587641, -0.072850], [-0.124550, 1.132900, -0.008349], [-0.018151, -0.100579, 1.118730]], np.float32
)
"""linear light (ITU-R BT.2087)"""


def light_from_pq(signal: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Display light in cd/m^2 of a PQ signal in [0, 1] (SMPTE ST 2084)."""
    m1, m2, c1, c2, c3 = 0.1593017578125, 78.84375, 0.8359375, 18.8515625, 18.6875
    p = np.power(np.clip(signal, 0.0, 1.0), 1 / m2)
    return 10000.0 * np.power(np.maximum(p - c1, 0.0) / (c2 - c3 * p), 1 / m1)


def light_from_hlg(signal: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Display light in cd/m^2 of an HLG signal on a 1000 cd/m^2 display (ITU-R BT.2100, system gamma 1.2)."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    x = np.clip(signal, 0.0, 1.0)
    scene = np.where(x <= 0.5, x * x / 3.0, (np.exp((x - c) / a) + b) / 12.0)
    luminance = scene @ np.array([0.2627, 0.6780, 0.0593], scene.dtype)
    return 1000.0 * scene * np.power(np.maximum(luminance, 1e-6), 0.2)[..., None]


def tone_map(picture: UInt16[np.ndarray, "h w 3"], transfer: int) -> UInt8[np.ndarray, "h w 3"]:
    """sRGB of a BT.2020 picture with the transfer curve PQ or HLG.

    Up to half of diffuse white the light is kept; above, it is bent over so that 10 times white reaches 1. The bend
    acts on the largest channel, which keeps hues. A look is not meant: only that water and foam keep their contrast.
    """
    signal = picture.astype(np.float32) / 65535.0
    light = light_from_pq(signal) if transfer == PQ else light_from_hlg(signal)
    linear = np.maximum((light / REFERENCE_WHITE).astype(np.float32) @ REC709_FROM_REC2020.T, 0.0)
    peak = np.maximum(linear.max(axis=-1, keepdims=True), 1e-6)
    knee, top = 0.5, 10.0
    over = np.maximum(peak - knee, 0.0) / (top - knee)
    stretch = (top - knee) / (1.0 - knee)  # slope 1 at the knee, value 1 at the top
    bent = knee + (1.0 - knee) * over * stretch / (1.0 + over * (stretch - 1.0))
    mapped = linear * (np.where(peak > knee, bent, peak) / peak)
    return np.round(255.0 * srgb_from_linear(mapped)).astype(np.uint8)
