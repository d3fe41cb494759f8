"""A body of two parts in the geometry: what lies, and the jets that fall onto it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from fluidlift.messages import NONE, Notice
from fluidlift.shape import airborne, chute, jets, registration
from fluidlift.shape.drawn import region_pixels
from fluidlift.shape.fountain_columns import find_columns
from fluidlift.shape.jet_column import Jet, with_columns
from fluidlift.shape.kind import level_camera
from fluidlift.shape.slope import LEVEL
from fluidlift.shape.surface import FrontSurface
from fluidlift.types import GRAVITY, FluidKind, MetricScale, PinholeCamera, Setting, Similarity3, UpEvidence
from fluidlift.types.hints import DrawnView
from fluidlift.types.kind import LOOKING_DOWN, POUR

LEVEL_SAID = 0.999
"""share of streams that are level among those of which a person says so"""
LARGEST = 1000.0
"""m across the fluid, to which a size from a chute is believed: footage that is slowed down ten times shows 10 m so"""


@dataclass(frozen=True)
class BodyParts:
    """What lies and what falls onto it, in the picture."""

    outlines: tuple[jets.JetOutline, ...]
    lying: Bool[np.ndarray, "h w"]
    """the mask without what falls, and with what that hides"""
    puddle: bool = False
    """whether the lying part is a puddle: it has no downstream, so it is level"""
    ledges: Bool[np.ndarray, "h w"] | None = None
    """pixels of what comes down steeply onto the rest, as a person marked them"""
    level: bool = False
    """a person says that the rest is level"""

    @property
    def falling(self) -> Bool[np.ndarray, "h w"]:
        """Pixels of the jets."""
        return jets.airborne_pixels(list(self.outlines), self.lying.shape)

    @property
    def gentle(self) -> Bool[np.ndarray, "h w"]:
        """All pixels but those of jets and marked ledges: their motion may be that of one plane."""
        return ~self.falling if self.ledges is None else ~self.falling & ~self.ledges


def split(
    kind: FluidKind,
    camera: PinholeCamera,
    up: UpEvidence | None,
    mask: Bool[np.ndarray, "h w"],
    motion: Float[np.ndarray, "h w 2"],
    trust: Float[np.ndarray, "h w"],
) -> BodyParts:
    """The parts of a fluid.

    Args:
        kind: as it was found or given.
        camera: of the picture.
        up: its tilt, where that is known.
        mask: fluid pixels.
        motion: mean over the clip, px per frame.
        trust: of it.
    """
    usual = kind.pitch_prior[0] if kind.rises_from_pool else LOOKING_DOWN[0]
    tilt = up or UpEvidence(usual, 0.0, "", 0.0)
    if kind.rises_from_pool:
        return BodyParts(*_rising(mask, motion, trust, tilt))
    found = jets.find_jets(level_camera(camera, tilt), mask, motion, trust) if kind.runs_nearly_level else []
    return BodyParts(tuple(found), jets.lying_pixels(mask, jets.airborne_pixels(found, mask.shape)))


def _rising(mask, motion, trust, tilt: UpEvidence) -> tuple[tuple[jets.JetOutline, ...], np.ndarray]:
    """Columns and pool of a fountain."""
    found, pool = find_columns(mask, motion, trust, pitch=tilt.pitch)
    return tuple(found), pool


def with_roll(up: UpEvidence, parts: BodyParts, camera: PinholeCamera) -> UpEvidence:
    """The tilt, with the roll that the jets show."""
    if not parts.outlines or any(o.nozzle is not None for o in parts.outlines):  # wind leans what is thrown up
        return up
    roll = jets.roll_of(list(parts.outlines), level_camera(camera, replace(up, roll=0.0)))
    return replace(up, roll=roll, source=f"{up.source}; roll from the direction of a jet")


def level_prior(parts: BodyParts, motion: Float[np.ndarray, "h w 2"], trust: Float[np.ndarray, "h w"]) -> float:
    """Share of such streams that are level: few are where jets bring all there is, nearly all where one says so."""
    if parts.level:
        return LEVEL_SAID
    fed = not parts.puddle and jets.feed_all(list(parts.outlines), parts.lying, motion, trust)
    return jets.LEVEL_FED if fed else LEVEL


def trust_beside_jets(
    parts: BodyParts, camera: PinholeCamera, motion: Float[np.ndarray, "h w 2"], trust: Float[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w"]:
    """Trust in the motion of what lies, none in what spreads from the foot of a jet: that is as fast as what comes down
    a chute, and says nothing of a slope."""
    if not parts.outlines:
        return trust
    near = ndimage.binary_dilation(parts.falling, iterations=2 * round(jets.BLUR))
    spreads = [p for p in chute.chute_pixels(camera, parts.lying, motion, trust) if (p & near).any()]
    return trust * ~np.any(spreads, axis=0) if spreads else trust


def with_marks(parts: BodyParts, drawn: DrawnView | None, mask: Bool[np.ndarray, "h w"]) -> BodyParts:
    """The parts, with the ledges and pools that a person marked on the working picture."""
    if drawn is None:
        return parts
    ledges = region_pixels(drawn.ledges, (mask.shape[0], mask.shape[1])) & mask
    return replace(parts, ledges=ledges if ledges.any() else None, level=drawn.level)


def unused_marks(parts: BodyParts, front: FrontSurface) -> list[Notice]:
    """What to say of marked ledges of which the surface holds none."""
    if parts.ledges is None or front.chutes:
        return []
    return [
        Notice(
            "ledge-not-used",
            "the marked ledge is not part of the shape: it is too small, or the fluid is no stream that runs on below "
            "it; mark all of what falls, or give --kind stream",
        )
    ]


@dataclass(frozen=True)
class Composite:
    """The jets in space."""

    jets: tuple[Jet, ...]
    """canonical"""
    pixels: Bool[np.ndarray, "h w"]
    """where they are seen"""

    def plain(self, world_from_canonical: Similarity3) -> list[dict[str, Any]]:
        """For the stage's meta: in the world, m."""
        return [jet.transformed(world_from_canonical).to_dict() for jet in self.jets]


