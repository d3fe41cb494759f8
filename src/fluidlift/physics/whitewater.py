"""White water: spray, foam and bubbles as particles that a liquid makes and carries, and that do not act on it.

After Ihmsen, Akinci, Akinci, Teschner 2012 ("Unified spray, foam and air bubbles for particle-based fluids"), on the
grid as FLIP Fluids has it. Where the surface traps air (I_ta), or a crest overtakes what is behind it (I_wc), and the
liquid is fast (I_k),

    n = I_k (k_ta I_ta + k_wc I_wc) dt

particles are born per full cell. Each I is a potential between a least and a most, as a share of 0 to 1. What is born
is told by how much liquid is around it: spray flies, foam goes with the surface, bubbles rise.

Two potentials differ from the source. Its trapped air, |v| (1 - v . x / |v| |x|), also counts shear and rotation: a
bucket that turns as a whole would foam. Here air is trapped where neighbours close in on each other, and only within
`DEEP` of the surface. Its crests count any convex piece that moves along its normal: a drop in free fall would. Here
the velocity is that relative to the liquid around. Both are the same for any observer who moves evenly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from fluidlift.errors import InputRejected, require
from fluidlift.numerics.sampling import sample_centers, sample_faces, sample_nodes
from fluidlift.physics import whitewater_kernels
from fluidlift.physics.active_region import inner_grid, region_around
from fluidlift.physics.boundaries import cell_capacity, extrapolate
from fluidlift.physics.free_surface import SolidShares, liquid_surface, solid_shares
from fluidlift.physics.transfer import deposit_to_cells, particles_to_grid, sort_by_cell
from fluidlift.types import CellType, FaceVelocity, Grid, Particles, Terrain

SPRAY, FOAM, BUBBLE = 0, 1, 2
"""kinds"""

REACH = 3.0
"""cells around a cell whose motion counts: a breaking front is two or three cells wide (FLIP Fluids takes 5^3 cells)"""
DEEP = 1.25
"""cells below the surface from which air is trapped; deeper there is none to trap"""
TOWARDS = 0.6
"""cosine between a crest's motion and its normal from which it overtakes what is behind (Ihmsen et al. 2012)"""
THIN, DENSE = 0.1, 0.9
"""shares of liquid around a place below which it is spray and above which a bubble: a level surface has them 0.7 cells
above and below it. The source counts neighbours instead (6 and 20 of some 40)"""
CARRIED = 4
"""layers of cells over which the liquid's velocity is continued into the air, for foam on its surface"""
LIFE = (0.4, 2.5)
"""s that what is born with the least and the most energy lives: foam patches on fresh water decay with 2.5 s
(Monahan and Zietlow 1969), bubbles of some millimetres burst within tenths of a second"""
TERMINAL = 8.0
"""m/s, at which a drop of 3 mm falls (Gunn and Kinzer 1949): drag with the time v / g, linear"""
RISE = 0.23
"""m/s, at which bubbles of 1 to 10 mm rise (Clift, Grace, Weber 1978)"""
ADDED = 2.0
"""times gravity with which a bubble sets out: its own mass is nothing, that of the water that goes with it half of its
volume's"""
ACROSS = 0.5
"""cells, radius of the disc around a particle's path in which white water is born: half of its own spacing, twice"""
PULL = 0.25
"""cells by which foam comes to the surface in a step at most"""
FASTEST = 8
"""pieces in which a step is gone at most, none longer than a cell where these suffice"""
MOST = 50_000
"""particles of white water at once: as many as a viewer shows beside 100 000 splats at 10 frames per second"""

Inside = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class PotentialRange:
    """What counts of a potential: nothing below `least`, all above `most`."""

    least: float
    most: float

    def share(self, values: np.ndarray, least: np.ndarray | float = 0.0) -> np.ndarray:
        """0 to 1; `least` lifts the range as a whole where it is higher."""
        low = np.maximum(self.least, least)
        return np.clip((values - low) / max(self.most - self.least, 1e-12), 0.0, 1.0)


