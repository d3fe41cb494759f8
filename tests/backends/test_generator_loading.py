"""A generator in this process is asked in its own words, loads nothing that could run code, and fails with advice.

The third-party packages are stood in for by modules with the functions that the adapters call."""

from __future__ import annotations

import pickle
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from fluidlift.backends import generator_loading, lgm, sharp, trellis, triplane_gaussian, triposplat
from fluidlift.backends.generator_loading import RunChoice
from fluidlift.errors import FluidliftError, InputRejected, MissingPackage

SIZE = (96, 64)


class Harmful:
    """What a pickle can do."""

    def __reduce__(self):
        return exec, ("raise SystemExit('code was run')",)


@pytest.fixture
def picture():
    image = np.full((SIZE[1], SIZE[0], 3), 200, np.uint8)
    mask = np.zeros((SIZE[1], SIZE[0]), bool)
    mask[12:52, 30:70] = True
    image[mask] = (40, 90, 160)
    return image, mask


@pytest.fixture
def module(monkeypatch):
    """Puts a module of that name in place."""

    def put(name: str, **content) -> ModuleType:
        made = ModuleType(name)
        for key, value in content.items():
            setattr(made, key, value)
        monkeypatch.setitem(sys.modules, name, made)
        return made

    return put


def ball(n: int = 400) -> dict[str, torch.Tensor]:
    random = torch.Generator().manual_seed(1)
    means = 0.3 * torch.nn.functional.normalize(torch.randn(n, 3, generator=random), dim=1)
    return {
        "xyz": means, "scaling": torch.full((n, 3), 0.03), "opacity": torch.full((n, 1), 0.9),
        "rotation": torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1), "features": torch.full((n, 1, 3), -0.5),
    }  # fmt: skip


def sharp_stand_in(module, predict_image):
    network = torch.nn.Linear(2, 1)
    module("sharp")
    module("sharp.cli")
    module("sharp.models", create_predictor=lambda params: network, PredictorParams=dict)
    module("sharp.cli.predict", predict_image=predict_image)
    return network


def scene_of(predictor, image, focal, device):
    assert image.dtype == np.uint8
    b = ball()
    means = b["xyz"] + torch.tensor([0.0, 0.0, 1.5])
    return SimpleNamespace(
        mean_vectors=means[None], singular_values=b["scaling"][None], quaternions=b["rotation"][None],
        colors=torch.full((1, 400, 3), 0.2), opacities=b["opacity"][None, :, 0],
    )  # fmt: skip


def test_sharp_runs_on_a_cpu_with_weights_that_are_tensors_alone(module, picture, tmp_path):
    network = sharp_stand_in(module, scene_of)
    torch.save(torch.nn.Linear(2, 1).state_dict() | {"bias": torch.tensor([7.0])}, tmp_path / "sharp.pt")
    said = []
    generator = sharp.SharpGenerator(RunChoice(tmp_path / "sharp.pt", device="cpu", announce=said.append))
    gaussians, camera = generator.generate(*picture, 3)
    assert network.bias.item() == 7.0
    assert len(gaussians) > 100
    assert camera.size == SIZE
    assert camera.focal[0] == pytest.approx(sharp.focal_length(SIZE))
    generator.generate(*picture, 4)
    assert len(said) == 1  # the licence, once, before the first use
    assert "research only" in said[0]


def test_weights_that_could_run_code_are_refused(module, picture, tmp_path):
    sharp_stand_in(module, scene_of)
    (tmp_path / "sharp.pt").write_bytes(pickle.dumps(Harmful()))
    with pytest.raises(InputRejected, match=r"more than tensors|damaged"):
        sharp.SharpGenerator(RunChoice(tmp_path / "sharp.pt", device="cpu")).generate(*picture, 0)


def test_third_party_code_cannot_unpickle_in_this_process(tmp_path):
    torch.save({"x": Harmful()}, tmp_path / "evil.pt")
    original = torch.load
    refusal = pytest.raises(InputRejected, match=r"could run code.*--generator-python")
    with refusal, generator_loading.only_weights(triplane_gaussian.CARD):
        torch.load(tmp_path / "evil.pt", weights_only=False)
    assert torch.load is original
    refusal = pytest.raises(InputRejected, match="could run code")
    with refusal, generator_loading.only_weights(triplane_gaussian.CARD):
        original(tmp_path / "evil.pt", weights_only=False)  # as who had imported it by name


def test_no_weights_and_no_leave_to_fetch_them_is_said(module, picture, monkeypatch, tmp_path):
    sharp_stand_in(module, scene_of)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    with pytest.raises(InputRejected, match="allow the download"):
        sharp.SharpGenerator(RunChoice(device="cpu")).generate(*picture, 0)


