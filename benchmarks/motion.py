"""Measures every step from pixels to a divergence-free volume against the truth, and draws it.

    python benchmarks/motion.py --work runs
    python benchmarks/motion.py --work runs --only river --only scene_pour
    python benchmarks/motion.py --work runs --assets runs --before before.json --page docs/experiments/2026-11-motion.md

Subjects are the demo of the package, three scenes that the package simulates and films (kept in --work), the cases and
the real clips with a drawn mask below FLUIDLIFT_SHARED or a folder `shared` beside the repository (mask only). Masks,
depth and camera of the steps are the true ones, so that each step is measured by itself. Results of single subjects
stay in --work (`motion_NAME.json`, `motion_NAME.png`); the page shows all that lie there. Textures that move along
known flows show what each hard situation does alone (`--only situations`). The same code gives the same figures.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from motion_page import BEGIN, END, section
from motion_situations import situations
from motion_steps import (
    STEPS,
    Pixels,
    add_frame,
    lifted_surface,
    measured_frames,
    planar_figures,
    planar_steps,
    surface_figures,
    surface_summary,
    volume_figures,
)
from motion_subjects import ROOT, Subject, Truth, default_shared, prepare, read_truth, real_clip, subjects
from page_section import replace_section

from fluidlift.evaluate.images import mask_iou
from fluidlift.motion.cadence import examine_cadence, without_duplicates
from fluidlift.motion.optical_flow import estimate_flow, flow_picture
from fluidlift.motion.stabilize import stabilise
from fluidlift.shape.segment import segment
from fluidlift.types import PixelFlow, SurfaceMotion, VideoClip

PICTURES = ROOT / "docs" / "pictures"


def measure(subject: Subject, work: Path, assets: Path | None, publish: bool) -> dict[str, Any]:
    """All figures of one subject; leaves its JSON and its picture in the work folder."""
    cv2.setNumThreads(1)
    began = time.perf_counter()
    prepare(subject)
    record = measure_clip(subject) if subject.case is None else measure_case(subject, work, publish)
    record |= {"name": subject.name, "kind": subject.kind, "own": subject.own}
    if assets is not None and subject.case is not None:
        record["asset"] = asset_figures(subject, assets)
    record["seconds"] = round(time.perf_counter() - began, 1)
    (work / f"motion_{subject.name}.json").write_text(json.dumps(record, indent=1), encoding="utf-8")
    return record


def measure_case(subject: Subject, work: Path, publish: bool) -> dict[str, Any]:
    """Planar, surface, volume and mask figures of a clip with a truth."""
    truth = read_truth(subject)
    flow = estimate_flow(truth.frames)
    pixels, lifted, first_lifted = Pixels(), [], []
    frames = measured_frames(len(flow))
    for t in frames:
        found, observed = planar_steps(subject, truth, flow, t)
        add_frame(pixels, truth, t, found, observed)
        lifted.append(surface_figures(truth, t, found["as made"], observed))
        first_lifted.append(surface_figures(truth, t, found["Farneback"], observed))
        if t == frames[len(frames) // 2]:
            draw(subject, truth, t, found, observed, work / f"motion_{subject.name}.png")
            if publish and subject.own:
                draw(subject, truth, t, found, observed, PICTURES / f"motion_{subject.name}.png")
    record = {"frames": frames, **planar_figures(pixels)}
    record["surface"] = {"as made": surface_summary(lifted), "Farneback": surface_summary(first_lifted)}
    record["volume"] = volume(subject, truth, flow)
    clip = VideoClip(truth.frames, np.arange(len(truth.frames)) * truth.case.interval, subject.name)
    # as `fluidlift make` does: masks from the flow of single pairs
    iou = mask_iou(segment(clip, estimate_flow(truth.frames, method="dis")).fluid, truth.mask[: len(truth.frames)])
    record["mask"] = {"iou": float(iou.mean()), "worst": float(iou.min())}
    return record


def volume(subject: Subject, truth: Truth, flow: PixelFlow) -> dict[str, Any]:
    """At the key frame in the middle: from the true surface motion, and from the estimated one."""
    key = len(truth.case.key_frames) // 2
    t = min(int(truth.case.key_frames[key]), len(flow) - 1)
    found, observed = planar_steps(subject, truth, flow, t)
    points, velocities = truth.velocity(t)
    true = SurfaceMotion(points.astype(np.float32), velocities.astype(np.float32), np.ones(len(points), bool))
    surfaces = {"true motion": true, "estimated motion": lifted_surface(truth, t, found["as made"], observed)}
    return {"frame": t, **volume_figures(subject, truth, key, surfaces)}


def measure_clip(subject: Subject) -> dict[str, Any]:
    """Mask of a real clip next to the one that a person drew."""
    clip, drawn = real_clip(subject)
    steady, _ = stabilise(without_duplicates(clip, examine_cadence(clip.frames, clip.times)))
    fluid = segment(steady, estimate_flow(steady.frames, method="dis")).fluid.mean(axis=0) > 0.5
    drawn = drawn if drawn.ndim == 2 else drawn.mean(axis=0) > 0.5
    picture = steady.frames[len(steady) // 2].copy()
    picture[fluid] = (0.6 * picture[fluid] + 0.4 * np.array([255, 60, 60])).astype(np.uint8)
    edge = cv2.morphologyEx(drawn.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0
    picture[edge] = (255, 255, 255)
    return {"mask": {"iou": float(mask_iou(fluid[None], drawn[None])[0])}, "overlay": picture.shape[:2]}


def asset_figures(subject: Subject, assets: Path) -> dict[str, Any] | None:
    """The asset that the pipeline made from the clip, if one lies there: NAME*.fluid."""
    from fluidlift.evaluate import evaluate_asset

    folders = sorted(p for p in assets.glob("*.fluid") if p.name.split(".")[0] == subject.name)
    if not folders or subject.case is None:
        return None
    sheet = evaluate_asset(folders[-1], subject.case)
    keep = ("volume.", "divergence.", "segmentation.", "flow.", "surface.")
    return {f.key: f.value for f in sheet.figures if f.key.startswith(keep)}


def draw(subject: Subject, truth: Truth, t: int, found: dict[str, np.ndarray], observed: np.ndarray, out: Path) -> None:
    """Frame, flow after each step, which pixels count as observed, and the truth, on one scale of speed."""
    mask = truth.mask[t]
    scale = float(np.percentile(np.linalg.norm(truth.flow[t][mask], axis=-1), 98))
    error = np.linalg.norm(found["DIS"] - truth.flow[t], axis=-1)
    bad = error > np.maximum(1.0, 0.5 * np.linalg.norm(truth.flow[t], axis=-1))
    state = np.full((*mask.shape, 3), 96, np.uint8)
    state[mask & observed & ~bad] = (60, 160, 60)
    state[mask & observed & bad] = (220, 60, 40)
    state[mask & ~observed & bad] = (240, 200, 40)
    state[mask & ~observed & ~bad] = (70, 110, 220)
    panels = {"frame": truth.frames[t]}
    panels |= {name: flow_picture(found[name], mask, scale) for name in STEPS if name in found}
    panels |= {"truth": flow_picture(truth.flow[t], mask, scale), "observed": state}
    tiles = [_titled(name, picture) for name, picture in panels.items()]
    across = 5
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % across)
    rows = [np.concatenate(tiles[k : k + across], axis=1) for k in range(0, len(tiles), across)]
    image = np.concatenate(rows, axis=0)
    cv2.imwrite(str(out), cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_PNG_COMPRESSION, 9])


def _titled(name: str, picture: np.ndarray) -> np.ndarray:
    """A picture 240 px wide with its name above."""
    width = 240
    height = round(width * picture.shape[0] / picture.shape[1])
    small = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
    bar = np.full((22, width, 3), 255, np.uint8)
    cv2.putText(bar, name, (4, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
    return np.concatenate([bar, small], axis=0)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="Measure the motion estimate step by step.")
    parser.add_argument("--work", type=Path, default=Path("runs"), help="folder for scenes, results and pictures")
    parser.add_argument("--shared", type=Path, default=default_shared(), help="folder with cases and clips")
    parser.add_argument("--only", action="append", help="subject to measure, or `situations`; may be given again")
    parser.add_argument("--assets", type=Path, help="folder with assets of `make` (NAME.fluid)")
    parser.add_argument("--before", type=Path, help="JSON of an earlier run, shown beside")
    parser.add_argument("--json", type=Path, help="write all figures there")
    parser.add_argument("--page", type=Path, help="replace the motion section of this page; also draws its pictures")
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1), help="subjects at a time")
    parser.add_argument("--table-only", action="store_true", help="measure nothing, show what the work folder holds")
    args = parser.parse_args()
    args.work.mkdir(parents=True, exist_ok=True)
    every = list(subjects(args.work, args.shared))
    known = {s.name for s in every} | {"situations"}
    for name in args.only or []:
        if name not in known:
            parser.error(f"no subject '{name}'; there are {', '.join(sorted(known))}")
    chosen = [] if args.table_only else [s for s in every if not args.only or s.name in args.only]
    with ProcessPoolExecutor(max(args.jobs, 1), mp_context=get_context("spawn")) as pool:
        jobs = [pool.submit(measure, s, args.work, args.assets, args.page is not None) for s in chosen]
        for job in jobs:
            record = job.result()
            print(f"{record['name']}: {record['seconds']} s", flush=True)
    hard = args.work / "situations.json"
    if not args.table_only and (not args.only or "situations" in args.only):
        hard.write_text(json.dumps(situations(), indent=1), encoding="utf-8")
    files = [args.work / f"motion_{s.name}.json" for s in every]
    records = {f.stem.removeprefix("motion_"): json.loads(f.read_text("utf-8")) for f in files if f.is_file()}
    if hard.is_file():
        records["situations"] = json.loads(hard.read_text("utf-8"))
    before = json.loads(args.before.read_text("utf-8")) if args.before else {}
    if args.json:
        args.json.write_text(json.dumps(records, indent=1), encoding="utf-8")
    text = section(records, before)
    print(text)
    if args.page:
        replace_section(args.page, text, BEGIN, END)


if __name__ == "__main__":
    main()
