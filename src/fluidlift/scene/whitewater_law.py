"""How much white water a flow makes for the foam of its film: three limits and a rate, with how sure each is.

The limits of the potentials lie where as much of the simulated surface is above them as the film shows foam; the rate
is that by which what is born, carried downstream for its life, covers that share (`law_of`). Both records are short,
the film of some seconds and the simulation of one. *How sure:* each is resampled by blocks longer than its memory
(`numerics.block_bootstrap`), the film's foam by frames and the surface by simulated frames, independently of each
other, and the law is fitted to each pair again. *Limit:* that is the error of sampling alone. What is taken for foam
(a grey sky's mirror image has its color), the scale of the asset, and what the law leaves out (of a simulation by the
potentials alone the cover is 0.3 to 0.4 of the film's) are not in it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from fluidlift.look.whitewater_splats import FADING, OPACITIES, SHAPE, SIZES, FilmedFoam
from fluidlift.numerics.block_bootstrap import LEVEL, RecordMemory, Spread, memory_of, resampled, spread_of
from fluidlift.physics.whitewater import LIFE, PotentialRange
from fluidlift.types import Estimate

BY_ENERGY = (0.1, 0.9)
"""quantiles of the surface's energy between which it counts from nothing to all"""
FULL_RATE = 30.0
"""1/s, births in a full cell whose potentials are at their most, before it is fitted: with a life of 2 s and splats of
0.1 cells, foam there covers the water"""
SECTION = (SHAPE[0] * SHAPE[1] + SHAPE[0] * SHAPE[2] + SHAPE[1] * SHAPE[2]) / 3.0
"""of a splat's axes, seen from any side, over that of a ball"""
COVERS = np.pi * (1.5 * SIZES[1]) ** 2 * SECTION * OPACITIES[1]
"""cells^2 that a splat of foam hides: a disc of 1.5 standard deviations, as far as it is opaque"""
FITTED = (0.02, 50.0)
"""times `FULL_RATE` between which the rate is fitted"""
DRAWS = 100
"""records that are drawn: a standard deviation is then known to 7 %"""
SEED = 0
"""of them"""
PRECISE = 0.05
"""of its value: a standard deviation below it counts as determined, as for every fitted number"""
SHARE = "foam_share"
"""name of the film's own number among the estimates"""
LAW = {"whitewater_trapped": "m/s", "whitewater_crest": "1/s", "whitewater_energy": "m^2/s^2", "whitewater_rate": "1/s"}
"""names and units of the four: speed of closing, curvature times speed, and energy per mass from which on there are
births, and births in a full cell whose potentials are at their most"""


class SurfaceRecord(NamedTuple):
    """The potentials of a simulated surface by columns, frame by frame, once the flow has settled."""

    wet: np.ndarray
    """bool [t,nx,ny]"""
    trapped: np.ndarray
    """m/s"""
    crest: np.ndarray
    """1/s"""
    energy: np.ndarray
    """m^2/s^2"""
    velocity: np.ndarray
    """[t,nx,ny,2], m/s"""


class Law(NamedTuple):
    """How much of it is made."""

    trapped: PotentialRange
    """m/s"""
    crest: PotentialRange
    """1/s"""
    energy: PotentialRange
    """m^2/s^2"""
    rate: float
    """1/s"""

    @property
    def numbers(self) -> tuple[float, float, float, float]:
        """Those of `LAW`."""
        return self.trapped.least, self.crest.least, self.energy.least, self.rate


def law_of(record: SurfaceRecord, share: float, spacing: float) -> Law:
    """Limits and rate by which a surface foams by a share.

    Args:
        record: of it.
        share: 0 to 1.
        spacing: m, of the columns.
    """
    wet, trapped, crest, energy = record[:4]
    # two potentials that seldom meet share the foam
    quantile = 1.0 - 0.5 * share
    limits = []
    for values in (trapped, crest):
        # SPlisHSPlasH's FoamGenerator takes the mean of the frames' maxima as well
        least, most = np.quantile(values[wet], quantile), np.mean([v[w].max(initial=0.0) for v, w in zip(values, wet)])
        limits.append(PotentialRange(float(least), float(max(most, 1.25 * least, 1e-9))))
    low, high = (float(q) for q in np.quantile(energy[wet], BY_ENERGY))
    fast = PotentialRange(low, max(high, 1.25 * low, 1e-12))
    shares = (limits[0].share(trapped) + limits[1].share(crest)) * fast.share(energy) * wet
    life, lasts = _lives(shares, fast.share(energy))
    cover = carried_cover(shares.mean(axis=0), np.mean(record.velocity, axis=0), spacing, life, lasts)
    return Law(limits[0], limits[1], fast, FULL_RATE * _factor(cover[wet.mean(axis=0) > 0.5], share))


