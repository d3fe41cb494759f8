"""The bed under a liquid, for what is seen through it.

A rock in the terrain is a model of one: upright, since nobody has seen its sides, with a foot of gravel. Light that is
bent beside it comes from behind it, where the bed goes on. And before a clip's own picture of a rock its model would
stand around and above it like a halo: there it is seen under water alone, and runs into the bed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy import ndimage

from fluidlift.look.smoothstep import smoothstep
from fluidlift.look.stream_slab import Slab
from fluidlift.numerics.ground_block import PARTS
from fluidlift.shape.background import filled_in
from fluidlift.shape.texture_grain import grain
from fluidlift.types import Grid, TriangleMesh

FOOT = 5
"""cells beside what stands out of the water that its foot, and its colours, may reach"""
SUNK = 1.0
"""cells below the liquid at rest that a foot ends, at least: it hides nothing of a wave's hollow"""
OWN = (0.0, 1.5)
"""cells beside it from which on, and up to which, its foot takes on the colours of the bed: there it is covered by
what covers the bed. Farther out the pale stone of a rock stands around it under water like a halo"""
EVEN = 1.0
"""cells over which the colours of the bed are evened out where they are not seen"""


@dataclass(frozen=True)
class Beds:
    """Ground without what stands out of its liquid and is no bank."""

    cut: TriangleMesh
    """cut off at the level of the liquid"""
    sunk: TriangleMesh
    """cut off below it: with its foot"""
    level: TriangleMesh
    """with the bed in its place"""


def beds_of(slab: Slab, ground: TriangleMesh, grid: Grid) -> Beds | None:
    """None where nothing stands out of the liquid."""
    found = slab.islands(ground, grid)
    if found is None:
        return None
    heights, level, island = found
    away = ndimage.distance_transform_edt(~island) / PARTS
    bed = (heights < level) & (away > FOOT)
    if not bed.any():
        return None
    low = filled_in(np.where(bed, heights, 0.0)[..., None].repeat(3, 2).astype(np.float32), bed)[..., 0]
    low = np.where(bed, heights, ndimage.gaussian_filter(low, 0.5 * FOOT * PARTS))
    low = np.minimum(low, heights)
    foot = np.minimum(heights, level - SUNK * grid.spacing)
    sunk = np.where(away <= FOOT, foot, heights)
    flat = np.where(away <= FOOT, low, heights)
    own = 1.0 - smoothstep(np.asarray(away, np.float32), *OWN)
    texture = ground.texture
    if texture is not None and ground.uv is not None:
        top = 2 * (heights.shape[0] - 1) * (heights.shape[1] - 1)  # its faces come first
        rows = round(float(ground.uv[:top, :, 1].max()) * len(texture))
        painted = _painted_over(texture[:rows], np.where(away <= FOOT + 1, 1.0 - own, 0.0), bed)
        texture = np.concatenate([painted, texture[rows:]])

    def with_heights(values: np.ndarray) -> TriangleMesh:
        points = np.asarray(ground.vertices).copy()
        points[: heights.size, 2] = values.ravel()
        return replace(ground, vertices=points, texture=texture)

    cut = np.where(island, np.minimum(heights, level), heights)
    return Beds(with_heights(cut), with_heights(sunk), with_heights(flat))


def _painted_over(texture: np.ndarray, share: np.ndarray, bed: np.ndarray) -> np.ndarray:
    """A map from above, u8 [h,w,3], with the stuff of the bed.

    Args:
        texture: y up.
        share: [nx,ny], of the nodes of the ground, how much of it.
        bed: bool [nx,ny], where it is known.
    """
    height, width = texture.shape[:2]

    def as_map(nodes: np.ndarray) -> np.ndarray:
        return cv2.resize(nodes.T[::-1].astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)

    image, source = texture.astype(np.float32), as_map(bed) > 0.999
    if not source.any():
        return texture
    sigma = EVEN * PARTS * width / share.shape[0]
    weight = cv2.GaussianBlur(source.astype(np.float32), (0, 0), sigma)
    mean = cv2.GaussianBlur(image * source[..., None], (0, 0), sigma) / np.maximum(weight, 1e-6)[..., None]
    filled = cv2.GaussianBlur(filled_in(mean, source), (0, 0), 0.5 * sigma) + grain(image, mean, source)
    return np.clip(np.round(image + as_map(share)[..., None] * (filled - image)), 0, 255).astype(np.uint8)
