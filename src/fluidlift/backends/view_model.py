"""What a learned model of the view is (which way is up, how wide is the picture), what it says, and which there are."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from fluidlift.backends.registry import ModelChoice, class_of, names
from fluidlift.errors import InputRejected
from fluidlift.types import PinholeCamera

VIEW = "view model"
VIEW_MODELS = names(VIEW)


@dataclass(frozen=True)
class ViewGuess:
    """What a model says about the camera of one picture. Its errors are standard errors."""

    pitch: float
    """degrees that the camera looks below the horizon"""
    roll: float
    """degrees that the picture is turned clockwise"""
    focal: float
    """px of the picture; the camera's, where that is known"""
    pitch_error: float
    """degrees"""
    roll_error: float
    """degrees"""
    focal_error: float
    """relative; 0 where the camera is known"""
    pitch_by_focal: float = 0.0
    """degrees that the pitch it means rises by with the logarithm of the focal length"""


class ViewModel(ABC):
    """A learned model of the view."""

    @abstractmethod
    def guess(self, image: np.ndarray, camera: PinholeCamera | None) -> ViewGuess | None:
        """Of a u8 [H,W,3] picture, with the focal length of the camera where it is known; None: it sees nothing."""


def make_view_estimator(name: str, choice: ModelChoice) -> ViewModel:
    """A learned model of the view: one of `VIEW_MODELS`.

    Raises:
        InputRejected: no weights, or weights of another network.
        MissingPackage: an optional package is missing.
        FluidliftError: no such device.
        ValueError: another name.
    """
    kind = class_of(VIEW, name)
    if choice.weights is None:
        raise InputRejected(
            f"no weights for {name}",
            "a file or folder with them",
            "fluidlift models get NAME, or name a file of your own (docs/learned_models.md)",
        )
    return kind(choice.weights, device=choice.device, announce=choice.announce)
