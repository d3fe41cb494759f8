"""The stage that builds the scene: kind, up, front surface, metres, terrain."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, cast

import numpy as np

from fluidlift.config import JobConfig
from fluidlift.errors import InputRejected
from fluidlift.pipeline import composite, dam, depths, given_body, ground
from fluidlift.pipeline.known_camera import known_camera, level_of
from fluidlift.pipeline.reading import Inputs, clip_of
from fluidlift.pipeline.seeing import masks_of, mean_motion
from fluidlift.pipeline.story import Result, Story
from fluidlift.shape import (
    generate,
    ground_mesh,
    ground_texture,
    place,
    puddle,
    standing,
    surface,
    terrain,
    texture_gradient,
)
from fluidlift.shape import kind as kinds
from fluidlift.shape.frame_pictures import typical_picture
from fluidlift.shape.framing import framing_warnings
from fluidlift.shape.given_depth import DepthPictures
from fluidlift.shape.kinds import Observation, builder_of
from fluidlift.shape.view import look_at
from fluidlift.types import (
    CellType,
    FluidKind,
    Gaussians,
    Grid,
    PinholeCamera,
    Similarity3,
    Terrain,
    TriangleMesh,
    kind_of,
)
from fluidlift.types.kind import STREAM

FEWEST_PIXELS = 16
"""of fluid at the first instant: fewer have no shape"""


def rest_frame(area: np.ndarray) -> int:
    """First frame in which a good part of the fluid is there (smoke and pours begin with nothing), of areas [T]."""
    enough = area >= 0.3 * np.percentile(area, 90)
    return int(np.argmax(enough)) if enough.any() else int(np.argmax(area))


@dataclass(frozen=True)
class _Sight:
    """What the stages before have seen, and how the camera is taken to stand."""

    start: int
    """frame of the body at rest"""
    united: int
    """frames in all that become one body"""
    mask: np.ndarray
    motion: np.ndarray
    trust: np.ndarray
    known: PinholeCamera
    """its pose counts where `pose_given`"""
    pose_given: bool
    evidence: kinds.KindEvidence
    kind: FluidKind
    parts: composite.Parts
    up: kinds.UpEvidence
    heading: float | None
    tilt_known: bool
    height: float | None
    """of the camera above the water, in the units of its file, where that is known"""
    unsure: str
    """what to say of that height; empty: nothing"""
    stood: standing.StandingBody | None = None
    """of a dam"""

    @property
    def lying_trust(self) -> np.ndarray:
        """Trust in the motion of what lies."""
        return self.trust * ~self.parts.falling


def geometry(story: Story, inputs: Inputs, config: JobConfig) -> Result:
    """Kind, camera, front surface, scale, terrain, cells."""
    clip, fluid, c = clip_of(story), masks_of(story), config.shape
    seen, pictures = _seen(story, inputs, config)
    kind, parts, mask = seen.kind, seen.parts, seen.mask
    up, canonical, front, known_scale, seen_depth = _surface(seen, pictures, fluid, inputs, clip.interval)
    warnings = framing_warnings(mask, fluid.areas()) + up.warnings
    front, falling = composite.standing(front, parts, canonical, mask)
    visible = mask & (front.depth > 0)
    if 0 < visible.sum() < FEWEST_PIXELS:
        raise InputRejected(
            f"only {int(visible.sum())} fluid pixels at frame {seen.start}", f"at least {FEWEST_PIXELS}",
            "check the mask, or raise --max-size",
        )  # fmt: skip
    points, velocities = _surface_motion(canonical, visible, front.sighted, seen.motion, clip.interval)
    falls, trust = falling.pixels[visible], seen.trust[visible]
    sighting = place.Sighting(trust, clip.interval, up.pitch)
    if seen.stood is not None:
        scale = standing.standing_scale(
            seen.stood, size=c.size, height=seen.height,
            speed=lambda: dam.front_speed(fluid, seen.start, canonical, seen.stood) / clip.interval,
        )  # fmt: skip
    else:
        scale = place.metric_scale(
            kind, points, velocities, size=c.size, camera_height=seen.height, known_scale=known_scale, seen=sighting
        )
    if seen_depth is not None:
        scale = depths.with_learned_scale(scale, seen_depth, points)
        warnings += depths.size_warnings(scale.across, seen_depth, seen.height, points)
    scale, sentence = _told(composite.with_fall(scale, points, velocities, falls, sighting), seen)
    warnings += [scale.warning] * bool(scale.warning)
    mainstream = _mainstream(kind, velocities[~falls], trust[~falls]) if seen.stood is None else seen.stood.direction
    eye = seen.known.position if seen.pose_given else None
    to_world, camera = place.place(canonical, points, scale.value, heading=seen.heading, eye=eye, mainstream=mainstream)
    depth = (front.depth * scale.value).astype(np.float32)
    half = (front.half_thickness * scale.value).astype(np.float32)
    bulk = to_world.vectors(mainstream) / to_world.scale
    scene = None if seen_depth is None else np.where(mask, np.nan, seen_depth.scene.depth * scale.value)
    if seen.stood is not None:
        setting = standing.standing_setting(seen.stood, to_world, bulk, longest=c.cells, limit=c.cell_limit)
    else:
        setting = ground.setting_around(
            kind, front, fluid, seen.start, seen.united, camera, to_world, depth, half, bulk, c, falling.pixels,
            speed=_seen_speed(visible, velocities * scale.value, seen.trust), scene_depth=scene, closed=parts.puddle,
        )  # fmt: skip
        setting = composite.composed(setting, falling, to_world, points[~falls], velocities[~falls], camera)
    if not (setting.cell_types == CellType.FLUID).any():
        raise InputRejected(
            f"as a {kind}, the fluid fills no cell of the grid beside those of its inlet", "a larger or thicker body",
            "check the mask and --kind, or raise --set shape.cells=...",
        )  # fmt: skip
    # the plate looks at a few frames only
    plate = generate.background_plate(clip.frames, cast(Any, fluid), ground.solid_share(fluid.labels) > 0.5)
    picture = plate.image
    if setting.surface_height is not None:
        labels = ground.seen_labels(fluid, seen.start, seen.united, falling.pixels)
        view = ground_texture.View(picture, camera, labels, np.asarray(plate.seen))
        setting = ground.textured(setting, view)
        picture = ground_texture.over_bed(picture, view.seen, setting.terrain.mesh, camera)
    arrays, meta = ground.packed(setting)
    if seen.stood is not None:
        arrays["rocks"] = seen.stood.solid
    arrays |= {
        "mask": mask, "depth": depth, "half_thickness": half, "mean_flow": seen.motion, "mean_confidence": seen.trust,
        "sighted_depth": (front.sighted * scale.value).astype(np.float32), "plate": picture,
    }  # fmt: skip
    meta |= {
        "warnings": warnings, "kind": kind.name, "kind_evidence": asdict(seen.evidence),
        "kind_source": "evidence" if c.kind == "auto" else "user", "up": asdict(up),
        "scale": asdict(scale) | {"sentence": sentence}, "camera": camera.to_dict(),
        "world_from_canonical": {
            "scale": to_world.scale, "rotation": to_world.rotation.tolist(),
            "translation": to_world.translation.tolist(),
        },
        "known_scale": known_scale, "depth_source": None if seen_depth is None else seen_depth.meta,
        "jets": falling.plain(to_world), "slope": None if front.slope is None else asdict(front.slope),
        "rest_frame": seen.start, "united_frames": seen.united,
    }  # fmt: skip
    return Result(arrays, meta)


def _seen(story: Story, inputs: Inputs, config: JobConfig) -> tuple[_Sight, DepthPictures | None]:
    """Mask, motion, kind and camera; and depth pictures where there are some."""
    clip, fluid, c = clip_of(story), masks_of(story), config.shape
    start, united = united_range(story, config)
    mask = generate.united_mask(fluid[start : start + united])
    if not mask.any():
        mask = fluid[start]
    motion, trust = mean_motion(story, fluid.any_frame())
    known, pose_given = known_camera(inputs, config, clip.size)
    pictures, known = _depth_pictures(story, inputs, config, known, start)
    evidence, kind, parts, up, heading = _kind_and_up(
        story, inputs, config, known, pose_given, mask, motion, trust, shaped=pictures is not None
    )
    height, unsure, stood = None, "", None
    if pose_given and kind.surveyed_level is not None:
        level, unsure = level_of(kind.surveyed_level, inputs)
        height = float(known.position[2] - level)
    if kind.starts_at_rest:
        start, united = dam.let_go(fluid), 1
        mask = fluid[start]
        parts = composite.Parts((), mask)
        stood = dam.stood(fluid, start, kinds.level_camera(known, up))
    tilt_known = pose_given or c.pitch is not None
    seen = _Sight(
        start, united, mask, motion, trust, known, pose_given, evidence, kind, parts, up, heading, tilt_known, height,
        unsure, stood,
    )  # fmt: skip
    return seen, pictures


def _surface(seen: _Sight, pictures: DepthPictures | None, fluid, inputs: Inputs, interval: float):
    """Up, the level camera, the surface of what lies, metres per unit where they are known, and the depth behind it."""
    lying, up = seen.parts.lying, seen.up
    canonical = kinds.level_camera(seen.known, up)
    observed = _observation(seen, canonical, interval)
    front, known_scale = _front(seen, inputs, observed)
    if seen.parts.puddle:
        front = surface.level_surface(canonical, lying)
    if pictures is None:
        return up, canonical, front, known_scale, None
    found = depths.depth_front(pictures, fluid, seen.known, up, seen.kind, observed, expected=front)
    return found.up, kinds.level_camera(seen.known, found.up), found.front, found.known_scale, found


def _told(scale: place.MetricScale, seen: _Sight) -> tuple[place.MetricScale, str]:
    """The scale with its warning, and its sentence, where the level of the water or the ground was assumed."""
    if seen.unsure and scale.source == "camera":
        what = "water" if seen.stood is None else "ground"
        return replace(scale, warning=seen.unsure), f"{scale.sentence}, with the {what} at z = 0, assumed"
    return scale, scale.sentence


def _kind_and_up(story, inputs, config, known, pose_given, mask, motion, trust, *, shaped):
    """Evidence for the kind, the kind, the tilt of the camera, and its heading where it was surveyed."""
    clip, fluid, c = clip_of(story), masks_of(story), config.shape
    surveyed, heading = place.pose_up(known)
    pitch = float(surveyed.pitch) if pose_given else c.pitch
    pick = np.unique(np.linspace(0, len(clip) - 1, 8).astype(int))
    evidence = kinds.estimate_kind(clip.frames[pick], fluid[pick], motion, trust, pitch=pitch)
    kind = kind_of(evidence.kind if c.kind == "auto" else c.kind)
    if kind.starts_at_rest and (shaped or inputs.geometry is not None):
        if c.kind != "auto":
            raise InputRejected(
                f"--kind {kind} together with a given depth or body", "one source of the fluid's shape", "leave one out"
            )
        others = [k for k in evidence.scores if not kind_of(k).starts_at_rest]
        kind = kind_of(max(others, key=lambda k: evidence.scores[k]))
    if inputs.geometry is None:
        kind, parts = composite.split(
            kind, known, surveyed if pose_given else None, mask, motion, trust, free=c.kind == "auto"
        )
        if kind.fills_vessel and c.kind == "auto":
            poured = puddle.jets_into_puddle(known, surveyed if pose_given else None, mask, motion, trust)
            if poured is not None:
                kind, parts = STREAM, composite.Parts(poured.jets, poured.lying, puddle=True)
    else:
        parts = composite.Parts((), mask)
    if pose_given:
        return evidence, kind, parts, surveyed, heading
    generated = given_body.note_of(inputs.geometry) is not None
    if inputs.geometry is not None and not (generated and (c.pitch is not None or c.roll is not None)):
        upright = given_body.up_of(inputs.geometry, surveyed, kind, rest_frame(fluid.areas()), clip.size)
        if upright is not None:
            return evidence, kind, parts, upright, None
    texture = None
    if kind.nearly_level and c.pitch is None and not parts.puddle:
        texture = texture_gradient.texture_patches(clip.frames, parts.lying & ~parts.falling)
    typical = typical_picture(clip.frames[pick]).astype(np.uint8)
    picture = look_at(kind, typical, fluid.any_frame(), parts.lying, texture, stays=parts.puddle)
    up = kinds.estimate_up(
        kind, parts.lying, motion, trust * ~parts.falling, known, picture, given=(c.pitch, c.roll),
        level_prior=composite.level_prior(parts, motion, trust),
    )  # fmt: skip
    if c.roll is None:
        up = composite.with_roll(up, parts, known)
    return evidence, kind, parts, up, None


def united_range(story: Story, config: JobConfig) -> tuple[int, int]:
    """First frame whose body is wanted, and how many in all become one."""
    from fluidlift.shape.unite import window_length

    frames, fluid, longest = clip_of(story).frames, masks_of(story), config.shape.longest_union
    start = rest_frame(fluid.areas())
    stop = min(len(frames), start + 2 * longest + 1)
    return start, int(min(window_length(frames[start:stop], fluid[start], longest=longest), len(frames) - start))


def _depth_pictures(story, inputs, config, known, start) -> tuple[DepthPictures | None, PinholeCamera]:
    """Depth from a file or a model, and the camera with the model's field of view where nothing else says it."""
    from fluidlift.io.lens import lens_field_of_view

    told = inputs.camera is not None or config.shape.fov or lens_field_of_view(inputs.clip)
    pictures = depths.pictures_of(story, inputs, config, known if told else None, start)
    if pictures is not None and not told and pictures.field_of_view is not None:
        known = PinholeCamera.from_fov(pictures.field_of_view, known.size)
    return pictures, known


