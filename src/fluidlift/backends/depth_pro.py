"""Depth Pro (Bochkovskii et al. 2024, Apple) through transformers: depth in metres and the field of view."""

from __future__ import annotations

import numpy as np

from fluidlift.backends.depth_model import Guess
from fluidlift.backends.depth_pictures import (
    TransformersDepth,
    longer_field_of_view,
    require_answer,
    require_picture,
    to_picture,
    to_tensor,
)
from fluidlift.backends.pair_network import memory_errors
from fluidlift.types import PinholeCamera

LICENCE = "Depth Pro: code and weights are under Apple's own licences (apple-amlr for the weights: research only)."
MEAN = SPREAD = (0.5, 0.5, 0.5)
"""of sRGB from 0 to 1, by which the model's input is normalised"""
NEAREST, FARTHEST = 1e-4, 1e4
"""m, between which its inverse depth is cut"""


class DepthPro(TransformersDepth):
    """Depth by Depth Pro."""

    licence = LICENCE
    network = ("depth_pro", "DepthProForDepthEstimation")

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
