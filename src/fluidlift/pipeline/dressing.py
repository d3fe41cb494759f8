"""What the splats of a simulated fluid look like in each frame.

Every particle carries a splat of the body at rest, deformed with it (paper: A = F A0 F^T). Over what lies, they are
under a skin whose pattern moves with the flow without being stirred into streaks (`look.texture_patches`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.types import Gaussians, Particles, concatenate, sh_from_rgb

if TYPE_CHECKING:
    from fluidlift.look.surface_map import SurfaceMap
    from fluidlift.look.texture_patches import TexturePatches
    from fluidlift.pipeline.scene import Scene

MAX_STRETCH = 3.0
"""longest axis over the mean one before a Gaussian starts again round: longer ones show as hair"""

MIXED = 0.42
"""standard deviation up to which splats close up with their neighbours, cells: that of a splat of the inside"""

LARGEST = 1.2
"""standard deviation of a splat at most, cells"""

PATCH = 0.12
"""radius of a patch of the skin, shares of the body's longer side in plan"""

FEWEST_CELLS = 4.0
"""radius of a patch at least, cells"""

UPRIGHT = 0.9
"""cosine between gravity and straight down from which the surface has one height at each place"""

COVERED = ((-0.6, -0.3), (0.6, 1.0))
"""cells from the surface between which the skin takes over from what is below, and spray from the skin"""

FAINT = 0.002
"""least opacity of a splat under the skin: not drawn, but there for other tools"""

TINTED = 1.5
"""cells about the surface within which particles wear the skin's colours"""

CLEAR = 0.1
"""cells from the ground within which the skin is left out"""

REACH = 0.5
"""standard deviation of a splat under the skin at most, shares of its distance from the ground and `CLEAR`: wider ones
would lie over the rocks beside them"""


Inside = Callable[[np.ndarray], np.ndarray]


class Dressed(NamedTuple):
    """One frame."""

    gaussians: Gaussians
    ids: np.ndarray
    velocities: np.ndarray
    """m/s"""


def lends_look(scene: Scene, own: Gaussians) -> np.ndarray:
    """Which of the body's own Gaussians show the fluid as such: in the picture, away from rocks and banks."""
    from fluidlift.look.inflow import surface_level
    from fluidlift.physics.inlet import clear_of_shore
    from fluidlift.shape.off_picture import in_picture

    level = surface_level(own.means, 0.5 * scene.terrain.grid.spacing)(own.means[:, :2])
    return in_picture(own.means, scene.camera) & clear_of_shore(own.means, level, scene.terrain)


