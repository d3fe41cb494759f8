"""Pictures of a finished asset from any camera: a film, numbered PNG with transparency, or numbered EXR with depth."""

from __future__ import annotations

import difflib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.io.frames import FIRST_FRAME
from fluidlift.pipeline.resimulate import FIRST_HALF, recall_first_half, settings_of
from fluidlift.pipeline.scene import Footage, Scene, SimulationRequest, footage_of, scene_of
from fluidlift.pipeline.showing import splat_frames
from fluidlift.pipeline.simulating import frame_file
from fluidlift.pipeline.story import Progress, Silence, Story
from fluidlift.pipeline.written import Written, cleared, numbered
from fluidlift.types import Gaussians, PinholeCamera, Similarity3, concatenate, matrix_from_quat

VIEWS = ("input", "side", "top", "turn")
BACKGROUNDS = ("auto", "plate", "terrain", "none")
FILMS = (".mp4", ".mov")
PICTURES = (".png", ".exr")
SURFELS = 200_000
"""of the terrain: stills are looked at longer than the preview"""
SIZES = (16, 8192)
"""px, of a side of the picture"""


@dataclass(frozen=True)
class RenderRequest:
    """What is drawn, and how."""

    view: str = "input"
    """input, side, top, turn (once around), or a file: a camera JSON or keyed views"""
    size: tuple[int, int] | None = None
    """width, height, px; None: that of the clip, or of the camera file"""
    frames: tuple[int, int] | None = None
    """first and last number, from 1001; None: all"""
    background: str = "auto"
    """plate: the clip without its fluid (input view only); terrain: bed and sky; none: transparent; auto: the first
    of these that can be had"""
    format: str = "png"
    """of pictures: png (8 bits, sRGB, with alpha) or exr (linear, premultiplied, alpha A and camera depth Z in m)"""


def render_asset(
    folder: Path, out: Path, request: RenderRequest | None = None, *, progress: Progress | None = None
) -> Written:
    """Draw the frames of an asset.

    Args:
        folder: of the asset.
        out: a film (.mp4, .mov), or a folder for numbered pictures.
        request: what is drawn.
        progress: where progress is told.

    Raises:
        InputRejected: no asset, no frames, or a request that does not fit it.
    """
    from fluidlift.io.asset_folder import load_asset, read_manifest
    from fluidlift.io.atomic import disk_errors

    request, progress, began = request or RenderRequest(), progress or Silence(), time.perf_counter()
    _check(request, out)
    manifest, asset = read_manifest(folder), load_asset(folder)
    played = manifest.get("simulation", {})
    interval = float(played.get("frame_interval", asset.interval))
    story = Story(folder, FIRST_HALF, progress=Silence())
    recall_first_half(story, manifest)
    footage = footage_of(story)
    config = settings_of(manifest, (), {}, sections=("simulate", "show"), work="a picture")
    longer = float(played.get("extended_downstream", 0.0))
    made_with = SimulationRequest(fps=1.0 / interval, extend_downstream=longer)
    scene = scene_of(asset, folder, made_with, config, footage=None, start=0)
    numbers = frame_numbers(folder, int(played.get("frames", 0)), request.frames)
    poses, warnings = _poses(folder, scene, len(numbers) + numbers[0])
    stage = _Stage(scene, footage, request, _cameras(scene, request, len(numbers)), numbers, poses)
    progress.stage("render", 1, 1)
    with disk_errors(out):
        _write(stage, folder, out, 1.0 / interval, lambda done: progress.update(done, len(numbers)))
    seconds = time.perf_counter() - began
    progress.finished("render", seconds, False)
    for text in warnings:
        progress.warn(text)
    size = stage.cameras[0].size
    facts = {"frames": len(numbers), "first": FIRST_FRAME + numbers[0], "size": list(size), "view": request.view,
             "out": str(out)}  # fmt: skip
    words = (f"{frames_told(len(numbers))} of {size[0]} x {size[1]} px: {out}",)
    return Written(out, seconds, tuple(warnings), {"render": {"seconds": round(seconds, 3)}}, facts, words)


