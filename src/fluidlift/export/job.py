"""What an export is asked for, and what its writers share."""

from __future__ import annotations

import difflib
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.messages import Notice
from fluidlift.present.surface_waves import SurfaceWaves
from fluidlift.seams import Progress
from fluidlift.types import FluidAsset, Similarity3

OF_CLIP = ("camera", "flow", "flo", "masks")
"""formats that hold what was found in the clip; no simulated frame is needed for them"""
PICTURES = ("flow", "flo", "masks")
"""formats in the pixels of the clip, which have no axes"""
FORMATS = ("mesh", "obj", "splats", "spz", "gltf", "html", "vdb", "usd", "usd-clips", *OF_CLIP)
AXES = ("z", "y")
OWN_AXES = {"vdb": "z", "html": "z", "camera": "z", "gltf": "y", "spz": "y", "flow": "z", "flo": "z", "masks": "z"}
"""the up axis of formats whose axes and unit (metres) are theirs, whatever is asked for"""
RATE_SLACK = 0.02
"""relative error of a frame rate that counts as rounding (23.98 for 24000/1001)"""


@dataclass(frozen=True)
class ExportRequest:
    """What is written, and how."""

    to: str
    """mesh: surface as PLY with colours and velocities; obj: the same as OBJ, without velocities; splats: Gaussians as
    splat viewers take them; spz: the same, small; gltf: one frame as GLB; html: a page that plays offline; vdb:
    OpenVDB with velocity, density and, of liquids, the level set; usd: one OpenUSD file with surface, splats, terrain
    and camera; usd-clips: the same with a file per frame; camera: JSON; flow, flo: motion in the clip as EXR or .flo;
    masks: the fluid in the clip as PNG"""
    up_axis: str = "z"
    """z or y, of mesh, obj, splats and usd; the others have their own"""
    meters_per_unit: float = 1.0
    """m that one unit of the files is; of mesh, obj, splats and usd"""
    frames: tuple[int, int] | None = None
    """first and last number, from 1001; None: all"""
    fps: float | None = None
    """frames per second of the files: those of the asset, or every second, third ... of them; None: all"""


@dataclass(frozen=True)
class ExportJob:
    """One export on its way."""

    folder: Path
    """of the asset"""
    out: Path
    asset: FluidAsset
    request: ExportRequest
    picked: range
    """frames of the asset that are written, from 0"""
    interval: float
    """s between those"""
    progress: Progress
    whitewater: bool = False
    """whether the frames were simulated with white water"""
    waves: SurfaceWaves | Notice | None = None
    """on the surface, or why there are none; None: none are asked for"""

    @property
    def numbers(self) -> range:
        """Of the written files, from 0: without gaps, from the first that was picked."""
        return range(self.picked.start, self.picked.start + len(self.picked))

    @property
    def place(self) -> Similarity3:
        """From the world to the axes and units that are asked for."""
        from fluidlift.io.ply import AXES as ROTATIONS

        return Similarity3(1.0 / self.request.meters_per_unit, ROTATIONS[f"{self.request.up_axis}_up"], np.zeros(3))

    @property
    def unit(self) -> str:
        """Axes and units in words, for the comments of files."""
        return f"{self.request.up_axis} up, one unit is {self.request.meters_per_unit:g} m"


@dataclass(frozen=True)
class ExportOutcome:
    """What a writer has to tell."""

    words: tuple[str, ...] = ()
    warnings: tuple[Notice, ...] = ()
    facts: dict[str, Any] | None = None


def checked(request: ExportRequest, out: Path) -> None:
    """Raise `InputRejected` for what no asset could be written as, before anything is read."""
    to = request.to
    if to not in FORMATS:
        near = difflib.get_close_matches(to, FORMATS, 1)
        raise InputRejected(f"no format '{to}'", ", ".join(FORMATS), f"did you mean {near[0]}?" if near else "")
    if request.up_axis not in AXES:
        raise InputRejected(f"an up axis '{request.up_axis}'", " or ".join(AXES))
    if to in OWN_AXES and (request.up_axis != "z" or request.meters_per_unit != 1.0):
        raise InputRejected(
            f"{to} with other axes or units",
            f"{OWN_AXES[to]} up and metres",
            "leave out --up-axis and --meters-per-unit",
        )
    if not (np.isfinite(request.meters_per_unit) and 1e-6 <= request.meters_per_unit <= 1e6):
        raise InputRejected(f"{request.meters_per_unit:g} m per unit", "1e-6 to 1e6, such as 0.01 for centimetres")
    if request.fps is not None and to in OF_CLIP:
        raise InputRejected(f"{to} at another frame rate", "the clip's own", "leave out --fps")
    if to != "html" and out.suffix.lower() == ".html" and not out.is_dir():
        raise InputRejected(f"{to} as '{out.name}'", "a folder", "add --to html")
    if to == "html" and out.suffix.lower() == ".html":
        if out.is_dir():
            raise InputRejected(f"'{out.name}', which is a folder", "a file name or another folder")
    elif out.exists() and not out.is_dir():
        raise InputRejected(f"'{out.name}', which is a file", "a folder")


def every(fps: float | None, interval: float) -> int:
    """How many frames of an asset (s apart) one frame of the files stands for.

    Raises:
        InputRejected: a rate that is not that of the asset divided by a whole number. Such frames were never
            simulated, and splats are not blended between frames.
    """
    if fps is None:
        return 1
    own = 1.0 / interval
    if not (math.isfinite(fps) and fps > 0):
        raise InputRejected(f"--fps {fps:g}", f"a positive number, such as {own:g}")
    step = max(round(own / fps), 1)
    if abs(own / step - fps) > RATE_SLACK * fps:
        raise InputRejected(
            f"--fps {fps:g} of frames at {own:.5g} per second", f"{own:.5g}, {own / 2:.5g}, {own / 3:.5g} and so on",
            f"simulate at that rate: fluidlift sim ASSET --fps {fps:g}",
        )  # fmt: skip
    return step


def as_simulated(folder: Path, asset: FluidAsset, manifest: dict[str, Any]) -> FluidAsset:
    """The asset on the ground that its frames flow over: scene.yaml may have moved, twisted, replaced or lengthened it.

    Raises:
        InputRejected: a scene.yaml that does not fit.
    """
    from fluidlift.io.scene import read_edits
    from fluidlift.scene.recall import simulated_scene

    played, edits = manifest.get("simulation", {}), read_edits(folder)
    longer = float(played.get("extended_downstream", 0.0))
    if not (edits.terrain or edits.emitters or longer > 0):
        return asset
    scene = simulated_scene(folder, asset, manifest)
    return replace(
        asset, terrain=scene.terrain, grid=scene.terrain.grid, cell_types=scene.cell_types, velocity=scene.velocity
    )


def write_terrain(job: ExportJob) -> None:
    """terrain.glb beside the numbered files, where there is a terrain."""
    from fluidlift.io.export_mesh import write_glb

    if len(job.asset.terrain.mesh.faces):
        write_glb(job.out / "terrain.glb", job.asset.terrain.mesh)
