"""Obstacles: put into the fluid, dragged, sized, let float, taken away."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import numpy as np

from fluidlift.pipeline.editing import Add, Remove

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
        gui = self._gui
        self._size_now = max(SIZE * viewer.stage.size, CELLS * viewer.asset.grid.spacing)
        self._shape = gui.add_dropdown("shape", SHAPES, initial_value="sphere")
        gui.add_button("Add to the scene", icon="plus").on_click(self._add)
        self._chosen = gui.add_dropdown("chosen", (NONE,), initial_value=NONE)
        self._chosen.on_update(self._choose)
        self._where = gui.add_markdown("No obstacle is chosen.")
        low, high = self._size_now / RANGE, self._size_now * RANGE
        self._size = gui.add_slider("width, m", _short(low), _short(high), _short(low / 10), _short(self._size_now))
        self._motion = gui.add_dropdown("motion", (STILL, FLOATS), initial_value=STILL)
        self._density = gui.add_slider(
            "density, kg/m³", 20.0, 3000.0, 10.0, 500.0, hint="water 1000; less floats in it"
        )
        self._remove = gui.add_button("Remove", icon="trash", color="red")
        self._size.on_update(self._sized)
        self._motion.on_update(self._moves)
        self._density.on_update(lambda e: self._set(e, "density", float(self._density.value)))
        self._remove.on_click(self._take_away)
        if viewer.asset.kind == "plume":
            gui.add_markdown("Smoke flows through obstacles: they are simulated in liquids only.")
        self.refresh()

    def _entry(self) -> dict[str, Any] | None:
        return next((o for o in self._viewer.draft.obstacles if o["name"] == self._viewer.chosen), None)

    def _add(self, _: Any) -> None:
        viewer, shape = self._viewer, self._shape.value
        names = {o["name"] for o in viewer.draft.obstacles}
        name = next(f"{shape}{k}" for k in range(1, 1000) if f"{shape}{k}" not in names)
        place = (*viewer.stage.middle[:2], viewer.stage.top + 0.5 * self._size_now)
        entry = {"name": name, "shape": shape, "position": [_short(float(c)) for c in place]}
        entry |= _extent(shape, self._size_now)
        viewer.chosen = name
        if not viewer.edited(
            lambda: viewer.draft.apply([Add("obstacles", entry)], f"{name} added"), "Drag it with the arrows."
        ):
            viewer.chosen = ""
            self.refresh()

    def _choose(self, event: Any) -> None:
        if event.client is None:
            return
        self._viewer.chosen = "" if self._chosen.value == NONE else self._chosen.value
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

    def _sized(self, event: Any) -> None:
        entry, width = self._entry(), float(self._size.value)
        if entry is None or event.client is None:
            return
        if "mesh" in entry:
            self._viewer.say("The size of a mesh is its scale in scene.yaml.")
            return
        for key, value in _extent(entry["shape"], width).items():
            self._set(event, key, value, f"{entry['name']}: {width:.3g} m wide")

    def _moves(self, event: Any) -> None:
        self._set(event, "motion", "free" if self._motion.value == FLOATS else "static")

    # the gizmo

    def refresh(self) -> None:
        """Show the obstacles of the scene, and the chosen one's values."""
        viewer = self._viewer
        names = tuple(o["name"] for o in viewer.draft.obstacles)
        if viewer.chosen not in names:
            viewer.chosen = ""
        if self._chosen.options != (NONE, *names):
            self._chosen.options = (NONE, *names)
        if self._chosen.value != (viewer.chosen or NONE):
            self._chosen.value = viewer.chosen or NONE
        entry = self._entry()
        for handle in (self._size, self._motion, self._density, self._remove):
            handle.disabled = entry is None
        self._place_gizmo(entry)
        if entry is None:
            self._where.content = "No obstacle is chosen." if names else "There are no obstacles yet."
            return
        self._tell(entry)
        motion = FLOATS if entry.get("motion") == "free" else STILL
        if self._motion.value != motion:
            self._motion.value = motion
        self._density.value = min(max(float(entry.get("density", 500.0)), 20.0), 3000.0)
        width = _width(entry)
        if width is not None:
            self._size.value = min(max(width, self._size.min), self._size.max)

    def _tell(self, entry: dict[str, Any]) -> None:
        at = ", ".join(f"{float(c):.3g}" for c in entry.get("position", (0, 0, 0)))
        turn = entry.get("rotation", (0, 0, 0))
        turned = "" if not any(turn) else f", turned by ({', '.join(f'{float(a):.0f}' for a in turn)})°"
        self._where.content = f"**{entry['name']}** at ({at}) m{turned}"

    def _place_gizmo(self, entry: dict[str, Any] | None) -> None:
        name = "" if entry is None else entry["name"]
        if name != self._gizmo_of:
            if self._gizmo is not None:
                self._gizmo.remove()
            self._gizmo, self._gizmo_of = None, name
        if entry is None:
            return
        place, turn = _pose(entry)
        if self._gizmo is None:
            self._gizmo = self._viewer.server.scene.add_transform_controls(
                "/gizmo", scale=1.2 * SIZE * self._viewer.stage.size, depth_test=False, position=place, wxyz=turn
            )
            self._gizmo.on_update(self._dragged)
        else:
            self._gizmo.position, self._gizmo.wxyz = place, turn

    def _dragged(self, event: Any) -> None:
        viewer, name = self._viewer, self._gizmo_of
        gizmo = self._gizmo
        if event.client is None or not name or gizmo is None:
            return
        now = time.monotonic()
        position = [_short(float(c)) for c in gizmo.position]
        told = f"{name} moved to ({', '.join(f'{c:.3g}' for c in position)}) m"
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


def _short(value: float) -> float:
    """Without the digits that nobody can see."""
    return float(f"{value:.4g}")


def _pose(entry: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    from fluidlift.io.obstacles import rotation_of

    x, y, z = (float(a) for a in entry.get("rotation", (0, 0, 0)))
    return np.asarray(entry.get("position", (0, 0, 0)), float), rotation_of((x, y, z))


def _degrees(quat: np.ndarray) -> list[float]:
    """Turns about the world's x, then y, then z axis, degrees, of a quaternion w, x, y, z."""
    from scipy.spatial.transform import Rotation

    turned = Rotation.from_quat(quat[[1, 2, 3, 0]]).as_euler("xyz", degrees=True)
    return [round(float(a), 2) + 0.0 for a in turned]
