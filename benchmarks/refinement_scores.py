"""Figures of a body against the truth: input view, depth, cells, a view from beside, flicker of the far side."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from motion_subjects import Truth
from scipy import ndimage

from fluidlift.evaluate.images import psnr, ssim
from fluidlift.evaluate.volumes import behind, in_picture, lookup, occupancy_iou
from fluidlift.look.rasterize import render
from fluidlift.shape.external_body import near_and_far
from fluidlift.shape.fill import hull
from fluidlift.shape.generate import front_gaussians
from fluidlift.shape.unite import unite, window_length
from fluidlift.types import Gaussians, PinholeCamera, RigidTransform, concatenate

ASIDE = 20.0
"""degrees by which the camera beside is turned about the middle of the fluid"""


@dataclass(frozen=True)
class Scored:
    """What bodies of one frame are measured against."""

    truth: Truth
    key: int
    t: int
    side: PinholeCamera
    side_picture: np.ndarray
    """u8 [H,W,3]: the true view from beside"""
    side_mask: np.ndarray
    """its pixels that show true surface"""
    held_out: str
    """filmed: by a second camera; warped: the frame on the true surface"""
    ceiling: float
    """dB: how like the filmed view the frame on the true surface is (waves glint elsewhere)"""

    @classmethod
    def of(cls, truth: Truth, key: int, t: int, filmed: np.ndarray | None) -> Scored:
        side = side_camera(truth, t)
        surface = front_gaussians(truth.frames[t], truth.mask[t], truth.depth[t], truth.camera)
        drawn = render(surface, side)
        valid = cv2.erode((drawn.alpha > 0.95).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        warped = _bytes(drawn.image / np.maximum(drawn.alpha, 0.5)[..., None])
        if filmed is None:
            return cls(truth, key, t, side, warped, valid, "warped", float("inf"))
        return cls(truth, key, t, side, filmed, valid, "filmed", psnr(warped, filmed, valid))


def side_camera(truth: Truth, t: int) -> PinholeCamera:
    """The clip's camera, turned about the vertical through the middle of the visible surface."""
    m = truth.mask[t]
    middle = np.median(truth.camera.unproject(truth.camera.pixel_grid()[m], truth.depth[t][m]), axis=0)
    c, s = np.cos(np.radians(ASIDE)), np.sin(np.radians(ASIDE))
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    pose = truth.camera.camera_from_world
    rotation = pose.rotation @ turn
    moved = RigidTransform(rotation, pose.rotation @ middle + pose.translation - rotation @ middle)
    return PinholeCamera(truth.camera.focal, truth.camera.center, truth.camera.size, moved)


def score(
    step: str, g: Gaussians, scored: Scored, seconds: float | None = None, notes: tuple[str, ...] = (),
    shell: Gaussians | None = None,
) -> dict[str, Any]:  # fmt: skip
    """One row of figures of a front and the shell behind it; without a shell no volume is scored."""
    front, g = g, g if shell is None else concatenate([g, shell])
    truth, t = scored.truth, scored.t
    mask, image = truth.mask[t], truth.frames[t]
    drawn = render(g, truth.camera)
    picture = _bytes(drawn.image)
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    box = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
    whole = np.where(mask[..., None], picture, image)
    seen = mask & (drawn.alpha > 0.5)
    depth = truth.depth[t]
    off = np.abs(drawn.depth - depth)[seen] / depth[seen]
    beside = _bytes(render(g, scored.side).image)
    bridged = ndimage.binary_fill_holes(mask) & ~ndimage.binary_dilation(mask, np.ones((5, 5)))
    row: dict[str, Any] = {
        "step": step, "gaussians": len(g), "psnr": psnr(picture, image, mask), "ssim": ssim(whole[box], image[box]),
        "depth": float(np.median(off)), "depth_95": float(np.quantile(off, 0.95)),
        "side_psnr": psnr(beside, scored.side_picture, scored.side_mask),
        "rocks": float(render(front, truth.camera).alpha[bridged].mean()) if bridged.any() else None,
        "notes": list(notes),
    }  # fmt: skip
    if shell is not None:
        row["iou"] = _occupancy(g, scored)
    if seconds is not None:
        row["seconds"] = round(seconds, 2)
    return row


