"""Edits of an asset: checked before they are written, undone to the byte, the same from every side."""

import json
import os
import re
import shutil
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fluidlift.errors import InputRejected
from fluidlift.io.asset_folder import load_asset, save_asset
from fluidlift.io.asset_lock import editing, writing
from fluidlift.io.export_mesh import write_obj
from fluidlift.io.scene import SCENE_TEMPLATE, SceneEdits, read_edits
from fluidlift.numerics.solid_mesh import box_mesh, moments
from fluidlift.scene import edit_history
from fluidlift.scene.edits import Add, EditSession, Remove, Set
from fluidlift.scene.splat_files import frame_files
from fluidlift.scene.substances import SUBSTANCES
from fluidlift.types import (
    CellType,
    FaceVelocity,
    FluidAsset,
    FluidParameters,
    Gaussians,
    Grid,
    PinholeCamera,
    Similarity3,
    Terrain,
    TriangleMesh,
)

DUCK = {"name": "duck", "shape": "sphere", "radius": 0.1, "position": [0.4, 0.3, 0.2]}


def channel(kind="stream") -> FluidAsset:
    """A straight channel of 8 x 6 x 5 cells of 0.1 m, two cells deep, from x = 0."""
    grid = Grid((8, 6, 5), 0.1, (0.0, 0.0, 0.0))
    cells = np.zeros(grid.shape, np.uint8)
    cells[:, :, 0] = CellType.SOLID
    cells[:, :, 1:3] = CellType.FLUID
    cells[0, :, 1:3], cells[-1, :, 1:3] = CellType.INFLOW, CellType.OUTFLOW
    distance = np.broadcast_to(0.1 * np.arange(-1, 5, dtype=np.float32), (9, 7, 6)).copy()
    places = np.argwhere(cells == CellType.FLUID)
    n = len(places)
    rest = Gaussians(
        0.1 * (places + 0.5), np.tile([1.0, 0, 0, 0], (n, 1)), np.full((n, 3), 0.04), np.full(n, 0.9),
        np.zeros((n, 1, 3)),
    )  # fmt: skip
    flow = FaceVelocity(*(np.full(grid.face_shape(a), 0.5 * (a == 0), np.float32) for a in range(3)))
    ground = TriangleMesh(np.array([[0, 0, 0.1], [0.8, 0, 0.1], [0, 0.6, 0.1]]), np.array([[0, 1, 2]]))
    return FluidAsset(
        kind=kind, rest=rest, terrain=Terrain(grid, distance, np.array([1.0, 0, 0]), ground), grid=grid,
        cell_types=cells, velocity=flow, parameters=FluidParameters(inflow_velocity=(0.5, 0, 0)), estimates={},
        camera=PinholeCamera.looking(np.array([3.0, -2, 2]), np.zeros(3), 50, (64, 36)),
        world_from_canonical=Similarity3(1.0, np.eye(3), np.zeros(3)), interval=0.04, frame_count=5,
    )  # fmt: skip


@pytest.fixture(scope="module")
def lifted(tmp_path_factory):
    """A small asset as `make` leaves it."""
    return save_asset(tmp_path_factory.mktemp("lifted") / "river.fluid", channel())


@pytest.fixture
def folder(lifted, tmp_path):
    """A copy of it."""
    return shutil.copytree(lifted, tmp_path / "river.fluid")


def scene_bytes(folder):
    return (folder / "scene.yaml").read_bytes()


def test_an_edit_keeps_what_a_person_wrote(folder):
    text = "# mine\nparameters:\n  density: 990   # salty?\nlook: {}   # later\n"
    (folder / "scene.yaml").write_text(text)
    session = EditSession.open(folder)
    session.set("parameters.kinematic_viscosity", 0.001)
    session.set("look.material", "honey")
    assert (folder / "scene.yaml").read_text() == (
        "# mine\nparameters:\n  density: 990   # salty?\n  kinematic_viscosity: 0.001\n"
        "look:   # later\n  material: honey\n"
    )


