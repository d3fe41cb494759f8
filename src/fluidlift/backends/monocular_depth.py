"""Learned depth by name: what `depth.model` may be. All say what their numbers mean, and some how wide the view is."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from fluidlift.backends.model_weights import Announce, say
from fluidlift.errors import InputRejected, require
from fluidlift.seams import DepthEstimator
from fluidlift.types import PinholeCamera

DEPTH_MODELS = ("moge", "depth-anything", "depth-anything-3", "depth-pro")
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


@dataclass(frozen=True)
class ModelWeights:
    """Which weights, where they run, and what the user has agreed to."""

    weights: Path | str | None = None
    """file or folder, or a name on the hub where downloads are allowed"""
    device: str = "cpu"
    """cpu, cuda or cuda:1"""
    allow_download: bool = False
    """whether weights may be fetched"""
    announce: Announce = say
    """is told the licence before the weights are touched"""


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


def make_depth_estimator(name: str, choice: ModelWeights) -> DepthModel:
    """A learned model of depth: one of `DEPTH_MODELS`.

    Raises:
        InputRejected: no weights, or weights of another network.
        MissingPackage: an optional package is missing.
        FluidliftError: no such device.
        ValueError: another name.
    """
    require(name in DEPTH_MODELS, f"depth model '{name}'", "one of " + ", ".join(DEPTH_MODELS))
    if choice.weights is None:
        raise InputRejected(
            f"no weights for {name}", "a file or folder with them", "name it (docs/depth.md says where to get it)"
        )
    if name == "moge":
        from fluidlift.backends.moge_depth import MogeDepth as Model
    elif name == "depth-anything":
        from fluidlift.backends.depth_anything import DepthAnything as Model
    elif name == "depth-anything-3":
        from fluidlift.backends.depth_anything import DepthAnything3 as Model
    else:
        from fluidlift.backends.depth_pro import DepthPro as Model
    return Model(choice.weights, device=choice.device, allow_download=choice.allow_download, announce=choice.announce)
