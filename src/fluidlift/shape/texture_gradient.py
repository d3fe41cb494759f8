"""What the fluid's own pattern (foam, ripples) says about the plane it lies on: shape from texture.

A pattern that is the same all over a plane looks finer where the plane is farther, and shorter along the view. Seen
locally, a wave of the plane with the wave vector k (cycles per unit of it) has f = J^T k in the picture (cycles per
px), where J = d(plane)/d(picture), and a power spectrum P(k) becomes S(f) = P(J^-T f) / |det J| (Malik and Rosenholtz
1997; Super and Bovik 1995). Here log S of windows of the picture is a sum of: log P as a smooth function of |k|, a
stretch of the pattern that is common to the whole plane, a filter of the picture that is common to all windows (lens,
codec), and each window's own contrast, spectral slope and stretch, because no real pattern is quite the same all over.
All of it is linear in coefficients with Gaussian priors, so what is left when they are integrated out is the evidence
for the plane alone, as in `shape.slope`. Where the pattern has no scale of its own, or there is none, it is flat.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage
from scipy.special import logsumexp

from fluidlift.shape.heights import FARTHEST
from fluidlift.types import PinholeCamera

WINDOW = 32
"""px of a picture no larger than `LONGEST`"""
LONGEST = 512
"""px"""
FEWEST, MOST = 12, 160
"""windows"""
PICTURES = 12
"""frames whose spectra are averaged"""
RINGS = np.array([2.0, 3.0, 4.2, 5.8, 7.7, 10.0])
"""waves per window, bounds of the rings of the spectrum; above, codecs leave little"""
SECTORS = 6
"""of half a turn"""
LOOKS = 0.4
"""independent looks per bin of a spectrum and frame: neighbouring bins share a window's taper, frames their pattern"""
CONTRAST, SLOPE, TURN, REST = 1.2, 0.4, 0.12, 0.15
"""standard deviations of a window's own log power, of its slope over log frequency, of its stretch, of each bin"""
STEP = 0.75
"""standard deviation of the step of log P from knot to knot of its profile (8 of them)"""
FILTER = 2.0
"""the same of the picture's filter, at 5 knots"""
STRETCH = 0.35
"""the same of the pattern's common stretch: power twice as high across as along is a usual one"""
FAINT = 3.0
"""how many times the power of the noise counts as an error of a bin's power"""
BELIEF, PATTERNLESS = 0.2, 0.5
"""Power that the evidence is taken to, and the prior share of pictures whose pattern says nothing of their plane. On
180 made streams whose patterns are stretched, warped and unevenly strong, these make the error of the pitch 0.97 times
what the posterior says; from 0.1 to 0.3 and 0.4 to 0.7 it is 8.1 to 8.2 degrees. On 100 others it is 7.9; 8.7 by the
motion alone on both. Without the second it is 9.6 and twice what the posterior says: a pattern that is not the same all
over is sure of a wrong plane"""


@dataclass(frozen=True)
class WhitenedSpectra:
    """Spectra of windows of the fluid's picture, in units of what is not explained of them (whitened)."""

    at: Float[np.ndarray, "n 2"]
    """px, middles of the windows"""
    wave: Float[np.ndarray, "k 2"]
    """cycles per px"""
    whitener: Float[np.ndarray, "n k k"]
    spectrum: Float[np.ndarray, "n k"]
    """log power, whitened"""
    filter: Float[np.ndarray, "n k c"]
    """columns that belong to the picture and to no plane, whitened, times their priors' deviations"""


def texture_patches(pictures: UInt8[np.ndarray, "t h w 3"], mask: Bool[np.ndarray, "h w"]) -> WhitenedSpectra | None:
    """Spectra of the windows that lie in the mask; None where there are fewer than `FEWEST`.

    Args:
        pictures: sRGB; a dozen of them, spread over the clip, are looked at.
        mask: fluid that lies.
    """
    pick = np.unique(np.linspace(0, len(pictures) - 1, PICTURES).astype(int))
    scale = min(LONGEST / max(mask.shape), 1.0)
    size = (round(mask.shape[1] * scale), round(mask.shape[0] * scale))
    grey = np.stack([_shrunk(cv2.cvtColor(np.asarray(pictures[t]), cv2.COLOR_RGB2GRAY), size) for t in pick])
    inner = ndimage.binary_erosion(_shrunk(mask.astype(np.uint8), size) > 0.99, iterations=2)
    corners = _corners(inner)
    if len(corners) < FEWEST:
        return None
    bins, wave = _polar_bins()
    power = np.array([_window_power(grey[:, y : y + WINDOW, x : x + WINDOW], bins) for y, x in corners])
    if power.max() < 1e-6:
        return None
    return _whitened(
        (corners[:, ::-1] + 0.5 * WINDOW) / scale, power, wave, np.bincount(bins[bins >= 0]), len(pick), scale
    )