def test_a_new_obstacle_gets_a_name_that_stays_when_others_go(folder):
    session = EditSession.open(folder)
    ball = {k: v for k, v in DUCK.items() if k != "name"}
    assert [session.add("obstacles", ball) for _ in range(3)] == [f"obstacles.sphere{n}" for n in (1, 2, 3)]
    session.remove("obstacles.sphere1")
    assert [o.name for o in session.edits.obstacles] == ["sphere2", "sphere3"]
    assert session.add("obstacles", ball) == "obstacles.sphere4"  # of the free ones, none that was there after it
    session.set("obstacles.sphere3.position", (0.2, 0.3, 0.2))
    assert session.edits.obstacles[1].position == (0.2, 0.3, 0.2)


def test_edits_of_the_terrain_go_by_their_kind_and_emitters_by_their_name(folder):
    session = EditSession.open(folder)
    session.set("terrain.twist", 20)
    session.set("terrain.move", [0, 0, 0.1])
    session.set("terrain.twist", 30)
    assert session.scene["terrain"] == [{"twist": 30}, {"move": [0, 0, 0.1]}]
    session.remove("terrain.twist")
    assert session.scene["terrain"] == [{"move": [0, 0, 0.1]}]
    session.add("emitters", {"name": "tap", "shape": "box", "size": [0.1, 0.1, 0.1], "position": [0.4, 0.3, 0.4]})
    session.set("emitters.tap.velocity", [0, 0, -1])
    assert session.edits.emitters[0].velocity == (0, 0, -1)


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (Set("parameters.viscosity", 1e-3), ["write 'parameters.kinematic_viscosity'"]),
        (Set("parameters.density", -1), ["-1", "kg/m^3"]),
        (Set("parameters.gravity", [0, 0, float("nan")]), ["nan", "finite"]),
        (Set("parameters.gravity", [0, 0]), ["3 numbers", "m/s^2"]),
        (Set("look.material", "hony"), ["write 'honey'"]),
        (Set("look.environment", "sky.hdr"), ["there is no 'sky.hdr'"]),
        (Set("look.environment", "../sky.hdr"), ["inside its own folder"]),
        (Set("material", "honey"), ["write 'look.material'"]),
        (Set("obstacles.duk.position", [0, 0, 0]), ["no 'duk' in obstacles", "obstacles.duck"]),
        (Set("duration", 0), ["duration", "0"]),
        (Set("loop", "yes"), ["true or false"]),
        (Set("look.tint", object()), ["object"]),
        (Set("terrain.twst", 3), ["write 'terrain.twist'"]),
        (Remove("parameters.gravity"), ["is not in scene.yaml"]),
        (Remove("obstacles.7"), ["no '7' in obstacles"]),
        (Add("look", {}), ["nothing can be added to 'look'"]),
        (Add("obstacle", DUCK), ["write 'obstacles'"]),
        (Add("obstacles", {"shape": "sphere", "radius": 0.1, "position": [0, 0, 50]}), ["outside the domain"]),
        (Add("obstacles", {"shape": "sphere", "radius": 900}), ["millimetres", "scale: 0.001"]),
        (Add("obstacles", {"mesh": "open.obj"}), ["open", "fill the holes"]),
        (Add("obstacles", {"mesh": "inside_out.obj"}), ["inside-out", "flip: true"]),
        (Add("emitters", {"mesh": "inside_out.obj"}), ["inside-out", "flip: true"]),
        (Add("obstacles", DUCK), ["second obstacle 'duck'"]),
    ],
)
def test_a_wrong_edit_says_what_is_right_and_changes_nothing(folder, edit, words):
    mesh = box_mesh(np.full(3, 0.1))
    write_obj(folder / "open.obj", TriangleMesh(mesh.vertices, mesh.faces[1:]))
    write_obj(folder / "inside_out.obj", TriangleMesh(mesh.vertices, mesh.faces[:, ::-1]))
    session = EditSession.open(folder)
    session.add("obstacles", DUCK)
    before = scene_bytes(folder), (folder / edit_history.HISTORY).read_bytes()
    with pytest.raises(InputRejected) as said:
        session.apply([Set("parameters.density", 900), edit])
    assert [w for w in words if w not in str(said.value)] == []
    assert "scene.yaml, line" not in str(said.value)  # a line of a text that nobody has seen
    assert (scene_bytes(folder), (folder / edit_history.HISTORY).read_bytes()) == before


