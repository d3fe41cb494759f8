"""What `triangles` draws, in plain NumPy: every ray against every face. For tests and for reading."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from fluidlift.numerics.triangles import NEAR
from fluidlift.types.camera import PinholeCamera


def crossings(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], camera: PinholeCamera
) -> tuple[Float[np.ndarray, "h w f"], Float[np.ndarray, "h w f 3"], Int[np.ndarray, " f"]]:
    """Camera z (m; 0: none) and barycentrics where each pixel's ray meets each face, and 1 for faces seen from outside,
    -1 for the others. Rays that meet an edge exactly are left out."""
    seen = camera.camera_from_world.points(np.asarray(vertices, np.float64))
    a, b, c = (seen[faces[:, k]] for k in range(3))
    rays = np.concatenate([(camera.pixel_grid() - camera.center) / camera.focal, np.ones((*camera.size[::-1], 1))], -1)
    volume = (a * np.cross(b, c)).sum(axis=-1)
    shares = np.stack([rays @ np.cross(*pair).T for pair in ((b, c), (c, a), (a, b))], axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = shares / volume[:, None]
        z = 1.0 / shares.sum(axis=-1)
        inside = (shares > 0).all(axis=-1) & (z >= NEAR) & np.isfinite(z)
        barycentric = shares * z[..., None]
    return np.where(inside, z, 0.0), np.where(inside[..., None], barycentric, 0.0), np.where(volume < 0, 1, -1)


def nearest(depths: Float[np.ndarray, "h w f"]) -> Int[np.ndarray, "h w"]:
    """The nearest face of every pixel; -1: none."""
    filled = np.where(depths > 0, depths, np.inf)
    return np.where(np.isfinite(filled).any(axis=-1), filled.argmin(axis=-1), -1)
