"""Rims of vessels: ellipses that the edges of a picture form.

Edges (Canny 1986) are cut into smooth arcs. One arc, or two that can be of one ellipse, give a candidate by direct
least squares (Fitzgibbon, Pilu and Fisher 1999). A candidate counts when most of its outline is an edge across which
the picture changes along the ellipse's normal (as in Lu et al. 2020, "Arc-support line segments revisited"). Of a rim
that the picture's edge cuts, what lies in the picture counts. Dark on dark, and glass before a bright wall, have edges
where the contrast is evened out (Zuiderveld 1994): they are looked for in both pictures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.spatial.distance import cdist

from fluidlift.shape.view.roundness import Ellipse

LONGEST = 512
"""px of the longer side of the picture that rims are looked for in"""
SHORTEST = 0.05
"""of that side, length of an arc that is looked at"""
SMALLEST, LARGEST = 0.05, 0.6
"""of that side, half the length of a rim"""
FEWEST = 16.0
"""px, the same (a choice: of 34 clips and six parts of each one has a rim below 30 px at 320 px that is none, and none
has at 512 px)"""
TURN, LEAST_TURN = 45.0, 12.0
"""degrees that an arc turns between its ends, at least: straighter ones say nothing of an ellipse; and those of an arc
that is paired with such a one: near and far side of a flat rim"""
CORNER = 50.0
"""degrees within `REACH` px at which an edge is cut"""
REACH = 6
"""px over which the direction of an edge is taken"""
MOST_ARCS = 60
"""arcs that are paired, the longest"""
SEEN = 0.65
"""share of the outline within the picture that is an edge, at least. Of random texture a third is"""
IN_PICTURE = 0.5
"""share of the outline that lies within the picture, at least: less is an arc or two, which any bend has"""
HALF_SEEN = 0.35
"""share of its upper and of its lower half that is an edge: one of them alone does not say how flat it is"""
OWN = 0.5
"""share of the outline within the picture that is an edge and lies on no rim that is seen better, at least: an arc of a
cup's rim and one of its handle have an ellipse too"""
NEAR = 2.2
"""px from an outline to its edge"""
ALONG = 20.0
"""degrees between the picture's gradient and the outline's normal"""
FLATTEST, NARROWEST = 0.12, 6.0 * NEAR
"""width over length, and px of half the width, at least: less is not told from two lines (of 34 clips and six parts of
each none of the 15 that were narrower was a vessel's: waves, lava, steps, pancakes)"""
SPREAD = 0.08
"""standard deviation of the logarithm of a rim's length over its width (a choice: thickness of the rim, its tilt)"""
EDGE = 1.5
"""px, error of half the width of a rim (inner or outer edge)"""
_NEIGHBOURS = tuple((i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j)
MOST = 4
"""rims that are kept, those seen best"""
EVENED, TILES = 4.0, 4
"""most that contrast is raised by, over its mean, and tiles along either side in which it is (a choice)"""
AROUND = 120
"""places along an outline that are looked at"""


def find_rims(picture: UInt8[np.ndarray, "h w 3"]) -> tuple[Ellipse, ...]:
    """Ellipses of a picture that can be level rims, those seen best first.

    Args:
        picture: sRGB, typical for the clip.
    """
    scale = min(LONGEST / max(picture.shape[:2]), 1.0)
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
    seen = _seen_in(grey) + _seen_in(cv2.createCLAHE(EVENED, (TILES, TILES)).apply(grey))
    kept: list[_Seen] = []
    for rim in sorted(seen, key=lambda e: -e.ellipse.likeness * np.sqrt(e.ellipse.axes[0])):
        if len(kept) < MOST and rim.has_own(kept):
            kept.append(rim)
    return tuple(
        Ellipse((e.center[0] / scale, e.center[1] / scale), e.covariance / scale**2, e.likeness, e.spread)
        for e in (rim.ellipse for rim in kept)
    )


def drawn_rim(center: tuple[float, float], axes: tuple[float, float], turned: float) -> Ellipse:
    """A rim that a person drew.

    Args:
        center: px.
        axes: px, half its length and half its width.
        turned: degrees clockwise from the picture's horizontal to the longer axis.
    """
    angle = np.radians(turned)
    axis, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    covariance = 0.25 * (axes[0] ** 2 * np.outer(axis, axis) + axes[1] ** 2 * np.outer(across, across))
    return Ellipse(center, covariance, 1.0, float(np.hypot(SPREAD, EDGE / axes[1])))


@dataclass(frozen=True)
class _Arc:
    """A smooth piece of an edge that turns one way."""

    points: Float[np.ndarray, "n 2"]
    """(u, v), px"""
    turn: float
    """degrees between its ends"""


@dataclass(frozen=True)
class _Seen:
    """A rim with what is seen of it."""

    ellipse: Ellipse
    edge: Float[np.ndarray, "n 2"]
    """(u, v), places of its outline that are an edge"""
    within: int
    """places of its outline that lie in the picture"""

    def has_own(self, others: Sequence[_Seen]) -> bool:
        """Whether enough of it lies on no other rim, of which none is found on the same edges, or nearly."""
        if any(_same(self.ellipse, other.ellipse) for other in others):
            return False
        free = np.ones(len(self.edge), bool)
        for other in others:
            free &= cdist(self.edge, _outline(other.ellipse)).min(axis=1) > 2.0 * NEAR
        return bool(free.sum() >= OWN * self.within)


def _seen_in(grey: UInt8[np.ndarray, "h w"]) -> list[_Seen]:
    """What can be rims in a picture, each perhaps several times."""
    grey = cv2.GaussianBlur(grey, (0, 0), 1.2)
    slope = np.stack([cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)], -1)
    strong = float(np.percentile(np.abs(slope).sum(-1), 92.0))
    edges = cv2.Canny(grey, 0.4 * strong, strong) > 0
    arcs = _arcs(edges, slope)
    tried = [(a.points,) for a in arcs if a.turn > TURN]
    tried += [(a.points, b.points) for a, b in combinations(arcs[:MOST_ARCS], 2) if max(a.turn, b.turn) > TURN]
    away = cv2.distanceTransform((~edges).astype(np.uint8), cv2.DIST_L2, 5)
    found = [e for parts in tried if (e := _candidate(parts, edges.shape)) is not None]
    return [rim for raw in found if (rim := _verified(raw, away, slope)) is not None]


