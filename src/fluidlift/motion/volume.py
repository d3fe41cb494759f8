"""From the surface to the whole volume (paper: V_vol): extension, bed, and a projection that keeps what was seen.

The free surface needs care. In a simulation the air holds p = 0 and fluid may pass through the surface, which then
moves. Here the surface is where it was seen. A projection with p = 0 there would get rid of every excess of the
interior by the shortest way, straight up through the surface, and so turn the best known velocities into the worst.
The projection is therefore weighted (`motion.volume_projection`): faces are heavy where the surface was observed,
lighter where it was filled in or lies out of sight, and between liquid and air a thousand times heavier still.

A stream that comes in and goes out is taken as steady over the frames that were averaged: the same discharge Q passes
every cross-section. The surface is then balanced (no net flux through it) and closed but for a small leak, in- and
outlet are free, and Q follows from the well observed cross-sections; badly seen ones, in the shade or out of the
picture, follow it. No end carries more than the fastest surface seen near it allows, nor flows against its sense: where
the geometry asks for that (a body too thick, an end too small), the surface yields as far as it must. A fall thins as
it speeds up: its surface yields, and what enters at its rim runs as the surface there. In a vessel that fills or
empties the surface must give way, and does. The surface of smoke is no barrier."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from fluidlift.errors import require
from fluidlift.motion.bed import SLOPE_ERROR, WALLS, bed_velocity, film_share, speed_share
from fluidlift.motion.extrapolation import (
    SNAP_CELLS,
    harmonic_extension,
    layered_extension,
    nearest_cells,
    sample_weight,
    splat_samples,
    wall_distance,
)
from fluidlift.motion.volume_projection import (
    DEPTH_ERROR,
    OBSERVED_ERROR,
    PROFILE_ERROR,
    agreed_limits,
    balance_surface,
    bounded_ends,
    continue_through_ends,
    end_faces,
    face_mobility,
    faces_from_centers,
    flux_through,
    held_ends,
    inward_only,
    mouths_of,
    net_outflow,
    outward_openings,
    passed_through,
    sides_of_faces,
    weighted_projection,
)
from fluidlift.numerics.sampling import gradient_nodes
from fluidlift.physics.pressure import PressureSystem, build_system
from fluidlift.types import CellType, FaceVelocity, FluidKind, Grid, SolveReport, SurfaceMotion, Terrain, kind_of

CLOSED_SURFACE = 0.25
"""Mobility of faces between fluid and air over that of the fluid below, times length^2 / depth of the fluid in cells,
where the flow is steady: about 3e-4 on a stream of 5 by 64 cells. A leak acts on a stream over sqrt(depth / mobility)
cells, here twice the stream's length: nearly the same discharge passes every cross-section, and the solve stays well
posed. On cases with a known truth the cosine of the volume velocity changes by less than 0.015 from 0.1 to 4 times
this."""
YIELDING_SURFACE = 0.02
"""the same where the fluid only comes in or only goes out, and its level must change, and for smoke"""
REACH = 2.0
"""depths of fluid over which confidence fades (1/e) away from the columns that were seen"""
FAST = 95.0
"""percentile of the observed speeds that counts as the fastest: a few samples always are wrong"""
DOUBT = 1.0 + 2.0 * float(np.hypot(OBSERVED_ERROR, PROFILE_ERROR))
"""mean speed through an end over the fastest surface observed near it, at most: two standard errors above 1. More says
that the geometry is wrong there: the fluid must then pass through the surface instead of speeding up"""


@dataclass(frozen=True)
class VolumeOptions:
    """How the volume follows from its surface. None: as the kind, the ends and the speed of the flow ask for."""

    extension: str | None = None
    """harmonic, or layered: speed constant below the surface but for a layer at the walls"""
    surface_mobility: float | None = None
    """of faces between fluid and air: 1 lets the surface leak freely, 0 is a wall that moves as it was seen"""
    balanced: bool | None = None
    """whether the net flux through the surface is taken off before the projection"""
    even: bool = False
    """all faces but those towards air resist alike, whatever was seen"""

    def __post_init__(self) -> None:
        require(self.extension in (None, "harmonic", "layered"), f"extension '{self.extension}'", "harmonic or layered")
        m = self.surface_mobility
        require(m is None or 0 <= m <= 1, f"surface mobility {m}", "0 to 1")


@dataclass(frozen=True)
class VolumeReport:
    """How well the volume velocity meets its conditions."""

    solve: SolveReport
    divergence_max: float
    """max of abs(div v) dx / mean speed, over the fluid cells"""
    divergence_mean: float
    """mean of the same"""
    flux_in: float
    """m^3/s through the faces of INFLOW cells"""
    flux_out: float
    """m^3/s through the faces of OUTFLOW cells"""
    flux_surface: float
    """m^3/s up and out through the free surface, net"""
    change_observed: float = 0.0
    """relative change (2-norm) that the divergence-free solve made to the faces between observed cells, 0 to 1"""
    viscous: float = 0.0
    """how surely a stream is a viscous film, 0 to 1 (`motion.bed.film_share`)"""
    circulating: float | None = None
    """of standing water: speed of what circulates in it over that of what was seen, 0 to 1 (`motion.circulation`)"""


class VolumeSolver:
    """`volume_velocity` for many frames in one place: what depends on cells and terrain alone is found once."""

    def __init__(
        self,
        terrain: Terrain | None,
        cell_types: UInt8[np.ndarray, "nx ny nz"],
        grid: Grid,
        *,
        kind: str | FluidKind,
        mainstream: Float[np.ndarray, "3"] | None = None,
        wall: str = "cubic",
        slope_error: float = SLOPE_ERROR,
        options: VolumeOptions | None = None,
    ) -> None:
        """Prepare; see `volume_velocity`."""
        options, kind = VolumeOptions() if options is None else options, kind_of(kind)
        types = np.asarray(cell_types)
        require(types.shape == grid.shape, f"cell types {types.shape}", str(grid.shape))
        require(wall in WALLS, f"wall function '{wall}'", "one of " + ", ".join(WALLS))
        carrying = (types == CellType.FLUID) | (types == CellType.INFLOW) | (types == CellType.OUTFLOW)
        require(bool(carrying.any()), "cell types without fluid")
        self._types, self._carrying, self._options = types, carrying, options
        wall = "cubic" if kind.is_gas else wall  # a gas meets few walls, and never by its whole depth
        # the other wall functions span the whole depth: there is nothing left to interpolate
        # what is poured may be viscous, which drags through its depth: harmonic between the surface and the bed
        layered = kind.lies_on_ground or wall != "cubic"
        self._bed = _Bed(types, terrain, grid, kind, mainstream, wall, _typical_depth(types, grid.spacing))
        self._extension = options.extension or ("layered" if layered else "harmonic")
        self._share = self._bed.share() if self._extension == "layered" else None
        # the paper's layer is for fluid that is not viscous; whether a stream is shows only in its motion
        asked = kind.runs_nearly_level and wall == "cubic" and self._share is not None
        self._film = replace(self._bed, wall="film").share() if asked else None
        self._slope_error = slope_error
        # fluid passes freely through both ends
        self._system = build_system(np.where(types == CellType.INFLOW, CellType.OUTFLOW, types), terrain, grid)
        self._nearest, self._ends = nearest_cells(carrying), end_faces(types)
        self._mouths = mouths_of(types, self._system, REACH * self._bed.depth)
        self._steady = kind.runs_nearly_level and len(self._mouths) == 2
        self._rim = [end for end in self._mouths if end.inlet] if kind.enters_over_rim else []
        self._below = float(np.hypot(PROFILE_ERROR, DEPTH_ERROR)) if kind.is_channel_flow else PROFILE_ERROR
        self._balanced = options.balanced if options.balanced is not None else not kind.is_gas
        if options.surface_mobility is not None:
            self._leak = np.full(grid.shape, options.surface_mobility, np.float32)
        else:
            steady = self._level_stays(kind)
            # between the two by ratio: they differ by orders of magnitude
            leak = self._closed() ** steady * YIELDING_SURFACE ** (1.0 - steady)
            self._leak = np.broadcast_to(leak, grid.shape).astype(np.float32)

    def velocity(self, surface: SurfaceMotion, *, tolerance: float = 1e-4) -> tuple[FaceVelocity, VolumeReport]:
        """Of one frame.

        Args:
            surface: from `lift_flow`.
            tolerance: relative residual of the projection.

        Raises:
            ValueError: no fluid cell near any sample.
        """
        types, system, grid = self._types, self._system, self._bed.grid
        fields = np.concatenate([surface.velocities, surface.observed[:, None]], axis=1)
        values, seen = splat_samples(
            surface.points, fields, sample_weight(surface), self._carrying, grid, nearest=self._nearest
        )
        require(
            bool(seen.any()), "no surface sample near a fluid cell", f"samples within {SNAP_CELLS} cells of the fluid"
        )
        viscous, share = self._viscous(surface), self._share
        if share is not None and self._film is not None:
            share = (viscous * self._film + (1.0 - viscous) * share).astype(np.float32)
        centers, confidence = self._extended(values, seen, share)
        extended = faces_from_centers(centers, self._carrying)
        extended = inward_only(extended, self._rim)
        start = balance_surface(extended, types, system.openings) if self._balanced else extended
        certain = np.ones_like(confidence) if self._options.even else confidence
        mobility = held_ends(face_mobility(types, seen, certain, self._leak, self._below), self._rim)
        velocity, solve = weighted_projection(start, system, mobility, tolerance=tolerance)
        limits = self._end_limits(values, seen) if self._options.surface_mobility is None else []
        if self._steady and limits:
            velocity, other = self._believed(limits, velocity, seen, certain, tolerance)
            solve = max(solve, other or solve, key=lambda report: report.residual)
        elif any(abs(flux_through(velocity, e.outward)) > limit for e, limit in zip(self._mouths, limits)):
            mobility = held_ends(face_mobility(types, seen, certain, np.ones_like(self._leak), self._below), self._rim)
            leaking, other = weighted_projection(extended, system, mobility, tolerance=tolerance)
            velocity = self._within(limits, velocity, leaking)
            solve = max(solve, other, key=lambda report: report.residual)
        velocity = velocity if self._rim else continue_through_ends(velocity, self._ends)
        change = _change(extended, velocity, seen & (confidence > 0.5))
        return velocity, replace(_report(velocity, system, types, solve, change), viscous=viscous)

    def _level_stays(self, kind: FluidKind) -> float | np.ndarray:
        """How surely no level changes, 0 to 1, where it is not the same for all [nx,ny,nz]."""
        if kind.is_gas or kind.is_standing_water:
            return float(kind.is_standing_water)
        return passed_through(self._types, self._system.openings, however_narrow=self._steady)

    def _closed(self) -> float:
        """Mobility of a closed surface."""
        fluid = self._types == CellType.FLUID
        length = max(int(np.count_nonzero(fluid.any(axis=a))) for a in ((1, 2), (0, 2), (0, 1)))
        return min(CLOSED_SURFACE * self._bed.depth / self._bed.grid.spacing / max(length, 1) ** 2, YIELDING_SURFACE)

    def _viscous(self, surface: SurfaceMotion) -> float:
        """How surely this is a viscous film, 0 to 1; 0 where it is not asked."""
        if self._film is None:
            return 0.0
        known = surface.observed if surface.observed.any() else slice(None)
        points, velocities = surface.points[known], surface.velocities[known]
        return film_share(points, velocities, self._bed.depth, slope_error=self._slope_error)

    def _end_limits(self, values: Float[np.ndarray, "nx ny nz 4"], seen: Bool[np.ndarray, "nx ny nz"]) -> list[float]:
        """Flux that each end can carry, in face areas times m/s, from the fastest surface observed near it: whatever
        the profile, the mean of a section is below that, but for errors (`DOUBT`)."""
        observed = seen & (values[..., 3] > 0.5)
        speed = np.linalg.norm(values[..., :3], axis=-1)
        limits = []
        for end in self._mouths:
            witnesses = observed & end.near if (observed & end.near).any() else observed
            fastest = DOUBT * end.area * float(np.percentile(speed[witnesses], FAST)) if witnesses.any() else np.inf
            limits.append(fastest)
        return limits

    def _believed(
        self, limits: list[float], closed: FaceVelocity, seen: np.ndarray, certain: np.ndarray, tolerance: float
    ) -> tuple[FaceVelocity, SolveReport | None]:
        """`closed` with ends that carry 0 to `limits` in their own direction; the surface takes the rest.

        What changes is a divergence-free field that vanishes with the excess, so that no frame jumps."""
        bounded = bounded_ends(closed, self._mouths, agreed_limits(closed, self._mouths, limits))
        if bounded is closed:
            return closed, None
        leaking = face_mobility(self._types, seen, certain, np.ones_like(self._leak))
        return weighted_projection(bounded, self._system, held_ends(leaking, self._mouths), tolerance=tolerance)

    def _within(self, limits: list[float], closed: FaceVelocity, leaking: FaceVelocity) -> FaceVelocity:
        """The mixture nearest to `closed` whose ends carry no more than they can; every mixture is divergence-free."""
        share = 0.0
        for end, limit in zip(self._mouths, limits):
            before, after = (abs(flux_through(v, end.outward)) for v in (closed, leaking))
            if before > limit:
                share = max(share, (before - limit) / (before - min(after, limit)))
        mixed = ((1.0 - share) * a + share * b for a, b in zip(closed.components, leaking.components))
        return FaceVelocity(*mixed)

    def _extended(
        self, values: Float[np.ndarray, "nx ny nz 4"], seen: Bool[np.ndarray, "nx ny nz"], share: np.ndarray | None
    ) -> tuple[Float[np.ndarray, "nx ny nz 3"], Float[np.ndarray, "nx ny nz"]]:
        """Velocity and confidence of all cells from those of the surface's cells."""
        bed, known = self._bed, seen
        if share is None:
            beside = _bed_cells(bed.types) & ~seen
            if beside.any() and bed.slows():
                values[beside] = _beside_bed(values, seen, beside, bed)
                known = seen | beside
        out = harmonic_extension(values, known, self._carrying, bed.grid.spacing)
        centers, confidence = out[..., :3], out[..., 3]
        if share is not None:
            centers = layered_extension(centers, seen, share, bed.mainstream)
        away = ndimage.distance_transform_edt(~np.any(seen, axis=2)) * bed.grid.spacing / (REACH * bed.depth)
        return centers, confidence * np.exp(-away)[..., None].astype(np.float32)


