"""The files of one frame's motion, and a journal of those that are written, so that a stopped run goes on."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from fluidlift.io.asset_folder import mark_owner
from fluidlift.io.asset_paths import asset_file
from fluidlift.io.atomic import plain, write_json
from fluidlift.io.frames import FIRST_FRAME
from fluidlift.io.limits import parse_json
from fluidlift.io.output_files import cleared, numbered
from fluidlift.messages import Notice, as_plain
from fluidlift.motion.steady_flow import spans_of
from fluidlift.pipeline.inputs import Inputs
from fluidlift.pipeline.mask_facts import MASK_FACTS, cleared_masks, require_unchanged, sealed
from fluidlift.pipeline.volume_motion import FAST_FALL, plain_report
from fluidlift.types import CellType, FaceVelocity, PixelFlow, SurfaceMotion, VideoClip
from fluidlift.types.flow import TRUSTED
from fluidlift.types.fluid_masks import FluidMasks
from fluidlift.types.stages import Geometry

if TYPE_CHECKING:
    from fluidlift.motion.sequence import FrameMotion

OVERLAY_SHARE = 0.65
"""of the flow's colour in the overlay where it is fast; the rest is the picture"""
LEGEND_SIDE = 161
"""px of the colour wheel"""


@dataclass(frozen=True)
class MotionFiles:
    """Which files are written."""

    format: Literal["flo", "exr", "npz"] = "exr"
    """of the flow"""
    raw: bool = False
    """also the flow of single pairs, before averaging and completion"""

    def of_frame(self, folder: Path, t: int) -> list[Path]:
        """The files of frame t."""
        flow = f"flow.{FIRST_FRAME + t:04d}.{self.format}"
        found = [folder / "flow" / flow, numbered(folder / "mask", t, ".png"), numbered(folder / "observed", t, ".png")]
        found += [numbered(folder / "overlay", t, ".png"), numbered(folder / "velocity", t, ".vdb")]
        found.append(numbered(folder / "surface", t, ".ply"))
        return [*found, folder / "raw_flow" / flow] if self.raw else found


@dataclass(frozen=True)
class WritingPlace:
    """Where files go, and what lies there already."""

    folder: Path
    inputs: Inputs
    """of the job: what was given stays as it is"""
    again: bool = False
    """write all frames again, over masks that a person has changed, too"""