def _observation(seen: _Sight, canonical: PinholeCamera, interval: float) -> Observation:
    """What lies, as the builder of its kind wants it."""
    return Observation(
        canonical, seen.parts.lying, seen.motion, seen.lying_trust, interval, camera_height=seen.height,
        tilt_known=seen.tilt_known, level_prior=composite.level_prior(seen.parts, seen.motion, seen.trust),
        roll=seen.up.roll, standing=seen.stood,
    )  # fmt: skip


def _front(seen: _Sight, inputs: Inputs, observed: Observation):
    """The front surface in canonical units; metres per unit where the depth came in metres, else None."""
    if inputs.geometry is not None:
        return given_body.given_front(inputs.geometry, observed.camera, observed.mask, seen.kind, seen.start)
    return builder_of(seen.kind).front_surface(observed), None


def _surface_motion(camera, visible, depth, motion, interval) -> tuple[np.ndarray, np.ndarray]:
    """Canonical points on the fluid and their velocities (units/s), moving along the surface."""
    from scipy import ndimage

    grid = camera.pixel_grid()
    uv = grid[visible]
    if len(uv) == 0:
        raise InputRejected(
            "no fluid pixel has a depth", "a surface that the camera sees", "give --pitch or another --kind"
        )
    points = camera.unproject(uv, depth[visible])
    index = ndimage.distance_transform_edt(~visible, return_distances=False, return_indices=True)
    whole = depth[tuple(index)]
    end = uv + motion[visible]
    row = np.clip(end[:, 1] - 0.5, 0, depth.shape[0] - 1)
    col = np.clip(end[:, 0] - 0.5, 0, depth.shape[1] - 1)
    later = ndimage.map_coordinates(whole, np.stack([row, col]), order=1)
    return points, (camera.unproject(end, later) - points) / interval


