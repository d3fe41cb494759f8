"""Measures the shape that the embedded generator finds, with the camera of a case and with nothing given, and draws it.

    python benchmarks/geometry.py --work runs
    python benchmarks/geometry.py --work runs --only river --sheets sheets
    python benchmarks/geometry.py --work runs --page docs/experiments/2026-11-geometry.md --before before.json

Subjects are the demo of the package, scenes that the package simulates and films (kept in --work), and the cases below
FLUIDLIFT_SHARED or a folder `shared` beside the repository. Masks and motion are the pipeline's own estimates; only the
stages up to the geometry run, those before it from their cache (`--again` runs them too). Next to it stand bodies that
need no thought: one depth for all, a level plane, the inflated silhouette, each also moved, turned and scaled as a
whole by the search that ours gets (what counts with nothing given); and what the true lens (`--fov`) and the true tilt
(`--pitch`, `--roll`) alone would change. Figures stay in --work (`geometry.json`), so that `--only` measures some
subjects again and the page shows all; `--before` takes such a file of older code, and the page shows old > new.
`--sheets` also draws every clip: the input, its Gaussians from the camera and from two sides, the bed alone.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from clips import subjects as runs
from motion_subjects import Subject, default_shared, prepare, subjects
from page_section import replace_section
from report import table
from scipy import ndimage

from fluidlift.config import JobConfig, build_config
from fluidlift.evaluate.alignment import score_aligned
from fluidlift.evaluate.case import Case, read_case
from fluidlift.evaluate.images import depth_error, depth_scale, resample_nearest
from fluidlift.evaluate.score import score_bed, score_depth, score_up, score_volume
from fluidlift.evaluate.space import align
from fluidlift.evaluate.volumes import align_cameras, behind, in_picture, occupancy_iou
from fluidlift.look.pictures import caption
from fluidlift.look.rasterize import render
from fluidlift.look.scenery import orbit_camera, terrain_surfels
from fluidlift.pipeline import begin
from fluidlift.pipeline.inputs import GivenFiles, Inputs
from fluidlift.pipeline.make import STAGES
from fluidlift.pipeline.runner import Runner
from fluidlift.pipeline.settings import RefineSettings, taken
from fluidlift.pipeline.stages.refine import refine
from fluidlift.pipeline.work import Work
from fluidlift.seams import Silence
from fluidlift.shape.airborne import inside_body
from fluidlift.shape.registration import pose_up
from fluidlift.shape.surface import inflated_surface, level_surface
from fluidlift.types import (
    CellType,
    FaceVelocity,
    FluidAsset,
    FluidParameters,
    Gaussians,
    Grid,
    PinholeCamera,
    concatenate,
    kind_of,
)
from fluidlift.types.stages import Flow, Geometry, Read, Segmentation

BEGIN, END = "<!-- geometry:begin -->", "<!-- geometry:end -->"
FIGURES = {
    "depth": "geometry.depth_error_relative", "relief": "geometry.depth_error_over_relief",
    "iou": "geometry.occupancy_iou", "aligned": "geometry.occupancy_iou_aligned",
    "bed": "geometry.bed_error_relative", "up": "geometry.up_angle",
}  # fmt: skip
PLAIN = ("depth", "iou", "aligned")
"""what bodies without thought are compared in"""
GOAL_IOU, GOAL_DEPTH = 0.7, 0.05
"""of streams and films with their camera"""
GOAL_IOU_ALONE, GOAL_UP = 0.5, 10.0
"""with nothing given: once the body is moved, turned and scaled as a whole; degrees"""
THICKNESS = 0.2
"""of the width: how thick the bodies without thought are taken to be"""
CELLS = 96
"""most along the longest side of such a body where it is moved; else its cells are as wide as the truth's"""


@dataclass(frozen=True)
class Shaped:
    """A clip up to its geometry."""

    lift: tuple[Read, Flow, Segmentation]
    """the clip, and what was seen in it"""
    geometry: Geometry
    seconds: float
    """of processor time, of the geometry alone"""


def shaped(clip: Path, camera: Path | None, folder: Path, again: bool, **told: float) -> Shaped:
    """Run the stages up to the geometry; those before it may come from the cache. `told`: settings of the shape."""
    config, inputs = build_config(preset="draft"), Inputs(clip, camera=camera)
    config = replace(config, shape=replace(config.shape, **told))
    folder.mkdir(parents=True, exist_ok=True)
    force = frozenset({"read", "geometry"} if again else {"geometry"})
    runner, given = Runner(folder, STAGES, force=force, progress=Silence()), GivenFiles.of(inputs)
    seen = begin.look(runner, given, config)
    began = time.process_time()
    geometry = begin.shape(runner, seen, given, config)
    return Shaped(seen, geometry, time.process_time() - began)


