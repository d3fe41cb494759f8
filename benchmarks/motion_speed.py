"""Seconds per frame of the motion estimate, and whether its memory grows with the clip.

    python benchmarks/motion_speed.py --page docs/experiments/2026-11-motion.md
    python benchmarks/motion_speed.py --only memory --seconds 30 300

Speed: a moving texture (`synthetic.moving_texture`) 512 px wide on a level pool, on a grid of 64^3 cells of which the
lower half is fluid; two threads; the median of several frames after one that warms up caches and compilers. Flow is
that of a clip of `LENGTH` frames, by the default method, over its pairs; mainstream is the mean over the window, the
direction, the completion and the projection on the screen; lift and volume are single calls. The sum stands next to
the goal of `GOAL` seconds.

Memory: the demo clip, small, at half its rate and played forth and back, through `fluidlift motion` in a process of its
own. What is measured is the peak of its anonymous memory (RssAnon, and that of its children), read from /proc several
times a second: files that are mapped do not count. Linux only.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

THREADS = "2"
for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, THREADS)  # before numpy and numba start

import cv2  # noqa: E402
import numpy as np  # noqa: E402
from page_section import replace_section  # noqa: E402

BEGIN, END = "<!-- motion-speed:begin -->", "<!-- motion-speed:end -->"
GOAL = 1.5
"""s per frame at 512 px with 64^3 cells on 2 cores"""
FRAMES = 5
LENGTH = 16
"""frames of the clip: its flow is estimated as a whole and its time shared among the pairs"""
CELLS = 64
SIZE = (512, 384)
LOOPED, LOOPED_FPS = (160, 104), 12.5
"""px and frames per second of the clip of the memory test"""
LOOPED_CELLS = 32
"""cells along its grid: the volume is solved for every frame"""


def median_seconds(call: Callable[[int], Any], frames: int = FRAMES) -> tuple[float, Any]:
    """Of frames 1, 2, ...; frame 0 warms up. Also what the last call returned."""
    result, seconds = call(0), []
    for k in range(1, frames + 1):
        began = time.perf_counter()
        result = call(k)
        seconds.append(time.perf_counter() - began)
    return statistics.median(seconds), result


def speed() -> dict[str, float]:
    """Median seconds per frame of each stage."""
    from fluidlift.motion.direction import mainstream_direction
    from fluidlift.motion.lift import lift_flow
    from fluidlift.motion.mainstream import complete_flow
    from fluidlift.motion.optical_flow import estimate_flow
    from fluidlift.motion.screen_divergence import project_screen_divergence, validated_reach
    from fluidlift.motion.temporal import smoothed_flow
    from fluidlift.motion.volume import VolumeSolver
    from fluidlift.synthetic.moving_texture import Situation, moving_texture

    cv2.setNumThreads(int(THREADS))
    texture = Situation(textured=0.6, noise=2.0)
    clip = moving_texture("bend", frames=LENGTH, size=SIZE, speed=6.0, situation=texture)
    out: dict[str, float] = {}
    whole, flow = median_seconds(lambda _: estimate_flow(clip.frames), frames=2)
    out["flow"] = whole / len(flow)
    camera, depth, terrain, types, grid = pool()
    mask = clip.mask[0]
    still = np.zeros_like(depth)

    def mainstream(k: int) -> tuple[np.ndarray, np.ndarray]:
        mean, trust = smoothed_flow(flow, len(flow) // 2 - k % 2, mask)
        full, seen = complete_flow(mean, trust, mask, mainstream_direction(mean, trust, mask), depth)
        return project_screen_divergence(full, mask, seen, depth, still, camera, reach=reach)[0], seen

    reach = 4.0  # a clip whose constraint is met at all: the dearer case
    out["mainstream"], (full, seen) = median_seconds(mainstream)
    out["once per clip"], _ = median_seconds(
        lambda _: validated_reach(full, mask, seen, depth, still, camera), frames=2
    )
    out["lift"], surface = median_seconds(lambda _: lift_flow(full, seen, mask, depth, depth, camera, 0.04))
    solver = VolumeSolver(terrain, types, grid, kind="stream", mainstream=terrain.mainstream)
    out["volume"], _ = median_seconds(lambda _: solver.velocity(surface))
    out["sum"] = sum(seconds for name, seconds in out.items() if name != "once per clip")
    return out


def pool() -> tuple[Any, np.ndarray, Any, np.ndarray, Any]:
    """A camera over a level pool, its depth, ground, cell types and grid: 64^3 cells, the lower half fluid."""
    from fluidlift.types import CellType, Grid, PinholeCamera, Terrain, TriangleMesh

    spacing = 2.0 / CELLS
    grid = Grid((CELLS, CELLS, CELLS), spacing, (-1.0, -1.0, -1.0))
    camera = PinholeCamera.looking((0.0, -1.6, 1.6), (0.0, 0.0, 0.0), 45.0, SIZE)
    rays = camera.rays(camera.pixel_grid())
    depth = np.where(rays[..., 2] < 0, -camera.position[2] / np.minimum(rays[..., 2], -1e-6), 0.0)
    centers, distance = grid.centers(), grid.nodes()[..., 2] - (grid.origin[2] + 2 * spacing)
    types = np.where(centers[..., 2] < 0, CellType.FLUID, CellType.EMPTY)
    types = np.where(centers[..., 2] < grid.origin[2] + 2 * spacing, CellType.SOLID, types).astype(np.uint8)
    types[:2][types[:2] == CellType.FLUID] = CellType.INFLOW
    types[-2:][types[-2:] == CellType.FLUID] = CellType.OUTFLOW
    empty = TriangleMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int64))
    terrain = Terrain(grid, distance.astype(np.float32), np.array([1.0, 0.0, 0.0]), empty)
    return camera, depth, terrain, types, grid


def looped(path: Path, seconds: float) -> int:
    """The demo clip, small, played forth and back until it lasts so long: a clip without a cut. Returns its frames."""
    from fluidlift.io.video import read_clip, write_video
    from fluidlift.synthetic.demo import demo_clip

    clip = read_clip(demo_clip())
    small = [cv2.resize(f, LOOPED, interpolation=cv2.INTER_AREA) for f in clip.frames]
    once = small + small[-2:0:-1]
    count = round(seconds * LOOPED_FPS)
    write_video(path, (once[k % len(once)] for k in range(count)), LOOPED_FPS, quality=18.0)
    return count


def anonymous_kb(pid: int) -> int:
    """RssAnon of a process and of those that it started, now; 0 for one that has gone."""
    total = 0
    try:
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            if line.startswith("RssAnon:"):
                total += int(line.split()[1])
        for task in Path(f"/proc/{pid}/task").iterdir():
            total += sum(anonymous_kb(int(child)) for child in (task / "children").read_text().split())
    except (OSError, ValueError):
        pass
    return total


def memory(seconds: float, extra: list[str]) -> dict[str, Any]:
    """Peak anonymous memory and wall time of `fluidlift motion` on a clip of this length."""
    with tempfile.TemporaryDirectory() as folder:
        clip = Path(folder) / "clip.mp4"
        frames = looped(clip, seconds)
        command = [sys.executable, "-m", "fluidlift", "motion", str(clip), "-o", str(Path(folder) / "out")]
        command += ["--set", f"shape.cells={LOOPED_CELLS}", *extra]
        began = time.perf_counter()
        with (Path(folder) / "log").open("w+") as log:
            child = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)
            peak = 0
            while child.poll() is None:
                peak = max(peak, anonymous_kb(child.pid))
                time.sleep(0.1)
            log.seek(0)
            message = log.read().strip().splitlines()[-1:]
    return {
        "seconds": seconds, "frames": frames, "exit_code": child.returncode, "peak_mb": peak / 1024,
        "wall_s": time.perf_counter() - began, "message": message if child.returncode else [],
    }  # fmt: skip


def section(records: dict[str, Any]) -> str:
    """Tables of what was measured."""
    lines: list[str] = []
    if "speed" in records:
        s = records["speed"]
        lines += ["| stage | s per frame |", "|---|---|"]
        lines += [f"| {k} | {v:.3f} |" for k, v in s.items()]
        lines += ["", f"Goal: {GOAL} s per frame; {'met' if s['sum'] <= GOAL else 'not met'}."]
    if "memory" in records:
        lines += ["", "| clip, s | frames | peak memory, MB | wall time, s | exit code |", "|---|---|---|---|---|"]
        lines += [
            f"| {m['seconds']:g} | {m['frames']} | {m['peak_mb']:.0f} | {m['wall_s']:.0f} | {m['exit_code']} |"
            for m in records["memory"]
        ]
    return "\n".join(lines).strip()


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Measure speed and memory of the motion estimate.")
    parser.add_argument("--only", choices=["speed", "memory"])
    parser.add_argument("--seconds", type=float, nargs="+", default=[30.0, 300.0], help="clips of the memory test")
    parser.add_argument("--json", type=Path, help="write all figures there; what was not measured is kept")
    parser.add_argument("--page", type=Path, help="replace the speed section of this page")
    parser.add_argument("extra", nargs="*", help="further options for `fluidlift motion`, after --")
    args = parser.parse_args()
    known = json.loads(args.json.read_text("utf-8")) if args.json and args.json.is_file() else {}
    if args.only != "memory":
        known["speed"] = speed()
    if args.only != "speed":
        known["memory"] = [memory(s, args.extra) for s in args.seconds]
    text = section(known)
    print(text)
    if args.json:
        args.json.write_text(json.dumps(known, indent=1), encoding="utf-8")
    if args.page:
        replace_section(args.page, text, BEGIN, END)


if __name__ == "__main__":
    main()
