"""How much a reader takes in before it says no, and the first look at any file that a user names."""

from __future__ import annotations

import difflib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fluidlift.errors import InputRejected, require

MAX_TEXT_BYTES = 16 * 2**20
"""of a JSON file"""
MAX_DEPTH = 100
"""of lists and objects inside each other: files of ours need ten. Python reads five times as many, but what walks them
afterwards (to write them, to compare them) calls itself more than once for each, and its stack ends"""
MAX_PIXEL_BYTES = 16
"""of decoded samples for each pixel of `ReadLimits.max_pixels`: four channels in single precision, or more on smaller
pictures"""


@dataclass(frozen=True)
class ReadLimits:
    """Bounds on what a video or a picture may cost, so that a hostile or mistaken file cannot fill the machine."""

    max_pixels: int = 8192 * 4320
    """of one source frame, before it is scaled down"""
    max_frames: int = 2000
    """frames kept"""
    max_bytes: int = 4 * 2**30
    """memory of all frames kept, after they are scaled down"""

    def __post_init__(self) -> None:
        require(min(self.max_pixels, self.max_frames, self.max_bytes) > 0, f"limits {self}", "positive numbers")


def require_file(path: Path | str, what: str = "file") -> Path:
    """The path, if it names a readable regular file with something in it.

    Raises:
        InputRejected: nothing there, a folder, a device, an empty file, or no permission.
    """
    path = Path(path)
    try:
        there = path.exists()
    except (OSError, ValueError) as error:  # longer than names can be, or with a zero byte
        why = getattr(error, "strerror", None) or error
        raise InputRejected(f"the {what} '{str(path)[:60]}' cannot be looked for ({why})", f"a {what}") from None
    if not there:
        raise InputRejected(f"no such {what}: '{path}'", f"an existing {what}", _suggestion(path))
    if path.is_dir():
        raise InputRejected(f"'{path}' is a folder", f"a {what}")
    if not path.is_file():
        raise InputRejected(f"'{path}' is not a regular file", f"a {what}")
    try:
        with path.open("rb") as file:
            first = file.read(1)
    except PermissionError:
        raise InputRejected(f"'{path}' may not be read", "permission to read it", "change its access rights") from None
    if not first:
        raise InputRejected(f"'{path}' is empty (0 bytes)", f"a {what} with content", "copy or download it again")
    return path


def _suggestion(path: Path) -> str:
    """Names nearby that look like the one that was asked for."""
    parent = path.parent
    if not parent.is_dir():
        return f"check the folder: '{parent}' does not exist either"
    # an asset that a run is about to write has the name of its clip
    names = [p.name for p in parent.iterdir() if p.suffix != ".fluid" or path.suffix == ".fluid"]
    near = difflib.get_close_matches(path.name, names, n=3, cutoff=0.6)
    return f"check the name; similar ones there: {', '.join(near)}" if near else "check the name"


def require_size(path: Path, max_bytes: int, what: str) -> None:
    """Raise `InputRejected` if the file is larger than `max_bytes`."""
    size = path.stat().st_size
    if size > max_bytes:
        raise InputRejected(
            f"'{path.name}' has {size} bytes",
            f"at most {max_bytes} bytes in a {what}",
            "check that it is the right file",
        )


def read_json(path: Path | str, what: str = "JSON file", max_bytes: int = MAX_TEXT_BYTES) -> Any:
    """The content of a JSON file.

    Raises:
        InputRejected: no such file, larger than `max_bytes`, or not JSON.
    """
    path = require_file(path, what)
    require_size(path, max_bytes, what)
    try:
        return parse_json(path.read_bytes())
    except ValueError as error:
        raise InputRejected(f"'{path.name}' is not valid JSON ({error})", f"a {what}", "check the file") from None


def parse_json(data: bytes | str) -> Any:
    """Plain data of a JSON text (UTF-8). Whole numbers that no reader can mean become infinite, as `1e999` does.

    Raises:
        ValueError: no JSON, no UTF-8, half a character, or more than `MAX_DEPTH` lists and objects inside each other.
    """
    try:
        text = data if isinstance(data, str) else data.decode("utf-8")
        value = json.loads(text, parse_int=_whole_number)
        if text.count("[") + text.count("{") > MAX_DEPTH and not _is_shallow(value):
            raise RecursionError
        if "\\u" in text:  # half of a pair is no character: it can be neither printed nor written
            json.dumps(value, ensure_ascii=False).encode("utf-8")
        return value
    except RecursionError:
        raise ValueError("lists and objects nested too deeply") from None


def _is_shallow(value: Any) -> bool:
    """Whether no more than `MAX_DEPTH` lists and dictionaries lie inside each other."""
    level = [value]
    for _ in range(MAX_DEPTH):
        within = (v.values() if isinstance(v, dict) else v for v in level if isinstance(v, dict | list))
        level = [item for items in within for item in items]
    return not any(isinstance(v, dict | list) for v in level)


def _whole_number(text: str) -> int | float:
    """Python refuses to read more than 4300 digits, and NumPy those that do not fit into 64 bits."""
    value = int(text) if len(text) <= 20 else float(text)
    return value if abs(value) < 2**63 else float(value)
