"""The page to share: which frames and how many splats it takes, so that it stays of a size that people send."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fluidlift.export.job import ExportJob, ExportOutcome
from fluidlift.io.frames import FIRST_FRAME
from fluidlift.messages import Notice
from fluidlift.present.looping import FAINTEST
from fluidlift.scene.splat_files import frames_of
from fluidlift.types import Gaussians, PinholeCamera, Similarity3, concatenate, matrix_from_quat, sh_from_rgb

if TYPE_CHECKING:
    from fluidlift.io.frames import MovingMesh
    from fluidlift.io.page_frames import Quantization

MOST_SPLATS = 100_000
"""of a frame: what a phone and a laptop without a graphics card still draw"""
MOST_BYTES = 64e6
"""of the page: what can still be sent and opens within seconds"""
SLOWEST = 12.0
"""frames per second down to which frames are left out before splats are"""
FEWEST = 10_000
"""splats down to which they are left out"""
SAMPLED = 4
"""frames that are encoded to know the size of all"""
POSTER = 960
"""px, longer side"""
_SPREAD = np.uint64(2654435761)
"""Knuth's multiplier: neighbouring ids become far ones, so that thinning leaves no holes"""


@dataclass(frozen=True)
class PageContent:
    """What of an asset goes into the page."""

    share: float
    """of the splats"""
    every: int
    """one frame of so many"""


def write_page_of(job: ExportJob) -> ExportOutcome:
    """page.html in the folder, or the .html file that was named."""
    from fluidlift.export.usd import bodies_of
    from fluidlift.io.export_page import PageScene, write_page
    from fluidlift.look.scenery import LIGHT
    from fluidlift.look.vessel import glass_of

    first, ids = next(_drawn(job, job.picked[:1]))
    plan = _plan(job, len(first))
    picked = job.picked[:: plan.every]
    bodies, missing = bodies_of(job.folder, picked)
    warnings = [*_warnings(plan, len(first), job, len(picked)), *missing]

    def frames(told: bool) -> Iterator[tuple[Gaussians, np.ndarray]]:
        for done, (g, number) in enumerate(_drawn(job, picked)):
            if told:
                job.progress.update(done, len(picked))
            yield thinned(_seen(g, job.asset.camera), number, plan.share)

    held = _range_of(g for g, _ in frames(False))
    shown = thinned(first, ids, plan.share)[0]
    scene = PageScene(
        title=job.folder.stem, camera=job.asset.camera, target=middle_of_view(job.asset.camera, first),
        interval=job.interval * plan.every, numbers=tuple(FIRST_FRAME + k for k in picked),
        poster=_poster(job, first, bodies), terrain=job.asset.terrain.mesh, warnings=tuple(warnings),
        bodies=tuple(bodies), sun=tuple((LIGHT / np.linalg.norm(LIGHT)).tolist()),
        terrain_opacity=glass_of(job.asset.kind, job.asset.terrain) or 1.0,
        facts=(f"{len(shown):,} splats".replace(",", " "), f"{len(picked)} frames"),
    )  # fmt: skip
    path, size = write_page(page_path(job.out), frames(True), held, scene)
    words = (f"{path.name}: {size / 1e6:.1f} MB, {held.slots} splats at most, {len(picked)} frames; opens in any "
             "browser, without a network",)  # fmt: skip
    return ExportOutcome(words, tuple(warnings), {"bytes": size, "frames": len(picked), "file": str(path)})


def _drawn(job: ExportJob, picked: range) -> Iterator[tuple[Gaussians, np.ndarray]]:
    """The splats of each frame that can be seen, with their ids: those that the page draws and its limits count."""
    for g, ids, _ in frames_of(job.folder, picked):
        seen = g.opacities >= FAINTEST
        yield g.select(seen), ids[seen]


def thinned(gaussians: Gaussians, ids: np.ndarray, share: float) -> tuple[Gaussians, np.ndarray]:
    """About a share of the splats, the same ids in every frame, grown so that they fill the same room."""
    if share >= 1.0:
        return gaussians, ids
    mixed = (np.asarray(ids).astype(np.uint64) * _SPREAD) & np.uint64(0xFFFFFFFF)
    keep = mixed < np.uint64(share * 2**32)
    g = gaussians.select(keep)
    return replace(g, scales=g.scales * np.float32(share ** (-1 / 3))), ids[keep]


