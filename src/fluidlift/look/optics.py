"""Light at the surface of a transparent body and inside it: Fresnel, Snell, Beer and Lambert (Born and Wolf 1999)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.errors import require


def fresnel(cos_incident: Float[np.ndarray, "*n"], refractive_index: float) -> Float[np.ndarray, "*n"]:
    """Share of unpolarised light that a smooth dielectric surface reflects: the mean of both polarisations, exact.

    Args:
        cos_incident: cosine between the outward normal and the direction the light comes from. Positive: from
            outside; negative: from within the body, where there is total reflection beyond the critical angle.
        refractive_index: of the body next to what surrounds it, above 0.

    Raises:
        ValueError: an index that is not positive.
    """
    require(np.isfinite(refractive_index) and refractive_index > 0, f"refractive index {refractive_index}", "above 0")
    cos = np.clip(np.asarray(cos_incident), -1.0, 1.0)
    # index on the far side over that on the near side
    ratio = np.where(cos >= 0, refractive_index, 1.0 / refractive_index).astype(cos.dtype)
    near = np.abs(cos)
    left = 1.0 - (1.0 - near * near) / (ratio * ratio)
    far = np.sqrt(np.maximum(left, 0.0))
    across = (near - ratio * far) / np.maximum(near + ratio * far, 1e-20)
    along = (ratio * near - far) / np.maximum(ratio * near + far, 1e-20)
    share = 0.5 * (across * across + along * along)
    # at grazing incidence both are 1; 0 / 0 there where the indices are equal
    return np.where((left <= 0) | (near <= 0), 1.0, share).astype(cos.dtype)


def refract(
    directions: Float[np.ndarray, "*n 3"], normals: Float[np.ndarray, "*n 3"], ratio: float
) -> tuple[Float[np.ndarray, "*n 3"], Bool[np.ndarray, "*n"]]:
    """Directions of light behind a surface (Snell), and False where it is reflected in total.

    Args:
        directions: unit, the way the light goes.
        normals: unit, towards where the light comes from; those that point the other way are turned.
        ratio: index on the near side over that on the far side, such as 1 / 1.333 into water.

    Returns:
        Unit directions (where nothing passes: those of the mirror), and whether light passes.
    """
    d, n = np.asarray(directions), np.asarray(normals)
    cos = -(d * n).sum(axis=-1, keepdims=True)
    n = np.where(cos < 0, -n, n)
    cos = np.abs(cos)
    left = 1.0 - ratio * ratio * (1.0 - cos * cos)
    passes = left >= 0
    bent = ratio * d + (ratio * cos - np.sqrt(np.maximum(left, 0.0))) * n
    return np.where(passes, bent, d + 2.0 * cos * n).astype(d.dtype), passes[..., 0]


def mirrored(directions: Float[np.ndarray, "*n 3"], normals: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Directions of light after a mirror, for unit normals on either side of it."""
    d, n = np.asarray(directions), np.asarray(normals)
    return d - 2.0 * (d * n).sum(axis=-1, keepdims=True) * n


def transmittance(
    absorption: Float[np.ndarray, "3"] | tuple[float, float, float], thickness: Float[np.ndarray, "*n"]
) -> Float[np.ndarray, "*n 3"]:
    """Share of the light left after `thickness` metres (Beer and Lambert): exp(-absorption thickness)."""
    depth = np.maximum(np.asarray(thickness), 0.0)
    return np.exp(-depth[..., None] * np.asarray(absorption, depth.dtype))
