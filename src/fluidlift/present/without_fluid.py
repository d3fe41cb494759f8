"""What a frame shows without its fluid: beside it, and through it.

Seen through a liquid are things that one does not see beside it: the bed behind a rock, and what goes on behind the end
of a stream. Before a clip's plate the ground is drawn where the clip shows its own fluid, and nobody has filmed it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from scipy import ndimage

from fluidlift.look.environment import Environment
from fluidlift.look.ground_picture import GRAY, GroundLight, GroundMeshes, place_of
from fluidlift.look.inflow import surface_level
from fluidlift.look.liquid import Behind
from fluidlift.look.materials import Material
from fluidlift.look.stream_slab import Slab
from fluidlift.numerics.srgb import linear_from_srgb
from fluidlift.present.bed import Beds, beds_of
from fluidlift.types import Grid, PinholeCamera, TriangleMesh

ALIKE = 1e-3
"""share of the depth within which two pictures show the same thing"""
STEP = 8
"""px between those in which it is found how much darker ground is under liquid: that changes slowly"""
NEAR = 0.02
"""of the picture's longer side: standard deviation of the weights of what is around"""
FLOOR = 3.0
"""of the size of a block of ground: half the width of the floor on which it throws a shadow"""
WHITE = Environment.white()
"""the light on ground that is drawn on a clip's plate"""
SQUARE = ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))
MET = 0.5
"""cells below the water: what a ray meets there is still a part of a rock that stands out of it"""


@dataclass(frozen=True)
class Backdrop:
    """What is behind the fluid."""

    picture: np.ndarray | None = None
    """[h,w,3] linear, which shows the ground as well; None: the terrain before the environment"""
    depth: np.ndarray | None = None
    """[h,w] camera z (m) at which the picture hides the fluid, 0 where it does not; None: nowhere"""
    coarse: float = 1.0
    """px of the picture that were one px of the clip"""
    fluid: np.ndarray | None = None
    """[h,w] 0 to 1, where the picture shows the clip's own fluid, or a guess in its place: the ground is drawn there.
    None: the picture stays as it is"""
    drawn: np.ndarray | None = None
    """[h,w] 0 to 1, how much of the ground is drawn there: beside what stands in the fluid the picture goes on as that.
    None: all of it"""
    cut_out: bool = False
    """the terrain hides the fluid and the obstacles, and is not drawn itself"""


@dataclass(frozen=True)
class Shade:
    """What moves and takes light from the ground."""

    caster: TriangleMesh | None = None
    """the liquid's surface"""
    material: Material | None = None
    """of it; None: no light passes"""
    bodies: Sequence[TriangleMesh] = ()
    """obstacles"""
    inset: float = 0.0
    """m that the caster stands outside of the liquid that it is made of"""


