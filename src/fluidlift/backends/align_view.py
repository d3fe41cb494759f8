"""The camera from which a body looks like a picture: silhouette and colours compared through the rasteriser.

For generators whose bodies stand upright but not as the picture saw them (TRELLIS). First all directions at a small
size, each with the distance and the place that fit the silhouette's spread and middle; then the best few by
Levenberg-Marquardt on what is drawn, at a larger size. A body of round shape and one colour has no direction, and the
result says so by its margin.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, UInt8

from fluidlift.backends.generator_view import Crop, box_of, require_picture
from fluidlift.errors import FluidliftError
from fluidlift.look.project import view_colors
from fluidlift.look.rasterize import render
from fluidlift.numerics.nearest import nearest
from fluidlift.types import Gaussians, PinholeCamera, RigidTransform

_ANGLE_STEP = 15.0
"""degrees between the azimuths tried first; half of it lies within the reach of the refinement"""
_ELEVATIONS = (-15.0, 5.0, 25.0, 45.0, 65.0, 85.0)
"""degrees that the camera stands above the body; fluids are hardly ever seen from below"""
_SIZES = (48, 64, 128)
"""px of the cut-out in the search, the refinement, and the last one"""
_COUNTS = (3000, 6000, 30000)
"""Gaussians drawn in them"""
_KEPT = (8, 2)
"""candidates that are refined, and refined to the last"""
_MARGIN = 1.2
"""cut-out over the fluid's box"""
_SPREAD_OF_FOCAL = 0.3
"""standard deviation of the logarithm of an unknown focal length about its usual value"""
_USUAL_FIELD_OF_VIEW = 50.0
"""degrees across the longer side, where nothing says better (as in the pipeline)"""


@dataclass(frozen=True)
class Aligned:
    """A camera, and how well it fits."""

    camera: PinholeCamera
    """of the original picture, principal point in its middle"""
    overlap: float
    """intersection over union of the silhouettes"""
    error: float
    """root mean square of colour (on black) and coverage over the cut-out"""
    margin: float
    """error of the best direction more than 30 degrees away, over that of the best: 1 means that they are as good"""


_NUMBERS = ("azimuth", "elevation", "roll", "log_distance", "u", "v", "log_focal")


@dataclass(frozen=True)
class _Pose:
    """Where the camera stands about the middle of the body, and where in the picture that middle appears."""

    azimuth: float
    """rad, from the x axis to the y axis"""
    elevation: float
    """rad"""
    roll: float
    """rad"""
    log_distance: float
    u: float
    v: float
    """px of the original picture"""
    log_focal: float

    def moved(self, step: np.ndarray) -> _Pose:
        numbers = np.array([getattr(self, name) for name in _NUMBERS]) + step
        return _Pose(*(float(x) for x in numbers))

    def camera(self, middle: np.ndarray, size: tuple[int, int]) -> PinholeCamera:
        ca, sa, ce, se = *_cos_sin(self.azimuth), *_cos_sin(self.elevation)
        back = np.array([ce * ca, ce * sa, se])
        right = np.array([-sa, ca, 0.0])
        down = np.cross(-back, right)
        c, s = _cos_sin(self.roll)
        looking = np.stack([c * right + s * down, c * down - s * right, -back])
        focal = math.exp(self.log_focal)
        ray = np.array([(self.u - size[0] / 2) / focal, (self.v - size[1] / 2) / focal, 1.0])
        rotation = _turn_to_z(ray / np.linalg.norm(ray)).T @ looking
        eye = middle + math.exp(self.log_distance) * back
        center = (size[0] / 2, size[1] / 2)
        return PinholeCamera((focal, focal), center, size, RigidTransform(rotation, -rotation @ eye))


