"""Surface speeds in m/s next to OpenPIV, the usual tool of river velocimetry, on the same frames.

    pip install openpiv     # GPL: in an environment of its own, never a dependency
    python benchmarks/velocimetry.py --openpiv PATH/TO/python --page docs/experiments/2026-11-motion.md

Frames are laid onto the level plane of the water with the known camera, at the median footprint of a pixel of the
water. What stands still (the mean over time) is taken out of them, as pyorc, which runs such velocimetry on rivers,
does before it correlates. OpenPIV measures on these (`peers/openpiv_run.py`, its own default settings); ours is the
flow in the clip itself, its displacements laid onto the same plane, and its median taken over the pixels of each of
OpenPIV's windows. Both are means over the same pairs of frames. Subjects are the demo, the river case (true camera and
mask; also compared with the truth on the same plane) and the clip geul_river (surveyed camera, drawn mask).

The main stream is where the mean of both speeds is at least half of its 90th percentile. Compared are windows that
show water only, that the clip resolves (a window is at least `RESOLVED` px of the clip wide and high), and where
OpenPIV's mean over the pairs is more than twice its own standard error: elsewhere it has measured nothing.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from motion_subjects import Subject, default_shared, prepare, read_truth, subjects
from page_section import replace_section

from fluidlift.io.images import read_camera, read_distortion, read_mask, undistort_clip, undistort_mask
from fluidlift.io.video import read_clip
from fluidlift.motion.optical_flow import estimate_flow
from fluidlift.motion.sequence import MotionScene, motion_sequence
from fluidlift.types import PinholeCamera, PixelFlow

BEGIN, END = "<!-- velocimetry:begin -->", "<!-- velocimetry:end -->"
PEER = Path(__file__).resolve().parent / "peers" / "openpiv_run.py"
PAIRS = 9
"""pairs of frames averaged; geul_river has no more"""
CLOSE = 0.15
"""share of the speed within which two velocities count as equal"""
WINDOW, STEP = 16, 8
"""px: OpenPIV's last window and its step"""
RESOLVED = 4
"""px of the clip: about two features, the least that a correlation can hold on to"""
SIGNIFICANT = 2.0
"""standard errors"""


@dataclass(frozen=True)
class River:
    """Frames above a level plane."""

    name: str
    frames: np.ndarray
    """u8 [T,H,W,3]"""
    camera: PinholeCamera
    mask: np.ndarray
    """bool [T,H,W]"""
    level: float
    """z of the water, m"""
    interval: float
    flow: np.ndarray | None
    """true displacement [T,H,W,2], where known"""


@dataclass(frozen=True)
class Ground:
    """The raster of the orthorectified pictures."""

    x: np.ndarray
    """m, of the columns"""
    y: np.ndarray
    """m, of the rows, falling: the picture shows north up"""
    spacing: float

    def points(self, level: float) -> np.ndarray:
        """World points [rows, columns, 3]."""
        x, y = np.meshgrid(self.x, self.y)
        return np.stack([x, y, np.full_like(x, level)], axis=-1)


def rivers(work: Path, shared: Path | None) -> Iterator[River]:
    """Demo, river case, geul_river."""
    for subject in subjects(work, shared):
        if subject.name in ("demo", "river", "river_sparse"):
            yield from_truth(subject)
    folder = shared / "clips" / "geul_river" if shared else None
    if folder is None or not folder.is_dir():
        return
    clip = read_clip(folder / "video.mp4", max_size=512)
    camera, lens = read_camera(folder / "camera.json", clip.size), read_distortion(folder / "camera.json")
    mask = read_mask(folder / "mask_hand.png", clip.size, len(clip))
    if lens is not None:
        clip, mask = undistort_clip(clip, camera, lens), undistort_mask(mask, camera, lens)
    level = json.loads((folder / "camera.json").read_text("utf-8"))["water_level_z"]
    every = np.broadcast_to(mask, clip.frames.shape[:3])
    yield River("geul_river", clip.frames, camera, every, level, clip.interval, None)


