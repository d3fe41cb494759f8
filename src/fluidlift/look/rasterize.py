"""Gaussian splatting: Gaussians to a picture, expected depth and coverage (alpha compositing), on the CPU."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fluidlift.errors import require
from fluidlift.look.project import LARGEST, bounded_scales, camera_depths, sound, view_colors
from fluidlift.numerics.sharing import shared
from fluidlift.numerics.splatting import Bins, Projected, SplatCamera, bin_tiles, project, rasterize_drawn, tiles_met
from fluidlift.numerics.splatting_kernels import WIDE_TILE
from fluidlift.types.camera import PinholeCamera
from fluidlift.types.gaussians import Gaussians

PAIRS_DRAWN_MAX = 400_000_000
"""largest number of pairs of tile and Gaussian that a picture may take (some ten seconds; memory is bounded anyway)"""
COUNT_MAX = 2**31 - 1
"""Gaussians in one picture: their indices are 32 bits"""
COVERED_MIN = np.float32(1e-3)
"""coverage below which a pixel has no depth"""


@dataclass(frozen=True)
class Rendered:
    """What a camera sees of Gaussians."""

    image: Float[np.ndarray, "h w c"]
    """float32; colours in [0, 1] (not clipped), or the features asked for"""
    depth: Float[np.ndarray, "h w"]
    """expected camera z (weighted by what reaches the eye), m; 0 where empty"""
    alpha: Float[np.ndarray, "h w"]
    """coverage, 0 to 1"""


def render(
    gaussians: Gaussians,
    camera: PinholeCamera,
    *,
    background: tuple[float, ...] | Float[np.ndarray, "h w c"] | None = None,
    features: Float[np.ndarray, "n c"] | None = None,
) -> Rendered:
    """Draw Gaussians.

    Any Gaussians will do: those with non-finite numbers are left out, opacities are held in [0, 1], and none is drawn
    wider than a quarter of the picture (standard deviation).

    Args:
        gaussians: n Gaussians, world, m. Harmonics above degree 0 are evaluated along each line of sight.
        camera: who looks.
        background: one colour, or a picture of the camera's size, behind the Gaussians; None: black.
        features: float [n,c], drawn in place of the colours.

    Raises:
        ValueError: features or background of the wrong shape.
    """
    width, height = camera.size
    n = len(gaussians)
    require(n <= COUNT_MAX, f"{n} Gaussians", f"at most {COUNT_MAX}", "draw them in parts, or prune them")
    shape = (n, 3) if features is None else np.shape(features)
    require(len(shape) == 2 and shape[0] == n, f"features of {shape}", f"({n}, c)")
    channels = shape[1]
    behind = _background(background, (height, width, channels))

    ok = sound(gaussians)
    if features is not None:
        ok &= np.isfinite(features).all(1)
    projected, opacities, bins = _project_bounded(gaussians, np.where(ok, gaussians.opacities, np.float32(0)), camera)
    # of millions of Gaussians far from all are drawn: only those get colours and depth
    index = bins.order
    drawn = np.empty((len(index), channels + 1), np.float32)
    drawn[:, :-1] = view_colors(gaussians, camera, index) if features is None else features[index]
    drawn[:, -1] = projected.depths[index]
    image, depth, light = rasterize_drawn(projected, opacities, drawn, bins, camera.size)
    over_kernel(image, depth, light, behind)
    return Rendered(image, depth, light)


@shared(lambda image, *_: (0, image.shape[0]), error_model="numpy")
def over_kernel(begin, end, image, depth, light, behind):
    """Features and depth (premultiplied) and the light that is left, before a background [h or 1,w or 1,c]. In place,
    and the light becomes the coverage: one pass over the picture, where array operations make eight with as many
    arrays."""
    _, width, channels = image.shape
    one, zero = np.float32(1), np.float32(0)
    for i in range(begin, end):
        bi = min(i, behind.shape[0] - 1)
        for j in range(width):
            bj = min(j, behind.shape[1] - 1)
            left = light[i, j]
            covered = one - left
            light[i, j] = covered
            depth[i, j] = depth[i, j] / covered if covered > COVERED_MIN else zero
            for c in range(channels):
                image[i, j, c] += left * behind[bi, bj, c]


def over_plain(
    image: np.ndarray, depth: np.ndarray, light: np.ndarray, behind: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What `over_kernel` leaves in its operands, for reading."""
    alpha = 1.0 - light
    mean = np.where(alpha > COVERED_MIN, depth / np.maximum(alpha, COVERED_MIN), np.float32(0))
    return image + light[..., None] * behind, mean, alpha


def _background(background: tuple[float, ...] | np.ndarray | None, shape: tuple[int, int, int]) -> np.ndarray:
    """[h,w,c] or [1,1,c], for `over_kernel`."""
    behind = np.asarray(0.0 if background is None else background, np.float32)
    fits = behind.ndim == 0 or behind.shape in ((shape[2],), shape)
    require(fits, f"background of shape {behind.shape}", f"one value per channel ({shape[2]}) or {shape}")
    whole = behind if behind.ndim == 3 else np.broadcast_to(behind, (1, 1, shape[2]))
    return np.require(whole, requirements=("C", "W"))  # one kind of array, so that the kernel is compiled once


def _project_bounded(g: Gaussians, opacities: np.ndarray, camera: PinholeCamera) -> tuple[Projected, np.ndarray, Bins]:
    """Projection whose pairs of tile and Gaussian are not too many: the bound on the widths halves until they fit."""
    view = SplatCamera.of(camera)
    depths = camera_depths(g.means, camera)
    opacities = np.clip(opacities, 0.0, 1.0)
    largest = LARGEST
    while True:
        scales = bounded_scales(g.scales, depths, camera, largest)
        projected = project(view, g.means, g.quats, scales, opacities)
        if tiles_met(projected, camera.size) <= PAIRS_DRAWN_MAX or largest < 1e-3:
            return projected, opacities, bin_tiles(projected, camera.size, WIDE_TILE, slots=False)
        largest /= 2
