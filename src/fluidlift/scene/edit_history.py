"""The history of an asset's scene.yaml: every edit as the lines it took away and put in, undone or not.

edits/history.jsonl holds one JSON object a line. The first one holds the text that all began with; each further one
is an edit, an undo or a redo, with its time, what it was in words, the first line it touched and the lines before and
after. Lines are only ever appended, so nothing that was once written can be lost.

An edit is written in three steps: edits/pending.json says what is about to happen, scene.yaml is replaced, the history
gets its line. A process that is killed in between leaves pending.json, and whoever comes next finishes the work.
"""

from __future__ import annotations

import difflib
import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from fluidlift.errors import InputRejected
from fluidlift.io.asset_paths import asset_file
from fluidlift.io.atomic import disk_errors, write_bytes, write_json
from fluidlift.io.limits import parse_json, read_json, require_size

HISTORY, PENDING = "edits/history.jsonl", "edits/pending.json"
"""inside the asset"""
BY_HAND = "by hand"

_MAX_BYTES = 256 * 2**20


@dataclass(frozen=True)
class EditRecord:
    """One change of scene.yaml."""

    number: int
    """from 1, in the order in which they happened; undo and redo count"""
    what: str
    """in words: "set parameters.gravity = [0, 0, -1]" """
    line: int
    """of scene.yaml, from 1, at which the change begins"""
    before: tuple[str, ...]
    """lines that it took away"""
    after: tuple[str, ...]
    """lines that it put in"""
    old: str
    """hash of the whole text before"""
    new: str
    """hash of the whole text after"""
    time: str = ""
    """UTC, ISO 8601"""
    undoes: int | None = None
    """number of the edit that this one takes back"""
    redoes: int | None = None
    """number of the edit that this one brings back"""
    undone: bool = field(default=False, compare=False)
    """it is taken back at the moment, or was left behind by an edit after an undo"""

    @classmethod
    def of(cls, number: int, what: str, before: str, after: str, **more: Any) -> EditRecord:
        """The edit between two texts."""
        a, b = before.split("\n"), after.split("\n")
        head = 0
        while head < min(len(a), len(b)) and a[head] == b[head]:
            head += 1
        tail = 0
        while tail < min(len(a), len(b)) - head and a[len(a) - 1 - tail] == b[len(b) - 1 - tail]:
            tail += 1
        now = datetime.now(UTC).isoformat(timespec="milliseconds")
        return cls(
            number, what, head + 1, tuple(a[head : len(a) - tail]), tuple(b[head : len(b) - tail]),
            text_hash(before), text_hash(after), now, **more,
        )  # fmt: skip

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> EditRecord:
        """As `to_dict` gave it; raises KeyError, TypeError, ValueError or OverflowError for other data."""
        lines = [tuple(str(x) for x in data[name]) for name in ("before", "after")]
        undoes, redoes = (None if data.get(name) is None else int(data[name]) for name in ("undoes", "redoes"))
        own = (int(data["number"]), str(data["what"]), int(data["line"]))
        return cls(*own, lines[0], lines[1], str(data["old"]), str(data["new"]), str(data["time"]), undoes, redoes)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, without those that say nothing."""
        found = {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items() if v is not None}
        del found["undone"]
        return found

    def done_to(self, text: str) -> str:
        """The text after the edit, from that before."""
        return _exchanged(text, self.line, self.before, self.after)

    def taken_from(self, text: str) -> str:
        """The text before the edit, from that after."""
        return _exchanged(text, self.line, self.after, self.before)

    def diff(self) -> str:
        """The lines before with '-', those after with '+', under the number of the line where they stand."""
        out = []
        matcher = difflib.SequenceMatcher(None, self.before, self.after, autojunk=False)
        for what, i, j, k, m in matcher.get_opcodes():
            if what != "equal":
                out += [f"@@ line {self.line + k} @@", *(f"-{x}" for x in self.before[i:j])]
                out += [f"+{x}" for x in self.after[k:m]]
        return "".join(f"{x.rstrip(chr(13))}\n" for x in out)


def _exchanged(text: str, line: int, old: Sequence[str], new: Sequence[str]) -> str:
    lines = text.split("\n")
    if tuple(lines[line - 1 : line - 1 + len(old)]) != tuple(old):
        raise _does_not_fit()
    return "\n".join([*lines[: line - 1], *new, *lines[line - 1 + len(old) :]])


def _does_not_fit() -> InputRejected:
    return InputRejected(
        "the history of edits does not fit scene.yaml", "a whole history",
        "remove the folder edits/ of the asset: scene.yaml stays as it is, and a new history begins",
    )  # fmt: skip


def text_hash(text: str) -> str:
    """SHA-256 of a scene.yaml."""
    return hashlib.sha256(text.encode()).hexdigest()


def unified(before: str, after: str) -> str:
    """The difference of two scene.yaml, as diff -u writes it; empty where there is none."""
    a, b = before.splitlines(), after.splitlines()
    lines = difflib.unified_diff(a, b, "scene.yaml as lifted", "scene.yaml", n=1, lineterm="")
    return "".join(line + "\n" for line in lines)


@dataclass(frozen=True)
class History:
    """All edits so far, and what can be undone and redone."""

    base: str
    """the text that all began with"""
    edits: tuple[EditRecord, ...] = ()
    undoable: tuple[int, ...] = ()
    """numbers of edits, the last one to be undone first"""
    redoable: tuple[int, ...] = ()

    @property
    def now(self) -> str:
        """Hash of the text after the last edit."""
        return self.edits[-1].new if self.edits else text_hash(self.base)

    def with_edit(self, edit: EditRecord) -> History:
        """With one more, which must have the next number and begin where the last one ended."""
        if edit.number != len(self.edits) + 1 or edit.old != self.now:
            raise _does_not_fit()
        undo, redo = _stacks(list(self.undoable), list(self.redoable), edit)
        return History(self.base, (*self.edits, edit), tuple(undo), tuple(redo))

    def __getitem__(self, number: int) -> EditRecord:
        return self.edits[number - 1]

    def text(self) -> str:
        """What scene.yaml was after the last edit, from the base on."""
        text = self.base
        for edit in self.edits:
            text = edit.done_to(text)
        return text

    def changes(self) -> tuple[EditRecord, ...]:
        """The edits without undo and redo themselves, each saying whether it is undone."""
        own = [e for e in self.edits if e.undoes is None and e.redoes is None]
        return tuple(replace(e, undone=e.number not in self.undoable) for e in own)


def _stacks(undo: list[int], redo: list[int], edit: EditRecord) -> tuple[list[int], list[int]]:
    """What can be undone and redone after one more edit; an edit after an undo leaves what was undone behind."""
    if edit.undoes is None and edit.redoes is None:
        return [*undo, edit.number], []
    taken, given, number = (redo, undo, edit.redoes) if edit.undoes is None else (undo, redo, edit.undoes)
    if taken[-1:] != [number]:
        raise _does_not_fit()
    given.append(taken.pop())
    return undo, redo


def read_history(folder: Path) -> History | None:
    """The history of an asset; None where nothing was edited yet. A last line that breaks off is left out.

    Raises:
        InputRejected: a damaged history, or one that is a link.
    """
    path = asset_file(folder, HISTORY)
    if not path.is_file():
        return None
    require_size(path, _MAX_BYTES, "history of edits")
    lines = path.read_bytes().split(b"\n")[:-1]  # a whole line ends with a line break
    if not lines:
        return None
    try:
        base = parse_json(lines[0])["text"]
        edits = [EditRecord.from_dict(parse_json(line)) for line in lines[1:]]
        if not isinstance(base, str):
            raise TypeError("no text")
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise InputRejected(
            f"'{HISTORY}' cannot be read ({error})", "a whole history",
            "remove the folder edits/ of the asset: scene.yaml stays as it is, and a new history begins",
        ) from None  # fmt: skip
    now = text_hash(base)
    undo: list[int] = []
    redo: list[int] = []
    for number, edit in enumerate(edits, start=1):
        if edit.number != number or edit.old != now:
            raise _does_not_fit()
        undo, redo = _stacks(undo, redo, edit)
        now = edit.new
    return History(base, tuple(edits), tuple(undo), tuple(redo))


def append(folder: Path, edit: EditRecord, *, base: str) -> None:
    """Write one more line; the first one begins the file with `base`."""
    path = asset_file(folder, HISTORY)
    with disk_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        lines = _line(edit.to_dict())
        with path.open("a+b") as file:
            size = _whole_length(file)
            file.truncate(size)  # what a killed process had begun to write
            if size == 0:
                first = {"time": edit.time, "what": "scene.yaml as found", "text": base}
                lines = _line(first) + lines
            file.write(lines)
            file.flush()
            os.fsync(file.fileno())


def _whole_length(file: Any) -> int:
    """Bytes up to the end of the last whole line."""
    end = file.seek(0, os.SEEK_END)
    while end:
        start = max(0, end - 65536)
        file.seek(start)
        found = file.read(end - start).rfind(b"\n")
        if found >= 0:
            return start + found + 1
        end = start
    return 0


def _line(data: dict[str, Any]) -> bytes:
    return (json.dumps(data, ensure_ascii=False) + "\n").encode()


def announce(folder: Path, edit: EditRecord, text: str) -> None:
    """Say what is about to happen: the edit, and scene.yaml after it."""
    write_json(asset_file(folder, PENDING), {"edit": edit.to_dict(), "text": text}, lasting=True)


def withdraw(folder: Path) -> None:
    """What was announced is done, or will not be."""
    asset_file(folder, PENDING).unlink(missing_ok=True)


def announced(folder: Path) -> tuple[EditRecord, str] | None:
    """An edit that a process was killed over, and scene.yaml after it; None: there is none."""
    path = asset_file(folder, PENDING)
    if not path.is_file():
        return None
    try:
        data = read_json(path, "announced edit", _MAX_BYTES)
        edit, text = EditRecord.from_dict(data["edit"]), data["text"]
    except (InputRejected, KeyError, TypeError, ValueError, OverflowError):
        return None
    return (edit, text) if isinstance(text, str) and text_hash(text) == edit.new else None


def write_scene(folder: Path, text: str) -> None:
    """Replace scene.yaml, all of it or nothing."""
    path = asset_file(folder, "scene.yaml")
    with disk_errors(path):
        write_bytes(path, text.encode(), lasting=True)
