"""From the screen to the world (paper: V_surf): the one place where px/frame becomes m/s."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from fluidlift.errors import require
from fluidlift.motion.mainstream import masked_gradient
from fluidlift.types import PinholeCamera, SurfaceMotion

OUTLIER = 8.0
"""depth changes further than so many robust deviations from the median are cut back to that distance"""


def lift_flow(
    displacement: Float[np.ndarray, "h w 2"],
    observed: Bool[np.ndarray, "h w"],
    mask: Bool[np.ndarray, "h w"],
    depth_t: Float[np.ndarray, "h w"],
    depth_t1: Float[np.ndarray, "h w"],
    camera: PinholeCamera,
    interval: float,
    *,
    mask_t1: Bool[np.ndarray, "h w"] | None = None,
    stride: int = 1,
) -> SurfaceMotion:
    """Velocity of the visible surface.

    The centre of a fluid pixel is unprojected with `depth_t`, the place it moves to with `depth_t1`, and the
    difference is divided by the interval. With `depth_t1` equal to `depth_t` the fluid slides along a surface at rest,
    which is right for steady flow and immune to depth that flickers from frame to frame.

    Where the end lies outside the mask or the picture, depth is continued along the surface, as a plane. The same
    holds, in part, where the change of depth is far off what the rest of the surface shows (an edge between near and
    far fluid): the change is cut back to `OUTLIER` robust deviations.

    Args:
        displacement: px/frame.
        observed: False where the mainstream filled in.
        mask: the fluid at t.
        depth_t: camera z at t, m.
        depth_t1: camera z one frame later, m.
        camera: of the picture.
        interval: s per frame.
        mask_t1: the fluid one frame later; `mask` where None.
        stride: take every stride-th pixel in both directions.

    Returns:
        points (where the fluid is at t), velocities and observed, float32, in world axes.

    Raises:
        ValueError: shapes that do not fit, an interval or a depth that is not positive, or an empty mask.
    """
    d, mask = np.asarray(displacement, np.float32), np.asarray(mask, bool)
    require(d.shape == (*mask.shape, 2), f"displacement {d.shape}", f"{(*mask.shape, 2)}")
    require(mask.shape == (camera.size[1], camera.size[0]), f"mask {mask.shape}", f"the camera's size {camera.size}")
    require(interval > 0, f"interval {interval}", "positive seconds")
    require(bool(mask.any()), "an empty mask", "at least one fluid pixel")
    require(bool((np.asarray(depth_t)[mask] > 0).all()), "depth that is not positive inside the mask")
    change = depth_change(d, mask, depth_t, depth_t1, mask_t1=mask_t1)
    taken = np.zeros_like(mask)
    taken[::stride, ::stride] = True
    taken &= mask
    start = camera.pixel_grid()[taken]
    z = np.asarray(depth_t, np.float64)[taken]
    first = camera.unproject(start, z)
    second = camera.unproject(start + d[taken], np.maximum(z + change[taken], 1e-6 * z))
    return SurfaceMotion(
        first.astype(np.float32), ((second - first) / interval).astype(np.float32), np.asarray(observed, bool)[taken]
    )


def depth_change(
    displacement: Float[np.ndarray, "h w 2"],
    mask: Bool[np.ndarray, "h w"],
    depth_t: Float[np.ndarray, "h w"],
    depth_t1: Float[np.ndarray, "h w"],
    *,
    mask_t1: Bool[np.ndarray, "h w"] | None = None,
) -> Float[np.ndarray, "h w"]:
    """Camera z gained by the fluid of each pixel in a frame, m (paper: v_z; see `lift_flow` for the rules)."""
    mask = np.asarray(mask, bool)
    after = mask if mask_t1 is None else np.asarray(mask_t1, bool)
    rows, cols = np.nonzero(mask)
    d = np.asarray(displacement, np.float64)[rows, cols]
    z = np.asarray(depth_t, np.float64)
    # 1/z is linear in the pixels of a plane, z is not; fluid pixels only: depth outside the mask means nothing
    near = np.where(after, 1.0 / np.where(after, depth_t1, 1.0), 0.0)
    end = np.stack([rows + d[:, 1], cols + d[:, 0]])
    total, share = (
        ndimage.map_coordinates(f, end, order=1, mode="constant", cval=0.0) for f in (near, after.astype(np.float64))
    )
    slope = masked_gradient(np.where(mask, 1.0 / np.where(mask, z, 1.0), 0.0), mask)[rows, cols]
    along = np.maximum(1.0 / z[rows, cols] + (slope * d).sum(axis=-1), 0.1 / z[rows, cols])
    change = np.zeros(mask.shape)
    change[rows, cols] = 1.0 / np.where(share > 0.99, total, along) - z[rows, cols]
    middle = np.median(change[mask])
    spread = 1.4826 * np.median(np.abs(change[mask] - middle)) + 1e-3 * np.median(np.abs(z[mask]))
    return np.where(mask, np.clip(change, middle - OUTLIER * spread, middle + OUTLIER * spread), 0.0)
