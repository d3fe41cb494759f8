"""Jets that sway: what their mask holds over a clip is many times as wide as they are at any instant.

A jug in a hand moves, and the jet that hangs from it moves along as a whole. The outline of a fluid that stays is
found from all frames together, and is then all that was ever jet. What is behind a jet is seen before and after it
comes by, so that it is told frame by frame (background subtraction), and that it sways by how its rows move: all of
them to the same side at the same time, where the edge of a river or of a flame goes its own way in each row.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from fluidlift.shape.background import filled_in
from fluidlift.shape.evidence import Evidence, distance_of_pictures
from fluidlift.shape.intermittently_wet import most_often
from fluidlift.shape.min_cut import disc, spread
from fluidlift.shape.moving_front import median_of_three

WIDEST = 0.05
"""part of the longer side: a jet and its sway are no wider (radius)"""
BESIDE = 2.0
"""px from what is wider: what falls into a pool ends there"""
LEAST = 0.002
"""part of the picture that a piece has at least: its rows are compared"""
BLUR, AROUND = 0.7, 1.5
"""px over which the grain of single frames is shared, and that of the jet's own middle: water glitters in specks"""
RIDGE = 0.04
"""part of the longer side, over which a jet's middle is looked for: it is within its sway of each place"""
HALF = 0.5
"""of the difference in the middle, at which the outline lies: that far a blur reaches"""
SEEN = 2
"""frames after it, or on either side, in which what is behind is seen, of a place that a jet only passes"""
PASSED = 0.5
"""of the places nearby that the jet is seen to cover for a time, it must leave again so many: it stays on a heap"""
BEFORE, NEARBY = 0.9, 0.008
"""share of the time below which a place is covered for a time; part of the longer side that is nearby"""
GAP = 0.012
"""part of the longer side: gaps along a jet that are narrower (radius) are of its own pattern"""
APART = 0.03
"""part of the longer side between two rows that are compared"""
TOGETHER = 0.7
"""correlation of their sway from which they go together: jets of three real pours have 0.87 to 0.90, 27 other thin
pieces of masks (edges of falls, pools, brooks, lava, a jug) -0.09 to 0.44, or are too short to tell"""
ALWAYS = 0.8
"""share of the frames in which a row must show the jet, to be compared"""


@dataclass(frozen=True)
class SwayingJets:
    """Where jets sway, and what is behind them."""

    where: Bool[np.ndarray, "h w"]
    """what they cover now and then"""
    behind: Float[np.ndarray, "h w 3"]
    """opponent colors"""
    still: Float[np.ndarray, "h w"]
    """grey levels: difference between two pictures of what does not move"""
    thin: Bool[np.ndarray, "h w"]
    """all that is no wider than a jet and its sway"""


def swaying_jets(evidence: Evidence, region: Bool[np.ndarray, "h w"]) -> SwayingJets | None:
    """The jets of a region, the outline of a fluid that stays, that sway by their own width or so; None without any."""
    longest = max(region.shape)
    wide = cv2.morphologyEx(region.astype(np.uint8), cv2.MORPH_OPEN, disc(WIDEST * longest))
    thin = region & ~spread(wide > 0, BESIDE)
    if thin.sum() < LEAST * thin.size:
        return None
    still = np.exp(evidence.level) * evidence.noise
    behind = most_often(evidence, still, thin)[1]
    jets = SwayingJets(thin, behind, still, thin)
    covered = np.stack(list(covered_over_time(jets, iter(evidence.pictures))))
    passed = _passed(covered, thin, _is_ground(evidence, jets, covered, region), NEARBY * longest)
    count, parts = cv2.connectedComponents(thin.astype(np.uint8), connectivity=4)
    where = np.zeros_like(region)
    for part in range(1, count):
        piece = passed & (parts == part)
        if piece.sum() >= LEAST * piece.size and _together(covered & piece, round(APART * longest)) > TOGETHER:
            where |= piece
    return SwayingJets(where, behind, still, thin) if where.any() else None


