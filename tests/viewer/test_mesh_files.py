"""Mesh files that are handed over in the page."""

import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.viewer import mesh_files
from fluidlift.viewer.mesh_files import kept_mesh, mesh_entry

BOX = b"v 0 0 0\nv 2 0 0\nv 0 4 0\nv 0 0 6\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.mark.parametrize(
    ("name", "inside"),
    [
        ("duck.obj", "meshes/duck.obj"), ("My Duck (2).OBJ", "meshes/My_Duck_2.obj"),
        ("../../etc/x.ply", "meshes/x.ply"),
        ("C:\\models\\rock.glb", "meshes/rock.glb"), (".obj.obj", "meshes/obj.obj"), ("ä.obj", "meshes/mesh.obj"),
    ],
)  # fmt: skip
def test_a_file_is_kept_in_the_asset_under_a_plain_name_whatever_it_is_called(tmp_path, name, inside):
    found, _ = kept_mesh(tmp_path, name, BOX)
    assert found == inside and (tmp_path / inside).read_bytes() == BOX


def test_the_same_file_is_kept_once_and_another_one_of_its_name_beside_it(tmp_path):
    first, _ = kept_mesh(tmp_path, "duck.obj", BOX)
    again, undo_nothing = kept_mesh(tmp_path, "duck.obj", BOX)
    other, take_away = kept_mesh(tmp_path, "duck.obj", BOX + b"\n")
    assert (first, again, other) == ("meshes/duck.obj", "meshes/duck.obj", "meshes/duck_2.obj")
    undo_nothing()
    take_away()
    assert [p.name for p in (tmp_path / "meshes").iterdir()] == ["duck.obj"]


def test_a_file_that_is_taken_away_leaves_no_folder(tmp_path):
    _, take_away = kept_mesh(tmp_path, "duck.obj", BOX)
    take_away()
    assert not (tmp_path / "meshes").exists()


@pytest.mark.parametrize(("name", "content", "told"), [
    ("duck.stl", BOX, ".obj, .ply, .glb"), ("duck", BOX, "as a mesh"), ("duck.obj", b"", "is empty"),
])  # fmt: skip
def test_what_is_no_mesh_is_refused_and_nothing_is_written(tmp_path, name, content, told):
    with pytest.raises(InputRejected, match=told):
        kept_mesh(tmp_path, name, content)
    assert not list(tmp_path.iterdir())


def test_a_file_that_is_too_large_is_refused_with_the_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(mesh_files, "MOST_BYTES", 2**20)
    with pytest.raises(InputRejected, match=r"has 2 MB.*at most 1 MB"):
        kept_mesh(tmp_path, "duck.obj", bytes(2 * 2**20))
    assert not list(tmp_path.iterdir())


def test_a_folder_that_is_a_link_out_of_the_asset_is_refused(tmp_path):
    (tmp_path / "asset").mkdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "asset" / "meshes").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InputRejected, match="link"):
        kept_mesh(tmp_path / "asset", "duck.obj", BOX)
    assert not list((tmp_path / "elsewhere").iterdir())


def test_a_mesh_is_put_with_the_middle_of_its_lower_side_at_the_place_in_metres(tmp_path):
    inside, _ = kept_mesh(tmp_path, "wedge.obj", BOX)
    entry = mesh_entry(tmp_path, inside, 0.1, turned_over=True, over=lambda width: np.array([1.0, 2.0, 3.0]))
    assert entry == {"mesh": "meshes/wedge.obj", "position": [0.9, 1.8, 3.0], "scale": 0.1, "flip": True}
    assert mesh_entry(tmp_path, inside, 1.0, turned_over=False, over=lambda width: np.zeros(3)).keys() == {
        "mesh",
        "position",
    }
    with pytest.raises(InputRejected, match="gone"):
        mesh_entry(tmp_path, "gone.obj", 1.0, turned_over=False, over=lambda width: np.zeros(3))
