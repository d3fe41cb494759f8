"""Registry of the back ends that are chosen by name: one table, by what they are for."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from fluidlift.backends.model_weights import Announce, say
from fluidlift.errors import require

BACK_ENDS: dict[str, dict[str, str]] = {
    "flow method": {"raft": "torchvision_raft:TorchvisionRaft", "sea-raft": "sea_raft:SeaRaft"},
    "mask method": {"sam2": "sam2_video:Sam2Video", "sam3": "sam3_video:Sam3Video"},
    "depth model": {
        "moge": "moge_depth:MogeDepth", "moge-onnx": "moge_onnx:MogeOnnx",
        "depth-anything": "depth_anything:DepthAnything",
        "depth-anything-3": "depth_anything:DepthAnything3", "depth-pro": "depth_pro:DepthPro",
    },
    "view model": {"geocalib": "geocalib:GeoCalib"},
    "generator": {
        "triplane-gaussian": "triplane_gaussian:TriplaneGaussianGenerator", "trellis": "trellis:TrellisGenerator",
        "triposplat": "triposplat:TripoSplatGenerator", "lgm": "lgm:LgmGenerator", "sharp": "sharp:SharpGenerator",
    },
}  # fmt: skip
"""module of this package and class in it, by purpose and name; nothing is imported before it is wanted"""


@dataclass(frozen=True)
class ModelChoice:
    """Which weights, where they run, and what the user has agreed to."""

    weights: Path | str | None = None
    """file, folder, or a name on the hub where downloads are allowed; None: the default, where there is one"""
    device: str = "cpu"
    """cpu, cuda or cuda:1"""
    allow_download: bool = False
    """whether weights may be fetched"""
    announce: Announce = say
    """is told the licence before the weights are touched"""
    python: Path | None = None
    """of the environment in which a model of depth is installed; None: this one"""
    seconds: float = 600.0
    """that one picture may take there, the loading of the weights with the first"""


def names(purpose: str) -> tuple[str, ...]:
    """The back ends for a purpose, the advised one first."""
    return tuple(BACK_ENDS[purpose])


def module_name(purpose: str, name: str) -> str:
    """Full name of the module of a back end, whose source its results depend on.

    Raises:
        ValueError: there is none of that name.
    """
    require(name in BACK_ENDS[purpose], f"{purpose} '{name}'", "one of " + ", ".join(names(purpose)))
    return "fluidlift.backends." + BACK_ENDS[purpose][name].partition(":")[0]


def class_of(purpose: str, name: str) -> Any:
    """The class of a back end, imported now.

    Raises:
        ValueError: there is none of that name.
        MissingPackage: an optional package is missing.
    """
    return getattr(import_module(module_name(purpose, name)), BACK_ENDS[purpose][name].partition(":")[2])
