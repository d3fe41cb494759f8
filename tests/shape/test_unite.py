"""The union of bodies is the union, and the window grows with calm."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from fluidlift.shape.unite import unite, window_length
from fluidlift.types.gaussians import Gaussians


def ball(seed: int = 0, count: int = 5000, center=(0.0, 0.0, 0.0), red: float = 0.5) -> Gaussians:
    rng = np.random.default_rng(seed)
    p = rng.normal(size=(count, 3))
    p *= rng.random((count, 1)) ** (1 / 3) / np.linalg.norm(p, axis=1, keepdims=True)
    return Gaussians.isotropic((p + center).astype(np.float32), 0.05, np.full((count, 3), [red, 0.5, 0.5]), 0.9)


def voxels(g: Gaussians, spacing: float) -> set:
    return set(map(tuple, np.floor(g.means / spacing).astype(int)))


def test_identical_bodies_unite_to_themselves():
    one, many = unite([ball()], spacing=0.01), unite([ball()] * 5, spacing=0.01)
    np.testing.assert_array_equal(one.means, many.means)
    # at a tenth of the usual distance hardly any two share a voxel
    assert len(one) > 0.98 * 5000


def test_volume_stays_and_counts_are_bounded():
    bodies = [ball(seed) for seed in range(6)]
    united = unite(bodies, spacing=0.1)
    volume = len(united) * 0.1**3
    # voxels that the surface cuts count whole: a shell of about half a voxel more
    assert 0.95 < volume / (4 / 3 * np.pi) < 1.25
    assert len(united) < 5500, "not the 30000 that came in"


def test_the_nearest_frame_lends_its_colours_where_it_has_something():
    red, grey = ball(0, red=1.0), ball(1, center=(1.0, 0, 0), red=0.0)
    united = unite([red, grey], spacing=0.2)
    far_left, far_right = united.means[:, 0] < -0.1, united.means[:, 0] > 1.1
    assert (united.rgb[far_left, 0] > 0.9).all() and (united.rgb[far_right, 0] < 0.1).all()
    overlap = (np.linalg.norm(united.means, axis=1) < 0.6) & (np.linalg.norm(united.means - [1, 0, 0], axis=1) < 0.6)
    assert np.mean(united.rgb[overlap, 0]) > 0.95


def test_a_hole_in_one_body_is_closed_by_another():
    whole = ball(1)
    torn = ball(0).select(np.linalg.norm(ball(0).means - [0.5, 0, 0], axis=1) > 0.3)
    united = unite([torn, whole], spacing=0.1)
    inside = np.linalg.norm(united.means - [0.5, 0, 0], axis=1) < 0.25
    # 5000 random points leave exp(-1.19) = 30 % of the voxels of 0.1 empty; the count of the others spreads by some 8 %
    expected = (1 - np.exp(-5000 * 0.1**3 / (4 / 3 * np.pi))) * (4 / 3 * np.pi * 0.25**3) / 0.1**3
    assert inside.sum() > 0.8 * expected


def test_more_per_voxel_keeps_more():
    counts = [len(unite([ball()], spacing=0.2, per_voxel=n)) for n in (1, 2, 4, 10_000)]
    assert counts == sorted(counts) and counts[-1] == 5000


def test_a_first_body_that_is_kept_whole_loses_nothing_and_the_others_only_close_what_it_lacks():
    near = ball(0, red=1.0)
    united = unite([near, ball(1, center=(1.0, 0, 0), red=0.0)], spacing=0.2, whole_first=True)
    red = united.rgb[:, 0] > 0.5
    np.testing.assert_array_equal(united.means[red], near.means)
    assert 0 < (~red).sum() < 700  # a ball of radius 1 has 520 voxels of 0.2 m, and those that it cuts


def test_splats_of_other_frames_do_not_lie_over_a_first_body_that_is_kept_whole():
    near = ball(0, red=1.0)
    shifted = ball(0, center=(0.04, 0.03, 0.0), red=0.0)  # the same surface, found a little beside it
    united = unite([near, shifted], spacing=0.1, whole_first=True)
    other = united.select(united.rgb[:, 0] < 0.5)
    gap = cKDTree(near.means).query(other.means)[0] if len(other) else np.full(1, np.inf)
    assert gap.min() > 0.1, "a whole voxel away"
    assert len(united) < 1.01 * len(near)


def test_broken_positions_are_left_out():
    g = ball(count=100)
    g.means[3] = np.nan
    assert len(unite([g, Gaussians.empty()], spacing=0.001)) == 99


def frames(noise: float, count: int = 6) -> np.ndarray:
    rng = np.random.default_rng(0)
    base = rng.uniform(60, 200, (32, 48, 3))
    return np.clip(base + noise * rng.normal(size=(count, 32, 48, 3)), 0, 255).astype(np.uint8)


def test_calm_fluids_are_gathered_over_more_frames():
    many = [window_length(frames(noise, 12), None) for noise in (0.0, 4.0, 12.0, 40.0)]
    assert many[0] == 8 and many[-1] == 2
    assert many == sorted(many, reverse=True) and len(set(many)) >= 3


def test_only_the_fluid_counts():
    clip = frames(0.0, 10)
    clip[:, :, 24:] = frames(50.0, 10)[:, :, 24:]
    mask = np.zeros((32, 48), bool)
    mask[:, :24] = True
    assert window_length(clip, mask) == 8
    assert window_length(clip, ~mask) == 2
    assert window_length(clip, np.broadcast_to(mask, (10, 32, 48))) == 8


def test_the_window_never_exceeds_the_clip():
    assert window_length(frames(0.0, 3), None) == 3
    assert window_length(frames(0.0, 1), None) == 1
    with pytest.raises(ValueError, match="shortest"):
        window_length(frames(0.0), None, shortest=5, longest=4)
