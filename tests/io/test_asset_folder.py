"""An asset comes back as it was; a folder that is not ours, a broken disk or a hostile asset is refused."""

from __future__ import annotations

import errno
import itertools
import json
import os
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from fluidlift.errors import InputRejected
from fluidlift.io import asset_folder as af
from fluidlift.io import atomic
from fluidlift.io.asset_lock import writing
from fluidlift.io.atomic import atomic_path, write_bytes
from fluidlift.io.export_mesh import write_glb, write_obj
from fluidlift.io.stage_cache import Scratch
from fluidlift.types import FluidAsset, TriangleMesh


def assert_same(a: FluidAsset, b: FluidAsset) -> None:
    """Everything equal; what goes through the splat file up to float32's logarithms."""
    for name in ("means", "quats", "scales", "opacities", "sh"):
        np.testing.assert_allclose(getattr(a.rest, name), getattr(b.rest, name), rtol=2e-6, atol=2e-6)
    for x, y in zip(a.velocity.components, b.velocity.components):
        np.testing.assert_array_equal(x, y)
    np.testing.assert_array_equal(a.cell_types, b.cell_types)
    np.testing.assert_array_equal(a.terrain.signed_distance, b.terrain.signed_distance)
    np.testing.assert_array_equal(a.terrain.mesh.vertices, b.terrain.mesh.vertices)
    np.testing.assert_array_equal(a.terrain.mesh.faces, b.terrain.mesh.faces)
    np.testing.assert_array_equal(a.terrain.mesh.colors, b.terrain.mesh.colors)
    assert a.camera.to_dict() == b.camera.to_dict()
    np.testing.assert_array_equal(a.world_from_canonical.translation, b.world_from_canonical.translation)
    for name in ("kind", "grid", "parameters", "estimates", "interval", "frame_count", "provenance"):
        assert getattr(a, name) == getattr(b, name)
    assert a.terrain.grid == b.terrain.grid and a.world_from_canonical.scale == b.world_from_canonical.scale


@pytest.fixture
def folder(tmp_path, asset):
    """A saved asset."""
    return af.save_asset(tmp_path / "river.fluid", asset, warnings=["metric scale is a guess"], timings={"read": 0.5})


def test_an_asset_comes_back(folder, asset):
    assert_same(af.load_asset(folder), asset)
    manifest = af.read_manifest(folder)
    assert manifest["warnings"] == ["metric scale is a guess"] and manifest["timings"] == {"read": 0.5}
    for file in manifest["files"].values():
        assert (folder / file).is_file()
    needed = af.FILES.keys() - {"film", "force", "motion"}
    assert {af.FILES[name] for name in needed} == set(manifest["files"].values())
    assert not [p for p in folder.rglob("*") if ".part" in p.name]


def test_the_manifest_tells_nothing_about_the_machine(folder):
    assert str(folder.parent) not in (folder / "manifest.json").read_text()


def test_an_unknown_sigma_is_null_in_the_file_and_infinite_in_memory(folder):
    data = json.loads((folder / "parameters.json").read_text())
    assert data["estimates"]["density"]["sigma"] is None
    assert af.load_asset(folder).estimates["density"].sigma == np.inf


def test_saving_again_keeps_the_scene_that_a_person_edited(folder, asset):
    (folder / "scene.yaml").write_text("parameters: {kinematic_viscosity: 1e-3}\n")
    af.save_asset(folder, asset)
    assert af.read_scene(folder) == {"parameters": {"kinematic_viscosity": 1e-3}}


def test_the_first_scene_changes_nothing(folder):
    assert all(not value for value in af.read_scene(folder).values())


@pytest.mark.parametrize("text", ["a: [", "- 1\n- 2\n", "a: &x [1]\nb: *x\n", "a: !!python/object:os.system {}\n"])
def test_broken_and_hostile_scenes_are_refused(folder, text):
    (folder / "scene.yaml").write_text(text)
    with pytest.raises(InputRejected, match=r"scene\.yaml"):
        af.read_scene(folder)


def test_the_manifest_can_be_extended(folder):
    af.update_manifest(folder, files={"preview": "preview.mp4"}, metrics={"psnr": np.float32(30)}, warnings=["a"])
    manifest = af.read_manifest(folder)
    assert manifest["files"]["preview"] == "preview.mp4" and manifest["files"]["camera"] == "rest/camera.json"
    assert manifest["metrics"] == {"psnr": 30.0} and manifest["warnings"] == ["a"]
    with pytest.raises(InputRejected, match="inside its own folder"):
        af.update_manifest(folder, files={"preview": "../preview.mp4"})


