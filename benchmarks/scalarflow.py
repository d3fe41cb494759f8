"""Captured smoke, lifted from one view and scored in four others, beside methods that did the same.

    python benchmarks/scalarflow.py ScalarReal                        made here, drawn from the other views, scored
    python benchmarks/scalarflow.py ScalarReal --until 60             made of the first 60 frames, scored on the rest
    python benchmarks/scalarflow.py ScalarReal --tiles static/videos  and the others, from the films of their page

`ScalarReal` is the folder of that name of HyFluid's repository (`data/ScalarReal`: train00.mp4 to train04.mp4 and
info.json, a part of ScalarFlow); `static/videos` is the folder of that name of FluidNexus' project page. Neither is
part of this project, and nothing is fetched. Smaller copies of the films do: poses and focal lengths go with them.

The input is train02. What is told beside it: its focal length and tilt, and where the middle of the authors' box is,
which says how far the smoke is away, and so how large; the other methods are given the box as well. Nothing of the
other views is seen. Ours is one re-simulation of one body, so that "new view" and "re-simulation" are the same; the
others reconstruct each frame for "new view". Pictures are drawn at the films' own size, on black.
"""

from __future__ import annotations

import argparse
import json
import platform
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from report import put
from smoke_scores import FIGURES, SMOKE, VIEWS, mean_of, scores, tiles_scored

from fluidlift.config import build_config
from fluidlift.errors import InputRejected
from fluidlift.io.asset_folder import load_asset, read_manifest
from fluidlift.io.kept_values import recalled
from fluidlift.io.video import read_clip
from fluidlift.pipeline import Inputs, RenderRequest, make, render_asset, resimulate
from fluidlift.scene import SimulationRequest
from fluidlift.types import PinholeCamera, RigidTransform

INPUT = "02"
Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""z-up world <- the authors' y-up world"""
OPENCV = np.diag([1.0, -1.0, -1.0])
"""OpenCV's axes of a camera <- OpenGL's"""
FIRST = 1001
"""number of an asset's first frame"""
OTHERS = {
    "new views": {
        "PINF": (22.7, 13.9, 0.31, 0.11), "HyFluid": (23.7, 14.5, 0.38, 0.11), "STG": (14.6, 13.1, 0.29, 1.46),
        "FluidNexus": (32.8, 21.5, 0.88, 0.80), "input copied": (21.9, 11.7, 0.43, 0.64),
    },
    "foretold from 60 frames": {
        "PINF": (20.9,), "HyFluid": (22.1,), "STG": (16.7,), "FluidNexus": (29.3, 20.4, 0.86, 0.78),
        "input copied": (20.4,),
    },
}  # fmt: skip
"""of the same scene in the order of `smoke_scores.FIGURES`: measured once on the tiles of the films nvs_scalar and
future_scalar (`--tiles` does it anew), 640 x 1156 px of 8-bit H.264. Their papers say 22.68, 22.23, 19.85 and 32.45 dB
for new views, and 28.51 dB for FluidNexus' future"""


@dataclass(frozen=True)
class View:
    """A camera and its film."""

    film: Path
    camera: PinholeCamera
    """in the data's own world, turned z up, m"""
    frames: np.ndarray
    """intensities f32 [t,h,w] in [0, 1]"""
    fps: float


@dataclass(frozen=True)
class Data:
    """The authors' folder."""

    views: dict[str, View]
    """by number, 00 to 04"""
    middle: np.ndarray
    """of the box, m, z up"""

    @classmethod
    def read(cls, folder: Path) -> Data:
        """All views.

        Raises:
            InputRejected: info.json or a film is missing or damaged, or films do not fit to each other or to it.
        """
        told = _info(folder)
        entries = {}
        for entry in [*told.get("train_videos", []), *told.get("test_videos", [])]:
            entries[str(entry.get("file_name", "")).removeprefix("train").removesuffix(".mp4")] = entry
        wanted = (INPUT, *VIEWS)
        lacking = [f"train{name}.mp4" for name in sorted(wanted) if name not in entries]
        if lacking:
            raise InputRejected(f"info.json without {', '.join(lacking)}", "a camera for each of train00 to train04")
        views = {name: _view(folder, entries[name], f"train{name}.mp4") for name in sorted(wanted)}
        shapes = {name: view.frames.shape for name, view in views.items()}
        if len(set(shapes.values())) > 1:
            raise InputRejected(f"films of {shapes} (frames, height, width)", "five of one length and size")
        if not (views[INPUT].frames > SMOKE).any():
            raise InputRejected(f"train{INPUT}.mp4 without smoke", "bright smoke on black", "films as they came")
        try:
            middle = np.asarray(told["render_center"], np.float64).reshape(3)
        except (KeyError, TypeError, ValueError):
            raise InputRejected("info.json without render_center", "the middle of the box, 3 numbers") from None
        return cls(views, Z_UP @ middle)

    @property
    def input(self) -> View:
        """What is lifted."""
        return self.views[INPUT]

    @property
    def tilt(self) -> tuple[float, float]:
        """Degrees that the input's camera looks below the horizon, and that its picture is turned clockwise."""
        right, down, forward = self.input.camera.camera_from_world.rotation
        return -float(np.degrees(np.arcsin(forward[2]))), float(np.degrees(np.arctan2(right[2], -down[2])))

    def across(self, until: int | None = None) -> float:
        """The longest side of what is ever smoke in the input's first frames, m, at the middle's distance."""
        ever = (self.input.frames[:until] > SMOKE).any(axis=0)
        sides = [np.flatnonzero(np.any(ever, axis=axis)) for axis in (0, 1)]
        camera = self.input.camera
        depth = float(camera.camera_from_world.points(self.middle[None])[0, 2])
        return max(float(np.ptp(side) + 1) for side in sides) * depth / camera.focal[0]

    def away(self) -> float:
        """Level distance of the middle before the input's camera, m: the same at all heights of what stands upright."""
        return _level_distance(self.input.camera, self.middle[None])


