"""The fixed linear operators of a differentiable rollout, assembled once per cell layout.

Velocity is one flat vector here: all faces across x, then y, then z, each raveled in C order. Extrapolation, viscous
Laplacian, divergence and pressure gradient are sparse matrices over it, so that the adjoint of each is its transpose.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy import sparse

from fluidlift.errors import require
from fluidlift.numerics.poisson import PoissonSystem
from fluidlift.physics.pressure import PressureSystem
from fluidlift.physics.rollout_surface import sides, surface_distances
from fluidlift.types import CellType


@dataclass(frozen=True)
class LinearMap:
    """A sparse matrix beside its transpose (both CSR, so that both products are fast)."""

    matrix: sparse.csr_matrix
    transpose: sparse.csr_matrix

    @classmethod
    def of(cls, matrix: sparse.spmatrix, dtype: np.dtype) -> LinearMap:
        """The map in one number type."""
        m = sparse.csr_matrix(matrix, dtype=dtype)
        return cls(m, m.T.tocsr())


@dataclass(frozen=True)
class RolloutDomain:
    """Which face does what, for one cell layout."""

    shape: tuple[int, int, int]
    system: PoissonSystem
    """faces to air weigh more the nearer the surface is, see `surface_distances`"""
    dynamic: Bool[np.ndarray, "f"]
    """faces whose velocity the momentum equation and the pressure change"""
    inflow: Float[np.ndarray, "f"]
    """1 on faces with the prescribed inflow velocity"""
    outflow: Float[np.ndarray, "f"]
    """component of the mainstream along the face's axis on faces between fluid and OUTFLOW cells, else 0"""
    outflow_faces: Float[np.ndarray, "f"]
    """1 on those faces"""
    interior: Float[np.ndarray, "f"]
    """1 on faces that keep a free value before the projection (neither wall nor inflow)"""
    force: Float[np.ndarray, "f"]
    """share of gravity each face feels: 1 on dynamic faces (liquid), minus the share of smoke beside them (gas:
    buoyancy acts against gravity, whose size is then that of the buoyancy)"""
    wall_share: Float[np.ndarray, "f"]
    """0 to 1: how much solid runs along a dynamic face's cells"""
    wall_count: Float[np.ndarray, "f"]
    """0 to 4: closed faces beside a dynamic face, mean of its two cells"""
    wall_below: Float[np.ndarray, "f"]
    wall_above: Float[np.ndarray, "f"]
    """0 to 1: closed share of the next face towards lower / higher index, where a wall stands across the motion"""
    extrapolation: LinearMap
    """faces to faces: fills unknown faces from known ones"""
    laplacian: sparse.csr_matrix
    """1/m^2, between dynamic faces only, symmetric"""
    boundary_laplacian: LinearMap
    """1/m^2, from prescribed faces to dynamic ones"""
    divergence: LinearMap
    """faces to cells, 1/m, open shares included"""
    gradient: LinearMap
    """cells to dynamic faces, 1/m; system = - divergence gradient"""

    @property
    def face_shapes(self) -> tuple[tuple[int, int, int], ...]:
        """Shapes of u, v, w."""
        return tuple(tuple(n + (a == axis) for a, n in enumerate(self.shape)) for axis in range(3))

    @property
    def offsets(self) -> tuple[int, int, int, int]:
        """Where u, v, w begin in the flat vector, and its length."""
        sizes = [int(np.prod(s)) for s in self.face_shapes]
        return (0, sizes[0], sizes[0] + sizes[1], sum(sizes))

    def active(self) -> tuple[np.ndarray, ...]:
        """`dynamic` split by component."""
        o = self.offsets
        return tuple(np.ascontiguousarray(self.dynamic[o[a] : o[a + 1]]) for a in range(3))


def _shift(faces: np.ndarray, axis: int, by: int) -> np.ndarray:
    """The neighbour's value along `axis`, 0 beyond the array."""
    out = np.zeros_like(faces)
    source, target = [slice(None)] * 3, [slice(None)] * 3
    source[axis], target[axis] = (slice(1, None), slice(None, -1)) if by > 0 else (slice(None, -1), slice(1, None))
    out[tuple(target)] = faces[tuple(source)]
    return out


