"""The page in a real browser, headless: each control is used as a person uses it, and nothing complains.

A software renderer draws it, so the asset is a tank of a few hundred splats, the picture has half of the page's pixels,
and one browser with one page serves all tests. Waits are for what is to happen, never for a time.
"""

import itertools
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("viser", reason="viser is not installed: pip install 'fluidlift[view]'")
pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

from fluidlift.scene.edits import Add
from fluidlift.viewer.controls import unbroken

CHROMIUM = Path("/usr/bin/chromium")
pytestmark = pytest.mark.skipif(not CHROMIUM.exists(), reason=f"there is no {CHROMIUM}")


@pytest.fixture(scope="module")
def viewer(finished_tank, opened_viewer, tmp_path_factory):
    import shutil

    folder = shutil.copytree(finished_tank, tmp_path_factory.mktemp("viewed") / "tank.fluid")
    made = opened_viewer(folder, 18080)
    yield made
    made.close()


@pytest.fixture(scope="module")
def page(visitor, viewer):
    made = visitor(viewer)
    made.until(lambda: viewer.preview.phase == "ready", "warming up")
    yield made
    made.page.close()


@pytest.fixture
def visit(page, viewer):
    """The page with the fluid as lifted, saved frames, the first one; nothing is drawn that need not be."""
    from fluidlift.viewer.app import SAVED

    viewer.chosen = ""
    viewer.edited(viewer.draft.reset, moves=False)
    viewer.preview.stop()
    page.until(lambda: viewer.preview.phase == "ready", "the end of the simulation before")
    viewer.preview.shown, viewer.preview.problem = None, ""
    viewer.take = None
    viewer.set_source(SAVED)
    with viewer.lock:
        viewer.timeline.pause()
        viewer.timeline.seek(0)
        viewer.timeline.speed = 1.0
    viewer.set_parts(splats=False, ground=False)
    page.until(lambda: page.label() == 1001, "the first frame")
    page.complaints.clear()
    yield page
    assert page.worries() == [] and page.strangers == []


def test_it_loads_plays_and_an_edit_changes_the_picture(visit, viewer):
    viewer.set_parts(splats=True, ground=True)
    visit.until(lambda: np.ptp(visit.picture().reshape(-1, 3), axis=0).max() > 60, "a picture")
    before = visit.picture()
    visit.press("Play")
    visit.until(lambda: visit.label() != 1001, "another frame")
    visit.press("Pause")
    visit.until(lambda: not viewer.timeline.playing, "the pause")

    viewer.edited(lambda: viewer.draft.move("parameters.gravity", [3.0, 0, 6.0], "gravity up", time.monotonic()))
    visit.live("gravity up")
    visit.says("Live preview")
    with viewer.lock:
        viewer.timeline.pause()
        viewer.timeline.seek(7)
    visit.until(lambda: visit.label() == 1008, "the last frame")

    def moved():
        return (np.abs(visit.picture().astype(int) - before).max(axis=2) > 30).mean()

    visit.until(lambda: moved() > 0.01, "water that has left its place")


def test_time_is_played_stepped_scrubbed_and_slowed_down(visit, viewer):
    for way, frame in (("forward", 1002), ("last", 1008), ("forward", 1001), ("back", 1008), ("first", 1001)):
        visit.press(way)
        visit.until(lambda frame=frame: visit.label() == frame, f"{way} to {frame}")
    visit.field("frame").fill("1005")
    visit.until(lambda: visit.label() == 1005, "the frame that was typed")
    visit.choose("speed", "1/8")
    visit.until(lambda: viewer.timeline.speed == 0.125, "the speed")
    visit.press("Play")
    visit.press("Pause")
    visit.until(lambda: not viewer.timeline.playing, "the pause")
    visit.choose("speed", "1")
    visit.until(lambda: viewer.timeline.speed == 1.0, "the speed")