class Dressing:
    """Splats for the particles of a scene, frame by frame from the first one on."""

    def __init__(self, scene: Scene) -> None:
        self._scene, self._cell = scene, scene.terrain.grid.spacing
        self._patches: TexturePatches | None = None
        self._surface: SurfaceMap | None = None
        gravity = np.asarray(scene.parameters.gravity, np.float64)
        upright = -gravity[2] > UPRIGHT * max(float(np.linalg.norm(gravity)), 1e-12)
        self._own = scene.rest.select(np.arange(len(scene.rest) - sum(map(len, scene.emitter_looks))))
        if scene.kind == "stream" and upright and len(self._own) and len(scene.body):
            self._lay_skin()

    def _lay_skin(self) -> None:
        from fluidlift.look.inflow import ENDS
        from fluidlift.look.seen_texture import SeenTexture
        from fluidlift.look.surface_map import SurfaceMap
        from fluidlift.look.texture_patches import TexturePatches

        scene, own = self._scene, self._own
        surface = SurfaceMap.of(scene.body.positions, scene.body.velocities, self._cell)
        along = own.means @ scene.terrain.mainstream
        share = (along - along.min()) / max(float(np.ptp(along)), 1e-12)
        usable = lends_look(scene, own) & (share > ENDS[0]) & (share < ENDS[1])
        texture = SeenTexture(own, scene.camera, surface, shading=scene.shading, usable=usable)
        if not texture.usable:
            return
        across = float(np.ptp(own.means[:, :2], axis=0).max())
        self._patches = TexturePatches(texture, max(PATCH * across, FEWEST_CELLS * self._cell))
        self._begin_again()

    def _begin_again(self) -> None:
        from fluidlift.look.surface_skin import SurfaceSkin
        from fluidlift.look.texture_patches import Patches

        assert self._patches is not None
        self._patches.state, self._skin = Patches.none(), SurfaceSkin(self._cell)

    def advance(self, particles: Particles, number: int) -> None:
        """Bring what floats on the surface to a frame; every frame after the last one, in order."""
        from fluidlift.look.surface_map import SurfaceMap

        if self._patches is None or not len(particles):
            return
        if number == 0:
            self._begin_again()
        rng = np.random.default_rng([self._scene.seed, number])
        interval = self._scene.interval if number else 0.0
        self._surface = SurfaceMap.of(particles.positions, particles.velocities, self._cell)
        self._patches.advance(self._surface, interval, rng)
        self._skin.advance(self._surface, interval, rng)

    def dressed(self, particles: Particles, number: int, inside: Inside | None = None) -> Dressed:
        """The splats of a frame to which `advance` has come. Ids of particles are even, those of the skin odd.

        Args:
            particles: of the frame.
            number: of the frame, from 0.
            inside: (points [n,3]) -> whether they are in an obstacle, where there is no skin; None: no obstacles.
        """
        from fluidlift.look.mixing import mixed
        from fluidlift.physics.deform import deform_gaussians

        scene = self._scene
        shown = deform_gaussians(scene.rest, particles, max_stretch=MAX_STRETCH, max_size=LARGEST * self._cell)
        if number:  # at rest nothing is drawn out
            shown = mixed(shown, particles.deformation, widest=MIXED * self._cell)
        shown = self._shaded(shown, particles.source)
        if not number or self._patches is None or self._surface is None or not len(particles):
            return Dressed(shown, 2 * particles.ids, particles.velocities)
        return self._with_skin(shown, particles, self._surface, self._patches, inside)

    def _shaded(self, shown: Gaussians, source: np.ndarray) -> Gaussians:
        """The splats with the shade of the places where they are now; those with a colour of their own keep it."""
        scene = self._scene
        if scene.shading is None:
            return shown
        painted = (scene.rest.means if scene.painted is None else scene.painted)[source]
        own = ~np.isfinite(painted).all(axis=1)
        moved = scene.shading.moved(shown, np.where(own[:, None], shown.means, painted))
        return moved if not own.any() else replace(moved, sh=np.where(own[:, None, None], shown.sh, moved.sh))

    def _with_skin(
        self,
        shown: Gaussians,
        particles: Particles,
        surface: SurfaceMap,
        patches: TexturePatches,
        inside: Inside | None,
    ) -> Dressed:
        from fluidlift.look.smoothstep import smoothstep
        from fluidlift.look.surface_skin import dyed

        skin, xy = self._skin, particles.positions[:, :2]
        above = (particles.positions[:, 2] - surface.at(surface.height, xy)) / self._cell
        below, spray = COVERED
        covered = smoothstep(above, *below) * (1 - smoothstep(above, *spray)) * (surface.presence(xy) > 0.5)
        room = REACH * np.maximum(self._clearance(shown.means) + CLEAR * self._cell, CLEAR * self._cell)
        scales = np.minimum(shown.scales, room[:, None]).astype(np.float32)
        opacities = np.minimum(shown.opacities, np.maximum(shown.opacities * (1 - covered), FAINT)).astype(np.float32)
        sh, own = shown.sh.copy(), self._own_colors(particles.source)
        near = np.flatnonzero((np.abs(above) < TINTED) & (covered < 1) & ~own)
        color, there = patches.colors(particles.positions[near])
        sh[near[there], :1] = sh_from_rgb(color[there])
        points = skin.points(surface)
        color, there = patches.colors(points)
        color = dyed(color, points, surface, shown, own, self._cell)
        there &= self._clearance(points) > CLEAR * self._cell
        if inside is not None:
            there &= ~inside(points)
        tracers = skin.splats(surface, color).select(there)
        speeds = surface.at(surface.velocity, skin.places[there]).astype(np.float32)
        return Dressed(
            concatenate([replace(shown, scales=scales, opacities=opacities, sh=sh), tracers]),
            np.concatenate([2 * particles.ids, 2 * skin.ids[there] + 1]),
            np.concatenate([particles.velocities, speeds]),
        )

    def _own_colors(self, source: np.ndarray) -> np.ndarray:
        """Which particles bring a colour of their own, as dye does."""
        painted = self._scene.painted
        return np.zeros(len(source), bool) if painted is None else ~np.isfinite(painted[source]).all(axis=1)

    def _clearance(self, points: np.ndarray) -> np.ndarray:
        """How far points are from the ground, m; negative inside it."""
        from fluidlift.numerics.sampling import sample_nodes

        terrain = self._scene.terrain
        return sample_nodes(terrain.signed_distance, terrain.grid, points)

    def state(self) -> dict[str, np.ndarray]:
        """What changes from frame to frame, as plain arrays."""
        if self._patches is None:
            return {}
        patches = {f"patches.{name}": np.array(value) for name, value in vars(self._patches.state).items()}
        skin = {"skin.places": self._skin.places.copy(), "skin.ids": self._skin.ids.copy()}
        return patches | skin | {"skin.next_id": np.int64(self._skin.next_id)}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Go to a state of `state`.

        Raises:
            InputRejected: something is missing, of the wrong shape or not finite; nothing has changed then.
        """
        from fluidlift.look.texture_patches import Patches

        if self._patches is None:
            return
        try:
            parts = {n.removeprefix("patches."): np.array(a) for n, a in state.items() if n.startswith("patches.")}
            patches, places = Patches(**parts), np.array(state["skin.places"], np.float64)
            ids, next_id = np.array(state["skin.ids"], np.int64), int(state["skin.next_id"])
        except (KeyError, TypeError, ValueError) as error:
            raise InputRejected(f"the state of a surface that does not fit: {error}") from None
        n = len(patches.turns)
        shapes = [(patches.centers, (n, 2)), (patches.sources, (n, 2)), (places, (len(ids), 2))]
        shapes += [(a, (n,)) for a in (patches.turns, patches.strains, patches.presences)]
        for array, shape in shapes:
            if array.shape != shape or not np.isfinite(array).all():
                raise InputRejected("the state of a surface with arrays of another shape, or not finite", "a whole one")
        self._patches.state = patches
        self._skin.places, self._skin.ids, self._skin.next_id = places, ids, next_id