def volume_velocity(
    surface: SurfaceMotion,
    terrain: Terrain | None,
    cell_types: UInt8[np.ndarray, "nx ny nz"],
    grid: Grid,
    *,
    kind: str | FluidKind,
    mainstream: Float[np.ndarray, "3"] | None = None,
    wall: str = "cubic",
    slope_error: float = SLOPE_ERROR,
    tolerance: float = 1e-4,
    options: VolumeOptions | None = None,
) -> tuple[FaceVelocity, VolumeReport]:
    """Divergence-free velocity of the whole fluid from that of its surface and its bed.

    Args:
        surface: from `lift_flow`.
        terrain: gives the bed's normals and the open share of faces; None: walls follow the cells.
        cell_types: `CellType`; fluid passes freely through INFLOW and OUTFLOW cells.
        grid: of the cells.
        kind: fluid type, decides the layer at the bed (`motion.bed`) and the extension.
        mainstream: unit direction of the bulk flow; None: that of the nearest surface.
        wall: wall function, one of `motion.bed.WALLS`; a plume keeps "cubic". A stream with "cubic" that is too slow
            for its slope takes "film" instead, by degrees (`motion.bed.film_share`).
        slope_error: standard error of the slope (rise over run) of the surface, which a film must exceed.
        tolerance: relative residual of the projection.
        options: see there; None: the usual ones.

    Returns:
        velocity on the faces, float32 m/s, 0 where neither neighbour holds fluid, and the report.

    Raises:
        ValueError: cell types of the wrong shape, an unknown wall, or no fluid cell near any sample.
        InputRejected: an unknown kind.
    """
    solver = VolumeSolver(
        terrain, cell_types, grid, kind=kind, mainstream=mainstream, wall=wall, slope_error=slope_error, options=options
    )
    return solver.velocity(surface, tolerance=tolerance)


