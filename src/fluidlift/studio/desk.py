"""What lies on the desk, the same for all windows: a folder, an open clip, its hints, what was found, what is made."""

from __future__ import annotations

import contextlib
import importlib
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fluidlift.config import PRESETS
from fluidlift.errors import FluidliftError, InputRejected
from fluidlift.io.hints_file import hints_beside
from fluidlift.pipeline.models import NO_MODELS, ModelWish
from fluidlift.studio.clips import Strip, clip_at, clips_in, jpeg
from fluidlift.studio.history import HintsHistory
from fluidlift.studio.looking import FindRequest, Looking, wished_at
from fluidlift.studio.making import MakeJob, Making
from fluidlift.studio.shelf import SUFFIX, Shelf
from fluidlift.types import Label

ROOM = ".fluidlift-studio"
"""folder of what is kept between two visits: looks, steps, trash. All of it but the trash can be made again"""
COLORS = {Label.FLUID: (255, 150, 0, 105), Label.SOLID: (0, 140, 255, 120)}
"""blue, green, red, alpha of the labels' picture"""
LOADED = "fluidlift.pipeline.find"
VIEW_SECONDS = 60.0
"""that the viewer may take to tell its address"""


class Desk:
    """All that the page shows and does.

    Args:
        folder: of clips and assets.
        learned: models that looks and makes take.
    """

    def __init__(self, folder: Path, learned: ModelWish = NO_MODELS) -> None:
        self.folder, self.room, self.learned = folder, folder / ROOM, learned
        self.version = 0
        """changes with what is shown"""
        self.lock = threading.RLock()
        self.clip: Path | None = None
        self.info: dict[str, Any] | None = None
        self.history: HintsHistory | None = None
        self.strip: Strip | None = None
        self.error = ""
        """of the clip that is open; it stays until another one is opened"""
        self.broken: Path | None = None
        """hints file of that clip that cannot be used"""
        self.times: dict[str, float] = {}
        """s: of opening the clip to its first picture and to the end of its look; of the last correction"""
        self._opened = 0.0
        self._first_look = True
        self.looking = Looking(self.changed, self._found)
        self.making = Making(self._make_changed)
        self.shelf = Shelf(folder, self.room)
        self._shown: list[dict[str, Any]] = self.shelf.entries()
        self._views: dict[str, tuple[subprocess.Popen[str], str]] = {}
        # what the first look needs is loaded while a person still chooses a clip
        threading.Thread(target=lambda: importlib.import_module(LOADED), name="loading", daemon=True).start()

    def changed(self) -> None:
        """There is something new to show."""
        with self.lock:
            self.version += 1
            if self.strip is not None and self.strip.first and "first_picture" not in self.times:
                self.times["first_picture"] = time.monotonic() - self._opened

    def close(self) -> None:
        """End all that was begun."""
        self.looking.close()
        self.making.close()
        for process, _ in self._views.values():
            process.terminate()

    def state(self) -> dict[str, Any]:
        """Plain data of all that the page shows."""
        with self.lock:
            look, history = self.looking.look, self.history
            read, seen = look.read, look.segmentation
            ours = look.clip == self.clip
            self._lay_hints()
            return {
                "version": self.version,
                "folder": str(self.folder),
                "presets": list(PRESETS),
                "clips": clips_in(self.folder),
                "clip": self.info,
                "error": self.error,
                "broken": None if self.broken is None else self.broken.name,
                "hints": None if history is None else history.shown,
                "hints_file": None if history is None else history.file.name,
                "undo": history is not None and history.can_undo,
                "redo": history is not None and history.can_redo,
                "strip": {
                    "first": bool(self.strip and self.strip.first),
                    "count": 0 if self.strip is None else len(self.strip.pictures),
                },
                "look": None if self.clip is None or not ours else {
                    "words": look.words, "share": look.share, "error": look.error, "warnings": look.warnings,
                    "pictures": look.pictures if read is not None else 0,
                    "masks": look.masks if seen is not None else 0,
                    "times": [] if read is None else [round(float(t), 4) for t in read.clip.times],
                    "read_warnings": [] if read is None else list(read.warnings),
                    "facts": look.facts, "so_far": look.so_far, "waited": round(look.waited, 2),
                },
                "make": self.making.state.to_dict(),
                "shelf": self._shown,
                "trash": self.shelf.trashed(),
                "times": {k: round(v, 2) for k, v in self.times.items()},
            }  # fmt: skip

    def open(self, name: str) -> None:
        """Open a clip of the folder.

        Raises:
            InputRejected: there is none of that name.
        """
        clip = clip_at(self.folder, name)
        with self.lock:
            if self.strip is not None:
                self.strip.closed = True
            self.clip, self.info, self.history, self.strip = clip, {"name": name}, None, None
            self.error, self.broken, self.times = "", None, {}
            self._opened, self._first_look = time.monotonic(), True
            self.looking.ask(None)
            try:
                self._look_into(clip)
            except FluidliftError as error:
                self.error = str(error)
        self.changed()

    def _look_into(self, clip: Path) -> None:
        from fluidlift.io.video import probe
        from fluidlift.pipeline.find import identity_of

        info = probe(clip)
        self.info = info.to_dict() | {"name": clip.name, "asset": clip.stem + SUFFIX}
        self.strip = Strip(clip, info, self.changed)
        try:
            file, steps = hints_beside(clip), self.room / clip.name / "steps.json"
            self.history = HintsHistory(clip, file, steps, identity_of(clip))
        except InputRejected:
            self.broken = hints_beside(clip)
            raise
        self._ask()

    def _ask(self) -> None:
        assert self.clip is not None and self.history is not None
        room = self.room / self.clip.name / "look"
        self.looking.ask(wished_at(FindRequest(self.clip, self.history.hints, room, learned=self.learned)))

    def _found(self, wish: FindRequest, facts: dict[str, Any]) -> None:
        with self.lock:
            if self.clip == wish.clip and self.history is not None:
                took = time.monotonic() - wish.asked
                self.times["findings" if self._first_look else "correction"] = took
                self._first_look = False
                with contextlib.suppress(FluidliftError):
                    self.history.note_found(facts)
        self.changed()

    def change(self, act: Callable[[HintsHistory], None]) -> None:
        """Change the hints, and look again.

        Raises:
            InputRejected: hints that do not hold, or no clip is open.
        """
        with self.lock:
            if self.history is None:
                raise InputRejected("no clip is open", "a clip", "choose one first")
            self._lay_hints()
            act(self.history)
            self._ask()
        self.changed()

    def _lay_hints(self) -> None:
        """Where the points of the hints lie on the picture that is shown: another trim may be laid on another frame."""
        from fluidlift.pipeline.hints import picture_shift, time_laid_on

        history, read = self.history, self.looking.look.read
        if history is None or read is None or self.looking.look.clip != self.clip:
            return
        history.shown_time = time_laid_on(read)
        shift, k = picture_shift(read, history.time) or (0.0, 0.0), history.size[0] / read.clip.size[0]
        history.shift = (round(k * shift[0], 1), round(k * shift[1], 1))  # tenths, as the file has them

    def fresh_hints(self) -> None:
        """Move a hints file that cannot be used aside, and begin anew."""
        with self.lock:
            if self.broken is not None and self.clip is not None:
                HintsHistory.aside(self.broken)
                self.open(self.clip.name)

    def frame(self, number: int) -> bytes:
        """JPEG of a frame as it is worked on.

        Raises:
            InputRejected: there is none.
        """
        read = self.looking.look.read
        if read is None or not 0 <= number < len(read.clip):
            raise InputRejected(f"no frame {number}")
        return jpeg(np.asarray(read.clip.frames[number]))

    def mask(self, number: int) -> bytes:
        """PNG with the fluid and the rocks of a frame, transparent elsewhere.

        Raises:
            InputRejected: there is none.
        """
        seen = self.looking.look.segmentation
        if seen is None or not 0 <= number < len(seen.labels.labels):
            raise InputRejected(f"no mask {number}")
        labels = np.asarray(seen.labels.labels[number])
        picture = np.zeros((*labels.shape, 4), np.uint8)
        for label, color in COLORS.items():
            picture[labels == label] = color
        outline = cv2.findContours((labels == Label.FLUID).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
        cv2.drawContours(picture, outline, -1, (255, 255, 255, 255), 1)
        return cv2.imencode(".png", picture)[1].tobytes()

    def stage_picture(self, name: str) -> bytes:
        """JPEG of what a stage of the make has left.

        Raises:
            InputRejected: there is none.
        """
        file = self.room / "making" / f"{name}.jpg"
        if name not in {s["name"] for s in self.making.state.finished} or not file.is_file():
            raise InputRejected(f"no picture of '{name[:40]}'")
        return file.read_bytes()

    def make(self, preset: str) -> None:
        """Make an asset of the clip with its hints.

        Raises:
            InputRejected: no clip, or one is being made.
        """
        if preset not in PRESETS:
            raise InputRejected(f"the preset '{preset[:20]}'", ", ".join(PRESETS))
        with self.lock:
            if self.clip is None or self.history is None:
                raise InputRejected("no clip is open", "a clip", "choose one first")
            file = self.history.file if self.history.file.exists() else None
            asset = self.folder / (self.clip.stem + SUFFIX)
            job = MakeJob(self.clip, file, asset, preset, self.room / "making", self.learned)
            if not self.making.start(job):
                raise InputRejected("an asset is being made", "one at a time", "wait for it, or stop it")

    def _make_changed(self) -> None:
        if not self.making.state.running:
            self._shown = self.shelf.entries()
        self.changed()

    def on_shelf(self, act: Callable[[Shelf], Any]) -> Any:
        """Do something to the shelf.

        Raises:
            InputRejected: as what is done.
        """
        with self.lock:
            if self.making.state.running:
                raise InputRejected("an asset is being made", "a shelf at rest", "wait for it, or stop it")
            done = act(self.shelf)
            self._shown = self.shelf.entries()
        self.changed()
        return done

    def export(self, name: str) -> str:
        """Write a page of an asset that plays offline, beside it; the name of the file.

        Raises:
            InputRejected: no such asset.
            FluidliftError: it could not be exported.
        """
        from fluidlift.export import ExportRequest, export_asset

        path = self.shelf.path(name)
        out = path.with_suffix(".html")
        export_asset(path, out, ExportRequest("html"))
        return out.name

    def view(self, name: str) -> str:
        """The address of a viewer of an asset, which is started where there is none yet.

        Raises:
            InputRejected: no such asset.
            FluidliftError: the viewer did not start.
        """
        path = self.shelf.path(name)
        known = self._views.get(name)
        if known is not None and known[0].poll() is None:
            return known[1]
        command = [sys.executable, "-m", "fluidlift", "view", str(path)]
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            env=os.environ | {"PYTHONUNBUFFERED": "1"},
        )  # fmt: skip
        address, said = _address_told(process)
        if not address:
            process.kill()
            raise FluidliftError(f"the viewer did not start: {said[:300] or 'it said nothing'}")
        self._views[name] = process, address
        return address


def _address_told(process: subprocess.Popen[str]) -> tuple[str, str]:
    """The address that a viewer prints, and all that it said until then."""
    said: list[str] = []
    found: list[str] = []
    ready = threading.Event()

    def listen() -> None:
        assert process.stdout is not None
        for line in process.stdout:
            said.append(line.strip())
            match = re.search(r"http://\S+", line)
            if match and not found:
                found.append(match[0].rstrip(".,"))
                ready.set()
        ready.set()

    threading.Thread(target=listen, name="viewer", daemon=True).start()
    ready.wait(VIEW_SECONDS)
    return (found[0] if found else ""), " ".join(said)
