"""Rigid bodies that viscous liquid drags along: their part in the minimum of `viscosity`.

The faces inside a body move with it, x_f = (those before) + J dU, where dU is the change of its velocity and angular
velocity. With the body's own energy 1/2 dU . M dU (in units of liquid density h^3) added, dU is sought together with
the liquid's velocity: one symmetric positive definite system, stable however light the body is, and liquid and
bodies exchange momentum without loss. (Same idea for pressure: Batty, Bertails, Bridson 2007; for both together:
Robinson-Mosher, Shinar, Gretarsson, Su, Fedkiw 2008, "Two-way coupling of fluids to rigid and deformable solids and
shells".)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from fluidlift.errors import require
from fluidlift.physics import stress_kernels as kernels


@dataclass(frozen=True)
class DraggedBody:
    """A free rigid body, as the viscous solve sees it."""

    body: int
    """number, for the caller"""
    mass: Float[np.ndarray, "6 6"]
    """mass (kg) and inertia about the centre of mass (kg m^2, world axes), over liquid density h^3"""
    faces: Int[np.ndarray, "n 4"]
    """component and index of the faces that move with it; only those with the role FIXED or WALL count"""
    values: Float[np.ndarray, "n 6"]
    """J: velocity of the face's centre per velocity (m/s) and angular velocity (rad/s) of the body"""
    shift: Float[np.ndarray, " n"]
    """m/s: velocity of the centre less that given. The pressure wants the mean over the covered part, but only faces
    that move as their centres do are without strain when body and liquid turn together"""

    def __post_init__(self) -> None:
        n = len(self.faces)
        require(self.faces.shape == (n, 4), f"faces {self.faces.shape}", "(n, 4)")
        require(self.values.shape == (n, 6), f"values {self.values.shape}", f"({n}, 6)")
        require(self.shift.shape == (n,), f"shifts {self.shift.shape}", f"({n},)")
        require(self.mass.shape == (6, 6), f"mass {self.mass.shape}", "(6, 6)")


@njit(cache=True)
def _mark_strained(normal, shear, out):
    """True on the faces that take part in a stress."""
    _, nx, ny, nz = out.shape
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        for i in range(1, nx - 1):
            for j in range(1, ny - 1):
                for k in range(1, nz - 1):
                    total = normal[a, i, j, k] + normal[a, i - (a == 0), j - (a == 1), k - (a == 2)]
                    total += shear[b, i, j, k] + shear[b, i + (c == 0), j + (c == 1), k + (c == 2)]
                    total += shear[c, i, j, k] + shear[c, i + (b == 0), j + (b == 1), k + (b == 2)]
                    out[a, i, j, k] = total > 0.0


