"""The white water of a scene: how much of it its clip asks for, and its splats, frame by frame.

What is bright and grey in the clip's film is foam (`look.whitewater_splats`). The scene is simulated as it was lifted
for a second, and the limits of the potentials are put where as much of its surface lies above them as the film shows
foam. In the edited scene white water is born where a place exceeds them, and all that the place had in the scene as
lifted: that is in the film, which the surface plays. Where it is asked for everywhere, what the film shows is born as
well, at its places (`scene.filmed_foam`).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage

from fluidlift.errors import FluidliftError, InputRejected
from fluidlift.io.footage_file import read_footage
from fluidlift.look.whitewater_splats import FADING, FilmedFoam, whitewater_splats
from fluidlift.messages import Notice
from fluidlift.physics.whitewater import (
    FOAM,
    Ground,
    LiquidState,
    PotentialRange,
    SeenBirths,
    Whitewater,
    WhitewaterLaw,
)
from fluidlift.scene.build import Scene
from fluidlift.scene.filmed_foam import SMOOTH, births_in_columns
from fluidlift.scene.simulator import simulator_of
from fluidlift.scene.whitewater_law import (
    BY_ENERGY,
    COVERS,
    SurfaceRecord,
    lasting,
    law_estimates,
    law_of,
    life_of,
)
from fluidlift.types import Estimate, Gaussians, Particles

SECONDS = 1.0
"""s over which the scene as lifted is looked at"""
SETTLED = 0.2
"""s after which that begins: the first frames have the jerk of a body that is let go"""
SPREAD = 1
"""cells around a column whose potentials count as its own: waves are not in the same place each time"""
FASTEST = 5.0
"""1/s, with which foam breaks up at most where the film's does: bubbles burst within tenths of a second"""
KEPT = 0.3
"""s in which foam that is short of the film's comes back, while that is measured: a tenth of its life, so that it stays
near, and longer than a frame, so that it does not flicker"""
IDS_FROM = 2**29
"""half of the ids of white water are above it, so that those of the particles and of the skin are others, and a loop
can add as many again within 32 bits"""


class Columns(NamedTuple):
    """The surface of a frame by columns of the grid."""

    wet: np.ndarray
    """bool [nx,ny]"""
    trapped: np.ndarray
    """m/s, the most in the column"""
    crest: np.ndarray
    """1/s"""
    energy: np.ndarray
    """m^2/s^2, where the most is trapped"""
    velocity: np.ndarray
    """[nx,ny,2], m/s"""
    height: np.ndarray
    """m, of the middle of the highest cell with liquid; not a number where there is none"""


@dataclass(frozen=True)
class MeasuredWhitewater:
    """What a scene as lifted, and its film, say about its white water."""

    trapped: PotentialRange
    crest: PotentialRange
    energy: PotentialRange
    rate: float
    """1/s"""
    share: float
    """of foam in the film; 0: none"""
    color: tuple[float, float, float]
    """sRGB"""
    trapped_known: Float[np.ndarray, "2 nx ny"]
    """m/s, the most in each column, before `SETTLED` and after"""
    crest_known: Float[np.ndarray, "2 nx ny"]
    """1/s"""
    filmed: Float[np.ndarray, "nx ny"]
    """1/s, births in each column by which the scene as lifted shows the film's foam"""
    energy_known: Float[np.ndarray, "nx ny"]
    """m^2/s^2, the least in each column in all frames"""
    there: Float[np.ndarray, "nx ny"]
    """particles in each column that show the film's foam, of any age, so some of them faded"""
    breaking: Float[np.ndarray, "nx ny"]
    """1/s, of the foam in each column that ends before its age"""
    estimates: dict[str, Estimate] = field(default_factory=dict)
    """limits and rate, and how sure they are"""

    def law(self, scene: Scene, amount: float, everywhere: bool = False, *, settled: bool = True) -> WhitewaterLaw:
        """For a scene edited from `scene`, with `amount` times as much; everywhere: also where the film shows it.

        A body that is let go jerks, and would foam all over: until it has `settled` what counts is more than that.
        """
        rate, grid = amount * self.rate, scene.terrain.grid
        known = grid, self.trapped_known[int(settled)], self.crest_known[int(settled)]
        seen = (
            SeenBirths(grid, amount * self.filmed, self.energy_known, amount * self.there, self.breaking)
            if everywhere
            else None
        )
        return WhitewaterLaw(self.trapped, self.crest, self.energy, rate, rate, known=known, seen=seen)


