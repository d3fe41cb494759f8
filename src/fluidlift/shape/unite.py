"""Makes the bodies of several frames one (paper: union over N frames), and says how many frames that should be."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Int, UInt8
from scipy.spatial import cKDTree

from fluidlift.errors import require
from fluidlift.types.gaussians import Gaussians, concatenate

CALM = 40.0
"""dB between neighbouring frames at which hardly any motion is seen: the longest window"""


def psnr(a: UInt8[np.ndarray, "h w 3"], b: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"] | None) -> float:
    """Likeness of two frames inside a mask, dB, at most 60 (equal frames)."""
    d = a.astype(np.float32) - b.astype(np.float32)
    error = float(np.mean(d**2 if mask is None else d[mask] ** 2)) / 255**2
    return -10 * float(np.log10(max(error, 1e-6)))


def window_length(
    frames: UInt8[np.ndarray, "t h w 3"],
    mask: Bool[np.ndarray, "h w"] | Bool[np.ndarray, "t h w"] | None,
    *,
    shortest: int = 2,
    longest: int = 8,
) -> int:
    """Number N of consecutive frames whose bodies are united.

    The paper: N in proportion to MSE(PSNR(f, f+1)). Read as the mean of the squared PSNR between neighbours, with the
    factor that gives `longest` at 40 dB: N = longest mean(PSNR^2) / 40^2. A calm fluid looks alike from frame to frame
    and may be gathered over more of them; a wild one has another shape two frames later. So 20 dB gives a quarter of
    the longest window, 28 dB half of it.

    Args:
        frames: u8, sRGB.
        mask: the fluid, one for all frames or one per frame; None or empty: the whole picture.
        shortest: N at least.
        longest: N at most; also never more than there are frames.
    """
    require(1 <= shortest <= longest, f"shortest {shortest}, longest {longest}", "1 <= shortest <= longest")
    count = len(frames)
    if count < 2:
        return count
    masks = None if mask is None else np.broadcast_to(mask, frames.shape[:3])
    squares = []
    for f in range(count - 1):
        both = None if masks is None else masks[f] & masks[f + 1]
        squares.append(psnr(frames[f], frames[f + 1], both if both is not None and both.any() else None) ** 2)
    n = round(longest * float(np.mean(squares)) / CALM**2)
    return min(max(n, shortest), longest, count)


def unite(bodies: Sequence[Gaussians], *, spacing: float, per_voxel: int = 1, whole_first: bool = False) -> Gaussians:
    """The union of bodies on a grid of fine voxels.

    A voxel belongs to the first body that has a Gaussian in it, and keeps that body's `per_voxel` most opaque ones (the
    first of equals). So the body of the nearest frame lends its shape and colours, the others close what it lacks, and
    the number of Gaussians is bounded by the voxels of the union, however many frames there are.

    Args:
        bodies: nearest frame first; world, m.
        spacing: of the voxels, m. At or below the distance of neighbouring Gaussians the first body stays as it is.
        per_voxel: Gaussians per voxel at most.
        whole_first: the first body keeps all of its Gaussians, and the others give only what lies a whole voxel away
            from it. Where the camera is near, its Gaussians are closer together than the voxels, and a surface of small
            splats that is thinned has holes; one over which the splats of other frames lie is blurred.
    """
    require(len(bodies) > 0, "no body to unite", "one at least")
    require(np.isfinite(spacing) and spacing > 0, f"spacing {spacing}", "positive metres")
    require(per_voxel >= 1, f"per_voxel {per_voxel}", "1 or more")
    bodies = [b.select(np.all(np.isfinite(b.means) & (np.abs(b.means) < 1e6), axis=1)) for b in bodies]
    everything = concatenate(bodies)
    if len(everything) == 0:
        return everything
    number = np.repeat(np.arange(len(bodies)), [len(b) for b in bodies])
    low = everything.means.min(0).astype(np.float64)
    cells = np.floor((everything.means - low) / spacing).astype(np.int64)
    _, voxel = np.unique(cells, axis=0, return_inverse=True)
    voxel = voxel.reshape(-1)
    order = np.lexsort((-np.nan_to_num(everything.opacities), number, voxel))
    voxel, number = voxel[order], number[order]
    first = np.r_[True, voxel[1:] != voxel[:-1]]
    start = np.flatnonzero(first)[np.cumsum(first) - 1]
    kept = (number == number[start]) & (np.arange(len(order)) - start < per_voxel)
    if whole_first:
        own = number == 0
        kept = own | (kept & ~_beside(cells[order], own))
    return everything.select(np.sort(order[kept]))


def _beside(cells: Int[np.ndarray, "n 3"], own: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Whether a cell of the others is, or touches, one of `own` (with its faces, edges or corners)."""
    out = np.zeros(len(cells), bool)
    others = np.flatnonzero(~own)
    if len(others) == 0 or not own.any():
        return out
    near, _ = cKDTree(np.unique(cells[own], axis=0)).query(cells[others], distance_upper_bound=1.9)
    out[others] = np.isfinite(near)  # the corners are sqrt(3) away, the next but one 2
    return out