def align_view(
    body: Gaussians,
    image: UInt8[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    *,
    field_of_view: float | None = None,
) -> Aligned:
    """The camera of a picture in which an upright body (z up) is the masked thing.

    Args:
        body: of any size and place.
        image: u8, sRGB.
        mask: where it shows the body.
        field_of_view: degrees across the longer side of the picture; None: 50 to start with, then fitted (loosely: a
            single view hardly tells it from the distance).

    Raises:
        InputRejected: no fluid in the picture.
        FluidliftError: no direction shows the body where the mask is.
    """
    require_picture(image, mask)
    size = (mask.shape[1], mask.shape[0])
    focal = 0.5 * max(size) / math.tan(math.radians(field_of_view or _USUAL_FIELD_OF_VIEW) / 2)
    free_focal = field_of_view is None
    middle = np.average(body.means.astype(np.float64), axis=0, weights=body.opacities.astype(np.float64) + 1e-9)

    stages = [
        _Comparison.of(_thinned(body, n), middle, image, mask, width) for n, width in zip(_COUNTS, _SIZES, strict=True)
    ]
    found = sorted((stages[0].loss(pose), i, pose) for i, pose in enumerate(_directions(stages[0], focal)))
    if not found or not math.isfinite(found[0][0]):
        raise FluidliftError("no direction shows the body. Needed: a body that can be seen. Do: try another seed.")
    fitted = [_refined(stages[1], pose, focal, 8, free_focal=False) for pose in _distinct(found, _KEPT[0])]
    fitted.sort(key=lambda pair: pair[0])
    last = [_refined(stages[2], pose, focal, 12, free_focal=free_focal) for _, pose in fitted[: _KEPT[1]]]
    loss, best = min(last, key=lambda pair: pair[0])
    others = [pose for _, pose in fitted if _apart(pose, best) > math.radians(30)]
    other = min((stages[2].loss(pose) for pose in others), default=math.inf)
    return Aligned(
        best.camera(middle, size), stages[2].overlap(best), math.sqrt(loss), math.sqrt(other / max(loss, 1e-12))
    )


@dataclass(frozen=True)
class _Comparison:
    """A body and the picture that it should look like, both in a small cut-out."""

    body: Gaussians
    colours: np.ndarray | None
    """[n,3] where they are the same from all sides"""
    middle: np.ndarray
    target: np.ndarray
    """[h,w,4]: colour on black, coverage"""
    known: np.ndarray
    """[h,w,1]: share of a pixel that lies in the original picture; beyond its edge nobody knows"""
    crop: Crop
    size: tuple[int, int]

    @classmethod
    def of(cls, body: Gaussians, middle: np.ndarray, image: np.ndarray, mask: np.ndarray, width: int) -> _Comparison:
        import cv2

        left, upper, right, lower = box_of(mask)
        half = max(2, round(0.5 * _MARGIN * (max(right - left, lower - upper) + 1)))
        x, y = (left + right + 1) // 2 - half, (upper + lower + 1) // 2 - half
        inside = mask[..., None].astype(np.float32)
        whole = np.dstack([image.astype(np.float32) / 255.0 * inside, inside, np.ones_like(inside)])
        square = np.zeros((2 * half, 2 * half, 5), np.float32)
        rows, columns = slice(max(y, 0), y + 2 * half), slice(max(x, 0), x + 2 * half)
        part = whole[rows, columns]
        square[rows.start - y :, columns.start - x :][: part.shape[0], : part.shape[1]] = part
        way = cv2.INTER_AREA if 2 * half >= width else cv2.INTER_LINEAR
        target, known = (cv2.resize(x, (width, width), interpolation=way) for x in (square[..., :4], square[..., 4]))
        crop = Crop.of_box((x, y, x + 2 * half, y + 2 * half), (width, width))
        size = (mask.shape[1], mask.shape[0])
        flat = body.sh.shape[1] == 1
        colours = view_colors(body, PinholeCamera((1, 1), (0, 0), (1, 1))) if flat else None
        return cls(body, colours, middle, target, known[..., None], crop, size)

    def drawn(self, pose: _Pose) -> np.ndarray:
        """[h,w,4]: colour on black, coverage; 0 where the original picture ends."""
        camera = pose.camera(self.middle, self.size)
        seen = render(self.body, self.crop.seen(camera), features=self.colours)
        return np.dstack([np.clip(seen.image, 0.0, 1.0), seen.alpha]) * self.known

    def residual(self, pose: _Pose) -> np.ndarray:
        """Differences, flat, scaled so that the sum of their squares is the mean over the mask's pixels."""
        return ((self.drawn(pose) - self.target) / math.sqrt(4.0 * max(self.target[..., 3].sum(), 1.0))).ravel()

    def loss(self, pose: _Pose) -> float:
        return float((self.residual(pose) ** 2).sum())

    def overlap(self, pose: _Pose) -> float:
        drawn, seen = self.drawn(pose)[..., 3] > 0.5, self.target[..., 3] > 0.5
        return float((drawn & seen).sum() / max((drawn | seen).sum(), 1))


def _directions(stage: _Comparison, focal: float) -> Iterator[_Pose]:
    """All directions, each with the distance and the place in the picture that fit the silhouette's."""
    wanted, radius = _place(stage.target[..., 3], stage.crop)
    spread = stage.body.means - stage.middle
    for elevation in np.radians(_ELEVATIONS):
        for azimuth in np.radians(np.arange(0.0, 360.0, _ANGLE_STEP)):
            pose = _Pose(float(azimuth), float(elevation), 0.0, 0.0, *wanted, math.log(focal))
            across = spread @ pose.camera(stage.middle, stage.size).camera_from_world.rotation[:2].T
            extent = math.sqrt(max(float((across**2).sum(1).mean()), 1e-12))
            pose = replace(pose, log_distance=math.log(focal * extent / radius))
            for _ in range(3):
                place, seen_radius = _place(stage.drawn(pose)[..., 3], stage.crop)
                if not math.isfinite(seen_radius):
                    break
                pose = pose.moved(
                    np.array([0, 0, 0, math.log(seen_radius / radius), wanted[0] - place[0], wanted[1] - place[1], 0])
                )
            yield pose


def _place(coverage: Float[np.ndarray, "h w"], crop: Crop) -> tuple[tuple[float, float], float]:
    """Middle (px of the original) and root mean square radius of a silhouette; infinite if there is none."""
    total = float(coverage.sum())
    if total < 1.0:
        return (0.0, 0.0), math.inf
    rows, columns = np.mgrid[: coverage.shape[0], : coverage.shape[1]] + 0.5
    u, v = float((coverage * columns).sum() / total), float((coverage * rows).sum() / total)
    around = float((coverage * ((columns - u) ** 2 + (rows - v) ** 2)).sum() / total)
    (sx, sy), (ox, oy) = crop.scale, crop.offset
    return ((u - ox) / sx, (v - oy) / sy), math.sqrt(max(around, 1e-6)) / sx


def _refined(stage: _Comparison, pose: _Pose, focal: float, steps: int, *, free_focal: bool) -> tuple[float, _Pose]:
    """Levenberg-Marquardt with differences of a tenth of what the search steps by."""
    px = 1.0 / stage.crop.scale[0]  # one pixel of the cut-out
    delta = np.array([0.02, 0.02, 0.02, 0.01, 0.5 * px, 0.5 * px, 0.02])
    free = np.arange(7 if free_focal else 6)

    def residual(p: _Pose) -> np.ndarray:
        # unseen things hold the focal length near the usual one, and the camera level
        prior = 0.02 * np.array([(p.log_focal - math.log(focal)) / _SPREAD_OF_FOCAL, p.roll / 0.2])
        return np.concatenate([stage.residual(p), prior])

    return _levenberg_marquardt(residual, pose, delta, free, steps)


def _levenberg_marquardt(
    residual: Callable[[_Pose], np.ndarray], pose: _Pose, delta: np.ndarray, free: np.ndarray, steps: int
) -> tuple[float, _Pose]:
    damping, r = 1e-2, residual(pose)
    loss = float(r @ r)
    for _ in range(steps):
        columns = []
        for k in free:
            step = np.zeros(7)
            step[k] = delta[k]
            columns.append((residual(pose.moved(step)) - residual(pose.moved(-step))) / 2)
        jacobian = np.stack(columns, axis=1)  # per delta, so that all unknowns are of one size
        normal, slope = jacobian.T @ jacobian, jacobian.T @ r
        before = loss
        for _ in range(4):
            step = np.zeros(7)
            scaled = np.linalg.solve(normal + damping * (np.diag(np.diag(normal)) + 1e-9 * np.eye(len(free))), -slope)
            step[free] = delta[free] * np.clip(scaled, -12, 12)
            trial = pose.moved(step)
            new = residual(trial)
            if float(new @ new) < loss:
                pose, r, loss, damping = trial, new, float(new @ new), max(damping / 5, 1e-5)
                break
            damping *= 6
        if before - loss < 1e-4 * before:
            break
    return loss, pose


def _distinct(found: list[tuple[float, int, _Pose]], count: int) -> list[_Pose]:
    """The best poses that are more than 20 degrees apart."""
    kept: list[_Pose] = []
    for _, _, pose in found:
        if len(kept) < count and all(_apart(pose, other) > math.radians(20) for other in kept):
            kept.append(pose)
    return kept


def _apart(a: _Pose, b: _Pose) -> float:
    """rad between two directions."""

    def back(p: _Pose) -> np.ndarray:
        (ca, sa), (ce, se) = _cos_sin(p.azimuth), _cos_sin(p.elevation)
        return np.array([ce * ca, ce * sa, se])

    return math.acos(float(np.clip(back(a) @ back(b), -1.0, 1.0)))


def _thinned(body: Gaussians, count: int) -> Gaussians:
    """At most `count` of the Gaussians, as much wider as closes the gaps that the others leave.

    That is no more than what keeps the area covered, and no more than up to the nearest neighbour: bodies whose
    Gaussians lie many over each other have no gaps.
    """
    seen = body.select(body.opacities > 0.02)
    if len(seen) <= count:
        return seen
    pick = seen.select(np.sort(np.random.default_rng(0).choice(len(seen), count, replace=False)))
    spacing = np.median(nearest(pick.means, pick.means, 2)[0][:, 1])
    width = max(float(np.median(pick.scales.max(axis=1))), 1e-12)
    wider = float(np.clip(spacing / width, 1.0, math.sqrt(len(seen) / count)))
    return replace(pick, scales=pick.scales * wider)


def _turn_to_z(direction: np.ndarray) -> np.ndarray:
    """The shortest rotation that takes a unit vector (not -z) to z."""
    x, y, z = direction
    return np.array([
        [1 - x * x / (1 + z), -x * y / (1 + z), -x], [-x * y / (1 + z), 1 - y * y / (1 + z), -y], [x, y, z],
    ])  # fmt: skip


def _cos_sin(angle: float) -> tuple[float, float]:
    return math.cos(angle), math.sin(angle)
