"""How a person has arranged the page: kept for the next asset, in a file of the user's settings."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path

from fluidlift.errors import FluidliftError
from fluidlift.io.atomic import write_json

FILMS = {"small": 230, "large": 460, "folded": 230}
"""px, width of the window with the input video; a small one leaves a laptop's screen (1366 px) to the fluid"""
LARGEST = 4096
"""bytes of the file that are read, at most"""


@dataclass(frozen=True)
class PageLayout:
    """Of the page."""

    film: str = "small"
    """one of `FILMS`"""
    folded: bool = False
    """the controls are folded to a strip"""


def place() -> Path:
    """$XDG_CONFIG_HOME/fluidlift/viewer.json, else below ~/.config."""
    base = os.environ.get("XDG_CONFIG_HOME")
    return (Path(base) if base else Path.home() / ".config") / "fluidlift" / "viewer.json"


def read() -> PageLayout:
    """What was kept; what is damaged or was never kept is as at first."""
    try:
        with place().open("rb") as file:
            found = json.loads(file.read(LARGEST))
    except (OSError, ValueError, RecursionError):
        return PageLayout()
    if not isinstance(found, dict):
        return PageLayout()
    film, folded = found.get("film"), found.get("folded")
    return PageLayout(film if isinstance(film, str) and film in FILMS else "small", folded is True)


def keep(layout: PageLayout) -> None:
    """Write it down; a disk that is full or read-only keeps nothing, and says nothing: the page goes on."""
    try:
        place().parent.mkdir(parents=True, exist_ok=True)
        write_json(place(), asdict(layout))
    except (FluidliftError, OSError):
        return
