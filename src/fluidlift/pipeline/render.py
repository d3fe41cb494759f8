"""Pictures of a finished asset from any camera: a film, numbered PNG with transparency, or numbered EXR with depth."""

from __future__ import annotations

import difflib
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.io.frames import FIRST_FRAME
from fluidlift.io.output_files import Written, cleared, numbered
from fluidlift.io.scene_look import Look
from fluidlift.messages import Notice
from fluidlift.present.frames import BACKGROUNDS, Drawn, FrameRenderer, SimulatedFrame
from fluidlift.present.front_view import slab_of, white_of
from fluidlift.present.looks import OnSurface, Painter, Quality
from fluidlift.present.surface_waves import SurfaceWaves, waves_of
from fluidlift.scene.build import Scene
from fluidlift.scene.recall import footage_of_asset, simulated_poses, simulated_scene
from fluidlift.scene.splat_files import frame_numbers, frames_of, frames_told
from fluidlift.seams import Progress, Silence
from fluidlift.types import FluidAsset, PinholeCamera

VIEWS = ("input", "side", "top", "turn")
FILMS = (".mp4", ".mov")
PICTURES = (".png", ".exr")
SURFELS = 200_000
"""of the terrain: stills are looked at longer than the preview"""
WAVING = ("transparent", "surface")
"""looks in which a surface has waves: the splats of others carry the film, which shows them"""
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
    look: str | None = None
    """splats, relit, transparent or surface; None: as scene.yaml says"""
    material: str | None = None
    """a preset of `look.materials`; None: as scene.yaml says"""
    environment: str | None = None
    """sky, studio, white, or a .hdr or .exr file; None: as scene.yaml says"""
    exposure: float | None = None
    """stops; None: as scene.yaml says"""
    engine: str = "mesh"
    """of the look surface: mesh, screen or mitsuba"""
    samples: int = 64
    """light paths per pixel, of mitsuba"""
    supersample: int = 2
    """of other looks than splats: they are drawn so many times finer and averaged"""
    draft: bool = False
    """looks are only tried: `Quality.draft`, in place of `supersample` and `samples`"""


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
    from fluidlift.io.atomic import disk_errors, require_writable
    from fluidlift.io.scene import read_edits

    request, progress, began = request or RenderRequest(), progress or Silence(), time.perf_counter()
    _check(request, out)
    manifest, asset = read_manifest(folder), load_asset(folder)
    played = manifest.get("simulation", {})
    interval = float(played.get("frame_interval", asset.interval))
    footage = footage_of_asset(folder, manifest)
    scene = simulated_scene(folder, asset, manifest)
    numbers = frame_numbers(folder, int(played.get("frames", 0)), request.frames)
    poses, warnings = _poses(folder, scene, len(numbers) + numbers[0])
    warnings = [*_beyond_clip(scene.camera.size, request), *warnings]
    edits = read_edits(folder)
    look = _look(request, edits.look)
    waves, said = _waves(scene, asset, folder, played, edits.waves * (look.style in WAVING))
    warnings += said
    painter = _painter(scene, folder, request, look, waves)
    renderer = FrameRenderer(scene, footage, painter=painter, surfels=SURFELS)
    background = renderer.background(request.background, front=request.view == "input")
    cameras = _cameras(scene, request, len(numbers))
    pictures = _pictures(renderer, folder, numbers, cameras, poses, background)
    require_writable(out.parent if out.suffix.lower() in FILMS else out)
    progress.stage("render", 1, 1)
    with disk_errors(out):
        _write(_told(pictures, progress, len(numbers)), out, numbers, request.format, 1.0 / interval)
    seconds = time.perf_counter() - began
    progress.finished("render", seconds, False)
    for text in warnings:
        progress.warn(text)
    size = cameras[0].size
    facts = {"frames": len(numbers), "first": FIRST_FRAME + numbers[0], "size": list(size), "view": request.view,
             "look": "splats" if painter is None else painter.look.style, "out": str(out)}  # fmt: skip
    words = (f"{frames_told(len(numbers))} of {size[0]} x {size[1]} px: {out}",)
    if waves is not None:
        facts, words = facts | {"waves": waves.facts}, (*words, waves.told)
    return Written(out, seconds, tuple(warnings), {"render": {"seconds": round(seconds, 3)}}, facts, words)