def test_a_mesh_that_is_inside_out_can_be_turned_over(folder):
    mesh = box_mesh(np.full(3, 0.2))
    write_obj(folder / "rock.obj", TriangleMesh(mesh.vertices, mesh.faces[:, ::-1]))
    session = EditSession.open(folder)
    session.add("obstacles", {"mesh": "rock.obj", "flip": True, "position": [0.4, 0.3, 0.2]})
    assert moments(session.edits.obstacles[0].body(1.0).mesh).volume == pytest.approx(0.2**3)


def test_an_emitter_above_the_box_is_taken_as_the_simulation_takes_it(folder):
    session = EditSession.open(folder)
    session.add("emitters", {"shape": "sphere", "radius": 0.1, "position": [0.4, 0.3, 1.5]})
    assert session.warnings() == []
    with pytest.raises(InputRejected, match="outside the domain"):
        session.add("emitters", {"shape": "sphere", "radius": 0.1, "position": [0.4, 0.3, 9.0]})


def test_a_mesh_that_was_named_by_hand_is_checked_too(folder):
    mesh = box_mesh(np.full(3, 0.1))
    write_obj(folder / "open.obj", TriangleMesh(mesh.vertices, mesh.faces[1:]))
    (folder / "scene.yaml").write_text("obstacles:\n  - {mesh: open.obj, position: [0.4, 0.3, 0.2]}\n")
    with pytest.raises(InputRejected, match=r"scene\.yaml, line 2: .*open"):
        EditSession.open(folder).warnings()


def test_several_changes_are_one_edit(folder):
    session = EditSession.open(folder)
    before = scene_bytes(folder)
    edit = session.apply([Add("obstacles", DUCK), Set("obstacles.duck.radius", 0.05), Set("duration", 2.0)])
    assert len(session.history()) == 1
    assert [line for line in edit.diff().splitlines() if "duck" in line] == [
        "+  - {name: duck, shape: sphere, radius: 0.05, position: [0.4, 0.3, 0.2]}"
    ]
    session.undo()
    assert scene_bytes(folder) == before


def test_what_changes_nothing_is_no_edit(folder):
    session = EditSession.open(folder)
    session.set("parameters.density", 1e3)
    assert session.set("parameters.density", 1000.0) is None
    assert session.set("parameters.gravity", None) is None
    assert len(session.history()) == 1


def test_honey_has_the_look_and_the_mechanics_of_honey(folder):
    session = EditSession.open(folder)
    session.apply(session.made_of("honey"))
    edits, honey = session.edits, SUBSTANCES["honey"]
    assert (edits.look.style, edits.look.material) == ("surface", "honey")
    assert edits.parameters["kinematic_viscosity"] * honey.density == pytest.approx(honey.dynamic_viscosity, rel=5e-3)
    session.apply(session.made_of("source"))  # 5e-3: the viscosity is rounded to three digits
    assert (session.edits.parameters, session.edits.look.material) == ({}, "source")


def test_nothing_is_written_before_the_first_edit(folder):
    before = sorted(p.name for p in folder.rglob("*"))
    session = EditSession.open(folder)
    assert (session.history(), session.diff(), session.can_undo) == ((), "", False)
    assert sorted(p.name for p in folder.rglob("*")) == before


def test_reset_leads_back_to_what_was_lifted_and_can_be_undone(folder):
    before = scene_bytes(folder), (folder / "parameters.json").read_bytes()
    session = EditSession.open(folder)
    session.set("parameters.density", 900)
    edited = scene_bytes(folder)
    session.reset()
    assert (scene_bytes(folder), (folder / "parameters.json").read_bytes()) == before
    session.undo()
    assert scene_bytes(folder) == edited


def test_the_history_outlives_the_process(folder):
    EditSession.open(folder).set("parameters.density", 900)
    EditSession.open(folder).set("parameters.density", 800)
    EditSession.open(folder).undo()
    again = EditSession.open(folder)
    assert [(e.what, e.undone) for e in again.history()] == [
        ("set parameters.density = 900", False), ("set parameters.density = 800", True),
    ]  # fmt: skip
    assert again.scene["parameters"]["density"] == 900
    again.redo()
    assert EditSession.open(folder).scene["parameters"]["density"] == 800
    lines = (folder / edit_history.HISTORY).read_text().splitlines()
    assert all({"time", "what"} <= set(json.loads(line)) for line in lines)


