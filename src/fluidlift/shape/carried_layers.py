"""Layered motion: what is carried through the picture as a whole, outline and all, however smooth or slow it is.

A jug, a hand or a post before a camera that sways moves by one similarity for a second and longer (features that are
found again at its end, RANSAC). Laid back by that motion, its pictures agree where they differ as they stand (Wang,
Adelson 1994): a fluid's do not, which falls, deforms and goes out. Ground without texture beside the outline agrees
as well, but never before the outline has gone over it and after that: so the first and the last picture of a stretch
are both asked. And what a solid leaves, or has not come to, stands still: a current has more of itself there.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Bool
from scipy import ndimage

from fluidlift.numerics.similarity2 import composed, inverse
from fluidlift.shape.frame_pictures import shrink, working_scale
from fluidlift.shape.min_cut import disc
from fluidlift.shape.moving_solids import LEAST_FEATURES, LEAST_MOVE, SIZE, carried_alike, tracked
from fluidlift.types.clip import VideoClip

STRETCH = 1.1
"""s over which pictures are compared: nearly three times that over which solids are found by their flow, so that they
may be as much slower; of water nothing is found again after so long"""
SHORTEST = 0.6
"""s, of a clip, below which it is too short to tell"""
STRETCHES = 4
"""looked at, spread over the clip"""
COMPARED = 8
"""pictures of a stretch, laid back"""
BETTER = 0.5
"""difference of the pictures laid back, as part of that of the pictures as they stand, below which a place is carried:
half way between a thing that moves so (0) and one that does not (1)"""
SEEN = 3.0
"""times the noise: differences that can be told"""
BLUR = 1.5
"""px over which neighbours share them"""
EVEN = 8.0
"""px, standard deviation of the surroundings over which contrast is made even: half a patch that is followed"""
FAINT = 1.5
"""grey levels of contrast that are not raised to the same: those of a sensor's noise"""
THIN = 0.02
"""part of the longer side: what is narrower (radius) is left to other evidence: a jet sways with the spout it comes
from, and one without any pattern that falls looks the same, laid back"""
SAME = 0.5
"""of a solid found by its flow that a layer must cover to be the same thing: most of it"""
STANDS = 0.75
"""share of what a solid uncovers, or will cover, that must stand still"""
LEAST_UNCOVERED = 40
"""px that are needed to tell it: 10 px of outline that go 4 px"""


@dataclass(frozen=True)
class _Stretch:
    """Some pictures of a stretch, the first and last among them, and where one thing is in them."""

    pictures: list[np.ndarray]
    """float32 [h,w], grey levels"""
    motions: list[np.ndarray]
    """[2,3] each, from the first"""
    noise: float
    """grey levels: mean difference of two pictures of what stands"""


