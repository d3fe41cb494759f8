"""The Blender extension: an asset arrives upright, in metres and on its frames, and is changed from the panel.

The Blenders that are tried: the program `blender` on the PATH, and, where FLUIDLIFT_BPY names a Python that has the
module bpy, that one as well.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from fluidlift.backends.mitsuba_scene import medium
from fluidlift.io.asset_folder import load_asset, read_manifest, update_manifest
from fluidlift.io.ply import read_mesh
from fluidlift.io.scene import read_edits
from fluidlift.look.materials import HONEY
from fluidlift.scene.splat_files import frame_file, frame_files, read_frame

ROOT = Path(__file__).resolve().parents[2]
FRAMES = 4


def blender(kind):
    """How a Python script is run inside a Blender."""
    if kind == "program":
        found = shutil.which("blender")
        if found is None:
            pytest.skip("no program 'blender' on this machine")
        return [found, "-b", "--factory-startup", "--python-exit-code", "1", "--python"]
    found = os.environ.get("FLUIDLIFT_BPY")
    if not found:
        pytest.skip("FLUIDLIFT_BPY names no Python with the module bpy")
    return [found]


@pytest.fixture(scope="module", params=["program", "module"])
def seen(request, made, tmp_path_factory):
    """What the extension did with a copy of a small asset."""
    call = blender(request.param)
    folder = shortened(shutil.copytree(made.folder, tmp_path_factory.mktemp("blender") / "copy.fluid"))
    before = (folder / "parameters.json").read_bytes()
    splats = {n: read_frame(frame_file(folder, n)) for n in (1001, last(folder))}
    command = Path(sys.executable).with_name("fluidlift")
    script = Path(__file__).with_name("in_blender.py")
    call += [str(script), "--", str(ROOT / "blender" / "fluidlift_asset"), str(folder), str(command)]
    done = subprocess.run(call, capture_output=True, text=True, timeout=1200)
    lines = [line for line in done.stdout.splitlines() if line.startswith("RESULT ")]
    assert done.returncode == 0 and lines, done.stdout[-3000:] + done.stderr[-3000:]
    assert "Warning" not in done.stderr, done.stderr
    return json.loads(lines[0].removeprefix("RESULT ")), folder, splats, before


def shortened(folder):
    """The asset with its first frames alone: what is exported for Blender takes as long as there are frames."""
    for file in frame_files(folder):
        if int(file.stem) > 1000 + FRAMES:
            file.unlink()
    update_manifest(folder, simulation=read_manifest(folder)["simulation"] | {"frames": FRAMES})
    return folder


def last(folder):
    return 1000 + read_manifest(folder)["simulation"]["frames"]


def test_all_parts_arrive(seen):
    assert {"fluid surface", "fluid splats", "clip camera", "terrain"} <= set(seen[0]["objects"])


def test_white_water_has_points_of_its_own_with_a_material_per_kind(seen):
    found = seen[0]["white"]
    assert found["materials"] == ["fluidlift spray", "fluidlift foam", "fluidlift bubbles"]
    assert found["points"] == [0, 3]
    assert found["told"]["kind"] == [0, 1, 2] and found["told"]["id"] == [2**29, 2**29 + 1, 2**29 + 2]
    assert found["told"]["radius"] == [0.25] * 3 and found["told"]["opacity"] == [0.5] * 3
    assert found["velocity"] == [[0.0, float(k), 0.0] for k in range(3)]
    drawn = {name: (places, radii, moves) for name, places, radii, moves in found["drawn"]}
    for k, name in enumerate(found["materials"]):
        assert drawn[name] == ([[float(k), 0.0, 1.0]], [0.375], True)  # 1.5 times the splat's own
    # a refresh changes nothing of it; without white water it goes
    assert found["kept"] == [1, 3, [1.0, 0.0, 0.0, 1.0]] and found["gone"]


def test_frames_and_rate_are_those_of_the_asset(seen, made):
    found, asset = seen[0], load_asset(made.folder)
    assert found["range"] == [1001, 1000 + FRAMES]
    assert found["rate"] == pytest.approx(1 / asset.interval, rel=1e-4)
    # Blender keeps its numbers in single precision
    assert found["viscosity"] == pytest.approx(asset.parameters.kinematic_viscosity, rel=1e-5)


@pytest.mark.parametrize("which", ["first", "last"])
def test_splats_arrive_in_metres_upright_with_velocities(seen, which):
    found, _, splats, _ = seen
    number = min(splats) if which == "first" else max(splats)
    means = splats[number].gaussians.means
    speed = splats[number].velocities
    got = found[which]["splats"]
    assert got["vertices"] == len(means)
    np.testing.assert_allclose([got["low"], got["high"]], [means.min(0), means.max(0)], atol=1e-6)
    # both are means of single precision numbers, added in another order
    np.testing.assert_allclose(got["velocity"], speed.mean(0), atol=1e-5 + 1e-4 * np.abs(speed).max())


def test_the_surface_is_that_of_the_export(seen):
    found, folder, _, _ = seen
    exported = read_mesh(folder / "blender" / "surface" / f"{found['after'][1]}.ply")
    got = found["changed"]["surface"]
    assert got["vertices"] == len(exported.vertices) and got["faces"] == len(exported.faces)
    np.testing.assert_allclose(got["low"], np.asarray(exported.vertices).min(0), atol=1e-6)


def test_the_surface_of_one_frame_is_made_before_those_of_the_others(seen):
    found = seen[0]
    assert set(found["one at once"]) <= {"1002.ply"}  # the command for all may have begun by clearing it away
    assert found["all before a picture"] == found["after"][1] - 1000


def test_the_camera_stands_where_the_clips_stood(seen, made):
    asset, found = load_asset(made.folder), seen[0]["camera"]
    matrix = np.array(found["matrix"])
    np.testing.assert_allclose(matrix[:3, 3], asset.camera.position, atol=1e-5)
    # Blender looks along -z
    np.testing.assert_allclose(-matrix[:3, 2], asset.camera.camera_from_world.rotation[2], atol=1e-5)
    assert found["lens"] == pytest.approx(asset.camera.focal[0] * 36 / asset.camera.size[0], rel=1e-4)


def test_cycles_blurs_the_surface_by_its_velocities(seen):
    moving, still = seen[0]["blur"]
    assert still == 0  # the same samples of the same mesh
    # 1 m/s is a pixel per frame here, so only edges change: one channel in forty, by one step of 8 bits, is 1e-4
    assert moving > 1e-4


def test_cycles_shows_the_colours_of_the_vertices(seen):
    assert seen[0]["colors"]


def test_honey_is_the_medium_that_our_own_path_tracer_is_given(seen):
    extinction, share = medium(HONEY, np.zeros(3))
    found = seen[0]["honey"]
    density, *color, _ = found["ShaderNodeVolumeScatter"]
    scattered = density * np.array(color)
    density, *color, _ = found["ShaderNodeVolumeAbsorption"]
    absorbed = density * (1 - np.array(color))
    # single precision, of 1 - color where that is near 1
    np.testing.assert_allclose(scattered, extinction * share, rtol=1e-4)
    np.testing.assert_allclose(absorbed, extinction * (1 - share), rtol=1e-4)


def test_an_unlit_scene_gets_sun_and_sky(seen):
    assert seen[0]["light"] == ["fluidlift sky", 1]


def test_the_sun_is_not_counted_twice_through_clear_liquids(seen):
    # it shines straight through the surface; rays that were refracted must not meet it once more, as white specks
    assert seen[0]["sun refracted"] == [False]


def test_the_panel_and_the_menu_draw_what_they_offer(seen):
    drawn = seen[0]["panel"]
    assert {"Viscosity", "Density", "Gravity", "Inflow", "Duration", "Look", "Tint", "Simulate again"} <= set(drawn)
    assert drawn.count("Its density") == 1  # only of an obstacle that moves
    assert "Fluid asset (.fluid folder)" in drawn


def test_while_a_command_is_at_work_the_share_that_is_done_and_its_last_line_are_shown(seen):
    found = seen[0]["waited"]
    assert found["pointer"] == [[0, 100], 25.0, "end"]
    assert any("10 of 40, about 3 min left" in line for line in found["bar"][:-1])
    assert found["bar"][-1] is None  # the status bar is Blender's own again


def test_the_underside_of_the_liquid_lies_in_the_ground(seen, made):
    """Else a film of air is left between them, which throws the light back."""
    found, cell = seen[0]["contact"], load_asset(made.folder).grid.spacing
    assert 0.05 * found["points"] < found["moved"] < 0.7 * found["points"]  # of a shallow body about half looks down
    # at most one cell to the ground and three tenths of one into it, in single precision
    assert found["farthest"] < 1.301 * cell
    assert found["inside"] > 0.95 * found["moved"]  # beside creases the nearest place is on the other side


def test_the_panel_changes_what_was_changed_in_it_and_nothing_else(seen):
    found, folder, _, before = seen
    edits = read_edits(folder)
    assert set(edits.parameters) == {"kinematic_viscosity"}
    assert edits.parameters["kinematic_viscosity"] == pytest.approx(0.01, rel=1e-6)
    assert (edits.look.material, edits.look.style) == ("honey", "surface")
    assert [o.name for o in edits.obstacles] == ["ball"]  # removed, and the removal undone
    assert (folder / "parameters.json").read_bytes() == before
    assert found["told"] == "done"


def test_the_new_simulation_is_shown_and_what_a_person_did_to_the_objects_stays(seen):
    found = seen[0]
    assert found["after"] == [1001, 1003]
    assert found["changed"]["splats"]["vertices"] != found["last"]["splats"]["vertices"]
    assert found["material"][:3] == ["fluidlift source", "fluidlift honey", "fluidlift honey"]
    assert found["modifiers"] == ["fluidlift rests on the ground", "mine"]


def test_the_panel_goes_back_with_an_undo_of_what_it_changed(seen, made):
    found, fitted = seen[0], load_asset(made.folder).parameters.kinematic_viscosity
    before, after = found["undone"]
    assert before == [pytest.approx(0.01), "honey", pytest.approx(3 / found["rate"], rel=1e-5)]  # of another edit
    assert after == [pytest.approx(fitted, rel=1e-5), "source", 0.0]
    assert found["material"][3] == "fluidlift source"


def test_a_floating_obstacle_moves_as_it_was_simulated(seen):
    found, folder, _, _ = seen
    (body,) = json.loads((folder / "blender" / "surface" / "bodies.json").read_text())["bodies"]
    np.testing.assert_allclose(found["ball"], [body["poses"][k][:3] for k in (0, 2)], atol=1e-6)
    assert found["ball"][1][2] < found["ball"][0][2] - 0.001  # it falls onto the water


def test_an_obstacle_has_the_colours_of_its_file(seen):
    material, color = seen[0]["painted"]
    assert material == "fluidlift obstacle"
    # sRGB (255, 204, 26) / 255 in linear light, as Blender keeps colours; single precision
    np.testing.assert_allclose(color, [1.0, 0.60383, 0.01033], atol=1e-5)


def test_an_obstacle_whose_motion_is_not_at_hand_is_told_to_be_missing(seen):
    assert "they are left out" in seen[0]["warned"]


@pytest.mark.parametrize(
    ("which", "words"),
    [
        ("command", "was not found"),
        ("simulate", "pip install fluidlift"),
        ("folder", "is no asset"),
        ("twice", "give the object another name"),
    ],
)
def test_what_cannot_be_done_is_told_in_a_sentence(seen, which, words):
    assert words in seen[0]["refused"][which] and "Traceback" not in seen[0]["refused"][which]
