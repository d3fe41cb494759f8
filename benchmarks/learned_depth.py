"""What a learned depth does to the camera's tilt and to a stream's surface, where nothing is known of the camera.

    python benchmarks/learned_depth.py --cases CASES --work runs --draws 6

For each case with a known truth (a folder with video.mp4, camera.json, truth.npz), the true depth is spoilt as models
spoil it: a slow error of 2.5 % over the picture, noise of 2 %, flicker of 5 %; the field of view is off by 6 %, and
normals are those of the true surfaces, turned as a whole by 4 degrees and rippled by 0.15 rad. Rows: the plane of the
depth replaces what the clip itself shows (as it was before both were weighed), is weighed beside it, and is weighed
together with the normals. Columns: degrees between the found and the true vertical (mean and worst of the draws), and
median relative error of the depth after one factor.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fluidlift.backends.depth_model import DepthModel, Guess
from fluidlift.config import build_config
from fluidlift.io.images import read_camera
from fluidlift.pipeline import Inputs, begin, depths
from fluidlift.pipeline.inputs import GivenFiles
from fluidlift.pipeline.runner import Runner
from fluidlift.pipeline.settings import GivenView
from fluidlift.pipeline.sight import Sighted, sighted
from fluidlift.pipeline.work import Work
from fluidlift.seams import Silence
from fluidlift.shape import depth_surface
from fluidlift.types import PinholeCamera
from fluidlift.types.hints import NOTHING_SAID

SLOW, NOISE, FLICKER, LENS = 0.025, 0.02, 0.05, 0.06
"""relative errors of a model's depth and focal length"""
TURNED, RIPPLED = np.radians(4.0), 0.15
"""rad, errors of its normals: of all together, and of each"""
WAYS = ("replaced", "weighed", "with normals")


@dataclass(frozen=True)
class Truth:
    """Of a case."""

    depth: np.ndarray
    """[t,h,w] m, the fluid before what stands"""
    camera: PinholeCamera
    video: Path

    @classmethod
    def of(cls, folder: Path) -> Truth:
        """Read a case."""
        with np.load(folder / "truth.npz") as z:
            fluid, static = z["depth"].astype(np.float32), z["static_depth"].astype(np.float32)
            visible = np.unpackbits(z["visible"], axis=-1)[:, :, : static.shape[1]].astype(bool)
        depth = np.where(visible & (fluid > 0), fluid, static)
        size = (static.shape[1], static.shape[0])
        return cls(np.where(depth > 0, depth, np.nan), read_camera(folder / "camera.json", size), folder / "video.mp4")

    def normals(self, t: int) -> np.ndarray:
        """float64 [h,w,3], camera axes, of the depth smoothed over two pixels."""
        depth = np.nan_to_num(self.depth[t], nan=float(np.nanmedian(self.depth[t])))
        depth = cv2.GaussianBlur(depth, (0, 0), 2.0)
        grid = self.camera.pixel_grid()
        rays = np.concatenate([(grid - self.camera.center) / self.camera.focal, np.ones((*depth.shape, 1))], axis=-1)
        points = rays * depth[..., None]
        found = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
        return found / np.linalg.norm(found, axis=-1, keepdims=True)


