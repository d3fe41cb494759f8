"""Which frames on disk still show what scene.yaml says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from fluidlift.io.asset_folder import load_asset, read_manifest
from fluidlift.io.checkpoint import differing_parts, read_parts
from fluidlift.io.obstacles import color_mark
from fluidlift.io.scene import SceneEdits
from fluidlift.io.scene_look import Look
from fluidlift.io.stage_cache import owner_of
from fluidlift.pipeline.recall import footage_of_asset, rest_frame_of
from fluidlift.pipeline.resimulate import SECOND_HALF_SECTIONS, settings_of
from fluidlift.pipeline.scene import Scene, SimulationRequest, scene_of
from fluidlift.pipeline.splat_files import checkpoint_file
from fluidlift.pipeline.stages.simulate import state_parts


def stale_parts(folder: Path, edits: SceneEdits, *, meshes: Path | None = None) -> set[str]:
    """What would have to be done anew for the frames to show an asset's scene.yaml.

    Args:
        folder: of the asset.
        edits: its scene.yaml, read.
        meshes: folder of its mesh files; None: the asset.

    Returns:
        "simulate" where the particles would go another way, or further; "look" where they would only be drawn
        otherwise; both, or neither. Frames of which nothing is known any more count as stale.

    Raises:
        InputRejected: no asset, or a scene that does not fit it.
    """
    manifest = read_manifest(folder)
    done = manifest.get("simulation")
    if not done:
        return {"simulate", "look"}
    found = set()
    if done.get("look", Look().mark(folder)) != edits.look.mark(folder) | color_mark(edits.obstacles):
        found.add("look")
    if _moved(folder, edits, manifest, meshes):
        found.add("simulate")
    return found


def _moved(folder: Path, edits: SceneEdits, manifest: dict[str, Any], meshes: Path | None) -> bool:
    """Whether a simulation of scene.yaml would give other frames, or more."""
    done, parts, of_state = manifest["simulation"], None, checkpoint_file(folder).is_file()
    if of_state:
        _, parts = read_parts(checkpoint_file(folder))
    elif owner_of(folder, "simulate") is not None:  # a closed loop has no checkpoint; frames half written, no owner
        parts = done.get("parts")
    if not isinstance(parts, dict):
        return True
    scene = scene_now(folder, manifest, meshes)
    if differing_parts(parts, state_parts(scene) if of_state else scene.parts):
        return True
    more = done["frames"] > scene.frames
    return done["frames"] < scene.frames or (more and edits.duration is not None)


def scene_now(folder: Path, manifest: dict[str, Any], meshes: Path | None) -> Scene:
    """The scene that `resimulate` would simulate, at the frame rate and with the seed of the frames on disk.

    Raises:
        InputRejected: a scene that does not fit.
    """
    done = manifest["simulation"]
    config = settings_of(manifest, (), {"seed": done.get("seed")}, sections=SECOND_HALF_SECTIONS, work="a simulation")
    footage, interval = footage_of_asset(folder, manifest), done["frame_interval"]
    fps = None if interval == manifest["frame_interval"] else 1.0 / interval
    request = SimulationRequest(fps=fps, meshes=meshes)
    start = rest_frame_of(manifest, footage)
    scene = scene_of(load_asset(folder), folder, request, config, footage=footage, start=start)
    return replace(scene, interval=interval)  # 1 / fps may be another by its last bit