@dataclass(frozen=True)
class SeenBirths:
    """Births where a clip shows foam, in columns of a grid, whatever the potentials are."""

    grid: Grid
    rate: Float[np.ndarray, "nx ny"]
    """1/s, in the whole column, in the flow as lifted"""
    energy: Float[np.ndarray, "nx ny"]
    """m^2/s^2, at the surface, from which on it has all of that; slower water has as much less as it has energy less"""
    there: Float[np.ndarray, "nx ny"] | None = None
    """particles in the whole column in the steady state, of any age: they are there from the first step on. None: it
    begins bare"""
    breaking: Float[np.ndarray, "nx ny"] | None = None
    """1/s, of the foam in each column that ends before its age: where a clip's foam breaks up. None: none does"""

    def in_cells(self, state: LiquidState) -> Float[np.ndarray, "nx ny nz"]:
        """Births per second, in cells of the state, were they full: in the layer of a cell under the surface."""
        rate, energy = _in_columns((self.grid, self.rate, self.energy), state.grid)
        return self._spread(rate, np.clip(state.energy / np.maximum(energy, 1e-12), 0.0, 1.0), state)

    def at_first(self, state: LiquidState) -> Float[np.ndarray, "nx ny nz"]:
        """Particles that are there already, in cells of the state, were they full."""
        if self.there is None:
            return np.zeros(state.grid.shape)
        there, _ = _in_columns((self.grid, self.there, self.energy), state.grid)
        return self._spread(there, 1.0, state)

    def _spread(self, columns: np.ndarray, share: np.ndarray | float, state: LiquidState) -> np.ndarray:
        layer = (state.distance < 0) & (state.distance > -state.grid.spacing)
        filled = (state.amount * layer).sum(axis=2, keepdims=True)
        # a film of water is no column: at least a quarter of a cell
        return np.where(layer, columns * share / np.maximum(filled, 0.25), 0.0)


@dataclass(frozen=True)
class WhitewaterLaw:
    """How much white water a liquid makes."""

    trapped: PotentialRange
    """m/s, of closing"""
    crest: PotentialRange
    """1/s: curvature times the speed along the normal"""
    energy: PotentialRange
    """m^2/s^2: of motion, per mass"""
    trapped_rate: float
    """1/s, births in a full cell whose shares are 1"""
    crest_rate: float
    """1/s"""
    most: int = MOST
    """particles at once"""
    known: tuple[Grid, Float[np.ndarray, "nx ny"], Float[np.ndarray, "nx ny"]] | None = None
    """trapped (m/s) and crest (1/s) of each column up to which no white water is made: what is shown there already"""
    seen: SeenBirths | None = None
    """beside those of the potentials"""

    def births(self, state: LiquidState) -> Float[np.ndarray, "nx ny nz"]:
        """Per second, in cells of the state, were they full."""
        floors = (0.0, 0.0) if self.known is None else _in_columns(self.known, state.grid)
        made = self.trapped_rate * self.trapped.share(state.trapped, floors[0])
        made += self.crest_rate * self.crest.share(state.crest, floors[1])
        made = made * self.energy.share(state.energy)
        return made if self.seen is None else made + self.seen.in_cells(state)


def _in_columns(
    known: tuple[Grid, np.ndarray, np.ndarray], grid: Grid
) -> tuple[Float[np.ndarray, "nx ny 1"], Float[np.ndarray, "nx ny 1"]]:
    """What is known per column of another grid, in columns of a grid; 0 beside it."""
    other, *fields = known
    middles = grid.centers()[:, :, 0, :2]
    at = np.floor((middles - other.low[:2]) / other.spacing).astype(np.int64)
    there = ((at >= 0) & (at < other.shape[:2])).all(axis=-1)
    at = np.clip(at, 0, np.array(other.shape[:2]) - 1)
    first, second = (np.where(there, f[at[..., 0], at[..., 1]], 0.0)[..., None] for f in fields)
    return first, second


@dataclass(frozen=True)
class Ground:
    """What a liquid lies on: it does not change."""

    terrain: Terrain
    solids: SolidShares
    capacity: Float[np.ndarray, "nx ny nz"]
    outlet: Bool[np.ndarray, "nx ny nz"]

    @classmethod
    def of(cls, terrain: Terrain, cell_types: UInt8[np.ndarray, "nx ny nz"]) -> Ground:
        """Of a terrain whose OUTFLOW cells white water leaves through."""
        distance = terrain.signed_distance
        return cls(
            terrain, solid_shares(distance, terrain.grid), cell_capacity(distance, terrain.grid),
            cell_types == CellType.OUTFLOW,
        )  # fmt: skip


