"""Measures the looks: how near the splats come to the clip, how much each look flickers, how long a picture takes.

    python benchmarks/looks.py demo.fluid river.fluid --page docs/experiments/2026-11-looks.md
    python benchmarks/looks.py demo.fluid river.fluid --sheets sheets
    python benchmarks/looks.py --speed --page docs/experiments/2026-11-looks.md

Assets are finished ones, with their folder work/. PSNR and SSIM compare the re-simulated splats, seen from the clip's
camera, with the clip inside its mask. Flicker is the mean of |I(t-1) - 2 I(t) + I(t+1)| over the pixels that are
fluid in all three frames (8 bits): what moves steadily gives little, what blinks gives much; next to it stands the
clip's own.
`--speed` draws made-up bodies of splats: medians over repeated pictures, after the first one has compiled.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from page_section import replace_section
from report import table as rows_of

from fluidlift.evaluate.images import psnr, ssim
from fluidlift.io.asset_folder import load_asset, read_manifest
from fluidlift.io.scene_look import Look
from fluidlift.look.materials import PRESETS
from fluidlift.look.outlet_section import OpenEnd
from fluidlift.look.pictures import caption
from fluidlift.look.rasterize import render
from fluidlift.look.scenery import orbit_camera, side_camera, terrain_surfels
from fluidlift.look.stream_slab import Slab
from fluidlift.look.vessel import glass_of
from fluidlift.numerics.srgb import linear_from_srgb, srgb_from_linear
from fluidlift.present.looks import Frame, Painter
from fluidlift.present.without_fluid import Backdrop
from fluidlift.scene.recall import footage_of_asset
from fluidlift.scene.splat_files import splat_frames
from fluidlift.types import CellType, FluidAsset, Gaussians, Grid, PinholeCamera, Terrain, TriangleMesh, kind_of

BEGIN, END = "<!-- looks:begin -->", "<!-- looks:end -->"
SPEED_BEGIN, SPEED_END = "<!-- looks-speed:begin -->", "<!-- looks-speed:end -->"
STYLES = (("relit", "source"), ("transparent", "water"), ("surface", "water"))
FRAMES = 12
"""of each clip for the flicker: three in a row, from four places"""
GROUP = 3


def table(head: list[str], rows: list[list[str]]) -> str:
    """Markdown."""
    return "\n".join(rows_of(head, rows))


def footage(folder: Path):
    """Clip, mask [t,h,w] and first frame of an asset whose stages are still there; None where they are not."""
    found = footage_of_asset(folder, read_manifest(folder))
    return None if found is None else (found.clip, found.labels.fluid, found.start)


def picked(count: int) -> list[int]:
    """First frames of the groups."""
    starts = np.linspace(0, max(count - GROUP, 0), FRAMES // GROUP).astype(int)
    return sorted({int(s) for s in starts})


def shown(light: np.ndarray, painter: Painter) -> np.ndarray:
    """8 bits."""
    return (255 * srgb_from_linear(painter.display(light)) + 0.5).astype(np.uint8)


def flicker(pictures: list[np.ndarray], mask: np.ndarray) -> float:
    """Second difference in time, 8 bits."""
    a, b, c = (p.astype(np.float32) for p in pictures)
    return float(np.abs(a - 2 * b + c)[mask].mean())


def measured(folder: Path) -> list[str]:
    """A row of the table."""
    asset, found = load_asset(folder), footage(folder)
    if found is None:
        return [folder.stem, "no clip at hand", "", "", *[""] * len(STYLES)]
    clip, masks, start = found
    played = read_manifest(folder)["simulation"]
    count = min(int(played["frames"]), len(clip) - start)
    frames = list(splat_frames(folder, count))
    painters = {style: Painter(Look(style, m), asset.terrain, folder, kind=asset.kind) for style, m in STYLES}
    noise: dict[str, list[float]] = {name: [] for name in ("clip", "splats", *painters)}
    near, alike = [], []
    for first in picked(count):
        series: dict[str, list[np.ndarray]] = {name: [] for name in noise}
        still = clip.frames[start + first]  # behind the fluid nothing moves: what is seen through it must not flicker
        for k in range(first, first + GROUP):
            fluid, _, velocities = frames[k]
            mask, truth = masks[start + k], clip.frames[start + k]
            plain = (255 * np.clip(render(fluid, asset.camera, background=still / 255.0).image, 0, 1)).astype(np.uint8)
            if k == first:
                near.append(psnr(plain, truth, mask))
                alike.append(ssim(plain, truth))
            series["clip"].append(truth)
            series["splats"].append(plain)
            for style, painter in painters.items():
                behind = Backdrop(linear_from_srgb(still / 255.0).astype(np.float32))
                lit = painter.picture(Frame(fluid, velocities), asset.camera, behind)
                series[style].append(shown(lit.image, painter))
        wet = masks[start + first : start + first + GROUP].all(axis=0)
        for name, pictures in series.items():
            noise[name].append(flicker(pictures, wet))
    means = {name: statistics.mean(values) for name, values in noise.items()}
    own = max(means["clip"], 1e-9)
    compared = [f"{means[name]:.1f} ({means[name] / own:.2f})" for name in ("splats", *painters)]
    quality = [f"{statistics.mean(near):.1f} dB", f"{statistics.mean(alike):.2f}"]
    return [folder.stem, *quality, f"{means['clip']:.1f}", *compared]


def sheet(folder: Path, out: Path) -> None:
    """A contact sheet per look: materials side by side, from the clip's camera and from the side."""
    asset = load_asset(folder)
    count = int(read_manifest(folder)["simulation"]["frames"])
    fluid, _, velocities = list(splat_frames(folder, count // 2 + 1))[-1]
    for style in ("relit", "transparent", "surface"):
        rows = [
            np.concatenate([tile(asset, folder, Look(style, m, "sky"), fluid, velocities, view) for m in materials], 1)
            for view in ("input", "side") for materials in (list(PRESETS)[:4], list(PRESETS)[4:])
        ]  # fmt: skip
        cv2.imwrite(str(out / f"{folder.stem}_{style}.png"), np.concatenate(rows)[..., ::-1])


def tile(asset: FluidAsset, folder: Path, look: Look, fluid: Gaussians, velocities: np.ndarray, view: str):
    """One picture of a sheet."""
    ends = []
    if kind_of(asset.kind).is_channel_flow:
        kinds = (CellType.INFLOW, CellType.OUTFLOW)
        ends = [OpenEnd.of(asset.cell_types, asset.grid, asset.terrain.mainstream, kind=k) for k in kinds]
    slab = Slab(tuple(end for end in ends if end is not None), asset.rest.means)
    painter = Painter(look, asset.terrain, folder, kind=asset.kind, slab=slab)
    width = 480
    size = (width, max(2, 2 * round(width * asset.camera.size[1] / asset.camera.size[0] / 2)))
    around = np.concatenate([asset.rest.means, asset.terrain.mesh.vertices])
    ground = terrain_surfels(asset.terrain, glass=glass_of(asset.kind))
    camera = asset.camera.resized(size) if view == "input" else side_camera(
        asset.camera, asset.rest, ground, around, size=size
    )  # fmt: skip
    lit = painter.picture(Frame(fluid, velocities), camera, Backdrop())
    return caption(shown(lit.image, painter), f"{look.style}, {look.material}")


def body(count: int) -> tuple[Gaussians, np.ndarray, Terrain]:
    """A wavy pool of splats on a flat bed, half a cell apart, with its terrain."""
    spacing = 0.5 * 0.02
    layers = 8
    side = round((count / layers) ** 0.5)
    x, y, z = (v.ravel() for v in np.meshgrid(*(np.arange(n) * spacing for n in (side, side, layers)), indexing="ij"))
    wave = 0.15 * spacing * layers * np.sin(25 * x) * np.cos(18 * y)
    rng = np.random.default_rng(0)
    means = np.stack([x, y, z * (1 + wave / (layers * spacing)) + 0.02], -1) + rng.normal(0, 0.1 * spacing, (len(x), 3))
    n = len(means)
    sh = rng.normal(0, 0.2, (n, 1, 3)).astype(np.float32)
    quats = np.tile(np.float32([1, 0, 0, 0]), (n, 1))
    g = Gaussians(
        means.astype(np.float32), quats, np.full((n, 3), 0.42 * 0.02, np.float32), np.full(n, 0.9, np.float32), sh
    )
    wide = side * spacing
    grid = Grid((max(2, int(wide / 0.02)), max(2, int(wide / 0.02)), 16), 0.02, (0.0, 0.0, 0.0))
    height = np.arange(grid.shape[2] + 1) * 0.02 - 0.02
    distance = np.broadcast_to(height, tuple(s + 1 for s in grid.shape)).astype(np.float32)
    corners = np.float32([[-1, -1, 0.02], [wide + 1, -1, 0.02], [wide + 1, wide + 1, 0.02], [-1, wide + 1, 0.02]])
    mesh = TriangleMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), np.full((4, 3), 0.5, np.float32))
    return g, np.zeros((n, 3), np.float32), Terrain(grid, distance, np.float32([1, 0, 0]), mesh)