def test_an_edit_by_hand_is_an_edit_of_its_own(folder):
    session = EditSession.open(folder)
    session.set("parameters.density", 900)
    by_hand = (folder / "scene.yaml").read_text() + "duration: 3.0   # enough\n"
    (folder / "scene.yaml").write_text(by_hand)
    session.set("parameters.density", 950)
    assert [e.what for e in session.history()][1] == edit_history.BY_HAND
    session.undo()
    assert (folder / "scene.yaml").read_text() == by_hand
    session.undo()
    assert "duration" not in session.scene
    session.redo()
    assert (folder / "scene.yaml").read_text() == by_hand


def test_a_scene_that_was_changed_by_hand_before_all_is_found_again_by_undo(folder):
    found = (
        b"# mine, from an earlier version\r\nparameters:\r\n  density: 900  # heavy\r\nlook: {}\r\nduration: 3.0\r\n"
    )
    (folder / "scene.yaml").write_bytes(found)
    session = EditSession.open(folder)
    assert "+duration: 3.0" in session.diff()
    session.set("parameters.density", 800)
    session.undo()
    assert scene_bytes(folder) == found
    with pytest.raises(InputRejected, match=r"no edit to undo.*--reset"):
        session.undo()
    session.reset()
    assert session.edits == SceneEdits()
    assert b"# mine" in scene_bytes(folder)
    session.undo()
    assert scene_bytes(folder) == found


def test_a_broken_scene_can_be_undone_but_not_edited(folder):
    session = EditSession.open(folder)
    session.set("parameters.density", 900)
    good = scene_bytes(folder)
    (folder / "scene.yaml").write_text("parameters: [1\n")
    with pytest.raises(InputRejected, match=r"scene\.yaml, line \d"):
        session.set("parameters.density", 950)
    session.undo()
    assert scene_bytes(folder) == good


def test_an_error_that_was_there_before_is_told_as_such(folder):
    (folder / "scene.yaml").write_text("parameters: {densty: 3}\n")
    with pytest.raises(InputRejected, match=r"before the edit either: scene\.yaml, line 1"):
        EditSession.open(folder).set("duration", 3.0)


@pytest.mark.parametrize("step", ["announce", "write_scene", "append", "withdraw"])
def test_what_a_killed_process_had_begun_is_whole_afterwards(folder, step):
    """The process ends at once, as if killed, when it comes to one of the steps of writing an edit."""
    EditSession.open(folder).set("parameters.density", 900)
    first = scene_bytes(folder)
    child = os.fork()
    if child == 0:
        setattr(edit_history, step, lambda *a, **k: os._exit(9))
        EditSession.open(folder).set("parameters.density", 800)
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9
    session = EditSession.open(folder)
    session.set("duration", 2.0)  # whoever comes next finishes the work
    done = 900 if step == "announce" else 800
    assert session.scene["parameters"]["density"] == done
    session.undo()
    if done == 800:
        session.undo()
    assert scene_bytes(folder) == first
    assert not (folder / edit_history.PENDING).exists()


def test_a_kill_while_the_history_is_written_loses_no_edit(folder):
    session = EditSession.open(folder)
    session.set("parameters.density", 900)
    first = scene_bytes(folder)
    session.set("parameters.density", 800)
    path = folder / edit_history.HISTORY
    path.write_bytes(path.read_bytes()[:-40])  # half a line
    session.undo()
    assert scene_bytes(folder) == first
    assert [e.what for e in session.history()][1] == edit_history.BY_HAND


@pytest.mark.parametrize("step", ["write_scene", "append"])
def test_a_full_disk_changes_nothing(folder, step, monkeypatch):
    session = EditSession.open(folder)
    session.set("parameters.density", 900)
    before = scene_bytes(folder), (folder / edit_history.HISTORY).read_bytes()
    real, calls = getattr(edit_history, step), []

    def full(*args, **options):
        calls.append(step)
        if len(calls) == 1:
            raise InputRejected("disk full", "free space")
        return real(*args, **options)

    monkeypatch.setattr(edit_history, step, full)
    with pytest.raises(InputRejected, match="disk full"):
        session.set("parameters.density", 800)
    assert (scene_bytes(folder), (folder / edit_history.HISTORY).read_bytes()) == before
    session.undo()
    assert session.scene["parameters"] == {}


