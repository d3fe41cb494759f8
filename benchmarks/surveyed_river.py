"""A surveyed river beside the surface velocities and the discharge that another program found: RIVeR's example *Pisco*.

    python benchmarks/surveyed_river.py                    velocities of the surface, from the clip alone
    python benchmarks/surveyed_river.py pisco.fluid        and the depth and the discharge of an asset

The case lies below FLUIDLIFT_SHARED (or a folder `shared` beside the repository) in `cases/pisco`: a clip, the map
from its pixels to metres on the water, the surveyed section, and RIVeR's velocities at some hundred nodes (medians of
particle image velocimetry over all pairs). The survey is a measurement; velocities and discharge of RIVeR are another
program's estimate. `fluidlift make` is given the clip alone.

Velocities: the flow of the clip, its mean over the pairs, carried to metres by the same map. Discharge by
velocity-area, as RIVeR does it: surface speed across the section, times the surveyed depth, times alpha (1 in its
example; 0.85 is usual). An asset's discharge is that of its own bed: what passes its sections per second, the median
over them, at the size at which the river is as wide as surveyed (lengths and speeds grow alike, a discharge with their
third power); its depth is the greatest of each section over its width.
"""

from __future__ import annotations

import argparse
import csv
import json
import platform
import time
from pathlib import Path
from typing import Any

import numpy as np
from motion_subjects import default_shared
from report import put

from fluidlift.io.asset_folder import load_asset
from fluidlift.io.video import read_clip
from fluidlift.motion.optical_flow import estimate_flow, mean_flow
from fluidlift.types import CellType

SURVEYED = (1920, 1080)
"""px of the pictures that the case's map and nodes belong to"""
FULL = 1280
"""px: longer side of the clip, at which the flow is measured"""
STATIONS = 60
"""points of the section"""
NEAR = 3
"""px around a node or a station, over which the median is taken"""


