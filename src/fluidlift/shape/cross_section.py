"""How deep water is where only its surface is seen: a typical depth, how it changes along the stream, and the shape of
bed, banks and rocks across it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from fluidlift.types import GRAVITY, FluidKind, kind_of

REPOSE = 0.7
"""slope of a bank under water: the tangent of 35 degrees, the angle of repose of gravel and soil (30 to 40 degrees)"""

ROCK_FLANK = 2.0
"""slope of a rock under water; a sphere that is half out of the water has steeper ones, a slab flatter ones"""

STEEPEST = 2.0
"""slope of a bank under water beside which the water is as fast as elsewhere: it is rooted, cohesive, rock or built"""

CONTINUITY = 0.6
"""exponent on 1 / (speed x width): the share of what the discharge says about the depth that is believed. Depth varies
by about 35 % along a reach, and a surface speed misjudges the mean one by about 30 %: 0.35^2 / (0.35^2 + 0.3^2)"""

STRAIGHT = 0.5
"""how far the bed is drawn to a straight line along the stream: a reach's bed is straighter than its water"""

RIVER_DEPTH, RIVER_POWER = 0.067, 0.857
"""mean depth of a river of 1 m's width, m, and the power of its width (m) that it goes with. Parker and others 2007
(Journal of Geophysical Research 112, F04005) for rivers full to their banks in gravel of size D: depth = 0.382 q and
width = 4.63 q (Q / (sqrt(g D) D^2))^0.0667 with q = (Q^2 / g)^(1/5); Q is eliminated, D is 50 mm. With four times that
it is 1.2 times as deep. A bed between banks is nearly flat here, so its mean depth is the one that carries the water"""
RIVERS = (1.0, 5.0)
"""m: width up to which nothing is known of a channel (a flume, a gutter, a film), and from which it is such a river"""


SHELF = 0.125
"""m^(1/3), depth of a beach's bed over (distance from its waterline)^(2/3): equilibrium profile of sand of 0.3 mm
(Dean 1977; 1991, Journal of Coastal Research 7; medium sand, and the middle of what beaches have)"""
FORESHORE = 0.05
"""slope of its dry sand (a choice: experiments on beaches take 1 in 15 and 1 in 25, as those of Dionisio Antonio and
others 2023, Journal of Marine Science and Engineering 11, 2244)"""


@dataclass(frozen=True)
class Reach:
    """What is known of the water from above, one entry per column."""

    wet: Bool[np.ndarray, "nx ny"]
    """water, and the rocks that stand in it"""
    rock: Bool[np.ndarray, "nx ny"]
    level: Float[np.ndarray, "nx ny"]
    """z of the water's surface, m"""
    along: Float[np.ndarray, "nx ny"]
    """distance along the stream, m"""
    speed: Float[np.ndarray, "nx ny"]
    """of the surface, m/s; nan where it is not known"""
    spacing: float
    """width of a column, m"""


def distance_inside(inside: Bool[np.ndarray, "nx ny"], spacing: float) -> Float[np.ndarray, "nx ny"]:
    """Distance (m) of each true cell to the nearest false one; the map's edge is no bank."""
    if inside.all():
        return np.full(inside.shape, spacing * max(inside.shape) / 2)
    pad = max(inside.shape)
    return ndimage.distance_transform_edt(np.pad(inside, pad, mode="edge"))[pad:-pad, pad:-pad] * spacing


def usual_depth(width: float, ratio: float) -> float:
    """Depth (m) of the flat bed of a stream whose width is known in metres.

    Small channels are `ratio` times as deep as wide; rivers are shallower, the wider the more (`RIVER_DEPTH`); between
    both (`RIVERS`) by their logarithms.

    Args:
        width: m, positive.
        ratio: depth over width of small channels.
    """
    small, large = RIVERS
    known = float(np.clip(np.log(width / small) / np.log(large / small), 0.0, 1.0))
    assumed = ratio * width
    return min(assumed, assumed ** (1.0 - known) * (RIVER_DEPTH * width**RIVER_POWER) ** known)


