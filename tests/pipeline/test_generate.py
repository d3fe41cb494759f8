"""A third-party generator in the main job: its terms, its failures, and its bodies in the place of the embedded one."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from fluidlift.backends import generators
from fluidlift.cli import DONE, FAILED, REJECTED, WITH_WARNINGS, main
from fluidlift.config import GenerateConfig, JobConfig
from fluidlift.errors import FluidliftError, InputRejected
from fluidlift.io.asset_folder import read_manifest
from fluidlift.io.atomic import write_json
from fluidlift.io.kept_values import kept_value
from fluidlift.io.ply import read_gaussians, write_gaussians
from fluidlift.pipeline import STAGES, Inputs
from fluidlift.pipeline.given_body import NOTE, given_bodies, tilt_of_sheet, up_of
from fluidlift.pipeline.stages import generate as generating
from fluidlift.pipeline.stages import geometry as stage
from fluidlift.types import Gaussians, PinholeCamera, UpEvidence
from fluidlift.types.stages import Geometry, Segmentation

RUNNER = Path(__file__).parent.parent / "backends" / "stand_in_runner.py"
NAME = "trellis"  # its terms allow commercial use
BEFORE = ("read", "flow", "segment")


@pytest.fixture(autouse=True)
def settings(tmp_path_factory, monkeypatch):
    """No test reads or writes the user's accepted licences."""
    folder = tmp_path_factory.mktemp("settings")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(folder))
    return folder


@pytest.fixture
def asked(tmp_path, monkeypatch):
    """The frames that the stand-in was asked for, in order."""
    path = tmp_path / "asked"
    monkeypatch.setenv("STAND_IN_ASKED", str(path))
    return lambda: [int(t) for t in path.read_text().split()] if path.exists() else []


@pytest.fixture
def run(stream_clip, tmp_path, hasty, asked, monkeypatch):
    """Runs the job with the stand-in, told how to behave."""

    def make(what, *options, folder="x.fluid", accept=True):
        monkeypatch.setenv("STAND_IN", what)
        given = ["--generator", NAME, "--set", f"generate.runner={RUNNER}", "--set", "generate.frame_seconds=20"]
        given += ["--accept-licence", NAME] if accept else []
        return main(["make", str(stream_clip), "-o", str(tmp_path / folder), "--size", "2", *hasty, *given, *options])

    return make


def written(folder):
    """When each stage wrote its result."""
    return {path.parent.name: path.stat().st_mtime_ns for path in (folder / "work").glob("*/*.json")}


def kept(folder, name, kind):
    """The one value that a stage has kept."""
    (facts,) = (folder / "work" / name).glob("*.json")
    found = kept_value(folder, name, facts.stem, kind)
    assert found is not None
    return found[0]


def test_the_bodies_of_a_generator_take_the_place_of_the_embedded_one(run, tmp_path, asked, capsys):
    assert run("success", "--fov", "40", "--json") in (DONE, WITH_WARNINGS)
    folder = tmp_path / "x.fluid"
    found = kept(folder, "geometry", Geometry)
    frames = list(range(found.rest_frame, found.rest_frame + found.united_frames))
    assert asked() == frames and len(frames) > 1
    # the stand-in's own depth at the first frame, seen by a camera of the same field of view
    import cv2

    mask = kept(folder, "segment", Segmentation).labels.labels[frames[0]] == 1
    true = 2.0 - 0.5 * cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5) / max(mask.shape)
    both = mask & (found.depth > 0)
    ratio = found.depth[both] / true[both]
    # the near side is a minimum over some px, on which the stand-in's slope is 0.5 / 96 of 2 per px
    np.testing.assert_allclose(ratio / np.median(ratio), 1.0, atol=0.02)
    assert found.scale.source == "user" or found.scale.across == pytest.approx(2.0)
    assert set(json.loads(capsys.readouterr().out)["stages"]) == {*STAGES, "generate"}
    assert read_manifest(folder)["provenance"]["config"]["generate"]["name"] == NAME
    assert run("crash", "--fov", "40") in (DONE, WITH_WARNINGS)  # nothing is asked for again
    assert asked() == frames


@pytest.fixture
def stops_at_the_geometry(monkeypatch):
    """What comes after the generator is not what is looked at."""

    def stop(*inputs, **beside):
        raise FluidliftError("no further")

    monkeypatch.setattr(stage, "sighted", stop)


def test_after_every_failure_the_same_command_goes_on_from_the_last_finished_frame(
    run, tmp_path, asked, capsys, stops_at_the_geometry, patience_ends
):
    patience_ends(tmp_path / "asked.child")
    assert run("crash") == FAILED
    cached = written(tmp_path / "x.fluid")
    assert set(cached) == set(BEFORE)
    (first,) = asked()
    for what in ("memory", "killed", "garbage", "empty", "nan", "missing", "rejected", "second: crash"):
        before = len(asked())
        assert run(what) == FAILED
        assert "Do:" in capsys.readouterr().err or what == "rejected"
        assert written(tmp_path / "x.fluid") == cached
        assert asked()[before] == first
    second = asked()[-1]  # the body before the crash is there now: only what comes after is asked for
    before = len(asked())
    assert run("hang", "--set", "generate.frame_seconds=600") == FAILED
    assert "longer than 600 s" in capsys.readouterr().err
    assert run("success") == FAILED
    assert "no further" in capsys.readouterr().err
    found = written(tmp_path / "x.fluid")
    assert found.pop("generate") and found == cached
    assert second > first and asked()[before:] == [second, second]