def _arcs(edges: Bool[np.ndarray, "h w"], slope: Float[np.ndarray, "h w 2"]) -> list[_Arc]:
    """Smooth pieces of edges that turn one way, the longest first, (u, v) px."""
    shortest = max(SHORTEST * max(edges.shape), 2 * REACH + 2)
    arcs = []
    for line in _lines(edges, slope):
        if len(line) < shortest:
            continue
        way = line[REACH:] - line[:-REACH]
        angle = np.unwrap(np.arctan2(way[:, 1], way[:, 0]))
        bend = np.degrees(angle[REACH:] - angle[:-REACH])
        if not len(bend):
            continue
        cuts = np.abs(bend) > CORNER
        for piece in np.split(np.arange(len(bend)), np.flatnonzero(np.diff(cuts.astype(int))) + 1):
            if cuts[piece[0]]:
                continue
            for part in _one_way(bend, piece):
                arc = line[part[0] : part[-1] + 2 * REACH + 1]
                turned = abs(float(np.degrees(angle[part[-1] + REACH] - angle[part[0]])))
                if len(arc) >= shortest and turned > LEAST_TURN:
                    arcs.append(_Arc(arc + 0.5, turned))
    return sorted(arcs, key=lambda a: len(a.points), reverse=True)


def _lines(edges: Bool[np.ndarray, "h w"], slope: Float[np.ndarray, "h w 2"]) -> list[Float[np.ndarray, "n 2"]]:
    """Edge pixels in the order in which an edge runs, (column, row), each in one line."""
    free = np.pad(edges, 1)
    along = np.pad(np.stack([-slope[..., 1], slope[..., 0]], -1), ((1, 1), (1, 1), (0, 0)))
    along = along / np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-9)

    def walk(row: int, column: int, sign: int) -> list[tuple[int, int]]:
        found = []
        while True:
            tangent = sign * along[row, column]
            best, step = 0.5, None
            for i, j in _NEIGHBOURS:
                if free[row + i, column + j]:
                    ahead = (j * tangent[0] + i * tangent[1]) / np.hypot(i, j)
                    if ahead > best and along[row, column] @ along[row + i, column + j] > 0.7:
                        best, step = ahead, (i, j)
            if step is None:
                return found
            # what lies beside the step is the same edge
            for i, j in _NEIGHBOURS:
                if j * tangent[0] + i * tangent[1] > 0:
                    free[row + i, column + j] = False
            row, column = row + step[0], column + step[1]
            found.append((column - 1, row - 1))

    lines = []
    for row, column in np.argwhere(free).tolist():
        if free[row, column]:
            free[row, column] = False
            ahead = walk(row, column, 1)
            lines.append(np.array([*walk(row, column, -1)[::-1], (column - 1, row - 1), *ahead], float))
    return lines