def _change(folder, name: str, **values) -> None:
    data = json.loads((folder / name).read_text())
    data.update(values)
    (folder / name).write_text(json.dumps(data))


@pytest.mark.parametrize(
    "name",
    ["/etc/passwd", "../secret.ply", "rest/../../secret.ply", "C:\\secret.ply", "C:secret.ply", "\\\\host\\a",
     "rest\\..\\..\\a", ""],
)  # fmt: skip
def test_files_outside_the_folder_are_refused(folder, name):
    files = json.loads((folder / "manifest.json").read_text())["files"] | {"gaussians": name}
    _change(folder, "manifest.json", files=files)
    with pytest.raises(InputRejected):
        af.load_asset(folder)


def test_links_are_refused(folder, tmp_path):
    target = tmp_path / "secret.ply"
    os.replace(folder / "rest/gaussians.ply", target)
    (folder / "rest/gaussians.ply").symlink_to(target)
    with pytest.raises(InputRejected, match="link"):
        af.load_asset(folder)


def test_a_linked_folder_inside_is_refused(folder, tmp_path):
    os.replace(folder / "rest", tmp_path / "rest")
    (folder / "rest").symlink_to(tmp_path / "rest")
    with pytest.raises(InputRejected, match="link"):
        af.load_asset(folder)


def test_a_newer_format_is_refused(folder):
    _change(folder, "manifest.json", format_version=99)
    with pytest.raises(InputRejected, match="update fluidlift"):
        af.load_asset(folder)


@pytest.mark.parametrize(
    "change",
    [
        {"kind": "lava"}, {"frame_interval": 0}, {"frame_interval": "fast"}, {"format": "another"},
        {"grid": {"shape": [6, 5], "spacing": 0.1, "origin": [0, 0, 0]}}, {"files": {}},
        {"grid": {"shape": [6, 5, 9], "spacing": 0.1, "origin": [0, 0, 0]}},
    ],
)  # fmt: skip
def test_a_manifest_that_makes_no_sense_is_refused(folder, change):
    _change(folder, "manifest.json", **change)
    with pytest.raises(InputRejected):
        af.load_asset(folder)


@pytest.mark.parametrize("number", ["1e999", "NaN", "-Infinity", "1" + "0" * 400])
@pytest.mark.parametrize("file", ["manifest.json", "parameters.json"])
def test_numbers_that_are_not_finite_are_refused(folder, file, number):
    path = folder / file
    found = {"manifest.json": '"spacing": 0.1', "parameters.json": '"density": 1000.0'}[file]
    text = path.read_text()
    assert found in text
    path.write_text(text.replace(found, found.partition(":")[0] + f": {number}"))
    with pytest.raises(InputRejected, match="not finite"):
        af.load_asset(folder)


def test_an_oversize_manifest_is_refused_before_it_is_read(folder):
    with (folder / "manifest.json").open("ab") as file:
        file.truncate(17 * 2**20)
    with pytest.raises(InputRejected, match="at most"):
        af.load_asset(folder)


@pytest.mark.parametrize(
    ("part", "value"), [("density", -1), ("density", "heavy"), ("restitution", 2), ("color", 3), ("gravity", [0, 1])]
)
def test_parameters_out_of_range_are_refused(folder, part, value):
    data = json.loads((folder / "parameters.json").read_text())
    data["values"][part] = value
    (folder / "parameters.json").write_text(json.dumps(data))
    with pytest.raises(InputRejected):
        af.load_asset(folder)


def test_pickles_are_refused(folder):
    np.savez(
        folder / "rest/velocity.npz", u=np.array([{}], object), v=np.zeros(1), w=np.zeros(1), cell_types=np.zeros(1)
    )
    with pytest.raises(InputRejected, match="cannot be read"):
        af.load_asset(folder)


