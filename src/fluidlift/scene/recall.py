"""Values of an asset's earlier runs, where they are still in its folder work/."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.config.of_asset import SECOND_HALF_SECTIONS, settings_of
from fluidlift.io.kept_values import kept_value, last_value
from fluidlift.scene.build import Scene, SimulationRequest, scene_of
from fluidlift.scene.footage import Footage, footage_of
from fluidlift.types import FluidAsset
from fluidlift.types.stages import (
    Fit,
    Flow,
    Geometry,
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
CORRECTED = {"segment": "correct"}
"""stages whose value is replaced by that of another where that was run: labels with a person's regions over them"""


def footage_of_asset(folder: Path, manifest: dict[str, Any]) -> Footage | None:
    """The clip that an asset comes from; None where it is no longer at hand."""
    found = [recalled(folder, manifest, name) for name in ("read", "segment", "geometry")]
    return None if any(value is None for value in found) else footage_of(*found)


def recalled(folder: Path, manifest: dict[str, Any], name: str) -> Any:
    """The value of one stage of `OF_CLIP` that an asset was made from; None where it is gone."""
    keys = stage_keys(manifest)
    stage = that_counts(name, keys)
    found = None if stage not in keys else kept_value(folder, stage, keys[stage], OF_CLIP[name])
    return None if found is None else found[0]


def that_counts(name: str, keys: dict[str, str]) -> str:
    """The stage, of those with a key, whose value counts as that of a stage."""
    return CORRECTED[name] if CORRECTED.get(name) in keys else name


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


def simulated_scene(folder: Path, asset: FluidAsset, manifest: dict[str, Any]) -> Scene:
    """The scene whose frames lie in an asset's folder: at their rate, in the channel as long as it was for them.

    Raises:
        InputRejected: a scene.yaml that does not fit.
    """
    played = manifest.get("simulation", {})
    interval = float(played.get("frame_interval", asset.interval))
    longer = float(played.get("extended_downstream", 0.0))
    config = settings_of(manifest, (), {}, sections=SECOND_HALF_SECTIONS, work="frames that are there")
    request = SimulationRequest(fps=1.0 / interval, extend_downstream=longer)
    return scene_of(asset, folder, request, config, footage=None, start=0)
