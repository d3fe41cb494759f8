"""Frames of an asset in another look than its splats' own: relit, transparent, or as the surface of a liquid."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.io.scene_look import Look
from fluidlift.look.clear_water import absorption_in
from fluidlift.look.display import displayed
from fluidlift.look.environment import BUILT_IN, LUMINANCE, Environment, built_in
from fluidlift.look.fluid_normals import OUTSIDE, fluid_depths, fluid_normals, fluid_surface
from fluidlift.look.ground_picture import GroundMeshes, place_of
from fluidlift.look.liquid import Behind, SurfaceBuffer, shaded
from fluidlift.look.materials import WATER, Material, material_named
from fluidlift.look.outlet_section import OpenEnd
from fluidlift.look.rasterize import render
from fluidlift.look.relight import relit
from fluidlift.look.screen_space import mesh_surface, particle_surface
from fluidlift.look.solid_contact import settled
from fluidlift.look.stream_slab import Slab
from fluidlift.look.surface_foam import FilmedWhite, with_foam
from fluidlift.look.surface_skin import painted_liquid
from fluidlift.look.transparent import splat_surface
from fluidlift.look.vessel import Pane, before_glass, has_glass, panes, vessel_apart
from fluidlift.look.wet_ground import wetted
from fluidlift.numerics.mesh_normals import vertex_normals
from fluidlift.numerics.srgb import linear_from_srgb, srgb_from_linear
from fluidlift.present.supersampling import Lit, Quality, averaged, enlarged
from fluidlift.present.surface_waves import SurfaceWaves
from fluidlift.present.surfacing import RADIUS, surface_of
from fluidlift.present.without_fluid import Backdrop, GroundPictures, Shade, wet_behind
from fluidlift.types import (
    FluidKind,
    Gaussians,
    PinholeCamera,
    Similarity3,
    Terrain,
    TriangleMesh,
    kind_of,
    matrix_from_quat,
)
from fluidlift.types.kind import STREAM

if TYPE_CHECKING:
    from fluidlift.backends.mitsuba_renderer import MitsubaRenderer
    from fluidlift.io.obstacles import Obstacle
    from fluidlift.seams import Mesher

ENGINES = ("mesh", "screen", "mitsuba")
"""of the look surface: its mesh drawn in one pass; the particles themselves in screen space, several times faster and
softer; path tracing of the mesh"""
MARGIN = 1.5
"""cells behind a solid over which a splat fades: its middle may lie a little inside the bed"""
INNER = 0.02
"""weight of the normals of splats inside the fluid next to those at its surface"""
SKY_BLUR = 0.5
"""roughness at which a studio is seen behind everything: lamps are for light, not to look at"""

FLOOR = 0.45
"""linear grey seen straight below"""
HORIZON = 0.08
"""sine of the angle over which floor and sky flow into each other"""


@dataclass(frozen=True)
class Frame:
    """What stands before the camera in one frame."""

    fluid: Gaussians
    velocities: np.ndarray
    """[n,3], m/s"""
    bodies: Sequence[TriangleMesh] = ()
    """obstacles, in the world"""
    time: float = 0.0
    """s from the first frame, by which waves move on"""


@dataclass(frozen=True)
class OnSurface:
    """What is on the surface of a liquid in the looks transparent and surface."""

    waves: SurfaceWaves | None = None
    """None: it is as smooth as it was simulated"""
    white: FilmedWhite | None = None
    """what of its colours is foam; None: nothing is"""


def placed_bodies(obstacles: Sequence[Obstacle], poses: np.ndarray) -> list[TriangleMesh]:
    """Meshes of obstacles where they are: poses [b,7], position (m) and orientation (w, x, y, z)."""
    return [
        TriangleMesh(
            Similarity3(1.0, matrix_from_quat(p[3:]), p[:3]).points(o.mesh.vertices), o.mesh.faces, o.mesh.colors
        )
        for o, p in zip(obstacles, poses, strict=True)
    ]


def environment_of(folder: Path, name: str) -> Environment:
    """A built-in environment, or a .hdr or .exr file in the asset's folder (or any, by an absolute path).

    Raises:
        InputRejected: an unknown name, or a file that is no environment.
    """
    from fluidlift.io.asset_paths import asset_file
    from fluidlift.io.environments import read_environment_image

    if Path(name).suffix.lower() not in (".hdr", ".exr"):
        return built_in(name)
    path = Path(name) if Path(name).is_absolute() else asset_file(folder, name)
    return Environment(read_environment_image(path))


def _as_filmed(material: Material, folder: Path) -> Material:
    """Water that absorbs what the clip's own does, where the bed that is seen through it tells that."""
    from fluidlift.io.asset_folder import FILES, read_parameters
    from fluidlift.io.asset_paths import asset_file

    if material is not WATER:
        return material
    try:
        found = absorption_in(read_parameters(asset_file(folder, FILES["parameters"]))[1])
    except InputRejected:  # no asset lies there
        return material
    return material if found is None else replace(material, absorption=found)