def _neighbour_pairs(shape: tuple[int, int, int], axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Flat indices of all entries that have a neighbour at +1 along `axis`, and of that neighbour."""
    index = np.arange(int(np.prod(shape))).reshape(shape)
    n = shape[axis]
    return np.take(index, range(n - 1), axis).ravel(), np.take(index, range(1, n), axis).ravel()


def extrapolation_matrix(known: Bool[np.ndarray, "a b c"], sweeps: int) -> sparse.csr_matrix:
    """Each sweep gives unknown entries the mean of their known neighbours, which then count as known.

    Entries that no sweep reaches become 0.
    """
    flat = known.ravel().copy()
    low, high = zip(*(_neighbour_pairs(known.shape, axis) for axis in range(3)))
    rows, cols = np.concatenate([*low, *high]), np.concatenate([*high, *low])
    total = sparse.diags(flat.astype(float)).tocsr()
    for _ in range(sweeps):
        use = ~flat[rows] & flat[cols]
        if not use.any():
            break
        count = np.bincount(rows[use], minlength=flat.size)
        mean = sparse.csr_matrix((1.0 / count[rows[use]], (rows[use], cols[use])), shape=total.shape)
        total = total + mean @ total
        flat |= count > 0
    return total


def _viscous_matrices(
    dynamic: np.ndarray, prescribed: np.ndarray, wall: np.ndarray, axis: int, h: float
) -> tuple[sparse.csr_matrix, sparse.csr_matrix]:
    """Laplacian of one component: among dynamic faces (with its diagonal), and from prescribed faces.

    A wall face ahead or behind holds the normal velocity 0; walls beside a face are left to `wall_count`; towards air
    the derivative is 0.
    """
    n = dynamic.size
    d, b, z = dynamic.ravel(), prescribed.ravel(), wall.ravel()
    inner, outer = [], []
    diagonal = np.zeros(n)
    for direction in range(3):
        low, high = _neighbour_pairs(dynamic.shape, direction)
        for row, col in ((low, high), (high, low)):
            use = d[row] & d[col]
            inner.append((row[use], col[use]))
            given = d[row] & b[col]
            outer.append((row[given], col[given]))
            zero = d[row] & z[col] if direction == axis else np.zeros(row.size, bool)
            np.add.at(diagonal, row[use | given | zero], 1.0)

    def assemble(parts: list[tuple[np.ndarray, np.ndarray]]) -> sparse.csr_matrix:
        rows, cols = (np.concatenate(side) for side in zip(*parts))
        return sparse.csr_matrix((np.full(rows.size, 1 / h**2), (rows, cols)), shape=(n, n))

    return assemble(inner) - sparse.diags(diagonal / h**2), assemble(outer)


def _pressure_matrices(
    dynamic: np.ndarray, opening: np.ndarray, unknown: np.ndarray, distance: np.ndarray, axis: int, h: float
) -> tuple[sparse.csr_matrix, sparse.csr_matrix]:
    """Divergence (cells from faces) and gradient (faces from cells, over the distance to the surface) of one axis."""
    faces = np.arange(dynamic.size).reshape(dynamic.shape)
    n = unknown.shape[axis]
    cells = np.arange(unknown.size)
    low, high = np.take(faces, range(n), axis).ravel(), np.take(faces, range(1, n + 1), axis).ravel()
    use = unknown.ravel()
    cells, low, high = cells[use], low[use], high[use]
    area = opening.ravel()
    values = np.concatenate([area[high], -area[low]]) / h
    shape = (unknown.size, dynamic.size)
    divergence = sparse.csr_matrix((values, (np.tile(cells, 2), np.concatenate([high, low]))), shape=shape)
    signs = np.concatenate([-np.ones(cells.size), np.ones(cells.size)]) / h
    gradient = sparse.csr_matrix((signs, (np.concatenate([high, low]), np.tile(cells, 2))), shape=shape[::-1])
    return divergence, sparse.diags((dynamic / distance).ravel()) @ gradient


def _openings(system: PoissonSystem, inflow: list[np.ndarray]) -> list[np.ndarray]:
    """Open share of every face; a plain system counts inflow faces as fully open."""
    if isinstance(system, PressureSystem):
        return [np.asarray(o, float) for o in system.openings]
    return [np.where(w > 0, w, i.astype(float)) for w, i in zip(system.weights, inflow)]


def prepare_domain(
    cell_types: np.ndarray,
    system: PoissonSystem,
    *,
    mainstream: Float[np.ndarray, "3"] | None = None,
    smoke: Float[np.ndarray, "nx ny nz"] | None = None,
    sweeps: int = 4,
    dtype: type = np.float32,
) -> RolloutDomain:
    """Assemble the operators of one cell layout.

    Args:
        cell_types: u8 [nx,ny,nz], `CellType`.
        system: pressure system of the same layout (`pressure.build_system`).
        mainstream: unit direction of the outflow; None leaves the outlet free.
        smoke: share of smoke per cell in [0, 1] for a gas, whose body force acts there alone; None for a liquid.
        sweeps: cells that velocity is extrapolated beyond the fluid; at least the Courant number plus one.
        dtype: number type of the rollout.
    """
    types = np.asarray(cell_types)
    require(types.shape == system.unknown.shape, f"cell types {types.shape}", str(system.unknown.shape))
    h, unknown = float(system.spacing), system.unknown
    touching = [np.logical_or(*sides(unknown, a)) for a in range(3)]
    is_inflow = [np.logical_or(*sides(types == CellType.INFLOW, a)) for a in range(3)]
    openings = _openings(system, is_inflow)
    closed_share = [np.where(t, 1.0 - o, 0.0) for t, o in zip(touching, openings)]
    distances = surface_distances(types) if smoke is None else [np.ones(t.shape) for t in touching]
    nearer = [np.asarray(w / d, np.float32) for w, d in zip(system.weights, distances)]
    parts: dict[str, list] = {name: [] for name in _PARTS}
    for axis in range(3):
        opening = openings[axis]
        dynamic = (system.weights[axis] > 0) & touching[axis]
        inflow = is_inflow[axis] & (opening > 0)
        wall = (opening == 0) & touching[axis]
        low_out, high_out = sides(types == CellType.OUTFLOW, axis)
        leaving = dynamic & (low_out | high_out)
        along = 0.0 if mainstream is None else float(mainstream[axis])
        side, count = np.zeros(types.shape), np.zeros(types.shape)
        for other in range(3):
            if other != axis:
                n = types.shape[other]
                for ends in (range(n), range(1, n + 1)):
                    closed = np.take(closed_share[other], ends, other)
                    side, count = np.maximum(side, closed), count + closed
        share = dynamic if smoke is None else dynamic * -0.5 * np.add(*sides(np.asarray(smoke, float), axis))
        below, above = sides(unknown, axis)
        inner, outer = _viscous_matrices(dynamic, inflow, wall, axis, h)
        divergence, gradient = _pressure_matrices(dynamic, opening, unknown, distances[axis], axis, h)
        new = {
            "dynamic": dynamic,
            "inflow": inflow,
            "outflow": leaving * along,
            "outflow_faces": leaving & (mainstream is not None),
            "interior": ~(inflow | wall),
            "force": share,
            "wall_share": dynamic * np.maximum(*sides(side, axis)),
            "wall_count": dynamic * 0.5 * np.add(*sides(count * unknown, axis)),
            "wall_below": dynamic * below * _shift(closed_share[axis], axis, -1),
            "wall_above": dynamic * above * _shift(closed_share[axis], axis, 1),
            "extrapolation": extrapolation_matrix(dynamic | inflow | wall, sweeps),
            "laplacian": inner,
            "boundary": outer,
            "divergence": divergence,
            "gradient": gradient,
        }
        for name, value in new.items():
            parts[name].append(value)
    flat = {n: np.concatenate([np.asarray(x).ravel() for x in parts[n]]).astype(dtype) for n in _PARTS[1:10]}
    return RolloutDomain(
        shape=types.shape,
        system=replace(system, weight_x=nearer[0], weight_y=nearer[1], weight_z=nearer[2]),
        dynamic=np.concatenate([x.ravel() for x in parts["dynamic"]]),
        extrapolation=LinearMap.of(sparse.block_diag(parts["extrapolation"]), dtype),
        laplacian=sparse.csr_matrix(sparse.block_diag(parts["laplacian"]), dtype=dtype),
        boundary_laplacian=LinearMap.of(sparse.block_diag(parts["boundary"]), dtype),
        divergence=LinearMap.of(sparse.hstack(parts["divergence"]), dtype),
        gradient=LinearMap.of(sparse.vstack(parts["gradient"]), dtype),
        **flat,
    )


_PARTS = (
    "dynamic", "inflow", "outflow", "outflow_faces", "interior", "force", "wall_share", "wall_count", "wall_below",
    "wall_above", "extrapolation", "laplacian", "boundary", "divergence", "gradient",
)  # fmt: skip
