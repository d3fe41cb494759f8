"""hints.yaml: what a person says of a clip, read from strangers and written for people (docs/hints.md)."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar, cast, get_args

import yaml

from fluidlift.errors import InputRejected
from fluidlift.io.atomic import plain, write_bytes
from fluidlift.io.sequences import is_sequence, list_sequence
from fluidlift.io.yaml_reader import read_yaml
from fluidlift.types.hints import Arrow, Click, ClipHints, ClipIdentity, Point, Region, Rim, Ruler, What
from fluidlift.types.kind import KINDS

VERSION = 1
MOST = 400
"""regions, clicks, rims or arrows of a file"""
MOST_POINTS = 2000
"""of one region"""
FARTHEST = 1e6
"""px: a horizon outside the picture is still within this"""
INSTEAD = {
    "pool": "mark it as a region: {is: pool, area: ...}",
    "ledge": "mark what falls as a region: {is: ledge, area: ...}",
}  # fmt: skip
"""what a person could write for something that is said elsewhere, and what to do"""
FOUND = "found"
"""what `fluidlift hints` found; it is there to be looked at and copied from, and is not read"""
HEAD = """\
# What a person says of a clip: fluidlift make CLIP --hints THIS_FILE  (docs/hints.md)
# Points are px of the clip's own picture (clip.size), times are seconds into it. What is left out is estimated.
# `found` is what was estimated, to be looked at and copied from: make does not read it.
"""
T = TypeVar("T")


def read_hints(path: Path | str) -> ClipHints:
    """The hints of a file.

    Raises:
        InputRejected: no such file, too large, no YAML, or an entry that is not one of docs/hints.md.
    """
    path = Path(path)
    return parse_hints(read_yaml(path, "hints file"), path.name)


def read_found(path: Path | str) -> dict[str, Any]:
    """The section of a hints file that tells what was found; empty where there is none."""
    data = read_yaml(Path(path), "hints file")
    found = data.get(FOUND) if isinstance(data, dict) else None
    return found if isinstance(found, dict) else {}


def parse_hints(data: Any, name: str = "hints.yaml") -> ClipHints:
    """Hints from the plain data of such a file.

    Args:
        data: as YAML or JSON has it.
        name: of the file, for messages.

    Raises:
        InputRejected: as `read_hints`.
    """
    top = _Entry(name, "", data if data is not None else {})
    version = top.whole("hints", 1, VERSION)
    if version is None:
        raise top.refused(f"no line 'hints: {VERSION}'", "a hints file", "begin it with that line")
    for word, what in INSTEAD.items():
        if word in top.data:
            raise top.refused(f"'{word}'", "hints that have an effect", what)
    found = ClipHints(
        clip=top.part("clip", _identity),
        start=top.number("start", 0.0, 1e9),
        duration=top.number("duration", 1e-6, 1e9),
        kind=top.word("kind", tuple(KINDS)),
        fov=top.number("fov", 2.0, 165.0),
        pitch=top.number("pitch", -90.0, 90.0),
        horizon=top.part("horizon", _horizon),
        ruler=top.part("ruler", _ruler),
        rims=top.several("rims", _rim),
        regions=top.several("regions", _region),
        clicks=top.several("clicks", _click),
        roi=top.part("roi", _box),
        flow=top.several("flow", _arrow),
        level=top.part("level", _level),
    )
    top.data.pop(FOUND, None)
    top.nothing_else()
    if found.pitch is not None and found.horizon is not None:
        raise top.refused("two horizons: one drawn, and a pitch", "one of them", "leave one out")
    if found.clip is None and found.has_points:
        raise top.refused(
            "points without the size of the picture that they are px of", "clip: {size: [width, height]}",
            "let fluidlift hints CLIP write it",
        )  # fmt: skip
    return found


def hints_data(hints: ClipHints) -> dict[str, Any]:
    """Hints as the plain data of a file, in its order; what was not said is left out."""
    data: dict[str, Any] = {"hints": VERSION}
    if hints.clip is not None:
        data["clip"] = {k: v for k, v in plain(asdict(hints.clip)).items() if v is not None}
    for name in ("start", "duration", "kind", "fov", "pitch"):
        if (value := getattr(hints, name)) is not None:
            data[name] = value if isinstance(value, str) else round(value, 4)
    if hints.horizon is not None:
        data["horizon"] = [_rounded(p) for p in hints.horizon]
    if (ruler := hints.ruler) is not None:
        data["ruler"] = {"from": _rounded(ruler.begin), "to": _rounded(ruler.end), "metres": ruler.metres}
    if hints.rims:
        data["rims"] = [
            {"center": _rounded(r.center), "axes": _rounded(r.axes), "turned": round(r.turned, 2)} for r in hints.rims
        ]
    if hints.regions:
        data["regions"] = [_region_data(r) for r in hints.regions]
    if hints.clicks:
        data["clicks"] = [{"at": _rounded(c.at), "fluid": c.fluid} for c in hints.clicks]
    if hints.roi is not None:
        data["roi"] = _rounded(hints.roi)
    if hints.flow:
        data["flow"] = [{"at": _rounded(a.at), "to": _rounded(a.to)} for a in hints.flow]
    if hints.level is not None:
        data["level"] = [_rounded(p) for p in hints.level]
    return data


def hints_text(hints: ClipHints, found: Mapping[str, Any] | None = None) -> str:
    """A hints file as text."""
    data = hints_data(hints) | ({FOUND: plain(dict(found))} if found else {})
    return HEAD + "\n".join(_lines(data, "")) + "\n"


def _lines(data: Mapping[str, Any], indent: str) -> list[str]:
    """A mapping with one line per entry and one per item of a list of mappings."""
    found = []
    for key, value in data.items():
        if key in (FOUND,):
            found += [f"{indent}{key}:", *_lines(value, indent + "  ")]
        elif isinstance(value, list) and value and isinstance(value[0], dict | str):
            found += [f"{indent}{key}:", *(f"{indent}- {_in_one_line(item)}" for item in value)]
        else:
            found.append(f"{indent}{key}: {_in_one_line(value)}")
    return found


def _in_one_line(value: Any) -> str:
    text = yaml.safe_dump(value, sort_keys=False, default_flow_style=True, width=10**6, allow_unicode=True)
    return text.removesuffix("\n").removesuffix("\n...")


def write_hints(path: Path | str, hints: ClipHints, found: Mapping[str, Any] | None = None) -> Path:
    """Write a hints file at once."""
    return write_bytes(path, hints_text(hints, found).encode(), lasting=True)


def hints_beside(clip: Path) -> Path:
    """Where the hints of a clip lie: beside it, with its name."""
    folder = clip.is_dir()
    pattern = not folder and is_sequence(clip)
    name = clip.parent.name if pattern else clip.name if folder else clip.stem
    return (clip.parent.parent if pattern and clip.parent.name else clip.parent) / f"{name}.hints.yaml"


def content_hash(clip: Path) -> str:
    """SHA-256 of a clip's content, whatever its name; of pictures, of their hashes in order."""
    files = [file for _, file in list_sequence(clip)] if is_sequence(clip) else [clip]
    hashes = [_file_hash(file) for file in files]
    return hashes[0] if len(hashes) == 1 else hashlib.sha256("".join(hashes).encode()).hexdigest()


