"""What all models of depth share: pictures as they take them, and their answers at the size of the picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from fluidlift.backends.depth_model import DepthModel
from fluidlift.backends.model_weights import Announce, say
from fluidlift.backends.pair_network import torch_device
from fluidlift.backends.sam2_video import loaded_model
from fluidlift.errors import InputRejected, require


class TransformersDepth(DepthModel):
    """A model of depth that transformers knows.

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

    licence: ClassVar[str]
    network: ClassVar[tuple[str, str]]
    """kind and class by which transformers knows it"""

    def __init__(
        self, weights: Path | str, *, device: str = "cpu", allow_download: bool = False, announce: Announce = say
    ) -> None:
        self._device = torch_device(device)
        announce(self.licence)
        self._model = loaded_model(weights, *self.network, allow_download).to(self._device)


def require_picture(image: np.ndarray) -> None:
    """Raise `ValueError` unless it is u8 [H,W,3]."""
    require(image.ndim == 3 and image.shape[2] == 3, f"a picture {image.shape}", "[H,W,3]")
    require(image.dtype == np.uint8, f"a picture of {image.dtype}", "u8")


def multiple_near(length: float, step: int) -> int:
    """The multiple of `step` nearest to a length in px, at least one."""
    return max(step, round(length / step) * step)


def to_tensor(image: np.ndarray, size: tuple[int, int], mean: tuple, spread: tuple, device: Any, how: str) -> Any:
    """float32 [1,3,h,w] of a u8 [H,W,3] picture, resized to (height, width) and normalised.

    Args:
        how: interpolation that the model was trained with: bilinear or bicubic.
    """
    import torch

    require_picture(image)
    values = torch.from_numpy(np.ascontiguousarray(image)).to(device).permute(2, 0, 1)[None].float() / 255.0
    if tuple(values.shape[-2:]) != size:
        values = torch.nn.functional.interpolate(values, size, mode=how, align_corners=False, antialias=True)
        values = values.clamp(0.0, 1.0)
    shape = (1, 3, 1, 1)
    return (values - values.new_tensor(mean).view(shape)) / values.new_tensor(spread).view(shape)


def to_picture(values: Any, size: tuple[int, int]) -> np.ndarray:
    """float32 [H,W] of a tensor [h,w] or [1,h,w], at (height, width)."""
    import torch

    flat = values.reshape(1, 1, *values.shape[-2:]).float()
    if tuple(flat.shape[-2:]) != size:
        flat = torch.nn.functional.interpolate(flat, size, mode="bilinear", align_corners=False)
    return flat[0, 0].cpu().numpy()


def longer_field_of_view(horizontal: float, size: tuple[int, int]) -> float:
    """Degrees across the longer side of a picture (height, width) that is `horizontal` degrees wide."""
    height, width = size
    if width >= height:
        return horizontal
    return float(2.0 * np.degrees(np.arctan(np.tan(np.radians(horizontal) / 2.0) * height / width)))


def require_answer(values: np.ndarray, model: str) -> np.ndarray:
    """The values, nan where they are no positive numbers.

    Raises:
        InputRejected: nowhere.
    """
    known = np.isfinite(values) & (values > 0)
    if not known.any():
        raise InputRejected(
            f"{model} finds no depth in the picture",
            "a picture of a scene",
            "look at the clip, or choose another model",
        )
    return np.where(known, values, np.nan).astype(np.float32)
