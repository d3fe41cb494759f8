"""`fluidlift mask`: the fluid as one picture per frame, which a person can correct and give back."""

from __future__ import annotations

import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.config import JobConfig
from fluidlift.io.output_files import Written, cleared, numbered
from fluidlift.pipeline import begin
from fluidlift.pipeline.hints import NO_HINTS, MaskHints
from fluidlift.pipeline.inputs import GivenFiles, Inputs
from fluidlift.pipeline.mask_facts import cleared_masks, require_unchanged, sealed
from fluidlift.pipeline.models import allowed_models, provenance_of
from fluidlift.pipeline.runner import Runner, gone_if_refused
from fluidlift.pipeline.work import Work
from fluidlift.seams import Progress, Silence
from fluidlift.types import Label
from fluidlift.types.stages import MaskFiles, Read, Segmentation

MASK_STAGES = ("read", "flow", "segment", "masks")


def find_masks(
    inputs: Inputs,
    folder: Path,
    config: JobConfig,
    *,
    hints: MaskHints = NO_HINTS,
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

    began = time.perf_counter()
    runner = Runner(folder, MASK_STAGES, force=frozenset(force), progress=progress or Silence())
    check_output_folder(folder)
    models, warnings = allowed_models(config, inputs)
    for text in warnings:
        runner.warn(text)
    with gone_if_refused(runner, "segment"):
        config = begin.uncropped(config)
        read, _, segmentation = begin.look(runner, GivenFiles.of(inputs), config, hints)
        found = runner.run(
            "masks", write_masks, read, segmentation, undistorted=inputs.camera is not None,
            beside={"folder": folder, "overwrite": "masks" in runner.force},
            still_there=lambda made: all(
                numbered(folder / name, t, ".png").is_file() for name in ("mask", "overlay") for t in range(made.frames)
            ),
            owns_files=True,
        )  # fmt: skip
    return Written(
        folder, time.perf_counter() - began, tuple(runner.warnings), runner.timings,
        _facts(segmentation, folder, found) | provenance_of(models), _words(segmentation, folder, found),
    )  # fmt: skip


def write_masks(
    read: Read, segmentation: Segmentation, *, undistorted: bool, folder: Path, overwrite: bool, work: Work
) -> MaskFiles:
    """The pictures, and beside them what they belong to."""
    from fluidlift.io.asset_folder import mark_owner
    from fluidlift.io.images import write_png
    from fluidlift.shape.segment import overlay

    clip, labels = read.clip, segmentation.labels
    if not overwrite:
        require_unchanged(folder / "mask", MASK_STAGES[-1])
    mark_owner(folder, "velocities", None)  # motion has masks and overlays of the same names
    masks, overlays = cleared_masks(folder / "mask"), cleared(folder / "overlay", (".png",))
    for t in range(len(clip)):
        work.step(t, len(clip))
        seen = np.asarray(labels.labels[t])
        write_png(numbered(masks, t, ".png"), np.where(seen == Label.FLUID, 255, 0).astype(np.uint8))
        write_png(numbered(overlays, t, ".png"), overlay(np.asarray(clip.frames[t]), seen))
    facts = {
        "of": clip.source,
        "size": clip.size,
        "frames": len(clip),
        "first_frame_of_clip": int(read.kept[0]),
        "undistorted": undistorted,
    }
    sealed(masks, facts)
    return MaskFiles(len(clip), clip.size)


def _facts(segmentation: Segmentation, folder: Path, found: MaskFiles) -> dict[str, Any]:
    return {
        "mask": str(folder / "mask"),
        "overlay": str(folder / "overlay"),
        "frames": found.frames,
        "size": list(found.size),
        "first_number": 1001,
        "fluid_share": segmentation.fluid_share,
        "confidence_mean": segmentation.confidence_mean,
        "flow_trusted": segmentation.flow_trusted,
    }


def _words(segmentation: Segmentation, folder: Path, found: MaskFiles) -> tuple[str, ...]:
    (width, height), sure = found.size, segmentation.confidence_mean
    return (
        f"{found.frames} masks of {width} x {height} px in {folder / 'mask'}, to be compared with the overlays "
        f"in {folder / 'overlay'}",
        f"fluid covers {100 * segmentation.fluid_share:.0f} % of the picture, mean confidence {sure:.2f}",
        f"correct them (white is fluid) and go on with: fluidlift make ... --mask {folder / 'mask'}",
        "or say more with --roi x,y,width,height, --click x,y and --not-here x,y",
    )
