"""Masks as pictures, and beside them what they belong to, so that a person's change is seen."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fluidlift.errors import InputRejected
from fluidlift.io.output_files import cleared, digest_of, numbered

MASK_FACTS = "mask.json"
"""beside the pictures: what they belong to"""


def cleared_masks(masks: Path) -> Path:
    """The folder without the masks of an earlier run; their facts go first, so that a run cut off here is not taken
    for a person's change."""
    (masks / MASK_FACTS).unlink(missing_ok=True)
    return cleared(masks, (".png",))


def sealed(masks: Path, facts: dict[str, Any]) -> dict[str, Any]:
    """Write what finished masks belong to, with the digest by which a person's change is seen later."""
    from fluidlift.io.atomic import write_json

    digest = digest_of(numbered(masks, t, ".png") for t in range(facts["frames"]))
    facts = facts | {"sha256": digest}
    write_json(masks / MASK_FACTS, facts)
    return facts


def require_unchanged(masks: Path, stage: str) -> None:
    """Raise `InputRejected` where a person has changed the masks of an earlier run; `stage` writes them anew.

    Masks without a digest are those of a run that was stopped: nothing is known of them.
    """
    from fluidlift.io.limits import read_json

    if not (masks / MASK_FACTS).is_file():
        return
    facts = read_json(masks / MASK_FACTS, "mask facts")
    facts = facts if isinstance(facts, dict) else {}
    if "sha256" not in facts:
        return
    frames = facts.get("frames", 0)
    there = type(frames) is int and 0 <= frames <= sum(1 for _ in masks.glob("*.png"))  # else some were taken away
    if not there or digest_of(numbered(masks, t, ".png") for t in range(frames)) != facts["sha256"]:
        raise InputRejected(
            f"the masks in '{masks}' were changed since they were written", "another folder",
            f"choose another one with -o, or write over them with --force {stage}",
        )  # fmt: skip


def is_straight(mask: Path) -> bool:
    """Whether a mask was drawn on pictures without lens distortion, as those that fluidlift writes."""
    from fluidlift.io.limits import read_json

    facts = mask / MASK_FACTS if mask.is_dir() else mask.parent / MASK_FACTS
    if not facts.is_file():
        return False
    data = read_json(facts, "mask facts")
    return isinstance(data, dict) and data.get("undistorted") is True
