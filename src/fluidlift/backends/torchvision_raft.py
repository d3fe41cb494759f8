"""Flow by RAFT (Teed and Deng 2020) as torchvision has it, with weights that the user gives or allows to download."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.backends.model_weights import Announce, fill_network, missing, read_state_dict, say
from fluidlift.backends.pair_network import memory_errors, padded_pair, require_memory, torch_device
from fluidlift.errors import InputRejected, MissingPackage, require
from fluidlift.seams import FlowEstimator

LICENCE = (
    "RAFT: the code is BSD-3 (torchvision). The weights' licence is unclear for commercial use: they were trained on "
    "research data sets, and the question was never answered. Take them for research, or ask a lawyer."
)
_STEM = "feature_encoder.convnormrelu.0.weight"
_CHANNELS = {64: "raft_large", 32: "raft_small"}
"""width of the first convolution, by which a file says which network it is for"""


class TorchvisionRaft(FlowEstimator):
    """RAFT, large or small: which one, the weights say.

    Args:
        weights: file of torchvision's weights (.pth or .safetensors); None: download them.
        updates: iterations of the network; 12 is what it was trained with.
        device: "cpu", "cuda", "cuda:1"...
        allow_download: whether torchvision's own weights may be fetched (20 MB, into torch's cache).
        announce: is told the licence before the weights are touched.
        max_bytes: memory of the correlation.

    Raises:
        MissingPackage: torchvision is missing or does not fit torch.
        InputRejected: no weights, or weights of another network.
        FluidliftError: no such device.
    """

    def __init__(
        self,
        weights: Path | str | None = None,
        *,
        updates: int = 12,
        device: str = "cpu",
        allow_download: bool = False,
        announce: Announce = say,
        max_bytes: int = 4 * 2**30,
    ) -> None:
        require(updates >= 1, f"{updates} updates", "at least 1")
        models = _models()
        if weights is None and not allow_download:
            raise InputRejected(
                "no weights for RAFT", "a file of torchvision's weights, such as raft_large_C_T_SKHT_V2-ff5fadd5.pth",
                "name it, or allow the download",
            )  # fmt: skip
        announce(LICENCE)
        path = _downloaded(models) if weights is None else Path(weights)
        state = read_state_dict(path, purpose="weights of torchvision's RAFT")
        width = len(state[_STEM]) if _STEM in state else 0
        if width not in _CHANNELS:
            other = " (these are the names of the original RAFT)" if "fnet.conv1.weight" in state else ""
            raise InputRejected(
                f"'{path.name}' holds no weights of torchvision's RAFT{other}",
                "raft_large or raft_small by torchvision",
            )
        network = getattr(models, _CHANNELS[width])(weights=None, progress=False)
        fill_network(network, state, path.name)
        self._device = torch_device(device)
        self._network = network.eval().to(self._device)
        self._updates, self._max_bytes = updates, max_bytes

    def displacement(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """float32 [H,W,2], px: where each pixel of `first` (u8 [H,W,3] or grey [H,W]) went in `second`.

        Raises:
            InputRejected: pictures that would take more than `max_bytes`.
            FluidliftError: memory ran out.
        """
        import torch

        require_memory((first.shape[1], first.shape[0]), self._max_bytes)
        with torch.inference_mode(), memory_errors(self._device):
            pair = padded_pair(first, second, self._device)
            flow = self._network(pair.first, pair.second, num_flow_updates=self._updates)[-1]
            return flow[0, :, pair.rows, pair.columns].permute(1, 2, 0).float().cpu().numpy()


def _models() -> Any:
    try:
        import torchvision.models.optical_flow as models  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError:
        raise missing("torchvision", "for the flow method raft") from None
    except (ImportError, RuntimeError, OSError) as error:  # built for another torch, such as CUDA's beside the CPU's
        reason = str(error).partition("\n")[0]
        raise MissingPackage(
            f"torchvision does not fit the installed torch ({reason}). Needed: the build of the same version and kind. "
            "Do: install both from the same place, or choose dis."
        ) from None
    return models


def _downloaded(models: Any) -> Path:
    """torchvision's default weights of the large network in torch's cache, checked against the hash in their name."""
    import torch

    url = models.Raft_Large_Weights.DEFAULT.url
    path = Path(torch.hub.get_dir()) / "checkpoints" / url.rpartition("/")[2]
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            torch.hub.download_url_to_file(url, str(path), path.stem.rpartition("-")[2], progress=False)
        except (OSError, RuntimeError) as error:
            raise InputRejected(
                f"the weights could not be downloaded ({error})", "a connection to torchvision's server",
                f"fetch {url} yourself and name the file",
            ) from None  # fmt: skip
    return path
