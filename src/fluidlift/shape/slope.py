"""How steep a stream or a film runs, and how the camera is tilted over it, from the perspective of its motion.

Model: a plane that is level across the stream. Motion in it, at the distances l along and c across (both -1 to 1 over
the fluid), is a smooth field V(l, c) = V_l d + V_c e: a profile across, a gain along, banks that open or close, a
bend. A point at depth Z = h / (n.r) on the ray r = (x, y, 1) moves in the picture by f / Z (V_xy - x V_z). Every such
field is linear in its coefficients, so their prior and the noise are integrated out exactly (Bayesian linear
regression), and what is left is the evidence for the plane alone: parallel streamlines that meet in a vanishing point,
speeds that grow as they come nearer, weighed by how free the field is to do the same.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage
from scipy.special import logsumexp

from fluidlift.shape.heights import FARTHEST
from fluidlift.shape.texture_gradient import WhitenedSpectra, texture_evidence, weighed
from fluidlift.shape.view import PictureEvidence
from fluidlift.shape.view.habit import ROLL
from fluidlift.types import FluidKind, PinholeCamera, SlopeEvidence
from fluidlift.types.kind import STEEPEST_STREAM, STREAM

PATCHES = 160
"""pieces that the fluid's picture is cut into"""
LOOKS = 0.18
"""independent looks per patch: errors of optical flow, and what the model leaves out, reach over two to three patches.
Chosen with `USUAL` among 16 settings on 150 made streams with eddies; from 0.12 to 0.25 the error of the slope hardly
changes (6.0 to 6.4 degrees there). On 150 others it is 6.2 (+- 0.8); 16 if all are taken as level"""
FEWEST = 12
"""patches that a plane is read from"""
BEYOND = 0.1
"""share of the patches that may lie above a plane's vanishing line (spray, errors of the mask) where it is possible"""
LEVEL = 0.6
"""prior share of streams that are level within a degree or two (rivers, channels; the others are films and chutes)"""
STEEP = 20.0
"""degrees, scale of the half-normal prior of the slope of the others"""
STEEP_RIVER = 6.0
"""degrees, the same under the open sky: channels of rivers and brooks fall by 1 % (pools and riffles) to 25 % at most
(cascades; Montgomery and Buffington 1997), of 14 degrees; films and boards are filmed from near"""
UNMODELLED = 2.0
"""actual over computed standard error of the slope, on made streams with eddies, bends and uneven profiles."""
BELIEF = 0.5
"""power that the evidence for the tilt is taken to: as it stands, the error of the pitch is 1.2 to 1.5 times what the
posterior says on three sets of made streams (238, of which 58 with measured optical flow), so weighed 1.0 to 1.06
times. The motion still draws the pitch up by some 4 degrees: no motion speaks against a steep view"""
FREEDOM = np.array([0.08, 0.25, 0.6, 1.2])
"""how far the field may be from uniform, as multiples of `USUAL`; each as likely"""
NOISE = np.array([0.015, 0.03, 0.06, 0.12, 0.24, 0.48, 0.96])
"""px over the mean displacement; each as likely. Ripples of calm water move each on its own way, and their mean over a
second is as uncertain as it is large: with 0.24 at most, a river that mirrors its trees was level with a probability of
0.02, on a slope of 25 +- 20 degrees"""
TURNS = np.radians(np.arange(-12.0, 13.0, 3.0))
"""about the headings that fit the mean motion: the steeper a plane, the more headings look alike, and the best alone
draws slopes down"""
LEAST_NOISE = 0.05
"""px, of optical flow at its best"""
USUAL = np.array([1.0, 0.25, 0.5, 0.2, 0.3, 0.18, 0.15, 0.2, 0.05, 0.08, 0.2, 0.1, 0.1])
"""standard deviations over the mean speed of V_l: 1, c, c^2, c^3, c^4, l, lc, l^2, and V_c: 1, c, l, lc, l^2. A
parabola across has -0.5 to -1 in c^2; a stream that gets half as fast again along the view 0.2 in l; banks that close
by 5 degrees 0.09 in c of V_c, a bend by 10 degrees 0.18 in its l. What changes along the stream must be rarer than what
changes across it, or perspective says nothing: twice the deviations of l and of c in V_c cost about one degree"""


