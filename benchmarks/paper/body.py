"""Pictures of the body: generated beside refined, and sparse, filled, united."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from benchmarks.paper.tiles import Tile, cut, fit, framed, sheet
from benchmarks.paper.workshop import Workshop

from fluidlift.evaluate.images import psnr
from fluidlift.look.rasterize import render
from fluidlift.shape.fill import fill
from fluidlift.shape.generate import bounded_colours, front_gaussians
from fluidlift.shape.refine import refine
from fluidlift.types import CellType, Gaussians

COARSE = 7
"""px of the clip between the Gaussians that come in: as few as a generator's 16 000 would be on this fluid"""
STEPS = 100
"""of the refinement, as the preset standard has it"""
FRONT, INSIDE = (30, 90, 200), (235, 150, 40)
"""colours of Gaussians that are seen, and of those inside"""


def refinement(shop: Workshop) -> None:
    """Fig. gsopt: a coarse body as a generator gives it, before and after the optimisation on its picture."""
    asset = shop.asset("demo")
    geometry, read = shop.stage(asset, "geometry"), shop.stage(asset, "read")
    t, camera = geometry.rest_frame, geometry.camera
    labels = (shop.stage(asset, "segment")).labels
    picture, mask = read.clip.frames[t], labels.fluid[t] & (geometry.depth > 0)
    given = front_gaussians(picture, mask, geometry.depth, camera, stride=COARSE)
    given = replace(given, scales=(1.5 * given.scales).astype(np.float32))
    found = refine(given, picture, mask, camera, iterations=STEPS, max_gaussians=12 * len(given))
    better = bounded_colours(found.gaussians, picture, camera)
    views = [np.where(mask[..., None], picture, 255).astype(np.uint8)]
    for name, body in (("generated", given), ("refined", better)):
        drawn = render(body, camera, background=(1.0, 1.0, 1.0)).image
        shown = (255 * np.clip(drawn, 0, 1) + 0.5).astype(np.uint8)
        views.append(shown)
        shop.tell("generated beside refined", f"PSNR, {name}", psnr(shown, picture, mask), "dB", "more")
        shop.tell("generated beside refined", f"Gaussians, {name}", len(body))
    h, w = mask.shape
    y, x = (int(v) for v in np.argwhere(mask).mean(axis=0))
    box = (max(y - h // 6, 0), y + h // 6, max(x - w // 6, 0), x + w // 6)
    names = ("the picture", f"generated: {len(given)} Gaussians", f"refined: {len(better)}")
    whole = [Tile(n, framed(v, box)) for n, v in zip(names, views, strict=True)]
    near = [Tile("", fit(cut(v, box), w)) for v in views]
    shop.keep("refined.jpg", sheet([*whole, *near], 3, 320))


def filling(shop: Workshop) -> None:
    """Fig. denoisefill: a section through the body of one frame, filled, and united over frames and filled."""
    asset = shop.asset("demo")
    geometry, read, refined = (shop.stage(asset, n) for n in ("geometry", "read", "refine"))
    t, camera, setting = geometry.rest_frame, geometry.camera, geometry.setting
    grid, mask = setting.terrain.grid, shop.stage(asset, "segment").labels.fluid[t] & (geometry.depth > 0)
    front = front_gaussians(read.clip.frames[t], mask, geometry.depth, camera, stride=2)
    added = fill(front, spacing=grid.spacing / 2, rng=np.random.default_rng(0), closed_below=setting.terrain)
    united = refined.front - refined.pruned
    bodies = {
        "one frame, as generated": (front.means, np.zeros((0, 3))),
        "the same, filled": (front.means, added.means),
        f"{geometry.united_frames} frames united, filled": (refined.body.means[:united], refined.body.means[united:]),
    }
    wet = setting.cell_types == CellType.FLUID
    wet_box = np.argwhere(wet)
    pictures = []
    for name, (seen, inside) in bodies.items():
        held = np.zeros(grid.shape, bool)
        points = np.concatenate([seen, inside])
        index = np.floor((points - grid.low) / grid.spacing).astype(int)
        index = index[((index >= 0) & (index < grid.shape)).all(axis=1)]
        held[tuple(index.T)] = True
        shop.tell(
            "sparse, filled, united", f"cells of the body that hold a Gaussian, {name}", held[wet].mean(), "", "more"
        )
        shop.tell("sparse, filled, united", f"Gaussians, {name}", len(points))
        pictures.append(Tile(f"{name}: {len(points)}", section(seen, inside, grid, wet_box)))
    shop.keep("filled.png", sheet(pictures, 1, 760))


def section(seen: np.ndarray, inside: np.ndarray, grid, wet: np.ndarray) -> np.ndarray:
    """Centres within a cell of the vertical plane through the middle of the fluid, along the grid's longer side."""
    long = 0 if grid.shape[0] >= grid.shape[1] else 1
    across = 1 - long
    middle = grid.low[across] + (np.median(wet[:, across]) + 0.5) * grid.spacing
    low, high = wet.min(axis=0) - 1, wet.max(axis=0) + 2
    scale = 760 / ((high[long] - low[long]) * grid.spacing)
    out = np.full((round((high[2] - low[2]) * grid.spacing * scale), 760, 3), 255, np.uint8)
    for points, colour in ((inside, INSIDE), (seen, FRONT)):
        near = points[np.abs(points[:, across] - middle) < grid.spacing]
        x = (near[:, long] - grid.low[long] - low[long] * grid.spacing) * scale
        y = out.shape[0] - (near[:, 2] - grid.low[2] - low[2] * grid.spacing) * scale
        for place in zip(x, y, strict=True):
            cv2.circle(out, (int(place[0]), int(place[1])), 2, colour, -1, cv2.LINE_AA)
    return out


def count(body: Gaussians) -> int:
    """Number of Gaussians."""
    return len(body)
