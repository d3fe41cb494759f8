"""Camera paths that a person writes: keyed views in a JSON file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.io.frames import FIRST_FRAME
from fluidlift.io.limits import read_json
from fluidlift.types import PinholeCamera, ViewKey

VIEW = "{'keys': [{'frame': 1001, 'eye': [x, y, z], 'target': [x, y, z], 'fov': 40}, ...]}"


def read_view(path: Path | str) -> PinholeCamera | list[ViewKey]:
    """One standing camera, or the keys of a moving one.

    Two kinds of file: a camera JSON (width, height, K, R, t), or an object with `keys`, each with `frame` (from 1001),
    `eye` and `target` (m, world) and, if it is not 40, `fov` (degrees across the longer side).

    Raises:
        InputRejected: a file that is neither, or with numbers that are none.
    """
    data, name = read_json(path, "view"), Path(path).name
    if isinstance(data, dict) and "keys" not in data:
        return PinholeCamera.from_dict(data)
    keys = data.get("keys") if isinstance(data, dict) else None
    if not isinstance(keys, list) or not keys or not all(isinstance(k, dict) for k in keys):
        raise InputRejected(f"'{name}' holds no view", f"a camera JSON, or {VIEW}")
    found = []
    for number, key in enumerate(keys, 1):
        unknown = set(key) - {"frame", "eye", "target", "fov"}
        try:
            (ex, ey, ez), (tx, ty, tz) = (map(float, key[n]) for n in ("eye", "target"))
            eye, target = (ex, ey, ez), (tx, ty, tz)
            fov, frame = float(key.get("fov", 40.0)), float(key["frame"]) - FIRST_FRAME
            sound = bool(np.isfinite([*eye, *target, fov, frame]).all()) and 1 < fov < 170
        except (KeyError, TypeError, ValueError, OverflowError):
            sound, eye, target, fov, frame = False, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0, 0.0
        if unknown or not sound or eye == target:
            raise InputRejected(f"key {number} of '{name}'", f"numbers as in {VIEW}, with an eye beside its target")
        found.append(ViewKey(frame, eye, target, fov))
    if len({k.frame for k in found}) < len(found):
        raise InputRejected(f"'{name}' has two keys of one frame", "one key per frame")
    return found
