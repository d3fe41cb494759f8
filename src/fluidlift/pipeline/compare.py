"""The frames of an asset held against other footage of the same camera, such as a part of the clip left out."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fluidlift.config.of_asset import settings_of
from fluidlift.errors import InputRejected
from fluidlift.present.as_filmed import Reel, why_not
from fluidlift.present.front_view import FrontView, to_bytes
from fluidlift.scene.build import SimulationRequest, scene_of
from fluidlift.scene.recall import footage_of_asset
from fluidlift.scene.splat_files import frames_of
from fluidlift.seams import Progress, Silence
from fluidlift.types import VideoClip, kind_of

if TYPE_CHECKING:
    from fluidlift.evaluate.as_filmed import AsFilmed

SAME_RATE = 0.02
"""relative difference of frame intervals that is none: figures follow the fluid over less than a second"""


def card_against(folder: Path, video: Path, *, start: float = 0.0, progress: Progress | None = None) -> AsFilmed:
    """Hold an asset against footage that it was not made from.

    Frames after the end of the asset's own clip are taken where there are as many as the card needs, else all. Where
    fluid was filmed is what was taken for it in the asset's clip most of the time. The footage is compared as it is: it
    is not steadied.

    Args:
        folder: of the asset, with its work/.
        video: of the same camera, with as many frames per second as the asset at least.
        start: s from the beginning of the video.
        progress: where progress is told.

    Raises:
        InputRejected: no asset, an edited one, one whose fluid is elsewhere at another time, or footage that does not
            fit it.
    """
    from fluidlift.evaluate.as_filmed import FEWEST, as_filmed, comparable
    from fluidlift.io.asset_folder import load_asset, read_manifest
    from fluidlift.io.bars import between_bars
    from fluidlift.io.video import read_clip

    progress, manifest, asset = progress or Silence(), read_manifest(folder), load_asset(folder)
    played = manifest.get("simulation", {})
    footage = footage_of_asset(folder, manifest)
    config = settings_of(manifest, (), {"show.preview": True}, sections=("simulate", "show"), work="a comparison")
    interval, longer = played.get("frame_interval", asset.interval), played.get("extended_downstream")
    fps = None if interval == asset.interval else 1.0 / interval
    request = SimulationRequest(played.get("frames", 0) * interval, fps, longer)
    scene = scene_of(asset, folder, request, config, footage=None, start=0)
    reason = why_not(scene, footage, preview=config.show.preview)
    if reason is not None or footage is None:
        raise InputRejected(
            f"'{folder.name}' cannot be held against footage", "frames as they were filmed", reason or ""
        )
    count, own = int(played.get("frames", 0)), len(footage.clip) - footage.start
    decode = partial(read_clip, video, start=start, duration=(count + 1) * interval, max_size=max(asset.camera.size))
    read = manifest["provenance"]["config"]["read"]
    other = between_bars(decode)[0] if read.get("crop") == "auto" else decode()
    if other.size != footage.clip.size:
        raise InputRejected(
            f"footage that is {other.size[0]} x {other.size[1]} px in the asset's size",
            f"a picture of the shape of the clip, {footage.clip.size[0]} x {footage.clip.size[1]} px",
            "use the same camera",
        )
    other = at_rate(other, interval)
    first = own if count - own >= FEWEST else 0
    masks, kind = footage.labels.fluid[footage.start :], kind_of(scene.kind)
    there = comparable(masks, count, fills=kind.fills_vessel)
    if there < FEWEST:
        raise InputRejected(
            f"'{folder.name}' cannot be held against other footage: its fluid moves, grows or shrinks in the picture",
            "one that is at another time where it was filmed", "compare it with its own clip: fluidlift evaluate ASSET",
        )  # fmt: skip
    last = min(count, first + len(other), own + there)
    if min(last - first, len(other)) < FEWEST:
        raise InputRejected(
            f"{len(other)} frames of '{video.name}' and {last - first} of the asset", f"{FEWEST} or more of each",
            "choose another --start, or a longer fluidlift sim --duration",
        )  # fmt: skip
    progress.stage("compare", 1, 1)
    renders, coverage = _renders(folder, FrontView.of(scene, footage), range(first, last), progress)
    usual = np.broadcast_to(masks.mean(axis=0) > 0.5, other.frames.shape[:3])
    return as_filmed(other.frames, usual, interval, renders, coverage, runs=not kind.is_still_water)


def at_rate(clip: VideoClip, interval: float) -> VideoClip:
    """Footage without the frames that repeat the one before and, where it has more than one each interval (s), those
    nearest to an asset's instants.

    Raises:
        InputRejected: it has fewer.
    """
    from fluidlift.motion.cadence import examine_cadence, without_duplicates

    found = without_duplicates(clip, examine_cadence(clip.frames, clip.times))
    own = float(found.times[-1] - found.times[0]) / max(len(found) - 1, 1)
    if own > interval * (1.0 + SAME_RATE):
        raise InputRejected(
            f"footage of {1 / own:.4g} frames per second and an asset of {1 / interval:.4g}",
            "as many frames per second at least", "take the footage that has them",
        )  # fmt: skip
    if own > interval * (1.0 - SAME_RATE):
        return found
    instants = np.arange(found.times[0], found.times[-1] + 0.5 * own, interval)
    nearest = np.abs(found.times - instants[:, None]).argmin(axis=1)
    return replace(found, frames=found.frames[nearest], times=instants, alpha=None)


def _renders(folder: Path, view: FrontView, numbers: range, progress: Progress) -> tuple[np.ndarray, np.ndarray]:
    """u8 [K,H,W,3] and bool [K,H,W]: the frames `numbers`, counted from 0, in the clip's camera."""
    pictures, coverage = Reel(folder), Reel(folder)
    for k, (gaussians, _, velocities) in enumerate(frames_of(folder, numbers)):
        progress.update(k, len(numbers))
        rendered, *_ = view.drawn(gaussians, velocities)
        pictures.append(to_bytes(rendered.image))
        coverage.append(rendered.alpha > 0.5)
    return pictures.array(), coverage.array()
