"""Normals of a fluid's surface at its splats, from the density of the splats themselves.

The shortest axis of a splat, which GaussianShader (arXiv:2311.17977) takes, means nothing for the nearly round splats
of a fluid. Here the density is gathered on a coarse grid with quadratic B-splines, held at that of a full body, and its
downward slope at each splat is the outward normal: it changes smoothly while splats move, come and go.
`gather_kernel`, `add_solid_kernel`, `normals_kernel` and `depths_kernel` have twins for reading, whose names end in
`_plain`.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np
from jaxtyping import Float
from scipy import ndimage

from fluidlift.errors import require
from fluidlift.look.smoothstep import eased, smoothstep
from fluidlift.look.surface_skin import without_skin
from fluidlift.numerics.isosurface import surface_nets
from fluidlift.numerics.sampling import sample_nodes
from fluidlift.numerics.sharing import shared
from fluidlift.types.gaussians import Gaussians
from fluidlift.types.terrain import Terrain, TriangleMesh

NODES_APART = 2.0
"""distance of the grid's nodes, in spacings of the splats"""
BLUR = 1.22
"""standard deviation of the blur of the density, in distances of the nodes: variances of 1/4 for each of the two
splines and 1/2 for each of two passes of `_blurred`. Less shows the rows of splats as ripples"""
NODES_MAX = 30_000_000
"""of the grid; a body that is larger gets a coarser one"""
FULL = 0.8
"""share of a full body's density from which more does not count: rows of an inlet are finer, and no surface"""
AT_SURFACE = (0.08, 0.35)
"""slope, as a share of that of a flat surface at its middle, from which a splat begins to belong to the surface, and
from which it does in full"""
SHADOWED = 0.35
"""share of a full body's density where the surface for shadows lies: a layer of one splat has half of it"""
OUTSIDE = 0.85
"""spacings that the surface for shadows stands outside of a thick body"""
SPACINGS = 2.0
"""of the splats in a cell of the simulation"""
STEPS = 48
"""nodes' distances that the depth of a body is followed to each side of a splat"""
EMPTY = 0.2
"""share of a full body's density under which the body has ended"""
_CHUNK = 2048


