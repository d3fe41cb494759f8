"""Waves that a film of a surface shows: its brightness by wavenumber and frequency, and slopes from brightness.

A surface that is seen at a slant mirrors and shows its body by its slope. So waves are brightness that moves as waves
do: at omega = sigma(k) + k . U (`physics.wave_dispersion`), on a current U. Foam and dirt are carried, omega = k . U;
what shows through from the bed stands, omega = 0; noise is everywhere. What counts is by how much more there is on a
wave's place in the spectrum than right beside it.

On calm water crests are the only thing that moves, and what was measured as its current is their speed: then nothing
lies where a wave on that current would. But waves of one origin have a frequency, where carried patterns fall off
evenly. Where a peak over time lies nearer to waves on water that stands, or to what that current carries, than to waves
on it, the water stands. From the frequency dispersion gives their length, whatever the scale.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.errors import require
from fluidlift.look.slope_brightness import gain_and_range
from fluidlift.physics.wave_dispersion import STEEPEST, WaveMedium

LEAST_GAIN = 0.3
"""of d ln L / d s: below it (seen from within 37 degrees of straight above, with no shore to mirror) brightness says
nothing about slope"""
LOBE = 1.3
"""bins to each side within which what Hann's window spreads of one frequency counts: 96 % of it"""
SPREAD = 1.2
"""bins of wavenumber by which the same window spreads it, as it counts for a frequency that changes with it"""
SHOULDER = 2.0
"""widths of a band up to which, beside it, the spectrum says what would be there without waves"""
ALONG = 0.25
"""squared cosine between wave and line of sight up to which its slope is not seen"""
CORRELATED = 7.0
"""cells of the spectrum that vary as one: (35/18)^3, of Hann's window over time and plan"""
SIGNIFICANT = 5.0
"""standard deviations above what is beside it from which there are waves"""
STANDS_OUT = 0.5
"""and share of what is beside it: drifting patterns have tails that slope off"""
STANDING_OUT = 2.0
"""the same of what stands: a bed's pattern has peaks by chance"""
LEAKING = 1e-2
"""share of what is carried, at the wavenumbers of waves, that their brightness must exceed: Hann's window and speeds
that differ let a thousandth of foam's reach to where waves are, and more in a second's film"""
SECTORS = 12
"""directions in which standing waves are compared with what stands beside them, and into which a peak is taken apart"""
PEAK = (1.4, 2.2)
"""factors in frequency to each side up to which a peak reaches, and up to which, beyond, is what it stands on"""
PEAKED = 2.0
"""times what it stands on: patterns of few flakes have lumps"""
RISES = 1.5
"""times the mean of what lies below it, at its highest: the spectrum of a carried pattern falls, however it bends"""
CORE = 0.1
"""of the most power, from which wavenumbers of a peak count"""
LOWEST = 3.5
"""bins, of the frequency of a peak at least: light and clouds change slowly"""
PREFERRED = 0.5
"""share of a peak's brightness from which waves on the measured current are taken in place of it"""
OFTEN = 0.4
"""of the windows that can tell must show waves: what is in fewer is chance"""
WIDE = 0.15
"""of a wavenumber that a peak gives: the width for which it stands"""


WHY_NOT = {
    "small": "too little of its surface is seen at once",
    "steep": "it is seen too much from above for brightness to tell slope",
    "short": "it is too short, or shows too little at once, to tell waves from what the current carries",
    "none": "nothing in it moves as waves do",
}
"""why there are no waves, in words that go on from "the clip": the last of several counts, as the one that came
furthest"""


@dataclass(frozen=True)
class SurfaceWindow:
    """A square of a surface, filmed, over the plan."""

    contrast: Float[np.ndarray, "t nx ny"]
    """natural logarithm of linear brightness; where none is known, its mean"""
    pitch: float
    """m between places"""
    interval: float
    """s between frames"""
    current: tuple[float, float]
    """m/s, mean of the surface"""
    unsteady: float
    """m/s, standard deviation of the current in the window"""
    medium: WaveMedium
    sight: tuple[float, float]
    """unit, on the plan, along the line of sight"""
    incidence: float
    """radians between line of sight and plumb line"""
    resolved: float
    """m, the shortest wavelength that the film resolves"""
    mirrored: float = 0.0
    """d ln L / d s by what stands on the shore, root mean square"""

    def __post_init__(self) -> None:
        require(self.contrast.ndim == 3, f"contrast of shape {self.contrast.shape}", "[t, nx, ny]")
        require(self.pitch > 0 and self.interval > 0, f"{self.pitch} m, {self.interval} s", "positive numbers")


