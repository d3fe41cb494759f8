"""How quick the viewer is: from an edit to the first changed frame, live frames per second, opening, memory over play.

    python benchmarks/viewer.py ASSET [--frames 100] [--splats 100000] [--changes 2000]

The server side is measured, up to the message that leaves for the browser: drawing is the graphics card's own
business. Warm kernels; wall-clock seconds, and seconds of processor time, which others on the machine disturb less.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import tempfile
import time
from pathlib import Path

import numpy as np

from fluidlift.io.asset_folder import update_manifest
from fluidlift.io.ply import write_gaussians
from fluidlift.pipeline.preview import Wish
from fluidlift.types import Gaussians
from fluidlift.viewer.app import Viewer, ViewRequest

GRAVITIES = (6.0, 12.0, 4.0, 15.0, 9.0)
"""m/s^2, one edit each"""


def resident() -> float:
    """MB of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def synthetic(source: Path, out: Path, frames: int, splats: int) -> Path:
    """A copy of an asset with so many frames of so many splats."""
    shutil.copytree(source, out, ignore=shutil.ignore_patterns("work", "*.usda", "*.usdc", "splats"))
    (out / "frames" / "splats").mkdir(parents=True)
    rng = np.random.default_rng(0)
    quats = rng.normal(size=(splats, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    means = rng.uniform((-0.8, -0.5, 0.0), (0.8, 0.5, 0.3), (splats, 3))
    body = (quats, rng.uniform(0.003, 0.01, (splats, 3)), np.full(splats, 0.8), rng.normal(0, 0.5, (splats, 1, 3)))
    velocities = np.tile((0.5, 0.0, 0.0), (splats, 1))
    for k in range(frames):
        path = out / "frames" / "splats" / f"{1001 + k}.ply"
        write_gaussians(path, Gaussians(means + 0.01 * k, *body), ids=np.arange(splats), velocities=velocities)
    update_manifest(out, simulation={"frames": frames})
    return out


def live(folder: Path) -> None:
    """Edits of gravity, as a slider makes them, while the one before is still simulated."""
    viewer = Viewer(folder, ViewRequest(port=18100))
    began = time.perf_counter()
    while viewer.preview.phase == "warming up":
        time.sleep(0.01)
    print(f"warming up: {time.perf_counter() - began:.2f} s; {viewer.preview.particles:,} particles")
    firsts, rates, costs = [], [], []
    for k, strength in enumerate(GRAVITIES):
        wish = Wish({"parameters": {"gravity": [0.0, 0.0, -strength]}}, f"gravity {strength:g}")
        began = time.perf_counter()
        viewer.preview.ask(wish)
        while viewer.preview.shown is None or viewer.preview.shown.wish is not wish:
            time.sleep(0.001)
        firsts.append(time.perf_counter() - began)
        began, busy, take = time.perf_counter(), time.process_time(), viewer.preview.shown
        before = len(take.frames)
        while time.perf_counter() - began < 3.0 and not take.complete:
            time.sleep(0.01)
        made = len(take.frames) - before
        rates.append(made / (time.perf_counter() - began))
        costs.append((time.process_time() - busy) / max(made, 1))
        if k == 0:
            print(f"take: {take.total} frames")
    print(f"edit to first changed frame: median {statistics.median(firsts):.2f} s, most {max(firsts):.2f} s")
    print(f"live frames per second: median {statistics.median(rates):.1f}, least {min(rates):.1f}; "
          f"{1e3 * statistics.median(costs):.0f} ms of processor time each, all threads")  # fmt: skip
    viewer.close()


def play(folder: Path, changes: int) -> None:
    """Opening, then many frame changes through the cache and the server's buffer."""
    began = time.perf_counter()
    viewer = Viewer(folder, ViewRequest(port=18100))
    frame = viewer.cache.get(0)
    viewer.stage.show(frame, viewer.parts, viewer.asset.grid.spacing)
    print(f"open, first frame sent: {time.perf_counter() - began:.2f} s ({len(frame.centers):,} splats, "
          f"{viewer.saved.count} frames)")  # fmt: skip
    while viewer.preview.phase == "warming up":
        time.sleep(0.1)
    began, sizes = time.perf_counter(), []
    for k in range(changes):
        frame = viewer.cache.get(k % viewer.saved.count)
        viewer.stage.show(frame, viewer.parts, viewer.asset.grid.spacing)
        if k % max(changes // 10, 1) == 0:
            sizes.append(resident())
    rate = changes / (time.perf_counter() - began)
    print(f"{changes} frame changes: {rate:.1f} per second; resident MB each tenth: {[round(s) for s in sizes]}")
    viewer.close()


def main() -> None:
    """Run both on an asset."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("asset", type=Path)
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--splats", type=int, default=100_000)
    parser.add_argument("--changes", type=int, default=2000)
    options = parser.parse_args()
    print("load average", os.getloadavg(), "cores", os.cpu_count())
    live(options.asset)
    with tempfile.TemporaryDirectory() as place:
        play(synthetic(options.asset, Path(place) / "big.fluid", options.frames, options.splats), options.changes)


if __name__ == "__main__":
    main()
