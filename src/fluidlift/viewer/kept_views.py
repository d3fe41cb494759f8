"""Cameras of the page that are kept for `fluidlift render --view`: one stands still, several make a path."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fluidlift.errors import InputRejected
from fluidlift.io.asset_paths import asset_file
from fluidlift.io.atomic import write_json
from fluidlift.io.frames import FIRST_FRAME
from fluidlift.io.views import read_view
from fluidlift.types import PinholeCamera, ViewKey

FILE = "view.json"
"""inside the asset"""
MOST_FOV = 160.0
"""degrees across the longer side"""


def key_of(frame: int, eye: Sequence[float], target: Sequence[float], fov: float, aspect: float) -> ViewKey:
    """The key of a browser's camera.

    Args:
        frame: that is shown, from 0.
        eye, target: m, world.
        fov: rad, from the lower to the upper edge.
        aspect: width over height of the page.
    """
    across = 2.0 * math.degrees(math.atan(math.tan(0.5 * fov) * max(aspect, 1.0)))
    (ex, ey, ez), (tx, ty, tz) = ((round(float(c), 5) for c in place) for place in (eye, target))
    return ViewKey(float(frame), (ex, ey, ez), (tx, ty, tz), round(min(max(across, 2.0), MOST_FOV), 2))


def keep(folder: Path, key: ViewKey) -> int:
    """Add a key to those of an asset, or replace that of its frame; how many there are then.

    Raises:
        InputRejected: the file there holds something else; nothing is changed then.
    """
    path = asset_file(folder, FILE)
    found = read_view(path) if path.is_file() else []
    if isinstance(found, PinholeCamera):
        raise InputRejected(f"'{FILE}' in '{folder.name}' is a camera that stands still", "keys", "rename or remove it")
    keys = sorted([k for k in found if k.frame != key.frame] + [key], key=lambda k: k.frame)
    write_json(path, {"keys": [_as_plain(k) for k in keys]})
    return len(keys)


def forget(folder: Path) -> bool:
    """Remove the keys of an asset; whether there were some."""
    path = asset_file(folder, FILE)
    there = path.is_file()
    path.unlink(missing_ok=True)
    return there


def _as_plain(key: ViewKey) -> dict[str, Any]:
    return {"frame": key.frame + FIRST_FRAME, "eye": list(key.eye), "target": list(key.target), "fov": key.fov}
