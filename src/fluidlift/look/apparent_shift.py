"""Where overlapping splats of a surface appear: the nearer ones hide the near side of those behind them.

Splats are drawn from front to back, so what is left to be seen of each is its far side. On a surface that is seen from
flat above, a pixel shows splats whose centres lie one or two pixels nearer (lower in the picture): a look that was
taken at the centres would come out displaced by as much.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from fluidlift.look.rasterize import render
from fluidlift.types import Gaussians, PinholeCamera

SEEN = 0.8
"""coverage of a pixel in which a centre is looked for"""
SMOOTH = 6.0
"""px over which the displacement is taken: those of single splats differ by 0.1 to 0.3 px about it, and it changes with
the tilt and the distance of the surface, over some ten times as much"""
FARTHEST = 4.0
"""px: what appears further off is seen through a gap, or past an edge. Splats two px apart appear 0.3 px (seen from
straight above) to 2.4 px (ten degrees) away"""


def apparent_shift(splats: Gaussians, camera: PinholeCamera) -> Float[np.ndarray, "h w 2"]:
    """Rows and columns from where a splat has its centre to the middle of what is seen of it, px, by the pixel of the
    centre; 0 where none is seen.

    Args:
        splats: of a surface, world, m.
        camera: who looks.
    """
    width, height = camera.size
    uv, depth = camera.project(splats.means)
    centers = np.where(depth[:, None] > 0, uv, 0.0)
    drawn = render(splats, camera, features=centers[:, ::-1].astype(np.float32))
    pixels = np.moveaxis(np.indices((height, width)), 0, -1) + 0.5
    away = pixels - drawn.image / np.maximum(drawn.alpha, 1e-3)[..., None]
    known = (drawn.alpha > SEEN) & (np.linalg.norm(away, axis=-1) < FARTHEST)
    weight = ndimage.gaussian_filter(known.astype(np.float32), SMOOTH)
    smooth = np.stack([ndimage.gaussian_filter(np.where(known, a, 0.0), SMOOTH) for a in np.moveaxis(away, -1, 0)], -1)
    return np.where(weight[..., None] > 0.01, smooth / np.maximum(weight, 0.01)[..., None], 0.0)