@dataclass(frozen=True)
class _Bed:
    """What the extension must know about walls."""

    types: np.ndarray
    terrain: Terrain | None
    grid: Grid
    kind: FluidKind
    mainstream: np.ndarray | None
    wall: str
    depth: float
    """m, typical"""

    def share(self) -> Float[np.ndarray, "nx ny nz"]:
        """Of the free speed in each cell."""
        spacing = self.grid.spacing
        depth = np.clip(_column_depth(self.types, spacing), spacing, 2.0 * self.depth)[..., None]
        distance = wall_distance(self.types, self.terrain, self.grid)
        return speed_share(distance, kind=self.kind, spacing=spacing, depth=depth, wall=self.wall).astype(np.float32)

    def slows(self) -> bool:
        """Whether the layer reaches the centres of the cells at the wall; else a wall only turns the flow."""
        half, h = np.asarray(0.5 * self.grid.spacing), self.grid.spacing
        return bool(speed_share(half, kind=self.kind, spacing=h, depth=self.depth, wall=self.wall) < 1.0)


def _bed_cells(types: np.ndarray) -> np.ndarray:
    """Fluid cells with a solid face neighbour."""
    solid = np.pad(types == CellType.SOLID, 1)
    beside = np.zeros(types.shape, bool)
    for axis in range(3):
        for shift in (0, 2):
            window = [slice(1, -1)] * 3
            window[axis] = slice(shift, shift + types.shape[axis])
            beside |= solid[tuple(window)]
    return beside & (types == CellType.FLUID)


