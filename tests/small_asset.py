"""A small asset with every field filled, and Gaussians, for tests that only look at files."""

from __future__ import annotations

import numpy as np

from fluidlift.types import (
    CellType,
    Estimate,
    FaceVelocity,
    FluidAsset,
    FluidParameters,
    Gaussians,
    Grid,
    PinholeCamera,
    Similarity3,
    Terrain,
    TriangleMesh,
)


def random_gaussians(n: int, coefficients: int = 4, seed: int = 0) -> Gaussians:
    """Gaussians with every number different."""
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(n, 4))
    return Gaussians(
        rng.normal(size=(n, 3)),
        quats / np.linalg.norm(quats, axis=1, keepdims=True),
        rng.uniform(0.005, 0.05, (n, 3)),
        rng.uniform(0.01, 0.99, n),
        0.3 * rng.normal(size=(n, coefficients, 3)),
    )


def small_mesh() -> TriangleMesh:
    """One quarter of an octahedron, with colours."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], np.float32)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    return TriangleMesh(vertices, faces, np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.5, 0.5, 0.5]], np.float32))


def small_asset() -> FluidAsset:
    """A fluid with every field filled."""
    rng = np.random.default_rng(7)
    grid = Grid((6, 5, 4), 0.1, (-0.3, 0.2, -1.0))
    cells = rng.integers(0, len(CellType), grid.shape).astype(np.uint8)
    velocity = FaceVelocity(*(rng.normal(size=grid.face_shape(a)).astype(np.float32) for a in range(3)))
    distance = rng.normal(size=(7, 6, 5)).astype(np.float32)
    return FluidAsset(
        kind="stream",
        rest=random_gaussians(40),
        terrain=Terrain(grid, distance, np.array([1.0, 0.0, 0.0]), small_mesh()),
        grid=grid,
        cell_types=cells,
        velocity=velocity,
        parameters=FluidParameters(kinematic_viscosity=3e-5, inflow_velocity=(0.4, 0.1, 0.0)),
        estimates={
            "kinematic_viscosity": Estimate(3e-5, 1e-6, True, 1e-6, "m^2/s"),
            "density": Estimate(1000.0, np.inf, False, 1000.0, "kg/m^3"),
        },
        camera=PinholeCamera.looking(np.array([3.0, -2.0, 2.0]), np.zeros(3), 50, (512, 288)),
        world_from_canonical=Similarity3(2.5, np.eye(3), np.array([0.1, 0.2, 0.3])),
        interval=1001 / 30000,
        frame_count=90,
        provenance={"seed": 3, "input": {"name": "river.mp4", "sha256": "00"}},
    )
