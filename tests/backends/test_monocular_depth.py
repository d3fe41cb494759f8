"""Learned depth: pictures go in as the models expect, and numbers come out with what they mean."""

from __future__ import annotations

import sys
import types

import numpy as np
import pytest
import torch

from fluidlift.backends.depth_pictures import longer_field_of_view, multiple_near
from fluidlift.backends.monocular_depth import DEPTH_MODELS, make_depth_estimator
from fluidlift.backends.registry import ModelChoice
from fluidlift.errors import InputRejected, MissingPackage
from fluidlift.types import PinholeCamera

H, W = 40, 60


def quiet(line: str) -> None:
    """Nobody listens."""


def picture(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (H, W, 3), dtype=np.uint8)


def model_of(name, weights, **options):
    return make_depth_estimator(name, ModelChoice(weights, announce=quiet, **options))


def saved_depth_anything(transformers, folder, **options):
    """Depth Anything with random weights and few channels, in a folder."""
    torch.manual_seed(0)
    backbone = transformers.Dinov2Config(
        hidden_size=16, num_attention_heads=2, num_hidden_layers=4, image_size=56, patch_size=14, mlp_ratio=2,
        out_indices=[1, 2, 3, 4], reshape_hidden_states=False,
    )  # fmt: skip
    config = transformers.DepthAnythingConfig(
        backbone_config=backbone, patch_size=14, reassemble_hidden_size=16, neck_hidden_sizes=[8, 8, 8, 8],
        fusion_hidden_size=8, head_hidden_size=8, **options,
    )  # fmt: skip
    model = transformers.DepthAnythingForDepthEstimation(config).eval()
    model.head.conv3.bias.data.fill_(1.0)  # random weights may give 0 everywhere: the last layer cuts there
    model.save_pretrained(folder)
    return model


@pytest.fixture(scope="module")
def depth_pro(transformers, tmp_path_factory):
    """Depth Pro with random weights and few channels, and its folder."""
    torch.manual_seed(1)
    inner = {"model_type": "dinov2", "hidden_size": 16, "num_attention_heads": 2, "num_hidden_layers": 2,
             "image_size": 32, "patch_size": 8, "mlp_ratio": 2}  # fmt: skip
    config = transformers.DepthProConfig(
        patch_size=32, fusion_hidden_size=8, intermediate_hook_ids=[1, 0], intermediate_feature_dims=[8, 8],
        scaled_images_feature_dims=[8, 8, 8], image_model_config=inner, patch_model_config=inner,
        fov_model_config=inner, use_fov_model=True, num_fov_head_layers=1, merge_padding_value=1,
    )  # fmt: skip
    model = transformers.DepthProForDepthEstimation(config).eval()
    model.head.layers[-2].bias.data.fill_(0.5)  # so that inverse depth is positive
    model.fov_model.head.layers[-1].bias.data.fill_(55.0)  # degrees, as a trained one would say
    folder = tmp_path_factory.mktemp("depth_pro")
    model.save_pretrained(folder)
    return model, folder


@pytest.mark.parametrize("name", DEPTH_MODELS)
def test_without_weights_every_model_says_what_it_needs(name):
    with pytest.raises(InputRejected, match="no weights"):
        make_depth_estimator(name, ModelChoice(announce=quiet))


def test_other_names_are_a_mistake():
    with pytest.raises(ValueError, match="moge, moge-onnx, depth-anything"):
        make_depth_estimator("midas", ModelChoice("w"))


def test_sides_of_the_picture():
    assert multiple_near(517.0, 14) == 518 and multiple_near(3.0, 14) == 14
    # twice as wide as high: the tangent of half the angle goes with the length
    upright = longer_field_of_view(40.0, (200, 100))
    assert np.tan(np.radians(upright / 2)) == pytest.approx(2 * np.tan(np.radians(20.0)))
    assert longer_field_of_view(40.0, (100, 200)) == 40.0


# Depth Anything --------------------------------------------------------------------------------------------------


def test_depth_anything_gives_what_its_network_gives(transformers, tmp_path):
    network = saved_depth_anything(transformers, tmp_path)
    found = model_of("depth-anything", tmp_path).guess(picture(), None)
    assert found.holds == "disparity" and found.field_of_view is None
    assert found.values.shape == (H, W) and found.values.dtype == np.float32
    # the shorter side becomes 518 px, both multiples of 14; then as transformers does it
    pixels = torch.from_numpy(picture()).permute(2, 0, 1)[None].float() / 255.0
    pixels = torch.nn.functional.interpolate(pixels, (518, 770), mode="bicubic", antialias=True).clamp(0, 1)
    mean = torch.tensor([0.485, 0.456, 0.406]).view(1, 3, 1, 1)
    spread = torch.tensor([0.229, 0.224, 0.225]).view(1, 3, 1, 1)
    with torch.inference_mode():
        wanted = network(pixel_values=(pixels - mean) / spread).predicted_depth
    wanted = torch.nn.functional.interpolate(wanted[None], (H, W), mode="bilinear")[0, 0].numpy()
    np.testing.assert_allclose(found.values, wanted, rtol=1e-4, atol=1e-5)  # single precision


