"""The extension's parts that need no Blender: they read what fluidlift writes, and know the same liquids."""

import ast
import importlib
import importlib.util
import json
import os
import subprocess
import sys
import tomllib
import zipfile
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from fluidlift.io.packed_splats import read_packed, write_packed
from fluidlift.io.ply import write_gaussians, write_mesh
from fluidlift.look.materials import PRESETS
from fluidlift.types import Gaussians, TriangleMesh

FOLDER = Path(__file__).resolve().parents[2] / "blender"


def part(name, folder=FOLDER / "fluidlift_asset"):
    """A module of the extension by itself: the package as a whole wants Blender."""
    spec = importlib.util.spec_from_file_location(f"extension_{name}", folder / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def meshing(monkeypatch):
    """The module that has surfaces made, in a Blender of which there is no more than it asks for."""
    timers, scene = [], SimpleNamespace(fluidlift=SimpleNamespace(told=""))
    fake = ModuleType("bpy")
    fake.app = SimpleNamespace(timers=SimpleNamespace(register=lambda call, first_interval: timers.append(call)))
    fake.context = SimpleNamespace(scene=scene)
    package = ModuleType("in_part")
    package.__path__ = [str(FOLDER / "fluidlift_asset")]
    monkeypatch.setitem(sys.modules, "bpy", fake)
    monkeypatch.setitem(sys.modules, "in_part", package)
    for name in ("in_part.command", "in_part.meshing"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    yield SimpleNamespace(module=importlib.import_module("in_part.meshing"), timers=timers, scene=scene)


def waiting_for(go: Path, end: str) -> list[str]:
    """A command that says how far it is, and ends so once a file is there."""
    code = f"""import pathlib, sys, time
print("[1/1] export: 10 of 40", flush=True)
while not pathlib.Path({str(go)!r}).exists(): time.sleep(0.01)
{end}"""
    return [sys.executable, "-c", code]


def test_surfaces_are_made_while_blender_goes_on(meshing, tmp_path):
    work, looks, ended = meshing.module.Meshing(), [], []
    work.begin(waiting_for(tmp_path / "go", "print('made')"), lambda: looks.append(1), ended.append)
    assert meshing.timers == [work.tick]
    while "25 %" not in meshing.scene.fluidlift.told:
        assert work.tick() == meshing.module.EVERY
    assert looks and not ended
    (tmp_path / "go").touch()
    work.wait()
    assert len(ended) == 1 and "made" in ended[0] and work.tick() is None
    assert meshing.scene.fluidlift.told == "surfaces: done"


def test_a_command_that_fails_or_is_replaced_ends_nothing(meshing, tmp_path):
    work, ended = meshing.module.Meshing(), []
    (tmp_path / "go").touch()
    work.begin(waiting_for(tmp_path / "go", "sys.exit('no disk')"), lambda: None, ended.append)
    work.wait()
    assert not ended and "no disk" in meshing.scene.fluidlift.told
    work.begin(waiting_for(tmp_path / "never", ""), lambda: None, ended.append)
    first = work.call
    work.begin(waiting_for(tmp_path / "never", ""), lambda: None, ended.append)
    assert first.process.returncode and work.call is not first
    work.stop()
    assert work.tick() is None and not ended


def test_meshes_and_splats_are_read_as_they_were_written(tmp_path):
    ply, rng = part("ply"), np.random.default_rng(0)
    mesh = TriangleMesh(rng.normal(size=(5, 3)), np.array([[0, 1, 2], [2, 3, 4]]), rng.uniform(size=(5, 3)))
    speed = rng.normal(size=(5, 3)).astype(np.float32)
    write_mesh(tmp_path / "a.ply", mesh, velocities=speed)
    table, faces = ply.read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(faces, mesh.faces)
    np.testing.assert_allclose(ply.columns(table, "x", "y", "z"), mesh.vertices, rtol=1e-6)
    np.testing.assert_array_equal(ply.columns(table, "vx", "vy", "vz"), speed)
    assert ply.columns(table, "nx") is None
    splats = Gaussians.isotropic(rng.normal(size=(7, 3)), 0.02, np.full((7, 3), 0.5))
    write_gaussians(tmp_path / "b.ply", splats, ids=np.arange(7), velocities=np.zeros((7, 3), np.float32))
    table, faces = ply.read_ply(tmp_path / "b.ply")
    assert len(faces) == 0 and (table["id"] == np.arange(7)).all()
    np.testing.assert_allclose(np.exp(table["scale_0"]), 0.02, rtol=1e-5)


def test_packed_frames_are_read_as_fluidlift_reads_them(tmp_path):
    packed, rng, n = part("packed"), np.random.default_rng(0), 300
    splats = Gaussians.isotropic(rng.normal(size=(n, 3)), 0.02, rng.uniform(size=(n, 3)), rng.uniform(0.1, 0.9, n))
    for degree in (0, 2):
        sh = np.concatenate([splats.sh, rng.normal(size=(n, (degree + 1) ** 2 - 1, 3))], axis=1)
        path = tmp_path / f"{degree}.flsp"
        write_packed(path, replace(splats, sh=sh), ids=np.arange(n) * 7 - 3, velocities=rng.normal(size=(n, 3)))
        table, own = packed.read_packed(path), read_packed(path)
        for names, values in (
            ("x y z", own.gaussians.means), ("vx vy vz", own.velocities),
            ("f_dc_0 f_dc_1 f_dc_2", own.gaussians.sh[:, 0]),
            ("scale_0 scale_1 scale_2", np.log(own.gaussians.scales)),
        ):  # fmt: skip
            found = part("ply").columns(table, *names.split())
            np.testing.assert_allclose(found, values, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(1 / (1 + np.exp(-table["opacity"])), own.gaussians.opacities, rtol=1e-5)
        np.testing.assert_array_equal(part("ply").whole_numbers(table, "id"), own.ids)


def test_a_packed_frame_that_is_damaged_or_lies_is_refused(tmp_path):
    g, path = Gaussians.isotropic(np.eye(3), 0.02, np.full((3, 3), 0.5)), tmp_path / "a.flsp"
    data = write_packed(path, g, ids=np.arange(3), velocities=np.eye(3)).read_bytes()
    claims = data[:8] + (5_000_000).to_bytes(4, "little") + data[12:]
    for bad, words in (
        (data[:40], "no packed frame"), (b"PLSF" + data[4:], "no packed frame"), (data[:-20], "damaged|too early"),
        (data[:4] + b"\x02" + data[5:], "version 2"), (claims, "damaged"), (data[:8] + b"\xff" * 4 + data[12:], "says"),
    ):  # fmt: skip
        path.write_bytes(bad)
        with pytest.raises(ValueError, match=words):
            part("packed").read_packed(path)


def test_a_frame_is_the_packed_one_or_where_that_is_not_there_the_ply_of_an_older_version(tmp_path):
    facts = part("facts")
    for name in ("1001.ply", "1002.flsp", "1003.ply", "1003.flsp"):
        (tmp_path / name).write_text("")
    assert [facts.frame_of(tmp_path, n).suffix for n in facts.frames(tmp_path)] == [".ply", ".flsp", ".flsp"]
    assert facts.frames(tmp_path, ".vdb") == range(1001, 1001)


@pytest.mark.parametrize(("cut", "words"), [(-20, "ends before"), (2, "no PLY")])
def test_a_file_that_is_being_written_is_refused(tmp_path, cut, words):
    mesh = TriangleMesh(np.eye(3), np.array([[0, 1, 2]]))
    data = write_mesh(tmp_path / "a.ply", mesh).read_bytes()
    (tmp_path / "a.ply").write_bytes(data[:cut])
    with pytest.raises(ValueError, match=words):
        part("ply").read_ply(tmp_path / "a.ply")


def test_the_panel_takes_over_what_scene_yaml_holds_after_an_undo():
    edits, facts = part("edits"), part("facts")
    fitted = {"kinematic_viscosity": 1e-5, "density": 998.0, "gravity": [0, 0, -9.81], "inflow_velocity": [1, 0, 0]}
    known = facts.Facts(0.04, fitted | {"density": 1420.0}, "honey", (1.0, 1.0, 1.0), 0.05, fitted)
    panel = SimpleNamespace(duration=3.0, material="honey", tint=(1.0, 1.0, 1.0))
    scene = {"parameters": {"kinematic_viscosity": 1e-3}, "look": {"style": "relit", "material": "oil"}, "duration": 2}
    edits.read_scene(panel, known, "a line before\n" + json.dumps({"scene": scene}, indent=1) + "\n")
    assert (panel.viscosity, panel.density, panel.duration, panel.material) == (1e-3, 998.0, 2.0, "oil")
    assert edits.changes(panel) == []  # nothing is left to write
    edits.read_scene(panel, known, json.dumps({"scene": {"look": None, "parameters": None}}))
    assert (panel.viscosity, panel.duration, panel.material) == (1e-5, 0.0, "source")
    for told in ("", "error", '{"asset": 1}'):
        with pytest.raises(RuntimeError, match="press Refresh"):
            edits.read_scene(panel, known, told)


def test_frames_end_where_one_is_missing_and_an_older_export_is_made_anew(tmp_path):
    facts, source, made = part("facts"), tmp_path / "source", tmp_path / "made"
    for folder in (source, made):
        folder.mkdir()
        for number in (1001, 1002, 1004):
            (folder / f"{number}.ply").write_text("")
    assert facts.frames(source) == range(1001, 1003) and len(facts.frames(tmp_path)) == 0
    assert facts.up_to_date(made, source, ".ply")
    (made / "1003.ply").write_text("")
    assert not facts.up_to_date(made, source, ".ply")  # frames of a longer simulation
    (made / "1003.ply").unlink()
    os.utime(made / "1002.ply", (0, 0))
    assert not facts.up_to_date(made, source, ".ply")


@pytest.mark.parametrize(
    ("files", "words"),
    [
        (None, "There is no folder"),
        ({}, "no manifest.json"),
        ({"manifest.json": "{", "parameters.json": "{}"}, "cannot be read"),
        ({"manifest.json": "{}"}, "cannot be read"),
        ({"manifest.json": "{}", "parameters.json": '{"values": {}}'}, "does not say"),
        ({"manifest.json": "[]", "parameters.json": "{}"}, "does not say"),
    ],
)
def test_a_folder_that_is_no_sound_asset_is_told_in_a_sentence(tmp_path, files, words):
    facts, folder = part("facts"), tmp_path / "a.fluid"
    for name, text in (files or {}).items():
        folder.mkdir(exist_ok=True)
        (folder / name).write_text(text)
    if files == {}:
        folder.mkdir()
    with pytest.raises(RuntimeError, match=words):
        facts.read_facts(facts.require_asset(folder))


def test_the_look_of_the_frames_is_read(tmp_path):
    facts = part("facts")
    (tmp_path / "parameters.json").write_text('{"values": {"density": 1000}}')
    for look, material in (
        ({"style": "surface", "material": "honey", "tint": [1, 0.5, 1]}, "honey"),
        ({"style": "splats"}, "source"),
        (None, "source"),
    ):
        played = {"frame_interval": 0.04, "parameters": {"density": 900}} | ({"look": look} if look else {})
        told = {"frame_interval": 0.02, "grid": {"spacing": 0.1}, "simulation": played}
        (tmp_path / "manifest.json").write_text(json.dumps(told))
        found = facts.read_facts(tmp_path)
        assert found.cell == 0.1
        assert (found.material, found.interval, found.parameters["density"]) == (material, 0.04, 900)
        assert found.tint == ((1.0, 0.5, 1.0) if material == "honey" else (1.0, 1.0, 1.0))


BODY = {"name": "ball", "mesh": "bodies/01_ball.ply", "first": 1001, "poses": [[0, 0, 1, 1, 0, 0, 0]]}


@pytest.mark.parametrize(
    ("told", "words"),
    [
        ("{", "cannot be read"),
        ("[1]", "no list of bodies"),
        ('{"bodies": 3}', "no list of bodies"),
        ({"name": "ball"}, "body 1 is not whole"),
        (BODY | {"poses": []}, "seven finite numbers"),
        (BODY | {"poses": [[0, 0, 1]]}, "seven finite numbers"),
        (BODY | {"poses": [[float("nan")] * 7]}, "seven finite numbers"),
        (BODY | {"first": "soon"}, "body 1 is not whole"),
        (BODY | {"mesh": 3}, "body 1 is not whole"),
        *((BODY | {"mesh": m}, "only files bodies") for m in (
            "/etc/passwd", "../a.ply", "bodies/../a.ply", "bodies/../../a.ply", "/bodies/a.ply", "bodies/a.obj",
            "a.ply", "bodies/deep/a.ply", "bodies\\..\\..\\a.ply", "bodies/link.ply",
        )),
    ],
)  # fmt: skip
def test_a_list_of_obstacles_that_is_damaged_or_leads_elsewhere_is_refused(tmp_path, told, words):
    folder = tmp_path / "surface"
    (folder / "bodies").mkdir(parents=True)
    (tmp_path / "a.ply").write_text("")
    (folder / "bodies" / "link.ply").symlink_to(tmp_path / "a.ply")
    (folder / "bodies.json").write_text(told if isinstance(told, str) else json.dumps({"bodies": [told]}))
    with pytest.raises(RuntimeError, match=words):
        part("facts").read_bodies(folder)


def test_a_sound_list_of_obstacles_is_read(tmp_path):
    facts = part("facts")
    assert facts.read_bodies(tmp_path) == []
    (tmp_path / "bodies.json").write_text(json.dumps({"bodies": [BODY]}))
    (body,) = facts.read_bodies(tmp_path)
    assert body == ("ball", tmp_path / "bodies" / "01_ball.ply", 1001, [[0, 0, 1, 1, 0, 0, 0]])


def test_faces_of_vertices_that_are_not_there_are_refused(tmp_path):
    data = write_mesh(tmp_path / "a.ply", TriangleMesh(np.eye(3), np.array([[0, 1, 2]]))).read_bytes()
    (tmp_path / "a.ply").write_bytes(data[:-4] + np.int32(7).tobytes())
    with pytest.raises(ValueError, match="vertices that it does not have"):
        part("ply").read_ply(tmp_path / "a.ply")


def test_numbers_beyond_32_bits_are_held_at_the_ends_and_not_wrapped():
    table = np.array([(2**40,), (-(2**40),), (5,)], [("id", "<i8")])
    got = part("ply").whole_numbers(table, "id")
    assert got.dtype == np.int32 and got.tolist() == [2**31 - 1, -(2**31), 5]
    real = part("ply").whole_numbers(np.array([(3e9,), (np.nan,)], [("id", "<f4")]), "id")
    assert real.tolist() == [2**31 - 1, 0]
    assert part("ply").whole_numbers(table, "number") is None


def test_liquids_are_those_of_fluidlift():
    tree = ast.parse((FOLDER / "fluidlift_asset" / "materials.py").read_text())
    (table,) = (
        n.value for n in tree.body if isinstance(n, ast.Assign) and getattr(n.targets[0], "id", "") == "LIQUIDS"
    )
    liquids = {key.value: [ast.literal_eval(v) for v in call.args] for key, call in zip(table.keys, table.values)}
    assert set(liquids) == set(PRESETS)
    for name, m in PRESETS.items():
        own = [m.refractive_index, m.roughness, m.absorption, m.scattering, m.albedo, m.emission]
        assert liquids[name] + [(0.0, 0.0, 0.0)] * (6 - len(liquids[name])) == own, name


def test_the_zip_holds_the_extension_and_is_the_same_every_time(tmp_path):
    script = FOLDER / "pack.py"
    for name in "ab":
        subprocess.run([sys.executable, str(script), str(tmp_path / name)], check=True, capture_output=True)
    version = tomllib.loads((FOLDER / "fluidlift_asset" / "blender_manifest.toml").read_text())["version"]
    first, second = (tmp_path / n / f"fluidlift_asset-{version}.zip" for n in "ab")
    assert first.read_bytes() == second.read_bytes()
    names = zipfile.ZipFile(first).namelist()
    own = {f"fluidlift_asset/{p.name}" for p in (FOLDER / "fluidlift_asset").iterdir() if p.is_file()}
    assert set(names) == own and zipfile.ZipFile(first).testzip() is None


def test_all_say_the_same_version():
    manifest = tomllib.loads((FOLDER / "fluidlift_asset" / "blender_manifest.toml").read_text())
    project = tomllib.loads((FOLDER.parent / "pyproject.toml").read_text())["project"]
    tree = ast.parse((FOLDER / "fluidlift_asset" / "__init__.py").read_text())
    (info,) = (n.value for n in tree.body if isinstance(n, ast.Assign) and getattr(n.targets[0], "id", "") == "bl_info")
    told = ast.literal_eval(info)
    assert manifest["version"] == project["version"] == ".".join(str(v) for v in told["version"])
    assert manifest["blender_version_min"] == ".".join(str(v) for v in told["blender"])


def test_of_a_command_at_work_the_last_line_is_told_and_nothing_of_its_output_is_lost(monkeypatch):
    command = part("command")
    monkeypatch.setattr(command, "EVERY", 0.01)
    lines = [f"[1/1] export: {k} of 9" for k in range(1, 10)]
    script = "import sys, time\nfor k in range(1, 10):\n"
    script += " print(f'[1/1] export: {k} of 9', flush=True)\n time.sleep(0.03)"
    told = []
    said = command.run([sys.executable, "-c", script], told.append)
    assert said.splitlines() == lines  # though it was read while it was written
    shown = [line for line in told if line]
    assert shown and set(shown) <= set(lines) and shown == sorted(shown)
    shares = [command.share_done(line) for line in (lines[2], "[1/9] reading the clip ...", "flow: 0 of 0")]
    assert shares == [pytest.approx(1 / 3), None, None]
