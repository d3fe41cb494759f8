"""Parts of a fluid as they can be drawn on its picture: jets, ledges, vessel and pool, and the lines of levels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from fluidlift.types import PinholeCamera, kind_of
from fluidlift.types.flow import TRUSTED

if TYPE_CHECKING:
    from fluidlift.pipeline.sight import Sighted
    from fluidlift.shape.filled_vessel import FilledVessel

CORNERS = 0.004
"""of the longer side: how far an outline may be from the mask's"""
SMALLEST = 0.002
"""of the picture: pieces of a mask whose outline is told"""
ALIKE = np.cos(np.radians(30.0))
"""of the angle between two motions that count as the same direction"""
TURNS, RINGS = 48, 16
"""points of a circle, and heights of a vessel, that are drawn"""
STRETCHES = 12
"""pieces across a ledge of which its upper and lower edge are told"""
Points = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class FoundPart:
    """A part of the fluid, or what holds it."""

    what: str
    """a kind of fluid (what lies or stands), jet, ledge, vessel or pool"""
    probability: float
    """of the kind, for what lies and for vessel and pool, which come with it; of a jet or a ledge the share of its
    pixels whose motion is measured and goes its way; 1: a person marked it"""
    area: Points = ()
    """px, corners; empty: all of the mask that is no other part"""


@dataclass(frozen=True)
class Line:
    """A line on the picture."""

    what: str
    """crest or foot, of a ledge; level, of a pool or of what a vessel holds"""
    points: Points
    """px"""


def outlines(mask: np.ndarray) -> list[list[tuple[float, float]]]:
    """Outlines of the pieces of a mask, bool [h,w], the largest first, px, with few corners; holes are left out."""
    found, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    large = sorted((c for c in found if cv2.contourArea(c) > SMALLEST * mask.size), key=cv2.contourArea, reverse=True)
    lines = (cv2.approxPolyDP(c, CORNERS * max(mask.shape), True)[:, 0] + 0.5 for c in large)
    return [[(float(u), float(v)) for u, v in line] for line in lines if len(line) >= 3]


def parts_of(s: Sighted) -> tuple[FoundPart, ...]:
    """What the fluid consists of, what lies first."""
    seen, share = s.seen, s.seen.evidence.scores.get(s.seen.kind.name, 0.0)
    sure = share if seen.kind_free else 1.0
    found = [FoundPart(seen.kind.name, sure)]
    for jet in seen.parts.outlines:
        found.append(FoundPart("jet", _going_its_way(jet.pixels, seen.motion, seen.trust), _outline(jet.pixels)))
    marked = seen.parts.ledges is not None
    for pixels in s.front.chutes:
        going = 1.0 if marked else _going_its_way(pixels, seen.motion, seen.trust)
        found.append(FoundPart("ledge", going, _outline(pixels)))
    if s.front.vessel is not None:
        found.append(FoundPart("vessel", sure, _silhouette(s.front.vessel, s.canonical)))
    if _pools(s):
        found.append(FoundPart("pool", 1.0 if seen.parts.level else sure, _outline(_level_pixels(s))))
    return tuple(found)


def lines_of(s: Sighted) -> tuple[Line, ...]:
    """Crests and feet of ledges, and where still surfaces are level."""
    found: list[Line] = []
    for pixels in s.front.chutes:
        found += ledge_lines(pixels)
    if s.front.vessel is not None:
        found.append(Line("level", _ring(s.front.vessel, s.front.vessel.level, s.canonical)))
    if _pools(s) and (area := _outline(_level_pixels(s))):
        found.append(Line("level", (*area, area[0])))
    return tuple(found)


def ledge_lines(pixels: np.ndarray) -> list[Line]:
    """The upper and the lower edge of what comes down, bool [h,w], from left to right."""
    columns = np.flatnonzero(pixels.any(axis=0))
    if len(columns) < 2:
        return []
    top, bottom = pixels.argmax(axis=0), pixels.shape[0] - pixels[::-1].argmax(axis=0)
    crest, foot = [], []
    for piece in np.array_split(columns, min(STRETCHES, len(columns))):
        at = float(piece.mean()) + 0.5
        crest.append((at, float(np.median(top[piece]))))
        foot.append((at, float(np.median(bottom[piece]))))
    return [Line("crest", tuple(crest)), Line("foot", tuple(foot))]


def _pools(s: Sighted) -> bool:
    """Whether what lies is a pool that stands level."""
    return s.seen.parts.puddle or s.seen.parts.level or kind_of(s.seen.kind).is_standing_water


def _level_pixels(s: Sighted) -> np.ndarray:
    pixels = s.seen.parts.lying & ~s.seen.parts.falling
    for steep in s.front.chutes:
        pixels = pixels & ~steep
    return pixels


def _going_its_way(pixels: np.ndarray, motion: np.ndarray, trust: np.ndarray) -> float:
    """Share of some pixels whose motion is measured and goes the way that they go at large."""
    ways, sure = motion[pixels], trust[pixels] > TRUSTED
    if not sure.any():
        return 0.0
    mean = np.median(ways[sure], axis=0)
    length = np.linalg.norm(ways, axis=1) * max(float(np.linalg.norm(mean)), 1e-9)
    return float((sure & (ways @ mean > ALIKE * length)).mean())


def _outline(pixels: np.ndarray) -> Points:
    found = outlines(pixels)
    return tuple(found[0]) if found else ()


def _ring(vessel: FilledVessel, z: float, camera: PinholeCamera) -> Points:
    """px of the inside of a vessel at a height."""
    angle = np.linspace(0.0, 2.0 * np.pi, TURNS + 1)
    radius = float(vessel.radius_at(np.array([z]))[0])
    x, y = (vessel.axis[k] + radius * f(angle) for k, f in ((0, np.cos), (1, np.sin)))
    uv, _ = camera.project(np.stack([x, y, np.full_like(x, z)], axis=-1))
    return tuple((float(u), float(v)) for u, v in uv)


def _silhouette(vessel: FilledVessel, camera: PinholeCamera) -> Points:
    """px of its outline, up on one side and down on the other, as high as its radius is known."""
    heights = np.linspace(vessel.floor, float(vessel.heights[-1]), RINGS)
    sides: tuple[list[tuple[float, float]], list[tuple[float, float]]] = ([], [])
    for z in heights:
        ring = _ring(vessel, float(z), camera)
        sides[0].append(min(ring))
        sides[1].append(max(ring))
    return (*sides[0], *reversed(sides[1]))
