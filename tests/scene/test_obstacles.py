"""Obstacles of scene.yaml reach the simulation, its checkpoints, the USD file and the preview."""

import shutil

import numpy as np
import pytest

from fluidlift.cli import DONE, REJECTED, WITH_WARNINGS, main
from fluidlift.evaluate import arrays_of_run
from fluidlift.io.asset_folder import load_asset, read_manifest
from fluidlift.io.export_mesh import write_obj
from fluidlift.io.video import read_clip
from fluidlift.numerics.solid_mesh import box_mesh
from fluidlift.physics.stepping import ParticleSimulator
from fluidlift.scene.splat_files import frame_files

WELL = (DONE, WITH_WARNINGS)


@pytest.fixture(scope="module")
def coarse(stream_clip, tmp_path_factory):
    """The small clip as a coarse asset of four frames."""
    folder = tmp_path_factory.mktemp("coarse") / "stream.fluid"
    options = ("--set", "shape.cells=14", "--set", "shape.refine_iterations=0", "--set", "motion.targets=1",
               "--set", "fit.max_seconds=0.5", "--set", "simulate.frames=4", "--set", "show.usd=false")  # fmt: skip
    assert main(["make", str(stream_clip), "-o", str(folder), "--size", "2", *options]) in WELL
    return folder


@pytest.fixture
def asset(coarse, tmp_path):
    """A copy of it."""
    return shutil.copytree(coarse, tmp_path / "stream.fluid")


def frames(folder):
    return {p.name: p.read_bytes() for p in frame_files(folder)}


def put(folder, text):
    (folder / "scene.yaml").write_text(text)


def raft(folder, **more):
    """A box, two cells wide, that drops into the middle of the water."""
    asset = load_asset(folder)
    h, means = asset.grid.spacing, asset.rest.means
    x, y = np.median(means[:, :2], axis=0)
    top = float(np.percentile(means[:, 2], 99))
    extra = "".join(f", {k}: {v}" for k, v in more.items())
    shape = f"shape: box, name: raft, size: [{2 * h}, {2 * h}, {1.5 * h}], position: [{x}, {y}, {top + h}]"
    put(folder, f"obstacles: [{{{shape}, density: 400, motion: free{extra}}}]")


@pytest.mark.parametrize(
    ("scene", "words"),
    [
        ("obstacles:\n  - mesh: open.obj\n    position: [0, 0, 0.1]\n", ["line 2", "open", "fill the holes"]),
        ("obstacles:\n  - mesh: inside_out.obj\n", ["line 2", "inside-out"]),
        ("obstacles:\n  - mesh: ../x.obj\n", ["line 2", "--meshes"]),
        ("obstacles:\n  - {shape: box, size: [1, 1, 1], densty: 3}\n", ["line 2", "write 'density'"]),
    ],
)
def test_an_obstacle_that_is_no_solid_is_rejected_before_anything_is_written(asset, capsys, scene, words):
    mesh = box_mesh(np.ones(3))
    write_obj(asset / "open.obj", type(mesh)(mesh.vertices, mesh.faces[1:]))
    write_obj(asset / "inside_out.obj", type(mesh)(mesh.vertices, mesh.faces[:, ::-1]))
    before = frames(asset)
    put(asset, scene)
    capsys.readouterr()
    assert main(["sim", str(asset)]) == REJECTED
    said = capsys.readouterr().err
    assert [w for w in words if w not in said] == []
    assert frames(asset) == before


def test_a_checkpoint_without_obstacles_is_refused_once_there_are_some(asset, capsys):
    raft(asset)
    assert main(["sim", str(asset), "--resume"]) == REJECTED
    assert "another obstacles" in capsys.readouterr().err


def test_a_raft_floats_and_the_usd_file_shows_where(asset):
    from pxr import Gf, Usd, UsdGeom

    raft(asset)
    assert (
        main(["sim", str(asset), "--set", "show.usd=true", "--set", "show.usd_frames=true", "--duration", "0.4"])
        in WELL
    )
    assert main(["validate", str(asset)]) == DONE
    assert read_manifest(asset)["simulation"]["obstacles"] == ["raft"]
    stage = Usd.Stage.Open(str(asset / "asset.usda"))
    prim = UsdGeom.Xformable(stage.GetPrimAtPath("/Fluid/Bodies/raft"))
    heights = [prim.ComputeLocalToWorldTransform(1001 + k).Transform(Gf.Vec3d(0, 0, 0))[2] for k in range(10)]
    h = load_asset(asset).grid.spacing
    # it falls into the water, and not through the bed; there it bobs, and stays afloat
    assert heights[0] - 0.3 * h > min(heights) > heights[0] - 3 * h
    assert max(heights) < heights[0] + 0.5 * h
    assert len(read_clip(asset / "preview.mp4")) == 10
    assert arrays_of_run(asset, read_manifest(asset)) == {}  # there is no raft in the clip to compare with


def test_a_simulation_with_a_raft_that_was_stopped_goes_on_bit_for_bit(asset, monkeypatch):
    raft(asset, velocity="[0.5, 0, 0]", angular_velocity="[0, 2, 0]")
    command = ["sim", str(asset), "--set", "show.usd=false", "--duration", "0.24", "--checkpoint-every", "2"]
    assert main(command) in WELL
    whole = frames(asset)
    advance, calls = ParticleSimulator.advance, []

    def stopping(self, duration):
        calls.append(duration)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return advance(self, duration)

    with monkeypatch.context() as patch:
        patch.setattr(ParticleSimulator, "advance", stopping)
        main([*command, "--restart"])
    assert main([*command, "--resume"]) in WELL
    assert frames(asset) == whole


def test_a_raft_outside_the_box_is_rejected_before_anything_is_written(asset, capsys):
    put(asset, "obstacles: [{shape: sphere, name: moon, radius: 0.1, position: [0, 0, 900], motion: free}]")
    before = frames(asset)
    assert main(["sim", str(asset)]) == REJECTED
    assert "moon" in capsys.readouterr().err
    assert frames(asset) == before
