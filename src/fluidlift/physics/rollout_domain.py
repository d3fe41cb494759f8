"""The cell layout of a differentiable rollout: which face does what, assembled once.

Velocity is one flat vector here: all faces across x, then y, then z, each raveled in C order. `RolloutLists` holds the
same facts as compact lists for the kernels; sparse matrices of the linear operators are built when asked for.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse

from fluidlift.errors import require
from fluidlift.numerics.poisson import PoissonSystem
from fluidlift.physics import rollout_kernels as kernels
from fluidlift.physics.pressure import PressureSystem
from fluidlift.physics.rollout_diffusion import add_boundary
from fluidlift.physics.rollout_matrices import extrapolation_matrix, pressure_matrices, viscous_matrices
from fluidlift.physics.rollout_surface import depth_at_outlet, liquid_distance, outlet_head, sides, surface_distances
from fluidlift.types import CellType, triple

WEIGHTS = ("weight_x", "weight_y", "weight_z")
"""fields of `PoissonSystem`"""


@dataclass(frozen=True)
class LinearMap:
    """A linear map and its transpose by kernels; its sparse matrix is built when asked for."""

    forward: Callable[[np.ndarray], np.ndarray]
    adjoint: Callable[[np.ndarray], np.ndarray]
    build: Callable[[], sparse.csr_matrix]

    @cached_property
    def matrix(self) -> sparse.csr_matrix:
        """The readable form."""
        return self.build()

    @cached_property
    def transpose(self) -> sparse.csr_matrix:
        """Of the matrix."""
        return self.matrix.T.tocsr()


@dataclass(frozen=True)
class RolloutLists:
    """Faces by what happens to them, as indices into the flat vector; see `rollout_kernels` for runs and components."""

    known: Bool[np.ndarray, " f"]
    """faces that extrapolation starts from"""
    components: tuple[tuple[int, tuple[int, int, int]], ...]
    runs: tuple[tuple[np.ndarray, np.ndarray], ...]
    """dynamic faces of each component: runs, and where those of each plane begin"""
    extrapolation: tuple[np.ndarray, np.ndarray, np.ndarray]
    """faces in the order of filling, where the neighbours of each begin, neighbours"""
    walls: Int[np.ndarray, " w"]
    """faces on which a wall acts"""
    wall_layout: tuple[np.ndarray, np.ndarray, np.ndarray]
    """their `wall_share`, `wall_below`, `wall_above`"""
    inflow: Int[np.ndarray, " i"]
    inflow_ends: tuple[int, int, int, int]
    """the inflow faces across axis a are inflow[ends[a]:ends[a + 1]]"""
    closed: Int[np.ndarray, " c"]
    """walls: faces whose velocity is 0"""
    outflow: Int[np.ndarray, " o"]
    outlet: Int[np.ndarray, " h"]
    """faces that a head pushes"""
    couplings: Float[np.ndarray, " f"]
    """neighbours that a dynamic face is coupled with by viscosity, walls ahead and behind included"""
    boundary: tuple[np.ndarray, np.ndarray]
    """pairs of a dynamic face and a prescribed neighbour"""


@dataclass(frozen=True)
class RolloutDomain:
    """Which face does what, for one cell layout. Operators among `LinearMap`s have their kernels behind them."""

    shape: tuple[int, int, int]
    system: PoissonSystem
    """faces to air weigh more the nearer the surface is, see `surface_distances`"""
    sweeps: int
    """of the extrapolation"""
    dynamic: Bool[np.ndarray, " f"]
    """faces whose velocity the momentum equation and the pressure change"""
    wall: Bool[np.ndarray, " f"]
    """closed faces beside cells whose pressure is solved"""
    inflow: Float[np.ndarray, " f"]
    """1 on faces with the prescribed inflow velocity"""
    outflow: Float[np.ndarray, " f"]
    """component of the mainstream along the face's axis on faces between fluid and OUTFLOW cells, else 0"""
    outflow_faces: Float[np.ndarray, " f"]
    """1 on those faces"""
    outlet_head: Float[np.ndarray, "3 f"]
    """times gravity: acceleration by the weight of the liquid behind the outlet (`rollout_surface.outlet_head`)"""
    interior: Float[np.ndarray, " f"]
    """1 on faces that keep a free value before the projection (neither wall nor inflow)"""
    force: Float[np.ndarray, " f"]
    """share of gravity each face feels: 1 on dynamic faces (liquid), minus the share of smoke beside them (gas:
    buoyancy acts against gravity, whose size is then that of the buoyancy)"""
    wall_share: Float[np.ndarray, " f"]
    """0 to 1: how much solid runs along a dynamic face's cells"""
    wall_count: Float[np.ndarray, " f"]
    """0 to 4: closed faces beside a dynamic face, mean of its two cells"""
    wall_below: Float[np.ndarray, " f"]
    wall_above: Float[np.ndarray, " f"]
    """0 to 1: closed share of the next face towards lower / higher index, where a wall stands across the motion"""
    opening: Float[np.ndarray, " f"]
    """open share"""
    reach: Float[np.ndarray, " f"]
    """1 / distance of the pressures on both sides of a dynamic face in cells, 0 on other faces"""

    @property
    def face_shapes(self) -> tuple[tuple[int, int, int], ...]:
        """Shapes of u, v, w."""
        nx, ny, nz = self.shape
        return ((nx + 1, ny, nz), (nx, ny + 1, nz), (nx, ny, nz + 1))

    @cached_property
    def offsets(self) -> tuple[int, int, int, int]:
        """Where u, v, w begin in the flat vector, and its length."""
        sizes = [a * b * c for a, b, c in self.face_shapes]
        return (0, sizes[0], sizes[0] + sizes[1], sum(sizes))

    def component(self, flat: np.ndarray, axis: int) -> np.ndarray:
        """One component of a flat vector as an array."""
        return flat[self.offsets[axis] : self.offsets[axis + 1]].reshape(self.face_shapes[axis])

    def active(self) -> tuple[np.ndarray, ...]:
        """`dynamic` split by component."""
        return tuple(np.ascontiguousarray(self.component(self.dynamic, a).ravel()) for a in range(3))

    @cached_property
    def lists(self) -> RolloutLists:
        """For the kernels."""
        return _compact_lists(self)

    @cached_property
    def extrapolation(self) -> LinearMap:
        """Faces to faces: fills unknown faces from known ones."""
        return LinearMap(self._extrapolate, self._extrapolate_adjoint, self._extrapolation_matrix)

    @cached_property
    def divergence(self) -> LinearMap:
        """Faces to cells, 1/m, open shares included."""
        return LinearMap(
            partial(self._to_cells, weight=self.opening, sign=1.0),
            partial(self._to_faces, weight=self.opening, sign=-1.0),
            partial(self._pressure_matrix, 0),
        )

    @cached_property
    def gradient(self) -> LinearMap:
        """Cells to dynamic faces, 1/m; system = - divergence gradient."""
        return LinearMap(
            partial(self._to_faces, weight=self.reach, sign=1.0),
            partial(self._to_cells, weight=self.reach, sign=-1.0),
            partial(self._pressure_matrix, 1),
        )

    @cached_property
    def laplacian(self) -> sparse.csr_matrix:
        """1/m^2, between dynamic faces only, symmetric: the readable form of `rollout_diffusion`."""
        return self._viscous_matrix(0)

    @cached_property
    def boundary_laplacian(self) -> LinearMap:
        """1/m^2, from prescribed faces to dynamic ones."""
        rows, cols = self.lists.boundary
        rate = 1.0 / float(self.system.spacing) ** 2
        return LinearMap(
            partial(_scattered, rows=rows, cols=cols, rate=rate),
            partial(_scattered, rows=cols, cols=rows, rate=rate),
            partial(self._viscous_matrix, 1),
        )

    def _matrix(self, matrix: Any) -> sparse.csr_matrix:
        return sparse.csr_matrix(matrix, dtype=self.inflow.dtype)

    def _extrapolate(self, v: np.ndarray) -> np.ndarray:
        out = np.empty_like(v)
        faces, first, neighbours = self.lists.extrapolation
        kernels.extrapolate(v, self.lists.known, faces, first, neighbours, out)
        return out

    def _extrapolate_adjoint(self, g: np.ndarray) -> np.ndarray:
        out = np.empty_like(g)
        faces, first, neighbours = self.lists.extrapolation
        kernels.extrapolate_adjoint(g, self.lists.known, faces, first, neighbours, out)
        return out

    def _extrapolation_matrix(self) -> sparse.csr_matrix:
        known = self.lists.known
        return self._matrix(
            sparse.block_diag([extrapolation_matrix(self.component(known, a), self.sweeps) for a in range(3)])
        )

    def _to_cells(self, v: np.ndarray, weight: np.ndarray, sign: float) -> np.ndarray:
        out = np.empty(self.shape, v.dtype)
        scale = v.dtype.type(sign / float(self.system.spacing))
        kernels.cells_from_faces(v, weight, self.system.unknown, scale, out)
        return out.reshape(-1)

    def _to_faces(self, q: np.ndarray, weight: np.ndarray, sign: float) -> np.ndarray:
        out = np.zeros(self.offsets[3], q.dtype)
        # the kernel's sign: cell above less cell below
        scale = q.dtype.type(sign / float(self.system.spacing))
        kernels.faces_from_cells(q.reshape(self.shape), weight, self.system.unknown, scale, out)
        return out

    def _viscous_matrix(self, which: int) -> sparse.csr_matrix:
        masks = (self.dynamic, self.inflow > 0, self.wall)
        h = float(self.system.spacing)
        pairs = [viscous_matrices(*triple(self.component(m, a) for m in masks), a, h) for a in range(3)]
        return self._matrix(sparse.block_diag([pair[which] for pair in pairs]))

    def _pressure_matrix(self, which: int) -> sparse.csr_matrix:
        h, unknown = float(self.system.spacing), self.system.unknown
        pairs = [
            pressure_matrices(self.component(self.reach, a), self.component(self.opening, a), unknown, a, h)
            for a in range(3)
        ]
        join = (sparse.hstack, sparse.vstack)[which]
        return self._matrix(join([pair[which] for pair in pairs]))