def test_the_live_preview_and_the_saved_frames_are_chosen(visit, viewer):
    visit.choose("frames shown", "live preview")
    visit.says("There is no live preview yet")
    visit.until(lambda: visit.field("frames shown").input_value() == "saved frames", "going back")
    viewer.edited(lambda: viewer.draft.move("parameters.density", 900.0, "density 900", time.monotonic()))
    visit.live("density 900")
    visit.says("Live preview")
    visit.choose("frames shown", "saved frames")
    visit.says("Saved frames")
    visit.choose("frames shown", "live preview")
    visit.says("Live preview")


def test_each_part_is_put_into_the_view_and_taken_out_and_the_camera_is_placed(visit, viewer):
    visit.tab("View")
    names = {"splats": "/fluid", "points": "/points", "velocity arrows": "/velocity", "terrain": "/ground",
             "input camera": "/input camera"}  # fmt: skip
    viewer.set_parts(splats=False, ground=False)
    visit.press("last")  # at rest there are no arrows
    for label, node in names.items():
        for on in (True, False):
            box = visit.field(label)
            visit.until(lambda box=box, on=on: box.is_checked() != on, f"{label} {not on}")
            box.click()

            def there(node=node):
                handle = viewer.server.scene.get_handle_by_name(node)
                return handle is not None and handle.visible

            visit.until(lambda on=on, there=there: there() == on, f"{label} {on}")
    for way in ("Look from the side", "Look from the input camera"):
        before = np.array(visit.client().camera.position)
        visit.press(way)
        visit.until(lambda before=before: np.abs(visit.client().camera.position - before).max() > 0.1, way)
    place = viewer.asset.camera.position
    visit.until(lambda: np.abs(visit.client().camera.position - place).max() < 1e-3, "the input camera's place")


def test_a_drag_of_a_slider_is_one_edit_simulated_live_and_undo_redo_and_reset_follow_it(visit, viewer):
    visit.tab("Fluid")
    thumb = visit.page.locator(".mantine-Slider-thumb[aria-valuemax='30']")  # of gravity, m/s^2
    box = thumb.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    visit.page.mouse.move(x, y)
    visit.page.mouse.down()
    visit.page.mouse.move(x + 40, y, steps=2)
    visit.page.mouse.up()
    visit.live("gravity")
    drawn = viewer.draft.scene["parameters"]["gravity"]
    assert 11 < np.linalg.norm(drawn) <= 30
    visit.tab("Run")
    visit.says("gravity")  # the edit in words
    while viewer.draft.scene.get("parameters"):  # one edit, unless the machine held the hand up for longer than a rest
        before = viewer.draft.scene
        visit.press("undo")
        visit.until(lambda before=before: viewer.draft.scene != before, "undo")
    visit.says("(undone)")
    visit.press("redo")
    visit.until(lambda: viewer.draft.scene.get("parameters"), "redo")
    visit.press("reset")
    visit.until(lambda: not viewer.draft.scene.get("parameters"), "reset")
    visit.press("reset")
    visit.says("There is nothing to reset")


def test_what_is_typed_is_refused_or_clamped_with_the_range(visit, viewer):
    visit.tab("Fluid")
    visit.unfold("Type a value", "Set")
    visit.choose("parameter", "viscosity")
    told = {"abc": "'abc' is no number", "": "'' is no number", "nan": "is no finite number", "-4e9": "is outside",
            "1e308": "is outside", "2e-5": ""}  # fmt: skip
    for text, said in told.items():
        visit.field("value").fill(text)
        visit.until(lambda text=text: viewer.panels.fluid._text.value == text, "typing")
        visit.press("Set")
        if said:
            visit.says(said)
    visit.until(lambda: viewer.draft.parameters["kinematic_viscosity"] == 2e-5, "the last value")
    visit.says(f"viscosity {unbroken('2e-5 m²/s')}")
    viscosity = visit.page.locator(f".mantine-Slider-root:has([aria-valuemin='{-7}'])")
    assert viscosity.count() <= 1  # no box beside it holds its power of ten
    boxes = visit.page.locator("input:not([type=hidden])").evaluate_all("found => found.map(f => f.value)")
    assert not any(text.startswith("-4.7") for text in boxes)


