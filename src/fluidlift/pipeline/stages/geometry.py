"""The stage that builds the scene: kind, up, front surface, metres, terrain."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.look.smoke_film import behind_smoke
from fluidlift.pipeline.bed_seen import BedPicture, bed_of
from fluidlift.pipeline.settings import GeometrySettings, GivenView
from fluidlift.pipeline.sight import Sight, Sighted, sighted
from fluidlift.pipeline.work import Work
from fluidlift.shape import (
    composite,
    filled_vessel,
    generate,
    ground,
    ground_texture,
    occluders,
    registration,
    standing,
)
from fluidlift.shape.frame_pictures import typical_picture
from fluidlift.shape.kind import level_camera
from fluidlift.shape.kinds import builder_of
from fluidlift.shape.looked_into import Bowl, bowl_of
from fluidlift.shape.view import horizon_line
from fluidlift.types import (
    CellType,
    FluidKind,
    PinholeCamera,
    SaidFlow,
    Setting,
    Similarity3,
    VideoClip,
)
from fluidlift.types.fluid_masks import FluidMasks
from fluidlift.types.stages import Flow, Geometry, Read, Segmentation

BEHIND = 24
"""frames that what is behind smoke is looked for in"""


def geometry(
    read: Read, flow: Flow, segmentation: Segmentation, given: GivenView, config: GeometrySettings, *, work: Work
) -> Geometry:
    """Kind, camera, front surface, scale, terrain, cells.

    Args:
        read: the clip.
        flow: of it.
        segmentation: of it.
        given: what a person has of camera, body and depth.
        config: what a person says of the fluid, and the cells.
        work: keeps a learned model's depth.

    Raises:
        InputRejected: a fluid without a shape, or something given that does not fit.
    """
    s, clip, c = sighted(read, flow, segmentation, given, config, work=work), read.clip, config
    seen, front, falling, kind, mask, scale, seen_depth = (
        s.seen, s.front, s.falling, s.seen.kind, s.seen.mask, s.scale, s.seen_depth
    )  # fmt: skip
    hidden = _hidden(seen, segmentation)
    fluid = FluidMasks(segmentation.labels.labels, hidden)
    mainstream = _mainstream(s)
    eye = seen.known.position if seen.pose_given else None
    to_world, camera = registration.place(
        s.canonical, s.points, scale.value, heading=seen.heading, eye=eye, mainstream=mainstream
    )
    depth = (front.depth * scale.value).astype(np.float32)
    half = (front.half_thickness * scale.value).astype(np.float32)
    setting = _setting(s, fluid, camera, to_world, depth, half, to_world.vectors(mainstream) / to_world.scale, c)
    if not (setting.cell_types == CellType.FLUID).any():
        raise InputRejected(
            f"as a {kind}, the fluid fills no cell of the grid beside those of its inlet", "a larger or thicker body",
            "check the mask and --kind, or raise --set shape.cells=...",
        )  # fmt: skip
    bed = bed_of(clip, fluid, seen, setting, camera, depth)
    vessel = None if front.vessel is None else front.vessel.transformed(to_world)
    setting, picture = _coloured(setting, clip, fluid, seen, falling.pixels, camera, bed, vessel)
    return Geometry(
        kind=kind.name,
        kind_source="evidence" if seen.kind_free else "user",
        kind_evidence=seen.evidence,
        up=s.up,
        scale=scale,
        scale_sentence=s.sentence,
        camera=camera,
        world_from_canonical=to_world,
        setting=setting,
        mask=mask,
        depth=depth,
        half_thickness=half,
        sighted_depth=(front.sighted * scale.value).astype(np.float32),
        mean_flow=seen.motion,
        mean_confidence=seen.trust,
        plate=picture,
        rest_frame=seen.start,
        united_frames=seen.united,
        rocks=_solid_before(s, fluid, camera, vessel),
        hidden=hidden,
        known_scale=s.known_scale,
        depth_source=None if seen_depth is None else seen_depth.meta,
        jets=tuple(falling.plain(to_world)),
        slope=front.slope,
        said_flow=seen.said_flow,
        bed=None if bed is None else bed.evidence,
        warnings=tuple(s.warnings),
    )


def _mainstream(s: Sighted) -> np.ndarray:
    """Canonical direction in which the body runs as a whole: as its jet, or what stands, is let go; else by its
    motion, beside what falls."""
    seen = s.seen
    held = s.front.vessel or s.front.heap
    if held is not None:
        return np.array(held.inflow)
    if seen.stood is not None:
        return seen.stood.direction
    lies, counted = ~s.falling.pixels[s.visible], seen.trust[s.visible]
    if seen.said_flow is not None:
        counted = counted * _said(seen.said_flow, s.visible & ~s.falling.pixels)[s.visible]
    return _mainstream_of(seen.kind, s.velocities[lies], counted[lies])


def _setting(
    s: Sighted, fluid: FluidMasks, camera: PinholeCamera, to_world: Similarity3, depth: np.ndarray,
    half: np.ndarray, bulk: np.ndarray, config: GeometrySettings,
) -> Setting:  # fmt: skip
    """Terrain and cells, without colors.

    Args:
        s: the fluid as it is seen.
        fluid: its masks.
        camera: in the world.
        to_world: from the canonical frame.
        depth: camera z of the surface, m.
        half: half of the body's thickness there, m.
        bulk: unit vector in the world, in which the body runs as a whole.
        config: the cells.
    """
    seen, kind, parts = s.seen, s.seen.kind, s.seen.parts
    if seen.stood is not None:
        return standing.standing_setting(seen.stood, to_world, bulk, longest=config.cells, limit=config.cell_limit)
    scene = None if s.seen_depth is None else np.where(seen.mask, np.nan, s.seen_depth.scene.depth * s.scale.value)
    speed = None if kind.is_standing_water else _seen_speed(s.visible, s.velocities * s.scale.value, seen.trust)
    setting = ground.setting_around(
        kind, s.front, fluid, seen.start, seen.united, camera, to_world, depth, half, bulk, config, s.falling.pixels,
        speed=speed, scene_depth=scene, in_metres=s.scale.source != "assumed",
        closed=parts.puddle or kind.is_standing_water, goes_on=kind.is_standing_water,
        pool=parts.lying if kind.rises_from_pool else None, horizon=_horizon(s, camera),
        bowl=_bowl(s, camera, to_world),
    )  # fmt: skip
    lies = ~s.falling.pixels[s.visible]
    return composite.composed(setting, s.falling, to_world, s.points[lies], s.velocities[lies], camera)


def _bowl(s: Sighted, camera: PinholeCamera, to_world: Similarity3) -> Bowl | None:
    """The vessel in which standing water lies, by its rim."""
    seen = s.seen
    if not seen.kind.is_standing_water or not len(s.points):
        return None
    held = next((rim for rim in seen.heeded_rims if filled_vessel.in_vessel([rim], seen.mask)), None)
    level = float(np.median(to_world.points(s.points)[:, 2]))
    return None if held is None else bowl_of(camera, held, seen.mask, level)


def _horizon(s: Sighted, camera: PinholeCamera) -> tuple[tuple[float, float], tuple[float, float]]:
    """px, the horizon as the camera was seen to look, not as a relief is built."""
    if s.up.raised:
        camera = level_camera(camera, replace(s.up, pitch=s.up.pitch - s.up.raised))
    return horizon_line(camera)


def _said(flow: SaidFlow, visible: np.ndarray) -> np.ndarray:
    """bool [h,w]: pixels whose motion says where the mainstream runs, those that a person's arrows speak for."""
    return flow.counts if (flow.counts & visible).any() else np.ones(visible.shape, bool)


