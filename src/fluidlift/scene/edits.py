"""Edits of an asset: one model behind scene.yaml, the command line, Python and the viewer.

What is edited is scene.yaml alone. The fitted original (parameters.json, rest/) is never touched, so `reset` always
leads back to it. Each edit is checked before it is written; a wrong one changes nothing.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from fluidlift.errors import FluidliftError, InputRejected
from fluidlift.io.asset_folder import read_manifest, read_parameters, read_scene
from fluidlift.io.asset_lock import editing
from fluidlift.io.asset_paths import asset_file
from fluidlift.io.scene import SCENE_TEMPLATE, SECTIONS, SceneEdits, edits_of, plain_scene, read_edits, scene_text
from fluidlift.io.scene_look import Look
from fluidlift.io.scene_path import PLAIN, names_of
from fluidlift.io.scene_text import with_value, without
from fluidlift.messages import Notice
from fluidlift.scene import edit_history
from fluidlift.scene.changes import Add, Change, Remove, Set
from fluidlift.scene.edit_history import BY_HAND, EditRecord, History, text_hash, unified
from fluidlift.scene.forecast import outlook
from fluidlift.scene.known_state import recalled, remember
from fluidlift.scene.reshaping import HIGHEST
from fluidlift.scene.substances import SUBSTANCES
from fluidlift.types import Grid, kind_of

__all__ = ["Add", "Change", "EditSession", "Remove", "Set"]


class EditSession:
    """The scene of one asset, to be read and changed. Several sessions, threads and processes may have the same one.

    Args:
        folder: of the asset.
        meshes: folder of the mesh files that scene.yaml names; None: the asset.

    Raises:
        InputRejected: (all that change something) a change that does not fit, another edit at the same time, an asset
            that another process is writing, or a disk that is full; nothing was changed then.
    """

    def __init__(self, folder: Path | str, *, meshes: Path | None = None) -> None:
        self.folder, self.meshes = Path(folder), meshes
        read_manifest(self.folder)
        asset_file(self.folder, edit_history.HISTORY)  # a link on the way is refused

    @classmethod
    def open(cls, folder: Path | str, *, meshes: Path | None = None) -> EditSession:
        """The session of an asset; nothing is written before the first edit."""
        return cls(folder, meshes=meshes)

    @property
    def scene(self) -> dict[str, Any]:
        """scene.yaml as it is now."""
        return read_scene(self.folder)

    @property
    def density(self) -> float:
        """kg/m^3, as edited, else as fitted."""
        edited = (self.scene.get("parameters") or {}).get("density")
        return read_parameters(asset_file(self.folder, "parameters.json"))[0].density if edited is None else edited

    @property
    def edits(self) -> SceneEdits:
        """scene.yaml as it is now, checked."""
        return read_edits(self.folder, meshes=self.meshes)

    def set(self, path: str, value: Any) -> EditRecord | None:
        """Another value at a place such as "parameters.gravity" or "obstacles.duck.position"; None takes it away.

        Returns:
            The edit; None where nothing changed.
        """
        return self.apply([Set(path, value)])

    def add(self, section: str, entry: dict[str, Any]) -> str:
        """One more entry of obstacles, emitters or terrain; its place, such as "obstacles.sphere1"."""
        self.apply([Add(section, entry)])
        items = self.scene[section]
        return f"{section}.{len(items) if section == 'terrain' else names_of(items)[-1]}"

    def remove(self, path: str) -> EditRecord | None:
        """Take an entry away."""
        return self.apply([Remove(path)])

    def apply(self, changes: Sequence[Change], *, what: str = "") -> EditRecord | None:
        """Several changes as one edit, in their order.

        Args:
            changes: to do; all or none.
            what: the edit in words; "" says what the changes are.

        Returns:
            The edit; None where nothing changed.
        """

        def change(text: str, history: History) -> tuple[str, str, dict[str, int]]:
            new = text
            for one in changes:
                new = one.done(new)
            if new != text:
                self._check(text, new)
            return new, what or "; ".join(map(str, changes)), {}

        return self._change(change)

    def made_of(self, material: str) -> list[Change]:
        """The changes that make the liquid one of this material: its density, its viscosity and its look.

        Splats as lifted have no material: their style becomes "surface". "source" takes density, viscosity and
        material away again: the liquid as fitted, in the clip's own colours.

        Raises:
            InputRejected: a material that is not known, or an asset of smoke.
        """
        names = ("density", "kinematic_viscosity")
        if material == "source":
            return [Set("look.material", None), *(Set(f"parameters.{n}", None) for n in names)]
        if material not in SUBSTANCES:
            raise InputRejected(f"no material '{material}'", "one of source, " + ", ".join(SUBSTANCES))
        if kind_of(read_manifest(self.folder)["kind"]).is_gas:
            raise InputRejected(
                f"{material} for smoke", "a liquid", "look.tint and look.environment change smoke's look"
            )
        physics = [Set(f"parameters.{n}", getattr(SUBSTANCES[material], n)) for n in names]
        style = [] if self.edits.look.style != Look().style else [Set("look.style", "surface")]
        return [*physics, *style, Set("look.material", material)]

    def undo(self) -> EditRecord:
        """Take the last edit back.

        Raises:
            InputRejected: there is none.
        """

        def back(text: str, history: History) -> tuple[str, str, dict[str, int]]:
            if not history.undoable:
                changed = not _empty(text)
                do = "use reset (--reset) to take away what was there before the first edit" if changed else ""
                raise InputRejected("there is no edit to undo", "", do)
            edit = history[history.undoable[-1]]
            return edit.taken_from(text), f"undo: {edit.what}", {"undoes": edit.number}

        return self._changed(back)

    def redo(self) -> EditRecord:
        """Bring back what was undone last.

        Raises:
            InputRejected: nothing was undone since the last edit.
        """

        def again(text: str, history: History) -> tuple[str, str, dict[str, int]]:
            if not history.redoable:
                raise InputRejected("there is nothing to redo", "an edit that was undone")
            edit = history[history.redoable[-1]]
            return edit.done_to(text), f"redo: {edit.what}", {"redoes": edit.number}

        return self._changed(again)

    def reset(self) -> EditRecord | None:
        """Back to the fluid as lifted: scene.yaml without what changes it. It can be undone."""

        def original(text: str, history: History) -> tuple[str, str, dict[str, int]]:
            return _as_lifted(history.base), "reset", {}

        return self._change(original)

    def diff(self) -> str:
        """What differs from scene.yaml as lifted, in the manner of diff -u; empty where nothing does."""
        text, history = self._seen()
        return unified(_as_lifted(history.base), text)

    def history(self) -> tuple[EditRecord, ...]:
        """All edits, the oldest first; each says whether it is undone."""
        return self._seen()[1].changes()

    @property
    def can_undo(self) -> bool:
        """Whether there is an edit to undo."""
        return bool(self._seen()[1].undoable)

    @property
    def can_redo(self) -> bool:
        """Whether there is an edit to redo."""
        return bool(self._seen()[1].redoable)

    def stale(self) -> set[str]:
        """What the frames on disk no longer show of scene.yaml: of "simulate" and "look", or nothing."""
        from fluidlift.scene.stale_frames import stale_parts

        return stale_parts(self.folder, self.edits, meshes=self.meshes)

    def known_standing(self) -> set[str] | None:
        """`stale()` where it was found for this very scene before and nothing was odd; None: the scene has to be built
        for that."""
        return recalled(self.folder, scene_text(self.folder), meshes=self.meshes)

    def standing(self) -> tuple[set[str], list[Notice]]:
        """`stale()` and `warnings()`; from memory where both were found for this very scene and nothing was odd.

        A scene that cannot be simulated is stale, and a warning.
        """
        text = scene_text(self.folder)
        known = recalled(self.folder, text, meshes=self.meshes)
        if known is not None:
            return known, []
        warnings = self.warnings()
        try:
            stale = self.stale()
        except InputRejected as error:  # the edit is done, and can be undone
            refused = Notice("scene-refused", f"this scene cannot be simulated as it is: {error}")
            return {"simulate"}, [*warnings, refused]
        if not warnings:
            remember(self.folder, text, stale, meshes=self.meshes)
        return stale, warnings

    def note_shown(self) -> None:
        """Remember for `standing` that the frames on disk show this scene: they have just been simulated."""
        if not self.warnings():
            remember(self.folder, scene_text(self.folder), set(), meshes=self.meshes)

    def warnings(self) -> list[Notice]:
        """What is odd about the scene as it is: things mostly outside the domain or in the ground, edits that take very
        long to simulate, a look that is not drawn."""
        edits, manifest = self.edits, read_manifest(self.folder)
        idle = edits.look.warning()
        self._require_kind(edits)
        found = self._inside(edits) + outlook(self.folder, manifest, edits, _grid_of(manifest))
        return found + ([] if idle is None else [idle])

    # --- inside -----------------------------------------------------------------------------------------------------

    def _changed(self, change: Callable[[str, History], tuple[str, str, dict[str, int]]]) -> EditRecord:
        edit = self._change(change)
        assert edit is not None  # an edit in the history changes something, back and forth
        return edit

    def _change(self, change: Callable[[str, History], tuple[str, str, dict[str, int]]]) -> EditRecord | None:
        """Change scene.yaml and write the edit down, or neither."""
        with editing(self.folder):
            text, history = self._settled()
            new, what, links = change(text, history)
            if new == text:
                return None
            edit = EditRecord.of(len(history.edits) + 1, what, text, new, **links)
            edit_history.announce(self.folder, edit, new)
            try:
                edit_history.write_scene(self.folder, new)
                edit_history.append(self.folder, edit, base=history.base)
            except BaseException:  # a full disk, Ctrl-C: all as it was before
                with suppress(OSError, FluidliftError):
                    if scene_text(self.folder) != text:
                        edit_history.write_scene(self.folder, text)
                    edit_history.withdraw(self.folder)
                raise
            edit_history.withdraw(self.folder)
        return edit

    def _settled(self) -> tuple[str, History]:
        """scene.yaml and its history, with what a killed process left undone done, and edits by hand written down."""
        if asset_file(self.folder, edit_history.PENDING).exists():
            found = edit_history.announced(self.folder)
            if found is not None:
                self._finish(*found)
            edit_history.withdraw(self.folder)
        before = edit_history.read_history(self.folder)
        text, history = self._seen()
        known = 0 if before is None else len(before.edits)
        for edit in history.edits[known:]:
            edit_history.append(self.folder, edit, base=history.base)
        return text, history

    def _finish(self, edit: EditRecord, after: str) -> None:
        """Do the rest of an edit that a process was killed over."""
        history = edit_history.read_history(self.folder)
        if edit.number != (0 if history is None else len(history.edits)) + 1:
            return  # its line is there: only the announcement was left
        if history is not None and history.now != edit.old:
            return
        if text_hash(scene_text(self.folder)) == edit.old:
            edit_history.write_scene(self.folder, after)
        base = edit.taken_from(after) if history is None else history.base
        edit_history.append(self.folder, edit, base=base)

    def _seen(self) -> tuple[str, History]:
        """scene.yaml and its history, with what was changed by hand since as a last edit; nothing is written."""
        text, history = scene_text(self.folder), edit_history.read_history(self.folder)
        if history is None:
            history = History(text)  # as it was found, whatever a person or an earlier version wrote
        if text_hash(text) != history.now:
            edit = EditRecord.of(len(history.edits) + 1, BY_HAND, history.text(), text)
            history = history.with_edit(edit)
        return text, history

    def _check(self, old: str, new: str) -> None:
        """Raise `InputRejected` where the new text describes no scene."""
        try:
            self._require_fit(new)
        except InputRejected as error:
            self._require_old(old)
            # the line is one of a text that nobody has seen: the name says enough
            got = re.sub(r"^scene\.yaml(, line \d+)?: ", "", error.got)
            raise InputRejected(got, error.needed, error.do) from None

    def _require_old(self, old: str) -> None:
        try:
            edits_of(old, self.folder, meshes=self.meshes)
        except InputRejected as error:
            raise InputRejected(
                f"scene.yaml could not be read before the edit either: {error.got}", error.needed,
                error.do or "correct that line, or go back with undo or reset",
            ) from None  # fmt: skip

    def _require_fit(self, text: str) -> None:
        edits = edits_of(text, self.folder, meshes=self.meshes)
        self._require_kind(edits)
        self._inside(edits)

    def _require_kind(self, edits: SceneEdits) -> None:
        """Raise `InputRejected` for what this kind of fluid cannot do."""
        kind = kind_of(read_manifest(self.folder)["kind"])
        if edits.extend_downstream > 0 and not kind.is_channel_flow:
            raise InputRejected(f"a {kind} cannot be extended downstream", "a stream or a fall")
        if kind.is_gas and edits.obstacles:
            raise InputRejected(f"{edits.obstacles[0].line}: an obstacle in a {kind}", "obstacles in a liquid")

    def _inside(self, edits: SceneEdits) -> list[Notice]:
        """Warnings about what lies mostly outside the domain, which the terrain's edits may move elsewhere."""
        if edits.terrain or not (edits.obstacles or edits.emitters):
            return []
        from fluidlift.io.scene_domain import require_inside  # with bodies, and with what those need

        manifest = read_manifest(self.folder)
        grid, clip = _grid_of(manifest), manifest["frame_count"] * manifest["frame_interval"]
        above = HIGHEST * float((grid.high - grid.low).max())
        return require_inside(
            edits, grid, reach=edits.extend_downstream, above=above, seconds=edits.duration or clip
        )  # fmt: skip


def _grid_of(manifest: dict[str, Any]) -> Grid:
    data = manifest["grid"]
    return Grid(tuple(data["shape"]), data["spacing"], tuple(data["origin"]))


def _as_lifted(text: str) -> str:
    """A scene.yaml without what changes the fluid; its comments stay."""
    found = text
    try:
        for name in {} if _empty(text) else plain_scene(text):
            here = name in SECTIONS and name not in PLAIN
            found = with_value(found, (name,), None) if here else without(found, (name,))
    except InputRejected:
        return SCENE_TEMPLATE
    return found if _empty(found) else SCENE_TEMPLATE


def _empty(text: str) -> bool:
    """Whether a scene.yaml changes nothing."""
    try:
        return all(value in (None, {}, [], "") for value in plain_scene(text).values())
    except InputRejected:
        return False
