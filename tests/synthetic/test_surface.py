"""What the camera of the synthetic scenes sees is where the particles are."""

import numpy as np

from fluidlift.synthetic.film import screen_motion, still_seen, surface_depth
from fluidlift.synthetic.surface import Neighbours, body_of, deposit, finer, first_hit, sphere_trace
from fluidlift.types import Grid, PinholeCamera

GRID = Grid((12, 10, 8), 0.1, (-0.6, -0.5, 0.0))
LEVEL = 0.4


def pool() -> tuple[np.ndarray, float]:
    """Eight particles per cell up to z = 0.4, on a lattice."""
    points = finer(GRID).centers().reshape(-1, 3)
    return points[points[:, 2] < LEVEL], (GRID.spacing / 2) ** 3


def test_deposited_weights_are_all_there_inside_the_grid():
    points = np.random.default_rng(0).uniform(GRID.low + 0.1, GRID.high - 0.1, (50, 3))
    weights = np.arange(50.0)
    assert deposit(points, weights, GRID).sum() == np.float64(weights.sum()).round(9)


def test_the_body_of_a_pool_ends_at_its_level():
    points, volume = pool()
    body = body_of(points, volume, GRID, np.ones(finer(GRID).shape))
    phi = body.signed_cells(GRID)
    z = GRID.centers()[..., 2]
    inner = phi[4:8, 3:7]  # away from the sides of the box
    # a tenth of a cell: the smoothed step of the density is symmetric about the level
    np.testing.assert_allclose(inner[..., 2:6], ((z - LEVEL) / GRID.spacing)[4:8, 3:7, 2:6], atol=0.1)
    normals = body.normals(np.array([[0.0, 0.0, LEVEL]]))
    np.testing.assert_allclose(normals, [[0, 0, 1]], atol=1e-6)


def test_rays_end_on_a_sphere():
    def sphere(p):
        return np.linalg.norm(p - np.array([0, 0, 3.0]), axis=-1) - 1.0

    rays = np.array([[0.0, 0.0, 1.0], [0.2, 0.0, 1.0], [2.0, 0.0, 1.0]])
    start, stop = np.full(3, 0.1), np.full(3, 10.0)
    # depth t of |t r - c| = 1 on the second ray: 1.04 t^2 - 6 t + 8 = 0
    want = np.array([2.0, (6 - np.sqrt(36 - 4 * 1.04 * 8)) / (2 * 1.04), np.inf])
    traced = sphere_trace(sphere, np.zeros(3), rays, start, stop, tolerance=1e-5, safety=1.0)
    np.testing.assert_allclose(traced, want, atol=1e-4)
    # six bisections of a step of 0.05
    np.testing.assert_allclose(first_hit(sphere, np.zeros(3), rays, start, stop, 0.05), want, atol=0.05 / 2**6)


def test_depth_and_motion_of_a_sliding_pool_are_those_of_its_plane():
    points, volume = pool()
    body = body_of(points, volume, GRID, np.ones(finer(GRID).shape))
    camera = PinholeCamera.looking((0.0, -1.2, 1.4), (0.0, 0.0, LEVEL), 25.0, (24, 16))
    wall = np.full(24 * 16, np.inf)
    depth, mask = surface_depth(body, camera, wall)
    assert mask.all()
    rays = camera.rays(camera.pixel_grid())
    plane = (LEVEL - camera.position[2]) / rays[..., 2]
    np.testing.assert_allclose(depth, plane, atol=0.1 * GRID.spacing)
    step = np.array([0.03, 0.01, 0.0])
    flow, change = screen_motion(camera, depth, mask, points, points + step, 0.045)
    there, z = camera.project(camera.unproject(camera.pixel_grid(), depth) + step)
    np.testing.assert_allclose(flow, there - camera.pixel_grid(), atol=1e-5)
    np.testing.assert_allclose(change, z - depth, atol=1e-6)
    seen = still_seen(depth, mask, flow, change, depth, 0.05)
    assert seen.mean() > 0.8  # all but the border that leaves the picture
    assert not still_seen(depth, mask, flow, change, depth - 0.3, 0.05).any()  # something came in front


def test_solids_in_front_hide_the_liquid():
    points, volume = pool()
    body = body_of(points, volume, GRID, np.ones(finer(GRID).shape))
    camera = PinholeCamera.looking((0.0, -1.2, 1.4), (0.0, 0.0, LEVEL), 25.0, (24, 16))
    _, mask = surface_depth(body, camera, np.full(24 * 16, 0.5))
    assert not mask.any()


def test_neighbours_average_linear_fields_of_a_lattice_exactly_at_its_points():
    points, _ = pool()
    near = Neighbours.of(points[:40], points, 0.01)
    # with a radius far below the spacing the nearest particle alone counts
    np.testing.assert_allclose(near.mean(points), points[:40], atol=1e-5)
    np.testing.assert_allclose(near.weight.sum(axis=1), 1.0)
