"""What a scene that has just been changed means: which frames are older than it, and what its simulation will meet."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING

from fluidlift.errors import FluidliftError

if TYPE_CHECKING:
    from fluidlift.viewer.app import Viewer


class Comparison:
    """Found out in a thread of its own, after each edit: it takes a second or so."""

    def __init__(self, viewer: Viewer) -> None:
        self._viewer = viewer
        self._wanted, self._unwarned = threading.Event(), True
        self.stale: set[str] | None = None
        """what the saved frames no longer show of the scene; None: not known yet"""
        self.warnings: tuple[str, ...] = ()
        """what is odd about the scene, as `fluidlift edit` says it"""

    def start(self) -> None:
        """Begin to wait for edits."""
        threading.Thread(target=self._run, name="compare", daemon=True).start()

    def again(self) -> None:
        """The scene or the frames have changed."""
        self.stale, self._unwarned = None, True
        self._wanted.set()

    def _run(self) -> None:
        viewer = self._viewer
        while viewer.alive:
            if not self._wanted.wait(0.5):
                continue
            if self._unwarned:  # at once: of an edit that takes for ever the preview does too
                self._warn()
            if viewer.preview.busy or viewer.jobs.running:
                time.sleep(0.2)  # what somebody waits for goes first
                continue
            self._wanted.clear()
            try:
                found = viewer.draft.stale()
            except Exception as error:  # what cannot be compared counts as older than the scene
                viewer.surprised("comparing the frames with the scene", error)
                found = {"simulate", "look"}
            if not self._wanted.is_set():
                self.stale = found

    def _warn(self) -> None:
        self._unwarned = False
        try:
            self.warnings = tuple(self._viewer.draft.warnings())
        except (FluidliftError, OSError):
            self.warnings = ()  # a scene.yaml that does not fit is told where it is read
        except Exception as error:
            self.warnings = ()
            self._viewer.surprised("looking for warnings", error)
        self._viewer.redraw()
