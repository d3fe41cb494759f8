"""A surveyed river beside the surface velocities and the discharge that other programs find: RIVeR's example *Pisco*.

    python benchmarks/surveyed_river.py                                 velocities of the surface, from the clip alone
    python benchmarks/surveyed_river.py --openpiv PYTHON                and OpenPIV's on the same frames
    python benchmarks/surveyed_river.py pisco.fluid --openpiv PYTHON    and depth and discharge of an asset
    python benchmarks/surveyed_river.py pisco.fluid --camera --dry      of one that is made with a camera by the map

The case lies below FLUIDLIFT_SHARED (or a folder `shared` beside the repository) in `cases/pisco`: a clip, the map
from its pixels to metres on the water, the surveyed section, and RIVeR's velocities at some hundred nodes (medians of
particle image velocimetry over all pairs). The survey is a measurement; velocities and discharge of RIVeR are another
program's estimate, and so are OpenPIV's. An asset that is not there is made (`fluidlift make`) of the clip alone.

Ours: the flow of the clip, its mean over the pairs, carried to metres by the map. OpenPIV (GPL: with a Python of its
own, never a dependency): its default settings on the same frames, laid onto the water by the same map at the median
footprint of a pixel, without what stands still (`velocimetry.py`); the mean over the pairs of each window, where that
is more than twice its own standard error.

Discharge by velocity-area, as RIVeR does it: surface speed across the section, times the surveyed depth, times alpha (1
in its example; 0.85 is usual). Where a program has measured nothing, its speed is drawn straight between the stations
beside, and to zero at the banks. RIVeR's own nodes go through the same sum, beside what RIVeR itself makes of them.
An asset's discharge is that of its own bed: what passes its sections per second, the median over them, at the size at
which the surveyed section is as long as surveyed (lengths and speeds grow alike, a discharge with their third power):
its ends are looked for on the asset's water by the asset's camera. Its depth is the greatest of the sections that
this one crosses, and over width it is that of each section over its own.
"""

from __future__ import annotations

import argparse
import csv
import functools
import json
import platform
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from motion_subjects import default_shared
from report import put
from scipy.spatial import cKDTree
from velocimetry import WINDOW, Ground, moving, peer_velocity

from fluidlift.config import build_config
from fluidlift.io.asset_folder import load_asset
from fluidlift.io.video import read_clip
from fluidlift.motion.optical_flow import estimate_flow, mean_flow
from fluidlift.pipeline import Inputs, make
from fluidlift.types import CellType, FluidAsset

SURVEYED = (1920, 1080)
"""px of the pictures that the case's map and nodes belong to"""
FULL = 1280
"""px: longer side of the clip, at which the flow is measured"""
STATIONS = 60
"""points of the section"""
NEAR = 3
"""px around a node or a station, over which the median is taken"""
CLOSE = 0.25
"""share of RIVeR's speed within which a node counts as near"""
FOCAL = 1500.0
"""px of the surveyed pictures: the map alone says 1300 by its lengths and 1730 by its angles"""
RIVER_DISCHARGE, RIVER_ERROR = 50.5, 9.1
"""m3/s, and its uncertainty: what RIVeR gives out for this clip"""


@dataclass(frozen=True)
class Case:
    """The folder of the case."""

    folder: Path

    @functools.cached_property
    def map(self) -> np.ndarray:
        """Pixel (x, y, 1) of the surveyed pictures -> metres on the water (east, north), homogeneous [3,3]."""
        return np.array(json.loads((self.folder / "transformation.json").read_text(encoding="utf-8")))

    @functools.cached_property
    def nodes(self) -> tuple[np.ndarray, np.ndarray]:
        """Pixels [n,2] and RIVeR's velocities [n,2] (m/s, east and north)."""
        with (self.folder / "river_velocities.csv").open(encoding="utf-8") as file:
            rows = [{k: float(x) for k, x in row.items()} for row in csv.DictReader(file)]
        return (
            np.array([[r["px"], r["py"]] for r in rows]),
            np.array([[r["v_east_m_s"], r["v_north_m_s"]] for r in rows]),
        )

    @functools.cached_property
    def survey(self) -> np.ndarray:
        """Distance from the left bank and height of the bed [n,2], m."""
        with (self.folder / "pisco_section.csv").open(encoding="utf-8") as file:
            return np.array([[float(r["d"]), float(r["h"])] for r in csv.DictReader(file)])

    @functools.cached_property
    def section(self) -> Section:
        """Its stations."""
        told = json.loads((self.folder / "section.json").read_text(encoding="utf-8"))["section1"]
        depth = np.maximum(told["level"] - self.survey[:, 1], 0.0)
        share = (np.arange(STATIONS) + 0.5) / STATIONS
        ends = np.array([[told["xl"], told["yl"]], [told["xr"], told["yr"]]])
        across = np.array([told["east_r"] - told["east_l"], told["north_r"] - told["north_l"]])
        pixels = ends[0] + share[:, None] * (ends[1] - ends[0])
        along = np.linalg.norm(metres(self.map, pixels) - [told["east_l"], told["north_l"]], axis=1)
        return Section(
            pixels, along, np.interp(along + told["left_station"], self.survey[:, 0], depth),
            np.array([-across[1], across[0]]) / np.linalg.norm(across), float(depth.max()),
        )  # fmt: skip


