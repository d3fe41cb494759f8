"""The fluid of a clip, frame by frame, without holding all of it."""

from __future__ import annotations

from typing import Any

import numpy as np

from fluidlift.io.stage_cache import parts_of
from fluidlift.types import Label


class FluidMasks:
    """The fluid of each frame, bool [T,H,W], read from the labels when it is asked for."""

    def __init__(self, labels: np.ndarray) -> None:
        self.labels, self.shape, self.ndim = labels, labels.shape, 3

    def __len__(self) -> int:
        return len(self.labels)

    def __getitem__(self, index: Any) -> np.ndarray:
        return np.asarray(self.labels[index]) == Label.FLUID

    def any_frame(self) -> np.ndarray:
        """bool [H,W]: fluid at some time."""
        seen = np.zeros(self.shape[1:], bool)
        for part in parts_of(self.labels):
            seen |= self[part].any(axis=0)
        return seen

    def areas(self) -> np.ndarray:
        """float [T]: px of each frame."""
        parts = [self[part].sum(axis=(1, 2)) for part in parts_of(self.labels)]
        return np.concatenate(parts).astype(float)
