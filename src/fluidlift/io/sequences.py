"""Numbered pictures as a clip: `frames/%04d.png`, `frames/####.png`, or a folder of pictures."""

from __future__ import annotations

import re
from pathlib import Path

from fluidlift.errors import InputRejected, required
from fluidlift.io.pictures import PICTURE_SUFFIXES

_PLACEHOLDER = re.compile(r"%0?(\d*)d|#+")


def is_sequence(path: Path | str) -> bool:
    """Whether the path names many pictures: a folder, or a name with %04d or ####."""
    path = Path(path)
    return path.is_dir() or (not path.exists() and _PLACEHOLDER.search(path.name) is not None)


def list_sequence(path: Path | str) -> list[tuple[int, Path]]:
    """(number, file) of every picture, in the order of the numbers.

    Raises:
        InputRejected: no such folder, no picture, or a folder with pictures of several kinds.
    """
    path = Path(path)
    return _in_folder(path) if path.is_dir() else _matching(path)


def _in_folder(folder: Path) -> list[tuple[int, Path]]:
    if (folder / "manifest.json").is_file() and (folder / "scene.yaml").is_file():
        raise InputRejected(
            f"'{folder.name}' is an asset, not a clip", "a video, or a folder of pictures",
            f"look at it with 'fluidlift view {folder.name}', check it with 'fluidlift validate {folder.name}'",
        )  # fmt: skip
    files = [p for p in folder.iterdir() if p.suffix.lower() in PICTURE_SUFFIXES and not p.name.startswith(".")]
    kinds = sorted({p.suffix.lower() for p in files})
    if not files:
        raise InputRejected(
            f"the folder '{folder}' holds no pictures",
            "numbered pictures, such as 0001.png, or a video file",
            "give the name of the video or of the folder of frames",
        )
    if len(kinds) > 1:
        raise InputRejected(
            f"the folder '{folder}' holds pictures of several kinds ({', '.join(kinds)})",
            "one kind",
            f"name the frames by a pattern, such as {folder.name}/%04d{kinds[0]}",
        )
    digits = [re.findall(r"\d+", p.stem) for p in files]
    if not all(digits):
        return list(enumerate(sorted(files)))
    numbered = sorted((int(d[-1]), p) for d, p in zip(digits, files))
    if len({n for n, _ in numbered}) < len(numbered):
        raise InputRejected(
            f"the folder '{folder}' holds two pictures with the same number",
            "one picture per number",
            f"name the frames by a pattern, such as {folder.name}/name_%04d{kinds[0]}",
        )
    return numbered


def _matching(pattern: Path) -> list[tuple[int, Path]]:
    if not pattern.parent.is_dir():
        raise InputRejected(f"no such folder: '{pattern.parent}'", "the folder of the frames", "check the path")
    if pattern.suffix.lower() not in PICTURE_SUFFIXES:
        raise InputRejected(
            f"'{pattern.name}' does not name pictures of a known kind", "one of " + ", ".join(sorted(PICTURE_SUFFIXES))
        )
    place = required(_PLACEHOLDER.search(pattern.name), f"'{pattern.name}' without a place for numbers")
    head, tail = re.escape(pattern.name[: place.start()]), re.escape(pattern.name[place.end() :])
    name = re.compile(head + r"(\d+)" + tail)
    hits = [(int(m[1]), p) for p in pattern.parent.iterdir() if (m := name.fullmatch(p.name))]
    if not hits:
        raise InputRejected(f"no file matches '{pattern}'", "numbered pictures", "check the folder and the pattern")
    return sorted(hits)
