"""Values of an asset's earlier runs, where they are still in its folder work/."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.pipeline.footage import Footage, footage_of
from fluidlift.pipeline.runner import Runner, kept_value, last_value
from fluidlift.types.stages import (
    Fit,
    Flow,
    Geometry,
    Lift,
    Motion,
    Read,
    Refined,
    Segmentation,
    Simulation,
)

OF_CLIP: dict[str, type] = {
    "read": Read, "flow": Flow, "segment": Segmentation, "geometry": Geometry, "refine": Refined, "motion": Motion,
    "fit": Fit,
}  # fmt: skip
"""stages that need the clip, and what they leave"""


def recalled_lift(runner: Runner, manifest: dict[str, Any]) -> Lift | None:
    """What `make` found in the clip; None where any of it is gone, and the runner knows nothing of it then."""
    keys, values = stage_keys(manifest), []
    for name, kind in OF_CLIP.items():
        value = runner.recall(name, keys[name], kind) if name in keys else None
        if value is None:
            runner.forget()
            return None
        values.append(value)
    return Lift(*values)


def footage_of_asset(folder: Path, manifest: dict[str, Any]) -> Footage | None:
    """The clip that an asset comes from; None where it is no longer at hand."""
    found = [recalled(folder, manifest, name) for name in ("read", "segment", "geometry")]
    return None if any(value is None for value in found) else footage_of(*found)


def recalled(folder: Path, manifest: dict[str, Any], name: str) -> Any:
    """The value of one stage of `OF_CLIP` that an asset was made from; None where it is gone."""
    key = stage_keys(manifest).get(name)
    found = None if key is None else kept_value(folder, name, key, OF_CLIP[name])
    return None if found is None else found[0]


def stage_keys(manifest: dict[str, Any]) -> dict[str, str]:
    """Keys of the cached values that an asset was made from; those that are none are left out."""
    keys = manifest.get("provenance", {}).get("stages", {})
    return {n: k for n, k in keys.items() if is_key(k)} if isinstance(keys, dict) else {}


def is_key(text: Any) -> bool:
    """Whether this can be the key of a value."""
    return isinstance(text, str) and len(text) == 64 and text.isalnum() and text.isascii()


def rest_frame_of(manifest: dict[str, Any], footage: Footage | None) -> int:
    """Frame of the clip that the body at rest shows."""
    start = manifest.get("metrics", {}).get("rest_frame", 0) if footage is None else footage.start
    return start if type(start) is int and 0 <= start < manifest["frame_count"] else 0


def simulated_poses(folder: Path, bodies: int | None = None, frames: int = 0) -> np.ndarray | None:
    """[k,b,7] of the obstacles in the k frames that were simulated last: position (m) and orientation (w, x, y, z).

    None where they are not at hand, not of so many `bodies` (None: any number), or of fewer than `frames`.
    """
    found = last_value(folder, "simulate", Simulation)
    if found is None or found.frames < frames:
        return None
    return found.poses if bodies is None or found.poses.shape[1:] == (bodies, 7) else None