@pytest.mark.parametrize(
    "damage", [lambda text: "{}\n" + text, lambda text: re.sub('"number": 1', '"number": 1e999', text)]
)
def test_a_damaged_history_is_told_and_the_scene_kept(folder, damage):
    session = EditSession.open(folder)
    session.set("parameters.density", 900)
    path, before = folder / edit_history.HISTORY, scene_bytes(folder)
    text = path.read_text()
    path.write_text(damage(text))
    assert path.read_text() != text
    with pytest.raises(InputRejected, match="remove the folder edits/"):
        session.undo()
    assert scene_bytes(folder) == before


def test_two_edits_at_once_take_turns(folder):
    children = []
    for start in (100.0, 200.0):
        child = os.fork()
        if child == 0:
            for k in range(5):
                EditSession.open(folder).set("parameters.density", start + k)
            os._exit(0)
        children.append(child)
    assert [os.waitstatus_to_exitcode(os.waitpid(c, 0)[1]) for c in children] == [0, 0]
    session = EditSession.open(folder)
    assert len(session.history()) == 10
    for _ in range(10):
        session.undo()
    assert (folder / "scene.yaml").read_text() == SCENE_TEMPLATE


def test_an_asset_that_another_process_writes_is_not_edited(folder):
    ready, done = os.pipe(), os.pipe()
    child = os.fork()
    if child == 0:
        with writing(folder, "a simulation"):
            os.write(ready[1], b"1")
            os.read(done[0], 1)
        os._exit(0)
    os.read(ready[0], 1)
    before = scene_bytes(folder)
    try:
        with pytest.raises(InputRejected, match=rf"written by a simulation \(process {child}\)"):
            EditSession.open(folder).set("duration", 2.0)
    finally:
        os.write(done[1], b"1")
        os.waitpid(child, 0)
    assert scene_bytes(folder) == before
    EditSession.open(folder).set("duration", 2.0)  # the lock went with its holder
    with writing(folder, "the viewer's simulation"):
        EditSession.open(folder).set("duration", 3.0)  # one's own run is no hindrance


def test_an_edit_does_not_wait_for_ever(folder):
    with editing(folder), pytest.raises(InputRejected, match="being changed by an edit"), editing(folder, wait=0.05):
        pass


VALUES = {
    "parameters.density": st.floats(0.1, 5000),
    "parameters.kinematic_viscosity": st.one_of(st.none(), st.floats(0, 1)),
    "parameters.gravity": st.lists(st.floats(-20, 20), min_size=3, max_size=3),
    "look.material": st.sampled_from([*SUBSTANCES, None]),
    "look.tint": st.lists(st.floats(0, 1), min_size=3, max_size=3),
    "look.exposure": st.floats(-5, 5),
    "inflow.factor": st.floats(0, 3),
    "inflow.keyframes": st.just([{"time": 0, "factor": 1}, {"time": 2, "factor": 0.5}]),
    "terrain.twist": st.floats(-90, 90),
    "terrain.move": st.lists(st.floats(-1, 1), min_size=3, max_size=3),
    "duration": st.one_of(st.none(), st.floats(0.1, 100)),
    "extend_downstream": st.one_of(st.none(), st.floats(0, 3)),
    "loop": st.booleans(),
    "look.style": st.sampled_from(["splats", "relit", "surface", None]),
    "terrain.scale": st.one_of(st.floats(0.1, 3), st.lists(st.floats(0.1, 3), min_size=3, max_size=3)),
    "obstacles.duck.color": st.lists(st.floats(0, 1), min_size=3, max_size=3),
    "obstacles.duck.name": st.sampled_from(["duck", "swan"]),
    "obstacles.duck.radius": st.floats(0.01, 0.3),
}


