"""`fluidlift hints`: what was found of a clip, as a hints file to be corrected by hand."""

from __future__ import annotations

import json
import tempfile
from dataclasses import replace
from pathlib import Path

from fluidlift.cli.options import Hints
from fluidlift.progress import shown_progress


def run(command: Hints) -> int:
    """Write the file; the exit code."""
    from fluidlift.config import build_config
    from fluidlift.io.hints_file import hints_beside, read_hints, require_same_clip, write_hints
    from fluidlift.pipeline import Inputs
    from fluidlift.pipeline.find import find_hints, identity_of
    from fluidlift.pipeline.hints import time_laid_on
    from fluidlift.types.hints import NOTHING_SAID

    clip, part = command.clip, command.part
    identity = identity_of(clip, part.fps)
    file = command.out or hints_beside(clip)
    hints = NOTHING_SAID
    if file.exists():
        hints = read_hints(file)
        require_same_clip(hints, clip, file.name)
        identity = replace(identity, time=None if hints.clip is None else hints.clip.time)
    said = {"start": part.start, "duration": part.duration}
    hints = replace(hints, clip=identity, **{k: v for k, v in said.items() if v is not None})
    flat = {"read.fps": part.fps, "read.max_size": command.max_size}
    config = build_config(None, None, (), flat, base=dict(hints.settings))
    with tempfile.TemporaryDirectory() as room, shown_progress() as progress:
        found = find_hints(Inputs(clip), Path(room) / "look", config, hints, progress=progress)
    if not hints.has_points:  # what is copied from the section `found` lies in the picture of this frame
        hints = replace(hints, clip=replace(identity, time=time_laid_on(found.read)))
    write_hints(file, hints, found.facts())
    if command.json:
        print(json.dumps(found.facts(), indent=1))
    else:
        print(
            "\n".join(
                [*found.lines(), f"hints in {file}: correct them and go on with: fluidlift make {clip} --hints {file}"]
            )
        )
    return 4 if found.warnings else 0