def _look(request: RenderRequest, look: Look) -> Look:
    """The one that is asked for; what is not, as scene.yaml names it.

    Raises:
        InputRejected: an unknown look, material or environment, or one that a look does not show.
    """
    asked = {"style": request.look, "material": _checked_material(request), "environment": request.environment,
             "exposure": request.exposure}  # fmt: skip
    if request.engine != "mesh" and request.look is None:
        asked["style"] = "surface"
    if request.environment is not None and Path(request.environment).is_file():
        asked["environment"] = str(Path(request.environment).resolve())
    look = replace(look, **{k: v for k, v in asked.items() if v is not None})
    if look.style == "splats" and (request.material is not None or request.environment is not None):
        raise InputRejected(
            "a material or an environment for splats as they were lifted", "another look",
            "add --look relit, transparent or surface",
        )  # fmt: skip
    return look


def _painter(
    scene: Scene, folder: Path, request: RenderRequest, look: Look, waves: SurfaceWaves | None
) -> Painter | None:
    """Of a look; None: the splats as they were lifted."""
    if look.style == "splats":
        return None
    if request.engine == "mitsuba" and request.background == "none":
        raise InputRejected("Mitsuba without the ground", "--background plate or terrain", "or use --engine mesh")
    return Painter(
        look,
        scene.terrain,
        folder,
        kind=scene.kind,
        engine=request.engine,
        quality=Quality.draft() if request.draft else Quality(request.supersample, request.samples),
        slab=slab_of(scene),
        on_surface=OnSurface(waves, white_of(scene)),
    )


def _waves(
    scene: Scene, asset: FluidAsset, folder: Path, played: dict[str, Any], amount: float
) -> tuple[SurfaceWaves | None, list[Notice]]:
    """Of the frames on disk; none where none are asked for, or filmed, which is said."""
    if amount == 0:
        return None, []
    numbers = frame_numbers(folder, int(played.get("frames", 0)), None)
    found = waves_of(scene, asset, folder, numbers, amount)
    return (None, [found]) if isinstance(found, Notice) else (found, [])


def _checked_material(request: RenderRequest) -> str | None:
    """The material by its own name ("muddy water" is muddy_water).

    Raises:
        InputRejected: an unknown material, look or environment; the nearest is told.
    """
    from fluidlift.io.scene_look import EXPOSURE, STYLES
    from fluidlift.look.environment import BUILT_IN
    from fluidlift.look.materials import material_named

    if request.look is not None and request.look not in STYLES:
        near = difflib.get_close_matches(request.look, STYLES, 1)
        raise InputRejected(f"no look '{request.look}'", ", ".join(STYLES), f"did you mean {near[0]}?" if near else "")
    material = None if request.material is None else material_named(request.material).name
    name = request.environment
    if name is not None and name not in BUILT_IN and not Path(name).is_file():
        near = difflib.get_close_matches(name, BUILT_IN, 1)
        raise InputRejected(
            f"no environment '{name}'", f"{', '.join(BUILT_IN)}, or an existing .hdr or .exr file",
            f"did you mean {near[0]}?" if near else "",
        )  # fmt: skip
    if request.exposure is not None and not abs(request.exposure) <= EXPOSURE:
        raise InputRejected(f"an exposure of {request.exposure:g} stops", f"-{EXPOSURE:g} to {EXPOSURE:g}")
    if not 1 <= request.samples <= 100_000:
        raise InputRejected(f"{request.samples} samples per pixel", "1 to 100000")
    return material


def _check(request: RenderRequest, out: Path) -> None:
    if request.view not in VIEWS and not Path(request.view).is_file():
        near = difflib.get_close_matches(request.view, VIEWS, 1)
        raise InputRejected(
            f"no view '{request.view}'", f"{', '.join(VIEWS)}, or a file with a camera or keyed views",
            f"did you mean {near[0]}?" if near else "check --view",
        )  # fmt: skip
    if request.background not in BACKGROUNDS:
        raise InputRejected(f"no background '{request.background}'", ", ".join(BACKGROUNDS))
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