def _mainstream_of(kind: FluidKind, velocities: np.ndarray, trust: np.ndarray) -> np.ndarray:
    """Bulk direction: confident and fast motion counts most; bodies in the air move along the vertical."""
    speed = np.linalg.norm(velocities, axis=1)
    capped = velocities * np.minimum(1.0, np.percentile(speed, 95) / np.maximum(speed, 1e-12))[:, None]
    bulk = (capped * (trust * np.linalg.norm(capped, axis=1))[:, None]).sum(axis=0)
    bulk = builder_of(kind).mainstream(bulk)
    norm = np.linalg.norm(bulk)
    return bulk / norm if norm > 1e-12 else np.array([1.0, 0.0, 0.0])


def _coloured(
    setting: Setting,
    clip: VideoClip,
    fluid: FluidMasks,
    seen: Sight,
    falls: np.ndarray,
    camera: PinholeCamera,
    bed: BedPicture | None = None,
    vessel: filled_vessel.FilledVessel | None = None,
) -> tuple[Setting, np.ndarray]:
    """The setting with its ground as the clip shows it, and the picture without the fluid, u8 [h,w,3].

    bed: what is seen of it through the water. vessel: that stands on it, in the world.
    """
    # the plate looks at a few frames only
    solid = ground.solid_share(fluid.labels) > 0.5
    solid = solid if fluid.hidden is None else solid & ~fluid.hidden
    on_ground = setting.surface_height is not None
    plate = generate.background_plate(clip.frames, cast(Any, fluid), solid, shore=on_ground)
    picture = plate.image
    if seen.kind.is_gas:
        pick = np.unique(np.linspace(0, len(clip) - 1, BEHIND).round().astype(int))
        masks = np.stack([fluid[t] for t in pick]) & ~plate.seen
        picture = behind_smoke(clip.frames[pick], masks, picture)
    if on_ground:
        labels = ground.seen_labels(fluid, seen.start, seen.united, falls)
        shown, known = picture, np.asarray(plate.seen)
        if bed is not None:  # under water it is seen; what the plate shows there is inpainted
            shown, known = np.where((bed.known & ~known)[..., None], bed.picture, picture), known | bed.known
        under = None if bed is None else bed.known & ~np.asarray(plate.seen)
        view = ground_texture.GroundView(shown, camera, labels, known, under)
        setting = ground.textured(setting, view)
        picture = ground_texture.over_bed(picture, plate.kept, setting.terrain.mesh, camera)
    setting = ground.finished(setting, picture, camera, vessel)
    if fluid.hidden is not None:  # what stands before the fluid is on no ground, but in the picture without the fluid
        typical = typical_picture(clip.frames, most=8).astype(np.uint8)
        picture = np.where(fluid.hidden[..., None], typical, picture)
    return setting, picture


def _hidden(seen: Sight, segmentation: Segmentation) -> np.ndarray | None:
    """Pixels in which something stands before a fall."""
    if not seen.kind.enters_over_rim:
        return None
    ever = FluidMasks(segmentation.labels.labels).any_frame()
    found = occluders.occluders(seen.mask, ever, seen.motion, seen.trust)
    return found if found.any() else None


def _solid_before(
    s: Sighted, fluid: FluidMasks, camera: PinholeCamera, vessel: filled_vessel.FilledVessel | None
) -> np.ndarray | None:
    """Pixels in which something solid stands in or before the fluid; None: those of the labels."""
    if s.seen.stood is not None:
        return s.seen.stood.solid
    if vessel is None or not vessel.looked_into:
        return None
    walls = filled_vessel.behind_its_wall(vessel, camera, fluid.any_frame())
    return walls | (ground.solid_share(fluid.labels) > 0.5)


def _seen_speed(visible, velocities, trust) -> np.ndarray:
    """m/s of the surface at each pixel; nan where there is none, or its motion is a guess."""
    speed = np.full(visible.shape, np.nan)
    speed[visible] = np.where(trust[visible] > 0.3, np.linalg.norm(velocities, axis=1), np.nan)
    return speed