@dataclass(frozen=True)
class FilmedWaves:
    """Waves that were found, as wavenumbers with their share of the slope's variance."""

    wavevectors: Float[np.ndarray, "n 2"]
    """rad/m, the way they run on water at rest"""
    variance: Float[np.ndarray, " n"]
    """of the slope (m/m)^2 that each stands for"""
    standing: Bool[np.ndarray, " n"]
    """held in place by the current"""
    bins: float
    """rad/m, the width for which each stands"""
    factor: tuple[float, float]
    """low and high, of the slope (not its variance): what is not known of water's body and sky"""
    carried: bool = True
    """by the current; else what was measured as current is their own speed"""

    @property
    def slope_variance(self) -> float:
        """(m/m)^2, of all of them."""
        return float(self.variance.sum())

    @property
    def slope(self) -> tuple[float, float, float]:
        """Standard deviation of the slope, and the least and the most that it may be."""
        usual = float(np.sqrt(self.slope_variance))
        low, high = (min(f * usual, STEEPEST / np.sqrt(2.0)) for f in self.factor)
        return usual, float(low), float(high)

    def wavelength(self, standing: bool | None = None) -> float:
        """m, 2 pi over the mean wavenumber weighed by slope variance; of those that stand, or run; None: of all."""
        of = np.ones(len(self.variance), bool) if standing is None else self.standing == standing
        k = np.linalg.norm(self.wavevectors[of], axis=1)
        total = float((k * self.variance[of]).sum())
        return float(2.0 * np.pi * self.variance[of].sum() / total) if total > 0 else 0.0


Part = tuple[tuple[np.ndarray, ...], np.ndarray]
"""places in a spectrum over the plan, and how much of the brightness is waves there"""


@dataclass(frozen=True)
class _Spectrum:
    """Power of a window's contrast by wavenumber and frequency: its sum is the variance."""

    power: np.ndarray
    """[t, nx, ny]"""
    moving: np.ndarray
    """the same without the mean over time"""
    omega: np.ndarray
    """[t, 1, 1], rad/s: of exp(i (k . x - omega t))"""
    kx: np.ndarray
    ky: np.ndarray
    k: np.ndarray
    """[nx, ny], rad/m"""
    d_omega: float
    d_k: float


def _spectrum(window: SurfaceWindow) -> _Spectrum:
    c, p = np.asarray(window.contrast, np.float64), window.pitch
    t, nx, ny = c.shape
    hann = [np.hanning(n + 2)[1:-1] for n in (t, nx, ny)]
    taper = hann[0][:, None, None] * hann[1][:, None] * hann[2]
    flat = hann[1][:, None] * hann[2]
    # what all of the window does at once is the light's doing
    c = c - ((c * flat).sum(axis=(1, 2)) / flat.sum())[:, None, None]
    power = np.abs(np.fft.fftn(c * taper)) ** 2 / (c.size * (taper**2).sum())
    # without its mean over time nothing of what stands reaches into its neighbours
    stands = (c * hann[0][:, None, None]).sum(axis=0) / hann[0].sum()
    moving = np.abs(np.fft.fftn((c - stands) * taper)) ** 2 / (c.size * (taper**2).sum())
    kx, ky = (2.0 * np.pi * np.fft.fftfreq(n, p) for n in (nx, ny))
    kx, ky = (a.copy() for a in np.broadcast_arrays(kx[:, None], ky[None, :]))
    # the means over a pixel and over a place of the window blur: sinc is numpy's, of pi x
    along = kx * window.sight[0] + ky * window.sight[1]
    seen = np.sinc(kx * p / (2 * np.pi)) * np.sinc(ky * p / (2 * np.pi)) * np.sinc(along * p / (2 * np.pi))
    power, moving = (x / np.maximum(seen, 0.5) ** 2 for x in (power, moving))
    omega = -2.0 * np.pi * np.fft.fftfreq(t, window.interval)[:, None, None]
    return _Spectrum(
        power, moving, omega, kx, ky, np.hypot(kx, ky), 2 * np.pi / (t * window.interval), 2 * np.pi / (min(nx, ny) * p)
    )


