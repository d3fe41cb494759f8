"""The surface beyond the picture's edges: as fine as the seen one, its mirror image, without smears."""

import numpy as np
import pytest

from fluidlift.physics.inlet import clear_of_shore
from fluidlift.shape.off_picture import continued, in_picture
from fluidlift.types import CellType, Gaussians, Grid, PinholeCamera, Setting, Terrain, TriangleMesh

GRID = Grid((24, 12, 6), 0.1)
LEVEL = 0.35
CAMERA = PinholeCamera.looking((1.2, -1.4, 1.6), (1.2, 0.6, 0.3), 40.0, (96, 64))


def setting(rock=None, level=LEVEL):
    """Water 0.35 m deep on a flat bed, with a pillar where it is told to stand."""
    nodes = GRID.nodes()
    distance = nodes[..., 2] - 0.02
    if rock is not None:
        distance = np.minimum(distance, np.linalg.norm(nodes[..., :2] - rock, axis=-1) - 0.15)
    cells = np.where(GRID.centers()[..., 2] < LEVEL, CellType.FLUID, CellType.EMPTY).astype(np.uint8)
    mesh = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    terrain = Terrain(GRID, distance.astype(np.float32), np.array([1.0, 0.0, 0.0]), mesh)
    height = None if level is None else np.full(GRID.shape[:2], level)
    return Setting(terrain, cells, height, np.zeros(GRID.shape[:2]))


def surface(step=0.02):
    """Splats that the picture shows, red by where they are along the stream."""
    x, y = np.meshgrid(np.arange(0.01, 2.4, step), np.arange(0.01, 1.2, step), indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, LEVEL)], axis=1)
    points = points[in_picture(points, CAMERA)]
    colours = np.stack([points[:, 0] / 2.4, points[:, 1] / 1.2, np.full(len(points), 0.5)], axis=1)
    return Gaussians.isotropic(points, 0.008, colours)


def hull():
    x, y, z = np.meshgrid(np.arange(0.05, 2.4, 0.1), np.arange(0.05, 1.2, 0.1), [0.34, 0.2], indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
    return Gaussians.isotropic(points, 0.04, np.zeros((len(points), 3)))


def test_what_is_not_seen_is_the_mirror_image_of_what_is():
    front = surface()
    new, _ = continued(front, hull(), setting(), CAMERA)
    # half cells that the edge cuts take splats from both sides of it, by at most their own width
    assert (~in_picture(new.means, CAMERA)).mean() > 0.9
    np.testing.assert_allclose(new.means[:, 2], LEVEL, atol=1e-6)
    left = new.select((new.means[:, 0] < 1.2) & (new.means[:, 1] > 0.3) & (new.means[:, 1] < 0.9))
    seen = front.means
    begins = np.array([seen[np.abs(seen[:, 1] - y) < 0.03, 0].min() for y in left.means[:, 1]])
    # the colour tells where it was taken; rows are half a cell wide, and the edge slants by less than that in a row
    np.testing.assert_allclose(2.4 * left.rgb[:, 0], 2 * begins - left.means[:, 0], atol=0.08)


def test_it_is_as_fine_as_the_seen_surface():
    front = surface()
    new, _ = continued(front, hull(), setting(), CAMERA)
    outside = ~in_picture(np.concatenate([front.means, new.means]), CAMERA)
    area = 2.4 * 1.2 - len(front) * 0.02**2
    assert len(new) == pytest.approx(area / 0.02**2, rel=0.1)  # one per 2 cm square
    assert outside.sum() > 500


def test_the_hull_goes_where_it_would_show_through_and_nowhere_else():
    _, kept = continued(surface(), hull(), setting(), CAMERA)
    seen = in_picture(kept.means, CAMERA)
    top = kept.means[:, 2] > 0.3
    assert not (top & ~seen & (np.abs(kept.means[:, 0] - 1.2) > 1.0)).any()
    before = hull()
    assert (~top).sum() == (before.means[:, 2] < 0.3).sum()


def test_rocks_are_not_repeated():
    rock = np.array([0.75, 0.55])
    front = surface()
    near = np.linalg.norm(front.means[:, :2] - rock, axis=1) < 0.25  # the pillar and a cell around it
    painted = Gaussians(front.means, front.quats, front.scales, front.opacities, front.sh.copy())
    painted.sh[near, 0] = 9.0
    new, _ = continued(painted, hull(), setting(rock), CAMERA)
    assert len(new) > 500 and (new.sh[:, 0] < 8.0).all()


def test_a_body_in_the_air_stays_as_it_is():
    before = hull()
    new, kept = continued(surface(), before, setting(level=None), CAMERA)
    assert len(new) == 0 and kept is before


def test_only_what_stands_out_of_the_water_is_a_shore():
    points = np.array([[0.75, 0.55, LEVEL], [0.75, 0.8, LEVEL], [1.8, 0.55, LEVEL], [1.8, 0.55, 0.05]])
    terrain = setting(np.array([0.75, 0.55])).terrain
    # on the pillar, 0.1 m from it, and far from it at the surface and at the bed
    assert clear_of_shore(points, np.full(4, LEVEL), terrain).tolist() == [False, False, True, True]
