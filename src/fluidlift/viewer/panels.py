"""The controls beside the picture: what is shown, when, and in what state everything is."""

from __future__ import annotations

import shlex
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from fluidlift.errors import FluidliftError
from fluidlift.io.frames import FIRST_FRAME
from fluidlift.viewer import kept_layout, kept_views
from fluidlift.viewer.callbacks import heard, show
from fluidlift.viewer.footage import GONE, WIDTH
from fluidlift.viewer.panel_fluid import FluidPanel
from fluidlift.viewer.panel_obstacles import ObstaclePanel
from fluidlift.viewer.panel_run import RunPanel
from fluidlift.viewer.stage import whole_fov, world_from_camera
from fluidlift.viewer.timeline import SPEEDS

if TYPE_CHECKING:
    from fluidlift.viewer.app import Viewer

LEVEL = 0.02
"""rad of roll up to which a camera's horizon counts as level"""

SHOWN = {
    "splats": "splats", "points": "points", "arrows": "velocity arrows", "surface": "surface mesh", "ground": "terrain",
    "obstacles": "obstacles", "camera": "input camera",
}  # fmt: skip


class Panels:
    """All controls. Callbacks run in threads of the server; `tick`, `show_picture` in the one that draws."""

    def __init__(self, viewer: Viewer) -> None:
        self._viewer, self._gui = viewer, viewer.server.gui
        gui = self._gui
        self._status = gui.add_markdown("warming up ...")
        self._told = ""
        self._layout = kept_layout.read()
        self._play_controls()
        self._edits = gui.add_button_group("edits", ("undo", "redo", "reset"))
        self._edits.on_click(lambda _: self._back(str(self._edits.value)))
        self._keys()
        tabs = gui.add_tab_group()
        with tabs.add_tab("View"):
            self._view_controls()
        with tabs.add_tab("Fluid"):
            self.fluid = FluidPanel(viewer)
        with tabs.add_tab("Obstacles"):
            self.obstacles = ObstaclePanel(viewer)
        with tabs.add_tab("Run"):
            self.run = RunPanel(viewer)
        self._picture_panel()
        self._arrange()

    # time

    def _play_controls(self) -> None:
        gui, viewer = self._gui, self._viewer
        last = FIRST_FRAME + max(viewer.timeline.count - 1, 1)
        self._frame = gui.add_slider("frame", FIRST_FRAME, last, 1, FIRST_FRAME, hint="number of the frame, from 1001")
        self._time = gui.add_markdown(viewer.timeline.label)
        self._play = gui.add_button("Play")
        self._steps = gui.add_button_group("step", ("first", "back", "forward", "last"))
        self._speed = gui.add_dropdown("speed (1: real)", tuple(SPEEDS), initial_value="1")
        self._source = gui.add_dropdown("frames shown", ("saved frames", "live preview"), initial_value="saved frames")
        heard(self._frame, self._scrubbed)
        self._play.on_click(self._played)
        self._steps.on_click(self._stepped)
        heard(self._speed, self._sped)
        heard(self._source, self._sourced)

    def _scrubbed(self, event: Any, frame: float) -> None:
        if event.client is None:  # we moved it ourselves
            return
        with self._viewer.lock:
            self._viewer.timeline.pause()
            self._viewer.timeline.seek(int(frame) - FIRST_FRAME)
        self._viewer.redraw()

    def _keys(self) -> None:
        """What the page of an export does at the same keys, and undo."""
        for label, key, modifier, act in (
            ("Play or pause", "space", None, self._played),
            ("Next frame", "arrowright", None, lambda _: self._step("forward")),
            ("Frame before", "arrowleft", None, lambda _: self._step("back")),
            ("First frame", "home", None, lambda _: self._step("first")),
            ("Last frame", "end", None, lambda _: self._step("last")),
            ("Undo the last edit", "Z", "cmd/ctrl", lambda _: self._back("undo")),
            ("Redo the last edit", "Z", "cmd/ctrl+shift", lambda _: self._back("redo")),
            ("Fold the controls, or unfold them", "p", None, lambda _: self._lay_out(folded=not self._layout.folded)),
        ):
            self._gui.add_command(label, hotkey=key, modifier=modifier).on_trigger(act)

    def _back(self, what: str) -> None:
        """Undo, redo or reset."""
        viewer = self._viewer
        if viewer.refused():
            return
        told: list[str] = []
        if viewer.edited(lambda: told.append(getattr(viewer.draft, what)())):
            viewer.say(told[0] or "There is nothing to reset: this is the fluid as lifted.")

    def _played(self, _: Any) -> None:
        with self._viewer.lock:
            timeline = self._viewer.timeline
            if timeline.playing:
                timeline.pause()
            else:
                timeline.play(time.monotonic())
        self._viewer.redraw()

    def _stepped(self, _: Any) -> None:
        self._step(str(self._steps.value))

    def _step(self, way: str) -> None:
        with self._viewer.lock:
            timeline = self._viewer.timeline
            timeline.pause()
            if way in ("first", "last"):
                timeline.seek(0 if way == "first" else timeline.count - 1)
            else:
                timeline.step(1 if way == "forward" else -1)
        self._viewer.redraw()

    def _sped(self, _: Any, speed: str) -> None:
        with self._viewer.lock:
            self._viewer.timeline.speed = SPEEDS[speed]

    def _sourced(self, event: Any, source: str) -> None:
        if event.client is not None:
            self._viewer.set_source(source)

    # view

    def _view_controls(self) -> None:
        gui, viewer = self._gui, self._viewer
        self._checks = {}
        for name, label in SHOWN.items():
            check = gui.add_checkbox(label, getattr(viewer.parts, name))
            heard(check, lambda event, on, name=name: self._ticked(event, name, bool(on)))
            self._checks[name] = check
        self._legend = gui.add_markdown("", visible=False)
        gui.add_button("Look from the input camera", icon="video").on_click(self._input_view)
        gui.add_button("Look from the side", icon="arrows-horizontal").on_click(self._side_view)
        film = gui.add_dropdown(
            "input video", tuple(kept_layout.FILMS), initial_value=self._layout.film,
            hint="size of its window; it is kept for other assets, and so is whether the controls are folded (key p)",
        )  # fmt: skip
        heard(film, lambda event, size: None if event.client is None else self._lay_out(film=str(size)))
        kept = gui.add_button_group(
            "camera for render", ("keep", "forget"), hint="cameras of several frames make a path; forget takes all away"
        )
        kept.on_click(lambda event: self._kept_view(event, str(kept.value)))

    def _kept_view(self, event: Any, what: str) -> None:
        viewer = self._viewer
        if event.client is None or viewer.refused():
            return
        if what == "forget":
            viewer.say("Kept cameras are forgotten." if kept_views.forget(viewer.folder) else "No camera is kept.")
            return
        view, frame = event.client.camera, viewer.timeline.frame
        key = kept_views.key_of(frame, view.position, view.look_at, float(view.fov), float(view.aspect))
        try:
            count = kept_views.keep(viewer.folder, key)
        except (FluidliftError, OSError) as error:
            viewer.say(str(error))
            return
        place = shlex.quote(str(viewer.folder))
        path = f"a path of {count}" if count > 1 else "one, which stands still"
        viewer.say(f"Camera of frame {FIRST_FRAME + frame} kept ({path}): `fluidlift render {place} --view "
                   f"{shlex.quote(str(viewer.folder / kept_views.FILE))}`")  # fmt: skip

    def _ticked(self, event: Any, name: str, on: bool) -> None:
        if event.client is not None:  # else we ticked it ourselves
            self._viewer.set_parts(**{name: on})

    def show_parts(self, changes: dict[str, bool]) -> None:
        """These are on or off now."""
        for name, on in changes.items():
            show(self._viewer.server, self._checks[name], on)

    def _input_view(self, event: Any) -> None:
        if event.client is None:
            return
        viewer, camera = self._viewer, self._viewer.asset.camera
        axes = world_from_camera(camera)
        up = -axes[:, 1]
        if abs(axes[2, 0]) < LEVEL and abs(axes[2, 2]) < 0.99:  # level: orbiting then keeps the horizon level too
            up = np.array([0.0, 0.0, 1.0])
        self._look(
            event.client, np.asarray(camera.position), viewer.stage.distance() * axes[:, 2], up,
            whole_fov(camera, event.client.camera.aspect),
        )  # fmt: skip

    def _side_view(self, event: Any) -> None:
        if event.client is None:
            return
        stage, along = self._viewer.stage, np.asarray(self._viewer.asset.terrain.mainstream, float)
        across = np.cross(along, (0.0, 0.0, 1.0))
        across = across / np.linalg.norm(across) if np.linalg.norm(across) > 1e-3 else np.array([0.0, -1.0, 0.0])
        away = 1.3 * stage.size * (across + np.array([0.0, 0.0, 0.35]))
        self._look(event.client, stage.middle + away, -away, np.array([0.0, 0.0, 1.0]), 0.75)

    @staticmethod
    def _look(client: Any, eye: np.ndarray, ahead: np.ndarray, up: np.ndarray, fov: float) -> None:
        with client.atomic():
            client.camera.up_direction = up
            client.camera.position = eye
            client.camera.look_at = eye + ahead
            client.camera.fov = fov

    # input video

    def _picture_panel(self) -> None:
        panel = self._film = self._gui.add_panel()
        with panel.add_tab("Input video", icon="video"):
            self._picture_note = self._gui.add_markdown("looking for the input video ...")
            self._picture = self._gui.add_image(np.full((4, 6, 3), 230, np.uint8), format="jpeg", visible=False)
        panel.float(x=12, y=12, width=kept_layout.FILMS[self._layout.film])

    def _lay_out(self, **changes: Any) -> None:
        """Arrange the page otherwise, from now on."""
        self._layout = replace(self._layout, **changes)
        kept_layout.keep(self._layout)
        self._arrange()

    def _arrange(self) -> None:
        controls, film = self._gui.main_panel, self._film
        (controls.minimize if self._layout.folded else controls.expand)()
        film.set_width(kept_layout.FILMS[self._layout.film])
        (film.minimize if self._layout.film == "folded" else film.expand)()

    def show_picture(self, index: int) -> None:
        """The picture of the video at the time of a frame, from 0."""
        viewer = self._viewer
        if viewer.looking_for_pictures:
            return
        if viewer.pictures is None:
            self._say_of_picture(GONE)
            return
        picture, over = viewer.pictures.at(index * viewer.timeline.interval)
        self._picture.image = picture[:, :WIDTH]
        self._picture.visible = True
        end = ", which has ended by now: its last picture" if over else ""
        self._say_of_picture(f"from {viewer.pictures.source}{end}")

    def _say_of_picture(self, text: str) -> None:
        if self._picture_note.content != text:
            self._picture_note.content = text

    # state

    def tick(self) -> None:
        """Bring up to date what tells the time and the state."""
        viewer, timeline = self._viewer, self._viewer.timeline
        last = FIRST_FRAME + max(timeline.count - 1, 1)
        if self._frame.max != last:
            self._frame.max = last
        show(viewer.server, self._frame, min(FIRST_FRAME + timeline.frame, last))
        _assign(self._time, "content", f"**{timeline.label}** of {(timeline.count - 1) * timeline.interval:.2f} s")
        _assign(self._play, "label", "Pause" if timeline.playing else "Play")
        show(viewer.server, self._source, viewer.source)
        _assign(self._status, "content", self._state_told())
        self._tell_arrows()
        self.run.tick()

    def _tell_arrows(self) -> None:
        viewer = self._viewer
        if self._legend.visible != viewer.parts.arrows:
            self._legend.visible = viewer.parts.arrows
        if viewer.parts.arrows:
            _assign(self._legend, "content", f"arrows: violet is still, yellow is {viewer.fastest:.2g} m/s")

    def _state_told(self) -> str:
        viewer = self._viewer
        lines = []
        if viewer.source == "live preview" and viewer.take is not None:
            take = viewer.take
            lines.append(f"**Live preview**, coarse ({viewer.preview.particles:,} particles): "
                         f"{len(take.frames)} of {take.total} frames")  # fmt: skip
        elif viewer.saved.count:
            lines.append(f"**Saved frames**: {viewer.saved.count}")
        else:
            lines.append("**No simulated frames yet**: see 'Run'")
        phase = viewer.preview.phase
        if phase == "warming up":
            lines.append("warming up the live preview ...")
        elif phase == "held":
            lines.append("the live preview waits until the full simulation is done")
        elif phase in ("preparing", "running") or viewer.preview.busy:  # also before the worker has taken it up
            lines.append("simulating ..." if phase == "running" else "preparing the simulation ...")
        if viewer.jobs.running:
            lines.append(viewer.jobs.state.told)
        for text in (viewer.preview.problem, *viewer.comparison.warnings):
            if text and "⚠ " + text not in lines:
                lines.append("⚠ " + text)
        if viewer.messages and "⚠ " + viewer.messages not in lines:
            lines.append(viewer.messages)
        return "\n\n".join(lines)

    def refresh(self) -> None:
        """The scene has changed from elsewhere: controls show its values."""
        self.fluid.refresh()
        self.obstacles.refresh()
        self.run.refresh()

    def job_ended(self) -> None:
        """Work behind the page has ended."""
        self._viewer.say(self._viewer.jobs.state.outcome)
        self.run.refresh()


def _assign(handle: Any, name: str, value: Any) -> None:
    """Set a property where it is another one: what is set is sent to all browsers."""
    if getattr(handle, name) != value:
        setattr(handle, name, value)