def _one_way(bend: np.ndarray, piece: np.ndarray) -> list[np.ndarray]:
    """Parts of a piece within which the smoothed bend has one sign."""
    width = 2 * REACH + 1
    padded = np.pad(bend[piece], REACH, mode="edge")
    smooth = np.convolve(padded, np.ones(width) / width, mode="valid")
    sign = np.where(smooth > -2.0, 1, 0) if np.median(smooth) > 0 else np.where(smooth < 2.0, 1, 0)
    parts = np.split(piece, np.flatnonzero(np.diff(sign)) + 1)
    return [p for p in parts if sign[p[0] - piece[0]] and len(p) > 1]


def _candidate(parts: tuple[np.ndarray, ...], shape: tuple[int, int]) -> Ellipse | None:
    """The ellipse through arcs that fits all of them and has the size and the attitude of a rim."""
    points = np.concatenate(parts)
    if np.ptp(points, axis=0).max() < SMALLEST * max(shape):
        return None
    (u, v), (first, second), turn = cv2.fitEllipseDirect(points.astype(np.float32))
    long, short = 0.5 * max(first, second), 0.5 * min(first, second)
    if not max(SMALLEST * max(shape), FEWEST) < long < LARGEST * max(shape) or short < max(FLATTEST * long, NARROWEST):
        return None
    if not (0 <= u < shape[1] and -0.2 * shape[0] <= v < 1.2 * shape[0]):
        return None
    theta = np.radians(turn if first >= second else turn + 90.0)
    axis = np.array([np.cos(theta), np.sin(theta)])
    across = np.array([-axis[1], axis[0]])
    offset = points - [u, v]
    radius = np.hypot(offset @ axis / long, offset @ across / short)
    if np.percentile(np.abs(radius - 1.0), 90) * short > NEAR:
        return None
    covariance = 0.25 * (long**2 * np.outer(axis, axis) + short**2 * np.outer(across, across))
    found = Ellipse((float(u), float(v)), covariance, 0.0, float(np.hypot(SPREAD, EDGE / short)))
    return found if found.lies else None


def _outline(ellipse: Ellipse) -> Float[np.ndarray, "n 2"]:
    """Places along it, (u, v)."""
    angle = np.linspace(0.0, 2.0 * np.pi, AROUND, endpoint=False)
    root = np.linalg.cholesky(4.0 * ellipse.covariance)
    return np.stack([np.cos(angle), np.sin(angle)], -1) @ root.T + ellipse.center


def _verified(ellipse: Ellipse, away: np.ndarray, slope: np.ndarray) -> _Seen | None:
    """With the share of its outline in the picture that is an edge along its normal; None for too little."""
    at = _outline(ellipse)
    normal = (at - ellipse.center) @ np.linalg.inv(ellipse.covariance)
    column, row = np.floor(at).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < away.shape[1]) & (row < away.shape[0])
    column, row = np.where(inside, column, 0), np.where(inside, row, 0)
    across = slope[row, column]
    size = np.linalg.norm(across, axis=1) * np.linalg.norm(normal, axis=1)
    likeness = np.abs((across * normal).sum(1)) > np.cos(np.radians(ALONG)) * np.maximum(size, 1e-12)
    seen = inside & (away[row, column] < NEAR) & likeness
    upper = at[:, 1] < ellipse.center[1]
    if inside.mean() < IN_PICTURE or min(seen[upper].mean(), seen[~upper].mean()) < HALF_SEEN:
        return None
    share = float(seen[inside].mean())
    found = Ellipse(ellipse.center, ellipse.covariance, share, ellipse.spread)
    return None if share < SEEN else _Seen(found, at[seen], int(inside.sum()))


def _same(one: Ellipse, other: Ellipse) -> bool:
    """Whether both are found on the same edges, or nearly."""
    far = float(np.linalg.norm(np.subtract(one.center, other.center)))
    return far < 0.15 * other.axes[0] and abs(np.log(one.axes[0] / other.axes[0])) < 0.15