class GroundPictures:
    """The ground of an asset as pictures show it. What stays from frame to frame is kept.

    Args:
        whole: the ground.
        grid: of the terrain.
        slab: where a stream is cut.
        environment: the light.
        lit: how finely its shadows are drawn.
    """

    def __init__(
        self, whole: TriangleMesh, grid: Grid, slab: Slab, environment: Environment, lit: GroundLight | None = None
    ) -> None:
        self._lit = lit or GroundLight()
        self._grid, self._slab, self._environment, self._whole = grid, slab, environment, whole
        self.solid = slab.cut(whole, grid)
        self._farther: tuple[tuple[bool, ...], GroundMeshes] | None = None
        self._plate: tuple[Backdrop, tuple, tuple[Behind, Behind]] | None = None

    @cached_property
    def ground(self) -> GroundMeshes:
        """As it is."""
        return GroundMeshes([self.solid], self._environment, self._lit)

    def light_on_floor(self, camera: PinholeCamera) -> np.ndarray:
        """Share [h,w,3] of the light that the ground leaves the floor that it stands on, 1 beside it."""
        points = np.asarray(self.solid.vertices, np.float64)
        shape = (*camera.size[::-1], 3)
        if not len(self.solid.faces) or camera.position[2] <= points[:, 2].min():
            return np.ones(shape, np.float32)
        low, high = points.min(axis=0), points.max(axis=0)
        middle, reach = 0.5 * (low + high), FLOOR * float(np.linalg.norm(high - low))
        corners = [(middle[0] + x * reach, middle[1] + y * reach, low[2]) for x, y in SQUARE]
        floor = TriangleMesh(np.array(corners), np.array([[0, 1, 2], [0, 2, 3]]))
        empty = Behind(np.zeros(shape, np.float32), np.zeros(shape[:2], np.float32))
        left = GroundMeshes([floor], self._environment, self._lit, casters=self.ground.casters).picture(camera, empty)
        in_the_open = linear_from_srgb(np.array(GRAY)) * self._environment.irradiance(np.array([0.0, 0.0, 1.0]))
        share = np.clip(left.image / np.maximum(in_the_open, 1e-6), 0.0, 1.0)
        return np.where((left.depth > 0)[..., None], share, 1.0).astype(np.float32)

    @cached_property
    def _beds(self) -> Beds:
        found = beds_of(self._slab, self._whole, self._grid)
        if found is None:
            return Beds(self.solid, self.solid, self.solid)
        return Beds(*(self._slab.cut(mesh, self._grid) for mesh in (found.cut, found.sunk, found.level)))

    @cached_property
    def bed(self) -> GroundMeshes:
        """Where a clip's plate shows fluid: no rock stands out of it, since the plate shows the rocks. It goes on
        beyond the ends. Its light is that of a white sky: under the clip's own the plate has its colours."""
        low = self._slab.carried_on(self._beds.sunk)
        return GroundMeshes([low], WHITE, self._lit, casters=self._level.casters)

    @cached_property
    def _around(self) -> GroundMeshes:
        """Where a clip's plate shows dry ground."""
        return GroundMeshes([self._slab.carried_on(self.solid)], WHITE, self._lit)

    def through(
        self, camera: PinholeCamera, beside: Behind, far: np.ndarray, shade: Shade
    ) -> tuple[Behind, GroundMeshes]:
        """Before the terrain: what is seen through the liquid, and the ground of that picture.

        Args:
            camera: who looks.
            beside: what is seen beside it.
            far: [h,w,3] linear, behind everything.
            shade: what moves.
        """
        inside = tuple(bool(end.before(camera.position[None])[0]) for end in self._slab.ends)
        if self._beds.level is self.solid and not any(inside):
            return beside, self.ground
        if self._farther is None or self._farther[0] != inside:
            seen = replace(self._slab, ends=tuple(e for e, i in zip(self._slab.ends, inside, strict=True) if i))
            mesh = seen.carried_on(self._beds.level)
            self._farther = inside, GroundMeshes([mesh], self._environment, self._lit, casters=self.ground.casters)
        low, s = self._farther[1], shade
        empty = Behind(far, np.zeros(far.shape[:2], np.float32))
        found = low.picture(camera, empty, s.caster, material=s.material, bodies=s.bodies, inset=s.inset)
        # only where something stands before the liquid, or nothing behind it: all else is seen beside it as through it
        there = (beside.depth <= 0) | (self._cut.depth(camera) > beside.depth * (1.0 + ALIKE))
        direct = beside.direct
        if direct is not None and found.direct is not None:
            direct = np.where(there[..., None], found.direct, direct)
        image = np.where(there[..., None], found.image, beside.image)
        return replace(
            beside, image=image, depth=np.where(there, found.depth, beside.depth), direct=direct
        ), self.ground

    @cached_property
    def _cut(self) -> GroundMeshes:
        return GroundMeshes([self._beds.cut], self._environment, self._lit)

    def on_plate(
        self, camera: PinholeCamera, backdrop: Backdrop, bodies: Sequence[TriangleMesh] = ()
    ) -> tuple[Behind, Behind]:
        """A clip's plate with the ground in place of its fluid: what is seen beside the liquid, and through it.

        Level ground in the open has the colours of its texture, as the plate has it. A wall keeps the plate's guess: a
        map from above has few texels on it.

        Args:
            camera: who looks.
            backdrop: with a picture, and where it shows fluid.
            bodies: obstacles.
        """
        assert backdrop.picture is not None and backdrop.fluid is not None
        if self._plate is not None and self._plate[0] is backdrop and self._plate[1] == place_of(camera) and not bodies:
            return self._plate[2]
        plate, fluid = backdrop.picture, backdrop.fluid
        empty = Behind(plate, np.zeros(plate.shape[:2], np.float32))
        lit = self.bed.picture(camera, empty, bodies=bodies)
        lies = ((lit.depth > 0) * self.bed.lying(camera)).astype(np.float32)
        rocks = np.zeros(plate.shape[:2], np.float32) if backdrop.depth is None else backdrop.depth
        hole = np.maximum(fluid, rocks > 0)
        drawn = fluid if backdrop.drawn is None else fluid * backdrop.drawn
        wet = lit.depth > 0
        dry = np.where(hole > 0.5, self._around.depth(camera), self._dry(camera))
        found = []
        for share, depth in (
            (drawn, np.where(rocks > 0, rocks, np.where((fluid > 0.5) & wet, lit.depth, dry))),
            (hole, self._cleared(camera, np.where((hole > 0.5) & wet, lit.depth, dry), rocks > 0)),
        ):
            image = plate + (share * lies)[..., None] * (lit.image - plate)
            found.append(Behind(image, depth, goes_on=True, coarse=backdrop.coarse))
        self._plate = backdrop, place_of(camera), (found[0], found[1])
        return found[0], found[1]

    def _dry(self, camera: PinholeCamera) -> np.ndarray:
        """Camera z (m) of ground that the plate shows: what is modelled of it, and no farther than the ends.

        Beyond them liquid goes on as a mirror image, which knows no bend of the river and no far shore: where the clip
        is dry it is hidden.
        """
        depth = self._around.depth(camera)
        rays = camera.rays(camera.pixel_grid())
        for end in self._slab.ends:
            left = end.at - float(camera.position @ end.along)
            if left > 0:
                ahead = rays @ end.along
                beyond = np.where(ahead > 1e-9, left / np.maximum(ahead, 1e-9), 0.0).astype(np.float32)
                depth = np.where((beyond > 0) & ((depth <= 0) | (depth > beyond)), beyond, depth)
        return depth

    def _cleared(self, camera: PinholeCamera, depth: np.ndarray, hidden: np.ndarray) -> np.ndarray:
        """Camera z with that of the bed where something hides the liquid: light that is bent beside a rock comes from
        behind it, and its stump is in the way of none."""
        if not hidden.any():
            return depth
        width, height = camera.size
        if width % 2 or height % 2:
            bed = self._level.depth(camera)
        else:  # the bed is smooth, and this a half of the time
            bed = self._level.depth(camera.resized((width // 2, height // 2))).repeat(2, axis=0).repeat(2, axis=1)
        return np.where(hidden & (bed > 0) & (depth > 0), bed, depth)

    @cached_property
    def _level(self) -> GroundMeshes:
        return GroundMeshes([self._slab.carried_on(self._beds.level)], WHITE, self._lit)

    def depth_of_rocks(self, camera: PinholeCamera, depth: np.ndarray) -> np.ndarray:
        """Camera z (m) of what a clip's plate shows in its fluid, 0 beside it. A ray that misses the model of a rock
        has the depth of the nearest that meets it."""
        there, still = depth > 0, self._slab.still
        if still is None or not len(still) or not there.any():
            return depth
        points = camera.unproject(camera.pixel_grid()[there], depth[there])
        level = surface_level(still, self._grid.spacing)(points[:, :2])
        met = np.zeros(depth.shape, bool)
        met[there] = points[:, 2] > level - MET * self._grid.spacing
        if not met.any():
            return depth
        nearest = ndimage.distance_transform_edt(~met, return_distances=False, return_indices=True)
        return np.where(there, depth[tuple(nearest)], 0.0).astype(np.float32)


def _hidden(through: Behind, beside: Behind) -> np.ndarray:
    """bool [h,w], where what is seen beside a liquid hides what is seen through it."""
    return (beside.depth > 0) & (through.depth > beside.depth * (1.0 + ALIKE))


def wet_behind(dry: Behind, wet: Behind, beside: Behind) -> Behind:
    """The picture through a liquid, wet also behind what hides the liquid, where nobody knows how deep it is: as much
    darker as around there.

    Args:
        dry, wet: the picture before and after it was made wet under the liquid that is seen.
        beside: what is seen beside it, and hides it.
    """
    hidden = _hidden(dry, beside)
    if not hidden.any():
        return wet
    few = (slice(STEP // 2, None, STEP),) * 2
    before, after = dry.image[few], wet.image[few]
    under = ((after != before).any(axis=-1) & ~hidden[few]).astype(np.float32)
    sigma = NEAR * max(hidden.shape) / STEP
    weight = cv2.GaussianBlur(under, (0, 0), sigma)
    sums = [cv2.GaussianBlur(under[..., None] * part, (0, 0), sigma) for part in (before, after)]
    share = np.where(weight[..., None] > 1e-3, sums[1] / np.maximum(sums[0], 1e-6), 1.0)
    share = cv2.resize(share.astype(np.float32), hidden.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return replace(wet, image=np.where(hidden[..., None], wet.image * share, wet.image))
