"""The divergence of an incompressible fluid on the screen, on fields that can be written down."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from fluidlift.motion.screen_divergence import (
    masked_gradient,
    project_screen_divergence,
    screen_divergence,
    validated_reach,
)
from fluidlift.types import PinholeCamera

H, W = 72, 96
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


def patchy(mask: np.ndarray, width: float, share: float, seed: int = 4) -> np.ndarray:
    """Blobs of about `width` px over a share of the mask."""
    noise = ndimage.gaussian_filter(np.random.default_rng(seed).standard_normal(mask.shape), width)
    return mask & (noise < np.quantile(noise[mask], share))


def filled_by_neighbours(d: np.ndarray, failed: np.ndarray) -> np.ndarray:
    out = np.where(failed[..., None], d[~failed].mean(axis=0), d)
    for _ in range(500):  # Jacobi on patches some ten px wide
        padded = np.pad(out, ((1, 1), (1, 1), (0, 0)), mode="edge")
        mean = 0.25 * (padded[2:, 1:-1] + padded[:-2, 1:-1] + padded[1:-1, 2:] + padded[1:-1, :-2])
        out = np.where(failed[..., None], mean, out)
    return out.astype(np.float32)


def test_where_the_surface_does_not_stretch_the_observed_pixels_call_for_the_constraint() -> None:
    every = np.ones((H, W), bool)
    v, u = np.mgrid[:H, :W] * (2 * np.pi / 40)
    true = np.stack([3 + 1.5 * np.sin(v) * np.cos(u), -1.5 * np.cos(v) * np.sin(u)], axis=-1)
    failed = patchy(every, 5, 0.3)
    filled = filled_by_neighbours(true, failed)
    one, zero = np.ones((H, W)), np.zeros((H, W))
    assert validated_reach(filled, every, ~failed, one, zero, CAMERA, form="paper") > 0
    out, report = project_screen_divergence(filled, every, ~failed, one, zero, CAMERA, form="paper")
    assert report.converged and (out[~failed] == filled[~failed]).all()
    before, after = (np.linalg.norm(f - true, axis=-1)[failed].mean() for f in (filled, out))
    assert after < 0.8 * before  # eddies are half gradient, half rotation to the filling; the borders keep some of it


def test_where_the_surface_wells_up_and_dives_the_flow_is_left_as_it_is() -> None:
    every = np.ones((H, W), bool)
    v, u = np.mgrid[:H, :W] * (2 * np.pi / 40)
    # as much divergence as rotation, and none of it in depth or depth rate: the constraint is wrong here
    true = np.stack([3 + 1.5 * np.cos(u) * np.sin(v), 1.5 * np.sin(u) * np.cos(v)], axis=-1)
    failed = patchy(every, 5, 0.3)
    filled = filled_by_neighbours(true, failed)
    one, zero = np.ones((H, W)), np.zeros((H, W))
    assert validated_reach(filled, every, ~failed, one, zero, CAMERA) == 0
    out, report = project_screen_divergence(filled, every, ~failed, one, zero, CAMERA)
    assert (out == filled).all() and report.converged and report.iterations == 0
    hard, _ = project_screen_divergence(filled, every, ~failed, one, zero, CAMERA, reach=np.inf)
    errors = [np.linalg.norm(f - true, axis=-1)[failed].mean() for f in (filled, hard)]
    assert errors[1] > errors[0]  # so the choice was right


def test_too_little_to_hold_out_means_no_constraint() -> None:
    every = np.ones((H, W), bool)
    d, one, zero = np.ones((H, W, 2), np.float32), np.ones((H, W)), np.zeros((H, W))
    assert validated_reach(d, every, every, one, zero, CAMERA) == 0  # nothing failed
    assert validated_reach(d, every, ~every, one, zero, CAMERA) == 0  # nothing observed
    corner = np.zeros((H, W), bool)
    corner[:6, :6] = True
    assert validated_reach(d, every, corner, one, zero, CAMERA) == 0
