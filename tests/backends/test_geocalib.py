"""GeoCalib takes its authors' checkpoint and nothing else, and says what its field means for our camera."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fluidlift.backends import geocalib_network
from fluidlift.backends.geocalib import FILE, LICENCE, LONGEST, PITCH_ERROR, SHORTER, GeoCalib
from fluidlift.backends.geocalib_network import (
    RANK,
    ROUNDS,
    GeoCalibNetwork,
    GeoCalibShape,
    completed_state,
    factorised,
)
from fluidlift.backends.model_table import model_of
from fluidlift.backends.perspective_field import field_of_camera
from fluidlift.backends.registry import ModelChoice
from fluidlift.backends.view_model import VIEW_MODELS, make_view_estimator
from fluidlift.errors import InputRejected
from fluidlift.types import PinholeCamera

SMALL = GeoCalibShape((8, 8, 12, 16), (1, 1, 2, 1), (16, 16, 24, 32), 8, 16)


def quiet(line: str) -> None:
    """Nobody listens."""


def random_network(seed: int = 0) -> GeoCalibNetwork:
    torch.manual_seed(seed)
    network = GeoCalibNetwork(SMALL)
    for part in network.modules():
        if isinstance(part, torch.nn.BatchNorm2d):
            part.running_mean.normal_(0, 0.2)
            part.running_var.uniform_(0.5, 2)
    return network.eval()


def picture(height: int = 90, width: int = 160) -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, (height, width, 3), dtype=np.uint8)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    """As the authors save theirs: the tensors under "model"."""
    folder = tmp_path_factory.mktemp("weights")
    torch.save({"model": random_network().state_dict()}, folder / FILE)
    return folder / FILE


def test_names_and_sizes_are_those_of_the_published_checkpoint():
    with torch.device("meta"):
        state = GeoCalibNetwork().state_dict()
    assert len(state) == 889  # tensors of the published file, as its users report
    assert GeoCalibShape.of(state, "it") == GeoCalibShape()
    assert state["backbone.block3.11.attn.spatial_gating_unit.conv2_1.weight"].shape == (320, 1, 1, 21)
    assert state["perspective_decoder.latitude_head.decoder.squeeze.conv.weight"].shape == (512, 1024, 1, 1)
    tensors = sum(t.numel() * t.element_size() for t in state.values())
    published = model_of("geocalib").bytes
    assert published is not None
    assert 0 < published - tensors < 889 * 400  # what a zip archive says of each of its files


@pytest.mark.parametrize("kind", ["file", "folder", "plain", "safetensors"])
def test_a_checkpoint_gives_the_network_that_was_saved(checkpoint, tmp_path, kind):
    state = random_network().state_dict()
    path = {"file": checkpoint, "folder": checkpoint.parent}.get(kind, tmp_path / f"w.{kind}")
    if kind == "plain":
        torch.save({k: v for k, v in state.items() if not k.endswith("num_batches_tracked")}, path)
    if kind == "safetensors":
        pytest.importorskip("safetensors.torch", reason="safetensors is not installed").save_file(state, path)
    told: list[str] = []
    field, scale = GeoCalib(path, announce=told.append).field(picture())
    assert told == [LICENCE] and scale == pytest.approx(SHORTER / 90)
    assert field.latitude.shape == (320, 544)  # 569 px wide, cut to a multiple of 32
    pixels = torch.from_numpy(picture()).permute(2, 0, 1)[None].float() / 255.0
    pixels = torch.nn.functional.interpolate(pixels, (320, 569), mode="bilinear", antialias=True).clamp(0, 1)
    with torch.inference_mode():
        wanted = random_network()(pixels[..., 12:556])
    np.testing.assert_allclose(field.up.transpose(2, 0, 1), wanted[0][0].numpy(), atol=1e-5)  # single precision
    np.testing.assert_allclose(field.latitude, wanted[2][0].numpy(), atol=1e-5)
    assert (np.abs(np.linalg.norm(field.up, axis=-1) - 1.0) < 1e-4).all() and (np.abs(field.latitude) <= 1).all()
    assert (field.up_trust > 0).all() and (field.up_trust < 1).all()


def test_the_same_picture_gives_the_same_answer(checkpoint):
    """The authors draw the bases of their factorisation anew each time; an asset must not depend on a draw."""
    model = GeoCalib(checkpoint, announce=quiet)
    torch.manual_seed(1)
    first = model.field(picture())[0]
    torch.manual_seed(2)
    np.testing.assert_array_equal(first.latitude, model.field(picture())[0].latitude)


def test_features_become_a_product_of_few_non_negative_bases(monkeypatch):
    """Multiplicative updates never raise the error (Lee and Seung 2001): of four parts it goes to none."""
    rng = np.random.default_rng(0)
    parts = torch.from_numpy(rng.random((1, 96, 4)) @ rng.random((1, 4, 300))).float().reshape(1, 96, 15, 20)
    off = []
    for rounds in (0, 1, ROUNDS, 50, 500):
        monkeypatch.setattr(geocalib_network, "ROUNDS", rounds)
        found = factorised(parts)
        assert (found >= 0).all()
        off.append(float((found - parts).norm() / parts.norm()))
    assert off == sorted(off, reverse=True) and off[-1] < 0.1 * off[2] < 0.1 * off[0]
    columns = found.reshape(96, 300).numpy()
    assert np.linalg.matrix_rank(columns, tol=1e-3 * np.linalg.norm(columns)) <= RANK


@pytest.mark.parametrize("damage", ["lacking", "unknown", "shape", "other", "cut", "code", "deep"])
def test_other_files_are_refused(tmp_path, damage):
    state = random_network().state_dict()
    path = tmp_path / FILE
    says = "does not fit the network"
    if damage == "lacking":
        del state["ll_enc.conv2.conv.bias"]
    elif damage == "unknown":
        state["more"] = torch.ones(1)
    elif damage == "shape":
        state["perspective_decoder.up_head.linear_pred_up.bias"] = torch.ones(3)
    elif damage == "other":
        state, says = {"fnet.conv1.weight": torch.ones(3)}, "holds no weights of GeoCalib"
    elif damage == "deep":
        state["backbone.norm2.weight"], says = torch.ones(100_000), "variant of GeoCalib that is not known"
    torch.save({"model": state} if damage != "code" else {"model": state, "run": print}, path)
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:5000])
    says = {"cut": "is damaged", "code": "could run code"}.get(damage, says)
    with pytest.raises(InputRejected, match=says):
        GeoCalib(path, announce=quiet)


def test_what_it_needs_is_said():
    assert VIEW_MODELS == ("geocalib",)
    with pytest.raises(InputRejected, match="no weights"):
        make_view_estimator("geocalib", ModelChoice(announce=quiet))
    with pytest.raises(InputRejected, match="no file"):
        make_view_estimator("geocalib", ModelChoice("nowhere.tar", announce=quiet))
    with pytest.raises(ValueError, match="geocalib"):
        make_view_estimator("other", ModelChoice("w"))


class Seen:
    """In place of the network: the field of a camera of known tilt, for a picture whose whole height is `height` px."""

    def __init__(self, pitch: float, roll: float, focal_over_side: float) -> None:
        self.pitch, self.roll, self.focal = pitch, roll, focal_over_side

    def __call__(self, image):
        height, width = image.shape[-2:]
        assert height % 32 == 0 and width % 32 == 0 and max(height, width) <= LONGEST
        field = field_of_camera(self.pitch, self.roll, self.focal * SHORTER, (width, height))
        up = torch.from_numpy(field.up.transpose(2, 0, 1))[None]
        trust = torch.ones(1, height, width, dtype=torch.float64)
        return up, trust, torch.from_numpy(field.latitude)[None], trust


@pytest.mark.parametrize(("height", "width"), [(90, 160), (333, 201), (720, 1280), (64, 900), (32, 32)])
def test_a_camera_that_looks_down_and_one_that_is_turned(checkpoint, height, width):
    """Focal length in px of the picture as it came, also where it was scaled and cut."""
    model = GeoCalib(checkpoint, announce=quiet)
    for pitch, roll in ((28.0, 0.0), (5.0, 7.0)):
        model._network = Seen(pitch, roll, 1.3)
        found = model.guess(picture(height, width), None)
        assert found is not None
        assert (found.pitch, found.roll) == pytest.approx((pitch, roll), abs=0.05)
        assert found.focal == pytest.approx(1.3 * min(height, width), rel=2e-3)
        assert PITCH_ERROR <= found.pitch_error < 2 * PITCH_ERROR and 0.1 < found.focal_error < 0.5


def test_a_known_lens_is_told_to_the_fit(checkpoint):
    model = GeoCalib(checkpoint, announce=quiet)
    model._network = Seen(28.0, 0.0, 1.3)
    lens = PinholeCamera((260.0, 260.0), (160.0, 90.0), (320, 180))  # of the picture at twice its size
    found = model.guess(picture(), lens)
    assert found is not None and found.focal == pytest.approx(130.0) and found.focal_error == 0.0
    assert found.pitch == pytest.approx(28.0, abs=4.0) and found.pitch_by_focal == 0.0


def test_a_network_that_sees_nothing_gives_no_answer(checkpoint):
    model = GeoCalib(checkpoint, announce=quiet)

    def blank(image):
        height, width = image.shape[-2:]
        nothing = torch.zeros(1, height, width)
        return torch.zeros(1, 2, height, width), nothing, nothing, nothing

    model._network = blank
    assert model.guess(picture(), None) is None


def test_counters_of_batches_may_lack():
    network = random_network()
    state = {k: v for k, v in network.state_dict().items() if not k.endswith("num_batches_tracked")}
    assert completed_state(state, network).keys() == network.state_dict().keys()
