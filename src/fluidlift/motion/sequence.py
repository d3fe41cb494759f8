"""Velocities of a whole clip, frame by frame (paper: v_gt): flow, mainstream, lift, volume, with a window in memory.

A frame's motion is estimated from the pairs of frames around it. Only these are held, so that memory does not grow with
the clip, and each frame's result depends on its own window alone: any subset of frames gives the same as all of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, UInt8

from fluidlift.errors import require
from fluidlift.motion.air import with_air
from fluidlift.motion.bed import SLOPE_ERROR, WALLS
from fluidlift.motion.circulation import circulating
from fluidlift.motion.direction import mainstream_direction
from fluidlift.motion.free_fall import downhill_of, with_free_fall
from fluidlift.motion.front import raised_flow
from fluidlift.motion.lift import depth_change, lift_flow
from fluidlift.motion.mainstream import complete_flow
from fluidlift.motion.neighbour_sum import complete_by_sum
from fluidlift.motion.screen_divergence import project_screen_divergence, validated_reach
from fluidlift.motion.temporal import smoothed_flow
from fluidlift.motion.thrown_up import Flight, with_flights
from fluidlift.motion.volume import VolumeReport, VolumeSolver
from fluidlift.types import FaceVelocity, FluidKind, PinholeCamera, PixelFlow, SurfaceMotion, Terrain, kind_of
from fluidlift.types.flow import TRUSTED

FlowReader = Callable[[int, int], PixelFlow]
"""(first, last) -> the flow of the pairs first to last - 1"""
MaskReader = Callable[[int], Bool[np.ndarray, "h w"]]
"""frame -> the fluid"""

DepthReader = Callable[[int], Float[np.ndarray, "h w"]]
"""frame -> camera z of the visible surface, m; 0 where there is none"""

FRONT_HALF_WINDOW = 30
"""frames on either side over which a silhouette's growth is followed at most"""

STRICTNESS = ("validated", "hard", "none")
"""words for how strictly the screen divergence is met"""

LEVEL = 0.05
"""sine of the slope below which a surface counts as level: 3 degrees, the error of a pitch that was estimated from one
view"""


@dataclass(frozen=True)
class MotionScene:
    """Where the fluid is: all that turns px/frame into m/s. Geometry at rest, in metres."""

    camera: PinholeCamera
    """of the working picture: if that was cropped or resized, so is the camera (`PinholeCamera.resized`)"""
    depth: Float[np.ndarray, "h w"] | DepthReader | None
    """camera z of the visible surface, m; 0 where there is none. One for all frames: the fluid slides along a surface
    at rest. A function of the frame, 0 to `pairs`: the surface moves. None: nothing is lifted"""
    terrain: Terrain | None
    """its grid is the grid of the volume. None: no volume"""
    cell_types: UInt8[np.ndarray, "nx ny nz"] | None
    """`CellType`"""
    kind: str | FluidKind
    """of the fluid"""
    interval: float
    """s per frame"""
    surface_height: Float[np.ndarray, "nx ny"] | None = None
    """z of the free surface over each column, m, of fluids that lie on something"""
    pool_level: float | None = None
    """z below which a pour stands in its vessel, m"""
    flights: tuple[Flight, ...] = ()
    """of the columns of a fountain"""
    prior: tuple[Float[np.ndarray, "h w 2"], Float[np.ndarray, "h w"]] | None = None
    """mean motion of the clip, px/frame, and its confidence: a neighbour more for what a frame did not see"""
    slope_error: float = SLOPE_ERROR
    """standard error of the slope (rise over run) of a stream's surface along it"""

    def __post_init__(self) -> None:
        require(self.interval > 0, f"interval {self.interval}", "positive seconds")
        if self.depth is not None and not callable(self.depth):
            self._checked(self.depth)

    def depth_at(self, frame: int) -> Float[np.ndarray, "h w"]:
        """Camera z of the visible surface at a frame, m.

        Raises:
            ValueError: no depth, or one of another size than the camera's picture.
        """
        require(self.depth is not None, "a scene without depth")
        assert self.depth is not None
        return self._checked(self.depth(frame) if callable(self.depth) else self.depth)

    def _checked(self, depth: np.ndarray) -> np.ndarray:
        w, h = self.camera.size
        require(np.shape(depth) == (h, w), f"depth {np.shape(depth)}", f"the camera's {(h, w)}")
        return np.asarray(depth)


