"""The clip that comes with the package, and its truth."""

from __future__ import annotations

import json
import shutil
from importlib import resources
from pathlib import Path

from fluidlift.types import PinholeCamera

FILES = {
    "video.mp4": "demo.mp4",
    "camera.json": "demo_truth_camera.json",
    "scene.json": "demo_scene.json",
    "truth.npz": "demo_truth.npz",
    "solids.npz": "demo_solids.npz",
}
"""file of a case -> file of the package"""


def data_file(name: str) -> Path:
    """A file of `synthetic/data`, as it was installed."""
    return Path(str(resources.files("fluidlift.synthetic").joinpath("data", name)))


def demo_clip() -> Path:
    """A small stream with rocks, 320 x 208 px, 40 frames at 25 per second, made by `synthetic.make_demo`."""
    return data_file("demo.mp4")


def demo_camera() -> PinholeCamera:
    """The camera of the demo clip, in the world of its truth."""
    return PinholeCamera.from_dict(json.loads(data_file("demo_camera.json").read_text(encoding="utf-8")))


def unpack_demo_case(folder: Path) -> Path:
    """Lay the demo out as a case folder (made if absent), which `fluidlift.evaluate.read_case` reads.

    Its truth lives on a coarser raster than the clip, to keep the package small; scores do not need more.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for name, source in FILES.items():
        shutil.copyfile(data_file(source), folder / name)
    return folder
