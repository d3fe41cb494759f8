"""What `sensitivity.py` runs: small made scenes with their truth, real clips without, and the figures of what is found.

The stream, the pour, the honey and the dam are simulated (`fluidlift.synthetic.scenes`); smoke, a fall and a sea are
painted by a formula each, with an exact mask, and an exact motion or horizon where the formula says one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

INTERVAL = 0.04
"""s between the frames of painted scenes"""


@dataclass(frozen=True)
class Painted:
    """A painted scene."""

    kind: str
    frames: np.ndarray
    """u8 [T,H,W,3]"""
    mask: np.ndarray
    """bool [T,H,W]"""
    flow: np.ndarray | None = None
    """px per frame [T-1,H,W,2]"""
    pitch: float | None = None
    """degrees below the horizon, of a camera with the lens that is assumed"""


def noise(rng: np.random.Generator, shape: tuple[int, int], grain: tuple[float, float]) -> np.ndarray:
    """Smooth random texture of unit spread; grain: sigmas along x and y, px."""
    found = cv2.GaussianBlur(rng.standard_normal(shape).astype(np.float32), (0, 0), grain[0], sigmaY=grain[1])
    return found / found.std()


def ground(rng: np.random.Generator, shape: tuple[int, int], colour: tuple[float, float, float]) -> np.ndarray:
    """[H,W,3] of something rough that stands still."""
    rough = 16.0 * noise(rng, shape, (1.2, 1.2)) + 10.0 * noise(rng, shape, (6.0, 6.0))
    return np.asarray(colour) + rough[..., None]


def plume(seed: int) -> Painted:
    """Smoke that rises 2 px per frame in a growing column before a dark wall."""
    height, width, count = 112, 144, 14
    rng = np.random.default_rng(seed)
    texture = 150.0 + 35.0 * noise(rng, (height + 2 * count, width), (2.0, 1.5))
    wall = ground(rng, (height, width), (32.0, 30.0, 28.0)) * 0.8
    row, column = np.mgrid[:height, :width]
    frames, masks = [], []
    for t in range(count):
        wide = 12.0 + 0.14 * (104 - row) + 2.5 * np.sin(row / 6.0 + 0.5 * t + seed)
        smoke = (np.abs(column - 72) < wide) & (row > 64 - 3 * t) & (row < 104)
        frames.append(np.where(smoke[..., None], texture[2 * t : 2 * t + height, :, None], wall))
        masks.append(smoke)
    flow = np.zeros((count - 1, height, width, 2), np.float32)
    flow[..., 1] = -2.0
    return Painted("plume", _bytes(frames), np.stack(masks), flow)


def fall(seed: int) -> Painted:
    """A curtain that falls freely between rocks and out of the picture."""
    height, width, count, top = 144, 128, 14, 28
    rng = np.random.default_rng(seed)
    rocks = ground(rng, (height, width), (70.0, 64.0, 58.0))
    row, column = np.mgrid[:height, :width].astype(float)
    start, gravity, past = 1.6, 0.05, 400.0  # px per frame, px per frame^2, px of texture above the rim
    fallen = np.maximum(row - top, 0.0)
    since = (np.sqrt(start**2 + 2.0 * gravity * fallen) - start) / gravity
    curtain = (np.abs(column - 62 - 2.0 * np.sin(row / 17.0)) < 30 + 0.03 * fallen) & (row > top)
    texture = noise(rng, (1200, width), (1.3, 3.0))
    frames = []
    for t in range(count):
        at = (past + start * (since - t)).astype(np.float32)
        streaks = cv2.remap(texture, column.astype(np.float32), at, cv2.INTER_LINEAR)
        water = np.array([178.0, 190.0, 196.0]) + 30.0 * streaks[..., None]
        frames.append(np.where(curtain[..., None], water, rocks))
    flow = np.zeros((count - 1, height, width, 2), np.float32)
    flow[..., 1] = np.sqrt(start**2 + 2.0 * gravity * fallen)
    return Painted("fall", _bytes(frames), np.repeat(curtain[None], count, axis=0), flow)


def sea(seed: int) -> Painted:
    """Waves of deep water that run towards the camera, under an even sky: nothing of it flows."""
    height, width, count, eye = 112, 168, 16, 2.0
    rng = np.random.default_rng(seed)
    focal, above = 0.5 * width / np.tan(np.radians(30.0)), 22.0  # px; px that the horizon lies above the middle
    u, v = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    water = v > -above
    down = np.maximum((v + above) / focal, 1e-3)
    far = eye / down
    x, y = far * u / focal, far
    shade, time = np.zeros((count, height, width)), np.arange(count)[:, None, None] * INTERVAL
    for _ in range(40):
        number, heading = np.exp(rng.uniform(np.log(1.2), np.log(9.0))), rng.normal(0.0, 0.35)
        seen = np.exp(-((0.35 * number * far / focal * far / eye) ** 2))  # shorter than a pixel: averaged out
        phase = number * (x * np.sin(heading) + y * np.cos(heading)) + np.sqrt(9.81 * number) * time
        shade += seen * np.sin(phase + rng.uniform(0.0, 2.0 * np.pi)) * number**-0.3
    grey = 92.0 + 9.0 * shade + 30.0 * np.exp(-6.0 * down)
    colour = grey[..., None] * np.array([0.72, 0.95, 1.12])
    sky = np.array([205.0, 214.0, 224.0]) + 0.06 * v[..., None]
    frames = np.where(water[..., None], colour, sky) + rng.normal(0.0, 1.0, (count, height, width, 1))
    pitch = float(np.degrees(np.arctan(above / focal)))
    return Painted("basin", _bytes(frames), np.repeat(water[None], count, axis=0), None, pitch)


def _bytes(frames: Any) -> np.ndarray:
    return np.clip(np.stack(list(frames)), 0, 255).astype(np.uint8)


PAINTED: dict[str, Callable[[int], Painted]] = {"plume": plume, "fall": fall, "sea": sea}
SIMULATED = {
    "stream": ("stream", (192, 128), 48, 14),
    "pour": ("pour", (160, 160), 40, 14),
    "dam": ("dam", (192, 144), 32, 18),
    "honey": ("stream", (192, 152), 44, 12),
}
"""kind as one would call what is seen (a film of honey runs down its board), size in px, cells, frames"""
SEEDS = (0, 1, 2)
"""of simulation and texture; trials use the first"""
SCENES = ("stream", "pour", "dam", "plume", "fall", "sea", "honey")


@dataclass(frozen=True)
class Findings:
    """What the stages found in a clip; each may be missing after a failure."""

    read: Any
    flow: Any
    segmentation: Any
    geometry: Any
    refined: Any
    motion: Any


def clip_of(scene: str, seed: int, folder: Path) -> Path:
    """The clip of a made scene, made if it is not there."""
    place = folder / f"{scene}-{seed}"
    clip = place / "video.mp4"
    if clip.is_file():
        return clip
    if scene in PAINTED:
        from fluidlift.io.video import write_video

        place.mkdir(parents=True, exist_ok=True)
        return write_video(clip, PAINTED[scene](seed).frames, 1.0 / INTERVAL, quality=16.0, repeatable=True)
    from fluidlift.synthetic.record import make_scene

    _, size, cells, frames = SIMULATED[scene]
    make_scene(scene, place, size=size, frames=frames, cells=cells, seed=seed)
    return clip


def figures(found: Findings, scene: str, seed: int, folder: Path) -> dict[str, float]:
    """Of what was found in a made scene, against its truth; NaN where a figure cannot be measured."""
    kind = scene_kind(scene)
    values = {"kind": float(found.geometry.kind_evidence.scores.get(kind, 0.0)), **_plain(found)}
    return values | (
        _painted(found, scene, seed) if scene in PAINTED else _simulated(found, folder / f"{scene}-{seed}")
    )


def scene_kind(scene: str) -> str:
    """The kind that should be found."""
    return SIMULATED[scene][0] if scene in SIMULATED else {"sea": "basin"}.get(scene, scene)


def _plain(found: Findings) -> dict[str, float]:
    """Figures that need no truth."""
    focal = float(np.max(found.geometry.camera.focal)) / max(found.read.clip.size)
    psnr = found.refined.psnr_after
    return {"focal length": float(np.log(focal)), "refined picture": float("nan") if psnr is None else float(psnr)}


def _painted(found: Findings, scene: str, seed: int) -> dict[str, float]:
    from fluidlift.evaluate.images import end_point_error, mask_iou
    from fluidlift.types import Label

    truth, fluid = PAINTED[scene](seed), found.segmentation.labels.labels == Label.FLUID
    values = {"mask": float(mask_iou(fluid, truth.mask).mean())}
    if truth.pitch is not None:
        up = found.geometry.up
        values["up"] = float(np.hypot(up.pitch - up.raised - truth.pitch, up.roll))
    if truth.flow is not None:
        both = (truth.mask & fluid)[:-1]
        values["flow"] = _number(
            end_point_error(np.asarray(found.flow.flow.displacement, np.float32), truth.flow, both)
        )
        last = np.asarray(found.motion.completed, np.float32)
        both = both & np.isfinite(last).all(axis=-1)
        values["completed flow"] = _number(end_point_error(np.nan_to_num(last), truth.flow, both))
    return values


SCORED = {
    "segmentation.iou": "mask",
    "geometry.up_angle": "up",
    "flow.raw.epe": "flow",
    "flow.completed.epe": "completed flow",
    "geometry.depth_error_over_relief": "depth",
    "geometry.occupancy_iou": "body",
    "geometry.scale": "scale",
    "geometry.bed_error_relative": "bed",
    "surface.velocity.relative_error": "surface velocity",
    "volume.relative_l2": "volume velocity",
}


def _simulated(found: Findings, case_folder: Path) -> dict[str, float]:
    from fluidlift.evaluate import planar, read_case, solid, space
    from fluidlift.types import FluidAsset, FluidParameters

    g, m, clip = found.geometry, found.motion, found.read.clip
    asset = FluidAsset(
        kind=g.kind, rest=found.refined.body, terrain=g.setting.terrain, grid=g.grid, cell_types=g.setting.cell_types,
        velocity=m.velocities[0], parameters=FluidParameters(), estimates={}, camera=g.camera,
        world_from_canonical=g.world_from_canonical, interval=clip.interval, frame_count=len(clip),
    )  # fmt: skip
    arrays = {
        "labels": found.segmentation.labels.labels, "front_depth": g.sighted_depth * g.mask,
        "flow_raw": found.flow.flow.displacement, "flow_completed": m.completed, "first_frame": np.array(g.rest_frame),
    }  # fmt: skip
    case = read_case(case_folder)
    depth, scale, frame = space.score_depth(arrays, case)
    found_all = [*planar.score_segmentation(arrays, case)[0], *planar.score_flow(arrays, case), *depth]
    if scale is not None:
        laid = space.align(asset, case, scale, frame)
        found_all += space.score_surface_velocity(arrays, asset, case, laid) + space.score_volume(asset, case, laid)
        found_all += solid.score_bed(arrays, asset, case, laid) + solid.score_up(case, laid)
    scored = {f.key: f.value for f in found_all}
    values = {name: _number(scored.get(key)) for key, name in SCORED.items()}
    values["scale"] = float(np.log(values["scale"])) if values["scale"] > 0 else float("nan")
    return values


def changes(found: Findings, before: Findings) -> dict[str, float]:
    """How far what was found in a real clip is from what was found before, in the units of the made scenes' figures."""
    from fluidlift.evaluate.images import mask_iou
    from fluidlift.types import Label

    g, old = found.geometry, before.geometry
    fluid, was = (f.segmentation.labels.labels == Label.FLUID for f in (found, before))
    moved = np.asarray(found.flow.flow.displacement, np.float32) - np.asarray(before.flow.flow.displacement, np.float32)
    names = set(g.kind_evidence.scores) | set(old.kind_evidence.scores)
    shares = [g.kind_evidence.scores.get(n, 0.0) - old.kind_evidence.scores.get(n, 0.0) for n in names]
    both = (g.depth > 0) & (old.depth > 0)
    ratio = np.log(g.depth[both] / old.depth[both]) if both.any() else np.zeros(1)
    values = {
        "mask": 1.0 - float(mask_iou(fluid, was).mean()),
        "kind": float(np.abs(shares).max()),
        "up": float(np.hypot(g.up.pitch - old.up.pitch, g.up.roll - old.up.roll)),
        "flow": float(np.linalg.norm(moved, axis=-1)[(fluid | was)[:-1]].mean()) if (fluid | was)[:-1].any() else 0.0,
        "scale": float(abs(np.log(g.scale.value / old.scale.value))),
        "depth": float(np.abs(ratio).mean()),
    }
    return values | {"focal length": abs(_plain(found)["focal length"] - _plain(before)["focal length"])}


def _number(value: Any) -> float:
    return float("nan") if value is None else float(value)
