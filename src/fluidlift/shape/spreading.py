"""Fluid that spreads over what it lies on, told from fluid that falls: by its speed along its way.

Both move down in the picture. What falls gains speed, v^2 = v0^2 + 2 g s, and so it does in a picture that is taken
from the side. What spreads from the foot of a jet passes the same discharge through ever longer arcs, v h r = const: in
a layer of even depth h it has lost three quarters of its v^2 at twice the radius r, and more where it is viscous.

A jet may seem to lose speed as well, where it moves by more than its own pattern between two frames. But a jet has air
on both sides, and what spreads has what spread before it.
"""

from __future__ import annotations

from typing import cast

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

FALLS = 40.0
"""degrees to either side of straight down, within which motion may be that of a fall"""
CLEAR_PX = 0.3
"""px per frame: six times the error of optical flow at its best (`slope.LEAST_NOISE`)"""
CORE = 0.25
"""of the 95th percentile of the confident speed: slower fluid is what a fall ends in, or what lies around it"""
FEWEST = 60
"""pixels of a piece: fewer do not tell a speed along a way"""
KEEPS = (0.25, 0.5)
"""v^2 at the lower end of the fastest piece over that at its upper end: what keeps the first or less spreads (twice the
radius), what keeps the second or more may fall. Falls, fountains and cascades kept 1.4 times theirs and more, water
that runs down over stones 0.6, honey in its tray nothing"""
FLANKED = (0.5, 1.0)
"""fluid on either side of the piece over the piece's width, the median of its rows: less than the first is a jet or a
curtain, more than the second lies in fluid. Falls, fountains and jets have 0 to 0.4, honey in its tray 1.8 to 4"""


def spreading(
    fluid: Bool[np.ndarray, "h w"], displacement: Float[np.ndarray, "h w 2"], confidence: Float[np.ndarray, "h w"]
) -> float:
    """How far what moves down in the picture spreads and does not fall, 0 to 1; 0 where too little of it is seen.

    What spreads towards the viewer seems to gain as it comes nearer, the more so the lower he stands: a low value
    speaks for nothing.

    Args:
        fluid: its pixels.
        displacement: mean optical flow, px per frame.
        confidence: of the flow, 0 to 1.
    """
    piece = _fastest_piece(fluid, displacement, confidence)
    if piece is None:
        return 0.0
    weight = confidence[piece]
    moved = displacement[piece]
    heading = (weight[:, None] * moved).sum(axis=0)
    rows, columns = np.nonzero(piece)
    way = (columns * heading[0] + rows * heading[1]) / max(float(np.linalg.norm(heading)), 1e-9)
    kept = energy_kept(way, np.square(moved).sum(axis=1), weight)
    slows = np.clip((KEEPS[1] - kept) / (KEEPS[1] - KEEPS[0]), 0.0, 1.0)
    lies = np.clip((_flanks(piece, fluid) - FLANKED[0]) / (FLANKED[1] - FLANKED[0]), 0.0, 1.0)
    return float(slows * lies)


def energy_kept(
    way: Float[np.ndarray, " n"], energy: Float[np.ndarray, " n"], weight: Float[np.ndarray, " n"]
) -> float:
    """Kinetic energy at the lower end of a way over that at its upper end; infinite where there was none.

    Gravity and a steady friction change it along a line: v^2 = v0^2 + 2 a s.

    Args:
        way: how far along it each point lies, any unit.
        energy: there, any unit.
        weight: of it.
    """
    rise, start = np.polyfit(way, energy, 1, w=np.sqrt(weight))
    upper, lower = (max(float(start + rise * s), 0.0) for s in np.percentile(way, [2, 98]))
    return lower / upper if upper > 0 else np.inf


def _fastest_piece(fluid: np.ndarray, displacement: np.ndarray, confidence: np.ndarray) -> np.ndarray | None:
    """Connected pixels that move down clearly and carry the most motion of all such pieces."""
    if not fluid.any():
        return None
    speed = np.linalg.norm(displacement, axis=-1)
    weight = np.where(fluid, confidence * speed, 0.0)
    down = displacement[..., 1] > np.cos(np.radians(FALLS)) * speed
    moving = fluid & down & (speed > CLEAR_PX) & (weight > CORE * np.percentile(weight[fluid], 95))
    label, count = cast(tuple[np.ndarray, int], ndimage.label(ndimage.binary_opening(moving)))
    if count == 0:
        return None
    piece = label == 1 + int(np.argmax(ndimage.sum(weight, label, range(1, count + 1))))
    return piece if piece.sum() >= FEWEST else None


def _flanks(piece: np.ndarray, fluid: np.ndarray) -> float:
    """Width of the fluid beside a piece, on the side that has less of it, over the piece's own; median of its rows."""
    ratios = []
    for marked, wet in zip(piece, fluid):
        columns = np.nonzero(marked)[0]
        if len(columns):
            first, last = int(columns[0]), int(columns[-1])
            beside = min(_run(wet[:first][::-1]), _run(wet[last + 1 :]))
            ratios.append(beside / (last + 1 - first))
    return float(np.median(ratios))


def _run(wet: np.ndarray) -> int:
    """How many there are before the first that is dry."""
    return len(wet) if wet.all() else int(np.argmin(wet))
