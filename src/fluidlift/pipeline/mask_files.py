"""`fluidlift mask`: the fluid as one picture per frame, which a person can correct and give back."""

from __future__ import annotations

import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.config import JobConfig
from fluidlift.errors import InputRejected
from fluidlift.pipeline import begin
from fluidlift.pipeline.reading import Inputs, clip_of
from fluidlift.pipeline.seeing import NO_HINTS, Hints, labels_of
from fluidlift.pipeline.story import Progress, Result, Silence, Story, gone_if_refused
from fluidlift.pipeline.written import Written, cleared, digest_of, numbered, require_stages
from fluidlift.types import Label

MASK_STAGES = ("read", "flow", "segment", "masks")
MASK_FACTS = "mask.json"
"""beside the pictures: what they belong to"""


def find_masks(
    inputs: Inputs,
    folder: Path,
    config: JobConfig,
    *,
    hints: Hints = NO_HINTS,
    force: Iterable[str] = (),
    progress: Progress | None = None,
) -> Written:
    """Write mask/####.png (0 and 255) and overlay/####.png of the working pictures, as make sees them.

    Args:
        inputs: the clip, and its camera where the lens distorts.
        folder: to write; an earlier one is continued.
        config: of the job; read, segment and motion.method count.
        hints: where the fluid is.
        force: stages to run again, with all that come after.
        progress: where progress is told.

    Raises:
        InputRejected: an input that cannot be used, a folder with other things in it, or masks there that a person
            has changed.
    """
    from fluidlift.io.asset_folder import check_output_folder

    require_stages(force, MASK_STAGES)
    check_output_folder(folder)
    began = time.perf_counter()
    story = Story(folder, MASK_STAGES, force=frozenset(force), progress=progress or Silence())
    with gone_if_refused(story, "segment"):
        begin.look(story, inputs, config, begin.input_hashes(inputs), hints)
        found = story.run(
            "masks",
            lambda: _write(story, folder, "masks" in story.force, inputs.camera is not None),
            settings=inputs.camera is not None,
            after=("read", "segment"),
            still_there=lambda result: all(
                numbered(folder / name, t, ".png").is_file()
                for name in ("mask", "overlay") for t in range(result.meta["frames"])
            ),
            owns_files=True,
        )  # fmt: skip
    return Written(
        folder, time.perf_counter() - began, tuple(story.warnings), story.timings,
        _facts(story, folder, found), _words(story, folder, found),
    )  # fmt: skip


def _write(story: Story, folder: Path, overwrite: bool, undistorted: bool) -> Result:
    """The pictures, and beside them what they belong to."""
    from fluidlift.io.asset_folder import mark_owner
    from fluidlift.io.images import write_png
    from fluidlift.shape.segment import overlay

    clip, labels = clip_of(story), labels_of(story)
    if not overwrite:
        require_unchanged(folder / "mask", MASK_STAGES[-1])
    mark_owner(folder, "velocities", None)  # motion has masks and overlays of the same names
    masks, overlays = cleared_masks(folder / "mask"), cleared(folder / "overlay", (".png",))
    for t in range(len(clip)):
        story.step(t, len(clip))
        seen = np.asarray(labels.labels[t])
        write_png(numbered(masks, t, ".png"), np.where(seen == Label.FLUID, 255, 0).astype(np.uint8))
        write_png(numbered(overlays, t, ".png"), overlay(np.asarray(clip.frames[t]), seen))
    kept = story["read"].arrays["kept"]
    facts = {
        "of": clip.source,
        "size": clip.size,
        "frames": len(clip),
        "first_frame_of_clip": int(kept[0]),
        "undistorted": undistorted,
    }
    return Result({}, sealed(masks, facts))


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
    if digest_of(numbered(masks, t, ".png") for t in range(facts.get("frames", 0))) != facts["sha256"]:
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


def _facts(story: Story, folder: Path, found: Result) -> dict[str, Any]:
    meta = story["segment"].meta
    return {
        "mask": str(folder / "mask"),
        "overlay": str(folder / "overlay"),
        "frames": found.meta["frames"],
        "size": list(found.meta["size"]),
        "first_number": 1001,
        "fluid_share": meta["fluid_share"],
        "confidence_mean": meta["confidence_mean"],
        "flow_trusted": meta["flow_trusted"],
    }


def _words(story: Story, folder: Path, found: Result) -> tuple[str, ...]:
    meta, (width, height) = story["segment"].meta, found.meta["size"]
    return (
        f"{found.meta['frames']} masks of {width} x {height} px in {folder / 'mask'}, to be compared with the overlays "
        f"in {folder / 'overlay'}",
        f"fluid covers {100 * meta['fluid_share']:.0f} % of the picture, mean confidence {meta['confidence_mean']:.2f}",
        f"correct them (white is fluid) and go on with: fluidlift make ... --mask {folder / 'mask'}",
        "or say more with --roi x,y,width,height, --click x,y and --not-here x,y",
    )