def uncovered_over_time(evidence: Evidence, jets: SwayingJets) -> Iterator[Bool[np.ndarray, "h w"]]:
    """Where a jet sways and what is behind it is seen, for every frame."""
    frames = (evidence.source[t] for t in range(len(evidence.source)))
    for covered in covered_over_time(jets, frames):
        yield jets.where & ~covered


def covered_over_time(
    jets: SwayingJets, pictures: Iterator[Float[np.ndarray, "h w 3"]]
) -> Iterator[Bool[np.ndarray, "h w"]]:
    """Where pictures in opponent colors, one after the other, differ from what is behind by half of what jets do."""
    longest = max(jets.where.shape)
    differences = (
        cv2.GaussianBlur(np.where(jets.thin, distance_of_pictures(p, jets.behind), np.float32(0.0)), (0, 0), BLUR)
        for p in pictures
    )
    for apart in median_of_three(differences):
        middle = np.where(jets.thin, cv2.GaussianBlur(apart, (0, 0), AROUND), np.float32(0.0))
        middle = cv2.GaussianBlur(cv2.dilate(middle, disc(RIDGE * longest)), (0, 0), RIDGE * longest)
        found = jets.where & (apart > np.maximum(jets.still, HALF * middle))
        yield jets.where & (cv2.morphologyEx(found.astype(np.uint8), cv2.MORPH_CLOSE, disc(GAP * longest)) > 0)


def _is_ground(
    evidence: Evidence, jets: SwayingJets, covered: Bool[np.ndarray, "t h w"], region: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Where what is behind looks more like what lies around the region than what covers it does."""
    around = filled_in(evidence.typical, ~spread(region, BESIDE))
    count, seen = np.zeros(region.shape, np.float32), np.zeros((*region.shape, 3), np.float32)
    for picture, here in zip(evidence.pictures, covered, strict=True):
        count += here
        seen += here[..., None] * picture.astype(np.float32)
    fluid = distance_of_pictures(seen / np.maximum(count, 1.0)[..., None], around) * (count > 0)
    ground = distance_of_pictures(jets.behind, around) * (count > 0)
    nearby = NEARBY * max(region.shape)
    return cv2.GaussianBlur(ground, (0, 0), nearby) < cv2.GaussianBlur(fluid, (0, 0), nearby)


def _passed(
    covered: Bool[np.ndarray, "t h w"], thin: Bool[np.ndarray, "h w"], ground: Bool[np.ndarray, "h w"], nearby: float
) -> Bool[np.ndarray, "h w"]:
    """The part of what is thin where most of what is covered for a time is seen bare after it.

    Where what is behind looks like `ground`; else it must be seen before it as well: it could be a heap that came.
    """
    bare = ~covered
    before, after = np.cumsum(bare, axis=0) >= SEEN, np.cumsum(bare[::-1], axis=0)[::-1] >= SEEN
    for_a_time = np.any(covered, axis=0) & (covered.mean(axis=0) < BEFORE) & thin
    passes = for_a_time & np.any(covered & (before | ground) & after, axis=0)
    across = RIDGE * max(thin.shape)
    share, of = (cv2.GaussianBlur(x.astype(np.float32), (0, 0), across, sigmaY=nearby) for x in (passes, for_a_time))
    return thin & (share > PASSED * np.maximum(of, 1e-3)) & spread(np.any(covered, axis=0), BESIDE)


def _together(covered: Bool[np.ndarray, "t h w"], apart: int) -> float:
    """Correlation over time between the middles of what is covered in rows that lie so many px apart."""
    apart = max(apart, 1)
    width = covered.sum(axis=2)
    middle = (covered * np.arange(covered.shape[2], dtype=np.float32)).sum(axis=2) / np.maximum(width, 1)
    seen = width > 0
    often = seen.mean(axis=0) > ALWAYS
    mean = (middle * seen).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
    moved = np.where(seen, middle - mean, 0.0)
    both = often[:-apart] & often[apart:]
    if both.sum() <= apart:  # too short to tell
        return 0.0
    one, other = moved[:, :-apart][:, both], moved[:, apart:][:, both]
    return float((one * other).sum() / max(float(np.sqrt((one**2).sum() * (other**2).sum())), 1e-6))
