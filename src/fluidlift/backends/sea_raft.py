"""Flow by SEA-RAFT (Wang, Lipson, Deng 2024) with a checkpoint of its authors, which the user gives."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fluidlift.backends.model_weights import Announce, fill_network, read_state_dict, say
from fluidlift.backends.pair_network import memory_errors, padded_pair, require_memory, torch_device
from fluidlift.errors import require
from fluidlift.seams import FlowEstimator

LICENCE = (
    "SEA-RAFT: the authors' code is BSD-3, and the same is assumed for their weights. Those were trained on data sets "
    "some of which are for research only: take them for research, or ask a lawyer."
)


class SeaRaft(FlowEstimator):
    """SEA-RAFT: S, M or L, which the checkpoint says.

    Args:
        weights: checkpoint of the authors, .pth or .safetensors.
        iterations: refinements; the authors use 4 for S and M. L is M with 12.
        device: "cpu", "cuda", "cuda:1"...
        announce: is told the licence before the weights are touched.
        max_bytes: memory of the correlation.

    Raises:
        InputRejected: no such file, or weights of another network.
        FluidliftError: no such device.
    """

    def __init__(
        self,
        weights: Path | str,
        *,
        iterations: int = 4,
        device: str = "cpu",
        announce: Announce = say,
        max_bytes: int = 4 * 2**30,
    ) -> None:
        from fluidlift.backends.sea_raft_network import SeaRaftNetwork, SeaRaftShape, completed_state

        require(iterations >= 0, f"{iterations} iterations", "0 or more")
        announce(LICENCE)
        path = Path(weights)
        state = completed_state(read_state_dict(path, purpose="weights of SEA-RAFT"))
        network = SeaRaftNetwork(SeaRaftShape.of(state, path.name))
        fill_network(network, state, path.name, "a checkpoint of its authors")
        self._device = torch_device(device)
        self._network = network.eval().to(self._device)
        self._iterations, self._max_bytes = iterations, max_bytes

    def displacement(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """float32 [H,W,2], px: where each pixel of `first` (u8 [H,W,3] or grey [H,W]) went in `second`."""
        return self.estimate(first, second)[0]

    def estimate(self, first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The displacement, and the network's own trust in it (`sea_raft_network.mixture_confidence`).

        Raises:
            InputRejected: pictures that would take more than `max_bytes`.
            FluidliftError: memory ran out.
        """
        import torch

        from fluidlift.backends.sea_raft_network import mixture_confidence

        require_memory((first.shape[1], first.shape[0]), self._max_bytes)
        with torch.inference_mode(), memory_errors(self._device):
            pair = padded_pair(first, second, self._device)
            flow, mixture = self._network(pair.first, pair.second, self._iterations)
            inside = (slice(None), pair.rows, pair.columns)
            trust = mixture_confidence(mixture)[0][inside[1:]].float().cpu().numpy()
            return flow[0][inside].permute(1, 2, 0).float().cpu().numpy(), trust
