"""The fluid as the clip's camera sees it: before the clip without its fluid, behind its rocks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from fluidlift.numerics.short_axis import every
from fluidlift.scene.build import Scene
from fluidlift.scene.footage import Footage
from fluidlift.types import CellType, Gaussians, PinholeCamera, concatenate, kind_of
from fluidlift.types.rows import rows

if TYPE_CHECKING:
    from fluidlift.look.outlet_section import OpenEnd
    from fluidlift.look.rasterize import Rendered
    from fluidlift.look.stream_slab import Slab
    from fluidlift.look.surface_foam import FilmedWhite

BEHIND = (1.5, 0.5)
"""cells behind the terrain from which fluid is hidden: at rocks, whose shape is a guess, and where it is always dry"""
COVERED = 0.3
"""opacity from which a pixel has a motion"""
FARTHEST = 1e3
"""px per frame that a splat moves at most: more is beyond any picture, and one of them would outshine all others"""


def before_ground(scene: Scene, footage: Footage | None) -> Callable[[Gaussians], np.ndarray] | None:
    """Which splats are not hidden by the ground that the clip's picture shows; None where it hides nothing.

    The picture is drawn as one plate behind the fluid: without this, fluid would be seen through a near bank.
    """
    from fluidlift.look.scenery import terrain_depth, visible_beside_rocks

    if footage is None:
        return None
    rocks, before = footage.rocks, footage.before
    ground = rocks | ~footage.labels.fluid.any(axis=0) if kind_of(scene.kind).lies_on_ground else rocks
    if not ground.any():
        return None
    guessed = rocks & (not scene.terrain.opaque)  # a vessel's wall is where its rim says
    margin = scene.terrain.grid.spacing * np.where(guessed, *BEHIND)
    depth = terrain_depth(scene.terrain, scene.camera)
    if before is not None:
        depth = np.where(before, -np.inf, depth)
    return lambda g: visible_beside_rocks(g.means, scene.camera, depth, ground, margin=margin)


@dataclass(frozen=True)
class FrontView:
    """Splats as the clip's camera sees them: before the clip without its fluid, behind its rocks."""

    camera: PinholeCamera
    plate: np.ndarray
    """[H,W,3] sRGB in [0, 1]"""
    rocks: np.ndarray
    """bool [H,W]"""
    seen_of: Callable[[Gaussians], np.ndarray] | None
    """whether the ground of the clip hides a splat; None where it hides none"""

    @staticmethod
    def of(scene: Scene, footage: Footage | None) -> FrontView:
        """Of a scene; before grey where its clip is not at hand, or shows a ground that was edited."""
        size, shown = scene.camera.size[::-1], None if scene.reshaped else footage
        plate, rocks = np.full((*size, 3), 0.5, np.float32), np.zeros(size, bool)
        if shown is not None:  # the clip shows the ground as it was
            plate, rocks = shown.plate.astype(np.float32) / 255.0, shown.rocks
        return FrontView(scene.camera, plate, rocks, before_ground(scene, shown))

    def drawn(
        self,
        gaussians: Gaussians,
        velocity: np.ndarray,
        solids: Sequence[Gaussians] = (),
        *,
        camera: PinholeCamera | None = None,
        plate: np.ndarray | None = None,
    ) -> tuple[Rendered, Gaussians, np.ndarray]:
        """The picture with its coverage, and the splats that the ground leaves over, with their velocities (m/s).

        Args:
            gaussians: of the fluid.
            velocity: [n,3], m/s.
            solids: of the obstacles.
            camera: another in the same place; None: the clip's own.
            plate: as that one sees it, sRGB in [0, 1].
        """
        from fluidlift.look.rasterize import render

        gaussians, velocity = self._seen(gaussians, velocity)
        behind = self.plate if plate is None else plate
        picture = render(concatenate([gaussians, *solids]), camera or self.camera, background=behind)
        return picture, gaussians, velocity

    def measured(
        self, gaussians: Gaussians, velocity: np.ndarray, solids: Sequence[Gaussians], interval: float
    ) -> tuple[Rendered, np.ndarray]:
        """The picture with its coverage, and its motion, float32 [H,W,2] px per frame, NaN where it shows no fluid.

        Colours and motion of a splat are composited together: what costs most is to find which splats a pixel sees.

        Args:
            gaussians: of the fluid.
            velocity: [n,3], m/s.
            solids: of the obstacles; they are taken to rest.
            interval: s between frames.
        """
        from fluidlift.look.project import view_colors
        from fluidlift.look.rasterize import render
        from fluidlift.numerics.splatting_projection import ALPHA_MIN

        # of smoke most splats are not drawn: what they would show is not worked out
        drawn = gaussians.opacities > ALPHA_MIN
        if not drawn.all():
            gaussians, velocity = gaussians.select(drawn), rows(velocity, drawn)
        gaussians, velocity = self._seen(gaussians, velocity)
        shown = concatenate([gaussians, *solids])
        before, z0 = self.camera.project(gaussians.means)
        after, z1 = self.camera.project(gaussians.means + velocity * interval)
        ahead = (z0 > 0) & (z1 > 0) & every(np.isfinite(velocity))
        move = np.zeros((len(shown), 2), np.float32)
        move[: len(gaussians)] = np.where(ahead[:, None], np.clip(after - before, -FARTHEST, FARTHEST), 0.0)
        features = np.concatenate([view_colors(shown, self.camera), move], axis=1)
        behind = np.concatenate([self.plate, np.zeros_like(self.plate[..., :2])], axis=-1)
        picture = render(shown, self.camera, background=behind, features=features)
        alpha = picture.alpha[..., None]
        motion = np.where(alpha > COVERED, picture.image[..., 3:] / np.maximum(alpha, COVERED), np.nan)
        return replace(picture, image=np.ascontiguousarray(picture.image[..., :3])), motion.astype(np.float32)

    def _seen(self, gaussians: Gaussians, velocity: np.ndarray) -> tuple[Gaussians, np.ndarray]:
        """What the ground leaves over of splats and their velocities."""
        if self.seen_of is None:
            return gaussians, velocity
        keep = self.seen_of(gaussians)
        return gaussians.select(keep), rows(velocity, keep)


def open_end(scene: Scene) -> OpenEnd | None:
    """Where a stream is cut in pictures; None of other kinds."""
    from fluidlift.look.outlet_section import OpenEnd

    if not kind_of(scene.kind).is_channel_flow:
        return None
    return OpenEnd.of(scene.cell_types, scene.terrain.grid, scene.terrain.mainstream)


def slab_of(scene: Scene) -> Slab:
    """Where a stream and its ground are cut in looks (other kinds are not), and how high its fluid stands."""
    from fluidlift.look.outlet_section import OpenEnd
    from fluidlift.look.stream_slab import Slab

    ends = [open_end(scene)]
    if kind_of(scene.kind).is_channel_flow:
        grid, along = scene.terrain.grid, scene.terrain.mainstream
        ends.append(OpenEnd.of(scene.cell_types, grid, along, kind=CellType.INFLOW))
    return Slab(tuple(end for end in ends if end is not None), scene.rest.means)


def white_of(scene: Scene) -> FilmedWhite:
    """By what foam is told in the colours of a scene's fluid."""
    from fluidlift.look.surface_foam import FilmedWhite

    return FilmedWhite.of(scene.camera, scene.rest.rgb)


def to_bytes(image: np.ndarray) -> np.ndarray:
    """u8 sRGB of sRGB in [0, 1]."""
    return (np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
