"""Pictures of the motion: flow found, interpolated, corrected; the boundary layer; planar velocity and its errors."""

from __future__ import annotations

import math

import cv2
import numpy as np
from benchmarks.paper.tiles import Tile, coloured, flow_colours, sheet
from benchmarks.paper.workshop import Workshop

from fluidlift.evaluate.case import read_case
from fluidlift.evaluate.images import end_point_error, mean_cosine, resample_nearest
from fluidlift.evaluate.of_run import arrays_of_run
from fluidlift.evaluate.planar import truth_flow, truth_mask
from fluidlift.io.asset_folder import load_asset, read_manifest
from fluidlift.io.video import read_clip
from fluidlift.motion.bed import layer_thickness
from fluidlift.motion.direction import mainstream_direction
from fluidlift.motion.lift import depth_change
from fluidlift.motion.mainstream import complete_flow
from fluidlift.motion.optical_flow import Farneback, flow_of_pair
from fluidlift.motion.screen_divergence import project_screen_divergence
from fluidlift.types import CellType

PAIR = 12
"""frame of the made stream that is shown"""


def correction(shop: Workshop) -> None:
    """Fig. opflow: Farneback's flow, filled along the mainstream, with the paper's constraint, and as it is made."""
    asset, case = shop.asset("stream"), read_case(shop.case("stream"))
    frames = read_clip(case.video, max_size=1 << 14).frames
    t, camera = PAIR, case.camera
    mask = case.mask[t]
    depth = [np.where(case.mask[k], case.depth[k].astype(np.float32), 1.0) for k in (t, t + 1)]
    raw, trust = flow_of_pair(frames[t], frames[t + 1], Farneback())
    direction = mainstream_direction(raw, trust, mask)
    filled, observed = complete_flow(raw, trust, mask, direction, depth[0])
    rate = depth_change(filled, mask, depth[0] * mask, depth[1] * case.mask[t + 1], mask_t1=case.mask[t + 1])
    hard, _ = project_screen_divergence(
        filled, mask, observed, depth[0], rate, camera, form="paper", reach=math.inf
    )  # fmt: skip
    made = np.asarray(shop.stage(asset, "motion").completed[t], np.float32)
    true = case.flow[t].astype(np.float32)
    shown = {
        "Farneback alone": raw, "filled along the mainstream": filled, "with the paper's constraint": hard,
        "several frames, as made here": made, "the truth": true,
    }  # fmt: skip
    top = float(np.percentile(np.linalg.norm(true[mask], axis=-1), 98))
    tiles = [Tile("the clip; blue: flow failed", _failed(frames[t], mask & ~observed))]
    for name, flow in shown.items():
        error = end_point_error(flow[None], true[None], mask[None])
        text = name if flow is true else f"{name}: {error:.2f} px"
        tiles.append(Tile(text, flow_colours(np.nan_to_num(flow), mask, top)))
        if flow is not true:
            shop.tell("flow of the made stream", name, error, "px/frame", "less")
    shop.tell(
        "flow of the made stream", "mean speed of the truth", np.linalg.norm(true[mask], axis=-1).mean(), "px/frame"
    )
    shop.tell("flow of the made stream", "share of the fluid on which flow failed", (~observed)[mask].mean())
    shop.keep("flow.jpg", sheet(tiles, 3, 320))


def _failed(picture: np.ndarray, failed: np.ndarray) -> np.ndarray:
    """A picture with the failed pixels in blue."""
    return np.where(failed[..., None], (0.4 * picture + 0.6 * np.array([30, 80, 255])).astype(np.uint8), picture)


def boundary_layer(shop: Workshop) -> None:
    """Fig. bc_layer: sections through the volume velocity of the demo, and its profile above the bed."""
    asset = load_asset(shop.asset("demo"))
    speed = np.linalg.norm(asset.velocity.at_centers(), axis=-1)
    wet, solid = asset.cell_types == CellType.FLUID, asset.cell_types == CellType.SOLID
    long = int(np.argmax(np.abs(asset.terrain.mainstream[:2])))
    top = float(np.percentile(speed[wet], 99))
    tiles = []
    for name, axis in (("along the stream", 1 - long), ("across it", long)):
        places = wet.sum(axis=tuple(a for a in range(3) if a != axis))
        at = int(np.argmax(places)) if axis == 1 - long else int(np.flatnonzero(places).mean())
        cells, ground = (np.take(a, at, axis=axis).T[::-1] for a in (np.where(wet, speed, np.nan), solid))
        rows = np.flatnonzero(~np.isnan(cells).all(axis=1))
        cells, ground = (a[max(rows[0] - 1, 0) : rows[-1] + 3] for a in (cells, ground))
        times = max(round(1200 / cells.shape[1]), 1)
        tiles.append(Tile(f"{name}: speed, 0 to {top:.2f} m/s", coloured(cells, top, ground=ground, times=times)))
    height, share = profile(speed, wet, asset.terrain.signed_distance[:-1, :-1, :-1] / asset.grid.spacing)
    thickness = layer_thickness(asset.kind, 1.0)
    tiles.append(Tile("mean speed over the surface's, against cells above the bed; line: the paper's polynomial",
                      _curve(height, share, thickness)))  # fmt: skip
    shop.tell("boundary layer of the demo", "thickness", thickness, "cells")
    shop.tell("boundary layer of the demo", "speed in the lowest cell over the surface's", share[0])
    shop.keep("layer.png", sheet(tiles, 1, 620))


