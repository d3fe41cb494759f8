"""A body that comes as files, the user's or a generator's: its surface as the clip's camera sees it, and where it lies.

A folder of the user's (`--geometry-from`) has one camera for all frames, which is also that of the clip, in metres and
z up. A folder that the stage `generate` left has a camera per frame, each of the generator's own making, beside a
`generator.json` that says what can be relied on.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.io.images import read_camera, read_json
from fluidlift.io.ply import read_gaussians
from fluidlift.shape import external_body, registration, surface
from fluidlift.types import FluidKind, Gaussians, PinholeCamera, Similarity3, UpEvidence, kind_of
from fluidlift.types.kind import STEEPEST_STREAM
from fluidlift.types.stages import Geometry

NOTE = "generator.json"
"""file of a folder of generated bodies: `name`, `metric` (in metres), `knows_up` (z is the vertical), `frames`"""


@dataclass(frozen=True)
class SeenBodies:
    """Bodies in the frames that were asked for, each with the camera that saw it."""

    bodies: list[Gaussians]
    cameras: list[PinholeCamera]


def note_of(folder: Path | None) -> dict[str, Any] | None:
    """What a generator's folder says of itself; None for one of the user's.

    Raises:
        InputRejected: a note that cannot be read, or lacks what `NOTE` names.
    """
    if folder is None or not (folder / NOTE).is_file():
        return None
    note = read_json(folder / NOTE, NOTE)
    frames = note.get("frames") if isinstance(note, dict) else None
    whole = isinstance(frames, list) and len(frames) > 0 and all(type(t) is int and 0 <= t < 10**9 for t in frames)
    if not whole or not all(isinstance(note.get(name), bool) for name in ("metric", "knows_up")):
        raise InputRejected(
            f"'{NOTE}' in '{folder.name}' is not what a generator wrote", "metric, knows_up and frames",
            "make the bodies again (--force generate), or delete the file: its PLY files then count in order of name",
        )  # fmt: skip
    return note


def given_bodies(folder: Path, size: tuple[int, int], frames: list[int]) -> SeenBodies:
    """Bodies of some frames. A user's files count from the first frame in order of name, and the last stands for all
    after it; of a generator's, a frame without a body takes the nearest that has one.

    Raises:
        InputRejected: no PLY file, or one that is no body.
    """
    note = note_of(folder)
    if note is not None:
        known = np.array(sorted(note["frames"]))
        names = [f"{known[int(np.argmin(np.abs(known - t)))]:04d}" for t in frames]
        return SeenBodies(
            [read_gaussians(folder / f"{name}.ply") for name in names],
            [read_camera(folder / f"{name}.json", size) for name in names],
        )
    files = sorted(folder.glob("*.ply"))
    if not files:
        raise InputRejected(f"no PLY file in '{folder.name}'", "one Gaussian PLY per frame, or one, and camera.json")
    camera = read_camera(folder / "camera.json", size)
    return SeenBodies([read_gaussians(files[min(t, len(files) - 1)]) for t in frames], [camera] * len(frames))


FLAT = 0.5
"""thickness of a body over its width (standard deviations) from which it is no sheet, and says nothing"""
GENERATOR_TRUST = 0.5
"""of 1: generators put things upright that usually stand; a fluid need not"""


def up_of(
    folder: Path, camera: UpEvidence, kind: str | FluidKind, start: int, size: tuple[int, int]
) -> UpEvidence | None:
    """The vertical where the body's own axes say it; None where it has to be estimated.

    Args:
        folder: of the body.
        camera: what the clip's camera says, which is a user's folder's own.
        kind: of fluid.
        start: first frame.
        size: of the picture, px.
    """
    note = note_of(folder)
    if note is None:
        return camera
    if not note["knows_up"]:
        return None
    seen = given_bodies(folder, size, [start])
    # a sheet that stands steeper was made by a generator that took the camera for a level one
    if kind_of(kind).nearly_level and tilt_of_sheet(seen.bodies[0]) > STEEPEST_STREAM:
        return None
    return replace(registration.pose_up(seen.cameras[0])[0], source="generator", confidence=GENERATOR_TRUST)


def tilt_of_sheet(body: Gaussians) -> float:
    """Degrees between the plane of a flat body and the level; 0 for one that is not flat."""
    spread, axes = np.linalg.eigh(np.cov(body.means.astype(np.float64).T))
    if spread[0] > FLAT**2 * spread[1]:
        return 0.0
    return float(np.degrees(np.arccos(min(abs(axes[2, 0]), 1.0))))


def given_front(
    folder: Path, canonical: PinholeCamera, mask: np.ndarray, kind: FluidKind, start: int
) -> tuple[surface.FrontSurface, float | None]:
    """The front surface in canonical units, and metres per unit where the body is in metres."""
    seen, note = given_bodies(folder, canonical.size, [start]), note_of(folder)
    body, camera = seen.bodies[0], seen.cameras[0]
    if note is None:
        to_canonical = external_body.canonical_from_given(camera, body)
    else:
        to_canonical = external_body.into_view(body.means, camera, canonical)
    near, far = external_body.near_and_far(body.transformed(to_canonical), canonical, mask)
    front = surface.given_surface(canonical, mask, near, kind)
    unit = float(np.median(near[mask]))
    half = np.where(mask, 0.5 * np.maximum(far - near, 0.0), 0.0) / unit
    thick = half if kind.airborne else np.zeros_like(half)
    metres = unit / to_canonical.scale if note is None or note["metric"] else None
    return surface.FrontSurface(front.depth, thick.astype(np.float32), front.height), metres


def placed_bodies(geometry: Geometry, folder: Path, frames: list[int]) -> list[Gaussians]:
    """The bodies in the world: a user's where its files have them, a generator's as the clip's camera saw them.

    Args:
        geometry: of the clip.
        folder: of the bodies.
        frames: that are wanted.
    """
    camera = geometry.camera
    seen = given_bodies(folder, camera.size, frames)
    if note_of(folder) is None:
        assert geometry.known_scale is not None  # a user's body is in metres
        to_canonical = external_body.canonical_from_given(seen.cameras[0], seen.bodies[0])
        scale = 1.0 / geometry.known_scale
        moved = to_canonical.translation * (scale / to_canonical.scale)
        to_world = geometry.world_from_canonical @ Similarity3(scale, to_canonical.rotation, moved)
        return [b.transformed(to_world) for b in seen.bodies]
    depth, mask = geometry.depth, geometry.mask
    first = external_body.into_view(seen.bodies[0].means, seen.cameras[0], camera)
    near, _ = external_body.near_and_far(seen.bodies[0].transformed(first), camera, mask)
    visible = mask & (depth > 0)
    # all middles at one depth: between neighbouring frames a fluid does not come nearer, a generator's guess does
    middle = float(np.median(depth[visible] / near[visible]))
    views = [external_body.into_view(b.means, c, camera, depth=middle) for b, c in zip(seen.bodies, seen.cameras)]
    return [b.transformed(view) for b, view in zip(seen.bodies, views)]