def test_white_water_has_a_dial_that_scene_yaml_holds(visit, viewer):
    visit.tab("Fluid")
    # of white water: the tank has no inflow, and exposure begins below 0
    thumb = visit.page.locator(".mantine-Slider-thumb[aria-valuemin='0'][aria-valuemax='4']").last
    thumb.scroll_into_view_if_needed()
    box = thumb.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    visit.page.mouse.move(x, y)
    visit.page.mouse.down()
    visit.page.mouse.move(x + 40, y, steps=2)
    visit.page.mouse.up()
    visit.until(lambda: (viewer.draft.scene.get("whitewater") or {}).get("amount", 0) > 0, "the amount")
    visit.until(lambda: not viewer.draft.pending, "taking it over")
    assert "whitewater:" in (viewer.folder / "scene.yaml").read_text()
    visit.press("reset")
    visit.until(lambda: not viewer.draft.scene.get("whitewater"), "reset")


def test_a_material_changes_look_and_physics_and_the_look_alone_changes_colours(visit, viewer):
    visit.tab("Fluid")
    visit.choose("material", "honey")
    visit.until(lambda: viewer.draft.parameters["kinematic_viscosity"] > 1e-3, "honey")
    assert viewer.draft.look == {"material": "honey", "style": "surface"}
    visit.choose("environment", "studio")
    visit.choose("style", "relit")
    visit.field("exposure, stops").fill("2")
    visit.until(lambda: viewer.draft.look == {
        "material": "honey", "style": "relit", "environment": "studio", "exposure": 2.0
    }, "the look")  # fmt: skip
    visit.choose("material", "source")
    visit.until(lambda: viewer.draft.parameters["kinematic_viscosity"] == pytest.approx(1e-6), "water again")


def test_an_obstacle_is_added_dragged_sized_let_float_and_removed(visit, viewer):
    visit.tab("Obstacles")
    visit.choose("shape", "box")
    visit.press("Add to the scene")
    visit.until(lambda: viewer.chosen == "box1", "a box")
    visit.says("box1 hangs just above the fluid")
    entry = viewer.draft.obstacles[0]
    gizmo = viewer.panels.obstacles._gizmo
    along = np.array([0.0, 0.0, 1.0])

    pauses = itertools.chain((0.3, 0.6, 1.2), itertools.repeat(3.0))

    def drag():
        visit.close_notices()
        viewer.stage.look_from_input(visit.client().camera)  # each drag beside the arrow turned the view
        visit.drawn(next(pauses))
        grasped = np.array(entry["position"]) + 0.6 * gizmo.scale * along
        x, y = visit.on_screen(grasped)
        far_x, far_y = visit.on_screen(grasped - [0, 0, 0.1])
        visit.page.mouse.move(x, y)
        visit.drawn()
        visit.page.mouse.down()
        visit.drawn()
        visit.page.mouse.move(far_x, far_y, steps=4)
        visit.drawn()
        visit.page.mouse.up()
        visit.drawn(0.3)
        return viewer.draft.obstacles[0]["position"] != entry["position"]

    visit.until(drag, "a drag of the arrow upwards")  # until the renderer has put the arrow where it is grasped
    after = viewer.draft.obstacles[0]["position"]
    assert after[2] < entry["position"][2] - 0.02
    assert after[:2] == pytest.approx(entry["position"][:2], abs=1e-3)
    visit.live("box1 moved")
    visit.field("width, m").fill("0.1")
    visit.choose("motion", "floats freely")
    visit.field("density").fill("300")
    visit.live("box1")
    visit.until(lambda: viewer.draft.obstacles[0].get("density") == 300, "the density")
    found = viewer.draft.obstacles[0]
    assert found["size"] == [0.1, 0.1, 0.1] and found["motion"] == "free"
    assert len(viewer.bodies()) == 1
    visit.press("Remove")
    visit.says("There are no obstacles yet.")
    assert viewer.draft.obstacles == []


