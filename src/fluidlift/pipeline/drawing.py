"""The frames of an asset as pictures in memory: its splats or another look, before a plate, the terrain or nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.pipeline.footage import Footage
from fluidlift.pipeline.front_view import before_ground, open_end
from fluidlift.pipeline.looks import Backdrop, Frame, Painter, placed_bodies
from fluidlift.pipeline.scene import Scene
from fluidlift.pipeline.splat_files import splat_frames
from fluidlift.types import Gaussians, PinholeCamera, Similarity3, concatenate, matrix_from_quat

SURFELS = 200_000
"""of the terrain: stills are looked at longer than the preview"""


@dataclass(frozen=True)
class Drawn:
    """One picture."""

    image: np.ndarray
    """[h,w,3], linear light, premultiplied by `alpha`"""
    alpha: np.ndarray
    """[h,w]"""
    depth: np.ndarray
    """[h,w] camera z, m; 0 where nothing is"""
    shown: np.ndarray
    """[h,w,3] sRGB in [0, 1] for a display, premultiplied by `alpha`"""


@dataclass(frozen=True)
class Stage:
    """All that one run draws."""

    scene: Scene
    footage: Footage | None
    background: str
    """plate, terrain, none, or auto: the first of these that can be had"""
    view_is_input: bool
    """whether the cameras stand where the clip's stood"""
    cameras: list[PinholeCamera]
    numbers: range
    """frames, from 0"""
    poses: np.ndarray | None
    """[k,b,7] of the obstacles, from frame 0"""
    painter: Painter | None = None
    """of another look than the splats' own"""


def drawn(stage: Stage, folder: Path, step: Callable[[int], None]) -> Iterator[Drawn]:
    """Each frame of the stage."""
    yield from (_own_look(stage, folder, step) if stage.painter is None else _other_look(stage, folder, step))


def _own_look(stage: Stage, folder: Path, step: Callable[[int], None]) -> Iterator[Drawn]:
    """Splats before surfels: one rasteriser for all, in the colours that the clip has."""
    from fluidlift.look.rasterize import render
    from fluidlift.look.scenery import mesh_surfels, terrain_surfels
    from fluidlift.look.vessel import glass_of

    scene, way, wanted = stage.scene, _background(stage), stage.numbers
    # a vessel hides nothing of what it holds, and is ground: cut out, none of it is there
    glass = glass_of(scene.kind)
    glass = 0.0 if glass is not None and way == "none" else glass
    ground = Gaussians.empty() if way == "plate" else terrain_surfels(scene.terrain, most=SURFELS, glass=glass)
    shapes = [mesh_surfels(o.mesh, scene.terrain.grid.spacing) for o in scene.obstacles]
    seen_of = before_ground(stage.scene, stage.footage) if way == "plate" else None
    end = None if way in ("plate", "none") else open_end(scene)
    for k, (fluid, _, _) in enumerate(splat_frames(folder, wanted.stop)):
        if k < wanted.start:
            continue
        step(k - wanted.start)
        camera = stage.cameras[k - wanted.start]
        fluid = fluid if end is None else fluid.select(end.before(fluid.means))
        bodies = [] if stage.poses is None else [
            s.transformed(Similarity3(1.0, matrix_from_quat(p[3:]), p[:3])) for s, p in zip(shapes, stage.poses[k])
        ]  # fmt: skip
        seen = concatenate([fluid if seen_of is None else fluid.select(seen_of(fluid)), *bodies])
        if way == "none":
            yield _encoded(*_held_out(seen, ground, camera))
            continue
        found = render(concatenate([ground, seen]), camera, background=_behind(way, stage, camera))
        yield _encoded(found.image, np.ones(found.alpha.shape, np.float32), found.depth)


def _encoded(rgb: np.ndarray, alpha: np.ndarray, depth: np.ndarray) -> Drawn:
    """Of sRGB colours, premultiplied; linear light beside them, because compositing programs multiply linear values."""
    from fluidlift.numerics.srgb import linear_from_srgb

    rgb = np.clip(rgb, 0.0, 1.0)
    straight = np.clip(rgb / np.maximum(alpha, 1e-4)[..., None], 0.0, 1.0)
    return Drawn((linear_from_srgb(straight) * alpha[..., None]).astype(np.float32), alpha, depth, rgb)