def _scattered(v: np.ndarray, rows: np.ndarray, cols: np.ndarray, rate: float) -> np.ndarray:
    out = np.zeros_like(v)
    add_boundary(out, v, rows, cols, v.dtype.type(rate))
    return out


def _compact_lists(domain: RolloutDomain) -> RolloutLists:
    inflow_mask = domain.inflow > 0
    known = domain.dynamic | inflow_mask | domain.wall
    components = tuple(zip(domain.offsets[:3], domain.face_shapes))
    runs, fills, rows, cols = [], [], [], []
    couplings = np.empty(domain.offsets[3], domain.inflow.dtype)
    for axis, (start, shape) in enumerate(components):
        dynamic, given, wall, here = (
            domain.component(m, axis) for m in (domain.dynamic, inflow_mask, domain.wall, known)
        )
        runs.append(kernels.find_runs(dynamic, axis == 2))
        fills.append(kernels.extrapolation_lists(here.ravel(), shape, start, domain.sweeps))
        count, row, col = kernels.count_couplings(dynamic, given, wall, axis, start)
        domain.component(couplings, axis)[...] = count
        rows.append(row)
        cols.append(col)
    begins = np.cumsum([0] + [len(f[2]) for f in fills])
    first = [np.zeros(1, np.int32)] + [f[1][1:] + np.int32(b) for f, b in zip(fills, begins)]
    walls = np.flatnonzero((domain.wall_share != 0) | (domain.wall_below != 0) | (domain.wall_above != 0))
    inflow = np.flatnonzero(inflow_mask)
    ends = np.searchsorted(inflow, domain.offsets)
    return RolloutLists(
        known=known,
        components=components,
        runs=tuple(runs),
        extrapolation=(
            np.concatenate([f[0] for f in fills]),
            np.concatenate(first),
            np.concatenate([f[2] for f in fills]),
        ),
        walls=walls.astype(np.int32),
        wall_layout=(domain.wall_share[walls], domain.wall_below[walls], domain.wall_above[walls]),
        inflow=inflow.astype(np.int32),
        inflow_ends=(int(ends[0]), int(ends[1]), int(ends[2]), int(ends[3])),
        closed=np.flatnonzero(domain.wall & ~inflow_mask).astype(np.int32),
        outflow=np.flatnonzero(domain.outflow_faces).astype(np.int32),
        outlet=np.flatnonzero(domain.outlet_head.any(axis=0)).astype(np.int32),
        couplings=couplings,
        boundary=(np.concatenate(rows), np.concatenate(cols)),
    )