def foam_estimate(foam: FilmedFoam, level: float = LEVEL) -> Estimate:
    """The share of a film's fluid that is foam, and between what an endless film's lies with a probability `level`."""
    memory, drawn = _drawn_shares(foam)
    source = f"measured: bright, grey pixels of {len(foam.by_frame)} frames of the clip"
    return _estimate(foam.share, spread_of(drawn, "logit", memory), "", source, (memory,), level)


def law_estimates(record: SurfaceRecord, foam: FilmedFoam, spacing: float, level: float = LEVEL) -> dict[str, Estimate]:
    """The numbers of the law by name, each with the interval that the shortness of film and simulation leaves.

    Args:
        record: of the surface.
        foam: of the film.
        spacing: m, of the columns.
        level: probability with which an interval holds what endless ones would give.
    """
    value = law_of(record, foam.share, spacing).numbers
    of_film, shares = _drawn_shares(foam)
    of_flow = memory_of(np.stack([record.trapped, record.crest, record.energy], axis=1) / _usual(record))
    frames = resampled(of_flow, DRAWS, SEED + 1)
    drawn = [
        law_of(SurfaceRecord(*(part[f] for part in record)), float(s), spacing).numbers
        for f, s in zip(frames, np.clip(shares, 1e-6, 1.0 - 1e-6))
    ]
    source = f"fitted: to the foam of {len(foam.by_frame)} frames of the clip, on {len(record.wet)} simulated ones"
    memories, columns = (of_film, of_flow), np.array(drawn).T
    found = {
        name: _estimate(value[k], spread_of(columns[k], "logarithm", *memories), unit, source, memories, level)
        for k, (name, unit) in enumerate(LAW.items())
    }
    least, most = (FULL_RATE * end for end in FITTED)
    name, rate = "whitewater_rate", value[3]
    if not 1.01 * least < rate < 0.99 * most:  # the flow breaks in too few places for the film's foam, or in too many
        why = f"at the end of its range: no rate gives the foam of {len(foam.by_frame)} frames of the clip"
        found[name] = Estimate(rate, float("inf"), False, rate, LAW[name], None, why)
    return found


def _usual(record: SurfaceRecord) -> np.ndarray:
    """[1,3,1,1], the usual size of each potential, so that none counts for its unit."""
    sizes = [float(values[record.wet].std()) if record.wet.any() else 1.0 for values in record[1:4]]
    return np.maximum(np.array(sizes), 1e-12)[None, :, None, None]


def _drawn_shares(foam: FilmedFoam) -> tuple[RecordMemory, np.ndarray]:
    """Of other films of as many frames that might have been."""
    if not len(foam.by_frame):
        return RecordMemory(1, 1, 1.0), np.full(DRAWS, foam.share)
    memory = memory_of(foam.by_frame[:, 0] / np.maximum(foam.by_frame[:, 1], 1.0))
    found, fluid = foam.by_frame[resampled(memory, DRAWS, SEED)].sum(axis=1).T
    return memory, found / np.maximum(fluid, 1.0)


def _estimate(
    value: float, spread: Spread, unit: str, source: str, memories: tuple[RecordMemory, ...], level: float
) -> Estimate:
    """With its interval; of one that is 0, or of too short a record, nothing is known."""
    if value <= 0.0 or min(m.count for m in memories) < 2:
        return Estimate(value, float("inf"), False, value, unit, None, source)
    sigma = spread.deviation(value)
    return Estimate(value, sigma, sigma < PRECISE * value, 0.0, unit, spread.interval(value, level), source)


def _lives(shares: np.ndarray, energies: np.ndarray) -> tuple[float, float]:
    """s that what is born lives, and for how long it would cover as much without fading; means by births."""
    life = life_of(energies)
    lasts = lasting(life)
    total = max(float(shares.sum()), 1e-12)
    return max(float((shares * life).sum()) / total, LIFE[0]), float((shares * lasts).sum()) / total


def life_of(energies: np.ndarray) -> np.ndarray:
    """s that what is born lives, by the share of its energy."""
    return LIFE[0] + (LIFE[1] - LIFE[0]) * energies


def lasting(life: np.ndarray) -> np.ndarray:
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
