"""What the user says about a mask: points that are fluid or are not, a rectangle.

A point speaks for its surroundings: for what can be reached from it without crossing an edge (geodesic distance) and
looks and moves as it does. Where points of both kinds could speak, the nearer one does. So that one point does not
empty the whole fluid, sure places of the automatic mask that look unlike the point speak against it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.shape.evidence import Evidence
from fluidlift.shape.min_cut import edge_weights, geodesic_distance, min_cut

Point = tuple[float, float, int]
"""x, y in px of the clip, 1 (or True) for fluid or 0 (False) for none"""

RADIUS = 3
"""px at working size: a click is a disc of this size"""
REACH = 2.0
"""of the spread of colours over the picture: geodesic distance at which a click has lost its voice"""
LIKENESS = 1.0
"""of the spread of colours over the picture: what differs by this from a click is not its like"""
STEP = 0.3
"""grey levels per px: cost of a step in a smooth place, of the size of the noise"""
VOICE = 6.0
"""log odds of a click where it speaks"""
FAITH = 1.5
"""log odds of the automatic mask at its surest"""
LIVELINESS = 5.0
"""grey levels that a unit of log activity counts for when a click is compared with other places"""
ANCHORS = 8
"""sure places of the automatic mask that speak against a click of the other kind"""
STIFFNESS = 4.0
"""log odds per px of outline in a smooth place"""


@dataclass(frozen=True)
class Clicks:
    """Points at working size, int [n,2] (column, row)."""

    fluid: np.ndarray
    other: np.ndarray

    def __bool__(self) -> bool:
        return len(self.fluid) + len(self.other) > 0


def clicks_at(points: Sequence[Point], size: tuple[int, int], shape: tuple[int, ...]) -> Clicks:
    """The points at working size.

    Args:
        points: in px of the clip.
        size: width and height of the clip, px.
        shape: rows and columns at working size.

    Raises:
        InputRejected: a point outside the picture, or a label that is neither 0 nor 1.
    """
    found: dict[int, list[tuple[int, int]]] = {0: [], 1: []}
    for x, y, label in points:
        if label not in (0, 1):
            raise InputRejected(f"a point with the label {label}", "1 for fluid or 0 for none", "correct the label")
        if not (0 <= x < size[0] and 0 <= y < size[1]):
            raise InputRejected(f"a point ({x:g}, {y:g}) outside the {size[0]} x {size[1]} picture", "x,y in px",
                                "move the point")  # fmt: skip
        found[label].append((int(x * shape[1] / size[0]), int(y * shape[0] / size[1])))
    fluid, other = (np.array(found[label], int).reshape(-1, 2) for label in (1, 0))
    return Clicks(fluid, other)


def heed(clicks: Clicks, evidence: Evidence, score: np.ndarray, region: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The region as the clicks correct it, bool [h,w], and the log odds that they added, float32 [h,w].

    Args:
        clicks: at working size.
        evidence: of the clip.
        score: float32 [h,w], log odds of fluid.
        region: bool [h,w], the automatic mask.
    """
    channels = look(evidence)
    spread = max(float(np.sqrt(channels[..., :3].reshape(-1, 3).var(axis=0).sum())), 1.0)
    voice, against = {}, {}
    for label, own, foes in ((1, clicks.fluid, clicks.other), (0, clicks.other, clicks.fluid)):
        voice[label] = distance_to(channels, own, RADIUS, spread)
        helpers = anchors(channels / (LIKENESS * spread), region == bool(label), score, foes)
        against[label] = np.minimum(voice[label], distance_to(channels, helpers, 1, spread))
    reach = np.exp(-(np.minimum(voice[0], voice[1]) ** 2))
    nearest = np.minimum(against[0], against[1])
    vote = reach * VOICE * np.clip((against[0] - against[1]) / (nearest + 0.05), -1.0, 1.0)
    automatic = FAITH * (2.0 * region - 1.0) * np.clip(np.abs(score) / 3.0, 0.3, 1.0)
    for label, points in ((1, clicks.fluid), (0, clicks.other)):
        vote[discs(points, RADIUS, score.shape)] = 100.0 * (2 * label - 1)
    across, down = edge_weights(np.dstack([channels[..., :3], 20.0 * evidence.fine_activity]), STIFFNESS)
    return min_cut((1.0 - reach) * automatic + vote, across, down), vote.astype(np.float32)


def holes_asked_for(region: np.ndarray, clicks: Clicks) -> np.ndarray:
    """bool [h,w]: the holes that a person pointed at, which tidying up must not fill again."""
    _, parts = cv2.connectedComponents((~region).astype(np.uint8))
    open_ended = np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]])
    wanted = parts[discs(clicks.other, 0, region.shape) & ~region]
    return np.isin(parts, wanted[~np.isin(wanted, open_ended)])


def look(evidence: Evidence) -> np.ndarray:
    """float32 [h,w,4]: smoothed colours of the typical picture and activity, in grey levels."""
    colours = cv2.GaussianBlur(evidence.typical, (0, 0), 1.0)
    lively = LIVELINESS * np.minimum(evidence.fine_activity, 2.0 * evidence.level)
    return np.dstack([colours, lively]).astype(np.float32)


def discs(points: np.ndarray, radius: int, shape: tuple[int, ...]) -> np.ndarray:
    """bool [h,w]: discs around points (column, row)."""
    mask = np.zeros(shape[:2], np.uint8)
    for x, y in points:
        cv2.circle(mask, (int(x), int(y)), radius, 1, -1)
    return mask > 0


def distance_to(channels: np.ndarray, points: np.ndarray, radius: int, spread: float) -> np.ndarray:
    """Distance from the nearest of some points, [h,w], in reaches: along the picture and in looks; 1000 for none."""
    nearest = np.full(channels.shape[:2], 1e3)
    for point in points:
        seeds = discs(point[None], radius, channels.shape)
        way = geodesic_distance(channels, seeds, step=STEP) / (REACH * spread)
        unlike = np.linalg.norm(channels - np.median(channels[seeds], axis=0), axis=-1) / (LIKENESS * spread)
        nearest = np.minimum(nearest, np.hypot(way, unlike))
    return nearest


def anchors(looks: np.ndarray, region: np.ndarray, score: np.ndarray, foes: np.ndarray) -> np.ndarray:
    """int [n,2]: places of the region that are sure, unlike the clicks against it, and spread over looks and picture.

    Farthest points, one after the other, each weighted by how sure the place is. None without such a click.
    """
    if len(foes) == 0:
        return np.zeros((0, 2), int)
    height, width = region.shape
    inner = cv2.erode(region.astype(np.uint8), np.ones((5, 5), np.uint8), borderValue=1) > 0
    nearest = np.min([np.linalg.norm(looks - looks[y, x], axis=-1) for x, y in foes], axis=0)
    inner &= nearest > 0.6
    rows, columns = np.mgrid[0:height, 0:width] / (0.25 * max(height, width))
    places = np.dstack([looks, rows, columns])
    found = []
    for _ in range(ANCHORS):
        worth = np.where(inner, nearest * np.clip(np.abs(score) / 3.0, 0.2, 1.0), 0.0)
        row, column = divmod(int(worth.argmax()), width)
        if worth[row, column] <= 0.0:
            break
        found.append((column, row))
        nearest = np.minimum(nearest, np.linalg.norm(places - places[row, column], axis=-1))
    return np.array(found, int).reshape(-1, 2)