def _column_depth(types: np.ndarray, spacing: float) -> Float[np.ndarray, "nx ny"]:
    """Height of the fluid in each column, m."""
    return ((types == CellType.FLUID) | (types == CellType.INFLOW)).sum(axis=2) * spacing


def _typical_depth(types: np.ndarray, spacing: float) -> float:
    """Median height of the fluid in the columns that hold some, m; outlets, which reach up to the air, do not count."""
    columns = _column_depth(types, spacing)
    return float(np.median(columns[columns > 0])) if (columns > 0).any() else spacing


def _beside_bed(
    values: Float[np.ndarray, "nx ny nz 4"], seen: np.ndarray, beside: np.ndarray, bed: _Bed
) -> Float[np.ndarray, "n 4"]:
    """Velocity and confidence of the bed cells from the nearest surface cells."""
    nearest = ndimage.distance_transform_edt(~seen, return_distances=False, return_indices=True)
    above = values[tuple(n[beside] for n in nearest)].astype(np.float64)
    direction = bed.mainstream
    if direction is None:
        direction = above[:, :3] / np.maximum(np.linalg.norm(above[:, :3], axis=-1, keepdims=True), 1e-9)
    normal = None
    if bed.terrain is not None:
        points = bed.grid.low + (np.argwhere(beside) + 0.5) * bed.grid.spacing
        normal = gradient_nodes(bed.terrain.signed_distance, bed.terrain.grid, points)
        normal = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    slow = bed_velocity(
        above[:, :3], direction, normal, kind=bed.kind, spacing=bed.grid.spacing, depth=bed.depth, wall=bed.wall
    )  # fmt: skip
    return np.concatenate([slow, above[:, 3:]], axis=1)


