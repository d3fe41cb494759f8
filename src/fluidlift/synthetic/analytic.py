"""Velocity fields that are known in closed form, sampled on the faces of a MAC grid."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from fluidlift.errors import require
from fluidlift.types import GRAVITY, FaceVelocity, Grid

VectorField = Callable[[Float[np.ndarray, "*n 3"]], Float[np.ndarray, "*n 3"]]
"""m/s at positions in m"""


def on_faces(field: VectorField, grid: Grid, dtype: type = np.float32) -> FaceVelocity:
    """The normal component of a velocity field (m/s at positions in m) at the centre of every face."""
    return FaceVelocity(*(np.ascontiguousarray(field(grid.faces(a))[..., a], dtype) for a in range(3)))


def uniform(velocity: tuple[float, float, float]) -> VectorField:
    """The same velocity (m/s) everywhere."""
    return lambda x: np.broadcast_to(np.asarray(velocity, float), x.shape)


def taylor_green(
    *, amplitude: float = 1.0, wavelength: float = 1.0, viscosity: float = 0.0, time: float = 0.0
) -> VectorField:
    """The decaying vortices of Taylor and Green (1937) in the x-y plane: an exact solution of Navier-Stokes.

    u = A sin(kx) cos(ky), v = -A cos(kx) sin(ky), both times exp(-2 nu k^2 t); no divergence.

    Args:
        amplitude: A at time 0, m/s.
        wavelength: 2 pi / k, m.
        viscosity: kinematic, nu, m^2/s.
        time: t, s.
    """
    require(wavelength > 0, f"wavelength {wavelength}", "positive metres")
    k = 2 * np.pi / wavelength
    a = amplitude * np.exp(-2 * viscosity * k * k * time)

    def field(x: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        kx, ky = k * x[..., 0], k * x[..., 1]
        return np.stack([a * np.sin(kx) * np.cos(ky), -a * np.cos(kx) * np.sin(ky), np.zeros_like(kx)], axis=-1)

    return field


def film_speed(
    depth: Float[np.ndarray, "*n"], *, thickness: float, slope: float, viscosity: float, gravity: float = GRAVITY
) -> Float[np.ndarray, "*n"]:
    """Speed (m/s) of a steady viscous film on a slope: the half-parabola of Nusselt (1916).

    u(y) = g sin(slope) / nu * (h y - y^2 / 2), no slip at the bed (y = 0), no shear at the surface (y = h).

    Args:
        depth: y, m, height above the bed measured across the film; 0 outside [0, thickness].
        thickness: h, m.
        slope: angle of the bed, rad.
        viscosity: kinematic, nu, m^2/s.
        gravity: magnitude, m/s^2.
    """
    require(viscosity > 0, f"viscosity {viscosity}", "positive m^2/s")
    y = np.asarray(depth, float)
    u = gravity * np.sin(slope) / viscosity * (thickness * y - 0.5 * y * y)
    return np.where((y >= 0) & (y <= thickness), u, 0.0)


def tilted_channel(
    *, thickness: float, slope: float, viscosity: float, gravity: float = GRAVITY, height: float = 0.0
) -> VectorField:
    """`film_speed` down a plane that falls along +x by `slope` (rad) and passes z = `height` (m) at x = 0."""
    along = np.array([np.cos(slope), 0.0, -np.sin(slope)])
    normal = np.array([np.sin(slope), 0.0, np.cos(slope)])

    def field(x: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        depth = (x - np.array([0.0, 0.0, height])) @ normal
        speed = film_speed(depth, thickness=thickness, slope=slope, viscosity=viscosity, gravity=gravity)
        return speed[..., None] * along

    return field
