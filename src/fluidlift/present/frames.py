"""The one renderer of frames, for the preview, `fluidlift render` and the viewer's pictures.

A frame is drawn as its splats or in another look, before the clip's plate, the terrain or nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage

from fluidlift.errors import InputRejected
from fluidlift.look.rasterize import Rendered, render
from fluidlift.look.scenery import mesh_surfels, terrain_depth, terrain_surfels
from fluidlift.look.smoothstep import smoothstep
from fluidlift.look.vessel import glass_of
from fluidlift.numerics.srgb import linear_from_srgb, srgb_from_linear
from fluidlift.present.front_view import FrontView, open_end, to_bytes
from fluidlift.present.looks import Frame, Painter, placed_bodies
from fluidlift.present.without_fluid import Backdrop
from fluidlift.scene.build import Scene
from fluidlift.scene.footage import Footage
from fluidlift.types import Gaussians, PinholeCamera, Similarity3, concatenate, kind_of, matrix_from_quat

BACKGROUNDS = ("auto", "plate", "terrain", "none")
RIM = 2
"""px beside the fluid that lens and coding mix with it"""
RING = 6
"""px around what stands in the fluid over which a picture of it runs into the bed: a simulated liquid keeps off solids
by up to a cell"""
SOMETIMES = 0.1
"""share of the frames from which on a pixel counts as one of the fluid: its plate may show fluid that masks missed"""
PALE = 0.5
"""mean sRGB, 0 to 1, from which smoke that is seen through is told from a pale sky by little"""
NEAR = 1e-3
"""m, depth of what stands before the fluid in an unknown place: it hides all of it"""


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
class SimulatedFrame:
    """What the simulation left of one frame."""

    fluid: Gaussians
    velocities: np.ndarray
    """[n,3], m/s"""
    poses: np.ndarray | None = None
    """[b,7] of the obstacles: position (m) and orientation (w, x, y, z); None: they are not drawn"""
    time: float = 0.0
    """s from the first frame"""


class FrameRenderer:
    """Draws the frames of one scene. What stays from frame to frame is kept.

    Args:
        scene: that was simulated.
        footage: the clip, where it is at hand; of a scene whose terrain was edited it is not shown.
        painter: of another look than the splats' own.
        surfels: of the terrain at most; None: as many as a film needs.
    """

    def __init__(
        self, scene: Scene, footage: Footage | None, *, painter: Painter | None = None, surfels: int | None = None
    ) -> None:
        self.scene, self.footage, self.painter = scene, None if scene.reshaped else footage, painter
        self.front_view = FrontView.of(scene, footage)
        self._most = {} if surfels is None else {"most": surfels}
        self._rock_depth: tuple[PinholeCamera, np.ndarray | None] | None = None
        self._shown: tuple[PinholeCamera, Backdrop] | None = None
        self._end = open_end(scene)

    def background(self, asked: str, *, front: bool) -> str:
        """plate, terrain or none: what is asked for; of auto the first of these that there is.

        Args:
            asked: one of `BACKGROUNDS`.
            front: whether the camera stands where the clip's stood.

        Raises:
            InputRejected: the clip's background, which is not at hand.
        """
        if asked == "plate" and self.footage is None:
            raise InputRejected(
                "the clip's background, which is no longer at hand", "the asset's folder work/, as make left it",
                "use --background terrain or none, or run fluidlift make again",
            )  # fmt: skip
        if asked != "auto":
            return asked
        return "plate" if front and self.footage is not None else "terrain"

    def draw(self, frame: SimulatedFrame, camera: PinholeCamera, background: str) -> Drawn:
        """One frame.

        Args:
            frame: what is in it.
            camera: who looks.
            background: plate (of a camera where the clip's stood; grey where the clip is not at hand), terrain or none.
        """
        if self.painter is not None:
            found = self.painter.picture(self._painted(frame), camera, self._backdrop(camera, background))
            alpha = found.alpha[..., None]
            light = self.painter.display(found.image / np.maximum(alpha, 1e-4))
            return Drawn(found.image, found.alpha, found.depth, (srgb_from_linear(light) * alpha).astype(np.float32))
        if background == "none":
            return _encoded(*_held_out(self._seen(frame), self._ground_without_glass, camera))
        found = self._splatted(frame, camera, background)
        return _encoded(found.image, np.ones(found.alpha.shape, np.float32), found.depth)

    def shown(self, frame: SimulatedFrame, camera: PinholeCamera, background: str) -> np.ndarray:
        """One frame before plate or terrain, as `draw` has it: u8 [h,w,3], sRGB."""
        if self.painter is not None:
            return self.painter.shown(self._painted(frame), camera, self._backdrop(camera, background))
        return to_bytes(self._splatted(frame, camera, background).image)

    def measured(self, frame: SimulatedFrame, *, moving: bool) -> tuple[Rendered, np.ndarray | None]:
        """The splats as the clip's camera sees them, whatever the look, and their motion in it where it is asked for:
        `FrontView.measured`."""
        solids = self._solids(frame)
        if moving:
            return self.front_view.measured(frame.fluid, frame.velocities, solids, self.scene.interval)
        return self.front_view.drawn(frame.fluid, frame.velocities, solids)[0], None

    # --- inside -----------------------------------------------------------------------------------------------------

    def _splatted(self, frame: SimulatedFrame, camera: PinholeCamera, background: str) -> Rendered:
        """Splats before surfels: one rasteriser for all, in the colours that the clip has."""
        if background == "plate":
            return self.front_view.drawn(
                frame.fluid, frame.velocities, self._solids(frame), camera=camera, plate=self._plate(camera)
            )[0]
        # as in the other looks, what thins out behind the section of a stream is not drawn before the terrain
        fluid = frame.fluid if self._end is None else frame.fluid.select(self._end.before(frame.fluid.means))
        sky = _sky(camera, self._pale)
        return render(concatenate([self.ground, *self._solids(frame), fluid]), camera, background=sky)

    def _seen(self, frame: SimulatedFrame) -> Gaussians:
        return concatenate([frame.fluid, *self._solids(frame)])

    def _painted(self, frame: SimulatedFrame) -> Frame:
        bodies = [] if frame.poses is None else placed_bodies(self.scene.obstacles, frame.poses)
        return Frame(frame.fluid, frame.velocities, bodies, frame.time)

    def _backdrop(self, camera: PinholeCamera, background: str) -> Backdrop:
        if background != "plate":
            return Backdrop(cut_out=background == "none")
        if self._shown is None or self._shown[0] is not camera:
            self._shown = camera, self._on_plate(camera)
        return self._shown[1]

    def _on_plate(self, camera: PinholeCamera) -> Backdrop:
        fluid = self._filmed_fluid(camera)
        plate = linear_from_srgb(self._plate(camera, dry=fluid is not None)).astype(np.float32)
        coarse = max(camera.focal[0] / self.scene.camera.focal[0], 1.0)
        drawn = None if fluid is None else _placed(self._beside_rocks, self.scene.camera, camera)[..., 0]
        return Backdrop(plate, self._depth_of_rocks(camera), coarse, fluid, drawn)

    @cached_property
    def _pale(self) -> bool:
        """Whether the fluid is smoke that would hardly be seen before a pale sky."""
        return kind_of(self.scene.kind).is_gas and bool(np.mean(self.scene.rest.rgb) > PALE)

    @cached_property
    def ground(self) -> Gaussians:
        """Surfels of the terrain."""
        return terrain_surfels(self.scene.terrain, glass=glass_of(self.scene.kind, self.scene.terrain), **self._most)

    @cached_property
    def _ground_without_glass(self) -> Gaussians:
        """A vessel hides nothing of what it holds, and is ground: cut out, none of it is there."""
        if glass_of(self.scene.kind, self.scene.terrain) is None:
            return self.ground
        return terrain_surfels(self.scene.terrain, glass=0.0, **self._most)

    @cached_property
    def _shapes(self) -> list[Gaussians]:
        return [mesh_surfels(o.mesh, self.scene.terrain.grid.spacing) for o in self.scene.obstacles]

    def _solids(self, frame: SimulatedFrame) -> list[Gaussians]:
        """The obstacles where they are."""
        poses = () if frame.poses is None else frame.poses
        return [s.transformed(Similarity3(1.0, matrix_from_quat(p[3:]), p[:3])) for s, p in zip(self._shapes, poses)]

    def _plate(self, camera: PinholeCamera, *, dry: bool = False) -> np.ndarray:
        """sRGB [h,w,3] in [0, 1] of the clip without its fluid (dry: nor on what stands in it); grey where it is not at
        hand."""
        if self.footage is None:
            return np.full((*camera.size[::-1], 3), 0.5, np.float32)
        return _placed(self._dry_plate if dry else self.footage.plate, self.scene.camera, camera)

    def _filmed_fluid(self, camera: PinholeCamera) -> np.ndarray | None:
        """Where the plate shows the clip's fluid or a guess in its place, 0 to 1: around the fluid, which leaves a rim
        in it, and not on what stands in or before it. None: it shows none, or its ground is not known."""
        if self.footage is None or not kind_of(self.scene.kind).lies_on_ground:
            return None
        picture = self._fluid_pixels[..., None].repeat(3, 2).astype(np.uint8) * 255
        return np.clip(_placed(picture, self.scene.camera, camera)[..., 0], 0.0, 1.0)

    @cached_property
    def _stands(self) -> np.ndarray:
        """bool [H,W] of the clip: something stands in or before the fluid."""
        assert self.footage is not None
        rocks, before = self.footage.rocks, self.footage.before
        return rocks if before is None else rocks | before

    @cached_property
    def _dry_plate(self) -> np.ndarray:
        """The clip's plate without the rim that fluid leaves on what stands in it. That goes on as it is inside: also
        over the ring around it up to which a simulated liquid does not reach."""
        assert self.footage is not None
        core = _without_rim(self._stands)
        if not core.any():
            return self.footage.plate
        nearest = ndimage.distance_transform_edt(~core, return_distances=False, return_indices=True)
        rim = self._filmed_around & ~core
        return np.where(rim[..., None], self.footage.plate[tuple(nearest)], self.footage.plate)

    @cached_property
    def _beside_rocks(self) -> np.ndarray:
        """u8 [H,W,3], how much of the bed is drawn: 255 but for the ring around what stands in the fluid."""
        away = ndimage.distance_transform_edt(~self._stands)
        share = smoothstep(np.asarray(away, np.float32), 0.0, RING)
        return (255.0 * share + 0.5).astype(np.uint8)[..., None].repeat(3, 2)

    @cached_property
    def _filmed_around(self) -> np.ndarray:
        """bool [H,W], what stands in the fluid, and the ring around it."""
        near = ndimage.binary_dilation(self._stands, iterations=RING)
        return self._stands | (near & self._fluid_pixels)

    @cached_property
    def _fluid_pixels(self) -> np.ndarray:
        """bool [H,W], where the plate shows the clip's fluid or a guess in its place: a little more than the fluid,
        which leaves a rim in it, with what its masks have missed."""
        assert self.footage is not None
        sometimes = self.footage.labels.fluid.mean(axis=0) > SOMETIMES
        around = ndimage.binary_dilation(sometimes, iterations=RIM)
        return ndimage.binary_fill_holes(around | self._stands) & ~self._stands

    def _depth_of_rocks(self, camera: PinholeCamera) -> np.ndarray | None:
        """Camera depth (m) of the rocks that the plate shows, and of what stands before the fluid, 0 beside them; None
        where it shows none."""
        if self.footage is None:
            return None
        before, stands = self.footage.before, self._stands
        if not stands.any():
            return None
        if self._rock_depth is None or self._rock_depth[0] is not camera:

            def placed(pixels: np.ndarray) -> np.ndarray:
                picture = pixels[..., None].repeat(3, 2).astype(np.uint8) * 255
                return _placed(picture, self.scene.camera, camera, goes_on=False)[..., 0] > 0.5

            there = placed(stands)
            depth = terrain_depth(self.scene.terrain, camera, where=there)
            if before is not None:
                depth = np.where(placed(before), NEAR, depth)
            self._rock_depth = camera, np.where(there & np.isfinite(depth), depth, 0.0).astype(np.float32)
        return self._rock_depth[1]


def _without_rim(stands: np.ndarray) -> np.ndarray:
    """bool [h,w]: pixels of things without those that are mixed with the fluid beside them; those of what is so thin
    that nothing would be left stay."""
    core = ndimage.binary_erosion(stands, iterations=RIM + 1, border_value=1)
    parts, count = ndimage.label(stands)
    thick = np.zeros(count + 1, bool)
    thick[parts[core]] = True
    return np.where(thick[parts], core, stands)


def _sky(camera: PinholeCamera, pale_fluid: bool) -> np.ndarray:
    """sRGB [h,w,3] behind the terrain: pale, and dim behind a pale fluid that is seen through; darker towards the
    bottom."""
    width, height = camera.size
    ends = (0.32, 0.2) if pale_fluid else (0.93, 0.78)
    return np.linspace(*ends, height, dtype=np.float32)[:, None, None] * np.ones((1, width, 3), np.float32)


def _encoded(rgb: np.ndarray, alpha: np.ndarray, depth: np.ndarray) -> Drawn:
    """Of sRGB colours, premultiplied; linear light beside them, because compositing programs multiply linear values."""
    rgb = np.clip(rgb, 0.0, 1.0)
    straight = np.clip(rgb / np.maximum(alpha, 1e-4)[..., None], 0.0, 1.0)
    return Drawn((linear_from_srgb(straight) * alpha[..., None]).astype(np.float32), alpha, depth, rgb)


def _held_out(seen: Gaussians, ground: Gaussians, camera: PinholeCamera) -> tuple[np.ndarray, ...]:
    """What is seen of the fluid beside the ground: the ground hides, and is not drawn itself."""
    from fluidlift.look.project import view_colors

    both = concatenate([seen, ground])
    shown = (np.arange(len(both)) < len(seen)).astype(np.float32)[:, None]
    depth = camera.camera_from_world.points(both.means)[:, 2:]
    drawn = render(both, camera, features=shown * np.concatenate([view_colors(both, camera), shown, depth], axis=1))
    rgb, alpha, z = drawn.image[..., :3], drawn.image[..., 3], drawn.image[..., 4]
    return rgb, alpha, np.where(alpha > 1e-3, z / np.maximum(alpha, 1e-3), 0.0).astype(np.float32)


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
