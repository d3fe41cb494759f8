"""The inlet: Dirichlet velocity in INFLOW cells (paper: v_in, v~_in) and gap-free emission of particles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, Integer, UInt8
from scipy import ndimage
from scipy.spatial import cKDTree

from fluidlift.numerics.sampling import sample_faces, sample_nodes
from fluidlift.numerics.sharing import shared
from fluidlift.physics.boundaries import CLEARANCE, Walls, touching_faces
from fluidlift.physics.emitter import PHASES, Emission, Supply
from fluidlift.types import CellType, FaceVelocity, FluidParameters, Grid, Terrain, triple

MODES = 12
"""plane waves that make up the inflow fluctuation"""

LOOK_BACK = 5
"""cells of the way back without liquid after which what falls is not fed from above: as tall is one column of the plan
of a curtain at 80 degrees, and its rim has steps of that"""

STEP = 2
"""cells that a sheet of cells may step back or forth from one layer to the next"""

SHORE = 1.5
"""cells from what stands out of a fluid within which its splats have the colours of rocks and banks"""


@dataclass(frozen=True)
class Fluctuation:
    """A smooth, divergence-free random velocity with |v| of unit root mean square over space and time."""

    wave_vectors: Float[np.ndarray, "m 3"]
    """1/m"""
    frequencies: Float[np.ndarray, " m"]
    """1/s"""
    directions: Float[np.ndarray, "m 3"]
    """unit vectors normal to the wave vectors"""
    phases: Float[np.ndarray, " m"]

    def __call__(self, points: Float[np.ndarray, "n 3"], time: float) -> Float[np.ndarray, "n 3"]:
        """No unit."""
        angle = points @ self.wave_vectors.T - self.frequencies * time + self.phases
        return np.sqrt(2.0 / len(self.phases)) * np.cos(angle) @ self.directions


def random_fluctuation(
    size: float, finest: float, bulk: Float[np.ndarray, "3"], amplitude: float, rng: np.random.Generator
) -> Fluctuation:
    """Waves from the size of the inlet (m) down to a quarter of it, not shorter than `finest` (m).

    They are carried along by the bulk velocity and change while they travel; without one, the amplitude (m/s) sets
    the time scale.
    """
    lengths = np.maximum(size * 0.25 ** rng.uniform(0.0, 1.0, MODES), finest)
    axes = rng.normal(size=(MODES, 3))
    k = axes / np.linalg.norm(axes, axis=1, keepdims=True) * (2 * np.pi / lengths)[:, None]
    directions = np.cross(k, rng.normal(size=(MODES, 3)))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    own = rng.uniform(0.5, 1.0, MODES) * max(float(np.linalg.norm(bulk)), amplitude) * 2 * np.pi / lengths
    return Fluctuation(k, k @ bulk + 0.5 * own, directions, rng.uniform(0, 2 * np.pi, MODES))


def inlet_to_surface(
    cell_types: UInt8[np.ndarray, "nx ny nz"], positions: Float[np.ndarray, "n 3"], grid: Grid
) -> UInt8[np.ndarray, "nx ny nz"]:
    """The cells with an inlet that reaches up to the surface of the body: EMPTY cells above INFLOW that hold particles.

    A cell that the surface leaves less than half full counts as EMPTY at the start. Without it, all that flows in
    does so below the surface, and rises behind the inlet.
    """
    cells = cell_types.copy()
    held = np.zeros(grid.shape, bool)
    held[tuple(np.clip(grid.cell_of(positions), 0, np.asarray(grid.shape) - 1).T)] = True
    for k in range(1, grid.shape[2]):
        above = (cells[:, :, k - 1] == CellType.INFLOW) & (cells[:, :, k] == CellType.EMPTY) & held[:, :, k]
        cells[:, :, k][above] = CellType.INFLOW
    return cells


def inlet_along_rim(
    cell_types: Integer[np.ndarray, "nx ny nz"],
    positions: Float[np.ndarray, "n 3"],
    velocity: FaceVelocity,
    grid: Grid,
    gravity: Float[np.ndarray, "3"],
) -> Integer[np.ndarray, "nx ny nz"]:
    """The cells with an inlet that follows the rim of a falling body without gaps, from its highest to its lowest cell.

    An inlet drawn on the plan of a steep curtain misses cells of its rim, and below each gap the curtain runs dry as
    soon as it has fallen: a sheet comes down in strings. So between the ends of the inlet a cell of the body that moves
    down, however gently (over the rim water runs before it falls), becomes INFLOW where the way back along its velocity
    meets nothing wet. The way is looked for to either side as well, across the curtain, which may lean: it is a
    staircase of cells.

    Args:
        cell_types: `CellType`; those of an inlet without anything of the body are returned as they are.
        positions: of the body's particles, m.
        velocity: of the liquid, m/s.
        grid: of all of it.
        gravity: m/s^2.
    """
    held = np.zeros(grid.shape, bool)
    held[tuple(np.clip(grid.cell_of(positions), 0, np.asarray(grid.shape) - 1).T)] = True
    near = ndimage.binary_dilation(held)
    # inlet cells away from all that was seen say nothing about where the body ends
    down, given = np.asarray(gravity, np.float64), np.argwhere((cell_types == CellType.INFLOW) & near)
    index = np.argwhere(held & ((cell_types == CellType.FLUID) | (cell_types == CellType.EMPTY)))
    if not len(given) or not down.any() or not len(index):
        return cell_types
    down = down / np.linalg.norm(down)
    v = velocity.at_centers()[tuple(index.T)].astype(np.float64)
    speed = np.linalg.norm(v, axis=1)
    falls = (v @ down > 0) & (index @ down <= (given @ down).max())
    index, along = index[falls], v[falls] / speed[falls, None]
    across = _across_sheet(np.argwhere(held), down, (given @ down).max())
    reach = LOOK_BACK + STEP + 1
    liquid = np.isin(cell_types, (CellType.FLUID, CellType.INFLOW)) | ((cell_types != CellType.SOLID) & held)
    wet = np.pad(liquid, reach)
    fed = np.zeros(len(index), bool)
    for steps in range(1, LOOK_BACK + 1):
        for side in range(-STEP, STEP + 1):
            at = np.rint(index - steps * along + side * across).astype(np.int64) + reach
            fed |= wet[tuple(at.T)]
    cells = cell_types.copy()
    cells[tuple(index[~fed].T)] = CellType.INFLOW
    return cells


def _across_sheet(cells: Int[np.ndarray, "n 3"], down: Float[np.ndarray, "3"], lowest: float) -> Float[np.ndarray, "3"]:
    """Unit vector across what falls, level: the axis along which its layers of cells are thinnest, those that lie no
    further along `down` than `lowest`."""
    depth = np.rint(cells @ down).astype(int)
    above = depth <= lowest
    points, layer = cells[above].astype(np.float64), depth[above] - depth.min()
    count = np.maximum(np.bincount(layer), 1)
    middle = np.stack([np.bincount(layer, points[:, a]) / count for a in range(3)], axis=1)
    spread = points - middle[layer]
    spread -= (spread @ down)[:, None] * down
    # what is along gravity itself never counts as thin
    values, vectors = np.linalg.eigh(spread.T @ spread + 1e9 * np.outer(down, down))
    return vectors[:, int(values.argmin())]


def _shifted(cells: Bool[np.ndarray, "nx ny nz"], by: tuple[int, int, int]) -> Bool[np.ndarray, "nx ny nz"]:
    """Cells that are so many cells beside those given, as far as they are in the box."""
    if not any(by):
        return cells
    out, index = np.zeros_like(cells), np.argwhere(cells) + by
    index = index[((index >= 0) & (index < cells.shape)).all(axis=1)]
    out[tuple(index.T)] = True
    return out


def beside_inlet(
    points: Float[np.ndarray, "n 3"], cell_types: Integer[np.ndarray, "nx ny nz"], grid: Grid, reach: float
) -> Bool[np.ndarray, " n"]:
    """Whether points (m) lie in the inlet or within so many cells of it; none do where there is no inlet."""
    inlet = cell_types == CellType.INFLOW
    if not inlet.any():
        return np.zeros(len(points), bool)
    index = np.clip(grid.cell_of(np.asarray(points)), 0, np.asarray(grid.shape) - 1)
    return ndimage.distance_transform_edt(~inlet)[tuple(index.T)] <= reach


def clear_of_shore(
    points: Float[np.ndarray, "n 3"], level: Float[np.ndarray, " n"], terrain: Terrain
) -> Bool[np.ndarray, " n"]:
    """Whether points (m) of a fluid whose surface stands at a level (z, m) are away from rocks and banks.

    Those that rise by less than `SHORE` above the surface, and its bed, do not count.
    """
    reach = SHORE * terrain.grid.spacing
    above = np.concatenate(
        [np.asarray(points, np.float64)[:, :2], np.asarray(level, np.float64)[:, None] + reach], axis=1
    )
    above[:, 2] = np.minimum(above[:, 2], terrain.grid.high[2])
    return sample_nodes(terrain.signed_distance, terrain.grid, above) > reach


@dataclass(frozen=True)
class SteadyInflow:
    """What the velocity of INFLOW cells is made of (`Inlet.velocity`), for those who evaluate it elsewhere."""

    offset: Float[np.ndarray, "3"]
    """m/s"""
    profile: FaceVelocity | None
    """m/s, on the faces of the whole box"""
    gain: float
    """of the profile"""
    amplitude: float
    """m/s"""
    fluctuation: Fluctuation
    faces: tuple[Int[np.ndarray, "m 3"], ...]
    """per component, the faces with this velocity, and their centres (m)"""
    points: tuple[Float[np.ndarray, "m 3"], ...]


@dataclass(frozen=True)
class InletLattice:
    """The travelling lattice of places for particles around the INFLOW cells, at one instant.

    Place (i, j, k) lies at `start` + `spacing` (i, j, k), shifted along the axis `along` by `spacing` times the phase
    of its column, mod((index - turns) . PHASES, 1) over the two other axes.
    """

    start: Float[np.ndarray, "3"]
    """m"""
    spacing: float
    """m"""
    first: tuple[int, int, int]
    """least index"""
    counts: tuple[int, int, int]
    """places along each axis"""
    along: int
    turns: Float[np.ndarray, "3"]
    """whole spacings that the lattice has travelled"""
    reach: float
    """m: a place with a particle nearer than that lacks none"""
    clear: float
    """m: places are farther than that from the solid"""


class Inlet:
    """What flows in: velocity as a function of place and time, and where new particles are due.

    INFLOW cells make up the inlet proper; the emitters of the `supply` come and go. Where the supply has a path, these
    cells go along it, and those of the walls say where they are without it.
    """

    def __init__(
        self,
        walls: Walls,
        parameters: FluidParameters,
        profile: FaceVelocity | None,
        seed: int,
        per_cell: int,
        supply: Supply | None = None,
    ) -> None:
        grid = walls.grid
        self._walls, self.supply = walls, supply or Supply()
        self._home = walls.regions == CellType.INFLOW
        """the cells in their own place"""
        self._steady = bool(self._home.any())
        self._moved = (0, 0, 0)
        """cells from there"""
        self.bulk = np.asarray(parameters.inflow_velocity, np.float64)
        self._amplitude = parameters.inflow_fluctuation
        self._per_side = max(1, round(per_cell ** (1.0 / 3.0)))
        self.particle_spacing = grid.spacing / self._per_side
        """m"""
        self.shift = np.zeros(3)
        """m, by which the emission pattern has travelled"""
        self.emissions = tuple(Emission(e, walls, self.particle_spacing) for e in self.supply.emitters)
        self.running = tuple(e for e in self.emissions if e.emitter.on(0.0))
        """emissions that are on"""
        self._profile, self._gain, self._offset = profile, 0.0, self.bulk
        if not self._steady:
            return
        index = np.argwhere(self._home)
        centers = grid.low + (index + 0.5) * grid.spacing
        if profile is not None:
            mean = sample_faces(profile, grid, centers).mean(axis=0, dtype=np.float64)
            size = float(np.linalg.norm(mean))
            self._gain = float(np.linalg.norm(self.bulk)) / size if size > 1e-6 else 0.0
            self._offset = self.bulk - self._gain * mean
        extent = float((np.ptp(index, axis=0) + 1).max()) * grid.spacing
        rng = np.random.default_rng(seed)
        self._fluctuation = random_fluctuation(extent, 4 * grid.spacing, self.bulk, self._amplitude, rng)
        self._lay()
        self._go_along(0.0)

    def _lay(self) -> None:
        """Find its cells, and their faces and places for particles, where it stands now."""
        walls, grid = self._walls, self._walls.grid
        self._cells = _shifted(self._home, self._moved)
        index = np.argwhere(self._cells)
        self._low, self._high = index.min(axis=0), index.max(axis=0) + 1
        self._beside = ndimage.binary_dilation(self._cells, np.ones((3, 3, 3), bool))
        self._numbers = self._lattice_of_cells(index - self._low)
        self._faces, self._face_points = [], []
        for axis, (touched, opening) in enumerate(zip(touching_faces(self._cells), walls.openings)):
            touched &= opening > 0
            self._faces.append(np.argwhere(touched))
            self._face_points.append(grid.faces(axis)[touched])
        self._face_means = [self._mean(points) for points in self._face_points]

    @property
    def steady(self) -> SteadyInflow | None:
        """What the velocity of INFLOW cells is made of; None without such cells."""
        if not self._steady:
            return None
        return SteadyInflow(
            self._offset, self._profile, self._gain, self._amplitude, self._fluctuation, tuple(self._faces),
            tuple(self._face_points),
        )  # fmt: skip

    @property
    def moves(self) -> bool:
        """Whether INFLOW cells go along a path."""
        return self._steady and self.supply.path is not None

    @property
    def comes_and_goes(self) -> bool:
        """Whether cells are inflow now that the walls do not have as such."""
        return bool(self.running) or self.moves

    @property
    def has_cells(self) -> bool:
        """Whether there are INFLOW cells."""
        return self._steady

    @property
    def active(self) -> bool:
        """Whether anything flows in now."""
        return self._steady or bool(self.running)

    @property
    def cell_range(self) -> tuple[np.ndarray, np.ndarray]:
        """Cells (low, high exclusive) that hold all cells with a prescribed velocity."""
        lows = [self._low] if self._steady else []
        highs = [self._high] if self._steady else []
        for e in self.running:
            if len(e.cells):
                lows.append(e.cells.min(axis=0))
                highs.append(e.cells.max(axis=0) + 1)
        if not lows:  # emitters thinner than a cell: their particles say where they are
            return np.array(self._walls.grid.shape), np.zeros(3, int)
        return np.min(lows, axis=0), np.max(highs, axis=0)

    def switch(self, time: float) -> bool:
        """Turn emitters on and off, and move the inlet, as due at a time (s); whether that changed anything."""
        running = tuple(e for e in self.emissions if e.emitter.on(time))
        changed = running != self.running
        self.running = running
        return self._go_along(time) or changed

    def _go_along(self, time: float) -> bool:
        """Stand where the path has it at a time (s), unless that is beyond the box; whether that is another place."""
        if self.supply.path is None or not self._steady:
            return False
        moved = self.supply.path.at(time)
        if moved == self._moved or not _shifted(self._home, moved).any():
            return False
        self._moved = moved
        self._lay()
        return True

    def emitter_cells(self, shape: tuple[int, ...], first: tuple[int, int, int] = (0, 0, 0)) -> np.ndarray:
        """bool, of `shape`, from cell `first` on: cells of the emitters that are on, and of an inlet that moves."""
        out = np.zeros(shape, bool)
        if self.moves:
            out[tuple((np.argwhere(self._cells) - first).T)] = True
        for e in self.running:
            out[tuple((e.cells - first).T)] = True
        return out

    def carry(self, positions: np.ndarray, velocities: np.ndarray, affine: np.ndarray, time: float) -> None:
        """Particles in INFLOW cells and in emitters move as prescribed, in place."""
        if self._steady:
            inside = np.flatnonzero(self.inside(positions))
            velocities[inside] = self.velocity(positions[inside], time)
            affine[inside] = 0.0
        for e in self.running:
            inside = e.inside(positions)
            velocities[inside], affine[inside] = e.velocity, 0.0

    def velocity(self, points: Float[np.ndarray, "n 3"], time: float) -> Float[np.ndarray, "n 3"]:
        """Prescribed velocity of INFLOW cells, m/s: the profile, scaled and shifted so that its mean over them is the
        bulk velocity, plus the fluctuation; all of it times the schedule's factor."""
        return self._varied(self._mean(points), points, time)

    def _mean(self, points: np.ndarray) -> np.ndarray:
        """Velocity [n,3] without the fluctuation and the schedule, m/s."""
        out = np.broadcast_to(self._offset, (len(points), 3)).copy()
        if self._profile is not None and self._gain > 0:
            if any(self._moved):
                points = points - np.multiply(self._moved, self._walls.grid.spacing)
            out += self._gain * sample_faces(self._profile, self._walls.grid, points)
        return out

    def _varied(self, mean: np.ndarray, points: np.ndarray, time: float) -> np.ndarray:
        """`_mean` of the points at a time (s), with what changes."""
        out = mean + self._amplitude * self._fluctuation(points, time) if self._amplitude > 0 else mean
        return out * self.supply.schedule.factor(time)

    def impose(self, velocity: FaceVelocity, time: float, first: tuple[int, int, int] = (0, 0, 0)) -> FaceVelocity:
        """The velocity with the prescribed faces set; `first` is the cell at which the arrays begin."""
        if not self.active:
            return velocity
        out = [component.copy() for component in velocity.components]
        if self._steady:
            for axis, new in enumerate(out):
                found = self._varied(self._face_means[axis], self._face_points[axis], time)
                new[tuple((self._faces[axis] - first).T)] = found[:, axis]
        for e in self.running:
            e.impose(out, first)
        return FaceVelocity(*out)

    def face_masks(
        self, shapes: tuple[tuple[int, ...], ...], first: tuple[int, int, int] = (0, 0, 0)
    ) -> list[np.ndarray]:
        """bool per component, in arrays of `shapes` that begin at cell `first`: faces with a prescribed velocity."""
        masks = [np.zeros(shape, bool) for shape in shapes]
        if self._steady:
            for mask, faces in zip(masks, self._faces):
                mask[tuple((faces - first).T)] = True
        for e in self.running:
            e.mark(masks, first)
        return masks

    def inside(self, positions: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Particles in INFLOW cells."""
        return self._within(positions, self._cells, 0)

    def beside(self, positions: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Particles in INFLOW cells and in those next to them: the ones that say whether a place lacks a particle."""
        return self._within(positions, self._beside, 1)

    def _within(self, positions: np.ndarray, cells: Bool[np.ndarray, "nx ny nz"], margin: int) -> np.ndarray:
        """Which positions lie in some of the cells, all of which are at most a margin (cells) beside the INFLOW cells.

        What is beyond the sides of the box belongs to its last cells.
        """
        grid, out = self._walls.grid, np.empty(len(positions), bool)
        low, high = (grid.low + end * grid.spacing for end in (self._low - margin, self._high + margin))
        _within_kernel(np.ascontiguousarray(positions), (low, high), (grid.low, grid.spacing), cells, out)
        return out

    def holds(self, positions: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Whether a particle may be put there: in INFLOW cells, clear of walls."""
        if not self._steady:
            return np.zeros(len(positions), bool)
        out, grid = self.inside(positions), self._walls.grid
        out[out] = sample_nodes(self._walls.signed_distance, grid, positions[out]) > CLEARANCE * grid.spacing
        return out

    def travel(self, dt: float, time: float = 0.0) -> None:
        """Move the emission pattern along with the bulk flow from `time` on, so that new particles continue the old
        lattice."""
        self.shift = self.shift + self.bulk * (dt * self.supply.schedule.travelled(time, dt))

    @property
    def lattice(self) -> InletLattice:
        """The places of particles now. There are INFLOW cells.

        Each column along the flow has a phase of its own, which travels with it: particles arrive one by one and not
        layer by layer.
        """
        s, grid = self.particle_spacing, self._walls.grid
        turns = np.floor(self.shift / s)
        start = grid.low + self._low * grid.spacing - 0.5 * s + self.shift - turns * s
        along = int(np.abs(self.bulk).argmax())
        # shifts and phases are up to a spacing long: a layer more at the end, and one at the beginning of each column
        first = triple(-1 if a == along else 0 for a in range(3))
        ends = (self._high - self._low) * self._per_side + 1
        counts = triple(int(n) - f for n, f in zip(ends, first))
        # every lattice point outside the solid: a wider berth would emit less than what flows through the opening
        return InletLattice(start, s, first, counts, along, turns, 0.8 * s, CLEARANCE * grid.spacing)

    def _lattice_of_cells(self, index: Int[np.ndarray, "m 3"]) -> Int[np.ndarray, "n 3"]:
        """Numbers, in their order, of the places that are in one of the cells (counted from the first one on) at some
        time: the lattice fills the box of all INFLOW cells, and along a rim that runs askew few of its places matter.

        Along its axis a place lies up to a spacing and a half beyond half a spacing below its number, beside it half a
        spacing to either side.
        """
        own, per = self.lattice, self._per_side
        wanted = np.zeros(own.counts, bool)
        first = index * per - own.first
        reach = [range(-1 if a == own.along else 0, per + 1) for a in range(3)]
        for step in np.stack(np.meshgrid(*reach, indexing="ij"), axis=-1).reshape(-1, 3):
            wanted[tuple((first + step).T)] = True
        return np.argwhere(wanted) + own.first

    def _places(self) -> Float[np.ndarray, "n 3"]:
        """Points of the lattice that may lie in INFLOW cells."""
        own, lattice = self.lattice, self._numbers
        beside = [a for a in range(3) if a != own.along]
        points = own.start + own.spacing * lattice
        points[:, own.along] += own.spacing * np.mod((lattice - own.turns)[:, beside] @ PHASES, 1.0)
        return points

    def missing(self, positions: Float[np.ndarray, "n 3"], rng: np.random.Generator) -> Float[np.ndarray, "m 3"]:
        """Places in INFLOW cells that lack a particle: points of the travelling lattice farther than 0.8 of its
        spacing from every particle, slightly jittered."""
        if not self._steady:
            return np.zeros((0, 3), np.float32)
        grid, own = self._walls.grid, self.lattice
        candidates = self._places()
        candidates = candidates[grid.contains(candidates)]
        candidates = candidates[self.inside(candidates)]
        clear = own.clear
        candidates = candidates[sample_nodes(self._walls.signed_distance, grid, candidates) > clear]
        near = positions[self.beside(positions)]  # what is as near as that to a place
        if len(near) and len(candidates):
            distance, _ = cKDTree(near).query(candidates, distance_upper_bound=own.reach)
            candidates = candidates[~np.isfinite(distance)]
        return self.jittered(candidates, rng)

    def jittered(self, candidates: Float[np.ndarray, "m 3"], rng: np.random.Generator) -> Float[np.ndarray, "m 3"]:
        """Places of the lattice, slightly jittered where that leaves them in the inlet."""
        grid, clear = self._walls.grid, CLEARANCE * self._walls.grid.spacing
        jittered = candidates + rng.uniform(-0.1, 0.1, candidates.shape) * self.particle_spacing
        astray = ~self.inside(jittered) | (sample_nodes(self._walls.signed_distance, grid, jittered) <= clear)
        jittered[astray] = candidates[astray]
        return np.clip(jittered, grid.low + clear, grid.high - clear).astype(np.float32)


@shared(lambda positions, *_: (0, len(positions)), least=2000)
def _within_kernel(begin, end, positions, corners, grid, cells, out):
    """Whether positions lie between two corners, ends included, and in one of the cells."""
    (low, high), (origin, spacing), at = corners, grid, np.empty(3, np.int64)
    for p in range(begin, end):
        there = True
        for axis in range(3):
            x = np.float64(positions[p, axis])
            if not (x >= low[axis] and x <= high[axis]):
                there = False
                break
            cell = np.int64(np.floor((x - origin[axis]) / spacing))
            at[axis] = min(max(cell, 0), cells.shape[axis] - 1)
        out[p] = there and cells[at[0], at[1], at[2]]
