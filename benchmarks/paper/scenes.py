"""The eight made examples of the page: five thin liquids and three viscous ones.

Four are scenes of the package; the others are the same simulator and painter on other ground.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fluidlift.synthetic.paint import LiquidPaint, smoothstep
from fluidlift.synthetic.scenes import (
    SyntheticScene,
    _moving,
    _seeded,
    _solid_cells,
    _terrain,
    dam,
    ellipsoid,
    honey,
    pour,
    signed,
    stream,
)  # fmt: skip
from fluidlift.types import CellType, FluidParameters, Grid, PinholeCamera

Field = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Plan:
    """One example."""

    scene: Callable[[], SyntheticScene]
    kind: str
    """of the fluid, as `--kind` has it"""
    frames: int
    seed: int
    title: str


def channel(
    name: str, bed: Field, level: Field, shares: Field, *, length: float, width: float, height: float, cells: int,
    parameters: FluidParameters, camera: PinholeCamera, stones: Field | None = None, **looks: Any,
) -> SyntheticScene:  # fmt: skip
    """A liquid that runs along +x over a bed, in at one end and out at the other.

    Args:
        name: of the scene.
        bed: z of the ground at points, m.
        level: z of the surface at the start, m.
        shares: rock, green and wet at points of the ground.
        length: m along x.
        width: m along y.
        height: m along z.
        cells: along x.
        parameters: of the liquid; its inflow is the velocity at the start.
        camera: of the film.
        stones: signed distance of rocks, m.
        looks: further fields of `SyntheticScene`.
    """
    h = length / cells
    grid = Grid((cells, round(width / h), round(height / h)), h, (-length / 2, -width / 2, 0.0))

    def ground(points: np.ndarray) -> np.ndarray:
        above = points[..., 2] - bed(points)
        return above if stones is None else np.minimum(above, stones(points))

    solid = signed(ground, 0.25 * h)
    positions, volume = _seeded(grid, solid, lambda p: p[:, 2] < level(p), rng=np.random.default_rng(1))
    types, centers = _solid_cells(grid, solid), grid.centers()
    open_cell = types != CellType.SOLID
    types[open_cell & (centers[..., 2] < level(centers)) & (centers[..., 0] < grid.low[0] + 2 * h)] = CellType.INFLOW
    types[open_cell & (centers[..., 0] > grid.high[0] - 2 * h)] = CellType.OUTFLOW
    moving = _moving(positions, volume, parameters, parameters.inflow_velocity)
    told: dict[str, Any] = {"settle": 1.2} | looks
    return SyntheticScene(
        name, "stream", grid, ground, shares, _terrain(solid, grid, (1.0, 0.0, 0.0)), types, parameters, moving,
        volume, camera, **told,
    )  # fmt: skip


def rapids() -> SyntheticScene:
    """A steep brook 2.4 m long between five boulders, 9 cm deep."""
    slope, depth, half = 0.09, 0.10, 0.42

    def bed(p: np.ndarray) -> np.ndarray:
        off = np.abs(p[..., 1] - 0.07 * np.sin(2.1 * p[..., 0])) / half
        rough = 0.014 * np.sin(13 * p[..., 0] + 3 * p[..., 1]) * np.sin(12 * p[..., 1] + 1)
        return 0.17 - slope * p[..., 0] + 0.24 * smoothstep(off, 0.7, 1.3) + rough

    def level(p: np.ndarray) -> np.ndarray:
        return 0.17 - slope * p[..., 0] + depth

    places = [(-0.62, 0.16, 0.11), (-0.2, -0.2, 0.13), (0.15, 0.12, 0.12), (0.55, -0.12, 0.11), (0.8, 0.22, 0.09)]
    rocks = [
        ellipsoid((x, y, float(0.19 - slope * x)), (1.1 * r, 0.9 * r, 1.3 * r), 0.22)
        for x, y, r in places
    ]  # fmt: skip

    def stones(p: np.ndarray) -> np.ndarray:
        return np.min([rock(p) for rock in rocks], axis=0)

    def shares(p: np.ndarray) -> np.ndarray:
        above = p[..., 2] - level(p)
        return np.stack([
            smoothstep(-stones(p), -0.012, 0.0), smoothstep(above, 0.05, 0.14), 1 - smoothstep(above, 0.0, 0.04)
        ], -1)  # fmt: skip

    parameters = FluidParameters(inflow_velocity=(0.8, 0.0, -0.07), time_step=0.02)
    camera = PinholeCamera.looking((0.35, -1.5, 1.35), (0.05, 0.02, 0.2), 48.0, (320, 208))
    return channel(
        "rapids", bed, level, shares, length=2.4, width=1.3, height=0.56, cells=80, parameters=parameters,
        camera=camera, stones=stones, stretch=(0.5, 1.0, 1.0), paint=LiquidPaint(foam_from=0.50, foam_to=0.66),
    )  # fmt: skip


def fall() -> SyntheticScene:
    """A stream that goes over a ledge 0.5 m high into a pool."""
    lip, drop = -0.10, 0.50

    def bed(p: np.ndarray) -> np.ndarray:
        step = 0.62 - drop * smoothstep(p[..., 0], lip, lip + 0.07)
        off = np.abs(p[..., 1])
        banks = 0.20 * smoothstep(off, 0.26, 0.40) + 0.05 * np.clip(off - 0.4, 0, 1)
        return step + banks + 0.008 * np.sin(15 * p[..., 0]) * np.sin(17 * p[..., 1])

    def level(p: np.ndarray) -> np.ndarray:
        return np.where(p[..., 0] < lip + 0.05, 0.69, 0.20)

    def shares(p: np.ndarray) -> np.ndarray:
        high = smoothstep(p[..., 2], 0.72, 0.82)
        return np.stack([0.6 * np.ones_like(high), 0.8 * high, 1 - smoothstep(p[..., 2], 0.24, 0.3)], -1)

    parameters = FluidParameters(inflow_velocity=(0.7, 0.0, 0.0), time_step=0.01)
    camera = PinholeCamera.looking((1.75, -0.75, 0.95), (-0.05, 0.0, 0.36), 42.0, (288, 256))
    made = channel(
        "fall", bed, level, shares, length=1.6, width=1.0, height=0.96, cells=64, parameters=parameters, camera=camera,
        grain=(0.07, 0.025), settle=1.0, fps=30.0, paint=LiquidPaint(foam_from=0.38, foam_to=0.58),
    )  # fmt: skip
    return replace(made, kind="fall")


LAVA = LiquidPaint(
    body=(0.55, 0.06, 0.005), absorption=(30.0, 200.0, 400.0), foam=(0.05, 0.03, 0.028), foam_from=0.46, foam_to=0.56
)
CHOCOLATE = LiquidPaint(
    body=(0.10, 0.035, 0.014), absorption=(200.0, 300.0, 400.0), foam=(0.34, 0.17, 0.09), foam_from=0.42, foam_to=0.62
)


def film(
    name: str, paint: LiquidPaint, viscosity: float, angle: float, thickness: float, winding: float
) -> SyntheticScene:
    """A viscous film in a channel on a slope of `angle` degrees; it starts at the mean speed of its steady profile."""
    length, width, cells = 0.9, 0.46, 72
    slope = float(np.tan(np.radians(angle)))

    def off(p: np.ndarray) -> np.ndarray:
        return np.abs(p[..., 1] - winding * np.sin(7.0 * p[..., 0]))

    def floor(p: np.ndarray) -> np.ndarray:
        return 0.04 + slope * (length / 2 - p[..., 0])

    def bed(p: np.ndarray) -> np.ndarray:
        rough = 0.006 * np.sin(31 * p[..., 0] + 9 * p[..., 1]) * np.sin(29 * p[..., 1])
        return floor(p) + 0.06 * smoothstep(off(p), 0.11, 0.16) + rough * smoothstep(off(p), 0.12, 0.16)

    def level(p: np.ndarray) -> np.ndarray:
        return floor(p) + thickness

    def shares(p: np.ndarray) -> np.ndarray:
        return np.stack([np.ones(p.shape[:-1]), np.zeros(p.shape[:-1]), np.zeros(p.shape[:-1])], -1)

    deep = thickness * float(np.cos(np.radians(angle)))
    mean = 9.81 * float(np.sin(np.radians(angle))) * deep**2 / (3 * viscosity)
    turn = np.radians(angle)
    parameters = FluidParameters(
        density=1400.0, kinematic_viscosity=viscosity, wall_damping=1.0, time_step=0.01,
        inflow_velocity=(mean * float(np.cos(turn)), 0.0, -mean * float(np.sin(turn))),
    )  # fmt: skip
    middle = 0.04 + slope * length / 2
    camera = PinholeCamera.looking((0.30, -0.72, middle + 0.72), (0.0, 0.0, middle), 44.0, (288, 208))
    return channel(
        name, bed, level, shares, length=length, width=width, height=slope * length + 0.14, cells=cells,
        parameters=parameters, camera=camera, settle=0.6, paint=paint, grain=(0.06, 0.022),
    )  # fmt: skip


PLANS = {
    "stream": Plan(lambda: stream(size=(320, 208), seed=3, cells=72), "stream", 24, 3, "a brook with a rock"),
    "rapids": Plan(rapids, "stream", 24, 4, "rapids between boulders"),
    "fall": Plan(fall, "fall", 24, 5, "a fall into a pool"),
    "pour": Plan(lambda: pour(size=(256, 256), cells=56), "pour", 30, 0, "water poured into a bowl"),
    "dam": Plan(lambda: dam(size=(320, 240), cells=64), "dam", 30, 0, "a column of water that breaks"),
    "honey": Plan(lambda: honey(size=(288, 224), cells=64), "stream", 24, 0, "honey down a board"),
    "lava": Plan(lambda: film("lava", LAVA, 0.03, 14.0, 0.05, 0.03), "stream", 24, 7, "lava in a channel"),
    "chocolate": Plan(
        lambda: film("chocolate", CHOCOLATE, 0.006, 9.0, 0.03, 0.0), "stream", 24, 8, "chocolate down a slope"
    ),
}
"""what is filmed, each about a second: five thin liquids, three viscous ones"""
EXAMPLES = tuple(PLANS)
"""of the sheet"""
