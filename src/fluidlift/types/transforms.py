"""Rigid motions, similarities and quaternions. Names read `target_from_source`; products cancel like units."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from fluidlift.errors import require


def matrix_from_quat(quats: Float[np.ndarray, "*n 4"]) -> Float[np.ndarray, "*n 3 3"]:
    """Rotation matrices of unit quaternions in the order w, x, y, z (normalised here)."""
    q = np.asarray(quats)
    q = q / np.maximum(np.linalg.norm(q, axis=-1, keepdims=True), 1e-12)
    w, x, y, z = np.moveaxis(q, -1, 0)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return np.stack(rows, axis=-1).reshape(*q.shape[:-1], 3, 3)


def quat_from_matrix(matrices: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n 4"]:
    """Unit quaternions (w, x, y, z; w >= 0) of rotation matrices.

    The column of the symmetric 4x4 form with the largest diagonal entry is taken, which is stable for every angle.
    """
    m = np.asarray(matrices)
    m00, m11, m22 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    k = np.empty((*m.shape[:-2], 4, 4), m.dtype)
    k[..., 0, 0] = 1 + m00 + m11 + m22
    k[..., 1, 1] = 1 + m00 - m11 - m22
    k[..., 2, 2] = 1 - m00 + m11 - m22
    k[..., 3, 3] = 1 - m00 - m11 + m22
    k[..., 0, 1] = k[..., 1, 0] = m[..., 2, 1] - m[..., 1, 2]
    k[..., 0, 2] = k[..., 2, 0] = m[..., 0, 2] - m[..., 2, 0]
    k[..., 0, 3] = k[..., 3, 0] = m[..., 1, 0] - m[..., 0, 1]
    k[..., 1, 2] = k[..., 2, 1] = m[..., 0, 1] + m[..., 1, 0]
    k[..., 1, 3] = k[..., 3, 1] = m[..., 0, 2] + m[..., 2, 0]
    k[..., 2, 3] = k[..., 3, 2] = m[..., 1, 2] + m[..., 2, 1]
    best = np.argmax(np.diagonal(k, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(k, best[..., None, None], axis=-1)[..., 0]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., :1] < 0, -q, q)


def turned(rotation: Float[np.ndarray, "3 3"], x: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "3 m"]:
    """Rotated vectors as the columns of a wide matrix.

    As the rows of a tall one the product takes four to ten times as long, and starts threads of BLAS that wait for each
    other where other threads work beside them (200,000 points 2.3 to 8.6 > 0.6 ms); of mixed types it takes longer yet.
    """
    return rotation @ np.asarray(x, np.float64).reshape(-1, 3).T


def in_rows(wide: Float[np.ndarray, "3 m"], shape: tuple[int, ...]) -> Float[np.ndarray, "*n 3"]:
    """The columns of a wide matrix as the rows of an array of a shape."""
    return np.ascontiguousarray(wide.T).reshape(shape)


@dataclass(frozen=True)
class RigidTransform:
    """x_target = rotation @ x_source + translation."""

    rotation: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    """orthonormal, determinant +1"""
    translation: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    """metres"""

    def __post_init__(self) -> None:
        r = np.asarray(self.rotation, np.float64)
        t = np.asarray(self.translation, np.float64)
        require(r.shape == (3, 3) and t.shape == (3,), f"rotation {r.shape}, translation {t.shape}", "(3, 3) and (3,)")
        require(bool(np.isfinite(r).all() and np.isfinite(t).all()), "a transform with non-finite numbers")
        require(
            np.allclose(r @ r.T, np.eye(3), atol=1e-4) and np.linalg.det(r) > 0,
            "a rotation that is not orthonormal with determinant +1",
        )
        object.__setattr__(self, "rotation", r)
        object.__setattr__(self, "translation", t)

    def points(self, x: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Positions, metres."""
        return in_rows(self.coordinates(x), np.shape(x))

    def coordinates(self, x: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "3 m"]:
        """Positions, metres: each coordinate of all points in a row."""
        out = turned(self.rotation, x)
        out += self.translation[:, None]
        return out

    def vectors(self, v: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Directions and velocities: rotated, not moved."""
        return in_rows(turned(self.rotation, v), np.shape(v))

    def inverse(self) -> RigidTransform:
        """source_from_target."""
        return RigidTransform(self.rotation.T, -self.rotation.T @ self.translation)

    def __matmul__(self, other: RigidTransform) -> RigidTransform:
        """a_from_b @ b_from_c = a_from_c."""
        return RigidTransform(self.rotation @ other.rotation, self.rotation @ other.translation + self.translation)


@dataclass(frozen=True)
class Similarity3:
    """x_target = scale * rotation @ x_source + translation."""

    scale: float = 1.0
    """target length per source length"""
    rotation: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    translation: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    """in target units"""

    def __post_init__(self) -> None:
        require(np.isfinite(self.scale) and self.scale > 0, f"scale {self.scale}", "a positive finite number")
        rigid = RigidTransform(self.rotation, self.translation)  # checks
        object.__setattr__(self, "rotation", rigid.rotation)
        object.__setattr__(self, "translation", rigid.translation)

    def points(self, x: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Positions."""
        out = turned(self.rotation, x)
        out *= self.scale
        out += self.translation[:, None]
        return in_rows(out, np.shape(x))

    def vectors(self, v: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Displacements and velocities (scaled with the lengths)."""
        return in_rows(self.scale * turned(self.rotation, v), np.shape(v))

    def covariances(self, c: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n 3 3"]:
        """Second moments of positions."""
        return self.scale**2 * (self.rotation @ c @ self.rotation.T)

    def quats(self, q: Float[np.ndarray, "*n 4"]) -> Float[np.ndarray, "*n 4"]:
        """Orientations, w x y z."""
        return quat_from_matrix(self.rotation @ matrix_from_quat(q))

    def inverse(self) -> Similarity3:
        """source_from_target."""
        r = self.rotation.T
        return Similarity3(1.0 / self.scale, r, -(r @ self.translation) / self.scale)

    def __matmul__(self, other: Similarity3) -> Similarity3:
        """a_from_b @ b_from_c = a_from_c."""
        return Similarity3(
            self.scale * other.scale,
            self.rotation @ other.rotation,
            self.scale * (self.rotation @ other.translation) + self.translation,
        )
