"""Plain twins of the kernels in `physics.boundaries`: whole arrays, double precision, as the model reads."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from fluidlift.numerics.sampling import gradient_nodes, sample_nodes
from fluidlift.physics.boundaries import CLEARANCE, CONTACT, Walls
from fluidlift.types import CellType, FaceVelocity


def _shifted(values: np.ndarray, axis: int, step: int) -> np.ndarray:
    """The neighbour's value `step` (+-1) along `axis`; 0 beyond the ends."""
    out = np.zeros_like(values)
    along, source = np.moveaxis(out, axis, 0), np.moveaxis(values, axis, 0)
    if step > 0:
        along[:-1] = source[1:]
    else:
        along[1:] = source[:-1]
    return out


def extrapolate_plain(
    velocity: FaceVelocity, valid: tuple[np.ndarray, np.ndarray, np.ndarray], layers: int = 3
) -> FaceVelocity:
    """`boundaries.extrapolate`: a face without a value takes the mean of its neighbours that have one."""
    out = []
    for component, known in zip(velocity.components, valid):
        field, mask = np.where(known, component, 0.0).astype(np.float64), known.astype(np.float64)
        for _ in range(layers):
            steps = [(axis, step) for axis in range(3) for step in (-1, 1)]
            total = sum(_shifted(field * mask, *s) for s in steps)
            count = sum(_shifted(mask, *s) for s in steps)
            new = (mask == 0) & (count > 0)
            field = np.where(new, total / np.maximum(count, 1.0), field)
            mask = np.where(new, 1.0, mask)
        out.append(field)
    return FaceVelocity(*out)


def _at_faces(component: np.ndarray, own_axis: int, axis: int) -> np.ndarray:
    """A component that lives across `own_axis`, averaged over the four of its faces around each face across `axis`."""
    pad = [(0, 0)] * 3
    pad[axis] = (1, 1)
    wide = np.moveaxis(np.pad(component.astype(np.float64), pad, mode="edge"), axis, 0)
    between = np.moveaxis(0.5 * (wide[1:] + wide[:-1]), 0, axis)
    along = np.moveaxis(between, own_axis, 0)
    return np.moveaxis(0.5 * (along[1:] + along[:-1]), 0, own_axis)


def slide_along_walls_plain(velocity: FaceVelocity, walls: Walls) -> FaceVelocity:
    """`boundaries.slide_along_walls`: v - (v . n) n on closed faces."""
    out = []
    for axis, component in enumerate(velocity.components):
        normal = walls.normals[axis].astype(np.float64)
        speed = sum(
            normal[..., b] * (component if b == axis else _at_faces(velocity.components[b], b, axis)) for b in range(3)
        )
        closed = walls.openings[axis] == 0
        out.append(np.where(closed, component - normal[..., axis] * speed, component))
    return FaceVelocity(*out)


def collide_plain(
    positions: Float[np.ndarray, "n 3"],
    previous: Float[np.ndarray, "n 3"],
    velocities: Float[np.ndarray, "n 3"],
    incoming: Float[np.ndarray, "n 3"],
    walls: Walls,
    *,
    dt: float,
    restitution: float,
    tangential_share: float,
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """`boundaries.collide`: the new positions and velocities (the arguments stay)."""
    x, old, v, before = (np.asarray(a, np.float64) for a in (positions, previous, velocities, incoming))
    x, v = _kept_in_the_box(x, old, v, before, walls, dt, restitution)
    grid, field = walls.grid, walls.signed_distance.astype(np.float64)
    clearance = CLEARANCE * grid.spacing
    distance, gradient = sample_nodes(field, grid, x), gradient_nodes(field, grid, x)
    length = np.linalg.norm(gradient, axis=1)
    normal = gradient / np.maximum(length, 1e-3)[:, None]
    outward, incoming_outward = (v * normal).sum(axis=1), (before * normal).sum(axis=1)
    # pressed into the wall without a flight into it: stopped
    back = np.where(distance < clearance, np.maximum(outward, 0.0), outward)
    flight = sample_nodes(field, grid, old + dt * before)
    impact = (incoming_outward < 0) & (flight < CONTACT * grid.spacing) & (restitution > 0)
    back = np.where(impact, np.maximum(back, -restitution * incoming_outward), back)
    share = np.clip(1.0 - distance / grid.spacing, 0.0, 1.0)
    kept = 1.0 - (1.0 - tangential_share) * share
    at_wall = (distance < grid.spacing) & (length > 1e-3)
    changed = kept[:, None] * (v - outward[:, None] * normal) + back[:, None] * normal
    gone = ~grid.contains(x)  # no terrain is known out of the box
    v = np.where((at_wall & ~gone)[:, None], changed, v)
    return np.where(gone[:, None], x.astype(np.float32), _pushed_out(x, old, walls, clearance)), v


def _kept_in_the_box(
    x: np.ndarray, old: np.ndarray, v: np.ndarray, before: np.ndarray, walls: Walls, dt: float, restitution: float
) -> tuple[np.ndarray, np.ndarray]:
    """Closed sides of the box, except for particles that come from INFLOW and OUTFLOW cells."""
    grid, clearance = walls.grid, CLEARANCE * walls.grid.spacing
    cell = np.clip(grid.cell_of(old), 0, np.asarray(grid.shape) - 1)
    held = walls.regions[tuple(cell.T)] < CellType.INFLOW
    x, v, flight = x.copy(), v.copy(), old + dt * before
    for axis in range(3):
        for side, (wall, inward) in enumerate(((grid.low[axis] + clearance, 1), (grid.high[axis] - clearance, -1))):
            if walls.open_sides[axis, side]:
                continue
            hits = held & (inward * (flight[:, axis] - wall) < 0) & (inward * before[:, axis] < 0)
            bounced = inward * np.maximum(inward * v[:, axis], -restitution * inward * before[:, axis])
            v[:, axis] = np.where(hits, bounced, v[:, axis])
            x[:, axis] = np.where(held, inward * np.maximum(inward * x[:, axis], inward * wall), x[:, axis])
    return x, v


def _pushed_out(x: np.ndarray, old: np.ndarray, walls: Walls, clearance: float) -> np.ndarray:
    """Along the gradient until clear of the solid; particles that stay inside go back to where they were."""
    grid, field = walls.grid, walls.signed_distance.astype(np.float64)
    moved = np.zeros(len(x), bool)
    for _ in range(6):
        distance, gradient = sample_nodes(field, grid, x), gradient_nodes(field, grid, x)
        squared = (gradient**2).sum(axis=1)
        moved |= distance < clearance
        inside = (distance < clearance) & (squared >= 1e-6)
        step = 1.01 * (clearance - distance) / np.maximum(squared, 1e-6)
        target = np.clip(x + step[:, None] * gradient, grid.low + clearance, grid.high - clearance)
        x = np.where(inside[:, None], target, x)
    stored = x.astype(np.float32)
    buried = moved & (sample_nodes(field, grid, stored) <= 0)
    return np.where(buried[:, None], old, stored)
