"""What a person wrote into a YAML file, taken entry by entry; a complaint names the line and the nearest valid name."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import Any

import yaml

from fluidlift.errors import InputRejected
from fluidlift.io.yaml_reader import composed
from fluidlift.types.quantity import DEGREES, METRES, OF_UNIT, quantity

Path = tuple[Any, ...]
"""keys and indices from the top of the file"""

TERRAIN_EDITS = ("move", "rotate", "scale", "twist", "mesh")
"""what an entry of the section `terrain` may do"""


def line_numbers(text: str) -> dict[Path, int]:
    """The line (from 1) on which each entry stands, by its path. Empty where the text is no valid YAML."""
    lines: dict[Path, int] = {}

    def walk(node: yaml.Node | None, path: Path) -> None:
        if node is None:
            return
        lines.setdefault(path, node.start_mark.line + 1)
        if isinstance(node, yaml.MappingNode):
            for key, value in node.value:
                if not isinstance(key, yaml.ScalarNode):
                    continue
                name = (*path, key.value)
                lines[name] = key.start_mark.line + 1
                walk(value, name)
        elif isinstance(node, yaml.SequenceNode):
            for i, value in enumerate(node.value):
                walk(value, (*path, i))

    try:
        walk(composed(text), ())
    except yaml.YAMLError:
        return {}
    return lines


def nearest(name: Any, known: Iterable[str]) -> str:
    """What to do about a wrong name: the valid one most like it, if any is."""
    close = difflib.get_close_matches(str(name), list(known), n=1, cutoff=0.5)
    return f"write '{close[0]}'" if close else "remove it"


def in_unit(value: Any, unit: str) -> str:
    """What to write instead of a quantity with a unit of its own, or a list of such; empty where it is none."""
    units = {"m": METRES, "degrees": DEGREES}.get(unit) or OF_UNIT.get(unit, {})
    try:
        if isinstance(value, list) and any(isinstance(v, str) for v in value):
            numbers = (quantity(v, units) if isinstance(v, str) else float(v) for v in value[:3])
            return f"write [{', '.join(f'{v:g}' for v in numbers)}]"
        return f"write {quantity(value, units):g}" if isinstance(value, str) else ""
    except (TypeError, ValueError, OverflowError):
        return ""


class Entries:
    """One mapping of a file.

    Args:
        data: the mapping.
        what: what it describes, in words: "an obstacle".
        file: name of the file.
        path: where it stands in the file.
        lines: of `line_numbers`.

    Raises:
        InputRejected: (all methods) an entry that is missing, unknown or of the wrong kind or range.
    """

    def __init__(self, data: Any, what: str, *, file: str, path: Path = (), lines: Mapping[Path, int]) -> None:
        self.what, self.file, self.path, self.lines = what, file, path, lines
        self.data: dict[str, Any] = {}
        if not isinstance(data, dict):
            raise self.wrong(None, f"{what} is {data!r}", "name: value entries")
        self.data = data

    def wrong(self, name: str | None, got: str, needed: str = "", do: str = "") -> InputRejected:
        """The complaint about an entry."""
        path = self.path if name is None else (*self.path, name)
        line = self.lines.get(path, self.lines.get(self.path))
        place = self.file if line is None else f"{self.file}, line {line}"
        return InputRejected(f"{place}: {got}", needed, do)

    def only(self, known: Iterable[str], hints: Mapping[Any, str] | None = None) -> None:
        """No other entries than these; `hints` says what to do about some others."""
        known = sorted(known)
        for name in self.data:
            if name not in known:
                do = (hints or {}).get(name) or nearest(name, known)
                raise self.wrong(name, f"unknown entry '{name}' of {self.what}", "one of " + ", ".join(known), do)

    def given(self, name: str) -> bool:
        """Whether an entry is there and not empty."""
        return self.data.get(name) is not None

    def number(self, name: str, default: float | None, *, low: float, high: float, unit: str) -> float:
        """A finite number in low..high."""
        value = self.data.get(name)
        if value is None and default is not None:
            return default
        needed = f"a number from {low:g} to {high:g} {unit}".strip()
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.wrong(name, f"{name} of {self.what} is {value!r}", needed, in_unit(value, unit))
        if not low <= value <= high:  # a nan fails the comparison
            raise self.wrong(name, f"{name} of {self.what} is {str(value)[:20]}", needed)
        return float(value)

    def vector(
        self, name: str, default: tuple[float, ...] | None, *, limit: float, unit: str, low: float | None = None,
        example: str = "[0, 0, 1]",
    ) -> tuple:  # fmt: skip
        """Three finite numbers of at most `limit` in size; not below `low` where that is given."""
        value, least = self.data.get(name), -limit if low is None else low
        if value is None and default is not None:
            return default

        def good(v: object) -> bool:  # a nan fails the comparison
            return isinstance(v, int | float) and not isinstance(v, bool) and least <= v <= limit

        if not isinstance(value, list) or len(value) != 3 or not all(map(good, value)):
            needed = f"3 numbers from {least:g} to {limit:g} {unit}".strip() + f", such as {example}"
            raise self.wrong(name, f"{name} of {self.what} is {value!r}", needed, in_unit(value, unit))
        return tuple(float(v) for v in value)

    def flag(self, name: str, default: bool) -> bool:
        """true or false."""
        value = self.data.get(name)
        if value is None:
            return default
        if not isinstance(value, bool):
            raise self.wrong(name, f"{name} of {self.what} is {value!r}", "true or false")
        return value

    @property
    def place(self) -> str:
        """Where it stands, for later complaints: file and line."""
        line = self.lines.get(self.path)
        return self.file if line is None else f"{self.file}, line {line}"

    def word(self, name: str, default: str | None, options: Iterable[str]) -> str:
        """One of some words."""
        value, options = self.data.get(name), list(options)
        if value is None and default is not None:
            return default
        if value not in options:
            do = nearest(value, options) if isinstance(value, str) else ""
            raise self.wrong(
                name, f"{name} of {self.what} is {value!r}", "one of " + ", ".join(options), do.replace("remove it", "")
            )
        return value

    def text(self, name: str) -> str:
        """A text that is not empty."""
        value = self.data.get(name)
        if not isinstance(value, str) or not value.strip():
            raise self.wrong(name, f"{name} of {self.what} is {value!r}", "a text")
        return value

    def part(self, name: str, what: str) -> Entries:
        """The mapping under a name; empty where there is none."""
        path = (*self.path, name)
        return Entries(self.data.get(name) or {}, what, file=self.file, path=path, lines=self.lines)

    def parts(self, name: str, what: str, *, most: int) -> list[Entries]:
        """The mappings of a list under a name; none where there is no such entry."""
        value = self.data.get(name) or []
        if not isinstance(value, list):
            raise self.wrong(name, f"{name} is {value!r}", f"a list: one '- ' line for {what}")
        if len(value) > most:
            raise self.wrong(name, f"{name} has {len(value)} entries", f"at most {most}")
        return [
            Entries(v, what, file=self.file, path=(*self.path, name, i), lines=self.lines) for i, v in enumerate(value)
        ]
