"""The stage that reads the clip: decoded, without lens distortion, repeated frames, shake and cuts.

Frames go to disk as they are decoded and are mapped from there on: memory does not grow with the clip.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.io.stage_cache import Scratch
from fluidlift.messages import Notice, without
from fluidlift.pipeline.inputs import GivenFile
from fluidlift.pipeline.known_camera import USUAL_FIELD_OF_VIEW
from fluidlift.pipeline.settings import ReadSettings
from fluidlift.pipeline.work import Work
from fluidlift.seams import PoseSolver
from fluidlift.types import MeasuredView, PinholeCamera, VideoClip
from fluidlift.types.fluid_masks import parts_of
from fluidlift.types.stages import Read

if TYPE_CHECKING:
    from fluidlift.io.bars import PictureWindow
    from fluidlift.motion.moving_camera import Walking

BARS_STAY = Notice(
    "bars-stay",
    "the clip has black bars beside its picture, which are taken for ground: make cuts them off where nothing but the "
    "clip is given; else give a clip without them (ffmpeg -vf cropdetect tells where they are)",
)


def read(clip: GivenFile, camera: GivenFile | None, config: ReadSettings, *, work: Work) -> Read:
    """Decode, steady, look for repeated frames and cuts.

    Args:
        clip: video file or image sequence.
        camera: a file that may know how the lens distorts.
        config: what is decoded.
        work: room for the frames.

    Raises:
        InputRejected: a clip that cannot be used.
    """
    from fluidlift.io.bars import between_bars, find_bars
    from fluidlift.io.limits import ReadLimits
    from fluidlift.io.sequences import is_sequence
    from fluidlift.io.video import read_clip

    scratch = work.scratch
    decode = partial(
        read_clip,
        clip.path,
        start=config.start,
        duration=config.duration,
        max_size=config.max_size,
        fps=config.fps if is_sequence(clip.path) else None,
        limits=ReadLimits(max_pixels=config.max_pixels, max_frames=config.max_frames),
        store=scratch,
    )
    found, bars = between_bars(decode) if config.crop == "auto" else (decode(), None)
    if bars is not None:
        found = replace(found, warnings=(*found.warnings, _cut_off(bars)))
    elif config.crop == "none" and find_bars(found.frames) is not None:
        found = replace(found, warnings=(*found.warnings, BARS_STAY))
    decoded = len(found)
    found = _without_distortion(found, None if camera is None else camera.path, scratch)
    found, kept = _without_repeats(found, scratch)
    walking = _walking(clip, camera, found.size)
    steady, shake = _steady(found, scratch, walking, correct=config.stabilise)
    first, last, warnings = _longest_run(shake, len(steady), found.source, kept)
    frames, alpha = steady.frames, steady.alpha
    if last - first < len(steady):
        frames, kept = frames[first:last], kept[first:last]
        alpha = None if alpha is None else alpha[first:last]
    alpha = None if alpha is None else scratch.keep("alpha", alpha)
    used = VideoClip(scratch.keep("frames", frames), steady.times[first:last], found.source, alpha)
    said = (*found.warnings, *(w for w in shake.warnings if w not in found.warnings), *warnings)
    path = None if shake.path is None else shake.path[first:last]
    return Read(
        used, kept, decoded, shake.shake_px, shake.stabilised, shake.cuts, said, path, shake.view, shake.fluid_evidence,
        None if shake.unseen is None else shake.unseen[first:last],
    )  # fmt: skip


def _cut_off(bars: PictureWindow) -> Notice:
    wide = f"{100 * bars.left:.1f} to {100 * bars.right:.1f} % of its width"
    high = f"{100 * bars.top:.1f} to {100 * bars.bottom:.1f} % of its height"
    return Notice(
        "bars-cut-off",
        f"the black bars beside the picture are cut off: what is left is {wide} and {high}; --set read.crop=none keeps "
        "all of it",
    )


def _without_distortion(clip: VideoClip, file: Path | None, scratch: Scratch) -> VideoClip:
    """Lines that are straight in the world made straight in the picture, where a camera file knows the lens."""
    from fluidlift.io.images import read_camera, read_distortion, undistort_clip

    distortion = read_distortion(file) if file is not None else None
    if file is None or distortion is None:
        return clip
    camera = read_camera(file, clip.size)
    frames, alpha, before = scratch.array("straight", clip.frames.shape, np.uint8), None, clip.alpha
    if before is not None:
        alpha = scratch.array("straight_alpha", before.shape, np.uint8)
    straight = clip
    for part in parts_of(clip.frames):
        piece = replace(
            clip, frames=clip.frames[part], times=clip.times[part], alpha=None if before is None else before[part]
        )
        straight = undistort_clip(piece, camera, distortion)
        frames[part] = straight.frames
        if alpha is not None:
            alpha[part] = straight.alpha
    return replace(clip, frames=frames, alpha=alpha, warnings=straight.warnings)


def _without_repeats(clip: VideoClip, scratch: Scratch) -> tuple[VideoClip, np.ndarray]:
    """The clip without frames that bring nothing new, and which frames (int [T]) it has kept."""
    from fluidlift.motion.cadence import examine_cadence, without_duplicates

    report = examine_cadence(clip.frames, clip.times)
    kept = np.asarray(report.kept)
    if len(kept) == len(clip):
        return replace(clip, warnings=_told(clip.warnings, report.warnings)), kept
    if len(kept) < 2:
        raise InputRejected(
            f"'{clip.source}' shows one picture all the time", "at least two different frames", "choose another stretch"
        )
    # what lies on disk is chosen part by part; the times do not depend on the pictures
    hollow = replace(clip, frames=np.zeros((len(clip), 1, 1, 3), np.uint8), alpha=None)
    times = without_duplicates(hollow, report).times
    frames = _chosen(clip.frames, kept, "without_repeats", scratch)
    alpha = None if clip.alpha is None else _chosen(clip.alpha, kept, "alpha_without_repeats", scratch)
    from fluidlift.io.collect import REPEATED

    # the reader counts exact repeats as well: said once is enough
    said = without(clip.warnings, REPEATED)
    return replace(clip, frames=frames, times=times, alpha=alpha, warnings=_told(said, report.warnings)), kept


def _chosen(array: np.ndarray, kept: np.ndarray, name: str, scratch: Scratch) -> np.ndarray:
    out = scratch.array(name, (len(kept), *array.shape[1:]), array.dtype)
    for part in parts_of(out):
        out[part] = array[kept[part]]
    return out


def _told(before: tuple[Notice, ...], more: tuple[Notice, ...]) -> tuple[Notice, ...]:
    return (*before, *(w for w in more if w not in before))


@dataclass(frozen=True)
class _Shake:
    """How the camera moved."""

    shake_px: float
    stabilised: bool
    cuts: tuple[int, ...]
    runs: tuple[tuple[int, int], ...]
    """first frame and end of what can be used of each shot"""
    warnings: tuple[Notice, ...] = ()
    path: np.ndarray | None = None
    """[T,2] px, as in `motion.stabilize.ShakeReport`"""
    view: MeasuredView | None = None
    fluid_evidence: np.ndarray | None = None
    unseen: np.ndarray | None = None


def _walking(clip: GivenFile, camera: GivenFile | None, size: tuple[int, int]) -> Walking:
    """What is known of the lens, and who finds the path of a camera that goes somewhere."""
    from fluidlift.io.images import read_camera
    from fluidlift.io.lens import lens_field_of_view
    from fluidlift.motion.moving_camera import Lens, Walking

    if camera is not None:
        return Walking(Lens(float(max(read_camera(camera.path, size).focal)), told=True), _pose_solver)
    said = lens_field_of_view(clip.path)
    guess = PinholeCamera.from_fov(said or USUAL_FIELD_OF_VIEW, size)
    return Walking(Lens(float(guess.focal[0]), told=bool(said)), _pose_solver)


def _pose_solver() -> PoseSolver:
    from fluidlift.backends.colmap_poses import ColmapPoses

    return ColmapPoses()


def _steady(clip: VideoClip, scratch: Scratch, walking: Walking, *, correct: bool) -> tuple[VideoClip, _Shake]:
    """The clip as from a camera that stands still, and how the camera moved."""
    from fluidlift.motion.stabilize import GreyFrames, find_cuts, stabilise

    if not correct:
        cuts = tuple(int(c) for c in find_cuts(GreyFrames(clip.frames)))
        return clip, _Shake(0.0, False, cuts, tuple(pairwise((0, *cuts, len(clip)))))
    steady, shake = stabilise(clip, out=scratch.array("steady", clip.frames.shape, np.uint8), walking=walking)
    cuts = tuple(int(c) for c in shake.cuts)
    return steady, _Shake(
        float(shake.shake_px), bool(shake.stabilised), cuts, shake.runs, shake.warnings, shake.path,
        shake.view, shake.fluid_evidence, shake.unseen,
    )  # fmt: skip


def _longest_run(shake: _Shake, frames: int, source: str, kept: np.ndarray) -> tuple[int, int, list[Notice]]:
    """First frame and end of the longest stretch of one view; what comes after a cut or a turn is another scene."""
    first, last = max(shake.runs, key=lambda run: run[1] - run[0])
    if last - first == frames:
        return first, last, []
    if last - first < 2:
        raise InputRejected(
            f"'{source}' shows another view at nearly every frame", "a stretch of at least 2 frames from one camera",
            "trim it with --start and --duration",
        )  # fmt: skip
    why, advice = [], ""
    if shake.cuts:
        advice = "; fluidlift batch CLIP --shots auto makes an asset of each shot"
        why.append(f"has {len(shake.cuts)} cut(s), at frame {', '.join(str(kept[c]) for c in shake.cuts)}")
    if last - first < max(b - a for a, b in pairwise((0, *shake.cuts, frames))):
        why.append("turns away from its view")
    return (
        first,
        last,
        [
            Notice(
                "clip-cut-short",
                f"the clip {' and '.join(why)}: only frames {kept[first]} to {kept[last - 1]} are used{advice}",
            )
        ],
    )
