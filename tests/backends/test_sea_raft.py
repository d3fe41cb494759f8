"""SEA-RAFT takes its authors' checkpoints and nothing else, and treats every part of a picture alike."""

from __future__ import annotations

import os

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from fluidlift.backends.pair_network import LEAST, padded_pair, require_memory, torch_device
from fluidlift.backends.sea_raft import LICENCE, SeaRaft
from fluidlift.backends.sea_raft_network import (
    CorrelationPyramid,
    SeaRaftNetwork,
    SeaRaftShape,
    mixture_confidence,
    upsampled,
)
from fluidlift.errors import FluidliftError, InputRejected

SMALL = SeaRaftShape(blocks=(2, 2, 2), stem=8, stages=(8, 12, 16), width=8, radius=2, refiners=2)
CPU = torch.device("cpu")


def quiet(line: str) -> None:
    """Nobody listens."""


def random_network(seed: int = 0) -> SeaRaftNetwork:
    """A small network whose statistics are like those of a trained one: every part counts in the result."""
    torch.manual_seed(seed)
    network = SeaRaftNetwork(SMALL)
    for part in network.modules():
        if isinstance(part, torch.nn.BatchNorm2d):
            part.running_mean.normal_(0, 0.2)
            part.running_var.uniform_(0.5, 2)
    for block in network.update_block.refine:
        block.gamma.data.uniform_(0.1, 1)
    network.flow_head[2].weight.data *= 10
    return network.eval()