@dataclass(frozen=True)
class MotionOptions:
    """How the motion is estimated."""

    half_window: int = 1
    """frames on either side whose flow is averaged into one frame's motion"""
    reach: int = 6
    """frames on either side that are asked where the near ones fail"""
    along_paths: bool = True
    """average along the fluid's paths too (`motion.temporal`); False: at fixed pixels, over `half_window` alone"""
    filling: str = "diffusion"
    """how failed pixels take others' motion: diffusion (`motion.mainstream`) or sum (`motion.neighbour_sum`)"""
    divergence: str = "exact"
    """form of the screen-divergence constraint: exact or paper"""
    constraint: str = "validated"
    """how strictly it is met: "validated" (as far as hidden patches bear it out), "hard" (the paper) or "none" """
    wall: str = "cubic"
    """wall function, one of `motion.bed.WALLS`"""
    tolerance: float = 1e-4
    """relative residual of the volume's projection"""

    def __post_init__(self) -> None:
        require(self.half_window >= 0, f"half window of {self.half_window} frames", "0 or more")
        require(self.reach >= 0, f"a reach of {self.reach} frames", "0 or more")
        require(self.wall in WALLS, f"wall function '{self.wall}'", "one of " + ", ".join(WALLS))
        require(self.divergence in ("exact", "paper"), f"form '{self.divergence}'", "exact or paper")
        require(self.filling in ("diffusion", "sum"), f"filling by '{self.filling}'", "diffusion or sum")
        require(self.constraint in STRICTNESS, f"constraint '{self.constraint}'", " or ".join(STRICTNESS))


@dataclass(frozen=True)
class FrameMotion:
    """What is known of one frame's motion."""

    frame: int
    displacement: Float[np.ndarray, "h w 2"]
    """completed flow, px/frame, float32; 0 outside the mask"""
    confidence: Float[np.ndarray, "h w"]
    """of the flow before completion, 0 to 1, float32"""
    observed: Bool[np.ndarray, "h w"]
    """False where the mainstream filled in"""
    surface: SurfaceMotion | None
    velocity: FaceVelocity | None
    """volume velocity, m/s"""
    report: VolumeReport | None
    free_fall_share: float | None
    """share of the steep points whose speed is that of free fall"""
    front_factor: float | None
    """by which the mean rise of a plume grew when its flow was held against its silhouette (`motion.front`)"""


def motion_sequence(
    flow: FlowReader,
    mask: MaskReader,
    pairs: int,
    scene: MotionScene,
    options: MotionOptions = MotionOptions(),
    *,
    frames: Iterable[int],
    volume_frames: Iterable[int] | None = None,
) -> Iterator[FrameMotion]:
    """The motion of frames, one in memory at a time, in ascending order. Frames without fluid are left out.

    Args:
        flow: reads the flow of some pairs; each pair is asked for once while it is in the window.
        mask: reads the fluid of a frame, 0 to `pairs`.
        pairs: number of pairs of frames in the clip.
        scene: geometry.
        options: see `MotionOptions`.
        frames: of which the planar motion is wanted, each below `pairs`.
        volume_frames: of which the surface and volume velocity is wanted as well; they need not be in `frames`.

    Raises:
        ValueError: frames outside the clip, or volumes without depth, terrain and cell types.
    """
    volumes = frozenset(() if volume_frames is None else volume_frames)
    wanted = sorted(volumes | set(frames))
    require(not wanted or (wanted[0] >= 0 and wanted[-1] < pairs), f"frames {wanted[:1]} to {wanted[-1:]}",
            f"0 to {pairs - 1}")  # fmt: skip
    ready = scene.depth is not None and scene.terrain is not None and scene.cell_types is not None
    require(ready or not volumes, "volume frames without geometry", "depth, terrain and cell types in the scene")
    return _sequence(flow, mask, pairs, scene, options, wanted, volumes)


