"""`fluidlift edit`: what it prints, what it changes, how it ends."""

import json
import shutil
import subprocess
import sys

import pytest

from fluidlift.cli import DONE, FAILED, REJECTED, WITH_WARNINGS, main

WELL = (DONE, WITH_WARNINGS)


@pytest.fixture
def asset(tmp_path):
    """A folder that is an asset as far as editing goes."""
    place = {"scale": 1.0, "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "translation": [0, 0, 0]}
    files = {name: f"rest/{name}" for name in ("gaussians", "terrain", "velocity", "camera", "parameters")}
    manifest = {
        "format": "fluidlift asset", "format_version": 1, "kind": "stream",
        "units": {"length": "m", "time": "s", "mass": "kg", "up": "z"},
        "frame_interval": 0.04, "frame_count": 10, "start_frame": 1001,
        "grid": {"shape": [10, 10, 5], "spacing": 0.1, "origin": [0, 0, 0]},
        "world_from_canonical": place, "files": files,
    }  # fmt: skip
    folder = tmp_path / "my river.fluid"
    folder.mkdir()
    (folder / "manifest.json").write_text(json.dumps(manifest))
    return folder


def edit(asset, *options):
    return main(["edit", str(asset), *options])


def test_an_edit_is_shown_as_lines_with_what_to_do_next(asset, capsys):
    assert edit(asset, "--set", "parameters.gravity=[0, 0, -1]", "--set", "look.exposure=1") in WELL
    said = capsys.readouterr().out
    assert "set parameters.gravity = [0, 0, -1]; set look.exposure = 1" in said
    assert "+  gravity: [0, 0, -1]" in said
    assert f"fluidlift sim '{asset}'" in said  # quoted for the shell, as the name has a space


def test_undo_redo_reset_and_history(asset, capsys):
    for value in (900, 800):
        assert edit(asset, "--set", f"parameters.density={value}") in WELL
    assert edit(asset, "--undo") in WELL
    capsys.readouterr()
    assert edit(asset, "--history", "--diff") in WELL
    said = capsys.readouterr().out
    assert "set parameters.density = 800  (undone)" in said
    assert "+  density: 900" in said
    assert edit(asset, "--redo") in WELL
    assert "density: 800" in (asset / "scene.yaml").read_text()
    assert edit(asset, "--reset") in WELL
    assert "density: 800" not in (asset / "scene.yaml").read_text()


def test_an_idle_look_is_told_once_and_edits_are_counted_without_gaps(asset, capsys):
    assert edit(asset, "--set", "parameters.density=900") in WELL
    assert edit(asset, "--undo") in WELL
    capsys.readouterr()
    assert edit(asset, "--set", "look.material=honey") == WITH_WARNINGS
    said = capsys.readouterr().out
    assert "look.material changes nothing while look.style is splats: set it to relit, transparent or surface" in said
    assert edit(asset, "--history") in WELL
    said = capsys.readouterr().out
    assert "look.style is splats" not in said
    assert [line.split()[0] for line in said.splitlines() if "  set " in line] == ["1", "2"]


def test_all_as_json(asset, capsys):
    assert edit(asset, "--material", "honey", "--json", "--diff", "--history") in WELL
    said = json.loads(capsys.readouterr().out)
    assert said["scene"]["look"] == {"style": "surface", "material": "honey"}
    assert set(said["stale"]) == {"simulate", "look"}
    assert (said["can_undo"], said["can_redo"], len(said["history"])) == (True, False, 1)
    assert said["edit"]["what"] == said["history"][0]["what"]


def test_a_value_after_a_material_stands_over_it(asset):
    assert edit(asset, "--set", "parameters.density=1500", "--material", "honey") in WELL
    text = (asset / "scene.yaml").read_text()
    assert "density: 1500" in text
    assert "kinematic_viscosity: 0.00704" in text


def test_a_viscosity_with_its_unit_is_kinematic_in_scene_yaml(asset):
    wanted = ("--set", "parameters.density=1400", "--set", "parameters.kinematic_viscosity=7 Pa s")
    assert edit(asset, *wanted) in WELL
    assert "kinematic_viscosity: 0.005" in (asset / "scene.yaml").read_text()
    assert edit(asset, "--set", "parameters.kinematic_viscosity=20 cSt") in WELL
    assert "kinematic_viscosity: 2.0e-05" in (asset / "scene.yaml").read_text()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--set", "parameters.density"), ["place=value"]),
        (("--set", "parameters.surface_tension=3 kg"), ["'3 kg'", "N/m, mN/m"]),
        (("--set", "parameters.density=-3"), ["-3", "kg/m^3"]),
        (("--set", "parameters.gravity=[0, 0"), ["no value", "quotes"]),
        (("--set", "parameters.densty=3"), ["write 'parameters.density'"]),
        (("--add", "obstacles=duck"), ["'duck'"]),
        (("--remove", "obstacles.duck"), ["no 'duck' in obstacles"]),
        (("--undo",), ["no edit to undo"]),
        (("--redo",), ["nothing to redo"]),
        (("--undo", "--redo"), ["--undo and --redo at once"]),
        (("--reset", "--set", "duration=3"), ["at once"]),
        (("--meshes", "nowhere", "--add", "obstacles={mesh: a.obj}"), ["a.obj"]),
    ],
)
def test_nonsense_is_refused_with_what_is_needed(asset, capsys, options, words):
    before = sorted(asset.rglob("*.yaml"))
    assert edit(asset, *options) == REJECTED
    said = capsys.readouterr().err
    assert [w for w in words if w not in said] == []
    assert sorted(asset.rglob("*.yaml")) == before


