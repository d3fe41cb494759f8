"""Kind of fluid, pose of the camera, visible surface and metric scale: the first half of the stage geometry.

In the order of the calls: `_seen` (mask, mean motion, lens, kind, tilt), `_surface` (depth of the visible surface in
the canonical frame, whose camera is level), `_scale` (metres per canonical unit).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.messages import NONE, Notice
from fluidlift.motion.steady_flow import bulk_motion, mean_motion
from fluidlift.pipeline import depths, given_body, views
from fluidlift.pipeline.inputs import GivenFile
from fluidlift.pipeline.known_camera import (
    MODEL_LENS_ERROR,
    USUAL_FIELD_OF_VIEW,
    USUAL_SPREAD,
    known_camera,
    level_of,
    with_model_lens,
)
from fluidlift.pipeline.settings import GeometrySettings, GivenView
from fluidlift.pipeline.work import Work
from fluidlift.shape import (
    composite,
    dam,
    filled_vessel,
    generate,
    puddle,
    registration,
    standing,
    surface,
    texture_gradient,
    thrown,
)
from fluidlift.shape import kind as kinds
from fluidlift.shape.drawn import region_pixels
from fluidlift.shape.drawn_flow import heard
from fluidlift.shape.frame_pictures import typical_picture
from fluidlift.shape.framing import framing_warnings
from fluidlift.shape.given_depth import DepthPictures
from fluidlift.shape.kinds import Observation, builder_of
from fluidlift.shape.rest_frames import FEWEST_PIXELS, rest_frame, united_range
from fluidlift.shape.slope import STEEP, SlopePrior, steepness
from fluidlift.shape.view import (
    Ellipse,
    LearnedTilt,
    MeasuredPlane,
    Skyline,
    as_relief,
    drawn_rim,
    find_rims,
    look_at,
    sky_of,
    tilt_of_horizon,
)
from fluidlift.types import (
    FluidKind,
    KindEvidence,
    MetricScale,
    PinholeCamera,
    SaidFlow,
    UpEvidence,
    VideoClip,
    kind_of,
)
from fluidlift.types.fluid_masks import FluidMasks
from fluidlift.types.kind import STREAM
from fluidlift.types.stages import Flow, Read, Segmentation

USUALLY = 0.25
"""share of the frames in which a pixel must be fluid to count as part of a body that may be thrown up: spray comes and
goes"""


@dataclass(frozen=True)
class Sight:
    """Kind of fluid and pose of the camera, with the evidence that they are inferred from; pixels are [h,w]."""

    start: int
    """frame of the body at rest"""
    united: int
    """frames in all that become one body"""
    mask: np.ndarray
    """bool, of the body at rest"""
    motion: np.ndarray
    """[h,w,2] px per frame, mean over the clip"""
    trust: np.ndarray
    """confidence of `motion`, 0 to 1"""
    known: PinholeCamera
    """the lens; its pose counts where `pose_given`"""
    pose_given: bool
    evidence: KindEvidence
    kind: FluidKind
    parts: composite.BodyParts
    up: UpEvidence
    heading: float | None
    tilt_known: bool
    height: float | None
    """of the camera above the water, in the units of its file, where that is known"""
    unsure: Notice
    """warning that goes with that height; empty: none"""
    stood: standing.StandingBody | None = None
    """of a dam"""
    kind_free: bool = True
    """evidence decided on the kind"""
    said_flow: SaidFlow | None = None
    """what a person says of the direction of the flow; `motion` holds it"""
    told: tuple[Notice, ...] = ()
    rims: tuple[Ellipse, ...] = ()
    """of vessels, as they were found"""
    steep: float = STEEP
    """degrees, scale of the prior of the slope of a stream that is not level"""
    heeded_rims: tuple[Ellipse, ...] = ()
    """those that a person drew, or else those that were found"""

    @property
    def lying_trust(self) -> np.ndarray:
        """Trust in the motion of what lies."""
        return self.trust * ~self.parts.falling


@dataclass(frozen=True)
class Sighted:
    """The fluid as the camera sees it: its visible surface in the canonical frame, and what that is in metres."""

    seen: Sight
    up: UpEvidence
    canonical: PinholeCamera
    """level, at the origin"""
    front: Any
    falling: Any
    visible: np.ndarray
    """bool [h,w]: pixels with a depth"""
    points: np.ndarray
    """[n,3] canonical, of the visible pixels"""
    velocities: np.ndarray
    """[n,3] units per second"""
    scale: MetricScale
    sentence: str
    """the scale in words"""
    known_scale: float | None
    """m per unit, of depth in metres"""
    seen_depth: depths.DepthFront | None
    warnings: list[Notice]


def sighted(
    read: Read, flow: Flow, segmentation: Segmentation, given: GivenView, config: GeometrySettings, *, work: Work
) -> Sighted:
    """Kind, camera, front surface and scale.

    Args:
        read: the clip.
        flow: of it.
        segmentation: of it.
        given: what a person has of camera, body and depth.
        config: what a person says of the fluid.
        work: keeps a learned model's depth.

    Raises:
        InputRejected: a fluid without a shape, or something given that does not fit.
    """
    clip, c = read.clip, config
    fluid = FluidMasks(segmentation.labels.labels)
    seen, pictures = _seen(read, flow, segmentation, given, config, work)
    parts, mask = seen.parts, seen.mask
    up, canonical, front, known_scale, seen_depth = _surface(seen, pictures, fluid, given, clip.interval)
    warnings = framing_warnings(mask, fluid.areas()) + up.warnings + composite.unused_marks(parts, front)
    warnings += [*seen.told, *_unused_flow(seen, front.vessel is not None)]
    if c.kind == "auto":
        warnings += kinds.doubts(seen.evidence, seen.kind.name)
    front, falling = composite.standing(front, parts, canonical, mask)
    visible = mask & (front.depth > 0)
    if 0 < visible.sum() < FEWEST_PIXELS:
        raise InputRejected(
            f"only {int(visible.sum())} fluid pixels at frame {seen.start}", f"at least {FEWEST_PIXELS}",
            "check the mask, or raise --max-size",
        )  # fmt: skip
    points, velocities = _surface_motion(canonical, visible, front.sighted, seen.motion, clip.interval)
    falls, trust = falling.pixels[visible], seen.trust[visible]
    seen_velocities = registration.VelocityEvidence(trust, clip.interval, up.pitch)
    chutes = tuple(part[visible] for part in front.chutes)
    moving = _Moving(points, velocities, falls, chutes, seen_velocities, known_scale)
    scale, sentence, told = _scale(seen, moving, seen_depth, c, fluid, canonical)
    warnings += told
    return Sighted(
        seen, up, canonical, front, falling, visible, points, velocities, scale, sentence, known_scale, seen_depth,
        list(warnings),
    )  # fmt: skip


@dataclass(frozen=True)
class _Moving:
    """Points on the surface, canonical, and how they move."""

    points: np.ndarray
    velocities: np.ndarray
    """units per second"""
    falls: np.ndarray
    """bool: of jets"""
    chutes: tuple[np.ndarray, ...]
    """bool, of each"""
    seen_velocities: registration.VelocityEvidence
    known_scale: float | None
    """m per unit, of depth in metres"""


def _scale(
    seen: Sight, moving: _Moving, seen_depth: depths.DepthFront | None, c: GeometrySettings, fluid: FluidMasks,
    canonical: PinholeCamera,
) -> tuple[MetricScale, str, list[Notice]]:  # fmt: skip
    """Metres per canonical unit, in words, and warnings."""
    points, velocities, stood, warnings, size = moving.points, moving.velocities, seen.stood, [], c.size
    if c.drawn is not None and c.drawn.ruler is not None:
        scale = registration.ruler_scale(canonical, points, c.drawn.ruler)
        return scale, scale.sentence, []
    if stood is not None:
        scale = standing.standing_scale(
            stood, size=size, height=seen.height,
            speed=lambda: dam.front_speed(fluid, seen.start, canonical, stood) / moving.seen_velocities.interval,
        )  # fmt: skip
    else:
        scale = registration.metric_scale(
            seen.kind, points, velocities, size=size, camera_height=seen.height, known_scale=moving.known_scale,
            seen=moving.seen_velocities, usual=seen.kind.usual_size(seen.up.pitch - seen.up.raised),
        )  # fmt: skip
    if seen_depth is not None:
        scale = depths.with_learned_scale(scale, seen_depth, points)
        warnings += depths.size_warnings(scale.across, seen_depth, seen.height, points)
    scale = composite.with_fall(scale, points, velocities, moving.falls, moving.seen_velocities)
    scale = composite.with_chute(scale, points, velocities, moving.chutes, moving.seen_velocities)
    scale, sentence = _told(scale, seen)
    return scale, sentence, warnings + [scale.warning] * bool(scale.warning)


def _seen(
    read: Read, flow: Flow, segmentation: Segmentation, given: GivenView, config: GeometrySettings, work: Work
) -> tuple[Sight, DepthPictures | None]:
    """Mask, motion, kind and camera; and depth pictures where there are some."""
    clip, fluid = read.clip, FluidMasks(segmentation.labels.labels)
    start, united = united_range(clip, fluid, config.longest_union)
    mask = generate.united_mask(fluid[start : start + united])
    if not mask.any():
        mask = fluid[start]
    motion, trust, bulk = work.remembered("motion at large", _motion_at_large, read, flow, segmentation)
    arrows = () if config.drawn is None else config.drawn.flow
    said = heard(arrows, mask, motion, trust) if arrows else None
    if said is not None:
        motion, trust = said.mean(motion, trust)
    known, pose_given, lens_told = known_camera(given, config.fov, clip.size)
    if read.view is not None and np.isfinite(read.view.focal_error) and not lens_told:
        known = replace(known, focal=(read.view.focal, read.view.focal))
    pictures, known, lens_error = _depth_pictures(read, given, lens_told, known, start, work)
    learned, known = (None, known) if pose_given else _learned_tilt(read, given, config, known, lens_error, start, work)
    pick = np.unique(np.linspace(0, len(clip) - 1, 8).astype(int))
    typical = typical_picture(clip.frames[pick]).astype(np.uint8)
    rims = work.remembered("rims", find_rims, typical)
    looked = _Looked(
        clip, fluid, mask, motion, trust, bulk if said is None else None, pick, typical, rims, _measured_plane(read),
        learned, work.remembered("up and down", _up_and_down, read, segmentation),
    )  # fmt: skip
    evidence, kind, parts, up, heading, steep = _kind_and_up(
        looked, given, config, known, pose_given, shaped=pictures is not None
    )
    if kind.rises_from_pool:  # what falls back is taken to land in it, seen or not
        mask = mask | parts.lying
    height, unsure, stood = None, NONE, None
    if pose_given and kind.surveyed_level is not None:
        level, unsure = level_of(kind.surveyed_level, given.camera)
        height = float(known.position[2] - level)
    if kind.starts_at_rest:
        start, united = dam.let_go(fluid), 1
        mask = fluid[start]
        parts = composite.BodyParts((), mask)
        stood = dam.stood(fluid, start, kinds.level_camera(known, up))
    horizon = config.drawn is not None and config.drawn.horizon is not None and up.raised == 0.0
    tilt_known = pose_given or config.pitch is not None or horizon
    seen = Sight(
        start, united, mask, motion, trust, known, pose_given, evidence, kind, parts, up, heading, tilt_known, height,
        unsure, stood, config.kind == "auto", *((None, ()) if said is None else (said.flow, said.warnings)), rims,
        steep, _said_of_view(config, known, mask.shape).rims or rims,
    )  # fmt: skip
    return seen, pictures


def _motion_at_large(
    read: Read, flow: Flow, segmentation: Segmentation
) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Mean motion over the clip with its confidence, and the bulk motion of fluid and ground in each pair of frames."""
    fluid = FluidMasks(segmentation.labels.labels)
    ever = fluid.any_frame()
    motion, trust = mean_motion(read.clip, flow.flow, ever)
    return motion, trust, bulk_motion(read.clip, flow.flow, fluid.__getitem__, ever)