def _occupancy(g: Gaussians, scored: Scored) -> float | None:
    """IoU of the true cells and those in which the field of opacities exceeds its threshold."""
    case, camera = scored.truth.case, scored.truth.case.camera
    centers = case.grid.centers().reshape(-1, 3)
    held = hull(g, spacing=case.grid.spacing)
    mine = lookup(held.voxels == 1, held.grid, centers, outside=False)
    true = case.occupied(scored.key).reshape(-1)
    ignored = ~in_picture(centers, camera) | (true & behind(centers, case.static_depth, camera, case.grid.spacing))
    return occupancy_iou(mine, true, ignored)


def flicker(truth: Truth, start: int, frames: int = 12, roughness: float = 0.3) -> dict[str, Any]:
    """Change of the far side from frame to frame, over the thickness: single bodies, and unions over N frames.

    The bodies have the true front of each frame, and a back that is off by a smooth random share of the thickness,
    another one in each frame, as generators give it. The union is the paper's: one batch per N frames.
    """
    rng = np.random.default_rng(0)
    clip = slice(start, min(start + frames, len(truth.frames)))
    mask, bodies = truth.mask[clip].all(axis=0), []
    if clip.stop - clip.start < 4 or mask.sum() < 100:
        return {}
    camera, pixels = truth.camera, truth.camera.pixel_grid()
    thickness = _thickness(truth, start)
    for t in range(clip.start, clip.stop):
        noise = ndimage.gaussian_filter(rng.normal(size=mask.shape), max(mask.shape) / 20)
        back = truth.depth[t] + thickness * np.clip(1 + roughness * noise / noise.std(), 0.1, 2.0)
        m = truth.mask[t] & (truth.depth[t] > 0)
        front = front_gaussians(truth.frames[t], m, truth.depth[t], camera, stride=2)
        pick = m & (pixels.astype(int) % 2 == 0).all(-1)
        points = camera.unproject(pixels[pick], back[pick])
        size = back[pick] / camera.focal[0]
        behind_it = Gaussians.isotropic(points.astype(np.float32), size, np.full((len(points), 3), 0.5))
        bodies.append(concatenate([front, behind_it]))
    n = window_length(truth.frames[clip], truth.mask[clip], longest=6)
    spacing = 1.2 * float(np.median(truth.depth[start][mask])) / camera.focal[0]
    batches = [unite(bodies[k : k + n], spacing=spacing) for k in range(0, len(bodies), n)]
    united = [batches[k // n] for k in range(len(bodies))]
    out: dict[str, Any] = {"frames": len(bodies), "window": n}
    for name, row in (("single", bodies), ("united", united)):
        far = np.stack([near_and_far(b, camera, mask)[1] for b in row])
        near = np.stack([near_and_far(b, camera, mask)[0] for b in row])
        change = np.abs(np.diff(far, axis=0))[:, mask] / np.median((far - near)[:, mask])
        out |= {name: float(change.mean()), f"{name}_thickness": float(np.median((far - near)[:, mask]))}
    out["true_thickness"] = float(np.median(thickness[mask]))
    return out


def _thickness(truth: Truth, t: int) -> np.ndarray:
    """Along the line of sight to the solid behind, m; a tenth of the width in the picture where there is none."""
    depth = truth.depth[t]
    wall = cv2.resize(truth.case.static_depth.astype(np.float32), truth.camera.size, interpolation=cv2.INTER_NEAREST)
    width = 0.1 * np.sqrt(truth.mask[t].sum()) * np.median(depth[depth > 0]) / truth.camera.focal[0]
    thick = np.where((wall > depth) & (depth > 0), wall - depth, width)
    return np.minimum(thick, 5 * width)


def _bytes(image: np.ndarray) -> np.ndarray:
    return (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)