def median_ms(work: Callable[[], object], repeats: int = 7) -> float:
    """Median of repeated runs after the first."""
    work()
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        times.append(time.perf_counter() - began)
    return 1000 * statistics.median(times)


def speeds(count: int = 100_000, size: tuple[int, int] = (1280, 720)) -> list[list[str]]:
    """Rows of the table of speeds."""
    from fluidlift.backends.splashsurf import SplashsurfMesher
    from fluidlift.present.surfacing import surface_of

    g, velocities, terrain = body(count)
    start = PinholeCamera.looking(np.array([0.5, -1.0, 0.8]), np.array([0.5, 0.5, 0.0]), 45.0, size)
    camera = orbit_camera(start, g.means, azimuth=0.0, elevation=35.0, size=size)
    folder, frame = Path(), Frame(g, velocities)
    rows = [["splats, as lifted", median_ms(lambda: render(g, camera)), "10 per second"]]
    for style, engine in (("relit", "mesh"), ("transparent", "mesh"), ("surface", "screen"), ("surface", "mesh")):
        painter = Painter(Look(style, "water"), terrain, folder, engine=engine)
        took = median_ms(lambda p=painter: p.picture(frame, camera, Backdrop()), 5)
        rows.append([f"{style}, engine {engine}, with ground", took, "5 per second" if engine == "screen" else ""])
    mesher = SplashsurfMesher()
    rows.append(
        ["surface mesh of the particles alone", median_ms(lambda: surface_of(g, velocities, terrain, mesher), 5), "1 s"]
    )
    return [[name, f"{ms:.0f} ms", f"{1000 / ms:.1f} per second", goal] for name, ms, goal in rows]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("assets", nargs="*", type=Path)
    parser.add_argument("--sheets", type=Path, help="folder for contact sheets")
    parser.add_argument("--speed", action="store_true", help="measure the time of a picture")
    parser.add_argument("--page", type=Path, help=f"page with the markers {BEGIN} and {SPEED_BEGIN}")
    a = parser.parse_args()
    if a.sheets:
        a.sheets.mkdir(parents=True, exist_ok=True)
        for folder in a.assets:
            sheet(folder, a.sheets)
    elif a.assets:
        head = ["asset", "PSNR in the mask", "SSIM", "flicker of the clip", "splats", *(f"{s}, {m}" for s, m in STYLES)]
        text = table(head, [measured(folder) for folder in a.assets])
        print(text)
        if a.page:
            replace_section(a.page, text, BEGIN, END)
    if a.speed:
        text = table(["100 000 splats at 1280 x 720, two cores", "median", "", "goal"], speeds())
        print(text)
        if a.page:
            replace_section(a.page, text, SPEED_BEGIN, SPEED_END)


if __name__ == "__main__":
    main()
