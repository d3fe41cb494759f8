"""Edits on their way: what a hand still moves, before it becomes one entry of the history."""

from __future__ import annotations

import copy
import threading
from collections.abc import Sequence
from typing import Any, Protocol

from fluidlift.messages import Notice
from fluidlift.types import FluidParameters

QUIET = 0.7
"""s without another move after which a change is taken into the history: a drag of a slider is one edit"""


class Session(Protocol):
    """What the viewer needs of `scene.edits.EditSession`; all that change something raise `InputRejected`."""

    @property
    def scene(self) -> dict[str, Any]:
        """What scene.yaml holds, as plain data; read from disk."""
        ...

    def apply(self, changes: Sequence[Any], *, what: str = "") -> Any:
        """Several changes as one edit; all or none."""
        ...

    def made_of(self, material: str) -> Sequence[Any]:
        """The changes that make a liquid of this material: its look, its density, its viscosity."""
        ...

    def undo(self) -> Any:
        """Take the last edit back."""
        ...

    def redo(self) -> Any:
        """Bring back what was undone last."""
        ...

    def reset(self) -> Any:
        """The scene as it was lifted."""
        ...

    def diff(self) -> str:
        """All edits, as a unified diff."""
        ...

    def history(self) -> Sequence[Any]:
        """All edits, the oldest first: each says what it did (`what`) and whether it is undone."""
        ...

    def stale(self) -> Any:
        """Which of simulate and look the frames on disk no longer match; this takes a second or so."""
        ...

    def warnings(self) -> list[Notice]:
        """What is odd about the scene as it is, and what its simulation will meet."""
        ...


class Draft:
    """A session and what is not in it yet. Safe to use from several threads.

    Args:
        session: of the asset.
        fitted: parameters of the asset before any edit.
    """

    def __init__(self, session: Session, fitted: FluidParameters) -> None:
        self._session, self._fitted = session, fitted
        self._base: dict[str, Any] | None = None
        self._pending: dict[str, tuple[Any, str]] = {}
        self._moved = 0.0
        self._lock = threading.RLock()
        self.last = ""
        """the last edit, in words"""

    @property
    def pending(self) -> bool:
        """Whether something is not in the history yet."""
        with self._lock:  # what is being written is pending until it is written
            return bool(self._pending)

    def forget(self) -> None:
        """scene.yaml may have been changed by somebody else: read it again."""
        self._base = None

    @property
    def scene(self) -> dict[str, Any]:
        """What scene.yaml would hold, with what is pending; a copy."""
        with self._lock:
            if self._base is None:
                self._base = dict(self._session.scene)
            scene = copy.deepcopy(self._base)
            for path, (value, _) in self._pending.items():
                _put(scene, path, copy.deepcopy(value))
            return scene

    @property
    def fitted(self) -> dict[str, Any]:
        """Parameters without any edit, by name, `inflow.factor` and `whitewater.amount`."""
        return self._fitted.to_dict() | {"inflow.factor": 1.0, "whitewater.amount": 0.0}

    @property
    def parameters(self) -> dict[str, Any]:
        """All parameters as they would be simulated, by name, `inflow.factor` and `whitewater.amount`."""
        scene, known = self.scene, self._fitted.to_dict()
        changed = scene.get("parameters") or {}
        inflow = {"inflow.factor": float((scene.get("inflow") or {}).get("factor", 1.0))}
        foam = {"whitewater.amount": float((scene.get("whitewater") or {}).get("amount", 0.0))}
        return known | {k: v for k, v in changed.items() if k in known} | inflow | foam

    @property
    def look(self) -> dict[str, Any]:
        """The section `look`, as far as it says anything."""
        return self.scene.get("look") or {}

    @property
    def obstacles(self) -> list[dict[str, Any]]:
        """As scene.yaml lists them, each with the name by which it is known."""
        return [o | {"name": _name(o, i)} for i, o in enumerate(self.scene.get("obstacles") or [])]

    def move(self, path: str, value: Any, told: str, now: float) -> None:
        """Change an entry for the time being.

        Args:
            path: such as `parameters.gravity`.
            value: plain data; None: as fitted.
            told: the edit in words.
            now: s, of a steady clock.
        """
        with self._lock:
            self._pending[path] = (value, told)
            self._moved, self.last = now, told

    def settle(self, now: float) -> bool:
        """Take what is pending into the history, once nobody has moved anything for a while; whether it was.

        Raises:
            InputRejected: as `commit`.
        """
        with self._lock:
            if not self._pending or now - self._moved < QUIET:
                return False
            self.commit()
            return True

    def commit(self) -> None:
        """Take what is pending into the history now, and so into scene.yaml.

        Raises:
            InputRejected: edits that do not fit; they are dropped.
        """
        from fluidlift.scene.edits import Set

        with self._lock:
            pending, self._pending = self._pending, {}
            if pending:
                told = dict.fromkeys(words for _, words in pending.values())
                self._do([Set(path, value) for path, (value, _) in pending.items()], "; ".join(told))

    def _do(self, changes: Sequence[Any], told: str) -> None:
        try:
            self._session.apply(changes, what=told)
        finally:
            self._base = None

    def apply(self, changes: Sequence[Any], told: str) -> None:
        """Changes of `scene.edits` as one edit.

        Raises:
            InputRejected: they do not fit; nothing was changed.
        """
        with self._lock:
            self.commit()
            self._do(changes, told)
            self.last = told

    def make_of(self, material: str) -> None:
        """The liquid of another material, as one edit.

        Raises:
            InputRejected: a material that is not known.
        """
        with self._lock:
            self.apply(self._session.made_of(material), f"material {material}")

    def undo(self) -> str:
        """Back by one edit, told in words; raises `InputRejected` where there is none."""
        return self._turn(self._session.undo, "undo")

    def redo(self) -> str:
        """The edit that was undone last; raises `InputRejected` where there is none."""
        return self._turn(self._session.redo, "redo")

    def reset(self) -> str:
        """The scene as it was lifted; one edit, which can be undone. Empty where it is that already."""
        return self._turn(self._session.reset, "reset")

    def _turn(self, act: Any, told: str) -> str:
        with self._lock:
            self.commit()
            try:
                done = act()
            finally:
                self._base = None
            self.last = told
            return "" if done is None else str(done.what)

    def diff(self) -> str:
        """All edits so far, as a unified diff."""
        with self._lock:
            return str(self._session.diff())

    def history(self) -> list[tuple[str, bool]]:
        """All edits, the oldest first: in words, and whether each is undone."""
        with self._lock:
            return [(str(edit.what), bool(edit.undone)) for edit in self._session.history()]

    def stale(self) -> set[str]:
        """Which of simulate and look the frames on disk no longer match."""
        return set(self._session.stale())

    def warnings(self) -> list[Notice]:
        """What is odd about the scene as it is in the history; raises `InputRejected` for a broken scene.yaml."""
        return list(self._session.warnings())


def _put(scene: dict[str, Any], path: str, value: Any) -> None:
    """Set an entry by its path, or take it away (None); entries of lists go by their name."""
    *way, last = path.split(".")
    at: Any = scene
    for key in way:
        if isinstance(at, list):
            at = next((e for i, e in enumerate(at) if _name(e, i) == key), {})
        else:
            if at.get(key) is None:
                at[key] = {}
            at = at[key]
    if not isinstance(at, dict):
        return
    if value is None:
        at.pop(last, None)
    else:
        at[last] = value


def _name(entry: dict[str, Any], index: int) -> str:
    return str(entry.get("name") or f"{entry.get('shape', 'mesh')}{index + 1}")
