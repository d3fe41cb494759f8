"""Edits on their way into the history: what a drag of a slider becomes."""

import pytest

from fluidlift.errors import InputRejected
from fluidlift.scene.edits import EditSession
from fluidlift.types import FluidParameters
from fluidlift.viewer.draft import QUIET, Draft

GRAVITY = "parameters.gravity"


@pytest.fixture
def session(tank_folder):
    return EditSession.open(tank_folder)


@pytest.fixture
def draft(session):
    return Draft(session, FluidParameters())


def test_a_drag_is_one_edit_taken_over_once_the_hand_rests(draft, session):
    for k in range(20):
        draft.move(GRAVITY, [0, 0, -float(k)], f"gravity {k}", now=0.1 * k)
        assert not draft.settle(0.1 * k + 0.05)
    assert draft.parameters["gravity"] == [0, 0, -19.0]
    assert not session.scene.get("parameters")
    assert draft.settle(2.0 + QUIET)
    assert session.scene["parameters"]["gravity"] == [0, 0, -19.0]
    assert [e.what for e in session.history()] == ["gravity 19"]
    assert not draft.settle(100.0)


def test_undo_takes_a_whole_drag_back_and_redo_brings_it_again(draft):
    draft.move(GRAVITY, [0, 0, -1.0], "gravity 1", 0.0)
    draft.commit()
    draft.move(GRAVITY, [0, 0, -2.0], "gravity 2", 1.0)
    draft.undo()  # what is pending is an edit too
    assert draft.parameters["gravity"] == [0, 0, -1.0]
    draft.redo()
    assert draft.parameters["gravity"] == [0, 0, -2.0]
    draft.reset()
    assert draft.parameters["gravity"] == [0, 0, -9.81]
    draft.undo()
    assert draft.parameters["gravity"] == [0, 0, -2.0]


def test_an_edit_that_does_not_fit_is_dropped_and_told(draft, session):
    draft.move("parameters.density", -4.0, "density -4", 0.0)
    with pytest.raises(InputRejected, match="density"):
        draft.commit()
    assert not draft.pending and not session.scene.get("parameters")
    assert draft.parameters["density"] == 1000.0


def test_a_value_as_fitted_leaves_no_trace(draft, session):
    draft.move(GRAVITY, [0, 0, -1.0], "gravity 1", 0.0)
    draft.commit()
    draft.move(GRAVITY, None, "gravity as fitted", 1.0)
    assert draft.parameters["gravity"] == [0, 0, -9.81] and "gravity" not in draft.scene["parameters"]
    draft.commit()
    assert "gravity" not in (session.scene.get("parameters") or {})


def test_obstacles_are_moved_by_their_names(draft, session):
    from fluidlift.scene.edits import Add

    draft.apply([Add("obstacles", {"shape": "sphere", "radius": 0.05, "position": [0.3, 0.2, 0.2]})], "added")
    name = draft.obstacles[0]["name"]
    draft.move(f"obstacles.{name}.position", [0.4, 0.2, 0.2], "moved", 0.0)
    assert draft.obstacles[0]["position"] == [0.4, 0.2, 0.2]
    assert session.scene["obstacles"][0]["position"] == [0.3, 0.2, 0.2]
    draft.commit()
    assert session.scene["obstacles"][0]["position"] == [0.4, 0.2, 0.2]


def test_a_material_changes_how_it_looks_and_how_it_flows(draft):
    draft.make_of("honey")
    assert draft.look["material"] == "honey"
    assert draft.parameters["kinematic_viscosity"] > 1e-3
    draft.undo()
    assert not draft.look and draft.parameters["kinematic_viscosity"] == pytest.approx(1e-6)


def test_what_somebody_else_wrote_is_seen_once_it_is_read_again(draft, tank_folder):
    assert draft.parameters["density"] == 1000.0
    (tank_folder / "scene.yaml").write_text("parameters: {density: 900}\n")
    draft.forget()
    assert draft.parameters["density"] == 900


def test_undo_without_an_edit_is_told(draft):
    with pytest.raises(InputRejected, match="undo"):
        draft.undo()
