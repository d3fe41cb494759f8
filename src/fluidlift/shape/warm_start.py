"""Warm start of the frames after the first: each is refined from the Gaussians of the frame before it.

They are moved as the picture moves and keep to the surface, so that a few steps are enough for what is new in the
frame. Where the fluid has come to a place that the last frame did not show, the freshly generated body helps out.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from fluidlift.errors import require
from fluidlift.numerics.splatting import SplatCamera, bin_tiles, project, rasterize
from fluidlift.seams import Rasterizer
from fluidlift.shape.refine import RefineResult, refine
from fluidlift.types.camera import PinholeCamera
from fluidlift.types.gaussians import Gaussians, concatenate

COVERED = 0.5
"""opacity of the carried body above which a pixel needs no fresh Gaussian"""


def carried(
    last: Gaussians,
    fresh: Gaussians,
    mask: Bool[np.ndarray, "h w"],
    camera: PinholeCamera,
    *,
    motion: Float[np.ndarray, "h w 2"] | None = None,
    depths: tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]] | None = None,
) -> Gaussians:
    """The last frame's body where the fluid is now, and fresh Gaussians where that leaves the mask open.

    Args:
        last: refined on the frame before, world, m.
        fresh: generated from this frame, world, m.
        mask: fluid in this frame.
        camera: who sees both.
        motion: from the frame before to this one, px; None: nothing moves.
        depths: camera z (m, 0 where there is none) of the visible surface, before and now: Gaussians keep their
            distance from it. None: they keep their depth.
    """
    moved = last if motion is None else _moved(last, camera, motion, depths)
    uv, z = camera.project(moved.means)
    height, width = mask.shape
    column, row = np.floor(np.clip(np.nan_to_num(uv, nan=-1.0), -1, max(mask.shape) + 1)).astype(int).T
    within = (z > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    kept = np.ones(len(moved), bool)
    kept[within] = mask[row[within], column[within]]  # what is off the picture is not contradicted by it
    moved = moved.select(kept)
    if len(fresh) == 0:
        return moved
    covered = _coverage(moved, camera) > COVERED
    uv, z = camera.project(fresh.means)
    column, row = np.floor(np.clip(np.nan_to_num(uv, nan=-1.0), -1, max(mask.shape) + 1)).astype(int).T
    within = (z > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    needed = np.zeros(len(fresh), bool)
    needed[within] = ~covered[row[within], column[within]] & mask[row[within], column[within]]
    return concatenate([moved, fresh.select(needed)])


def follow(
    last: Gaussians,
    fresh: Gaussians,
    image: UInt8[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    camera: PinholeCamera,
    *,
    motion: Float[np.ndarray, "h w 2"] | None = None,
    depths: tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]] | None = None,
    iterations: int = 10,
    seed: int = 0,
    max_gaussians: int = 60_000,
    rasterizer: Rasterizer | None = None,
) -> RefineResult:
    """`refine`, started from the frame before (see `carried`).

    Raises:
        InputRejected: as `refine`.
        ValueError: image, mask, motion or depths of different size.
    """
    if motion is not None:
        require(motion.shape == (*mask.shape, 2), f"motion {motion.shape}", f"({mask.shape}, 2)")
    require(depths is None or all(d.shape == mask.shape for d in depths), "depths of another size than the mask")
    start = carried(last, fresh, mask, camera, motion=motion, depths=depths)
    return refine(
        start, image, mask, camera, iterations=iterations, seed=seed,
        max_gaussians=max(max_gaussians, len(start)), rasterizer=rasterizer,
    )  # fmt: skip


def _moved(
    g: Gaussians,
    camera: PinholeCamera,
    motion: np.ndarray,
    depths: tuple[np.ndarray, np.ndarray] | None,
) -> Gaussians:
    """Along the motion of the picture, by the depth of the surface where they come from and where they go."""
    uv, z = camera.project(g.means)
    seen = (z > 0) & np.isfinite(uv).all(1) & (uv >= 0).all(1) & (uv < camera.size).all(1)
    start, depth = uv[seen], z[seen]
    place = start[:, ::-1].T - 0.5
    shift = np.stack([ndimage.map_coordinates(motion[..., c], place, order=1, mode="nearest") for c in (0, 1)], axis=1)
    end = start + np.nan_to_num(shift)
    if depths is not None:
        before, now = (_surface_at(d, at) for d, at in zip(depths, (start, end), strict=True))
        depth = np.where((before > 0) & (now > 0), depth * now / np.maximum(before, 1e-12), depth)
    means = g.means.copy()
    means[seen] = camera.unproject(end, depth)
    scale = np.ones(len(g), np.float32)
    scale[seen] = depth / z[seen]
    return Gaussians(means, g.quats, g.scales * scale[:, None], g.opacities, g.sh)


def _surface_at(depth: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Depth at places in the picture; carried on beside the fluid, 0 without any."""
    ok = depth > 0
    if not ok.any():
        return np.zeros(len(uv))
    index = ndimage.distance_transform_edt(~ok, return_distances=False, return_indices=True)
    return ndimage.map_coordinates(depth[tuple(index)], uv[:, ::-1].T - 0.5, order=1, mode="nearest")


def _coverage(g: Gaussians, camera: PinholeCamera) -> Float[np.ndarray, "h w"]:
    projected = project(SplatCamera.of(camera), g.means, g.quats, g.scales, g.opacities)
    light = rasterize(
        projected, g.opacities, np.zeros((len(g), 1), np.float32), bin_tiles(projected, camera.size), camera.size
    )[1]
    return 1 - light
