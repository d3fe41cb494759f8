"""Pictures on meshes of strangers arrive where they were painted; what is missing or hostile is refused in words."""

import numpy as np
import pytest
from PIL import Image

from fluidlift.errors import InputRejected
from fluidlift.io import mesh_textures
from fluidlift.io.confined import reading_here
from fluidlift.io.export_mesh import write_glb
from fluidlift.io.read_mesh import read_any_mesh
from fluidlift.numerics.textures import sample_texture
from fluidlift.types import TriangleMesh

COLORS = {(0, 0): (255, 0, 0), (1, 0): (0, 255, 0), (0, 1): (0, 0, 255), (1, 1): (255, 255, 0)}
"""of the quarters of a picture, (right, below)"""


def quarters(path, size=32):
    picture = np.zeros((size, size, 3), np.uint8)
    half = size // 2
    for (right, below), color in COLORS.items():
        picture[below * half :][:half, right * half :][:, :half] = color
    Image.fromarray(picture).save(path)
    return picture


def square(folder, lines=(), uv=((0, 0), (1, 0), (1, 1), (0, 1)), library="newmtl stone\nmap_Kd stone.png\n"):
    """A unit square in the plane z = 0 as an OBJ with a material."""
    (folder / "a.mtl").write_text(library)
    text = ["mtllib a.mtl", "v 0 0 0", "v 1 0 0", "v 1 1 0", "v 0 1 0", *(f"vt {u} {v}" for u, v in uv)]
    (folder / "a.obj").write_text("\n".join([*text, "usemtl stone", "f 1/1 2/2 3/3 4/4", *lines]))
    return folder / "a.obj"


def shown(mesh, x, y):
    """What the mesh shows at a point of the plane, 8 bits."""
    for face, uv in zip(mesh.faces, mesh.uv):
        a, b, c = mesh.vertices[face][:, :2]
        share = np.linalg.solve(np.array([b - a, c - a]).T, np.array([x, y]) - a)
        if min(*share, 1 - share.sum()) >= -1e-9:
            at = uv[0] + share[0] * (uv[1] - uv[0]) + share[1] * (uv[2] - uv[0])
            return tuple(np.round(255 * sample_texture(mesh.texture, at)).astype(int))
    raise AssertionError("no triangle there")


def test_the_picture_of_an_obj_lies_with_its_lower_left_corner_at_the_origin(tmp_path):
    quarters(tmp_path / "stone.png")
    mesh = read_any_mesh(square(tmp_path))
    assert shown(mesh, 0.25, 0.25) == COLORS[0, 1] and shown(mesh, 0.75, 0.25) == COLORS[1, 1]
    assert shown(mesh, 0.25, 0.75) == COLORS[0, 0] and shown(mesh, 0.75, 0.75) == COLORS[1, 0]
    # the vertices have it as well, for what shows no textures; half a pixel inside is the same colour here
    np.testing.assert_allclose(255 * mesh.colors[0], COLORS[0, 1], atol=1)


def test_a_picture_that_is_repeated_is_repeated(tmp_path):
    quarters(tmp_path / "stone.png")
    mesh = read_any_mesh(square(tmp_path, uv=((-1, 0), (2, 0), (2, 2), (-1, 2))))
    for column in range(3):
        for row in range(2):
            at = (column + 0.25) / 3, (row + 0.25) / 2
            assert shown(mesh, *at) == COLORS[0, 1]


def test_pictures_and_colours_of_several_materials_become_one_picture(tmp_path):
    quarters(tmp_path / "stone.png")
    Image.new("RGB", (8, 40), (10, 200, 30)).save(tmp_path / "moss.png")
    library = "newmtl stone\nmap_Kd -s 1 1 1 stone.png\nnewmtl moss\nKd 1 0 0\nmap_Kd C:\\work\\moss.png\n"
    library += "newmtl sand\nKd 0.8 0.6 0.4\n"
    more = ["v 2 0 0", "v 2 1 0", "v 3 0 0", "v 3 1 0", "usemtl moss", "f 2/1 5/2 6/3 3/4", "usemtl sand", "f 5 7 8 6"]
    mesh = read_any_mesh(square(tmp_path, more, library=library))
    assert shown(mesh, 0.25, 0.75) == COLORS[0, 0] and shown(mesh, 1.5, 0.5) == (10, 200, 30)
    assert shown(mesh, 2.5, 0.5) == (204, 153, 102)  # 8 bits of 0.8, 0.6, 0.4


