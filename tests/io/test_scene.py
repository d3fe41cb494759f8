"""scene.yaml: what a person writes is checked, entry by entry, and a complaint names the line."""

import re

import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.io.export_mesh import write_obj
from fluidlift.io.scene import SCENE_TEMPLATE, SceneEdits, read_edits
from fluidlift.io.scene_look import Look
from fluidlift.numerics.solid_mesh import box_mesh, moments
from fluidlift.types import TriangleMesh


@pytest.fixture
def edits(tmp_path):
    """What a scene.yaml of some text changes."""

    def read(text, **options):
        (tmp_path / "scene.yaml").write_text(text)
        return read_edits(tmp_path, **options)

    return read


EXAMPLE = r"^#(?! )|^#(?=  )"
"""the mark before a line that can be used; prose has one space behind it"""


@pytest.mark.parametrize("line", [x for x in SCENE_TEMPLATE.splitlines() if re.match(EXAMPLE, x)])
def test_each_line_of_the_template_can_be_used_alone(edits, tmp_path, line):
    write_obj(tmp_path / "rock.obj", box_mesh(np.ones(3)))
    assert edits(SCENE_TEMPLATE.replace(line, line[1:])) != SceneEdits()


def test_the_template_of_earlier_versions_still_works(edits):
    old = re.sub(r"^(parameters|inflow|look):$", r"\1: {}", SCENE_TEMPLATE, flags=re.M)
    old = re.sub(r"^(obstacles|emitters|terrain):$", r"\1: []", old, flags=re.M)
    assert edits(old) == SceneEdits()
    with pytest.raises(InputRejected, match=r"line 5.*Do: write 'parameters:' without the \{\}"):
        edits(old.replace("#  density", "  density"))


def test_the_template_changes_nothing(edits):
    found = edits(SCENE_TEMPLATE)
    assert found == SceneEdits()


def test_the_examples_of_the_template_work(edits, tmp_path):
    write_obj(tmp_path / "rock.obj", box_mesh(np.ones(3)))
    found = edits(re.sub(EXAMPLE, "", SCENE_TEMPLATE, flags=re.M))
    assert [o.name for o in found.obstacles] == ["sphere1", "mesh2", "box3"]
    assert found.parameters["kinematic_viscosity"] == 1e-6
    volumes = [moments(o.mesh).volume for o in found.obstacles]
    # the sphere is a polyhedron of 5120 faces inside it: 0.1 % less
    np.testing.assert_allclose(volumes, [4 / 3 * np.pi * 1e-3, 1e-3, 4e-3], rtol=2e-3)
    assert [o.motion for o in found.obstacles] == ["static", "static", "free"]
    assert (found.emitters[0].velocity, found.emitters[0].end) == ((0.0, 0.0, -1.0), 2.5)
    assert (found.terrain[0].offset, found.terrain[1].degrees_per_metre) == ((0.0, 0.0, 0.1), 20.0)
    assert (found.inflow.keyframes, found.inflow.fluctuation) == (((0.0, 1.5),), 0.1)
    assert found.look == Look("surface", "honey", "studio")
    assert (found.duration, found.extend_downstream, found.loop) == (4.0, 2.0, True)


def test_a_turn_is_about_x_then_y_then_z(edits):
    (found,) = edits("obstacles: [{shape: box, size: [1, 2, 3], rotation: [90, 0, 90], position: [1, 2, 3]}]").obstacles
    body = found.body(1.0)
    np.testing.assert_allclose(body.position, [1, 2, 3])
    # 90 degrees about x take (x, y, z) to (x, -z, y); 90 about z then to (z, x, y): lengths 3, 1, 2
    from fluidlift.types import matrix_from_quat

    turned = body.mesh.vertices @ matrix_from_quat(body.orientation).T
    np.testing.assert_allclose(np.ptp(turned, axis=0), [3, 1, 2], atol=1e-9)


def test_a_body_that_moves_steadily_is_where_it_must_be(edits):
    text = "obstacles: [{shape: sphere, radius: 1, motion: animated, velocity: [2, 0, 0], angular_velocity: [0, 0, 3]}]"
    (obstacle,) = edits(text).obstacles
    short, long = obstacle.body(1.0).trajectory, obstacle.body(10.0).trajectory
    for time in (0.0, 0.3, 0.97):
        position, turn = short.pose(time)
        np.testing.assert_allclose(position, [2 * time, 0, 0], atol=1e-12)
        # half the angle in the quaternion, up to its sign
        np.testing.assert_allclose(abs(turn[0]), abs(np.cos(1.5 * time)), atol=1e-12)
        for one, two in zip(short.pose(time), long.pose(time)):
            np.testing.assert_array_equal(one, two)  # a longer simulation goes on as the shorter one did