def test_of_several_obstacles_the_chosen_one_has_the_gizmo_and_the_controls(visit, viewer):
    visit.tab("Obstacles")
    visit.choose("shape", "sphere")
    for name in ("sphere1", "sphere2"):
        visit.press("Add to the scene")
        visit.until(lambda name=name: viewer.chosen == name, name)
        # the page hears of it later: a choice before that is lost with the list that it was made in
        visit.until(lambda name=name: visit.field("chosen").input_value() == name, f"{name} on the page")
    first, second = viewer.draft.obstacles
    apart = np.linalg.norm(np.subtract(first["position"], second["position"]))
    assert apart > 2 * first["radius"]  # not one inside the other
    panel = viewer.panels.obstacles
    for entry in (first, second):
        visit.choose("chosen", entry["name"])
        visit.until(lambda entry=entry: viewer.chosen == panel._gizmo_of == entry["name"], "the choice")
        visit.until(lambda entry=entry: np.allclose(panel._gizmo.position, entry["position"]), "the gizmo's place")
        visit.says(f"{entry['name']} at (")
    visit.field("width, m").fill("0.1")
    visit.until(lambda: viewer.draft.obstacles[1]["radius"] == 0.05, "the width of the second")
    assert viewer.draft.obstacles[0] == first
    assert panel._density.disabled  # what stands still needs none
    visit.choose("chosen", "(none)")
    visit.says("No obstacle is chosen.")
    visit.until(lambda: panel._gizmo is None and visit.field("motion").is_disabled(), "nothing to change")
    for label, said in (("width, m", "no obstacle is chosen"), ("density", "no obstacle is chosen")):
        # a slider that is greyed out leaves its box open: what is typed there is told and goes back
        typed = "0.123" if label == "width, m" else "77"
        visit.field(label).fill(typed)
        visit.until(lambda said=said: said in viewer.messages, f"a word on {label}")
        visit.until(lambda label=label, typed=typed: visit.field(label).input_value() != typed, "another value again")
        viewer.say("")
    assert all("density" not in o for o in viewer.draft.obstacles)

    visit.tab("View")
    nodes = [viewer.server.scene.get_handle_by_name(f"/obstacles/{name}") for name in ("sphere1", "sphere2")]
    for on in (False, True):
        visit.field("obstacles").click()
        visit.until(lambda on=on: [n.visible for n in nodes] == [on, on], f"obstacles {on}")


def test_the_surface_is_meshed_shown_in_the_fluids_colour_and_taken_out(visit, viewer):
    pytest.importorskip("pysplashsurf", reason="pysplashsurf is not installed: no surface mesh")
    visit.tab("View")

    def blue():
        return (visit.picture()[..., 0] > visit.picture()[..., 2] + 40.0).mean()  # blue, green, red

    for on in (True, False):
        visit.field("surface mesh").click()
        visit.until(lambda on=on: (viewer.server.scene.get_handle_by_name("/surface") is not None) == on, f"mesh {on}")
        visit.until(lambda on=on: (blue() > 0.01) == on, f"a blue body {on}")


def test_a_tint_colours_the_splats_and_what_is_no_colour_changes_nothing(visit, viewer):
    viewer.set_parts(splats=True)
    visit.tab("Fluid")
    visit.field("tint").fill("#ff0000")
    visit.page.keyboard.press("Tab")  # taken when the field is left
    visit.until(lambda: viewer.draft.look.get("tint") == [1.0, 0.0, 0.0], "the tint")
    visit.until(lambda: not viewer.draft.pending, "taking over the edit")
    visit.until(lambda: (visit.picture()[..., :2].max(axis=2) < 40).mean() > 0.01, "splats without blue and green")
    visit.field("tint").fill("hello")
    visit.page.keyboard.press("Tab")
    visit.until(lambda: visit.field("tint").input_value() != "hello", "the colour as it was")
    assert viewer.draft.look["tint"] == [1.0, 0.0, 0.0]


