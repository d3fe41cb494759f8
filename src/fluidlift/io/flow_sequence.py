"""Which file holds the flow of which pair of frames: a single file, a folder, or a numbered pattern."""

from __future__ import annotations

import re
from pathlib import Path

from fluidlift.errors import InputRejected
from fluidlift.io.limits import require_file

FLOW_SUFFIXES = (".flo", ".exr", ".npz", ".npy", ".png")
ARRAY_SUFFIXES = (".npz", ".npy")
_PLACEHOLDER = re.compile(r"%0?(\d*)d|#+")


def is_array(path: Path | str) -> bool:
    """Whether the path names one file of arrays, which may hold a whole clip."""
    path = Path(path)
    return path.suffix.lower() in ARRAY_SUFFIXES and not is_pattern(path) and not path.is_dir()


def is_pattern(path: Path) -> bool:
    """Whether the name holds a place for numbers and is no file itself."""
    return not path.exists() and _PLACEHOLDER.search(path.name) is not None


def numbered_flow(path: Path | str, pairs: int, start: int, first_number: int | None) -> list[Path]:
    """The files of pairs start to start + pairs - 1, one each.

    Args:
        path: a file, a folder, or a pattern with %04d or ####.
        pairs: how many are needed.
        start: number of the first frame, counted from 0.
        first_number: number in the name of the file of frame 0; None: the lowest.

    Raises:
        InputRejected: nothing there, several kinds in one folder, or a pair that lacks, with its frame.
    """
    path = Path(path)
    files = _files(path)
    if not files:
        raise InputRejected(f"'{path}' holds no flow", "numbered files: " + ", ".join(FLOW_SUFFIXES))
    base = min(files) if first_number is None else first_number
    for t in range(start, start + pairs):
        if base + t not in files:
            raise InputRejected(
                f"'{path}' holds {len(files)} flow file(s), and none from frame {t} to {t + 1} (number {base + t})",
                f"{pairs} pairs, numbers {base + start} to {base + start + pairs - 1}",
                "export the flow of every frame of the clip but the last",
            )
    return [files[base + t] for t in range(start, start + pairs)]


def _files(path: Path) -> dict[int, Path]:
    """File by number."""
    if path.is_dir():
        listed = [p for p in path.iterdir() if p.suffix.lower() in FLOW_SUFFIXES and not p.name.startswith(".")]
        kinds = sorted({p.suffix.lower() for p in listed})
        if len(kinds) > 1:
            raise InputRejected(
                f"the folder '{path}' holds flow of several kinds ({', '.join(kinds)})", "one kind",
                f"name the files by a pattern, such as {path.name}/%04d{kinds[0]}",
            )  # fmt: skip
        digits = [re.findall(r"\d+", p.stem) for p in listed]
        if not all(digits):
            return dict(enumerate(sorted(listed)))
        numbered = [(int(d[-1]), p) for d, p in zip(digits, listed)]
    elif is_pattern(path):
        if not path.parent.is_dir():
            raise InputRejected(f"no such folder: '{path.parent}'", "the folder of the flow", "check the path")
        _known(path)
        place = _PLACEHOLDER.search(path.name)
        assert place is not None
        name = re.compile(re.escape(path.name[: place.start()]) + r"(\d+)" + re.escape(path.name[place.end() :]))
        numbered = [(int(m[1]), p) for p in path.parent.iterdir() if (m := name.fullmatch(p.name))]
    else:
        numbered = [(0, _known(require_file(path, "flow file")))]
    if len({n for n, _ in numbered}) < len(numbered):
        raise InputRejected(f"'{path}' holds two flow files with the same number", "one file per number")
    return dict(numbered)


def _known(path: Path) -> Path:
    if path.suffix.lower() not in FLOW_SUFFIXES:
        raise InputRejected(f"'{path.name}' is no flow of a known kind", "one of " + ", ".join(FLOW_SUFFIXES))
    return path