def _mainstream(kind: FluidKind, velocities: np.ndarray, trust: np.ndarray) -> np.ndarray:
    """Bulk direction: confident and fast motion counts most; bodies in the air move along the vertical."""
    speed = np.linalg.norm(velocities, axis=1)
    capped = velocities * np.minimum(1.0, np.percentile(speed, 95) / np.maximum(speed, 1e-12))[:, None]
    bulk = (capped * (trust * np.linalg.norm(capped, axis=1))[:, None]).sum(axis=0)
    bulk = builder_of(kind).mainstream(bulk)
    norm = np.linalg.norm(bulk)
    return bulk / norm if norm > 1e-12 else np.array([1.0, 0.0, 0.0])


def _seen_speed(visible, velocities, trust) -> np.ndarray:
    """m/s of the surface at each pixel; nan where there is none, or its motion is a guess."""
    speed = np.full(visible.shape, np.nan)
    speed[visible] = np.where(trust[visible] > 0.3, np.linalg.norm(velocities, axis=1), np.nan)
    return speed


# what later stages see ------------------------------------------------------------------------------------------


def camera_of(story: Story) -> PinholeCamera:
    """The video's camera in the world."""
    return PinholeCamera.from_dict(story["geometry"].meta["camera"])


def grid_of(story: Story) -> Grid:
    """The simulation grid."""
    g = story["geometry"].meta["grid"]
    return Grid(tuple(g["shape"]), g["spacing"], tuple(g["origin"]))


