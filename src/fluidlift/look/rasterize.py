"""Gaussians to a picture, expected depth and coverage, on the CPU."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fluidlift.errors import require
from fluidlift.look.project import LARGEST, bounded_scales, sound, view_colors
from fluidlift.numerics.splatting import PAIRS_MAX, Projected, View, bin_tiles, project, rasterize
from fluidlift.numerics.splatting_kernels import TILE
from fluidlift.types.camera import PinholeCamera
from fluidlift.types.gaussians import Gaussians


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
    require(features is None or (np.ndim(features) == 2 and len(features) == n), f"features of {np.shape(features)}",
            f"({n}, c)")  # fmt: skip
    ok = sound(gaussians)
    if features is not None:
        ok &= np.isfinite(features).all(1)
    g = gaussians if ok.all() else gaussians.select(ok)
    colors = view_colors(g, camera) if features is None else np.asarray(features, np.float32)[ok]
    behind = _background(background, (height, width, colors.shape[1]))

    projected, opacities = _project_bounded(g, camera)
    drawn = np.concatenate([colors, projected.depths[:, None]], axis=1).astype(np.float32)
    image, light = rasterize(projected, opacities, drawn, bin_tiles(projected, camera.size), camera.size)
    alpha = 1.0 - light
    depth = np.where(alpha > 1e-3, image[..., -1] / np.maximum(alpha, 1e-3), 0.0)
    return Rendered(image[..., :-1] + light[..., None] * behind, depth.astype(np.float32), alpha)


def _background(background: tuple[float, ...] | np.ndarray | None, shape: tuple[int, int, int]) -> np.ndarray:
    behind = np.asarray(0.0 if background is None else background, np.float32)
    fits = behind.ndim == 0 or behind.shape in ((shape[2],), shape)
    require(fits, f"background of shape {behind.shape}", f"one value per channel ({shape[2]}) or {shape}")
    return behind


def _project_bounded(g: Gaussians, camera: PinholeCamera) -> tuple[Projected, np.ndarray]:
    """Projection whose pairs of tile and Gaussian fit into memory: the bound on the widths halves until they do."""
    view = View.of(camera)
    depths = camera.camera_from_world.points(g.means)[:, 2]
    opacities = np.clip(g.opacities, 0.0, 1.0)
    largest = LARGEST
    while True:
        scales = bounded_scales(g.scales, depths, camera, largest)
        projected = project(view, g.means, g.quats, scales, opacities)
        spans = np.minimum(2 * projected.extents / TILE + 2, np.asarray(camera.size) / TILE + 1)
        if spans[projected.extents[:, 0] > 0].prod(1).sum(dtype=np.float64) <= PAIRS_MAX or largest < 1e-3:
            return projected, opacities
        largest /= 2