def texture_evidence(camera: PinholeCamera, patches: WhitenedSpectra, normal: Float[np.ndarray, "3"]) -> float:
    """Logarithm of the evidence for a plane, but for a constant; minus infinity where it is not seen in all windows.

    Args:
        camera: for its focal length and its pose.
        patches: of the picture.
        normal: of the plane, in the camera's world, towards the camera.
    """
    seen = _plane_jacobian(camera, patches.at, camera.camera_from_world.rotation @ normal)
    if seen is None:
        return -np.inf
    wave = np.einsum("nji,kj->nki", np.linalg.inv(seen), patches.wave)
    size, angle = np.log(np.hypot(wave[..., 0], wave[..., 1])), 2.0 * np.arctan2(wave[..., 1], wave[..., 0])
    low, high = np.percentile(size, [1.0, 99.0])
    knots = np.linspace(low, high, 9)
    profile = STEP * np.clip((size[..., None] - knots[:-1]) / (knots[1] - knots[0]), 0.0, 1.0)
    middle = 0.3 * (size - np.median(size))
    turn = [f * g for f in (np.ones_like(size), middle) for g in (np.cos(angle), np.sin(angle))]
    columns = np.concatenate([profile, STRETCH * np.stack(turn, axis=-1)], axis=-1)
    shrinks = np.log(np.abs(np.linalg.det(seen)))
    target = patches.spectrum + patches.whitener.sum(axis=-1) * (shrinks - np.median(shrinks))[:, None]
    columns = np.concatenate([patches.whitener @ columns, patches.filter], axis=-1).reshape(target.size, -1)
    normal_matrix = columns.T @ columns + np.eye(columns.shape[1])
    moment = columns.T @ target.ravel()
    misfit = float((target**2).sum() - moment @ np.linalg.solve(normal_matrix, moment))
    return -0.5 * misfit - 0.5 * float(np.linalg.slogdet(normal_matrix)[1])


