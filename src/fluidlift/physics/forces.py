"""Body forces on face velocities (paper: `eq::v`, last term)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from fluidlift.types import FaceVelocity


def add_gravity(velocity: FaceVelocity, gravity: tuple[float, float, float], dt: float) -> FaceVelocity:
    """v + g dt on every face. gravity: m/s^2; dt: s."""
    return FaceVelocity(*(c + np.asarray(g * dt, c.dtype) for c, g in zip(velocity.components, gravity)))


def add_buoyancy(
    velocity: FaceVelocity,
    concentration: Float[np.ndarray, "nx ny nz"],
    *,
    strength: float,
    gravity: tuple[float, float, float],
    dt: float,
) -> FaceVelocity:
    """v + strength * concentration * dt against gravity (Boussinesq; straight up where there is no gravity).

    Args:
        velocity: m/s.
        concentration: 0 (clear air) to 1 (smoke as it enters) per cell.
        strength: m/s^2 at concentration 1.
        gravity: m/s^2, only its direction counts.
        dt: s.
    """
    down = np.asarray(gravity, np.float64)
    size = float(np.linalg.norm(down))
    up = -down / size if size > 0 else np.array([0.0, 0.0, 1.0])
    out = []
    for axis, component in enumerate(velocity.components):
        if up[axis] == 0.0:
            out.append(component.copy())
            continue
        pad = [(0, 0)] * 3
        pad[axis] = (1, 1)
        wide = np.moveaxis(np.pad(concentration, pad, mode="edge"), axis, 0)
        on_faces = np.moveaxis(0.5 * (wide[1:] + wide[:-1]), 0, axis)
        out.append((component + strength * dt * up[axis] * on_faces).astype(component.dtype))
    return FaceVelocity(*out)
