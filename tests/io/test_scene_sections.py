"""Emitters, inflow, terrain and look of scene.yaml, and whether things lie where the simulation takes place."""

from dataclasses import fields

import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.io.export_mesh import write_obj
from fluidlift.io.scene import PARAMETERS, SceneEdits, edits_of
from fluidlift.io.scene_domain import require_inside
from fluidlift.io.scene_look import ENVIRONMENTS, MATERIALS, Look
from fluidlift.numerics.solid_mesh import box_mesh, moments
from fluidlift.physics.terrain_edit import Move, Replace, Rotate, Scale, Twist
from fluidlift.pipeline.substances import SUBSTANCES
from fluidlift.types import FluidParameters, Grid, TriangleMesh

GRID = Grid((10, 10, 5), 0.1, (0.0, 0.0, 0.0))


@pytest.fixture
def edits(tmp_path):
    """What a text changes."""
    return lambda text: edits_of(text, tmp_path)


def test_names_that_scene_yaml_knows_are_those_of_the_code():
    from fluidlift.look.environment import BUILT_IN
    from fluidlift.look.materials import PRESETS

    assert set(MATERIALS) == set(PRESETS)
    assert set(ENVIRONMENTS) == set(BUILT_IN)
    assert {"source", *SUBSTANCES} == set(PRESETS)
    assert set(PARAMETERS) == {f.name for f in fields(FluidParameters)}


def test_an_emitter_is_a_closed_mesh_in_the_world(edits):
    (tap,) = edits(
        "emitters: [{name: tap, shape: cylinder, radius: 0.05, height: 0.2, position: [0, 0, 1], rotation: [0, 90, 0],"
        " velocity: [1, 0, 0], start: 1, end: 2.5, color: [0.2, 0.4, 0.9]}]"
    ).emitters
    np.testing.assert_allclose(np.ptp(tap.mesh.vertices, axis=0), [0.2, 0.1, 0.1], rtol=3e-3)  # a polygon of 64 sides
    assert moments(tap.mesh).center == pytest.approx([0, 0, 1], abs=1e-9)
    assert (tap.name, tap.velocity, tap.start, tap.end, tap.color) == ("tap", (1, 0, 0), 1, 2.5, (0.2, 0.4, 0.9))
    assert tap.line == "scene.yaml, line 1"


def test_the_inflow_is_a_factor_times_its_keyframes(edits):
    inflow = edits("inflow: {factor: 2, keyframes: [{time: 0, factor: 1}, {time: 4, factor: 0}], period: 3}").inflow
    assert [inflow.factor(t) for t in (0, 2, 4, 9)] == [2, 1, 0, 0]
    assert edits("inflow: {factor: 0.5}").inflow.factor(7) == 0.5


def test_edits_of_the_terrain_keep_their_order(edits, tmp_path):
    write_obj(tmp_path / "bed.obj", box_mesh(np.array([1.0, 1.0, 0.1])))
    found = edits(
        "terrain: [{mesh: bed.obj, position: [0.5, 0.5, 0], scale: 2}, {move: [0, 0, 1]}, {rotate: 10}, {scale: 2},"
        " {scale: [1, 1, 1.5]}, {twist: 20}]"
    ).terrain
    assert [type(t) for t in found] == [Replace, Move, Rotate, Scale, Scale, Twist]
    np.testing.assert_allclose(found[0].mesh.vertices.max(axis=0), [1.5, 1.5, 0.1])
    assert (found[3].factors, found[4].factors) == ((2, 2, 2), (1, 1, 1.5))


def test_an_open_bed_is_closed_downwards_after_it_was_turned_upright(edits, tmp_path):
    # y up, as most programs write an OBJ: only turned by 90 degrees about x is it a height field
    sheet = TriangleMesh(np.array([[0, 0, 0], [0, 0, -1], [1, 0, -1], [1, 0.2, 0.0]]), np.array([[0, 2, 1], [0, 3, 2]]))
    write_obj(tmp_path / "bed.obj", sheet)
    (bed,) = edits("terrain: [{mesh: bed.obj, rotation: [90, 0, 0]}]").terrain
    assert "line 1" in bed.note and "closed" in bed.note
    low, high = bed.mesh.vertices.min(axis=0), bed.mesh.vertices.max(axis=0)
    np.testing.assert_allclose(high, [1, 1, 0.2], atol=1e-6)
    assert low[2] < -0.05