@dataclass(frozen=True)
class Kept:
    """A measure as a stage keeps it."""

    found: MeasuredWhitewater | None


def kept_measure(scene: Scene, device: str) -> Kept:
    """`measured`, as a part of a stage."""
    return Kept(measured(scene, device))


def measured(scene: Scene, device: str = "cpu", foam: FilmedFoam | None = None) -> MeasuredWhitewater | None:
    """What a scene as lifted and its film say about white water; None where the film shows none, or there is none.

    Args:
        scene: without edits.
        device: that moves particles, "cpu" or "cuda".
        foam: of the film, or of a part of it; None: of all of it.
    """
    foam = filmed_foam(scene) if foam is None else foam
    if foam is None or foam.share == 0.0:
        return None
    watch, simulator = FlowWatch(scene, foam), simulator_of(scene, device, deform=False)
    for _ in range(watch.wanted):
        try:
            simulator.advance(scene.interval)
        except FluidliftError:  # the simulation that follows says so
            break
        watch.see(simulator.particles)
    return watch.found()


class FlowWatch:
    """A scene as lifted, looked at frame by frame as it is simulated, for `SETTLED` and `SECONDS`.

    Beside its potentials: white water that begins as the film shows it, and is born as a steady flow asks for
    (`scene.filmed_foam`) and as much more or less as it is short of the film's, or over it. So the births that keep the
    film's foam on this flow are known, with what is carried under, and covers nothing, what gathers, and what comes
    in askew.
    """

    def __init__(self, scene: Scene, foam: FilmedFoam) -> None:
        self._scene, self._foam = scene, foam
        self._settled, count = (round(s / scene.interval) for s in (SETTLED, SETTLED + SECONDS))
        self.wanted = max(count, 2)
        """frames, after the one at rest"""
        self._seen: list[Columns] = []
        self._ground = Ground.of(scene.terrain, scene.cell_types)
        self._water: Whitewater | None = None
        self._mean_height, self._mean_flow = np.zeros(0), np.zeros(0)
        self._asked: list[np.ndarray] = []
        """1/s, that foam in each column had to become more"""
        self._number = np.zeros(0)
        """of the film's in each"""

    def see(self, particles: Particles) -> None:
        """The next frame; more than are wanted, and empty ones, are not looked at."""
        if len(self._seen) < self.wanted and len(particles):
            self._seen.append(self._columns(particles))

    def found(self) -> MeasuredWhitewater | None:
        """What was seen says about white water; None where the flow did not settle."""
        if len(self._seen) <= self._settled:
            return None
        # the last births were asked for, and nobody saw what became of them
        asked = np.mean(self._asked[self._settled : -1] or self._asked[-1:], axis=0)
        filmed = np.stack(_apart(asked, self._number, self._number))
        return _fitted(self._seen, self._settled, self._foam, self._scene, filmed)

    def _columns(self, particles: Particles) -> Columns:
        scene = self._scene
        if self._water is None:
            now = columns_of(LiquidState.of(particles, self._ground, scene.parameters.density), scene)
            self._mean_height, self._mean_flow = now.height, now.velocity
        else:
            state = self._water.advance(particles, scene.interval)
            assert state is not None  # there are particles
            now, weight = columns_of(state, scene), 1.0 / (len(self._seen) + 1)
            known = np.isfinite(self._mean_height)
            higher = self._mean_height + weight * (now.height - self._mean_height)
            self._mean_height = np.where(
                known & np.isfinite(now.height), higher, np.where(known, self._mean_height, now.height)
            )
            self._mean_flow = self._mean_flow + weight * (now.velocity - self._mean_flow)
        low, high = (float(q) for q in np.quantile(now.energy[now.wet], BY_ENERGY))
        fast = PotentialRange(
            low, max(high, 1.25 * low, 1e-12)
        )  # of this frame: the jerk of the first ones is not the flow's
        life = life_of(fast.share(now.energy))
        shown = births_in_columns(
            self._foam, scene.camera, scene.terrain.grid, self._mean_height, self._mean_flow, lasting(life), COVERS
        )
        if self._water is None:
            asked, there = shown.balance, shown.number * life / lasting(life)
            floats = shown.number
        else:
            floats, there = self._floating(), None
            asked = shown.balance + (shown.number - floats) / KEPT
        births, breaking = _apart(asked, floats, shown.number)
        self._asked.append(asked)
        self._number = shown.number
        nothing = PotentialRange(0.0, 1.0)
        seen = SeenBirths(scene.terrain.grid, births, 0.0 * births, there, breaking)
        law = WhitewaterLaw(nothing, nothing, fast, 0.0, 0.0, seen=seen)
        if self._water is None:
            self._water = Whitewater(self._ground, law, scene.parameters.gravity, scene.parameters.density, scene.seed)
        self._water.law = law
        return now

    def _floating(self) -> np.ndarray:
        """[nx,ny] particles of foam in each column, those that fade by as much as they are seen; means around it."""
        water, grid = self._water, self._scene.terrain.grid
        assert water is not None
        own = water.kinds == FOAM
        cell = np.clip(grid.cell_of(water.positions[own]), 0, np.array(grid.shape) - 1)
        found = np.zeros(grid.shape[:2])
        np.add.at(found, (cell[:, 0], cell[:, 1]), np.clip(water.lives[own] / FADING, 0.0, 1.0))
        return ndimage.gaussian_filter(found, SMOOTH)


