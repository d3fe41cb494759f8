"""A picture in light, and pictures drawn finer than they are shown."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from fluidlift.errors import require
from fluidlift.look.ground_picture import GroundLight


@dataclass(frozen=True)
class Quality:
    """How much work a picture gets."""

    supersample: int = 1
    """1 to 8: pictures are drawn so many times as wide and as high, and averaged in linear light: edges become smooth,
    at the price of so many pixels. Mitsuba's are smooth as they are"""
    samples: int = 64
    """light paths per pixel, of Mitsuba"""
    light: GroundLight = field(default_factory=GroundLight)
    """on the ground"""
    coarse: bool = False
    """the surface's mesh has larger triangles"""

    def __post_init__(self) -> None:
        require(1 <= self.supersample <= 8, f"a supersample of {self.supersample}", "1 to 8")

    @classmethod
    def draft(cls) -> Quality:
        """To try a look: rough edges, and shadows that are softer and of fewer directions."""
        return cls(samples=8, light=GroundLight(directions=6, shadow=512), coarse=True)


@dataclass(frozen=True)
class Lit:
    """One picture in linear light."""

    image: np.ndarray
    """[h,w,3]; premultiplied by `alpha` where the fluid is cut out"""
    alpha: np.ndarray
    """[h,w], share that is covered"""
    depth: np.ndarray
    """[h,w] camera z, m; 0 where nothing is"""


def enlarged(picture: np.ndarray | None, k: int) -> np.ndarray | None:
    """Every pixel k x k times."""
    return None if picture is None else picture.repeat(k, axis=0).repeat(k, axis=1)


def averaged(lit: Lit, k: int) -> Lit:
    """A picture of k x k as many pixels, averaged; its depth is the nearest of each."""
    h, w = lit.alpha.shape[0] // k, lit.alpha.shape[1] // k
    depth = np.where(lit.depth > 0, lit.depth, np.inf).reshape(h, k, w, k).min(axis=(1, 3))
    return Lit(
        lit.image.reshape(h, k, w, k, 3).mean(axis=(1, 3)), lit.alpha.reshape(h, k, w, k).mean(axis=(1, 3)),
        np.where(np.isfinite(depth), depth, 0.0).astype(np.float32),
    )  # fmt: skip