@pytest.mark.parametrize("file", ["rest/velocity.npz", "rest/terrain.npz", "rest/gaussians.ply", "rest/camera.json"])
def test_damaged_and_missing_parts_are_refused(folder, file):
    data = (folder / file).read_bytes()
    (folder / file).write_bytes(data[: len(data) // 2])
    with pytest.raises(InputRejected):
        af.load_asset(folder)
    (folder / file).unlink()
    with pytest.raises(InputRejected):
        af.load_asset(folder)


def test_a_folder_that_is_no_asset_is_refused(tmp_path):
    with pytest.raises(InputRejected, match="not a fluidlift asset"):
        af.load_asset(tmp_path)


def test_output_goes_to_new_empty_or_own_folders_only(tmp_path, folder):
    assert af.check_output_folder(tmp_path / "new.fluid") == tmp_path / "new.fluid"
    (tmp_path / "empty").mkdir()
    af.check_output_folder(tmp_path / "empty")
    af.check_output_folder(folder)
    af.save_stage(tmp_path / "begun", "read", "k", {}, {})
    af.check_output_folder(tmp_path / "begun")  # a run that was killed before its manifest
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos/manifest.json").write_text('{"name": "a web app"}')
    (tmp_path / "work-of-others/work").mkdir(parents=True)
    (tmp_path / "file").write_text("x")
    (tmp_path / "broken").symlink_to(tmp_path / "nowhere")
    for name in ("photos", "work-of-others", "file", "broken"):
        with pytest.raises(InputRejected):
            af.check_output_folder(tmp_path / name)


def test_whether_a_vessel_hides_what_it_holds_is_kept(tmp_path, asset):
    assert not af.load_asset(af.save_asset(tmp_path / "glass.fluid", asset)).terrain.opaque
    cup = replace(asset, terrain=replace(asset.terrain, opaque=True))
    assert af.load_asset(af.save_asset(tmp_path / "cup.fluid", cup)).terrain.opaque


def test_a_fluid_without_terrain_faces_can_be_saved(tmp_path, asset):
    from dataclasses import replace

    nothing = TriangleMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int64))
    bare = replace(asset, terrain=replace(asset.terrain, mesh=nothing))
    back = af.load_asset(af.save_asset(tmp_path / "a.fluid", bare))
    assert len(back.terrain.mesh.faces) == 0 and back.terrain.mesh.colors is None


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.bin"
    with af.atomic_write(path) as file:
        file.write(b"old")
    with pytest.raises(RuntimeError), af.atomic_write(path) as file:
        file.write(b"new")
        raise RuntimeError("broke")
    assert path.read_bytes() == b"old" and [p.name for p in tmp_path.iterdir()] == ["a.bin"]
    with atomic_path(tmp_path / "b.usdc") as name:
        assert name.suffix == ".usdc"
        name.write_bytes(b"x")
    assert (tmp_path / "b.usdc").read_bytes() == b"x"


def _ended() -> int:
    """The number of a process that is over."""
    done = subprocess.Popen([sys.executable, "-c", ""])
    done.wait()
    return done.pid


def test_what_a_killed_run_left_is_removed_by_the_next(tmp_path):
    gone, other = _ended(), os.getppid()
    names = (f".a.{gone}.1.part.bin", f".a.{other}.1.part.bin", f".a.{os.getpid()}.99999999.part.bin")
    for name in (*names, f".b.{gone}.1.part.bin", f".a.b.{gone}.part.bin"):
        (tmp_path / name).write_bytes(b"x")
    os.utime(tmp_path / names[2], (time.time() - 1e6,) * 2)  # of an earlier process with this one's number
    with af.atomic_write(tmp_path / "a.bin") as file:
        file.write(b"new")
    left = {names[1], f".b.{gone}.1.part.bin", f".a.b.{gone}.part.bin", "a.bin"}
    assert {p.name for p in tmp_path.iterdir()} == left


def test_a_run_removes_what_killed_runs_left_anywhere_in_the_asset(folder):
    left = [f"work/flow/.labels.{_ended()}.3.part.npy", f"frames/splats/.1001.{_ended()}.1.part.ply"]
    mine = f"work/flow/.labels.{os.getppid()}.3.part.npy"
    for name in (*left, mine):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"x")
    with writing(folder, "a test"):
        assert not any((folder / name).exists() for name in left)
        assert (folder / mine).exists()


