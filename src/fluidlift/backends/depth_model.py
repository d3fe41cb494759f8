"""What a learned model of depth is, and what it says about one picture."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from fluidlift.seams import DepthEstimator
from fluidlift.types import PinholeCamera


@dataclass(frozen=True)
class Guess:
    """What a model says about one picture."""

    values: Float[np.ndarray, "h w"]
    """float32; nan where it says nothing, such as the sky"""
    holds: Literal["metres", "relative", "disparity"]
    """metres; depth up to a factor; inverse depth up to factor and offset"""
    field_of_view: float | None = None
    """degrees across the longer side, where it says that"""
    normals: Float[np.ndarray, "h w 3"] | None = None
    """unit normals of the surfaces in camera axes (x right, y down, z forward), where it gives them; nan elsewhere"""


class DepthModel(DepthEstimator):
    """A learned model of depth."""

    @abstractmethod
    def guess(self, image: np.ndarray, camera: PinholeCamera | None) -> Guess:
        """Depth of a u8 [H,W,3] picture; the camera where it is known."""

    def depth(self, image: np.ndarray, camera: PinholeCamera) -> np.ndarray:
        """float32 [H,W], camera z in m up to one factor; of a model that gives disparity, as if its offset were 0."""
        found = self.guess(image, camera)
        if found.holds != "disparity":
            return found.values
        with np.errstate(divide="ignore"):
            return np.where(found.values > 0, 1.0 / found.values, np.nan).astype(np.float32)
