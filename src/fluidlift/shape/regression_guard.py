"""Regression guard of the refinement: the frame it is refined on, and the figures that must not get worse meanwhile."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float

from fluidlift.errors import require
from fluidlift.numerics.splatting import SplatCamera, bin_tiles, project, rasterize
from fluidlift.types import triple
from fluidlift.types.camera import PinholeCamera
from fluidlift.types.gaussians import SH_C0, Gaussians

PLAIN_COLORS = ((0, 0, 0), (1, 1, 1), (1, 0, 1), (0, 1, 0), (0, 0, 1), (1, 0, 0))
"""candidates for the plain background, black and white first"""

NEIGHBOURS = (6.0, 14.0)
"""degrees to the side from which the refined body must still look like the frame"""

MARGIN = 12
"""px around the mask where the picture is compared, so that Gaussians that spill over are seen"""


@dataclass(frozen=True)
class LossFrame:
    """The part of the frame around the mask, as the loss needs it."""

    view: SplatCamera
    target: np.ndarray
    """[h,w,3], composited on the plain background"""
    weight: np.ndarray
    """[h,w]: 1 inside the mask and near it"""
    mask: np.ndarray
    plain: tuple[float, float, float]
    depth: np.ndarray
    """[h,w]: camera z of the body before the refinement, m; NaN where it is not to be held"""

    @classmethod
    def of(
        cls, image: np.ndarray, mask: np.ndarray, camera: PinholeCamera, plain: tuple[float, float, float]
    ) -> LossFrame:
        rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
        y0, y1 = max(0, rows[0] - MARGIN), min(mask.shape[0], rows[-1] + 1 + MARGIN)
        x0, x1 = max(0, columns[0] - MARGIN), min(mask.shape[1], columns[-1] + 1 + MARGIN)
        inside = np.ascontiguousarray(mask[y0:y1, x0:x1])
        picture = np.where(inside[..., None], image[y0:y1, x0:x1].astype(np.float32) / 255, np.array(plain, np.float32))
        near = cv2.dilate(inside.astype(np.uint8), np.ones((2 * MARGIN + 1,) * 2, np.uint8))
        pose, (cx, cy) = camera.camera_from_world, camera.center
        center, size = (cx - x0, cy - y0), (int(x1 - x0), int(y1 - y0))
        view = SplatCamera(pose.rotation, pose.translation, camera.focal, center, size)
        unknown = np.full(inside.shape, np.nan, np.float32)
        near, own = near.astype(np.float32), triple(map(float, plain))
        return cls(view, picture.astype(np.float32), near, inside, own, unknown)

    def before_another_color(self) -> LossFrame:
        """The same on the complementary plain background."""
        plain = triple(1 - p for p in self.plain)
        target = np.where(self.mask[..., None], self.target, np.array(plain, np.float32))
        return replace(self, plain=plain, target=target)


def plain_color(image: np.ndarray, mask: np.ndarray, background: object) -> tuple[float, float, float]:
    if background == "black":
        return (0.0, 0.0, 0.0)
    if background is not None:
        color = np.asarray(background, float)
        require(color.shape == (3,) and bool(((color >= 0) & (color <= 1)).all()), f"background {background!r}",
                "'black' or three numbers in [0, 1]")  # fmt: skip
        return triple(color)
    fluid = image[mask].astype(np.float32) / 255
    # even the 2 % of the fluid that come nearest: before its own colour a fluid may turn transparent unnoticed
    away = (np.linalg.norm(fluid - np.array(c, np.float32), axis=1) for c in PLAIN_COLORS)
    distances = [float(np.quantile(a, 0.02)) for a in away]
    return PLAIN_COLORS[int(np.argmax(distances))]


def neighbours(frame: LossFrame, gaussians: Gaussians, before: ShapeFigures) -> list[LossFrame]:
    """What the same frame would look like from the sides, by its depth before the refinement.

    The camera turns about the middle of the body, left, right, up and down by each of `NEIGHBOURS`. Every pixel of the
    new view takes the colour of the frame at the point that it shows; pixels whose point the frame does not show weigh
    nothing. A Gaussian that only paints the one view is wrong in all of these.
    """
    view = frame.view
    middle = float(np.nanmedian(before.depth)) if np.isfinite(before.depth).any() else 1.0
    full = np.ones_like(frame.mask)
    out = []
    for angle in NEIGHBOURS:
        for axis in ((0, angle), (0, -angle), (angle, 0), (-angle, 0)):
            turn = cv2.Rodrigues(np.radians([*axis, 0.0]))[0]
            center = np.array([0.0, 0.0, middle])
            moved = replace(
                view, rotation=turn @ view.rotation, translation=turn @ (np.asarray(view.translation) - center) + center
            )
            beside = replace(frame, view=moved, mask=full)
            depth = np.nan_to_num(picture_and_figures(gaussians, beside)[1].depth).astype(np.float32)
            v, u = np.mgrid[0 : depth.shape[0], 0 : depth.shape[1]].astype(np.float32) + np.float32(0.5)
            x = np.stack([(u - view.center[0]) / view.focal[0], (v - view.center[1]) / view.focal[1], np.ones_like(u)])
            x = np.einsum("ji,jhw->hwi", turn, x * depth - center[:, None, None]) + center
            z = np.maximum(x[..., 2], view.near)
            back_u = (x[..., 0] / z * view.focal[0] + view.center[0] - 0.5).astype(np.float32)
            back_v = (x[..., 1] / z * view.focal[1] + view.center[1] - 0.5).astype(np.float32)
            target = cv2.remap(frame.target, back_u, back_v, cv2.INTER_LINEAR)
            seen = cv2.remap(np.nan_to_num(before.depth).astype(np.float32), back_u, back_v, cv2.INTER_NEAREST)
            inside = cv2.remap(frame.mask.astype(np.float32), back_u, back_v, cv2.INTER_LINEAR) > 0.99
            shown = inside & (depth > 0) & (np.abs(z - seen) < 0.02 * before.size)
            held = np.where(shown, depth, np.nan).astype(np.float32)
            out.append(replace(beside, target=target, weight=shown.astype(np.float32), depth=held))
    return out


@dataclass(frozen=True)
class ShapeFigures:
    """What must not get worse while the picture gets better."""

    depth: Float[np.ndarray, "h w"]
    """expected camera z in m; NaN outside the mask or where hardly anything is drawn"""
    extents: Float[np.ndarray, "3"]
    """size of the body along the camera's axes between its 1 % and 99 % quantiles, m"""
    coverage: float
    """mean alpha inside the mask"""
    size: float
    """side of the square with the area of the mask, at the depth of the body, m"""


