"""A finished asset is simulated again: from where it stopped, longer, with another liquid, without its clip."""

import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest

from fluidlift.cli import DONE, FAILED, REJECTED, WITH_WARNINGS, main
from fluidlift.errors import FluidliftError
from fluidlift.evaluate import arrays_of_run
from fluidlift.io.asset_folder import load_asset, read_manifest
from fluidlift.io.video import read_clip
from fluidlift.physics.stepping import ParticleSimulator
from fluidlift.scene import simulator, splat_files
from fluidlift.scene.splat_files import frame_files, read_frame

FRAMES = 6
WELL = (DONE, WITH_WARNINGS)


@pytest.fixture(scope="module")
def made(stream_clip, tmp_path_factory):
    """The small clip as a coarse asset of which the fit is worth nothing."""
    folder = tmp_path_factory.mktemp("coarse") / "stream.fluid"
    coarse = ("--set", "shape.cells=14", "--set", "shape.refine_iterations=0", "--set", "motion.targets=1",
              "--set", "fit.max_seconds=0.5", "--set", "simulate.frames=6", "--set", "show.usd=false")  # fmt: skip
    assert main(["make", str(stream_clip), "-o", str(folder), "--size", "2", *coarse]) in WELL
    return SimpleNamespace(clip=stream_clip, folder=folder, options=coarse)


@pytest.fixture
def asset(made, tmp_path):
    """A copy of the asset to simulate again."""
    return shutil.copytree(made.folder, tmp_path / "stream.fluid")


def sim(folder, *options):
    return main(["sim", str(folder), "--set", "show.usd=false", *options])


def frames(folder):
    return {p.name: p.read_bytes() for p in frame_files(folder)}


@pytest.fixture
def advances(monkeypatch):
    """How many frames were computed."""
    calls = []
    advance = ParticleSimulator.advance

    def counted(self, duration):
        calls.append(duration)
        return advance(self, duration)

    monkeypatch.setattr(ParticleSimulator, "advance", counted)
    return calls


def stop_at(monkeypatch, number, error):
    """The simulation is stopped while frame `number` is on its way."""
    advance = ParticleSimulator.advance
    calls = []

    def stopping(self, duration):
        calls.append(duration)
        if len(calls) == number:
            raise error
        return advance(self, duration)

    monkeypatch.setattr(ParticleSimulator, "advance", stopping)


# the same again ------------------------------------------------------------------------------------------------


def test_an_asset_that_did_not_change_is_not_simulated_again(asset, made, advances, capsys):
    assert sim(asset, "--json") in WELL
    found = json.loads(capsys.readouterr().out)
    assert not advances and found["frames"] == FRAMES
    assert all(found["stages"][name]["cached"] for name in ("simulate", "show"))
    assert frames(asset) == frames(made.folder)


def test_sim_makes_the_frames_that_make_made(asset, made, advances):
    assert sim(asset, "--restart") in WELL
    assert len(advances) == FRAMES - 1
    assert frames(asset) == frames(made.folder)


def test_a_simulation_that_was_stopped_goes_on_bit_for_bit(asset, made, monkeypatch, capsys):
    with monkeypatch.context() as patch:
        stop_at(patch, 5, KeyboardInterrupt())  # on the way to the sixth frame; checkpoints after 2 and 4
        assert sim(asset, "--restart", "--checkpoint-every", "2") == FAILED
    assert "goes on from there" in capsys.readouterr().err
    assert list(frames(asset)) == [f"{1001 + k}.flsp" for k in range(5)]
    calls = []
    advance = ParticleSimulator.advance
    monkeypatch.setattr(ParticleSimulator, "advance", lambda self, t: (calls.append(t), advance(self, t))[1])
    assert sim(asset, "--resume") in WELL
    assert len(calls) == FRAMES - 4
    assert frames(asset) == frames(made.folder)


def test_a_kill_while_a_frame_is_written_leaves_what_can_be_continued(asset, made, monkeypatch):
    write = splat_files.write_packed

    def killed(path, *args, **options):
        if path.stem == "1005":
            raise SystemExit(137)
        return write(path, *args, **options)

    with monkeypatch.context() as patch:
        patch.setattr(splat_files, "write_packed", killed)
        with pytest.raises(SystemExit):
            sim(asset, "--restart", "--checkpoint-every", "2")
    assert sim(asset, "--resume") in WELL
    assert frames(asset) == frames(made.folder)


