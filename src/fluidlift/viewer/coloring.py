"""What a look does to the colours of splats, near enough to choose by: the body, not the light on it."""

from __future__ import annotations

from typing import Any

import numpy as np

from fluidlift.errors import FluidliftError
from fluidlift.numerics.srgb import linear_from_srgb, srgb_from_linear

SPOON = 0.03
"""m of a material before white, that its colour is shown by: more of honey or oil is nearly black"""


def colored(rgb: np.ndarray, look: dict[str, Any]) -> np.ndarray | None:
    """u8 [n,3] sRGB of splats in a look; None: their own. Reflections and refraction are for rendered pictures.

    Args:
        rgb: u8 [n,3] sRGB, of the clip.
        look: `style`, `material`, `tint` (linear) and `exposure` (stops), each where it is given.
    """
    if look.get("style", "splats") == "splats" and not {"tint", "exposure"} & look.keys():
        return None
    linear = linear_from_srgb(rgb.astype(np.float32) / 255)
    name = look.get("material", "source")
    if look.get("style", "splats") != "splats" and name != "source":
        body, glow, carried = _material(name)
        linear = carried * linear + (1 - carried) * body + glow
    linear = linear * np.asarray(look.get("tint", (1, 1, 1)), np.float32) * 2.0 ** float(look.get("exposure", 0.0))
    return np.round(255 * np.clip(srgb_from_linear(linear), 0, 1)).astype(np.uint8)


def _material(name: str) -> tuple[np.ndarray, np.ndarray, float]:
    """Linear colour of the body, its glow, and how much of the clip's colour shows; grey where it is not known."""
    from fluidlift.look.materials import material_named

    try:
        m = material_named(name)
    except (FluidliftError, ValueError):
        return np.full(3, 0.5, np.float32), np.zeros(3, np.float32), 1.0
    return m.before_white(SPOON).astype(np.float32), np.asarray(m.emission, np.float32), float(m.carried)
