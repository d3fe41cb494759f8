"""Depth Anything: version 2 (Yang et al. 2024) by transformers, version 3 (Lin et al. 2025) by its own package."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fluidlift.backends.depth_model import DepthModel, Guess
from fluidlift.backends.depth_pictures import (
    TransformersDepth,
    longer_field_of_view,
    multiple_near,
    require_answer,
    require_picture,
    to_picture,
    to_tensor,
)
from fluidlift.backends.model_table import DA3
from fluidlift.backends.model_weights import Announce, require_all_tensors, say
from fluidlift.backends.pair_network import memory_errors, torch_device
from fluidlift.backends.sam2_video import MEAN, SPREAD
from fluidlift.errors import InputRejected, MissingPackage
from fluidlift.types import PinholeCamera

LICENCE = (
    "Depth Anything V2: code is Apache-2.0; weights Small are Apache-2.0, Base and Large CC-BY-NC-4.0 (not for "
    "commercial use), those for metres say nothing."
)
LICENCE_3 = (
    "Depth Anything 3: code is Apache-2.0 (ByteDance); weights Small, Base, Mono-Large and Metric-Large are "
    "Apache-2.0, Large, Giant and Nested CC-BY-NC-4.0 (not for commercial use)."
)
SHORTER = 518
"""px of the picture's shorter side, as in training: a multiple of the 14 px of a patch"""
CANONICAL_FOCAL = 300.0
"""px, for which version 3's metric model gives metres: metres = answer x focal length / 300, at the size it looks at"""


class DepthAnything(TransformersDepth):
    """Depth Anything V2 (V1's files fit as well)."""

    licence = LICENCE
    network = ("depth_anything", "DepthAnythingForDepthEstimation")

    @property
    def metric(self) -> bool:
        """Whether it gives metres."""
        return self._model.config.depth_estimation_type == "metric"

    def guess(self, image: np.ndarray, camera: PinholeCamera | None) -> Guess:
        """Disparity, or metres of the models that give them. It does not see how wide the view is.

        Raises:
            InputRejected: it finds no depth at all.
            FluidliftError: memory ran out.
        """
        import torch

        require_picture(image)
        size = image.shape[:2]
        patch = int(self._model.config.patch_size)
        scale = SHORTER / min(size)
        inner = multiple_near(size[0] * scale, patch), multiple_near(size[1] * scale, patch)
        with memory_errors(self._device), torch.inference_mode():
            picture = to_tensor(image, inner, MEAN, SPREAD, self._device, "bicubic")
            values = to_picture(self._model(pixel_values=picture).predicted_depth, size)
        if self.metric:
            return Guess(require_answer(values, "Depth Anything"), "metres")
        if not (values > 0).any():  # its last layer cuts at 0: the sky
            require_answer(values, "Depth Anything")
        return Guess(values.astype(np.float32), "disparity")


class DepthAnything3(DepthModel):
    """Depth Anything 3 through its authors' package `depth_anything_3`.

    Args:
        weights: folder with config.json and model.safetensors, or its name on the hub where downloads are allowed.
        device: "cpu", "cuda", "cuda:1"...
        allow_download: whether files may be fetched.
        announce: is told the licence before the weights are touched.

    Raises:
        MissingPackage: the package is missing.
        InputRejected: no such folder, or weights of another model.
        FluidliftError: no such device.
    """

    def __init__(
        self, weights: Path | str, *, device: str = "cpu", allow_download: bool = False, announce: Announce = say
    ) -> None:
        self._device = torch_device(device)
        try:
            from depth_anything_3.api import DepthAnything3 as Network  # pyright: ignore[reportMissingImports]
        except ModuleNotFoundError as error:
            raise MissingPackage(
                f"{error.name} is not installed. Needed: for Depth Anything 3. Do: {DA3}, in an environment of its "
                "own, whose Python --set depth.python=PATH names."
            ) from None
        except (ImportError, RuntimeError, OSError) as error:
            reason = str(error).partition("\n")[0]
            raise MissingPackage(
                f"Depth Anything 3's package does not start ({reason}). Needed: packages that fit each other. "
                "Do: install it in an environment of its own, and name its Python with --set depth.python=PATH."
            ) from None
        folder = Path(weights)
        if not allow_download and not (folder / "model.safetensors").is_file():
            raise InputRejected(
                f"no 'model.safetensors' in '{weights}'", "a folder with config.json and model.safetensors",
                "check it, or set depth.download=true",
            )  # fmt: skip
        announce(LICENCE_3)
        try:
            network = Network.from_pretrained(str(weights), local_files_only=not allow_download)
        except (OSError, ValueError, KeyError, RuntimeError, TypeError) as error:
            reason = " ".join(str(error).split())[:200]
            raise InputRejected(f"'{folder.name}' cannot be loaded ({reason})", "a model of Depth Anything 3") from None
        require_all_tensors(network, _weights_file(weights))
        self._model = network.to(self._device).eval()
        self.canonical = "metric" in str(getattr(network, "model_name", "")).lower()

    def guess(self, image: np.ndarray, camera: PinholeCamera | None) -> Guess:
        """Depth: metres of the metric model where the camera is known, and of the nested ones; else up to a factor.

        Raises:
            InputRejected: it finds no depth at all.
            FluidliftError: memory ran out.
        """
        require_picture(image)
        size = image.shape[:2]
        with memory_errors(self._device):
            found = self._model.inference([image])
        answer = np.asarray(found.depth, np.float32)[0]
        sky = getattr(found, "sky", None)
        if sky is not None:
            answer = np.where(np.asarray(sky)[0] > 0.5, np.nan, answer)
        view = None
        if getattr(found, "intrinsics", None) is not None:
            horizontal = float(2.0 * np.degrees(np.arctan(0.5 * answer.shape[1] / float(found.intrinsics[0][0, 0]))))
            view = longer_field_of_view(horizontal, size)
        metres = bool(getattr(found, "is_metric", 0))
        if self.canonical:
            metres = camera is not None
            if camera is not None:
                answer = answer * np.float32(camera.focal[0] * answer.shape[1] / camera.size[0] / CANONICAL_FOCAL)
        depth = require_answer(_nearest(answer, size), "Depth Anything 3")
        return Guess(depth, "metres" if metres else "relative", view)


def _weights_file(weights: Path | str) -> Path:
    """That the tensors were read from: in the folder, or in the hub's cache."""
    path = Path(weights) / "model.safetensors"
    if path.is_file():
        return path
    from huggingface_hub import hf_hub_download

    return Path(hf_hub_download(repo_id=str(weights), filename=path.name, local_files_only=True))


def _nearest(values: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """At (height, width); holes do not grow."""
    import cv2

    return cv2.resize(values, size[::-1], interpolation=cv2.INTER_NEAREST_EXACT)