def metres(map_: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Places [n,2] (m) of pixels [n,2]."""
    x = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1) @ map_.T
    return x[:, :2] / x[:, 2:]


def speeds(case: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Velocity [H,W,2] (m/s, east and north) of each pixel of the clip, how far it is trusted, and the map's pixels."""
    clip = read_clip(case / "video.mp4", max_size=FULL)
    found, trust = mean_flow(estimate_flow(clip.frames))
    height, width = trust.shape
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    scale = np.array(SURVEYED) / [width, height]
    here = np.stack([u, v], axis=-1).reshape(-1, 2)
    there = here + found.reshape(-1, 2)
    map_ = np.array(json.loads((case / "transformation.json").read_text(encoding="utf-8")))
    moved = (metres(map_, there * scale) - metres(map_, here * scale)) / clip.interval
    return moved.reshape(height, width, 2), trust, scale


def surveyed(case: Path) -> np.ndarray:
    """Distance from the left bank and height of the bed [n,2], m."""
    with (case / "pisco_section.csv").open(encoding="utf-8") as file:
        return np.array([[float(r["d"]), float(r["h"])] for r in csv.DictReader(file)])


def around(field: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Medians of a field [H,W,2] around pixels [n,2]."""
    out = []
    for u, v in np.floor(pixels).astype(int):
        part = field[max(v - NEAR, 0) : v + NEAR + 1, max(u - NEAR, 0) : u + NEAR + 1].reshape(-1, 2)
        out.append(np.median(part, axis=0) if len(part) else np.full(2, np.nan))
    return np.array(out)


def of_clip(case: Path) -> dict[str, float]:
    """Our velocities beside RIVeR's at its nodes, and the discharge through the surveyed section."""
    field, _, scale = speeds(case)
    with (case / "river_velocities.csv").open(encoding="utf-8") as file:
        rows = [{k: float(x) for k, x in row.items()} for row in csv.DictReader(file)]
    nodes = np.array([[r["px"], r["py"]] for r in rows]) / scale
    theirs = np.array([[r["v_east_m_s"], r["v_north_m_s"]] for r in rows])
    ours = around(field, nodes)
    size = np.linalg.norm(theirs, axis=1)
    cosine = (ours * theirs).sum(axis=1) / np.maximum(np.linalg.norm(ours, axis=1) * size, 1e-9)
    section = json.loads((case / "section.json").read_text(encoding="utf-8"))["section1"]
    survey = surveyed(case)
    depth = np.maximum(section["level"] - survey[:, 1], 0.0)
    share = (np.arange(STATIONS) + 0.5) / STATIONS
    ends = np.array([[section["xl"], section["yl"]], [section["xr"], section["yr"]]])
    across = np.array([section["east_r"] - section["east_l"], section["north_r"] - section["north_l"]])
    length = float(np.linalg.norm(across))
    normal = np.array([-across[1], across[0]]) / length
    pixels = ends[0] + share[:, None] * (ends[1] - ends[0])
    map_ = np.array(json.loads((case / "transformation.json").read_text(encoding="utf-8")))
    ground = metres(map_, pixels)
    along = np.linalg.norm(ground - [section["east_l"], section["north_l"]], axis=1)
    speed = around(field, pixels / scale) @ normal
    deep = np.interp(along + section["left_station"], survey[:, 0], depth)
    discharge = abs(float(np.trapezoid(speed * deep, along)))
    return {
        "speed over RIVeR's, median of nodes": float(np.median(np.linalg.norm(ours, axis=1) / size)),
        "direction against RIVeR's, median cosine": float(np.median(cosine)),
        "nodes within 25 % of RIVeR's speed": float(np.mean(np.abs(np.linalg.norm(ours, axis=1) / size - 1) < 0.25)),
        "discharge through the surveyed section, alpha 1, m3/s": discharge,
        "discharge through the surveyed section, alpha 0.85, m3/s": 0.85 * discharge,
        "surveyed greatest depth over width": float(depth.max() / np.ptp(survey[:, 0])),
    }


def of_asset(folder: Path, case: Path) -> dict[str, float]:
    """Depth and discharge of an asset's own bed."""
    asset = load_asset(folder)
    grid, liquid = asset.grid, np.isin(asset.cell_types, (CellType.FLUID, CellType.INFLOW, CellType.OUTFLOW))
    h, flow = grid.spacing, asset.velocity.at_centers()
    direction = np.asarray(asset.terrain.mainstream, np.float64)
    direction /= np.linalg.norm(direction)
    station = np.floor(grid.centers() @ direction / h).astype(int)
    station -= station.min()
    count = np.bincount(station[liquid])
    through = np.bincount(station[liquid], (flow[liquid] @ direction)) * h * h
    columns = liquid.any(axis=2)
    deep = liquid.sum(axis=2) * h
    own = station[:, :, 0]
    wide = np.bincount(own[columns], minlength=len(count)) * h
    deepest = np.zeros(len(count))
    np.maximum.at(deepest, own[columns], deep[columns])
    middle = count > 0.5 * np.median(count[count > 0])
    width = float(np.median(wide[middle]))
    size = float(np.ptp(surveyed(case)[:, 0])) / width
    return {
        "greatest depth over width, median of sections": float(np.median(deepest[middle] / wide[middle])),
        "discharge of the asset at the surveyed width, m3/s": float(np.median(through[middle])) * size**3,
        "mean speed of the asset at the surveyed width, m/s": float(
            np.median(through[middle] / (count[middle] * h * h))
        )
        * size,
        "width of the asset before that, m": width,
    }


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("asset", nargs="?", type=Path)
    parser.add_argument("--dry", action="store_true", help="write no results")
    args = parser.parse_args()
    shared = default_shared()
    if shared is None or not (shared / "cases" / "pisco").is_dir():
        parser.error("the case pisco is not there: set FLUIDLIFT_SHARED to the folder that holds cases/pisco")
    figures = of_clip(shared / "cases" / "pisco") | (
        {} if args.asset is None else of_asset(args.asset, shared / "cases" / "pisco")
    )
    for name, value in figures.items():
        print(f"{name:60} {value:.3g}")
    if not args.dry:
        records: list[dict[str, Any]] = [
            {"subject": "Pisco", "figure": k, "value": float(f"{v:.3g}")} for k, v in figures.items()
        ]
        put("river", records, date=time.strftime("%Y-%m-%d"), machine=f"{platform.machine()}, {platform.system()}")


if __name__ == "__main__":
    main()