def body_of(found: Shaped, config: JobConfig) -> Gaussians:
    """The Gaussians of the body."""
    settings = taken(RefineSettings, config.shape, seed=config.seed)
    with tempfile.TemporaryDirectory() as folder:
        return refine(*found.lift, found.geometry, None, settings, work=Work.alone(Path(folder))).body


def still_asset(found: Shaped) -> FluidAsset:
    """The geometry as an asset at rest: what the figures of space need."""
    g, clip = found.geometry, found.lift[0].clip
    velocity = FaceVelocity(*(np.zeros(g.grid.face_shape(axis), np.float32) for axis in range(3)))
    return FluidAsset(
        g.kind, Gaussians.empty(), g.setting.terrain, g.grid, g.setting.cell_types, velocity, FluidParameters(), {},
        g.camera, g.world_from_canonical, clip.interval, len(clip),
    )  # fmt: skip


def measured(found: Shaped, case: Case) -> dict[str, Any]:
    """Figures of the geometry, and of the bodies without thought."""
    g = found.geometry
    front = np.where(g.mask, g.sighted_depth, 0.0)
    arrays, asset = {"front_depth": front, "rest_frame": g.rest_frame}, still_asset(found)
    figures, scale, frame = score_depth(arrays, case)
    if scale is not None:
        alignment = align(asset, case, scale, frame)
        figures += score_bed(arrays, asset, case, alignment) + score_up(case, alignment)
        figures += score_volume(asset, case, alignment) + score_aligned(asset, case, alignment)
    values = {f.key: f.value for f in figures}
    record: dict[str, Any] = {name: values.get(key) for name, key in FIGURES.items()}
    record |= {"kind": g.kind, "seconds": round(found.seconds, 2), "warnings": list(g.warnings)}
    record["plain"] = plain_bodies(g.mask, asset, case, frame, g.kind)
    return record


def hints(camera: PinholeCamera) -> dict[str, dict[str, float]]:
    """The settings of a true camera that a user may know: the lens alone, the tilt alone, both."""
    up, _ = pose_up(camera)
    lens = {"fov": float(np.degrees(2 * np.arctan(0.5 * max(camera.size) / max(camera.focal))))}
    tilt = {"pitch": up.pitch, "roll": up.roll}
    return {"lens": lens, "tilt": tilt, "lens and tilt": lens | tilt}


def plain_bodies(mask: np.ndarray, asset: FluidAsset, case: Case, frame: int, kind: str) -> dict[str, Any]:
    """Depth error, IoU and IoU, moved of one depth for all, a plane (tilt as known, else the usual), an inflation."""
    camera, size = asset.camera, asset.camera.size
    distance = ndimage.distance_transform_edt(mask)
    ridge = mask & (distance >= ndimage.maximum_filter(distance, size=5) - 1e-9)
    thick = np.full(mask.shape, THICKNESS * 2 * float(np.median(distance[ridge])) / camera.focal[0])
    plane = level_surface(_tilted(camera, kind), mask).depth
    round_ = inflated_surface(camera, mask, "pour")
    bodies = {
        "one depth": (np.ones(mask.shape), thick),
        "plane": (plane, thick * plane),
        "inflation": (round_.depth, 2 * round_.half_thickness),
    }
    truth = resample_nearest(case.depth[frame].astype(np.float32), size)
    out: dict[str, Any] = {}
    for name, (depth, half) in bodies.items():
        seen = mask & (depth > 0)
        scale = depth_scale(np.where(seen, depth, 0.0), truth, seen)
        error = None if scale is None else depth_error(np.where(seen, depth, 0.0), truth, seen, scale)
        iou = None if scale is None else plain_iou((depth, half, seen), camera, case, frame, scale)
        moved = None if scale is None else plain_moved((depth, half, seen), asset, case, frame, scale)
        out[name] = {"depth": None if error is None else error[2], "iou": iou, "aligned": moved}
    return out


def _tilted(camera: PinholeCamera, kind: str) -> PinholeCamera:
    """The camera in a world that is level where it is known to be, and where people usually hold it else."""
    forward = camera.camera_from_world.rotation[2]
    pitch = float(np.degrees(np.arcsin(np.clip(-forward[2], -1, 1))))
    pitch = pitch if pitch > 5.0 else kind_of(kind).usual_pitch[0]
    ahead = (0.0, float(np.cos(np.radians(pitch))), -float(np.sin(np.radians(pitch))))
    posed = PinholeCamera.looking((0.0, 0.0, 0.0), ahead, 50.0, camera.size)
    return PinholeCamera(camera.focal, camera.center, camera.size, posed.camera_from_world)