@dataclass(frozen=True)
class _Stage:
    """All that one run draws."""

    scene: Scene
    footage: Footage | None
    request: RenderRequest
    cameras: list[PinholeCamera]
    numbers: range
    """frames, from 0"""
    poses: np.ndarray | None
    """[k,b,7] of the obstacles, from frame 0"""


def _check(request: RenderRequest, out: Path) -> None:
    if request.view not in VIEWS and not Path(request.view).is_file():
        near = difflib.get_close_matches(request.view, VIEWS, 1)
        raise InputRejected(
            f"no view '{request.view}'", f"{', '.join(VIEWS)}, or a file with a camera or keyed views",
            f"did you mean {near[0]}?" if near else "check --view",
        )  # fmt: skip
    if request.background == "plate" and request.view != "input":
        raise InputRejected(
            f"the clip's background in the view '{request.view}'", "the view input: a plate is a flat picture",
            "use --background terrain or none",
        )  # fmt: skip
    if request.size is not None and not all(SIZES[0] <= s <= SIZES[1] for s in request.size):
        raise InputRejected(f"a picture of {request.size[0]} x {request.size[1]} px", f"{SIZES[0]} to {SIZES[1]} px")
    if out.suffix.lower() in PICTURES:
        raise InputRejected(f"one file '{out.name}' for many pictures", "a folder, or a film that ends in .mp4 or .mov")
    if out.suffix.lower() in FILMS and request.background == "none":
        raise InputRejected("a transparent film", "pictures: H.264 has no alpha", "give a folder to --out")
    if out.suffix.lower() not in FILMS and out.exists() and not out.is_dir():
        raise InputRejected(f"'{out.name}', which is a file", "a folder, or a film that ends in .mp4 or .mov")


def frames_told(count: int) -> str:
    """A number of frames in words."""
    return f"{count} frame" + ("s" if count != 1 else "")


def frame_numbers(folder: Path, count: int, wanted: tuple[int, int] | None) -> range:
    """Frames of an asset, from 0: of the `count` that were simulated those whose files are there, or those wanted
    (first and last number, from 1001).

    Raises:
        InputRejected: none are there, or not those.
    """
    there = next((k for k in range(count) if not frame_file(folder, FIRST_FRAME + k).is_file()), count)
    if there == 0:
        raise InputRejected(f"'{folder.name}' has no simulated frames", "frames/splats/1001.ply and so on",
                            f"fluidlift sim {folder}")  # fmt: skip
    if wanted is None:
        return range(there)
    first, last = wanted
    if not FIRST_FRAME <= first <= last < FIRST_FRAME + there:
        raise InputRejected(f"frames {first} to {last}", f"numbers from {FIRST_FRAME} to {FIRST_FRAME + there - 1}",
                            "the first frame of an asset is 1001" if first < FIRST_FRAME else "")  # fmt: skip
    return range(first - FIRST_FRAME, last - FIRST_FRAME + 1)


def _poses(folder: Path, scene: Scene, frames: int) -> tuple[np.ndarray | None, list[str]]:
    """Where the obstacles are in every frame, from the simulation's own result."""
    from fluidlift.io.stage_cache import load_stage, owner_of

    if not scene.obstacles:
        return None, []
    key = owner_of(folder, "simulate")
    found = load_stage(folder, "simulate", key) if key is not None else None
    poses = found[0].get("poses") if found is not None else None
    if poses is None or poses.shape[0] < frames or poses.shape[1:] != (len(scene.obstacles), 7):
        return None, ["the obstacles' motion is not at hand and they are not drawn: run fluidlift sim again"]
    return poses, []