def _poses(folder: Path, scene: Scene, frames: int) -> tuple[np.ndarray | None, list[Notice]]:
    """Where the obstacles are in every frame, from the simulation's own result."""
    if not scene.obstacles:
        return None, []
    poses = simulated_poses(folder, len(scene.obstacles), frames)
    if poses is None:
        return None, [
            Notice(
                "obstacles-left-out",
                "the obstacles' motion is not at hand and they are not drawn: run fluidlift sim again",
            )
        ]
    return poses, []


def _beyond_clip(clip: tuple[int, int], request: RenderRequest) -> list[Notice]:
    """What to say of pictures of another shape than the clip's, from its camera: they show what it never saw."""
    from fluidlift.io.pictures import same_shape

    if request.view != "input" or request.size is None or same_shape(clip, request.size):
        return []
    (width, height), (w, h) = clip, request.size
    sides = "left and right" if w * height > h * width else "above and below"
    return [Notice("picture-beyond-clip", f"pictures of {w} x {h} px show more {sides} than the clip, {width} x "
                   f"{height} px, which saw no fluid and no ground there: the ends of both may be in view; a --size of "
                   "its shape, or another --view, shows none")]  # fmt: skip


def _cameras(scene: Scene, request: RenderRequest, count: int) -> list[PinholeCamera]:
    """One per frame."""
    from fluidlift.io.views import read_view
    from fluidlift.look import camera_path
    from fluidlift.look.scenery import orbit_camera, side_camera, terrain_surfels
    from fluidlift.look.vessel import glass_of

    camera = scene.camera
    size = request.size or camera.size
    around = np.concatenate([scene.rest.means, _surroundings(scene)])
    if request.view == "input":
        return [_fitted(camera, size)] * count
    if request.view == "side":
        ground = terrain_surfels(scene.terrain, glass=glass_of(scene.kind, scene.terrain))
        return [side_camera(camera, scene.rest, ground, around, size=size)] * count
    if request.view == "top":
        return [orbit_camera(camera, around, azimuth=0.0, elevation=89.0, size=size)] * count
    if request.view == "turn":
        return camera_path.orbit_path(camera, around, count, size=size)
    found = read_view(Path(request.view))
    if isinstance(found, PinholeCamera):
        return [found if request.size is None else _fitted(found, request.size)] * count
    return camera_path.keyed_path(found, count, size)


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


def _pictures(
    renderer: FrameRenderer,
    folder: Path,
    numbers: range,
    cameras: list[PinholeCamera],
    poses: np.ndarray | None,
    background: str,
) -> Iterator[Drawn]:
    """Each frame, from its camera."""
    for k, camera, (fluid, _, velocities) in zip(numbers, cameras, frames_of(folder, numbers), strict=True):
        frame = SimulatedFrame(fluid, velocities, None if poses is None else poses[k], k * renderer.scene.interval)
        yield renderer.draw(frame, camera, background)


def _told(pictures: Iterator[Drawn], progress: Progress, count: int) -> Iterator[Drawn]:
    """The same pictures; how many are done is told before each."""
    for done in range(count):
        progress.update(done, count)
        yield next(pictures)


def _write(pictures: Iterator[Drawn], out: Path, numbers: range, form: str, fps: float) -> None:
    from fluidlift.io.exr_write import write_channels
    from fluidlift.io.images import write_png
    from fluidlift.io.video import write_video

    if out.suffix.lower() in FILMS:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_video(out, (p.shown for p in pictures), fps)
        return
    suffix = "." + form
    cleared(out, [suffix])
    for k, p in zip(numbers, pictures, strict=True):
        path = numbered(out, k, suffix)
        if suffix == ".exr":
            write_channels(path, {**{c: p.image[..., i] for i, c in enumerate("RGB")}, "A": p.alpha, "Z": p.depth})
        else:
            straight = p.shown / np.maximum(p.alpha, 1e-4)[..., None]
            picture = np.concatenate([np.clip(straight, 0, 1), np.clip(p.alpha, 0, 1)[..., None]], axis=-1)
            write_png(path, (255 * picture + 0.5).astype(np.uint8))
