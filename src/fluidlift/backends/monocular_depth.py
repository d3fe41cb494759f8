"""Learned depth by name: what `depth.model` may be. All say what their numbers mean, and some how wide the view is."""

from __future__ import annotations

from fluidlift.backends.depth_model import DepthModel
from fluidlift.backends.registry import ModelChoice, class_of, names
from fluidlift.errors import InputRejected

DEPTH = "depth model"
DEPTH_MODELS = names(DEPTH)
"""the first is what we advise: its code and weights may be used for everything, and it says the field of view"""


def make_depth_estimator(name: str, choice: ModelChoice) -> DepthModel:
    """A learned model of depth: one of `DEPTH_MODELS`.

    Raises:
        InputRejected: no weights, or weights of another network.
        MissingPackage: an optional package is missing.
        FluidliftError: no such device.
        ValueError: another name.
    """
    kind = class_of(DEPTH, name)  # of another Python: which imports none of its packages yet
    if choice.weights is None:
        raise InputRejected(
            f"no weights for {name}",
            "a file or folder with them",
            "fluidlift models get NAME, or name a file of your own (docs/depth.md)",
        )
    if choice.python is not None:
        from fluidlift.backends.depth_process import DepthProcess

        return DepthProcess(name, choice)
    return kind(choice.weights, device=choice.device, allow_download=choice.allow_download, announce=choice.announce)
