"""Depth of the pictures, from the user's file or from a learned model, and the fluid's surface that it makes."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from fluidlift.backends.depth_model import Guess
from fluidlift.backends.monocular_depth import make_depth_estimator
from fluidlift.backends.registry import ModelChoice
from fluidlift.errors import InputRejected
from fluidlift.messages import Notice
from fluidlift.pipeline.settings import DepthModelSettings, GivenDepth, GivenView
from fluidlift.pipeline.work import Work
from fluidlift.shape import depth_surface, given_depth
from fluidlift.shape import kind as kinds
from fluidlift.shape.given_depth import DepthPictures, Holds, SceneDepth
from fluidlift.shape.kinds import Observation, builder_of
from fluidlift.shape.registration import DISAGREEING
from fluidlift.shape.surface import FrontSurface
from fluidlift.types import FluidKind, MetricScale, PinholeCamera, UpEvidence
from fluidlift.types.fluid_masks import FluidMasks
from fluidlift.types.stages import DepthGuess, Read

LEARNED_SCALE = 0.15
"""relative standard error of a model's metres: assumed, as no trained model was measured here"""
FILE_FLOOR, MODEL_FLOOR = 0.003, 0.02
"""relative error of depth that changes slowly over the picture, at least: a sensor or a renderer; a learned model
(assumed)"""
HUGE, TINY = 300.0, 1e-3
"""m across a fluid that a depth file must not make it without a word"""


@dataclass(frozen=True)
class DepthFront:
    """What the pictures' depth says about a fluid."""

    scene: SceneDepth
    up: UpEvidence
    front: FrontSurface
    unit: float | None
    """m per canonical unit, where the depth is in metres"""
    learned: bool
    meta: dict[str, Any] = field(default_factory=dict)

    @property
    def known_scale(self) -> float | None:
        """m per canonical unit that can be relied on: a file's, not a model's."""
        return None if self.learned else self.unit


def pictures_of(
    read: Read, given: GivenView, camera: PinholeCamera | None, start: int, work: Work
) -> DepthPictures | None:
    """Depth of some frames from `start` on: of the file that was given, or of a model; None where there is neither.

    Args:
        read: the clip.
        given: the depth file, or the model.
        camera: where it is known; some models take it, and all others say how wide they see.
        start: first frame in which there is enough fluid.
        work: keeps what a model says: it is the slowest part of the geometry.

    Raises:
        InputRejected: a file that does not fit, or weights that do not.
        MissingPackage: of a model.
    """
    if given.depth is not None:
        return _from_file(read, given.depth, start)
    if given.model is None:
        return None
    pick = spread_frames(len(read.clip), start, given.model.frames)
    found = work.part("depth", depth_by_model, read, given.model, pick, camera)
    return DepthPictures(
        np.asarray(found.values),
        tuple(pick),
        found.holds,
        f"depth of {given.model.model}",
        MODEL_FLOOR,
        found.field_of_view,
        None if found.normals is None else np.asarray(found.normals),
    )


def require_file(read: Read, given: GivenDepth) -> None:
    """Say before the flow is computed that a depth file cannot be of this clip.

    Raises:
        InputRejected: a file that cannot be read, or does not fit.
    """
    _from_file(read, given, 0)


def spread_frames(count: int, start: int, most: int) -> list[int]:
    """Numbers of at most `most` frames, evenly from `start` to the end of a clip of `count`."""
    return [int(t) for t in np.unique(np.linspace(start, count - 1, min(most, count - start)).round())]


def _from_file(read: Read, given: GivenDepth, start: int) -> DepthPictures:
    from fluidlift.io.images import read_depth

    clip, path = read.clip, given.file.path
    holds: Holds = "metres" if given.holds == "auto" else given.holds
    values = read_depth(path, clip.size, scale=given.scale, positive=holds != "disparity")
    if values.ndim == 2:
        return DepthPictures(values[None], (start,), holds, "depth file", FILE_FLOOR)
    kept = np.asarray(read.kept)
    if len(values) != len(clip):
        if len(values) <= kept.max(initial=0):
            raise InputRejected(
                f"'{path.name}' has {len(values)} pictures for {len(clip)} frames", "one, or one per frame",
                "cut it as the clip is cut",
            )  # fmt: skip
        values = values[kept]
    pick = spread_frames(len(clip), start, given.frames)
    return DepthPictures(values[pick], tuple(pick), holds, "depth file", FILE_FLOOR)


