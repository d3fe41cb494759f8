"""Learned depth by name: what `depth.model` may be. All say what their numbers mean, and some how wide the view is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from fluidlift.backends.depth_model import DepthModel
from fluidlift.backends.model_weights import Announce, say
from fluidlift.errors import InputRejected, require

DEPTH_MODELS = ("moge", "depth-anything", "depth-anything-3", "depth-pro")
"""the first is what we advise: its code and weights may be used for everything, and it says the field of view"""


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
