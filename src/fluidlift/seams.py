"""The sockets that back ends fill: one abstract class, one method each."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path

import numpy as np

from fluidlift.types import (
    FluidAsset,
    Gaussians,
    PinholeCamera,
    PixelFlow,
    PixelLabels,
    TriangleMesh,
    VideoClip,
)


class Segmenter(ABC):
    """Which pixels are fluid."""

    @abstractmethod
    def segment(self, clip: VideoClip, flow: PixelFlow) -> PixelLabels:
        """Labels of every frame of the clip."""


class Generator(ABC):
    """Image to Gaussians (paper: G)."""

    @abstractmethod
    def generate(self, image: np.ndarray, mask: np.ndarray, frame: int) -> tuple[Gaussians, PinholeCamera]:
        """Canonical Gaussians and the camera that saw them.

        Args:
            image: u8 [H,W,3], sRGB.
            mask: bool [H,W], the fluid.
            frame: number of the frame in its clip.
        """


class FlowEstimator(ABC):
    """Motion of pixels between two pictures."""

    @abstractmethod
    def displacement(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """float32 [H,W,2], px: where each pixel of `first` (u8 [H,W,3]) went in `second`."""


class DepthEstimator(ABC):
    """Distance of every pixel."""

    @abstractmethod
    def depth(self, image: np.ndarray, camera: PinholeCamera) -> np.ndarray:
        """float32 [H,W], camera z in m up to one factor, of a u8 [H,W,3] picture."""


class Mesher(ABC):
    """Particles to a surface."""

    @abstractmethod
    def surface(self, positions: np.ndarray, radius: float) -> TriangleMesh:
        """The free surface of particles at `positions` (float [n,3], m) with `radius` (m)."""


class Exporter(ABC):
    """An asset to files of one format."""

    @abstractmethod
    def export(self, asset: FluidAsset, folder: Path) -> list[Path]:
        """Write below `folder`; the files written."""