def pictures(size: tuple[int, int] = (160, 136), seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Two noise pictures, u8 [H,W,3]; size is width, height."""
    rng = np.random.default_rng(seed)
    first, second = (rng.integers(0, 256, (size[1], size[0], 3), dtype=np.uint8) for _ in range(2))
    return first, second


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "small.pth"
    torch.save(random_network().state_dict(), path)
    return path


def test_names_and_sizes_are_those_of_the_published_variants():
    """M has a ResNet-34, S a ResNet-18, else they are alike; millions of parameters of the reference network."""
    for blocks, millions in (((3, 4, 6), 19.7), ((2, 2, 2), 8.9)):
        with torch.device("meta"):
            network = SeaRaftNetwork(SeaRaftShape(blocks=blocks))
        state = network.state_dict()
        assert state["cnet.conv1.weight"].shape == (64, 6, 7, 7)
        assert state["fnet.layer2.0.downsample.1.running_var"].shape == state["fnet.layer2.0.bn3.bias"].shape == (128,)
        assert state["update_block.encoder.convc1.weight"].shape == (256, 324, 1, 1)
        assert state["update_block.refine.1.pwconv2.weight"].shape == (384, 512)
        assert state["upsample_weight.2.bias"].shape == (576,) and state["flow_head.2.weight"].shape == (6, 256, 3, 3)
        assert f"fnet.layer3.{blocks[2] - 1}.bn2.num_batches_tracked" in state
        assert SeaRaftShape.of(state, "it") == SeaRaftShape(blocks=blocks)
        assert round(sum(p.numel() for p in network.parameters()) / 1e6, 1) == millions


@pytest.mark.parametrize("wrapped", ["plain", "training script", "safetensors"])
def test_a_checkpoint_gives_the_network_that_was_saved(tmp_path, wrapped):
    network = random_network()
    state = network.state_dict()
    path = tmp_path / ("w.safetensors" if wrapped == "safetensors" else "w.pth")
    if wrapped == "safetensors":
        save = pytest.importorskip("safetensors.torch", reason="safetensors is not installed").save_model
        save(network, str(path))  # stores what two names share once, as the model hub does
    elif wrapped == "plain":
        torch.save(state, path)
    else:
        torch.save({"state_dict": {f"module.{k}": v for k, v in state.items()}, "step": 5}, path)
    first, second = pictures()
    flow, trust = SeaRaft(path, iterations=2, announce=quiet).estimate(first, second)
    pair = padded_pair(first, second, CPU)
    with torch.inference_mode():
        expected, mixture = network(pair.first, pair.second, 2)
    np.testing.assert_array_equal(flow, expected[0].permute(1, 2, 0).numpy())
    np.testing.assert_array_equal(trust, mixture_confidence(mixture)[0].numpy())
    assert np.abs(flow).max() > 0.1, "a test of nothing moves nothing"


def test_every_size_of_picture_comes_back_as_it_went_in(checkpoint):
    network = SeaRaft(checkpoint, iterations=1, announce=quiet)
    for size in ((160, 136), (133, 141), (40, 17)):
        first, second = pictures(size)
        flow, trust = network.estimate(first, second)
        assert flow.shape == (size[1], size[0], 2) and flow.dtype == np.float32
        assert trust.shape == flow.shape[:2] and (trust >= 0).all() and (trust <= 1).all()
        np.testing.assert_array_equal(network.displacement(first, second), flow)


def test_padding_is_what_the_border_repeated_by_hand_gives(checkpoint):
    network = SeaRaft(checkpoint, iterations=2, announce=quiet)
    first, second = pictures((157, 131))
    edges = ((2, 3), (1, 2), (0, 0))  # to 160 x 136; the larger half goes to the right and below
    flow = network.displacement(first, second)
    whole = network.displacement(np.pad(first, edges, mode="edge"), np.pad(second, edges, mode="edge"))
    np.testing.assert_array_equal(flow, whole[2:-3, 1:-2])


def test_a_shift_of_whole_cells_shifts_the_flow_with_it():
    """Away from the border, which a convolution sees, nothing depends on where in the picture a thing is."""
    network = random_network()
    rng = np.random.default_rng(3)
    wide = rng.integers(0, 256, (2, 128, 448, 3), dtype=np.uint8)
    with torch.inference_mode():
        (a, _), (b, _) = (
            network(*padded_pair(wide[0, :, s : s + 416], wide[1, :, s : s + 416], CPU)[:2], 0) for s in (0, 32)
        )
    middle = slice(192, 224)  # the receptive field of the encoder and the head is below 190 px to each side
    torch.testing.assert_close(a[..., 32:][..., middle], b[..., : 416 - 32][..., middle], rtol=0, atol=1e-4)  # float32


def test_correlation_at_the_true_place_is_the_scalar_product():
    """A plain twin: four levels of averaged features, looked up one by one."""
    torch.manual_seed(0)
    first, second = torch.randn(2, 5, 16, 24), torch.randn(2, 5, 16, 24)
    rows, columns = torch.meshgrid(torch.arange(16.0), torch.arange(24.0), indexing="ij")
    target = torch.stack([columns, rows])[None].repeat(2, 1, 1, 1)
    found = CorrelationPyramid(first, second, 1).around(target)
    assert found.shape == (2, 4 * 9, 16, 24)
    for level in range(4):
        coarse = second
        for _ in range(level):
            coarse = F.avg_pool2d(coarse, 2)
        y, x = 8, 16  # a multiple of all cell widths: no interpolation on any level
        for k, (dx, dy) in enumerate((i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)):
            at = y // 2**level + dy, x // 2**level + dx
            inside = 0 <= at[0] < coarse.shape[2] and 0 <= at[1] < coarse.shape[3]
            value = (first[:, :, y, x] * coarse[:, :, at[0], at[1]]).sum(dim=1) / 5**0.5 if inside else torch.zeros(2)
            torch.testing.assert_close(found[:, 9 * level + k, y, x], value, rtol=1e-4, atol=1e-4)  # float32 products


def test_upsampling_of_a_constant_is_that_constant_away_from_the_border():
    torch.manual_seed(0)
    fine = upsampled(torch.full((1, 2, 6, 7), 3.0), torch.randn(1, 9 * 64, 6, 7))
    assert fine.shape == (1, 2, 48, 56)
    torch.testing.assert_close(fine[..., 8:-8, 8:-8], torch.full((1, 2, 32, 40), 3.0))
    assert (fine <= 3.0 + 1e-5).all() and fine[..., :8, :].min() < 3.0, "cells beyond the border count as 0, as trained"


def test_confidence_is_the_share_of_the_narrow_component():
    raw = torch.tensor([[0.0, 100.0, 5.0, 0.0], [100.0, 0.0, 3.0, 0.0], [100.0, 0.0, 50.0, 0.0], [0.0, 0.0, 1.0, -3.0]])
    trust = mixture_confidence(raw[:, :, None, None])[:, 0, 0]
    expected = [1.0, np.exp(-3), np.exp(-10), 0.5 + 0.5 * np.exp(-1)]  # scales above e^10 px were never trained
    np.testing.assert_allclose(trust, expected, rtol=1e-5)  # float32


def test_a_checkpoint_with_code_in_it_is_refused_and_not_run(tmp_path):
    mark = tmp_path / "ran"

    class Hostile:
        def __reduce__(self):
            return os.mkdir, (str(mark),)

    torch.save({"fnet.conv1.weight": Hostile()}, tmp_path / "bad.pth")
    with pytest.raises(InputRejected, match="could run code"):
        SeaRaft(tmp_path / "bad.pth", announce=quiet)
    assert not mark.exists()


def test_wrong_and_damaged_checkpoints_are_refused(tmp_path, checkpoint):
    state = torch.load(checkpoint, weights_only=True)
    cases = {
        "holds no weights of SEA-RAFT": {"feature_encoder.convnormrelu.0.weight": torch.zeros(64, 3, 7, 7)},
        "1 tensors lack, 0 are unknown": {k: v for k, v in state.items() if k != "init_conv.bias"},
        "1 are unknown": state | {"extra": torch.zeros(1)},
        r"\[4\] instead of \[16\]": state | {"init_conv.bias": torch.zeros(4)},
        "variant of SEA-RAFT that is not known": {k: v for k, v in state.items() if ".layer1.1." not in k},
        "no named tensors": {"fnet.conv1.weight": 3},
    }
    for reason, content in cases.items():
        torch.save(content, tmp_path / "w.pth")
        with pytest.raises(InputRejected, match=reason):
            SeaRaft(tmp_path / "w.pth", announce=quiet)
    (tmp_path / "cut.pth").write_bytes(checkpoint.read_bytes()[:2000])
    (tmp_path / "cut.safetensors").write_bytes(b"\x10")
    with pytest.raises(InputRejected, match="damaged"):
        SeaRaft(tmp_path / "cut.pth", announce=quiet)
    with pytest.raises(InputRejected, match="no file"):
        SeaRaft(tmp_path / "none.pth", announce=quiet)
    pytest.importorskip("safetensors", reason="safetensors is not installed")
    with pytest.raises(InputRejected, match="damaged"):
        SeaRaft(tmp_path / "cut.safetensors", announce=quiet)


def test_the_licence_is_named_before_the_weights_are_read(tmp_path, checkpoint):
    said = []
    with pytest.raises(InputRejected):
        SeaRaft(tmp_path / "none.pth", announce=said.append)
    assert said == [LICENCE] and "BSD-3" in LICENCE and "research" in LICENCE


def test_pictures_beyond_the_memory_are_refused_with_the_way_out(checkpoint):
    network = SeaRaft(checkpoint, announce=quiet, max_bytes=10**6)
    with pytest.raises(InputRejected, match=r"1920 x 1080.*read\.max_size"):
        network.displacement(*pictures((1920, 1080)))
    require_memory((512, 288), 4 * 2**30)
    assert LEAST == 128


def test_a_gpu_that_is_not_there_is_said_to_be(checkpoint):
    if not torch.cuda.is_available():
        with pytest.raises(FluidliftError, match="torch sees 0 GPU"):
            SeaRaft(checkpoint, device="cuda", announce=quiet)
    with pytest.raises(ValueError, match="device 'tpu'"):
        torch_device("tpu")


def test_pictures_of_unlike_size_are_a_mistake(checkpoint):
    first, second = pictures()
    network = SeaRaft(checkpoint, announce=quiet)
    with pytest.raises(ValueError, match="the same size"):
        network.displacement(first, second[:-1])
    with pytest.raises(ValueError, match="u8"):
        network.displacement(first / 255, second / 255)