def test_temporary_files_are_new_ones(tmp_path, monkeypatch):
    (tmp_path / "outside").write_bytes(b"kept")
    monkeypatch.setattr(atomic, "_COUNT", itertools.count(1))
    (tmp_path / f".a.{os.getpid()}.1.part.bin").symlink_to(tmp_path / "outside")
    write_bytes(tmp_path / "a.bin", b"new")
    assert (tmp_path / "outside").read_bytes() == b"kept"
    assert (tmp_path / "a.bin").read_bytes() == b"new" and not (tmp_path / "a.bin").is_symlink()


def test_what_cannot_be_made_again_is_on_the_disk_before_it_has_its_name(tmp_path, monkeypatch):
    calls: list[str] = []
    monkeypatch.setattr(atomic.os, "fsync", lambda file: calls.append("fsync"))
    replace = os.replace
    monkeypatch.setattr(atomic.os, "replace", lambda *a: (calls.append("replace"), replace(*a)))
    write_bytes(tmp_path / "a", b"x", lasting=True)
    assert calls == ["fsync", "replace", "fsync"]
    write_bytes(tmp_path / "b", b"x")
    assert calls[3:] == ["replace"]


@pytest.mark.skipif(sys.platform == "win32", reason="has no such limit")
def test_a_file_over_the_limit_is_said_like_a_full_disk(tmp_path):
    script = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))\n"
        "from fluidlift.errors import InputRejected\n"
        "from fluidlift.io.atomic import write_bytes\n"
        "try: write_bytes(sys.argv[1], bytes(2**20))\n"
        "except InputRejected as error: print(error)\n"
    )
    run = subprocess.run([sys.executable, "-c", script, str(tmp_path / "a")], capture_output=True, text=True)
    assert "larger than it may be" in run.stdout, run.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("number", "word"), [(errno.ENOSPC, "disk full"), (errno.EACCES, "cannot be written")])
def test_disk_errors_say_what_to_do(tmp_path, number, word):
    with pytest.raises(InputRejected, match=word), af.atomic_write(tmp_path / "a.bin"):
        raise OSError(number, os.strerror(number))
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(FileNotFoundError), af.disk_errors("a"):
        raise FileNotFoundError("something else is not hidden")


def test_too_little_space_is_noticed_before_the_work(tmp_path):
    af.require_free_space(tmp_path / "not" / "yet", 1)
    with pytest.raises(InputRejected, match="MB free"):
        af.require_free_space(tmp_path, 10**18)


def test_stage_results_come_back(tmp_path):
    arrays = {
        "flow": np.arange(6, dtype=np.float16).reshape(2, 3),
        "mask": np.array([True, False]),
        "file": np.zeros(0),
    }
    af.save_stage(tmp_path, "motion", "abc123", arrays, {"psnr": np.float64(3.5), "names": ("a", "b"), "bad": np.nan})
    found, meta = af.load_stage(tmp_path, "motion", "abc123")
    assert set(found) == set(arrays) and meta == {"psnr": 3.5, "names": ["a", "b"], "bad": None}
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == array.dtype
    assert af.load_stage(tmp_path, "motion", "other") is None
    assert af.load_stage(tmp_path, "shape", "abc123") is None


@pytest.mark.parametrize("suffix", [".npz", ".json"])
@pytest.mark.parametrize("damage", ["cut", "flip", "gone", "empty"])
def test_damaged_caches_count_as_absent(tmp_path, suffix, damage):
    af.save_stage(tmp_path, "s", "k", {"a": np.arange(1000.0)}, {})
    path = tmp_path / "work" / "s" / f"k{suffix}"
    data = path.read_bytes()
    if damage == "gone":
        path.unlink()
    else:
        middle = len(data) // 2
        flipped = data[:middle] + bytes([data[middle] ^ 0xFF]) + data[middle + 1 :]
        path.write_bytes({"cut": data[:middle], "flip": flipped, "empty": b""}[damage])
    assert af.load_stage(tmp_path, "s", "k") is None


def scratched(folder, key="k"):
    """A stage that wrote its array in parts."""
    scratch = Scratch(folder, "flow")
    flow = scratch.array("flow", (5, 3), np.float16)
    for t in range(5):
        flow[t] = t
    scratch.array("notes", (7,), np.uint8)
    af.save_stage(folder, "flow", key, {"flow": flow, "few": np.arange(3)}, {"n": 5}, scratch=scratch)
    return folder / "work" / "flow"


