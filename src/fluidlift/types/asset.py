"""The product: everything that is needed to show, re-simulate and edit one fluid."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fluidlift.types.camera import PinholeCamera
from fluidlift.types.gaussians import Gaussians
from fluidlift.types.grid import FaceVelocity, Grid
from fluidlift.types.parameters import Estimate, FluidParameters
from fluidlift.types.terrain import Terrain
from fluidlift.types.transforms import Similarity3

FORMAT_VERSION = 1
"""of the asset folder; readers reject newer ones"""


@dataclass(frozen=True)
class FluidAsset:
    """One fluid, at rest in its terrain, with the physics that moves it."""

    kind: str
    """name of a `FluidKind` (`kind_of`)"""
    rest: Gaussians
    """world, m"""
    terrain: Terrain
    grid: Grid
    cell_types: np.ndarray
    """u8 [nx,ny,nz], values of `CellType` at the first instant"""
    velocity: FaceVelocity
    """at the first instant"""
    parameters: FluidParameters
    estimates: dict[str, Estimate]
    camera: PinholeCamera
    """of the video, in the world"""
    world_from_canonical: Similarity3
    interval: float
    """s between frames of the video"""
    frame_count: int
    """frames of the video"""
    provenance: dict[str, Any] = field(default_factory=dict)