def test_a_look_may_have_a_picture_of_its_surroundings(edits, tmp_path):
    (tmp_path / "quay.hdr").write_bytes(b"x")
    look = edits("look: {style: relit, environment: quay.hdr, tint: [1, 0.5, 0], exposure: -1}").look
    assert look == Look("relit", "source", "quay.hdr", (1.0, 0.5, 0.0), -1.0)
    before = look.mark(tmp_path)
    (tmp_path / "quay.hdr").write_bytes(b"y")
    assert look.mark(tmp_path) != before  # another picture under the same name is another look


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("emitters:\n  - {shape: sphere, radius: 1, speed: 3}", ["line 2", "unknown entry 'speed'"]),
        ("emitters:\n  - {shape: sphere, radius: 1, velocty: [0, 0, 1]}", ["line 2", "write 'velocity'"]),
        ("emitters: [{shape: sphere, radius: 1, start: 3, end: 2}]", ["end 2 s", "starts at 3 s"]),
        ("emitters: [{shape: sphere, radius: 1, color: [0, 0, 255]}]", ["color", "from 0 to 1", "sRGB"]),
        ("emitters: [{radius: 1}]", ["an emitter with neither shape nor mesh"]),
        ("emitters: [{name: a, shape: sphere, radius: 1}, {name: a, shape: sphere, radius: 1}]", ["second emitter"]),
        ("emitters: [{mesh: open.obj}]", ["line 1", "open", "fill the holes"]),
        ("terrain: [{mesh: open.obj}]", ["line 1", "open", "fill the holes"]),
        ("terrain: [{mesh: no.obj}]", ["line 1", "no.obj"]),
        ("terrain:\n  - {twst: 3}", ["line 2", "write 'twist'"]),
        ("terrain:\n  - {move: [0, 0, 1], twist: 3}", ["line 2", "move and twist in one edit", "line of its own"]),
        ("terrain: [{scale: 0}]", ["scale", "0.01 to 100"]),
        ("terrain: [{scale: [1, 1, -1]}]", ["scale", "inside out"]),
        ("terrain: {twist: 3}", ["a list"]),
        ("terrain: [{rotate: east}]", ["rotate", "degrees"]),
        ("inflow: {factor: -1}", ["factor", "0 to 100"]),
        ("inflow:\n  keyframes:\n  - {time: 1, factor: 1}\n  - {time: 1, factor: 2}", ["line 4", "order of time"]),
        ("inflow: {flucuation: 1}", ["write 'fluctuation'"]),
        ("look: {style: splat}", ["write 'splats'"]),
        ("look: {material: watre}", ["write 'water'"]),
        ("look: {environment: skye}", ["write 'sky'", ".hdr"]),
        ("look: {environment: no.hdr}", ["there is no 'no.hdr'"]),
        ("look: {environment: ../a.hdr}", ["inside its own folder"]),
        ("look: {tint: [2, 0, 0]}", ["tint", "from 0 to 1"]),
        ("look: {exposure: 99}", ["exposure", "stops"]),
        ("loop: 1", ["loop", "true or false"]),
        ("parameters: {density: 1}\nparameters: {density: 2}", ["line 2", "'parameters' twice"]),
        ("duration: 2001-13-01", ["scene.yaml"]),
        (f"duration: 1{'0' * 400}", ["line 1", "a number of 401 characters"]),
        ("parameters: {density: 1\n", ["scene.yaml, line 2", "not valid YAML"]),
        ("parameters: &a {density: 1}\nlook: *a", ["aliases"]),
    ],
)
def test_a_complaint_names_line_range_unit_and_the_nearest_name(edits, tmp_path, text, words):
    mesh = box_mesh(np.ones(3))
    write_obj(tmp_path / "open.obj", type(mesh)(mesh.vertices, mesh.faces[1:]))
    with pytest.raises(InputRejected) as said:
        edits(text)
    assert [w for w in ["scene.yaml", *words] if w not in str(said.value)] == []