def test_arrays_that_were_written_in_parts_come_back_mapped(tmp_path):
    place = scratched(tmp_path)
    arrays, meta = af.load_stage(tmp_path, "flow", "k")
    assert isinstance(arrays["flow"], np.memmap) and not isinstance(arrays["few"], np.memmap)
    np.testing.assert_array_equal(arrays["flow"], np.repeat(np.arange(5), 3).reshape(5, 3))
    assert meta == {"n": 5}
    # what was not a result is gone, and nothing has a temporary name
    assert sorted(p.name for p in place.iterdir()) == ["k.flow.npy", "k.json", "k.npz"]


def test_writing_into_a_mapped_array_does_not_change_the_cache(tmp_path):
    scratched(tmp_path)
    af.load_stage(tmp_path, "flow", "k")[0]["flow"][:] = 9
    assert af.load_stage(tmp_path, "flow", "k")[0]["flow"][1, 0] == 1


@pytest.mark.parametrize("damage", ["cut", "gone", "empty", "other", "link"])
def test_a_damaged_mapped_array_counts_as_absent(tmp_path, damage):
    path = scratched(tmp_path) / "k.flow.npy"
    data = path.read_bytes()
    path.unlink()
    if damage == "other":
        np.save(path, np.zeros((5, 4), np.float16))
    elif damage == "link":
        (tmp_path / "elsewhere.npy").write_bytes(data)
        path.symlink_to(tmp_path / "elsewhere.npy")
    elif damage != "gone":
        path.write_bytes({"cut": data[:-4], "empty": b""}[damage])
    assert af.load_stage(tmp_path, "flow", "k") is None


def test_old_mapped_arrays_go_with_their_result(tmp_path):
    for i in range(4):
        place = scratched(tmp_path, f"k{i}")
        os.utime(place / f"k{i}.json", (i, i))
    assert sorted(p.name for p in place.glob("*.npy")) == ["k2.flow.npy", "k3.flow.npy"]


def test_a_scratch_keeps_its_own_files_and_copies_others(tmp_path):
    scratch = Scratch(tmp_path, "read")
    growing = scratch.growing("decoded", (2, 3), np.uint8)
    for t in range(4):
        growing.append(np.full((2, 3), t))
    whole = growing.close()
    assert whole.shape == (4, 2, 3) and len(growing) == 4
    assert scratch.keep("frames", whole) is whole  # renamed
    part = scratch.keep("part", whole[1:3])
    assert part is not whole and part.shape == (2, 2, 3)
    np.testing.assert_array_equal(part, whole[1:3])
    again = scratch.keep("part", part[1:])  # under a name that was taken
    np.testing.assert_array_equal(again, whole[2:3])
    assert len(list((tmp_path / "work" / "read").iterdir())) == 2
    with pytest.raises(ValueError, match="item"):
        scratch.growing("other", (2, 3), np.uint8).append(np.zeros((3, 3)))
    scratch.discard()
    assert not list((tmp_path / "work" / "read").iterdir())


def test_a_scratch_asks_for_room_before_it_takes_it(tmp_path):
    with pytest.raises(InputRejected, match="MB free"):
        Scratch(tmp_path, "read").array("frames", (10**9, 10**9), np.uint8)


def test_only_the_last_results_of_a_stage_are_kept(tmp_path):
    for i in range(4):
        af.save_stage(tmp_path, "s", f"k{i}", {"a": np.zeros(1)}, {})
        os.utime(tmp_path / "work" / "s" / f"k{i}.json", (i, i))
    assert [af.load_stage(tmp_path, "s", f"k{i}") is not None for i in range(4)] == [False, False, True, True]
    assert len(list((tmp_path / "work" / "s").iterdir())) == 4


def test_stage_names_cannot_lead_elsewhere(tmp_path):
    for stage, key in (("../x", "k"), ("s", "a/b"), ("", "k")):
        with pytest.raises(ValueError, match="letters and digits"):
            af.load_stage(tmp_path, stage, key)
    with pytest.raises(ValueError, match="numbers"):
        af.save_stage(tmp_path, "s", "k", {"a": np.array([{}], object)}, {})