@dataclass(frozen=True)
class Section:
    """Stations across the river."""

    pixels: np.ndarray
    """[n,2], of the surveyed pictures"""
    along: np.ndarray
    """m from the left end"""
    depth: np.ndarray
    """m, surveyed"""
    normal: np.ndarray
    """unit vector across it (east, north)"""
    deepest: float
    """m, surveyed"""

    def discharge(self, velocities: np.ndarray) -> float:
        """m3/s of surface velocities [n,2] at the stations; not a number: not measured there.

        Raises:
            ValueError: nothing was measured at any station.
        """
        speed = velocities @ self.normal
        known = np.isfinite(speed)
        if not known.any():
            raise ValueError("no station of the section was measured")
        step = self.along[1] - self.along[0]
        places = np.concatenate([[self.along[0] - step / 2], self.along[known], [self.along[-1] + step / 2]])
        filled = np.interp(self.along, places, np.concatenate([[0.0], speed[known], [0.0]]))
        return abs(float(np.trapezoid(filled * self.depth, self.along)))


def metres(map_: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Places [n,2] (m) of pixels [n,2]; with the inverse of the map pixels of places."""
    x = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1) @ map_.T
    return x[:, :2] / x[:, 2:]


def ours(case: Case) -> tuple[np.ndarray, np.ndarray]:
    """Our velocities [n,2] (m/s) at the nodes and at the stations."""
    clip = read_clip(case.folder / "video.mp4", max_size=FULL)
    found, _ = mean_flow(estimate_flow(clip.frames))
    height, width = found.shape[:2]
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    scale = np.array(SURVEYED) / [width, height]
    here = np.stack([u, v], axis=-1).reshape(-1, 2)
    there = here + found.reshape(-1, 2)
    moved = (metres(case.map, there * scale) - metres(case.map, here * scale)) / clip.interval
    field = moved.reshape(height, width, 2)
    return around(field, case.nodes[0] / scale), around(field, case.section.pixels / scale)


def around(field: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Medians of a field [H,W,2] around pixels [n,2]."""
    out = []
    for u, v in np.floor(pixels).astype(int):
        part = field[max(v - NEAR, 0) : v + NEAR + 1, max(u - NEAR, 0) : u + NEAR + 1].reshape(-1, 2)
        out.append(np.median(part, axis=0) if len(part) else np.full(2, np.nan))
    return np.array(out)


def ground_of(case: Case, scale: np.ndarray) -> Ground:
    """A raster on the water over nodes and section; `scale` is surveyed px per px of the clip."""
    pixels = np.concatenate([case.nodes[0], case.section.pixels])
    at = metres(case.map, pixels)
    right, below = metres(case.map, pixels + [scale[0], 0.0]) - at, metres(case.map, pixels + [0.0, scale[1]]) - at
    area = right[:, 0] * below[:, 1] - right[:, 1] * below[:, 0]
    spacing = float(np.sqrt(np.median(np.abs(area))))
    low, high = at.min(axis=0) - WINDOW * spacing, at.max(axis=0) + WINDOW * spacing
    columns, rows = np.ceil((high - low) / spacing).astype(int)
    return Ground(low[0] + (np.arange(columns) + 0.5) * spacing, high[1] - (np.arange(rows) + 0.5) * spacing, spacing)


def openpiv(case: Case, python: str) -> tuple[np.ndarray, np.ndarray]:
    """OpenPIV's velocities [n,2] (m/s) at the nodes and at the stations; not a number where it measured nothing."""
    clip = read_clip(case.folder / "video.mp4", max_size=FULL)
    scale = np.array(SURVEYED) / clip.size
    ground = ground_of(case, scale)
    x, y = np.meshgrid(ground.x, ground.y)
    at = metres(np.linalg.inv(case.map), np.stack([x, y], axis=-1).reshape(-1, 2)) / scale - 0.5
    at = at.reshape(*x.shape, 2).astype(np.float32)
    above = [
        cv2.remap(cv2.cvtColor(f, cv2.COLOR_RGB2GRAY), at[..., 0], at[..., 1], cv2.INTER_CUBIC,
                  borderMode=cv2.BORDER_REPLICATE) for f in np.asarray(clip.frames)
    ]  # fmt: skip
    column, row, velocity, significant = peer_velocity(python, moving(np.stack(above)), ground, clip.interval)
    inside = np.all((at >= 0) & (at < np.array(clip.size) - 1), axis=-1)
    j, i = (np.clip(p.astype(int), 0, n - 1) for p, n in ((column, x.shape[1]), (row, x.shape[0])))
    known = significant & inside[i, j]
    places = np.stack([ground.x[j], ground.y[i]], axis=-1)[known]
    reach = WINDOW * ground.spacing
    return tuple(
        nearest(places, velocity[known], metres(case.map, pixels), reach)
        for pixels in (case.nodes[0], case.section.pixels)
    )  # pyright: ignore[reportReturnType]


def nearest(places: np.ndarray, values: np.ndarray, wanted: np.ndarray, reach: float) -> np.ndarray:
    """Values [n,2] of the places that are nearest to those wanted; not a number beyond `reach` (m)."""
    found = np.full((len(wanted), 2), np.nan)
    if len(places):
        away, which = cKDTree(places).query(wanted)
        found[away <= reach] = values[which][away <= reach]
    return found


def beside_river(case: Case, nodes: np.ndarray, stations: np.ndarray) -> dict[str, float]:
    """Velocities at nodes and stations [n,2] beside RIVeR's, and the discharge through the surveyed section."""
    theirs, known = case.nodes[1], np.isfinite(nodes).all(axis=1)
    mine, theirs = nodes[known], theirs[known]
    size, speed = np.linalg.norm(theirs, axis=1), np.linalg.norm(mine, axis=1)
    cosine = (mine * theirs).sum(axis=1) / np.maximum(speed * size, 1e-9)
    discharge = case.section.discharge(stations)
    return {
        "nodes measured": float(known.mean()),
        "speed over RIVeR's, median of nodes": float(np.median(speed / size)),
        "direction against RIVeR's, median cosine": float(np.median(cosine)),
        f"nodes within {100 * CLOSE:.0f} % of RIVeR's speed": float(np.mean(np.abs(speed / size - 1) < CLOSE)),
        "stations measured": float(np.isfinite(stations).all(axis=1).mean()),
        "discharge through the surveyed section, alpha 1": discharge,
        "discharge through the surveyed section, alpha 0.85": 0.85 * discharge,
    }


def river(case: Case) -> dict[str, float]:
    """RIVeR's own nodes by our sum, and what RIVeR makes of them."""
    at = metres(case.map, case.nodes[0])
    away, _ = cKDTree(at).query(at, k=2)
    spacing = float(np.median(np.asarray(away)[:, 1]))
    stations = nearest(at, case.nodes[1], metres(case.map, case.section.pixels), spacing)
    found = beside_river(case, case.nodes[1], stations)
    wanted = {k: v for k, v in found.items() if k.startswith(("stations", "discharge"))}
    return wanted | {"discharge given out": RIVER_DISCHARGE, "its uncertainty": RIVER_ERROR}


def of_asset(folder: Path, case: Case) -> dict[str, float]:
    """Depth and discharge of an asset's own bed."""
    asset = load_asset(folder)
    grid, liquid = asset.grid, np.isin(asset.cell_types, (CellType.FLUID, CellType.INFLOW, CellType.OUTFLOW))
    h, flow = grid.spacing, asset.velocity.at_centers()
    direction = np.asarray(asset.terrain.mainstream, np.float64) * [1.0, 1.0, 0.0]  # sections are upright
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
    own_water = np.isin(asset.cell_types, (CellType.FLUID, CellType.INFLOW))  # outlets reach up to the air
    places = on_water(asset, own_water, case.section.pixels * (np.array(asset.camera.size) / SURVEYED))
    length = float(np.linalg.norm(places[-1] - places[0]))
    size = float(np.ptp(case.section.along)) / length
    inside = np.floor((places[:, :2] - grid.low[:2]) / h).astype(int)
    here = np.unique(own[tuple(np.clip(inside, 0, np.array(own.shape) - 1).T)])
    return {
        "greatest depth over width": float(np.median(deepest[middle] / wide[middle])),
        "greatest depth": float(np.median(deepest[here])) * size,
        "area of its sections": float(np.median(count[here])) * (h * size) ** 2,
        "discharge of its own bed": float(np.median(through[middle])) * size**3,
        "mean speed": float(np.median(through[here] / (np.maximum(count[here], 1) * h * h))) * size,
        "width before that": length,
    }


def on_water(asset: FluidAsset, liquid: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Places [n,3] of pixels of the asset's camera on the plane through the top of its `liquid` cells, m."""
    grid = asset.grid
    top = grid.low[2] + (grid.shape[2] - np.argmax(liquid[:, :, ::-1], axis=2)) * grid.spacing
    wet = np.asarray(liquid.any(axis=2))
    at = grid.centers()[:, :, 0, :2][wet]
    plane, *_ = np.linalg.lstsq(np.c_[at, np.ones(len(at))], top[wet], rcond=None)
    rays, eye, up = asset.camera.rays(pixels), asset.camera.position, np.array([-plane[0], -plane[1], 1.0])
    return eye + ((plane[2] - eye @ up) / (rays @ up))[:, None] * rays


def made(folder: Path, case: Case, with_camera: bool) -> Path:
    """The asset; made of the clip alone where there is none, or of the clip and a camera by the map."""
    if not (folder / "manifest.json").is_file():
        with tempfile.TemporaryDirectory() as scratch:
            camera = Path(scratch) / "camera.json"
            camera.write_text(json.dumps(camera_of(case)), encoding="utf-8")
            inputs = Inputs(case.folder / "video.mp4", camera=camera if with_camera else None)
            make(inputs, folder, build_config("draft"))
    return folder


def camera_of(case: Case) -> dict[str, Any]:
    """A camera file (m, z up, the water at 0): the rotation that is nearest to the map at `FOCAL`."""
    to_pixels = np.linalg.inv(case.map)
    k = np.array([[FOCAL, 0.0, SURVEYED[0] / 2], [0.0, FOCAL, SURVEYED[1] / 2], [0.0, 0.0, 1.0]])
    found = np.linalg.inv(k) @ to_pixels
    found *= np.sign(found[2] @ [*metres(case.map, case.nodes[0]).mean(axis=0), 1.0])  # the water lies before it
    found /= np.linalg.norm(found[:, :2], axis=0).mean()
    u, _, v = np.linalg.svd(found[:, :2], full_matrices=False)
    axes = u @ v
    rotation = np.column_stack([axes, np.cross(axes[:, 0], axes[:, 1])])
    size = FULL / SURVEYED[0]
    k[:2] *= size
    return {"width": FULL, "height": round(size * SURVEYED[1]), "K": k.tolist(), "R": rotation.tolist(),
            "t": found[:, 2].tolist(), "water_level_z": 0.0}  # fmt: skip


UNITS = {"discharge": "m3/s", "its uncertainty": "m3/s", "greatest depth": "m", "mean speed": "m/s", "width": "m",
         "area": "m2"}  # fmt: skip
"""of figures by their beginning; the others have none"""


def unit_of(figure: str) -> str:
    """Of a figure."""
    return next((u for k, u in UNITS.items() if figure.startswith(k)), "") if "over" not in figure else ""


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("asset", nargs="?", type=Path, help="made where it is not there")
    parser.add_argument("--openpiv", help="interpreter that has the package openpiv")
    parser.add_argument("--camera", action="store_true", help="make the asset with a camera by the map")
    parser.add_argument("--dry", action="store_true", help="write no results")
    args = parser.parse_args()
    shared = default_shared()
    if shared is None or not (shared / "cases" / "pisco").is_dir():
        parser.error("the case pisco is not there: set FLUIDLIFT_SHARED to the folder that holds cases/pisco")
    case = Case(shared / "cases" / "pisco")
    width = float(np.ptp(case.survey[:, 0]))
    found = {"survey": {"greatest depth over width": case.section.deepest / width,
                        "greatest depth": case.section.deepest,
                        "area of its sections": float(np.trapezoid(case.section.depth, case.section.along))},
             "RIVeR": river(case)}  # fmt: skip
    mine = ours(case)
    found["ours"] = beside_river(case, *mine)
    if args.openpiv:
        theirs = openpiv(case, args.openpiv)
        found["OpenPIV"] = beside_river(case, *theirs)
        both = [np.linalg.norm(v[0], axis=1) for v in (mine, theirs)]
        found["ours"]["speed over OpenPIV's, median of nodes"] = float(np.nanmedian(both[0] / both[1]))
    if args.asset is not None:
        found["our asset"] = of_asset(made(args.asset, case, args.camera), case)
    for subject, figures in found.items():
        for name, value in figures.items():
            print(f"{subject:10} {name:55} {value:8.3g} {unit_of(name)}")
    if not args.dry:
        records: list[dict[str, Any]] = [
            {"subject": subject, "figure": k, "value": float(f"{v:.3g}"), "unit": unit_of(k)}
            for subject, figures in found.items() for k, v in figures.items()
        ]  # fmt: skip
        put("river", records, date=time.strftime("%Y-%m-%d"), machine=f"{platform.machine()}, {platform.system()}")


if __name__ == "__main__":
    main()
