"""Waves raise meshes, lean the normals of pictures, and end at the waterline."""

import numpy as np

from fluidlift.look.liquid import SurfaceBuffer
from fluidlift.look.wave_relief import WaveRelief
from fluidlift.look.wave_spectrum import FilmedWaves
from fluidlift.numerics.mesh_normals import vertex_normals
from fluidlift.physics.wave_dispersion import WaveMedium
from fluidlift.present.surface_waves import SurfaceWaves
from fluidlift.types import Grid, PinholeCamera, Terrain, TriangleMesh

CELL, LEVEL, SLOPE = 0.1, 0.5, 0.1
CAMERA = PinholeCamera.looking((1.0, -2.0, 2.0), (1.0, 1.0, LEVEL), fov_degrees=40.0, size=(80, 60))


def waves(wavelength=0.8):
    """On a basin of 2 x 2 m over a bed at z = 0, with a bank beyond y = 1.6 m."""
    grid = Grid((20, 20, 10), CELL)
    nodes = grid.nodes()
    terrain = Terrain(
        grid, np.minimum(nodes[..., 2], 1.6 - nodes[..., 1]).astype(np.float32), np.array([1.0, 0.0, 0.0]),
        TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int)),
    )  # fmt: skip
    k = np.array([[0.0, 2 * np.pi / wavelength]])
    filmed = FilmedWaves(k, np.array([SLOPE**2]), np.array([False]), 0.0, (1.0, 1.0))
    place = np.zeros(2), 0.2
    relief = WaveRelief.of(filmed, WaveMedium(), place, np.zeros((10, 10, 2)), np.ones((10, 10)), seed=2)
    return SurfaceWaves(relief, terrain, 0.04)


def sheet(count=41):
    """A level surface with a wall at its near edge."""
    x, y = np.meshgrid(*[np.linspace(0.0, 2.0, count)] * 2, indexing="ij")
    points = np.stack([x, y, np.full_like(x, LEVEL)], axis=-1).reshape(-1, 3)
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    faces = np.concatenate([np.stack([corner, corner + count, corner + 1], 1),
                            np.stack([corner + 1, corner + count, corner + count + 1], 1)])  # fmt: skip
    return TriangleMesh(points, faces, np.full(points.shape, 0.5))


def test_a_mesh_is_raised_by_the_waves_and_moves_with_them():
    made, mesh = waves(), sheet()
    up, still = vertex_normals(mesh), np.zeros((len(mesh.vertices), 3))
    raised, moving = made.raised(mesh, up, still, 1.0)
    away = 1.6 - mesh.vertices[:, 1]
    height = raised.vertices[:, 2] - LEVEL
    expected = made.relief.at(mesh.vertices[:, :2], 1.0, blur=0.2 * CELL).height
    np.testing.assert_allclose(height[away > 0.2], expected[away > 0.2], atol=1e-5)
    assert np.abs(height[away > 0.2]).max() > 0.005
    np.testing.assert_array_equal(raised.vertices[:, :2], mesh.vertices[:, :2].astype(np.float32))
    assert moving is not None
    later, _ = made.raised(mesh, up, still, 1.01)
    np.testing.assert_allclose((later.vertices[:, 2] - raised.vertices[:, 2]) / 0.01, moving[:, 2], atol=0.02)
    assert np.abs(moving[:, 2]).max() > 0.02


def test_nothing_moves_at_the_waterline_or_on_what_stands():
    made, mesh = waves(), sheet()
    raised, _ = made.raised(mesh, vertex_normals(mesh), None, 1.0)
    beyond = mesh.vertices[:, 1] >= 1.6
    np.testing.assert_array_equal(raised.vertices[beyond, 2], np.float32(LEVEL))
    near = (mesh.vertices[:, 1] > 1.54) & ~beyond
    assert np.abs(raised.vertices[near, 2] - LEVEL).max() < 0.3 * np.abs(raised.vertices[:, 2] - LEVEL).max()
    walls = np.broadcast_to([0.0, -1.0, 0.0], mesh.vertices.shape)
    np.testing.assert_array_equal(made.raised(mesh, walls, None, 1.0)[0].vertices, mesh.vertices.astype(np.float32))


def seen(normal=(0.0, 0.0, 1.0)):
    """The level surface, as the camera sees it; to the left there is none."""
    rays = CAMERA.rays(CAMERA.pixel_grid())
    depth = ((LEVEL - CAMERA.position[2]) / rays[..., 2]).astype(np.float32)
    depth[:, :10] = 0.0
    shape = depth.shape
    return SurfaceBuffer(depth, np.broadcast_to(normal, (*shape, 3)), np.ones(shape), np.ones((*shape, 3)),
                         (depth > 0).astype(np.float32))  # fmt: skip


def test_normals_lean_as_the_waves_slope():
    made, surface = waves(), seen()
    found = made.tilted(surface, CAMERA, 1.0)
    points = CAMERA.unproject(CAMERA.pixel_grid(), surface.depth.astype(float))
    inside = (surface.depth > 0) & (points[..., 1] > 0.1) & (points[..., 1] < 1.4)
    slope = made.relief.at(points[inside][:, :2], 1.0).slope
    np.testing.assert_allclose(-found.normal[inside][:, 1] / found.normal[inside][:, 2], slope[:, 1], atol=0.01)
    assert np.abs(slope[:, 1]).max() > SLOPE
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=-1), 1.0, atol=1e-5)
    for same in ("depth", "thickness", "covered"):
        np.testing.assert_array_equal(getattr(found, same), getattr(surface, same))
    np.testing.assert_array_equal(found.normal[:, :10], surface.normal[:, :10])
    dry = points[..., 1] > 1.6
    np.testing.assert_allclose(found.normal[dry], surface.normal[dry], atol=1e-6)


def test_waves_shorter_than_a_pixel_do_not_glitter():
    calm = waves(0.004).tilted(seen(), CAMERA, 1.0)
    assert np.abs(calm.normal[..., :2]).max() < 1e-3


def test_no_normal_turns_away_from_the_viewer():
    grazing = PinholeCamera.looking((1.0, -6.0, 0.75), (1.0, 1.0, LEVEL), fov_degrees=20.0, size=(80, 60))
    rays = grazing.rays(grazing.pixel_grid())
    down = rays[..., 2] < -0.01
    depth = np.where(down, (LEVEL - grazing.position[2]) / np.where(down, rays[..., 2], -1.0), 0.0)
    depth = np.where(depth < 9.0, depth, 0.0).astype(np.float32)
    shape, up = depth.shape, np.broadcast_to([0.0, 0.0, 1.0], (*depth.shape, 3))
    surface = SurfaceBuffer(depth, up, np.ones(shape), np.ones((*shape, 3)), (depth > 0).astype(np.float32))
    found = waves().tilted(surface, grazing, 1.0)
    away = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    assert (depth > 0).any()
    assert ((found.normal * away).sum(axis=-1)[depth > 0] < 0).all()


def test_an_empty_picture_stays_empty():
    shape = (60, 80)
    empty = SurfaceBuffer(np.zeros(shape), np.zeros((*shape, 3)), np.zeros(shape), np.zeros((*shape, 3)),
                          np.zeros(shape))  # fmt: skip
    assert waves().tilted(empty, CAMERA, 1.0) is empty