def _cameras(scene: Scene, request: RenderRequest, count: int) -> list[PinholeCamera]:
    """One per frame."""
    from fluidlift.io.views import read_view
    from fluidlift.look.camera_path import keyed_path, orbit_path
    from fluidlift.look.scenery import orbit_camera, side_camera, terrain_surfels

    camera = scene.camera
    size = request.size or camera.size
    around = np.concatenate([scene.rest.means, _surroundings(scene)])
    if request.view == "input":
        return [_fitted(camera, size)] * count
    if request.view == "side":
        return [side_camera(camera, scene.rest, terrain_surfels(scene.terrain), around, size=size)] * count
    if request.view == "top":
        return [orbit_camera(camera, around, azimuth=0.0, elevation=89.0, size=size)] * count
    if request.view == "turn":
        return orbit_path(camera, around, count, size=size)
    found = read_view(Path(request.view))
    if isinstance(found, PinholeCamera):
        return [found if request.size is None else _fitted(found, request.size)] * count
    return keyed_path(found, count, size)


def _surroundings(scene: Scene) -> np.ndarray:
    """Points that a view of the whole should hold."""
    if len(scene.terrain.mesh.vertices):
        return np.asarray(scene.terrain.mesh.vertices)
    return np.stack([scene.terrain.grid.low, scene.terrain.grid.high])


def _fitted(camera: PinholeCamera, size: tuple[int, int]) -> PinholeCamera:
    """The camera with another picture size: the whole of its picture is seen, with more beside it where the shape
    differs; nothing is stretched."""
    factor = min(size[0] / camera.size[0], size[1] / camera.size[1])
    center = (0.5 * size[0] + factor * (camera.center[0] - 0.5 * camera.size[0]),
              0.5 * size[1] + factor * (camera.center[1] - 0.5 * camera.size[1]))  # fmt: skip
    focal = (factor * camera.focal[0], factor * camera.focal[1])
    return PinholeCamera(focal, center, (int(size[0]), int(size[1])), camera.camera_from_world)


def _write(stage: _Stage, folder: Path, out: Path, fps: float, step: Callable[[int], None]) -> None:
    from fluidlift.io.exr_write import write_channels
    from fluidlift.io.images import write_png
    from fluidlift.io.video import write_video

    drawn = _drawn(stage, folder, step)
    if out.suffix.lower() in FILMS:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_video(out, (np.clip(rgb, 0, 1) for rgb, _, _ in drawn), fps)
        return
    suffix = "." + stage.request.format
    cleared(out, [suffix])
    for k, (rgb, alpha, depth) in zip(stage.numbers, drawn, strict=True):
        path = numbered(out, k, suffix)
        if suffix == ".exr":
            linear = _linear(rgb, alpha)
            write_channels(path, {**{c: linear[..., i] for i, c in enumerate("RGB")}, "A": alpha, "Z": depth})
        else:
            straight = rgb / np.maximum(alpha, 1e-4)[..., None]
            picture = np.concatenate([np.clip(straight, 0, 1), np.clip(alpha, 0, 1)[..., None]], axis=-1)
            write_png(path, (255 * picture + 0.5).astype(np.uint8))