@pytest.mark.parametrize(
    "error", [torch.OutOfMemoryError("CUDA out of memory"), MemoryError(), RuntimeError("DefaultCPUAllocator: can't "
                                                                                     "allocate memory")]
)  # fmt: skip
def test_running_out_of_memory_names_what_to_do_and_the_next_frame_still_runs(module, picture, tmp_path, error):
    frames = iter([error])

    def predict(*arguments):
        for trouble in frames:
            raise trouble
        return scene_of(*arguments)

    sharp_stand_in(module, predict)
    torch.save(torch.nn.Linear(2, 1).state_dict(), tmp_path / "sharp.pt")
    generator = sharp.SharpGenerator(RunChoice(tmp_path / "sharp.pt", device="cpu", announce=lambda line: None))
    with pytest.raises(FluidliftError, match=r"out of memory.*Needed: a GPU with 12 GB.*built-in generator"):
        generator.generate(*picture, 0)
    assert len(generator.generate(*picture, 1)[0]) > 100


def test_other_errors_of_a_generator_are_not_taken_for_memory(module, picture, tmp_path):
    def predict(*arguments):
        raise RuntimeError("shapes do not match")

    sharp_stand_in(module, predict)
    torch.save(torch.nn.Linear(2, 1).state_dict(), tmp_path / "sharp.pt")
    with pytest.raises(RuntimeError, match="shapes"):
        sharp.SharpGenerator(RunChoice(tmp_path / "sharp.pt", device="cpu")).generate(*picture, 0)


def test_an_empty_body_is_no_body(module, picture, tmp_path):
    def predict(*arguments):
        scene = scene_of(*arguments)
        scene.opacities = torch.full_like(scene.opacities, 0.001)
        return scene

    sharp_stand_in(module, predict)
    torch.save(torch.nn.Linear(2, 1).state_dict(), tmp_path / "sharp.pt")
    with pytest.raises(FluidliftError, match=r"empty body of frame 5.*another seed"):
        sharp.SharpGenerator(RunChoice(tmp_path / "sharp.pt", device="cpu")).generate(*picture, 5)


ALL = {
    "triplane-gaussian": triplane_gaussian.TriplaneGaussianGenerator, "lgm": lgm.LgmGenerator,
    "trellis": trellis.TrellisGenerator, "triposplat": triposplat.TripoSplatGenerator, "sharp": sharp.SharpGenerator,
}  # fmt: skip


@pytest.mark.parametrize("name", list(ALL))
def test_a_generator_that_is_not_installed_says_how_to_get_it(picture, name, monkeypatch):
    for package in ALL[name].card.packages:
        monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingPackage, match=r"not installed here.*git clone.*--generator-python"):
        ALL[name](RunChoice(isolated=True, announce=lambda line: None)).generate(*picture, 0)


@pytest.mark.parametrize("name", ["lgm", "trellis"])
def test_what_runs_code_from_the_hub_stays_out_of_this_process(picture, name):
    with pytest.raises(InputRejected, match=r"runs code.*--generator-python"):
        ALL[name](RunChoice()).generate(*picture, 0)


@pytest.mark.parametrize("name", list(ALL))
def test_a_frame_without_fluid_is_refused_before_anything_is_loaded(picture, name):
    image, mask = picture
    with pytest.raises(InputRejected, match="no fluid"):
        ALL[name]().generate(image, np.zeros_like(mask), 0)
    line = np.zeros_like(mask)
    line[20, 10:80] = True
    with pytest.raises(InputRejected, match="70 x 1 px"):
        ALL[name]().generate(image, line, 0)