def test_plain_materials_colour_the_vertices(tmp_path):
    mesh = read_any_mesh(square(tmp_path, library="newmtl stone\nKd 0.25 0.5 0.75\n"))
    assert mesh.texture is None
    np.testing.assert_allclose(mesh.colors, np.tile([0.25, 0.5, 0.75], (4, 1)), atol=1e-6)


def test_an_obj_without_its_list_of_materials_is_a_shape_without_colours(tmp_path):
    path = square(tmp_path)
    (tmp_path / "a.mtl").unlink()
    mesh = read_any_mesh(path)
    assert mesh.texture is None and mesh.colors is None and len(mesh.faces) == 2


@pytest.mark.parametrize("name", ["missing.png", "../stone.png", "/etc/hostname"])
def test_a_picture_that_is_not_beside_the_mesh_is_refused_by_name(tmp_path, name):
    (tmp_path / "in").mkdir()
    quarters(tmp_path / "stone.png")
    with pytest.raises(InputRejected, match="not beside it"):
        read_any_mesh(square(tmp_path / "in", library=f"newmtl stone\nmap_Kd {name}\n"))


def test_a_picture_behind_a_link_is_not_followed(tmp_path):
    (tmp_path / "in").mkdir()
    quarters(tmp_path / "secret.png")
    (tmp_path / "in" / "stone.png").symlink_to(tmp_path / "secret.png")
    with pytest.raises(InputRejected, match="not beside it"):
        read_any_mesh(square(tmp_path / "in"))


@pytest.mark.parametrize(("data", "words"), [(b"no picture at all", "decoded"), (b"", "empty")])
def test_a_picture_that_is_none_is_refused(tmp_path, data, words):
    (tmp_path / "stone.png").write_bytes(data)
    with pytest.raises(InputRejected, match=words):
        read_any_mesh(square(tmp_path))


@pytest.fixture
def read_here():
    """Bounds that a test sets hold in its own process."""
    with reading_here():
        yield


@pytest.mark.usefixtures("read_here")
def test_pictures_are_held_to_sizes(tmp_path, monkeypatch):
    quarters(tmp_path / "stone.png", 256)
    monkeypatch.setattr(mesh_textures, "MAX_SIDE", 64)
    mesh = read_any_mesh(square(tmp_path, uv=((0, 0), (5, 0), (5, 5), (0, 5))))
    assert max(mesh.texture.shape) <= 64
    far = read_any_mesh(square(tmp_path, uv=((0, 0), (1e6, 0), (1e6, 1), (0, 1))))
    assert max(far.texture.shape) <= 64  # the mean of what is too fine to be seen
    np.testing.assert_allclose(255 * far.colors[0], [127.5, 127.5, 63.75], atol=1)
    with pytest.raises(InputRejected, match="finite"):
        read_any_mesh(square(tmp_path, uv=((0, 0), ("nan", 0), (1, 1), (0, 1))))
    monkeypatch.setattr(mesh_textures, "_MAX_BYTES", 50)
    with pytest.raises(InputRejected, match="bytes in a texture"):
        read_any_mesh(square(tmp_path))


def test_a_textured_gltf_comes_back_as_it_was_written(tmp_path):
    picture = quarters(tmp_path / "stone.png")
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    uv = np.array([[0.0, 1], [1, 1], [1, 0], [0, 0]], np.float32)[faces]
    write_glb(tmp_path / "a.glb", TriangleMesh(corners, faces, None, uv, picture))
    mesh = read_any_mesh(tmp_path / "a.glb")
    for (right, below), color in COLORS.items():
        # the file may hold the picture as JPEG: neighbours of another colour are 4 pixels away
        np.testing.assert_allclose(shown(mesh, 0.25 + 0.5 * right, 0.75 - 0.5 * below), color, atol=8)


def test_colours_of_a_gltfs_vertices_are_taken_as_linear(tmp_path):
    import trimesh

    box = trimesh.creation.box((1, 1, 1))
    box.visual = trimesh.visual.ColorVisuals(box, vertex_colors=np.tile([188, 0, 255, 255], (8, 1)))
    (tmp_path / "a.glb").write_bytes(box.export(file_type="glb"))
    mesh = read_any_mesh(tmp_path / "a.glb")
    # 188/255 in linear light is 0.876 of sRGB
    np.testing.assert_allclose(mesh.colors, np.tile([0.876, 0, 1], (len(mesh.vertices), 1)), atol=2e-3)