def _linear(rgb: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Premultiplied sRGB to premultiplied linear light: compositing programs multiply linear values."""
    from fluidlift.io.color import linear_from_srgb

    covered = np.maximum(alpha, 1e-4)[..., None]
    return (linear_from_srgb(np.clip(rgb / covered, 0.0, 1.0)) * alpha[..., None]).astype(np.float32)


def _drawn(stage: _Stage, folder: Path, step: Callable[[int], None]) -> Iterator[tuple[np.ndarray, ...]]:
    """(premultiplied sRGB [H,W,3], alpha [H,W], camera depth [H,W] m) of each frame; depth 0 where nothing is."""
    from fluidlift.look.rasterize import render
    from fluidlift.look.scenery import mesh_surfels, terrain_surfels

    scene, way, wanted = stage.scene, _background(stage), stage.numbers
    ground = Gaussians.empty() if way == "plate" else terrain_surfels(scene.terrain, most=SURFELS)
    shapes = [mesh_surfels(o.mesh, scene.terrain.grid.spacing) for o in scene.obstacles]
    before_rocks = _rocks(stage) if way == "plate" else None
    for k, (fluid, _, _) in enumerate(splat_frames(folder, wanted.stop)):
        if k < wanted.start:
            continue
        step(k - wanted.start)
        camera = stage.cameras[k - wanted.start]
        bodies = [] if stage.poses is None else [
            s.transformed(Similarity3(1.0, matrix_from_quat(p[3:]), p[:3])) for s, p in zip(shapes, stage.poses[k])
        ]  # fmt: skip
        seen = concatenate([fluid if before_rocks is None else before_rocks(fluid), *bodies])
        if way == "none":
            yield _held_out(seen, ground, camera)
            continue
        found = render(concatenate([ground, seen]), camera, background=_behind(way, stage, camera))
        yield found.image, np.ones(found.alpha.shape, np.float32), found.depth


def _held_out(seen: Gaussians, ground: Gaussians, camera: PinholeCamera) -> tuple[np.ndarray, ...]:
    """What is seen of the fluid beside the ground: the ground hides, and is not drawn itself."""
    from fluidlift.look.project import view_colors
    from fluidlift.look.rasterize import render

    both = concatenate([seen, ground])
    shown = (np.arange(len(both)) < len(seen)).astype(np.float32)[:, None]
    depth = camera.camera_from_world.points(both.means)[:, 2:]
    drawn = render(both, camera, features=shown * np.concatenate([view_colors(both, camera), shown, depth], axis=1))
    rgb, alpha, z = drawn.image[..., :3], drawn.image[..., 3], drawn.image[..., 4]
    return rgb, alpha, np.where(alpha > 1e-3, z / np.maximum(alpha, 1e-3), 0.0).astype(np.float32)


def _rocks(stage: _Stage) -> Callable[[Gaussians], Gaussians] | None:
    """Takes away what rocks of the plate hide; None where the clip shows none."""
    from fluidlift.look.scenery import terrain_depth, visible_beside_rocks

    scene, footage = stage.scene, stage.footage
    rocks = None if footage is None else footage.labels.solid.mean(axis=0) > 0.5
    if rocks is None or not rocks.any():
        return None
    depth, margin = terrain_depth(scene.terrain, scene.camera), 1.5 * scene.terrain.grid.spacing
    return lambda g: g.select(visible_beside_rocks(g.means, scene.camera, depth, rocks, margin=margin))


def _background(stage: _Stage) -> str:
    """The kind of background: what was asked for, or the best that there is."""
    way, has_plate = stage.request.background, stage.footage is not None
    if way == "plate" and not has_plate:
        raise InputRejected(
            "the clip's background, which is no longer at hand", "the asset's folder work/, as make left it",
            "use --background terrain or none, or run fluidlift make again",
        )  # fmt: skip
    if way != "auto":
        return way
    return "plate" if stage.request.view == "input" and has_plate else "terrain"


def _behind(way: str, stage: _Stage, camera: PinholeCamera) -> np.ndarray:
    """sRGB [H,W,3] behind everything."""
    width, height = camera.size
    if way == "terrain" or stage.footage is None:
        return np.linspace(0.93, 0.78, height, dtype=np.float32)[:, None, None] * np.ones((1, width, 3), np.float32)
    return _placed(stage.footage.plate, stage.scene.camera, camera)


def _placed(plate: np.ndarray, source: PinholeCamera, camera: PinholeCamera) -> np.ndarray:
    """The plate as a camera of the same place with another picture size sees it; its edge goes on beyond it."""
    import cv2

    scale = np.array(camera.focal) / np.array(source.focal)
    # OpenCV counts from the middle of the first pixel
    shift = np.array(camera.center) - 0.5 - scale * (np.array(source.center) - 0.5)
    move = np.array([[scale[0], 0.0, shift[0]], [0.0, scale[1], shift[1]]])
    way = cv2.INTER_AREA if scale[0] < 1 else cv2.INTER_CUBIC
    if (scale == 1).all() and camera.size == source.size:
        return plate.astype(np.float32) / 255.0
    moved = cv2.warpAffine(plate, move, camera.size, flags=way, borderMode=cv2.BORDER_REPLICATE)
    return moved.astype(np.float32) / 255.0