def standing(
    front: FrontSurface, parts: BodyParts, camera: PinholeCamera, mask: Bool[np.ndarray, "h w"]
) -> tuple[FrontSurface, Composite]:
    """The visible side with the jets on it."""
    front, found, pixels = with_columns(front, list(parts.outlines), camera, mask)
    return front, Composite(tuple(found), pixels)


def with_fall(
    scale: MetricScale,
    points: Float[np.ndarray, "n 3"],
    velocities: Float[np.ndarray, "n 3"],
    falls: Bool[np.ndarray, " n"],
    seen: registration.VelocityEvidence,
) -> MetricScale:
    """The scale from the jets' free fall, where nothing else gives one."""
    if scale.source != "assumed" or not falls.any():
        return scale
    part = registration.VelocityEvidence(None if seen.trust is None else seen.trust[falls], seen.interval, seen.pitch)
    found = registration.metric_scale(POUR, points[falls], velocities[falls], seen=part)
    if found.source != "free fall":
        return scale
    return replace(found, across=scale.across * found.value / scale.value)


def with_chute(
    scale: MetricScale,
    points: Float[np.ndarray, "n 3"],
    velocities: Float[np.ndarray, "n 3"],
    chutes: Sequence[Bool[np.ndarray, " n"]],
    seen: registration.VelocityEvidence,
) -> MetricScale:
    """The scale from the speed on the largest chute, where nothing else gives one.

    What runs down there must do so under 9.81 m/s^2 at the size that is taken (similarity after Froude). At a size that
    is too small the water outruns what was filmed, and a chute that is fed as filmed falls dry.
    """
    if scale.source != "assumed" or not chutes:
        return scale
    part = max(chutes, key=lambda c: int(c.sum()))
    trust = np.ones(len(points)) if seen.trust is None else seen.trust
    gravity = chute.head_acceleration(points[part], velocities[part], trust[part])
    if gravity is None:
        return scale
    value = GRAVITY / gravity
    across = scale.across * value / scale.value
    if not registration.SHORTEST_FALL < across < LARGEST:
        return scale
    slowed = Notice(
        "slowed-down",
        f"the speed on its chute makes the fluid {across:.3g} m across: the clip is likely slowed down, or moves "
        "faster than it shows. The asset keeps to the clip's time; --size METRES is true to scale, and runs faster",
    )
    warning = slowed if across > registration.LONGEST_FALL else NONE
    return MetricScale(value, "chute", warning, relative_error=chute.SCALED, across=across)


def composed(
    setting: Setting,
    composite: Composite,
    world_from_canonical: Similarity3,
    points: Float[np.ndarray, "n 3"],
    velocities: Float[np.ndarray, "n 3"],
    camera: PinholeCamera,
) -> Setting:
    """The setting with the jets' cells.

    Args:
        setting: of the lying part.
        composite: canonical.
        world_from_canonical: to metres.
        points: of the lying part's surface, canonical.
        velocities: there, canonical units per second.
        camera: in the world.
    """
    if not composite.jets:
        return setting
    t = world_from_canonical
    columns = [jet.transformed(t) for jet in composite.jets]
    return airborne.with_jets(setting, columns, t.points(points), t.vectors(velocities), camera)
