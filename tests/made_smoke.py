"""A made smoke seen by five cameras, in the folder layout of HyFluid's part of ScalarFlow, with exact pictures.

The smoke is a sum of round blobs whose density falls off like a bell; what a ray meets of one is known in closed form,
so a picture is exact: 1 - exp(-sum of a s sqrt(2 pi) exp(-d^2 / 2 s^2)) with d the distance of the ray from its middle.
Poses are built here from an eye and a target, with axes of OpenGL and y up as the authors' are, without the reader's
code.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fluidlift.io.encode import write_video

MIDDLE = np.array([0.3, 0.4, -0.2])
"""of the box, m, y up"""
ANGLE = 0.41
"""rad, field of view across the picture's width, as the authors' cameras have"""
FULL = (1080, 1920)
"""width and height, px, that info.json tells; films may be smaller"""
TURNS = {"00": -60.0, "01": -30.0, "02": 0.0, "03": 30.0, "04": 60.0}
"""degrees around the vertical of each camera"""


RISE = 0.012
"""m per frame"""
PUFF = 6
"""blobs that come out per frame"""


@dataclass(frozen=True)
class Blobs:
    """Where smoke is in a frame."""

    middles: np.ndarray
    """[n,3] m, y up"""
    size: float
    """m, standard deviation"""
    amount: float | np.ndarray
    """1/m, extinction in the middle of each"""


def pose(turn: float, away: float = 1.25, below: float = 0.35, roll: float = 0.0) -> np.ndarray:
    """World <- camera [4,4]: looks at the middle from `away` m, from `below` m under it, turned by `roll` degrees."""
    angle = np.radians(turn)
    eye = MIDDLE + [away * np.sin(angle), -below, away * np.cos(angle)]
    back = (eye - MIDDLE) / np.linalg.norm(eye - MIDDLE)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    up = np.cross(back, right)
    c, s = np.cos(np.radians(roll)), np.sin(np.radians(roll))
    made = np.eye(4)
    made[:3, :3] = np.stack([c * right + s * up, c * up - s * right, back], axis=1)
    made[:3, 3] = eye
    return made


def seen(blobs: Blobs, camera: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Intensities [h,w] in [0, 1] of white smoke on black, before a camera world <- camera of OpenGL's axes."""
    width, height = size
    focal = 0.5 * width / np.tan(0.5 * ANGLE)
    x, y = np.meshgrid(np.arange(width) + 0.5 - 0.5 * width, np.arange(height) + 0.5 - 0.5 * height)
    rays = np.stack([x / focal, -y / focal, -np.ones_like(x)], axis=-1) @ camera[:3, :3].T
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    thick = np.zeros(x.shape)
    for middle, amount in zip(blobs.middles, np.broadcast_to(blobs.amount, len(blobs.middles)), strict=True):
        off = middle - camera[:3, 3]
        squared = (off**2).sum() - (rays @ off) ** 2
        thick += amount * blobs.size * np.sqrt(2 * np.pi) * np.exp(-0.5 * squared / blobs.size**2)
    return 1.0 - np.exp(-thick)


def plume(t: int) -> Blobs:
    """A plume of uneven puffs, which rise by `RISE` per frame and spread with the height."""
    rng = np.random.default_rng(0)
    aside, amounts = rng.normal(size=(200, PUFF, 2)), rng.uniform(2.0, 20.0, (200, PUFF))
    age = np.arange(t + 1)
    wide = 0.02 + 0.06 * RISE * age / 0.3
    x = MIDDLE[0] + wide[:, None] * aside[t - age, :, 0]
    z = MIDDLE[2] + wide[:, None] * aside[t - age, :, 1]
    y = np.broadcast_to((MIDDLE[1] - 0.25 + RISE * age)[:, None], x.shape)
    return Blobs(np.stack([x, y, z], axis=-1).reshape(-1, 3), 0.011, amounts[t - age].reshape(-1))


def write(folder: Path, frames: list[Blobs], size: tuple[int, int], *, roll: float = 0.0) -> dict[str, np.ndarray]:
    """train00.mp4 to train04.mp4 (lossless but for 8 bits) and info.json; the pose of each camera."""
    folder.mkdir(parents=True, exist_ok=True)
    poses = {name: pose(turn, roll=roll) for name, turn in TURNS.items()}
    entries = {}
    for name, camera in poses.items():
        pictures = (np.repeat(np.round(255 * seen(b, camera, size))[..., None], 3, axis=2) for b in frames)
        write_video(folder / f"train{name}.mp4", (p.astype(np.uint8) for p in pictures), 30.0, quality=0.0)
        entries[name] = {
            "file_name": f"train{name}.mp4", "frame_rate": 30, "frame_num": len(frames), "camera_angle_x": ANGLE,
            "camera_hw": FULL[::-1], "transform_matrix": camera.tolist(),
        }  # fmt: skip
    told = {
        "train_videos": [entries[n] for n in ("00", "01", "03", "04")], "test_videos": [entries["02"]],
        "render_center": MIDDLE.tolist(), "near": 1.1, "far": 1.5, "rot": "Y",
    }  # fmt: skip
    (folder / "info.json").write_text(json.dumps(told), encoding="utf-8")
    return poses
