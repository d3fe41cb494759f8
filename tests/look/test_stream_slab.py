"""A stream's piece: its ground ends with it in clean sections, and before a plate both go on as in a mirror."""

import numpy as np
import pytest

from fluidlift.look.outlet_section import OpenEnd
from fluidlift.look.stream_slab import Slab
from fluidlift.numerics.ground_block import ground_mesh
from fluidlift.types import CellType, Gaussians, Grid, PinholeCamera, TriangleMesh, matrix_from_quat

GRID = Grid((16, 8, 6), 0.1)
OUT, IN = OpenEnd(np.array([1.0, 0.0, 0.0]), 1.25, 0.1), OpenEnd(np.array([-1.0, 0.0, 0.0]), -0.35, 0.1)
SLAB = Slab((OUT, IN))
STEEP = 0.3


def block():
    """A channel whose bed rises downstream, behind the section by much."""
    x, y = GRID.nodes()[:, :, 0, 0], GRID.nodes()[:, :, 0, 1]
    heights = 0.1 + STEEP * np.abs(y - 0.4) + np.where(x > 1.3, 0.2, 0.0)
    return ground_mesh(GRID, heights), heights


def volume(points, faces):
    a, b, c = (np.asarray(points, float)[faces[:, k]] for k in range(3))
    return float((a * np.cross(b, c)).sum() / 6.0)


def test_a_section_may_stand_at_the_inlet_too():
    cells = np.full((24, 8, 6), CellType.EMPTY, np.uint8)
    cells[4:20, :, 1:4], cells[1:4, :, 1:4] = CellType.FLUID, CellType.INFLOW
    end = OpenEnd.of(cells, Grid(cells.shape, 0.1), np.array([0.98, 0.0, -0.2]), kind=CellType.INFLOW)
    assert end is not None
    np.testing.assert_allclose(end.along, [-1.0, 0.0, 0.0])
    assert end.at == pytest.approx(-0.35)  # the middle of the last of the inlet's cells, counted upstream
    np.testing.assert_array_equal(end.before(np.array([[0.4, 0, 0], [0.3, 0, 0]])), [True, False])


def test_the_ground_is_cut_where_its_liquid_is_and_nothing_stands_behind_the_cut():
    mesh, _ = block()
    found = SLAB.cut(mesh, GRID)
    x, z = found.vertices[:, 0], found.vertices[:, 2]
    assert x.min() == pytest.approx(0.35, abs=1e-6) and x.max() == pytest.approx(1.25, abs=1e-6)
    # at the cut the ground is as high as it was there: what rises behind it was not pushed onto it
    at_cut = np.isclose(x, 1.25, atol=1e-6)
    # heights between nodes are of a spline, which overshoots before the step: by less than a tenth of it
    assert at_cut.sum() > 50 and z[at_cut].max() < 0.1 + STEEP * 0.4 + 0.02
    inside = (mesh.vertices[:, 0] > 0.4) & (mesh.vertices[:, 0] < 1.2)
    np.testing.assert_allclose(found.vertices[inside], mesh.vertices[inside], atol=1e-6)  # float32
    # closed still: its volume is the same about any point
    moved = found.vertices + np.array([3.0, -2.0, 5.0])
    assert volume(found.vertices, found.faces) == pytest.approx(volume(moved, found.faces), rel=1e-4)
    assert 0 < volume(found.vertices, found.faces) < volume(mesh.vertices, mesh.faces)


def test_another_mesh_is_not_cut_and_without_ends_none_is():
    mesh, _ = block()
    other = TriangleMesh(mesh.vertices[:5], np.array([[0, 1, 2]]))
    assert SLAB.cut(other, GRID) is other and Slab().cut(mesh, GRID) is mesh


def test_ground_goes_on_as_in_a_mirror_and_looks_outward_still():
    mesh = SLAB.cut(block()[0], GRID)
    found = SLAB.carried_on(mesh)
    n, f = len(mesh.vertices), len(mesh.faces)
    assert len(found.vertices) == 3 * n and len(found.faces) == 3 * f
    image = found.vertices[n : 2 * n]
    np.testing.assert_allclose(image[:, 0], 2.5 - mesh.vertices[:, 0], atol=1e-6)
    np.testing.assert_array_equal(image[:, 1:], mesh.vertices[:, 1:])
    whole = volume(mesh.vertices, mesh.faces)
    for k in (1, 2):  # a mirror image with the faces as they were would be inside out
        assert volume(found.vertices, found.faces[k * f : (k + 1) * f]) == pytest.approx(whole, rel=1e-4)


def test_liquid_goes_on_as_in_a_mirror_where_it_is_seen():
    rng = np.random.default_rng(0)
    places = rng.uniform([0.2, 0.2, 0.2], [1.4, 0.6, 0.3], (400, 3))
    turned = rng.normal(size=(400, 4))
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    scales = rng.uniform(0.01, 0.05, (400, 3))
    fluid = Gaussians(places, turned, scales, np.full(400, 0.9), np.zeros((400, 1, 3)))
    speeds = rng.normal(size=(400, 3))
    wide = PinholeCamera.looking(np.array([1.25, 0.4, 6.0]), np.array([1.25, 0.4, 0.2]), 60.0, (80, 60))
    found, velocities = SLAB.beyond(fluid, speeds, wide)
    kept = SLAB.before(places)
    n = int(kept.sum())
    assert 0 < n < 400 and len(found) == 3 * n == len(velocities)
    np.testing.assert_allclose(found.means[n : 2 * n, 0], 2.5 - places[kept, 0], atol=1e-9)
    np.testing.assert_allclose(velocities[n : 2 * n], speeds[kept] * [-1, 1, 1])

    def covariances(g):
        axes = matrix_from_quat(g.quats) * g.scales[:, None, :]
        return axes @ np.swapaxes(axes, 1, 2)

    flip = np.diag([-1.0, 1.0, 1.0])
    image = covariances(found.select(slice(n, 2 * n)))
    np.testing.assert_allclose(image, flip @ covariances(fluid.select(kept)) @ flip, atol=1e-7)  # float32
    near = PinholeCamera.looking(np.array([0.8, 0.4, 0.9]), np.array([0.8, 0.4, 0.2]), 20.0, (80, 60))
    assert len(SLAB.beyond(fluid, speeds, near)[0]) == n  # beyond its picture there is nothing to see