def plain_iou(shape: tuple[np.ndarray, ...], camera: PinholeCamera, case: Case, frame: int, scale: float) -> float:
    """Occupancy IoU of the body between a depth and that much behind it, on the truth's cells in the picture."""
    depth, thick, seen = shape
    key = int(np.argmin(np.abs(case.key_frames - frame)))
    centers = case.grid.centers().reshape(-1, 3)
    truth = case.occupied(key).reshape(-1)
    posed = align_cameras(case.camera, camera, 1.0).inverse()
    eye = case.camera.position
    mine = inside_body(posed.points(eye + (centers - eye) / scale), depth, depth + thick, seen, camera)
    hidden = truth & behind(centers, case.static_depth, case.camera, case.grid.spacing)
    return occupancy_iou(mine, truth, ~in_picture(centers, case.camera) | hidden) or 0.0


def plain_moved(shape: tuple[np.ndarray, ...], asset: FluidAsset, case: Case, frame: int, scale: float) -> float | None:
    """The largest occupancy IoU of such a body in cells, by the search that ours gets (`score_aligned`)."""
    depth, thick, seen = shape
    pixels = asset.camera.pixel_grid()[seen]
    sides = np.concatenate([asset.camera.unproject(pixels, z[seen]) for z in (depth, depth + thick)])
    low, size = sides.min(axis=0), np.ptp(sides, axis=0)
    spacing = max(case.grid.spacing / scale, float(size.max()) / CELLS)
    grid = Grid(tuple(np.ceil(size / spacing).astype(int) + 1), spacing, tuple(low - 0.5 * spacing))
    inside = inside_body(grid.centers().reshape(-1, 3), depth, depth + thick, seen, asset.camera).reshape(grid.shape)
    cells = np.where(inside, CellType.FLUID, CellType.EMPTY).astype(np.uint8)
    body_ = replace(asset, grid=grid, cell_types=cells, velocity=FaceVelocity.zeros(grid))
    return score_aligned(body_, case, align(body_, case, scale, frame))[0].value


