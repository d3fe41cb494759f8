"""The stage that shows: preview, report, USD, pictures for measurement."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from fluidlift.export.whitewater import with_kinds
from fluidlift.io.frames import FluidFrame
from fluidlift.io.scene_look import Look
from fluidlift.pipeline.inputs import BESIDE
from fluidlift.pipeline.settings import ShowSettings
from fluidlift.pipeline.work import Work
from fluidlift.present.as_filmed import BEYOND, Reel, card_of_run
from fluidlift.present.frames import FrameRenderer, SimulatedFrame
from fluidlift.present.front_view import slab_of, to_bytes, white_of
from fluidlift.present.looks import OnSurface, Painter
from fluidlift.scene.build import Scene
from fluidlift.scene.footage import Footage
from fluidlift.scene.splat_files import splat_frames
from fluidlift.types import PinholeCamera, kind_of
from fluidlift.types.stages import Shown, Simulation

T = TypeVar("T")
COVERS, COVERS_THIN = 0.5, 0.15
"""opacity from which a pixel counts as covered by a liquid, and by smoke whose film cannot be asked for it"""


@dataclass(frozen=True)
class SeenLook:
    """The look of the fluid in pictures, by what they depend on."""

    look: Look = field(metadata=BESIDE)
    mark: dict[str, Any]
    """`Look.mark`, with the colours of obstacles: all of the look that counts"""


@dataclass(frozen=True)
class ComparedFrames:
    """What is compared with the clip, frame by frame, as it is drawn."""

    frames: Reel
    """u8 [H,W,3]"""
    mask: Reel
    """bool [H,W]"""
    flow: list[np.ndarray]
    """[H,W,2], px per frame"""


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
    measured = ComparedFrames(Reel(folder), Reel(folder), [])
    painter = _painter(scene, folder, seen.look)
    panels = _panels(scene, footage, folder, config, poses, measured, step, painter)
    if config.preview:
        write_video(folder / "preview.mp4", panels, 1.0 / scene.interval, repeatable=True)
    else:
        (folder / "preview.mp4").unlink(missing_ok=True)  # of frames that are no longer there
    if config.usd:
        told = count if config.usd_frames else 1
        write_usd(
            folder / "asset.usda",
            frames=_told(scene, folder, told),
            interval=scene.interval,
            terrain=scene.terrain.mesh,
            camera=scene.camera,
            bodies=[
                MovingMesh(o.name, o.mesh, poses[:told, b, :3], poses[:told, b, 3:])
                for b, o in enumerate(scene.obstacles)
            ],
            attributes=scene.parameters.to_dict() | {"kind": scene.kind},
        )
    else:
        for name in ("asset.usda", "asset.usdc"):  # of frames that are no longer there
            (folder / name).unlink(missing_ok=True)
    frames, mask, compared = measured.frames.array(), measured.mask.array(), len(measured.flow)
    card = card_of_run(scene, footage, config.preview, frames, mask)
    if not compared:
        return Shown(count, card.as_filmed, warnings=card.warnings)
    flow = np.stack(measured.flow).astype(np.float16)
    return Shown(count, card.as_filmed, frames[:compared], mask[:compared], flow, card.warnings)


def _told(scene: Scene, folder: Path, count: int) -> Iterator[FluidFrame | tuple]:
    """The frames that the USD file holds."""
    frames = splat_frames(folder, count)
    return frames if scene.whitewater == 0 else (with_kinds(f, scene.terrain.grid.spacing) for f in frames)


def _painter(scene: Scene, folder: Path, look: Look | None) -> Painter | None:
    """Of another look than the splats' own."""
    if look is None or look.style == "splats":
        return None
    white = OnSurface(white=white_of(scene))
    return Painter(look, scene.terrain, folder, kind=scene.kind, slab=slab_of(scene), on_surface=white)


