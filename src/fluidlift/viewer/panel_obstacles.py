"""Obstacles: put into the fluid, dragged, sized, let float, taken away."""

from __future__ import annotations

import threading
import time
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np

from fluidlift.errors import FluidliftError
from fluidlift.scene.edits import Add, Remove
from fluidlift.scene.forecast import place_told, placed
from fluidlift.scene.open_water import open_water
from fluidlift.types import kind_of
from fluidlift.viewer.callbacks import heard, show
from fluidlift.viewer.controls import unbroken
from fluidlift.viewer.mesh_files import MOST_BYTES, UNITS, kept_mesh, mesh_entry

if TYPE_CHECKING:
    from fluidlift.viewer.app import Viewer

SHAPES = ("sphere", "box", "cylinder", "ellipsoid")
SIZE = 0.12
"""of a new obstacle, share of the size of the fluid"""
CELLS = 3.0
"""that a new obstacle measures at least: the liquid hardly sees a smaller one"""
RANGE = 6.0
"""times smaller and larger that an obstacle can be made with the slider"""
NONE = "(none)"
STILL, FLOATS = "stands still", "floats freely"


class ObstaclePanel:
    """One obstacle is chosen at a time and has the gizmo."""

    def __init__(self, viewer: Viewer) -> None:
        self._viewer, self._gui = viewer, viewer.server.gui
        self._gizmo: Any = None
        self._gizmo_of = ""
        self._refreshing = threading.RLock()
        self._level = np.zeros(3)
        """m, on the fluid: where the last one was put"""
        gui = self._gui
        self._size_now = max(SIZE * viewer.stage.size, CELLS * viewer.asset.grid.spacing)
        self._shape = gui.add_dropdown("shape", SHAPES, initial_value="sphere")
        gui.add_button("Add to the scene", icon="plus").on_click(self._add)
        with gui.add_folder("From a mesh file", expand_by_default=False):
            self._mesh_controls()
        self._chosen = gui.add_dropdown("chosen", (NONE,), initial_value=NONE, hint="the one that is edited below")
        heard(self._chosen, self._choose)
        self._where = gui.add_markdown("No obstacle is chosen.")
        low, high = (_short(size, 2) for size in (self._size_now / RANGE, self._size_now * RANGE))
        self._size = gui.add_slider("width, m", low, high, _short(low / 10, 1), _short(self._size_now))
        self._motion = gui.add_dropdown("motion", (STILL, FLOATS), initial_value=STILL)
        self._density = gui.add_slider(
            f"density, {unbroken('kg/m³')}",
            20.0,
            3000.0,
            10.0,
            500.0,
            hint="of one that floats freely; water 1000: less floats in it, more sinks",
        )
        self._remove = gui.add_button("Remove", icon="trash", color="red")
        heard(self._size, self._sized)
        heard(self._motion, self._moves)
        heard(self._density, self._weighed)
        self._remove.on_click(self._take_away)
        if kind_of(viewer.asset.kind).is_gas:
            gui.add_markdown("Smoke flows through obstacles: they are simulated in liquids only.")
        self.refresh()

    def _mesh_controls(self) -> None:
        gui = self._gui
        self._unit = gui.add_dropdown("file is in", tuple(UNITS), hint="the unit of the lengths in the file")
        self._over = gui.add_checkbox("turn over", False, hint="for a mesh whose faces look inwards")
        self._upload = gui.add_upload_button(
            "Upload and add", icon="upload", mime_type=".obj,.ply,.glb",
            hint=f".obj, binary .ply (z up) or .glb; closed; at most {MOST_BYTES // 2**20} MB; kept in the asset",
        )  # fmt: skip
        self._file = gui.add_text("file in asset", "", hint="name inside the asset's folder, such as duck.obj")
        self._named = gui.add_button("Add this file", icon="plus")
        self._upload.on_upload(self._uploaded)
        self._named.on_click(self._add_named)

    def _uploaded(self, _: Any) -> None:
        viewer, file = self._viewer, self._upload.value
        if viewer.refused():
            return
        try:
            inside, take_away = kept_mesh(viewer.folder, file.name, file.content)
        except (FluidliftError, OSError) as error:
            viewer.say(str(error))
            return
        if not self._add_mesh(inside):
            take_away()

    def _add_named(self, _: Any) -> None:
        name = self._file.value.strip()
        if name:
            self._add_mesh(name)
        else:
            self._viewer.say("Add this file: no name. Needed: a mesh file inside the asset's folder, such as duck.obj.")

    def _add_mesh(self, inside: str) -> bool:
        viewer = self._viewer
        unit, over = UNITS[self._unit.value], bool(self._over.value)
        try:
            entry = mesh_entry(viewer.folder, inside, unit, turned_over=over, over=self._room)
        except (FluidliftError, OSError) as error:
            viewer.say(str(error))
            return False
        stem = PurePosixPath(inside).stem.replace(".", "_")
        return self._put(stem, {"name": "", **entry})

    def _room(self, width: float) -> np.ndarray:
        """[3] m on the fluid, where a body so wide (m) touches neither ground nor the other obstacles."""
        taken = []
        for body in self._viewer.bodies():
            points = np.asarray(body.mesh.vertices, float)[:, :2]
            taken.append((np.asarray(body.position, float)[:2], float(np.ptp(points, axis=0).max())))
        self._level = open_water(self._viewer.asset, width, taken)
        return self._level

    def _put(self, stem: str, entry: dict[str, Any]) -> bool:
        """Add an entry under the first free name, and choose it; whether it went well."""
        viewer = self._viewer
        names = {o["name"] for o in viewer.draft.obstacles}
        name = next(f"{stem}{k}" for k in range(1, 1000) if f"{stem}{k}" not in names)
        before, viewer.chosen = viewer.chosen, name
        added = viewer.edited(
            lambda: viewer.draft.apply([Add("obstacles", entry | {"name": name})], f"{name} added"),
            f"{name} hangs just above the fluid, whose surface is at z = {self._told(self._level[2:])} m there. "
            "Drag it down by the blue arrow, or let it float: it then falls in.",
        )
        if not added:
            viewer.chosen = before
            self.refresh()
        return added

    def _entry(self) -> dict[str, Any] | None:
        return next((o for o in self._viewer.draft.obstacles if o["name"] == self._viewer.chosen), None)

    def _add(self, _: Any) -> None:
        shape = self._shape.value
        extent = _extent(shape, self._size_now)
        high = extent["size"][2] if shape == "ellipsoid" else self._size_now
        place = self._room(self._size_now) + [0.0, 0.0, 0.5 * high]
        self._put(shape, {"name": "", "shape": shape, "position": self._at(place)} | extent)

    def _choose(self, event: Any, name: str) -> None:
        if event.client is None:
            return
        self._viewer.chosen = "" if name == NONE else name
        self._viewer.messages = ""
        self.refresh()
        self._viewer.redraw()

    def _take_away(self, _: Any) -> None:
        viewer, name = self._viewer, self._viewer.chosen
        if name:
            viewer.chosen = ""
            viewer.edited(
                lambda: viewer.draft.apply([Remove(f"obstacles.{name}")], f"{name} removed"), f"{name} removed"
            )

    def _set(self, event: Any, key: str, value: Any, told: str = "") -> None:
        viewer, name = self._viewer, self._viewer.chosen
        if event.client is None or not name:
            return
        viewer.draft.move(f"obstacles.{name}.{key}", value, told or f"{name}: {key} {value}", time.monotonic())
        viewer.changed()

    def _sized(self, event: Any, value: float) -> None:
        entry, width = self._entry(), float(value)
        if event.client is None:
            return
        if entry is None:  # typed into the box of a slider that is greyed out
            self._viewer.say(f"width {width:g} m: no obstacle is chosen. Choose one, or add one first.")
            show(self._viewer.server, self._size, _short(self._size_now))
            return
        if "mesh" in entry:
            now = self._mesh_width(entry)
            if now is not None:
                scale = np.multiply(entry.get("scale", 1.0), width / now)
                scale = [_short(float(c)) for c in scale] if np.ndim(scale) else _short(float(scale))
                self._set(event, "scale", scale, f"{entry['name']}: {width:.3g} m wide")
            return
        for key, value in _extent(entry["shape"], width).items():
            self._set(event, key, value, f"{entry['name']}: {width:.3g} m wide")

    def _mesh_width(self, entry: dict[str, Any]) -> float | None:
        """m, longest side of a mesh as it is now; None where it cannot be read."""
        body = next((o for o in self._viewer.bodies() if o.name == entry["name"]), None)
        return None if body is None else float(np.ptp(body.mesh.vertices, axis=0).max())

    def _weighed(self, event: Any, density: float) -> None:
        """A slider that is greyed out cannot be moved, but its box can be typed into: what is typed there is told to
        have no effect, and goes back."""
        entry = self._entry()
        if event.client is not None and (entry is None or entry.get("motion") != "free"):
            thing = "no obstacle is chosen" if entry is None else f"{entry['name']} stands still"
            self._viewer.say(f"density {density:g}: {thing}, and only what floats freely has one that counts.")
            show(self._viewer.server, self._density, _density(entry))
            return
        self._set(event, "density", float(density))

    def _moves(self, event: Any, motion: str) -> None:
        name = self._viewer.chosen
        if event.client is not None and name:
            self._density.disabled = motion != FLOATS
            self._viewer.say(
                f"{name} begins where the arrows are, falls in and drifts as time goes on." if motion == FLOATS else ""
            )
        self._set(event, "motion", "free" if motion == FLOATS else "static")

    # the gizmo

    def refresh(self) -> None:
        """Show the obstacles of the scene, and the chosen one's values."""
        with self._refreshing:  # of two threads the later one shows what is chosen by then
            self._refresh()

    def _refresh(self) -> None:
        viewer = self._viewer
        names = tuple(o["name"] for o in viewer.draft.obstacles)
        if viewer.chosen not in names:
            viewer.chosen = ""
        if self._chosen.options != (NONE, *names):
            self._chosen.options = (NONE, *names)
        show(viewer.server, self._chosen, viewer.chosen or NONE)
        entry = self._entry()
        for handle in (self._size, self._motion, self._remove):
            handle.disabled = entry is None
        self._density.disabled = entry is None or entry.get("motion") != "free"
        self._place_gizmo(entry)
        if entry is None:
            self._where.content = "No obstacle is chosen." if names else "There are no obstacles yet."
            return
        self._tell(entry)
        show(viewer.server, self._motion, FLOATS if entry.get("motion") == "free" else STILL)
        show(viewer.server, self._density, _density(entry))
        width = self._mesh_width(entry) if "mesh" in entry else _width(entry)
        if width is not None:
            show(viewer.server, self._size, min(max(width, self._size.min), self._size.max))

    def _at(self, place: Any) -> list[float]:
        """A place as it is written: to a hundredth of a cell."""
        return placed(place, 0.01 * self._viewer.asset.grid.spacing)

    def _told(self, place: Any) -> str:
        return place_told(place, self._viewer.asset.grid.spacing)

    def _tell(self, entry: dict[str, Any]) -> None:
        at = self._told(entry.get("position", (0, 0, 0)))
        turn = entry.get("rotation", (0, 0, 0))
        turned = "" if not any(turn) else f", turned by ({', '.join(f'{float(a):.0f}' for a in turn)})°"
        self._where.content = f"**{entry['name']}** at ({at}) m{turned}"

    def _place_gizmo(self, entry: dict[str, Any] | None) -> None:
        name = "" if entry is None else entry["name"]
        if name != self._gizmo_of:
            if self._gizmo is not None:
                self._gizmo.remove()
            self._gizmo, self._gizmo_of = None, ""
        if entry is None:
            return
        place, turn = _pose(entry)
        if self._gizmo is None:
            self._gizmo = self._viewer.server.scene.add_transform_controls(
                "/gizmo", scale=1.2 * SIZE * self._viewer.stage.size, depth_test=False, position=place, wxyz=turn
            )
            self._gizmo_of = name
            self._gizmo.on_update(self._dragged)
        else:
            self._gizmo.position, self._gizmo.wxyz = place, turn

    def _dragged(self, event: Any) -> None:
        viewer, name = self._viewer, self._gizmo_of
        gizmo = self._gizmo
        if event.client is None or not name or gizmo is None:
            return
        now = time.monotonic()
        position = self._at(gizmo.position)
        told = f"{name} moved to ({self._told(position)}) m"
        viewer.draft.move(f"obstacles.{name}.position", position, told, now)
        turn = _degrees(np.asarray(gizmo.wxyz, float))
        entry = self._entry() or {}
        if np.abs(np.subtract(turn, entry.get("rotation", (0, 0, 0)))).max() > 0.05:
            viewer.draft.move(f"obstacles.{name}.rotation", turn, f"{name} turned", now)
        entry = self._entry()
        if entry is not None:
            self._tell(entry)
        viewer.changed()