def require_same_clip(hints: ClipHints, clip: Path, name: str) -> None:
    """Raise `InputRejected` where hints were given for another clip."""
    told = hints.clip
    if told is None or told.sha256 is None or told.sha256 == content_hash(clip):
        return
    w, h = told.size
    raise InputRejected(
        f"{name} belongs to another clip than '{clip.name}': to '{told.name}' ({w} x {h} px)", "the hints of this clip",
        "give the right file; where this is the same footage in another encoding, delete the line clip.sha256",
    )  # fmt: skip


def _file_hash(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _rounded(values: Sequence[float]) -> list[float]:
    return [round(float(v), 1) for v in values]


def _region_data(r: Region) -> dict[str, Any]:
    data: dict[str, Any] = {"is": r.what}
    if r.width is None:
        data["area"] = [_rounded(p) for p in r.line]
    else:
        data |= {"brush": [_rounded(p) for p in r.line], "width": round(r.width, 1)}
    if r.moves:
        data |= {"time": round(r.time, 4), "moves": True}
    elif r.time:
        data["time"] = round(r.time, 4)
    return data | {name: round(v, 4) for name, v in (("from", r.begins), ("until", r.ends)) if v is not None}


class _Entry:
    """A mapping of the file whose entries are taken out one by one; what is left over is unknown."""

    def __init__(self, file: str, place: str, data: Any) -> None:
        self.file, self.place = file, place
        if not isinstance(data, dict):
            raise self.refused(f"{place or 'the file'} is no mapping", "lines such as 'kind: stream'")
        self.data: dict[Any, Any] = dict(data)
        self.known: list[str] = []

    def refused(self, got: str, needed: str = "", do: str = "") -> InputRejected:
        return InputRejected(f"{self.file}: {got}", needed, do or "correct it (docs/hints.md)")

    def take(self, name: str) -> Any:
        self.known.append(name)
        return self.data.pop(name, None)

    def at(self, name: str) -> str:
        return f"{self.place}.{name}" if self.place else name

    def number(self, name: str, low: float, high: float) -> float | None:
        value = self.take(name)
        return None if value is None else self.checked(self.at(name), value, low, high)

    def checked(self, place: str, value: Any, low: float, high: float) -> float:
        good = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        if not good or not low <= value <= high:
            raise self.refused(f"{place} = {str(value)[:40]}", f"a number from {low:g} to {high:g}")
        return float(value)

    def whole(self, name: str, low: int, high: int) -> int | None:
        value = self.number(name, low, high)
        if value is not None and value != int(value):
            raise self.refused(f"{self.at(name)} = {value:g}", "a whole number")
        return None if value is None else int(value)

    def word(self, name: str, words: tuple[str, ...] = ()) -> str | None:
        value = self.take(name)
        if value is None:
            return None
        if not isinstance(value, str) or len(value) > 4096 or (words and value not in words):
            needed = f"one of {', '.join(words)}" if words else "a text"
            raise self.refused(f"{self.at(name)} = {str(value)[:40]}", needed)
        return value

    def yes(self, name: str) -> bool | None:
        value = self.take(name)
        if value is not None and not isinstance(value, bool):
            raise self.refused(f"{self.at(name)} = {str(value)[:40]}", "true or false")
        return value

    def numbers(self, place: str, value: Any, count: int) -> tuple[float, ...]:
        if not isinstance(value, list) or len(value) != count:
            example = ", ".join(["64", "48", "320", "200"][:count])
            raise self.refused(f"{place} = {str(value)[:60]}", f"{count} numbers in px, such as [{example}]")
        return tuple(self.checked(place, v, -FARTHEST, FARTHEST) for v in value)

    def point(self, name: str) -> Point:
        x, y = self.numbers(self.at(name), self.take(name), 2)
        return x, y

    def part(self, name: str, read: Callable[[_Entry, str, Any], T]) -> T | None:
        value = self.take(name)
        return None if value is None else read(self, self.at(name), value)

    def several(self, name: str, read: Callable[[_Entry], T]) -> tuple[T, ...]:
        value = self.take(name)
        if value is None:
            return ()
        if not isinstance(value, list) or len(value) > MOST:
            raise self.refused(f"{self.at(name)} is no list, or one of more than {MOST}", "a list")
        found = []
        for k, item in enumerate(value):
            entry = _Entry(self.file, f"{self.at(name)}[{k + 1}]", item)
            found.append(read(entry))
            entry.nothing_else()
        return tuple(found)

    def nothing_else(self) -> None:
        if self.data:
            first = str(next(iter(self.data)))[:40]
            raise self.refused(f"unknown entry '{self.at(first)}'", f"one of {', '.join(self.known)}")


def _identity(entry: _Entry, place: str, value: Any) -> ClipIdentity:
    e = _Entry(entry.file, place, value)
    size = e.numbers(e.at("size"), e.take("size"), 2)
    if min(size) < 1 or size != tuple(int(v) for v in size):
        raise e.refused(f"{e.at('size')} = {list(size)}", "width and height of the clip's picture, px")
    found = ClipIdentity(
        e.word("name") or "", (int(size[0]), int(size[1])), e.whole("frames", 1, 10**9), e.word("sha256"),
        e.number("time", 0.0, 1e9),
    )  # fmt: skip
    e.nothing_else()
    return found


def _horizon(entry: _Entry, place: str, value: Any) -> tuple[Point, Point]:
    if isinstance(value, list) and len(value) > 2:
        raise entry.refused(f"{len(value)} points of a horizon", "one horizon: two points", "leave the others out")
    return _two_beside(entry, place, value)


def _level(entry: _Entry, place: str, value: Any) -> tuple[Point, Point]:
    if isinstance(value, list) and len(value) > 2:
        raise entry.refused(
            f"{len(value)} points of a level", "two points along the edge of still water", "leave the others out"
        )
    return _two_beside(entry, place, value)


def _two_beside(entry: _Entry, place: str, value: Any) -> tuple[Point, Point]:
    """Two points of a line across the picture, the left one first."""
    if not isinstance(value, list) or len(value) != 2:
        raise entry.refused(f"{place} = {str(value)[:60]}", "two points of it, such as [[0, 120], [640, 112]]")
    ends = []
    for point in value:
        x, y = entry.numbers(place, point, 2)
        ends.append((x, y))
    ends.sort()
    if ends[1][0] - ends[0][0] < 1.0:
        raise entry.refused(f"{place} = {str(value)[:60]}", "two points beside each other", "move one to the side")
    return ends[0], ends[1]


def _ruler(entry: _Entry, place: str, value: Any) -> Ruler:
    e = _Entry(entry.file, place, value)
    begin, end, metres = e.point("from"), e.point("to"), e.number("metres", 1e-4, 1e5)
    if metres is None or math.dist(begin, end) < 2.0:
        raise e.refused(f"{place} without a length", "two points at least 2 px apart, and metres")
    e.nothing_else()
    return Ruler(begin, end, metres)


def _rim(e: _Entry) -> Rim:
    center = e.point("center")
    long, short = e.numbers(e.at("axes"), e.take("axes"), 2)
    turned = e.number("turned", -360.0, 360.0) or 0.0
    if short > long:
        long, short, turned = short, long, turned + 90.0
    if short < 1.0:
        raise e.refused(f"{e.at('axes')} = {[long, short]}", "half the length and half the width of the rim, over 1 px")
    return Rim(center, (long, short), (turned + 90.0) % 180.0 - 90.0)


def _region(e: _Entry) -> Region:
    what = e.word("is", get_args(What))
    area, brush = e.take("area"), e.take("brush")
    width, time, moves = e.number("width", 0.1, FARTHEST), e.number("time", 0.0, 1e9), e.yes("moves")
    begins, ends = e.number("from", 0.0, 1e9), e.number("until", 0.0, 1e9)
    line = area if brush is None else brush
    if what is None or (area is None) == (brush is None) or not isinstance(line, list):
        raise e.refused(f"{e.place} is no region", "'is', and either 'area' (corners) or 'brush' (a way) with 'width'")
    if (brush is None) != (width is None):
        raise e.refused(f"{e.place}: a width belongs to a brush", "'brush' and 'width', or 'area' alone")
    least = 3 if brush is None else 1
    if not least <= len(line) <= MOST_POINTS:
        raise e.refused(f"{e.place} has {len(line)} points", f"{least} to {MOST_POINTS}")
    points = []
    for p in line:
        x, y = e.numbers(e.place, p, 2)
        points.append((x, y))
    if begins is not None and ends is not None and ends <= begins:
        raise e.refused(f"{e.place} is there from {begins:g} s until {ends:g} s", "an end after its beginning")
    return Region(cast(What, what), tuple(points), width, time or 0.0, bool(moves), begins, ends)


def _click(e: _Entry) -> Click:
    at, fluid = e.point("at"), e.yes("fluid")
    if fluid is None:
        raise e.refused(f"{e.place} does not say what is there", "fluid: true or false")
    return Click(at, fluid)


def _arrow(e: _Entry) -> Arrow:
    at, to = e.point("at"), e.point("to")
    if math.dist(at, to) < 2.0:
        raise e.refused(
            f"{e.place} has no direction", "'at' (where the fluid is) and 'to' (where it runs) 2 px apart or more"
        )
    return Arrow(at, to)


def _box(entry: _Entry, place: str, value: Any) -> tuple[float, float, float, float]:
    x, y, width, height = entry.numbers(place, value, 4)
    return x, y, width, height