def _apart(asked: np.ndarray, floats: np.ndarray, number: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Births (1/s) and breaking (1/s, of the foam that floats) by which foam becomes more or less, as asked (1/s); none
    are born where the film has none, by its `number`."""
    births = np.where(number > 0, np.maximum(asked, 0.0), 0.0)
    return births, np.clip(-asked / np.maximum(floats, 1e-6), 0.0, FASTEST)


def filmed_foam(scene: Scene) -> FilmedFoam | None:
    """The foam of a scene's film; None where it has none that can be read (which is said elsewhere)."""
    if scene.film is None or not scene.film.is_file():
        return None
    written = scene.film.stat()
    return _foam_in(scene.film, scene.camera.size, (written.st_mtime_ns, written.st_size))


@lru_cache(maxsize=1)
def _foam_in(film: Path, size: tuple[int, int], written: tuple[int, int]) -> FilmedFoam | None:
    """As `filmed_foam`, of a file as it was `written`. The last one is kept: it is asked for before a simulation and
    after it, and takes a second or two."""
    try:
        frames, fluid, _ = read_footage(film, size)
    except InputRejected:
        return None
    return FilmedFoam.of(frames, fluid)


def columns_of(state: LiquidState, scene: Scene) -> Columns:
    """The potentials of a liquid by columns of the scene's grid."""
    grid = scene.terrain.grid
    first = np.round((state.grid.low - grid.low) / grid.spacing).astype(int)
    box = tuple(slice(a, a + n) for a, n in zip(first[:2], state.grid.shape[:2]))

    def on_grid(values: np.ndarray, beside: float | bool = 0.0) -> np.ndarray:
        whole = np.full((*grid.shape[:2], *values.shape[2:]), beside)
        whole[box] = values
        return whole

    inside = state.distance < 0
    wet = np.asarray(inside.any(axis=2))
    top = np.where(inside.any(axis=2), state.grid.shape[2] - 1 - inside[:, :, ::-1].argmax(axis=2), 0)[..., None]
    u, v, _ = state.velocity.components
    flow = [np.take_along_axis(c, top, axis=2)[..., 0] for c in (0.5 * (u[1:] + u[:-1]), 0.5 * (v[:, 1:] + v[:, :-1]))]
    energy = np.take_along_axis(state.energy, top, axis=2)[..., 0]
    height = np.where(wet, state.grid.low[2] + (top[..., 0] + 0.5) * grid.spacing, np.nan)
    return Columns(
        on_grid(wet, False), on_grid(state.trapped.max(axis=2)), on_grid(state.crest.max(axis=2)),
        on_grid(energy), on_grid(np.stack(flow, axis=-1)), on_grid(height, np.nan),
    )  # fmt: skip


def _fitted(
    frames: list[Columns], settled: int, foam: FilmedFoam, scene: Scene, filmed: np.ndarray
) -> MeasuredWhitewater:
    """Limits and rate by which as much of the surface foams as of the film's, with the births and the breaking at its
    places, `filmed` [2,nx,ny]. The flow has `settled` with that frame."""
    grid, seen = scene.terrain.grid, frames[settled:]
    reached = [
        np.stack([_reached(np.stack([getattr(c, name) for c in part])) if part else np.zeros(grid.shape[:2])
                  for part in (frames[:settled], seen)]) for name in ("trapped", "crest")
    ]  # fmt: skip
    record = SurfaceRecord(*(np.stack([getattr(c, name) for c in seen]) for name in SurfaceRecord._fields))
    law = law_of(record, foam.share, grid.spacing)
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # columns that were never wet
        height = np.nanmedian(np.stack([c.height for c in seen]), axis=0)
    life = life_of(law.energy.share(record.energy).mean(axis=0))
    lasts, flow = lasting(life), record.velocity.mean(axis=0)
    shown = births_in_columns(foam, scene.camera, grid, height, flow, lasts, COVERS)
    return MeasuredWhitewater(
        law.trapped,
        law.crest,
        law.energy,
        law.rate,
        foam.share,
        foam.color,
        *reached,
        filmed=filmed[0],
        breaking=filmed[1],
        there=shown.number * life / lasts,
        energy_known=record.energy.min(axis=0),
        estimates=law_estimates(record, foam, grid.spacing),
    )


def _reached(potential: Float[np.ndarray, "t nx ny"]) -> Float[np.ndarray, "nx ny"]:
    """The most in each column and beside it, in all frames; 0 where there are none."""
    return ndimage.maximum_filter(potential.max(axis=0, initial=0.0), 2 * SPREAD + 1)


class SceneWhitewater:
    """White water beside the splats of a scene, from its first frame on."""

    def __init__(self, scene: Scene, found: MeasuredWhitewater | None) -> None:
        """
        Args:
            scene: that is simulated.
            found: in the scene as lifted; None: its clip shows no foam.
        """
        self._scene, self._found = scene, found
        self._begin_again()

    def _begin_again(self) -> None:
        self._water: Whitewater | None = None
        scene, found = self._scene, self._found
        if found is None or scene.as_lifted is None:
            return
        law = self._law(0)
        ground = Ground.of(scene.terrain, scene.cell_types)
        self._water = Whitewater(ground, law, scene.parameters.gravity, scene.parameters.density, scene.seed)

    def _law(self, number: int) -> WhitewaterLaw:
        """At a frame."""
        scene, found = self._scene, self._found
        assert scene.as_lifted is not None and found is not None
        settled = number > round(SETTLED / scene.interval)
        return found.law(scene.as_lifted, scene.whitewater, scene.whitewater_everywhere, settled=settled)

    @property
    def particles(self) -> Whitewater | None:
        """What there is of it now; None where the clip shows no foam."""
        return self._water

    @property
    def warnings(self) -> tuple[Notice, ...]:
        """What a person should know."""
        if self._water is None:
            text = (
                "there is no white water: the clip shows no foam (bright, grey pixels) to tell how much and where from"
            )
            return (Notice("whitewater-not-filmed", text),)
        if not self._water.thinned:
            return ()
        most = self._water.law.most
        return (
            Notice(
                "whitewater-thinned",
                f"there was more white water than the {most} particles that are shown at once: it was thinned; set "
                "whitewater.amount lower",
            ),
        )

    def advance(self, particles: Particles, number: int) -> None:
        """Go on to a frame; every frame after the last one, in order."""
        if number == 0:
            self._begin_again()
        elif self._water is not None:
            self._water.law = self._law(number)
            self._water.advance(particles, self._scene.interval)

    def splats(
        self, inside: Callable[[np.ndarray], np.ndarray] | None = None
    ) -> tuple[Gaussians, Int[np.ndarray, " n"], Float[np.ndarray, "n 3"]] | None:
        """Splats, ids and velocities (m/s) but of those inside obstacles; None where there are none."""
        water, found = self._water, self._found
        if water is None or found is None or not len(water):
            return None
        cell, shown = self._scene.terrain.grid.spacing, np.ones(len(water), bool)
        if inside is not None:
            shown = ~inside(water.positions)
        splats = whitewater_splats(water.positions, water.kinds, water.lives, found.color, cell).select(shown)
        return splats, IDS_FROM + 2 * water.ids[shown] + 1, water.velocities[shown].astype(np.float32)

    def state(self) -> dict[str, np.ndarray]:
        """What changes from frame to frame, as plain arrays."""
        return {} if self._water is None else {f"whitewater.{k}": v for k, v in self._water.state().items()}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Go to a state of `state`; raises as `Whitewater.restore`."""
        if self._water is not None:
            prefix = "whitewater."
            self._water.restore({k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)})