class FrameWriter:
    """Writes frames one after the other and remembers what it has written.

    Args:
        clip: that moves.
        masks: of its fluid.
        measured: its flow, as measured.
        geometry: of the body.
        files: which are written.
        place: where they go.
        key: of the run: only one with the same goes on from what it has written.

    Raises:
        InputRejected: a person has changed the masks of the run before, and has not given them back.
    """

    def __init__(
        self, clip: VideoClip, masks: FluidMasks, measured: PixelFlow, geometry: Geometry, files: MotionFiles,
        place: WritingPlace, key: str,
    ) -> None:  # fmt: skip
        folder, inputs = place.folder, place.inputs
        self.folder, self.inputs, self.files = folder, inputs, files
        self.clip, self.masks, self.measured, self.geometry = clip, masks, measured, geometry
        self.journal = asset_file(folder, f"work/velocities/{key}.rows")
        self.spans = spans_of(self.clip)
        self.grid, self.cells = geometry.grid, geometry.setting.cell_types
        self.scale = self._flow_scale()
        self.keeps_masks = _same(inputs.mask, folder / "mask")
        """the masks there are those that were given: they stay as they are"""
        self.rows: dict[int, dict[str, Any]] = {} if place.again else self._written_before()
        if not self.rows:
            if not place.again and not self.keeps_masks:
                require_unchanged(folder / "mask", "velocities")
            self._clear()
        self._write_once()

    @cached_property
    def wet(self) -> np.ndarray:
        """bool [nx,ny,nz]: cells that hold fluid at rest."""
        return np.isin(self.cells, (CellType.FLUID, CellType.INFLOW, CellType.OUTFLOW))

    def write(self, t: int, found: FrameMotion | None) -> None:
        """The files of a frame, and its row in the journal; `found` is None where it shows no fluid."""
        from fluidlift.io.flow_files import write_flow
        from fluidlift.io.images import write_png

        mask, (width, height) = self.masks[t], self.clip.size
        displacement = np.zeros((height, width, 2), np.float32) if found is None else found.displacement
        trust = np.zeros((height, width), np.float32) if found is None else found.confidence
        seen = np.zeros((height, width), bool) if found is None else found.observed & mask
        self._write_mask(t)
        write_png(numbered(self.folder / "observed", t, ".png"), _white(seen))
        # outside the fluid nothing is known: NaN, which .flo marks as unknown
        moved = self.spans[t] * displacement  # files say what happened between two frames
        known = np.where(mask[..., None], moved, np.nan) if self.files.format == "flo" else moved
        write_flow(self.folder / "flow", t, known, np.where(mask, trust, 0.0), self.files.format)
        if self.files.raw:
            pair = self.measured.displacement[t], self.measured.confidence[t]
            write_flow(self.folder / "raw_flow", t, *pair, self.files.format)
        write_png(numbered(self.folder / "overlay", t, ".png"), self._overlay(t, displacement, mask))
        self._write_space(t, None if found is None else found.surface, None if found is None else found.velocity)
        row = {
            "frame": t,
            "number": FIRST_FRAME + t,
            "time": float(self.clip.times[t]),
            **_row(found, moved, mask, seen, trust),
        }
        self.rows[t] = row
        with self.journal.open("a", encoding="utf-8") as journal:
            journal.write(json.dumps(plain(row)) + "\n")

    def finish(self, pairs: int) -> list[dict[str, Any]]:
        """The mask of the last frame, from which no flow goes on; the rows in order. The journal is done with."""
        self._write_mask(pairs)
        if not self.keeps_masks:
            sealed(self.folder / "mask", self._mask_facts())
        self.journal.unlink(missing_ok=True)
        return [self.rows[t] for t in range(pairs)]

    def _written_before(self) -> dict[int, dict[str, Any]]:
        """Rows of frames whose files are all there; a line that was cut off ends the list."""
        rows: dict[int, dict[str, Any]] = {}
        if not self.journal.is_file():
            return rows
        for line in self.journal.read_bytes().splitlines():
            try:
                row = parse_json(line)
                t = int(row["frame"])
            except (ValueError, KeyError, TypeError, OverflowError):
                break
            if all(path.is_file() for path in self.files.of_frame(self.folder, t)):
                rows[t] = row
        return rows

    def _write_mask(self, t: int) -> None:
        from fluidlift.io.images import write_png

        file = numbered(self.folder / "mask", t, ".png")
        if not (self.keeps_masks and file.is_file()):
            write_png(file, _white(self.masks[t]))

    def _mask_facts(self) -> dict[str, Any]:
        """What the masks belong to."""
        straight = self.inputs.camera is not None
        return {"of": self.clip.source, "size": self.clip.size, "frames": len(self.clip), "undistorted": straight}

    def _clear(self) -> None:
        """Nothing of an earlier run may stand beside what is written now, but the flow that was given."""
        mark_owner(self.folder, "masks", None)  # `fluidlift mask` has masks and overlays of the same names
        self.journal.parent.mkdir(parents=True, exist_ok=True)
        for old in self.journal.parent.glob("*.rows"):
            old.unlink()
        suffixes = {"flow": (".flo", ".exr", ".npz"), "raw_flow": (".flo", ".exr", ".npz"), "velocity": (".vdb",)}
        suffixes |= {"surface": (".ply",), "observed": (".png",), "overlay": (".png",)}
        for name, kinds in suffixes.items():
            if not _same(self.inputs.flow, self.folder / name):
                cleared(self.folder / name, kinds)
        if not self.keeps_masks:
            cleared_masks(self.folder / "mask")

    def _write_once(self) -> None:
        """What does not change from frame to frame: camera, colour wheel."""
        from fluidlift.io.images import write_png
        from fluidlift.motion.optical_flow import flow_picture

        write_json(self.folder / "camera.json", self.geometry.camera.to_dict())
        if not self.keeps_masks:
            write_json(self.folder / "mask" / MASK_FACTS, self._mask_facts())
        across = np.linspace(-self.scale, self.scale, LEGEND_SIDE, dtype=np.float32)
        wheel = np.stack(np.meshgrid(across, across), axis=-1)
        disc = np.hypot(wheel[..., 0], wheel[..., 1]) <= self.scale
        write_png(self.folder / "colour_wheel.png", flow_picture(wheel, disc, self.scale))

    def _flow_scale(self) -> float:
        """px per frame of full colour, the same for the whole clip: a little above its mean motion."""
        g = self.geometry
        speed = np.linalg.norm(g.mean_flow, axis=-1)[(g.mean_confidence > TRUSTED) & g.mask]
        return max(1.3 * float(np.percentile(speed, 99)), 0.5) if speed.size else 1.0

    def _overlay(self, t: int, displacement: np.ndarray, mask: np.ndarray) -> np.ndarray:
        from fluidlift.motion.optical_flow import flow_picture

        picture = np.asarray(self.clip.frames[t])
        # what hardly moves shows the picture: dark colours would hide it
        speed = np.linalg.norm(displacement, axis=-1, keepdims=True)
        colour = flow_picture(displacement / np.maximum(speed, 1e-6), mask, 1.0)
        share = OVERLAY_SHARE * np.clip(speed / self.scale, 0.0, 1.0)
        blended = share * colour + (1 - share) * picture
        return np.where(mask[..., None], blended, picture).astype(np.uint8)

    def _write_space(self, t: int, surface: SurfaceMotion | None, velocity: FaceVelocity | None) -> None:
        """Points on the surface with their velocities, and the volume."""
        from fluidlift.io.ply import write_points
        from fluidlift.io.volume_grid import velocity_grid, write_vdb

        points = np.zeros((0, 3)) if surface is None else surface.points
        speeds = np.zeros((0, 3)) if surface is None else surface.velocities
        seen = np.zeros(0, bool) if surface is None else surface.observed
        extras: dict[str, np.ndarray] = {"observed": seen.astype(np.uint8)}
        for i, name in enumerate(("vx", "vy", "vz")):
            extras[name] = speeds[:, i].astype(np.float32)
        write_points(numbered(self.folder / "surface", t, ".ply"), points, extras=extras)
        still = FaceVelocity.zeros(self.grid) if velocity is None else velocity
        # a plume moves the air around it, too: there the whole box is stored
        moving = self.wet if velocity is None else self.wet | (np.abs(velocity.at_centers()).max(axis=-1) > 0)
        grid = velocity_grid(still, self.grid, active=moving)
        write_vdb(numbered(self.folder / "velocity", t, ".vdb"), [grid])


