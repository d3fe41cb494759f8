"""Velocity beside the bed (paper: V_base): a wall function instead of a layer that the grid cannot resolve."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from fluidlift.errors import require

LAYER_CELLS = {"stream": 1.0, "fall": 0.75, "pour": 2.0, "plume": 0.4}
"""Thickness of the layer in cells. Water is turbulent: beside the bed of a river some 10 cells deep its speed at half
a cell is about 0.7 of the surface speed (1/7 power law), which a layer of one cell gives; films from a fall are
shorter. What is poured is often viscous and drags through its depth. In smoke the layer stays below half a cell and so
damps nothing (paper: "sub-cell scale")."""


def wall_profile(distance: Float[np.ndarray, "*n"], thickness: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Share of the free speed at a distance from the wall: 3/2 (y/d) - 1/2 (y/d)^3, and 1 beyond the layer.

    This is the cubic of the integral (Karman-Pohlhausen) solution of laminar flow along a plate: no slip at the wall,
    the free speed without shear at y = d, no curvature at the wall.

    Args:
        distance: y, m, not negative.
        thickness: d, m, positive.
    """
    require(bool((np.asarray(thickness) > 0).all()), "a layer without thickness", "positive metres")
    share = np.clip(np.asarray(distance) / thickness, 0.0, 1.0)
    return 1.5 * share - 0.5 * share**3


def layer_thickness(kind: str, spacing: float, depth: float | None = None) -> float:
    """Thickness d of the layer, m, by fluid type and grid (paper: "dynamically decided by the fluid type").

    It is set in cells and not from a Reynolds number: the wall function stands for the part of the slowing that the
    grid cannot show, and the fluid's own viscosity acts beyond it. A layer cannot be thicker than the fluid.

    Args:
        kind: "stream", "fall", "pour" or "plume".
        spacing: cell width, m.
        depth: typical thickness of the fluid above the bed, m.
    """
    require(kind in LAYER_CELLS, f"kind '{kind}'", "one of " + ", ".join(LAYER_CELLS))
    thickness = LAYER_CELLS[kind] * spacing
    return thickness if depth is None else min(thickness, max(depth, 0.25 * spacing))


def laminar_layer_thickness(viscosity: float, length: float, speed: float) -> float:
    """Thickness of the laminar layer of the cubic profile, 4.64 sqrt(nu x / U), m, at x metres from its beginning."""
    require(
        speed > 0 and length >= 0 and viscosity >= 0, "a layer without flow", "speed > 0, length and viscosity >= 0"
    )
    return 4.64 * float(np.sqrt(viscosity * length / speed))


def bed_velocity(
    surface_velocity: Float[np.ndarray, "n 3"],
    mainstream: Float[np.ndarray, "*n 3"],
    normal: Float[np.ndarray, "n 3"] | None = None,
    *,
    kind: str,
    spacing: float,
    depth: float | None = None,
) -> Float[np.ndarray, "n 3"]:
    """Velocity in the cells beside the bed, m/s.

    It has the direction of the mainstream, turned into the bed's tangent plane, and the speed of the surface above
    times the wall profile at half a cell, where the cells' centres are. Where the mainstream runs straight into the
    bed the fluid there is at rest.

    Args:
        surface_velocity: of the nearest surface, m/s.
        mainstream: unit direction(s) of the bulk flow.
        normal: unit normals of the bed, where known.
        kind: fluid type, see `layer_thickness`.
        spacing: cell width, m.
        depth: typical thickness of the fluid, m.
    """
    speed = np.linalg.norm(surface_velocity, axis=-1, keepdims=True)
    direction = np.broadcast_to(np.asarray(mainstream, np.float64), (len(speed), 3))
    if normal is not None:
        direction = direction - (direction * normal).sum(axis=-1, keepdims=True) * normal
        length = np.linalg.norm(direction, axis=-1, keepdims=True)
        direction = np.where(length > 0.1, direction / np.maximum(length, 0.1), 0.0)
    return speed * direction * wall_profile(0.5 * spacing, layer_thickness(kind, spacing, depth))
