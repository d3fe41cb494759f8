"""Weighted Helmholtz projection to a divergence-free velocity that keeps what was seen; the paper's own iteration.

The weighted projection takes of all divergence-free fields the one with least

    sum over faces of m_f |v'_f - v_f|^2.

The mass m_f of a face is one over the variance of its velocity, so that this is the best linear estimate (Gauss,
Markov); m enters the Poisson equation as the mobility 1/m of each face. It leaves in- and outflow free and lets the
discharge of a stream follow from all its cross-sections, those that were seen well before those that were not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy import ndimage

from fluidlift.numerics.poisson import PoissonSystem, solve
from fluidlift.physics.pressure import PressureSystem
from fluidlift.types import CellType, FaceVelocity, SolveReport, triple

Faces = tuple[np.ndarray, np.ndarray, np.ndarray]
"""one array per axis: [nx+1,ny,nz], [nx,ny+1,nz], [nx,ny,nz+1]"""

OBSERVED_ERROR, FILLED_ERROR, PROFILE_ERROR = 0.1, 0.5, 0.2
"""Relative errors of a speed: of one that was seen (a tenth of a pixel of flow where it moves by a pixel or more, and
its depth), of one that the mainstream filled in or that lies far from all samples, and of what extension adds below
the surface (depth-averaged over surface speed of real streams: 0.79 to 0.93, Rantz 1982, USGS WSP 2175; a film of
constant viscosity: 0.67)."""
DEPTH_ERROR = 0.3
"""relative, of a depth that is not seen: standard deviation of the logarithm of found over true depths in the columns
of a river of another simulator (0.30). Continuity asks for a flux, and not for a speed: what the bed is off counts as
an error of the flux below the surface, and not of what was seen at it"""
BALANCE_RADIUS = 4.0
"""cells (standard deviation of a Gaussian) over which the flux through the surface of a liquid is balanced: the steps
of a surface in cells have a period of one over its slope, so slopes down to about 1/8 are evened out"""
NARROW_END, WIDE_END = 0.25, 0.5
"""Open area of an in- or outlet over the mean cross-section of the fluid. Through the first, a steady discharge would
come in at four times the mean speed, which says that the end is too small in the geometry; from the second on, at no
more than twice, it is believed."""


def face_mobility(
    types: UInt8[np.ndarray, "nx ny nz"],
    seen: Bool[np.ndarray, "nx ny nz"],
    confidence: Float[np.ndarray, "nx ny nz"],
    surface: Float[np.ndarray, "nx ny nz"],
    below: float = PROFILE_ERROR,
) -> Faces:
    """Mobility of every face, 0 to 1: the variance of its velocity over the largest one.

    Args:
        types: `CellType`.
        seen: cells with a sample of the surface.
        confidence: 1 where the fluid was observed, 0 where it was filled in.
        surface: mobility of each cell's faces towards air over that of its faces towards the fluid below.
        below: relative error that fluid below the samples has beside theirs (`PROFILE_ERROR`; over a bed that is not
            seen with `DEPTH_ERROR`).
    """
    share = np.clip(confidence, 0.0, 1.0)
    variance = OBSERVED_ERROR**2 * share + FILLED_ERROR**2 * (1.0 - share)
    carries = (types != CellType.EMPTY) & (types != CellType.SOLID)
    largest = FILLED_ERROR**2 + below**2
    out = []
    for axis in range(3):
        fluid_low, fluid_high = sides_of_faces(types == CellType.FLUID, axis)
        air_low, air_high = sides_of_faces(types == CellType.EMPTY, axis)
        seen_low, seen_high = sides_of_faces(seen, axis)
        low, high = sides_of_faces(np.where(carries, variance, 0.0), axis)
        leak_low, leak_high = sides_of_faces(surface, axis)
        there_low, there_high = sides_of_faces(carries.astype(np.float32), axis)
        mean = (low + high) / np.maximum(there_low + there_high, 1.0)
        deep = (mean + below**2) / largest
        face = np.where(seen_low & seen_high, mean / largest, deep)
        face = np.where(fluid_low & air_high, leak_low * deep, face)
        out.append(np.where(air_low & fluid_high, leak_high * deep, face).astype(np.float32))
    return out[0], out[1], out[2]


def passed_through(
    types: UInt8[np.ndarray, "nx ny nz"], openings: Faces, *, however_narrow: bool = False
) -> Float[np.ndarray, "nx ny nz"]:
    """How surely each body of fluid has an in- and an outlet that take what it carries, so that no level need change.

    1 where the open area of both ends is at least `WIDE_END` of the body's mean cross-section (its volume over its
    length), 0 at `NARROW_END` and below, where an end is a gap in the geometry and not the way all the fluid takes.
    `however_narrow`: 1 wherever there are both ends.
    """
    label, count = ndimage.label(types == CellType.FLUID)
    section = np.ones(count + 1)
    for k, box in enumerate(ndimage.find_objects(label), start=1):
        section[k] = (label[box] == k).sum() / max(part.stop - part.start for part in box)
    through = np.ones(count + 1)
    for end in (CellType.INFLOW, CellType.OUTFLOW):
        area = np.zeros(count + 1)
        for axis, opening in enumerate(openings):
            (end_low, end_high), (low, high) = sides_of_faces(types == end, axis), sides_of_faces(label, axis)
            area += np.bincount(low[end_high], opening[end_high], count + 1)
            area += np.bincount(high[end_low], opening[end_low], count + 1)
        wide = (area / section - NARROW_END) / (WIDE_END - NARROW_END)
        through = np.minimum(through, area > 0 if however_narrow else np.clip(wide, 0.0, 1.0))
    through[0] = 0.0
    return through[label]


def balance_surface(velocity: FaceVelocity, types: UInt8[np.ndarray, "nx ny nz"], openings: Faces) -> FaceVelocity:
    """No net flux through the free surface, over patches some `BALANCE_RADIUS` cells wide.

    The kinematic condition of a surface at rest is v . n = 0. The faces between liquid and air are steps, so it holds
    for sums over patches and not for each: fluid leaves through the front of a step and enters through the flat
    behind it. Noise of the samples does not balance and would add up along a stream. The local mean of the outward
    flux (Gaussian) is taken off every face towards air; the sum over all of them is then 0.
    """
    fluid, air = types == CellType.FLUID, types == CellType.EMPTY
    faces = [c.astype(np.float32) for c in velocity.components]
    outward = []
    for axis in range(3):
        (fluid_low, fluid_high), (air_low, air_high) = sides_of_faces(fluid, axis), sides_of_faces(air, axis)
        outward.append((fluid_low & air_high).astype(np.float32) - (air_low & fluid_high))

    def of_cells(of_faces: list[np.ndarray]) -> np.ndarray:
        total = np.zeros(types.shape)
        for axis, f in enumerate(of_faces):
            total += cells_of_faces(f, axis, low=True) + cells_of_faces(f, axis, low=False)
        return np.where(fluid, total, 0.0)

    def blurred(cells: np.ndarray) -> np.ndarray:
        return ndimage.gaussian_filter(cells, BALANCE_RADIUS, mode="constant", truncate=2.5)

    area = of_cells([np.abs(s) * o for s, o in zip(outward, openings)])
    flux = of_cells([s * o * f for s, o, f in zip(outward, openings, faces)])
    # divided before the blur: what a cell spreads over the area around it sums up to its own flux, G being symmetric
    mean = blurred(flux / np.maximum(blurred(area), 1e-9)).astype(np.float32)
    for axis, s in enumerate(outward):
        low, high = sides_of_faces(mean, axis)
        faces[axis] = faces[axis] - s * np.where(s > 0, low, high)
    return FaceVelocity(*faces)


EndFaces = tuple[tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]], ...]
"""per axis: faces of in- and outlet cells, and for each the nearest face of the fluid (flat indices)"""


def end_faces(types: UInt8[np.ndarray, "nx ny nz"]) -> EndFaces:
    """Faces of in- and outlet cells that the projection leaves alone, and where they take their velocity from."""
    fluid = types == CellType.FLUID
    ends = (types == CellType.INFLOW) | (types == CellType.OUTFLOW)
    out = []
    for axis in range(3):
        fluid_low, fluid_high = sides_of_faces(fluid, axis)
        end_low, end_high = sides_of_faces(ends, axis)
        solid_low, solid_high = sides_of_faces(types == CellType.SOLID, axis)
        source = (fluid_low | fluid_high) & ~(solid_low | solid_high)
        target = (end_low | end_high) & ~(fluid_low | fluid_high | solid_low | solid_high)
        if not (source.any() and target.any()):
            out.append((np.zeros(0, np.int64), np.zeros(0, np.int64)))
            continue
        index = ndimage.distance_transform_edt(~source, return_distances=False, return_indices=True)
        nearest = np.ravel_multi_index(tuple(n[target] for n in index), source.shape)
        out.append((np.flatnonzero(target), nearest))
    return tuple(out)


def continue_through_ends(velocity: FaceVelocity, ends: EndFaces) -> FaceVelocity:
    """In- and outlet cells take the velocity of the nearest faces of the fluid, which the projection made fit."""
    out = []
    for component, (target, nearest) in zip(velocity.components, ends):
        continued = component.copy()
        continued.flat[target] = component.flat[nearest]
        out.append(continued)
    return FaceVelocity(*out)


def faces_from_centers(
    centers: Float[np.ndarray, "nx ny nz 3"], carrying: Bool[np.ndarray, "nx ny nz"]
) -> FaceVelocity:
    """Means of the two cells at each face; of one alone where only one carries fluid; 0 where none does."""
    faces = []
    for axis in range(3):
        low, high = sides_of_faces(np.where(carrying, centers[..., axis], 0.0), axis)
        there_low, there_high = sides_of_faces(carrying.astype(np.float32), axis)
        faces.append(((low + high) / np.maximum(there_low + there_high, 1.0)).astype(np.float32))
    return FaceVelocity(*faces)


def weighted_projection(
    velocity: FaceVelocity,
    system: PressureSystem,
    mobility: Faces,
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
    weights = triple((w * m).astype(np.float32) for w, m in zip(system.weights, mobility))
    weighted = PoissonSystem(system.unknown, *weights, system.spacing)
    rhs = -net_outflow(velocity, system)
    q, report = solve(weighted, rhs.astype(np.float32), tolerance=tolerance)
    q = np.where(system.unknown, q, 0.0)
    faces = []
    for axis, component in enumerate(velocity.components):
        low, high = sides_of_faces(q, axis)
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
    squares = sum(
        cells_of_faces(g**2, a, low=True) + cells_of_faces(g**2, a, low=False) for a, g in enumerate(gradients)
    )
    for _ in range(iterations):
        constraint = net_outflow(FaceVelocity(*faces), system)
        multiplier = np.where(system.unknown, -constraint / (squares + epsilon / h**2), 0.0)
        for axis, gradient in enumerate(gradients):
            low, high = sides_of_faces(multiplier, axis)
            faces[axis] = faces[axis] + gradient * (low - high)
    return FaceVelocity(*faces)


def outward_openings(types: UInt8[np.ndarray, "nx ny nz"], kind: CellType, openings: Faces) -> Faces:
    """Open share of the faces between the fluid and cells of a kind, negative where out of the fluid is against the
    axis, so that the flux out of the fluid is the sum of these times the velocity."""
    out = []
    for axis, opening in enumerate(openings):
        fluid_low, fluid_high = sides_of_faces(types == CellType.FLUID, axis)
        other_low, other_high = sides_of_faces(types == kind, axis)
        out.append(opening * ((fluid_low & other_high).astype(np.float32) - (other_low & fluid_high)))
    return out[0], out[1], out[2]


def flux_through(velocity: FaceVelocity, outward: Faces) -> float:
    """Sum over faces of velocity times `outward_openings`; m^3/s when multiplied by the area of a face."""
    return sum(float((c * o).sum(dtype=np.float64)) for c, o in zip(velocity.components, outward))


@dataclass(frozen=True)
class Mouth:
    """An end of the flow: all of its inlet, or all of its outlet."""

    outward: Faces
    """see `outward_openings`"""
    area: float
    """open, in faces of cells"""
    near: Bool[np.ndarray, "nx ny nz"]
    """cells beside it"""
    inlet: bool = False
    """fluid comes in here"""


def mouths_of(types: UInt8[np.ndarray, "nx ny nz"], system: PressureSystem, reach: float) -> list[Mouth]:
    """Inlet and outlet, where there are some, and the cells within `reach` (m) of each."""
    found = []
    for kind in (CellType.INFLOW, CellType.OUTFLOW):
        outward = outward_openings(types, kind, system.openings)
        area = sum(float(np.abs(o).sum()) for o in outward)
        if area > 0:
            near = ndimage.distance_transform_edt(types != kind)
            found.append(Mouth(outward, area, np.asarray(near) * system.spacing <= reach, kind == CellType.INFLOW))
    return found


def agreed_limits(velocity: FaceVelocity, mouths: list[Mouth], limits: list[float]) -> list[float]:
    """Limits of both ends of a steady stream, which takes in what leaves it.

    Where one end can carry only a share of the discharge, two witnesses disagree on one number and may be wrong by the
    same factor: the other end carries the geometric mean at most.
    """
    carried = [abs(flux_through(velocity, mouth.outward)) for mouth in mouths]
    share = min(1.0, *(limit / max(c, 1e-12) for c, limit in zip(carried, limits)))
    return limits if share == 1.0 else [min(limit, float(np.sqrt(share)) * c) for c, limit in zip(carried, limits)]


def bounded_ends(velocity: FaceVelocity, mouths: list[Mouth], limits: list[float]) -> FaceVelocity:
    """The ends scaled to carry between 0 and their limit, in at the inlet and out at the outlet.

    Returns `velocity` itself where they do already.

    Args:
        velocity: m/s.
        mouths: the ends.
        limits: of the flux through each, in face areas times m/s.
    """
    faces = list(velocity.components)
    for mouth, limit in zip(mouths, limits):
        carried = flux_through(velocity, mouth.outward) * (-1.0 if mouth.inlet else 1.0)
        if 0.0 <= carried <= limit:
            continue
        share = np.float32(max(min(carried, limit), 0.0) / carried)
        faces = [np.where(o != 0, share * c, c) for c, o in zip(faces, mouth.outward)]
        velocity = FaceVelocity(*faces)
    return velocity


def inward_only(velocity: FaceVelocity, inlets: list[Mouth]) -> FaceVelocity:
    """Nothing leaves through a face of an inlet."""
    faces = list(velocity.components)
    for mouth in inlets:
        faces = [np.where(c * o > 0, np.float32(0.0), c) for c, o in zip(faces, mouth.outward)]
    return FaceVelocity(*faces)


def held_ends(mobility: Faces, mouths: list[Mouth]) -> Faces:
    """Mobility with none at the faces of the ends."""
    x, y, z = (np.where(sum(np.abs(m.outward[a]) for m in mouths) > 0, 0.0, part) for a, part in enumerate(mobility))
    return x.astype(np.float32), y.astype(np.float32), z.astype(np.float32)


def net_outflow(velocity: FaceVelocity, system: PressureSystem) -> np.ndarray:
    """Divergence with the open share of faces, 1/s, 0 outside the unknown cells."""
    flux = (c.astype(np.float64) * o for c, o in zip(velocity.components, system.openings))
    total = sum(np.diff(f, axis=axis) for axis, f in enumerate(flux)) / system.spacing
    return np.where(system.unknown, total, 0.0)


def sides_of_faces(cells: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Values of the cells before and after each face across `axis`; 0 or False outside the box."""
    before, after = [(0, 0)] * 3, [(0, 0)] * 3
    before[axis], after[axis] = (1, 0), (0, 1)
    return np.pad(cells, before), np.pad(cells, after)


def cells_of_faces(faces: np.ndarray, axis: int, *, low: bool) -> np.ndarray:
    """For each cell the value of its face on the low or high side across `axis`."""
    part = [slice(None)] * 3
    part[axis] = slice(None, -1) if low else slice(1, None)
    return faces[tuple(part)]
