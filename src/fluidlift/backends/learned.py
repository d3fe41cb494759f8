"""The learned options by name: what `motion.method` and `segment.method` may be besides our own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from fluidlift.backends.model_weights import Announce, say
from fluidlift.errors import InputRejected, require
from fluidlift.seams import FlowEstimator, Segmenter

if TYPE_CHECKING:
    from fluidlift.backends.sam2_video import Guess, Progress

FLOW_METHODS = ("raft", "sea-raft")
MASK_METHODS = ("sam2", "sam3")


@dataclass(frozen=True)
class ModelChoice:
    """Which weights, where they run, and what the user has agreed to."""

    weights: Path | str | None = None
    """file (flow) or folder (masks); None: the default of the method, where there is one to download"""
    device: str = "cpu"
    """cpu, cuda or cuda:1"""
    allow_download: bool = False
    """whether weights may be fetched"""
    announce: Announce = say
    """is told the licence before the weights are touched"""


def make_estimator(name: str, choice: ModelChoice) -> FlowEstimator:
    """A learned estimator of flow: one of `FLOW_METHODS`.

    Raises:
        InputRejected: no weights, or weights of another network.
        MissingPackage: an optional package is missing.
        FluidliftError: no such device.
        ValueError: another name.
    """
    require(name in FLOW_METHODS, f"flow method '{name}'", "one of " + ", ".join(FLOW_METHODS))
    if name == "raft":
        from fluidlift.backends.torchvision_raft import TorchvisionRaft

        return TorchvisionRaft(
            choice.weights, device=choice.device, allow_download=choice.allow_download, announce=choice.announce
        )
    from fluidlift.backends.sea_raft import SeaRaft

    return SeaRaft(
        _given(choice, "sea-raft", "a checkpoint of its authors"), device=choice.device, announce=choice.announce
    )


def make_segmenter(
    name: str,
    choice: ModelChoice,
    *,
    words: Sequence[str] = ("water",),
    guess: Guess | None = None,
    progress: Progress | None = None,
) -> Segmenter:
    """A learned segmentation: one of `MASK_METHODS`.

    Args:
        name: of the method.
        choice: weights and device.
        words: what SAM 3 looks for; SAM 2 takes no words.
        guess: from which SAM 2 takes its clicks, such as our own segmentation with the user's hints; None: without.
        progress: called after each frame.

    Raises:
        InputRejected: no weights, or weights of another network.
        MissingPackage: an optional package is missing.
        FluidliftError: no such device.
        ValueError: another name.
    """
    require(name in MASK_METHODS, f"mask method '{name}'", "one of " + ", ".join(MASK_METHODS))
    weights = _given(choice, name, "a folder with config.json and model.safetensors")
    if name == "sam2":
        from fluidlift.backends.sam2_video import Sam2Video

        return Sam2Video(
            weights,
            guess=guess,
            device=choice.device,
            allow_download=choice.allow_download,
            announce=choice.announce,
            progress=progress,
        )
    from fluidlift.backends.sam3_video import Sam3Video

    return Sam3Video(
        weights,
        words=words,
        device=choice.device,
        allow_download=choice.allow_download,
        announce=choice.announce,
        progress=progress,
    )


def _given(choice: ModelChoice, name: str, what: str) -> Path | str:
    if choice.weights is None:
        raise InputRejected(f"no weights for {name}", what, "name it (docs/learned_models.md says where to get it)")
    return choice.weights