def depth_by_model(
    read: Read, model: DepthModelSettings, frames: list[int], camera: PinholeCamera | None, *, work: Work
) -> DepthGuess:
    """What a learned model says of some frames, one after the other."""
    weights = None if model.weights is None else model.weights.name
    estimator = make_depth_estimator(
        model.model, ModelChoice(weights, model.device, model.download, python=model.python, seconds=model.seconds)
    )
    guesses: list[Guess] = []
    for t in frames:
        guesses.append(estimator.guess(np.ascontiguousarray(read.clip.frames[t]), camera))
        work.step(len(guesses), len(frames))
    views = [g.field_of_view for g in guesses if g.field_of_view is not None]
    values = np.stack([g.values for g in guesses])
    normals = [g.normals for g in guesses if g.normals is not None]
    faces = np.stack(normals).astype(np.float16) if len(normals) == len(guesses) else None
    return DepthGuess(values, guesses[0].holds, float(np.median(views)) if views else None, faces)


def depth_front(
    pictures: DepthPictures, fluid: FluidMasks, camera: PinholeCamera, up: UpEvidence, kind: FluidKind,
    seen: Observation, *, expected: FrontSurface,
) -> DepthFront:  # fmt: skip
    """Surface, tilt and scale by the depth.

    Args:
        pictures: of some frames.
        fluid: masks of the clip.
        camera: pose not used.
        up: as it is known, or taken to be without the depth.
        kind: of the fluid.
        seen: the fluid whose surface is wanted; its camera is not used.
        expected: surface that the fluid would be taken to have otherwise, for what the pictures cannot say.

    Raises:
        InputRejected: a depth that says nothing about the fluid, or cannot be of this view.
    """
    mask, shown = seen.mask, np.stack([fluid[t] for t in pictures.frames])
    fused = given_depth.fuse(pictures, shown, mask)
    scene = given_depth.scene_depth(fused, expected.depth, mask)
    meta: dict[str, Any] = {
        "source": scene.source, "frames": scene.frames, "flicker": scene.flicker, "holds": fused.holds,
    }  # fmt: skip
    slopes, usual = depth_surface.slopes_by_motion(expected.slope), expected.height
    learned = pictures.source != "depth file"
    if kind.nearly_level and not seen.tilt_known and fused.holds != "disparity":
        normal, error = None, 0.0
        if learned:
            faces = pictures.normals
            faces = None if faces is None else depth_surface.facing(faces, shown, mask, camera)
            normal, error = depth_surface.model_normal(camera, scene.depth, mask, faces)
        found, slope = depth_surface.up_from_depth(scene, camera, mask, seen.motion, seen.trust, normal=normal)
        up = depth_surface.weighed_up(up, found, error) if learned else found
        slopes, usual = ((1.0, slope, 0.5),), None
    level = kinds.level_camera(camera, up)
    front, evidence = builder_of(kind).depth_surface(scene, replace(seen, camera=level), slopes=slopes, usual=usual)
    if evidence is not None:
        meta["slope"] = asdict(evidence)
    if not learned and kind.lies_on_ground and fused.holds != "disparity":
        # a file is believed to its last wave, where it says something; what lies below follows the smooth surface
        known = mask & np.isfinite(scene.depth) & (scene.depth > 0)
        front = replace(front, depth=np.where(known, scene.depth, front.depth).astype(np.float32))
    return DepthFront(scene, up, front, scene.unit, learned, meta)


def with_learned_scale(scale: MetricScale, found: DepthFront, points: np.ndarray) -> MetricScale:
    """The scale, from a model's metres where nothing else is known: they are right to some ten per cent or so."""
    if scale.source != "assumed" or found.unit is None or not found.learned:
        return scale
    extent = float(np.ptp(np.percentile(points, [0.5, 99.5], axis=0), axis=0).max())
    return MetricScale(found.unit, "depth", relative_error=LEARNED_SCALE, across=found.unit * extent)


def size_warnings(across: float, found: DepthFront, camera_height: float | None, points: np.ndarray) -> list[Notice]:
    """What to say about a depth file whose metres are hardly meant, or not those of the surveyed camera."""
    if found.learned or found.unit is None:
        return []
    told: list[Notice] = []
    if not TINY < across < HUGE:
        likely = "millimetres: --set depth.scale=0.001" if across >= HUGE else "kilometres: --set depth.scale=1000"
        told.append(
            Notice("depth-unit-unlikely", f"the depth file makes the fluid {across:.3g} m across; is it in {likely}?")
        )
    drop = float(-np.median(points[:, 2]))
    if camera_height is not None and camera_height > 0 and drop > 0:
        ratio = found.unit * drop / camera_height
        if not 1 / DISAGREEING < ratio < DISAGREEING:
            told.append(
                Notice(
                    "depth-camera-disagree",
                    f"the depth file puts the camera {found.unit * drop:.3g} m above the water, the camera file "
                    f"{camera_height:.3g} m: one of them has another unit; the depth is taken",
                )
            )
    return told