def test_keyframes_become_a_trajectory(edits):
    (found,) = edits("""
obstacles:
  - shape: cylinder
    radius: 0.1
    height: 1
    motion: animated
    keyframes:
      - {time: 0, position: [0, 0, 0]}
      - {time: 2, position: [1, 0, 0], rotation: [0, 0, 90]}
""").obstacles
    position, turn = found.body(4.0).trajectory.pose(1.0)
    np.testing.assert_allclose(position, [0.5, 0, 0])
    np.testing.assert_allclose(turn, [np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8)], atol=1e-12)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("obstacle: []", ["line 1", "write 'obstacles'"]),
        ("gravity: [0, 0, -1]", ["line 1", "write it under parameters"]),
        ("parameters:\n  material: honey", ["line 2", "write it under look"]),
        ("parameters: {gravity: -9.8}", ["such as [0, 0, -9.81]"]),
        ("obstacles: [{shape: sphere, size: [1, 1, 1]}]", ["a sphere has radius"]),
        ("- a\n- b", ["is a list", "sections", "Do: write each name"]),
        ("look:\n\tstyle: surface", ["line 2", "spaces", "no tabs"]),
        ("parameters: {density: 3\nlook: {}", ["close the '{' of line 1"]),
        ("obstacles: [3", ["close the '[' of line 1"]),
        ("parameters:\n density: 3\n  gravity: 3", ["same column"]),
        ("\nparameters:\n  density: 1\n  viscosity: 2\n", ["line 4", "write 'kinematic_viscosity'"]),
        ("obstacles:\n  - shape: spere\n", ["line 2", "write 'sphere'"]),
        ("obstacles:\n  - shape: box\n    size: [1, 1, 1]\n    densitie: 3\n", ["line 4", "write 'density'"]),
        ("obstacles:\n  - shape: box\n    radius: 1\n", ["line 3", "unknown entry 'radius'"]),
        ("obstacles:\n  - shape: box\n", ["line 2", "size", "None"]),
        ("obstacles:\n  - radius: 1\n", ["line 2", "neither shape nor mesh"]),
        ("obstacles: [{shape: box, mesh: a.obj}]", ["both shape and mesh"]),
        ("obstacles: [{shape: sphere, radius: -1}]", ["radius", "-1"]),
        ("obstacles: [{shape: sphere, radius: .nan}]", ["radius", "nan"]),
        ("obstacles: [{shape: sphere, radius: true}]", ["radius", "True"]),
        ("obstacles: [{shape: sphere, radius: 1, position: [0, 0]}]", ["position", "3 numbers"]),
        ("obstacles: [{shape: sphere, radius: 1, scale: [1, -1, 1]}]", ["scale", "inside out"]),
        ("obstacles: [{shape: sphere, radius: 1, motion: swim}]", ["motion", "animated"]),
        ("obstacles: [{shape: sphere, radius: 1, motion: animated}]", ["nothing moves"]),
        ("obstacles: [{shape: sphere, radius: 1, velocity: [1, 0, 0]}]", ["static"]),
        ("obstacles: [{shape: sphere, radius: 1, name: a}, {shape: sphere, radius: 1, name: a}]", ["second"]),
        ("obstacles: {shape: box}", ["a list"]),
        ("obstacles: [3]", ["name: value"]),
        ("duration: long", ["duration", "'long'"]),
        ("extend_downstream: -2", ["extend_downstream", "-2"]),
        ("look: {hue: 1}", ["line 1", "unknown entry 'hue' of look"]),
        ("parameters: {gravity: [0, 0]}", ["line 1", "3 numbers", "m/s^2"]),
        ("obstacles: [{shape: sphere, radius: 30cm, position: [0, 0, 1]}]", ["a number from", "m. Do: write 0.3."]),
        ("obstacles: [{shape: sphere, radius: 1, position: [4in, 0, 20 cm]}]", ["3 numbers", "write [0.1016, 0, 0.2]"]),
        ("parameters: [1]", ["name: value"]),
    ],
)
def test_a_complaint_names_the_line_and_the_nearest_name(edits, text, words):
    with pytest.raises(InputRejected) as said:
        edits(text)
    assert [w for w in ["scene.yaml", *words] if w not in str(said.value)] == []


def keys(*times):
    return ", ".join(f"{{time: {t}, position: [0, 0, 0]}}" for t in times)


@pytest.mark.parametrize("times", [(1, 1), (2, 1), (1,)])
def test_keyframes_must_be_in_order(edits, times):
    with pytest.raises(InputRejected, match="keyframe"):
        edits(f"obstacles: [{{shape: sphere, radius: 1, motion: animated, keyframes: [{keys(*times)}]}}]")


@pytest.mark.parametrize("name", ["../rock.obj", "/etc/passwd", "C:\\rock.obj", "sub/../../rock.obj", "link.obj"])
def test_meshes_are_read_from_the_asset_only(edits, tmp_path, name):
    outside = tmp_path.parent / "rock.obj"
    write_obj(outside, box_mesh(np.ones(3)))
    (tmp_path / "link.obj").symlink_to(outside)
    with pytest.raises(InputRejected, match=r"--meshes|link"):
        edits(f"obstacles: [{{mesh: '{name}'}}]")


def test_the_user_may_name_another_folder_of_meshes(edits, tmp_path):
    other = tmp_path / "elsewhere"
    write_obj(other / "rock.obj", box_mesh(np.ones(3)))
    assert len(edits("obstacles: [{mesh: rock.obj}]", meshes=other).obstacles[0].mesh.faces) == 12


def test_an_open_mesh_is_refused_with_the_line_that_names_it(edits, tmp_path):
    mesh = box_mesh(np.ones(3))
    write_obj(tmp_path / "open.obj", type(mesh)(mesh.vertices, mesh.faces[:-1]))
    with pytest.raises(InputRejected, match=r"scene\.yaml, line 3: .*open"):
        edits("\nobstacles:\n  - mesh: open.obj\n")


@pytest.mark.parametrize("section", ["obstacles", "emitters"])
def test_a_flat_mesh_is_told_as_flat_until_its_file_is_another(edits, tmp_path, section):
    square = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.0]])
    both = np.array([[0, 1, 2], [1, 3, 2], [0, 2, 1], [1, 2, 3]])
    write_obj(tmp_path / "a.obj", TriangleMesh(square, both))
    for _ in range(2):
        with pytest.raises(InputRejected, match=r"line 1: .*flat"):
            edits(f"{section}: [{{mesh: a.obj, position: [0, 0, 99]}}]")
    write_obj(tmp_path / "a.obj", box_mesh(np.ones(3)))
    assert len(getattr(edits(f"{section}: [{{mesh: a.obj}}]"), section)) == 1
