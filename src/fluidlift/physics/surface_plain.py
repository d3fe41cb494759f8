"""`physics.free_surface.liquid_surface` and `solid_shares` in NumPy and double precision, as the formulas read: the
readable twins of `physics.surface_kernels`. Lengths are in cells."""

from __future__ import annotations

from itertools import product

import numpy as np
from jaxtyping import Float
from scipy import ndimage
from scipy.special import erfc, erfinv

from fluidlift.numerics.bspline import quadratic
from fluidlift.numerics.sampling import gradient_nodes, sample_nodes
from fluidlift.physics import boundaries
from fluidlift.physics.free_surface import (
    BAND,
    LAYERS,
    MORE_SMOOTHINGS,
    ROUNDS,
    SMOOTHINGS,
    SURE_OPENING,
    LiquidSurface,
    SolidShares,
)
from fluidlift.physics.liquid_fractions import cut_share
from fluidlift.physics.surface_kernels import (
    DEPTH,
    LARGEST_CURVATURE,
    LEAST_FILL,
    RELAXATION,
    SOLID_DEPTH,
    VARIANCE,
)
from fluidlift.types import FaceVelocity, Grid

AROUND = [np.array(step) for step in product((-1, 0, 1), repeat=3)]


def liquid_surface_plain(
    positions: Float[np.ndarray, "n 3"],
    volumes: Float[np.ndarray, " n"],
    grid: Grid,
    solids: SolidShares,
    *,
    curved: bool = False,
) -> LiquidSurface:
    """See `free_surface.liquid_surface`."""
    fill = fill_plain(shares_plain(positions, volumes, grid), solids)
    h = grid.spacing
    bend = curvature_plain(smoothed_plain(fill, SMOOTHINGS), fill)
    distance = np.clip(flat_distance_plain(fill) - 0.5 * VARIANCE * bend * solids.clear, -BAND, BAND)
    if not curved:
        return LiquidSurface(h * distance, None)
    flatter = curvature_plain(smoothed_plain(fill, SMOOTHINGS + MORE_SMOOTHINGS), fill)
    gain = (VARIANCE + 0.5 * SMOOTHINGS) / (0.5 * MORE_SMOOTHINGS)
    sharp = np.clip(bend + gain * (bend - flatter), -LARGEST_CURVATURE, LARGEST_CURVATURE)
    return LiquidSurface(h * distance, sharp / h)


def open_volumes_plain(signed_distance: Float[np.ndarray, "nx+1 ny+1 nz+1"], grid: Grid) -> np.ndarray:
    """Open share of each cell, from its octants."""
    centers, h = grid.centers().reshape(-1, 3), grid.spacing
    out = np.zeros(len(centers))
    for octant in product((-0.25, 0.25), repeat=3):
        points = centers + np.array(octant) * h
        value, slopes = sample_nodes(signed_distance, grid, points), gradient_nodes(signed_distance, grid, points)
        out += [0.125 * (1.0 - cut_share(v, *(0.5 * h * g))) for v, g in zip(value.astype(float), slopes)]
    return out.reshape(grid.shape)


def three_point_plain(field: np.ndarray, side: float) -> np.ndarray:
    """Weights side, 1 - 2 side, side along each axis; mirrored at the border."""
    for axis in range(3):
        field = ndimage.convolve1d(field, [side, 1.0 - 2.0 * side, side], axis=axis, mode="nearest")
    return field


def smoothed_plain(field: np.ndarray, count: int) -> np.ndarray:
    """Binomial filters."""
    for _ in range(count):
        field = three_point_plain(field, 0.25)
    return field


def shares_plain(positions: np.ndarray, volumes: np.ndarray, grid: Grid) -> np.ndarray:
    """Volume of particles around each cell centre over the cell's volume, mirrored at the sides of the box."""
    out = np.zeros(grid.shape)
    base, weights = quadratic((np.asarray(positions, np.float64) - grid.low) / grid.spacing - 0.5)
    for step in np.ndindex(3, 3, 3):
        index = np.clip(base + np.asarray(step), 0, np.asarray(grid.shape) - 1)
        weight = weights[:, 0, step[0]] * weights[:, 1, step[1]] * weights[:, 2, step[2]]
        np.add.at(out, tuple(index.T), weight * volumes / grid.spacing**3)
    return out


def flat_distance_plain(fill: np.ndarray) -> np.ndarray:
    """Distance of the surface, were it flat."""
    known = np.clip(fill, LEAST_FILL, 1.0 - LEAST_FILL)
    return np.clip(-np.sqrt(2.0 * VARIANCE) * erfinv(2.0 * known - 1.0), -DEPTH, DEPTH)


def slopes_plain(field: np.ndarray) -> Float[np.ndarray, "nx ny nz 3"]:
    """Central differences, mirrored at the border."""
    wide = np.pad(field, 1, mode="edge")
    inner = (slice(1, -1),) * 3
    return np.stack([(0.5 * (np.roll(wide, -1, a) - np.roll(wide, 1, a)))[inner] for a in range(3)], axis=-1)