def carried_layers(clip: VideoClip, shape: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """What is carried through the picture sweeps over.

    Args:
        clip: from a camera that stands or sways a little.
        shape: h, w of the result.
    """
    frames, height, width = clip.frames.shape[:3]
    length = min(round(STRETCH / clip.interval), frames - 1)
    scale = working_scale(height, width, longest=SIZE)
    found = np.zeros(shrink(np.zeros((height, width), np.uint8), scale).shape, bool)
    if length * clip.interval >= SHORTEST and length >= 2:
        count = min(STRETCHES, max(1, (frames - 1) // length))
        for start in np.unique(np.linspace(0, frames - 1 - length, count).astype(int)):
            span = range(int(start), int(start) + length + 1)
            found |= _swept([cv2.cvtColor(shrink(np.ascontiguousarray(clip.frames[t]), scale), cv2.COLOR_RGB2GRAY)
                             for t in span])  # fmt: skip
    return cv2.resize(found.astype(np.uint8), shape[::-1], interpolation=cv2.INTER_NEAREST) > 0


def by_either(layers: Bool[np.ndarray, "h w"], flowing: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Solids from their layers and from their flow: what both found is taken without what is thin in the latter.

    A jet sways with its spout, and its flow then agrees with the jug's.
    """
    count, parts = cv2.connectedComponents(flowing.astype(np.uint8), connectivity=4)
    parts = parts.astype(np.intp)
    same = np.bincount(parts[layers], minlength=count) >= SAME * np.bincount(parts.ravel(), minlength=count)
    same[0] = False
    thick = cv2.morphologyEx((same[parts] | layers).astype(np.uint8), cv2.MORPH_OPEN, disc(THIN * max(layers.shape)))
    return layers | (thick > 0) | (flowing & ~same[parts])


def _swept(grey: list[np.ndarray]) -> np.ndarray:
    """bool [h,w]: what solids sweep over while these frames, u8 [h,w], last."""
    found = np.zeros(grey[0].shape, bool)
    picked = np.unique(np.linspace(0, len(grey) - 1, COMPARED + 1).round().astype(int))
    pictures = [cv2.GaussianBlur(grey[t].astype(np.float32), (0, 0), 0.8) for t in picked]
    apart = np.mean([np.abs(picture - pictures[0]) for picture in pictures[1:]], axis=0)
    noise = max(float(np.quantile(apart, 0.2)), 0.3)
    changes = cv2.dilate((apart > SEEN * noise).astype(np.uint8), disc(2.0))
    tracks = tracked([_even(picture) for picture in grey], changes)
    if tracks is None:
        return found
    for agree, motions in carried_alike(tracks, LEAST_MOVE * max(grey[0].shape)):
        stretch = _Stretch(pictures, [motions[t] for t in picked], noise)
        layer = _layer(stretch, tracks.places[0][agree])
        if layer.any() and _leaves_ground(stretch, layer):
            for motion in motions:
                found |= _laid(layer, motion)
    return found


def _even(picture: np.ndarray) -> np.ndarray:
    """u8 [h,w] of one contrast everywhere: a smooth jug has features too, if there were none but those of its rim.

    Less its mean over the surroundings, in units of the deviation there, as in local contrast normalisation.
    """
    values = cv2.GaussianBlur(picture.astype(np.float32), (0, 0), 1.0)
    rest = values - cv2.GaussianBlur(values, (0, 0), EVEN)
    deviation = np.sqrt(cv2.GaussianBlur(rest * rest, (0, 0), EVEN))
    return np.clip(128.0 + 50.0 * rest / (deviation + FAINT), 0.0, 255.0).astype(np.uint8)


def _laid(mask: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """bool [h,w], carried by a motion [2,3]; what reaches the edge of the picture goes on beyond it."""
    kinds = {"flags": cv2.INTER_NEAREST, "borderMode": cv2.BORDER_REPLICATE}
    return cv2.warpAffine(mask.astype(np.uint8), motion, mask.shape[::-1], None, **kinds) > 0


def _layer(stretch: _Stretch, features: np.ndarray) -> np.ndarray:
    """bool [h,w] of the first picture: what moves so and hangs together with these features [n,2]."""
    motions, last = stretch.motions, stretch.motions[-1]
    forwards, against = _agreeing(stretch.pictures, motions, stretch.noise)
    back = [composed(motion, inverse(last)) for motion in motions[::-1]]
    backwards, against_too = _agreeing(stretch.pictures[::-1], back, stretch.noise)
    agrees = forwards & _laid(backwards, inverse(last))
    against |= _laid(against_too, inverse(last))
    longest = max(agrees.shape)
    solid = cv2.morphologyEx(agrees.astype(np.uint8), cv2.MORPH_CLOSE, disc(THIN * longest)) > 0
    solid = np.asarray(ndimage.binary_fill_holes(solid)) & ~against
    solid = cv2.morphologyEx(solid.astype(np.uint8), cv2.MORPH_OPEN, disc(THIN * longest))
    parts = cv2.connectedComponents(solid, connectivity=4)[1].astype(np.intp)
    columns, rows = np.clip(features.astype(int), 0, np.array(solid.shape[::-1]) - 1).T
    held = np.bincount(parts[rows, columns], minlength=int(parts.max()) + 1)
    held[0] = 0
    return (held >= LEAST_FEATURES // 2)[parts]


def _agreeing(pictures: list[np.ndarray], motions: list[np.ndarray], noise: float) -> tuple[np.ndarray, np.ndarray]:
    """bool [h,w] of the first picture: where the others agree with it, laid back, and where they clearly do not."""
    size = pictures[0].shape[::-1]
    laid, stands = np.zeros(pictures[0].shape, np.float32), np.zeros(pictures[0].shape, np.float32)
    seen = np.zeros(pictures[0].shape, np.float32)
    for picture, motion in zip(pictures[1:], motions[1:], strict=True):
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        again = cv2.warpAffine(picture, motion, size, flags=flags, borderMode=cv2.BORDER_CONSTANT, borderValue=-1e4)
        inside = again > -1.0
        laid += np.where(inside, np.abs(again - pictures[0]), 0.0)
        stands += np.where(inside, np.abs(picture - pictures[0]), 0.0)
        seen += inside
    laid, stands = (cv2.GaussianBlur(x / np.maximum(seen, 1.0), (0, 0), BLUR) for x in (laid, stands))
    told = seen >= 0.5 * (len(pictures) - 1)
    return (
        told & (stands > SEEN * noise) & (laid < BETTER * stands),
        told & (laid > SEEN * noise) & (laid > BETTER * stands),
    )


def _leaves_ground(stretch: _Stretch, layer: np.ndarray) -> bool:
    """Whether what a layer, bool [h,w] of the first picture, uncovers and will cover stands still."""
    return _still_share(stretch, layer) > STANDS


def _still_share(stretch: _Stretch, layer: np.ndarray) -> float:
    """Share of what is swept, while it is not covered, that changes by less than half of what it does at most; 0 where
    too little is to tell."""
    grow = np.ones((5, 5), np.uint8)
    masks = [_laid(layer, motion) for motion in stretch.motions]
    swept, covers = np.any(masks, axis=0), [cv2.dilate(mask.astype(np.uint8), grow) > 0 for mask in masks]
    changes = [cv2.GaussianBlur(np.abs(b - a), (0, 0), BLUR) for a, b in pairwise(stretch.pictures)]
    least = np.maximum(BETTER * np.max(changes, axis=0), SEEN * stretch.noise)
    still = total = 0
    for change, first, second in zip(changes, covers, covers[1:]):
        bare = swept & ~first & ~second  # seen in two pictures that follow each other, swept at another time
        total, still = total + int(bare.sum()), still + int((bare & (change < least)).sum())
    return still / total if total >= LEAST_UNCOVERED else 0.0
