"""What an edit of a scene is made of: a value set, an entry added or taken away."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.io.entries import nearest
from fluidlift.io.scene import plain_scene
from fluidlift.io.scene_path import LISTS, free_name, place_of
from fluidlift.io.scene_text import one_line, with_item, with_value, without


@dataclass(frozen=True)
class Set:
    """A value at a place such as "parameters.gravity"; None takes it away, back to what was fitted."""

    path: str
    value: Any

    def done(self, text: str) -> str:
        """The text of scene.yaml with it."""
        scene, value = plain_scene(text), plain_value(self.value, self.path)
        if value is None:
            path = place_of(scene, self.path)
            try:
                place_of(scene, self.path, new=False)
            except InputRejected:
                return text
            return without(text, path)
        path = place_of(scene, self.path)
        if path[0] == "terrain" and len(path) > 2 and path[1] == len(scene.get("terrain") or []):
            return with_item(text, ("terrain",), {path[2]: value})
        return with_value(text, path, value)

    def __str__(self) -> str:
        return f"set {self.path} = {one_line(plain_value(self.value, self.path))}"


@dataclass(frozen=True)
class Add:
    """One more obstacle, emitter or edit of the terrain. It gets a name where it has none."""

    section: str
    entry: dict[str, Any]

    def done(self, text: str) -> str:
        """The text of scene.yaml with it."""
        if self.section not in LISTS:
            near = nearest(self.section, LISTS)
            do = near if near != "remove it" else "set it"
            raise InputRejected(f"nothing can be added to '{self.section}'", "one of " + ", ".join(LISTS), do)
        entry = plain_value(self.entry, self.section)
        if not isinstance(entry, dict):
            raise InputRejected(f"{self.section} of {entry!r}", "name: value entries", "such as {shape: sphere, ...}")
        items = plain_scene(text).get(self.section) or []
        if self.section != "terrain" and not entry.get("name") and isinstance(items, list):
            entry = {"name": free_name(items, entry)} | entry
        return with_item(text, (self.section,), entry)

    def __str__(self) -> str:
        return f"add to {self.section}: {one_line(plain_value(self.entry, self.section))}"


@dataclass(frozen=True)
class Remove:
    """An obstacle, an emitter, an edit of the terrain, or any other entry, by its place."""

    path: str

    def done(self, text: str) -> str:
        """The text of scene.yaml without it."""
        return without(text, place_of(plain_scene(text), self.path, new=False))

    def __str__(self) -> str:
        return f"remove {self.path}"


Change = Set | Add | Remove


def plain_value(value: Any, what: str) -> Any:
    """The same in YAML's own kinds.

    Raises:
        InputRejected: numbers that are not finite, or what YAML cannot hold.
    """
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, dict):
        return {str(k): plain_value(v, what) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain_value(v, what) for v in value]
    if isinstance(value, Path):
        return value.as_posix()
    if isinstance(value, float) and not np.isfinite(value):
        raise InputRejected(f"{what} = {value}", "finite numbers")
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise InputRejected(f"{what} = {type(value).__name__}", "numbers, texts, lists and dictionaries")