def waves_in(windows: list[SurfaceWindow]) -> FilmedWaves | str:
    """The waves of some windows of one surface, or why there are none: a key of `WHY_NOT`.

    Each window tells the whole spectrum; the mean over those that can tell counts, those without waves included.
    """
    found = [_of_window(w) for w in windows]
    there = [f for f in found if isinstance(f, FilmedWaves)]
    if not there:
        reasons = [f for f in found if isinstance(f, str)]
        return max(reasons, key=list(WHY_NOT).index) if reasons else "small"
    telling = len(there) + sum(f == "none" for f in found if isinstance(f, str))
    if len(there) < OFTEN * telling:
        return "none"
    # on a current or on none: what most of them say
    carried = 2 * sum(f.carried for f in there) >= len(there)
    share = sum(f.carried == carried for f in there) + telling - len(there)
    there = [f for f in there if f.carried == carried]
    return FilmedWaves(
        np.concatenate([f.wavevectors for f in there]),
        _unbroken(np.concatenate([f.variance for f in there]) / share),
        np.concatenate([f.standing for f in there]),
        max(f.bins for f in there),
        (min(f.factor[0] for f in there), max(f.factor[1] for f in there)),
        carried,
    )


def _unbroken(variance: np.ndarray) -> np.ndarray:
    """Slopes up to those that waves of one height have when they break."""
    most = 0.5 * STEEPEST**2
    return variance * min(1.0, most / max(float(variance.sum()), 1e-12))


def _of_window(window: SurfaceWindow) -> FilmedWaves | str:
    """Its waves, or why there are none."""
    gain, factor = gain_and_range(window.incidence, window.mirrored)
    if gain < LEAST_GAIN:
        return "steep"
    s = _spectrum(window)
    on_current, peak = _on_current(s, window), _peak(s, window)
    found = on_current
    if not isinstance(peak, str):
        weak = isinstance(on_current, str) or on_current.energy.sum() < PREFERRED * peak.energy.sum()
        found = peak if weak else on_current
    if isinstance(found, str):
        return "none" if peak == "none" else found
    q = (found.wavevectors @ np.array(window.sight)) ** 2 / (found.wavevectors**2).sum(axis=1)
    variance = found.energy / (gain**2 * q)
    return FilmedWaves(found.wavevectors, variance, found.standing, found.bins, factor, found.carried)


class _Bright(NamedTuple):
    """Waves by the variance of brightness that is theirs."""

    wavevectors: np.ndarray
    energy: np.ndarray
    standing: np.ndarray
    bins: float
    carried: bool


def _on_current(s: _Spectrum, window: SurfaceWindow) -> _Bright | str:
    """Waves that run and stand where the measured current has them."""
    parts = [_running(s, window), _standing(s, window)]
    found = [(part, stands) for part, stands in zip(parts, (False, True)) if not isinstance(part, str)]
    if not found:
        return "short" if all(part == "short" for part in parts) else "none"
    vectors = [np.stack([s.kx[places], s.ky[places]], axis=-1) for (places, _), _ in found]
    standing = np.concatenate([np.full(len(energy), stands) for (_, energy), stands in found])
    # a wave has its like of opposite sign in the spectrum: twice
    energy = 2.0 * np.concatenate([energy for (_, energy), _ in found])
    return _Bright(np.concatenate(vectors), energy, standing, s.d_k, True)


