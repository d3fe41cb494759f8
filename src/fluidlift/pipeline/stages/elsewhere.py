"""The stage that gathers what moved at other times of a long clip, in the cells of the part that is made."""

from __future__ import annotations

import numpy as np

from fluidlift.types import CellType
from fluidlift.types.stages import Elsewhere, Geometry, Motion, Stretch


def elsewhere(geometry: Geometry, motion: Motion, others: tuple[Motion, ...], starts: tuple[float, ...]) -> Elsewhere:
    """The targets of other stretches of the clip.

    Args:
        geometry: of the body.
        motion: of the part that is made.
        others: of the stretches, each of two targets or more.
        starts: s into the clip, of each.
    """
    liquid = geometry.setting.cell_types == CellType.FLUID
    usual = _mean(motion, liquid)
    size = max(float(np.sqrt(np.square(usual).mean())), 1e-9)
    found = []
    for start, other in zip(starts, others, strict=True):
        apart = float(np.sqrt(np.square(_mean(other, liquid) - usual).mean())) / size
        found.append(Stretch(start, other.targets, apart))
    return Elsewhere(tuple(found))


def _mean(motion: Motion, liquid: np.ndarray) -> np.ndarray:
    """Mean velocity (m/s) of the liquid's cells over the targets."""
    return np.mean([v.at_centers()[liquid] for v in motion.velocities], axis=0)
