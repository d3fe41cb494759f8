"""How far the centres of faces are from the solid."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def face_clearance(
    signed_distance: Float[np.ndarray, "nx+1 ny+1 nz+1"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """m, negative inside the solid: per component, the mean of the distance at the four corners of each face."""
    out = []
    for axis in range(3):
        mean = np.asarray(signed_distance)
        for side in range(3):
            if side != axis:
                along = np.moveaxis(mean, side, 0)
                mean = np.moveaxis(0.5 * (along[1:] + along[:-1]), 0, side)
        out.append(mean)
    return tuple(out)
