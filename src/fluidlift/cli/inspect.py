"""`fluidlift inspect`: what a clip is, and what `make` would warn of when it reads it."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

from fluidlift.cli.options import Inspect
from fluidlift.messages import Notice, as_plain, from_plain
from fluidlift.progress import shown_progress


def run(wanted: Inspect) -> bool:
    """Tell; whether there is something to warn of."""
    from fluidlift.io.video import probe

    info: dict[str, Any] = probe(wanted.clip, fps=wanted.fps).to_dict()
    warnings = from_plain(info)
    if not wanted.header_only:
        camera, more = _as_read(wanted)
        warnings += [w for w in more if w not in warnings]
        info |= {"camera": camera} if camera else {}
    info |= as_plain(warnings)
    if wanted.json:
        print(json.dumps(info, indent=1, default=str))
        return bool(warnings)
    for name, value in info.items():
        if name not in ("warnings", "warning_codes"):
            print(f"{name.replace('_', ' '):16} {value}")
    for text in warnings:
        print(f"warning: {text}")
    return bool(warnings)


def _as_read(wanted: Inspect) -> tuple[str, list[Notice]]:
    """How the camera moved, in words, and the warnings of reading the clip as `make` does by default.

    What `make` would refuse (a clip longer than it takes) is a warning here.
    """
    from fluidlift.config import build_config
    from fluidlift.errors import InputRejected
    from fluidlift.pipeline import Inputs
    from fluidlift.pipeline.find import camera_facts, read_alone

    config = build_config(None, None, (), {"read.fps": wanted.fps})
    with tempfile.TemporaryDirectory() as room, shown_progress() as progress:
        try:
            found = read_alone(Inputs(wanted.clip), Path(room) / "read", config, progress=progress)
        except InputRejected as error:
            return "", [Notice("make-would-refuse", f"make would not take it as it is: {error}")]
        return camera_facts(found, found.clip.size)["words"], list(found.warnings)