def test_a_folder_that_is_no_asset_is_refused(tmp_path, capsys):
    assert edit(tmp_path / "nothing.fluid") == REJECTED
    assert "is not a fluidlift asset" in capsys.readouterr().err


def test_a_folder_of_edits_that_is_a_link_is_refused(asset, tmp_path, capsys):
    (tmp_path / "elsewhere").mkdir()
    (asset / "edits").symlink_to(tmp_path / "elsewhere")
    assert edit(asset, "--set", "duration=3") == REJECTED
    assert "link" in capsys.readouterr().err
    shutil.rmtree(tmp_path / "elsewhere")


def test_simulate_does_what_the_edit_makes_necessary(asset, monkeypatch):
    from fluidlift import pipeline

    called = []
    monkeypatch.setattr(pipeline, "resimulate", lambda folder, **options: called.append(folder))
    assert edit(asset, "--set", "duration=3", "--simulate") in WELL
    assert called == [asset]


def test_a_simulation_that_breaks_down_names_the_edit_before_it(asset, monkeypatch, capsys):
    from fluidlift import pipeline
    from fluidlift.errors import FluidliftError

    def blow_up(folder, **options):
        raise FluidliftError("frame 1003: the simulation blew up.")

    monkeypatch.setattr(pipeline, "resimulate", blow_up)
    assert edit(asset, "--set", "parameters.gravity=[0, 0, -900]", "--simulate") == FAILED
    said = capsys.readouterr().err
    assert "blew up. The last edit was: set parameters.gravity = [0, 0, -900]" in said
    assert "--undo" in said


def test_what_a_fresh_asset_shows_is_told_without_building_the_scene(made, tmp_path):
    from fluidlift.scene.edits import EditSession

    asset = shutil.copytree(made.folder, tmp_path / "river.fluid")
    code = f"""
import sys
from fluidlift.cli import main
for options in (["--diff"], ["--history"], []):
    assert main(["edit", {str(asset)!r}, *options]) == 0
print("loaded:", *sorted(set(sys.modules) & {{"torch", "numba", "scipy", "cv2", "av", "pxr", "trimesh"}}))
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr
    assert run.stdout.splitlines()[-1] == "loaded:"
    assert run.stdout.count("the frames on disk show this scene") == 3
    assert EditSession.open(asset).stale() == set()  # and that is true


def test_looking_at_edits_and_taking_them_back_builds_no_scene_whose_state_is_not_known(made, tmp_path):
    """An asset that was copied, or met by a newer version: nothing is in memory."""
    from fluidlift.scene.edits import EditSession
    from fluidlift.scene.known_state import KNOWN

    asset = shutil.copytree(made.folder, tmp_path / "river.fluid")
    EditSession.open(asset).set("parameters.density", 900)
    (asset / KNOWN).unlink(missing_ok=True)
    code = f"""
import sys
from fluidlift.cli import main
for options in (["--diff"], ["--history"], ["--undo"], ["--redo"], ["--history", "--json"]):
    assert main(["edit", {str(asset)!r}, *options]) == 0
print("loaded:", *sorted(set(sys.modules) & {{"torch", "numba", "scipy", "cv2", "av", "pxr", "trimesh"}}))
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr
    assert run.stdout.splitlines()[-1] == "loaded:"
    assert run.stdout.count(f"whether the frames on disk show this scene: fluidlift edit {asset}") == 4
    assert '"stale": null' in run.stdout
    assert edit(asset) in WELL  # this looks
    assert EditSession.open(asset).known_standing() == {"simulate"}