def mean_velocity(
    mask: Bool[np.ndarray, "h w"], scene: MotionScene, options: MotionOptions = MotionOptions()
) -> FaceVelocity | None:
    """Volume velocity of the clip's mean motion (`MotionScene.prior`), m/s: what a steady flow does at all times.

    The mean of a whole clip is known better than that of a few frames in a row, in which eddies and waves that pass
    are as large as they are: of a simulated river the mean of eight frames is off by 0.97 px, of 47 by 0.50.

    Args:
        mask: the fluid.
        scene: with a prior, one depth for all frames, terrain and cell types.
        options: see `MotionOptions`; nothing holds what was filled in against the divergence on the screen.

    Returns:
        on the faces; None where no fluid lies on the body.

    Raises:
        ValueError: a scene that lacks one of these.
    """
    ready = scene.prior is not None and scene.terrain is not None and scene.cell_types is not None
    require(ready and scene.depth is not None and not callable(scene.depth), "a scene without mean motion and geometry",
            "prior, one depth, terrain and cell types")  # fmt: skip
    assert scene.prior is not None
    depth = scene.depth_at(0)
    body = np.asarray(mask, bool) & (depth > 0)
    if not body.any():
        return None
    mean, trust = scene.prior
    direction = mainstream_direction(mean, trust, body, downhill=screen_downhill(scene))
    full, seen = complete_flow(mean, trust, body, direction, np.where(body, depth, 1.0))
    now = _Instant(body, body, depth, depth)
    return _lifted(full, seen, now, scene, options, _solver(scene, options))[2]


def _sequence(
    flow: FlowReader, mask: MaskReader, pairs: int, scene: MotionScene, options: MotionOptions, wanted: list[int],
    volumes: frozenset[int],
) -> Iterator[FrameMotion]:  # fmt: skip
    window, clip = FlowWindow(flow, pairs, mask), _Clip.of(flow, mask, pairs, scene, options)
    solver = _solver(scene, options) if volumes else None
    for t in wanted:
        found = _frame_motion(window, mask, t, scene, options, clip, solver if t in volumes else None)
        if found is not None:
            yield found


class FlowWindow:
    """Reads pairs of a flow as they are needed and forgets those that a later frame cannot need.

    Where a frame has no fluid its flow is that of the ground, and has no confidence: a front comes to pixels that were
    dry, and seen to be at rest, a moment ago.
    """

    def __init__(self, flow: FlowReader, pairs: int, mask: MaskReader) -> None:
        self._flow = flow
        self._mask = mask
        self.pairs = pairs
        self._held: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def around(self, t: int, half_window: int) -> tuple[PixelFlow, int]:
        """The pairs t - half_window to t + half_window that there are, and which of them is t; t must not go back."""
        first, last = max(t - half_window, 0), min(t + half_window + 1, self.pairs)
        for k in [k for k in self._held if k < first]:
            del self._held[k]
        for k in range(first, last):
            if k not in self._held:
                read = self._flow(k, k + 1)
                require(len(read) == 1, f"{len(read)} pairs of flow", f"1, that of frame {k}")
                self._held[k] = (read.displacement[0], read.confidence[0] * np.asarray(self._mask(k), bool))
        part = [self._held[k] for k in range(first, last)]
        return PixelFlow(np.stack([d for d, _ in part]), np.stack([c for _, c in part])), t - first


@dataclass(frozen=True)
class _Instant:
    """The fluid and its surface at a frame and one later."""

    mask: np.ndarray
    mask_after: np.ndarray
    depth: np.ndarray | None
    depth_after: np.ndarray | None

    @classmethod
    def of(cls, mask: MaskReader, t: int, scene: MotionScene) -> _Instant:
        """Read at t and t + 1."""
        if scene.depth is None:
            return cls(np.asarray(mask(t), bool), np.asarray(mask(t + 1), bool), None, None)
        depth = scene.depth_at(t)
        after = scene.depth_at(t + 1) if callable(scene.depth) else depth
        return cls(np.asarray(mask(t), bool), np.asarray(mask(t + 1), bool), depth, after)

    def on_body(self) -> tuple[np.ndarray, np.ndarray]:
        """Fluid whose depth is known, at the frame and one later."""
        assert self.depth is not None and self.depth_after is not None
        return self.mask & (self.depth > 0), self.mask_after & (self.depth_after > 0)


