"""Views so flat that the far water would take the cells of the near: drawn as a relief, from a little higher."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Bool

from fluidlift.shape.view.horizon import elevation
from fluidlift.types import PinholeCamera, UpEvidence

MOST_SPREAD = 2.5
"""times that the farthest water may be as far away as the nearest. A wide river to the brink of a fall, seen from 5
degrees above the level, was built with its true tilt and three others; farthest over nearest 14, 4.1, 2.6 and 1.8: the
mean pictures of the re-simulations differ from the clip's by 35, 13, 5.4 and 4.9 grey levels, where those of the clip
differ among themselves by 6"""
STEP = 0.5
"""degrees"""


def as_relief(
    up: UpEvidence, mask: Bool[np.ndarray, "h w"], level_camera: Callable[[UpEvidence], PinholeCamera]
) -> UpEvidence:
    """The tilt from which a level fluid is built: as seen, or just so steep that it spreads no more than `MOST_SPREAD`.

    A plane that is seen from flat above says little about lengths along the view: the picture from the camera stays as
    it is, the shore opposite comes nearer.

    Args:
        up: as seen.
        mask: pixels of the fluid on the ground.
        level_camera: the camera in a level frame, z up, at a tilt.
    """
    places = np.argwhere(mask)[:, ::-1] + 0.5
    for pitch in np.arange(up.pitch, 90.0, STEP):
        raised = replace(up, pitch=float(pitch))
        low, high = np.percentile(-elevation(level_camera(raised), places), [2.0, 98.0])
        if low > 0 and np.sin(np.radians(high)) <= MOST_SPREAD * np.sin(np.radians(low)):
            return replace(raised, raised=float(pitch) - up.pitch)
    return up