def weighed(evidence: Float[np.ndarray, "..."], habit: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """What evidence counts for (logarithm): little where a pattern need not be the same all over, and never all.

    Args:
        evidence: logarithms, for each plane.
        habit: logarithms of the prior, for each plane: a pattern that says nothing is as likely under all of them.
    """
    log = BELIEF * (evidence - evidence.max())
    silent = logsumexp(log + habit) - logsumexp(habit)
    return np.logaddexp(log + np.log(1.0 - PATTERNLESS), silent + np.log(PATTERNLESS))


def _shrunk(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    return cv2.resize(picture.astype(np.float32), size, interpolation=cv2.INTER_AREA)


def _corners(inner: np.ndarray) -> np.ndarray:
    """int [n,2] (row, column) of windows that lie within, half a window apart, or farther where there would be many."""
    area = cv2.integral(inner.astype(np.uint8))
    for step in (WINDOW // 2, 3 * WINDOW // 4, WINDOW, 3 * WINDOW // 2):
        rows, cols = (np.arange(0, n - WINDOW + 1, step) for n in inner.shape)
        y, x = (v.ravel() for v in np.meshgrid(rows, cols, indexing="ij"))
        held = area[y + WINDOW, x + WINDOW] - area[y, x + WINDOW] - area[y + WINDOW, x] + area[y, x]
        corners = np.stack([y, x], axis=-1)[held == WINDOW**2]
        if len(corners) <= MOST:
            break
    return corners[:MOST]


def _polar_bins() -> tuple[np.ndarray, np.ndarray]:
    """Bin of each frequency of a window's transform (-1: none), and each bin's mean wave, cycles per px [k,2]."""
    fy, fx = np.meshgrid(np.fft.fftfreq(WINDOW), np.fft.fftfreq(WINDOW), indexing="ij")
    ring = np.digitize(np.hypot(fx, fy) * WINDOW, RINGS) - 1
    angle = np.arctan2(fy, fx)
    sector = (np.mod(angle / np.pi + 0.5 / SECTORS, 1.0) * SECTORS).astype(int) % SECTORS
    half = (fy > 0) | ((fy == 0) & (fx > 0))
    bins = np.where((ring >= 0) & (ring < len(RINGS) - 1) & half, ring * SECTORS + sector, -1)
    wave = []
    for k in range((len(RINGS) - 1) * SECTORS):
        own = bins == k
        turn = 0.5 * np.angle(np.exp(2j * angle[own]).mean())
        wave.append(np.hypot(fx, fy)[own].mean() * np.array([np.cos(turn), np.sin(turn)]))
    return bins, np.array(wave)


def _window_power(window: np.ndarray, bins: np.ndarray) -> np.ndarray:
    """Mean power of each bin of the spectrum of a window [t,n,n] under a Hann taper."""
    taper = np.hanning(WINDOW + 2)[1:-1]
    taper = taper[:, None] * taper
    mean = (window * taper).sum(axis=(1, 2), keepdims=True) / taper.sum()
    power = (np.abs(np.fft.fft2((window - mean) * taper)) ** 2).mean(axis=0) / (taper**2).sum()
    own = bins >= 0
    return np.bincount(bins[own], power[own]) / np.bincount(bins[own])


def _whitened(at, power, wave, count, pictures: int, scale: float) -> WhitenedSpectra:
    """Log power over the noise, in units of what is left to chance and to each window's own pattern."""
    radius, angle = np.log(np.hypot(*wave.T)), 2.0 * np.arctan2(wave[:, 1], wave[:, 0])
    power = np.maximum(power, 1e-3 * np.median(power) + 1e-12)
    # the least that any window holds at the finest scales is noise
    noise = float(np.percentile(power[:, radius > radius.max() - 0.3].min(axis=1), 5.0))
    log = np.log(np.maximum(power - 0.7 * noise, 0.1 * power))
    chance = 1.0 / np.maximum(LOOKS * count * pictures, 1.0) + REST**2 + (FAINT * noise / power) ** 2
    own = [
        CONTRAST * np.ones_like(radius),
        SLOPE * (radius - radius.mean()),
        TURN * np.cos(angle),
        TURN * np.sin(angle),
    ]
    shared = np.stack(own, axis=-1)
    spread = shared @ shared.T + chance[:, :, None] * np.eye(len(wave))
    whitener = np.linalg.inv(np.linalg.cholesky(spread))
    knots = np.linspace(radius.min(), radius.max(), 5)
    hats = [FILTER * np.interp(radius, knots, row) for row in np.eye(5)]
    # a mean of any size; codecs prefer rows to columns by little
    fixed = np.stack([3.0 * np.ones_like(radius), *hats, 0.1 * np.cos(angle), 0.1 * np.sin(angle)], axis=-1)
    log = np.einsum("nkl,nl->nk", whitener, log - log.mean())
    return WhitenedSpectra(at, wave * scale, whitener, log, whitener @ fixed)


def _plane_jacobian(camera: PinholeCamera, at: np.ndarray, normal: np.ndarray) -> np.ndarray | None:
    """d(plane)/d(picture) [n,2,2] at points of the picture, of a plane at a median depth of 1; None if it is not seen.

    Args:
        camera: for its focal length.
        at: px.
        normal: of the plane, in camera axes.
    """
    focal = np.asarray(camera.focal)
    ray = np.concatenate([(at - np.asarray(camera.center)) / focal, np.ones((len(at), 1))], axis=1)
    facing = -ray @ normal
    if facing.min() <= max(facing.max(), 0.0) / FARTHEST:
        return None
    first = np.cross(normal, [1.0, 0.0, 0.0] if abs(normal[0]) < 0.9 else [0.0, 1.0, 0.0])
    first /= np.linalg.norm(first)
    axes = np.stack([first, np.cross(normal, first)])
    # X = r / (-r.n): dX = dr / (-r.n) + r (dr.n) / (r.n)^2
    moved = (
        axes[:, :2] / facing[:, None, None] + (ray @ axes.T)[..., None] * (normal[:2] / facing[:, None] ** 2)[:, None]
    )
    return moved / focal * np.median(facing)
