"""The hints of one clip on disk, with what was undone: each change is there before the page shows it."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from fluidlift.errors import InputRejected
from fluidlift.io.atomic import disk_errors, write_json
from fluidlift.io.hints_file import hints_data, parse_hints, read_found, read_hints, require_same_clip, write_hints
from fluidlift.io.limits import read_json
from fluidlift.types.hints import ClipHints, ClipIdentity, Point

MOST_STEPS = 100
"""that can be undone"""
LISTS = ("regions", "clicks", "rims", "flow")
WHOLE = ("start", "duration", "kind", "fov", "pitch", "horizon", "ruler", "roi", "level")


class HintsHistory:
    """The hints file of a clip and its steps.

    Args:
        clip: file that the hints are of.
        file: hints file; made with the first change.
        steps: JSON file of what can be undone and done again.
        identity: of the clip.

    Raises:
        InputRejected: the hints file there cannot be read, or is of another clip.
    """

    def __init__(self, clip: Path, file: Path, steps: Path, identity: ClipIdentity) -> None:
        self.clip, self.file, self._steps, self._identity = clip, file, steps, identity
        self.found: dict[str, Any] = {}
        self.shift: Point = (0.0, 0.0)
        """px from the points of the file to where they lie on the picture that is shown"""
        self.shown_time: float | None = None
        """s: the frame that the picture which is shown is that of, where the camera moves"""
        self._written: bytes | None = None
        self._undone: list[dict[str, Any]] = []
        self._done: list[dict[str, Any]] = []
        self.hints = ClipHints(identity)
        self.refresh()
        if steps.exists():
            try:
                kept = read_json(steps, "list of steps")
                self._done = [d for d in kept["done"] if isinstance(d, dict)][-MOST_STEPS:]
                self._undone = [d for d in kept["undone"] if isinstance(d, dict)][-MOST_STEPS:]
            except (InputRejected, KeyError, TypeError):
                with suppress(OSError):  # only a convenience is lost
                    steps.unlink()

    @property
    def time(self) -> float | None:
        """s into the clip: the frame whose picture the points of the file lie in."""
        return self._identity.time

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the clip's picture, px."""
        return self._identity.size

    @property
    def shown(self) -> dict[str, Any]:
        """The hints as plain data, with their points on the picture that is shown."""
        return hints_data(self.hints.moved(self.shift))

    @property
    def can_undo(self) -> bool:
        """Whether there is a step to take back."""
        return bool(self._done)

    @property
    def can_redo(self) -> bool:
        """Whether one was taken back."""
        return bool(self._undone)

    def refresh(self) -> bool:
        """Take over what another program wrote to the file; whether it did."""
        now = self.file.read_bytes() if self.file.exists() else None
        if now is None or now == self._written:
            return False
        read = read_hints(self.file)
        require_same_clip(read, self.clip, self.file.name)
        self.hints, self.found, self._written = read.at(self._identity.size), read_found(self.file), now
        self._identity = replace(self._identity, time=None if read.clip is None else read.clip.time)
        self.hints = replace(self.hints, clip=self._identity)
        return True

    def change(self, what: dict[str, Any]) -> None:
        """One step, in the form of the file; points are those of the picture that is shown.

        `{"set": name, "to": value}` (null takes it back), `{"add": list, "item": data}`,
        `{"put": list, "at": number, "item": data}` or `{"remove": list, "at": number}`.

        Raises:
            InputRejected: no such step, or hints that do not hold.
        """
        self.refresh()
        before = hints_data(self.hints)
        if not self.hints.has_points:  # the first point says which picture they lie in
            self._identity, self.shift = replace(self._identity, time=self.shown_time), (0.0, 0.0)
        after = parse_hints(_changed(self.shown, what), self.file.name)
        self._save(after.moved((-self.shift[0], -self.shift[1])))
        self._done, self._undone = [*self._done, before][-MOST_STEPS:], []
        self._save_steps()

    def undo(self) -> None:
        """Take the last step back."""
        self._step(self._done, self._undone)

    def redo(self) -> None:
        """Do again what was taken back."""
        self._step(self._undone, self._done)

    def note_found(self, found: dict[str, Any]) -> None:
        """Write what was found beside the hints."""
        self.refresh()
        if found != self.found:
            self.found = found
            self._save(self.hints)

    @staticmethod
    def aside(file: Path) -> Path:
        """Move a hints file that cannot be used out of the way; its new name."""
        return file.rename(file.with_name(f"{file.name}.{time.strftime('%Y%m%d-%H%M%S')}.old"))

    def _step(self, source: list[dict[str, Any]], sink: list[dict[str, Any]]) -> None:
        self.refresh()
        if not source:
            return
        now = hints_data(self.hints)
        self._save(parse_hints(source[-1], self.file.name))
        source.pop()
        sink.append(now)
        self._save_steps()

    def _save(self, hints: ClipHints) -> None:
        hints = replace(hints, clip=self._identity)
        with disk_errors(self.file):
            write_hints(self.file, hints, self.found)
        # as the file has them: points are rounded there, and would do all work anew when they change with the next step
        self.hints = replace(parse_hints(hints_data(hints), self.file.name), clip=self._identity)
        self._written = self.file.read_bytes()

    def _save_steps(self) -> None:
        with disk_errors(self._steps):
            self._steps.parent.mkdir(parents=True, exist_ok=True)
            write_json(self._steps, {"done": self._done, "undone": self._undone})


def _changed(data: dict[str, Any], what: dict[str, Any]) -> dict[str, Any]:
    """Hints as data with one step done."""
    steps: dict[str, Callable[[], dict[str, Any]]] = {
        "set": lambda: _set(data, what["set"], what.get("to")),
        "add": lambda: data | {what["add"]: [*data.get(_list(what["add"]), []), what["item"]]},
        "put": lambda: _put(data, what["put"], what["at"], what["item"]),
        "remove": lambda: _put(data, what["remove"], what["at"], None),
    }
    for name, step in steps.items():
        if name in what:
            try:
                return step()
            except (KeyError, TypeError, IndexError):
                break
    raise InputRejected(f"the step {str(what)[:80]}", "a change of the hints", "load the page again")


def _set(data: dict[str, Any], name: str, value: Any) -> dict[str, Any]:
    if isinstance(name, list):  # several at once are one step
        for one, v in zip(name, value, strict=True):
            data = _set(data, one, v)
        return data
    if name not in WHOLE:
        raise KeyError(name)
    return {k: v for k, v in data.items() if k != name} | ({} if value is None else {name: value})


def _list(name: str) -> str:
    if name not in LISTS:
        raise KeyError(name)
    return name


def _put(data: dict[str, Any], name: str, at: int, item: Any) -> dict[str, Any]:
    items = list(data.get(_list(name), []))
    if not 0 <= int(at) < len(items):
        raise IndexError(at)
    items[int(at) : int(at) + 1] = [] if item is None else [item]
    return {k: v for k, v in data.items() if k != name} | ({name: items} if items else {})
