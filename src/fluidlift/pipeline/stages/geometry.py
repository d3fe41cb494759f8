"""The stage that builds the scene: kind, up, front surface, metres, terrain."""

from __future__ import annotations

from typing import Any, cast

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.look.smoke_film import behind_smoke
from fluidlift.pipeline.bed_seen import BedPicture, bed_of
from fluidlift.pipeline.settings import GeometrySettings, GivenView
from fluidlift.pipeline.sight import Sight, Sighted, mainstream_of, sighted
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
from fluidlift.types import (
    CellType,
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
    seen, canonical, front, falling, visible = s.seen, s.canonical, s.front, s.falling, s.visible
    kind, parts, mask, points, velocities, scale = seen.kind, seen.parts, seen.mask, s.points, s.velocities, s.scale
    falls, trust, seen_depth = falling.pixels[visible], seen.trust[visible], s.seen_depth
    hidden = _hidden(seen, segmentation)
    fluid = FluidMasks(segmentation.labels.labels, hidden)
    if front.vessel is not None:
        mainstream = np.array(front.vessel.inflow)
    elif seen.stood is not None:
        mainstream = seen.stood.direction
    else:
        counted = trust if seen.said_flow is None else trust * _said(seen.said_flow, visible & ~falling.pixels)[visible]
        mainstream = mainstream_of(kind, velocities[~falls], counted[~falls])
    eye = seen.known.position if seen.pose_given else None
    to_world, camera = registration.place(
        canonical, points, scale.value, heading=seen.heading, eye=eye, mainstream=mainstream
    )
    depth = (front.depth * scale.value).astype(np.float32)
    half = (front.half_thickness * scale.value).astype(np.float32)
    bulk = to_world.vectors(mainstream) / to_world.scale
    scene = None if seen_depth is None else np.where(mask, np.nan, seen_depth.scene.depth * scale.value)
    if seen.stood is not None:
        setting = standing.standing_setting(seen.stood, to_world, bulk, longest=c.cells, limit=c.cell_limit)
    else:
        setting = ground.setting_around(
            kind, front, fluid, seen.start, seen.united, camera, to_world, depth, half, bulk, c, falling.pixels,
            speed=None if kind.is_standing_water else _seen_speed(visible, velocities * scale.value, seen.trust),
            scene_depth=scene, in_metres=scale.source != "assumed",
            closed=parts.puddle or kind.is_standing_water, goes_on=kind.is_standing_water,
            pool=parts.lying if kind.rises_from_pool else None,
        )  # fmt: skip
        setting = composite.composed(setting, falling, to_world, points[~falls], velocities[~falls], camera)
    if not (setting.cell_types == CellType.FLUID).any():
        raise InputRejected(
            f"as a {kind}, the fluid fills no cell of the grid beside those of its inlet", "a larger or thicker body",
            "check the mask and --kind, or raise --set shape.cells=...",
        )  # fmt: skip
    bed = bed_of(clip, fluid, seen, setting, camera, depth)
    setting, picture = _coloured(setting, clip, fluid, seen, falling.pixels, camera, bed)
    return Geometry(
        kind=kind.name,
        kind_source=s.kind_source,
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
        rocks=_solid_before(s, fluid, camera, to_world),
        hidden=hidden,
        known_scale=s.known_scale,
        depth_source=None if seen_depth is None else seen_depth.meta,
        jets=tuple(falling.plain(to_world)),
        slope=front.slope,
        said_flow=seen.said_flow,
        bed=None if bed is None else bed.evidence,
        warnings=tuple(s.warnings),
    )


def _said(flow: SaidFlow, visible: np.ndarray) -> np.ndarray:
    """bool [h,w]: pixels whose motion says where the mainstream runs, those that a person's arrows speak for."""
    return flow.counts if (flow.counts & visible).any() else np.ones(visible.shape, bool)


def _coloured(
    setting: Setting,
    clip: VideoClip,
    fluid: FluidMasks,
    seen: Sight,
    falls: np.ndarray,
    camera: PinholeCamera,
    bed: BedPicture | None = None,
) -> tuple[Setting, np.ndarray]:
    """The setting with its ground as the clip shows it, and the picture without the fluid, u8 [h,w,3].

    bed: what is seen of it through the water.
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
        view = ground_texture.View(shown, camera, labels, known, under)
        setting = ground.textured(setting, view)
        picture = ground_texture.over_bed(picture, plate.kept, setting.terrain.mesh, camera)
    setting = ground.finished(setting, picture, camera)
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


def _solid_before(s: Sighted, fluid: FluidMasks, camera: PinholeCamera, to_world: Similarity3) -> np.ndarray | None:
    """Pixels in which something solid stands in or before the fluid; None: those of the labels."""
    if s.seen.stood is not None:
        return s.seen.stood.solid
    if s.front.vessel is None or not s.front.vessel.looked_into:
        return None
    walls = filled_vessel.behind_its_wall(s.front.vessel.transformed(to_world), camera, fluid.any_frame())
    return walls | (ground.solid_share(fluid.labels) > 0.5)


def _seen_speed(visible, velocities, trust) -> np.ndarray:
    """m/s of the surface at each pixel; nan where there is none, or its motion is a guess."""
    speed = np.full(visible.shape, np.nan)
    speed[visible] = np.where(trust[visible] > 0.3, np.linalg.norm(velocities, axis=1), np.nan)
    return speed