def _up_and_down(read: Read, segmentation: Segmentation) -> thrown.Thrown:
    """What of the fluid rises and what falls, over consecutive frames."""
    return thrown.thrown(read.clip.frames, FluidMasks(segmentation.labels.labels).shares() > USUALLY)


def _surface(seen: Sight, pictures: DepthPictures | None, fluid: FluidMasks, given: GivenView, interval: float):
    """Up, the level camera, the surface of what lies, metres per unit where they are known, and the depth behind it."""
    lying, up = seen.parts.lying, seen.up
    canonical = kinds.level_camera(seen.known, up)
    observed = _observation(seen, canonical, interval, fluid)
    front, known_scale = _front(seen, given.bodies, observed)
    if seen.parts.puddle:
        front = surface.level_surface(canonical, lying)
    if pictures is None:
        return up, canonical, front, known_scale, None
    found = depths.depth_front(pictures, fluid, seen.known, up, seen.kind, observed, expected=front)
    return found.up, kinds.level_camera(seen.known, found.up), found.front, found.known_scale, found


def _unused_flow(seen: Sight, in_vessel: bool) -> list[Notice]:
    """What to say of a direction of the flow that the way of the fluid does not follow."""
    if seen.said_flow is None or (seen.stood is None and not in_vessel):
        return []
    return [
        Notice(
            "flow-not-used",
            "the direction of the flow that was drawn does not decide where a body that is let go runs, or how a jet "
            "falls into its vessel: that is read from their outlines; give --kind stream or fall if it is neither",
        )
    ]