def _other_look(stage: Stage, folder: Path, step: Callable[[int], None]) -> Iterator[Drawn]:
    """Lit by an environment, or as a liquid."""
    from fluidlift.numerics.srgb import linear_from_srgb, srgb_from_linear

    assert stage.painter is not None
    scene, wanted, way = stage.scene, stage.numbers, _background(stage)
    rocks = _rock_depth(stage) if way == "plate" else None
    coarse = max(stage.cameras[0].focal[0] / scene.camera.focal[0], 1.0) if way == "plate" else 1.0
    for k, (fluid, _, velocities) in enumerate(splat_frames(folder, wanted.stop)):
        if k < wanted.start:
            continue
        step(k - wanted.start)
        camera = stage.cameras[k - wanted.start]
        frame = Frame(fluid, velocities, [] if stage.poses is None else placed_bodies(scene.obstacles, stage.poses[k]))
        plate = linear_from_srgb(_behind(way, stage, camera)).astype(np.float32) if way == "plate" else None
        found = stage.painter.picture(frame, camera, Backdrop(plate, rocks, coarse, way == "none"))
        alpha = found.alpha[..., None]
        light = stage.painter.display(found.image / np.maximum(alpha, 1e-4))
        yield Drawn(found.image, found.alpha, found.depth, (srgb_from_linear(light) * alpha).astype(np.float32))


def _rock_depth(stage: Stage) -> np.ndarray | None:
    """Camera depth (m) of the rocks that the plate shows, 0 beside them; None where it shows none."""
    from fluidlift.look.scenery import terrain_depth

    footage, camera = stage.footage, stage.cameras[0]
    rocks = None if footage is None else footage.rocks
    if rocks is None or not rocks.any():
        return None
    picture = rocks[..., None].repeat(3, 2).astype(np.uint8) * 255
    there = _placed(picture, stage.scene.camera, camera, goes_on=False)[..., 0] > 0.5
    depth = terrain_depth(stage.scene.terrain, camera)
    return np.where(there & np.isfinite(depth), depth, 0.0).astype(np.float32)


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


def _background(stage: Stage) -> str:
    """The kind of background: what was asked for, or the best that there is."""
    way, has_plate = stage.background, stage.footage is not None and not stage.scene.reshaped
    if way == "plate" and not has_plate:
        raise InputRejected(
            "the clip's background, which is no longer at hand", "the asset's folder work/, as make left it",
            "use --background terrain or none, or run fluidlift make again",
        )  # fmt: skip
    if way != "auto":
        return way
    return "plate" if stage.view_is_input and has_plate else "terrain"


def _behind(way: str, stage: Stage, camera: PinholeCamera) -> np.ndarray:
    """sRGB [H,W,3] behind everything."""
    width, height = camera.size
    if way == "terrain" or stage.footage is None:
        return np.linspace(0.93, 0.78, height, dtype=np.float32)[:, None, None] * np.ones((1, width, 3), np.float32)
    return _placed(stage.footage.plate, stage.scene.camera, camera)


def _placed(plate: np.ndarray, source: PinholeCamera, camera: PinholeCamera, *, goes_on: bool = True) -> np.ndarray:
    """The plate as a camera of the same place with another picture size sees it.

    Args:
        plate: u8 [h,w,3].
        source: its camera.
        camera: of the picture.
        goes_on: beyond its edges as in a mirror: grass stays grass, where a repeated last pixel is a streak. Else zero.
    """
    import cv2

    scale = np.array(camera.focal) / np.array(source.focal)
    # OpenCV counts from the middle of the first pixel
    shift = np.array(camera.center) - 0.5 - scale * (np.array(source.center) - 0.5)
    move = np.array([[scale[0], 0.0, shift[0]], [0.0, scale[1], shift[1]]])
    way = cv2.INTER_AREA if scale[0] < 1 else cv2.INTER_CUBIC
    if (scale == 1).all() and camera.size == source.size:
        return plate.astype(np.float32) / 255.0
    border = cv2.BORDER_REFLECT if goes_on else cv2.BORDER_CONSTANT
    moved = cv2.warpAffine(plate, move, camera.size, flags=way, borderMode=border)
    return moved.astype(np.float32) / 255.0