def _length(vectors: np.ndarray) -> np.ndarray:
    return np.sqrt(np.square(vectors).sum(axis=-1, keepdims=True))


def curvature_plain(smooth: np.ndarray, fill: np.ndarray) -> np.ndarray:
    """div(n), n = -grad f / |grad f|: (n . H n - tr H) / |grad f| with the matrix H of second derivatives."""
    wide = np.pad(smooth, 1, mode="edge")
    inner = (slice(1, -1),) * 3
    slope = slopes_plain(smooth)
    second = np.empty((*smooth.shape, 3, 3))
    for a, b in product(range(3), repeat=2):
        if a == b:
            second[..., a, a] = (np.roll(wide, -1, a) - 2.0 * wide + np.roll(wide, 1, a))[inner]
        else:
            along = np.roll(wide, -1, a) - np.roll(wide, 1, a)
            second[..., a, b] = 0.25 * (np.roll(along, -1, b) - np.roll(along, 1, b))[inner]
    length = _length(slope)[..., 0]
    steep = length > 1e-3
    normal = slope / np.where(steep, length, 1.0)[..., None]
    bend = np.einsum("...a,...ab,...b->...", normal, second, normal) - np.einsum("...aa->...", second)
    near = steep & (fill > LEAST_FILL) & (fill < 1.0 - LEAST_FILL)
    return np.clip(np.where(near, bend / np.where(steep, length, 1.0), 0.0), -LARGEST_CURVATURE, LARGEST_CURVATURE)


def fill_plain(share: np.ndarray, solids: SolidShares) -> np.ndarray:
    """Share of liquid around each cell centre, with virtual liquid in solids."""
    fill = smoothed_plain(share, 1)
    open_share, layer = solids.open_share.astype(float), solids.layer
    around = smoothed_plain(open_share, 1)
    virtual = np.where((layer > 0) & (around > 0.05), np.minimum(fill / np.maximum(around, 0.05), 1.0), 0.0)
    toward_open = slopes_plain(open_share)
    toward_open /= np.maximum(_length(toward_open), 1e-3)
    distance, normal = np.zeros_like(share), np.zeros((*share.shape, 3))
    for _ in range(ROUNDS):
        fill = smoothed_plain(share + (1.0 - open_share) * virtual, 1)
        slope = slopes_plain(fill)
        direct, outward = flat_distance_plain(fill), -slope / np.maximum(_length(slope), 1e-3)
        distance, normal = np.where(layer <= 1, direct, distance), np.where(layer[..., None] <= 1, outward, normal)
        for want in range(2, LAYERS + 1):
            for cell in np.argwhere(layer == want):
                _extrapolate(tuple(cell), want, layer, open_share, distance, normal)
        middle = distance - SOLID_DEPTH * open_share * np.einsum("...a,...a->...", normal, toward_open)
        step = RELAXATION * (0.5 * erfc(middle / np.sqrt(0.5)) - virtual)
        virtual = np.where((layer > 0) & (layer <= LAYERS), np.clip(virtual + step, 0.0, 1.0), virtual)
    return smoothed_plain(share + (1.0 - open_share) * virtual, 1)


def _extrapolate(cell: tuple, want: int, layer: np.ndarray, open_share: np.ndarray, distance, normal) -> None:
    """Weighted mean of what the neighbours in the layers before say, by their distance and normal; in place."""
    total, mean, weights = 0.0, np.zeros(3), 0.0
    for step in AROUND:
        other = tuple(np.asarray(cell) + step)
        if any(o < 0 or o >= n for o, n in zip(other, layer.shape)) or layer[other] >= want:
            continue
        weight = (open_share[other] ** 2 if want == 2 else 1.0) / (1.0 + (step**2).sum())
        total += weight * (distance[other] - normal[other] @ step)
        mean += weight * normal[other]
        weights += weight
    if weights > 0:
        distance[cell], normal[cell] = total / weights, mean / weights


def continue_velocity_plain(
    velocity: FaceVelocity, carried: FaceVelocity, masses, wet, skin: np.ndarray, openings
) -> FaceVelocity:
    """See `free_surface.continue_velocity`: what the liquid's velocity gained is extrapolated, and then the sum."""
    sure = tuple(w & (o >= SURE_OPENING) for w, o in zip(wet, openings))
    gained = FaceVelocity(*(new - old for new, old in zip(velocity.components, carried.components)))
    gained = boundaries.extrapolate(gained, sure, layers=1)
    faces, sources, known = [], [], []
    for axis, beside in enumerate(boundaries.touching_faces(skin)):
        own = beside & ~wet[axis] & (openings[axis] > 0) & (masses[axis] > 0)
        faces.append(np.where(own, carried.components[axis] + gained.components[axis], velocity.components[axis]))
        known.append(wet[axis] | own)
        sources.append(known[axis] & (openings[axis] >= SURE_OPENING))
    continued = boundaries.extrapolate(FaceVelocity(*faces), tuple(sources))
    return FaceVelocity(*(np.where(k, f, c) for k, f, c in zip(known, faces, continued.components)))
