"""Single frames for viewers on the web: splats as SPZ, and one frame with its ground and camera as glTF."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fluidlift.export.job import ExportJob, ExportOutcome
from fluidlift.export.whitewater import whitewater_of
from fluidlift.io.frames import FIRST_FRAME

if TYPE_CHECKING:
    from collections.abc import Callable

    from fluidlift.io.frames import FluidFrame

HERO, SURFACE = "hero.glb", "surface.glb"


def hero_of(picked: range) -> int:
    """The frame of a range that stands for all: the middle one."""
    return picked[len(picked) // 2]


def write_hero(job: ExportJob, surfaced: Callable[[range], FluidFrame]) -> ExportOutcome:
    """One frame as hero.glb (splats, terrain, camera) and surface.glb (the surface as a mesh instead of the splats, and
    white water as points).

    Args:
        job: whose middle frame is taken.
        surfaced: gives a frame with its surface.
    """
    from fluidlift.io.export_gltf import write_gltf

    k = hero_of(job.picked)
    frame = surfaced(range(k, k + 1))
    ground = {"terrain": job.asset.terrain.mesh}
    write_gltf(job.out / HERO, gaussians=frame.gaussians, meshes=ground, camera=job.asset.camera)
    written = HERO
    if frame.surface is not None and len(frame.surface.faces):
        write_gltf(job.out / SURFACE, meshes=ground | {"surface": frame.surface}, camera=job.asset.camera,
                   whitewater=whitewater_of(frame))  # fmt: skip
        written += f" (splats) and {SURFACE} (mesh)"
    told = f"glTF holds one instant: frame {FIRST_FRAME + k} as {written}; another with --frames"
    return ExportOutcome((told,), (), {"frames": 1, "first": FIRST_FRAME + k})
