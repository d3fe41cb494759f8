"""`fluidlift studio`: clips in the browser, put right and made."""

from __future__ import annotations

from dataclasses import field
from pathlib import Path
from typing import Annotated

import tyro

from fluidlift.cli.options import LearnedOptions
from fluidlift.cli.quantities import command


@command
class Studio:
    """See in the browser what is found of a clip, put it right with a few strokes, and make it."""

    place: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PLACE")] = Path(".")
    """a video, or a folder of videos and assets"""
    port: int = 8180
    """of the page; the next free one where it is in use"""
    browser: bool = True
    """the page opens in the default browser; --no-browser leaves that to you"""
    learned: tyro.conf.OmitArgPrefixes[LearnedOptions] = field(default_factory=LearnedOptions)
    """learned models, which see some things better"""


def run(wanted: Studio) -> int:
    """Serve the page until Ctrl-C; the exit code."""
    from fluidlift.pipeline.models import NONE, ModelWish
    from fluidlift.studio.app import StudioRequest, studio

    learned = ModelWish(wanted.learned.models or NONE, wanted.learned.use)
    request = StudioRequest(wanted.port, wanted.browser, learned)
    studio(wanted.place, request, told=lambda line: print(line, flush=True))
    return 0