def _told(scale: MetricScale, seen: Sight) -> tuple[MetricScale, str]:
    """The scale with its warning, and its sentence, where the level of the water or the ground was assumed."""
    if seen.unsure and scale.source == "camera":
        what = "water" if seen.stood is None else "ground"
        return replace(scale, warning=seen.unsure), f"{scale.sentence}, with the {what} at z = 0, assumed"
    return scale, scale.sentence


@dataclass(frozen=True)
class _Looked:
    """The pictures, and what moves in them."""

    clip: VideoClip
    fluid: FluidMasks
    mask: np.ndarray
    motion: np.ndarray
    trust: np.ndarray
    bulk: tuple[np.ndarray, np.ndarray] | None
    """mean motion of all of the fluid, and of the ground, in each pair of frames; None: a person said where it runs, so
    that it does not swing to and fro"""
    pick: np.ndarray
    """frames that stand for the clip"""
    typical: np.ndarray
    """their picture"""
    rims: tuple[Ellipse, ...]
    """of vessels, in that picture"""
    plane: MeasuredPlane | None = None
    """of the water, where the camera's path tells it"""
    learned: LearnedTilt | None = None
    """of the camera, by a learned model of the view"""
    ways: thrown.Thrown | None = None
    """how much goes up and how much comes down"""