def picture_and_figures(gaussians: Gaussians, frame: LossFrame) -> tuple[Float[np.ndarray, "h w 3"], ShapeFigures]:
    """The cut-out as drawn on the plain background, and the figures of the body; constant harmonics only."""
    view, size = frame.view, frame.view.size
    g = gaussians
    projected = project(view, g.means, g.quats, g.scales, g.opacities)
    colors = np.maximum(0.5 + SH_C0 * g.sh[:, 0], 0.0)
    features = np.concatenate([colors, projected.depths[:, None]], 1).astype(np.float32)
    image, light = rasterize(projected, g.opacities, features, bin_tiles(projected, size), size)
    alpha = 1 - light
    depth = np.where(frame.mask & (alpha > 0.3), image[..., 3] / np.maximum(alpha, 1e-3), np.nan)
    extents = _extents(g.select(projected.extents[:, 0] > 0), view)
    middle = float(np.nanmedian(depth)) if np.isfinite(depth).any() else 0.0
    side = float(np.sqrt(frame.mask.sum())) * middle / max(view.focal)
    figures = ShapeFigures(depth, extents, float(alpha[frame.mask].mean()), side)
    return image[..., :3] + light[..., None] * np.array(frame.plain, np.float32), figures


def _extents(g: Gaussians, view: SplatCamera) -> Float[np.ndarray, "3"]:
    """Size along the camera's axes that holds 98 % of the cross-sections: splitting a Gaussian leaves it alone."""
    if len(g) == 0:
        return np.zeros(3)
    x = g.means @ np.float32(view.rotation.T) + np.float32(view.translation)
    share = g.opacities * np.cbrt(g.scales.prod(1)) ** 2
    out = np.zeros(3)
    for a in range(3):
        order = np.argsort(x[:, a], kind="stable")
        below = np.cumsum(share[order], dtype=np.float64)
        low, high = np.searchsorted(below, [0.01 * below[-1], 0.99 * below[-1]])
        out[a] = x[order[min(high, len(g) - 1)], a] - x[order[low], a]
    return out


def psnr(picture: Float[np.ndarray, "h w 3"], frame: LossFrame) -> float:
    """Likeness inside the mask, dB (at most 99)."""
    error = float(np.mean((picture[frame.mask] - frame.target[frame.mask]) ** 2))
    return -10 * float(np.log10(max(error, 10**-9.9)))


def broken(before: ShapeFigures, after: ShapeFigures) -> tuple[str, ...]:
    """What got worse, in words; empty if the body still has its shape.

    The allowances are shares of the size of the body: the surface may settle by 1 % (median) and 5 % (95 % of the
    pixels), the body may grow by 3 % along any axis of the camera, and coverage may fall by 2 %.
    """
    reasons = []
    shift = np.abs(after.depth - before.depth)
    if np.isfinite(shift).any():
        median, tail = np.nanquantile(shift, [0.5, 0.95]) / max(before.size, 1e-12)
        if median > 0.01 or tail > 0.05:
            reasons.append(f"depth moved by {median:.1%} of the size (median), {tail:.1%} (95 %)")
    growth = (after.extents - before.extents) / max(before.size, 1e-12)
    if growth.max() > 0.03:
        reasons.append(
            f"the body grew by {growth.max():.1%} of its size along the camera's {'xyz'[int(growth.argmax())]}"
        )
    if after.coverage < before.coverage - 0.02:
        reasons.append(f"coverage of the mask fell from {before.coverage:.0%} to {after.coverage:.0%}")
    return tuple(reasons)