@st.composite
def steps(draw):
    """What a person does next."""
    kind = draw(st.sampled_from(["set"] * 5 + ["add", "remove", "undo", "redo", "reset", "hand"]))
    if kind == "set":
        path = draw(st.sampled_from(sorted(VALUES)))
        return kind, Set(path, draw(VALUES[path]))
    if kind == "add":
        name = draw(st.sampled_from(["duck", "a b", "nr. 5", "ähre", "- x", "#1"]))
        return kind, Add(draw(st.sampled_from(["obstacles", "emitters"])), DUCK | {"name": name})
    if kind == "remove":
        return kind, Remove(draw(st.sampled_from(["obstacles.duck", "emitters.1", "look", "parameters", "terrain.1"])))
    texts = ["\n# a thought", "\nduration: 7\n", "\r\n", "\nextend_downstream: 1  # m\n", "\nnonsense: [\n", "\n\n\tx"]
    return kind, draw(st.sampled_from(texts))


def do(session, kind, what):
    """One step; whether it changed scene.yaml."""
    path = session.folder / "scene.yaml"
    before = path.read_bytes()
    if kind == "hand":
        path.write_bytes(before + what.encode())
        return
    try:
        if kind in ("undo", "redo", "reset"):
            getattr(session, kind)()
        else:
            session.apply([what])
    except InputRejected:
        assert path.read_bytes() == before


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(steps(), max_size=7))
def test_any_sequence_of_edits_undone_and_redone_gives_the_same_bytes(lifted, sequence):
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "river.fluid"
        folder.mkdir()
        for name in ("manifest.json", "scene.yaml"):
            shutil.copy(lifted / name, folder)
        session = EditSession.open(folder)
        found = scene_bytes(folder)
        for kind, what in sequence:
            if not (folder / edit_history.HISTORY).exists():
                found = scene_bytes(folder)  # at the first edit
            do(session, kind, what)
        if not (folder / edit_history.HISTORY).exists():
            found = scene_bytes(folder)
        session = EditSession.open(folder)
        states = [scene_bytes(folder)]
        while session.can_undo:
            session.undo()
            states.append(scene_bytes(folder))
        first = states[-1]
        assert first == found
        for state in reversed(states[:-1]):
            session.redo()
            assert scene_bytes(folder) == state
        while session.can_undo:
            session.undo()
        assert scene_bytes(folder) == first


