"""What a learned model of the view does to the camera's tilt and focal length, where nothing is known of the camera.

    python benchmarks/learned_view.py --cases CASES --work runs --draws 8

For each case with a known camera (a folder with video.mp4 and camera.json), a model answers as well as GeoCalib does by
its authors' benchmarks: its pitch, roll and vertical field of view are off by a Gaussian of the standard errors that
are taken for it, the same for all frames of a clip, and by a degree more from frame to frame. "Wrong" is a model that
is 40 degrees off in pitch, with twice as long a lens. Columns: degrees between the found and the true vertical (mean
and worst of the draws), standard error of the pitch that is told, and relative error of the focal length.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.backends.geocalib import PITCH_ERROR, ROLL_ERROR, VIEW_ERROR
from fluidlift.backends.view_model import ViewGuess, ViewModel
from fluidlift.config import build_config
from fluidlift.io.images import read_camera
from fluidlift.pipeline import Inputs, begin, sight, views
from fluidlift.pipeline.inputs import GivenFiles
from fluidlift.pipeline.runner import Runner
from fluidlift.pipeline.settings import GivenView
from fluidlift.pipeline.work import Work
from fluidlift.seams import Silence
from fluidlift.shape.kind import level_camera
from fluidlift.shape.registration import pose_up
from fluidlift.types import PinholeCamera
from fluidlift.types.hints import NOTHING_SAID

FRAME = 1.0
"""degrees by which the answers for the frames of one clip differ"""
WRONG, WRONG_LENS = 40.0, 2.0
WAYS = ("without", "as published", "wrong")


class Answering(ViewModel):
    """The truth as a model would tell it."""

    def __init__(self, truth: PinholeCamera, seed: int, wrong: bool) -> None:
        self._rng = np.random.default_rng(seed)
        true, _ = pose_up(truth)
        high = 2.0 * np.arctan(0.5 * truth.size[1] / truth.focal[1])
        off = self._rng.normal(size=3) * (PITCH_ERROR, ROLL_ERROR, VIEW_ERROR)
        if wrong:
            off = np.array([WRONG if true.pitch < 30.0 else -WRONG, 0.0, 0.0])
        self._pitch, self._roll = true.pitch + off[0], true.roll + off[1]
        seen = np.clip(high + np.radians(off[2]), np.radians(5.0), np.radians(150.0))
        self._over_height = 0.5 / np.tan(0.5 * seen) * (WRONG_LENS if wrong else 1.0)
        self._focal_error = float(np.radians(VIEW_ERROR) / np.sin(high))

    def guess(self, image: np.ndarray, camera: PinholeCamera | None) -> ViewGuess:
        """Of any frame."""
        step = FRAME * self._rng.normal(size=2)
        focal = self._over_height * image.shape[0] if camera is None else camera.focal[0]
        error = self._focal_error if camera is None else 0.0
        return ViewGuess(self._pitch + step[0], self._roll + step[1], float(focal), PITCH_ERROR, ROLL_ERROR, error)


def looked(video: Path, truth: PinholeCamera, work: Path, seed: int, way: str) -> sight.Sight:
    """How a clip is taken to stand before the camera, where such a model looks."""
    dummy = work / "no_weights"
    dummy.write_bytes(b"-")
    model = [] if way == "without" else ["view.model=geocalib", f"view.weights={dummy}"]
    config = build_config("draft", overrides=["read.max_size=320", "read.duration=1.2", *model])
    given = GivenFiles.of(Inputs(video))
    runner = Runner(work / video.parent.name, ("read", "flow", "segment", "geometry"), progress=Silence())
    seen = begin.look(runner, given, config)
    asked = begin.geometry_settings(seen[0], config, NOTHING_SAID)
    before, views.make_view_estimator = views.make_view_estimator, lambda *_: Answering(truth, seed, way == "wrong")
    try:
        return sight._seen(*seen, GivenView.of(given, config), asked, Work.alone(work))[0]
    finally:
        views.make_view_estimator = before


def figures(found: sight.Sight, truth: PinholeCamera) -> tuple[float, float, float]:
    """Degrees between the verticals, told standard error of the pitch, relative error of the focal length."""
    up, true = (c.camera_from_world.rotation[:, 2] for c in (level_camera(found.known, found.up), truth))
    off = float(np.degrees(np.arccos(np.clip(up @ true, -1.0, 1.0))))
    focal = found.known.focal[0] / found.known.size[0] / (truth.focal[0] / truth.size[0])
    return off, found.up.error, float(abs(np.log(focal)))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=Path, required=True, help="folder of cases")
    parser.add_argument("--work", type=Path, required=True, help="keeps what does not depend on the model")
    parser.add_argument("--only", nargs="+", default=["river", "honey", "smoke"], help="cases")
    parser.add_argument("--draws", type=int, default=8)
    args = parser.parse_args()
    args.work.mkdir(parents=True, exist_ok=True)
    told: dict[str, Any] = {}
    for name in args.only:
        folder = args.cases / name
        facts = json.loads((folder / "camera.json").read_text(encoding="utf-8"))
        truth = read_camera(folder / "camera.json", (int(facts["width"]), int(facts["height"])))
        for way in WAYS:
            seeds = range(args.draws if way == "as published" else 1)
            off, error, lens = np.array(
                [figures(looked(folder / "video.mp4", truth, args.work, seed, way), truth) for seed in seeds]
            ).T
            told[f"{name}, {way}"] = {"up": off.mean(), "worst": off.max(), "told": error.mean(), "focal": lens.mean()}
            print(
                f"{name:8} {way:13} up {off.mean():5.1f} off (worst {off.max():.1f}), told {error.mean():.1f}, "
                f"focal length {100 * lens.mean():.0f} %", flush=True,
            )  # fmt: skip
    (args.work / "learned_view.json").write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
