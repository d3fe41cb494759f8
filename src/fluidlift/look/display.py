"""Tone mapping: from linear light to what a display shows."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

KNEE = 0.8
"""up to here light is shown as it is: what a plate or a source colour holds stays itself"""
FILM = 0.6
"""how much light above that bends like film, each channel for itself, on its way towards white: the core of a flame is
yellower than its rim. The rest keeps its hue."""


def displayed(linear: Float[np.ndarray, "*n 3"], *, exposure: float = 0.0) -> Float[np.ndarray, "*n 3"]:
    """Linear light in [0, 1) for a display; the sRGB curve is still to come.

    Above `KNEE` light is bent over towards 1, with a slope that goes on smoothly: in part the largest channel, and the
    others follow it, in part (`FILM`) each channel. Neither suns nor lava clip, or become one flat colour.

    Args:
        linear: light, 0 and more.
        exposure: stops by which it is brightened.
    """
    light = np.maximum(np.asarray(linear, np.float32) * np.float32(2.0**exposure), 0.0)
    peak = light.max(axis=-1, keepdims=True)
    if not (peak > KNEE).any():
        return light
    hue = light * (_bent(peak) / np.maximum(peak, 1e-12))
    return hue + np.float32(FILM) * (_bent(light) - hue)


def _bent(light: np.ndarray) -> np.ndarray:
    over = np.maximum(light - KNEE, 0.0) / (1.0 - KNEE)
    return np.where(light > KNEE, KNEE + (1.0 - KNEE) * over / (1.0 + over), light).astype(np.float32)
