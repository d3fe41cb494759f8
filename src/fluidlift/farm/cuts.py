"""A clip of several shots becomes several shots: its cuts are found, and each part is a shot of its own.

Cuts are those that `make` finds (`motion.stabilize.find_cuts`), in pictures that are as small as it looks at them
there; they go through a file, so that memory does not grow with the clip.
"""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from fluidlift.errors import InputRejected
from fluidlift.farm.shots import Shot
from fluidlift.io.atomic import atomic_write
from fluidlift.io.hashes import digest
from fluidlift.io.limits import parse_json

FOUND = ".cuts.json"
"""suffix of a file beside the assets: where a clip is cut, so that it is looked through once"""
LEAST = 0.5
"""s; what is shorter is no shot to make: a flow is averaged over some ten frames, and titles flash by as fast"""


@dataclass(frozen=True)
class Cut:
    """A part of a clip, of one view."""

    start: float
    """s, between its first frame and the one before; 0 for the first of a clip"""
    end: float | None
    """s, as `start` of the next one; None: it lasts to the end"""
    seconds: float
    """that it lasts"""


def parted(shots: Sequence[Shot], folder: Path | None, tell: Callable[[str], None]) -> list[Shot]:
    """The shots, those with cuts as several: NAME_01, NAME_02, ..., with a start and a duration of their own.

    A clip that cannot be read stays one shot, whose make says why. Parts under `LEAST` seconds are left out, and told.

    Args:
        shots: of a list.
        folder: where what was found is kept; None: nowhere.
        tell: lines for people.

    Raises:
        InputRejected: two shots of one name come out.
    """
    found: list[Shot] = []
    for shot in shots:
        parts = _parts_of(shot, folder)
        long = [part for part in parts if part.seconds >= LEAST]
        if len(parts) < 2 or not long:
            found.append(shot)
            continue
        short = len(parts) - len(long)
        tell(f"{shot.name}: {len(long)} shots" + (f", {short} under {LEAST:g} s left out" if short else ""))
        found += [_part(shot, k, part) for k, part in enumerate(long, 1)]
    names = [shot.name for shot in found]
    if twice := {name for name in names if names.count(name) > 1}:
        raise InputRejected(
            f"two shots are called {min(twice)}", "a name for each", "name the clips in a list of shots"
        )
    return found


def _part(shot: Shot, number: int, part: Cut) -> Shot:
    options: dict[str, Any] = {**shot.options, "start": part.start}
    options.pop("duration", None)
    if part.end is not None:
        options["duration"] = round(part.end - part.start, 6)
    return replace(shot, name=f"{shot.name}_{number:02d}", options=options)


def _parts_of(shot: Shot, folder: Path | None) -> list[Cut]:
    """Of one clip, from the file that says so where it is of this clip; none where it cannot be read."""
    span = {name: shot.options.get(name) for name in ("start", "duration", "fps")}
    if folder is None:
        return _looked_for(shot.clip, span)
    path = folder / f"{shot.name}{FOUND}"
    asked = {"clip": digest(shot.clip) if shot.clip.is_file() else "", "span": {k: str(v) for k, v in span.items()}}
    if asked["clip"]:
        with suppress(OSError, ValueError, TypeError, KeyError, IndexError):
            kept = parse_json(path.read_bytes())
            if kept["asked"] == asked:
                return [_cut(c) for c in kept["parts"]]
    parts = _looked_for(shot.clip, span)
    if not parts:
        return parts
    with atomic_write(path) as file:
        file.write((json.dumps({"asked": asked, "parts": [vars(part) for part in parts]}, indent=1) + "\n").encode())
    return parts


def _cut(kept: Mapping[str, Any]) -> Cut:
    """A part as a file has it; raises ValueError, TypeError or KeyError for what is none."""
    end = None if kept["end"] is None else float(kept["end"])
    cut = Cut(float(kept["start"]), end, float(kept["seconds"]))
    if not all(math.isfinite(x) for x in (cut.start, cut.end or 0.0, cut.seconds)):
        raise ValueError(f"times {cut}")
    return cut


def _looked_for(clip: Path, span: Mapping[str, Any]) -> list[Cut]:
    """As `cuts_of`; none where the clip cannot be read."""
    try:
        return cuts_of(clip, **{k: None if v is None else float(v) for k, v in span.items()})
    except (InputRejected, ValueError):
        return []


def cuts_of(
    clip: Path, *, start: float | None = None, duration: float | None = None, fps: float | None = None
) -> list[Cut]:
    """The parts of a clip between its cuts, in order.

    Args:
        clip: video file or image sequence.
        start: s, where in it the first part begins; None: at its first frame.
        duration: s that are looked at; None: to its end.
        fps: frames per second of an image sequence.

    Raises:
        InputRejected: a clip that cannot be used.
    """
    from fluidlift.io.stage_cache import Scratch
    from fluidlift.io.video import before_frame, look_through
    from fluidlift.motion.stabilize import GreyFrames, find_cuts

    with tempfile.TemporaryDirectory() as room:
        read = look_through(clip, Scratch(room, "cuts"), start=start or 0.0, duration=duration, fps=fps)
        times = read.times
        edges = find_cuts(GreyFrames(read.frames))
        end = float(times[-1] + read.interval)
    between = [before_frame(times, e) for e in edges]
    begins = [start or 0.0, *between]
    last = None if duration is None else round((start or 0.0) + duration, 6)
    ends = [*between, last]
    return [Cut(a, b, round((end if b is None else min(b, end)) - a, 6)) for a, b in zip(begins, ends)]
