"""Velocity beside the bed (paper: V_base): a wall function instead of a layer that the grid cannot resolve."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from fluidlift.errors import require
from fluidlift.types import GRAVITY, FluidKind, kind_of

WALLS = ("cubic", "log", "film")
"""wall functions, see `speed_share`"""

SECTIONS = 2
"""pieces along a stream that are asked whether it is a viscous film: more, and the steps of a grid are pieces"""
FEWEST = 12
"""points of a piece: a plane through fewer follows their errors"""
SURFACE_COEFFICIENT = 0.85
"""mean speed over depth by speed at the surface of a stream on a natural bed, where its roughness is not known: what
gauging with floats uses (Rantz 1982, USGS Water-Supply Paper 2175: 0.85 to 0.86)"""

SLOPE_ERROR = 0.05
"""slope that a stream must exceed to count, at least: 3 degrees. One view tells no pitch better than that; where less
is known of the slope, that error counts"""
VISCOUS_RATIO, TURBULENT_RATIO = 1.0, 2.5
"""Surface speed over the shear velocity sqrt(g h S), up to which a stream is surely a viscous film, and from which on
it is taken to be turbulent. Water is faster than the first for its slope and depth even among boulders twice as tall
as it is deep: 1.2 there, 2.3 where they are as tall (Ferguson 2007, Water Resources Research 43, W05427). At the
second, 1 / 0.4, the log law ends: its mean over the depth is 0. In a film the ratio is sqrt(Re / 2)."""


def wall_profile(distance: Float[np.ndarray, "*#n"] | float, thickness: Float[np.ndarray, "*#n"] | float) -> np.ndarray:
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


def log_profile(
    distance: Float[np.ndarray, "*#n"] | float, depth: Float[np.ndarray, "*#n"] | float, roughness: float | None = None
) -> np.ndarray:
    """Share of the surface speed in a turbulent stream: ln(y / y0) / ln(h / y0), and 0 below y0 (Prandtl, Karman).

    The mean of this over the depth is 1 - 1 / ln(h / y0) for small y0 / h. Without a roughness, y0 is the one for which
    that is `SURFACE_COEFFICIENT`: ln(h / y0) = 6.7, a bed with grains of about 4 % of the depth (y0 = k_s / 30).

    Args:
        distance: y, m, not negative.
        depth: h, m, positive.
        roughness: y0, m, the height at which the speed is nothing; a thirtieth of the sand grains' size.
    """
    h = np.asarray(depth, np.float64)
    require(bool((h > 0).all()), "fluid without depth", "positive metres")
    if roughness is None:
        decades = np.full(h.shape, 1.0 / (1.0 - SURFACE_COEFFICIENT))
    else:
        require(bool(0 < roughness < h.min()), f"a roughness of {roughness} m", f"between 0 and the depth, {h.min()} m")
        decades = np.log(h / roughness)
    return np.clip(1.0 + np.log(np.maximum(np.asarray(distance) / h, 1e-12)) / decades, 0.0, 1.0)


def film_profile(distance: Float[np.ndarray, "*#n"] | float, depth: Float[np.ndarray, "*#n"] | float) -> np.ndarray:
    """Share of the surface speed in a laminar film: 2 y/h - (y/h)^2 (Nusselt 1916), half of plane Poiseuille flow.

    `wall_profile` with a thickness of the whole depth differs from it by eta (1 - eta)^2 / 2 at most, 0.074 at a third
    of the depth; the mean over depth is 2/3 here and 5/8 there.

    Args:
        distance: y, m, not negative.
        depth: h, m, positive.
    """
    require(bool((np.asarray(depth) > 0).all()), "fluid without depth", "positive metres")
    share = np.clip(np.asarray(distance) / depth, 0.0, 1.0)
    return share * (2.0 - share)


def speed_share(
    distance: Float[np.ndarray, "*#n"] | float,
    *,
    kind: str | FluidKind,
    spacing: float,
    depth: Float[np.ndarray, "*#n"] | float | None = None,
    wall: str = "cubic",
) -> np.ndarray:
    """Share of the surface speed at a distance from the bed, by wall function.

    "cubic" is the paper's: a layer as thick as fluid type and grid say (`layer_thickness`). "log" is a turbulent
    stream through its whole depth, "film" a viscous one. On two simulations with their true surface velocity, "film"
    takes the error of a honey film's volume from 0.36 (a cubic layer of two cells) to 0.23; "log" leaves a stream that
    was simulated without friction at the bed at 0.57 (cubic 0.55, no layer at all 0.53), as it must.

    Args:
        distance: y, m, not negative.
        kind: fluid type.
        spacing: cell width, m.
        depth: of the fluid above the bed, there or typical, m; needed by "log" and "film".
        wall: one of `WALLS`.

    Raises:
        ValueError: an unknown wall function, or a depth that is missing or not positive.
        InputRejected: an unknown kind.
    """
    require(wall in WALLS, f"wall function '{wall}'", "one of " + ", ".join(WALLS))
    if wall == "cubic":
        thickness = np.asarray(layer_thickness(kind, spacing))
        if depth is not None:
            thickness = np.minimum(thickness, np.maximum(depth, 0.25 * spacing))  # not thicker than the fluid
        return wall_profile(distance, thickness)
    require(depth is not None, f"wall function '{wall}' without a depth", "metres of fluid above the bed")
    profile = log_profile if wall == "log" else film_profile
    return profile(distance, np.asarray(depth, np.float64))


def film_share(
    points: Float[np.ndarray, "n 3"],
    velocities: Float[np.ndarray, "n 3"],
    depth: float,
    *,
    slope_error: float = SLOPE_ERROR,
) -> float:
    """How surely a stream is a viscous film, 0 to 1: whether it is too slow for its slope to be turbulent.

    The energy line z + v^2 / 2g over the surface falls along the stream by what friction takes; its slope S, the depth
    h and gravity give the shear velocity sqrt(g h S) of a steady stream, and the surface speed over that is compared
    with `VISCOUS_RATIO` and `TURBULENT_RATIO`. It goes with the root of the scale: a size that was assumed ten times
    too small makes it a third.

    Nearly all hangs on S, whose error is the picture's and not the fluid's: a level river that is guessed to fall by 5
    degrees is several times too slow for that. So what counts is what is left of the slope after one standard error: a
    film must fall surely.

    A fluid is the same all along: where one of `SECTIONS` pieces is hardly a film, the whole is none, if another is
    surely steep. Taken at once, a chute and the pool below it are as steep as both together and as slow as the pool.

    Args:
        points: of the surface, m, z up.
        velocities: m/s.
        depth: typical, m.
        slope_error: standard error of the surface's slope (rise over run); below `SLOPE_ERROR` that counts.
    """
    error = max(slope_error, SLOPE_ERROR)
    speed = np.linalg.norm(velocities, axis=-1).astype(np.float64)
    along = np.asarray(velocities, np.float64)[:, :2].sum(axis=0)
    along = along / max(float(np.linalg.norm(along)), 1e-12)
    s = np.asarray(points, np.float64)[:, :2] @ along
    order = np.argsort(s, kind="stable")
    whole, _ = _film_share_of(np.asarray(points), speed, along, depth, error)
    if whole == 0.0 or len(order) < SECTIONS * FEWEST:
        return whole
    pieces = np.array_split(order, SECTIONS)
    shares, falls = zip(*(_film_share_of(np.asarray(points)[p], speed[p], along, depth, error) for p in pieces))
    # a slope over a part of the length has that much more error: a jet on a puddle makes one piece seem steep. How the
    # whole plane leans is wrong for all pieces alike, and says nothing of their differences
    known = max(falls) > SECTIONS**1.5 * SLOPE_ERROR
    return whole * min(2.0 * min(shares), 1.0) if known else whole  # pieces scatter more than the whole


def _film_share_of(
    points: np.ndarray, speed: np.ndarray, along: np.ndarray, depth: float, slope_error: float
) -> tuple[float, float]:
    """`film_share` of a piece whose surface is a plane, and its slope."""
    head = points[:, 2] + speed**2 / (2.0 * GRAVITY)
    flat = np.asarray(points, np.float64)[:, :2]
    fall, *_ = np.linalg.lstsq(flat - flat.mean(axis=0), head - head.mean(), rcond=None)
    slope = -float(fall @ along)
    sure = slope - slope_error
    if sure <= 0:
        return 0.0, slope
    ratio = float(np.median(speed)) / np.sqrt(GRAVITY * depth * sure)
    return float(np.clip((TURBULENT_RATIO - ratio) / (TURBULENT_RATIO - VISCOUS_RATIO), 0.0, 1.0)), slope


def layer_thickness(kind: str | FluidKind, spacing: float) -> float:
    """Thickness d of the layer, m, by fluid type and grid (paper: "dynamically decided by the fluid type").

    It is set in cells and not from a Reynolds number: the wall function stands for the part of the slowing that the
    grid cannot show, and the fluid's own viscosity acts beyond it.

    Args:
        kind: of the fluid.
        spacing: cell width, m.

    Raises:
        InputRejected: an unknown kind.
    """
    return kind_of(kind).wall_layer * spacing


def bed_velocity(
    surface_velocity: Float[np.ndarray, "n 3"],
    mainstream: Float[np.ndarray, "*n 3"],
    normal: Float[np.ndarray, "n 3"] | None = None,
    *,
    kind: str | FluidKind,
    spacing: float,
    depth: Float[np.ndarray, " n"] | float | None = None,
    wall: str = "cubic",
) -> Float[np.ndarray, "n 3"]:
    """Velocity in the cells beside the bed, m/s.

    It has the direction of the mainstream, turned into the bed's tangent plane, and the speed of the surface above
    times the wall function at half a cell, where the cells' centres are. Where the mainstream runs straight into the
    bed the fluid there is at rest.

    Args:
        surface_velocity: of the nearest surface, m/s.
        mainstream: unit direction(s) of the bulk flow.
        normal: unit normals of the bed, where known.
        kind: fluid type, see `layer_thickness`.
        spacing: cell width, m.
        depth: thickness of the fluid, of each cell's column or typical, m.
        wall: wall function, see `speed_share`.
    """
    speed = np.linalg.norm(surface_velocity, axis=-1, keepdims=True)
    direction = np.broadcast_to(np.asarray(mainstream, np.float64), (len(speed), 3))
    if normal is not None:
        direction = direction - (direction * normal).sum(axis=-1, keepdims=True) * normal
        length = np.linalg.norm(direction, axis=-1, keepdims=True)
        direction = np.where(length > 0.1, direction / np.maximum(length, 0.1), 0.0)
    share = speed_share(np.asarray(0.5 * spacing), kind=kind, spacing=spacing, depth=depth, wall=wall)
    return speed * direction * share[..., None]
