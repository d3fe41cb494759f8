"""RAFT through torchvision: the flow is torchvision's own, and every way in which its weights may be wrong is said."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import torch

from fluidlift.backends.torchvision_raft import LICENCE, TorchvisionRaft
from fluidlift.errors import InputRejected, MissingPackage


def quiet(line: str) -> None:
    """Nobody listens."""


@pytest.fixture(scope="module")
def models():
    try:
        import torchvision.models.optical_flow as models
    except (ImportError, RuntimeError, OSError) as error:
        pytest.skip(f"torchvision is not installed, or does not fit torch ({str(error).splitlines()[0]})")
    return models


@pytest.fixture(scope="module")
def small(models, tmp_path_factory):
    """RAFT small with random weights, and the file that holds them."""
    torch.manual_seed(0)
    network = models.raft_small(weights=None, progress=False).eval()
    path = tmp_path_factory.mktemp("weights") / "small.pth"
    torch.save(network.state_dict(), path)
    return network, path


def pictures(size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    first, second = (rng.integers(0, 256, (size[1], size[0], 3), dtype=np.uint8) for _ in range(2))
    return first, second


def test_the_flow_is_what_torchvision_itself_gives(small):
    network, path = small
    first, second = pictures((136, 128))
    flow = TorchvisionRaft(path, updates=3, announce=quiet).displacement(first, second)
    inputs = [torch.from_numpy(p).permute(2, 0, 1)[None].float() / 127.5 - 1 for p in (first, second)]
    with torch.inference_mode():
        expected = network(*inputs, num_flow_updates=3)[-1]
    np.testing.assert_array_equal(flow, expected[0].permute(1, 2, 0).numpy())
    assert np.abs(flow).max() > 0.01, "a test of nothing moves nothing"


def test_every_size_of_picture_comes_back_as_it_went_in(small):
    raft = TorchvisionRaft(small[1], updates=1, announce=quiet)
    for size in ((131, 139), (40, 17)):
        flow, trust = raft.estimate(*pictures(size))
        assert flow.shape == (size[1], size[0], 2) and flow.dtype == np.float32 and trust is None
    grey = pictures((40, 17))[0][..., 0]
    assert raft.displacement(grey, grey).shape == (17, 40, 2)


def test_wrong_weights_are_refused(models, small, tmp_path):
    state = small[0].state_dict()
    cases = {
        "names of the original RAFT": {"fnet.conv1.weight": torch.zeros(64, 3, 7, 7)},
        "no weights of torchvision's RAFT": {"a": torch.zeros(1)},
        "1 tensors lack": dict(list(state.items())[:-1]),
    }
    for reason, content in cases.items():
        torch.save(content, tmp_path / "w.pth")
        with pytest.raises(InputRejected, match=reason):
            TorchvisionRaft(tmp_path / "w.pth", announce=quiet)


def test_nothing_is_downloaded_unless_that_is_allowed(models):
    said = []
    with pytest.raises(InputRejected, match="allow the download"):
        TorchvisionRaft(announce=said.append)
    assert said == []


def test_the_licence_is_named_before_the_weights_are_read(models, tmp_path):
    said = []
    with pytest.raises(InputRejected, match="no file"):
        TorchvisionRaft(tmp_path / "none.pth", announce=said.append)
    assert said == [LICENCE] and "unclear for commercial use" in LICENCE


def test_without_torchvision_the_message_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "torchvision", None)
    monkeypatch.delitem(sys.modules, "torchvision.models.optical_flow", raising=False)
    with pytest.raises(MissingPackage, match=r"fluidlift\[learned\]"):
        TorchvisionRaft("any.pth", announce=quiet)


def test_a_torchvision_built_for_another_torch_is_said_to_be(monkeypatch, tmp_path):
    """What the build for CUDA does beside a torch for the CPU: it raises while it is imported."""
    for name in [n for n in sys.modules if n.partition(".")[0] == "torchvision"]:
        monkeypatch.delitem(sys.modules, name)
    (tmp_path / "torchvision").mkdir()
    (tmp_path / "torchvision" / "__init__.py").write_text(
        "raise RuntimeError('operator torchvision::nms does not exist')"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(MissingPackage, match="does not fit the installed torch"):
        TorchvisionRaft("any.pth", announce=quiet)
