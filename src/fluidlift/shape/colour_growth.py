"""Colour where motion says too little: quiet water beside lively water, what lies still where it was poured, and clips
where everything moves a little."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.ndimage import convolve1d

from fluidlift.shape.background import colour_bins
from fluidlift.shape.evidence import Evidence
from fluidlift.shape.looked_into import jet_rows
from fluidlift.shape.min_cut import disc, edge_weights, min_cut

STIFFNESS = 4.0
"""log odds per px of outline in a smooth place"""
RARE = 1e-4
"""share of a colour below which it is held to be unknown"""
DECISIVE = 4.0
"""log odds at which colour alone is held to say no more"""
QUIET = 1.0
"""log odds of motion below which colour may add a place"""
STEADY = 3.0
"""log odds at which motion is held to say no more against quiet water"""
GIVEN = 4.0
"""log odds by which what motion has decided is kept"""
DIRECT = 0.15
"""streaming at which a place counts fully as a seed: flow that goes somewhere, in a clip where everything shakes"""
RIM = 0.04
"""part of the longer side: a stabilised picture is made up at its rim, nothing there is a seed"""
SCARCE = 1.0
"""log odds against fluid of a place near a jet that does not stream. In a whole picture it says nothing where what is
grown does not run out: of a fluid's own places 1 to 36 in 100 stream (14 parts of clips). Of 0, 0.5 and 1, masks of
these have a mean IoU of 0.55, 0.49 and 0.41, of 9 other parts 0.66, 0.62 and 0.60, of 6 whole clips 0.58, 0.56 and
0.53"""
RUNS_OUT = 4.0
"""times, by which what is grown may be larger where nothing is said against it. Of 22 clips and parts it is 1.0 to 2.7
times, but 11 times where water and all that is around it are of one blue: there colours do not tell where to end"""
CLEAR = 2.0
"""weight of colour against streaming, which marks few places"""
AROUND = 0.02
"""part of the longer side by which what a jet has poured may reach beyond the hull of what moves: its rim creeps"""
JET = 1.0 / 6.0
"""of the height of a pour that its jet takes, at least (as `rectified.PARTS`)"""
FALLS, LIES = 0.05, 0.25
"""part of a jet that streams, at least, and share of that which may stream of what lies below it (a choice). Thin jets
stream in specks: eight made ones in 0.10 to 0.80 of them, what they pour in 0.00 to 0.05"""
FEW_ROUNDS = 3
"""in which colors are read anew within a small part of a picture: of 1, 2, 3 and 10, the first miss what glitters in
two of eight made scenes, ten take what is poured on for the fluid in two"""
SEEDED = 0.25
"""parts with fewer seeds than this share of the best part's are not the fluid"""


def colour_odds(picture: np.ndarray, fluid: np.ndarray, other: np.ndarray) -> np.ndarray:
    """float32 [h,w]: log odds of fluid from colour, within +-`DECISIVE`.

    Args:
        picture: float32 [h,w,3], opponent colours.
        fluid: float [h,w], weight of each pixel in the histogram of the fluid.
        other: float [h,w], the same of the rest.
    """
    bins = colour_bins(picture)
    shares = []
    for weight in (fluid, other):
        counts = np.zeros((16, 16, 16), np.float32)
        np.add.at(counts, bins, weight.astype(np.float32))
        for axis in range(3):
            counts = convolve1d(counts, np.array([0.25, 0.5, 0.25], np.float32), axis=axis, mode="constant")
        shares.append(counts[bins] / max(float(counts.sum()), 1e-6) + RARE)
    return np.clip(np.log(shares[0] / shares[1]), -DECISIVE, DECISIVE).astype(np.float32)


def with_quiet_water(picture: np.ndarray, score: np.ndarray, region: np.ndarray, *, rounds: int = 3) -> np.ndarray:
    """The region, bool [h,w], and what is quiet beside it and has its colours.

    Nothing is taken away, and nothing that moves is added: motion has decided there.

    Args:
        picture: float32 [h,w,3], opponent colours: how places look where they are fluid.
        score: float32 [h,w], log odds of fluid.
        region: bool [h,w], what motion and edges gave.
        rounds: in which the colours are read anew from the larger region.
    """
    across, down = edge_weights(picture, STIFFNESS)
    chance = 1.0 / (1.0 + np.exp(-score))
    found = region
    for _ in range(rounds):
        colour = colour_odds(picture, found * chance, ~found * (1.0 - chance))
        odds = np.clip(score, -STEADY, STEADY) + colour
        odds[score > QUIET] = -GIVEN
        odds[region] = GIVEN
        found = min_cut(odds, across, down) | region
    return found