def _info(folder: Path) -> dict[str, Any]:
    path = folder / "info.json"
    if not path.is_file():
        raise InputRejected(f"no info.json in '{folder}'", "data/ScalarReal of HyFluid's repository")
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputRejected(f"info.json that is no JSON ({error})", "the authors' own") from None
    if not isinstance(told, dict):
        raise InputRejected("info.json that is no object", "the authors' own")
    return told


def _view(folder: Path, entry: dict[str, Any], name: str) -> View:
    if not (folder / name).is_file():
        raise InputRejected(f"no {name} in '{folder}'", "all five films")
    clip = read_clip(folder / name, max_size=4096)
    width, height = clip.size
    try:
        pose = np.asarray(entry["transform_matrix"], np.float64).reshape(4, 4)
        angle = float(entry["camera_angle_x"])
        tall, wide = entry.get("camera_hw", (height, width))
    except (KeyError, TypeError, ValueError) as error:
        raise InputRejected(f"the camera of {name} ({error!r})", "camera_angle_x and transform_matrix, 4 x 4") from None
    turn = pose[:3, :3]
    if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-4) or np.linalg.det(turn) < 0 or not 0 < angle < np.pi:
        raise InputRejected(f"a camera of {name} that is turned and stretched", "a rigid transform_matrix")
    if abs(width / height - wide / tall) > 0.01 * wide / tall:
        raise InputRejected(f"{name} of {width} x {height} px", f"the sides of {wide} x {tall} px", "do not crop it")
    rotation = OPENCV @ (Z_UP @ turn).T
    rigid = RigidTransform(rotation, -rotation @ Z_UP @ pose[:3, 3])
    focal = 0.5 * width / float(np.tan(0.5 * angle))
    camera = PinholeCamera((focal, focal), (0.5 * width, 0.5 * height), clip.size, rigid)
    return View(folder / name, camera, np.stack([grey(f) for f in np.asarray(clip.frames)]), 1.0 / clip.interval)


def grey(picture: np.ndarray) -> np.ndarray:
    """Intensity f32 [h,w] of u8 [h,w,3]."""
    return cv2.cvtColor(np.ascontiguousarray(picture), cv2.COLOR_RGB2GRAY).astype(np.float32) / 255.0


def _level_distance(camera: PinholeCamera, points: np.ndarray) -> float:
    """Median of points [n,3] along the level part of the view."""
    forward = camera.camera_from_world.rotation[2] * [1.0, 1.0, 0.0]
    forward = forward / np.linalg.norm(forward)
    return float(np.median((points - camera.position) @ forward))


def lifted(data: Data, folder: Path, *, until: int | None = None, settings: Sequence[str] = ()) -> Path:
    """An asset of the input alone; simulated on to the film's end where it was made of the first `until` frames.

    Raises:
        InputRejected: as `make`.
    """
    view = data.input
    beside = folder.with_suffix(".camera.json")
    beside.parent.mkdir(parents=True, exist_ok=True)
    told = view.camera.to_dict()
    beside.write_text(json.dumps({k: told[k] for k in ("width", "height", "K")}), encoding="utf-8")
    pitch, roll = data.tilt
    flat = {"shape.kind": "plume", "shape.pitch": pitch, "shape.roll": roll, "shape.size": data.across(until),
            "read.duration": None if until is None else until / view.fps}  # fmt: skip
    config = build_config("draft", overrides=["show.usd=false", *settings], flat=flat)
    make(Inputs(view.film, camera=beside), folder, config)
    if until is not None:
        frames = len(view.frames) - _begins(folder)
        resimulate(folder, request=SimulationRequest(duration=frames / view.fps))
    return folder