def test_by_hand_by_command_in_python_and_in_the_viewer_give_the_same_simulation(lifted, tmp_path):
    from fluidlift.cli import DONE, WITH_WARNINGS, main
    from fluidlift.config import JobConfig
    from fluidlift.pipeline.settings import SimulateSettings, taken
    from fluidlift.pipeline.stages.simulate import simulate
    from fluidlift.scene.build import SimulationRequest, scene_of
    from fluidlift.viewer.draft import Draft

    ways = ("hand", "command", "python", "viewer")
    hand, command, python, viewer = (shutil.copytree(lifted, tmp_path / f"{n}.fluid") for n in ways)
    (hand / "scene.yaml").write_text(
        "obstacles:\n  - name: duck\n    shape: sphere\n    radius: 0.1\n"
        "    position: [0.4, 0.3, 0.2]\n    motion: free\n"
        "emitters:\n  - {name: tap, shape: sphere, radius: 0.05, position: [0.2, 0.3, 0.4], velocity: [0, 0, -1]}\n"
        "terrain:\n  - twist: 10\n"
        "parameters: {gravity: [0, 1e0, -9], kinematic_viscosity: 1e-3}\nduration: 0.12\ninflow:\n  factor: 2\n"
        "look: {material: honey}\n"
    )
    tap = {"name": "tap", "shape": "sphere", "radius": 0.05, "position": [0.2, 0.3, 0.4], "velocity": [0, 0, -1]}
    code = main([
        "edit", str(command), "--add",
        "obstacles={name: duck, shape: sphere, radius: 0.1, position: [0.4, 0.3, 0.2], motion: free}",
        "--add", "emitters={name: tap, shape: sphere, radius: 0.05, position: [0.2, 0.3, 0.4], velocity: [0, 0, -1]}",
        "--add", "terrain={twist: 10}",
        "--set", "parameters.gravity=[0, 1, -9]", "--set", "parameters.kinematic_viscosity=1e-3",
        "--set", "duration=0.12", "--set", "inflow.factor=2", "--set", "look.material=honey",
    ])  # fmt: skip
    assert code in (DONE, WITH_WARNINGS)
    session = EditSession.open(python)
    session.set("look.material", "honey")
    session.set("inflow.factor", 2.0)
    session.set("parameters.gravity", np.array([0.0, 1.0, -9.0]))
    session.set("parameters.kinematic_viscosity", np.float64(1e-3))
    session.add("emitters", tap)
    session.set("terrain.twist", 10)
    session.add("obstacles", DUCK | {"position": (0.4, 0.3, 0.2), "motion": "free"})
    session.set("duration", 0.12)
    draft = Draft(EditSession.open(viewer), FluidParameters(inflow_velocity=(0.5, 0, 0)))
    draft.apply(
        [Add("obstacles", DUCK | {"position": [0.1, 0.3, 0.2], "motion": "free"}), Add("emitters", tap)], "added"
    )
    for k, x in enumerate((0.2, 0.3, 0.4)):  # a drag
        draft.move("obstacles.duck.position", [x, 0.3, 0.2], "moved", 0.1 * k)
    draft.move("parameters.gravity", [0, 1, -9], "gravity", 1.0)
    draft.move("parameters.kinematic_viscosity", 1e-3, "viscosity", 1.1)
    draft.move("inflow.factor", 2.0, "inflow", 1.2)
    draft.move("look.material", "honey", "look", 1.3)
    draft.apply([Add("terrain", {"twist": 10.0}), Set("duration", 0.12)], "bed and length")
    plain, shown = [], []
    for folder in (hand, command, python, viewer):
        edits = read_edits(folder)
        scene = scene_of(load_asset(folder), folder, SimulationRequest(), JobConfig(), footage=None, start=0)
        rest = edits.parameters, edits.duration, edits.inflow, edits.look, edits.loop
        plain.append((rest, [repr(x) for o in edits.obstacles for x in o.plain()], scene.parts, scene.frames))
        simulate(scene, taken(SimulateSettings, JobConfig().simulate), folder=folder)
        shown.append([p.read_bytes() for p in frame_files(folder)])
    assert plain[0] == plain[1] == plain[2] == plain[3]
    assert len(shown[0]) == 3 and shown[0] == shown[1] == shown[2] == shown[3]


def test_only_what_an_edit_touches_is_stale(folder):
    from fluidlift.config import JobConfig
    from fluidlift.io.asset_folder import update_manifest
    from fluidlift.io.checkpoint import Checkpoint, write_checkpoint
    from fluidlift.scene.build import SimulationRequest, scene_of
    from fluidlift.scene.simulation import state_parts
    from fluidlift.scene.splat_files import checkpoint_file

    session = EditSession.open(folder)
    assert session.stale() == {"simulate", "look"}  # nothing was simulated yet
    scene = scene_of(load_asset(folder), folder, SimulationRequest(), JobConfig(), footage=None, start=0)
    history = {"poses": np.zeros((scene.frames, 0, 7))}
    write_checkpoint(checkpoint_file(folder), Checkpoint(scene.frames, state_parts(scene), {}, history))
    update_manifest(
        folder, simulation={"frames": scene.frames, "frame_interval": scene.interval, "seed": scene.seed}
    )  # fmt: skip
    assert session.stale() == set()
    moves = [
        Set("parameters.kinematic_viscosity", 1e-3), Set("parameters.gravity", [0, 0, -1]), Set("duration", 10.0),
        Set("extend_downstream", 0.3), Set("inflow.factor", 2.0), Set("inflow.fluctuation", 0.1), Set("loop", True),
        Set("terrain.move", [0, 0, 0.1]), Add("obstacles", DUCK), Add("emitters", DUCK | {"velocity": [0, 0, -1]}),
    ]  # fmt: skip
    looks = [Set("look.style", "relit"), Set("look", {"style": "surface", "material": "honey"})]
    for change, wanted in [(c, {"simulate"}) for c in moves] + [(c, {"look"}) for c in looks]:
        session.apply([change])
        assert session.stale() == wanted, change
        session.undo()
        assert session.stale() == set(), change
    session.set("look.material", "honey")
    assert session.stale() == set()  # splats as lifted have no material,
    assert "look.material changes nothing" in session.warnings()[0]  # and that is said
    session.apply([moves[0], looks[0]])
    assert session.stale() == {"simulate", "look"}


