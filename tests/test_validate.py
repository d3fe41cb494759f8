"""`fluidlift validate` finds what is wrong with an asset, says which file, and what to do."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from fluidlift.cli import DONE, FAILED, REJECTED, main
from fluidlift.errors import InputRejected
from fluidlift.io.asset_folder import load_asset, read_manifest, save_asset, update_manifest, write_parameters
from fluidlift.io.export_usd import write_usd
from fluidlift.io.ply import write_gaussians
from fluidlift.io.video import write_video
from fluidlift.scene.splat_files import frame_file, frame_files, read_frame, write_frame
from fluidlift.types import (
    CellType,
    Estimate,
    FaceVelocity,
    FluidAsset,
    FluidParameters,
    Gaussians,
    Grid,
    PinholeCamera,
    Similarity3,
    Terrain,
    TriangleMesh,
)
from fluidlift.validate import Finding, validate_asset

COUNT = 4
"""frames"""
DRIFT = (0.5, 0.0, 0.0)
"""m/s, of everything"""


def drifting_block(count: int = 300) -> FluidAsset:
    """A block of water that moves as one: its velocity has no divergence."""
    rng, grid = np.random.default_rng(0), Grid((8, 6, 5), 0.1, (0.0, 0.0, 0.0))
    cells = np.full(grid.shape, int(CellType.FLUID), np.uint8)
    cells[0], cells[-1] = CellType.INFLOW, CellType.OUTFLOW
    faces = [np.full(grid.face_shape(a), DRIFT[a], np.float32) for a in range(3)]
    means = rng.uniform(grid.low + 0.1, grid.high - 0.2, (count, 3)).astype(np.float32)
    ground = TriangleMesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32), np.array([[0, 1, 2]]))
    nodes = tuple(n + 1 for n in grid.shape)
    return FluidAsset(
        kind="stream", rest=Gaussians.isotropic(means, 0.02, np.full((count, 3), 0.5)), grid=grid, cell_types=cells,
        terrain=Terrain(grid, np.ones(nodes, np.float32), np.array([1.0, 0, 0]), ground),
        velocity=FaceVelocity(*faces), parameters=FluidParameters(),
        estimates={"density": Estimate(1000.0, 10.0, True, 1000.0, "kg/m^3", (980.0, 1020.0))},
        camera=PinholeCamera.looking(np.array([0.4, -3.0, 1.0]), np.zeros(3), 50, (64, 48)),
        world_from_canonical=Similarity3(), interval=0.04, frame_count=COUNT, provenance={},
    )  # fmt: skip


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """An asset with frames, USD and preview, as `make` leaves it."""
    folder, asset = tmp_path_factory.mktemp("assets") / "block.fluid", drifting_block()
    ids, velocities = np.arange(len(asset.rest)), np.tile(np.float32(DRIFT), (len(asset.rest), 1))
    save_asset(folder, asset)
    frames = []
    for k in range(COUNT):
        moved = dataclasses.replace(asset.rest, means=asset.rest.means + velocities * np.float32(0.04 * k))
        frames.append((moved, ids, velocities))
        write_frame(folder, 1001 + k, moved, ids=ids, velocities=velocities)
    write_usd(folder / "asset.usda", frames=frames, interval=0.04, camera=asset.camera)
    write_video(folder / "preview.mp4", np.zeros((COUNT, 48, 64, 3), np.uint8), 25.0)
    files = {"usd": "asset.usda", "preview": "preview.mp4"}
    update_manifest(folder, files=files, simulation={"frames": COUNT, "frame_interval": 0.04})
    return folder


@pytest.fixture
def folder(whole, tmp_path) -> Path:
    """A copy to spoil."""
    return Path(shutil.copytree(whole, tmp_path / "block.fluid"))


def failed(folder: Path) -> dict[str, Finding]:
    return {f.check: f for f in validate_asset(folder) if not f.passed}


def test_a_whole_asset_passes_every_check(whole):
    findings = validate_asset(whole)
    assert [f.line() for f in findings if not f.passed] == []
    assert len(findings) > 18 and len({f.check for f in findings}) == len(findings)
    assert not any(f.do for f in findings)


def test_every_failure_says_what_to_do_in_words_and_in_json(folder, capsys):
    frame_file(folder, 1002).unlink()
    assert main(["validate", str(folder)]) == FAILED
    assert "FAILED  splat frames are complete: frame 1002 is missing" in capsys.readouterr().out
    assert main(["validate", str(folder), "--json"]) == FAILED
    (told,) = (f for f in json.loads(capsys.readouterr().out) if not f["passed"])
    assert told["check"] == "splat frames are complete" and "fluidlift sim" in told["do"]
    assert Finding(**told).line().endswith(told["do"])


def test_a_whole_asset_is_told_to_be_so(whole, capsys):
    assert main(["validate", str(whole)]) == DONE
    assert "FAILED" not in capsys.readouterr().out


# files ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name",
    [
        "rest/gaussians.ply",
        "rest/camera.json",
        "rest/velocity.vdb",
        "parameters.json",
        "asset.usda",
        "rest/terrain.glb",
    ],
)
def test_an_altered_file_is_named(folder, name):
    path = folder / name
    path.write_bytes(path.read_bytes() + b"\n")
    finding = failed(folder)["files are as they were written"]
    assert finding.detail == f"'{name}' was changed" and finding.do


def test_the_scene_may_be_changed_by_a_person(folder):
    (folder / "scene.yaml").write_text("parameters: {kinematic_viscosity: 1e-3}\n")
    assert not failed(folder)


def test_a_missing_file_is_named_and_the_rest_is_still_looked_at(folder):
    (folder / "rest" / "velocity.npz").unlink()
    frame_file(folder, 1003).unlink()
    found = failed(folder)
    assert "'rest/velocity.npz' is missing" in found["files of the manifest are there"].detail
    assert {"parts can be read", "splat frames are complete"} <= found.keys()


def test_hashes_follow_what_is_written_through_the_library(folder):
    asset = load_asset(folder)
    before = read_manifest(folder)["hashes"]
    write_parameters(folder, FluidParameters(density=900.0), asset.estimates)
    after = read_manifest(folder)["hashes"]
    changed = {name for name in after if after[name] != before[name]}
    assert changed == {"parameters.json"} and not failed(folder)
    assert "scene.yaml" not in after and "preview.mp4" not in after


def test_an_asset_of_an_earlier_version_has_no_hashes_and_passes(folder):
    change(folder, hashes=None)
    assert not failed(folder)


def test_a_hash_of_a_file_outside_the_asset_is_not_looked_at(folder):
    change(folder, hashes={"../../secret": "0" * 64})
    assert not failed(folder)


def test_a_newer_format_is_refused_with_what_to_do(folder, capsys):
    change(folder, format_version=99)
    with pytest.raises(InputRejected, match="update fluidlift"):
        validate_asset(folder)
    assert main(["validate", str(folder)]) == REJECTED
    assert "version 99" in capsys.readouterr().err


# frames ---------------------------------------------------------------------------------------------------------


def rewrite(folder: Path, number: int, **changes) -> None:
    """Write one frame again with other ids, velocities or Gaussians."""
    splats = read_frame(frame_file(folder, number))
    given = changes.get("gaussians", lambda g: g)(splats.gaussians)
    ids, velocities = changes.get("ids", splats.ids), changes.get("velocities", splats.velocities)
    write_frame(folder, number, given, ids=ids, velocities=velocities)


def flat(g: Gaussians) -> Gaussians:
    return dataclasses.replace(g, scales=g.scales * np.float32([1, 1, 1e-6]))


@pytest.mark.parametrize(
    ("check", "changes"),
    [
        ("ids of every frame are unique", {"ids": np.zeros(300, int)}),
        ("ids stay with their particles", {"ids": np.roll(np.arange(300), 100)}),
        ("numbers of every frame are finite", {"velocities": np.full((300, 3), np.nan)}),
        ("covariances of every frame are positive definite", {"gaussians": flat}),
    ],
)
def test_a_fault_of_a_frame_in_the_middle_is_found_and_the_frame_is_named(folder, check, changes):
    rewrite(folder, 1002, **changes)
    found = failed(folder)
    assert found.keys() == {check} and frame_file(folder, 1002).name in found[check].detail


def test_a_frame_that_is_damaged_or_no_frame_of_ours_is_named(folder):
    frame_file(folder, 1002).write_bytes(frame_file(folder, 1002).read_bytes()[:500])
    frame_file(folder, 1003).unlink()
    write_gaussians(folder / "frames" / "splats" / "1003.ply", load_asset(folder).rest)  # without ids and velocities
    detail = failed(folder)["every frame can be read"].detail
    assert "1002.flsp" in detail and "'1003.ply' has no id, vx, vy, vz" in detail


def test_frames_of_an_older_version_are_as_good(folder):
    before = [read_frame(file) for file in frame_files(folder)]
    for number, (g, ids, velocities, *_) in enumerate(before, 1001):
        frame_file(folder, number).unlink()
        write_gaussians(folder / "frames" / "splats" / f"{number}.ply", g, ids=ids, velocities=velocities)
    assert [f.suffix for f in frame_files(folder)] == [".ply"] * COUNT
    assert failed(folder) == {}
    assert all(np.array_equal(read_frame(f).ids, b.ids) for f, b in zip(frame_files(folder), before))


def test_a_frame_that_is_there_twice_is_named(folder):
    g, ids, velocities, *_ = read_frame(frame_file(folder, 1002))
    write_gaussians(folder / "frames" / "splats" / "1002.ply", g, ids=ids, velocities=velocities)
    assert "frame 1002 is there twice" in failed(folder)["splat frames are complete"].detail


def test_frames_that_the_manifest_does_not_know_are_named(folder):
    shutil.copy(frame_file(folder, 1004), frame_file(folder, 1005))
    assert "frame 1005" in failed(folder)["splat frames are complete"].detail


def test_all_frames_missing_is_not_passed_over(folder):
    shutil.rmtree(folder / "frames")
    assert "frame 1001 is missing" in failed(folder)["splat frames are complete"].detail


# numbers, scene, USD, preview -----------------------------------------------------------------------------------


def test_an_estimate_outside_its_own_interval_is_found(folder):
    asset = load_asset(folder)
    odd = dataclasses.replace(asset.estimates["density"], value=2000.0)
    write_parameters(folder, asset.parameters, {"density": odd})
    assert "density = 2000" in failed(folder)["parameters and their uncertainties fit"].detail


@pytest.mark.parametrize(
    ("text", "words"),
    [("parameters: {densty: 3}\n", "density"), ("a: [\n", "YAML"), ("parameters: {restitution: 7}\n", "restitution")],
)
def test_a_scene_that_would_be_refused_is_told_before_it_is_simulated(folder, text, words):
    (folder / "scene.yaml").write_text(text)
    finding = failed(folder)["scene.yaml can be used"]
    assert words in finding.detail + finding.do


def test_what_lies_outside_the_domain_is_no_scene_that_can_be_used(folder):
    (folder / "scene.yaml").write_text("obstacles:\n  - {shape: sphere, position: [90, 0, 0], radius: 0.1}\n")
    found = failed(folder)["scene.yaml can be used"]
    assert "outside the domain" in found.detail and found.do


def test_faults_of_the_usd_file_are_told(folder):
    from pxr import Usd

    stage = Usd.Stage.Open(str(folder / "asset.usdc"))
    stage.GetPrimAtPath("/Fluid/Splats").GetAttribute("opacities").Set([2.0] * 300, 1002)
    stage.GetRootLayer().Save()
    assert "at 1002: opacities outside 0 to 1" in failed(folder)["USD"].detail
    update_manifest(folder, simulation={"frames": COUNT + 1})
    assert "4 frames in the file, 5 in the manifest" in failed(folder)["USD shows its frames"].detail
    update_manifest(folder, simulation={"frames": COUNT, "usd_frames": 1})
    assert "4 frames in the file, 1 in the manifest" in failed(folder)["USD shows its frames"].detail
    (folder / "asset.usdc").unlink()
    assert "asset.usdc" in failed(folder)["USD"].detail
    (folder / "asset.usda").write_text("nothing")
    assert "cannot be opened" in failed(folder)["USD"].detail


def test_a_preview_that_does_not_open_or_lacks_pictures_is_found(folder):
    update_manifest(folder, files={"preview": "preview.mp4"}, simulation={"frames": COUNT})
    write_video(folder / "preview.mp4", np.zeros((2, 48, 64, 3), np.uint8), 25.0)
    assert "2 pictures for 4 frames" in failed(folder)["preview opens"].detail
    (folder / "preview.mp4").write_bytes(b"no film")
    assert failed(folder).keys() == {"preview opens"}


def change(folder: Path, **values) -> None:
    """Entries of the manifest, by hand; None removes one."""
    data = json.loads((folder / "manifest.json").read_text())
    data.update(values)
    data = {k: v for k, v in data.items() if v is not None}
    (folder / "manifest.json").write_text(json.dumps(data))
