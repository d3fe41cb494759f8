"""The learned options by name: what `motion.method` and `segment.method` may be besides our own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from fluidlift.backends.registry import ModelChoice, class_of, names
from fluidlift.errors import InputRejected
from fluidlift.seams import FlowEstimator, Segmenter

if TYPE_CHECKING:
    from fluidlift.backends.sam2_video import Guess, Progress

FLOW, MASKS = "flow method", "mask method"
FLOW_METHODS, MASK_METHODS = names(FLOW), names(MASKS)


def make_estimator(name: str, choice: ModelChoice) -> FlowEstimator:
    """A learned estimator of flow: one of `FLOW_METHODS`.

    Raises:
        InputRejected: no weights, or weights of another network.
        MissingPackage: an optional package is missing.
        FluidliftError: no such device.
        ValueError: another name.
    """
    kind, weights = class_of(FLOW, name), choice.weights
    run = {"device": choice.device, "announce": choice.announce}
    if name == "raft":
        return kind(weights, allow_download=choice.allow_download, **run)
    return kind(_given(choice, name, "a checkpoint of its authors"), **run)


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
    kind = class_of(MASKS, name)
    weights = _given(choice, name, "a folder with config.json and model.safetensors")
    hint = {"guess": guess} if name == "sam2" else {"words": words}
    return kind(
        weights, device=choice.device, allow_download=choice.allow_download, announce=choice.announce,
        progress=progress, **hint,
    )  # fmt: skip


def _given(choice: ModelChoice, name: str, what: str) -> Path | str:
    if choice.weights is None:
        raise InputRejected(
            f"no weights for {name}",
            what,
            "fluidlift models get NAME, or name a file of your own (docs/learned_models.md)",
        )
    return choice.weights