@dataclass(frozen=True)
class SlopePrior:
    """How steep such streams are, before their motion is looked at."""

    level: float = LEVEL
    """share of them that are level"""
    steep: float = STEEP
    """degrees, scale of the half-normal prior of the slope of the others"""


USUAL_SLOPES = SlopePrior()
"""where nothing is known of what lies around"""


@dataclass(frozen=True)
class FlowPatches:
    """Motion of pieces of the fluid's picture."""

    at: Float[np.ndarray, "n 2"]
    """px, the middle of the way that was seen"""
    motion: Float[np.ndarray, "n 2"]
    """px per frame, medians"""
    weight: Float[np.ndarray, " n"]
    """0 to 1"""


@dataclass(frozen=True)
class TiltEvidence:
    """What the motion of a stream says about the tilt of the camera."""

    pitch: float
    roll: float
    """degrees, median and mean of the posterior"""
    pitch_error: float
    """degrees, standard deviation of the posterior"""
    gained: float
    """0 to 1: share of the prior's variance of the pitch that the motion took away"""


def flow_patches(
    mask: Bool[np.ndarray, "h w"], motion: Float[np.ndarray, "h w 2"], trust: Float[np.ndarray, "h w"]
) -> FlowPatches | None:
    """Medians of the motion over squares of the picture; None where too little is known."""
    inner = np.asarray(ndimage.binary_erosion(mask, iterations=2) if mask.sum() > 2000 else mask, bool)
    rows, cols = np.where(inner & (trust > 0.3))
    if len(rows) < 10 * FEWEST:
        return None
    size = max(3, round(np.sqrt(mask.sum() / PATCHES)))
    _, patch, count = np.unique(rows // size * mask.shape[1] + cols // size, return_inverse=True, return_counts=True)
    ends = np.cumsum(count)
    middle = np.stack([ends - count + (count - 1) // 2, ends - count + count // 2])
    values = np.stack([cols + 0.5, rows + 0.5, motion[rows, cols, 0], motion[rows, cols, 1]])
    medians = np.stack([v[np.lexsort((v, patch))][middle].mean(axis=0) for v in values], axis=-1)
    share = np.bincount(patch, trust[rows, cols]) / size**2
    kept = (count >= 0.3 * size**2) & np.isfinite(medians).all(axis=1)
    if kept.sum() < FEWEST:
        return None
    at, flow = medians[kept, :2], medians[kept, 2:]
    return FlowPatches(at + 0.5 * flow, flow, _robust_weights(at, flow, np.clip(share[kept], 0.0, 1.0)))


def estimate_slope(
    camera: PinholeCamera,
    patches: FlowPatches | None,
    *,
    tilt_known: bool = True,
    prior: SlopePrior = USUAL_SLOPES,
) -> SlopeEvidence:
    """Slope of a stream under a camera whose tilt is known, or was estimated by `estimate_tilt`.

    A choice between two models by their posterior odds: level; or falling by an angle whose prior is half-normal. Where
    falling wins, its slope is the posterior's mean. Under an estimated tilt, a mean over both models, so is the slope.

    Args:
        camera: canonical, z up.
        patches: of the motion; None: nothing is known, and level is taken.
        tilt_known: the camera's tilt was given.
        prior: of the slope.
    """
    if patches is None:
        return SlopeEvidence(0.0, prior.steep, 0.0, 1.0, 0.0, "prior: too little motion to tell")
    slopes = np.arange(0.0, STEEPEST_STREAM + 1.0, 2.0)
    log = np.array([heading_evidence(camera, patches, np.radians(s))[0] for s in slopes])
    if not np.isfinite(log).any():
        return SlopeEvidence(0.0, prior.steep, 0.0, 1.0, 0.0, "prior: no plane is seen by the camera in all of it")
    likelihood = np.exp(log - log.max())
    share = likelihood * falling_prior(slopes, prior.steep)
    falling = float(share.sum())
    level = prior.level * likelihood[0] / (prior.level * likelihood[0] + (1.0 - prior.level) * falling)
    mean = float((share * slopes).sum() / max(falling, 1e-300))
    error = float(np.sqrt((share * (slopes - mean) ** 2).sum() / max(falling, 1e-300)))
    slope = (mean if level < 0.5 else 0.0) if tilt_known else (1.0 - level) * mean
    heading = heading_evidence(camera, patches, np.radians(slope))[1]
    source = "perspective of the motion" if slope > 0 else "prior: the motion does not speak against a level stream"
    return SlopeEvidence(slope, UNMODELLED * max(error, 1.0), float(np.degrees(heading)), float(level), mean, source)


def estimate_tilt(
    patches: FlowPatches | None, tilted: Callable[[float, float], PinholeCamera], picture: PictureEvidence,
    level_prior: float = LEVEL, kind: FluidKind = STREAM,
) -> TiltEvidence:  # fmt: skip
    """Pitch and roll of the camera over a stream of unknown slope, or standing water: means of their posterior.

    The motion and the pattern show the plane's tilt against the camera, not gravity: priors share it out between both,
    and what is seen beside the fluid.

    Args:
        patches: of the motion; None: too little is known of it, or it is none of the plane.
        tilted: camera for a pitch and a roll, degrees.
        picture: what else shows the tilt.
        level_prior: share of such streams that are level.
        kind: of the fluid, one that is nearly level: how people film it.
    """
    pitches, rolls = np.arange(-4.0, 89.0, 4.0), np.array([-4.0, 0.0, 4.0])
    if picture.learned is not None:
        rolls = picture.learned.rolls(ROLL)
    slopes = np.array([0.0, 5.0, 10.0, 16.0, 22.0, 30.0, 38.0])
    others = falling_prior(slopes, steepness(picture))
    prior = np.where(slopes > 0, (1.0 - level_prior) * others, level_prior)
    cameras = [[tilted(float(p), float(r)) for r in rolls] for p in pitches]
    if patches is None:
        slopes, prior = slopes[:1], np.ones(1)
        best = np.zeros((len(pitches), len(rolls), 1, 2))
    else:
        best = np.array([[[best_heading(c, patches, np.radians(s)) for s in slopes] for c in row] for row in cameras])
    # the vanishing line of a plane that comes down towards the camera lies above the horizon
    rise = np.degrees(np.arctan(-np.tan(np.radians(slopes)) * np.sin(best[..., 1])))
    habit = picture.lying(kind, pitches, cameras, rise) + np.log(prior)
    log = BELIEF * best[..., 0] + habit - 0.5 * ((rolls / ROLL) ** 2)[None, :, None]
    log += np.array([[picture.tilt(c) for c in row] for row in cameras])[..., None]
    if picture.texture is not None and (patches is not None or kind.is_standing_water):
        seen = _texture_evidence([row[1] for row in cameras], picture.texture, slopes, best[:, 1, :, 1])
        log += weighed(seen, habit[:, 1])[:, None]
    log = picture.with_learned(np.asarray(logsumexp(log, axis=2)), pitches, rolls)
    return tilt_posterior(pitches, rolls, log, kind.usual_pitch)


def tilt_posterior(
    pitches: Float[np.ndarray, " p"], rolls: Float[np.ndarray, " r"], log: Float[np.ndarray, "p r"],
    pitch_prior: tuple[float, float],
) -> TiltEvidence:  # fmt: skip
    """Median pitch and mean roll of a posterior that is known on an even grid (degrees), but for a constant.

    The median is the pitch with the least error to be expected; between two habits of filming, a mean is neither.
    """
    if not np.isfinite(log).any():
        return TiltEvidence(pitch_prior[0], 0.0, pitch_prior[1], 0.0)
    share = np.exp(log - log.max())
    share /= share.sum()
    of_pitch = share.sum(axis=1)
    ends = np.append(pitches, 2.0 * pitches[-1] - pitches[-2]) - 0.5 * (pitches[1] - pitches[0])
    pitch = float(np.interp(0.5, np.concatenate([[0.0], np.cumsum(of_pitch)]), ends))
    error = float(np.sqrt((of_pitch * (pitches - pitch) ** 2).sum()))
    roll = float((share.sum(axis=0) * rolls).sum())
    return TiltEvidence(pitch, roll, error, 1.0 - min(error / pitch_prior[1], 1.0) ** 2)


def _texture_evidence(
    cameras: list[PinholeCamera], texture: WhitenedSpectra, slopes: np.ndarray, headings: np.ndarray
) -> np.ndarray:
    """[n, k] for each camera and slope (degrees) with its heading (rad): every second camera's, and between them."""
    known = np.arange(0, len(cameras), 2)
    found = np.array([
        [texture_evidence(cameras[i], texture, plane_axes(np.radians(s), h)[2])
         for s, h in zip(slopes, headings[i], strict=True)] for i in known
    ])  # fmt: skip
    # planes that are not seen in all of it: less likely than any other, by far
    found = np.where(np.isfinite(found), found, -1e4)
    return np.stack([np.interp(np.arange(len(cameras)), known, column) for column in found.T], axis=-1)


def speed_along(
    camera: PinholeCamera, patches: FlowPatches, axes: Float[np.ndarray, "3 3"], drop: float
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Distance along the stream and downstream speed (per frame) of each patch, in the unit of `drop`.

    Args:
        camera: canonical.
        patches: of the motion.
        axes: of the plane, as from `plane_axes`.
        drop: distance of the plane from the camera, along its normal.
    """
    _, ray, along, across = basis(camera, patches.at, axes)
    depth = drop / np.maximum(-ray @ axes[2], 1e-9)
    return (ray @ axes[0]) * depth, _downstream(patches.motion, along, across) * depth


def basis(camera: PinholeCamera, at: np.ndarray, axes: np.ndarray):
    """Points (x, y) of the picture, their rays, and the image motion of unit velocities along and across at depth 1."""
    rotation, focal = camera.camera_from_world.rotation, np.asarray(camera.focal)
    x = (at - np.asarray(camera.center)) / focal
    ray = np.concatenate([x, np.ones((len(x), 1))], axis=1) @ rotation
    along, across = (focal * (v[:2] - x * v[2]) for v in (rotation @ axes[0], rotation @ axes[1]))
    return x, ray, along, across


def _downstream(motion: np.ndarray, along: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Share of `along` in motion = a along + b across, for each row."""
    determinant = along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]
    return (motion[:, 0] * across[:, 1] - motion[:, 1] * across[:, 0]) / determinant


def steepness(picture: PictureEvidence) -> float:
    """Degrees: scale of the prior of the slope of what is not level, by what is seen around it."""
    return STEEP if picture.sky is None else STEEP_RIVER


def falling_prior(slopes: np.ndarray, steep: float = STEEP) -> np.ndarray:
    """Half-normal of a scale `steep` over slopes > 0 (degrees), per step of the grid; sums to 1."""
    prior = np.exp(-0.5 * (slopes / steep) ** 2) * np.gradient(slopes) * (slopes > 0)
    return prior / prior.sum()


def best_heading(camera: PinholeCamera, patches: FlowPatches, slope: float) -> tuple[float, float]:
    """(log evidence, heading in rad) of the better of the headings that fit the mean motion."""
    found = [(plane_evidence(camera, patches, plane_axes(slope, h))[0], h) for h in headings(camera, patches, slope)]
    return max(found, default=(-np.inf, 0.0))


def heading_evidence(camera: PinholeCamera, patches: FlowPatches, slope: float) -> tuple[float, float]:
    """(log evidence, mean heading in rad) with the heading integrated out about those that fit the mean motion."""
    tried = np.add.outer(headings(camera, patches, slope), TURNS)
    log = np.array([[plane_evidence(camera, patches, plane_axes(slope, h))[0] for h in row] for row in tried])
    if not np.isfinite(log).any():
        return -np.inf, 0.0
    share = np.exp(log - log.max())
    side = int(np.argmax(share.sum(axis=1)))
    return float(logsumexp(log)), float(np.average(tried[side], weights=share[side]))


def plane_axes(slope: float, heading: float) -> Float[np.ndarray, "3 3"]:
    """Rows: downstream, across (to the left), normal of a plane that falls by `slope` (rad) towards `heading` (rad)."""
    s, c = np.sin(slope), np.cos(slope)
    ahead = np.array([np.cos(heading), np.sin(heading), 0.0])
    return np.stack([c * ahead - [0, 0, s], [-ahead[1], ahead[0], 0.0], s * ahead + [0, 0, c]])


def headings(camera: PinholeCamera, patches: FlowPatches, slope: float) -> list[float]:
    """Headings (rad) of streams of that slope (rad) that run as the mean motion does in the picture."""
    x, mean = _middle(camera, patches)
    normal = np.cross(x, [*mean, 0.0]) @ camera.camera_from_world.rotation
    flat = np.hypot(normal[0], normal[1])
    cosine = np.tan(slope) * normal[2] / max(flat, 1e-12)
    if abs(cosine) > 1.0:
        return []
    base, turn = np.arctan2(normal[1], normal[0]), np.arccos(cosine)
    found = []
    for heading in (base + turn, base - turn):
        ahead = camera.camera_from_world.rotation @ plane_axes(slope, heading)[0]
        if (ahead[:2] - x[:2] * ahead[2]) @ mean > 0:
            found.append(float(heading))
    return found


def plane_evidence(
    camera: PinholeCamera, patches: FlowPatches, axes: Float[np.ndarray, "3 3"]
) -> tuple[float, Float[np.ndarray, " k"]]:
    """Logarithm of the evidence for a plane with these axes, and the coefficients of the field over its mean speed.

    Minus infinity where the camera does not see such a plane in all patches.
    """
    columns = _columns(camera, patches, axes)
    return (-np.inf, np.zeros(len(USUAL))) if columns is None else field_evidence(patches, columns, USUAL)


def field_evidence(
    patches: FlowPatches, columns: Float[np.ndarray, "n 2 k"], usual: Float[np.ndarray, " k"]
) -> tuple[float, Float[np.ndarray, " k"]]:
    """Logarithm of the evidence for a field that is linear in its coefficients, and these over its mean speed.

    Args:
        patches: of the motion.
        columns: px per frame that each coefficient moves each patch by; the first is a uniform stream of unit speed.
        usual: standard deviations of the coefficients over the mean speed, as `USUAL`.
    """
    first, motion, weight = columns[..., 0], patches.motion, LOOKS * patches.weight
    speed = float((weight[:, None] * first * motion).sum() / (weight[:, None] * first * first).sum())
    if speed <= 0:
        return -np.inf, np.zeros(len(usual))
    columns = columns * speed
    rest = motion - columns[..., 0]  # the prior mean is a uniform field
    flat = columns.reshape(-1, len(usual))
    weighted = (np.repeat(weight, 2)[:, None] * flat).T
    normal, moment = weighted @ flat, weighted @ rest.reshape(-1)
    energy = float((weight[:, None] * rest**2).sum())
    looks = 2.0 * weight.sum()
    size = max(float(np.average(np.linalg.norm(motion, axis=1), weights=patches.weight)), 1e-9)
    noise = np.maximum(NOISE * size, LEAST_NOISE)
    spread = usual * np.concatenate([np.ones((len(FREEDOM), 1)), np.repeat(FREEDOM[:, None], len(usual) - 1, 1)], 1)
    variance = noise[:, None, None, None] ** 2
    # in units of the prior: I + S (A'WA / noise^2) S
    scaled = spread[None, :, :, None] * normal * spread[None, :, None, :] / variance + np.eye(len(usual))
    right = spread[None] * moment / variance[..., 0]
    found = np.linalg.solve(scaled, right[..., None])[..., 0]
    misfit = energy / noise[:, None] ** 2 - (right * found).sum(-1)
    log = -looks * np.log(noise)[:, None] - 0.5 * misfit - 0.5 * np.linalg.slogdet(scaled)[1]
    share = np.exp(log - log.max())
    evidence = float(log.max() + np.log(share.mean()))
    field = np.einsum("ab,abk->k", share / share.sum(), spread[None] * found)
    field[0] += 1.0
    return evidence, field / max(abs(field[0]), 1e-9)


def _robust_weights(at: np.ndarray, motion: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Less weight for what no smooth field explains (a jet above a film, the wake of a rock): Student's t with four
    degrees of freedom about a quadratic in the picture, which stands for any plane and any field on it."""
    x = (at - at.mean(axis=0)) / np.maximum(at.std(axis=0), 1e-9)
    columns = np.stack([np.ones(len(x)), *x.T, *(x**2).T, x[:, 0] * x[:, 1]], axis=1)
    robust = weight
    for _ in range(8):
        root = np.sqrt(robust)[:, None]
        fit, *_ = np.linalg.lstsq(columns * root, motion * root, rcond=None)
        square = ((motion - columns @ fit) ** 2).sum(axis=1)
        variance = max(float(np.median(square)) / 1.39, LEAST_NOISE**2)  # 1.39: median of chi^2, two degrees of freedom
        robust = weight * 6.0 / (6.0 + square / variance)
    return robust


def _middle(camera: PinholeCamera, patches: FlowPatches) -> tuple[np.ndarray, np.ndarray]:
    mean = np.average(patches.motion, axis=0, weights=patches.weight)
    at = np.average(patches.at, axis=0, weights=patches.weight)
    x = (at - np.asarray(camera.center)) / np.asarray(camera.focal)
    return np.array([*x, 1.0]), mean / max(float(np.linalg.norm(mean)), 1e-12)


def _columns(camera: PinholeCamera, patches: FlowPatches, axes: np.ndarray) -> np.ndarray | None:
    """[n, 2, k] px: image motion of the fields of `USUAL` at unit speed, median depth 1."""
    _, ray, along, across = basis(camera, patches.at, axes)
    facing = -ray @ axes[2]
    if (facing <= 0).mean() > BEYOND:
        return None
    facing = np.maximum(facing, facing.max() / FARTHEST)
    inverse = facing / quantile(facing, 0.5)
    points = ray / inverse[:, None]
    l, c = to_unit(points @ axes[0]), to_unit(points @ axes[1])
    along, across = along * inverse[:, None], across * inverse[:, None]
    return field_columns(patches, along, across, l, c)


def field_columns(
    patches: FlowPatches, along: Float[np.ndarray, "n 2"], across: Float[np.ndarray, "n 2"],
    l: Float[np.ndarray, " n"], c: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "n 2 k"]:  # fmt: skip
    """px that the fields of `USUAL` move each patch by at unit speed.

    Args:
        patches: of the motion.
        along: px that unit speed downstream is seen as.
        across: px that unit speed across is seen as.
        l: distance along the stream, -1 to 1.
        c: distance across it, -1 to 1.
    """
    one = np.ones_like(l)
    # centred powers, so that their priors mean little to each other
    fields = [one, c, c**2 - 1 / 3, c**3 - 0.6 * c, c**4 - 0.2, l, l * c, l**2 - 1 / 3]
    # a bend turns the whole profile: what is smooth is the direction, V_c / V_l
    speed = _downstream(patches.motion, along, across)
    speed = np.clip(speed / max(quantile(speed, 0.5), 1e-12), 0.0, 3.0)
    turned = [speed * f for f in (one, c, l, l * c, l**2 - 1 / 3)]
    return np.stack([along * f[:, None] for f in fields] + [across * f[:, None] for f in turned], axis=-1)


def quantile(values: np.ndarray, share: float) -> float:
    """As `np.quantile`, which takes ten times as long for some hundred values; it is asked thousands of times."""
    ordered = np.sort(values)
    return float(np.interp(share * (len(ordered) - 1), np.arange(len(ordered)), ordered))


def to_unit(values: np.ndarray) -> np.ndarray:
    low, high = quantile(values, 0.02), quantile(values, 0.98)
    return (values - 0.5 * (low + high)) / max(0.5 * (high - low), 1e-9)
