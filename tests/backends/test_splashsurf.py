"""The surface of particles."""

import sys

import numpy as np
import pytest

from fluidlift.backends.splashsurf import SplashsurfMesher
from fluidlift.errors import MissingPackage

pytest.importorskip("pysplashsurf")
RADIUS = 0.02


def lattice(keep) -> np.ndarray:
    axis = np.arange(-1.0, 1.0, 2 * RADIUS)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    return points[keep(points)]


def volume(mesh) -> float:
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(float) for k in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


def test_a_ball_of_particles_has_its_radius_and_volume():
    ball = lattice(lambda p: np.linalg.norm(p, axis=1) < 0.4)
    mesh, _ = SplashsurfMesher().surface(ball, RADIUS, {})
    distance = np.linalg.norm(mesh.vertices, axis=1)
    # the surface stands up to a radius outside the particles, on a lattice that is as wide as two of them
    assert abs(np.median(distance) - 0.4) < RADIUS and distance.std() < 0.5 * RADIUS
    assert volume(mesh) == pytest.approx(4 / 3 * np.pi * 0.4**3, rel=3 * RADIUS / 0.4)  # a radius all around


def test_a_block_is_closed_and_faces_outwards():
    block = lattice(lambda p: (np.abs(p) < (0.5, 0.3, 0.2)).all(1))
    mesh, _ = SplashsurfMesher().surface(block, RADIUS, {})
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    _, counts = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)
    assert (counts == 2).all() and volume(mesh) > 0


def test_the_top_of_still_water_is_flat():
    block = lattice(lambda p: (np.abs(p) < (0.7, 0.5, 0.2)).all(1))
    block += np.random.default_rng(0).uniform(-0.3, 0.3, block.shape) * RADIUS  # as particles lie in a simulation
    mesh, _ = SplashsurfMesher().surface(block, RADIUS, {})
    v = mesh.vertices
    top = v[(v[:, 2] > 0.1) & (np.abs(v[:, 0]) < 0.5) & (np.abs(v[:, 1]) < 0.3)]
    assert len(top) > 100 and top[:, 2].std() < 0.3 * RADIUS


def test_velocities_and_colours_are_carried_to_the_vertices():
    block = lattice(lambda p: (np.abs(p) < (0.5, 0.3, 0.2)).all(1))
    turning = np.stack([-block[:, 1], block[:, 0], 0 * block[:, 0]], axis=1)
    mesh, found = SplashsurfMesher().surface(block, RADIUS, {"velocity": turning, "rgb": np.full((len(block), 3), 0.4)})
    true = np.stack([-mesh.vertices[:, 1], mesh.vertices[:, 0], 0 * mesh.vertices[:, 0]], axis=1)
    assert np.abs(found["velocity"] - true).max() < 3 * RADIUS  # the mean over a kernel that lies to one side
    np.testing.assert_allclose(found["rgb"], 0.4, atol=1e-5)


def test_particles_that_are_nowhere_are_left_out_and_none_have_no_surface():
    ball = lattice(lambda p: np.linalg.norm(p, axis=1) < 0.2)
    broken = np.concatenate([ball, np.full((2, 3), np.nan)])
    values = {"velocity": np.ones((len(broken), 3))}
    mesh, found = SplashsurfMesher().surface(broken, RADIUS, values)
    assert np.isfinite(mesh.vertices).all() and len(found["velocity"]) == len(mesh.vertices) > 0
    mesh, found = SplashsurfMesher().surface(np.zeros((0, 3)), RADIUS, {"velocity": np.zeros((0, 3))})
    assert len(mesh.faces) == 0 and found["velocity"].shape == (0, 3)


def test_a_missing_package_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "pysplashsurf", None)
    with pytest.raises(MissingPackage, match="pip install pysplashsurf"):
        SplashsurfMesher()