def grown_from_streams(
    evidence: Evidence, inside: np.ndarray, *, rounds: int = 10, against: float = 0.0
) -> np.ndarray | None:
    """bool [h,w]: what has the colours of the places that stream and hangs together with them; None without any.

    For clips in which the camera or its stabilisation moves everything a little: change tells nothing there, but
    only a fluid goes on in one direction.

    Args:
        evidence: of the clip.
        inside: bool [h,w], where to look.
        rounds: at most, in which the colours are read anew.
        against: log odds against fluid of a place that does not stream.
    """
    picture = evidence.typical
    rim = max(1, round(RIM * max(inside.shape)))
    middle = np.zeros_like(inside)
    middle[rim:-rim, rim:-rim] = True
    streaming = np.where(middle & inside, evidence.streaming, 0.0)
    if float(streaming.max()) < DIRECT or (streaming > DIRECT).mean() < 1e-3:
        return None
    seeds = np.clip(streaming / DIRECT, 0.0, 1.0)
    motion = 6.0 * streaming / float(streaming.max()) - against
    across, down = edge_weights(picture, STIFFNESS)
    fluid, other = seeds, (streaming < 0.1 * DIRECT).astype(np.float32)
    before = None
    for _ in range(rounds):
        odds = motion + CLEAR * colour_odds(picture, fluid, other)
        found = min_cut(np.where(inside, odds, -100.0), across, down)
        count, parts = cv2.connectedComponents(found.astype(np.uint8), connectivity=4)
        held = np.bincount(parts.ravel(), weights=(seeds * found).ravel(), minlength=count)
        held[0] = 0.0
        found = ((held > 0.0) & (held >= SEEDED * held.max()))[parts]
        if before is not None and np.array_equal(found, before):
            break
        before, fluid, other = found, found + 2.0 * seeds, (~found).astype(np.float32)
    return before if before is not None and before.any() else None


def grown_steadily(evidence: Evidence, inside: np.ndarray) -> np.ndarray | None:
    """bool [h,w]: `grown_from_streams` with the least said against what does not stream that it does not run out by.

    What is determined by its colours stays much the same when a little is said less against it.
    """
    sure = grown_from_streams(evidence, inside, against=SCARCE)
    for against in (0.0, 0.5 * SCARCE):
        found = grown_from_streams(evidence, inside, against=against)
        if sure is None or found is None or found.sum() <= RUNS_OUT * sure.sum():
            return found
    return sure


def still_below_jet(evidence: Evidence, region: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """bool [h,w]: what has the colours of a jet, lies below it between what moves, and does not move itself.

    What is thick and smooth lies still where it was poured: only its jet and its rim are seen to move. Both are the
    fluid, and what they enclose is it as well where it looks like them.

    Args:
        evidence: of the clip.
        region: bool [h,w], what motion and edges gave.
        inside: bool [h,w], where to look.
    """
    none = np.zeros_like(region)
    if jet_rows(region).any(axis=1).sum() < max(JET * region.any(axis=1).sum(), 1):
        return none
    hull = np.zeros(region.shape, np.uint8)
    cv2.fillConvexPoly(hull, cv2.convexHull(np.argwhere(region)[:, ::-1].astype(np.int32)), 1)
    near = cv2.dilate(hull, disc(AROUND * max(region.shape))) > 0
    grown = grown_from_streams(evidence, inside & near, rounds=FEW_ROUNDS, against=SCARCE)
    if grown is None:
        return none
    jet = jet_rows(grown)
    rows, below = jet.any(axis=1), grown & ~jet
    if rows.sum() < JET * grown.any(axis=1).sum() or not below.any():
        return none
    streams = evidence.streaming > DIRECT
    falls = float(streams[jet].mean())
    if falls < FALLS or streams[below].mean() > LIES * falls:
        return none
    below[: int(np.flatnonzero(rows)[-1]) + 1] = False  # what it falls from may have its colours, too
    return below & ~region
