"""Measures what each step from a generated body to the rest Gaussians does to picture and shape.

    python benchmarks/refinement.py --work runs
    python benchmarks/refinement.py --work runs --only demo --publish
    python benchmarks/refinement.py --work runs --only speed
    python benchmarks/refinement.py --work runs --only none --page docs/experiments/2026-11-splats.md

Subjects are those of `motion.py` that have a truth: the demo of the package, its own scenes, and the cases below
FLUIDLIFT_SHARED or a folder `shared` beside the repository. The body that comes in is what a generator would give: a
coarse front on the true surface that bridges the rocks, the hollow shell of the true volume behind it, and rubbish
(faint ones, needles, strays), so that the shape is right and what a step spoils can be seen. Every step is scored on
the input view, on the true depth, on the true cells, and from a camera beside. The same is then asked of the pipeline
as it is, with the case's camera and everything else estimated. Figures stay in --work (`refinement_NAME.json`), with
their tables in `refinement.md`; `--page` puts those of all subjects there into a page.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from geometry import body_of, shaped, still_asset
from motion_subjects import ROOT, SCENES, Subject, Truth, default_shared, prepare, read_truth, subjects
from page_section import replace_section
from refinement_page import page
from refinement_scores import Scored, flicker, score, side_camera
from scipy import ndimage

from fluidlift.config import build_config
from fluidlift.evaluate.score import score_depth
from fluidlift.evaluate.space import align
from fluidlift.look.rasterize import render
from fluidlift.shape.fill import fill
from fluidlift.shape.generate import beneath_front, bounded_colours, front_gaussians, picture_colours
from fluidlift.shape.losses import LossWeights
from fluidlift.shape.prune import prune
from fluidlift.shape.refine import refine
from fluidlift.shape.unite import unite, window_length
from fluidlift.shape.warm_start import follow
from fluidlift.types import Gaussians, PinholeCamera, concatenate

BEGIN, END = "<!-- refinement:begin -->", "<!-- refinement:end -->"
PICTURES = ROOT / "docs" / "pictures"
COARSE = 4
"""px between the Gaussians of the body that comes in"""

STEPS = 60
"""of the refinement"""

LOSSES = ("image", "anisotropy", "volume", "scale", "luminance", "depth")
"""terms that are left out one at a time; the last is not in the paper"""


def measure(subject: Subject, publish: bool, work: Path) -> dict[str, Any]:
    """All figures of one subject."""
    cv2.setNumThreads(1)
    prepare(subject)
    truth = read_truth(subject)
    key = len(truth.case.key_frames) // 2
    t = min(int(truth.case.key_frames[key]), len(truth.frames) - 1)
    scored = Scored.of(truth, key, t, _second_view(subject, truth, t))
    record: dict[str, Any] = {"name": subject.name, "frame": t, "held_out": scored.held_out, "ceiling": scored.ceiling}
    record["steps"], record["later"], record["window"] = steps(truth, scored, key, t)
    record["losses"] = losses(truth, scored, t, subject.name if publish and subject.own else None)
    record["flicker"] = flicker(truth, t)
    record["estimated"] = estimated(subject, truth, work)
    return record


def _second_view(subject: Subject, truth: Truth, t: int) -> np.ndarray | None:
    """The scene filmed again from beside, where it was filmed for this; None: the true surface must do."""
    name = subject.name.removeprefix("scene_")
    if subject.name == name:  # a case, or the demo, whose film is older than the code that would make it again
        return None
    from fluidlift.synthetic.record import record
    from fluidlift.synthetic.scenes import scene_of

    settings: dict[str, Any] = {k: v for k, v in SCENES[name].items() if k != "frames"}
    scene = replace(scene_of(name, **settings), camera=side_camera(truth, t))
    return record(scene, max(t + 1, 2), seed=settings["seed"]).frames[t]


def steps(truth: Truth, scored: Scored, key: int, t: int) -> tuple[list[dict[str, Any]], list[list[float]], int]:
    """Figures after each step in the order of the pipeline, likeness of the later frames, frames united."""
    camera, h = truth.camera, truth.case.grid.spacing
    rng = np.random.default_rng(0)
    window = min(window_length(truth.frames[t : t + 13], truth.mask[t], longest=6), len(truth.frames) - t)
    fronts = [_coarse_front(truth, s) for s in range(t, t + window)]
    shell = _shell(truth, key, t)
    rubbish = _rubbish(fronts[0], rng)
    rows = [score("generated", concatenate([fronts[0], rubbish]), scored, shell=shell)]
    began = time.process_time()
    clean, report = prune(concatenate([fronts[0], rubbish]), max_stretch=12.0)
    rows.append(score("prune", clean, scored, time.process_time() - began, (str(report),), shell))
    began = time.process_time()
    first = refine(clean, truth.frames[t], truth.mask[t], camera, iterations=STEPS)
    bodies, later = [bounded_colours(first.gaussians, truth.frames[t], camera)], []
    rows.append(score("refine", bodies[0], scored, time.process_time() - began, first.notes, shell))
    began = time.process_time()
    for s, fresh in zip(range(t + 1, t + window), fronts[1:]):
        options: dict[str, Any] = {"iterations": STEPS // 5}
        warm = follow(
            bodies[-1], fresh, truth.frames[s], truth.mask[s], camera, motion=truth.flow[s - 1],
            depths=(truth.depth[s - 1], truth.depth[s]), **options,
        )  # fmt: skip
        cold = refine(fresh, truth.frames[s], truth.mask[s], camera, **options)
        later.append([warm.psnr_before, warm.psnr_after, cold.psnr_after])
        bodies.append(bounded_colours(warm.gaussians, truth.frames[s], camera))
    pixel = float(np.median(truth.depth[t][truth.mask[t]])) / camera.focal[0]
    others = [
        beneath_front(b, truth.depth[t], truth.mask[t], camera, smallest=1.0, drop_above=True) for b in bodies[1:]
    ]
    united = unite([bodies[0], *others], spacing=max(0.35 * h, 1.2 * pixel), whole_first=True)
    rows.append(score(f"unite ({window})", united, scored, time.process_time() - began, shell=shell))
    began = time.process_time()
    clean, report = prune(united, max_stretch=12.0)
    rows.append(score("prune again", clean, scored, time.process_time() - began, (str(report),), shell))
    began = time.process_time()
    added = fill(concatenate([clean, shell]), spacing=h, rng=rng)
    added = beneath_front(added, truth.depth[t], truth.mask[t], camera, smallest=0.6, drop_above=True)
    rows.append(score("fill", clean, scored, time.process_time() - began, shell=concatenate([shell, added])))
    return rows, later, window


def estimated(subject: Subject, truth: Truth, work: Path) -> list[dict[str, Any]]:
    """Figures of the pipeline's own body, laid over the truth: not refined, refined, and united over frames.

    All are pruned and filled; only the case's camera is given.
    """
    assert subject.case is not None
    found = shaped(subject.video, subject.case / "camera.json", work / f"{subject.name}.camera.fluid", False)
    config, g = build_config(preset="draft"), found.geometry
    arrays = {"front_depth": np.where(g.mask, g.sighted_depth, 0.0), "rest_frame": g.rest_frame}
    _, scale, frame = score_depth(arrays, truth.case)
    if scale is None:
        return []
    alignment = align(still_asset(found), truth.case, scale, frame)
    scored = Scored.of(truth, alignment.key, frame, None)
    rows, frames = [], g.united_frames
    for name, united, iterations in (
        ("generated", 1, 0), ("refine", 1, config.shape.refine_iterations),
        (f"unite ({frames})", frames, config.shape.refine_iterations),
    ):  # fmt: skip
        wanted = replace(config, shape=replace(config.shape, refine_iterations=iterations))
        began = time.process_time()
        made = body_of(replace(found, geometry=replace(g, united_frames=united)), wanted)
        seconds = time.process_time() - began
        laid = made.transformed(alignment.truth_from_asset)
        # without its terrain, what lies behind a rock is seen through it
        rows.append(score(name, laid, scored, seconds, shell=Gaussians.empty()) | {"rocks": None})
    return rows


def _coarse_front(truth: Truth, t: int) -> Gaussians:
    """A coarse body on the visible surface that bridges the rocks, in the blurred colours of a generator."""
    mask, depth = truth.mask[t], truth.depth[t]
    bridged = ndimage.binary_fill_holes(mask)
    index = ndimage.distance_transform_edt(~(mask & (depth > 0)), return_distances=False, return_indices=True)
    blurred = cv2.GaussianBlur(truth.frames[t], (0, 0), COARSE / 2)
    return front_gaussians(blurred, bridged, depth[tuple(index)], truth.camera, stride=COARSE)


def _shell(truth: Truth, key: int, t: int) -> Gaussians:
    """Gaussians on the rim of the true volume behind the visible surface."""
    grid, occupied = truth.case.grid, truth.case.occupied(key)
    rim = occupied & ~ndimage.binary_erosion(occupied, border_value=0)
    points = grid.centers()[rim]
    row, col, z = truth.camera.nearest_pixels(points)
    seen = (truth.depth[t][row, col] > 0) & (z < truth.depth[t][row, col] + 1.5 * grid.spacing)
    points = points[~seen]
    colours = picture_colours(truth.frames[t], points, truth.camera, size=0.5 * grid.spacing)
    return Gaussians.isotropic(points.astype(np.float32), 0.5 * grid.spacing, colours, 0.8)


def _rubbish(front: Gaussians, rng: np.random.Generator) -> Gaussians:
    """What generators leave: 2 % each of faint ones, needles and strays."""
    n = max(len(front) // 50, 1)
    pick = [front.select(np.sort(rng.choice(len(front), n, replace=False))) for _ in range(3)]
    size = float(np.ptp(np.quantile(front.means, [0.02, 0.98], axis=0), axis=0).max())
    faint = Gaussians(pick[0].means, pick[0].quats, 2 * pick[0].scales, np.full(n, 0.03), pick[0].sh)
    long = pick[1].scales.max(1, keepdims=True) * np.float32([20.0, 0.5, 0.5])
    needles = Gaussians(pick[1].means, rng.normal(size=(n, 4)), long, pick[1].opacities, pick[1].sh)
    stray = Gaussians(
        pick[2].means + rng.normal(0, 0.3 * size, (n, 3)), pick[2].quats, pick[2].scales, pick[2].opacities, pick[2].sh
    )
    return concatenate([faint, needles, stray])


def losses(truth: Truth, scored: Scored, t: int, publish: str | None) -> list[dict[str, Any]]:
    """The refinement with all terms, and with each of them left out."""
    front, rows, tiles = _coarse_front(truth, t), [], []
    for name in ("all", *LOSSES):
        weights = LossWeights() if name == "all" else replace(LossWeights(), **{name: 0.0})
        found = refine(
            front, truth.frames[t], truth.mask[t], truth.camera, iterations=STEPS, weights=weights,
            max_gaussians=max(3 * len(front), 1000),
        )  # fmt: skip
        g = found.gaussians
        row = score("all" if name == "all" else f"without {name}", g, scored)
        ordered = np.sort(g.scales, axis=1)
        stretch = ordered[:, 2] / np.maximum(ordered[:, 1], 1e-12)
        size = ordered.prod(1) ** (1 / 3)
        bright = np.abs(g.rgb - 0.5).max(1) > 0.5
        row |= {
            "kept": found.kept, "needles": float((stretch > 2).mean()), "oversaturated": float(bright.mean()),
            "size": float(np.median(size)), "largest": float(np.quantile(size, 0.999) / np.median(size)),
        }  # fmt: skip
        rows.append(row)
        tiles.append(_tile(g, truth.camera, scored, row["step"]))
    if publish:
        _write_tiles(tiles, PICTURES / f"refine_losses_{publish}.png")
    return rows


def _tile(g: Gaussians, camera: PinholeCamera, scored: Scored, name: str) -> np.ndarray:
    """Input view above the view from beside."""
    views = [render(g, c, background=(0.5, 0.5, 0.5)).image for c in (camera, scored.side)]
    picture = (np.clip(np.concatenate(views), 0, 1) * 255 + 0.5).astype(np.uint8)
    picture = cv2.resize(picture, None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA)
    cv2.putText(picture, name, (4, 12), cv2.FONT_HERSHEY_SIMPLEX, 0.35, (255, 255, 255), 1, cv2.LINE_AA)
    return picture


def _write_tiles(tiles: list[np.ndarray], path: Path) -> None:
    """A PNG of 48 colours, which keeps it below 100 kB."""
    from PIL import Image

    while len(tiles) % 4:
        tiles.append(np.full_like(tiles[0], 128))
    whole = np.concatenate([np.concatenate(tiles[i : i + 4], axis=1) for i in range(0, len(tiles), 4)])
    Image.fromarray(whole).quantize(48, dither=Image.Dither.NONE).save(path, optimize=True)


def speed(side: int = 512, count: int = 50_000, iterations: int = 100) -> dict[str, Any]:
    """Seconds of processor time to refine one frame of a textured ball that fills most of a square picture."""
    camera = PinholeCamera.looking(np.array([0.0, -3.0, 0.6]), np.zeros(3), 35, (side, side))
    rng = np.random.default_rng(0)
    p = rng.normal(size=(3 * count, 3))
    p /= np.linalg.norm(p, axis=1, keepdims=True)
    p = 0.8 * p[((camera.position - 0.8 * p) * p).sum(1) > 0][:count]
    wave = np.sin(25 * p[:, 0]) * np.sin(25 * p[:, 2])
    colours = np.stack([0.5 + 0.35 * wave, 0.5 + 0.3 * wave, np.full(len(p), 0.6)], 1)
    sigma = 0.8 * np.sqrt(2 * np.pi * 0.64 / len(p)) * 0.6
    fine = Gaussians.isotropic(p.astype(np.float32), sigma, colours, 0.9)
    seen = render(fine, camera)
    image = (np.clip(seen.image, 0, 1) * 255).astype(np.uint8)
    dull = Gaussians.isotropic(p.astype(np.float32), 1.3 * sigma, 0.5 + 0.3 * (colours - 0.5), 0.8)
    refine(dull.select(slice(0, None, 50)), image, seen.alpha > 0.5, camera, iterations=2)
    began = time.process_time()
    found = refine(dull, image, seen.alpha > 0.5, camera, iterations=iterations, max_gaussians=count)
    seconds = time.process_time() - began
    return {
        "gaussians": len(dull), "side": side, "iterations": iterations, "seconds": round(seconds, 1),
        "psnr_before": found.psnr_before, "psnr_after": found.psnr_after, "kept": found.kept,
    }  # fmt: skip


def main() -> None:
    """Measure, keep, and write the page of all that lies in the work folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("runs"))
    parser.add_argument("--shared", type=Path, default=default_shared())
    parser.add_argument("--only", action="append", help="name of a subject, speed, or none")
    parser.add_argument("--publish", action="store_true", help="pictures of own scenes into docs/pictures")
    parser.add_argument("--page", type=Path, help=f"page with the markers {BEGIN} and {END}")
    options = parser.parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    for subject in subjects(options.work, options.shared):
        if subject.case is None or (options.only and subject.name not in options.only):
            continue
        began = time.perf_counter()
        record = measure(subject, options.publish, options.work)
        record["seconds"] = round(time.perf_counter() - began, 1)
        (options.work / f"refinement_{subject.name}.json").write_text(json.dumps(record, indent=1), encoding="utf-8")
    if not options.only or "speed" in options.only:
        (options.work / "refinement_speed.json").write_text(json.dumps({"speed": speed()}, indent=1), encoding="utf-8")
    text = page([json.loads(p.read_text("utf-8")) for p in sorted(options.work.glob("refinement_*.json"))])
    (options.work / "refinement.md").write_text(text, encoding="utf-8")
    if options.page is not None:
        replace_section(options.page, text, BEGIN, END)
    print(text)


if __name__ == "__main__":
    main()
