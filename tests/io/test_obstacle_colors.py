"""Obstacles are drawn in a colour of scene.yaml or in those of their file; how they move does not depend on it."""

import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.io.export_mesh import write_mesh, write_obj
from fluidlift.io.obstacles import color_mark
from fluidlift.io.read_mesh import read_any_mesh
from fluidlift.io.scene import read_edits
from fluidlift.look.scenery import mesh_surfels
from fluidlift.numerics.solid_mesh import box_mesh
from fluidlift.present.looks import placed_bodies
from fluidlift.types import TriangleMesh

YELLOW, BLACK = (1.0, 0.8, 0.1), (0.0, 0.0, 0.0)


def painted():
    """A box whose upper half is yellow and whose lower half is black."""
    mesh = box_mesh(np.array([0.2, 0.2, 0.2]))
    colors = np.where(mesh.vertices[:, 2:] > 0, YELLOW, BLACK).astype(np.float32)
    return TriangleMesh(mesh.vertices, mesh.faces, colors)


@pytest.fixture
def obstacle(tmp_path):
    """obstacle(entry) -> the first obstacle of a scene.yaml with this one entry; box.obj lies beside it."""
    write_obj(tmp_path / "box.obj", painted())

    def read(entry):
        (tmp_path / "scene.yaml").write_text(f"obstacles:\n  - {entry}\n")
        return read_edits(tmp_path).obstacles[0]

    return read


@pytest.mark.parametrize(("write", "name"), [(write_obj, "a.obj"), (write_mesh, "a.ply")])
def test_vertex_colors_of_a_file_come_back(tmp_path, write, name):
    write(tmp_path / name, painted())
    found = read_any_mesh(tmp_path / name)
    # a PLY has 8 bits a channel
    np.testing.assert_allclose(found.colors, painted().colors, atol=0.5 / 255 + 1e-6)


@pytest.mark.parametrize("tail", ["", " 1.0", " 200 10 10", " nan 0 0"])
def test_what_follows_a_vertex_and_is_no_color_is_left_out(tmp_path, tail):
    corners = [f"v {p}{tail}" for p in ("0 0 0", "1 0 0", "0 1 0", "0 0 1")]
    (tmp_path / "a.obj").write_text("\n".join([*corners, "f 1 3 2", "f 1 2 4", "f 1 4 3", "f 2 3 4"]))
    assert read_any_mesh(tmp_path / "a.obj").colors is None


def test_a_mesh_keeps_the_colors_of_its_file_unless_scene_yaml_names_one(obstacle):
    own = obstacle("{mesh: box.obj}")
    np.testing.assert_allclose(own.mesh.colors, painted().colors, atol=1e-6)  # seven digits in the file
    told = obstacle("{mesh: box.obj, color: [0.2, 0.4, 0.6]}")
    np.testing.assert_allclose(told.mesh.colors, np.tile([0.2, 0.4, 0.6], (len(told.mesh.vertices), 1)), atol=1e-6)
    assert obstacle("{shape: sphere, radius: 0.1}").mesh.colors is None


def test_a_color_out_of_range_is_refused_with_its_line_and_range(obstacle):
    with pytest.raises(InputRejected, match=r"line 2.*color") as caught:
        obstacle("{shape: sphere, radius: 0.1, color: [255, 200, 0]}")
    assert "0 to 1" in str(caught.value)


def test_a_color_changes_the_pictures_and_not_the_motion(obstacle):
    plain, red, blue = (
        obstacle(f"{{name: a, shape: sphere, radius: 0.1{told}}}")
        for told in ("", ", color: [1, 0, 0]", ", color: [0, 0, 1]")
    )
    assert all(np.array_equal(a, b) for a, b in zip(plain.plain(), red.plain(), strict=True))
    marks = [color_mark((o,)) for o in (plain, red, blue)]
    assert marks[0] == {} and marks[1] != marks[2] and marks[1] == color_mark((red,))


def test_bodies_in_their_places_and_their_surfels_have_the_colors(obstacle):
    own = obstacle("{mesh: box.obj}")
    body = placed_bodies([own], np.array([[0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0]]))[0]
    assert np.array_equal(body.colors, own.mesh.colors)
    found = mesh_surfels(body, 0.02)
    top, floor = found.means[:, 2] > 1.099, found.means[:, 2] < 0.901
    tone = found.rgb[top] / found.rgb[top][:, :1]
    np.testing.assert_allclose(tone, np.broadcast_to(YELLOW, tone.shape), atol=1e-3)  # shaded, of one hue
    assert found.rgb[floor].max() < 1e-3
