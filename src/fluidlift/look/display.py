"""From linear light to what a display shows."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

KNEE = 0.8
"""up to here light is shown as it is: what a plate or a source colour holds stays itself"""


def displayed(linear: Float[np.ndarray, "*n 3"], *, exposure: float = 0.0) -> Float[np.ndarray, "*n 3"]:
    """Linear light in [0, 1) for a display; the sRGB curve is still to come.

    Above `KNEE` the largest channel is bent over towards 1, with a slope that goes on smoothly, and the others follow
    it: suns and lava keep their hue instead of clipping to yellow and white.

    Args:
        linear: light, 0 and more.
        exposure: stops by which it is brightened.
    """
    light = np.maximum(np.asarray(linear, np.float32) * np.float32(2.0**exposure), 0.0)
    peak = light.max(axis=-1, keepdims=True)
    over = np.maximum(peak - KNEE, 0.0) / (1.0 - KNEE)
    bent = np.where(peak > KNEE, KNEE + (1.0 - KNEE) * over / (1.0 + over), peak)
    return light * (bent / np.maximum(peak, 1e-12))