def _measured_plane(read: Read) -> MeasuredPlane | None:
    """The plane of the water in the axes of the camera."""
    if read.view is None:
        return None
    stood = UpEvidence(read.view.pitch, read.view.roll, "path of the camera", 1.0)
    any_lens = PinholeCamera.from_fov(USUAL_FIELD_OF_VIEW, read.clip.size)
    return MeasuredPlane(kinds.level_camera(any_lens, stood).camera_from_world.rotation[:, 2])


def _kind_and_up(
    looked: _Looked, given: GivenView, config: GeometrySettings, known: PinholeCamera, pose_given: bool, *, shaped: bool
):
    """Evidence for the kind, the kind, the tilt of the camera, its heading where surveyed, and `slope.steepness`."""
    clip, fluid, mask, motion, trust = looked.clip, looked.fluid, looked.mask, looked.motion, looked.trust
    c, bodies = config, None if given.bodies is None else given.bodies.path
    surveyed, heading = registration.pose_up(known)
    said = _said_of_view(c, known, mask.shape)
    pitch = float(surveyed.pitch) if pose_given else said.pitch
    frames, shown = clip.frames[looked.pick], fluid[looked.pick]
    evidence = kinds.estimate_kind(
        frames,
        shown,
        motion,
        trust,
        pitch=pitch,
        bulk=looked.bulk,
        ways=looked.ways,
        rims=said.rims or looked.rims,
    )
    kind = kind_of(evidence.kind if c.kind == "auto" else c.kind)
    if kind.starts_at_rest and (shaped or bodies is not None):
        if c.kind != "auto":
            raise InputRejected(
                f"--kind {kind} together with a given depth or body", "one source of the fluid's shape", "leave one out"
            )
        others = [k for k in evidence.scores if not kind_of(k).starts_at_rest]
        kind = kind_of(max(others, key=lambda k: evidence.scores[k]))
    if bodies is None:
        tilt = surveyed if pose_given else None
        parts = composite.split(kind, known, tilt, mask, motion, trust)
        if c.kind == "auto" and (kind.fills_vessel or kinds.spreads(evidence)):
            poured = puddle.jet_over_pool(tilt, mask) or puddle.jets_into_puddle(known, tilt, mask, motion, trust)
            stays = poured is not None and not filled_vessel.in_vessel(said.rims or looked.rims, poured.lying)
            if poured is not None and stays and not puddle.grows_taller(poured, fluid.any_frame()):
                kind, parts = STREAM, composite.BodyParts(poured.jets, poured.lying, puddle=True)
    else:
        parts = composite.BodyParts((), mask)
    parts = composite.with_marks(parts, c.drawn, mask)
    if pose_given:
        return evidence, kind, parts, surveyed, heading, STEEP
    tilted = c.pitch is not None or c.roll is not None
    if bodies is not None and not (tilted and given_body.note_of(bodies) is not None):
        upright = given_body.up_of(bodies, surveyed, kind, rest_frame(fluid.areas()), clip.size)
        if upright is not None:
            return evidence, kind, parts, upright, None, STEEP
    texture = None
    if kind.nearly_level and c.pitch is None and not parts.puddle:
        texture = texture_gradient.texture_patches(clip.frames, parts.lying & parts.gentle)
    said = _said_of_view(c, known, mask.shape)
    picture = look_at(
        kind, looked.typical, fluid.any_frame(), parts.lying, texture, stays=parts.puddle,
        drawn_sky=said.sky, rims=said.rims or looked.rims,
    )  # fmt: skip
    picture = replace(picture, plane=looked.plane if kind.nearly_level else None, learned=looked.learned)
    up = kinds.estimate_up(
        kind, parts.lying, motion, trust * parts.gentle, known, picture, given=(said.pitch, said.roll),
        level_prior=composite.level_prior(parts, motion, trust),
    )  # fmt: skip
    if said.roll is None:
        up = composite.with_roll(up, parts, known)
    if c.pitch is None and kind.nearly_level and not shaped:
        up = as_relief(up, parts.lying & ~parts.falling, lambda tilted: kinds.level_camera(known, tilted))
    return evidence, kind, parts, up, None, steepness(picture)