def _peak(s: _Spectrum, window: SurfaceWindow) -> _Bright | str:
    """Waves of a peak over time."""
    over_time = s.moving[:, s.k > 0].sum(axis=1)
    at = np.arange(1, (len(s.omega) - 1) // 2 + 1)
    rate, energy = np.abs(s.omega[at, 0, 0]), over_time[at] + over_time[-at]
    reach, end = np.log(PEAK)
    best, told, most = None, False, PEAKED
    for center in rate[(rate >= LOWEST * s.d_omega) & (rate * PEAK[1] <= rate[-1])]:
        away = np.log(rate / center)
        sides = [(away < -reach) & (away >= -end), (away > reach) & (away <= end)]
        if not all(side.any() for side in sides):
            continue
        told, band = True, np.abs(away) <= reach
        # between both sides a carried pattern falls as a power
        (x0, y0), (x1, y1) = ((away[side].mean(), np.log(energy[side] + 1e-30).mean()) for side in sides)
        base = np.exp(y0 + (away[band] - x0) * (y1 - y0) / (x1 - x0))
        rises = energy[band].max() >= RISES * energy[sides[0]].mean()
        if rises and energy[band].sum() >= most * base.sum():
            most = float(energy[band].sum() / base.sum())
            best = at[band], np.maximum(energy[band] - base, 0.0)
    if best is None:
        return "none" if told else "short"
    return _taken_apart(s, window, *best)


def _taken_apart(s: _Spectrum, window: SurfaceWindow, bins: np.ndarray, energy: np.ndarray) -> _Bright | str:
    """A peak's frequencies, with the brightness of each, by the directions in which they run."""
    omega, (sigma, doppler, *_, seen) = s.omega[bins, 0, 0], _told_apart(s, window)
    rate = np.abs(omega)
    # with omega above 0 they run along their wavevector
    power = s.moving[np.where(omega > 0, bins, -bins)].sum(axis=0)
    sector = _sectors(s)
    cells = np.bincount(sector[seen], minlength=SECTORS)
    share = np.bincount(sector[seen], power[seen], SECTORS) / np.maximum(cells, 1)
    middle = (np.arange(SECTORS) + 0.5) / SECTORS * 2 * np.pi - np.pi
    ways = np.stack([np.cos(middle), np.sin(middle)], axis=-1)
    faced = ((ways @ np.array(window.sight)) ** 2 > ALONG) & (cells > 0)
    if not faced.any():
        return "none"
    # what runs nowhere in particular is in all of them
    share = np.where(faced, share - share[faced].min(), 0.0)
    if share.sum() <= 0:
        return "none"
    # are they where waves on the measured current are, or on none, or is that current their own speed?
    core = seen & (power > CORE * power[seen].max())
    middling = float((rate * energy).sum() / energy.sum())
    off = [float((power * np.abs(middling - place))[core].sum()) for place in (doppler + sigma, sigma, doppler)]
    carried = off[0] == min(off)
    along = ways @ np.array(window.current) if carried else np.zeros(SECTORS)
    k = _wavenumbers(rate, along, window.medium)
    each = np.where(k > 0, energy[:, None] * share / share.sum(), 0.0).ravel()
    kept = each > 0
    if not kept.any():
        return "none"
    vectors = (k[..., None] * ways).reshape(-1, 2)[kept]
    width = WIDE * float((k.ravel() * each).sum() / each.sum())
    return _Bright(vectors, each[kept], np.zeros(len(vectors), bool), width, carried)


def _wavenumbers(rate: np.ndarray, along: np.ndarray, medium: WaveMedium) -> np.ndarray:
    """rad/m [n,m] of waves of some frequencies [n] (rad/s) that run along currents [m] (m/s); 0 where none does.

    Against a current there is a highest frequency.
    """
    table = np.geomspace(1e-3, 1e3, 4000)
    still, found = medium.frequency(table), []
    for u in along:
        seen = still + u * table
        highest = int(np.argmax(np.diff(seen) <= 0)) if (np.diff(seen) <= 0).any() else len(table) - 1
        k = np.interp(rate, seen[: highest + 1], table[: highest + 1])
        found.append(np.where(rate <= seen[highest], k, 0.0))
    return np.stack(found, axis=-1)


def _sectors(s: _Spectrum) -> np.ndarray:
    """[nx,ny], the direction of each wavenumber, of `SECTORS` from that of -x on."""
    turn = np.arctan2(s.ky, s.kx) / (2 * np.pi) + 0.5
    return np.floor(turn * SECTORS).astype(np.int64) % SECTORS


def _told_apart(s: _Spectrum, window: SurfaceWindow) -> tuple[np.ndarray, ...]:
    """[nx,ny] each: sigma, k . U, half widths (rad/s) of the bands of waves and of what is carried, and which
    wavenumbers are resolved and seen."""
    u = np.array(window.current)
    k = np.maximum(s.k, 1e-9)
    sigma, doppler = window.medium.frequency(k), s.kx * u[0] + s.ky * u[1]
    group = window.medium.group_speed(k)
    moving = np.hypot(u[0] + group * s.kx / k, u[1] + group * s.ky / k)
    own = LOBE * s.d_omega + k * window.unsteady
    wide = own + SPREAD * s.d_k * moving
    carried = own + SPREAD * s.d_k * float(np.linalg.norm(u))
    q = (s.kx * window.sight[0] + s.ky * window.sight[1]) ** 2 / k**2
    seen = (s.k > 1.9 * s.d_k) & (s.k < 2.0 * np.pi / window.resolved) & (q > ALONG)
    return sigma, doppler, wide, carried, seen


def _running(s: _Spectrum, window: SurfaceWindow) -> Part | str:
    """Wavenumbers of running waves and how much brightness is theirs."""
    sigma, doppler, wide, carried, seen = _told_apart(s, window)
    still = LOBE * s.d_omega
    center, highest = doppler + sigma, np.pi / window.interval
    usable = seen & (sigma > wide + carried) & (np.abs(center) > wide) & (np.abs(center) + wide < highest)
    if not usable.any():
        return "short"
    away = np.abs(s.omega - center) / wide
    band = (away <= 1.0) & usable
    drifting = np.abs(s.omega - doppler) <= carried
    shoulder = (away > 1.0) & (away <= SHOULDER) & ~drifting & (np.abs(s.omega) > still) & usable
    return _excess(s, band, shoulder, LEAKING * float(s.moving[drifting & usable].sum()))


def _excess(s: _Spectrum, band: np.ndarray, shoulder: np.ndarray, least: float) -> Part | str:
    """By wavenumber, what a band has above its shoulders at wavenumbers about as large; nothing if less than `least`
    in all."""
    ring = np.floor(s.k / s.d_k).astype(np.int64)
    count = int(ring.max()) + 1

    def per_ring(values: np.ndarray) -> np.ndarray:
        return np.bincount(ring.ravel(), values.ravel(), count)

    cells, beside = band.sum(axis=0), shoulder.sum(axis=0)
    have = per_ring(beside)
    base = per_ring((s.moving * shoulder).sum(axis=0)) / np.maximum(have, 1.0)
    usable = (cells > 0) & (have[ring] > 0)
    expected = np.where(usable, cells * base[ring], 0.0)
    excess = np.where(usable, (s.moving * band).sum(axis=0) - expected, 0.0)
    noise = float(np.sqrt(CORRELATED * (cells * base[ring] ** 2)[usable].sum()))
    if excess.sum() < max(SIGNIFICANT * noise, STANDS_OUT * expected.sum(), least, 1e-12):
        return "none"
    return _kept(excess)


def _kept(excess: np.ndarray) -> Part:
    """Places with more than nothing, together as much as all: what is below its expectation balances what is above."""
    places = np.nonzero(excess > 0)
    energy = excess[places]
    return places, energy * (float(excess.sum()) / float(energy.sum()))


def _standing(s: _Spectrum, window: SurfaceWindow) -> Part | str:
    """Wavenumbers of waves that the current holds in place, and how much brightness is theirs: peaks of what stands,
    where sigma(k) + k . U = 0, over what stands at smaller and larger wavenumbers of the same direction."""
    sigma, doppler, wide, _, seen = _told_apart(s, window)
    still = s.power[np.abs(s.omega[:, 0, 0]) <= LOBE * s.d_omega].sum(axis=0)
    apart = (doppler + sigma) / np.maximum(wide - LOBE * s.d_omega, 1e-9)
    seen &= doppler < 0
    sector = _sectors(s)
    excess, expected, noise = np.zeros(s.k.shape), 0.0, 0.0
    for direction in np.unique(sector[seen]):
        here = seen & (sector == direction)
        band = here & (np.abs(apart) <= 1.0)
        sides = [here & (apart > 1.0) & (apart <= 3.0), here & (apart < -1.0) & (apart >= -3.0)]
        if not band.any() or not all(side.any() for side in sides):
            continue
        # a pattern's spectrum falls as a power: between both sides it is the mean of their logarithms
        base = float(np.exp(np.mean([np.log(still[side].mean()) for side in sides])))
        excess[band] = still[band] - base
        expected, noise = expected + base * band.sum(), noise + CORRELATED * base**2 * band.sum()
    if expected == 0.0:
        return "short"
    if excess.sum() < max(SIGNIFICANT * np.sqrt(noise), STANDING_OUT * expected, 1e-12):
        return "none"
    return _kept(excess)
