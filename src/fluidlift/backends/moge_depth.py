"""MoGe (Wang et al. 2025, Microsoft): depth in metres, field of view and normals of a picture, by its authors' package.

The package is not on the registry of packages; the last commit of its second version is installed (`INSTALL`), whose
weights these are: the third needs other packages.
A checkpoint holds its own description (`model_config`) and tensors (`model`). The authors' loader lets tensors that
lack pass, and they would stay noise; here they are refused.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.backends.depth_model import DepthModel, Guess
from fluidlift.backends.depth_pictures import longer_field_of_view, require_answer, require_picture, to_picture
from fluidlift.backends.model_table import MOGE
from fluidlift.backends.model_weights import Announce, say
from fluidlift.backends.pair_network import memory_errors, torch_device
from fluidlift.errors import InputRejected, MissingPackage
from fluidlift.types import PinholeCamera

LICENCE = "MoGe: code and weights are MIT (Microsoft), its encoder DINOv2 Apache-2.0 (Meta)."
INSTALL = MOGE


class MogeDepth(DepthModel):
    """Depth by MoGe, first or second version.

    Args:
        weights: the authors' `model.pt`, a folder with it, or its name on the hub where downloads are allowed.
        device: "cpu", "cuda", "cuda:1"...
        allow_download: whether the file may be fetched.
        announce: is told the licence before the weights are touched.

    Raises:
        MissingPackage: the package is missing.
        InputRejected: no such file, or not MoGe's.
        FluidliftError: no such device.
    """

    def __init__(
        self, weights: Path | str, *, device: str = "cpu", allow_download: bool = False, announce: Announce = say
    ) -> None:
        self._device = torch_device(device)
        _module("moge.model")
        announce(LICENCE)
        self._model, self.metric = _loaded(weights, allow_download)
        self._model = self._model.to(self._device).eval()

    def guess(self, image: np.ndarray, camera: PinholeCamera | None) -> Guess:
        """Depth (metres of the second version, up to a factor of the first), field of view, and normals if it has them.

        A camera that is known fixes the field of view that the model works with.

        Raises:
            InputRejected: it finds no depth at all.
            FluidliftError: memory ran out.
        """
        import torch

        require_picture(image)
        height, width = image.shape[:2]
        fov = None if camera is None else float(2.0 * np.degrees(np.arctan(0.5 * width / camera.focal[0])))
        picture = torch.from_numpy(np.ascontiguousarray(image)).to(self._device).permute(2, 0, 1).float() / 255.0
        with memory_errors(self._device), torch.inference_mode():
            found = self._model.infer(picture, fov_x=fov, use_fp16=self._device.type == "cuda")
        depth = require_answer(to_picture(found["depth"], (height, width)), "MoGe")
        # intrinsics are in units of the picture's width and height
        horizontal = float(2.0 * np.degrees(np.arctan(0.5 / float(found["intrinsics"][..., 0, 0]))))
        holds = "metres" if self.metric else "relative"
        return Guess(depth, holds, longer_field_of_view(horizontal, (height, width)), _normals(found.get("normal")))


def _normals(found: Any) -> np.ndarray | None:
    """float32 [H,W,3], nan where there are none (the sky); None of versions that give none."""
    if found is None:
        return None
    normals = found.reshape(-1, *found.shape[-3:])[0].float().cpu().numpy()
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(length > 0.5, normals / length, np.nan).astype(np.float32)  # a masked one is 0


def _module(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise MissingPackage(
            f"{error.name} is not installed. Needed: for MoGe. Do: {INSTALL} (it is not on the package registry)."
        ) from None
    except (ImportError, RuntimeError, OSError) as error:
        reason = str(error).partition("\n")[0]
        raise MissingPackage(
            f"MoGe's package does not start ({reason}). Needed: packages that fit each other. Do: {INSTALL}."
        ) from None


def _loaded(weights: Path | str, allow_download: bool) -> tuple[Any, bool]:
    """The network with all its tensors, and whether it gives metres."""
    import pickle

    import torch

    path = _file_of(weights, allow_download)
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError:
        raise InputRejected(
            f"'{path.name}' holds more than tensors, which could run code", "the model.pt of MoGe's authors",
            "fetch it from their page",
        ) from None  # fmt: skip
    except (RuntimeError, ValueError, EOFError, OSError, KeyError) as error:
        reason = str(error).partition("\n")[0]
        raise InputRejected(f"'{path.name}' is damaged ({reason})", "MoGe's model.pt", "copy it again") from None
    config = checkpoint.get("model_config") if isinstance(checkpoint, dict) else None
    if not isinstance(config, dict) or not isinstance(checkpoint.get("model"), dict):
        raise InputRejected(f"'{path.name}' is not MoGe's", "a file with model_config and model", "check the name")
    version = "v2" if "neck" in config else "v1"
    try:
        network = _module(f"moge.model.{version}").MoGeModel(**config)
        report = network.load_state_dict(checkpoint["model"], strict=False)
    except (RuntimeError, TypeError, ValueError, KeyError) as error:
        reason = " ".join(str(error).split())[:200]
        raise InputRejected(
            f"'{path.name}' does not fit MoGe's network ({reason})", "weights of this version"
        ) from None
    # v1 keeps constants for its pictures among the tensors
    lacking = [k for k in report.missing_keys if "image_mean" not in k and "image_std" not in k]
    if lacking:
        raise InputRejected(f"'{path.name}' lacks {len(lacking)} tensors, such as {lacking[0]}", "whole weights")
    return network, version == "v2" and config.get("scale_head") is not None


def _file_of(weights: Path | str, allow_download: bool) -> Path:
    path = Path(weights)
    if path.is_dir():
        path = path / "model.pt"
    if path.is_file():
        return path
    if not allow_download:
        raise InputRejected(
            f"no file '{weights}'", "MoGe's model.pt, or a folder with it", "check it, or set depth.download=true"
        )
    from huggingface_hub import hf_hub_download

    try:
        return Path(hf_hub_download(repo_id=str(weights), filename="model.pt"))
    except (OSError, ValueError) as error:
        reason = " ".join(str(error).split())[:200]
        raise InputRejected(
            f"'{weights}' cannot be fetched ({reason})", "a name such as Ruicheng/moge-2-vits-normal"
        ) from None