def colours_in(path):
    """COLOR_0 of a GLB's only mesh, [v,c] in [0, 1]: trimesh leaves vertex colours out where there is a material."""
    data = path.read_bytes()
    length = int.from_bytes(data[12:16], "little")
    scene, body = json.loads(data[20 : 20 + length]), data[28 + length :]
    accessor = scene["accessors"][scene["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    assert accessor["componentType"] == 5123 and accessor["normalized"]
    view, size = scene["bufferViews"][accessor["bufferView"]], {"VEC3": 3, "VEC4": 4}[accessor["type"]]
    step = view.get("byteStride", 2 * size) // 2
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    count = step * (accessor["count"] - 1) + size
    flat = np.frombuffer(body, "<u2", count, start)
    rows = [flat[k * step : k * step + size] for k in range(accessor["count"])]
    return np.array(rows) / 65535


def test_the_terrain_glb_is_y_up_and_keeps_its_size(tmp_path, mesh):
    loaded = trimesh.load(write_glb(tmp_path / "t.glb", mesh), force="mesh", process=False)
    x, y, z = mesh.vertices.T
    np.testing.assert_allclose(loaded.vertices, np.stack([x, z, -y], axis=-1), atol=1e-6)
    assert loaded.volume == pytest.approx(1.0, rel=1e-6)  # positive: the faces still look outwards (1 * 2 * 3 / 6)
    grey = colours_in(tmp_path / "t.glb")[3, 0]
    assert grey == pytest.approx(0.21404, abs=1e-5)  # sRGB 0.5 in linear light, 16 bits
    with pytest.raises(ValueError, match="empty mesh"):
        write_glb(tmp_path / "e.glb", TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int)))


def quilt():
    """A square of two faces in z = 0 with a texture of four colours: red and green above (y = 2), blue and grey below;
    its back, on a seam, shows grey."""
    vertices = np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 2, 1], [0, 3, 2]])
    corner = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
    uv = corner[faces]
    uv[2:] = (0.9, 0.9)
    texture = np.zeros((40, 40, 3), np.uint8)
    texture[:20, :20], texture[:20, 20:] = (255, 0, 0), (0, 255, 0)
    texture[20:, :20], texture[20:, 20:] = (0, 0, 255), (90, 90, 90)
    return TriangleMesh(vertices, faces, np.full((4, 3), 0.5, np.float32), uv, texture)


def test_the_texture_in_a_glb_lies_where_it_belongs(tmp_path):
    quilted = quilt()
    loaded = trimesh.load(write_glb(tmp_path / "t.glb", quilted), force="mesh", process=False)
    picture = np.asarray(loaded.visual.material.baseColorTexture.convert("RGB"))
    np.testing.assert_array_equal(picture, quilted.texture)
    assert loaded.visual.material.metallicFactor == 0.0
    assert len(loaded.vertices) == 8  # those of the seam twice
    front = loaded.faces[:2]
    for (x, y), colour in {(0.3, 1.7): (255, 0, 0), (1.7, 1.7): (0, 255, 0), (0.3, 0.3): (0, 0, 255)}.items():
        # y up: z of the file is -y; barycentric coordinates in the face that holds the point
        for face in front:
            corners = loaded.vertices[face]
            share = np.linalg.solve(np.stack([corners[:, 0], -corners[:, 2], np.ones(3)]), [x, y, 1.0])
            if (share > -1e-9).all():
                u, v = share @ loaded.visual.uv[face]  # trimesh counts v from below
                np.testing.assert_array_equal(picture[int((1 - v) * 40), int(u * 40)], colour)
    assert loaded.vertex_normals[front].reshape(-1, 3)[:, 1].min() > 0.99


def test_a_textured_terrain_comes_back_and_one_without_a_texture_still_opens(tmp_path, asset):
    terrain = replace(asset.terrain, mesh=quilt())
    back = af.load_asset(af.save_asset(tmp_path / "a.fluid", replace(asset, terrain=terrain))).terrain.mesh
    np.testing.assert_array_equal(back.texture, terrain.mesh.texture)
    np.testing.assert_array_equal(back.uv, terrain.mesh.uv)
    older = af.load_asset(af.save_asset(tmp_path / "b.fluid", asset)).terrain.mesh
    assert older.uv is None and older.texture is None


def test_the_obj_is_z_up(tmp_path, mesh):
    loaded = trimesh.load(write_obj(tmp_path / "t.obj", mesh), process=False, maintain_order=True)
    np.testing.assert_allclose(loaded.vertices, mesh.vertices)
    np.testing.assert_array_equal(loaded.faces, mesh.faces)
