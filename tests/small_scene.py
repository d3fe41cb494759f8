"""Striped water that flows along a flat channel: a scene of a second of work; and the stages of a made clip."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fluidlift.io.kept_values import OF_CLIP, kept_value
from fluidlift.scene.build import Scene
from fluidlift.types import (
    CellType,
    FaceVelocity,
    FluidParameters,
    Gaussians,
    Grid,
    Particles,
    PinholeCamera,
    RigidTransform,
    Terrain,
    TriangleMesh,
)
from fluidlift.types.stages import Lift, Shown, Simulation

H = 0.1
"""m, of its cells"""


def from_above() -> PinholeCamera:
    """Looks straight down on the middle from 2 m above."""
    down = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
    return PinholeCamera((96.0, 96.0), (32.0, 24.0), (64, 48), RigidTransform(down, -down @ np.array([0.6, 0.4, 2.4])))


def striped_channel(frames: int, **more: Any) -> Scene:
    """1.2 x 0.8 m, 0.2 m deep from z = 0.1 on, at 0.6 m/s along x; `more` are fields of the scene."""
    grid = Grid((12, 8, 6), H)
    mesh = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    terrain = Terrain(grid, (grid.nodes()[..., 2] - 0.1).astype(np.float32), np.array([1.0, 0.0, 0.0]), mesh)
    cells = np.zeros(grid.shape, np.uint8)
    cells[:, :, 0], cells[:, :, 1:3] = CellType.SOLID, CellType.FLUID
    cells[:2, :, 1:3], cells[-3:, :, 1:3] = CellType.INFLOW, CellType.OUTFLOW
    axes = [(np.arange(2 * n) + 0.5) * 0.5 * H for n in (12, 8, 2)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3) + [0.0, 0.0, 0.1]
    shade = 0.5 + 0.4 * np.sin(17 * places[:, :1]) * np.cos(11 * places[:, 1:2])
    rest = Gaussians.isotropic(places, 0.04, np.repeat(shade, 3, axis=1), 0.9)
    still = FaceVelocity.zeros(grid)
    velocity = FaceVelocity(np.full_like(still.u, 0.6), still.v, still.w)
    body = Particles.at_rest(places, 1.0, np.arange(len(places)), np.broadcast_to([0.6, 0.0, 0.0], places.shape))
    parameters = FluidParameters(inflow_velocity=(0.6, 0.0, 0.0), time_step=0.04)
    scene = Scene("stream", rest, body, terrain, cells, velocity, parameters, from_above(), 0.04, 0.04, frames, 0)
    return replace(scene, **more)


@pytest.fixture
def camera() -> PinholeCamera:
    """`from_above`."""
    return from_above()


@pytest.fixture
def channel() -> Callable[..., Scene]:
    """`striped_channel`."""
    return striped_channel


@dataclass(frozen=True)
class Finished:
    """The values of all stages of a finished asset, as its cache has them."""

    lift: Lift
    simulation: Simulation
    shown: Shown

    @classmethod
    def of(cls, folder: Path) -> Finished:
        """Of the one result that each stage has kept."""

        def kept(name: str, kind: type) -> Any:
            (facts,) = (folder / "work" / name).glob("*.json")
            found = kept_value(folder, name, facts.stem, kind)
            assert found is not None, f"the cache of {name} is damaged"
            return found[0]

        lift = Lift(*(kept(name, kind) for name, kind in OF_CLIP.items()))
        return cls(lift, kept("simulate", Simulation), kept("show", Shown))


@pytest.fixture(scope="module")
def finished(made) -> Finished:
    """The small clip's asset."""
    return Finished.of(made.folder)
