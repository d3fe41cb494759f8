"""The stage that shows: preview, report, USD, pictures for measurement."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.io.scene_look import Look
from fluidlift.pipeline.as_filmed import BEYOND, Reel, card_of_run
from fluidlift.pipeline.footage import Footage
from fluidlift.pipeline.front_view import FrontView, open_end, to_bytes
from fluidlift.pipeline.looks import Backdrop, Frame, Painter, placed_bodies
from fluidlift.pipeline.scene import Scene
from fluidlift.pipeline.settings import ShowSettings
from fluidlift.pipeline.splat_files import splat_frames
from fluidlift.pipeline.work import Work
from fluidlift.types import PinholeCamera, Similarity3, concatenate, kind_of, matrix_from_quat
from fluidlift.types.stages import Shown, Simulation


@dataclass(frozen=True)
class SeenLook:
    """The look of the fluid in pictures, by what they depend on."""

    look: Look
    mark: dict[str, Any]
    """`Look.mark`, with the colours of obstacles"""

    @property
    def cache_key(self) -> dict[str, Any]:
        """What the stage's key knows of it."""
        return self.mark


def show(
    scene: Scene,
    simulation: Simulation,
    footage: Footage | None,
    seen: SeenLook,
    config: ShowSettings,
    *,
    folder: Path,
    work: Work,
) -> Shown:
    """Render the frames, write what people open.

    Args:
        scene: that was simulated.
        simulation: of it.
        footage: the clip; without it the preview leaves out the input, and the fluid stands before grey.
        seen: look of the fluid in the preview. What is measured are its splats as lifted in any case.
        config: what is written.
        folder: of the asset.
        work: told how many frames are done.
    """
    from fluidlift.io.export_usd import write_usd
    from fluidlift.io.frames import MovingMesh
    from fluidlift.io.video import write_video

    poses, step = simulation.poses, work.step
    count = len(poses)
    measured: dict[str, Any] = {"frames": Reel(folder), "mask": Reel(folder), "flow": []}
    painter = _painter(scene, folder, seen.look)
    panels = _panels(scene, footage, folder, config, poses, measured, step, painter)
    if config.preview:
        write_video(folder / "preview.mp4", panels, 1.0 / scene.interval, repeatable=True)
    else:
        (folder / "preview.mp4").unlink(missing_ok=True)  # of frames that are no longer there
    if config.usd:
        write_usd(
            folder / "asset.usda",
            frames=splat_frames(folder, count),
            interval=scene.interval,
            terrain=scene.terrain.mesh,
            camera=scene.camera,
            bodies=[
                MovingMesh(o.name, o.mesh, poses[:, b, :3], poses[:, b, 3:]) for b, o in enumerate(scene.obstacles)
            ],
            attributes=scene.parameters.to_dict() | {"kind": scene.kind},
        )
    else:
        for name in ("asset.usda", "asset.usdc"):  # of frames that are no longer there
            (folder / name).unlink(missing_ok=True)
    frames, mask, compared = measured["frames"].array(), measured["mask"].array(), len(measured["flow"])
    card = card_of_run(scene, footage, config.preview, frames, mask)
    if not compared:
        return Shown(count, card.as_filmed, warnings=card.warnings)
    flow = np.stack(measured["flow"]).astype(np.float16)
    return Shown(count, card.as_filmed, frames[:compared], mask[:compared], flow, card.warnings)


def _painter(scene: Scene, folder: Path, look: Look | None) -> Painter | None:
    """Of another look than the splats' own."""
    if look is None or look.style == "splats":
        return None
    return Painter(look, scene.terrain, folder, kind=scene.kind, end=open_end(scene))