class Spoilt(DepthModel):
    """The truth as a model would see it; frames are asked for in order."""

    def __init__(self, truth: Truth, frames: list[int], seed: int, with_normals: bool) -> None:
        self._rng, self._truth, self._frames = np.random.default_rng(seed), truth, iter(frames)
        size = truth.camera.size
        bent = cv2.resize(self._rng.normal(size=(3, 3)), size, interpolation=cv2.INTER_CUBIC)
        self._slow = SLOW * bent / bent.std()
        axis = np.append(self._rng.normal(size=2), 0.0)
        self._turn = cv2.Rodrigues(axis / np.linalg.norm(axis) * TURNED)[0]
        self._focal = float(max(truth.camera.focal)) * np.exp(LENS * self._rng.normal())
        self._with_normals = with_normals

    def guess(self, image: np.ndarray, camera: PinholeCamera | None) -> Guess:
        """Of the next frame."""
        t, rng, size = next(self._frames), self._rng, (image.shape[1], image.shape[0])
        depth = self._truth.depth[t]
        seen = depth * np.exp(self._slow + NOISE * rng.normal(size=depth.shape) + FLICKER * rng.normal())
        view = float(2.0 * np.degrees(np.arctan(0.5 * max(self._truth.camera.size) / self._focal)))
        normals = None
        if self._with_normals:
            rippled = self._truth.normals(t) @ self._turn.T + RIPPLED * rng.normal(size=(*depth.shape, 3))
            rippled = cv2.resize(rippled / np.linalg.norm(rippled, axis=-1, keepdims=True), size)
            normals = rippled.astype(np.float32)
        values = cv2.resize(seen.astype(np.float32), size, interpolation=cv2.INTER_NEAREST)
        return Guess(values, "metres", view, normals)


def looked(truth: Truth, work: Path, seed: int, way: str) -> Sighted:
    """What geometry begins with, where such a model looks."""
    dummy = work / "no_weights"
    dummy.write_bytes(b"-")
    settings = ["depth.model=moge", f"depth.weights={dummy}"]
    config = build_config("draft", overrides=settings, flat={"shape.kind": "stream"})
    given = GivenFiles.of(Inputs(truth.video))
    runner = Runner(work / truth.video.parent.name, ("read", "flow", "segment", "geometry"), progress=Silence())
    seen = begin.look(runner, given, config)

    def model(name: str, choice: Any) -> DepthModel:
        frames = depths.spread_frames(len(seen[0].clip), model.start, config.depth.frames)
        return Spoilt(truth, frames, seed, way == "with normals")

    def pictures(read, given, camera, start, work):
        model.start = start
        return before(read, given, camera, start, work)

    before, maker, weigh = depths.pictures_of, depths.make_depth_estimator, depth_surface.weighed_up
    depths.pictures_of, depths.make_depth_estimator = pictures, model
    if way == "replaced":
        depth_surface.weighed_up = lambda seen, by_model, error: by_model
    try:
        asked = begin.geometry_settings(seen[0], config, NOTHING_SAID)
        return sighted(*seen, GivenView.of(given, config), asked, work=Work.alone(work))
    finally:
        depths.pictures_of, depths.make_depth_estimator, depth_surface.weighed_up = before, maker, weigh


def figures(truth: Truth, found: Sighted) -> tuple[float, float]:
    """Degrees between the verticals, and median relative error of the depth after one factor."""
    up, true = (c.camera_from_world.rotation[:, 2] for c in (found.canonical, truth.camera))
    size = found.canonical.size
    depth = cv2.resize(truth.depth[found.seen.start], size, interpolation=cv2.INTER_NEAREST)
    use = found.visible & np.isfinite(depth)
    ratio = found.front.depth[use] / depth[use]
    off = float(np.degrees(np.arccos(np.clip(up @ true, -1.0, 1.0))))
    return off, float(np.median(np.abs(ratio / np.median(ratio) - 1.0)))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=Path, required=True, help="folder of cases")
    parser.add_argument("--work", type=Path, required=True, help="keeps what does not depend on the depth")
    parser.add_argument("--only", nargs="+", default=["river", "honey"], help="cases")
    parser.add_argument("--draws", type=int, default=6)
    args = parser.parse_args()
    args.work.mkdir(parents=True, exist_ok=True)
    told: dict[str, Any] = {}
    for name in args.only:
        truth = Truth.of(args.cases / name)
        for way in WAYS:
            found = [figures(truth, looked(truth, args.work, seed, way)) for seed in range(args.draws)]
            off, depth = np.array(found).T
            told[f"{name}, {way}"] = {"up": off.mean(), "worst": off.max(), "depth": depth.mean()}
            print(f"{name:8} {way:13} up {off.mean():.1f} off (worst {off.max():.1f}), depth {depth.mean():.4f}")
    (args.work / "learned_depth.json").write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
