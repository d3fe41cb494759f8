"""What the next simulation will meet, said when an edit is made: from the files alone, without building the scene."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fluidlift.errors import FluidliftError, InputRejected
from fluidlift.io.asset_folder import load_asset, read_parameters
from fluidlift.io.asset_paths import asset_file
from fluidlift.io.scene import SceneEdits
from fluidlift.messages import Notice
from fluidlift.scene.reshaping import Asked, changed_parameters, slow_edits
from fluidlift.scene.splat_files import BYTES_PER_SPLAT, frame_files
from fluidlift.types import FluidAsset, Grid, matrix_from_quat

if TYPE_CHECKING:
    from fluidlift.io.obstacles import Obstacle


def ahead(folder: Path, manifest: dict[str, Any], frames: int, interval: float, splats: int) -> str:
    """What a simulation will take, in one line that is told before it begins: frames, disk, time, and what goes for it.

    Args:
        folder: of the asset.
        manifest: of the asset, as the last simulation left it.
        frames: to simulate.
        interval: s between them.
        splats: in each of them.
    """
    text = f"simulating {frames} frames ({frames * interval:.3g} s)"
    there = len(frame_files(folder))
    if there > frames:
        text += f" in place of the {there} on disk"
    text += f": about {max(frames * splats * BYTES_PER_SPLAT / 1e6, 1):.0f} MB of disk"
    facts = manifest.get("metrics", {}).get("stages", {}).get("simulate", {})
    done, seconds = manifest.get("simulation", {}).get("frames"), facts.get("seconds")
    if isinstance(seconds, int | float) and isinstance(done, int) and done > 1 and seconds > 0:
        text += f", and {in_time(seconds * frames / done)} if each takes as long as the last time"
    return text


def in_time(seconds: float) -> str:
    """About how long, in words."""
    if seconds < 90:
        return f"{max(seconds, 1):.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def outlook(folder: Path, manifest: dict[str, Any], edits: SceneEdits, grid: Grid) -> list[Notice]:
    """Warnings about edits that take very long, and about floating bodies that begin inside the ground.

    Args:
        folder: of the asset; of one whose files cannot be read nothing is said: the simulation will.
        manifest: of the asset.
        edits: of its scene.yaml.
        grid: that it was lifted on.
    """
    try:
        return _slow(folder, manifest, edits, grid) + _buried(folder, edits)
    except (FluidliftError, OSError):
        return []


def _slow(folder: Path, manifest: dict[str, Any], edits: SceneEdits, grid: Grid) -> list[Notice]:
    fitted = read_parameters(asset_file(folder, "parameters.json"))[0]
    changes = dict(edits.parameters)
    step = changes.pop("time_step", None)
    # the frames on disk may have another rate than the clip, and keep it
    interval = (manifest.get("simulation") or manifest).get("frame_interval", manifest["frame_interval"])
    asked = Asked(
        fitted.updated(changes), interval, grid, edits.emitters, edits.obstacles, edits.inflow, step,
        changed_parameters(fitted, changes),
    )  # fmt: skip
    try:
        return slow_edits(asked)
    except InputRejected as error:  # the edit stands, and can be undone or weakened
        return [Notice("scene-refused", f"this scene cannot be simulated as it is: {error}")]


def _buried(folder: Path, edits: SceneEdits) -> list[Notice]:
    """Floating bodies that begin more than a cell deep in the ground, which the terrain's own edits may move."""
    free = [o for o in edits.obstacles if o.motion == "free"]
    if not free or edits.terrain:
        return []
    asset = load_asset(folder)
    return [Notice("obstacle-in-ground", told) for o in free if (told := _depth_told(o, asset))]


def _depth_told(obstacle: Obstacle, asset: FluidAsset) -> str:
    from fluidlift.numerics.sampling import sample_nodes
    from fluidlift.scene.open_water import open_water

    terrain, grid = asset.terrain, asset.grid
    points = np.asarray(obstacle.mesh.vertices, np.float64) @ matrix_from_quat(obstacle.rotation).T + obstacle.position

    def gap(rise: float) -> float:
        at = points + [0.0, 0.0, rise]
        at = at[grid.contains(at)]  # beside and above the box nothing is known
        return float(sample_nodes(terrain.signed_distance, grid, at).min()) if len(at) else np.inf

    deep = -gap(0.0)
    if deep <= grid.spacing:
        return ""
    height = np.ptp(points[:, 2]) + grid.high[2] - grid.low[2]
    rises = np.arange(grid.spacing, height + grid.spacing, grid.spacing)
    free = next((r for r in rises if gap(float(r)) >= 0.0), None)
    h = grid.spacing
    place = place_told(obstacle.position, h)
    told = f"{obstacle.line}: obstacle '{obstacle.name}' at ({place}) m begins {deep:.2g} m inside the ground"
    if free is not None:
        told += f": it is free there from a height of {place_told([obstacle.position[2] + free], h)} m"
    x, y, z = open_water(asset, float(np.ptp(points[:, :2], axis=0).max()))
    return told + f"; around ({place_told([x, y], h)}) is open fluid up to {place_told([z], h)} m"


def placed(place: Iterable[float], step: float) -> list[float]:
    """A place, m, to the decimal that is no coarser than a step, m: the same wherever the origin lies, which of a
    surveyed camera may be far away."""
    decimals = math.ceil(-math.log10(step) - 1e-9)
    return [round(float(c), decimals) + 0.0 for c in place]


def place_told(place: Iterable[float], cell: float) -> str:
    """A place, m, in words: to a tenth of a cell (m) or a little finer."""
    return ", ".join(f"{c:.12g}" for c in placed(place, 0.1 * cell))
