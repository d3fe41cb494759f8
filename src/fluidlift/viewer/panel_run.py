"""What becomes of the edits: listed, simulated in full, drawn, handed on."""

from __future__ import annotations

import json
import os
import re
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fluidlift.errors import FluidliftError, InputRejected
from fluidlift.io.frames import FIRST_FRAME
from fluidlift.types import PinholeCamera, RigidTransform
from fluidlift.viewer.jobs import JobProgress

if TYPE_CHECKING:
    from fluidlift.viewer.app import Viewer

STILL = (960, 540)
"""px of a drawn picture"""
SHOWN = 12
"""edits that are listed"""


class RunPanel:
    """Edits in words, export, simulate, draw."""

    def __init__(self, viewer: Viewer) -> None:
        from fluidlift.export.job import FORMATS

        self._viewer, self._gui = viewer, viewer.server.gui
        gui = self._gui
        gui.add_markdown("Every edit is in scene.yaml as soon as it is made.")
        self._edits = gui.add_markdown("")
        with gui.add_folder("As lines of scene.yaml", expand_by_default=False):
            self._diff = gui.add_markdown("")
        # of whatever is being done: simulation, export or picture
        self._bar = gui.add_progress_bar(0.0, visible=False)
        self._stop = gui.add_button("Stop", icon="player-stop", color="red", visible=False)
        self._stop.on_click(self._stopped)
        with gui.add_folder("Simulate in full"):
            self._state = gui.add_markdown("")
            self._begin = gui.add_button("Simulate in full", icon="player-play", color="green")
            self._begin.on_click(self._simulate)
        with gui.add_folder("Export", expand_by_default=False):
            self._format = gui.add_dropdown("format", tuple(FORMATS))
            self._out = gui.add_text("folder", str(viewer.folder.absolute().parent / "export"))
            gui.add_button("Export", icon="package-export").on_click(self._export)
            self._exported = gui.add_markdown("")  # the panel's top may be scrolled away
            self._exporting = False
        with gui.add_folder("Draw a picture", expand_by_default=False):
            gui.add_markdown("This frame from here, in the chosen look.")
            gui.add_button("Draw", icon="photo").on_click(self._draw)
            self._picture = gui.add_image(np.full((4, 6, 3), 230, np.uint8), format="jpeg", visible=False)
        self.refresh()

    def _stopped(self, _: Any) -> None:
        self._viewer.say("Stopping after this frame ...")  # first: what the work says at its end stays
        self._viewer.jobs.stop()

    # long work

    def _simulate(self, _: Any) -> None:
        from fluidlift.pipeline.resimulate import resimulate

        viewer = self._viewer
        if viewer.refused() or not viewer.edited(viewer.draft.commit, moves=False):
            return

        def work(progress: JobProgress) -> str:
            made = resimulate(viewer.folder, progress=progress)
            said = f" Warnings: {'; '.join(w.rstrip('.') for w in made.warnings)}." if made.warnings else ""
            return f"simulated {made.frames} frames in {made.seconds:.0f} s.{said}"

        viewer.preview.stop()
        viewer.preview.hold(True)
        if not viewer.jobs.start("full simulation", work):
            viewer.preview.hold(False)
            viewer.say("Something else is being done already.")
            return
        viewer.set_source("saved frames")

    def _export(self, _: Any) -> None:
        from fluidlift.export.asset import export_asset
        from fluidlift.export.job import ExportRequest

        viewer, out = self._viewer, Path(os.path.expanduser(self._out.value.strip()))
        if viewer.refused() or not viewer.edited(viewer.draft.commit, moves=False):
            return
        if not self._out.value.strip():
            self._exported.content = "Export: no folder. Needed: a name for a new one."
            viewer.say(self._exported.content)
            return
        request = ExportRequest(to=self._format.value)

        def work(progress: JobProgress) -> str:
            # compared here, however long it takes: what the page knows may be of the scene before the last edit
            if "simulate" in viewer.draft.stale():
                raise InputRejected("the saved frames are older than this scene", do="press 'Simulate in full' first")
            return "; ".join(export_asset(viewer.folder, out, request, progress=progress).lines())

        if not viewer.jobs.start("export", work):
            viewer.say("Something else is being done already.")
            return
        self._exporting = True  # also where it has ended before the page looks

    def _draw(self, event: Any) -> None:
        viewer = self._viewer
        if event.client is None or viewer.refused() or not viewer.edited(viewer.draft.commit, moves=False):
            return
        if not viewer.saved.count:
            viewer.say("Pictures are drawn of saved frames, and there are none yet: simulate in full first.")
            return
        if viewer.source != "saved frames":
            viewer.set_source("saved frames")
        camera, number = _camera_of(event.client), FIRST_FRAME + viewer.timeline.frame

        def work(progress: JobProgress) -> str:
            self._picture.image = _drawn(viewer.folder, camera, number, progress)
            self._picture.visible = True
            return f"frame {number} drawn"

        viewer.preview.hold(True)
        if not viewer.jobs.start("picture", work):
            viewer.preview.hold(False)
            viewer.say("Something else is being done already.")

    # state

    def tick(self) -> None:
        """How far the work is."""
        state = self._viewer.jobs.state
        if self._stop.visible != state.running:
            self._stop.visible, self._bar.visible = state.running, state.running
            self._begin.disabled = state.running
        if state.running and abs(self._bar.value - state.share) >= 1:
            self._bar.value = round(state.share)
        if state.name == "export" and (state.running or self._exporting):
            self._exporting = state.running
            if self._exported.content != state.told:
                self._exported.content = state.told
        # a message above goes with the next edit, or with an event of one that comes late: how a run ended stays here
        ended = "" if state.name == "export" else state.outcome
        text = state.told if state.running else "\n\n".join(filter(None, (ended, self._frames_told())))
        if self._state.content != text:
            self._state.content = text

    def refresh(self) -> None:
        """Show what has been edited."""
        try:
            diff, edits = self._viewer.draft.diff().strip(), self._viewer.draft.history()
        except (FluidliftError, OSError) as error:
            diff, edits = str(error), []
        self._diff.content = f"```diff\n{diff[-4000:]}\n```" if diff else "Nothing differs from the fluid as lifted."
        self._edits.content = in_words(edits)
        self._viewer.compare()

    def _frames_told(self) -> str:
        stale = self._viewer.stale
        if stale is None:
            return "comparing the saved frames with the scene ..."
        return f"The saved frames are {'older than' if 'simulate' in stale else 'of'} this scene."


