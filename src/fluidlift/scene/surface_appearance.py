"""What the splats of a simulated fluid look like in each frame.

Every particle carries a splat of the body at rest, deformed with it (paper: A = F A0 F^T). Over what lies, they are
under a skin whose pattern moves with the flow without being stirred into streaks (`look.texture_patches`).
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.messages import Notice
from fluidlift.scene.simulator import lends_look
from fluidlift.scene.surface_film import FINE, LATER, first_end, surface_film
from fluidlift.types import Gaussians, Particles, concatenate, kind_of, sh_from_rgb
from fluidlift.types.rows import rows

if TYPE_CHECKING:
    from fluidlift.look.filmed_outline import FilmedOutline, FilmedOutlines
    from fluidlift.look.footage import FluidFootage
    from fluidlift.look.seen_texture import SeenTexture
    from fluidlift.look.surface_axes import SurfaceAxes
    from fluidlift.look.surface_map import SurfaceMap
    from fluidlift.look.texture_patches import TexturePatches
    from fluidlift.scene.build import Scene
    from fluidlift.scene.smoke_appearance import SmokeAppearance
    from fluidlift.scene.whitewater import SceneWhitewater

MAX_STRETCH = 3.0
"""longest axis over the mean one before a Gaussian starts again round: longer ones show as hair"""

MIXED = 0.42
"""standard deviation up to which splats close up with their neighbours, cells: that of a splat of the inside"""

LARGEST = 1.2
"""standard deviation of a splat at most, cells"""

DROP = 0.25
"""the same of spray, in the air by itself: half of the spacing of particles. One that was drawn out before it came
loose showed as a disc of five cells"""

PATCH = 0.12
"""radius of a patch of the skin, shares of the body's longer side in plan"""

AT_HOME = 0.6
"""the same where patches stay, since they show what was filmed in their own place: nothing shears them, and where two
meet, the motion of the film breaks off. Of 0.12, 0.3 and 0.6 a fall's current is off by 0.65, 0.46 and 0.44 (after its
clip 0.64, 0.50 and 0.35)"""

FEWEST_CELLS = 4.0
"""radius of a patch at least, cells"""

UPRIGHT = 0.9
"""cosine between gravity and straight down above which the surface is a height field"""

COVERED = ((-0.6, -0.3), (0.6, 1.0))
"""cells from the surface (negative: below) over which particles' splats fade out under the skin, and fade in above it,
where they are spray"""

LONELY = 0.3
"""a place with a smaller share of surface around it is spray; at a straight shore that share is a half"""

FAINT = 0.002
"""least opacity of a splat under the skin: not drawn, but there for other tools"""

TINTED = 1.5
"""cells about the surface within which particles wear the skin's colours; before a surface that is a map over the
picture, all do"""

BEHIND_WALL = 0.5
"""cells behind the wall of a vessel from which something is hidden by it: half of the step of a wall of cells"""

CLEAR = 0.1
"""cells from the ground within which the skin is left out"""

SMALLEST = 0.02
"""standard deviation of a splat at least, cells: files hold its logarithm"""

CALM = 1.0
"""cells of deviation up to which unedited standing water is shown level: particles come to rest unevenly, by half a
cell, and sink by as much. From a low angle such a swell would hide lengths of water behind it; the film, with its
waves, is laid on a plane"""

REACH = 0.5
"""standard deviation of a splat under the skin at most, shares of its distance from the ground and `CLEAR`: wider ones
would lie over the rocks beside them"""


Inside = Callable[[np.ndarray], np.ndarray]


class Deform(Protocol):
    """`physics.deform.deform_gaussians`, or whoever does its work (`physics.stepping.ParticleSimulator.deformed`)."""

    def __call__(self, rest: Gaussians, particles: Particles, *, max_stretch: float, max_size: float) -> Gaussians:
        """See there."""
        ...


class Dressed(NamedTuple):
    """One frame."""

    gaussians: Gaussians
    ids: np.ndarray
    velocities: np.ndarray
    """m/s"""


class UnderSkin(NamedTuple):
    """How particles lie to the skin of a frame, each [n]."""

    places: np.ndarray
    """[n,3], on the axes of the surface, m"""
    above: np.ndarray
    """cells over the skin; negative: below it"""
    loose: np.ndarray
    """how far they are spray, 0 to 1"""
    covered: np.ndarray
    """share of which the skin hides them: of 1 nobody sees them"""
    hidden: np.ndarray
    """whether the wall of a vessel does"""
    filmed: np.ndarray | None
    """m to the outline of the film; None: there is none"""


