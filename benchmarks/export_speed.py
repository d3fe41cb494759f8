"""Export of 100 frames of 100,000 splats: seconds, size, and whether memory stays flat in the number of frames.

    python benchmarks/export_speed.py [frames] [splats] [--formats splats,mesh,vdb,html,gltf,spz]

An asset of that size is made up in a temporary folder (a block of splats that flows and wobbles over a plane) and
exported by the command line, each format in a process of its own, once with a tenth of the frames and once with all:
peak memory should not differ. For the page its limit of 100,000 splats and 64 MB holds, and what it left out is shown.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

FORMATS = ("splats", "spz", "mesh", "vdb", "gltf", "html")
INTERVAL = 0.04


def frames(folder: Path, count: int, splats: int) -> None:
    """The frames of a body that moves."""
    from fluidlift.io.frames import FIRST_FRAME
    from fluidlift.scene.splat_files import write_frame
    from fluidlift.types import Gaussians, sh_from_rgb

    rng = np.random.default_rng(0)
    rest = rng.uniform([-0.9, -0.4, 0.02], [0.9, 0.4, 0.2], (splats, 3))
    quats = rng.normal(size=(splats, 4))
    scales, rgb = rng.uniform(0.004, 0.009, (splats, 3)), rng.uniform(0.1, 0.6, (splats, 3))
    ids = np.arange(splats, dtype=np.int32)
    for k in range(count):
        phase = 6.0 * rest[:, 0] + 8.0 * k * INTERVAL
        velocity = np.stack([np.full(splats, 0.5), 0.1 * np.sin(phase), 0.15 * np.cos(phase)], axis=1)
        moved = rest + [0.5 * k * INTERVAL, 0, 0] + 0.02 * np.stack([0 * phase, np.cos(phase), np.sin(phase)], axis=1)
        moved[:, 0] = (moved[:, 0] + 0.9) % 1.8 - 0.9
        turned = quats + 0.1 * np.sin(phase)[:, None]
        turned /= np.linalg.norm(turned, axis=1, keepdims=True)
        # who wraps around is another splat, as at an inlet
        number = ids + splats * np.floor((rest[:, 0] + 0.5 * k * INTERVAL + 0.9) / 1.8).astype(np.int32)
        g = Gaussians(
            moved, turned, scales * (1 + 0.2 * np.sin(phase)[:, None]), np.full(splats, 0.8), sh_from_rgb(rgb)
        )
        write_frame(folder, FIRST_FRAME + k, g, ids=number, velocities=velocity)


def asset(folder: Path, count: int, splats: int) -> None:
    """A finished asset with such frames."""
    from fluidlift.io.asset_folder import save_asset, update_manifest
    from fluidlift.scene.splat_files import frame_file, read_frame
    from fluidlift.types import (
        FaceVelocity,
        FluidAsset,
        FluidParameters,
        Grid,
        PinholeCamera,
        Similarity3,
        Terrain,
        TriangleMesh,
    )  # fmt: skip

    frames(folder, count, splats)
    (folder / "work").mkdir()
    (folder / "work" / ".fluidlift").write_text("made up\n")
    grid = Grid((90, 40, 20), 0.02, (-0.9, -0.4, -0.05))
    z = grid.low[2] + grid.spacing * np.arange(21)
    distance = np.broadcast_to(z, tuple(n + 1 for n in grid.shape)).astype(np.float32)
    corners = np.array([[-1, -0.5, 0], [1, -0.5, 0], [1, 0.5, 0], [-1, 0.5, 0]], np.float32)
    mesh = TriangleMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), np.full((4, 3), 0.5, np.float32))
    save_asset(folder, FluidAsset(
        kind="stream", rest=read_frame(frame_file(folder, 1001)).gaussians,
        terrain=Terrain(grid, distance, np.array([1.0, 0, 0]), mesh), grid=grid,
        cell_types=np.ones(grid.shape, np.uint8), velocity=FaceVelocity.zeros(grid), parameters=FluidParameters(),
        estimates={}, camera=PinholeCamera.looking(np.array([0.0, -2.5, 1.2]), np.zeros(3), 50, (640, 360)),
        world_from_canonical=Similarity3(), interval=INTERVAL, frame_count=count, provenance={},
    ))  # fmt: skip
    update_manifest(folder, simulation={"frames": count, "frame_interval": INTERVAL})


def exported(folder: Path, out: Path, to: str, last: int) -> dict:
    """Seconds, bytes and peak memory of one export, in a process of its own."""
    command = [sys.executable, "-m", "fluidlift", "export", str(folder), "-o", str(out), "--to", to,
               "--frames", f"1001-{last}", "--json"]  # fmt: skip
    began = time.perf_counter()
    told, error = out.with_suffix(".json"), out.with_suffix(".log")
    to_files = [(os.POSIX_SPAWN_OPEN, n, str(p), os.O_CREAT | os.O_WRONLY, 0o600) for n, p in ((1, told), (2, error))]
    child = os.posix_spawn(sys.executable, command, os.environ, file_actions=to_files)
    _, status, used = os.wait4(child, 0)
    code = os.waitstatus_to_exitcode(status)
    if code not in (0, 4):
        return {"code": code, "error": error.read_text()[-400:]}
    size = sum(p.stat().st_size for p in out.rglob("*") if p.is_file())
    found = {"seconds": round(time.perf_counter() - began, 1), "mb": round(size / 1e6, 1),
             "peak_mb": round(used.ru_maxrss / 1024)}  # fmt: skip
    return found | {"warnings": json.loads(told.read_text())["warnings"]}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("frames", type=int, nargs="?", default=100)
    parser.add_argument("splats", type=int, nargs="?", default=100_000)
    parser.add_argument("--formats", default=",".join(FORMATS))
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "made_up.fluid"
        folder.mkdir()
        asset(folder, args.frames, args.splats)
        rows = {}
        for to in args.formats.split(","):
            few = max(args.frames // 10, 1)
            rows[to] = {n: exported(folder, Path(name) / f"{to}_{n}", to, 1000 + n) for n in (few, args.frames)}
            print(json.dumps({to: rows[to]}), flush=True)


if __name__ == "__main__":
    main()