class BodyUnknowns:
    """What the bodies add to the conjugate gradients: six unknowns each, with residual and direction.

    Args:
        bodies: may be none.
        low: first node of the box of the solve, in the grid of the bodies' faces.
        moved: bool [3,...] in the box: faces that may move with bodies.
        operator: `StressSystem.operator`.
        x: float64 [3,...], velocities with the bodies in the motion they had before; `shift` is added.
    """

    def __init__(
        self,
        bodies: Sequence[DraggedBody],
        low: tuple[int, ...],
        moved: np.ndarray,
        operator: tuple[np.ndarray, ...],
        x: np.ndarray,
    ) -> None:
        _, self._normal, self._shear, _, _ = operator
        chosen = []
        number = np.full(moved.shape if bodies else (0,) * 4, -1, np.int64)
        strained = np.zeros(number.shape, bool)
        if bodies:
            _mark_strained(self._normal, self._shear, strained)
        for body in bodies:
            at = body.faces - np.array([0, *low])
            inside = np.flatnonzero(((at[:, 1:] >= 1) & (at[:, 1:] < np.array(moved.shape[1:]) - 1)).all(axis=1))
            at = tuple(at[inside].T)
            acts = moved[at] & strained[at]
            number[tuple(a[acts] for a in at)] = 0
            chosen.append((tuple(a[acts] for a in at), body.values[inside[acts]]))
            x[chosen[-1][0]] += body.shift[inside[acts]]
        self._at = tuple(np.ascontiguousarray(a, np.int64) for a in np.nonzero(number == 0))
        number[self._at] = np.arange(len(self._at[0]))
        self._rows = [(number[at], values) for at, values in chosen]
        self._before = x[self._at]
        self._pulls = np.zeros(len(self._at[0]))
        size = (len(bodies), 6)
        self.change, self.residual, self._direction, self._image = (np.zeros(size) for _ in range(4))
        """change of (velocity m/s, angular velocity rad/s) of each body, and what is left to be balanced"""
        self._mass = np.array([b.mass for b in bodies]).reshape(-1, 6, 6)
        self._inverse_mass = np.linalg.inv(self._mass)
        self._inverse = np.linalg.inv(self._mass + self._stiffness(x))

    def _stiffness(self, x: np.ndarray) -> np.ndarray:
        """[b,6,6]: what the stresses answer when a body moves and everything else rests."""
        out, work = np.zeros_like(self._mass), np.zeros_like(x) if len(self._mass) else x
        for n, (rows, values) in enumerate(self._rows):
            for m in range(6):
                motion = np.zeros(len(self._before))
                motion[rows] = values[:, m]
                work[self._at] = motion
                out[n, :, m] = self._gathered(work)[n]
        return 0.5 * (out + out.transpose(0, 2, 1))

    def _gathered(self, x: np.ndarray) -> np.ndarray:
        """[b,6]: J^T of what the stresses take from the momentum of the bodies' faces."""
        axis, i, j, k = self._at
        kernels.pull_faces(x, self._normal, self._shear, axis, i, j, k, self._pulls)
        return np.array([(v * self._pulls[r][:, None]).sum(axis=0) for r, v in self._rows]).reshape(-1, 6)

    def _image_of(self, x: np.ndarray, motion: np.ndarray) -> np.ndarray:
        return _times(self._mass, motion) + self._gathered(x)

    def _motion_of_faces(self, motion: np.ndarray) -> np.ndarray:
        out = np.zeros(len(self._before))
        for (rows, values), six in zip(self._rows, motion):
            out[rows] += (values * six).sum(axis=1)
        return out

    def start(self, x: np.ndarray) -> float:
        """The residual, from x in which the bodies' faces hold their velocities; its square."""
        self.residual[...] = 0.0 if not len(self._mass) else -self._image_of(x, self.change)
        return self._squared()

    def _squared(self) -> float:
        # a residual r is the momentum of r . r / mass: what faces of the liquid's density in its place would give
        return float((self.residual * _times(self._inverse_mass, self.residual)).sum())

    def turn(self, direction: np.ndarray, factor: float, scale: float) -> None:
        """The bodies' part of the next direction, also on their faces, in place."""
        self._direction = scale * _times(self._inverse, self.residual) + factor * self._direction
        direction[self._at] = self._motion_of_faces(self._direction)

    def steepness(self, scale: float) -> float:
        """Residual . preconditioned residual."""
        return scale * float((self.residual * _times(self._inverse, self.residual)).sum())

    def curvature(self, direction: np.ndarray) -> float:
        """The bodies' part of direction . A direction."""
        if not len(self._mass):
            return 0.0
        self._image = self._image_of(direction, self._direction)
        return float((self._direction * self._image).sum())

    def descend(self, x: np.ndarray, step: float) -> float:
        """Go on along the direction, also on the faces of x; the square of the residual."""
        self.change += step * self._direction
        self.residual -= step * self._image
        x[self._at] = self._before + self._motion_of_faces(self.change)
        return self._squared()

    def mark(self, out: np.ndarray) -> None:
        """True on the bodies' faces (bool [3,...]), in place."""
        out[self._at] = True


def _times(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """[b,6,6] times [b,6]."""
    return (matrices * vectors[:, None, :]).sum(axis=2)