def test_triposplat_is_asked_stage_by_stage_and_keeps_its_camera(module, picture, tmp_path):
    asked = {}

    def encode_image(image, eyes, vae, generator):
        asked["size"] = image.size
        return {"feature": 1}

    def sample_latent(flow, cond, **options):
        asked.update(options)
        return {"latent": "z", "camera": torch.tensor([[[0.0, -1.0, 0.0, 0.5, 0.5]]])}

    b = ball()
    body = SimpleNamespace(
        get_xyz=b["xyz"], get_scaling=b["scaling"], get_opacity=b["opacity"], _rotation=0 * b["rotation"],
        rots_bias=torch.tensor([1.0, 0, 0, 0]), _features_dc=b["features"],
    )  # fmt: skip

    def load(path, device, dtype):
        return asked.setdefault("files", []).append(path)

    decoder = SimpleNamespace(decode=lambda latent, num_gaussians: body)
    module(
        "triposplat", load_dinov3=load, load_vae_encoder=load, load_flow_model=load, encode_image=encode_image,
        load_decoder=lambda path, device, dtype: decoder, sample_latent=sample_latent,
    )  # fmt: skip
    for name in triposplat.CARD.weights:
        path = tmp_path / name.removeprefix("VAST-AI/TripoSplat/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"0")
    choice = RunChoice(tmp_path, device="cpu", announce=lambda line: None)
    gaussians, camera = triposplat.TripoSplatGenerator(choice).generate(*picture, 0)
    assert asked["size"] == (1024, 1024)
    assert (asked["steps"], asked["guidance_scale"], asked["shift"]) == (20, 3.0, 3.0)
    np.testing.assert_allclose(camera.position, [0, -2, 0], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(gaussians.quats, axis=1), 1, atol=1e-6)


def test_triplane_gaussian_gets_its_checkpoint_from_us(module, picture, tmp_path):
    b, seen = ball(), {}

    class Network(torch.nn.Linear):
        def __init__(self, cfg):
            assert cfg.weights is None  # its own loader would unpickle anything
            super().__init__(1, 1)

        def _forward(self, batch):
            seen.update(batch)
            shs = torch.cat([b["features"], torch.zeros(400, 15, 3)], dim=1)
            body = SimpleNamespace(shs=shs, **{k: b[k] for k in ("xyz", "opacity", "rotation", "scaling")})
            return {"3dgs": [body]}

    module("infer", TGS=Network, __file__=str(tmp_path / "infer.py"))
    module("tgs")
    module("tgs.utils")
    config = SimpleNamespace(system=SimpleNamespace(weights="model.ckpt"))
    module("tgs.utils.config", load_config=lambda path, cli_args: config)
    torch.save({"state_dict": torch.nn.Linear(1, 1).state_dict(), "epoch": 3}, tmp_path / "model_lvis_rel.ckpt")
    choice = RunChoice(tmp_path, device="cpu", announce=lambda line: None)
    gaussians, camera = triplane_gaussian.TriplaneGaussianGenerator(choice).generate(*picture, 0)
    assert gaussians.sh.shape == (400, 16, 3)
    assert seen["rgb_cond"].shape == (1, 1, 252, 252, 3)
    assert camera.size == SIZE


def test_trellis_and_lgm_run_in_a_process_of_their_own(module, picture, tmp_path):
    b, asked = ball(), {}
    body = SimpleNamespace(**{f"get_{k}": v for k, v in b.items()})

    class Pipeline:
        @classmethod
        def from_pretrained(cls, where, **options):
            asked["where"] = where
            return cls()

        def to(self, device):
            return self

        def run(self, image, **options):
            asked.update(options, size=image.size)
            return {"gaussian": [body]}

        def __call__(self, words, image, **options):
            asked.update(options, seen=image.shape)
            return np.zeros((5, 256, 256, 3), np.float32)

    module("trellis")
    module("trellis.pipelines", TrellisImageTo3DPipeline=Pipeline)
    choice = RunChoice(isolated=True, device="cpu", field_of_view=40.0, announce=lambda line: None)
    mask = np.hypot(*(np.mgrid[:64, :96] - np.array([[[32]], [[50]]]))) < 20
    _, camera = trellis.TrellisGenerator(choice).generate(picture[0], mask, 0)
    assert (asked["size"], asked["formats"], asked["preprocess_image"]) == ((518, 518), ["gaussian"], False)
    assert camera.size == SIZE

    class Network(torch.nn.Linear):
        def __init__(self, options):
            assert options.lambda_lpips == 0
            super().__init__(1, 1)

        def prepare_default_rays(self, device, elevation):
            return torch.zeros(4, 6, 256, 256)

        def forward_gaussians(self, images):
            asked["images"] = images.shape
            order = ("xyz", "opacity", "scaling", "rotation")
            return torch.cat([*(b[k] for k in order), torch.full((400, 3), 0.3)], dim=1)[None]

    module("core")
    module("core.options", config_defaults={"big": SimpleNamespace(lambda_lpips=1)})
    module("core.models", LGM=Network)
    module("mvdream")
    module("mvdream.pipeline_mvdream", MVDreamPipeline=Pipeline)

    save_file(torch.nn.Linear(1, 1).state_dict(), tmp_path / "model_fp16_fixrot.safetensors")
    choice = RunChoice(tmp_path, isolated=True, device="cpu", announce=lambda line: None)
    gaussians, _ = lgm.LgmGenerator(choice).generate(*picture, 0)
    assert asked["images"] == (1, 4, 9, 256, 256)
    assert asked["seen"] == (96, 96, 3)
    np.testing.assert_allclose(gaussians.rgb, 0.3, atol=1e-6)