def obj(faces=slice(None), scale=0.1, turned=False):
    from fluidlift.numerics.solid_mesh import box_mesh

    mesh = box_mesh((scale, scale, scale))
    triangles = np.asarray(mesh.faces)[faces, :: -1 if turned else 1] + 1
    lines = [f"v {x} {y} {z}" for x, y, z in mesh.vertices] + [f"f {a} {b} {c}" for a, b, c in triangles]
    return "\n".join(lines).encode()


def test_a_mesh_file_is_uploaded_and_what_bounds_no_solid_is_refused(visit, viewer):
    visit.tab("Obstacles")
    visit.unfold("From a mesh file", "Add this file")
    upload = visit.page.locator("input[type=file]")
    refused = {"open.obj": (obj(slice(1, None)), "open"), "huge.obj": (obj(scale=100.0), "millimetres"),
               "inward.obj": (obj(turned=True), "inside-out"), "text.txt": (b"hello", "as a mesh"),
               "none.obj": (b"", "is empty")}  # fmt: skip
    for name, (content, said) in refused.items():
        upload.set_input_files({"name": name, "mimeType": "text/plain", "buffer": content})
        visit.until(lambda said=said: said in viewer.messages, f"a refusal of {name}")
    # a refusal is said before its file is taken away, in a thread of its own
    visit.until(lambda: not (viewer.folder / "meshes").exists(), "what was refused is taken away")
    assert viewer.draft.obstacles == []
    visit.field("turn over").click()
    visit.until(lambda: viewer.panels.obstacles._over.value, "the tick")
    upload.set_input_files({"name": "inward.obj", "mimeType": "text/plain", "buffer": obj(turned=True)})
    visit.until(lambda: viewer.chosen == "inward1", "the mesh turned over")
    assert viewer.draft.obstacles[0]["flip"] is True
    visit.press("Remove")
    visit.until(lambda: viewer.draft.obstacles == [], "the removal")
    visit.field("turn over").click()
    visit.until(lambda: not viewer.panels.obstacles._over.value, "no tick")
    visit.choose("file is in", "millimetres")
    upload.set_input_files({"name": "my box.obj", "mimeType": "text/plain", "buffer": obj(scale=100.0)})
    visit.until(lambda: viewer.chosen == "my_box1", "the box")
    entry = viewer.draft.obstacles[0]
    assert entry["mesh"] == "meshes/my_box.obj" and entry["scale"] == 0.001
    assert np.ptp(viewer.bodies()[0].mesh.vertices, axis=0) == pytest.approx([0.1, 0.1, 0.1])
    visit.field("width, m").fill("0.2")
    visit.until(lambda: viewer.draft.obstacles[0]["scale"] == 0.002, "twice the size")
    visit.field("file in asset").fill("meshes/my_box.obj")
    visit.until(lambda: viewer.panels.obstacles._file.value, "typing")
    visit.press("Add this file")
    visit.until(lambda: viewer.chosen == "my_box2", "a second one")
    visit.field("file in asset").fill("../secret.obj")
    visit.until(lambda: viewer.panels.obstacles._file.value.startswith(".."), "typing")
    visit.press("Add this file")
    visit.until(lambda: "inside its own folder" in viewer.messages, "a refusal")
    assert len(viewer.draft.obstacles) == 2