def sheet(found: Shaped, out: Path) -> None:
    """Input, Gaussians in the input view and from two sides, the bed alone: one row."""
    g = found.geometry
    rest, camera = body_of(found, build_config(preset="draft")), g.camera
    ground = terrain_surfels(g.setting.terrain)
    left, right = (orbit_camera(camera, rest.means, azimuth=a) for a in (-60.0, 60.0))
    sky = (0.82, 0.86, 0.9)
    clip = found.lift[0].clip.frames[g.rest_frame]
    views = [clip, _drawn(rest, camera, g.plate / 255.0)]
    views += [_drawn(concatenate([ground, rest]), c, sky) for c in (left, right)]
    views.append(_drawn(ground, left, sky))
    titles = ("input", "input view", "side view", "other side", "bed")
    height = clip.shape[0]
    row = [
        caption(cv2.resize(v, (v.shape[1] * height // v.shape[0], height), interpolation=cv2.INTER_AREA), t)
        for v, t in zip(views, titles, strict=True)
    ]
    cv2.imwrite(str(out), np.concatenate(row, axis=1)[..., ::-1])


def _drawn(gaussians: Gaussians, camera: PinholeCamera, background: Any) -> np.ndarray:
    image = render(gaussians, camera, background=background).image
    return (np.clip(image, 0, 1) * 255).astype(np.uint8)


Records = list[dict[str, Any]]


def page_section(records: Records, before: Records) -> str:
    """The tables: against the truth, against bodies without thought, what hints would change."""
    old = {(r["name"], r["given"]): r for r in before}
    whole = [r for r in records if "plain" in r]
    rows, plain = [], []
    for r in whole:
        was = old.get((r["name"], r["given"]), {})
        figures = [_change(was.get(k), r[k]) for k in ("depth", "relief", "iou", "aligned", "bed", "up")]
        rows.append([r["name"], r["given"], r["kind"], *figures, _number(r["seconds"]), _met(r)])
        bodies = [" / ".join(_number(p.get(k)) for k in PLAIN) for p in (r, *r["plain"].values())]
        plain.append([r["name"], r["given"], *bodies, _beaten(r)])
    head = [
        "subject",
        "given",
        "kind",
        "depth",
        "depth over relief",
        "IoU",
        "IoU, moved",
        "bed",
        "up, degrees",
        "s",
        "goals",
    ]
    lines = table(head, rows)
    lines += ["Depth / IoU / IoU, moved of bodies that need no thought. The verdict is on depth and IoU; with nothing"]
    lines += ["given, where the lens is not known, on depth and IoU, moved:", ""]
    lines += table(["subject", "given", "ours", "one depth", "plane", "inflation", "ours is better in both"], plain)
    told = [r for r in records if "plain" not in r or r["given"] == "nothing"]
    by_name: dict[str, dict[str, str]] = {}
    for r in told:
        shown = f"{_number(r['up'])} / {_number(r['depth'])} / {_number(r['iou'])}"
        by_name.setdefault(r["name"], {})[r["given"]] = shown
    columns = ["nothing", "lens", "tilt", "lens and tilt"]
    if any(len(row) > 1 for row in by_name.values()):
        lines += ["Up (degrees off) / depth / IoU where the true lens or tilt alone is told:", ""]
        lines += table(["subject", *columns], [[n, *(row.get(c, "-") for c in columns)] for n, row in by_name.items()])
    return "\n".join(lines)


def _met(record: dict[str, Any]) -> str:
    """Goals are set for what lies; with nothing given the tilt must be found as well."""
    alone = record["given"] == "nothing"
    if alone:
        met = [("up", (record["up"] or 0.0) <= GOAL_UP), ("IoU", (record["aligned"] or 0.0) >= GOAL_IOU_ALONE)]
    elif kind_of(record["kind"]).nearly_level:
        depth = np.inf if record["depth"] is None else record["depth"]
        met = [("depth", depth < GOAL_DEPTH), ("IoU", (record["iou"] or 0.0) >= GOAL_IOU)]
    else:
        return "-"
    missed = [name for name, good in met if not good]
    return "met" if not missed else f"**not: {', '.join(missed)}**"


def _beaten(record: dict[str, Any]) -> str:
    """Which plain bodies are at least as good, in what; without a camera all are moved before they are compared."""
    space = ("aligned", "IoU, moved", -1) if record["given"] == "nothing" else ("iou", "IoU", -1)
    lost = [
        f"{title} of {name}" for name, p in record["plain"].items()
        for key, title, sign in (("depth", "depth", 1), space)
        if record[key] is None or (p.get(key) is not None and sign * record[key] >= sign * p[key])
    ]  # fmt: skip
    return "yes" if not lost else f"**no**: not {', '.join(lost)}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value if abs(value) >= 5e-4 else 0.0:.3g}"


def _change(before: float | None, now: float | None) -> str:
    return _number(now) if before is None else f"{_number(before)} > {_number(now)}"


def measure(subject: Subject, work: Path, again: bool) -> Records:
    """With its camera, with nothing, and with what may be told of the camera."""
    assert subject.case is not None
    prepare(subject)
    case, records = read_case(subject.case), []
    for given, camera in (("camera", subject.case / "camera.json"), ("nothing", None)):
        found = shaped(subject.video, camera, work / f"{subject.name}.{given}.fluid", again)
        records.append({"name": subject.name, "given": given} | measured(found, case))
    for given, told in hints(case.camera).items():
        found = shaped(subject.video, None, work / f"{subject.name}.nothing.fluid", False, **told)
        figures = {k: v for k, v in measured(found, case).items() if k != "plain"}
        records.append({"name": subject.name, "given": given} | figures)
    return records


def main() -> None:
    """Measure, draw, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True, help="folder for stages and results")
    parser.add_argument("--only", action="append", default=[], help="a subject; may be repeated")
    parser.add_argument("--again", action="store_true", help="masks and motion too")
    parser.add_argument("--sheets", type=Path, help="folder for contact sheets of every clip and case")
    parser.add_argument("--page", type=Path, help=f"page with the markers {BEGIN} and {END}")
    parser.add_argument("--before", type=Path, help="geometry.json of older code")
    a = parser.parse_args()
    cv2.setNumThreads(1)
    a.work.mkdir(parents=True, exist_ok=True)
    kept = a.work / "geometry.json"
    records: dict[str, Records] = {}
    for r in json.loads(kept.read_text("utf-8")) if kept.is_file() and a.only else []:
        records.setdefault(r["name"], []).append(r)
    for subject in subjects(a.work, default_shared()):
        if subject.case is None or (a.only and subject.name not in a.only):
            continue
        records[subject.name] = measure(subject, a.work, a.again)
        for record in records[subject.name]:
            print(json.dumps(record), flush=True)
        kept.write_text(json.dumps([r for rs in records.values() for r in rs], indent=1), encoding="utf-8")
    if a.page is not None:
        before = json.loads(a.before.read_text("utf-8")) if a.before else []
        replace_section(a.page, page_section([r for rs in records.values() for r in rs], before), BEGIN, END)
    if a.sheets is not None:
        a.sheets.mkdir(parents=True, exist_ok=True)
        for run in runs(default_shared(), a.work):
            if a.only and run.name not in a.only:
                continue
            camera = Path(run.options[1]) if run.options else None
            name = run.name.replace(" ", "_")
            sheet(shaped(run.clip, camera, a.work / f"{name}.sheet.fluid", a.again), a.sheets / f"{name}.png")
            print(f"drew {name}", flush=True)


if __name__ == "__main__":
    main()
