"""Meshes of strangers: what is whole comes in right way up, what is broken or hostile is refused in words."""

import json
import struct

import numpy as np
import pytest
import trimesh

from fluidlift.errors import InputRejected
from fluidlift.io.export_mesh import write_glb, write_mesh, write_obj
from fluidlift.io.read_mesh import read_any_mesh
from fluidlift.numerics.solid_mesh import box_mesh, moments
from fluidlift.types import TriangleMesh


def brick():
    """A box of 1 x 2 x 3 m whose lowest corner is at (10, 20, 30): no two axes look the same."""
    mesh = box_mesh(np.array([1.0, 2.0, 3.0]))
    return TriangleMesh(mesh.vertices + [10.5, 21.0, 31.5], mesh.faces)


@pytest.mark.parametrize(("write", "name"), [(write_obj, "a.obj"), (write_mesh, "a.ply"), (write_glb, "a.glb")])
def test_a_mesh_of_our_own_comes_back_the_right_way_up_and_out(tmp_path, write, name):
    write(tmp_path / name, brick())
    found = read_any_mesh(tmp_path / name)
    np.testing.assert_allclose(found.vertices.min(axis=0), [10, 20, 30], rtol=1e-6)  # single precision in the files
    np.testing.assert_allclose(found.vertices.max(axis=0), [11, 22, 33], rtol=1e-6)
    assert moments(found).volume == pytest.approx(6.0, rel=1e-5)  # positive: not inside-out


def test_nodes_of_a_gltf_scene_are_placed_and_mirrors_do_not_turn_them_inside_out(tmp_path):
    scene = trimesh.Scene()
    one = trimesh.creation.box((1, 1, 1))
    place = trimesh.transformations.translation_matrix([0, 5, 0]) @ np.diag([2.0, -1.0, 1.0, 1.0])
    scene.add_geometry(one, transform=place)
    (tmp_path / "a.glb").write_bytes(scene.export(file_type="glb"))
    found = read_any_mesh(tmp_path / "a.glb")
    np.testing.assert_allclose(found.vertices.min(axis=0), [-1, -0.5, 4.5], atol=1e-6)  # glTF's y is our z
    assert moments(found).volume == pytest.approx(2.0, rel=1e-5)


def test_polygons_and_backward_indices_of_an_obj_are_understood(tmp_path):
    lines = [f"v {x} {y} {z}" for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    quads = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
    lines += ["vn 0 0 1", "vt 0 0", "usemtl stone"]
    lines += ["f " + " ".join(f"{i - 9}/1/1" if n % 2 else f"{i}//1" for i in q) for n, q in enumerate(quads)]
    (tmp_path / "a.obj").write_text("\n".join(lines))
    found = read_any_mesh(tmp_path / "a.obj")
    assert found.faces.shape == (12, 3)
    assert moments(found).volume == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("name", "data", "word"),
    [
        ("a.stl", b"solid", "obj"), ("a.obj", b"hello\n", "no triangles"), ("a.obj", b"v 1 2 x\n", "line 1"),
        ("a.obj", b"v 0 0 0\nf 1 2 3\n", "line 2"), ("a.obj", b"v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "finite"),
        ("a.obj", b"v 0 0 0\nf 1 1\n", "three corners"), ("a.obj", b"", "empty"), ("a.ply", b"ply\nhello", "PLY"),
        ("a.glb", b"glTF", "cannot be read"), ("a.glb", b"x" * 40, "glTF"),
    ],
)  # fmt: skip
def test_what_is_no_mesh_is_refused_in_words(tmp_path, name, data, word):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputRejected, match=word):
        read_any_mesh(tmp_path / name)


def glb(path, change):
    """A brick as GLB, its JSON changed by `change(scene)`."""
    write_glb(path, brick())
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    scene = json.loads(data[20 : 20 + length])
    change(scene)
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    rest = data[20 + length :]
    path.write_bytes(
        struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A) + text + rest
    )
    return path


def change_accessor(**values):
    def change(scene):
        index = scene["meshes"][0]["primitives"][0]["attributes"]["POSITION"]
        scene["accessors"][index] |= values

    return change


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (change_accessor(count=10**12), "more than 5000000 vertices"),
        (change_accessor(count=10**6), "beyond its data"),
        (change_accessor(byteOffset=10**12), "beyond its data"),
        (change_accessor(count=-1), "index"), (change_accessor(sparse={"count": 1}), "sparse"),
        (lambda s: s.update(extensionsRequired=["KHR_draco_mesh_compression"]), "draco"),
        (lambda s: s["buffers"][0].update(uri="/etc/passwd"), "another file"),
        (lambda s: s["nodes"][0].update(children=[0]), "ancestor"),
        (lambda s: s["meshes"][0]["primitives"][0].update(mode=1), "no triangles"),
        (lambda s: s["nodes"].__setitem__(slice(None), [1, 2, 3]), "cannot be read"),
    ],
)  # fmt: skip
def test_a_hostile_gltf_is_refused_without_taking_memory(tmp_path, change, word):
    with pytest.raises(InputRejected, match=word):
        read_any_mesh(glb(tmp_path / "a.glb", change))


def test_the_unchanged_gltf_of_the_test_before_is_accepted(tmp_path):
    assert len(read_any_mesh(glb(tmp_path / "a.glb", lambda scene: None)).faces) == 12