@pytest.mark.parametrize("section", ["emitters", "obstacles"])
def test_what_lies_outside_the_domain_is_refused_or_warned_about(edits, section):
    text = section + ": [{shape: box, size: [0.1, 0.1, 0.1], position: [0.5, 0.5, %s]}]"
    assert require_inside(edits(text % 0.3), GRID) == []
    (warning,) = require_inside(edits(text % 0.54), GRID)  # with a tenth of its height inside
    assert "scene.yaml, line 1" in warning
    assert "90 % of its extent" in warning
    with pytest.raises(InputRejected, match=r"line 1.*outside the domain.*a place within"):
        require_inside(edits(text % 0.56), GRID)


def test_an_emitter_may_be_above_the_box_as_far_as_it_is_raised(edits):
    text = "emitters: [{shape: box, size: [0.1, 0.1, 0.1], position: [0.5, 0.5, %s]}]"
    assert require_inside(edits(text % 2.4), GRID, above=2.0) == []  # its top at 2.45 m, the box ends at 0.5 m
    with pytest.raises(InputRejected, match=r"line 1.*outside the domain.*\(.*2\.5\) m"):
        require_inside(edits(text % 2.6), GRID, above=2.0)


def test_a_free_obstacle_may_be_dropped_from_above_the_box_where_it_falls_in(edits):
    text = "obstacles: [{shape: sphere, radius: 0.1, motion: %s, position: %s}]\n%s"
    assert require_inside(edits(text % ("free", [0.5, 0.5, 2.0], "")), GRID) == []
    # 1.4 m above the box: 0.53 s on its way
    (warning,) = require_inside(edits(text % ("free", [0.5, 0.5, 2.0], "")), GRID, seconds=0.5)
    assert "line 1: obstacle 'sphere1' falls for 0.53 s" in warning and "after the last frame" in warning
    assert require_inside(edits(text % ("free", [0.5, 0.5, 2.0], "")), GRID, seconds=0.6) == []
    moon = "parameters: {gravity: [0, 0, -1.62]}"
    (warning,) = require_inside(edits(text % ("free", [0.5, 0.5, 2.0], moon)), GRID, seconds=0.6)
    assert "falls for 1.3 s" in warning
    for motion, place, more in (
        ("free", [0.5, 0.5, 3.0], ""),  # more than two box lengths above
        ("free", [2.0, 0.5, 1.0], ""),  # beside it
        ("free", [0.5, 0.5, 2.0], "parameters: {gravity: [0, 0, 9.81]}"),
        ("static", [0.5, 0.5, 2.0], ""),
    ):
        with pytest.raises(InputRejected, match=r"line 1.*outside the domain"):
            require_inside(edits(text % (motion, place, more)), GRID)


def test_a_channel_that_is_extended_has_room_for_more(edits):
    far = edits("obstacles: [{shape: sphere, radius: 0.1, position: [2, 0.5, 0.2]}]")
    with pytest.raises(InputRejected, match="outside"):
        require_inside(far, GRID)
    assert require_inside(far, GRID, reach=2.0) == []


def test_an_animated_obstacle_may_come_in_from_outside(edits):
    text = "obstacles: [{{shape: sphere, radius: 0.1, motion: animated, keyframes: [{}]}}]"
    passing = text.format("{time: 0, position: [-2, 0.5, 0.2]}, {time: 1, position: [3, 0.5, 0.2]}")
    assert require_inside(edits(passing), GRID) == []
    away = text.format("{time: 0, position: [-2, 0.5, 0.2]}, {time: 1, position: [-3, 0.5, 0.2]}")
    with pytest.raises(InputRejected, match="outside"):
        require_inside(edits(away), GRID)


def test_a_mesh_in_millimetres_is_recognised(edits, tmp_path):
    write_obj(tmp_path / "rock.obj", box_mesh(np.full(3, 300.0)))
    with pytest.raises(InputRejected, match=r"300 m long, in a domain of 1 m.*scale: 0\.001"):
        require_inside(edits("obstacles: [{mesh: rock.obj}]"), GRID)
    assert require_inside(edits("obstacles: [{mesh: rock.obj, scale: 0.001, position: [0.5, 0.5, 0.2]}]"), GRID) == []


def test_an_empty_scene_changes_nothing(edits):
    assert edits("") == edits("parameters:\nobstacles:\nlook:\nterrain: []\ninflow: {}") == SceneEdits()
