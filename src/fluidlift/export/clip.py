"""What was found in the clip, for other tools: its camera, the motion in its pictures, and where the fluid is."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.export.job import ExportOutcome, ExportRequest
from fluidlift.io.frames import FIRST_FRAME
from fluidlift.io.kept_values import recalled
from fluidlift.io.output_files import cleared, numbered
from fluidlift.seams import Progress
from fluidlift.types import FluidAsset, Label, PinholeCamera
from fluidlift.types.stages import Flow, Motion, Segmentation

SENSOR = 36.0
"""mm, longer side of the film back that focal lengths in mm are told for, as 3D programs have it by default"""


def write_clip_files(
    folder: Path, out: Path, asset: FluidAsset, request: ExportRequest, manifest: dict[str, Any], progress: Progress
) -> ExportOutcome:
    """The files of one of the formats `OF_CLIP`.

    Raises:
        InputRejected: cached results of make are needed and gone, or frames are asked for that the clip has not.
    """
    if request.to == "camera":
        return write_camera(out, asset)
    if request.to == "masks":
        (segmentation,) = _recalled(folder, manifest, ("segment",), "the masks")
        return _masks(segmentation.labels.labels, out, request, progress)
    flow, segmentation, motion = _recalled(folder, manifest, ("flow", "segment", "motion"), "the flow")
    return _flow(flow, segmentation, motion, out, request, progress)


def camera_facts(camera: PinholeCamera) -> dict[str, Any]:
    """The camera JSON, with what 3D programs ask for: field of view, focal length on a 36 mm film back, shift.

    Shift is the principal point's offset in shares of the longer side, x to the right and y up, as Blender has it.
    """
    (width, height), (fx, fy), (cx, cy) = camera.size, camera.focal, camera.center
    longer = max(width, height)
    return camera.to_dict() | {
        "fov_degrees": {"horizontal": 2 * math.degrees(math.atan(0.5 * width / fx)),
                        "vertical": 2 * math.degrees(math.atan(0.5 * height / fy))},
        "film": {"longer_side_mm": SENSOR, "focal_length_mm": SENSOR * fx / longer,
                 "shift_x": (0.5 * width - cx) / longer, "shift_y": (cy - 0.5 * height) / longer},
        "world": "metres, z up",
    }  # fmt: skip


def write_camera(out: Path, asset: FluidAsset) -> ExportOutcome:
    """camera.json, as `fluidlift render --view` and `make --camera` take it."""
    from fluidlift.io.atomic import write_json

    moving = {"moves": False, "fps": 1.0 / asset.interval, "frames": asset.frame_count, "first_number": FIRST_FRAME}
    facts = camera_facts(asset.camera) | moving
    write_json(out / "camera.json", facts)
    fov, film = facts["fov_degrees"], facts["film"]
    words = (f"field of view {fov['horizontal']:.2f} x {fov['vertical']:.2f} degrees, {film['focal_length_mm']:.2f} mm "
             f"on a film {SENSOR:g} mm wide; it stands still",)  # fmt: skip
    return ExportOutcome(words, (), {"frames": asset.frame_count, "first": FIRST_FRAME})


def _recalled(folder: Path, manifest: dict[str, Any], names: tuple[str, ...], what: str) -> list[Any]:
    """Values of the stages that an asset was made from."""
    found = [recalled(folder, manifest, name) for name in names]
    gone = [name for name, value in zip(names, found) if value is None]
    if gone:
        raise InputRejected(
            f"{what} of the clip, which {'are' if what.endswith('s') else 'is'} no longer at hand "
            f"(no work/{gone[0]} of this asset)",
            "the asset's folder work/, as make left it", "run fluidlift make again, or fluidlift motion on the clip",
        )  # fmt: skip
    return found


def _wanted(request: ExportRequest, count: int, what: str) -> range:
    if request.frames is None:
        return range(count)
    first, last = request.frames
    if not FIRST_FRAME <= first <= last < FIRST_FRAME + count:
        raise InputRejected(f"{what} {first} to {last}", f"numbers from {FIRST_FRAME} to {FIRST_FRAME + count - 1}")
    return range(first - FIRST_FRAME, last - FIRST_FRAME + 1)


def _masks(labels: np.ndarray, out: Path, request: ExportRequest, progress: Progress) -> ExportOutcome:
    """####.png of every frame of the clip: white is fluid."""
    from fluidlift.io.images import write_png

    wanted = _wanted(request, len(labels), "masks")
    out.mkdir(parents=True, exist_ok=True)
    cleared(out, [".png"])
    for done, t in enumerate(wanted):
        progress.update(done, len(wanted))
        write_png(numbered(out, t, ".png"), np.where(np.asarray(labels[t]) == Label.FLUID, 255, 0).astype(np.uint8))
    return ExportOutcome(("white is fluid; of the working pictures of the clip",), (), _counted(wanted))


def _flow(
    flow: Flow, segmentation: Segmentation, motion: Motion, out: Path, request: ExportRequest, progress: Progress
) -> ExportOutcome:
    """flow.####.exr or .flo from every frame of the clip to the next: completed along the mainstream where make has
    done so, else as measured; unknown outside the fluid."""
    from fluidlift.io.flow_files import write_flow

    measured, labels = flow.flow, segmentation.labels.labels
    wanted = _wanted(request, len(measured), "flow")
    form = "flo" if request.to == "flo" else "exr"
    out.mkdir(parents=True, exist_ok=True)
    cleared(out, [".flo", ".exr"])
    completed = 0
    for done, t in enumerate(wanted):
        progress.update(done, len(wanted))
        wet = np.asarray(labels[t]) == Label.FLUID
        shown, trust = np.asarray(motion.completed[t], np.float32), np.asarray(measured.confidence[t], np.float32)
        if np.isfinite(shown[wet]).any():
            completed += 1
            shown, trust = np.where(np.isfinite(shown), shown, 0.0), np.where(motion.observed(t), trust, 0.0)
        else:
            shown = np.asarray(measured.displacement[t], np.float32)
        # EXR readers do not expect NaN: there the confidence says what is known
        shown = np.where(wet[..., None], shown, np.nan if form == "flo" else 0.0)
        write_flow(out, t, shown, np.where(wet, trust, 0.0), form)
    told = f"{completed} completed along the mainstream, {len(wanted) - completed} as measured between two frames"
    words = (f"{told}; px per frame of the working pictures", "fluidlift motion completes every frame")
    return ExportOutcome(words, (), _counted(wanted) | {"completed": completed})


def _counted(wanted: range) -> dict[str, Any]:
    return {"frames": len(wanted), "first": FIRST_FRAME + wanted.start}
