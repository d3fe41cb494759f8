"""Depth Pro (Bochkovskii et al. 2024, Apple) through transformers: depth in metres and the field of view."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fluidlift.backends.depth_pictures import (
    longer_field_of_view,
    require_answer,
    require_picture,
    to_picture,
    to_tensor,
)
from fluidlift.backends.model_weights import Announce, say
from fluidlift.backends.monocular_depth import DepthModel, Guess
from fluidlift.backends.pair_network import memory_errors, torch_device
from fluidlift.backends.sam2_video import loaded_model
from fluidlift.types import PinholeCamera

LICENCE = "Depth Pro: code and weights are under Apple's own licences (apple-amlr for the weights: research only)."
MEAN = SPREAD = (0.5, 0.5, 0.5)
"""of sRGB from 0 to 1, by which the model's input is normalised"""
NEAREST, FARTHEST = 1e-4, 1e4
"""m, between which its inverse depth is cut"""


class DepthPro(DepthModel):
    """Depth by Depth Pro.

    Args:
        weights: folder with config.json and .safetensors, or its name on the hub where downloads are allowed.
        device: "cpu", "cuda", "cuda:1"...
        allow_download: whether files may be fetched.
        announce: is told the licence before the weights are touched.

    Raises:
        MissingPackage: transformers is missing.
        InputRejected: no such folder, or weights of another model.
        FluidliftError: no such device.
    """

    def __init__(
        self, weights: Path | str, *, device: str = "cpu", allow_download: bool = False, announce: Announce = say
    ) -> None:
        self._device = torch_device(device)
        announce(LICENCE)
        self._model = loaded_model(weights, "depth_pro", "DepthProForDepthEstimation", allow_download).to(self._device)

    @property
    def side(self) -> int:
        """px of the square that it looks at: its patches at the finest of its scales."""
        config = self._model.config
        return int(config.patch_size / min(config.scaled_images_ratios))

    def guess(self, image: np.ndarray, camera: PinholeCamera | None) -> Guess:
        """Metres, by the focal length of the camera where it is known, else by the model's own; and that.

        The network gives the inverse depth of a picture as wide as its focal length; metres are that, divided by the
        width over the focal length in px.

        Raises:
            InputRejected: it finds no depth at all.
            FluidliftError: memory ran out.
        """
        import torch

        require_picture(image)
        size = image.shape[:2]
        with memory_errors(self._device), torch.inference_mode():
            out = self._model(
                pixel_values=to_tensor(image, (self.side, self.side), MEAN, SPREAD, self._device, "bilinear")
            )
            canonical = to_picture(out.predicted_depth, size)
        view = getattr(out, "field_of_view", None)
        horizontal = None if view is None else float(view.reshape(-1)[0])
        if camera is not None:
            width_over_focal = size[1] / (camera.focal[0] * size[1] / camera.size[0])
        elif horizontal is not None:
            width_over_focal = 2.0 * float(np.tan(np.radians(horizontal) / 2.0))
        else:
            width_over_focal = None
        inverse = canonical * (width_over_focal or 1.0)
        depth = 1.0 / np.clip(inverse, 1.0 / FARTHEST, 1.0 / NEAREST)
        depth = require_answer(np.where(inverse > 1.0 / FARTHEST, depth, np.nan), "Depth Pro")
        seen = None if horizontal is None else longer_field_of_view(horizontal, size)
        return Guess(depth, "relative" if width_over_focal is None else "metres", seen)
