"""Diffusion inside a mask against what can be worked out."""

from __future__ import annotations

import numpy as np
import pytest

from fluidlift.motion.interpolation import STEPS, conductances, depth_jump, diffusion_interpolation


def plain_operator(edges: np.ndarray, f: np.ndarray) -> np.ndarray:
    """-div D grad f, edge by edge."""
    h, w = f.shape
    out = np.zeros((h, w))
    for k, (down, right) in enumerate(STEPS):
        for i in range(h - down):
            for j in range(max(0, -right), w - max(0, right)):
                flux = edges[k, i + 1, j + 1] * (f[i, j] - f[i + down, j + right])
                out[i, j] += flux
                out[i + down, j + right] -= flux
    return out


def plain_solution(edges: np.ndarray, weight: np.ndarray, values: np.ndarray) -> np.ndarray:
    h, w = weight.shape
    units = np.eye(h * w).reshape(-1, h, w)
    matrix = np.stack([plain_operator(edges, unit).ravel() for unit in units], axis=1)
    active = (np.diag(matrix) > 0) | (weight.ravel() > 0)
    out = np.zeros((h * w, values.shape[-1]))
    right = (weight[..., None] * values).reshape(h * w, -1)
    out[active] = np.linalg.solve((matrix + np.diag(weight.ravel()))[np.ix_(active, active)], right[active])
    return out.reshape(h, w, -1)


@pytest.mark.parametrize("anisotropy", [1.0, 4.0])
def test_the_kernels_solve_what_the_plain_matrix_says(anisotropy: float) -> None:
    rng = np.random.default_rng(1)
    h, w = 17, 22
    mask = np.ones((h, w), bool)
    mask[5:9, 8:15] = False  # a rock
    weight = np.where(mask & (rng.random((h, w)) < 0.15), rng.uniform(0.1, 30.0, (h, w)), 0.0)
    angle = rng.uniform(0, 2 * np.pi, (h, w))
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    values = rng.standard_normal((h, w, 3))
    out, reached, report = diffusion_interpolation(
        values, weight, mask, direction, anisotropy=anisotropy, tolerance=1e-6
    )
    plain = plain_solution(conductances(mask, direction, anisotropy), weight, values)
    assert report.converged and (reached == mask).all()
    assert np.abs(out - plain)[mask].max() < 1e-4  # single precision, condition of some hundreds
    assert (out[~mask] == 0).all()
    # a mean of what was given, never beyond it
    assert out[mask].min() >= values[weight > 0].min() - 1e-4 and out[mask].max() <= values[weight > 0].max() + 1e-4


@pytest.mark.parametrize("angle", [0.0, 0.3, 0.8, np.pi / 4, 2.0])
def test_the_edges_add_up_to_the_tensor(angle: float) -> None:
    n = np.array([np.cos(angle), np.sin(angle)])
    anisotropy = 2.0  # below 1 + sqrt(2) no edge is cut off, so this is exact
    tensor = anisotropy * np.outer(n, n) + (np.eye(2) - np.outer(n, n)) / anisotropy
    v, u = np.mgrid[:7, :7].astype(float)
    edges = conductances(np.ones((7, 7), bool), np.tile(n, (7, 7, 1)), anisotropy)
    for f, second in ((u * u, 2 * tensor[0, 0]), (v * v, 2 * tensor[1, 1]), (u * v, 2 * tensor[0, 1])):
        assert np.allclose(-plain_operator(edges, f)[2:-2, 2:-2], second, atol=1e-5)


def test_a_constant_stays_constant_however_far_it_has_to_go() -> None:
    mask = np.ones((120, 300), bool)
    weight = np.zeros(mask.shape)
    weight[60, 3] = 0.5
    out, reached, report = diffusion_interpolation(np.full((*mask.shape, 1), 2.5), weight, mask)
    assert report.converged and reached.all() and np.abs(out - 2.5).max() < 1e-4


def test_a_small_mask_in_a_large_picture_is_filled_as_if_it_were_alone() -> None:
    rng = np.random.default_rng(4)
    weight, values = np.where(rng.random((20, 30)) < 0.1, 1.0, 0.0), rng.standard_normal((20, 30, 2))
    alone, _, _ = diffusion_interpolation(values, weight, np.ones((20, 30), bool), tolerance=1e-6)
    around = ((41, 7), (13, 90))
    out, reached, _ = diffusion_interpolation(
        np.pad(values, (*around, (0, 0))), np.pad(weight, around), np.pad(np.ones((20, 30), bool), around),
        tolerance=1e-6,
    )  # fmt: skip
    assert reached.sum() == 600 and (out[~reached] == 0).all()
    np.testing.assert_array_equal(out[reached].reshape(20, 30, 2), alone)