def _same(given: Path | None, folder: Path) -> bool:
    """Whether a path that was given is this folder: what stands in it has been read then."""
    return given is not None and given.absolute() == folder.absolute()


def _white(mask: np.ndarray) -> np.ndarray:
    return np.where(mask, 255, 0).astype(np.uint8)


def _row(
    found: FrameMotion | None, moved: np.ndarray, mask: np.ndarray, seen: np.ndarray, trust: np.ndarray
) -> dict[str, Any]:
    """What is known of one frame, as plain values."""
    row: dict[str, Any] = {"fluid_share": float(mask.mean())}
    if found is None:
        return row
    speed = np.linalg.norm(moved[mask], axis=-1)
    row |= {
        "observed_share": float(seen[mask].mean()),
        "trusted_share": float((trust[mask] > TRUSTED).mean()),
        "flow_median": float(np.median(speed)),
        "flow_p99": float(np.percentile(speed, 99)),
        "free_fall_share": found.free_fall_share,
        "front_factor": found.front_factor,
    }
    row |= as_plain(_doubts(found))
    if found.surface is not None and len(found.surface.velocities):
        fast = np.linalg.norm(found.surface.velocities, axis=1)
        row |= {
            "surface_speed_mean": float(fast.mean()),
            "surface_speed_median": float(np.median(fast)),
            "surface_speed_p90": float(np.percentile(fast, 90)),
        }
    return row | plain_report(found)


def _doubts(found: FrameMotion) -> list[Notice]:
    """What is wrong with one frame."""
    doubts = []
    if not found.observed.any():
        doubts.append(Notice("frame-not-trusted", "nothing of the flow was trusted: all of it is filled in"))
    if found.surface is None:
        doubts.append(Notice("frame-off-body", "none of its fluid lies on the body: no velocities in space"))
    if found.report is not None and not found.report.solve.converged:
        doubts.append(Notice("solve-not-converged", "the divergence-free solve did not converge"))
    if (found.free_fall_share or 0.0) > FAST_FALL:
        doubts.append(
            Notice(
                "speed-from-free-fall",
                "much of the steep part moves at the speed of free fall, which was not measured",
            )
        )
    return doubts
