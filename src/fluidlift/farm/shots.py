"""Lists of shots: clips, folders of videos, or YAML with options of `make` for each."""

from __future__ import annotations

import difflib
import hashlib
import json
import os
import re
import reprlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fluidlift.errors import InputRejected
from fluidlift.io.hashes import digest

VIDEOS = frozenset({".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".mpg", ".mpeg", ".mxf", ".gif"})
LISTS = (".yaml", ".yml")
NOTES = ("licence", "source")
"""keys of a row that say where its clip is from"""
LONGEST_NAME = 240
"""bytes of a shot's name: file systems take 255, and files beside the asset add up to eleven (`.state.json`)"""
_SHARD = re.compile(r"([1-9][0-9]{0,6})/([1-9][0-9]{0,6})", re.ASCII)


@dataclass(frozen=True)
class Shot:
    """One clip, the name of its asset, and the options of make that it has of its own."""

    clip: Path
    name: str
    options: dict[str, Any]
    licence: str = ""
    """of the clip, for people and for the index of a data set; making does not depend on it"""
    source: str = ""
    """where the clip is from, likewise"""

    def arguments(self, folder: Path) -> list[str]:
        """Of the command line that makes it, below `folder`."""
        told = ["make", str(self.clip), "--out", str(folder / f"{self.name}.fluid"), "--json"]
        for key, value in self.options.items():
            values = value if isinstance(value, list | tuple) else [value]
            told += [f"--{key.replace('_', '-')}={v}" for v in values]
        return told

    def fingerprint(self) -> str:
        """SHA-256 of its options and of the content of the clip and of the files that they name.

        Of folders and patterns of pictures names, sizes and times of change stand for the content.
        """
        files = [self.clip, *(v for v in self.options.values() if isinstance(v, Path))]
        told = [sorted((k, str(v)) for k, v in self.options.items()), [_content(f) for f in files]]
        return hashlib.sha256(json.dumps(told).encode()).hexdigest()


def _content(path: Path) -> Any:
    if path.is_file():
        return digest(path)
    folder = path if path.is_dir() else path.parent
    if not folder.is_dir():
        return str(path)
    stats = ((e.name, e.stat()) for e in sorted(os.scandir(folder), key=lambda e: e.name) if e.is_file())
    return [str(path), [(name, s.st_size, s.st_mtime_ns) for name, s in stats]]


@dataclass(frozen=True)
class ShotOptions:
    """What a row of a list may hold."""

    types: Mapping[str, str]
    """options of make by name, with their types as they are written; without those that a batch gives itself"""

    @property
    def known(self) -> list[str]:
        """All keys of a row."""
        return ["clip", "name", *NOTES, *self.types]


def read_shots(
    paths: Sequence[Path], options: ShotOptions, *, base: Mapping[str, Any], settings: Sequence[str]
) -> list[Shot]:
    """All that is named, in its order.

    Args:
        paths: clips, folders of videos, lists (.yaml).
        options: what rows of a list may hold.
        base: options of all shots that have none of their own.
        settings: `section.name=value` of all shots, before their own.

    Raises:
        InputRejected: a list that cannot be used, two shots of one name, no clips.
    """
    shots: list[Shot] = []
    for path in paths:
        rows: list[dict[str, Any]]
        if path.suffix.lower() in LISTS:
            rows = _listed(path, options)
        elif path.is_dir() and (videos := _videos(path)):
            rows = [{"clip": v} for v in videos]
        else:
            rows = [{"clip": path.absolute()}]
        for row in rows:
            clip = row.pop("clip")
            name = str(row.pop("name", clip.stem or "clip"))
            notes = {key: str(row.pop(key, "")) for key in NOTES}
            row["set"] = [*settings, *row.get("set", ())]
            shots.append(Shot(clip, name, dict(base) | row, **notes))
    _require_names(shots)
    return shots


def shard_of(shots: Sequence[Shot], text: str | None) -> list[Shot]:
    """Every n-th shot from the i-th on, of a text "i/n"; all of them where it is None.

    Raises:
        InputRejected: no such text.
    """
    if text is None:
        return list(shots)
    found = _SHARD.fullmatch(text)
    if found is None or not int(found[1]) <= int(found[2]):
        raise InputRejected(f"--shard {text[:40]}", "i/n with i from 1 to n, such as 3/40")
    return list(shots[int(found[1]) - 1 :: int(found[2])])


def _videos(folder: Path) -> list[Path]:
    """Those in a folder, by name; none in a folder of numbered pictures, which is itself a clip."""
    return sorted(p.absolute() for p in folder.iterdir() if p.suffix.lower() in VIDEOS and p.is_file())


def is_name(text: str) -> bool:
    """Whether files can be called so, on any system, and none outside their folder is meant."""
    short = len(text.encode("utf-8", "surrogatepass")) <= LONGEST_NAME
    return bool(text) and short and not text.startswith((".", "-")) and not any(c in text for c in '/\\:*?"<>|\0')


def _require_names(shots: Iterable[Shot]) -> None:
    seen: dict[str, Path] = {}
    for shot in shots:
        if not is_name(shot.name):
            raise InputRejected(f"the name '{shot.name}' of {shot.clip.name}", "a name that a folder can have")
        if shot.name in seen:
            raise InputRejected(
                f"two shots are called {shot.name}: {seen[shot.name]} and {shot.clip}",
                "a name for each", "give one of them a name: in a list of shots",
            )  # fmt: skip
        seen[shot.name] = shot.clip
    if not seen:
        raise InputRejected("no clip", "clips, folders of videos, or a list of shots (.yaml)")


def _listed(path: Path, options: ShotOptions) -> list[dict[str, Any]]:
    """The rows of a list, checked, with paths from where the list lies."""
    from fluidlift.io.yaml_reader import read_yaml

    needed = "a list: - clip: river.mp4, and below it options of make such as size: 4"
    rows = read_yaml(path, "list of shots")
    if not isinstance(rows, list) or not rows:
        raise InputRejected(f"{path.name} holds no list", needed)
    return [_row(row, f"{path.name}, shot {k}", path.absolute().parent, options) for k, row in enumerate(rows, 1)]


def _row(row: Any, where: str, folder: Path, options: ShotOptions) -> dict[str, Any]:
    row = {"clip": row} if isinstance(row, str) else row
    if not isinstance(row, dict) or not isinstance(row.get("clip"), str):
        raise InputRejected(f"{where} names no clip", "clip: and the name of a file")
    found: dict[str, Any] = {}
    for key, value in row.items():
        key = str(key).replace("-", "_")
        if key not in options.known:
            near = difflib.get_close_matches(key, options.known, 1)
            hint = f"did you mean {near[0]}?" if near else "one of " + ", ".join(options.known)
            raise InputRejected(f"{where}: unknown option '{key}'", hint)
        kind = options.types.get(key, "")
        several = "UseAppendAction" in kind
        values = value if isinstance(value, list) and several else [value]
        if not all(isinstance(v, str | int | float) and not isinstance(v, bool) for v in values):
            needed = "a word or a number" + (", or a list of them" * several)
            raise InputRejected(f"{where}: {key}: {reprlib.repr(value)}", needed)
        if key == "clip" or "Path" in kind:
            found[key] = folder / os.path.expanduser(str(value))  # pathlib raises where there is no such user
        else:
            found[key] = [str(v) for v in values] if several else value
    return found
