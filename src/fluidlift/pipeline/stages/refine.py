"""The stage that makes the rest Gaussians: generate per frame, refine, prune, unite, fill."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.pipeline.given_body import placed_bodies
from fluidlift.pipeline.inputs import GivenFile
from fluidlift.pipeline.settings import RefineSettings
from fluidlift.pipeline.work import Work
from fluidlift.seams import Rasterizer
from fluidlift.shape import generate, occluders
from fluidlift.types import (
    CellType,
    Gaussians,
    Label,
    PinholeCamera,
    Setting,
    VideoClip,
    concatenate,
    kind_of,
    sh_from_rgb,
)
from fluidlift.types.stages import Flow, Geometry, Read, Refined, Segmentation

if TYPE_CHECKING:
    from fluidlift.shape.refine import RefineResult

KEPT = 0.6
"""part of its size that a splat of the inside keeps at least: at 0.3 the first frame is a little cleaner, but once the
surface is drawn apart, dark dots of what lies below show between its splats"""

WHOLE = 6
"""splats that a cell of the body may take inside, whatever the limit for all of it: with less than three quarters of
the usual eight it holds less than its own mass, and a large shallow body sags as soon as it moves"""

DROPS = 0.125
"""share of what fills a cell that fills one of spray: one particle per cell is enough to fly, where there is no
pressure"""

LATER = 5
"""how much fewer steps the frames after the first take, as they start from the last"""


@dataclass(frozen=True)
class _Seen:
    """What the bodies are made of."""

    frames: np.ndarray | occluders.Pictures
    """u8 [T,H,W,3]"""
    fluid: np.ndarray
    """bool [T,H,W]"""
    flow: np.ndarray
    """px, [T-1,H,W,2]"""
    geometry: Geometry
    config: RefineSettings
    work: Work


def refine(
    read: Read, flow: Flow, segmentation: Segmentation, geometry: Geometry, bodies: GivenFile | None,
    config: RefineSettings, *, work: Work,
) -> Refined:  # fmt: skip
    """Generate per frame, refine on the first, prune, unite, fill.

    Args:
        read: the clip.
        flow: of it.
        segmentation: of it.
        geometry: of the body.
        bodies: folder of Gaussians, the user's or a generator's; None: the embedded generator makes them.
        config: how many, how fine.
        work: told how far the refinement is.

    Raises:
        InputRejected: too little fluid for a body.
    """
    from fluidlift.shape.fill import fill
    from fluidlift.shape.off_picture import continued
    from fluidlift.shape.prune import prune
    from fluidlift.shape.unite import unite

    clip, labels, c, camera, setting = read.clip, segmentation.labels, config, geometry.camera, geometry.setting
    start, united, depth = geometry.rest_frame, geometry.united_frames, geometry.depth
    h = setting.terrain.grid.spacing
    fluid, frames, mask = labels.fluid, clip.frames, geometry.mask
    if geometry.hidden is not None:
        behind = occluders.HiddenFluid.of(geometry.hidden, mask)
        fluid, frames, mask = fluid | behind.hidden, behind.pictures(frames), mask | behind.hidden
    seen = _Seen(frames, fluid, flow.flow.displacement, geometry, config, work)
    made, fitted = _bodies(seen, bodies)
    colours = generate.fluid_colour_frame(frames[start], fluid[start])
    hull = generate.hull_gaussians(colours, setting, camera, seed=config.seed)
    step = max(0.35 * h, 0.6 * c.stride * _pixel(depth, camera))
    # what another frame has nearer to the camera would hide the picture of the first
    others = [generate.beneath_front(b, depth, fluid[start], camera, smallest=1.0, drop_above=True) for b in made[1:]]
    front = unite([b for b in (made[0], *others) if len(b)], spacing=step, whole_first=True)
    # what is seen is kept before what is hidden
    front = _bounded(front, int(0.75 * c.max_gaussians), config.seed)
    hull = _bounded(hull, c.max_gaussians - len(front), config.seed)
    shown, _ = prune(_outside_solid(front, setting), min_opacity=0.05, max_stretch=12.0)
    beyond, hull = continued(shown, _outside_solid(hull, setting), setting, camera)
    beyond = _bounded(_outside_solid(beyond, setting), c.max_gaussians - len(shown) - len(hull), config.seed)
    shell = concatenate([shown, beyond, hull])
    least = WHOLE * int((setting.cell_types == CellType.FLUID).sum())
    added = fill(
        shell, spacing=h / 2, rays=c.rays, rng=np.random.default_rng(config.seed),
        max_added=max(c.max_gaussians - len(shell), least), closed_below=setting.terrain,
    )  # fmt: skip
    hull = shell.select(slice(len(shown), None))
    # what the picture contradicts goes: cells reach a little before the visible surface and beyond the silhouette
    allowed = (labels.labels[start : start + united] != Label.BACKGROUND).any(axis=0) | mask
    if geometry.rocks is not None and setting.pool_level is not None:  # the near wall of a vessel that is looked into
        allowed = allowed | geometry.rocks
    inside = [hull, _outside_solid(added, setting)]
    inside = [generate.beneath_front(part, depth, mask, camera, smallest=KEPT, drop_above=True) for part in inside]
    hull, added = (_not_contradicted(part, geometry, allowed) for part in inside)
    if kind_of(geometry.kind).rises_from_pool:
        added = _as_spray(added, geometry, config.seed)
    if kind_of(geometry.kind).starts_at_rest:  # its sides tell nothing of the inside that is seen once it spreads
        colour = _later_colour(clip, fluid, start)
        hull, added = (replace(part, sh=sh_from_rgb(np.tile(colour, (len(part), 1)))) for part in (hull, added))
    body = concatenate([shown, hull, added])
    if len(body) < 50:
        raise InputRejected(
            f"the body of the fluid has only {len(body)} Gaussians", "more fluid in the picture",
            "check the mask in the report, or raise --max-size",
        )  # fmt: skip
    how = (None, None, True) if fitted is None else (fitted.psnr_before, fitted.psnr_after, fitted.kept)
    return Refined(body, len(front), len(hull), len(added), len(front) - len(shown), *how)


def _as_spray(inside: Gaussians, geometry: Geometry, seed: int) -> Gaussians:
    """What fills a body, with a share of it above its pool: drops far apart."""
    grid, level = geometry.setting.terrain.grid, geometry.setting.surface_height
    if level is None:
        return inside
    at = np.clip(grid.cell_of(inside.means), 0, np.asarray(grid.shape) - 1)
    flies = inside.means[:, 2] > np.asarray(level)[at[:, 0], at[:, 1]]
    kept = np.random.default_rng(seed).random(len(inside)) < DROPS
    return inside.select(~flies | kept)


def _later_colour(clip: VideoClip, fluid, start: int) -> np.ndarray:
    """sRGB in [0, 1] that the fluid usually has after its first frame, float32 [3]."""
    later = np.unique(np.linspace(start + 1, len(clip) - 1, 8).round().astype(int))
    seen = np.concatenate([clip.frames[t][fluid[t]][::7] for t in later])
    return (np.median(seen, axis=0) / 255.0).astype(np.float32)


def _bodies(seen: _Seen, given: GivenFile | None) -> tuple[list[Gaussians], RefineResult | None]:
    """One body per united frame, each refined against its picture; those after the first start from the last. And how
    the first came out of that."""
    from fluidlift.backends.gsplat_rasterizer import best_rasterizer
    from fluidlift.shape.prune import prune

    g, pictures, fluid = seen.geometry, seen.frames, seen.fluid
    frames = list(range(g.rest_frame, g.rest_frame + g.united_frames))
    if given is not None:
        placed = placed_bodies(g, given.path, frames)
        # strays in front of the fluid would count as its shape, which the refinement must not change
        bodies = [prune(b, min_opacity=0.05, max_stretch=12.0)[0] for b in placed]
    else:
        stride = seen.config.stride
        bodies = [generate.front_gaussians(pictures[t], fluid[t], g.depth, g.camera, stride=stride) for t in frames]
    draws = best_rasterizer(seen.config.rasterizer, seen.work.warn)
    first, fitted = _refined(seen, bodies[0], draws)
    return [first, *_followed(seen, first, bodies[1:], frames[1:], draws)], fitted


def _followed(
    seen: _Seen, last: Gaussians, bodies: list[Gaussians], frames: list[int], draws: Rasterizer
) -> list[Gaussians]:
    """Bodies of the frames after the first, each from the one before."""
    from fluidlift.shape.warm_start import follow

    pictures, fluid, camera, c = seen.frames, seen.fluid, seen.geometry.camera, seen.config
    if c.refine_iterations == 0 or len(last) == 0:
        return bodies
    depth, out = seen.geometry.depth, []
    for t, fresh in zip(frames, bodies, strict=True):
        if not fluid[t].any() or len(fresh) == 0:
            out.append(fresh)
            continue
        found = follow(
            last, fresh, pictures[t], fluid[t], camera, motion=np.asarray(seen.flow[t - 1], np.float32),
            depths=(depth, depth), iterations=max(c.refine_iterations // LATER, 1), seed=c.seed,
            max_gaussians=max(int(1.5 * len(fresh)), 1000), rasterizer=draws,
        )  # fmt: skip
        last = generate.bounded_colours(found.gaussians, pictures[t], camera)
        out.append(last)
    return out


def _refined(seen: _Seen, front: Gaussians, draws: Rasterizer) -> tuple[Gaussians, RefineResult | None]:
    """A body optimised against the picture of the rest frame, and how; None: as it was."""
    from fluidlift.shape.refine import refine as refine_view

    c, start, camera = seen.config, seen.geometry.rest_frame, seen.geometry.camera
    if c.refine_iterations == 0 or not len(front):
        return front, None
    picture = seen.frames[start]
    found = refine_view(
        front, picture, seen.fluid[start], camera, iterations=c.refine_iterations, seed=c.seed,
        max_gaussians=max(int(1.5 * len(front)), 1000), rasterizer=draws, progress=seen.work.step,
    )  # fmt: skip
    return generate.bounded_colours(found.gaussians, picture, camera), found


def _pixel(depth: np.ndarray, camera: PinholeCamera) -> float:
    """Median size of a pixel on the fluid, m."""
    return float(np.median(depth[depth > 0]) / camera.focal[0])


def _outside_solid(g: Gaussians, setting: Setting) -> Gaussians:
    """Those whose centre is in the box and not inside the terrain."""
    from fluidlift.numerics.sampling import sample_nodes

    grid = setting.terrain.grid
    inside = grid.contains(g.means, margin=1e-6)
    g = g.select(inside)
    distance = sample_nodes(setting.terrain.signed_distance, grid, g.means)
    return g.select(distance > -0.25 * grid.spacing)


def _not_contradicted(inside: Gaussians, geometry: Geometry, allowed: np.ndarray) -> Gaussians:
    """What is within the silhouette; of standing water, what lies a cell below its surface as well.

    A level surface that ends at a near shore has water behind that shore, where the picture shows the ground before it.
    """
    setting, camera = geometry.setting, geometry.camera
    deep = np.zeros(len(inside), bool)
    if kind_of(geometry.kind).is_standing_water and setting.surface_height is not None:
        level = float(np.nanmedian(setting.surface_height))
        deep = inside.means[:, 2] < level - setting.terrain.grid.spacing
    seen = generate.within_silhouette(inside.select(~deep), allowed, camera, smallest=KEPT)
    return concatenate([inside.select(deep), seen]) if deep.any() else seen


def _bounded(g: Gaussians, most: int, seed: int) -> Gaussians:
    """A random subset where there are too many; each stands for more fluid then."""
    if len(g) <= most:
        return g
    keep = np.sort(np.random.default_rng(seed).permutation(len(g))[:most])
    return g.select(keep)
