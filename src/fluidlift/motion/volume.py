"""From the surface to the whole volume (paper: V_vol): extension, bed, and a projection that keeps what was seen.

The free surface needs care. In a simulation the air holds p = 0 and fluid may pass through the surface, which then
moves. Here the surface is where it was seen. A projection with p = 0 there would get rid of every excess of the
interior by the shortest way, straight up through the surface, and so turn the best known velocities into the worst.
The projection is therefore weighted: of all divergence-free fields take the one with least

    sum over faces of m_f |v'_f - v_f|^2,

with heavy faces (large m) where the surface was seen or is crossed, and light ones inside, where v was made up by
extension; m enters the Poisson equation as the mobility 1/m of each face. A closed surface is the limit of an
infinite m; a finite one stays solvable when what was seen does not balance.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from fluidlift.errors import require
from fluidlift.motion.bed import bed_velocity, layer_thickness, wall_profile
from fluidlift.motion.lift import depth_change, lift_flow
from fluidlift.motion.mainstream import complete_flow, mainstream_direction, project_screen_divergence
from fluidlift.motion.optical_flow import mean_flow
from fluidlift.numerics.poisson import PoissonSystem, solve
from fluidlift.numerics.sampling import gradient_nodes
from fluidlift.physics.pressure import PressureSystem, build_system
from fluidlift.types import (
    CellType,
    FaceVelocity,
    Grid,
    PinholeCamera,
    PixelFlow,
    SolveReport,
    SurfaceMotion,
    Terrain,
)

SURFACE_MOBILITY = 0.02
"""mobility of faces between fluid and air: 1 lets the surface leak freely, 0 is a wall that moves as it was seen"""
SEEN_MOBILITY = 0.2
"""mobility of faces whose velocity was seen"""
FILLED_WEIGHT = 0.25
"""weight of a surface sample that the mainstream filled in, beside 1 for an observed one"""
SNAP_CELLS = 3.0
"""samples further than so many cells from any fluid are left out"""


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


def volume_velocity(
    surface: SurfaceMotion,
    terrain: Terrain | None,
    cell_types: UInt8[np.ndarray, "nx ny nz"],
    grid: Grid,
    *,
    kind: str,
    mainstream: Float[np.ndarray, "3"] | None = None,
    surface_mobility: float = SURFACE_MOBILITY,
    seen_mobility: float = SEEN_MOBILITY,
    tolerance: float = 1e-4,
) -> tuple[FaceVelocity, VolumeReport]:
    """Divergence-free velocity of the whole fluid from that of its surface and its bed.

    Args:
        surface: from `lift_flow`.
        terrain: gives the bed's normals and the open share of faces; None: walls follow the cells.
        cell_types: `CellType`; fluid passes freely through INFLOW and OUTFLOW cells.
        grid: of the cells.
        kind: fluid type, decides the layer at the bed (`motion.bed`).
        mainstream: unit direction of the bulk flow; None: that of the nearest surface.
        surface_mobility: see the module.
        seen_mobility: see the module.
        tolerance: relative residual of the projection.

    Returns:
        velocity on the faces, float32 m/s, 0 where neither neighbour holds fluid, and the report.

    Raises:
        ValueError: cell types of the wrong shape, or no fluid cell near any sample.
    """
    types = np.asarray(cell_types)
    require(types.shape == grid.shape, f"cell types {types.shape}", str(grid.shape))
    carrying = (types == CellType.FLUID) | (types == CellType.INFLOW) | (types == CellType.OUTFLOW)
    require(bool(carrying.any()), "cell types without fluid")
    values, seen = splat_surface(surface, carrying, grid)
    require(bool(seen.any()), "no surface sample near a fluid cell", f"samples within {SNAP_CELLS} cells of the fluid")
    known = seen.copy()
    bed = _bed_cells(types) & ~seen
    thickness = layer_thickness(kind, grid.spacing, _typical_depth(carrying, grid))
    # a layer thinner than half a cell does not reach the cell's centre: such a wall only turns the flow (projection)
    if bed.any() and wall_profile(0.5 * grid.spacing, thickness) < 1.0:
        values[bed] = _beside_bed(values, seen, bed, terrain, grid, kind, mainstream, _typical_depth(carrying, grid))
        known |= bed
    centers = harmonic_extension(values, known, carrying, grid.spacing)
    velocity = faces_from_centers(centers, carrying)
    through = np.where(types == CellType.INFLOW, CellType.OUTFLOW, types)
    system = build_system(through, terrain, grid)
    mobility = _mobility(types, seen, surface_mobility, seen_mobility)
    velocity, report = weighted_projection(velocity, system, mobility, tolerance=tolerance)
    return velocity, _report(velocity, system, types, report)


def splat_surface(
    surface: SurfaceMotion, carrying: Bool[np.ndarray, "nx ny nz"], grid: Grid
) -> tuple[Float[np.ndarray, "nx ny nz 3"], Bool[np.ndarray, "nx ny nz"]]:
    """Weighted mean of the samples on the fluid cells nearest to them, and which cells got one.

    Each sample goes to its own cell, or the nearest that carries fluid. Then a Gaussian of 0.7 cells evens out the
    cells that were hit (it adds no others: the surface is one cell thick).
    """
    cells = np.clip(grid.cell_of(surface.points), 0, np.asarray(grid.shape) - 1)
    distance, nearest = ndimage.distance_transform_edt(~carrying, return_indices=True)
    at = tuple(cells.T)
    outside = np.abs(surface.points - np.clip(surface.points, grid.low, grid.high)).max(axis=-1) / grid.spacing
    near = (distance[at] <= SNAP_CELLS) & (outside <= SNAP_CELLS)
    target = np.ravel_multi_index(tuple(n[at][near] for n in nearest), grid.shape)
    weight = np.where(surface.observed[near], 1.0, FILLED_WEIGHT)
    sums = [np.bincount(target, weight, grid.cells).reshape(grid.shape)]
    sums += [
        np.bincount(target, weight * surface.velocities[near, a], grid.cells).reshape(grid.shape) for a in range(3)
    ]
    seen = sums[0] > 0
    # each hit cell counts by how well it was hit, but a near, finely sampled bank must not outvote the rest
    share = np.where(seen, 1.0 / np.maximum(sums[0], 1e-12), 0.0) * np.minimum(sums[0], 1.0)
    total, *parts = (ndimage.gaussian_filter(s * share, 0.7, mode="constant", truncate=2.0) for s in sums)
    values = np.stack(parts, axis=-1) / np.maximum(total, 1e-12)[..., None]
    return np.where(seen[..., None], values, 0.0).astype(np.float32), seen


def harmonic_extension(
    values: Float[np.ndarray, "nx ny nz c"],
    known: Bool[np.ndarray, "nx ny nz"],
    domain: Bool[np.ndarray, "nx ny nz"],
    spacing: float,
    *,
    tolerance: float = 1e-4,
) -> Float[np.ndarray, "nx ny nz c"]:
    """The smoothest continuation: laplace f = 0 in the domain, f = values where known, no flux through its rim.

    Parts of the domain that no known cell touches take the mean of the known values.
    """
    known = known & domain
    label, count = ndimage.label(domain)
    touched = np.zeros(count + 1, bool)
    touched[np.unique(label[known])] = True
    unknown = domain & ~known & touched[label]
    out = np.where(known[..., None], values, 0.0).astype(np.float32)
    weights = []
    for axis in range(3):
        low, high = _sides(domain, axis)
        weights.append((low & high).astype(np.float32))
    system = PoissonSystem(unknown, *weights, spacing)
    _, nearest = ndimage.distance_transform_edt(~known, return_indices=True)
    for c in range(values.shape[-1]):
        rhs = np.zeros(domain.shape, np.float32)
        for axis, w in enumerate(weights):
            low, high = _sides(out[..., c], axis)
            inner_low, inner_high = _cells(w * low, axis, low=True), _cells(w * high, axis, low=False)
            rhs += inner_low + inner_high
        guess = np.where(unknown, out[..., c][tuple(nearest)], 0.0).astype(np.float32)
        f, _ = solve(system, np.where(unknown, rhs, 0.0) / spacing**2, tolerance=tolerance, initial=guess)
        out[..., c] = np.where(unknown, f, out[..., c])
    adrift = domain & ~touched[label]
    if adrift.any() and known.any():
        out[adrift] = values[known].mean(axis=0)
    return out


def faces_from_centers(
    centers: Float[np.ndarray, "nx ny nz 3"], carrying: Bool[np.ndarray, "nx ny nz"]
) -> FaceVelocity:
    """Means of the two cells at each face; of one alone where only one carries fluid; 0 where none does."""
    faces = []
    for axis in range(3):
        low, high = _sides(np.where(carrying, centers[..., axis], 0.0), axis)
        there_low, there_high = _sides(carrying.astype(np.float32), axis)
        faces.append(((low + high) / np.maximum(there_low + there_high, 1.0)).astype(np.float32))
    return FaceVelocity(*faces)


def weighted_projection(
    velocity: FaceVelocity,
    system: PressureSystem,
    mobility: tuple[np.ndarray, np.ndarray, np.ndarray],
    *,
    tolerance: float = 1e-4,
) -> tuple[FaceVelocity, SolveReport]:
    """The divergence-free field nearest to `velocity` when faces resist change with the mass 1 / mobility.

    With the open share o of a face: v' = v - mobility grad q, where -div(o mobility grad q) = -div(o v). Mobility 1
    everywhere is `physics.pressure.project`; faces of mobility 0 keep their velocity.

    Args:
        velocity: m/s.
        system: from `physics.pressure.build_system`.
        mobility: per face across x, y, z, 0 to 1.
        tolerance: share of the divergence that may stay.
    """
    weights = [(w * m).astype(np.float32) for w, m in zip(system.weights, mobility)]
    weighted = PoissonSystem(system.unknown, *weights, system.spacing)
    rhs = -_net_outflow(velocity, system)
    q, report = solve(weighted, rhs.astype(np.float32), tolerance=tolerance)
    q = np.where(system.unknown, q, 0.0)
    faces = []
    for axis, component in enumerate(velocity.components):
        low, high = _sides(q, axis)
        change = np.where(system.weights[axis] > 0, mobility[axis] * (high - low) / system.spacing, 0.0)
        faces.append(np.where(system.openings[axis] > 0, component - change, 0.0).astype(np.float32))
    return FaceVelocity(*faces), report


def constraint_projection(
    velocity: FaceVelocity, system: PressureSystem, *, iterations: int = 200, epsilon: float = 0.1
) -> FaceVelocity:
    """The paper's own iteration (`divProj`), plain, as a reference for the Poisson solve.

    Constraint C_i = (div v)_i per fluid cell; all at once, lambda_i = -C_i / (sum_k |d C_i / d v_k|^2 + eps) and
    v_j += sum_i lambda_i dC_i / dv_j over the faces that may move. As dC/dv is +-o/h, this is the Jacobi iteration on
    C C^T lambda = -C, the Poisson equation. Without eps the iteration keeps a checkerboard of sign changes alive in a
    closed domain (eigenvalue -1); eps > 0 damps it.

    Args:
        velocity: m/s.
        system: from `physics.pressure.build_system`.
        iterations: number of sweeps.
        epsilon: relaxation in units of 1/h^2.
    """
    h = system.spacing
    faces = [np.where(o > 0, c, 0.0).astype(np.float64) for c, o in zip(velocity.components, system.openings)]
    gradients = [np.where(w > 0, o, 0.0) / h for w, o in zip(system.weights, system.openings)]
    squares = sum(_cells(g**2, a, low=True) + _cells(g**2, a, low=False) for a, g in enumerate(gradients))
    for _ in range(iterations):
        constraint = _net_outflow(FaceVelocity(*faces), system)
        multiplier = np.where(system.unknown, -constraint / (squares + epsilon / h**2), 0.0)
        for axis, gradient in enumerate(gradients):
            low, high = _sides(multiplier, axis)
            faces[axis] = faces[axis] + gradient * (low - high)
    return FaceVelocity(*faces)


def target_sequence(
    flow: PixelFlow,
    mask: Bool[np.ndarray, "*t h w"],
    depth: Float[np.ndarray, "*t h w"],
    camera: PinholeCamera,
    terrain: Terrain | None,
    cell_types: UInt8[np.ndarray, "*t nx ny nz"],
    grid: Grid,
    interval: float,
    *,
    kind: str,
    mainstream: Float[np.ndarray, "3"] | None = None,
    frames: range | None = None,
    window: int = 5,
    stride: int = 1,
    tolerance: float = 1e-4,
) -> Iterator[tuple[FaceVelocity, VolumeReport]]:
    """Target velocities frame by frame (paper: v_gt), one in memory at a time.

    Flow is averaged over a centred window of frames, so neighbouring targets share most of their data and do not
    jump; the mainstream direction is that of the whole clip. Masks, depth and cell types may be one for all frames
    (steady geometry) or one per frame.

    Args:
        flow: of the clip.
        mask: the fluid.
        depth: camera z, m, positive inside the mask.
        camera: of the pictures.
        terrain: see `volume_velocity`.
        cell_types: see `volume_velocity`.
        grid: of the cells.
        interval: s per frame.
        kind: fluid type.
        mainstream: unit direction of the bulk flow in the world.
        frames: which frames; None: all that have flow.
        window: frames to average over, odd; 1 takes each frame alone.
        stride: of the pixels that are lifted.
        tolerance: of the projection.
    """
    require(window >= 1 and window % 2 == 1, f"window of {window} frames", "an odd number")
    frames = range(len(flow)) if frames is None else frames

    def at(values: np.ndarray, t: int, dimensions: int) -> np.ndarray:
        return values if np.ndim(values) == dimensions else values[min(t, len(values) - 1)]

    mask = np.asarray(mask, bool)
    overall, trust = mean_flow(flow, mask)
    ever = mask if mask.ndim == 2 else mask.any(axis=0)
    direction = mainstream_direction(overall, trust, ever)
    for t in frames:
        part = slice(max(0, t - window // 2), t + window // 2 + 1)
        now = at(mask, t, 2)
        here = PixelFlow(flow.displacement[part], flow.confidence[part])
        displacement, confidence = mean_flow(here, mask if mask.ndim == 2 else mask[part])
        near, after = at(depth, t, 2), at(depth, t + 1, 2)
        completed, observed = complete_flow(displacement, confidence, now, direction, near)
        mask_after = at(mask, t + 1, 2)
        rate = depth_change(completed, now, near, after, mask_t1=mask_after)
        completed, _ = project_screen_divergence(completed, now, observed, near, rate, camera)
        surface = lift_flow(completed, observed, now, near, after, camera, interval, mask_t1=mask_after, stride=stride)
        yield volume_velocity(
            surface, terrain, at(cell_types, t, 3), grid, kind=kind, mainstream=mainstream, tolerance=tolerance
        )


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


def _typical_depth(carrying: np.ndarray, grid: Grid) -> float:
    """Median height of the fluid in the columns that hold some, m."""
    columns = carrying.sum(axis=2)
    return float(np.median(columns[columns > 0])) * grid.spacing


def _beside_bed(
    values: np.ndarray,
    seen: np.ndarray,
    bed: np.ndarray,
    terrain: Terrain | None,
    grid: Grid,
    kind: str,
    mainstream: np.ndarray | None,
    depth: float,
) -> np.ndarray:
    """Velocity [n,3] of the bed cells from the nearest surface cells."""
    _, nearest = ndimage.distance_transform_edt(~seen, return_indices=True)
    above = values[tuple(n[bed] for n in nearest)].astype(np.float64)
    direction = mainstream
    if direction is None:
        direction = above / np.maximum(np.linalg.norm(above, axis=-1, keepdims=True), 1e-9)
    normal = None
    if terrain is not None:
        points = grid.low + (np.argwhere(bed) + 0.5) * grid.spacing
        normal = gradient_nodes(terrain.signed_distance, terrain.grid, points)
        normal = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    return bed_velocity(above, direction, normal, kind=kind, spacing=grid.spacing, depth=depth)


def _mobility(types: np.ndarray, seen: np.ndarray, surface: float, observed: float) -> tuple[np.ndarray, ...]:
    """Mobility of every face: `surface` towards air, `observed` between two seen cells, else 1."""
    out = []
    for axis in range(3):
        fluid_low, fluid_high = _sides(types == CellType.FLUID, axis)
        air_low, air_high = _sides(types == CellType.EMPTY, axis)
        seen_low, seen_high = _sides(seen, axis)
        face = np.where(seen_low & seen_high, observed, 1.0)
        out.append(np.where((fluid_low & air_high) | (air_low & fluid_high), surface, face).astype(np.float32))
    return tuple(out)


def _net_outflow(velocity: FaceVelocity, system: PressureSystem) -> np.ndarray:
    """Divergence with the open share of faces, 1/s, 0 outside the unknown cells."""
    flux = (c.astype(np.float64) * o for c, o in zip(velocity.components, system.openings))
    total = sum(np.diff(f, axis=axis) for axis, f in enumerate(flux)) / system.spacing
    return np.where(system.unknown, total, 0.0)


def _report(velocity: FaceVelocity, system: PressureSystem, types: np.ndarray, report: SolveReport) -> VolumeReport:
    fluid = types == CellType.FLUID
    speed = np.linalg.norm(velocity.at_centers()[fluid], axis=-1)
    scale = system.spacing / max(float(speed.mean()) if speed.size else 0.0, 1e-12)
    excess = np.abs(_net_outflow(velocity, system)[fluid]) * scale
    fluxes = {}
    for kind in (CellType.INFLOW, CellType.OUTFLOW, CellType.EMPTY):
        total = 0.0
        for axis, (component, opening) in enumerate(zip(velocity.components, system.openings)):
            fluid_low, fluid_high = _sides(fluid, axis)
            other_low, other_high = _sides(types == kind, axis)
            out = (fluid_low & other_high).astype(float) - (other_low & fluid_high)
            total += float((component * opening * out).sum()) * system.spacing**2
        fluxes[kind] = total
    return VolumeReport(
        report,
        float(excess.max()) if excess.size else 0.0,
        float(excess.mean()) if excess.size else 0.0,
        -fluxes[CellType.INFLOW],
        fluxes[CellType.OUTFLOW],
        fluxes[CellType.EMPTY],
    )


def _sides(cells: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Values of the cells before and after each face across `axis`; 0 or False outside the box."""
    before, after = [(0, 0)] * 3, [(0, 0)] * 3
    before[axis], after[axis] = (1, 0), (0, 1)
    return np.pad(cells, before), np.pad(cells, after)


def _cells(faces: np.ndarray, axis: int, *, low: bool) -> np.ndarray:
    """For each cell the value of its face on the low or high side across `axis`."""
    part = [slice(None)] * 3
    part[axis] = slice(None, -1) if low else slice(1, None)
    return faces[tuple(part)]
