"""Samples to cells, and cells to the rest of the fluid."""

from __future__ import annotations

import numpy as np
import pytest
from channels import channel

from fluidlift.motion.extrapolation import (
    harmonic_extension,
    layered_extension,
    splat_samples,
    splat_surface,
    wall_distance,
)
from fluidlift.types import CellType, SurfaceMotion, Terrain, TriangleMesh


def test_samples_go_to_the_nearest_fluid_cell_and_far_ones_nowhere() -> None:
    types, grid = channel()
    carrying = types == CellType.FLUID
    points = np.array([[0.55, 0.35, 0.68], [0.55, 0.35, 0.1 + 8.0], [1.55, 0.35, 0.55]])
    motion = SurfaceMotion(points, np.array([[1.0, 0, 0], [9.0, 0, 0], [3.0, 0, 0]]), np.ones(3, bool))
    values, seen = splat_surface(motion, carrying, grid)
    assert np.argwhere(seen).tolist() == [[5, 3, 5], [15, 3, 5]]
    assert np.allclose(values[5, 3, 5], [1, 0, 0]) and np.allclose(values[15, 3, 5], [3, 0, 0])


def test_filled_samples_count_less_than_observed_ones() -> None:
    types, grid = channel()
    at = np.array([[0.55, 0.35, 0.55]] * 2)
    motion = SurfaceMotion(at, np.array([[1.0, 0, 0], [2.0, 0, 0]]), np.array([True, False]))
    values, _ = splat_surface(motion, types == CellType.FLUID, grid)
    assert values[5, 3, 5, 0] == pytest.approx((1.0 + 0.25 * 2.0) / 1.25)


def test_the_extension_is_harmonic_and_keeps_what_is_known() -> None:
    shape = (12, 4, 3)
    known = np.zeros(shape, bool)
    known[0], known[-1] = True, True
    values = np.zeros((*shape, 1), np.float32)
    values[-1] = 11.0
    f = harmonic_extension(values, known, np.ones(shape, bool), 0.1, tolerance=1e-6)
    assert np.abs(f[..., 0] - np.arange(12)[:, None, None]).max() < 1e-3  # linear between two planes
    apart = np.ones(shape, bool)
    apart[6] = False  # the far part is known only at its end
    f = harmonic_extension(values, known, apart, 0.1, tolerance=1e-6)
    assert np.abs(f[:6]).max() < 1e-4 and np.abs(f[7:] - 11.0).max() < 1e-3
    known[-1] = False  # and now not at all
    f = harmonic_extension(values, known, apart, 0.1)
    assert np.abs(f[7:]).max() == 0.0


def test_components_are_continued_alike_together_and_alone() -> None:
    rng = np.random.default_rng(0)
    types, grid = channel(12, 6, 6, 4)
    domain = types == CellType.FLUID
    known = domain & (rng.random(grid.shape) < 0.2)
    values = rng.standard_normal((*grid.shape, 3)).astype(np.float32)
    together = harmonic_extension(values, known, domain, 0.1, tolerance=1e-7)
    for c in range(3):
        alone = harmonic_extension(values[..., c : c + 1], known, domain, 0.1, tolerance=1e-7)
        assert np.abs(alone[..., 0] - together[..., c]).max() < 1e-5


def test_waves_of_the_surface_die_out_with_depth_and_the_mean_stays() -> None:
    n, depth, length = 48, 12, 16
    domain = np.ones((n, 3, depth), bool)
    known = np.zeros_like(domain)
    known[:, :, -1] = True
    k = 2 * np.pi / length
    values = np.zeros((*domain.shape, 1), np.float32)
    values[:, :, -1, 0] = 2.0 + np.cos(k * (np.arange(n) + 0.5))[:, None]
    f = harmonic_extension(values, known, domain, 0.1, tolerance=1e-7)[:, 1, :, 0]
    assert np.abs(f.mean(axis=0) - 2.0).max() < 1e-4
    swing = np.abs(np.fft.rfft(f, axis=0))[n // length] / (n / 2)
    below = depth - 1 - np.arange(depth)  # cells below the known layer; the wall is half a cell below the last centre
    wanted = np.cosh(k * (depth - 0.5 - below)) / np.cosh(k * (depth - 0.5))
    assert np.abs(swing - wanted).max() < 0.02  # second-order differences: (k h)^2 / 12 = 1.3 % of the decay


def test_the_layer_slows_and_turns_what_is_near_a_wall_and_keeps_what_was_seen() -> None:
    free = np.zeros((1, 1, 4, 3), np.float32)
    free[..., 1] = 2.0
    share = np.array([0.0, 0.5, 1.0, 0.5], np.float32).reshape(1, 1, 4)
    seen = np.zeros((1, 1, 4), bool)
    seen[..., 3] = True
    v = layered_extension(free, seen, share, np.array([1.0, 0, 0]))[0, 0]
    assert v[0].tolist() == [0, 0, 0] and v[2].tolist() == [0, 2, 0] and v[3].tolist() == [0, 2, 0]
    assert v[1].tolist() == [0.5, 0.5, 0.0]  # half the speed, half way to the mainstream
    straight = layered_extension(free, seen, share)[0, 0]
    assert straight[1].tolist() == [0.0, 1.0, 0.0]


def test_distances_to_a_plane_are_those_of_the_terrain_and_of_its_cells() -> None:
    types, grid = channel(4, 4, 6, 4)
    nodes = grid.nodes()
    empty = TriangleMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int64))
    terrain = Terrain(grid, (nodes[..., 2] - 0.1).astype(np.float32), np.array([1.0, 0, 0]), empty)
    for given in (terrain, None):
        assert wall_distance(types, given, grid)[2, 2, 1:] == pytest.approx([0.05, 0.15, 0.25, 0.35, 0.45], rel=1e-5)
    tilted = Terrain(grid, (nodes[..., 2] - 0.14).astype(np.float32), np.array([1.0, 0, 0]), empty)
    assert wall_distance(types, tilted, grid)[2, 2, 1] == pytest.approx(0.05)  # a cut cell counts as half a cell away


def test_any_field_of_the_samples_can_be_put_on_cells() -> None:
    types, grid = channel()
    at = np.array([[0.55, 0.35, 0.55], [0.55, 0.35, 0.55], [1.05, 0.35, 0.55]])
    share, seen = splat_samples(
        at, np.array([[1.0], [0.0], [1.0]]), np.array([1.0, 0.25, 1.0]), types == CellType.FLUID, grid
    )
    assert seen.sum() == 2
    assert share[5, 3, 5, 0] == pytest.approx(0.8) and share[10, 3, 5, 0] == pytest.approx(1.0)