class Painter:
    """Draws the frames of one asset in one look. What stays from frame to frame is kept: the ground's shadows, and for
    a camera that stands still the ground's picture.

    Args:
        look: its style is relit, transparent or surface.
        terrain: of the asset.
        folder: of the asset, where environments lie.
        kind: of the fluid; what lies on a bed has no surface towards it.
        engine: of the look surface, one of `ENGINES`.
        quality: how finely.
        slab: of a stream; before the terrain it ends there in clean sections, and the ground with it. Before a clip's
            plate it goes on beyond them. None: it is drawn as far as its particles go.
        on_surface: what there is beside the liquid; None: nothing.

    Raises:
        InputRejected: an unknown material, environment or engine.
        MissingPackage: the engine or the mesher is not installed.
    """

    def __init__(
        self,
        look: Look,
        terrain: Terrain,
        folder: Path,
        *,
        kind: str | FluidKind = STREAM,
        engine: str = "mesh",
        quality: Quality | None = None,
        slab: Slab | None = None,
        on_surface: OnSurface | None = None,
    ) -> None:
        if engine not in ENGINES:
            near = difflib.get_close_matches(engine, ENGINES, 1)
            raise InputRejected(f"no engine '{engine}'", ", ".join(ENGINES), f"did you mean {near[0]}?" if near else "")
        if engine != "mesh" and look.style != "surface":
            raise InputRejected(
                f"the engine {engine} with the look {look.style}", "the look surface", "add --look surface"
            )
        self.look, self.terrain, self.engine = look, terrain, engine
        self.material: Material = _as_filmed(material_named(look.material), folder).tinted(look.tint)
        self.environment = environment_of(folder, look.environment)
        self._quality, self._bed = quality or Quality(), terrain if kind_of(kind).lies_on_ground else None
        on_surface = on_surface or OnSurface()
        self._slab, self._waves, self._white = slab or Slab(), on_surface.waves, on_surface.white
        self._finer, self._folder = 1 if engine == "mitsuba" else self._quality.supersample, folder
        self._far: tuple[tuple, np.ndarray] | None = None
        self._taken: tuple[Backdrop, Backdrop] | None = None
        self._panes: tuple[tuple, tuple[Pane, Pane]] | None = None
        # the ground that hides, and the glass of a pour that does not
        ground, cell = terrain.mesh, terrain.grid.spacing
        whole, self._vessel = vessel_apart(ground, cell) if has_glass(kind, terrain) else (ground, None)
        self._grounds = GroundPictures(whole, terrain.grid, self._slab, self.environment, self._quality.light)
        _ = self._final if engine == "mitsuba" else self._mesher  # what is missing is said before anything is drawn

    @cached_property
    def _mesher(self) -> Mesher | None:
        if self.look.style != "surface" or self.engine == "screen":
            return None
        from fluidlift.backends.splashsurf import SplashsurfMesher

        return SplashsurfMesher(draft=self._quality.coarse)

    @cached_property
    def _final(self) -> MitsubaRenderer | None:
        if self.engine != "mitsuba":
            return None
        from fluidlift.backends.mitsuba_renderer import MitsubaRenderer

        return MitsubaRenderer()

    def picture(self, frame: Frame, camera: PinholeCamera, backdrop: Backdrop) -> Lit:
        """One frame.

        Args:
            frame: what is in it.
            camera: who looks.
            backdrop: what stands behind it.
        """
        if self._final is not None:
            return self._traced(frame, camera, backdrop)
        if self._taken is None or self._taken[0] is not backdrop:
            self._taken = backdrop, self._finer_backdrop(backdrop, camera)
        if self._finer == 1:
            return self._drawn(frame, camera, self._taken[1])
        k = self._finer
        wide = camera.resized((k * camera.size[0], k * camera.size[1]))
        return averaged(self._drawn(frame, wide, self._taken[1]), k)

    def _finer_backdrop(self, backdrop: Backdrop, camera: PinholeCamera) -> Backdrop:
        """The backdrop with the pixels in which pictures are drawn."""
        if backdrop.fluid is not None and backdrop.depth is not None:
            backdrop = replace(backdrop, depth=self._grounds.depth_of_rocks(camera, backdrop.depth))
        k = self._finer
        if k == 1:
            return backdrop
        return replace(
            backdrop,
            picture=enlarged(backdrop.picture, k),
            depth=enlarged(backdrop.depth, k),
            fluid=enlarged(backdrop.fluid, k),
            drawn=enlarged(backdrop.drawn, k),
            coarse=k * backdrop.coarse,
        )

    def _drawn(self, frame: Frame, camera: PinholeCamera, backdrop: Backdrop) -> Lit:
        """One frame, with the pixels of the camera."""
        if backdrop.fluid is not None and self._slab.ends:
            fluid, velocities = self._slab.beyond(frame.fluid, frame.velocities, camera)
            frame = replace(frame, fluid=fluid, velocities=velocities)
        ends = self._ends(backdrop)
        mesh = None
        if self._mesher is not None:
            mesh, _ = surface_of(
                frame.fluid, frame.velocities, self.terrain, self._mesher, clamped=False, ends=ends
            )  # fmt: skip
        if ends:
            kept = self._slab.before(frame.fluid.means)
            frame = replace(frame, fluid=frame.fluid.select(kept), velocities=frame.velocities[kept])
        beside, through, bed = self._pictures(camera, backdrop, self._shade(frame, mesh, backdrop))
        if self.look.style == "relit":
            lit = self._relit(frame.fluid, camera, self._through_far_wall(beside, camera, backdrop), backdrop.cut_out)
        else:
            lit = self._refracting(frame, mesh, camera, (beside, through, bed), backdrop)
        walls = self._glass(camera, backdrop)
        return lit if walls is None else replace(lit, image=walls[0].over(lit.image, lit.depth))

    def _refracting(
        self,
        frame: Frame,
        mesh: TriangleMesh | None,
        camera: PinholeCamera,
        pictures: tuple[Behind, Behind, GroundMeshes | None],
        backdrop: Backdrop,
    ) -> Lit:
        """A liquid that shows what lies behind it. pictures: as `_pictures` gives them."""
        beside, through, bed = pictures
        surface = self._liquid(frame, mesh, camera, beside, self._ends(backdrop))
        if self._waves is not None:
            surface = self._waves.tilted(surface, camera, frame.time)
        if through is not beside:  # what hides the liquid is not in the picture through it
            hidden = (beside.depth > 0) & (surface.depth >= beside.depth)
            surface = replace(surface, covered=np.where(hidden, np.float32(0.0), surface.covered))
        one = through is beside
        if bed is not None:  # else a plate shows its ground as it was
            ground = bed.albedo(camera), bed.depth(camera)
            shaded_there = backdrop.picture is None and (self.look.style == "transparent" or mesh is not None)
            wet = wetted(through, surface, camera, self.material, ground, shaded=shaded_there)
            beside = wet if one else wetted(beside, surface, camera, self.material, ground, shaded=shaded_there)
            through = wet if one else wet_behind(through, wet, beside)
        beside = self._through_far_wall(beside, camera, backdrop)
        through = beside if one else self._through_far_wall(through, camera, backdrop)
        image = shaded(
            surface, through, camera, self.material, self.environment, usual=self._usual, before=beside.image
        )
        if self.material.foams and self._white is not None:
            nearer = (beside.depth <= 0) | (surface.depth < beside.depth)
            cover = nearer * self._white.cover(surface, camera, self.material.refractive_index)
            image = with_foam(image, surface, cover, self.environment)
        if backdrop.cut_out:
            light = np.maximum(image - (1.0 - surface.covered[..., None]) * beside.image, 0.0)
            return Lit(light, surface.covered, surface.depth)
        return Lit(image, np.ones_like(surface.covered), np.where(surface.covered > 0.5, surface.depth, beside.depth))

    def display(self, linear: np.ndarray) -> np.ndarray:
        """Light of `picture` for a display, linear in [0, 1], with the look's exposure."""
        return displayed(linear, exposure=self.look.exposure)

    def shown(self, frame: Frame, camera: PinholeCamera, backdrop: Backdrop) -> np.ndarray:
        """A picture as u8 [h,w,3], sRGB."""
        light = self.display(self.picture(frame, camera, backdrop).image)
        return (255.0 * srgb_from_linear(light) + 0.5).astype(np.uint8)

    def seen_behind(self, camera: PinholeCamera) -> np.ndarray:
        """Linear [h,w,3] behind everything: a file's environment as it is; of a built-in one the sky, and below the
        horizon a pale floor with the ground's shadow, before which a dark liquid and a dark ground both stand out."""
        key = place_of(camera)
        if self._far is None or self._far[0] != key:
            self._far = key, self._surroundings(camera)
        return self._far[1]

    def _surroundings(self, camera: PinholeCamera) -> np.ndarray:
        rays = camera.rays(camera.pixel_grid())
        if self.look.environment not in BUILT_IN:
            return self.environment.toward(rays)
        rise = rays[..., 2:] / np.linalg.norm(rays, axis=-1, keepdims=True)
        sky = self.environment.blurred(rays, SKY_BLUR) if self.look.environment == "studio" else (
            self.environment.toward(rays)
        )  # fmt: skip
        above = np.clip(rise / HORIZON + 0.5, 0.0, 1.0)
        floor = (FLOOR + 0.2 * np.clip(rise + 1.0, 0.0, 1.0)) * self._grounds.light_on_floor(camera)
        return (sky * above + floor * (1.0 - above)).astype(np.float32)

    def _ends(self, backdrop: Backdrop) -> tuple[OpenEnd, ...]:
        """Where the liquid is cut: before the terrain, and neither on a plate nor cut out."""
        return () if backdrop.picture is not None or backdrop.cut_out else self._slab.ends

    def _shade(self, frame: Frame, mesh: TriangleMesh | None, backdrop: Backdrop) -> Shade:
        # what is drawn as splats hides what is behind it, and lets no light through to the ground either
        clear = None if self.look.style == "relit" else self.material
        # the caster made of splats stands outside of them: ground in between is beside the fluid, not under it
        inset = 0.0 if self._mesher is not None else OUTSIDE * 0.5 * self.terrain.grid.spacing
        return Shade(mesh or self._caster(frame, backdrop), clear, frame.bodies, inset)

    def _pictures(
        self, camera: PinholeCamera, backdrop: Backdrop, shade: Shade
    ) -> tuple[Behind, Behind, GroundMeshes | None]:
        """The picture without the fluid, beside it and through it, and the ground that is drawn in the latter; None: a
        photograph shows it."""
        if backdrop.fluid is not None:
            beside, through = self._grounds.on_plate(camera, backdrop, shade.bodies)
            if shade.bodies:
                drawn = self._no_ground.picture(camera, beside, bodies=shade.bodies)
                beside = replace(beside, image=drawn.image, depth=drawn.depth)
            return beside, through, self._grounds.bed
        beside = self._behind(camera, backdrop, shade)
        if backdrop.picture is not None:
            return beside, beside, None
        if backdrop.cut_out or self.look.style == "relit":
            return beside, beside, self._grounds.ground
        return beside, *self._grounds.through(camera, beside, self.seen_behind(camera), shade)

    def _behind(self, camera: PinholeCamera, backdrop: Backdrop, shade: Shade) -> Behind:
        """The picture without the fluid, a plate's as it is."""
        far = self.seen_behind(camera) if backdrop.picture is None else backdrop.picture
        depth = np.zeros(far.shape[:2], np.float32) if backdrop.depth is None else backdrop.depth
        ground = self._grounds.ground if backdrop.picture is None else self._no_ground
        if backdrop.picture is not None and self.look.style == "surface" and self._bed is not None:
            # the plate shows the ground: a liquid that touches it must not look through air. A vessel may be of glass
            depth = np.where(depth > 0, depth, self._grounds.ground.depth(camera))
        found = ground.picture(
            camera, Behind(far, depth), shade.caster, material=shade.material, bodies=shade.bodies, inset=shade.inset
        )
        # nobody knows what is around a clip: its own rim and mean fit it better than another world's sky
        on_plate = backdrop.picture is not None
        return replace(found, goes_on=on_plate, coarse=backdrop.coarse if on_plate else 1.0)

    def _caster(self, frame: Frame, backdrop: Backdrop) -> TriangleMesh | None:
        """The splats as a body that throws a shadow. Not on the plate of a clip: the clip's fluid has thrown its own
        there, and which of them are shadows nobody knows."""
        bare = backdrop.picture is not None or (backdrop.cut_out and self.look.style == "relit")
        if self.look.style == "surface" or (bare and not frame.bodies):
            return None
        return fluid_surface(frame.fluid, 0.5 * self.terrain.grid.spacing)

    @cached_property
    def _no_ground(self) -> GroundMeshes:
        return GroundMeshes([], self.environment, self._quality.light)

    def _glass(self, camera: PinholeCamera, backdrop: Backdrop) -> tuple[Pane, Pane] | None:
        """The vessel's walls before and behind the fluid, kept for a camera that stands still. None on a plate, which
        shows the vessel, and for what is cut out, which stands without its ground."""
        if self._vessel is None or backdrop.picture is not None or backdrop.cut_out:
            return None
        key = place_of(camera)
        if self._panes is None or self._panes[0] != key:
            self._panes = key, panes(self._vessel, camera, self.environment)
        return self._panes[1]

    def _through_far_wall(self, behind: Behind, camera: PinholeCamera, backdrop: Backdrop) -> Behind:
        walls = self._glass(camera, backdrop)
        return behind if walls is None else before_glass(behind, walls[1])

    @cached_property
    def _clip_colors(self) -> np.ndarray | None:
        """Linear colours of the asset's fluid at rest, against which things glow: the same for all frames. None: there
        is no asset in the folder, or nothing that glows."""
        from fluidlift.io.asset_folder import load_asset

        if max(self.material.emission) == 0:
            return None
        try:
            colors = load_asset(self._folder).rest.rgb
        except InputRejected:
            return None
        return linear_from_srgb(np.clip(colors, 0.0, 1.0)) if len(colors) else None

    @property
    def _usual(self) -> float | None:
        return None if self._clip_colors is None else float((self._clip_colors @ LUMINANCE).mean())

    def _visible(self, fluid: Gaussians, camera: PinholeCamera, behind: Behind) -> np.ndarray:
        """[n], 0 to 1: how much of each splat solids leave to be seen."""
        row, col, z = camera.nearest_pixels(fluid.means)
        wall = behind.depth[row, col]
        return 1.0 - np.clip((z - wall) / (MARGIN * self.terrain.grid.spacing), 0.0, 1.0) * (wall > 0)

    def _relit(self, fluid: Gaussians, camera: PinholeCamera, behind: Behind, cut_out: bool) -> Lit:
        """Splats under other light."""
        apart = 0.5 * self.terrain.grid.spacing
        normals, share = fluid_normals(fluid, apart, self._bed)
        deep = fluid_depths(fluid, normals, apart)
        light = relit(fluid, normals, share, camera, self.material, self.environment, self._clip_colors, deep)
        seen = (fluid.opacities * self._visible(fluid, camera, behind)).astype(np.float32)
        shown = Gaussians(fluid.means, fluid.quats, fluid.scales, seen, fluid.sh)
        drawn = render(shown, camera, features=light)
        if cut_out:
            return Lit(drawn.image, drawn.alpha, drawn.depth)
        image = drawn.image + (1.0 - drawn.alpha)[..., None] * behind.image
        return Lit(image, np.ones_like(drawn.alpha), np.where(drawn.alpha > 0.5, drawn.depth, behind.depth))

    def _liquid(
        self,
        frame: Frame,
        mesh: TriangleMesh | None,
        camera: PinholeCamera,
        behind: Behind,
        ends: Sequence[OpenEnd],
    ) -> SurfaceBuffer:
        fluid = frame.fluid
        if mesh is not None:
            normals = None if self._bed is None else settled(mesh.vertices, vertex_normals(mesh), self._bed, ends)
            if self._waves is not None and normals is not None:  # whose slope is added for each pixel
                mesh, _ = self._waves.raised(mesh, normals, None, frame.time)
            return mesh_surface(mesh, camera, radius=RADIUS * self.terrain.grid.spacing, normals=normals)
        fluid = painted_liquid(fluid, self.terrain.grid.spacing)
        free = self._bed is None  # what lies on a bed has its far side there: no second surface to bend light at
        if self.look.style == "transparent":
            apart = 0.5 * self.terrain.grid.spacing
            normals, share = fluid_normals(fluid, apart, self._bed)
            normals = normals * np.maximum(share, INNER)[:, None]
            return splat_surface(fluid, normals, camera, volume=apart**3, far_side=free, ground=behind.depth)
        radius = RADIUS * self.terrain.grid.spacing
        m = self.material
        shows = m.carried > 0 or max(m.emission) > 0 or m.foams  # else its colours change nothing
        colors = linear_from_srgb(np.clip(fluid.rgb, 0.0, 1.0)) if shows else None
        return particle_surface(fluid.means, radius, camera, colors, ground=behind.depth, far_side=free)

    def _traced(self, frame: Frame, camera: PinholeCamera, backdrop: Backdrop) -> Lit:
        """By light paths through the mesh, which reaches into the ground here: a gap would be a film of air."""
        from fluidlift.backends.mitsuba_scene import FinalScene, resting

        assert self._final is not None
        ends = () if backdrop.picture is not None else self._slab.ends
        mesh, _ = surface_of(frame.fluid, frame.velocities, self.terrain, self._need_mesher(), clamped=False, ends=ends)
        if self._waves is not None:
            mesh, _ = self._waves.raised(mesh, vertex_normals(mesh), None, frame.time)
        mesh = resting(mesh, self.terrain)
        ground = [self._grounds.solid] if len(self._grounds.solid.faces) else []
        image, alpha = self._final.picture_and_alpha(
            FinalScene(
                mesh, self.material, camera, self.environment.radiance, (*ground, *frame.bodies),
                panes=() if self._vessel is None else (self._vessel.sheet,),
                samples=self._quality.samples, show_environment=False, usual=self._usual,
            )
        )  # fmt: skip
        behind = self._behind(camera, Backdrop(backdrop.picture), Shade(bodies=frame.bodies))
        far = self.seen_behind(camera) if backdrop.picture is None else backdrop.picture
        depth = mesh_surface(mesh, camera).depth
        nearer = (depth > 0) & ((behind.depth == 0) | (depth < behind.depth))
        whole = image + (1.0 - alpha)[..., None] * far
        return Lit(whole, np.ones_like(alpha), np.where(nearer, depth, behind.depth))

    def _need_mesher(self) -> Mesher:
        assert self._mesher is not None
        return self._mesher
