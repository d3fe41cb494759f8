"""Values of an asset's earlier runs, where they are still in its folder work/."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.config.of_asset import SECOND_HALF_SECTIONS, settings_of
from fluidlift.io.kept_values import last_value, recalled
from fluidlift.scene.build import Scene, SimulationRequest, scene_of
from fluidlift.scene.footage import Footage, footage_of
from fluidlift.types import FluidAsset
from fluidlift.types.stages import Simulation


def footage_of_asset(folder: Path, manifest: dict[str, Any]) -> Footage | None:
    """The clip that an asset comes from; None where it is no longer at hand."""
    found = [recalled(folder, manifest, name) for name in ("read", "segment", "geometry")]
    return None if any(value is None for value in found) else footage_of(*found)


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
