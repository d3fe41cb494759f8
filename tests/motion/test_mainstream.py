"""Mainstream correction on fields that can be written down."""

from __future__ import annotations

import numpy as np
import pytest

from fluidlift.motion.mainstream import (
    bank_direction,
    complete_flow,
    mainstream_direction,
    masked_gradient,
    project_screen_divergence,
    screen_divergence,
)
from fluidlift.types import PinholeCamera

H, W = 72, 96


def band(angle: float, half_width: float = 16.0) -> np.ndarray:
    """A straight river through the picture."""
    v, u = np.mgrid[:H, :W]
    return np.abs(-(u - W / 2) * np.sin(angle) + (v - H / 2) * np.cos(angle)) < half_width


@pytest.mark.parametrize("angle", [0.0, 0.5, -1.0])
def test_without_flow_nearby_the_fluid_follows_its_banks(angle: float) -> None:
    mask = band(angle)
    along = np.array([np.cos(angle), np.sin(angle)])
    axis, elongation = bank_direction(mask, sigma=6.0)
    # at the border the mask is continued straight outwards, which bends an oblique river there; not so in the middle
    assert np.abs((axis * along).sum(-1))[mask].mean() > 0.95
    assert np.abs((axis * along).sum(-1))[H // 2 - 8 : H // 2 + 8, W // 2 - 8 : W // 2 + 8].min() > 0.99
    assert elongation[mask].mean() > 0.6
    # flow is known in one small place, and askew there: it gives the sign, the banks give the direction
    d = np.zeros((H, W, 2), np.float32)
    c = np.zeros((H, W), np.float32)
    v, u = np.mgrid[:H, :W]
    patch = np.hypot(u - W / 2, v - H / 2) < 4
    d[patch] = -2 * along + 0.8 * np.array([-along[1], along[0]])
    c[patch] = 1.0
    n = mainstream_direction(d, c, mask)
    assert np.allclose(np.linalg.norm(n, axis=-1), 1.0, atol=1e-5)
    far = mask & (np.hypot(u - W / 2, v - H / 2) > 30)
    assert (n[far] @ -along).mean() > 0.95


def test_confident_flow_decides_the_direction_where_it_is() -> None:
    d = np.zeros((H, W, 2), np.float32)
    d[..., 0], d[..., 1] = 1.0, 1.0
    n = mainstream_direction(d, np.ones((H, W), np.float32), band(0.0))
    assert np.abs(n[band(0.0)] - np.sqrt(0.5)).max() < 0.08


def test_without_any_flow_the_direction_is_the_long_axis_downwards() -> None:
    n = mainstream_direction(np.zeros((H, W, 2), np.float32), np.zeros((H, W), np.float32), band(1.2))
    assert (n[band(1.2)] @ [np.cos(1.2), np.sin(1.2)]).mean() > 0.95


def test_uniform_flow_is_continued_as_it_is() -> None:
    mask = np.ones((H, W), bool)
    d = np.tile(np.array([3.0, 0.5], np.float32), (H, W, 1))
    c = np.ones((H, W), np.float32)
    c[20:50, 30:80] = 0.0
    d[20:50, 30:80] = 0.0
    n = mainstream_direction(d, c, mask)
    completed, observed = complete_flow(d, c, mask, n)
    assert not observed[20:50, 30:80].any() and observed[:20].all()
    assert np.abs(completed - [3.0, 0.5]).max() < 1e-3  # weights are normalised: nothing is lost with distance


def test_flow_against_the_mainstream_does_not_count() -> None:
    mask = np.ones((H, W), bool)
    d = np.tile(np.array([2.0, 0.0], np.float32), (H, W, 1))
    d[: H // 2 - 4] = (-2.0, 0.0)  # a back eddy above, observed as well
    c = np.ones((H, W), np.float32)
    c[H // 2 - 4 : H // 2 + 4] = 0.0
    n = np.tile(np.array([1.0, 0.0], np.float32), (H, W, 1))
    completed, observed = complete_flow(d, c, mask, n)
    assert np.abs(completed[~observed] - [2.0, 0.0]).max() < 1e-3
    assert (completed[: H // 2 - 4] == d[: H // 2 - 4]).all()  # what was seen stays
    # where everything seen runs against it, the speed is kept and the direction is the mainstream's
    d[:] = (-2.0, 0.0)
    completed, observed = complete_flow(d, c, mask, n)
    assert np.abs(completed[~observed] - [2.0, 0.0]).max() < 1e-3


def test_standstill_amid_motion_is_not_believed_but_a_fluid_at_rest_is() -> None:
    mask = np.ones((H, W), bool)
    n = np.tile(np.array([1.0, 0.0], np.float32), (H, W, 1))
    d = np.tile(np.array([3.0, 0.0], np.float32), (H, W, 1))
    d[30:40, 40:50] = 0.0  # the bed seen through clear water: textured, still, and trusted by the estimator
    completed, observed = complete_flow(d, np.ones((H, W), np.float32), mask, n)
    assert not observed[32:38, 42:48].any() and np.abs(completed[32:38, 42:48] - [3.0, 0.0]).max() < 0.1
    believed, _ = complete_flow(d, np.ones((H, W), np.float32), mask, n, stall=0.0)
    assert (believed == d).all()
    _, observed = complete_flow(np.zeros_like(d), np.ones((H, W), np.float32), mask, n)
    assert observed.all()


def directed_mean_plain(d, c, n, k, sigma):
    """The paper's sum, term by term."""
    v, u = np.mgrid[: d.shape[0], : d.shape[1]]
    w = c * np.exp(-((v - k[0]) ** 2 + (u - k[1]) ** 2) / (2 * sigma**2))
    w = w * np.maximum(0, (d @ n) / np.maximum(np.linalg.norm(d, axis=-1), 1e-6))
    return (w[..., None] * d).sum(axis=(0, 1)) / w.sum()


def test_the_convolutions_give_the_papers_sum() -> None:
    rng = np.random.default_rng(3)
    v, u = np.mgrid[:H, :W]
    d = np.stack([2 + np.sin(u / 9.0), np.cos(v / 7.0 + u / 11.0)], axis=-1).astype(np.float32)
    c = np.ones((H, W), np.float32)
    c[30:34, 40:44] = 0.0
    angle = rng.uniform(-0.5, 0.5)
    n = np.array([np.cos(angle), np.sin(angle)])
    completed, observed = complete_flow(d, c, np.ones((H, W), bool), np.tile(n, (H, W, 1)))
    for k in np.argwhere(~observed):
        plain = directed_mean_plain(d, c, n, k, 4.0)
        # 5 % of the speed: wider windows take a small share, and the cosine is interpolated between 16 directions
        assert np.linalg.norm(completed[tuple(k)] - plain) < 0.05 * np.linalg.norm(plain)


def test_the_same_stream_far_away_moves_fewer_pixels() -> None:
    mask = np.ones((H, W), bool)
    depth = np.tile(np.linspace(1.0, 4.0, W), (H, 1))
    d = np.stack([6.0 / depth, 0 * depth], axis=-1).astype(np.float32)
    c = np.ones((H, W), np.float32)
    c[:, 60:] = 0.0
    n = np.tile(np.array([1.0, 0.0], np.float32), (H, W, 1))
    completed, _ = complete_flow(np.where(c[..., None] > 0, d, 0), c, mask, n, depth)
    assert np.abs(completed - d).max() < 0.02


def test_nothing_observed_is_said_so() -> None:
    mask = band(0.0)
    zero = np.zeros((H, W), np.float32)
    n = np.tile(np.array([1.0, 0.0], np.float32), (H, W, 1))
    completed, observed = complete_flow(np.ones((H, W, 2), np.float32), zero, mask, n)
    assert not observed.any() and (completed[~mask] == 0).all()
    with pytest.raises(ValueError, match="empty mask"):
        complete_flow(np.ones((H, W, 2), np.float32), zero, np.zeros((H, W), bool), n)


CAMERA = PinholeCamera.from_fov(60.0, (W, H))


def normalised() -> tuple[np.ndarray, np.ndarray]:
    uv = (CAMERA.pixel_grid() - CAMERA.center) / CAMERA.focal
    return uv[..., 0], uv[..., 1]


def screen_divergence_of(d: np.ndarray) -> np.ndarray:
    every = np.ones(d.shape[:2], bool)
    return masked_gradient(d[..., 0], every)[..., 0] + masked_gradient(d[..., 1], every)[..., 1]


def test_the_exact_form_holds_for_strain_along_the_line_of_sight_where_the_papers_does_not() -> None:
    # v = (a x, b y, -(a+b) z) is divergence-free; seen on the plane z = const it expands with 3 (a + b)
    a, b, z = 0.01, 0.02, 2.0
    u, v = normalised()
    d = np.stack([(2 * a + b) * u * CAMERA.focal[0], (a + 2 * b) * v * CAMERA.focal[1]], axis=-1)
    depth, rate = np.full((H, W), z), np.full((H, W), -(a + b) * z)
    every = np.ones((H, W), bool)
    true = screen_divergence_of(d)
    assert np.allclose(true, 3 * (a + b), atol=1e-9)
    exact = screen_divergence(d, every, depth, rate, CAMERA, axial_rate=np.full((H, W), -(a + b)))
    paper = screen_divergence(d, every, depth, rate, CAMERA, form="paper")
    assert np.allclose(exact, true, atol=1e-6)
    assert np.allclose(paper, 2 * (a + b), atol=1e-6)  # the dropped term is a third


def test_the_exact_form_holds_for_a_rigid_translation_of_a_slope_where_the_papers_does_not() -> None:
    u, v = normalised()
    depth = 2.0 / (1 - 0.6 * v)  # the plane z = 2 + 0.6 y
    velocity = np.array([0.01, 0.02, 0.012])  # m/frame: along the plane
    focal = CAMERA.focal
    d = np.stack(
        [focal[0] * (velocity[0] - u * velocity[2]) / depth, focal[1] * (velocity[1] - v * velocity[2]) / depth], -1
    )
    rate = np.full((H, W), velocity[2])
    every = np.ones((H, W), bool)
    inner = (slice(2, -2), slice(2, -2))
    true = screen_divergence_of(d)[inner]
    exact = screen_divergence(d, every, depth, rate, CAMERA)[inner]
    paper = screen_divergence(d, every, depth, rate, CAMERA, form="paper")[inner]
    scale = np.abs(true).mean()
    assert np.abs(exact - true).mean() < 0.01 * scale  # central differences
    assert np.abs(paper - true).mean() > 0.2 * scale


def test_a_divergence_free_motion_across_the_line_of_sight_needs_neither_form() -> None:
    u, v = normalised()
    d = np.stack([-v, u], axis=-1) * 3.0
    every = np.ones((H, W), bool)
    for form in ("exact", "paper"):
        assert np.abs(screen_divergence(d, every, np.full((H, W), 2.0), np.zeros((H, W)), CAMERA, form=form)).max() == 0


def test_the_projection_meets_the_divergence_in_the_failed_pixels_and_leaves_the_rest() -> None:
    rng = np.random.default_rng(5)
    every = np.ones((H, W), bool)
    observed = every.copy()
    observed[15:60, 20:70] = False
    v, u = np.mgrid[:H, :W] / 12.0
    true = np.stack([2 + np.sin(v) * np.cos(u), -np.cos(v) * np.sin(u)], axis=-1)  # divergence-free
    rows, cols = np.clip((np.mgrid[:H, :W][0] - 15) / 45, 0, 1), np.clip((np.mgrid[:H, :W][1] - 20) / 50, 0, 1)
    window = np.sin(np.pi * rows) * np.sin(np.pi * cols)  # no net flux through the rim, so the patch can be balanced
    smooth = window[..., None] * np.stack([np.sin(u + rng.random()), np.sin(v + rng.random())], axis=-1)
    d = np.where(observed[..., None], true, true + smooth)
    one, zero = np.ones((H, W)), np.zeros((H, W))
    out, report = project_screen_divergence(d, every, observed, one, zero, CAMERA, reach=np.inf, form="paper")
    assert report.converged
    assert (out[observed] == d[observed].astype(np.float32)).all()
    inner = (slice(20, 55), slice(25, 65))
    before, after = np.abs(screen_divergence_of(d)[inner]).mean(), np.abs(screen_divergence_of(out)[inner]).mean()
    assert after < 0.05 * before  # what is left comes from averaging faces to pixels
    assert np.linalg.norm(out - true, axis=-1)[inner].mean() < np.linalg.norm(d - true, axis=-1)[inner].mean()
    # the soft constraint goes part of the way
    soft, _ = project_screen_divergence(d, every, observed, one, zero, CAMERA, reach=4.0, form="paper")
    assert after < np.abs(screen_divergence_of(soft)[inner]).mean() < before


def test_an_enclosed_patch_with_unbalanced_inflow_stays_finite() -> None:
    every = np.ones((H, W), bool)
    observed = every.copy()
    observed[30:40, 30:40] = False
    u, v = normalised()
    d = np.stack([50 * u, 50 * v], axis=-1)  # more goes out than in
    out, _ = project_screen_divergence(d, every, observed, np.ones((H, W)), np.zeros((H, W)), CAMERA, reach=np.inf)
    assert np.isfinite(out).all()
    assert np.abs(out - d).max() < 0.5  # only the constant part is wrong, and that stays