def profile(speed: np.ndarray, wet: np.ndarray, height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Height above the ground (cells, in steps of a half) and mean speed over that of the column's top cell."""
    surface = np.zeros(wet.shape[:2])
    for k in range(wet.shape[2]):
        surface = np.where(wet[..., k], speed[..., k], surface)
    share = speed / np.maximum(surface, 1e-6)[..., None]
    counted = wet & (surface > 0.3 * surface.max())[..., None] & (height > 0) & (height < 6)
    bins = np.floor(2 * height[counted]).astype(int)
    total, sums = np.bincount(bins), np.bincount(bins, share[counted])
    kept = total > 20
    return (0.5 * np.arange(len(total)) + 0.25)[kept], (sums / np.maximum(total, 1))[kept]


def _curve(height: np.ndarray, share: np.ndarray, thickness: float) -> np.ndarray:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.2, 2.4), dpi=100, layout="constrained")
    canvas, axes = FigureCanvasAgg(figure), figure.subplots()
    y = np.linspace(0, max(height.max(), 1.2 * thickness), 100)
    reached = np.minimum(y / thickness, 1)
    axes.plot(1.5 * reached - 0.5 * reached**3, y, color="0.5", label=f"third order, {thickness:g} cells")
    axes.plot(share, height, "o-", label="the demo's volume velocity")
    axes.set(xlabel="speed over the surface's", ylabel="cells above the bed", xlim=(0, 1.3))
    axes.legend(fontsize=8)
    axes.grid(alpha=0.3)
    canvas.draw()
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3])


def planar(shop: Workshop) -> None:
    """Fig. vcomp: planar velocity of truth, estimate and re-simulation of a stream and of honey, with errors."""
    tiles = []
    for name in ("stream", "honey"):
        folder = shop.asset(name)
        arrays, case = arrays_of_run(folder, read_manifest(folder)), read_case(shop.case(name))
        first, t = int(arrays["first_frame"]), PAIR
        size = arrays["flow_completed"].shape[2], arrays["flow_completed"].shape[1]
        mask, true = truth_mask(case, slice(t, t + 1), size)[0], truth_flow(case, slice(t, t + 1), size)[0]
        found = np.nan_to_num(arrays["flow_completed"][t].astype(np.float32))
        again = _on(arrays["resim_flow"][t - first].astype(np.float32), size)
        shown = mask & resample_nearest(arrays["resim_mask"][t - first].astype(bool)[None], size)[0]
        top = float(np.percentile(np.linalg.norm(true[mask], axis=-1), 98))
        for title, flow, where in (("truth", true, mask), ("estimate", found, mask), ("re-simulation", again, shown)):
            text = f"{name}: {title}"
            if title != "truth":
                error = end_point_error(flow[None], true[None], where[None])
                cosine = mean_cosine(flow[None], true[None], where[None])
                text += f", error {error:.2f} px"
                shop.tell(f"planar velocity, {name}", f"error, {title}", error, "px/frame", "less")
                shop.tell(f"planar velocity, {name}", f"cosine, {title}", cosine, "", "more")
            tiles.append(Tile(text, flow_colours(flow, where, top)))
        shop.tell(f"planar velocity, {name}", "mean speed of the truth",
                  np.linalg.norm(true[mask], axis=-1).mean(), "px/frame")  # fmt: skip
    shop.keep("planar.jpg", sheet(tiles, 3, 320))


def _on(flow: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A flow on another raster, px of that."""
    factor = np.array([size[0] / flow.shape[1], size[1] / flow.shape[0]], np.float32)
    return cv2.resize(np.nan_to_num(flow), size, interpolation=cv2.INTER_LINEAR) * factor