def levelled(surface: SurfaceMap, level: float, within: float) -> SurfaceMap:
    """The map with what is within a distance of a level (both m) on it, and what is further off nearer by that."""
    away = surface.height - level
    return replace(surface, height=level + np.sign(away) * np.maximum(np.abs(away) - within, 0.0))


def _round(rest: Gaussians, particles: Particles) -> Gaussians:
    """The splats of particles without a turn, as wide and as dense as at rest."""
    turns, source = np.zeros((len(particles), 4), np.float32), particles.source
    turns[:, 0] = 1.0
    return Gaussians(particles.positions, turns, rest.scales[source], rest.opacities[source], rest.sh[source])


class SurfaceAppearance:
    """Splats for the particles of a scene, frame by frame from the first one on.

    Args:
        scene: that is simulated.
        whitewater: that is shown beside them; None: none is.
    """

    def __init__(self, scene: Scene, whitewater: SceneWhitewater | None = None) -> None:
        self._whitewater = whitewater
        self._scene, self._cell = scene, scene.terrain.grid.spacing
        self._camera = scene.camera
        self._missing: tuple[Notice, ...] = ()
        self._patches: TexturePatches | None = None
        self._surface: SurfaceMap | None = None
        self._axes: SurfaceAxes
        self._outline: FilmedOutline | None = None
        self._outlines: FilmedOutlines | None = None
        self._sways = False
        """whether it lies within all that its film ever shows, and covers of that what its patches show just then"""
        self._pace = 1.0
        """frames of the film per frame of the scene"""
        self._level: float | None = None
        self._plays, self._fine = False, FINE
        self._wall: np.ndarray | None = None
        """[h,w], camera depth (m) of a vessel's wall that hides what it holds; None: nothing is hidden so"""
        self._tracers = 0
        self._smoke: SmokeAppearance | None = None
        self._own = scene.rest.select(np.arange(len(scene.rest) - sum(map(len, scene.emitter_looks))))
        if not (scene.skin and len(self._own) and len(scene.body)):
            return
        if kind_of(scene.kind).is_gas:
            self._smoke = self._smoke_of()
        else:
            self._lay_skin()

    @property
    def splats(self) -> int:
        """Of the first frame: those of the body and of the skin over it."""
        return len(self._scene.body) + self._tracers

    @property
    def draws_out(self) -> bool:
        """Whether splats are drawn out as their particles are; smoke that has its film is drawn round."""
        return self._smoke is None

    @property
    def warnings(self) -> tuple[Notice, ...]:
        """What is missing for the usual look, in words."""
        return self._missing + (() if self._whitewater is None else self._whitewater.warnings)

    def _lay_skin(self) -> None:
        from fluidlift.look.apparent_shift import apparent_shift
        from fluidlift.look.filmed_outline import FilmedOutline, FilmedOutlines
        from fluidlift.look.picture_texture import PictureTexture
        from fluidlift.look.surface_axes import PictureAxes, PlanAxes
        from fluidlift.look.surface_skin import SurfaceSkin
        from fluidlift.look.texture_patches import TexturePatches

        scene, own = self._scene, self._own
        gravity = np.asarray(scene.parameters.gravity, np.float64)
        upright = -gravity[2] > UPRIGHT * max(float(np.linalg.norm(gravity)), 1e-12)
        kind = kind_of(scene.kind)
        level = kind.is_level_throughout and upright
        footage, stands = self._film_of(own, level=level), kind.is_still_water
        if level:
            self._axes = PlanAxes()
        elif footage is not None:
            self._axes = PictureAxes(self._camera, float(np.median(self._camera.project(own.means)[1])))
        else:
            return
        surface = self._surface_of(scene.body)
        if surface is None:
            return
        if isinstance(self._axes, PlanAxes):
            texture = self._seen_texture(surface, footage)
        else:
            assert footage is not None
            texture = PictureTexture(self._axes, surface, footage)
        if not texture.usable:
            return
        places = self._axes.points(own.means)
        across = float(np.ptp(places[self._axes.shown(places), :2], axis=0).max(initial=0.0))
        radius = AT_HOME if footage is not None and not scene.edited else PATCH
        # a jet is one thing: pieces of it from different instants do not fit together where it sways
        pours = (kind.rises_from_pool or not kind.lies_on_ground) and not scene.edited
        grows = pours and footage is not None and footage.grows and scene.outline_goes_on
        self._patches = TexturePatches(
            texture, max(radius * across, FEWEST_CELLS * self._cell), footage=footage,
            edited=scene.edited and not stands, start=scene.film_start, together=stands or pours,
            again=LATER * len(footage) if grows and footage is not None else 0.0,
            first_end=first_end(scene),
        )  # fmt: skip
        if footage is not None and stands and not scene.edited:
            self._level = float(np.median(surface.height[surface.wet]))
        if footage is not None and not scene.edited:
            if not (pours or stands):
                self._outline, self._sways = FilmedOutline(self._camera, footage.outside, self._cell), True
            else:
                self._outlines = FilmedOutlines(self._camera, footage, self._cell, rises=grows)
                self._outline = self._outlines.at(scene.film_start)
                self._pace = scene.interval / footage.interval
        self._plays = footage is not None
        if self._plays:
            self._surface = surface
        skin = SurfaceSkin(self._cell, self._level_at if self._plays else None)
        skin.advance(surface, 0.0, np.random.default_rng(scene.seed))
        self._tracers = len(skin)
        if self._plays:
            bare = skin.splats(surface, np.zeros((len(skin), 3)))
            texture.shift = apparent_shift(self._axes.world_splats(bare), self._camera)
        self._begin_again()

    def _smoke_of(self) -> SmokeAppearance | None:
        """How thin the smoke is; None without its film, which is a warning where there should be one."""
        from fluidlift.scene.smoke_appearance import SmokeAppearance, smoke_film

        if self._scene.film is None:
            return None
        found = smoke_film(self._scene.film, self._camera.size)
        if isinstance(found, str):
            self._missing = (Notice("film-not-played", f"the film of the smoke {found}"),)
            return None
        return SmokeAppearance(self._scene, found)

    def _film_of(self, own: Gaussians, *, level: bool) -> FluidFootage | None:
        """The film that the surface plays, whose size the camera has from here on; one that cannot be is a warning."""
        from fluidlift.look.scenery import terrain_depth

        scene = self._scene
        if scene.film is None:
            return None
        found = surface_film(scene.film, scene.camera, own.means, self._cell, level=level)
        if isinstance(found, str):
            self._missing = (Notice("film-not-played", f"the film of the fluid {found}"),)
            return None
        footage, self._fine = found
        self._camera = scene.camera.resized((footage.mean.shape[1], footage.mean.shape[0]))
        if scene.terrain.opaque:
            self._wall = terrain_depth(scene.terrain, self._camera)
        return footage

    def _level_at(self, places: np.ndarray) -> np.ndarray:
        """How fine the skin is at places of the map: as the film's pixels are there, 0 beside its picture.

        Where the surface is steep (a chute seen from its foot), neighbours on the map are far apart in the picture.
        """
        from fluidlift.look.surface_skin import PITCH, level_for
        from fluidlift.numerics.short_axis import every, lengths

        assert self._surface is not None
        heights, slopes = self._surface.at(self._surface.height, places), self._surface.slope(places)
        points = np.concatenate([places, heights[:, None]], axis=1)
        world = self._axes.world_points(points)
        camera = self._camera
        uv, depth = camera.project(world)
        inside = (depth > 0) & every((uv >= 0) & (uv <= np.array(camera.size)))
        apart = PITCH * self._cell * camera.focal[0] / np.maximum(depth, 1e-6)
        steep = lengths(slopes)[:, None]
        uphill = PITCH * self._cell * np.concatenate([slopes / np.maximum(steep, 1e-9), steep], axis=1)
        beside = camera.project(self._axes.world_points(points + uphill))[0]
        apart = np.maximum(apart, lengths(beside - uv))
        return np.where(inside, level_for(apart, self._fine), 0)

    def _seen_texture(self, surface: SurfaceMap, footage: FluidFootage | None) -> SeenTexture:
        from fluidlift.look.inflow import ENDS
        from fluidlift.look.seen_texture import SeenTexture
        from fluidlift.shape.off_picture import in_picture

        scene, own = self._scene, self._own
        if footage is not None:
            # each place shows its own film: shores, and what stands in the water's picture, as well
            usable = in_picture(own.means, scene.camera)
            plane = footage.outside <= 0 if kind_of(scene.kind).is_standing_water else None
            return SeenTexture(own, self._camera, surface, usable=usable, plane=plane)
        along = own.means @ scene.terrain.mainstream
        share = (along - along.min()) / max(float(np.ptp(along)), 1e-12)
        usable = lends_look(scene, own) & (share > ENDS[0]) & (share < ENDS[1])
        return SeenTexture(own, scene.camera, surface, shading=scene.shading, usable=usable)

    def _surface_of(self, particles: Particles) -> SurfaceMap | None:
        """The map of the surface; None where nothing is on it."""
        from fluidlift.look.filmed_outline import reach
        from fluidlift.look.surface_map import MARGIN, SurfaceMap

        points = self._axes.points(particles.positions)
        shown = self._axes.shown(points) & ~self._hidden(particles.positions)
        if not shown.any():
            return None
        moving = self._axes.velocities(particles.positions, particles.velocities)
        margin = MARGIN if self._outline is None else MARGIN + reach(self._axes)
        surface = SurfaceMap.of(points[shown], moving[shown], self._cell, margin=margin)
        if self._level is not None:
            surface = levelled(surface, self._level, CALM * self._cell)
        return surface if self._outline is None else self._outline.cut(surface, self._axes)

    def _hidden(self, points: np.ndarray) -> np.ndarray:
        """Which points (m) lie behind the wall of a vessel, where the film shows that and not the fluid."""
        from fluidlift.look.scenery import visible_beside_rocks

        if self._wall is None:
            return np.zeros(len(points), bool)
        there = np.isfinite(self._wall)
        return ~visible_beside_rocks(points, self._camera, self._wall, there, margin=BEHIND_WALL * self._cell)

    def _begin_again(self) -> None:
        from fluidlift.look.surface_skin import SurfaceSkin
        from fluidlift.look.texture_patches import Patches

        assert self._patches is not None
        self._patches.state, self._skin = (
            Patches.none(),
            SurfaceSkin(self._cell, self._level_at if self._plays else None),
        )

    def advance(self, particles: Particles, number: int) -> None:
        """Bring what floats on the surface to a frame; every frame after the last one, in order."""
        if self._whitewater is not None:
            self._whitewater.advance(particles, number)
        if self._patches is None or not len(particles):
            return
        if number == 0:
            self._begin_again()
        rng = np.random.default_rng([self._scene.seed, number])
        interval = self._scene.interval if number else 0.0
        if self._outlines is not None:
            instant, leading = self._scene.film_start + number * self._pace, self._patches.leading
            self._outline = self._outlines.at(instant, None if leading is None else leading + self._pace)
        self._surface = self._surface_of(particles)
        if self._surface is None:
            return
        self._patches.advance(self._surface, interval, rng)
        self._skin.advance(self._surface, interval, rng)

    @property
    def any_thread(self) -> bool:
        """Whether a frame can be `dressed`, by what `as_now` gives, while this goes on to the next one."""
        return self._whitewater is None

    def as_now(self) -> SurfaceAppearance:
        """The same at the frame to which `advance` has come, for `dressed` alone; the original may go on meanwhile.

        What a frame changes is put anew in its place, never within its arrays.
        """
        now = copy(self)
        if self._patches is not None:
            now._patches, now._skin = copy(self._patches), copy(self._skin)
        return now

    def dressed(
        self, particles: Particles, number: int, inside: Inside | None = None, deform: Deform | None = None
    ) -> Dressed:
        """The splats of a frame to which `advance` has come. Ids of particles are even, those of the skin and of white
        water odd.

        Args:
            particles: of the frame.
            number: of the frame, from 0.
            inside: (points [n,3]) -> whether they are in an obstacle, where there is no skin; None: no obstacles.
            deform: who deforms the splats of the body at rest; None: `deform_gaussians`.
        """
        bare = self._without_whitewater(particles, number, inside, deform)
        white = None if self._whitewater is None or not number else self._whitewater.splats(inside)
        if white is None:
            return bare
        gaussians, ids, velocities = white
        return Dressed(
            concatenate([bare.gaussians, gaussians]), np.concatenate([bare.ids, ids]),
            np.concatenate([bare.velocities, velocities]),
        )  # fmt: skip

    def _without_whitewater(
        self, particles: Particles, number: int, inside: Inside | None, deform: Deform | None
    ) -> Dressed:
        from fluidlift.look.mixing import mixed
        from fluidlift.physics.deform import deform_gaussians

        scene, carry = self._scene, deform or deform_gaussians
        if self._smoke is not None:
            shown = _round(scene.rest, particles)
            return Dressed(*self._smoke.dressed(shown, particles, number, self._own_colors(particles.source)))
        shown = carry(scene.rest, particles, max_stretch=MAX_STRETCH, max_size=LARGEST * self._cell)
        # without a film the body at rest is what was seen of its surface
        at_rest = not number and not self._plays
        surface = None if at_rest or self._patches is None or not len(particles) else self._surface
        under = None if surface is None else self._under_skin(particles, surface)
        if number:  # at rest nothing is drawn out
            seen = None if under is None else (under.covered < 1) | self._own_colors(particles.source)
            shown = mixed(shown, particles.deformation, widest=MIXED * self._cell, seen=seen)
        shown = self._shaded(shown, particles.source)
        if under is None:
            return Dressed(shown, 2 * particles.ids, particles.velocities)
        return self._with_skin(shown, particles, under, inside)

    def _shaded(self, shown: Gaussians, source: np.ndarray) -> Gaussians:
        """The splats with the shade of the places where they are now; those with a colour of their own keep it."""
        from fluidlift.numerics.short_axis import every

        scene = self._scene
        if scene.shading is None:
            return shown
        painted = rows(scene.rest.means if scene.painted is None else scene.painted, source)
        own = ~every(np.isfinite(painted))
        moved = scene.shading.moved(shown, np.where(own[:, None], shown.means, painted))
        return moved if not own.any() else replace(moved, sh=np.where(own[:, None, None], shown.sh, moved.sh))

    def _under_skin(self, particles: Particles, surface: SurfaceMap) -> UnderSkin:
        """Where particles lie below the skin of a frame."""
        from fluidlift.look.smoothstep import smoothstep

        places = self._axes.points(particles.positions)
        xy = places[:, :2]
        height, presence = surface.height_and_presence(xy)
        above = (places[:, 2] - height) / self._cell
        below, spray = COVERED
        loose = smoothstep(above, *spray)
        covered = smoothstep(above, *below) * (1 - loose) * (presence > 0.5)
        hidden = self._hidden(particles.positions)
        loose = np.where((presence > LONELY) | hidden, loose * ~hidden, 1.0)
        filmed = None if self._outline is None else self._outline.room(particles.positions)
        if filmed is not None:
            covered = np.where((filmed > 0) | hidden, covered, 1.0)
        return UnderSkin(places, above, loose, covered * ~hidden, hidden, filmed)

    def _with_skin(self, shown: Gaussians, particles: Particles, under: UnderSkin, inside: Inside | None) -> Dressed:
        """The splats of particles, and over them the skin of the frame to which `advance` has come."""
        from fluidlift.look.surface_axes import PictureAxes
        from fluidlift.look.surface_skin import WIDTH, dyed

        skin, axes, surface, patches = self._skin, self._axes, self._surface, self._patches
        assert surface is not None and patches is not None
        places, above, loose, covered, hidden, filmed = under
        room = REACH * np.maximum(self._clearance(shown.means) + CLEAR * self._cell, CLEAR * self._cell)
        drop = DROP * self._cell
        if self._outline is not None:  # drops before what plays its film are as sharp as that
            away = self._camera.project(particles.positions)[1]
            drop = np.minimum(
                drop, np.maximum(WIDTH * self._fine / self._camera.focal[0] * away, SMALLEST * self._cell)
            )
        room = np.minimum(room, drop * loose + LARGEST * self._cell * (1 - loose))
        if filmed is not None:
            room = np.where(hidden, room, np.minimum(room, np.maximum(filmed, SMALLEST * self._cell)))
        scales = np.minimum(shown.scales, room[:, None]).astype(np.float32)
        opacities = np.minimum(shown.opacities, np.maximum(shown.opacities * (1 - covered), FAINT)).astype(np.float32)
        sh, own = shown.sh.copy(), self._own_colors(particles.source)
        # what is in the air before a surface shows the film where it is seen, as on a map over the picture it always is
        deepest = np.inf if self._outline is not None or isinstance(axes, PictureAxes) else TINTED
        near = np.flatnonzero((above > -TINTED) & (above < deepest) & (covered < 1) & ~own & ~hidden)
        color, there, _ = patches.colors(rows(places, near))
        sh[near[there], :1] = sh_from_rgb(color[there])
        if hidden.any() and there.any():  # what nobody sees looks as what is seen of it does
            sh[hidden & ~own, :1] = sh_from_rgb(np.median(color[there], axis=0, keepdims=True))
        points = skin.points(surface)
        color, there, covers = patches.colors(points)
        color = dyed(color, points, surface, replace(shown, means=axes.points(shown.means)), own, self._cell)
        world = axes.world_points(points)
        if self._outline is None:
            there &= self._clearance(world) > CLEAR * self._cell
        else:
            there &= self._outline.inside(world)
        if inside is not None:
            there &= ~inside(world)
        tracers = axes.world_splats(skin.splats(surface, color).select(there))
        if self._sways and covers.min(initial=1.0) < 1.0:
            tracers = replace(tracers, opacities=tracers.opacities * covers[there].astype(np.float32))
            opacities *= surface.at(surface.mean(covers, skin.places, 1.0), places[:, :2]).astype(np.float32)
        speeds = axes.world_velocities(points[there], surface.at(surface.velocity, skin.places[there]))
        return Dressed(
            concatenate([replace(shown, scales=scales, opacities=opacities, sh=sh), tracers]),
            np.concatenate([2 * particles.ids, 2 * skin.ids[there] + 1]),
            np.concatenate([particles.velocities, speeds.astype(np.float32)]),
        )

    def _own_colors(self, source: np.ndarray) -> np.ndarray:
        """Which particles bring a colour of their own, as dye does."""
        from fluidlift.numerics.short_axis import every

        painted = self._scene.painted
        return np.zeros(len(source), bool) if painted is None else ~every(np.isfinite(rows(painted, source)))

    def _clearance(self, points: np.ndarray) -> np.ndarray:
        """How far points are from the ground, m; negative inside it."""
        from fluidlift.numerics.sampling import sample_nodes

        terrain = self._scene.terrain
        return sample_nodes(terrain.signed_distance, terrain.grid, points)

    def state(self) -> dict[str, np.ndarray]:
        """What changes from frame to frame, as plain arrays."""
        white = {} if self._whitewater is None else self._whitewater.state()
        if self._patches is None:
            return white
        patches = {f"patches.{name}": np.array(value) for name, value in vars(self._patches.state).items()}
        skin = {f"skin.{name}": getattr(self._skin, name).copy() for name in ("places", "ids", "levels", "heights")}
        return white | patches | skin | {"skin.next_id": np.array(self._skin.next_id, np.int64)}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Go to a state of `state`.

        Raises:
            InputRejected: something is missing, of the wrong shape or not finite; nothing has changed then.
        """
        from fluidlift.look.texture_patches import Patches

        if self._patches is None:
            if self._whitewater is not None:
                self._whitewater.restore(state)
            return
        try:
            parts = {n.removeprefix("patches."): np.array(a) for n, a in state.items() if n.startswith("patches.")}
            patches, places = Patches(**parts), np.array(state["skin.places"], np.float64)
            ids, next_id = np.array(state["skin.ids"], np.int64), int(state["skin.next_id"])
            levels, heights = np.array(state["skin.levels"], np.int64), np.array(state["skin.heights"], np.float64)
        except (KeyError, TypeError, ValueError) as error:
            raise InputRejected(f"the state of a surface that does not fit: {error}") from None
        numbers = [
            patches.centers,
            patches.sources,
            patches.turns,
            patches.strains,
            patches.presences,
            patches.instants,
        ]
        numbers += [places, levels, heights, np.nan_to_num(patches.ends, posinf=0.0)]  # without footage they do not end
        fits = places.shape == (len(ids), 2) and levels.shape == heights.shape == ids.shape
        if not fits or not all(np.isfinite(array).all() for array in numbers):
            raise InputRejected("the state of a surface with arrays of another shape, or not finite", "a whole one")
        if self._whitewater is not None:
            self._whitewater.restore(state)
        self._patches.state = patches
        self._skin.places, self._skin.ids, self._skin.next_id = places, ids, next_id
        self._skin.levels, self._skin.heights = levels, heights
