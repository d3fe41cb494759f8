"""What a film says of its foam and waves, as numbers with intervals, for the parameters of an asset.

The film alone has the share of foam (`foam_share`) and waves (`wave_length`, `wave_slope`, `wave_amplitude`). The law
of white water (`scene.whitewater_law`) takes a simulation of the scene as lifted: where that is what is simulated in
any case, its first 1.2 s are watched on the way, for 0.2 to 0.7 of the time that they take (`WatchedFlow`).

*How sure waves are.* The power at one place of a wave spectrum has two degrees of freedom, so the sum over all has
2 (sum of power)^2 / (sum of its squares), less what Hann's window makes alike beside each other: that is the error of
sampling. What is not known of the water's body and its sky is a range of factors for slope and height beside it
(`look.slope_brightness`); both add up as squares of logarithms. Lengths are those of the asset's scale.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from fluidlift.look.wave_spectrum import CORRELATED, FilmedWaves
from fluidlift.messages import Notice
from fluidlift.numerics.block_bootstrap import LEVEL, Spread
from fluidlift.physics.wave_dispersion import STEEPEST
from fluidlift.scene.build import FOAMS_UP_TO, Scene
from fluidlift.scene.waves import filmed_waves
from fluidlift.scene.whitewater import FlowWatch, SceneWhitewater, filmed_foam
from fluidlift.scene.whitewater_law import LAW, PRECISE, SHARE, foam_estimate
from fluidlift.types import Estimate, Gaussians, Particles, kind_of

WAVES = {"wave_length": "m", "wave_slope": "", "wave_amplitude": "m"}
"""names and units: mean wavelength, standard deviation of the slope, and amplitude of an even wave of their height"""
NAMES = (SHARE, *LAW, *WAVES)
"""of all numbers that a film gives, in the order of tables"""
ALIKE = CORRELATED ** (2.0 / 3.0)
"""places over the plan that vary as one: (35/18)^2, of Hann's window. Over time a place is one wave"""
WIDTH = 1.96
"""standard deviations on either side that hold 95 %"""


def film_estimates(scene: Scene) -> dict[str, Estimate]:
    """What the film alone says: the share of foam, and waves; what it does not show is not there.

    Args:
        scene: without edits.
    """
    if not _foams(scene):
        return {}
    foam, waves = filmed_foam(scene), filmed_waves(scene)
    found = {} if foam is None or foam.share == 0.0 else {SHARE: foam_estimate(foam)}
    return found if isinstance(waves, Notice) else found | wave_estimates(waves)


def _foams(scene: Scene) -> bool:
    """Whether what is bright on it can be foam: smoke, honey and lava have none. What is let go is at no time what it
    was before, and has no mean that an interval could be of."""
    kind = kind_of(scene.kind)
    return not (kind.is_gas or kind.starts_at_rest) and scene.parameters.kinematic_viscosity <= FOAMS_UP_TO


def wave_estimates(waves: FilmedWaves, level: float = LEVEL, *, optics: bool = True) -> dict[str, Estimate]:
    """Length, slope and amplitude of filmed waves.

    Args:
        waves: that a film shows.
        level: probability with which the error of sampling stays within an interval.
        optics: False: as if water and sky were known, so that only the error of sampling is left.
    """
    v, k = waves.variance, np.linalg.norm(waves.wavevectors, axis=1)
    mean, off = float((k * v).sum() / v.sum()), waves.factor if optics else (1.0, 1.0)
    lengths, slopes, heights = (
        (2.0 * np.pi / mean, _sampled(v * (k - mean), mean * v), (1.0, 1.0)),
        (float(np.sqrt(v.sum())), _sampled(0.5 * v, v), off),
        (float(np.sqrt(2.0 * (v / k**2).sum())), _sampled(0.5 * v / k**2, v / k**2), off),
    )
    source = "measured: how brightness moves over the water"
    found = {
        name: _told(value, _between(value, spread.interval(value, level), factors), unit, source)
        for (name, unit), (value, spread, factors) in zip(WAVES.items(), (lengths, slopes, heights), strict=True)
    }
    slope = found["wave_slope"]
    assert slope.interval is not None
    low, high = slope.interval  # steeper than that waves of one height break
    most = max(STEEPEST / float(np.sqrt(2.0)), slope.value)
    return found | {"wave_slope": _told(slope.value, (low, min(high, most)), "", source)}


def _sampled(parts: np.ndarray, of: np.ndarray) -> Spread:
    """Of the logarithm of a sum over places of a spectrum, whose parts by place vary with its power: to first order.

    The square of an observed power is twice that of the expected one in the mean.
    """
    total = max(float(of.sum()), 1e-300)
    sigma = float(np.sqrt(0.5 * ALIKE * (parts**2).sum())) / total
    freedom = 4.0 * total**2 / max(ALIKE * float((of**2).sum()), 1e-300)
    return Spread(sigma, max(freedom, 1.0))


def _between(value: float, sampled: tuple[float, float], factors: tuple[float, float]) -> tuple[float, float]:
    """An interval from that of the error of sampling and the factors by which a value may be off."""
    down, up = (
        float(np.hypot(np.log(end / value), np.log(factor))) for end, factor in zip(sampled, factors, strict=True)
    )
    return value * float(np.exp(-down)), value * float(np.exp(up))


def _told(value: float, interval: tuple[float, float], unit: str, source: str) -> Estimate:
    sigma = value * float(np.log(interval[1] / interval[0])) / (2.0 * WIDTH)
    return Estimate(value, sigma, sigma < PRECISE * value, 0.0, unit, interval, source)


class WatchedFlow(SceneWhitewater):
    """In the place of white water, where there is none: looks at the simulation of a scene as lifted, and shows
    nothing."""

    def __init__(self, scene: Scene, watch: FlowWatch) -> None:
        """
        Args:
            scene: without edits, that is simulated.
            watch: of it, before its first frame.
        """
        super().__init__(scene, None)
        self._watch, self._missed = watch, False
        self._beside = ThreadPoolExecutor(1, "watching")  # nothing that is shown waits for it
        self._looking: Future[None] | None = None

    @classmethod
    def of(cls, scene: Scene) -> WatchedFlow | None:
        """For a scene; None where it was edited, or its film shows no foam."""
        if scene.edited or not _foams(scene):
            return None
        foam = filmed_foam(scene)
        return None if foam is None or foam.share == 0.0 else cls(scene, FlowWatch(scene, foam))

    @property
    def estimates(self) -> dict[str, Estimate]:
        """What was seen; nothing where the simulation went on from a checkpoint, or ended before the flow settled."""
        self._looked()
        found = None if self._missed else self._watch.found()
        return {} if found is None else found.estimates

    @property
    def warnings(self) -> tuple[Notice, ...]:
        """None: nobody asked for white water."""
        return ()

    def advance(self, particles: Particles, number: int) -> None:
        """Look at a frame, once the one before has been looked at."""
        if number and not self._missed:
            self._looked()
            self._looking = self._beside.submit(self._watch.see, particles)

    def _looked(self) -> None:
        """Wait for the frame that is looked at."""
        looking, self._looking = self._looking, None
        if looking is not None:
            looking.result()

    def splats(
        self, inside: Callable[[np.ndarray], np.ndarray] | None = None
    ) -> tuple[Gaussians, np.ndarray, np.ndarray] | None:
        """None."""
        return None

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """The frames before were not seen."""
        self._missed = True