def shelving(distance: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Depth (m) of a sea at a distance (m) from its beach."""
    return SHELF * np.maximum(distance, 0.0) ** (2.0 / 3.0)


def depth_along(reach: Reach, depth: float, width: float, kind: str | FluidKind) -> Float[np.ndarray, "nx ny"]:
    """Greatest depth (m) of the section that each column lies in.

    The same discharge passes every section, so that depth x width x speed is the same in all of them: a narrow or fast
    part is shallower than its neighbours say, by `CONTINUITY`. Then the bed is drawn to a straight line.

    Args:
        reach: the water from above.
        depth: of a typical section, m.
        width: typical, m; what changes over less than half of it along the stream does not count.
        kind: of the fluid; only what runs nearly level has a straight bed.
    """
    h = reach.spacing
    free = reach.wet & ~reach.rock
    if not free.any():
        return np.full(reach.wet.shape, depth)
    start = float(reach.along[free].min())
    station = np.floor((reach.along - start) / h + 0.5).astype(int)
    count = int(station[free].max()) + 1
    blur = max(0.5 * width / h, 1.0)

    def smooth(values, where) -> np.ndarray:
        sums = np.bincount(station[where], values[where], count)
        return ndimage.gaussian_filter1d(sums, blur, mode="nearest")

    ones = np.ones(free.shape)
    columns = smooth(ones, free)
    level = smooth(reach.level, free) / np.maximum(columns, 1e-9)
    measured = free & np.isfinite(reach.speed)
    factor = np.ones(count)
    if measured.sum() >= 0.2 * free.sum():
        seen = smooth(ones, measured)
        flux = columns * smooth(reach.speed, measured) / np.maximum(seen, 1e-9)
        good = (seen > 0.1 * np.median(seen)) & (flux > 0)
        if good.any():
            flux = np.interp(np.arange(count), np.flatnonzero(good), flux[good])
            factor = np.clip((np.median(flux) / flux) ** CONTINUITY, 0.5, 2.0)
    section = depth * factor
    if kind_of(kind).runs_nearly_level and count > 2:
        bed = level - section
        line = np.polyval(np.polyfit(np.arange(count), bed, 1, w=np.sqrt(columns)), np.arange(count))
        section = np.clip(level - (STRAIGHT * line + (1 - STRAIGHT) * bed), 0.4 * depth, 2.5 * depth)
    return section[np.clip(station, 0, count - 1)]


def thickness(
    reach: Reach, section: Float[np.ndarray, "nx ny"], width: float, slope: float = REPOSE
) -> Float[np.ndarray, "nx ny"]:
    """Depth (m) of the water in each column: banks at their slope, down to a flat bed; 0 where it is dry.

    Where the water beside a bank keeps up with the rest, it is deep there: the bank is then as steep as that asks for,
    to `STEEPEST` (`swiftness`). Slow water says nothing, it may be in the shelter of something.

    Args:
        reach: the water from above.
        section: greatest depth of the section that each column lies in, m.
        width: typical, m: a section that is deep for its width has steeper banks, or its bed would never be reached.
        slope: of the banks under water where nothing is known.
    """
    bank = distance_inside(reach.wet, reach.spacing)
    share = bank * np.maximum(slope, section / (0.4 * width)) / np.maximum(section, 1e-12)
    # the bank is at the edge of the first dry column, not in its middle
    steep = STEEPEST * np.maximum(bank - 0.5 * reach.spacing, 0.0) / np.maximum(section, 1e-12)
    share = np.maximum(share, np.minimum(steep, swiftness(reach, width)))
    below = section * share / (1.0 + share**6) ** (1 / 6)  # the smaller of both, with a rounded foot
    return np.where(reach.wet, beside_rocks(reach, below), 0.0)


def beside_rocks(reach: Reach, depth: Float[np.ndarray, "nx ny"]) -> Float[np.ndarray, "nx ny"]:
    """Depth (m) with the flanks of what stands in the water."""
    if not reach.rock.any():
        return depth
    return np.minimum(depth, ROCK_FLANK * ndimage.distance_transform_edt(~reach.rock) * reach.spacing)


def swiftness(reach: Reach, width: float) -> Float[np.ndarray, "nx ny"]:
    """Depth that the speed of the surface speaks for, as part of the section's; 0 where no speed is known.

    Driven by one slope, the deeper of two neighbouring columns is the faster one: in a turbulent stream the speed goes
    with h^(2/3) (Manning), in a laminar film with h^2 (Nusselt). Between them stands h itself. Drag from the side slows
    water beside a steep bank as well, so this is the least depth that the speed allows.

    Args:
        reach: the water from above.
        width: typical, m; the section's speed is the mean over the discharge that passes within half of it.
    """
    known = np.isfinite(reach.speed) & reach.wet & ~reach.rock
    speed = np.where(known, reach.speed, 0.0)

    def mean(values: np.ndarray, sigma: float) -> np.ndarray:
        return ndimage.gaussian_filter(values, sigma, mode="nearest")

    across = max(0.5 * width / reach.spacing, 1.0)
    usual = mean(speed**2, across) / np.maximum(mean(speed, across), 1e-12)
    here = mean(speed, 1.0) / np.maximum(mean(known.astype(float), 1.0), 1e-12)
    return np.where(known, np.clip(here / np.maximum(usual, 1e-12), 0.0, 1.0), 0.0)


def rock_height(reach: Reach) -> Float[np.ndarray, "nx ny"]:
    """How far the rocks stand out of the water, m; 0 elsewhere.

    Domes seven tenths as high as half of them is wide, on a step as high as the water climbs when it stops at them,
    v^2 / 2g (Bernoulli), and a cell: a rock that stands out in the picture is not run over.
    """
    if not reach.rock.any():
        return np.zeros(reach.rock.shape)
    h, known = reach.spacing, np.isfinite(reach.speed)
    climb = float(np.median(reach.speed[known]) ** 2) / (2 * GRAVITY) if known.any() else 0.0
    label, count = ndimage.label(reach.rock, structure=np.ones((3, 3)))
    inner = distance_inside(reach.rock, h)
    radius = np.concatenate([[0.0], np.atleast_1d(ndimage.maximum(inner, label, range(1, count + 1)))])[label]
    dome = 0.7 * np.sqrt(np.maximum(2 * radius * inner - inner**2, 0.0))
    return np.where(reach.rock, h + min(climb, 3.0 * h) + dome, 0.0)