def test_make_goes_on_with_a_simulation_that_was_stopped(asset, made, monkeypatch, advances):
    command = ["make", str(made.clip), "-o", str(asset), "--size", "2", *made.options]
    with monkeypatch.context() as patch:
        stop_at(patch, 5, KeyboardInterrupt())
        assert main([*command, "--force", "simulate", "--set", "simulate.checkpoint_every=3"]) == FAILED
    advances.clear()
    assert main(command) in WELL
    assert len(advances) == FRAMES - 3
    assert frames(asset) == frames(made.folder)


def test_a_finished_simulation_is_made_longer(asset, made, advances):
    assert sim(asset, "--duration", "0.12", "--restart") in WELL
    assert len(frames(asset)) == 3
    advances.clear()
    assert sim(asset, "--duration", "0.24", "--resume") in WELL
    assert len(advances) == 3
    assert frames(asset) == frames(made.folder)
    assert read_manifest(asset)["simulation"]["frames"] == FRAMES
    assert len(read_clip(asset / "preview.mp4")) == FRAMES


def test_a_shorter_one_takes_the_frames_that_are_there(asset, made, advances):
    assert sim(asset, "--duration", "0.16") in WELL
    assert not advances
    whole = frames(made.folder)
    assert frames(asset) == {name: whole[name] for name in list(whole)[:4]}
    assert main(["validate", str(asset)]) == DONE


# another scene -------------------------------------------------------------------------------------------------


def test_a_checkpoint_of_another_scene_is_refused_and_says_what_differs(asset, made, capsys):
    (asset / "scene.yaml").write_text("parameters: {kinematic_viscosity: 0.01}\n")
    capsys.readouterr()
    assert sim(asset, "--resume", "--seed", "3") == REJECTED
    said = capsys.readouterr().err
    assert "another parameters, another seed" in said and "--resume" in said
    assert frames(asset) == frames(made.folder)  # nothing was touched


def test_without_resume_another_scene_starts_at_the_first_frame(asset, made, advances):
    (asset / "scene.yaml").write_text("parameters: {kinematic_viscosity: 0.01}\nduration: 0.12\n")
    assert sim(asset) in WELL
    assert len(advances) == 2
    assert frames(asset)["1003.flsp"] != frames(made.folder)["1003.flsp"]
    simulation = read_manifest(asset)["simulation"]
    assert simulation["parameters"]["kinematic_viscosity"] == 0.01
    # the frames of the first scene are gone, although its result is still in the cache
    (asset / "scene.yaml").unlink()
    advances.clear()
    assert sim(asset, "--duration", "0.12") in WELL
    assert len(advances) == 2
    assert frames(asset)["1003.flsp"] == frames(made.folder)["1003.flsp"]


def test_twice_the_frames_per_second_show_the_same_motion_in_between(asset, made):
    assert sim(asset, "--fps", "50", "--duration", "0.24") in WELL
    slow, fast = sorted(frames(made.folder)), sorted(frames(asset))
    assert len(fast) == 2 * len(slow)
    splats = [read_frame(folder / "frames" / "splats" / name) for folder, name in
              ((made.folder, slow[4]), (asset, fast[8]))]  # fmt: skip
    _, i, j = np.intersect1d(*(s.ids for s in splats), return_indices=True)
    apart = np.linalg.norm(splats[0].gaussians.means[i] - splats[1].gaussians.means[j], axis=1)
    # other substeps, and turbulence that they seed: most particles stay within half a cell of each other
    assert np.median(apart) < 0.5 * load_asset(asset).grid.spacing
    assert read_manifest(asset)["simulation"]["frame_interval"] == pytest.approx(0.02)
    assert arrays_of_run(asset, read_manifest(asset)) == {}  # its pictures are of other times


def test_a_river_is_made_longer_downstream(asset, made):
    assert sim(asset, "--extend-downstream", "1.0", "--duration", "0.12") in WELL
    before, grid = load_asset(made.folder).grid, read_manifest(asset)["simulation"]["grid"]
    assert grid["shape"][0] == before.shape[0] + int(np.ceil(1.0 / before.spacing))
    last = read_frame(asset / "frames" / "splats" / "1003.flsp").gaussians.means
    assert (last[:, 0] > before.high[0] + 0.8).sum() > 50
    assert main(["validate", str(asset)]) == DONE
    # the asset itself stays as long as the clip shows it
    assert load_asset(asset).grid == before


