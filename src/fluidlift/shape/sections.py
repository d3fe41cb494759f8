"""Whether a stream is one slope or a chute above a level pool, from the perspective of its motion.

Model: for a stream that runs straight in plan, the surface is level across; it falls by one angle down to a line across
the stream and is level below. Motion on it is the smooth field of `shape.slope`, which may also get slower or faster
below that line. In the picture such a stream turns at the line, and all of it at once; one plane can only explain that
by a bend, which is smooth. Both models are weighed by their evidence, with the field and the noise integrated out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp

from fluidlift.shape import slope
from fluidlift.shape.heights import FARTHEST
from fluidlift.shape.slope import FlowPatches
from fluidlift.types import PinholeCamera

BROKEN = 0.1
"""prior share of streams that are a chute above a pool (a choice; odds of the evidence below 9 change nothing)"""
CHUTES = np.array([12.0, 18.0, 25.0, 32.0, 40.0, 50.0, 60.0])
"""degrees that the chute falls by; each as likely"""
SHARES = np.array([0.15, 0.25, 0.35, 0.45, 0.55, 0.65, 0.75, 0.85])
"""of the fluid's picture that lies above the line; each as likely"""
SLOWED = np.array([0.4, 0.3])
"""standard deviations over the mean speed of a step and of a ramp of the speed below the line: a pool takes a third to
a half of a chute's speed at once (hydraulic jump), and more on the way"""
FEWEST = 5
"""patches above and below the line"""
SURE = 0.9
"""probability from which a stream is taken for a chute above a pool; a smooth bend and one slope are the usual case"""


@dataclass(frozen=True)
class BrokenSlope:
    """A chute above a level pool; lengths in units of the camera's height above the pool."""

    chute: float
    """degrees"""
    heading: float
    """rad from the canonical x axis towards y, where the stream runs to"""
    foot: float
    """distance over the ground from below the camera, along the heading, where the pool begins"""
    log: float
    """logarithm of the evidence"""

    def height(self, reach: tuple[float, float]) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """Distances along the heading, and z there, of the chute's top, its foot and the pool's end."""
        along = np.array([min(reach[0], self.foot - 1e-3), self.foot, max(reach[1], self.foot + 1e-3)])
        return along, np.array([-1.0 + np.tan(np.radians(self.chute)) * (self.foot - along[0]), -1.0, -1.0])


@dataclass(frozen=True)
class SectionEvidence:
    """What the motion says about a chute above a pool."""

    share: float
    """probability that the stream is one"""
    best: BrokenSlope | None
    """its likeliest form"""
    mean: float
    """degrees, posterior mean of the chute's slope"""
    standard_error: float
    """degrees, standard deviation of the posterior"""


def estimate_sections(camera: PinholeCamera, patches: FlowPatches | None) -> SectionEvidence:
    """One slope or two, under a camera whose tilt is known or was estimated.

    Args:
        camera: canonical, z up.
        patches: of the motion; None: one slope.
    """
    if patches is None:
        return SectionEvidence(0.0, None, 0.0, 0.0)
    broken = list(_broken(camera, patches))
    plain = _log_plain(camera, patches)
    if not broken:
        return SectionEvidence(0.0, None, 0.0, 0.0)
    log = np.array([b.log for b in broken])
    total = _log_broken(log)
    share = 1.0 / (1.0 + np.exp(np.clip(np.log((1.0 - BROKEN) / BROKEN) + plain - total, -700, 700)))
    weight = np.exp(log - log.max())
    degrees = np.array([b.chute for b in broken])
    mean = float(np.average(degrees, weights=weight))
    error = float(np.sqrt(np.average((degrees - mean) ** 2, weights=weight)))
    return SectionEvidence(float(share), broken[int(np.argmax(log))], mean, slope.UNMODELLED * max(error, 2.0))


def _log_broken(log: np.ndarray) -> float:
    """Over chutes and lines, of which those that the camera does not see have none; headings were maximised."""
    return float(logsumexp(log) - np.log(len(CHUTES) * len(SHARES)))


def _log_plain(camera: PinholeCamera, patches: FlowPatches) -> float:
    """Of one plane, level or falling."""
    slopes = np.array([0.0, 5.0, 10.0, 16.0, 22.0, 30.0, 38.0])
    prior = (1.0 - slope.LEVEL) * slope.falling_prior(slopes)
    prior[0] = slope.LEVEL
    log = [slope.best_heading(camera, patches, np.radians(s))[0] for s in slopes]
    return float(logsumexp(log, b=prior)) if np.isfinite(log).any() else -np.inf


