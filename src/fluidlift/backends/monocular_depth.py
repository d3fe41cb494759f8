"""Learned depth by name: what `depth.model` may be. All say what their numbers mean, and some how wide the view is."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from fluidlift.backends.registry import ModelChoice, class_of, names
from fluidlift.errors import InputRejected
from fluidlift.seams import DepthEstimator
from fluidlift.types import PinholeCamera

DEPTH = "depth model"
DEPTH_MODELS = names(DEPTH)
"""the first is what we advise: its code and weights may be used for everything, and it says the field of view"""


@dataclass(frozen=True)
class Guess:
    """What a model says about one picture."""

    values: Float[np.ndarray, "h w"]
    """float32; nan where it says nothing, such as the sky"""
    holds: Literal["metres", "relative", "disparity"]
    """metres; depth up to a factor; inverse depth up to factor and offset"""
    field_of_view: float | None = None
    """degrees across the longer side, where it says that"""


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


def make_depth_estimator(name: str, choice: ModelChoice) -> DepthModel:
    """A learned model of depth: one of `DEPTH_MODELS`.

    Raises:
        InputRejected: no weights, or weights of another network.
        MissingPackage: an optional package is missing.
        FluidliftError: no such device.
        ValueError: another name.
    """
    kind = class_of(DEPTH, name)
    if choice.weights is None:
        raise InputRejected(
            f"no weights for {name}", "a file or folder with them", "name it (docs/depth.md says where to get it)"
        )
    return kind(choice.weights, device=choice.device, allow_download=choice.allow_download, announce=choice.announce)