def middle_of_view(camera: PinholeCamera, gaussians: Gaussians) -> tuple[float, float, float]:
    """World point (m) in the middle of the picture, as far away as half of the splats are."""
    z = camera.project(gaussians.means)[1]
    ahead = z[z > 0]
    depth = float(np.median(ahead)) if len(ahead) else 1.0
    x, y, z = (camera.position + depth * camera.camera_from_world.rotation[2]).tolist()
    return x, y, z


def _seen(gaussians: Gaussians, camera: PinholeCamera) -> Gaussians:
    """Colours without direction: those that the clip's camera sees."""
    if gaussians.sh.shape[1] == 1:
        return gaussians
    from fluidlift.look.project import view_colors

    return replace(gaussians, sh=sh_from_rgb(np.clip(view_colors(gaussians, camera), 0.0, 1.0)))


def _plan(job: ExportJob, splats: int) -> PageContent:
    """Splats at most `MOST_SPLATS`; then, by the size of the first frames, frames left out, and splats where that would
    not do."""
    from fluidlift.io.export_page import BASE64
    from fluidlift.io.page_frames import FrameEncoder

    share = min(1.0, MOST_SPLATS / max(splats, 1))
    sample = [thinned(g, i, share) for g, i in _drawn(job, job.picked[:SAMPLED])]
    encoder = FrameEncoder(_range_of(g for g, _ in sample))
    sizes = [BASE64 * len(encoder.encode(*s)) for s in sample]
    excess = (sizes[0] + sizes[-1] * (len(job.picked) - 1)) / MOST_BYTES
    every = min(int(np.ceil(excess)), max(1, int(1.0 / (job.interval * SLOWEST)))) if excess > 1 else 1
    if excess / every > 1:
        share = min(max(share * every / excess, FEWEST / max(splats, 1)), share)
    return PageContent(share, every)


def _range_of(frames: Iterator[Gaussians]) -> Quantization:
    from fluidlift.io.page_frames import Quantization

    return Quantization.of(frames)


def _warnings(plan: PageContent, splats: int, job: ExportJob, frames: int) -> list[Notice]:
    """What was left out, in words."""
    told = []
    if plan.share < 1.0:
        told.append(
            Notice(
                "page-splats-thinned",
                f"{100 * plan.share:.0f} % of {splats} splats are in the page, grown to fill the same room",
            )
        )
    if plan.every > 1:
        rate = 1.0 / (job.interval * plan.every)
        told.append(
            Notice(
                "page-frames-thinned",
                f"{frames} of {len(job.picked)} frames are in the page, at {rate:.3g} per second; a shorter piece at "
                "full rate with --frames",
            )
        )
    return told


def _poster(job: ExportJob, first: Gaussians, bodies: list[MovingMesh]) -> np.ndarray:
    """u8 [h,w,3]: the first frame over its ground, from the clip's camera."""
    from fluidlift.look.rasterize import render
    from fluidlift.look.scenery import mesh_surfels, terrain_surfels
    from fluidlift.look.vessel import glass_of

    camera = job.asset.camera
    factor = min(1.0, POSTER / max(camera.size))
    camera = camera.resized((max(1, round(camera.size[0] * factor)), max(1, round(camera.size[1] * factor))))
    solids = [
        mesh_surfels(b.mesh, job.asset.grid.spacing).transformed(
            Similarity3(1.0, matrix_from_quat(b.orientations[0]), b.positions[0])
        )
        for b in bodies
    ]
    ground = terrain_surfels(job.asset.terrain, glass=glass_of(job.asset.kind, job.asset.terrain))
    scene = concatenate([ground, *solids, first])
    picture = render(scene, camera, background=(0.08, 0.09, 0.11)).image
    return (255 * np.clip(picture, 0, 1) + 0.5).astype(np.uint8)


def page_path(out: Path) -> Path:
    """Where the page of an output name goes."""
    return out if out.suffix.lower() == ".html" else out / "page.html"