def test_the_metric_variant_says_metres(transformers, tmp_path):
    saved_depth_anything(transformers, tmp_path, depth_estimation_type="metric", max_depth=20)
    found = model_of("depth-anything", tmp_path).guess(picture(), None)
    assert found.holds == "metres"
    assert 0 < np.nanmin(found.values) and np.nanmax(found.values) <= 20.0  # its sigmoid times 20 m


def test_weights_of_another_model_are_refused(transformers, tmp_path):
    saved_depth_anything(transformers, tmp_path)
    with pytest.raises(InputRejected, match="type depth_anything"):
        model_of("depth-pro", tmp_path)
    with pytest.raises(InputRejected, match="no folder"):
        model_of("depth-anything", tmp_path / "nothing")


# Depth Pro -------------------------------------------------------------------------------------------------------


def test_depth_pro_gives_metres_as_transformers_own_code_does(transformers, depth_pro):
    network, folder = depth_pro
    model = model_of("depth-pro", folder)
    assert model.side == 128  # 32 px patches at a quarter of the picture
    found = model.guess(picture(), None)
    pixels = torch.from_numpy(picture()).permute(2, 0, 1)[None].float() / 255.0
    pixels = torch.nn.functional.interpolate(pixels, (128, 128), mode="bilinear", antialias=True)
    with torch.inference_mode():
        out = network(pixel_values=(pixels - 0.5) / 0.5)
    degrees = float(out.field_of_view[0])
    inverse = torch.nn.functional.interpolate(out.predicted_depth[None], (H, W), mode="bilinear")[0, 0].numpy()
    with np.errstate(divide="ignore"):
        wanted = 1.0 / (inverse * 2 * np.tan(np.radians(degrees / 2)))
    assert found.holds == "metres" and found.field_of_view == pytest.approx(degrees, rel=1e-5)
    seen = inverse > 1e-3  # what is at infinity has no depth; near that, rounding counts
    assert seen.mean() > 0.3
    np.testing.assert_allclose(found.values[seen], wanted[seen], rtol=1e-3)  # interpolated in single precision


def test_a_camera_that_is_known_sets_depth_pros_metres(depth_pro):
    model = model_of("depth-pro", depth_pro[1])
    near = model.guess(picture(), PinholeCamera.from_fov(60.0, (W, H)))
    far = model.guess(picture(), PinholeCamera.from_fov(30.0, (W, H)))
    ratio = np.tan(np.radians(30.0)) / np.tan(np.radians(15.0))
    both = np.isfinite(far.values) & np.isfinite(near.values)
    assert both.mean() > 0.3
    np.testing.assert_allclose((far.values / near.values)[both], ratio, rtol=1e-5)  # a narrower view: farther away


# MoGe: a package that is not installed here; its stand-in has the same interface ----------------------------------


class StandIn(torch.nn.Module):
    """Looks like `moge.model.v2.MoGeModel`: built from its description, `infer` answers with a plane."""

    def __init__(self, neck=None, scale_head=None, **more):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(3))

    def infer(self, image, *, fov_x=None, use_fp16=True):
        assert image.shape == (3, H, W) and 0 <= float(image.min()) and float(image.max()) <= 1
        assert not use_fp16  # half precision is for GPUs
        fov = 50.0 if fov_x is None else fov_x
        focal = 0.5 / np.tan(np.radians(fov) / 2)
        depth = torch.linspace(4.0, 2.0, H)[:, None].repeat(1, W)
        depth[:5] = torch.inf  # the sky
        return {"depth": depth, "intrinsics": torch.tensor([[focal, 0, 0.5], [0, focal * W / H, 0.5], [0, 0, 1.0]])}


@pytest.fixture
def moge(monkeypatch):
    package, model = types.ModuleType("moge"), types.ModuleType("moge.model")
    package.__path__, model.__path__ = [], []
    for name, module in (("moge", package), ("moge.model", model)):
        monkeypatch.setitem(sys.modules, name, module)
    for version in ("v1", "v2"):
        module = types.ModuleType(f"moge.model.{version}")
        module.MoGeModel = StandIn
        monkeypatch.setitem(sys.modules, f"moge.model.{version}", module)


def moge_file(folder, **config):
    torch.save({"model_config": config, "model": {"weight": torch.ones(3)}}, folder / "model.pt")
    return folder


def test_moge_gives_metres_and_the_field_of_view(moge, tmp_path):
    said = []
    weights = moge_file(tmp_path, neck={}, scale_head={})
    model = make_depth_estimator("moge", ModelChoice(weights, announce=said.append))
    found = model.guess(picture(), None)
    assert "MIT" in said[0] and found.holds == "metres"
    assert np.isnan(found.values[:5]).all() and found.values[-1] == pytest.approx(2.0)
    assert found.field_of_view == pytest.approx(50.0, rel=1e-5)
    camera = PinholeCamera.from_fov(70.0, (W, H))
    assert model.guess(picture(), camera).field_of_view == pytest.approx(70.0, rel=1e-5)  # told, not guessed
    np.testing.assert_array_equal(model.depth(picture(), camera), found.values)