def placement_of(story: Story) -> Similarity3:
    """world_from_canonical."""
    t = story["geometry"].meta["world_from_canonical"]
    return Similarity3(t["scale"], np.array(t["rotation"]), np.array(t["translation"]))


def terrain_of(story: Story) -> Terrain:
    """The solid, textured from the background plate."""
    a = story["geometry"].arrays
    mesh = TriangleMesh(
        a["mesh_vertices"], a["mesh_faces"], a.get("mesh_colours"), a.get("mesh_uv"), a.get("mesh_texture")
    )
    if len(mesh.faces) and mesh.colors is None:
        mesh = replace(mesh, colors=ground_mesh.ground_colours(mesh, a["plate"], camera_of(story)))
    return Terrain(grid_of(story), a["signed_distance"], a["mainstream"], mesh)


def setting_of(story: Story) -> terrain.Setting:
    """Terrain and cells."""
    a, meta = story["geometry"].arrays, story["geometry"].meta
    return terrain.Setting(
        terrain_of(story), a["cell_types"], a.get("surface_height"), a["bed_height"], meta["pool_level"]
    )


def gaussians_to_arrays(g: Gaussians) -> dict[str, np.ndarray]:
    """Fields by name."""
    return {k: getattr(g, k) for k in ("means", "quats", "scales", "opacities", "sh")}


def gaussians_from_arrays(arrays: dict[str, np.ndarray]) -> Gaussians:
    """The reverse of `gaussians_to_arrays`."""
    return Gaussians(*(arrays[k] for k in ("means", "quats", "scales", "opacities", "sh")))


def rest_of(story: Story) -> Gaussians:
    """The rest body."""
    return gaussians_from_arrays(story["refine"].arrays)
