"""Whether a loop's seam is seen: how much its pictures change from the last to the first, held against the clip.

    python benchmarks/loops.py ASSET [ASSET ...] [--seconds S] [--coarse]

A copy of each asset is made a loop as `fluidlift edit --set loop=true --simulate` does, and drawn from the clip's
camera in the clip's mask over the clip's still background. Mean absolute difference of sRGB, 0 to 1, from one picture
to the next: over the whole mask, and in that part of it (of 8 x 8 parts of the picture) where it changes most. The
seam is the step from the last picture to the first; the fade is the largest step of those that show two instants.

It prints a table for docs/experiments/2026-11-looks.md. Assets need their folder work/ (the clip as it was read).
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np

from fluidlift.io.asset_folder import load_asset, read_manifest, save_asset
from fluidlift.look.rasterize import render
from fluidlift.pipeline import resimulate
from fluidlift.scene import EditSession
from fluidlift.scene.coarse_copy import coarser
from fluidlift.scene.recall import footage_of_asset
from fluidlift.scene.splat_files import frame_file, read_frame

PARTS = 8
"""along each side of the picture"""
LEAST = 0.25
"""of a part that must be fluid for it to count"""


def looped(source: Path, folder: Path, seconds: float | None, *, coarse: bool) -> list[str]:
    """Make a loop of a copy; warnings."""
    shutil.copytree(source, folder, ignore=shutil.ignore_patterns("*.usda", "*.usdc", "preview.mp4"))
    if coarse:
        save_asset(folder, coarser(load_asset(folder)))
    edits = EditSession.open(folder)
    if seconds is not None:
        edits.set("duration", seconds)
    edits.set("loop", True)
    return list(resimulate(folder, overrides=["show.usd=false", "show.preview=false"]).warnings)


def steps(pictures: np.ndarray, mask: np.ndarray, *, around: bool) -> np.ndarray:
    """[t,2] change to the next picture, over the mask and in its busiest part; `around`: also from the last on."""
    height, width = mask.shape
    part = np.add.outer(PARTS * np.arange(height) // height * PARTS, PARTS * np.arange(width) // width)[mask]
    count = np.bincount(part, minlength=PARTS**2)
    full = count > LEAST * height * width / PARTS**2
    found = []
    for k in range(len(pictures) - (not around)):
        change = np.abs(pictures[(k + 1) % len(pictures)] - pictures[k]).mean(axis=1)
        parts = np.bincount(part, change, PARTS**2)[full] / count[full]
        found.append((change.mean(), parts.max() if full.any() else change.mean()))
    return np.array(found)


def measured(source: Path, folder: Path, seconds: float | None, *, coarse: bool) -> str:
    """A row of the table."""
    began = time.perf_counter()
    warnings = looped(source, folder, seconds, coarse=coarse)
    footage = footage_of_asset(folder, read_manifest(folder))
    if footage is None:
        return f"| {source.stem} | has no work/ | | | |"
    asset, count = load_asset(folder), read_manifest(folder)["simulation"]["frames"]
    plate, mask = footage.plate.astype(np.float32) / 255.0, footage.labels.fluid.mean(axis=0) > 0.5
    shown = []
    for k in range(count):
        gaussians = read_frame(frame_file(folder, 1001 + k)).gaussians
        shown.append(np.clip(render(gaussians, asset.camera, background=plate).image[mask], 0.0, 1.0))
    loop = steps(np.stack(shown), mask, around=True)
    clip = steps(np.stack([f[mask] for f in footage.clip.frames]).astype(np.float32) / 255.0, mask, around=False)
    print(f"{source.stem}: {time.perf_counter() - began:.0f} s; {'; '.join(warnings)}", flush=True)
    cells = [f"{mean:.4f}, {most:.4f}" for mean, most in (loop[-1], loop.max(axis=0), np.median(loop, axis=0))]
    own = "{:.4f}, {:.4f}".format(*np.median(clip, axis=0))
    holds = "yes" if (loop[-1] <= np.median(clip, axis=0)).all() else "**no**"
    return f"| {source.stem}{', coarse' * coarse} | {count} | {' | '.join(cells)} | {own} | {holds} |"


def main() -> None:
    """Run all on assets."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("assets", type=Path, nargs="+")
    parser.add_argument("--seconds", type=float)
    parser.add_argument("--coarse", action="store_true", help="cells twice as wide")
    options = parser.parse_args()
    rows = ["| change of the picture: mask, its busiest part | frames | at the seam | largest step of the loop | "
            "its median step | the clip's median step | seam below it |",
            "|---|---|---|---|---|---|---|"]  # fmt: skip
    for source in options.assets:
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place) / source.name
            rows.append(measured(source, folder, options.seconds, coarse=options.coarse))
    print("\n".join(["", *rows]))


if __name__ == "__main__":
    main()
