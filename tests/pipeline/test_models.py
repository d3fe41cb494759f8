"""Which learned models a job takes, that it says so to the bit, and that none is taken unasked."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import shutil
import sys
import types
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from fluidlift.backends import model_table
from fluidlift.backends.model_cache import kept
from fluidlift.backends.model_card import ModelCard, ModelFile
from fluidlift.backends.model_get import ModelRequest, get_model
from fluidlift.cli import DONE, REJECTED, WITH_WARNINGS, main
from fluidlift.config import JobConfig, build_config
from fluidlift.errors import InputRejected, MissingPackage
from fluidlift.io.asset_folder import read_manifest
from fluidlift.messages import code_of, from_plain
from fluidlift.pipeline import Inputs, begin
from fluidlift.pipeline.inputs import GivenFile, GivenFiles, Weights
from fluidlift.pipeline.known_camera import USUAL_SPREAD, with_model_lens
from fluidlift.pipeline.models import require_use, used_models, with_models
from fluidlift.pipeline.runner import Runner
from fluidlift.pipeline.settings import DepthModelSettings, FlowSettings, SegmentSettings
from fluidlift.pipeline.stages.flow import flow_method
from fluidlift.seams import Silence
from fluidlift.types import PinholeCamera

CLIP = Inputs(Path("clip.mp4"))


class Plane(torch.nn.Module):
    """Looks like MoGe's network, and answers with the plane that a camera 4 m above it sees, 40 degrees down."""

    def __init__(self, **more):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(3))

    def infer(self, image, *, fov_x=None, use_fp16=True):
        height, width = image.shape[1:]
        focal = 0.5 / np.tan(np.radians(25.0 if fov_x is None else fov_x / 2))
        y = (torch.arange(height) + 0.5 - height / 2) / (focal * width)
        pitch = np.radians(40.0)
        depth = 4.0 / (np.cos(pitch) * y + np.sin(pitch)).clamp(min=0.05)
        normal = torch.zeros(height, width, 3)
        normal[..., 1], normal[..., 2] = -np.cos(pitch), -np.sin(pitch)
        rows = depth[:, None].repeat(1, width)
        tall = focal * width / height
        return {"depth": rows, "normal": normal,
                "intrinsics": torch.tensor([[focal, 0, 0.5], [0, tall, 0.5], [0, 0, 1.0]])}  # fmt: skip


@pytest.fixture
def stick(tmp_path):
    """Files of small models, as somebody brings them."""
    folder = tmp_path / "stick"
    folder.mkdir()
    torch.save({"model_config": {"neck": {}, "scale_head": {}}, "model": {"weight": torch.ones(3)}}, folder / "moge.pt")
    for name in ("flow.pth", "other.pth", "config.json"):
        (folder / name).write_bytes(name.encode())
    return folder