def _extent(shape: str, width: float) -> dict[str, Any]:
    """Entries of scene.yaml that make a shape so wide, m."""
    w = _short(width)
    if shape == "sphere":
        return {"radius": _short(0.5 * width)}
    if shape == "cylinder":
        return {"radius": _short(0.5 * width), "height": w}
    return {"size": [w, w, w] if shape == "box" else [w, _short(0.6 * width), _short(0.6 * width)]}


def _width(entry: dict[str, Any]) -> float | None:
    if "radius" in entry:
        return 2 * float(entry["radius"])
    size = entry.get("size")
    return float(size[0]) if isinstance(size, list | tuple) else (float(size) if size else None)


def _density(entry: dict[str, Any] | None) -> float:
    """kg/m^3, within what the slider has."""
    return min(max(float((entry or {}).get("density", 500.0)), 20.0), 3000.0)


def _short(value: float, digits: int = 4) -> float:
    """Without the digits that nobody can see."""
    return float(f"{value:.{digits}g}")


def _pose(entry: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    from fluidlift.io.obstacles import rotation_of

    x, y, z = (float(a) for a in entry.get("rotation", (0, 0, 0)))
    return np.asarray(entry.get("position", (0, 0, 0)), float), rotation_of((x, y, z))


def _degrees(quat: np.ndarray) -> list[float]:
    """Turns about the world's x, then y, then z axis, degrees, of a quaternion w, x, y, z."""
    from scipy.spatial.transform import Rotation

    turned = Rotation.from_quat(quat[[1, 2, 3, 0]]).as_euler("xyz", degrees=True)
    return [round(float(a), 2) + 0.0 for a in turned]