def from_truth(subject: Subject) -> River:
    """A case, its water taken as level at its mean height."""
    prepare(subject)
    truth = read_truth(subject)
    level = float(np.median(truth.velocity(0)[0][:, 2]))
    return River(
        subject.name, truth.frames, truth.camera, truth.mask, level, truth.case.interval, truth.flow
    )  # fmt: skip


def on_plane(camera: PinholeCamera, uv: np.ndarray, level: float) -> np.ndarray:
    """World points [...,3] where the rays of pixels meet z = level; not a number where they go up."""
    rays = camera.rays(uv)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = (level - camera.position[2]) / rays[..., 2]
    return camera.unproject(uv, np.where(z > 0, z, np.nan))


def ground_of(river: River) -> Ground:
    """A raster over the water of the first frame, its spacing the median footprint of a pixel."""
    points = on_plane(river.camera, river.camera.pixel_grid(), river.level)
    du, dv = (np.diff(points, axis=a)[: points.shape[0] - 1, : points.shape[1] - 1] for a in (1, 0))
    area = np.abs(du[..., 0] * dv[..., 1] - du[..., 1] * dv[..., 0])
    water = river.mask[0]
    spacing = float(np.sqrt(np.nanmedian(area[water[:-1, :-1]])))
    at = points[water & np.isfinite(points).all(axis=-1)]
    low, high = np.percentile(at, 1, axis=0) - WINDOW * spacing, np.percentile(at, 99, axis=0) + WINDOW * spacing
    columns, rows = (int(np.ceil((high[a] - low[a]) / spacing)) for a in (0, 1))
    x = low[0] + (np.arange(columns) + 0.5) * spacing
    return Ground(x, high[1] - (np.arange(rows) + 0.5) * spacing, spacing)


