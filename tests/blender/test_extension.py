"""The Blender extension: an asset arrives upright, in metres and on its frames, and is changed from the panel."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from fluidlift.io.asset_folder import load_asset, read_manifest
from fluidlift.io.ply import read_mesh, read_splats
from fluidlift.io.scene import read_edits

ROOT = Path(__file__).resolve().parents[2]
BLENDER = shutil.which("blender")

pytestmark = pytest.mark.skipif(BLENDER is None, reason="no program 'blender' on this machine")


@pytest.fixture(scope="module")
def seen(made, tmp_path_factory):
    """What the extension did with a copy of a small asset."""
    folder = shutil.copytree(made.folder, tmp_path_factory.mktemp("blender") / "copy.fluid")
    before = (folder / "parameters.json").read_bytes()
    splats = {n: read_splats(folder / "frames" / "splats" / f"{n}.ply") for n in (1001, last(folder))}
    command = Path(sys.executable).with_name("fluidlift")
    script = Path(__file__).with_name("in_blender.py")
    call = [str(BLENDER), "-b", "--factory-startup", "--python-exit-code", "1", "--python", str(script), "--",
            str(ROOT / "blender" / "fluidlift_asset"), str(folder), str(command)]  # fmt: skip
    done = subprocess.run(call, capture_output=True, text=True, timeout=600)
    lines = [line for line in done.stdout.splitlines() if line.startswith("RESULT ")]
    assert done.returncode == 0 and lines, done.stdout[-3000:] + done.stderr[-3000:]
    return json.loads(lines[0].removeprefix("RESULT ")), folder, splats, before


def last(folder):
    return 1000 + read_manifest(folder)["simulation"]["frames"]


def test_all_parts_arrive(seen):
    found = seen[0]
    assert {"fluid surface", "fluid splats", "clip camera"} <= set(found["objects"])
    assert any("terrain" in name for name in found["objects"])


def test_frames_and_rate_are_those_of_the_asset(seen, made):
    found, asset = seen[0], load_asset(made.folder)
    assert found["range"] == [1001, last(made.folder)]
    assert found["rate"] == pytest.approx(1 / asset.interval, rel=1e-4)
    # Blender keeps its numbers in single precision
    assert found["viscosity"] == pytest.approx(asset.parameters.kinematic_viscosity, rel=1e-5)


@pytest.mark.parametrize("which", ["first", "last"])
def test_splats_arrive_in_metres_upright_with_velocities(seen, which):
    found, _, splats, _ = seen
    number = min(splats) if which == "first" else max(splats)
    means = splats[number].gaussians.means
    speed = np.stack([splats[number].extras[v] for v in ("vx", "vy", "vz")], -1)
    got = found[which]["splats"]
    assert got["vertices"] == len(means)
    np.testing.assert_allclose([got["low"], got["high"]], [means.min(0), means.max(0)], atol=1e-6)
    np.testing.assert_allclose(got["velocity"], speed.mean(0), atol=1e-5 + 1e-4 * np.abs(speed).max())


def test_the_surface_is_that_of_the_export(seen):
    found, folder, _, _ = seen
    exported = read_mesh(folder / "blender" / "surface" / f"{found['after'][1]}.ply")
    got = found["changed"]["surface"]
    assert got["vertices"] == len(exported.vertices) and got["faces"] == len(exported.faces)
    np.testing.assert_allclose(got["low"], np.asarray(exported.vertices).min(0), atol=1e-6)


def test_the_camera_stands_where_the_clips_stood(seen, made):
    asset, found = load_asset(made.folder), seen[0]["camera"]
    matrix = np.array(found["matrix"])
    np.testing.assert_allclose(matrix[:3, 3], asset.camera.position, atol=1e-5)
    # Blender looks along -z
    np.testing.assert_allclose(-matrix[:3, 2], asset.camera.camera_from_world.rotation[2], atol=1e-5)
    assert found["lens"] == pytest.approx(asset.camera.focal[0] * 36 / asset.camera.size[0], rel=1e-4)


def test_the_panel_changes_the_scene_and_not_the_fitted_values(seen):
    found, folder, _, before = seen
    edits = read_edits(folder)
    assert edits.parameters["kinematic_viscosity"] == pytest.approx(0.01, rel=1e-4)
    assert [o.name for o in edits.obstacles] == ["ball"]
    assert (folder / "parameters.json").read_bytes() == before
    assert found["told"] == "done"


def test_the_new_simulation_is_shown(seen):
    found = seen[0]
    assert found["after"] == [1001, 1003]
    assert found["changed"]["splats"]["vertices"] != found["last"]["splats"]["vertices"]
    assert "ball" in found["bodies"]


def test_a_wrong_command_is_told_in_a_sentence(seen):
    assert "was not found" in seen[0]["refused"] and "pip install fluidlift" in seen[0]["refused"]