def test_moges_normals_come_along_where_it_has_them(moge, monkeypatch, tmp_path):
    plain = StandIn.infer
    weights = moge_file(tmp_path, neck={}, scale_head={})
    assert model_of("moge", weights).guess(picture(), None).normals is None
    slanted = torch.tensor([0.0, -3.0, -4.0]).expand(H, W, 3).clone()  # up and towards the camera, not of length 1
    slanted[:5] = 0.0  # the sky

    def infer(self, image, **options):
        return plain(self, image, **options) | {"normal": slanted}

    monkeypatch.setattr(StandIn, "infer", infer)
    normals = model_of("moge", weights).guess(picture(), None).normals
    assert normals.shape == (H, W, 3) and np.isnan(normals[:5]).all()
    np.testing.assert_allclose(normals[5:], np.broadcast_to([0.0, -0.6, -0.8], (H - 5, W, 3)), atol=1e-6)


def test_moges_first_version_knows_no_metres(moge, tmp_path):
    assert model_of("moge", moge_file(tmp_path)).guess(picture(), None).holds == "relative"


def test_a_moge_file_that_lacks_tensors_or_is_something_else_is_refused(moge, tmp_path):
    torch.save({"model_config": {"neck": {}}, "model": {}}, tmp_path / "model.pt")
    with pytest.raises(InputRejected, match="lacks 1 tensors, such as weight"):
        model_of("moge", tmp_path)
    torch.save({"weight": torch.ones(3)}, tmp_path / "model.pt")
    with pytest.raises(InputRejected, match="not MoGe's"):
        model_of("moge", tmp_path)
    (tmp_path / "model.pt").write_bytes(b"nonsense")
    with pytest.raises(InputRejected, match=r"damaged|more than tensors"):
        model_of("moge", tmp_path)


def test_packages_that_are_missing_are_named_with_the_command(monkeypatch, tmp_path):
    for name in ("moge", "moge.model", "depth_anything_3", "depth_anything_3.api"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingPackage, match=r"git\+https://github.com/microsoft/MoGe"):
        model_of("moge", tmp_path)
    with pytest.raises(MissingPackage, match="Depth-Anything-3"):
        model_of("depth-anything-3", tmp_path)


# Depth Anything 3: likewise ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["da3metric-large", "da3mono-large"])
def test_depth_anything_3_gives_metres_where_it_can(name, monkeypatch, tmp_path):
    save_file = pytest.importorskip("safetensors.torch", reason="safetensors is not installed").save_file

    class Network(torch.nn.Module):
        model_name = name

        def __init__(self):
            super().__init__()
            self.head, self.body = torch.nn.Linear(2, 2), torch.nn.Linear(2, 2)

        @classmethod
        def from_pretrained(cls, folder, local_files_only):
            assert local_files_only
            return cls()

        def inference(self, images):
            depth = np.full((1, H // 2, W // 2), 3.0, np.float32)
            sky = np.zeros(depth.shape)
            sky[:, 0] = 1.0
            return types.SimpleNamespace(depth=depth, sky=sky, intrinsics=None, is_metric=0)

    api = types.ModuleType("depth_anything_3.api")
    api.DepthAnything3 = Network
    monkeypatch.setitem(sys.modules, "depth_anything_3", types.ModuleType("depth_anything_3"))
    monkeypatch.setitem(sys.modules, "depth_anything_3.api", api)
    with pytest.raises(InputRejected, match=r"model\.safetensors"):
        model_of("depth-anything-3", tmp_path)
    whole = Network().state_dict()
    # the package's own loader would leave what lacks as it was drawn
    save_file({k: v for k, v in whole.items() if k != "head.bias"}, str(tmp_path / "model.safetensors"))
    with pytest.raises(InputRejected, match=r"lacks 1 tensors, such as head\.bias"):
        model_of("depth-anything-3", tmp_path)
    (tmp_path / "model.safetensors").write_bytes(b"nonsense")
    with pytest.raises(InputRejected, match="damaged"):
        model_of("depth-anything-3", tmp_path)
    save_file(whole, str(tmp_path / "model.safetensors"))
    model = model_of("depth-anything-3", tmp_path)
    assert model.guess(picture(), None).holds == "relative"
    camera = PinholeCamera.from_fov(60.0, (W, H))
    found = model.guess(picture(), camera)
    assert np.isnan(found.values[0]).all()
    if "metric" in name:
        # at half the size, half the focal length
        assert found.values[-1, 0] == pytest.approx(3.0 * 0.5 * camera.focal[0] / 300.0, rel=1e-5)
        assert found.holds == "metres"
    else:
        assert found.values[-1, 0] == 3.0 and found.holds == "relative"
