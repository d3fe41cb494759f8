"""The extension's parts that need no Blender: they read what fluidlift writes, and know the same liquids."""

import ast
import importlib.util
import json
import os
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import numpy as np
import pytest

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


@pytest.mark.parametrize(("cut", "words"), [(-20, "ends before"), (2, "no PLY")])
def test_a_file_that_is_being_written_is_refused(tmp_path, cut, words):
    mesh = TriangleMesh(np.eye(3), np.array([[0, 1, 2]]))
    data = write_mesh(tmp_path / "a.ply", mesh).read_bytes()
    (tmp_path / "a.ply").write_bytes(data[:cut])
    with pytest.raises(ValueError, match=words):
        part("ply").read_ply(tmp_path / "a.ply")


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
        (tmp_path / "manifest.json").write_text(json.dumps({"frame_interval": 0.02, "simulation": played}))
        found = facts.read_facts(tmp_path)
        assert (found.material, found.interval, found.parameters["density"]) == (material, 0.04, 900)
        assert found.tint == ((1.0, 0.5, 1.0) if material == "honey" else (1.0, 1.0, 1.0))


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
