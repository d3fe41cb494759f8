"""Emitters: closed meshes in the world whose volume is kept full of fluid while they are on.

New particles stand on a lattice that travels with the emitter's velocity. A lattice point becomes a particle when it
enters the mesh, so that what comes out in a time is projected area x speed x time whatever the length of the steps
and whatever is already there, plus the mesh's own volume, which is filled at the start. Masses make up for what the
lattice misses of the mesh's area.

Cells whose centre lies inside move as prescribed, like those of the inlet. Their faces against the velocity are
closed: an emitter under water is a nozzle, not a pump that draws in what it gives out. One thinner than a cell has no
such cells: its particles alone carry its velocity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from fluidlift.errors import InputRejected, require
from fluidlift.numerics.mesh_distance import MeshDistance, mesh_distance
from fluidlift.numerics.sampling import sample_nodes
from fluidlift.numerics.solid_mesh import closed_mesh, moments
from fluidlift.physics.boundaries import CLEARANCE, Walls
from fluidlift.physics.inflow_schedule import InflowSchedule, InletPath
from fluidlift.types import Grid, TriangleMesh

PHASES = np.array([0.7548776662466927, 0.5698402909980532])
"""phases of neighbouring columns of the lattice, in spacings: Roberts' evenly spread sequence in the plane"""
FEWEST_COLUMNS = 12
"""of the lattice across an emitter, where particles need not be finer than FINEST for it"""
FINEST = 0.4
"""of the simulator's spacing between particles"""
MOST_NODES = 2_000_000
"""of the signed distance around an emitter"""
TOO_NEAR = 0.9
"""of the simulator's spacing: at the start no particle is put closer to one that is there. The middle between eight of
a lattice is 0.87 away from each"""


@dataclass(frozen=True)
class Emitter:
    """A tap, a nozzle, a spring: while start <= t < end its volume is filled with fluid at its velocity."""

    name: str
    mesh: TriangleMesh
    """closed, m, in the world"""
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """m/s, of what comes out"""
    start: float = 0.0
    """s"""
    end: float | None = None
    """s; None: it never ends"""
    color: tuple[float, float, float] | None = None
    """sRGB in [0, 1]; None: that of the nearest Gaussian at rest"""
    line: str = ""
    """where it stands in the file, for later complaints"""

    def __post_init__(self) -> None:
        object.__setattr__(self, "velocity", tuple(float(v) for v in self.velocity))
        require(len(self.velocity) == 3 and all(map(math.isfinite, self.velocity)), f"velocity {self.velocity}")
        require(math.isfinite(self.start) and self.start >= 0, f"start {self.start}", "0 s or more")
        require(self.end is None or self.end > self.start, f"end {self.end} s", f"later than the start, {self.start} s")
        if self.color is not None:
            object.__setattr__(self, "color", tuple(float(c) for c in self.color))
            require(len(self.color) == 3 and all(0 <= c <= 1 for c in self.color), f"color {self.color}", "0 to 1")

    def plain(self) -> list[Any]:
        """What it is, as values that can be compared; not where it stands in the file."""
        mesh = [np.asarray(self.mesh.vertices), np.asarray(self.mesh.faces)]
        return [self.name, self.velocity, self.start, self.end, self.color, *mesh]

    def on(self, time: float) -> bool:
        """Whether it runs at a time (s)."""
        return self.start <= time and (self.end is None or time < self.end)


@dataclass(frozen=True)
class Supply:
    """What flows in besides a steady inlet."""

    schedule: InflowSchedule = field(default_factory=InflowSchedule)
    """of the inlet"""
    emitters: tuple[Emitter, ...] = ()
    looks: tuple[np.ndarray, ...] = ()
    """per emitter: the rest Gaussians that its particles take their look from, in turn; none at all: as at the inlet"""
    path: InletPath | None = None
    """of the inlet; None: it stays in its place"""

    def __post_init__(self) -> None:
        require(len(self.looks) in (0, len(self.emitters)), f"{len(self.looks)} looks", f"{len(self.emitters)}")


def emitter_distance(emitter: Emitter, spacing: float) -> MeshDistance:
    """Signed distance around an emitter, m, fine enough for its thinnest extent.

    Args:
        emitter: as given.
        spacing: cell width of the simulation, m.

    Raises:
        InputRejected: a mesh that bounds no solid.
    """
    try:
        mesh = closed_mesh(emitter.mesh, name=f"emitter '{emitter.name}'")
    except InputRejected as error:
        raise InputRejected(f"{emitter.line}: {error.got}", error.needed, error.do) from None
    extent = np.ptp(np.asarray(mesh.vertices, np.float64), axis=0)
    fine = min(0.5 * spacing, float(extent.min()) / 10)
    coarsest = float(np.prod(extent + 6 * fine) / MOST_NODES) ** (1 / 3)
    return mesh_distance(mesh, max(fine, coarsest))