def _begins(folder: Path) -> int:
    """Frame of the film that the asset's first one is."""
    manifest = read_manifest(folder)
    read = recalled(folder, manifest, "read")
    if read is None:
        raise InputRejected(f"'{folder.name}' without its work folder", "an asset as it was made", "make it again")
    return int(read.kept[int(manifest["metrics"]["rest_frame"])])


def camera_in_asset(data: Data, name: str, camera: PinholeCamera, points: np.ndarray) -> PinholeCamera:
    """A view's camera in the world of an asset.

    Args:
        data: of the views.
        name: of the view.
        camera: the asset's own of the input.
        points: [n,3] of the asset's body, m in its world: it stands where the middle of the data's box is.
    """
    scale = data.away() / _level_distance(camera, points)
    wanted, seen = data.views[name].camera, data.input.camera.camera_from_world
    turn = wanted.camera_from_world.rotation @ seen.rotation.T
    own = camera.camera_from_world
    moved = (wanted.camera_from_world.translation - turn @ seen.translation) / scale + turn @ own.translation
    return PinholeCamera(wanted.focal, wanted.center, wanted.size, RigidTransform(turn @ own.rotation, moved))


def drawn(data: Data, asset: Path, work: Path, name: str) -> tuple[list[np.ndarray], int]:
    """The asset's pictures from a view, intensities [h,w] on black, and the frame of the film that the first one is."""
    loaded, begins = load_asset(asset), _begins(asset)
    count = min(int(read_manifest(asset)["simulation"]["frames"]), len(data.input.frames) - begins)
    camera = camera_in_asset(data, name, loaded.camera, loaded.rest.means)
    folder = work / f"view{name}"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    file = folder / "camera.json"
    file.write_text(json.dumps(camera.to_dict()), encoding="utf-8")
    request = RenderRequest(str(file), frames=(FIRST, FIRST + count - 1), background="none", look="splats")
    render_asset(asset, folder / "pictures", request)
    found = []
    for k in range(count):
        picture = cv2.imread(str(folder / "pictures" / f"{FIRST + k}.png"), cv2.IMREAD_UNCHANGED)
        assert picture is not None, f"frame {k} of view {name} was not drawn"
        alpha = picture[..., 3:].astype(np.float32) / 255.0
        found.append(grey(np.round(picture[..., 2::-1] * alpha).astype(np.uint8)))
    return found, begins


def scored(data: Data, asset: Path, work: Path, *, since: int = 0) -> dict[str, dict[str, float]]:
    """Figures of the asset and of the copied input, means over the new views, and of the asset in the input's own.

    Frames before the asset's first one count as empty: there is no smoke in it yet.
    """
    ours, copied, own = [], [], {}
    for name in (INPUT, *VIEWS):
        pictures, begins = drawn(data, asset, work, name)
        truth = data.views[name].frames[: begins + len(pictures)]
        shown = [*([np.zeros_like(truth[0])] * begins), *pictures]
        found = scores(shown[since:], truth[since:], since)
        if name == INPUT:
            own = found
            continue
        ours.append(found)
        copied.append(scores(data.input.frames[since : len(truth)], truth[since:], since))
    return {"ours": mean_of(ours), "input copied, here": mean_of(copied), "ours, input view": own}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="data/ScalarReal of HyFluid's repository")
    parser.add_argument("--until", type=int, help="frames that are given; the rest is foretold")
    parser.add_argument("--tiles", type=Path, help="films of FluidNexus' project page, to measure the others anew")
    parser.add_argument("--work", type=Path, default=Path(".assets/scalarflow"), help="default: .assets/scalarflow")
    parser.add_argument("--set", action="append", default=[], help="a setting of the make; may be repeated")
    parser.add_argument("--dry", action="store_true", help="write no results")
    args = parser.parse_args()
    try:
        data = Data.read(args.folder)
        asset = args.work / ("plume.fluid" if args.until is None else f"plume_{args.until}.fluid")
        lifted(data, asset, until=args.until, settings=args.set)
        found = scored(data, asset, args.work, since=args.until or 0)
        what = "new views" if args.until is None else f"foretold from {args.until} frames"
        if args.tiles is not None:
            found |= tiles_scored(args.tiles, "nvs" if args.until is None else "future")
        else:
            found |= {name: dict(zip(FIGURES, told)) for name, told in OTHERS.get(what, {}).items()}
    except InputRejected as error:
        parser.error(str(error))
    for subject, figures in found.items():
        print(f"{what}: {subject:20}" + "".join(f"  {name} {value:.3g}" for name, value in figures.items()))
    if not args.dry:
        records = [
            {"subject": f"{what}: {subject}", "figure": name, "value": float(f"{value:.3g}"), "unit": FIGURES[name]}
            for subject, figures in found.items() for name, value in figures.items()
        ]  # fmt: skip
        put("smoke", records, date=time.strftime("%Y-%m-%d"), machine=f"{platform.machine()}, {platform.system()}")


if __name__ == "__main__":
    main()