@dataclass(frozen=True)
class _SaidOfView:
    """What a person says of the camera's tilt."""

    pitch: float | None
    roll: float | None
    sky: Skyline | None = None
    rims: tuple[Ellipse, ...] = ()


def _said_of_view(c: GeometrySettings, known: PinholeCamera, shape: tuple[int, ...]) -> _SaidOfView:
    """By number or by the horizon's line, and what speaks for it."""
    drawn = c.drawn
    if drawn is None:
        return _SaidOfView(c.pitch, c.roll)
    pitch, roll = (c.pitch, c.roll) if drawn.horizon is None else tilt_of_horizon(known, drawn.horizon)
    if drawn.level_line is not None and drawn.horizon is None:
        roll = tilt_of_horizon(known, drawn.level_line)[1]
    sky = sky_of(region_pixels(drawn.sky, (shape[0], shape[1])))
    return _SaidOfView(pitch, roll, sky, tuple(drawn_rim(r.center, r.axes, r.turned) for r in drawn.rims))


def _depth_pictures(
    read: Read, given: GivenView, told: bool, known: PinholeCamera, start: int, work: Work
) -> tuple[DepthPictures | None, PinholeCamera, float]:
    """Depth from a file or a model, and the camera with the model's field of view, weighed against the rest, where the
    lens was not told; and the relative standard deviation of its focal length then, 0 where it was told."""
    pictures = depths.pictures_of(read, given, known if told else None, start, work)
    if told:
        return pictures, known, 0.0
    measured = read.view is not None and np.isfinite(read.view.focal_error)
    error = read.view.focal_error if measured and read.view is not None else USUAL_SPREAD
    if pictures is not None and pictures.field_of_view is not None:
        known = with_model_lens(known, error, pictures.field_of_view)
        error = float((max(error, 1e-3) ** -2.0 + MODEL_LENS_ERROR**-2.0) ** -0.5)
    return pictures, known, error


def _learned_tilt(
    read: Read, given: GivenView, c: GeometrySettings, known: PinholeCamera, lens_error: float, start: int, work: Work
) -> tuple[LearnedTilt | None, PinholeCamera]:  # fmt: skip
    """What a learned model of the view says of the tilt, and the camera with the focal length that it counts for.

    Args:
        lens_error: relative standard deviation of the focal length without it; 0: it was told.
    """
    if given.view is None or None not in (c.pitch, c.roll, c.fov):
        return None, known
    found = views.view_of(read, given.view, known if lens_error <= 0.0 else None, start, work)
    if found is None:
        return None, known
    camera = found.lens(known, lens_error)
    return found.tilt(camera), camera


def _observation(seen: Sight, canonical: PinholeCamera, interval: float, fluid: FluidMasks) -> Observation:
    """What lies, as the builder of its kind wants it."""
    trust = composite.trust_beside_jets(seen.parts, canonical, seen.motion, seen.lying_trust)
    slopes = SlopePrior(composite.level_prior(seen.parts, seen.motion, seen.trust), seen.steep)
    return Observation(
        canonical, seen.parts.lying, seen.motion, trust, interval, camera_height=seen.height,
        tilt_known=seen.tilt_known, slopes=slopes, roll=seen.up.roll, standing=seen.stood, ledges=seen.parts.ledges,
        rims=seen.heeded_rims, ever=fluid.any_frame(),
    )  # fmt: skip


def _front(seen: Sight, bodies: GivenFile | None, observed: Observation):
    """The front surface in canonical units; metres per unit where the depth came in metres, else None."""
    if bodies is not None:
        return given_body.given_front(bodies.path, observed.camera, observed.mask, seen.kind, seen.start)
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
