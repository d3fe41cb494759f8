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
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage

from fluidlift.errors import FluidliftError, InputRejected
from fluidlift.io.footage_file import read_footage
from fluidlift.look.whitewater_splats import FADING, OPACITIES, SIZES, FilmedFoam, whitewater_splats
from fluidlift.messages import Notice
from fluidlift.physics.whitewater import (
    FOAM,
    LIFE,
    Ground,
    LiquidState,
    Range,
    SeenBirths,
    Whitewater,
    WhitewaterLaw,
)
from fluidlift.scene.build import Scene
from fluidlift.scene.filmed_foam import births_in_columns
from fluidlift.scene.simulator import simulator_of
from fluidlift.types import Gaussians, Particles

SECONDS = 1.0
"""s over which the scene as lifted is looked at"""
SETTLED = 0.2
"""s after which that begins: the first frames have the jerk of a body that is let go"""
BY_ENERGY = (0.1, 0.9)
"""quantiles of the surface's energy between which it counts from nothing to all"""
FULL_RATE = 30.0
"""1/s, births in a full cell whose potentials are at their most, before it is fitted: with a life of 2 s and splats of
0.1 cells, foam there covers the water"""
COVERS = np.pi * (1.5 * SIZES[1]) ** 2 * OPACITIES[1]
"""cells^2 that a splat of foam hides: a disc of 1.5 standard deviations, as far as it is opaque"""
FITTED = (0.02, 50.0)
"""times `FULL_RATE` between which the rate is fitted"""
SPREAD = 1
"""cells around a column whose potentials count as its own: waves are not in the same place each time"""
LEAST_AFLOAT = 0.25
"""share of white water that counts as foam at least: from less the film's foam would take four times as much"""
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
class Measured:
    """What a scene as lifted, and its film, say about its white water."""

    trapped: Range
    crest: Range
    energy: Range
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

    def law(self, scene: Scene, amount: float, everywhere: bool = False, *, settled: bool = True) -> WhitewaterLaw:
        """For a scene edited from `scene`, with `amount` times as much; everywhere: also where the film shows it.

        A body that is let go jerks, and would foam all over: until it has `settled` what counts is more than that.
        """
        rate, grid = amount * self.rate, scene.terrain.grid
        known = grid, self.trapped_known[int(settled)], self.crest_known[int(settled)]
        seen = SeenBirths(grid, amount * self.filmed, self.energy_known) if everywhere else None
        return WhitewaterLaw(self.trapped, self.crest, self.energy, rate, rate, known=known, seen=seen)


@dataclass(frozen=True)
class Kept:
    """A measure as a stage keeps it."""

    found: Measured | None


def kept_measure(scene: Scene, device: str) -> Kept:
    """`measured`, as a part of a stage."""
    return Kept(measured(scene, device))


def measured(scene: Scene, device: str = "cpu", foam: FilmedFoam | None = None) -> Measured | None:
    """What a scene as lifted and its film say about white water; None where the film shows none, or there is none.

    Args:
        scene: without edits.
        device: that moves particles, "cpu" or "cuda".
        foam: of the film, or of a part of it; None: of all of it.
    """
    foam = filmed_foam(scene) if foam is None else foam
    if foam is None or foam.share == 0.0:
        return None
    probe = _Probe(scene, foam)
    simulator = simulator_of(scene, device, deform=False)
    first, count = (round(s / scene.interval) for s in (SETTLED, SETTLED + SECONDS))
    seen: list[Columns] = []
    for _ in range(max(count, 2)):
        try:
            simulator.advance(scene.interval)
        except FluidliftError:  # the simulation that follows says so
            break
        if len(simulator.particles):
            seen.append(probe.columns(simulator.particles))
    if len(seen) <= first:
        return None
    return _fitted(seen, first, foam, scene, probe.afloat)


class _Probe:
    """White water that is born where the film shows foam, to know how much of it stays at the surface: what the flow
    carries under covers nothing."""

    def __init__(self, scene: Scene, foam: FilmedFoam) -> None:
        self._scene, self._foam = scene, foam
        self._ground = Ground.of(scene.terrain, scene.cell_types)
        self._water: Whitewater | None = None
        self._floating, self._all = 0.0, 0.0

    @property
    def afloat(self) -> float:
        """Share of what covers, were it all at the surface, that is foam; 1 where nothing was born."""
        return self._floating / self._all if self._all > 0 else 1.0

    def columns(self, particles: Particles) -> Columns:
        """Those of the next frame."""
        scene = self._scene
        if self._water is None:
            state = LiquidState.of(particles, self._ground, scene.parameters.density)
            self._water = self._begun(columns_of(state, scene))
            return columns_of(state, scene)
        state = self._water.advance(particles, scene.interval)
        assert state is not None  # there are particles
        fading = np.clip(self._water.lives / FADING, 0.0, 1.0)
        self._floating += float(fading[self._water.kinds == FOAM].sum())
        self._all += float(fading.sum())
        return columns_of(state, scene)

    def _begun(self, now: Columns) -> Whitewater:
        scene, grid, nothing = self._scene, self._scene.terrain.grid, Range(0.0, 1.0)
        lasting = np.full(now.wet.shape, float(np.mean(LIFE)))
        rate = births_in_columns(self._foam, scene.camera, grid, now.height, 0.0 * now.velocity, lasting, COVERS)
        low, high = (float(q) for q in np.quantile(now.energy[now.wet], BY_ENERGY))
        seen = SeenBirths(grid, rate, 0.0 * rate)
        law = WhitewaterLaw(nothing, nothing, Range(low, max(high, 1.25 * low, 1e-12)), 0.0, 0.0, seen=seen)
        return Whitewater(self._ground, law, scene.parameters.gravity, scene.parameters.density, scene.seed)