def test_an_asset_without_its_work_folder_is_simulated_too(asset, made):
    shutil.rmtree(asset / "work")
    assert sim(asset) in WELL
    assert len(frames(asset)) == FRAMES
    assert read_clip(asset / "preview.mp4").size == (2 * 96, 64)  # no clip to show beside
    report = (made.folder / "report.html").read_bytes()
    assert (asset / "report.html").read_bytes() == report
    for name, data in frames(made.folder).items():  # the same motion; the look has no shading to stay in place
        one, two = read_frame(made.folder / "frames/splats" / name), read_frame(asset / "frames/splats" / name)
        # the skin takes its look from other places where no clip says what stands still
        means = [s.gaussians.means[s.ids % 2 == 0] for s in (one, two)]
        np.testing.assert_array_equal(*means, err_msg=f"{name} {len(data)}")


# what goes wrong -----------------------------------------------------------------------------------------------


def test_a_simulation_that_blows_up_keeps_the_frames_before(asset, made, monkeypatch, capsys):
    stop_at(monkeypatch, 4, FluidliftError("Step 5, substep 2: the simulation blew up. Use a smaller time_step."))
    assert sim(asset, "--restart") == FAILED
    said = capsys.readouterr().err
    for word in ("frame 1005", "substep 2", "time_step", "4 frames before it are kept"):
        assert word in said
    whole = frames(made.folder)
    assert frames(asset) == {name: whole[name] for name in list(whole)[:4]}
    manifest = read_manifest(asset)
    assert manifest["simulation"]["frames"] == 4
    assert any("frame 1005" in text for text in manifest["warnings"])
    assert len(read_clip(asset / "preview.mp4")) == 4


def test_after_a_failure_the_same_command_tries_again(asset, made, monkeypatch):
    with monkeypatch.context() as patch:
        stop_at(patch, 3, FluidliftError("no luck"))
        assert sim(asset, "--restart") == FAILED
    assert sim(asset) in WELL
    assert frames(asset) == frames(made.folder)
    assert not any("no luck" in text for text in read_manifest(asset)["warnings"])


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (["--duration", "-1"], "--duration"), (["--fps", "0"], "--fps"), (["--duration", "1e8"], "frames"),
        (["--set", "shape.cells=12"], "shape.cells"), (["--set", "simulate.particles=1"], "simulate.particles"),
        (["--extend-downstream", "-1"], "--extend-downstream"), (["--meshes", "nowhere"], "--meshes"),
        (["--resume", "--restart"], "--restart"), (["--extend-downstream", "1e5"], "GB"),
        (["--checkpoint-every", "0"], "simulate.checkpoint_every"),
    ],
    ids=lambda x: " ".join(x) if isinstance(x, list) else "",
)  # fmt: skip
def test_what_cannot_work_is_said_before_anything_is_written(asset, made, capsys, options, word):
    capsys.readouterr()
    assert sim(asset, *options) == REJECTED
    assert word in capsys.readouterr().err
    assert frames(asset) == frames(made.folder)


@pytest.mark.parametrize(
    ("scene", "word"),
    [
        ("parameters: {viscosity: 1}", "kinematic_viscosity"), ("obstacles: [{shape: cube}]", "line 1"),
        ("emitters: [{rate: 1}]", "line 1: an emitter"), ("\n\nduraton: 3", "line 3"),
        ("parameters: {density: -1}", "density"),
    ],
)  # fmt: skip
def test_a_scene_file_that_does_not_fit_is_rejected_with_its_line(asset, made, capsys, scene, word):
    (asset / "scene.yaml").write_text(scene)
    capsys.readouterr()
    assert sim(asset) == REJECTED
    assert word in capsys.readouterr().err
    assert frames(asset) == frames(made.folder)


def test_the_memory_that_is_there_is_compared_with_what_is_needed(asset, monkeypatch, capsys):
    monkeypatch.setattr(simulator, "available_memory", lambda: 10**6)
    assert sim(asset, "--restart") == REJECTED
    said = capsys.readouterr().err
    assert "cells" in said and "0.0 GB are free" in said


def test_a_folder_that_is_no_asset_is_rejected(tmp_path, capsys):
    assert sim(tmp_path) == REJECTED
    assert "manifest.json" in capsys.readouterr().err