def _shift(faces: np.ndarray, axis: int, by: int) -> np.ndarray:
    """The neighbour's value along `axis`, 0 beyond the array."""
    out = np.zeros_like(faces)
    source, target = [slice(None)] * 3, [slice(None)] * 3
    source[axis], target[axis] = (slice(1, None), slice(None, -1)) if by > 0 else (slice(None, -1), slice(1, None))
    out[tuple(target)] = faces[tuple(source)]
    return out


def _openings(system: PoissonSystem, inflow: list[np.ndarray]) -> list[np.ndarray]:
    """Open share of every face; a plain system counts inflow faces as fully open."""
    if isinstance(system, PressureSystem):
        return [np.asarray(o) for o in system.openings]
    return [np.where(w > 0, w, i.astype(w.dtype)) for w, i in zip(system.weights, inflow)]


def prepare_domain(
    cell_types: np.ndarray,
    system: PoissonSystem,
    *,
    mainstream: Float[np.ndarray, "3"] | None = None,
    smoke: Float[np.ndarray, "nx ny nz"] | None = None,
    distance: Float[np.ndarray, "nx ny nz"] | None = None,
    sweeps: int = 4,
    dtype: type = np.float32,
) -> RolloutDomain:
    """Assemble what a rollout needs to know of one cell layout.

    Args:
        cell_types: u8 [nx,ny,nz], `CellType`.
        system: pressure system of the same layout (`pressure.build_system`).
        mainstream: unit direction of the outflow; None leaves the outlet free.
        smoke: share of smoke per cell in [0, 1] for a gas, whose body force acts there alone; None for a liquid.
        distance: m, of cell centres to a liquid's surface (`rollout_surface.surface_cells`); None: from the types.
        sweeps: cells that velocity is extrapolated beyond the fluid; at least the Courant number plus one.
        dtype: number type of the rollout.

    Raises:
        ValueError: cell types of another shape than the system.
    """
    types = np.asarray(cell_types)
    require(types.shape == system.unknown.shape, f"cell types {types.shape}", str(system.unknown.shape))
    unknown = np.ascontiguousarray(system.unknown)
    touching = [np.logical_or(*sides(unknown, a)) for a in range(3)]
    is_inflow = [np.logical_or(*sides(types == CellType.INFLOW, a)) for a in range(3)]
    openings = _openings(system, is_inflow)
    closed_share = [np.where(t, 1 - o, 0).astype(dtype) for t, o in zip(touching, openings)]
    depth, normal = np.zeros(types.shape), np.zeros(3)
    distances = [np.ones(t.shape) for t in touching]
    if smoke is None:
        level = liquid_distance(types) if distance is None else distance / system.spacing
        distances = surface_distances(types, level)
        depth, normal = depth_at_outlet(types, level)
    parts: dict[str, list[np.ndarray]] = {}
    for axis in range(3):
        dynamic = (system.weights[axis] > 0) & touching[axis]
        inflow, wall = is_inflow[axis] & (openings[axis] > 0), (openings[axis] == 0) & touching[axis]
        leaving = dynamic & np.logical_or(*sides(types == CellType.OUTFLOW, axis))
        along = 0.0 if mainstream is None else float(mainstream[axis])
        share = dynamic if smoke is None else dynamic * -0.5 * np.add(*sides(np.asarray(smoke, float), axis))
        new = {
            "dynamic": dynamic,
            "wall": wall,
            "inflow": inflow,
            "outflow": leaving * along,
            "outflow_faces": leaving & (mainstream is not None),
            "outlet_head": dynamic * outlet_head(types, depth, normal, axis),
            "interior": ~(inflow | wall),
            "force": share,
            "opening": openings[axis],
            "reach": dynamic / distances[axis],
        }
        for name, value in (new | _walls_beside(dynamic, unknown, closed_share, axis)).items():
            parts.setdefault(name, []).append(np.asarray(value).reshape(*value.shape[:-3], -1))
    flat = {n: np.concatenate(p, axis=-1) for n, p in parts.items()}
    nearer = (np.asarray(w / d, np.float32) for w, d in zip(system.weights, distances))
    return RolloutDomain(
        shape=types.shape,
        system=replace(system, unknown=unknown, **dict(zip(WEIGHTS, nearer))).prepared(),
        sweeps=sweeps,
        **{n: v if n in ("dynamic", "wall") else v.astype(dtype) for n, v in flat.items()},
    )


def _walls_beside(
    dynamic: np.ndarray, unknown: np.ndarray, closed_share: list[np.ndarray], axis: int
) -> dict[str, np.ndarray]:
    """The fields of `RolloutDomain` about walls, of one component."""
    # of a cell's faces along the other two axes: the largest closed share, and the sum of these shares
    side, count = (
        np.zeros_like(closed_share[0], shape=unknown.shape),
        np.zeros_like(closed_share[0], shape=unknown.shape),
    )
    for other in range(3):
        if other == axis:
            continue
        n = unknown.shape[other]
        for ends in (slice(0, n), slice(1, n + 1)):
            cut = [slice(None)] * 3
            cut[other] = ends
            closed = closed_share[other][tuple(cut)]
            np.maximum(side, closed, out=side)
            count += closed
    below, above = sides(unknown, axis)
    return {
        "wall_share": dynamic * np.maximum(*sides(side, axis)),
        "wall_count": dynamic * 0.5 * np.add(*sides(count * unknown, axis)),
        "wall_below": dynamic * below * _shift(closed_share[axis], axis, -1),
        "wall_above": dynamic * above * _shift(closed_share[axis], axis, 1),
    }