@pytest.fixture
def simulated(folder):
    """The asset with a checkpoint and a manifest as its simulation leaves them."""
    from fluidlift.config import JobConfig
    from fluidlift.io.asset_folder import update_manifest
    from fluidlift.io.checkpoint import Checkpoint, write_checkpoint
    from fluidlift.scene.build import SimulationRequest, scene_of
    from fluidlift.scene.simulation import state_parts
    from fluidlift.scene.splat_files import checkpoint_file

    scene = scene_of(load_asset(folder), folder, SimulationRequest(), JobConfig(), footage=None, start=0)
    held = Checkpoint(scene.frames, state_parts(scene), {}, {"poses": np.zeros((scene.frames, 0, 7))})
    write_checkpoint(checkpoint_file(folder), held)
    update_manifest(
        folder, simulation={"frames": scene.frames, "frame_interval": scene.interval, "seed": scene.seed}
    )  # fmt: skip
    return folder


@pytest.fixture
def built(monkeypatch):
    """How often it was found out what is stale by building the scene."""
    from fluidlift.scene import stale_frames

    count, plain = [], stale_frames.stale_parts
    monkeypatch.setattr(stale_frames, "stale_parts", lambda *a, **o: count.append(1) or plain(*a, **o))
    return count


def test_what_is_stale_is_found_out_once_for_each_scene(simulated, built):
    session = EditSession.open(simulated)
    for change, wanted in [(None, set()), (Set("parameters.gravity", [0, 0, -1]), {"simulate"})]:
        if change is not None:
            session.apply([change])
        before = len(built)
        assert [EditSession.open(simulated).standing() for _ in range(3)] == [(wanted, [])] * 3
        assert len(built) == before + 1
    session.undo()
    assert session.standing() == (set(), [])
    session.redo()
    assert session.standing() == ({"simulate"}, [])
    assert len(built) == 2


@pytest.mark.parametrize(
    "name", ["parameters.json", "manifest.json", "rest/terrain.npz", "work/checkpoint/simulation.npz", "rock.obj"]
)
def test_an_answer_is_forgotten_when_a_file_changes_that_it_depends_on(simulated, built, name):
    write_obj(simulated / "rock.obj", box_mesh(np.full(3, 0.1)))
    (simulated / "scene.yaml").write_text("obstacles:\n  - {mesh: rock.obj, position: [0.4, 0.3, 0.3]}\n")
    session = EditSession.open(simulated)
    first = session.standing()
    assert session.standing() == first
    known = len(built)
    file = simulated / name
    os.utime(file, ns=(0, file.stat().st_mtime_ns + 1_000_000))
    assert session.standing() == first
    assert len(built) == known + 1


def test_a_warning_is_told_again_and_no_text_comes_from_the_memory(simulated, built):
    session = EditSession.open(simulated)
    session.set("look.material", "honey")
    for _ in range(2):
        stale, warnings = session.standing()
        assert stale == set() and "look.material changes nothing" in warnings[0]
    assert len(built) == 2


@pytest.mark.parametrize("text", ["", "[", "[1]", '{"": ["simulate"]}', "x" * 10**6, "{}"])
def test_a_damaged_memory_is_none(simulated, built, text):
    session = EditSession.open(simulated)
    session.standing()
    kept = simulated / "work" / "stale.json"
    answers = json.loads(kept.read_text())
    kept.write_text(text)
    assert session.standing() == (set(), [])
    assert len(built) == 2
    for wrong in ("simulate", ["everything"], [["look"]], None, {"simulate": 1}):
        kept.write_text(json.dumps(dict.fromkeys(answers, wrong)))
        assert session.standing() == (set(), [])


def test_frames_that_were_just_simulated_are_noted_as_shown(simulated, built):
    EditSession.open(simulated).note_shown()
    assert EditSession.open(simulated).standing() == (set(), [])
    assert built == []


def test_an_asset_that_cannot_be_written_is_found_out_about_each_time(simulated, built, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "no space")

    monkeypatch.setattr("fluidlift.scene.known_state.write_json", full)
    session = EditSession.open(simulated)
    assert session.standing() == session.standing() == (set(), [])
    assert len(built) == 2