def _broken(camera: PinholeCamera, patches: FlowPatches) -> Iterator[BrokenSlope]:
    """The best heading of every chute and line that the camera can see."""
    for chute in CHUTES:
        for share in SHARES:
            found = [
                _evaluated(camera, patches, chute, share, heading)
                for heading in _headings(camera, patches, np.radians(chute), share)
            ]
            good = [f for f in found if f is not None]
            if good:
                yield max(good, key=lambda f: f.log)


def _headings(camera: PinholeCamera, patches: FlowPatches, chute: float, share: float) -> list[float]:
    """Headings (rad) as the motion of the pool, that of the chute, and the mean of both ask for."""
    rough = slope.headings(camera, patches, 0.0)
    found: list[float] = []
    for heading in rough:
        s = _ground_along(camera, patches, heading)
        above = s < np.quantile(s, share)
        if min(above.sum(), (~above).sum()) < FEWEST:
            continue
        pool, upper = (_part_of(patches, part) for part in (~above, above))
        level = slope.headings(camera, pool, 0.0)
        steep = slope.headings(camera, upper, chute)
        found += level + steep
        found += [a + 0.5 * _turn(b - a) for a in level for b in steep if abs(_turn(b - a)) < np.radians(60.0)]
    return found


def _turn(angle: float) -> float:
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


def _part_of(patches: FlowPatches, part: np.ndarray) -> FlowPatches:
    """Some of the patches."""
    return replace(patches, at=patches.at[part], motion=patches.motion[part], weight=patches.weight[part])


def _ground_along(camera: PinholeCamera, patches: FlowPatches, heading: float) -> np.ndarray:
    """Where the rays of the patches meet the pool's level, one below the camera, along the heading."""
    ray = camera.rays(patches.at)
    s = ray[:, 0] * np.cos(heading) + ray[:, 1] * np.sin(heading)
    # above the horizon a ray can only meet a chute that comes down towards the viewer
    return np.where(ray[:, 2] < -1e-6, s / np.maximum(-ray[:, 2], 1e-6), np.sign(s) * 1e6)


def _evaluated(
    camera: PinholeCamera, patches: FlowPatches, chute: float, share: float, heading: float
) -> BrokenSlope | None:
    s = _ground_along(camera, patches, heading)
    foot = slope.quantile(s, share)
    above = s < foot
    if abs(foot) > 1e3 or s.max() > 1e3 or min(above.sum(), (~above).sum()) < FEWEST:
        return None
    columns = _columns(camera, patches, (np.radians(chute), heading, foot), above)
    if columns is None:
        return None
    log, _ = slope.field_evidence(patches, columns, np.concatenate([slope.USUAL, SLOWED]))
    return BrokenSlope(float(chute), heading, foot, log) if np.isfinite(log) else None


def _columns(camera, patches, surface: tuple[float, float, float], above: np.ndarray) -> np.ndarray | None:
    """[n, 2, k] px: image motion of the fields of `slope.USUAL` and `SLOWED` at unit speed, median depth 1."""
    angle, heading, foot = surface
    steep, level = slope.plane_axes(angle, heading), slope.plane_axes(0.0, heading)
    drop = np.cos(angle) - np.sin(angle) * foot  # of the chute's plane below the camera
    parts = [slope.basis(camera, patches.at, axes) for axes in (steep, level)]
    facing = np.where(above, -parts[0][1] @ steep[2] / max(drop, 1e-9), -parts[1][1] @ level[2])
    if drop <= 0 or facing.min() <= facing.max() / FARTHEST:
        return None
    inverse = facing / slope.quantile(facing, 0.5)
    along, across = (np.where(above[:, None], a, b) * inverse[:, None] for a, b in zip(parts[0][2:], parts[1][2:]))
    points = parts[0][1] / facing[:, None]
    s = points @ level[0]
    run = np.where(above, (s - foot) / np.cos(angle), s - foot)
    l, c = slope.to_unit(run), slope.to_unit(points @ level[1])
    below = ~above
    ramp = np.where(below, l - l[below].min(), 0.0)
    columns = slope.field_columns(patches, along, across, l, c)
    extra = [along * (f - f.mean())[:, None] for f in (below.astype(float), ramp)]
    return np.concatenate([columns, np.stack(extra, axis=-1)], axis=-1)
