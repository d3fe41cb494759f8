"""Water that reaches the horizon: below that line is water, but for what stands still where waves would show.

On a level plane under a pinhole camera, what moves by a given length moves by px in proportion to how far it is seen
below the horizon (twice as far down is half the distance). So waves that are seen anywhere tell how far they would be
seen to move everywhere: near the viewer still sand is told from water, while towards the horizon even lively water
stands still. There the horizon itself speaks: nothing but water reaches it, over its whole width. Colour and the edges
of the picture draw the outline between both.
"""

from __future__ import annotations

import cv2
import numpy as np

from fluidlift.shape.colour_growth import STIFFNESS, colour_odds
from fluidlift.shape.evidence import Evidence, fluid_score, sharpness
from fluidlift.shape.min_cut import edge_weights, min_cut
from fluidlift.shape.open_water import APART, FINE, GIVEN, OF_COLOUR, OF_WANDER, STILL, SURE, holes, log_wander
from fluidlift.shape.region import clean_region
from fluidlift.shape.view import OpenHorizon, open_horizon

SEA = 1.0
"""log odds of water of a place below the horizon of which nothing else is known: of what a viewer on a shore has before
him a third is dry, of what one on a ship has nothing"""
FAR = 0.04
"""part of the picture's height below the line in which there is water alone, but for what stands before it: from a
height of 1.6 m and with 30 degrees from its upper to its lower edge, all that is farther than 75 m"""
UNLIKE = 3.0
"""of the spread of the far water's brightness and colours, by which what stands before it differs"""
QUIET_QUANTILE = 0.05
"""of what lies below the line is taken to be as still as anything is seen to be"""
LIKE_WATER = 1.0
"""log odds of the colours of a piece from which it is water: a colour that is seen nowhere else has 0"""
ROUNDS = 3
"""in which the colours are read anew"""


def sea_horizon(evidence: Evidence, layers: np.ndarray | None = None) -> OpenHorizon | None:
    """The horizon of open water that a clip shows, px at working size; None where it shows none.

    Waves keep their shape for a while, as what is carried through the picture does, so all that changes is asked, but
    for `layers`, bool [h,w], which leave ground behind: the edge of an arm is as straight.
    """
    changes = fluid_score(evidence.without_carried()) > 0.0
    moving = clean_region(changes if layers is None else changes & ~layers)
    return open_horizon(evidence.colours, moving)


def reaching_over(pieces: np.ndarray, horizon: OpenHorizon) -> np.ndarray:
    """bool [h,w]: those of some pieces, bool [h,w], that reach above the horizon: what is as tall as the viewer's eye.

    What moves below it and keeps its shape is a wave, or too small to matter.
    """
    parts = cv2.connectedComponents(pieces.astype(np.uint8), connectivity=8)[1]
    return pieces & np.isin(parts, np.unique(parts[pieces & (horizon.below(pieces.shape) < 0.0)]))


def with_sea(evidence: Evidence, region: np.ndarray, barred: np.ndarray, horizon: OpenHorizon) -> np.ndarray:
    """The region, bool [h,w], and all water up to the horizon; nothing above it.

    Args:
        evidence: of the clip.
        region: bool [h,w], what moves.
        barred: bool [h,w], what is no fluid in any case.
        horizon: px at working size.
    """
    depth = horizon.below(region.shape)
    region = region & (depth > 0.0)
    if not region.any():
        return region
    picture = evidence.typical
    far = far_water(picture, depth, barred)
    motion = wave_odds(log_wander(evidence), depth, region, px_per_noise(evidence))
    below = depth > 0.0
    across, down = edge_weights(picture, STIFFNESS)
    found = region | far
    for _ in range(ROUNDS):
        colour = colour_odds(picture, found.astype(np.float32), (below & ~found & ~barred).astype(np.float32))
        odds = np.clip(SEA + motion + OF_COLOUR * colour, -SURE, SURE)
        odds[region | far] = GIVEN
        odds[~below | barred] = -GIVEN
        larger = min_cut(odds, across, down)
        if np.array_equal(larger, found):
            break
        found = larger
    found = clean_region(found) & below & ~barred
    return found | lulls(picture, found, below & ~found, barred)


def lulls(picture: np.ndarray, water: np.ndarray, ground: np.ndarray, barred: np.ndarray) -> np.ndarray:
    """bool [h,w]: holes in water that look like it: between two waves a place may stand for a second.

    Args:
        picture: float32 [h,w,3], typical opponent colours.
        water: bool [h,w], what was found.
        ground: bool [h,w], the rest of what lies below the horizon.
        barred: bool [h,w], what is no fluid in any case.
    """
    within = holes(water) & ground & ~barred
    count, parts = cv2.connectedComponents(within.astype(np.uint8), connectivity=4)
    found = np.zeros_like(within)
    for part in range(1, count):
        piece = parts == part
        # by the colours of everything else: they would speak for their own piece
        odds = colour_odds(picture, water.astype(np.float32), (ground & ~piece).astype(np.float32))
        found |= piece & bool(odds[piece].mean() > LIKE_WATER)
    return found


def far_water(picture: np.ndarray, depth: np.ndarray, barred: np.ndarray) -> np.ndarray:
    """bool [h,w]: what is right below the horizon and looks as most of that does.

    Args:
        picture: float32 [h,w,3], typical opponent colours.
        depth: [h,w], px below the horizon.
        barred: bool [h,w], what is no fluid in any case.
    """
    strip = (depth > 0.0) & (depth < max(FAR * len(picture), 2.0)) & ~barred
    if not strip.any():
        return strip
    usual = np.median(picture[strip], axis=0)
    apart = np.abs(picture - usual)
    spread = np.maximum(np.median(apart[strip], axis=0) / 0.6745, 2.0)  # grey levels: what coding leaves
    return strip & (apart / spread < UNLIKE).all(axis=-1)


def px_per_noise(evidence: Evidence) -> np.ndarray:
    """float32 [h,w]: px by which a place must move to change by as much as a still one does between pictures."""
    steep = cv2.GaussianBlur(sharpness(evidence.typical), (0, 0), FINE)
    return evidence.noise / np.maximum(steep, 1e-3)


def wave_odds(wander: np.ndarray, depth: np.ndarray, region: np.ndarray, unseen: np.ndarray) -> np.ndarray:
    """float32 [h,w]: log odds of water from whether a place moves as waves would there; 0 where they would not show.

    A place without texture is still whatever it is: water, too, whose waves are smaller than a pixel.

    Args:
        wander: float32 [h,w], of `open_water.log_wander`.
        depth: [h,w], px below the horizon.
        region: bool [h,w], what moves, below it.
        unseen: float32 [h,w], px of motion that noise hides.
    """
    moved = np.maximum(np.exp(wander) - STILL, 0.0)
    pace = float(np.median(moved[region] / np.maximum(depth[region], 1.0)))
    waves = pace * np.maximum(depth, 0.0)
    expected = np.log(waves + STILL)
    still = float(np.quantile(wander[depth > 0.0], QUIET_QUANTILE))
    share = np.clip((wander - still) / np.maximum(expected - still, APART), -0.2, 1.2)
    told = np.clip((expected - still) / APART, 0.0, 1.0) * np.clip(waves / unseen - 1.0, 0.0, 1.0)
    return (told * OF_WANDER * (share - 0.5)).astype(np.float32)
