"""What `motion.py` measures on: clips with a known truth, and real clips with a mask that a person drew."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from fit_cases import exact_case

from fluidlift.evaluate.case import Case, read_case
from fluidlift.evaluate.images import resample_nearest
from fluidlift.evaluate.score import read_video
from fluidlift.io.images import read_mask
from fluidlift.io.video import read_clip
from fluidlift.synthetic.demo import unpack_demo_case
from fluidlift.synthetic.record import make_scene
from fluidlift.synthetic.scenes import scene_of
from fluidlift.types import CellType, PinholeCamera, Terrain, VideoClip

ROOT = Path(__file__).resolve().parent.parent
SCENES = {
    "stream": {"size": (320, 208), "frames": 16, "cells": 72, "seed": 3},
    "pour": {"size": (256, 256), "frames": 16, "cells": 56, "seed": 0},
    "honey": {"size": (288, 224), "frames": 16, "cells": 64, "seed": 0},
}
"""scenes of the package that are simulated and filmed for this; the demo has another seed"""
KINDS = {"river": "stream", "river_sparse": "stream", "honey": "stream", "smoke": "plume"}
"""kinds of the cases; a film that runs down a slope is a stream"""


@dataclass(frozen=True)
class Subject:
    """One clip to measure on."""

    name: str
    video: Path
    case: Path | None
    """folder with the truth; None: a real clip"""
    kind: str
    own: bool
    """pictures of it may be published: the project's own scene"""
    hand_mask: Path | None = None


@dataclass(frozen=True)
class Truth:
    """A case on the raster of its clip."""

    case: Case
    frames: np.ndarray
    """u8 [T,H,W,3]"""
    camera: PinholeCamera
    flow: np.ndarray
    """[T,H,W,2] px/frame of the clip"""
    depth: np.ndarray
    """[T,H,W] camera z, m; 0 outside the mask"""
    depth_change: np.ndarray
    mask: np.ndarray
    """bool [T,H,W]"""
    rows: np.ndarray
    """bool [H]: picture rows that count"""

    def velocity(self, t: int) -> tuple[np.ndarray, np.ndarray]:
        """Points (m) and velocities (m/s) of the visible surface of frame t, [n,3] each, in the order of the mask."""
        m = self.mask[t]
        uv, z = self.camera.pixel_grid()[m], self.depth[t][m].astype(np.float64)
        first = self.camera.unproject(uv, z)
        second = self.camera.unproject(uv + self.flow[t][m], z + self.depth_change[t][m])
        return first, (second - first) / self.case.interval


def default_shared() -> Path | None:
    """FLUIDLIFT_SHARED, or `shared` beside the repository, where that exists."""
    path = Path(os.environ.get("FLUIDLIFT_SHARED") or ROOT.parent / "shared")
    return path if path.is_dir() else None


def subjects(work: Path, shared: Path | None) -> Iterator[Subject]:
    """The package's scenes, then the cases, then real clips with a drawn mask. Nothing is simulated yet."""
    yield Subject("demo", work / "demo" / "video.mp4", work / "demo", "stream", True)
    for name in SCENES:
        folder = work / f"scene_{name}"
        yield Subject(f"scene_{name}", folder / "video.mp4", folder, "stream" if name == "honey" else name, True)
    if shared is None:
        return
    for folder in (shared / "cases" / n for n in ("river", "honey", "smoke")):
        if not (folder / "truth.npz").is_file():
            continue
        for video in sorted(folder.glob("video*.mp4")):
            name = folder.name + video.stem.removeprefix("video")
            yield Subject(name, video, folder, KINDS[name], False)
    for mask in sorted(shared.glob("clips/*/mask_hand.png")):
        yield Subject(f"clip_{mask.parent.name}", mask.parent / "video.mp4", None, "", False, mask)


def prepare(subject: Subject) -> None:
    """Simulate and film the scene, or unpack the demo, unless it lies there already."""
    if not subject.own or subject.case is None or (subject.case / "truth.npz").is_file():
        return
    if subject.name == "demo":
        unpack_demo_case(subject.case)
    else:
        name = subject.name.removeprefix("scene_")
        make_scene(name, subject.case, **SCENES[name])  # pyright: ignore[reportArgumentType]


def read_truth(subject: Subject) -> Truth:
    """The case of a subject, brought to the raster of its clip where that is finer (the demo's is)."""
    assert subject.case is not None
    case = read_case(subject.case)
    w, h = read_clip(subject.video, max_size=1 << 14, duration=0.1).size
    frames = read_video(subject.video, (w, h))
    mask = resample_nearest(case.mask, (w, h))
    scale = np.float32([w / case.size[0], h / case.size[1]])
    flow = resample_nearest(case.flow, (w, h), axes=(-3, -2)).astype(np.float32) * scale
    depth, change = case.depth.astype(np.float32), case.depth_change.astype(np.float32)
    if (w, h) != case.size:
        depth = np.stack([_enlarged(d, m, (w, h)) for d, m in zip(depth, case.mask)]) * mask
        change = np.stack([_enlarged(d, m, (w, h)) for d, m in zip(change, case.mask)]) * mask
    rows = np.ones(h, bool)
    if case.density is not None:  # the stem below the bar looks the same from frame to frame (README of the cases)
        rows[ABOVE_BAR * h // case.size[1] :] = False
    return Truth(case, frames, case.camera.resized((w, h)), flow, depth, change, mask, rows)


ABOVE_BAR = 159
"""rows of the smoke case above its bar"""


def _enlarged(field: np.ndarray, mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Linear interpolation that does not mix in what lies outside the mask."""
    weight = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    value = cv2.resize(np.where(mask, field, 0.0).astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    return np.where(weight > 0, value / np.maximum(weight, 1e-6), 0.0)


def true_layout(subject: Subject, case: Case, key: int) -> tuple[Terrain, np.ndarray]:
    """Ground and cell types of a key frame: fluid from the level set or the density, the rest from the scene."""
    if not subject.own:
        exact = exact_case(case, [key], 0)
        return exact.terrain, exact.cell_types[0]
    name = "stream" if subject.name == "demo" else subject.name.removeprefix("scene_")
    size, seed = ((320, 208), 7) if name == "stream" and subject.name == "demo" else (SCENES[name]["size"], 3)
    scene = scene_of(name, size=size, seed=seed, cells=case.grid.shape[0])
    given, occupied = scene.cell_types, case.occupied(key)
    types = np.where(occupied, CellType.FLUID, CellType.EMPTY)
    for kind in (CellType.INFLOW, CellType.OUTFLOW):
        types = np.where(occupied & (given == kind), kind, types)
    return scene.terrain, np.where(given == CellType.SOLID, CellType.SOLID, types).astype(np.uint8)


def real_clip(subject: Subject) -> tuple[VideoClip, np.ndarray]:
    """A real clip as the pipeline sees it, and the mask that a person drew."""
    clip = read_clip(subject.video, max_size=512)
    assert subject.hand_mask is not None
    return clip, read_mask(subject.hand_mask, clip.size, len(clip))