def _panels(
    scene: Scene,
    footage: Footage | None,
    folder: Path,
    config: ShowSettings,
    poses: np.ndarray,
    measured: ComparedFrames,
    step: Callable[[int, int], None],
    painter: Painter | None,
) -> Iterator[np.ndarray]:
    """Input | re-simulation | side view, frame by frame; keeps what the evaluation needs on the way.

    The side view is drawn by another thread, where splats are shown as they are, and the next frame is read by one.
    """
    from fluidlift.look.pictures import caption

    renderer, compared = FrameRenderer(scene, footage, painter=painter), 0
    if renderer.footage is not None:
        # frames between those of the clip, and those of an edited scene, have no counterpart in it
        edited = scene.obstacles or scene.emitters or scene.overlap or scene.changes
        if scene.interval == scene.clip_interval and not edited:
            compared = max(len(renderer.footage.clip) - renderer.footage.start, 1)
    covers = _covers(scene, footage)
    size = _panel_size(scene.camera.size, config.width)
    side = _side_camera(scene, renderer, size)
    with ThreadPoolExecutor(1, "side view") as beside:
        for k, (gaussians, _, speeds) in enumerate(_read_ahead(splat_frames(folder, len(poses)))):
            step(k, len(poses))
            frame = SimulatedFrame(gaussians, speeds, poses[k])
            # another look keeps pictures of its own between two views
            view = beside.submit(renderer.shown, frame, side, "terrain") if painter is None else None
            rendered, motion = renderer.measured(frame, moving=k < compared)
            picture = to_bytes(rendered.image)
            if k < BEYOND * compared:  # of the splats, whatever look the preview has
                measured.frames.append(picture)
                measured.mask.append(rendered.alpha > covers)
            if motion is not None:
                measured.flow.append(motion)
            if painter is not None:
                picture = renderer.shown(frame, scene.camera, "plate")
            shown = renderer.shown(frame, side, "terrain") if view is None else view.result()
            panels = [caption(_resized(picture, size), "re-simulation"), caption(shown, "side view")]
            if footage is not None:
                panels.insert(0, caption(*_input(footage, round(k * scene.interval / scene.clip_interval), size)))
            yield np.concatenate(panels, axis=1)


def _read_ahead(frames: Iterator[T]) -> Iterator[T]:
    """The same, each read by another thread while the one before is drawn."""
    with ThreadPoolExecutor(1, "reading") as beside:
        coming = beside.submit(next, frames, None)
        while (frame := coming.result()) is not None:
            coming = beside.submit(next, frames, None)
            yield frame


def _covers(scene: Scene, footage: Footage | None) -> float:
    """Opacity from which a pixel counts as covered: of smoke, that from which the clip's own counts in its masks, which
    go around all of it that can be seen."""
    from fluidlift.look.smoke_film import shown_from
    from fluidlift.scene.smoke_appearance import smoke_film

    if not kind_of(scene.kind).is_gas:
        return COVERS
    film = None if scene.film is None or footage is None else smoke_film(scene.film, scene.camera.size)
    if footage is None or film is None or isinstance(film, str):
        return COVERS_THIN
    first = footage.start - scene.film_start
    masks = footage.labels.fluid[first : first + len(film)]
    if masks.shape != film.opacities.shape:
        return COVERS_THIN
    return shown_from(film.opacities, np.asarray(masks), COVERS_THIN)


def _input(footage: Footage, time: int, size: tuple[int, int]) -> tuple[np.ndarray, str]:
    """The clip's frame at a time (frames), and what it is; beyond its end the clip begins again, since a still would
    say nothing of the motion."""
    clip = footage.clip.frames[footage.start :]
    return _resized(clip[time % len(clip)], size), "input, again" if time >= len(clip) else "input"


def _side_camera(scene: Scene, renderer: FrameRenderer, size: tuple[int, int]) -> PinholeCamera:
    """The camera of the side view."""
    from fluidlift.look.scenery import side_camera

    # a body in the air may fill its box later; what lies on a bed stays in it
    grid, around = scene.terrain.grid, scene.terrain.mesh.vertices
    if not kind_of(scene.kind).lies_on_ground:
        inset = 0.18 * (grid.high - grid.low) * np.array([1.0, 1.0, 0.0])
        around = np.stack([grid.low + inset, grid.high - inset])
    return side_camera(scene.camera, scene.rest, renderer.ground, np.concatenate([scene.rest.means, around]), size=size)


def _panel_size(size: tuple[int, int], width: int) -> tuple[int, int]:
    factor = min(1.0, width / max(size))
    return max(2, 2 * round(size[0] * factor / 2)), max(2, 2 * round(size[1] * factor / 2))


def _resized(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    import cv2

    if picture.shape[1::-1] == tuple(size):
        return picture
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