def _panels(
    scene: Scene,
    footage: Footage | None,
    folder: Path,
    config: ShowSettings,
    poses: np.ndarray,
    measured,
    step,
    painter,
) -> Iterator[np.ndarray]:
    """Input | re-simulation | side view, frame by frame; keeps what the evaluation needs on the way."""
    from fluidlift.look.pictures import caption
    from fluidlift.look.rasterize import render
    from fluidlift.look.scenery import mesh_surfels, side_camera, terrain_depth, terrain_surfels
    from fluidlift.look.vessel import glass_of
    from fluidlift.numerics.srgb import linear_from_srgb

    camera, terrain, grid = scene.camera, scene.terrain, scene.terrain.grid
    front_view, compared = FrontView.of(scene, footage), 0
    if footage is not None and not scene.reshaped:
        # frames between those of the clip, and those of an edited scene, have no counterpart in it
        edited = scene.obstacles or scene.emitters or scene.overlap or scene.changes
        if scene.interval == scene.clip_interval and not edited:
            compared = max(len(footage.clip) - footage.start, 1)
    rocks = front_view.rocks
    behind = terrain_depth(terrain, camera) if rocks.any() and painter is not None else None
    airborne = not kind_of(scene.kind).is_channel_flow
    ground = terrain_surfels(terrain, glass=glass_of(scene.kind))
    size = _panel_size(camera.size, config.width)
    # a body in the air may fill its box later; what lies on a bed stays in it
    around = terrain.mesh.vertices
    if airborne:
        inset = 0.18 * (grid.high - grid.low) * np.array([1.0, 1.0, 0.0])
        around = np.stack([grid.low + inset, grid.high - inset])
    side = side_camera(camera, scene.rest, ground, np.concatenate([scene.rest.means, around]), size=size)
    end = open_end(scene)
    sky = np.linspace(0.93, 0.78, size[1], dtype=np.float32)[:, None, None] * np.ones((1, size[0], 3), np.float32)
    shapes = [mesh_surfels(o.mesh, grid.spacing) for o in scene.obstacles]
    lit_plate = linear_from_srgb(front_view.plate).astype(np.float32)
    rock_depth = None if behind is None else np.where(rocks & np.isfinite(behind), behind, 0.0)
    for k, (gaussians, _, speeds) in enumerate(splat_frames(folder, len(poses))):
        step(k, len(poses))
        solids = [
            shape.transformed(Similarity3(1.0, matrix_from_quat(p[3:]), p[:3])) for shape, p in zip(shapes, poses[k])
        ]
        rendered, front, velocity = front_view.drawn(gaussians, speeds, solids)
        picture = to_bytes(rendered.image)
        if k < BEYOND * compared:  # of the splats, whatever look the preview has
            measured["frames"].append(picture)
            measured["mask"].append(rendered.alpha > 0.5)
        if k < compared:
            measured["flow"].append(_screen_velocity(front, velocity, camera, scene.interval, rendered.alpha))
        if painter is None:
            # as in the other looks, what thins out behind the section of a stream is not drawn before the terrain
            whole = gaussians if end is None else gaussians.select(end.before(gaussians.means))
            view = to_bytes(render(concatenate([ground, *solids, whole]), side, background=sky).image)
        else:
            frame = Frame(gaussians, speeds, placed_bodies(scene.obstacles, poses[k]))
            picture = painter.shown(frame, camera, Backdrop(lit_plate, rock_depth))
            view = painter.shown(frame, side, Backdrop())
        panels = [caption(_resized(picture, size), "re-simulation"), caption(view, "side view")]
        if footage is not None:
            time, clip = round(k * scene.interval / scene.clip_interval), footage.clip.frames[footage.start :]
            again = time >= len(clip)  # beyond its end the clip begins again: a still would say nothing of the motion
            panels.insert(0, caption(_resized(clip[time % len(clip)], size), "input, again" if again else "input"))
        yield np.concatenate(panels, axis=1)


def _panel_size(size: tuple[int, int], width: int) -> tuple[int, int]:
    factor = min(1.0, width / max(size))
    return max(2, 2 * round(size[0] * factor / 2)), max(2, 2 * round(size[1] * factor / 2))


def _resized(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    import cv2

    if picture.shape[1::-1] == tuple(size):
        return picture
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA)


def _screen_velocity(gaussians, velocity, camera: PinholeCamera, interval: float, alpha) -> np.ndarray:
    """Motion of the re-simulation in the picture, px per frame; NaN where it shows no fluid."""
    from fluidlift.look.rasterize import render

    before, z0 = camera.project(gaussians.means)
    after, z1 = camera.project(gaussians.means + velocity * interval)
    ok = (z0 > 0) & (z1 > 0)
    move = np.where(ok[:, None], after - before, 0.0).astype(np.float32)
    drawn = render(gaussians, camera, features=np.clip(move, -1e3, 1e3)).image
    return np.where(alpha[..., None] > 0.3, drawn / np.maximum(alpha, 0.3)[..., None], np.nan)