def fluid_normals(
    gaussians: Gaussians, spacing: float, terrain: Terrain | None = None
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Outward normals of the fluid's surface and how much each splat belongs to it.

    Args:
        gaussians: world, m.
        spacing: usual distance between neighbouring splats of the inside, m.
        terrain: counts as fluid, so that no surface is seen between the fluid and its bed. None: there is none, or
            it is a vessel through which one sees the fluid.

    Returns:
        Unit normals, float32; where there is no slope at all, (0, 0, 1). And the share, 0 (inside, or alone) to 1 (at
        the surface), float32.

    Raises:
        ValueError: a spacing that is not positive.
    """
    points = gaussians.means
    normals, share = np.empty((len(points), 3), np.float32), np.empty(len(points), np.float32)
    low, h, density = _body(gaussians, spacing)
    if terrain is not None:
        add_solid_kernel(terrain.signed_distance, terrain.grid.low, terrain.grid.spacing, low, h, density)
    density = _blurred(_blurred(density))
    normals_kernel(points, low, h, density, normals, share)
    return normals, share


def fluid_depths(gaussians: Gaussians, normals: Float[np.ndarray, "n 3"], spacing: float) -> Float[np.ndarray, " n"]:
    """Metres of fluid on the line through each splat along its normal, float32: how deep the body is there.

    The bed is no fluid here. Splats with a number that is not finite have 0.

    Args:
        gaussians, spacing: as of `fluid_normals`.
        normals: unit.
    """
    low, h, density = _body(gaussians, spacing)
    out = np.zeros(len(gaussians), np.float32)
    depths_kernel(gaussians.means, np.ascontiguousarray(normals, np.float32), low, h, density, out)
    return out


def fluid_surface(gaussians: Gaussians, spacing: float) -> TriangleMesh:
    """A closed, coarse surface of the fluid, for shadows: films of one layer of splats are in it, single drops are not.

    Its edges are a few spacings long, and it stands `OUTSIDE` spacings off a thick body.
    """
    low, h, density = _body(gaussians, spacing)
    vertices, faces = surface_nets(SHADOWED - density, spacing=h, origin=(float(low[0]), float(low[1]), float(low[2])))
    return TriangleMesh(vertices.astype(np.float32), faces)


def _body(gaussians: Gaussians, spacing: float) -> tuple[np.ndarray, float, np.ndarray]:
    """Low corner, distance and densities (1: full) of the nodes around the splats; a skin is not counted."""
    require(np.isfinite(spacing) and spacing > 0, f"spacing {spacing}", "positive metres")
    points = without_skin(gaussians, SPACINGS * spacing).means
    sound = points if np.isfinite(points).all() else points[np.isfinite(points).all(axis=1)]
    low, h, shape = _nodes(sound, spacing) if len(sound) else (np.zeros(3), spacing, (4, 4, 4))
    density = np.zeros(shape, np.float32)
    gather_kernel(sound, low, h, density)
    return low, h, _held(density * np.float32((spacing / h) ** 3 / FULL))


def _held(density: np.ndarray) -> np.ndarray:
    """Smoothly held at 1: tanh of a power keeps what is below nearly as it is."""
    return density / np.sqrt(np.sqrt(1.0 + density**4))


def _blurred(density: np.ndarray) -> np.ndarray:
    """The mean with weights 1, 2, 1 along each axis; what lies outside is empty."""
    for axis in range(3):
        around = np.zeros_like(density)
        a, b = np.moveaxis(around, axis, 0), np.moveaxis(density, axis, 0)
        a += np.float32(0.5) * b
        a[1:] += np.float32(0.25) * b[:-1]
        a[:-1] += np.float32(0.25) * b[1:]
        density = around
    return density


def _nodes(points: np.ndarray, spacing: float) -> tuple[np.ndarray, float, tuple[int, int, int]]:
    """Low corner (m), distance (m) and number of nodes around the points.

    Nodes lie at whole multiples of their distance in the world, so that they stay where they are while the fluid moves.
    A few splats far from the others (spray) are left outside rather than made to pay for.
    """
    h = NODES_APART * spacing
    low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
    for attempt in range(200):
        first = np.floor(low / h) - 3  # room for the blur
        shape = np.ceil(high / h) + 4 - first
        if np.prod(shape) <= NODES_MAX:
            break
        if attempt == 0 and len(points) > 100:
            low, high = np.percentile(points, (0.5, 99.5), axis=0) + np.array([[-4 * h], [4 * h]])
        else:
            h *= 1.26
    return np.asarray(first * h), h, (int(shape[0]), int(shape[1]), int(shape[2]))


@nb.njit(cache=True, inline="always")
def _base_and_weights(x, weights):
    """First of the three nodes around coordinate x (in nodes), and the quadratic B-spline's weights."""
    base = math.floor(x - 0.5)
    f = x - base
    weights[0] = 0.5 * (1.5 - f) ** 2
    weights[1] = 0.75 - (f - 1.0) ** 2
    weights[2] = 0.5 * (f - 0.5) ** 2
    return np.int64(base)


@shared(lambda distance, first, spacing, low, h, density: (0, density.shape[0]), error_model="numpy")
def add_solid_kernel(begin, end, distance, first, spacing, low, h, density):
    """Adds the share of solid around each node; beyond the terrain's box that goes on for a few nodes."""
    limits = np.array(distance.shape) - 1
    for i in range(begin, end):
        local, base = np.empty(3), np.empty(3, np.int64)
        for j in range(density.shape[1]):
            for k in range(density.shape[2]):
                far = False
                for axis in range(3):
                    x = (low[axis] + h * (i, j, k)[axis] - first[axis]) / spacing
                    inside = min(max(x, 0.0), float(limits[axis]))
                    far = far or abs(x - inside) * spacing > 3 * h
                    base[axis] = min(np.int64(inside), limits[axis] - 1)
                    local[axis] = inside - base[axis]
                if far:
                    continue
                d = 0.0
                for u in range(2):
                    for v in range(2):
                        for t in range(2):
                            w = (local[0] if u else 1 - local[0]) * (local[1] if v else 1 - local[1])
                            w *= local[2] if t else 1 - local[2]
                            d += w * distance[base[0] + u, base[1] + v, base[2] + t]
                solid = np.float32(min(max(0.5 - d / h, 0.0), 1.0))
                density[i, j, k] = min(density[i, j, k] + solid, np.float32(1))


@nb.njit(cache=True, nogil=True, error_model="numpy")
def gather_kernel(points, low, h, density):
    a, b, c = np.empty(3), np.empty(3), np.empty(3)
    nx, ny, nz = density.shape
    for p in range(points.shape[0]):
        i = _base_and_weights((points[p, 0] - low[0]) / h, a)
        j = _base_and_weights((points[p, 1] - low[1]) / h, b)
        k = _base_and_weights((points[p, 2] - low[2]) / h, c)
        if i < 0 or j < 0 or k < 0 or i + 2 >= nx or j + 2 >= ny or k + 2 >= nz:
            continue
        for u in range(3):
            for v in range(3):
                w = a[u] * b[v]
                for t in range(3):
                    density[i + u, j + v, k + t] += np.float32(w * c[t])


@shared(lambda points, *_: (0, -(-points.shape[0] // _CHUNK)), error_model="numpy")
def normals_kernel(begin, end, points, low, h, density, normals, share):
    n = points.shape[0]
    nx, ny, nz = density.shape
    flat = BLUR * h * math.sqrt(2 * math.pi)
    for chunk in range(begin, end):
        w, d = np.empty((3, 3)), np.empty((3, 3))
        at = np.empty(3, np.int64)
        for p in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, n)):
            normals[p, 0], normals[p, 1], normals[p, 2], share[p] = 0.0, 0.0, 1.0, 0.0
            if not math.isfinite(points[p, 0] + points[p, 1] + points[p, 2]):
                continue
            for axis in range(3):
                x = (points[p, axis] - low[axis]) / h
                at[axis] = _base_and_weights(x, w[axis])
                f = x - at[axis]
                d[axis, 0], d[axis, 1], d[axis, 2] = (f - 1.5) / h, (2.0 - 2.0 * f) / h, (f - 0.5) / h
            i, j, k = at[0], at[1], at[2]
            if i < 0 or j < 0 or k < 0 or i + 2 >= nx or j + 2 >= ny or k + 2 >= nz:
                continue
            gx, gy, gz = 0.0, 0.0, 0.0
            for u in range(3):
                for v in range(3):
                    row, across, steep = 0.0, w[0, u] * d[1, v], d[0, u] * w[1, v]
                    rise = 0.0
                    for t in range(3):
                        row += w[2, t] * density[i + u, j + v, k + t]
                        rise += d[2, t] * density[i + u, j + v, k + t]
                    gx += steep * row
                    gy += across * row
                    gz += w[0, u] * w[1, v] * rise
            slope = math.sqrt(gx * gx + gy * gy + gz * gz)
            if slope * h > 1e-9:
                normals[p, 0], normals[p, 1], normals[p, 2] = -gx / slope, -gy / slope, -gz / slope
            share[p] = eased((slope * flat - AT_SURFACE[0]) / (AT_SURFACE[1] - AT_SURFACE[0]))


@nb.njit(cache=True, inline="always")
def _density_at(x, y, z, density):
    """Trilinear, at a place in nodes; 0 outside."""
    i, j, k = np.int64(math.floor(x)), np.int64(math.floor(y)), np.int64(math.floor(z))
    if i < 0 or j < 0 or k < 0 or i + 1 >= density.shape[0] or j + 1 >= density.shape[1] or k + 1 >= density.shape[2]:
        return 0.0
    a, b, c = x - i, y - j, z - k
    value = 0.0
    for corner in range(8):
        u, v, t = corner // 4, corner // 2 % 2, corner % 2
        weight = (a if u else 1 - a) * (b if v else 1 - b) * (c if t else 1 - c)
        value += weight * density[i + u, j + v, k + t]
    return value


@shared(lambda points, *_: (0, -(-points.shape[0] // _CHUNK)), error_model="numpy")
def depths_kernel(begin, end, points, normals, low, h, density, out):
    """Adds up the density along each normal, half a node at a time, to both sides until it ends."""
    n = points.shape[0]
    for chunk in range(begin, end):
        for p in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, n)):
            total = 0.0
            x, y, z = (points[p, 0] - low[0]) / h, (points[p, 1] - low[1]) / h, (points[p, 2] - low[2]) / h
            if not math.isfinite(x + y + z):
                continue
            for side in (-0.5, 0.5):
                for step in range(2 * STEPS):
                    s = side * (step + 0.5)
                    here = _density_at(x + s * normals[p, 0], y + s * normals[p, 1], z + s * normals[p, 2], density)
                    if here < EMPTY:
                        break
                    total += here
            out[p] = 0.5 * h * total


def depths_plain(
    points: np.ndarray, normals: np.ndarray, low: np.ndarray, h: float, density: np.ndarray
) -> Float[np.ndarray, " n"]:
    """The twin of `depths_kernel`, for finite points."""
    total = np.zeros(len(points))
    for side in (-0.5, 0.5):
        goes_on = np.ones(len(points), bool)
        for step in range(2 * STEPS):
            at = (points - low) / h + side * (step + 0.5) * normals
            here = ndimage.map_coordinates(density, at.T, order=1, mode="constant", prefilter=False)
            goes_on &= here >= EMPTY
            total += np.where(goes_on, here, 0.0)
    return (0.5 * h * total).astype(np.float32)


def _splines(points: np.ndarray, low: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """First nodes [n,3], weights and their derivatives [3 nodes,n,3] per axis."""
    x = (points - low) / h
    base = np.floor(x - 0.5)
    f = x - base
    weights = np.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2])
    return base.astype(int), weights, np.stack([f - 1.5, 2.0 - 2.0 * f, f - 0.5]) / h


def add_solid_plain(terrain: Terrain, low: np.ndarray, h: float, density: np.ndarray) -> None:
    """The twin of `add_solid_kernel`."""
    nodes = low + h * np.stack([*np.indices(density.shape)], axis=-1).reshape(-1, 3)
    grid = terrain.grid
    beyond = np.abs(nodes - np.clip(nodes, grid.low, grid.high)).max(axis=1) > 3 * h
    solid = np.clip(0.5 - sample_nodes(terrain.signed_distance, grid, nodes) / h, 0.0, 1.0)
    density += np.where(beyond, 0.0, solid).reshape(density.shape)
    np.minimum(density, 1.0, out=density)


def gather_plain(points: np.ndarray, low: np.ndarray, h: float, density: np.ndarray) -> None:
    """The twin of `gather_kernel`: adds to the nodes."""
    base, w, _ = _splines(points, low, h)
    for u, v, t in np.ndindex(3, 3, 3):
        node = tuple((base + (u, v, t)).T)
        np.add.at(density, node, (w[u, :, 0] * w[v, :, 1] * w[t, :, 2]).astype(np.float32))


def normals_plain(
    points: np.ndarray, low: np.ndarray, h: float, density: np.ndarray
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """The twin of `normals_kernel`, for points within the grid."""
    base, w, d = _splines(points, low, h)
    slope = np.zeros((len(points), 3))
    for u, v, t in np.ndindex(3, 3, 3):
        value = density[tuple((base + (u, v, t)).T)]
        slope[:, 0] += d[u, :, 0] * w[v, :, 1] * w[t, :, 2] * value
        slope[:, 1] += w[u, :, 0] * d[v, :, 1] * w[t, :, 2] * value
        slope[:, 2] += w[u, :, 0] * w[v, :, 1] * d[t, :, 2] * value
    steep = np.linalg.norm(slope, axis=1)
    # the slope of a step that is blurred by a Gaussian is 1 / (sigma sqrt(2 pi)) at its middle
    share = smoothstep(steep * BLUR * h * math.sqrt(2 * math.pi), *AT_SURFACE)
    normals = np.where(steep[:, None] * h > 1e-9, -slope / np.maximum(steep, 1e-300)[:, None], (0.0, 0.0, 1.0))
    return normals.astype(np.float32), share.astype(np.float32)
