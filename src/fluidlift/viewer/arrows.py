"""Arrows of the velocity, standing on the outside of the fluid, where splats do not cover them."""

from __future__ import annotations

import numpy as np

from fluidlift.viewer.frames import SplatFrame

ACROSS = 18
"""blocks along the size of the fluid; each has one arrow"""
MOST = 1200
"""arrows"""
FAR = 3 * ACROSS
"""blocks from the middle of the fluid: a drop that flew farther has none"""
LONGEST, SHORTEST = 0.16, 0.04
"""share of the size of the fluid: an arrow of the fastest 1 %, and of what hardly moves; colours tell the speed"""
THICK = 3.0
"""px of an arrow's lines on the screen, whatever the distance"""
HEAD = 0.026
"""share of the size of the fluid: length of a head, where the arrow is more than twice as long"""
SPREAD = 0.4
"""half the width of a head over its length"""
STILL = 0.01
"""share of the fastest 1 %: what is slower has no arrow"""
COLORS = np.array([[95, 20, 160], [225, 60, 100], [255, 235, 60]])
"""sRGB, from still to the fastest 1 %: none of them is a colour of water"""
_SIDES = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]])
"""towards which a block may be open; below lies the bed"""


def arrows(frame: SplatFrame, size: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Ends [m,2,3] (m) and colours u8 [m,3] of velocity arrows; None where nothing moves.

    The space is cut into blocks. One that holds splats and is open to a side or upwards gets an arrow: the mean
    velocity of its splats, from half a block outside their mean place.

    Args:
        frame: with splats in m.
        size: m, of the fluid.
    """
    fastest = frame.fastest
    if not 0 < fastest < np.inf:
        return None
    width = size / ACROSS
    middle = np.median(frame.centers, axis=0)
    block = np.floor((frame.centers - middle) / width)
    near = (np.abs(block) < FAR).all(axis=1)
    side = 2 * FAR + 2  # an empty layer all around
    key = np.ravel_multi_index(tuple((block[near].astype(int) + FAR + 1).T), (side,) * 3)
    blocks, which, count = np.unique(key, return_inverse=True, return_counts=True)
    place, velocity = (_means(a[near], which, count) for a in (frame.centers, frame.velocities))
    steps = _SIDES @ np.array([side * side, side, 1])
    is_open = ~np.isin(blocks[:, None] + steps, blocks)
    outward = is_open @ _SIDES.astype(float)
    outward /= np.maximum(np.sqrt(np.square(outward).sum(axis=1, keepdims=True)), 1e-9)
    speed = np.sqrt(np.square(velocity).sum(axis=1))
    shown = np.flatnonzero(is_open.any(axis=1) & (speed > STILL * fastest))
    if not len(shown):
        return None
    shown = shown[np.linspace(0, len(shown) - 1, min(MOST, len(shown))).astype(int)]
    share = np.clip(speed[shown] / fastest, 0, 1)
    length = size * (SHORTEST + (LONGEST - SHORTEST) * share)
    tails = place[shown] + 0.5 * width * outward[shown]
    tips = tails + velocity[shown] * (length / speed[shown])[:, None]
    colors = np.stack([np.interp(share, [0, 0.5, 1], COLORS[:, c]) for c in range(3)], axis=1)
    return np.stack([tails, tips], axis=1), np.round(colors).astype(np.uint8)


def barbed(ends: np.ndarray, colors: np.ndarray, head: float) -> tuple[np.ndarray, np.ndarray]:
    """Arrows as lines: segments [5m,2,3] (m) and their colours u8 [5m,2,3].

    Lines are not lit, so that their colours are those of the legend. Each arrow is its shaft and four barbs
    in two planes across each other: from any side a head is seen.

    Args:
        ends: [m,2,3], tail and tip, m.
        colors: u8 [m,3].
        head: m, length of a head; at most half the arrow.
    """
    tips, along = ends[:, 1], ends[:, 1] - ends[:, 0]
    length = np.sqrt(np.square(along).sum(axis=1, keepdims=True))
    along = along / np.maximum(length, 1e-12)
    # the axis that an arrow is least along is never parallel to it
    one = np.cross(along, np.eye(3)[np.abs(along).argmin(axis=1)])
    one /= np.maximum(np.sqrt(np.square(one).sum(axis=1, keepdims=True)), 1e-12)
    back = np.minimum(head, 0.5 * length)
    barbs = [tips - back * (along + SPREAD * side) for side in (one, -one, np.cross(along, one), -np.cross(along, one))]
    lines = np.concatenate([ends, *(np.stack([tips, barb], axis=1) for barb in barbs)])
    return lines, np.repeat(np.tile(colors, (5, 1))[:, None], 2, axis=1)


def _means(values: np.ndarray, which: np.ndarray, count: np.ndarray) -> np.ndarray:
    return np.stack([np.bincount(which, weights=values[:, a]) / count for a in range(3)], axis=1)