def filmed_foam(scene: Scene) -> FilmedFoam | None:
    """The foam of a scene's film; None where it has none that can be read (which is said elsewhere)."""
    if scene.film is None or not scene.film.is_file():
        return None
    try:
        frames, fluid, _ = read_footage(scene.film, scene.camera.size)
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


def _fitted(frames: list[Columns], settled: int, foam: FilmedFoam, scene: Scene, afloat: float) -> Measured:
    """Limits and rate by which as much of the surface foams as of the film's, and births at its places, of which a
    share stays `afloat`. The flow has `settled` with that frame."""
    grid, seen = scene.terrain.grid, frames[settled:]
    reached = [
        np.stack([_reached(np.stack([getattr(c, name) for c in part])) if part else np.zeros(grid.shape[:2])
                  for part in (frames[:settled], seen)]) for name in ("trapped", "crest")
    ]  # fmt: skip
    wet = np.stack([c.wet for c in seen])
    trapped, crest, energy = (np.stack([getattr(c, name) for c in seen]) for name in ("trapped", "crest", "energy"))
    # two potentials that seldom meet share the foam
    quantile = 1.0 - 0.5 * foam.share
    limits = []
    for values in (trapped, crest):
        # SPlisHSPlasH's FoamGenerator takes the mean of the frames' maxima as well
        least, most = np.quantile(values[wet], quantile), np.mean([v[w].max(initial=0.0) for v, w in zip(values, wet)])
        limits.append(Range(float(least), float(max(most, 1.25 * least, 1e-9))))
    low, high = (float(q) for q in np.quantile(energy[wet], BY_ENERGY))
    fast = Range(low, max(high, 1.25 * low, 1e-12))
    shares = (limits[0].share(trapped) + limits[1].share(crest)) * fast.share(energy) * wet
    life, lasting = _lives(shares, fast.share(energy))
    flow = np.mean([c.velocity for c in seen], axis=0)
    cover = carried_cover(shares.mean(axis=0), flow, grid.spacing, life, lasting)
    places = wet.mean(axis=0) > 0.5
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # columns that were never wet
        height = np.nanmedian(np.stack([c.height for c in seen]), axis=0)
    lasts = _lasting(LIFE[0] + (LIFE[1] - LIFE[0]) * fast.share(energy).mean(axis=0))
    filmed = births_in_columns(foam, scene.camera, grid, height, flow, lasts, COVERS) / max(afloat, LEAST_AFLOAT)
    rate = FULL_RATE * _factor(cover[places], foam.share)
    return Measured(
        limits[0],
        limits[1],
        fast,
        rate,
        foam.share,
        foam.color,
        *reached,
        filmed=filmed,
        energy_known=energy.min(axis=0),
    )


def _reached(potential: Float[np.ndarray, "t nx ny"]) -> Float[np.ndarray, "nx ny"]:
    """The most in each column and beside it, in all frames; 0 where there are none."""
    return ndimage.maximum_filter(potential.max(axis=0, initial=0.0), 2 * SPREAD + 1)


def _lives(shares: np.ndarray, energies: np.ndarray) -> tuple[float, float]:
    """s that what is born lives, and for how long it would cover as much without fading; means by births."""
    life = LIFE[0] + (LIFE[1] - LIFE[0]) * energies
    lasting = _lasting(life)
    total = max(float(shares.sum()), 1e-12)
    return max(float((shares * life).sum()) / total, LIFE[0]), float((shares * lasting).sum()) / total


def _lasting(life: np.ndarray) -> np.ndarray:
    """s for which what lives so long (s) would cover as much without fading."""
    return np.where(life > FADING, life - 0.5 * FADING, life**2 / (2.0 * FADING))


def carried_cover(
    births: Float[np.ndarray, "nx ny"],
    velocity: Float[np.ndarray, "nx ny 2"],
    spacing: float,
    life: float,
    lasting: float,
) -> Float[np.ndarray, "nx ny"]:
    """Mean cover (cells^2 per cell, may be over 1) of what is born at `FULL_RATE` times `births`, and goes with a
    steady velocity (m/s) for its `life` (s), in which it covers as much as in `lasting` (s) without fading: the births
    upstream, added up."""
    pieces = 16
    at, total = np.indices(births.shape).astype(float), np.zeros(births.shape)
    for _ in range(pieces):
        total += ndimage.map_coordinates(births, at, order=1, cval=0.0)
        here = np.stack([ndimage.map_coordinates(velocity[..., a], at, order=1, mode="nearest") for a in range(2)])
        at = at - here * (life / pieces / spacing)
    return FULL_RATE * COVERS * lasting / pieces * total


def _factor(cover: np.ndarray, share: float) -> float:
    """By which to multiply a mean cover so that a random one of that mean hides a share of the surface."""
    low, high = FITTED
    for _ in range(40):
        middle = float(np.sqrt(low * high))
        if (1.0 - np.exp(-middle * cover)).mean() < share:
            low = middle
        else:
            high = middle
    return float(np.sqrt(low * high))


class SceneWhitewater:
    """White water beside the splats of a scene, from its first frame on."""

    def __init__(self, scene: Scene, found: Measured | None) -> None:
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