@dataclass(frozen=True)
class LiquidState:
    """What white water knows of the liquid at an instant, in a box of cells around it."""

    grid: Grid
    velocity: FaceVelocity
    """m/s, continued into the air"""
    distance: Float[np.ndarray, "nx ny nz"]
    """m to the surface, negative inside, cut at 1.5 cells"""
    amount: Float[np.ndarray, "nx ny nz"]
    """share of liquid around a cell's middle, of what there is room for"""
    trapped: Float[np.ndarray, "nx ny nz"]
    """m/s at which the liquid around closes in, at the surface"""
    crest: Float[np.ndarray, "nx ny nz"]
    """1/s: curvature times the speed, relative to the liquid around, along the normal, where crests overtake"""
    energy: Float[np.ndarray, "nx ny nz"]
    """m^2/s^2, half of the speed squared"""

    @classmethod
    def of(cls, particles: Particles, ground: Ground, density: float) -> LiquidState:
        """Of one or more particles inside the box, with masses (kg) at a density (kg/m^3)."""
        require(len(particles) > 0, "no particles", "one or more")
        box = region_around(particles.positions, ground.terrain.grid)
        grid, solids = inner_grid(ground.terrain.grid, box), ground.solids.inside(box)
        order = sort_by_cell(particles.positions, grid)
        wet = (np.diff(order.start) > 0).reshape(grid.shape)
        volumes = (particles.masses / density).astype(np.float32)
        surface = liquid_surface(particles.positions, volumes, grid, order, solids, curved=True)
        assert surface.curvature is not None
        velocity, masses = particles_to_grid(particles, grid, order)
        x, y, z = (m > 0 for m in masses)
        velocity = extrapolate(velocity, (x, y, z), CARRIED)
        room = grid.spacing**3 * np.maximum(ground.capacity[box], 0.25)
        amount = deposit_to_cells(particles.positions, volumes, grid, order) / room
        asked = wet & (surface.distance > -DEEP * grid.spacing)
        moves = _at_middles(velocity)
        trapped, apart = relative_motion(asked, wet, moves)
        crest = _crests(surface.distance, surface.curvature, apart, grid.spacing)
        return cls(
            grid, velocity, surface.distance, amount, trapped, np.where(asked, crest, 0.0),
            0.5 * np.einsum("...i,...i->...", moves, moves),
        )  # fmt: skip


def _at_middles(velocity: FaceVelocity) -> Float[np.ndarray, "nx ny nz 3"]:
    """m/s at cell centres: exact for a linear field."""
    u, v, w = velocity.components
    middles = 0.5 * (u[1:] + u[:-1]), 0.5 * (v[:, 1:] + v[:, :-1]), 0.5 * (w[:, :, 1:] + w[:, :, :-1])
    return np.ascontiguousarray(np.stack(middles, axis=-1), np.float32)