def _change(before: FaceVelocity, after: FaceVelocity, observed: np.ndarray) -> float:
    """Relative change of the faces between observed cells, 1 at most: what stood still cannot change relatively."""
    changed = total = 0.0
    for axis, (a, b) in enumerate(zip(before.components, after.components)):
        low, high = sides_of_faces(observed, axis)
        both = low & high
        changed += float(np.square(b[both] - a[both], dtype=np.float64).sum())
        total += float(np.square(a[both], dtype=np.float64).sum())
    return float(np.sqrt(changed / max(total, changed))) if changed > 0 else 0.0


def _report(
    velocity: FaceVelocity, system: PressureSystem, types: np.ndarray, report: SolveReport, change: float
) -> VolumeReport:
    fluid = types == CellType.FLUID
    speed = np.linalg.norm(velocity.at_centers()[fluid], axis=-1)
    scale = system.spacing / max(float(speed.mean()) if speed.size else 0.0, 1e-12)
    excess = np.abs(net_outflow(velocity, system)[fluid]) * scale
    kinds, area = (CellType.INFLOW, CellType.OUTFLOW, CellType.EMPTY), system.spacing**2
    inflow, outflow, up = (area * flux_through(velocity, outward_openings(types, k, system.openings)) for k in kinds)
    worst, mean = (float(excess.max()), float(excess.mean())) if excess.size else (0.0, 0.0)
    return VolumeReport(report, worst, mean, -inflow, outflow, up, change)
