"""Rims of vessels: ellipses that the edges of a picture form.

Edges (Canny 1986) are cut into smooth arcs. One arc, or two that can be of one ellipse, give a candidate by direct
least squares (Fitzgibbon, Pilu and Fisher 1999). A candidate counts when most of its outline is an edge across which
the picture changes along the ellipse's normal (as in Lu et al. 2020, "Arc-support line segments revisited").
"""

from __future__ import annotations

from itertools import combinations

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from fluidlift.shape.view.roundness import Ellipse

LONGEST = 400
"""px of the longer side of the picture that rims are looked for in"""
SHORTEST = 0.05
"""of that side, length of an arc that is looked at"""
SMALLEST, LARGEST = 0.08, 0.6
"""of that side, half the length of a rim"""
FEWEST = 30.0
"""px, the same: in less, any texture has arcs that fit (of 224 px pictures, one of three had such a rim, by mistake)"""
TURN = 25.0
"""degrees that an arc turns between its ends, at least: straighter ones say nothing of an ellipse"""
CORNER = 50.0
"""degrees within `REACH` px at which an edge is cut"""
REACH = 6
"""px over which the direction of an edge is taken"""
MOST_ARCS = 60
"""arcs that are paired, the longest"""
SEEN = 0.65
"""share of the outline that is an edge, at least. Of random texture a third is"""
HALF_SEEN = 0.35
"""the same of its upper and of its lower half: one of them alone does not say how flat it is"""
NEAR = 2.2
"""px from an outline to its edge"""
ALONG = 20.0
"""degrees between the picture's gradient and the outline's normal"""
FLATTEST = 0.12
"""width over length: flatter ones are not told from two lines"""
SPREAD = 0.08
"""standard deviation of the logarithm of a rim's length over its width (a choice: thickness of the rim, its tilt)"""
EDGE = 1.5
"""px, error of half the width of a rim (inner or outer edge)"""
_NEIGHBOURS = tuple((i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j)
MOST = 4
"""rims that are kept, those seen best"""


def find_rims(picture: UInt8[np.ndarray, "h w 3"]) -> tuple[Ellipse, ...]:
    """Ellipses of a picture that can be level rims, those seen best first.

    Args:
        picture: sRGB, typical for the clip.
    """
    scale = min(LONGEST / max(picture.shape[:2]), 1.0)
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    grey = cv2.GaussianBlur(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY), (0, 0), 1.2)
    slope = np.stack([cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)], -1)
    strong = float(np.percentile(np.abs(slope).sum(-1), 92.0))
    edges = cv2.Canny(grey, 0.4 * strong, strong) > 0
    arcs = _arcs(edges, slope)
    tried = [(a,) for a in arcs] + list(combinations(arcs[:MOST_ARCS], 2))
    away = cv2.distanceTransform((~edges).astype(np.uint8), cv2.DIST_L2, 5)
    found = [e for parts in tried if (e := _candidate(parts, edges.shape)) is not None]
    seen = [e for raw in found if (e := _verified(raw, away, slope)) is not None]
    kept: list[Ellipse] = []
    for ellipse in sorted(seen, key=lambda e: -e.likeness * np.sqrt(e.axes[0])):
        if len(kept) < MOST and not any(_same(ellipse, other) for other in kept):
            kept.append(ellipse)
    return tuple(
        Ellipse((e.center[0] / scale, e.center[1] / scale), e.covariance / scale**2, e.likeness, e.spread) for e in kept
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


def _arcs(edges: Bool[np.ndarray, "h w"], slope: Float[np.ndarray, "h w 2"]) -> list[Float[np.ndarray, "n 2"]]:
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
                turned = abs(np.degrees(angle[part[-1] + REACH] - angle[part[0]]))
                if len(arc) >= shortest and turned > TURN:
                    arcs.append(arc + 0.5)
    return sorted(arcs, key=len, reverse=True)


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
    if not max(SMALLEST * max(shape), FEWEST) < long < LARGEST * max(shape) or short < FLATTEST * long:
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


def _verified(ellipse: Ellipse, away: np.ndarray, slope: np.ndarray) -> Ellipse | None:
    """With the share of its outline that is an edge along its normal; None for too little."""
    root = np.linalg.cholesky(4.0 * ellipse.covariance)
    angle = np.linspace(0.0, 2.0 * np.pi, 120, endpoint=False)
    unit = np.stack([np.cos(angle), np.sin(angle)], -1)
    at = unit @ root.T + ellipse.center
    normal = unit @ np.linalg.inv(root)
    column, row = np.floor(at).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < away.shape[1]) & (row < away.shape[0])
    column, row = np.where(inside, column, 0), np.where(inside, row, 0)
    across = slope[row, column]
    size = np.linalg.norm(across, axis=1) * np.linalg.norm(normal, axis=1)
    likeness = np.abs((across * normal).sum(1)) > np.cos(np.radians(ALONG)) * np.maximum(size, 1e-9)
    seen = inside & (away[row, column] < NEAR) & likeness
    upper = at[:, 1] < ellipse.center[1]
    if seen.mean() < SEEN or min(seen[upper].mean(), seen[~upper].mean()) < HALF_SEEN:
        return None
    return Ellipse(ellipse.center, ellipse.covariance, float(seen.mean()), ellipse.spread)


def _same(one: Ellipse, other: Ellipse) -> bool:
    """Whether both are found on the same edges, or nearly."""
    far = float(np.linalg.norm(np.subtract(one.center, other.center)))
    return far < 0.15 * other.axes[0] and abs(np.log(one.axes[0] / other.axes[0])) < 0.15
