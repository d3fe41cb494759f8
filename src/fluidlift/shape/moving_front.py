"""Moving fronts: the outline, frame by frame, of a fluid that crosses the picture: rising smoke, an arriving jet."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from fluidlift.shape.background import (
    DECISIVE,
    TINGED,
    darker,
    filled_in,
    is_tinted,
    own_tint,
    still_background,
    typical_contrast,
)
from fluidlift.shape.evidence import POOLING, Evidence, change_over_time, pool
from fluidlift.shape.min_cut import disc, spread
from fluidlift.shape.presence import Presence
from fluidlift.shape.region import clean_region, solids_in, still_pixels
from fluidlift.types.clip import Label

SHADOW = 0.2
"""factor on changes of brightness against the sign of the fluid's own contrast"""
FAINTEST = 0.5
"""of the fluid's typical contrast with the background: an outline lies where fluid and background mix half and half"""
SPANNED = 0.02
"""part of the longer side: where background was seen on both sides of a gap that is narrower (radius), what is filled
in between is believed as if it had been seen. A jet is that thin, and is always somewhere within its sway"""
GAP = 0.012
"""part of the longer side: gaps between puffs that are narrower (radius) are fluid in the shade of other fluid"""

STRAY = 0.1
"""of the volume (pixels times frames) of the largest piece: smaller ones that never come near it, and are there for
less than half of the time, are no part of one fluid. In a pour from a pail such pieces had 0.03 and less (its rim and
the light on it); two made plumes, a filmed one and a splash have none"""
LEAP = 0.03
"""part of the longer side that a drop may move from one frame to the next and still be the same"""


def advancing_labels(
    evidence: Evidence, score: np.ndarray, presence: Presence, told: np.ndarray | None = None
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Labels u8 and confidence f32 [h,w] of every frame.

    Args:
        evidence: of the clip.
        score: float32 [h,w], log odds of fluid over the whole clip.
        presence: of activity.
        told: float32 [h,w], log odds that the user added; None: none.
    """
    hint = np.zeros_like(score) if told is None else told
    sure_of = score + hint
    domain = spread(clean_region(sure_of > -1.0), 0.01 * max(score.shape))
    domain &= hint > -2.0
    still = still_pixels(evidence)
    for odds in median_of_three(odds_over_time(evidence, presence, domain, hint)):
        region, solid = solids_in(clean_region(odds > 0.0, gap=GAP), still)
        labels = np.zeros(score.shape, np.uint8)
        labels[region], labels[solid] = Label.FLUID, Label.SOLID
        yield labels, np.tanh(0.5 * np.abs(odds))


def odds_over_time(
    evidence: Evidence, presence: Presence, domain: np.ndarray, hint: np.ndarray
) -> Iterator[np.ndarray]:
    """float32 [h,w], log odds of fluid in every frame: it differs from what is behind it, moves, has its colour.

    Where the background was never seen, what is filled in from around it only tells a shadow: a clear change against
    the sign of the fluid's contrast, though it moves as the fluid does. That steady fluid stands still says nothing.
    """
    scene = still_background(evidence, presence, domain)
    across = cv2.morphologyEx(scene.known.astype(np.uint8), cv2.MORPH_CLOSE, disc(SPANNED * max(domain.shape))) > 0
    known = scene.known | (across & ~scene.steady)
    contrast, brightens = typical_contrast(evidence, presence, scene.background, scene.known)
    threshold = np.maximum(4.0 * evidence.noise, FAINTEST * contrast)
    background, tinted = filled_in(scene.background, scene.known), is_tinted(evidence, presence, scene)
    sigma = POOLING * max(evidence.noise.shape)
    for t, change in enumerate(change_over_time(evidence)):
        picture = evidence.source[t].astype(np.float32)
        moved = (pool(np.log(np.maximum(change, 1.0)), sigma) - evidence.level) / 0.3
        change_of_colour = picture - background
        size = np.abs(change_of_colour).sum(axis=-1)
        differs = size / threshold
        shaded = change_of_colour[..., 0] * brightens < -0.5 * size
        differs[shaded] *= SHADOW
        if tinted:
            tint, dark = own_tint(picture, background, scene.fluid) / TINGED, darker(change_of_colour)
            differs[dark] = np.minimum(differs, np.maximum(tint, 0.0))[dark]
            shaded |= dark & (tint < 1.0)
        stands_out = np.log(np.maximum(differs, 1e-3)) / 0.3
        seen = stands_out + 0.25 * np.clip(moved, -4.0, 4.0)
        told = np.where(scene.steady, np.maximum(moved, 0.0), moved)
        guessed = np.clip(told, -3.0, 3.0) + scene.like_fluid(picture)
        guessed[shaded & (2.0 * size > threshold)] = -DECISIVE
        best = np.where(known, seen, guessed) + hint
        yield np.clip(np.where(domain, best, -12.0), -12.0, 12.0).astype(np.float32)


def median_of_three(odds: Iterator[np.ndarray]) -> Iterator[np.ndarray]:
    """Median of three neighbouring frames, ends kept; only three are held at a time."""
    before = next(odds, None)
    if before is None:
        return
    yield before
    here = next(odds, None)
    if here is None:
        return
    for after in odds:
        yield np.maximum(np.minimum(before, here), np.minimum(np.maximum(before, here), after))
        before, here = here, after
    yield here


def without_strays(labels: np.ndarray) -> int:
    """Clear pieces of the fluid that hang together with nothing, in place and time; number of pixels over all frames.

    What splashes or puffs off has left the rest, and what arrives comes to it: in space and time they are one piece. A
    part of a hand or a jug that looks like the fluid for a while is a piece of its own.

    Args:
        labels: u8 [T,H,W], changed in place; frames are read one by one, twice.
    """
    reach = disc(LEAP * max(labels.shape[1:]))
    volume, frame, edges = [], [], []
    before = np.zeros(labels.shape[1:], np.int64)  # pieces of the last frame, numbered over the whole clip
    for t in range(len(labels)):
        count, pieces = _pieces(labels[t])
        numbered = np.where(pieces > 0, pieces - 1 + len(volume), -1)
        volume += np.bincount(pieces.ravel(), minlength=count)[1:].tolist()
        frame += [t] * (count - 1)
        for piece in np.unique(before[before > 0]).tolist():
            near = cv2.dilate((before == piece).astype(np.uint8), reach) > 0  # wherever it may be by now
            edges += [(piece - 1, other) for other in np.unique(numbered[near & (pieces > 0)]).tolist()]
        before = numbered + 1
    if not volume:
        return 0
    linked = coo_array((np.ones(len(edges)), tuple(np.array(edges, int).reshape(-1, 2).T)), (len(volume), len(volume)))
    whole, at = connected_components(linked, directed=False)[1], np.array(frame)
    sizes = np.bincount(whole, volume)
    lasts = np.array([len(np.unique(at[whole == w])) for w in range(len(sizes))])
    stray = ((sizes < STRAY * sizes.max()) & (lasts < 0.5 * len(labels)))[whole]
    cleared = 0
    for t in np.unique(at[stray]).tolist():
        gone = np.append(stray[at == t], False)[_pieces(labels[t])[1] - 1]  # the last for 0, what is no fluid
        labels[t][gone] = Label.BACKGROUND
        cleared += int(gone.sum())
    return cleared


def _pieces(labels: np.ndarray) -> tuple[int, np.ndarray]:
    """Number of pieces of the fluid in a frame and one more, and which each pixel belongs to, 0 for none."""
    return cv2.connectedComponents((np.asarray(labels) == Label.FLUID).astype(np.uint8), connectivity=8)