def test_what_stands_out_of_the_liquid_and_is_no_bank_is_an_island():
    x, y = GRID.nodes()[:, :, 0, 0], GRID.nodes()[:, :, 0, 1]
    heights = np.where(np.hypot(x - 0.8, y - 0.4) < 0.12, 0.4, 0.1) + np.where(y < 0.05, 0.3, 0.0)
    mesh = ground_mesh(GRID, heights)
    axes = np.meshgrid(np.arange(0.05, 1.6, 0.05), np.arange(0.05, 0.8, 0.05), [0.15, 0.25], indexing="ij")
    still = np.stack(axes, -1).reshape(-1, 3)
    found = Slab(still=still).islands(mesh, GRID)
    assert found is not None
    tops, level, island = found
    np.testing.assert_allclose(level, 0.25)
    assert island[16, 8] and not island[:, 0].any() and (tops[island] > 0.25).all()
    assert Slab().islands(mesh, GRID) is None
    assert Slab(still=still).islands(ground_mesh(GRID, np.full((17, 9), 0.1)), GRID) is None


def test_a_stream_that_goes_down_goes_on_down_beyond_both_ends():
    """As a plain mirror image the upper part of a fall would stand before it, and hide it."""
    x, y = (np.arange(0.4, 1.3, 0.05)[:, None] * np.ones((1, 16)), np.arange(0.025, 0.8, 0.05) * np.ones((18, 1)))
    down = np.where(x < 0.8, 0.6, 0.2) - 0.02 * x  # a ledge in a stream with a slope
    still = np.stack([x, y, down], axis=-1).reshape(-1, 3)
    fluid = Gaussians(
        still.astype(np.float32), np.tile([1.0, 0, 0, 0], (len(still), 1)).astype(np.float32),
        np.full((len(still), 3), 0.02, np.float32), np.ones(len(still), np.float32),
        np.zeros((len(still), 1, 3), np.float32),
    )  # fmt: skip
    camera = PinholeCamera.looking(np.array([0.8, -9.0, 0.4]), np.array([0.8, 0.4, 0.4]), 60.0, (200, 200))
    found, _ = Slab((OUT, IN), still).beyond(fluid, np.zeros((len(still), 3)), camera)
    beyond = found.means[found.means[:, 0] > 1.25]
    upstream = found.means[found.means[:, 0] < 0.35]
    assert len(beyond) > 200 and len(upstream) > 200
    assert beyond[:, 2].max() < 0.2, "no higher than at the outlet"
    assert beyond[beyond[:, 0] > 1.9][:, 2].max() < -0.1, "the next ledge"
    assert upstream[:, 2].min() > 0.55 and upstream[upstream[:, 0] < -0.3][:, 2].min() > 0.9
    plain, _ = Slab((OUT, IN)).beyond(fluid, np.zeros((len(still), 3)), camera)
    assert plain.means[plain.means[:, 0] > 1.9][:, 2].min() > 0.5, "without a level it is the mirror image"
    ground = TriangleMesh(still - [0, 0, 0.1], np.array([[0, 1, 16]]))
    image = Slab((OUT,), still).carried_on(ground).vertices[len(still) :]
    assert image[:, 2].max() < 0.15


def test_images_left_out_beforehand_are_those_that_no_camera_would_see(monkeypatch):
    rng = np.random.default_rng(4)
    still = rng.uniform((0.3, 0, 0.1), (1.3, 0.8, 0.2), (4000, 3))
    still[:, 2] += 0.2 * (still[:, 0] - 0.3)  # it falls upstream: levels move images up and down
    n = len(still)
    splats = Gaussians(
        still.astype(np.float32), np.tile(np.float32([1, 0, 0, 0]), (n, 1)), np.full((n, 3), 0.02, np.float32),
        np.ones(n, np.float32), np.zeros((n, 1, 3), np.float32),
    )  # fmt: skip
    slab, speeds = Slab((OUT, IN), still), np.zeros((n, 3), np.float32)
    for eye in ((2.2, 0.4, 1.0), (0.8, -1.5, 0.6), (0.9, 0.4, 2.0)):
        camera = PinholeCamera.looking(np.array(eye), np.array([1.4, 0.4, 0.1]), 30.0, (48, 32))
        with monkeypatch.context() as m:
            found, _ = slab.beyond(splats, speeds, camera)
            m.setattr(Slab, "_may_be_seen", lambda self, points, end, camera: np.ones(len(points), bool))
            whole, _ = slab.beyond(splats, speeds, camera)
        np.testing.assert_allclose(found.means, whole.means, atol=1e-6)
        assert 0 < len(found)
        # what is seen is what a projection puts near the picture
        images = np.concatenate([slab._image(splats.means[slab.before(splats.means)], end) for end in slab.ends])
        uv, z = camera.project(images)
        room = 0.05 * 48
        near = (z > 0) & (uv > -room).all(axis=1) & (uv < np.array([48, 32]) + room).all(axis=1)
        assert len(found) == slab.before(splats.means).sum() + near.sum()