def test_after_a_failure_the_job_can_go_on_without_the_generator(
    run, stream_clip, tmp_path, hasty, capsys, stops_at_the_geometry
):
    assert run("crash") == FAILED
    folder = tmp_path / "x.fluid"
    cached = written(folder)
    assert main(["make", str(stream_clip), "-o", str(folder), "--size", "2", *hasty]) == FAILED
    assert "no further" in capsys.readouterr().err
    assert written(folder) == cached


def test_a_forced_stage_asks_for_every_body_again(run, asked):
    assert run("second: crash") == FAILED
    assert run("second: crash", "--force", "generate") == FAILED
    assert asked() == 2 * asked()[:2]


# terms ----------------------------------------------------------------------------------------------------------


def test_a_licence_that_was_not_accepted_ends_the_run_before_anything_is_read(run, tmp_path, capsys):
    assert run("success", accept=False) == REJECTED
    said = capsys.readouterr().err
    assert "MIT" in said and f"--accept-licence {NAME}" in said
    assert not (tmp_path / "x.fluid").exists()


def config(**generate):
    return replace(JobConfig(), generate=GenerateConfig(**{"runner": str(RUNNER), **generate}))


def test_an_accepted_licence_is_remembered_until_its_words_change(tmp_path, settings, monkeypatch):
    inputs, folder = Inputs(tmp_path / "clip.mp4"), tmp_path / "x.fluid"
    generating.require_usable(inputs, config(name=NAME, accept_licence=(NAME,)), folder)
    generating.require_usable(inputs, config(name=NAME), folder)
    with pytest.raises(InputRejected, match="not accepted"):  # that of another is another
        generating.require_usable(inputs, config(name="lgm"), folder)
    changed = replace(generators.card_of(NAME), licence="Now for a fee.")
    monkeypatch.setattr(generators, "card_of", lambda name: changed)
    with pytest.raises(InputRejected, match="Now for a fee"):
        generating.require_usable(inputs, config(name=NAME), folder)


def test_damaged_settings_mean_to_be_asked_again(tmp_path, settings):
    (settings / "fluidlift").mkdir()
    (settings / "fluidlift" / "licences.json").write_text("[1, 2")
    with pytest.raises(InputRejected, match="not accepted"):
        generating.require_usable(Inputs(tmp_path / "clip.mp4"), config(name=NAME), tmp_path / "x.fluid")


@pytest.mark.parametrize(("answer", "accepted"), [("yes\n", True), ("no\n", False), ("\n", False)])
def test_at_a_terminal_the_terms_are_shown_and_asked_about(monkeypatch, capsys, answer, accepted):
    import io
    import sys

    from fluidlift.cli.generators import accepted_by_asking

    terminal = io.StringIO(answer)
    terminal.isatty = lambda: True
    monkeypatch.setattr(sys, "stdin", terminal)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    found = accepted_by_asking(config(name=NAME))
    assert (NAME in found.generate.accept_licence) == accepted
    assert "MIT" in capsys.readouterr().err


def test_a_use_that_the_terms_forbid_is_refused_and_names_who_allows_it(tmp_path):
    inputs, folder = Inputs(tmp_path / "clip.mp4"), tmp_path / "x.fluid"

    def usable(name, use):
        return generating.require_usable(inputs, config(name=name, use=use, accept_licence=(name,)), folder)

    with pytest.raises(InputRejected, match="forbid") as refused:
        usable("sharp", "commercial")
    assert NAME in str(refused.value)
    assert usable("sharp", "research") == [] and usable(NAME, "commercial") == []
    (warning,) = usable("sharp", None)
    assert "commercially" in warning


# what else is refused -------------------------------------------------------------------------------------------


def test_a_generator_that_is_not_installed_is_said_with_its_commands_before_anything_is_read(
    stream_clip, tmp_path, capsys
):
    folder = tmp_path / "x.fluid"
    code = main(["make", str(stream_clip), "-o", str(folder), "--generator", NAME, "--accept-licence", NAME])
    said = capsys.readouterr().err
    assert code == FAILED and "not installed" in said and "--generator-python" in said
    assert generators.card_of(NAME).install[0] in said
    assert not folder.exists()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--generator", "dreamer"], "unknown generator 'dreamer'"),
        (["--generator", NAME, "--geometry-from", "."], "--geometry-from"),
        (["--generator", NAME, "--depth", "depth.exr"], "--depth"),
        (["--generator", NAME, "--generator-python", "/not/there/python"], "/not/there/python"),
        (["--generator", NAME, "--set", "generate.frame_seconds=0"], "generate.frame_seconds"),
    ],
)
def test_options_that_cannot_be_meant_are_rejected(stream_clip, tmp_path, capsys, options, said):
    folder = tmp_path / "x.fluid"
    assert main(["make", str(stream_clip), "-o", str(folder), "--accept-licence", NAME, *options]) == REJECTED
    assert said in capsys.readouterr().err and not folder.exists()