def test_edits_are_saved_simulated_in_full_stopped_exported_and_drawn(visit, viewer, tmp_path, monkeypatch):
    visit.tab("Run")
    visit.unfold("Export", "Export")
    visit.choose("format", "camera")
    visit.field("folder").fill(str(tmp_path / "out"))
    visit.until(lambda: viewer.panels.run._out.value == str(tmp_path / "out"), "typing")
    with monkeypatch.context() as patch:
        # an edit that is still moved, and frames that the page believes to be of the scene: it knows the one before
        patch.setattr(viewer.comparison, "again", lambda: None)
        viewer.comparison.stale = set()
        viewer.draft.move("parameters.density", 950.0, "density 950", time.monotonic() + 60.0)
        visit.press("Export")
        visit.says("export: the saved frames are older than this scene")
    assert "950" in (viewer.folder / "scene.yaml").read_text() and not (tmp_path / "out").exists()
    viewer.compare()

    told = viewer.jobs._told

    def waits(**changes):  # a run that takes until somebody stops it, where this one could end before the hand is there
        told(**changes)
        if changes.get("done"):
            assert viewer.jobs._stop.wait(240.0)

    with monkeypatch.context() as patch:
        patch.setattr(viewer.jobs, "_told", waits)
        visit.press("Simulate in full")
        visit.press("Stop")
        visit.until(lambda: not viewer.jobs.running, "the end")
    visit.says("stopped. What was finished is kept.")
    visit.press("Simulate in full")
    visit.says("simulated 8 frames in")
    visit.says("The saved frames are of this scene.")
    assert not visit.page.get_by_role("button", name="Stop", exact=True).is_visible()

    visit.press("Export")
    visit.until(lambda: (tmp_path / "out").exists() and not viewer.jobs.running, "the export")
    assert not viewer.jobs.state.failed and any((tmp_path / "out").iterdir())
    # what moves when the bar goes, a click may miss
    visit.page.get_by_role("button", name="Stop", exact=True).wait_for(state="hidden")
    visit.unfold("Draw a picture", "Draw")
    visit.press("Draw")
    visit.says("frame 1001 drawn")


def test_what_an_edit_leads_to_is_warned_about_until_it_is_undone(visit, viewer):
    # as fluidlift edit does
    fast = {"name": "ball", "shape": "sphere", "radius": 0.05, "position": [0.3, 0.2, 0.2], "motion": "animated",
            "velocity": [100.0, 0.0, 0.0]}  # fmt: skip
    viewer.edited(lambda: viewer.draft.apply([Add("obstacles", fast)], "ball added"), moves=False)
    visit.says("obstacle 'ball' at 100 m/s needs about 80 steps")
    visit.tab("Run")
    visit.press("undo")
    visit.until(lambda: not viewer.comparison.warnings, "no warning any more")
    visit.until(lambda: "needs about 80 steps" not in visit.page.inner_text("body"), "a page without it")


def test_what_runs_away_is_told_with_the_edit_and_the_frames_before_it_stay(visit, viewer, monkeypatch):
    from fluidlift.pipeline import preview

    viewer.edited(lambda: viewer.draft.move("parameters.gravity", [0, 0, -3.0], "gravity 3", time.monotonic()))
    visit.live("gravity 3")
    kept = viewer.take
    monkeypatch.setattr(preview, "MOST_SUBSTEPS", 10)  # it would cross 29 cells in the first frame
    viewer.edited(lambda: viewer.draft.move("parameters.gravity", [0, 0, 900.0], "gravity 900", time.monotonic()))
    visit.says("After 'gravity 900'")
    visit.says("What is shown is from before.")
    assert viewer.take is kept and viewer.take.complete


def test_a_second_browser_sees_the_same_and_one_may_close_in_the_middle_of_a_run(visit, viewer):
    other = visit.another((460, 300))
    visit.until(lambda: len(viewer.server.get_clients()) == 2, "two browsers")
    begun = SimpleNamespace(frames=0)

    def work(progress):
        while not viewer.jobs._stop.is_set() and len(viewer.server.get_clients()) > 1:
            progress.update(begun.frames, 10)
            time.sleep(0.02)
        return "run to its end"

    assert viewer.jobs.start("a run", work)
    viewer.edited(lambda: viewer.draft.move("parameters.gravity", [0, 0, -3.0], "gravity 3", time.monotonic()))
    other.until(lambda: "Live preview" in other.page.inner_text("body"), "the same in the other one")
    other.page.close()
    visit.until(lambda: len(viewer.server.get_clients()) == 1, "one browser less")
    visit.says("run to its end")
    visit.live("gravity 3")
    assert viewer.alive and not viewer.jobs.state.failed
