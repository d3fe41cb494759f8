"""Viscous flows with known solutions."""

import numpy as np
import pytest

from fluidlift.physics.viscosity import diffuse, diffuse_component
from fluidlift.types import FaceVelocity, Grid


def masks(grid, value):
    return tuple(np.full(grid.face_shape(a), value) for a in range(3))


@pytest.mark.parametrize("viscosity", [1e-3, 1e-1], ids=["diagonal preconditioner", "multigrid preconditioner"])
def test_taylor_green_vortices_decay_at_the_viscous_rate(viscosity):
    n = 32
    grid = Grid((n, n, 2), np.pi / n)
    h, k, dt, steps = grid.spacing, 1.0, 0.25, 4
    u, v = grid.faces(0), grid.faces(1)
    velocity = FaceVelocity(
        np.float32(np.sin(k * u[..., 0]) * np.cos(k * u[..., 1])),
        np.float32(-np.cos(k * v[..., 0]) * np.sin(k * v[..., 1])),
        np.zeros(grid.face_shape(2), np.float32),
    )
    start = velocity
    fixed = tuple(np.zeros(grid.face_shape(a), bool) for a in range(3))
    for a in range(2):  # no flow through the sides
        np.moveaxis(fixed[a], a, 0)[[0, -1]] = True
    solved = tuple(~f for f in fixed)
    for _ in range(steps):
        velocity, reports = diffuse(
            velocity, solved, fixed, masks(grid, False), viscosity=viscosity, dt=dt, spacing=h, wall_share=0.0,
            tolerance=1e-7,
        )  # fmt: skip
        assert all(r.converged for r in reports)
    rate = 2 * (2 - 2 * np.cos(k * h)) / h**2  # eigenvalue of the discrete Laplacian, 2 k^2 up to h^2 / 12
    truth = (1 + dt * viscosity * rate) ** -steps  # backward Euler
    for a in range(2):
        np.testing.assert_allclose(velocity.components[a], truth * start.components[a], atol=3e-6)  # float32
    # and the discrete rate is that of the equation: first order in dt, second in h
    assert truth == pytest.approx(np.exp(-2 * viscosity * dt * steps), rel=dt * viscosity * 2)


def test_flow_between_plates_becomes_a_parabola():
    grid = Grid((3, 3, 18), 0.05)
    viscosity, force, dt = 0.1, 1.0, 0.5
    walls = np.zeros(grid.face_shape(0), bool)
    walls[:, :, 0] = walls[:, :, -1] = True
    u = np.zeros(grid.face_shape(0), np.float32)
    for _ in range(60):
        u, report = diffuse_component(
            np.where(walls, 0, u + force * dt), ~walls, np.zeros_like(walls), walls,
            viscosity * dt / grid.spacing**2, wall_share=1.0, tolerance=1e-7,
        )  # fmt: skip
        assert report.converged
    z = grid.faces(0)[..., 2] - grid.spacing
    height = 16 * grid.spacing
    truth = force / (2 * viscosity) * z * (height - z)
    # the wall lies half a cell from the first face: the scheme is second order, h^2 / 8 of the curvature at the wall
    assert np.abs(u - truth)[~walls].max() < force / (2 * viscosity) * grid.spacing**2 * 0.26 + 1e-4


def test_walls_without_damping_let_the_flow_slip():
    grid = Grid((3, 3, 10), 0.1)
    walls = np.zeros(grid.face_shape(0), bool)
    walls[:, :, 0] = True
    u = np.where(walls, 0, 1).astype(np.float32)
    new, _ = diffuse_component(u, ~walls, np.zeros_like(walls), walls, 5.0, wall_share=0.0)
    np.testing.assert_allclose(new, u, atol=1e-5)


def test_negligible_viscosity_changes_nothing():
    grid = Grid((4, 4, 4), 0.1)
    velocity = FaceVelocity(*(np.random.default_rng(0).normal(size=grid.face_shape(a)) for a in range(3)))
    new, reports = diffuse(
        velocity, masks(grid, True), masks(grid, False), masks(grid, False), viscosity=1e-6, dt=0.01, spacing=0.1,
        wall_share=1.0,
    )  # fmt: skip
    assert new is velocity and reports == ()