def in_words(edits: Sequence[tuple[str, bool]]) -> str:
    """The newest edits as Markdown, the last one first; those that are undone are struck through."""
    shown = [f"~~{_literal(what)}~~ (undone)" if undone else _literal(what) for what, undone in reversed(edits)]
    more = [f"and {len(shown) - SHOWN} before them"] * (len(shown) > SHOWN)
    return "\n".join(f"- {text}" for text in [*shown[:SHOWN], *more]) or "No edits."


def _literal(text: str) -> str:
    """A text, which may name what a stranger named, without what Markdown makes of it."""
    return re.sub(r"([\\`*_{}\[\]<>()#+!|~-])", r"\\\1", " ".join(text.split())[:200])


def _camera_of(client: Any) -> PinholeCamera:
    """The camera of a browser, with the shape of a drawn picture."""
    from fluidlift.types import matrix_from_quat

    view, (width, height) = client.camera, STILL
    focal = 0.5 * height / np.tan(0.5 * view.fov)
    rotation = matrix_from_quat(np.asarray(view.wxyz, float)[None])[0].T
    pose = RigidTransform(rotation, -rotation @ np.asarray(view.position, float))
    return PinholeCamera((focal, focal), (width / 2, height / 2), (width, height), pose)


def _drawn(folder: Path, camera: PinholeCamera, number: int, progress: JobProgress) -> np.ndarray:
    """u8 [h,w,3] of one frame of the asset, in its look."""
    import cv2

    from fluidlift.pipeline.render import RenderRequest, render_asset

    with tempfile.TemporaryDirectory(prefix="fluidlift-view-") as name:
        place = Path(name)
        (place / "camera.json").write_text(json.dumps(camera.to_dict()))
        request = RenderRequest(view=str(place / "camera.json"), frames=(number, number), background="terrain")
        render_asset(folder, place / "out", request, progress=progress)
        found = cv2.imread(str(place / "out" / f"{number}.png"), cv2.IMREAD_COLOR)
    if found is None:
        raise InputRejected(f"frame {number} could not be drawn")
    return np.ascontiguousarray(found[..., ::-1])