@pytest.fixture
def table(monkeypatch, tmp_path, stick):
    """A table of small models, and MoGe's package in their midst; nothing is in the cache yet."""
    monkeypatch.setenv("FLUIDLIFT_MODELS", str(tmp_path / "cache"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    for name in ("moge", "moge.model", "moge.model.v2"):
        module = types.ModuleType(name)
        module.__path__ = []
        module.__spec__ = importlib.util.spec_from_loader(name, None)
        monkeypatch.setitem(sys.modules, name, module)
    sys.modules["moge.model.v2"].MoGeModel = Plane

    def file_of(name):
        data = (stick / name).read_bytes()
        return ModelFile(name, "https://x.y/z", len(data), hashlib.sha256(data).hexdigest())

    def card(name, gains, back_end, file, terms="allowed", packages=()):
        files = tuple(file_of(part) for part in file.split())
        return ModelCard(
            name, name, gains, back_end, "Its terms.", terms, "https://x.y", files, packages, "pip install it"
        )

    cards = (
        card("depth-1", ("depth", "tilt"), ("depth model", "moge"), "moge.pt", packages=("moge",)),
        card("depth-2", ("depth",), ("depth model", "depth-pro"), "other.pth", "research"),
        card("flow-1", ("flow",), ("flow method", "raft"), "flow.pth", "conditions", ("no_such_package",)),
        card("flow-2", ("flow",), ("flow method", "sea-raft"), "flow.pth", "conditions"),
        card("masks-2", ("masks",), ("mask method", "sam2"), "config.json other.pth"),
        card("masks-3", ("masks",), ("mask method", "sam3"), "other.pth", "conditions"),
    )
    monkeypatch.setattr(model_table, "MODELS", cards)
    monkeypatch.setattr("fluidlift.pipeline.models.MODELS", cards)
    return {c.name: c for c in cards}


@pytest.fixture
def seeing(table, stick, monkeypatch):
    """A model of the view beside the others: a small GeoCalib, whose field is that of a camera that looks 70 degrees
    down and is turned by 4."""
    from fluidlift.backends.geocalib import GeoCalib
    from fluidlift.backends.geocalib_network import GeoCalibNetwork, GeoCalibShape
    from fluidlift.backends.perspective_field import field_of_camera

    torch.manual_seed(0)
    state = GeoCalibNetwork(GeoCalibShape((8, 8, 8, 8), (1, 1, 1, 1), (8, 8, 8, 8), 8, 8)).state_dict()
    torch.save({"model": state}, stick / "geocalib-pinhole.tar")
    data = (stick / "geocalib-pinhole.tar").read_bytes()
    file = ModelFile("geocalib-pinhole.tar", "https://x.y/z", len(data), hashlib.sha256(data).hexdigest())
    card = ModelCard("view-1", "view-1", ("tilt",), ("view model", "geocalib"), "Its terms.", "allowed", "https://x.y",
                     (file,))  # fmt: skip
    monkeypatch.setattr(model_table, "MODELS", (*model_table.MODELS, card))
    monkeypatch.setattr("fluidlift.pipeline.models.MODELS", model_table.MODELS)

    def field(self, image):
        height, width = image.shape[:2]
        return field_of_camera(70.0, 4.0, 1.1 * width, (width, height)), 1.0

    monkeypatch.setattr(GeoCalib, "field", field)
    get_model(card, ModelRequest(stick))
    return file.sha256


def bring(table, stick, *names):
    for name in names:
        get_model(table[name], ModelRequest(stick))


def test_nothing_changes_unless_it_is_asked_for(table, stick):
    bring(table, stick, "depth-1", "flow-2")
    config = JobConfig()
    for asked in ("none", ""):
        assert with_models(config, CLIP, asked).config is config
    assert used_models(config, CLIP) == ()


def test_auto_takes_the_first_of_each_kind_that_is_there_and_can_run(table, stick):
    empty = with_models(JobConfig(), CLIP, "auto")
    assert empty.config == JobConfig() and "no learned model" in empty.told[0]
    bring(table, stick, *(name for name in table if name != "masks-2"))
    chosen = with_models(JobConfig(), CLIP, "auto")
    c = chosen.config
    assert (c.depth.model, c.depth.weights) == ("moge", "model:depth-1")
    assert (c.motion.method, c.motion.weights) == ("sea-raft", "model:flow-2")
    assert c.segment == JobConfig().segment  # which words, only a person knows
    assert any("flow-1 is left out: no_such_package" in line for line in chosen.told)
    assert any(line.startswith("depth by depth-1") for line in chosen.told)


def test_auto_leaves_alone_what_a_person_gave_or_chose(table, stick):
    bring(table, stick, "depth-1", "flow-2")
    given = Inputs(Path("clip.mp4"), depth=Path("d.exr"), flow=Path("flow"))
    assert with_models(JobConfig(), given, "auto").config == JobConfig()
    chosen = build_config(overrides=["motion.method=dis", "generate.name=trellis"])
    assert with_models(chosen, CLIP, "auto").config == chosen


def test_auto_keeps_to_what_the_asset_is_for(table, stick):
    bring(table, stick, "depth-2", "flow-2")
    commercial = build_config(overrides=["generate.use=commercial"])
    assert with_models(commercial, CLIP, "auto").config == commercial
    assert with_models(JobConfig(), CLIP, "auto").config.depth.weights == "model:depth-2"


def test_a_model_of_several_files_is_handed_over_as_its_folder(table, stick, tmp_path):
    bring(table, stick, "masks-2")
    config = with_models(JobConfig(), CLIP, "auto").config
    settings = SegmentSettings.of(config)
    assert settings.method == "sam2" and settings.weights.name == str(tmp_path / "cache" / "masks-2")
    (model,) = used_models(config, CLIP)
    assert set(model.files) == {"config.json", "other.pth"}  # and not what the cache notes beside them
    assert with_models(JobConfig(), Inputs(Path("clip.mp4"), mask=Path("m.png")), "auto").config == JobConfig()


@pytest.mark.parametrize(
    ("asked", "error", "says"),
    [
        ("depth-9", InputRejected, "no model"), ("flow-2", InputRejected, "models get flow-2"),
        ("depth-1,depth-2", InputRejected, "two for depth"), ("trellis", InputRejected, "--generator trellis"),
        ("flow-1", MissingPackage, "pip install it"),
    ],
)  # fmt: skip
def test_a_name_that_cannot_be_followed_says_why(table, stick, asked, error, says):
    bring(table, stick, "depth-1", "depth-2", "flow-1")
    with pytest.raises(error, match=says):
        with_models(JobConfig(), CLIP, asked)


def test_a_name_for_what_is_given_is_a_contradiction(table, stick):
    bring(table, stick, "depth-1")
    with pytest.raises(InputRejected, match="together with --depth"):
        with_models(JobConfig(), Inputs(Path("clip.mp4"), depth=Path("d.exr")), "depth-1")
    with pytest.raises(InputRejected, match="--generator trellis"):
        with_models(build_config(overrides=["generate.name=trellis"]), CLIP, "depth-1")


def test_a_job_with_fewer_stages_takes_fewer_models(table, stick):
    bring(table, stick, "depth-1", "flow-2")
    chosen = with_models(JobConfig(), CLIP, "auto", places=("masks", "flow"))
    assert chosen.config.depth == JobConfig().depth and chosen.config.motion.method == "sea-raft"
    with pytest.raises(InputRejected, match="depth-1, which is for depth"):
        with_models(JobConfig(), CLIP, "flow-2,depth-1", places=("masks", "flow"))


@pytest.mark.parametrize(
    ("command", "asked", "says"),
    [
        ("mask", "depth-1", "a model for masks or flow"), ("mask", "flow-2", "models get flow-2"),
        ("motion", "depth-1", "models get depth-1"), ("motion", "masks-9", "no model"),
    ],
)  # fmt: skip
def test_mask_and_motion_know_the_option(capsys, table, stream_clip, tmp_path, command, asked, says):
    out = tmp_path / "out"
    assert main([command, str(stream_clip), "-o", str(out), "--models", asked]) == REJECTED
    assert says in capsys.readouterr().err and not out.exists()


def test_motion_measures_with_the_model_that_it_was_told(capsys, table, stick, stream_clip, tmp_path):
    bring(table, stick, "depth-1")
    job = ["motion", str(stream_clip), "-o", str(tmp_path / "out"), "--kind", "stream", "--duration", "0.3",
           "--max-size", "96", "--models", "auto", "--json"]  # fmt: skip
    assert main(job) in (DONE, WITH_WARNINGS)
    said = capsys.readouterr()
    assert "models: depth by depth-1" in said.err
    (model,) = json.loads(said.out)["provenance"]["models"]
    assert model["name"] == "depth-1" and model["files"].keys() == {"moge.pt"}


def test_a_stage_depends_on_what_is_in_the_weights_and_not_on_where_they_are(table, stick, monkeypatch, tmp_path):
    bring(table, stick, "depth-1")
    config = with_models(JobConfig(), CLIP, "depth-1").config
    in_key = Runner(tmp_path / "asset", (), progress=Silence())._part
    before = Weights.of(config.depth.weights)
    shutil.move(tmp_path / "cache", tmp_path / "elsewhere")
    monkeypatch.setenv("FLUIDLIFT_MODELS", str(tmp_path / "elsewhere"))
    after = Weights.of(config.depth.weights)
    assert in_key(before) == in_key(after) and before.name != after.name
    assert hashlib.sha256((stick / "moge.pt").read_bytes()).hexdigest() in str(in_key(before))
    (stick / "moge.pt").write_bytes(b"another version")
    other = replace(table["depth-1"], files=(ModelFile("moge.pt", "https://x.y/z"),))
    get_model(other, ModelRequest(stick, accept_unverified=True))
    assert in_key(Weights.of(config.depth.weights)) != in_key(before)


def test_a_model_that_was_changed_or_is_gone_is_not_used(table, stick, tmp_path):
    bring(table, stick, "flow-2")
    config = with_models(JobConfig(), CLIP, "flow-2").config
    (tmp_path / "cache" / "flow-2" / "flow.pth").write_bytes(b"flow.pTh")
    with pytest.raises(InputRejected, match="not what was fetched"):
        used_models(config, CLIP)
    shutil.rmtree(tmp_path / "cache")
    with pytest.raises(InputRejected, match="models get flow-2"):
        used_models(config, CLIP)


def test_a_model_of_the_flow_that_is_gone_is_missed_before_the_clip_is_read(table, tmp_path):
    clip, work = tmp_path / "clip.mp4", tmp_path / "work"
    clip.write_bytes(b"no video")
    config = build_config(overrides=["motion.method=sea-raft", "motion.weights=model:flow-2"])
    with pytest.raises(InputRejected, match="models get flow-2"):
        begin.look(Runner(work, ("read",), progress=Silence()), GivenFiles.of(Inputs(clip)), config)
    assert not work.exists()


def test_a_file_of_the_same_name_is_not_taken_for_a_model(table, stick, monkeypatch, tmp_path):
    bring(table, stick, "flow-2")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "model:flow-2").write_bytes(b"of somebody else")
    config = with_models(JobConfig(), CLIP, "flow-2").config
    assert Weights.of(config.motion.weights).name == str(tmp_path / "cache" / "flow-2" / "flow.pth")


def test_the_back_end_gets_the_files_of_the_cache(table, stick, monkeypatch):
    bring(table, stick, "flow-2")
    settings = FlowSettings.of(with_models(JobConfig(), CLIP, "flow-2").config)
    seen = []
    monkeypatch.setattr(
        "fluidlift.pipeline.stages.flow.make_estimator", lambda name, choice: seen.append((name, choice))
    )
    flow_method(settings)
    assert seen[0][0] == "sea-raft" and Path(seen[0][1].weights).read_bytes() == b"flow.pth"


def test_terms_follow_the_asset(table, stick):
    bring(table, stick, "depth-2")
    models = used_models(with_models(JobConfig(), CLIP, "depth-2").config, CLIP)
    assert [code_of(w) for w in require_use(models, None)] == ["model-not-commercial"]
    assert require_use(models, "research") == []
    with pytest.raises(InputRejected, match="research only"):
        require_use(models, "commercial")


def test_weights_of_a_path_are_told_by_their_hash_too(table, stick):
    config = build_config(overrides=["motion.method=sea-raft", f"motion.weights={stick / 'flow.pth'}"])
    (model,) = used_models(config, CLIP)
    assert model.to_dict() == {
        "for": "flow", "method": "sea-raft", "name": "flow.pth",
        "files": {"flow.pth": hashlib.sha256(b"flow.pth").hexdigest()},
    }  # fmt: skip
    assert used_models(config, Inputs(Path("clip.mp4"), flow=Path("given"))) == ()  # which is not asked then


def test_an_asset_says_which_models_it_was_made_with(capsys, table, stick, stream_clip, hasty, tmp_path):
    out = tmp_path / "x.fluid"
    assert main(["make", str(stream_clip), "-o", str(out), "--models", "depth-1"]) == REJECTED
    assert "fluidlift models get depth-1" in capsys.readouterr().err and not out.exists()
    bring(table, stick, "depth-1")
    job = ["make", str(stream_clip), "-o", str(out), "--kind", "stream", "--models", "auto", *hasty]
    assert main(job) in (DONE, WITH_WARNINGS)
    assert "models: depth by depth-1" in capsys.readouterr().err
    manifest = read_manifest(out)
    (model,) = manifest["provenance"]["models"]
    sha256 = hashlib.sha256((stick / "moge.pt").read_bytes()).hexdigest()
    assert model["for"] == "depth" and model["name"] == "depth-1" and model["files"] == {"moge.pt": sha256}
    assert manifest["provenance"]["config"]["depth"]["weights"] == "model:depth-1"
    assert str(tmp_path) not in json.dumps(manifest)
    report = (out / "report.html").read_text(encoding="utf-8")
    assert "Learned models" in report and sha256 in report and "by the depth of moge" in report
    # the small clip is looked down on, and this model says 40 degrees: it counts for most, and the doubt is told
    up = manifest["metrics"]["up"]
    assert up["pitch"] == pytest.approx(40.0, abs=10.0) and "plane of the depth of moge (" in up["source"]
    assert up["error"] > 20.0 and "tilt-unsure" in [code_of(w) for w in from_plain(manifest)]
    assert kept("depth-1") is not None


def test_a_models_lens_counts_by_how_sure_it_is():
    usual = PinholeCamera.from_fov(50.0, (640, 360))
    model = PinholeCamera.from_fov(70.0, (640, 360)).focal[0]
    assumed = with_model_lens(usual, USUAL_SPREAD, 70.0)
    assert assumed.focal[0] == assumed.focal[1] == pytest.approx(model, rel=0.03)  # the usual view says next to nothing
    measured = with_model_lens(usual, 0.01, 70.0)
    assert measured.focal[0] == pytest.approx(usual.focal[0], rel=0.01)  # the path of the camera says it better


def test_a_model_of_the_view_has_something_to_do_where_the_tilt_is_open(seeing, tmp_path):
    chosen = with_models(JobConfig(), CLIP, "auto")
    assert (chosen.config.view.model, chosen.config.view.weights) == ("geocalib", "model:view-1")
    assert any(line.startswith("tilt by view-1") for line in chosen.told)
    lens, pose = tmp_path / "lens.json", tmp_path / "pose.json"
    facts = {"width": 96, "height": 64, "K": [[90, 0, 48], [0, 90, 32], [0, 0, 1]]}
    lens.write_text(json.dumps(facts), encoding="utf-8")
    pose.write_text(json.dumps(facts | {"R": np.eye(3).tolist(), "t": [0, 0, 0]}), encoding="utf-8")
    assert with_models(JobConfig(), replace(CLIP, camera=lens), "auto").config.view.model == "geocalib"
    assert with_models(JobConfig(), replace(CLIP, camera=pose), "auto").config.view.model == "none"
    with pytest.raises(InputRejected, match="together with --camera"):
        with_models(JobConfig(), replace(CLIP, camera=pose), "view-1")
    assert used_models(chosen.config, replace(CLIP, camera=pose)) == ()
    told = build_config(overrides=["shape.pitch=20", "shape.roll=0", "shape.fov=50"])
    assert with_models(told, CLIP, "auto").config == told
    with pytest.raises(InputRejected, match="--pitch, --roll and --fov"):
        with_models(told, CLIP, "view-1")


def test_an_asset_counts_what_a_model_of_the_view_says(capsys, seeing, stream_clip, hasty, tmp_path):
    def up_of(out, *more):
        job = ["make", str(stream_clip), "-o", str(out), "--kind", "stream", *hasty, *more]
        assert main(job) in (DONE, WITH_WARNINGS)
        return read_manifest(out)

    alone = up_of(tmp_path / "alone.fluid")["metrics"]["up"]
    manifest = up_of(tmp_path / "x.fluid", "--models", "view-1")
    up = manifest["metrics"]["up"]
    assert "tilt by view-1" in capsys.readouterr().err
    assert "geocalib (70 degrees, within 5)" in up["source"] and "geocalib" not in alone["source"]
    assert abs(up["pitch"] - 70.0) < abs(alone["pitch"] - 70.0) and up["error"] < alone["error"]
    assert up["roll"] == pytest.approx(4.0, abs=2.0) and abs(alone["roll"]) < 2.0
    (model,) = manifest["provenance"]["models"]
    assert model["for"] == "tilt" and model["files"] == {"geocalib-pinhole.tar": seeing}
    assert main(["make", str(stream_clip), "-o", str(tmp_path / "y.fluid"), "--set", "view.model=geocalib"]) == REJECTED
    assert "without its weights" in capsys.readouterr().err


def test_a_model_of_depth_in_another_python_needs_no_package_here(table, stick, monkeypatch):
    """What it lacks there is told there."""
    lacking = replace(table["depth-1"], packages=("no_such_package",))
    monkeypatch.setattr(model_table, "MODELS", (lacking,))
    monkeypatch.setattr("fluidlift.pipeline.models.MODELS", (lacking,))
    bring({"depth-1": lacking}, stick, "depth-1")
    with pytest.raises(MissingPackage, match="pip install it"):
        with_models(JobConfig(), CLIP, "depth-1")
    elsewhere = build_config(overrides=["depth.python=/somewhere/bin/python"])
    for asked in ("depth-1", "auto"):
        chosen = with_models(elsewhere, CLIP, asked).config
        assert (chosen.depth.model, chosen.depth.python) == ("moge", "/somewhere/bin/python")
    given = GivenFiles(GivenFile(CLIP.clip, "0"))
    there, here = (
        DepthModelSettings.of(given, replace(chosen, depth=replace(chosen.depth, python=p)))
        for p in ("~/x/bin/python", None)
    )
    assert there is not None and here is not None and here.python is None
    assert there.python == Path.home() / "x" / "bin" / "python"