def projected_area(mesh: TriangleMesh, direction: Float[np.ndarray, "3"]) -> float:
    """m^2 that a closed mesh shows along a unit direction; folds count as often as they are entered."""
    v = np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)]
    normals = 0.5 * np.cross(v[:, 1] - v[:, 0], v[:, 2] - v[:, 0])
    return 0.5 * float(np.abs(normals @ direction).sum())


class Emission:
    """One emitter on a simulation's grid.

    Args:
        emitter: as given.
        walls: of the simulation.
        particle_spacing: m, of the simulator's new particles.

    Raises:
        InputRejected: a mesh that bounds no solid.
    """

    def __init__(self, emitter: Emitter, walls: Walls, particle_spacing: float) -> None:
        self.emitter, self._walls, self._usual, grid = emitter, walls, particle_spacing, walls.grid
        self.velocity = np.array(emitter.velocity)
        self._speed = float(np.linalg.norm(self.velocity))
        self._along = self.velocity / self._speed if self._speed > 0 else np.array([0.0, 0.0, 1.0])
        self.last = np.nan
        """s, up to which it has emitted; not a number: it is off"""
        self._distance = emitter_distance(emitter, grid.spacing)
        area = projected_area(emitter.mesh, self._along)
        step = float(np.clip(np.sqrt(area / FEWEST_COLUMNS), FINEST * particle_spacing, particle_spacing))
        self._lay_columns(step)
        while not len(self._entries) and step > 0.05 * particle_spacing:
            step *= 0.5
            self._lay_columns(step)
        count = max(len(self._entries), 1)
        if self._speed > 0:
            self.volume = area * self._step / count
        else:
            inside = max(len(self._standing(0.0)), 1)
            self.volume = moments(emitter.mesh).volume / inside
        """m^3 that each of its particles stands for"""
        self._find_cells(grid)

    def _lay_columns(self, step: float) -> None:
        """Where columns of the lattice enter and leave the mesh, m along the velocity."""
        self._step, d = step, self._along
        across = np.linalg.svd(d[None])[2][1:]
        corners = np.asarray(self.emitter.mesh.vertices, np.float64)
        flat, run = corners @ across.T, corners @ d
        middle = 0.5 * (flat.min(axis=0) + flat.max(axis=0))
        half = np.ceil(0.5 * np.ptp(flat, axis=0) / step).astype(int)
        index = np.stack(np.meshgrid(*(np.arange(-n, n + 1) for n in half), indexing="ij"), axis=-1).reshape(-1, 2)
        feet = (middle + step * index) @ across
        samples = np.linspace(run.min() - step, run.max() + step, math.ceil(np.ptp(run) / (0.25 * step)) + 9)
        values = np.stack([self.distance(feet + x * d) for x in samples], axis=1)
        enters, leaves = ((values[:, :-1] > 0) & (values[:, 1:] <= 0), (values[:, :-1] <= 0) & (values[:, 1:] > 0))

        def crossing(at: np.ndarray) -> np.ndarray:
            i, j = np.nonzero(at)
            share = values[i, j] / (values[i, j] - values[i, j + 1])
            return samples[j] + share * (samples[j + 1] - samples[j])

        self._column = np.nonzero(enters)[0]
        self._entries, self._exits = crossing(enters), crossing(leaves)
        self._feet, self._phases = feet[self._column], np.mod(index[self._column] @ PHASES, 1.0)

    def _find_cells(self, grid: Grid) -> None:
        """Cells and faces that move as prescribed."""
        low, high = self.emitter.mesh.vertices.min(axis=0), self.emitter.mesh.vertices.max(axis=0)
        first = np.clip(np.floor((low - grid.low) / grid.spacing), 0, grid.shape).astype(int)
        last = np.clip(np.ceil((high - grid.low) / grid.spacing), 0, grid.shape).astype(int)
        self.cells = np.zeros((0, 3), np.int64)
        if (last > first).all():
            index = np.stack(np.meshgrid(*(np.arange(a, b) for a, b in zip(first, last)), indexing="ij"), axis=-1)
            index = index.reshape(-1, 3)
            inside = self.distance(grid.low + (index + 0.5) * grid.spacing) < 0
            self.cells = index[inside & ~self._walls.solid[tuple(index.T)]]
        self._faces, self._values = [], []
        held = {tuple(c) for c in self.cells}
        for axis in range(3):
            v, faces = float(self.velocity[axis]), {}
            one = np.eye(3, dtype=np.int64)[axis]
            for cell in self.cells:
                for face, beyond, outward in ((cell, cell - one, -1.0), (cell + one, cell + one, 1.0)):
                    closed = tuple(beyond) not in held and v * outward < 0
                    faces[tuple(face)] = 0.0 if closed else v
            index = np.array(list(faces), np.int64).reshape(-1, 3)
            open_here = self._walls.openings[axis][tuple(index.T)] > 0
            self._faces.append(index[open_here])
            self._values.append(np.array(list(faces.values()), np.float32)[open_here])

    def distance(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """m to the emitter's surface, negative inside; not less than a cell beyond the box around it."""
        grid, field = self._distance.grid, self._distance.distance
        out = sample_nodes(field, grid, points)
        return np.where(grid.contains(points), out, np.maximum(out, grid.spacing))

    def inside(self, positions: Float[np.ndarray, "n 3"]) -> np.ndarray:
        """Indices of the particles inside the mesh."""
        low, high = self._distance.grid.low, self._distance.grid.high
        near = np.flatnonzero(((positions > low) & (positions < high)).all(axis=1))
        return near[self.distance(positions[near]) < 0]

    def _standing(self, run: float) -> Float[np.ndarray, "n 3"]:
        """Lattice points inside the mesh once the lattice has travelled `run` m."""
        first = np.ceil((self._entries - run) / self._step - self._phases)
        return self._points(first, np.ceil((self._exits - run) / self._step - self._phases), run)

    def _points(self, first: np.ndarray, end: np.ndarray, run: float) -> Float[np.ndarray, "n 3"]:
        """Points first <= k < end of each column of the lattice, which has travelled `run` m."""
        counts = np.maximum(end - first, 0).astype(np.int64)
        column = np.repeat(np.arange(len(counts)), counts)
        k = np.arange(len(column)) - np.repeat(np.cumsum(counts) - counts, counts) + first[column]
        return self._feet[column] + ((k + self._phases[column]) * self._step + run)[:, None] * self._along

    def due(self, time: float, positions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
        """Places (m) of the particles that have come out since the last call, which had an earlier time (s).

        Args:
            time: now, s.
            positions: of the particles that are there; at the start none is put upon them.
        """
        e = self.emitter
        if time < e.start or (np.isnan(self.last) and not e.on(time)):
            return np.zeros((0, 3), np.float32)
        parts = []
        if np.isnan(self.last):
            self.last, standing = e.start, self._standing(0.0)
            if len(positions) and len(standing):
                gap, _ = cKDTree(positions).query(standing, distance_upper_bound=TOO_NEAR * self._usual)
                standing = standing[~np.isfinite(gap)]
            parts.append(standing + self.velocity * (time - e.start))
        until = time if e.end is None else min(time, e.end)
        run, before = self._speed * (until - e.start), self._speed * (self.last - e.start)
        first, end = (np.ceil((self._entries - x) / self._step - self._phases) for x in (run, before))
        parts.append(self._points(first, end, run) + self.velocity * (time - until))
        self.last = time if e.on(time) else np.nan
        return self._clear(np.concatenate(parts))

    def _clear(self, places: np.ndarray) -> Float[np.ndarray, "n 3"]:
        """Those in the box and outside the solid, float32."""
        grid, clear = self._walls.grid, CLEARANCE * self._walls.grid.spacing
        places = places[grid.contains(places, clear)]
        return places[sample_nodes(self._walls.signed_distance, grid, places) > clear].astype(np.float32)

    @property
    def prescribed(self) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Per component, faces (int64 [m,3]) that move as prescribed, and their velocity (float32 [m], m/s)."""
        return self._faces, self._values

    @property
    def field(self) -> MeshDistance:
        """Distance to the surface, m, negative inside, in a box around it."""
        return self._distance

    @property
    def is_new(self) -> bool:
        """Whether nothing has come out yet since it came on: `due` looks at the particles then."""
        return bool(np.isnan(self.last))

    def impose(self, components: list[np.ndarray], first: tuple[int, int, int]) -> None:
        """Set the faces of its cells, in arrays that begin at cell `first`, in place."""
        for component, faces, values in zip(components, self._faces, self._values):
            component[tuple((faces - first).T)] = values

    def mark(self, masks: list[np.ndarray], first: tuple[int, int, int]) -> None:
        """Set the mask of its faces, in place."""
        for mask, faces in zip(masks, self._faces):
            mask[tuple((faces - first).T)] = True