def orthorectified(river: River, ground: Ground, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Grey pictures u8 [count,rows,columns] from straight above; which pixels show water that the clip resolves."""
    uv, z = river.camera.project(ground.points(river.level))
    at = np.where(z[..., None] > 0, uv - 0.5, -1e4).astype(np.float32)
    grey = [cv2.cvtColor(f, cv2.COLOR_RGB2GRAY) for f in river.frames[:count]]
    above = [cv2.remap(g, at[..., 0], at[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE) for g in grey]
    still = river.mask[:count].all(axis=0).astype(np.uint8)
    water = cv2.remap(still, at[..., 0], at[..., 1], cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT) > 0
    # the smaller singular value of d(clip px)/d(ground px): how much of the clip lies under a step on the ground
    gx, gy = np.gradient(uv, axis=1), np.gradient(uv, axis=0)
    trace, det = (gx**2 + gy**2).sum(axis=-1), gx[..., 0] * gy[..., 1] - gx[..., 1] * gy[..., 0]
    finest = np.sqrt(np.maximum(0.5 * (trace - np.sqrt(np.maximum(trace**2 - 4 * det**2, 0.0))), 0.0))
    return moving(np.stack(above)), water & (WINDOW * finest >= RESOLVED)


def moving(pictures: np.ndarray) -> np.ndarray:
    """Pictures without their mean over time, u8, spread over the grey levels (pyorc: `normalize`)."""
    change = pictures.astype(np.float32) - pictures.mean(axis=0, dtype=np.float32)
    low, high = np.percentile(change, [0.5, 99.5])
    return np.clip(255 * (change - low) / max(high - low, 1e-6), 0, 255).astype(np.uint8)


def peer_velocity(python: str, pictures: np.ndarray, ground: Ground, interval: float) -> tuple[np.ndarray, ...]:
    """Column, row (px) and mean velocity [h,w,2] (m/s) of OpenPIV's windows, and which of them are significant."""
    with tempfile.TemporaryDirectory() as folder:
        given, found = Path(folder) / "pairs.npz", Path(folder) / "vectors.npz"
        np.savez(given, first=pictures[:-1], second=pictures[1:])
        subprocess.run([python, str(PEER), str(given), str(found)], check=True, stdout=subprocess.DEVNULL)
        data = dict(np.load(found, allow_pickle=False))
    ok = data["valid"]
    count = np.maximum(ok.sum(axis=0), 1)
    u, v = (np.where(ok, data[k], 0.0).sum(axis=0) / count for k in ("u", "v"))
    spread = sum((np.where(ok, data[k] - m, 0.0) ** 2).sum(axis=0) for k, m in (("u", u), ("v", v)))
    error = np.sqrt(spread / np.maximum(count - 1, 1) / count)
    significant = (ok.mean(axis=0) > 0.5) & (np.hypot(u, v) > SIGNIFICANT * error)
    return data["x"], data["y"], np.stack([u, -v], axis=-1) * ground.spacing / interval, significant


def our_displacement(river: River, count: int) -> np.ndarray:
    """Displacement [count-1,H,W,2] after all steps, px/frame."""
    flow = estimate_flow(river.frames[: count + 2])
    scene = MotionScene(river.camera, None, None, None, "stream", river.interval)
    made = motion_sequence(
        lambda a, b: PixelFlow(flow.displacement[a:b], flow.confidence[a:b]),
        lambda t: river.mask[min(t, len(river.mask) - 1)], len(flow), scene,
        frames=range(count - 1), volume_frames=[],
    )  # fmt: skip
    return np.stack([m.displacement for m in made])


def binned(river: River, displacement: np.ndarray, ground: Ground, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Velocity [h,w,2] (m/s) on the plane, the median over pixels and frames of each window; NaN where it has few."""
    uv = river.camera.pixel_grid()
    start = on_plane(river.camera, uv, river.level)
    columns, rows = x[0], y[:, 0]
    sums: list[list[list[np.ndarray]]] = [[[] for _ in columns] for _ in rows]
    for t, d in enumerate(displacement):
        velocity = (on_plane(river.camera, uv + d, river.level) - start)[..., :2] / river.interval
        m = river.mask[t] & np.isfinite(velocity).all(axis=-1)
        px = (start[m][:, 0] - ground.x[0]) / ground.spacing
        py = (ground.y[0] - start[m][:, 1]) / ground.spacing
        j, i = np.round((px - columns[0]) / STEP).astype(int), np.round((py - rows[0]) / STEP).astype(int)
        inside = (i >= 0) & (i < len(rows)) & (j >= 0) & (j < len(columns))
        order = np.argsort(i[inside] * len(columns) + j[inside], kind="stable")
        cell, values = (i[inside] * len(columns) + j[inside])[order], velocity[m][inside][order]
        for part in np.split(np.arange(len(cell)), np.flatnonzero(np.diff(cell)) + 1):
            if len(part):
                sums[cell[part[0]] // len(columns)][cell[part[0]] % len(columns)].append(values[part])
    out = np.full((len(rows), len(columns), 2), np.nan)
    for i, line in enumerate(sums):
        for j, parts in enumerate(line):
            if parts and sum(map(len, parts)) >= WINDOW:
                # the mean of medians: as OpenPIV's mean over pairs of one vector per window
                out[i, j] = np.mean([np.median(p, axis=0) for p in parts], axis=0)
    return out


def compared(one: np.ndarray, other: np.ndarray, at: np.ndarray) -> dict[str, float]:
    """Ratio of speeds (median, quartiles), share of windows within `CLOSE`, and median angle in degrees."""
    a, b = one[at], other[at]
    speed_a, speed_b = np.linalg.norm(a, axis=-1), np.linalg.norm(b, axis=-1)
    ratio = speed_a / np.maximum(speed_b, 1e-9)
    cosine = (a * b).sum(axis=-1) / np.maximum(speed_a * speed_b, 1e-12)
    low, middle, high = np.percentile(ratio, [25, 50, 75])
    return {
        "ratio": float(middle), "low": float(low), "high": float(high),
        "close": float((np.abs(ratio - 1) <= CLOSE).mean()),
        "angle": float(np.degrees(np.median(np.arccos(np.clip(cosine, -1, 1))))),
    }  # fmt: skip


def measure(river: River, python: str) -> dict[str, object]:
    """Ours, OpenPIV's and, where known, the true velocity on the same windows."""
    count = min(PAIRS + 1, len(river.frames) - 1) if river.flow is not None else min(PAIRS + 1, len(river.frames))
    ground = ground_of(river)
    pictures, water = orthorectified(river, ground, count)
    x, y, peer, significant = peer_velocity(python, pictures, ground, river.interval)
    ours = binned(river, our_displacement(river, count), ground, x, y)
    wet = cv2.erode(water.astype(np.uint8), np.ones((WINDOW, WINDOW), np.uint8))
    inside = wet[np.clip(y.astype(int), 0, water.shape[0] - 1), np.clip(x.astype(int), 0, water.shape[1] - 1)] > 0
    known = inside & np.isfinite(ours).all(axis=-1) & significant
    mean = 0.5 * (np.linalg.norm(ours, axis=-1) + np.linalg.norm(peer, axis=-1))
    stream = known & (mean >= 0.5 * np.percentile(mean[known], 90))
    record: dict[str, object] = {
        "name": river.name, "spacing_m": ground.spacing, "size": list(water.shape[::-1]), "pairs": count - 1,
        "windows": int(stream.sum()), "significant": float(known.sum() / max(inside.sum(), 1)),
        "speed": float(np.median(np.linalg.norm(peer[stream], axis=-1))),
        "ours to OpenPIV": compared(ours, peer, stream),
    }  # fmt: skip
    if river.flow is not None:
        truth = binned(river, river.flow[: count - 1], ground, x, y)
        stream &= np.isfinite(truth).all(axis=-1)
        record["ours to truth"] = compared(ours, truth, stream)
        record["OpenPIV to truth"] = compared(peer, truth, stream)
    return record


def section(records: list[dict[str, object]]) -> str:
    """The table."""
    lines = [
        "| clip | ground px, m | significant | windows | OpenPIV, m/s | compared | ratio of speeds | quartiles "
        "| within 15 % | angle |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in records:
        for pair in ("ours to OpenPIV", "ours to truth", "OpenPIV to truth"):
            f = r.get(pair)
            if isinstance(f, dict):
                lines.append(
                    f"| {r['name']} | {r['spacing_m']:.4f} | {100 * float(str(r['significant'])):.0f} % | "
                    f"{r['windows']} | {r['speed']:.3f} | {pair} | {f['ratio']:.2f} | "
                    f"{f['low']:.2f} to {f['high']:.2f} | {100 * f['close']:.0f} % | {f['angle']:.0f} deg |"
                )
    return "\n".join(lines)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Compare surface velocities with OpenPIV.")
    parser.add_argument("--openpiv", default=sys.executable, help="interpreter that has the package openpiv")
    parser.add_argument("--work", type=Path, default=Path("runs"), help="folder of `motion.py`")
    parser.add_argument("--shared", type=Path, default=default_shared(), help="folder with cases and clips")
    parser.add_argument("--json", type=Path, help="write all figures there")
    parser.add_argument("--page", type=Path, help="replace the velocimetry table of this page")
    args = parser.parse_args()
    args.work.mkdir(parents=True, exist_ok=True)
    cv2.setNumThreads(1)
    records = [measure(river, args.openpiv) for river in rivers(args.work, args.shared)]
    text = section(records)
    print(text)
    if args.json:
        args.json.write_text(json.dumps(records, indent=1), encoding="utf-8")
    if args.page:
        replace_section(args.page, text, BEGIN, END)


if __name__ == "__main__":
    main()
