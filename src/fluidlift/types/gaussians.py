"""3D Gaussians, activated: linear scales in metres, opacity in [0, 1]."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from fluidlift.errors import require
from fluidlift.types import harmonics
from fluidlift.types.rows import rows
from fluidlift.types.transforms import Similarity3, matrix_from_quat, quat_from_matrix

SH_C0 = 0.28209479177387814
"""the constant spherical harmonic: rgb = 0.5 + SH_C0 * f_dc"""


@dataclass(frozen=True)
class Gaussians:
    """n anisotropic Gaussians with spherical harmonics of degree d."""

    means: Float[np.ndarray, "n 3"]
    """centres, m"""
    quats: Float[np.ndarray, "n 4"]
    """orientation w x y z, unit"""
    scales: Float[np.ndarray, "n 3"]
    """standard deviations along the principal axes, m"""
    opacities: Float[np.ndarray, " n"]
    """0 to 1"""
    sh: Float[np.ndarray, "n k 3"]
    """k = (d+1)^2 coefficients per colour channel; rgb = 0.5 + 0.28209 sh[:, 0] when d = 0"""

    def __post_init__(self) -> None:
        n = len(self.means)
        shapes = {
            "means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,),
        }  # fmt: skip
        for name, shape in shapes.items():
            array = np.ascontiguousarray(getattr(self, name), dtype=np.float32)
            require(array.shape == shape, f"{name} of shape {array.shape}", str(shape))
            object.__setattr__(self, name, array)
        sh = np.ascontiguousarray(self.sh, dtype=np.float32)
        require(
            sh.ndim == 3 and sh.shape[0] == n and sh.shape[2] == 3 and sh.shape[1] in (1, 4, 9, 16),
            f"sh of shape {sh.shape}",
            f"({n}, (d+1)^2, 3) with degree d of 0 to 3",
        )
        object.__setattr__(self, "sh", sh)

    def __len__(self) -> int:
        return len(self.means)

    @classmethod
    def empty(cls, coefficients: int = 1) -> Gaussians:
        """No Gaussians at all."""
        return cls(np.zeros((0, 3)), np.zeros((0, 4)), np.zeros((0, 3)), np.zeros(0), np.zeros((0, coefficients, 3)))

    @classmethod
    def isotropic(
        cls,
        means: Float[np.ndarray, "n 3"],
        scale: float | Float[np.ndarray, " n"],
        rgb: Float[np.ndarray, "n 3"],
        opacity: float | Float[np.ndarray, " n"] = 0.9,
    ) -> Gaussians:
        """Round Gaussians of one standard deviation (m) with colours in [0, 1]."""
        n = len(means)
        quats = np.zeros((n, 4), np.float32)
        quats[:, 0] = 1.0
        scales = np.broadcast_to(np.asarray(scale, np.float32).reshape(-1, 1), (n, 3))
        return cls(means, quats, scales, np.broadcast_to(np.float32(opacity), (n,)), sh_from_rgb(rgb))

    @property
    def rgb(self) -> Float[np.ndarray, "n 3"]:
        """View-independent part of the colour, clipped to [0, 1]."""
        return np.clip(0.5 + SH_C0 * self.sh[:, 0], 0.0, 1.0)

    def covariances(self) -> Float[np.ndarray, "n 3 3"]:
        """R diag(scales^2) R^T, m^2 (paper: A)."""
        r = matrix_from_quat(self.quats) * self.scales[:, None, :]
        return r @ np.swapaxes(r, 1, 2)

    def select(self, index: np.ndarray | slice) -> Gaussians:
        """Those of a boolean or integer index, or of a slice."""
        if not isinstance(index, slice) and np.asarray(index).dtype == bool and len(index) == len(self):
            index = np.flatnonzero(index)  # once for all
        return Gaussians(*(rows(a, index) for a in (self.means, self.quats, self.scales, self.opacities, self.sh)))

    def transformed(self, target_from_source: Similarity3) -> Gaussians:
        """Moved, turned and scaled as one body: it looks the same from a camera that was moved with it."""
        t = target_from_source
        return replace(
            self,
            means=t.points(self.means),
            quats=t.quats(self.quats),
            scales=self.scales * t.scale,
            sh=harmonics.rotated(self.sh, t.rotation),
        )


def sh_from_rgb(rgb: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 1 3"]:
    """Degree-0 harmonics of colours in [0, 1]."""
    return ((np.asarray(rgb, np.float32) - 0.5) / SH_C0)[:, None, :].astype(np.float32)


def concatenate(parts: Sequence[Gaussians]) -> Gaussians:
    """All Gaussians of several bodies, in order. Harmonics are padded to the highest degree."""
    parts = [p for p in parts if len(p)] or list(parts[:1])
    require(len(parts) > 0, "nothing to concatenate")
    k = max(p.sh.shape[1] for p in parts)
    sh = [p.sh if p.sh.shape[1] == k else np.pad(p.sh, ((0, 0), (0, k - p.sh.shape[1]), (0, 0))) for p in parts]
    return Gaussians(
        np.concatenate([p.means for p in parts]),
        np.concatenate([p.quats for p in parts]),
        np.concatenate([p.scales for p in parts]),
        np.concatenate([p.opacities for p in parts]),
        np.concatenate(sh),
    )


def decompose_covariances(
    covariances: Float[np.ndarray, "n 3 3"], floor: float = 1e-12
) -> tuple[Float[np.ndarray, "n 4"], Float[np.ndarray, "n 3"]]:
    """Orientations (w x y z) and scales (m, ascending) of symmetric positive definite matrices (m^2)."""
    c = 0.5 * (covariances + np.swapaxes(covariances, 1, 2))
    values, vectors = np.linalg.eigh(c)
    vectors[..., 0] *= np.sign(np.linalg.det(vectors))[:, None]  # a reflection is no rotation
    return quat_from_matrix(vectors), np.sqrt(np.maximum(values, floor))