def test_between_two_ends_values_change_evenly() -> None:
    mask = np.ones((9, 41), bool)
    weight, values = np.zeros(mask.shape), np.zeros((*mask.shape, 1))
    weight[:, 0] = weight[:, -1] = 1e4
    values[:, -1] = 40.0
    out, _, _ = diffusion_interpolation(values, weight, mask, tolerance=1e-6)
    assert np.abs(out[..., 0] - np.arange(41)).max() < 0.01  # 1e4 ties the ends to 4e-3


def test_influence_reaches_further_along_than_across() -> None:
    mask = np.ones((41, 41), bool)
    weight, values = np.zeros(mask.shape), np.zeros((*mask.shape, 1))
    weight[20, 10] = weight[10, 20] = 1.0
    values[20, 10] = 1.0  # to the left of the middle; the other is above it
    middle = [
        diffusion_interpolation(values, weight, mask, np.tile(n, (41, 41, 1)), anisotropy=4.0)[0][20, 20, 0]
        for n in ([1.0, 0.0], [0.0, 1.0], [np.sqrt(0.5), np.sqrt(0.5)])
    ]
    assert middle[0] > 0.6 and middle[1] < 0.4 and abs(middle[2] - 0.5) < 0.01


def test_what_no_value_reaches_is_said_so() -> None:
    mask = np.ones((10, 20), bool)
    mask[:, 9] = False
    weight = np.zeros(mask.shape)
    weight[4, 4] = 1.0
    out, reached, _ = diffusion_interpolation(np.ones((10, 20, 2)), weight, mask)
    assert reached[:, :9].all() and not reached[:, 9:].any()
    assert np.allclose(out[:, :9], 1.0, atol=1e-4) and (out[:, 9:] == 0).all()
    with pytest.raises(ValueError, match="unlike shapes"):
        diffusion_interpolation(np.ones((10, 20, 2)), weight[:5], mask)
    with pytest.raises(ValueError, match="anisotropy"):
        diffusion_interpolation(np.ones((10, 20, 2)), weight, mask, anisotropy=0.5)
    with pytest.raises(ValueError, match="negative"):
        diffusion_interpolation(np.ones((10, 20, 2)), -weight, mask)


def test_a_jump_of_depth_is_seen_from_both_sides_and_not_across_the_rim_of_the_mask() -> None:
    depth = np.where(np.arange(8) < 4, 2.0, 3.0) * np.ones((5, 1))
    mask = np.ones((5, 8), bool)
    jump = depth_jump(depth, mask)
    assert (jump[:, 3:5] == 0.5).all() and not jump[:, [0, 1, 2, 5, 6, 7]].any()  # a metre over the nearer two
    mask[:, 4:] = False
    assert not depth_jump(depth, mask).any()


@pytest.mark.parametrize("faint", [1e-6, 1e-9, 1e-15])
def test_a_piece_that_is_hardly_known_takes_the_mean_of_what_it_is_given(faint: float) -> None:
    rng = np.random.default_rng(0)
    river, pond = np.zeros((2, 60, 80), bool)
    river[:, :60], pond[20:32, 65:74] = True, True
    weight = rng.uniform(0.0, 1.0, river.shape) * (river + faint * pond)
    values = rng.normal(0.0, 5.0, (60, 80, 2))
    angle = rng.uniform(0.0, 0.3, river.shape)
    n = np.dstack([np.cos(angle), np.sin(angle)])
    filled, reached, report = diffusion_interpolation(values, weight, river | pond, n, anisotropy=4.0)
    assert (reached == river | pond).all() and report.converged
    mean = (weight[..., None] * values)[pond].sum(axis=0) / weight[pond].sum()
    # the least weight that counts, 1e-5 a pixel, moves it by that times 12 px squared times the values, 0.01
    assert np.abs(filled[pond] - mean).max() < 0.02
    alone, _, _ = diffusion_interpolation(values, weight * river, river, n, anisotropy=4.0)
    np.testing.assert_allclose(filled[river], alone[river], atol=0.02)
