"""What packing the frames of an asset costs and saves: bytes, seconds, and what is lost of the numbers and the picture.

    python benchmarks/packed_frames.py ASSET

The frames of the asset are read, written as PLY and packed again, one after the other. Of an asset whose frames are
packed already, the losses are those of a second time, and mostly nothing: frames that are PLY tell more.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from fluidlift.io.asset_folder import load_asset
from fluidlift.io.frames import FluidFrame
from fluidlift.io.packed_splats import read_packed, write_packed
from fluidlift.io.ply import read_splats, write_gaussians
from fluidlift.look.rasterize import render
from fluidlift.scene.splat_files import frame_files, read_frame
from fluidlift.types import PinholeCamera
from fluidlift.types.gaussians import SH_C0

T = TypeVar("T")


def timed(seconds: list[float], do: Callable[..., T], *given: Any, **named: Any) -> T:
    """What a function gives; its seconds are noted."""
    began = time.perf_counter()
    found = do(*given, **named)
    seconds.append(time.perf_counter() - began)
    return found


def lost(before: FluidFrame, after: FluidFrame, camera: PinholeCamera) -> dict[str, float]:
    """The largest differences of two frames, and how alike their pictures are."""
    a, b = before.gaussians, after.gaussians
    speed = float(np.sqrt(np.square(before.velocities, dtype=np.float64).sum(axis=1).mean()))
    pictures = [render(g, camera).image.astype(np.float64) for g in (a, b)]
    turn = np.clip(np.abs((a.quats.astype(np.float64) * b.quats).sum(axis=1)), 0, 1).min()
    return {
        "position, median smallest axis": float(np.abs(a.means - b.means).max() / np.median(a.scales.min(axis=1))),
        "velocity, root mean square": float(np.abs(before.velocities - after.velocities).max()) / speed,
        "scale, share": float(np.abs(b.scales / a.scales - 1).max()),
        "color, of 255": 255 * SH_C0 * float(np.abs(a.sh[:, 0] - b.sh[:, 0]).max()),
        "opacity": float(np.abs(a.opacities - b.opacities).max()),
        "turn, degrees": float(np.degrees(2 * np.arccos(turn))),
        "ids that differ": float((before.ids != after.ids).sum()),
        "PSNR, dB (the least)": -10 * float(np.log10(max(np.square(pictures[0] - pictures[1]).mean(), 1e-12))),
    }


def main() -> None:
    """Print two tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("asset", type=Path)
    asset = parser.parse_args().asset
    camera, splats, worst = load_asset(asset).camera, 0, {}
    size, seconds = (
        {"PLY": 0, "packed": 0},
        {f"{do} {kind}": [] for do in ("write", "read") for kind in ("PLY", "packed")},
    )
    with tempfile.TemporaryDirectory(dir=asset) as place:
        plain, packed = Path(place) / "a.ply", Path(place) / "a.flsp"
        for file in frame_files(asset):
            frame = read_frame(file)
            given = {"ids": frame.ids, "velocities": frame.velocities}
            timed(seconds["write PLY"], write_gaussians, plain, frame.gaussians, **given)
            timed(seconds["write packed"], write_packed, packed, frame.gaussians, **given)
            timed(seconds["read PLY"], read_splats, plain)
            found = lost(frame, timed(seconds["read packed"], read_packed, packed), camera)
            worst = {name: (min if "PSNR" in name else max)(worst.get(name, v), v) for name, v in found.items()}
            size = {"PLY": size["PLY"] + plain.stat().st_size, "packed": size["packed"] + packed.stat().st_size}
            splats += len(frame.ids)
    print("| kind | MB | bytes a splat | write a frame, s (median) | read, s |\n|---|---|---|---|---|")
    for kind, total in size.items():
        times = (np.median(seconds[f"{do} {kind}"]) for do in ("write", "read"))
        print(f"| {kind} | {total / 1e6:.1f} | {total / splats:.1f} | " + " | ".join(f"{t:.3f}" for t in times) + " |")
    print("\n| lost at most | |\n|---|---|")
    for name, value in worst.items():
        print(f"| {name} | {value:.3g} |")


if __name__ == "__main__":
    main()