def neighbours() -> Float[np.ndarray, "m 4"]:
    """Offsets (cells) within `REACH`, and their weights 1 - |x| / `REACH`."""
    n = int(REACH)
    cells = np.stack(np.meshgrid(*[np.arange(-n, n + 1.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    far = np.linalg.norm(cells, axis=1)
    keep = (far > 0) & (far < REACH)
    return np.concatenate([cells[keep], 1.0 - far[keep, None] / REACH], axis=1)


def relative_motion(
    asked: Bool[np.ndarray, "nx ny nz"], wet: Bool[np.ndarray, "nx ny nz"], velocity: Float[np.ndarray, "nx ny nz 3"]
) -> tuple[Float[np.ndarray, "nx ny nz"], Float[np.ndarray, "nx ny nz 3"]]:
    """The mean speed (m/s) at which wet neighbours close in on the cells that are asked for, and the velocity of those
    cells relative to them (m/s); 0 elsewhere."""
    closing, apart = np.zeros(wet.shape), np.zeros((*wet.shape, 3))
    whitewater_kernels.relative_motion(asked, wet, velocity, neighbours(), closing, apart)
    return closing, apart


def _normals(distance: np.ndarray) -> Float[np.ndarray, "nx ny nz 3"]:
    """Of the surface, out of the liquid; 0 where there is none near."""
    slope = np.stack([*np.gradient(distance.astype(np.float64))], axis=-1)
    size = np.linalg.norm(slope, axis=-1, keepdims=True)
    return np.where(size > 1e-9, slope / np.maximum(size, 1e-9), 0.0)


def _crests(distance: np.ndarray, curvature: np.ndarray, apart: np.ndarray, spacing: float) -> np.ndarray:
    """1/s: convex curvature times the relative speed along the normal, where that is most of it."""
    if min(distance.shape) < 2:
        return np.zeros(distance.shape)
    along = np.einsum("...i,...i->...", _normals(distance), apart)
    speed = np.sqrt(np.einsum("...i,...i->...", apart, apart))
    bent = np.clip(curvature, 0.0, 1.0 / spacing)
    return np.where(along >= TOWARDS * np.maximum(speed, 1e-9), bent * along, 0.0)


@dataclass
class Whitewater:
    """The particles of white water.

    Args:
        ground: what the liquid lies on.
        law: how much of it is made.
        gravity: m/s^2.
        density: kg/m^3 of the liquid.
        seed: of births.
    """

    ground: Ground
    law: WhitewaterLaw
    gravity: tuple[float, float, float]
    density: float
    seed: int = 0
    positions: Float[np.ndarray, "n 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    """m"""
    velocities: Float[np.ndarray, "n 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    """m/s"""
    lives: Float[np.ndarray, " n"] = field(default_factory=lambda: np.zeros(0))
    """s that are left"""
    kinds: UInt8[np.ndarray, " n"] = field(default_factory=lambda: np.zeros(0, np.uint8))
    ids: Int[np.ndarray, " n"] = field(default_factory=lambda: np.zeros(0, np.int64))
    next_id: int = 0
    steps: int = 0
    thinned: bool = False
    """whether there were more than the law allows, since the beginning"""

    def __len__(self) -> int:
        return len(self.ids)

    def advance(self, particles: Particles, interval: float, inside: Inside | None = None) -> LiquidState | None:
        """Go on for an interval (s), at whose end the liquid's particles are as given.

        Args:
            particles: of the liquid, in the order of their ids.
            interval: s.
            inside: (points [n,3]) -> whether they are in a body, where white water ends.

        Returns:
            The liquid as it was seen; None where there is none.
        """
        require(interval > 0, f"interval {interval}", "positive seconds")
        self.steps += 1
        if not len(particles):
            self._fly(interval)
            self._end(inside)
            return None
        state = LiquidState.of(particles, self.ground, self.density)
        self._move(state, interval)
        self._bear(state, particles, interval)
        self.kinds = told(state, self.positions)
        self._end(inside)
        self._break(interval)
        self._thin()
        return state

    def _move(self, state: LiquidState, interval: float) -> None:
        if not len(self):
            return
        speed = float(np.sqrt(np.square(self.velocities).sum(axis=1).max(initial=0.0)))
        pieces = int(np.clip(np.ceil(speed * interval / state.grid.spacing), 1, FASTEST))
        dt = interval / pieces
        for _ in range(pieces):
            kinds = self.kinds = told(state, self.positions)
            for kind, way in ((SPRAY, self._flown), (FOAM, self._carried), (BUBBLE, self._risen)):
                own = np.flatnonzero(kinds == kind)
                if len(own):
                    self.positions[own], self.velocities[own] = way(
                        state, self.positions[own], self.velocities[own], dt
                    )
        self.lives = self.lives - interval

    def _fly(self, interval: float) -> None:
        """Go on where there is no liquid."""
        self.kinds = np.full(len(self), SPRAY, np.uint8)
        self.positions, self.velocities = self._flown(None, self.positions, self.velocities, interval)
        self.lives = self.lives - interval

    def _flown(self, state: LiquidState | None, x: np.ndarray, v: np.ndarray, dt: float) -> tuple[np.ndarray, ...]:
        """Spray: free fall with linear drag, exactly."""
        g = np.asarray(self.gravity, np.float64)
        return fallen(x, v, g, TERMINAL / max(float(np.linalg.norm(g)), 1e-12), dt)

    def _carried(self, state: LiquidState, x: np.ndarray, v: np.ndarray, dt: float) -> tuple[np.ndarray, ...]:
        """Foam: with the liquid (midpoint rule), kept to its surface."""
        middle = x + 0.5 * dt * sample_faces(state.velocity, state.grid, x)
        v = sample_faces(state.velocity, state.grid, middle)
        moved = x + dt * v
        h = state.grid.spacing
        off = sample_centers(state.distance, state.grid, moved)
        normal = sample_centers(_normals(state.distance), state.grid, moved)
        # beyond 1.5 cells distances are cut: thin sheets have none
        step = np.where(np.abs(off) < 1.4 * h, np.clip(off, -PULL * h, PULL * h), 0.0)
        return moved - step[:, None] * normal, v

    def _risen(self, state: LiquidState, x: np.ndarray, v: np.ndarray, dt: float) -> tuple[np.ndarray, ...]:
        """Bubbles: drag towards the liquid's velocity, and buoyancy; both exactly over the step."""
        g = np.asarray(self.gravity, np.float64)
        size = float(np.linalg.norm(g))
        flow = sample_faces(state.velocity, state.grid, x)
        if size < 1e-12:
            return x + dt * flow, flow
        moved, speed = fallen(x, v - flow, -ADDED * g, RISE / (ADDED * size), dt)
        return moved + dt * flow, speed + flow

    def _bear(self, state: LiquidState, particles: Particles, interval: float) -> None:
        """Born in a disc around the ways that the liquid's particles have gone."""
        rng, h = np.random.default_rng([self.seed, self.steps]), state.grid.spacing
        cell = np.clip(state.grid.cell_of(particles.positions), 0, np.array(state.grid.shape) - 1)
        at = tuple(cell.T)
        full = particles.masses.astype(np.float64) / (self.density * h**3)
        wanted, older = self.law.births(state)[at] * full * interval, np.zeros(0)
        draw = rng.random(len(wanted))
        seen = self.law.seen
        if self.steps == 1 and seen is not None and seen.there is not None:  # what the film shows has begun before it
            older = seen.at_first(state)[at] * full
        many = float(wanted.sum() + older.sum())
        if many > self.law.most:
            wanted, older, self.thinned = wanted * (self.law.most / many), older * (self.law.most / many), True
        count = np.floor(wanted + draw).astype(np.int64)
        parent, fresh = np.repeat(np.arange(len(count)), count), int(count.sum())
        if len(older):
            more = np.floor(older + rng.random(len(older))).astype(np.int64)
            parent = np.concatenate([parent, np.repeat(np.arange(len(more)), more)])
        if not len(parent):
            return
        n, cells = len(parent), tuple(c[parent] for c in at)
        back, out, turn = rng.random(n), np.sqrt(rng.random(n)), 2.0 * np.pi * rng.random(n)
        v = particles.velocities[parent].astype(np.float64)
        first, second = _across(v)
        disc = out[:, None] * (np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * second)
        x = particles.positions[parent] - (back * interval)[:, None] * v + ACROSS * h * disc
        # what closes in is thrown out sideways
        v = v + state.trapped[cells][:, None] * disc
        least, most = LIFE
        lives = least + (most - least) * self.law.energy.share(state.energy[cells])
        lives[:fresh] -= back[:fresh] * interval
        if n > fresh:
            lives[fresh:] *= rng.random(n - fresh)  # in the steady state of any age
        self.positions, self.velocities = np.concatenate([self.positions, x]), np.concatenate([self.velocities, v])
        self.lives = np.concatenate([self.lives, lives])
        self.ids = np.concatenate([self.ids, self.next_id + np.arange(n)])
        self.next_id += n

    def _end(self, inside: Inside | None) -> None:
        """What has lived, left the box, gone through an outlet, or is in the ground or a body, is no more."""
        terrain = self.ground.terrain
        keep = (self.lives > 0) & terrain.grid.contains(self.positions)
        cell = np.clip(terrain.grid.cell_of(self.positions), 0, np.array(terrain.grid.shape) - 1)
        keep &= ~self.ground.outlet[tuple(cell.T)]
        keep &= sample_nodes(terrain.signed_distance, terrain.grid, self.positions) > 0
        if inside is not None and keep.any():
            keep[keep] = ~inside(self.positions[keep])
        self._keep(keep)

    def _break(self, interval: float) -> None:
        """Foam ends where a clip's does."""
        seen = self.law.seen
        if seen is None or seen.breaking is None or not len(self):
            return
        grid = seen.grid
        cell = np.floor((self.positions[:, :2] - grid.low[:2]) / grid.spacing).astype(np.int64)
        there = ((cell >= 0) & (cell < grid.shape[:2])).all(axis=1) & (self.kinds == FOAM)
        cell = np.clip(cell, 0, np.array(grid.shape[:2]) - 1)
        rate = np.where(there, seen.breaking[cell[:, 0], cell[:, 1]], 0.0)
        rng = np.random.default_rng([self.seed, self.steps, 1])
        self._keep(rng.random(len(self)) < np.exp(-rate * interval))

    def _thin(self) -> None:
        """Down to the most that the law allows, by a number that each id has: those that stay are the same ones."""
        if len(self) <= self.law.most:
            return
        self.thinned = True
        keep = np.zeros(len(self), bool)
        keep[np.argsort(lots(self.ids), kind="stable")[: self.law.most]] = True
        self._keep(keep)

    def _keep(self, keep: np.ndarray) -> None:
        for name in ("positions", "velocities", "lives", "kinds", "ids"):
            setattr(self, name, getattr(self, name)[keep])

    def state(self) -> dict[str, np.ndarray]:
        """All that changes, as plain arrays."""
        arrays = {name: getattr(self, name).copy() for name in ("positions", "velocities", "lives", "kinds", "ids")}
        return arrays | {"counts": np.array([self.next_id, self.steps, self.thinned], np.int64)}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Go to a state of `state`.

        Raises:
            InputRejected: something is missing, of the wrong shape or not finite; nothing has changed then.
        """
        try:
            x, v = (np.array(state[name], np.float64) for name in ("positions", "velocities"))
            lives, kinds = np.array(state["lives"], np.float64), np.array(state["kinds"], np.uint8)
            ids, counts = np.array(state["ids"], np.int64), np.array(state["counts"], np.int64)
        except (KeyError, TypeError, ValueError) as error:
            raise InputRejected(f"a state of white water that does not fit: {error}") from None
        n = len(ids)
        fits = x.shape == v.shape == (n, 3) and lives.shape == kinds.shape == (n,) and counts.shape == (3,)
        if not fits or not all(np.isfinite(a).all() for a in (x, v, lives)) or (kinds > BUBBLE).any():
            raise InputRejected("a state of white water with arrays of another shape, or not finite", "a whole one")
        if n > self.law.most:
            raise InputRejected(f"a state of {n} particles of white water", f"at most {self.law.most}")
        self.positions, self.velocities, self.lives, self.kinds, self.ids = x, v, lives, kinds, ids
        self.next_id, self.steps, self.thinned = int(counts[0]), int(counts[1]), bool(counts[2])


def told(state: LiquidState, positions: Float[np.ndarray, "n 3"]) -> UInt8[np.ndarray, " n"]:
    """The kind of what is at some places, by how much liquid is around them; beside the box there is none."""
    amount = sample_centers(state.amount, state.grid, positions)
    amount = np.where(state.grid.contains(positions), amount, 0.0)
    kinds = np.full(len(positions), FOAM, np.uint8)
    kinds[amount < THIN], kinds[amount > DENSE] = SPRAY, BUBBLE
    return kinds


def fallen(
    x: Float[np.ndarray, "n 3"], v: Float[np.ndarray, "n 3"], push: Float[np.ndarray, "3"], slow: float, dt: float
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Places and velocities after dt (s) under a steady acceleration (m/s^2) and a drag v / `slow` (s): exact."""
    last = slow * push
    # in series where the drag has hardly begun: the differences would be rounding
    share = -np.expm1(-dt / slow)
    lost = dt - slow * share if dt > 1e-3 * slow else 0.5 * dt * dt / slow * (1.0 - dt / (3.0 * slow))
    return x + (dt - lost) * v + lost * slow * push, v + share * (last - v)


def _across(v: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Two unit vectors that stand upright on velocities and on each other."""
    size = np.linalg.norm(v, axis=1, keepdims=True)
    along = np.where(size > 1e-9, v / np.maximum(size, 1e-9), [1.0, 0.0, 0.0])
    other = np.eye(3)[np.abs(along).argmin(axis=1)]
    first = np.cross(along, other)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(along, first)


def lots(ids: Int[np.ndarray, " n"]) -> np.ndarray:
    """u64 [n]: a number for each id that looks drawn by lot (SplitMix64; Steele, Lea, Flood 2014)."""
    z = ids.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))