@dataclass(frozen=True)
class _Clip:
    """What is the same for all frames of a clip, and must not depend on which of them are asked for."""

    downhill: np.ndarray | None
    """direction of steepest descent on the screen"""
    reach: float
    """px, of the screen-divergence constraint"""

    @classmethod
    def of(cls, flow: FlowReader, mask: MaskReader, pairs: int, scene: MotionScene, options: MotionOptions) -> _Clip:
        """How far the constraint reaches is asked of one frame: the first with fluid from the middle on, then before.

        It is a question to the fluid and not to the frame (`screen_divergence.validated_reach`), and costs as much as
        the motion of a frame.
        """
        downhill = screen_downhill(scene)
        if options.constraint != "validated":
            return cls(downhill, math.inf if options.constraint == "hard" and scene.depth is not None else 0.0)
        for t in (*range(pairs // 2, pairs), *range(pairs // 2 - 1, -1, -1)) if scene.depth is not None else ():
            now = _Instant.of(mask, t, scene)
            body, body_after = now.on_body()
            if not body.any() or now.depth is None or now.depth_after is None:
                continue
            full, seen, _ = _filled(FlowWindow(flow, pairs, mask), t, now, scene, options, downhill)
            rate = depth_change(full, body, now.depth, now.depth_after, mask_t1=body_after)
            near = np.where(body, now.depth, 1.0)
            return cls(
                downhill,
                validated_reach(full, body, seen & body, near, rate, scene.camera, form=options.divergence),
            )
        return cls(downhill, 0.0)


def _solver(scene: MotionScene, options: MotionOptions) -> VolumeSolver:
    terrain, cells = scene.terrain, scene.cell_types
    assert terrain is not None and cells is not None
    return VolumeSolver(
        terrain, cells, terrain.grid, kind=scene.kind, mainstream=terrain.mainstream, wall=options.wall,
        slope_error=scene.slope_error,
    )  # fmt: skip


def _frame_motion(
    window: FlowWindow, mask: MaskReader, t: int, scene: MotionScene, options: MotionOptions, clip: _Clip,
    solver: VolumeSolver | None,
) -> FrameMotion | None:  # fmt: skip
    """The motion of one frame, its volume too with a solver; None where it shows no fluid."""
    now = _Instant.of(mask, t, scene)
    if not now.mask.any():
        return None
    full, seen, trust = _filled(window, t, now, scene, options, clip.downhill)
    if clip.reach > 0:
        full = _constrained(full, seen, now, scene, options, clip.reach)
    factor = None
    if kind_of(scene.kind).is_gas:
        full, factor = _with_front(full, mask, t, window)
    surface = velocity = report = share = None
    if solver is not None:
        before, surface, velocity, report, share = _lifted(full, seen, now, scene, options, solver)
        if share and surface is not None:
            full, seen, trust = _as_it_falls(full, seen, trust, before, surface, now, scene)
    return FrameMotion(t, full, trust, seen, surface, velocity, report, share, factor)


def _filled(
    window: FlowWindow, t: int, now: _Instant, scene: MotionScene, options: MotionOptions, downhill: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Smoothed in time and filled in along the mainstream: displacement, observed, and confidence before filling."""
    # what collapses is faster in every frame
    longer = options.along_paths and not kind_of(scene.kind).starts_at_rest
    reach = max(options.reach, options.half_window) if longer else options.half_window
    near, at = window.around(t, reach)
    mask, depth = now.mask, now.depth
    mean, trust = smoothed_flow(near, at, mask, half_window=options.half_window, along_paths=options.along_paths)
    direction = mainstream_direction(mean, trust, mask, downhill=downhill)
    if options.filling == "sum":
        full, seen = complete_by_sum(mean, trust, mask, direction)
        return full, seen, trust
    with_depth = depth is not None and bool((depth[mask] > 0).all())
    prior = scene.prior if kind_of(scene.kind).has_mean_motion else None
    full, seen = complete_flow(mean, trust, mask, direction, depth if with_depth else None, prior=prior)
    return full, seen, trust


def _constrained(
    full: np.ndarray, seen: np.ndarray, now: _Instant, scene: MotionScene, options: MotionOptions, reach: float
) -> np.ndarray:
    """What was filled in made consistent with an incompressible fluid."""
    assert now.depth is not None and now.depth_after is not None
    body, body_after = now.on_body()
    if not (body & ~seen).any():
        return full
    rate = depth_change(full, body, now.depth, now.depth_after, mask_t1=body_after)
    projected, _ = project_screen_divergence(
        full, body, seen & body, np.where(body, now.depth, 1.0), rate, scene.camera, form=options.divergence,
        reach=reach,
    )  # fmt: skip
    return np.where(body[..., None], projected, full)


def _with_front(full: np.ndarray, mask: MaskReader, t: int, window: FlowWindow) -> tuple[np.ndarray, float]:
    """A plume's flow sped up to what its silhouette says."""
    first, last = max(t - FRONT_HALF_WINDOW, 0), min(t + FRONT_HALF_WINDOW, window.pairs)
    masks = np.stack([np.asarray(mask(k), bool) for k in range(first, last + 1)])
    return raised_flow(full, masks, t - first)


def _lifted(
    full: np.ndarray, seen: np.ndarray, now: _Instant, scene: MotionScene, options: MotionOptions, solver: VolumeSolver
) -> tuple[SurfaceMotion | None, SurfaceMotion | None, FaceVelocity | None, VolumeReport | None, float | None]:
    """Surface motion as measured and as it must fall, and volume velocity; nothing where no fluid lies on the body."""
    terrain, cells = scene.terrain, scene.cell_types
    assert terrain is not None and cells is not None and now.depth is not None and now.depth_after is not None
    body, body_after = now.on_body()
    if not body.any():
        return None, None, None, None, None
    stays = kind_of(scene.kind).is_standing_water
    if stays and scene.prior is not None:  # waves come and go; what circulates is in the mean
        full, seen = scene.prior[0], scene.prior[1] > TRUSTED
    measured = surface = lift_flow(
        full, seen, body, now.depth, now.depth_after, scene.camera, scene.interval, mask_t1=body_after
    )
    share = circulates = None
    if stays:
        surface, circulates = circulating(surface, cells, terrain.grid)
    if kind_of(scene.kind).falls_freely:
        down = downhill_of(surface.points, terrain.grid, scene.surface_height, scene.pool_level)
        surface, share = with_free_fall(surface, down, kind=scene.kind)
    velocity, report = solver.velocity(surface, tolerance=options.tolerance)
    report = replace(report, circulating=circulates)
    if scene.flights and scene.surface_height is not None:
        velocity = with_flights(velocity, scene.flights, cells, scene.surface_height, terrain.grid)
    if kind_of(scene.kind).is_gas:
        velocity, _ = with_air(velocity, cells, terrain, terrain.grid)
    return measured, surface, velocity, report, share


def _as_it_falls(
    full: np.ndarray, seen: np.ndarray, trust: np.ndarray, measured: SurfaceMotion | None, surface: SurfaceMotion,
    now: _Instant, scene: MotionScene,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Displacement, observed and confidence where free fall took the place of flow: what that fall looks like."""
    assert measured is not None
    replaced = (surface.velocities != measured.velocities).any(axis=1)
    rows, cols = (index[replaced] for index in np.nonzero(now.on_body()[0]))
    ends, z = scene.camera.project(surface.points[replaced] + scene.interval * surface.velocities[replaced])
    full, seen, trust = full.copy(), seen.copy(), trust.copy()
    start = scene.camera.pixel_grid()[rows, cols]
    full[rows, cols] = np.where((z > 0)[:, None], ends - start, full[rows, cols])
    seen[rows, cols], trust[rows, cols] = False, 0.0
    return full, seen, trust


def screen_downhill(scene: MotionScene) -> Float[np.ndarray, "h w 2"] | None:
    """Unit direction in which the surface at rest descends on the screen; 0 where it is level (`LEVEL`) or unknown.

    None without a surface at rest, or one in the air, which says nothing about banks.
    """
    if scene.depth is None or callable(scene.depth) or scene.terrain is None or scene.surface_height is None:
        return None
    known = np.asarray(scene.depth) > 0
    start, z = scene.camera.pixel_grid()[known], np.asarray(scene.depth, np.float64)[known]
    points = scene.camera.unproject(start, z)
    down = downhill_of(points, scene.terrain.grid, scene.surface_height)
    moved, _ = scene.camera.project(points + 1e-3 * z[:, None] * down)
    step = moved - start
    length = np.linalg.norm(step, axis=-1, keepdims=True)
    out = np.zeros((*known.shape, 2), np.float32)
    out[known] = np.where((down[:, 2:] < -LEVEL) & (length > 1e-6), step / np.maximum(length, 1e-6), 0.0)
    return out
