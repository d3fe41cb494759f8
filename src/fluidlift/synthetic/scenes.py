"""Small scenes whose truth is known because this project simulates them itself: a stream, a pour, honey, a dam."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, UInt8

from fluidlift.errors import InputRejected
from fluidlift.numerics.isosurface import surface_nets
from fluidlift.synthetic.paint import LiquidPaint, smoothstep
from fluidlift.synthetic.surface import ScalarField
from fluidlift.types import GRAVITY, CellType, FluidParameters, Grid, Particles, PinholeCamera, Terrain, TriangleMesh

ColorShares = Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, "n 3"]]
"""shares of rock, of green and of wet at points (m) of the ground"""

PER_AXIS = 2
"""particles along each axis of a cell at the start"""


@dataclass(frozen=True)
class SyntheticScene:
    """A liquid in its terrain, ready to run, and a camera."""

    name: str
    kind: str
    grid: Grid
    ground: ScalarField
    """0 on the ground, positive outside, slope up to about 1.5; defined beyond the grid too, for the picture"""
    shares: ColorShares
    terrain: Terrain
    cell_types: UInt8[np.ndarray, "nx ny nz"]
    parameters: FluidParameters
    particles: Particles
    particle_volume: float
    """m^3"""
    camera: PinholeCamera
    settle: float
    """s of simulation before the first frame"""
    fps: float = 25.0
    """frames per second of the clip"""
    paint: LiquidPaint = field(default_factory=LiquidPaint)
    grain: tuple[float, float] = (0.10, 0.035)
    """m: size of the streaks and of the grain of the tracer"""
    stretch: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """how much the streaks are pressed together along each axis: less than 1 draws them out"""

    @property
    def solid(self) -> ScalarField:
        """Signed distance of the ground, m, positive outside."""
        return signed(self.ground, 0.25 * self.grid.spacing)


def signed(f: ScalarField, step: float) -> ScalarField:
    """A function that is 0 on the surface, over the length of its gradient: first-order signed distance."""

    def distance(points: np.ndarray) -> np.ndarray:
        p = np.asarray(points, float)
        value = f(p)
        slope = np.stack([f(p + e) - f(p - e) for e in step * np.eye(3)], -1) / (2 * step)
        return value / np.maximum(np.linalg.norm(slope, axis=-1), 0.3)

    return distance


def ellipsoid(center: tuple[float, float, float], radii: tuple[float, float, float], rough: float) -> ScalarField:
    """A rock: about the distance (m) to an ellipsoid whose radius varies by the share `rough`."""
    c, r = np.asarray(center), np.asarray(radii)

    def f(points: np.ndarray) -> np.ndarray:
        q = (points - c) / r
        length = np.maximum(np.linalg.norm(q, axis=-1), 1e-6)
        d = q / length[..., None]
        lumps = np.sin(3.1 * d[..., 0] + 1.3) * np.sin(4.3 * d[..., 1]) + np.sin(5.2 * d[..., 2] + 2.1 * d[..., 0])
        return (length - 1 - 0.5 * rough * lumps) * r.min()

    return f


def _terrain(solid: ScalarField, grid: Grid, mainstream: tuple[float, float, float]) -> Terrain:
    distance = solid(grid.nodes().reshape(-1, 3)).reshape(tuple(n + 1 for n in grid.shape)).astype(np.float32)
    vertices, faces = surface_nets(distance, spacing=grid.spacing, origin=grid.origin, close=False)
    mesh = TriangleMesh(vertices.astype(np.float32), faces.astype(np.int64))
    return Terrain(grid, distance, np.asarray(mainstream, float), mesh)


def _seeded(
    grid: Grid, solid: ScalarField, wet: Callable[[np.ndarray], np.ndarray], rng: np.random.Generator
) -> tuple[np.ndarray, float]:
    """Jittered particle positions (m) where `wet` and outside the solid, and the volume of one (m^3)."""
    spacing = grid.spacing / PER_AXIS
    axes = [grid.origin[a] + (np.arange(PER_AXIS * grid.shape[a]) + 0.5) * spacing for a in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    points = points + rng.uniform(-0.25, 0.25, points.shape) * spacing
    return points[wet(points) & (solid(points) > 0.25 * spacing)], spacing**3


def _moving(
    positions: np.ndarray, volume: float, parameters: FluidParameters, velocity: tuple[float, ...]
) -> Particles:
    velocities = np.broadcast_to(np.asarray(velocity, np.float32), positions.shape)
    return Particles.at_rest(positions, volume * parameters.density, velocities=velocities)


def _solid_cells(grid: Grid, solid: ScalarField) -> np.ndarray:
    types = np.full(grid.shape, CellType.EMPTY, np.uint8)
    distance = solid(grid.centers().reshape(-1, 3)).reshape(grid.shape)
    types[distance < -0.5 * grid.spacing] = CellType.SOLID
    return types


def stream(*, size: tuple[int, int] = (320, 208), seed: int = 0, cells: int = 72) -> SyntheticScene:
    """A brook 2 m long with one large rock and two small ones, flowing along +x."""
    length, width, height, speed, slope, level = 2.0, 1.28, 0.44, 0.5, 0.008, 0.225
    h = length / cells
    grid = Grid((cells, round(width / h), round(height / h)), h, (-length / 2, -width / 2, 0.0))

    def middle(x: np.ndarray) -> np.ndarray:
        return 0.05 * np.sin(2.4 * x + 0.4)

    def bed(points: np.ndarray) -> np.ndarray:
        x, y = points[..., 0], points[..., 1]
        off = np.abs(y - middle(x)) / (0.40 + 0.035 * np.sin(4.1 * x + 1.0) * np.sign(y))
        bumps = 0.012 * np.sin(9 * x + 2 * y) * np.sin(11 * y) + 0.02 * np.sin(2.7 * x + 4 * y)
        bank = 0.26 * smoothstep(off, 0.62, 1.35) + 0.05 * np.clip(off - 1.2, 0, 3)
        return 0.055 - slope * x + bank + bumps * smoothstep(off, 0.3, 1.2)

    rocks = [
        ellipsoid((0.10, 0.03, 0.15), (0.135, 0.115, 0.14), 0.22),
        ellipsoid((-0.42, -0.23, 0.15), (0.075, 0.065, 0.085), 0.25),
        ellipsoid((0.58, 0.27, 0.18), (0.085, 0.07, 0.08), 0.25),
    ]

    def stones(points: np.ndarray) -> np.ndarray:
        return np.min([rock(points) for rock in rocks], axis=0)

    def ground(points: np.ndarray) -> np.ndarray:
        return np.minimum(points[..., 2] - bed(points), stones(points))

    solid = signed(ground, 0.25 * h)

    def shares(points: np.ndarray) -> np.ndarray:
        above = points[..., 2] + slope * points[..., 0] - level
        rock = smoothstep(-stones(points), -0.012, 0.0)
        return np.stack([rock, smoothstep(above, 0.05, 0.14), 1 - smoothstep(above, 0.0, 0.04)], -1)

    positions, volume = _seeded(
        grid, solid, lambda p: p[:, 2] < level - slope * p[:, 0], rng=np.random.default_rng(seed)
    )
    types = _solid_cells(grid, solid)
    centers = grid.centers()
    wet = (types != CellType.SOLID) & (centers[..., 2] < level + slope * length / 2)
    types[wet & (centers[..., 0] < grid.low[0] + 2 * h)] = CellType.INFLOW
    types[(types != CellType.SOLID) & (centers[..., 0] > grid.high[0] - 2 * h)] = CellType.OUTFLOW
    parameters = FluidParameters(inflow_velocity=(speed, 0.0, 0.0), time_step=0.02)
    camera = PinholeCamera.looking((0.10, -1.28, 1.25), (0.06, 0.01, 0.16), 47.0, size)
    return SyntheticScene(
        "stream", "stream", grid, ground, shares, _terrain(solid, grid, (1.0, 0.0, 0.0)), types, parameters,
        _moving(positions, volume, parameters, parameters.inflow_velocity), volume, camera, settle=1.4,
        stretch=(0.5, 1.0, 1.0),
    )  # fmt: skip


def pour(*, size: tuple[int, int] = (256, 256), seed: int = 0, cells: int = 56) -> SyntheticScene:
    """Water poured from 0.3 m into a stone bowl that is already wet."""
    width, height, speed, radius, level = 0.42, 0.42, 0.9, 0.022, 0.075
    h = width / cells
    grid = Grid((cells, cells, round(height / h)), h, (-width / 2, -width / 2, 0.0))

    def ground(points: np.ndarray) -> np.ndarray:
        x, y = points[..., 0], points[..., 1]
        r = np.hypot(x, y)
        rim = 0.03 + 0.10 * smoothstep(r, 0.06, 0.175) - 0.13 * smoothstep(r, 0.19, 0.30)
        return points[..., 2] - rim

    solid = signed(ground, 0.25 * h)

    def shares(points: np.ndarray) -> np.ndarray:
        stone = smoothstep(points[..., 2], 0.01, 0.03)
        return np.stack([stone, 0 * stone, 0 * stone], -1)

    positions, volume = _seeded(
        grid, solid, lambda p: (p[:, 2] < level) & (np.hypot(p[:, 0], p[:, 1]) < 0.18), rng=np.random.default_rng(seed)
    )
    types = _solid_cells(grid, solid)
    centers = grid.centers()
    jet = np.hypot(centers[..., 0] + 0.03, centers[..., 1]) < radius
    types[jet & (centers[..., 2] > grid.high[2] - 3 * h)] = CellType.INFLOW
    parameters = FluidParameters(inflow_velocity=(0.12, 0.0, -speed), time_step=0.01)
    camera = PinholeCamera.looking((0.10, -0.52, 0.56), (0.0, 0.0, 0.15), 40.0, size)
    return SyntheticScene(
        "pour", "pour", grid, ground, shares, _terrain(solid, grid, (0.0, 0.0, -1.0)), types, parameters,
        _moving(positions, volume, parameters, (0.0, 0.0, 0.0)), volume, camera, settle=0.5, fps=60.0,
        grain=(0.04, 0.015), paint=LiquidPaint(absorption=(60.0, 30.0, 28.0)),
    )  # fmt: skip


def honey(*, size: tuple[int, int] = (288, 224), seed: int = 0, cells: int = 64) -> SyntheticScene:
    """A viscous film 3 cm thick down a board of 22 degrees, at the speed of its steady half-parabola."""
    length, width, thickness, viscosity, angle = 0.42, 0.26, 0.03, 0.008, np.radians(22.0)
    h = length / cells
    drop = length * np.tan(angle)
    grid = Grid((cells, round(width / h), int(np.ceil((drop + 0.08) / h))), h, (-length / 2, -width / 2, 0.0))
    foot = 0.02 + drop / 2
    along, normal = np.array([np.cos(angle), 0.0, -np.sin(angle)]), np.array([np.sin(angle), 0.0, np.cos(angle)])

    def above(points: np.ndarray) -> np.ndarray:
        return points @ normal - foot * normal[2]

    def ground(points: np.ndarray) -> np.ndarray:
        side = np.abs(points[..., 1]) - 0.085
        return above(points) - 0.045 * smoothstep(side, 0.0, 0.02)

    solid = signed(ground, 0.25 * h)

    def shares(points: np.ndarray) -> np.ndarray:
        return np.zeros(points.shape)

    mean = GRAVITY * np.sin(angle) * thickness**2 / (3 * viscosity)
    positions, volume = _seeded(
        grid, solid, lambda p: (above(p) < thickness) & (np.abs(p[:, 1]) < 0.098), rng=np.random.default_rng(seed)
    )
    types = _solid_cells(grid, solid)
    centers = grid.centers()
    open_cell = types != CellType.SOLID
    film = open_cell & (above(centers) < thickness) & (np.abs(centers[..., 1]) < 0.095)
    types[film & (centers[..., 0] < grid.low[0] + 2 * h)] = CellType.INFLOW
    types[open_cell & (centers[..., 0] > grid.high[0] - 2 * h)] = CellType.OUTFLOW
    inflow = tuple(mean * along)
    parameters = FluidParameters(
        density=1400.0, kinematic_viscosity=viscosity, inflow_velocity=inflow, wall_damping=1.0, time_step=0.01
    )
    camera = PinholeCamera.looking((0.16, -0.42, 0.46), (0.0, 0.0, foot + 0.01), 40.0, size)
    amber = LiquidPaint(
        body=(0.50, 0.19, 0.02), absorption=(18.0, 60.0, 220.0), foam=(0.86, 0.55, 0.16), foam_from=0.42, foam_to=0.62
    )
    return SyntheticScene(
        "honey", "pour", grid, ground, shares, _terrain(solid, grid, tuple(along)), types, parameters,
        _moving(positions, volume, parameters, inflow), volume, camera, settle=0.5, paint=amber, grain=(0.04, 0.016),
    )  # fmt: skip


def dam(*, size: tuple[int, int] = (320, 240), seed: int = 0, cells: int = 64) -> SyntheticScene:
    """A column of water 0.6 m high that collapses onto a dry floor, past a pillar, and runs back from unseen walls."""
    length, width, height = 2.0, 0.9, 0.8
    h = length / cells
    grid = Grid((cells, round(width / h), round(height / h)), h, (-length / 2, -width / 2, 0.0))
    floor, across, level = 0.05, 0.5, 0.65

    def pillar(points: np.ndarray) -> np.ndarray:
        return np.maximum(np.abs(points[..., 0] - 0.25), np.abs(points[..., 1] + 0.05)) - 0.09

    def ground(points: np.ndarray) -> np.ndarray:
        return np.minimum(points[..., 2] - floor, np.maximum(pillar(points), points[..., 2] - 0.55))

    solid = signed(ground, 0.25 * h)

    def shares(points: np.ndarray) -> np.ndarray:
        stone = smoothstep(-pillar(points), -0.012, 0.0)
        return np.stack([stone, 0 * stone, 0 * stone], -1)

    positions, volume = _seeded(
        grid, solid, lambda p: (p[:, 0] < grid.low[0] + across) & (p[:, 2] < level), rng=np.random.default_rng(seed)
    )
    parameters = FluidParameters(time_step=0.01)
    camera = PinholeCamera.looking((0.6, -2.9, 1.7), (0.0, 0.0, 0.2), 45.0, size)
    return SyntheticScene(
        "dam", "dam", grid, ground, shares, _terrain(solid, grid, (1.0, 0.0, 0.0)), _solid_cells(grid, solid),
        parameters, _moving(positions, volume, parameters, (0.0, 0.0, 0.0)), volume, camera, settle=0.0,
    )  # fmt: skip


SCENES: dict[str, Callable[..., SyntheticScene]] = {"stream": stream, "pour": pour, "honey": honey, "dam": dam}


def scene_of(name: str, *, size: tuple[int, int], seed: int, cells: int) -> SyntheticScene:
    """A scene by name.

    Args:
        name: stream, pour, honey or dam.
        size: width and height of the picture, px.
        seed: of the random numbers.
        cells: of the grid along x.

    Raises:
        InputRejected: an unknown name, or a size that cannot work.
    """
    if name not in SCENES:
        raise InputRejected(f"no synthetic scene '{name}'", "one of " + ", ".join(SCENES))
    if cells < 12 or min(size) < 16:
        raise InputRejected(f"a scene of {cells} cells and {size} px", "at least 12 cells and 16 px")
    return SCENES[name](size=size, seed=seed, cells=cells)
