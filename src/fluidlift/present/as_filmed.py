"""The card of an asset: how near its re-simulation stays to its own clip, or why that cannot be told."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fluidlift.messages import Notice
from fluidlift.physics.inflow_schedule import InflowSchedule
from fluidlift.scene.build import Scene
from fluidlift.scene.footage import Footage
from fluidlift.types import kind_of
from fluidlift.types.stages import Lift

if TYPE_CHECKING:
    from fluidlift.evaluate.as_filmed import AsFilmed

BEYOND = 3
"""times the clip's length, up to which frames are held against it: they lie on disk meanwhile"""


WORST_TILT = 8.0
"""degrees that a tilt that is right is off at most: from 25 degrees down, lengths along the view come
out wrong by a third"""


class Reel:
    """Pictures of one size, which go to a file without a name as they come and are mapped from there."""

    def __init__(self, folder: Path) -> None:
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115  it lives as long as the reel
        self._count, self._shape, self._type = 0, (0, 0), np.dtype(np.uint8)

    def append(self, picture: np.ndarray) -> None:
        """One more; all have the shape and type of the first."""
        self._count, self._shape, self._type = self._count + 1, picture.shape, picture.dtype
        self._file.write(np.ascontiguousarray(picture).tobytes())

    def array(self) -> np.ndarray:
        """All of them, [k, ...]; the file is gone once neither this nor the reel is held any more."""
        self._file.flush()
        shape = (self._count, *self._shape)
        return np.memmap(self._file, self._type, "r", shape=shape) if self._count else np.zeros(shape, self._type)


def why_not(scene: Scene, footage: Footage | None, *, preview: bool) -> str | None:
    """Why a re-simulation, drawn or not, cannot be held against its clip, and what to do; None where it can."""
    from fluidlift.evaluate.as_filmed import FEWEST

    edits = {
        "obstacles": scene.obstacles, "emitters": scene.emitters, "a loop": scene.overlap,
        "other parameters": scene.changes, "another inflow": scene.inflow != InflowSchedule(),
        "another terrain": scene.reshaped, "a longer channel": scene.extended,
    }  # fmt: skip
    found = [name for name, there in edits.items() if there]
    if found:
        return f"the scene is edited ({', '.join(found)}): run fluidlift edit --reset, then fluidlift sim"
    if footage is None:
        return "the clip is not at hand (work/ is missing or of another version): run fluidlift make again"
    if scene.interval != scene.clip_interval:
        return "the frames are at another rate than the clip's: run fluidlift sim without --fps"
    if not preview:
        return "no pictures were drawn: run fluidlift sim with --set show.preview=true"
    filmed = len(footage.clip) - footage.start
    if min(filmed, scene.frames) < FEWEST:
        return f"too few frames, {min(filmed, scene.frames)} where {FEWEST} are needed: give a longer --duration"
    return None


@dataclass(frozen=True)
class Noted:
    """The card as the manifest has it."""

    as_filmed: dict[str, Any]
    """the card, or why there is `none`"""
    warnings: tuple[Notice, ...] = ()


def card_of_run(
    scene: Scene, footage: Footage | None, preview: bool, renders: np.ndarray, coverage: np.ndarray
) -> Noted:
    """What the stage that shows notes; a warning where the card does not hold.

    Args:
        scene: that was simulated.
        footage: its clip, where it is at hand.
        preview: whether pictures are drawn.
        renders: u8 [K,H,W,3] in the clip's camera, from the first simulated frame on.
        coverage: bool [K,H,W], pixels that the fluid covers.
    """
    from fluidlift.evaluate.as_filmed import FEWEST, as_filmed
    from fluidlift.motion.full_frame import seen_pixels

    reason = why_not(scene, footage, preview=preview)
    if reason is None and len(renders) < FEWEST:
        reason = f"the simulation ended early: too few frames, {len(renders)} where {FEWEST} are needed"
    if reason is not None or footage is None:
        return Noted({"none": reason})
    frames, kind = footage.clip.frames[footage.start :], kind_of(scene.kind)
    card = as_filmed(
        frames, footage.labels.fluid[footage.start :], scene.interval, renders, coverage,
        runs=not kind.is_still_water, fills=kind.fills_vessel,
        seen=None if footage.unseen is None else seen_pixels(footage.unseen[footage.start :], footage.clip.size),
    )  # fmt: skip
    warning = card.warning()
    return Noted(card.to_dict(), (warning,) if warning else ())


def certainty(lift: Lift) -> dict[str, float]:
    """How likely it is that mask, kind and tilt are right, of those that no person gave."""
    from fluidlift.shape.fluid_found import chance_of_mask

    g, mask, found = lift.geometry, lift.segmentation, {}
    if not mask.user_mask and mask.likely_overlap is not None:
        found["mask"] = chance_of_mask(mask.likely_overlap)
    if g.kind_source != "user" and g.kind in g.kind_evidence.scores:
        found["kind"] = g.kind_evidence.scores[g.kind]
    if g.up.error > 0.0:
        found["tilt"] = math.erf(WORST_TILT / (g.up.error * math.sqrt(2.0)))
    return {key: round(value, 4) for key, value in found.items()}


def card_of(manifest: Mapping[str, Any]) -> AsFilmed | str:
    """The card that a manifest holds, or why there is none and what to do."""
    from fluidlift.evaluate.as_filmed import AsFilmed, with_certainty

    stored = manifest.get("simulation", {}).get("as_filmed")
    if not isinstance(stored, dict):
        return "its frames are of a version that did not measure this: run fluidlift sim"
    if "none" in stored:
        return str(stored["none"])
    try:
        return with_certainty(AsFilmed.from_dict(stored), manifest.get("metrics", {}).get("certainty", {}))
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
        return "what the manifest says of it cannot be read: run fluidlift sim --restart"