def test_the_generator_is_part_of_the_settings(stream_clip, capsys):
    given = ["--generator", NAME, "--generator-python", "env/bin/python", "--use", "research"]
    assert main(["make", str(stream_clip), "--print-config", *given]) == DONE
    shown = yaml.safe_load(capsys.readouterr().out)["generate"]
    assert (shown["name"], shown["python"], shown["use"]) == (NAME, "env/bin/python", "research")


# a generator's folder -------------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path):
    """Bodies of frames 4 and 6, seen by cameras that look 20 and 30 degrees down."""
    note = {"name": "x", "metric": False, "knows_up": True, "frames": [4, 6], "licence": "free"}
    write_json(tmp_path / NOTE, note)
    for frame, tilt in ((4, 20.0), (6, 30.0)):
        eye = 2 * np.array([0, -np.cos(np.radians(tilt)), np.sin(np.radians(tilt))])
        write_json(tmp_path / f"{frame:04d}.json", PinholeCamera.looking(eye, np.zeros(3), 40, (96, 64)).to_dict())
        body = Gaussians.isotropic(np.eye(3) * frame, 0.1, np.full((3, 3), 0.5))
        write_gaussians(tmp_path / f"{frame:04d}.ply", body)
    return tmp_path


def test_a_frame_without_a_body_takes_the_nearest_that_has_one(folder):
    found = given_bodies(folder, (96, 64), [4, 5, 6, 9])
    assert [round(float(b.means.max())) for b in found.bodies] == [4, 4, 6, 6]
    assert len({c.camera_from_world.rotation.tobytes() for c in found.cameras}) == 2


def test_the_vertical_of_a_generator_counts_only_where_it_knows_it(folder):
    clip = UpEvidence(5.0, 0.0, "default", 0.1)
    found = up_of(folder, clip, "pour", 4, (96, 64))
    assert found.pitch == pytest.approx(20.0) and found.source == "generator" and found.confidence < 1
    note = json.loads((folder / NOTE).read_text())
    write_json(folder / NOTE, note | {"knows_up": False})
    assert up_of(folder, clip, "pour", 4, (96, 64)) is None
    (folder / NOTE).unlink()  # a user's folder, whose camera is that of the clip
    assert up_of(folder, clip, "pour", 4, (96, 64)) == clip


@pytest.mark.parametrize(
    "changes",
    [
        {"frames": []}, {"frames": ["a", 1]}, {"frames": 3.5}, {"frames": [-1]}, {"frames": [True]}, {"frames": None},
        {"metric": "no"}, {"knows_up": 1},
    ],
)  # fmt: skip
def test_a_note_that_no_generator_wrote_is_refused(folder, changes):
    write_json(folder / NOTE, json.loads((folder / NOTE).read_text()) | changes)
    with pytest.raises(InputRejected, match="not what a generator wrote"):
        given_bodies(folder, (96, 64), [4])


@pytest.mark.parametrize(("tilt", "stands"), [(0, False), (20, False), (70, True), (90, True)])
def test_a_stream_that_a_generator_set_on_edge_is_not_believed(folder, tilt, stands):
    """A sheet 1 x 1 x 0.05 turned about x; a pour may stand as it likes."""
    sheet = np.random.default_rng(0).uniform(-0.5, 0.5, (500, 3)) * [1, 1, 0.05]
    c, s = np.cos(np.radians(tilt)), np.sin(np.radians(tilt))
    turned = sheet @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]]).T
    body_of = Gaussians.isotropic(turned, 0.02, np.full((500, 3), 0.5))
    # uniform noise in three directions of a few hundred points: a degree
    assert tilt_of_sheet(body_of) == pytest.approx(tilt, abs=1.0)
    write_gaussians(folder / "0004.ply", body_of)
    clip = UpEvidence(5.0, 0.0, "default", 0.1)
    assert (up_of(folder, clip, "stream", 4, (96, 64)) is None) == stands
    assert up_of(folder, clip, "pour", 4, (96, 64)) is not None


def test_a_body_that_is_no_sheet_has_no_tilt():
    block = Gaussians.isotropic(np.random.default_rng(0).normal(size=(500, 3)), 0.02, np.full((500, 3), 0.5))
    assert tilt_of_sheet(block) == 0.0


def test_bodies_that_were_kept_are_those_that_the_generator_made(run, tmp_path):
    run("second: crash")
    (kept,) = (tmp_path / "x.fluid" / "work" / "generate").glob("*/*.ply")
    assert kept.with_suffix(".json").is_file() and len(read_gaussians(kept)) > 100
