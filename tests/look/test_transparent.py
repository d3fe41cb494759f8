"""Liquid from splats: thickness with a scale, a surface where the body ends, and nothing that breaks it."""

import numpy as np
import pytest

from fluidlift.look import transparent
from fluidlift.look.transparent import (
    AWAY,
    COVERED,
    LEAD,
    LEANING,
    _eye,
    facing_plain,
    mean_volume,
    rated_plain,
    splat_surface,
    splatted_thickness,
    thickness_plain,
)
from fluidlift.look.transparent_kernels import far_normals, rated
from fluidlift.types import Gaussians, PinholeCamera


def filled(inside, spacing, *, jitter=0.25, seed=0, sigma=0.5, box=1.0) -> Gaussians:
    """Round Gaussians on a jittered lattice where `inside` holds."""
    at = np.arange(-box + spacing / 2, box, spacing)
    points = np.stack(np.meshgrid(at, at, at, indexing="ij"), -1).reshape(-1, 3)
    points = points[inside(points)]
    points = points + np.random.default_rng(seed).uniform(-jitter, jitter, points.shape) * spacing
    return Gaussians.isotropic(points, sigma * spacing, np.full((len(points), 3), 0.5), 0.8)


def slab(points):
    return (np.abs(points[:, 1]) < 0.1) & (np.abs(points[:, 0]) < 0.5) & (np.abs(points[:, 2]) < 0.5)


def ball(points):
    return np.linalg.norm(points, axis=1) < 0.3


def ahead(distance=2.0, size=(64, 48), fov=30.0) -> PinholeCamera:
    """A camera that looks along +y at the origin."""
    return PinholeCamera.looking(np.array([0.0, -distance, 0.0]), np.zeros(3), fov, size)


@pytest.mark.parametrize("sigma", [0.2, 0.5, 0.8])
def test_a_slab_measures_its_thickness_and_lies_where_it_is(sigma):
    g = filled(slab, 0.02, sigma=sigma)
    seen = splat_surface(g, np.tile([0.0, -1.0, 0.0], (len(g), 1)), ahead(), volume=0.02**3)
    middle = np.s_[12:36, 16:48]
    rays = ahead().rays(ahead().pixel_grid())
    straight = seen.thickness / np.linalg.norm(rays, axis=-1)
    # what lies beyond 3.33 standard deviations is not drawn (0.4 %); jittered splats leave a ripple of some per cent
    assert straight[middle].mean() == pytest.approx(0.2, rel=0.02)
    assert straight[middle].std() < 0.05 * 0.2
    # a fifth of the spacing: the first layer is jittered by a quarter of it
    assert np.abs(seen.depth[middle] - 1.9).mean() < 0.004
    assert np.abs(np.mean(seen.depth[middle] - 1.9)) < 0.002
    assert np.abs(seen.normal[middle] - (0, -1, 0)).max() < 1e-5 and (seen.covered[middle] == 1).all()


def test_a_ball_has_the_chords_the_outline_and_the_normals_of_a_ball():
    g = filled(ball, 0.02)
    camera = ahead(size=(96, 72))
    seen = splat_surface(g, g.means / np.linalg.norm(g.means, axis=1, keepdims=True), camera, volume=0.02**3)
    rays = camera.rays(camera.pixel_grid())
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    closest = rays @ -camera.position
    miss = np.linalg.norm(camera.position + rays * closest[..., None], axis=-1)
    chord = 2 * np.sqrt(np.maximum(0.09 - miss**2, 0.0))
    # volumes agree to a per cent, each ray to some: the ball's edge is a staircase of lattice cells
    assert seen.thickness.sum() == pytest.approx(chord.sum(), rel=0.02)
    assert np.abs(seen.thickness - chord)[miss < 0.25].mean() < 0.03 * 0.6
    # the outline swells by less than a spacing: it is blurred by the width of a splat, and covered from little on
    assert np.sqrt(seen.covered.sum() / (miss < 0.3).sum()) == pytest.approx(1.0, abs=0.02 / 0.3)
    hit = camera.position + rays * (closest - 0.5 * chord)[..., None]
    cosine = (seen.normal * hit / 0.3).sum(-1)[miss < 0.25]
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean() < 4  # means over a skin of a tenth of the radius
    left = camera.position + rays * (closest + 0.5 * chord)[..., None]
    cosine = (seen.back_normal * left / 0.3).sum(-1)[miss < 0.25]
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean() < 4
    depth = camera.camera_from_world.points(hit)[..., 2]
    assert np.abs(seen.depth - depth)[miss < 0.25].mean() < 0.25 * 0.02


def test_one_gaussian_is_seen_with_its_whole_volume():
    volume, camera = 0.02**3, ahead(size=(64, 64))
    quat = np.array([[0.9, 0.3, -0.2, 0.1]])
    one = Gaussians(
        [[0.05, 0.1, -0.03]], quat / np.linalg.norm(quat), [[0.01, 0.018, 0.013]], [0.7], np.zeros((1, 1, 3))
    )
    total, _ = splatted_thickness(one, np.zeros((1, 3), np.float32), camera, volume, 0.03)
    # metres along the ray, times the square metres of a pixel across it at the middle's depth
    z = camera.project(one.means)[1][0]
    stretch = np.linalg.norm(camera.rays(camera.pixel_grid()), axis=-1)
    seen = (total / stretch).sum() * z**2 / (camera.focal[0] * camera.focal[1])
    assert seen == pytest.approx(volume, rel=0.01)  # 0.4 % lie beyond 3.33 standard deviations


def test_compiled_and_plain_thickness_agree():
    g = filled(ball, 0.08)
    camera = ahead(size=(40, 30))
    features = np.random.default_rng(1).normal(size=(len(g), 6)).astype(np.float32)
    total, first = splatted_thickness(g, features, camera, 0.08**3, 0.12)
    found = transparent._projected(g, camera, 0.08**3)
    order = np.argsort(found.depths, kind="stable")
    packed = transparent._packed(found, order[found.extents[order, 0] > 0], features, camera, 0.08**3)
    assert packed.shape[1] == LEAD + 6
    stretch = np.linalg.norm(camera.rays(camera.pixel_grid()), axis=-1).astype(np.float32)
    wall = np.where(np.arange(40) < 20, np.median(found.depths), np.inf) * np.ones((30, 1))
    for ends in (np.full_like(total, np.inf), wall.astype(np.float32)):
        total, first = splatted_thickness(g, features, camera, 0.08**3, 0.12, wall=ends)
        plain = np.zeros_like(total), np.zeros_like(first)
        thickness_plain(packed, np.float32(0.12), (stretch, ends), *plain)
        # float32 sums of some hundred terms
        assert np.abs(total - plain[0]).max() < 1e-5 and np.abs(first - plain[1]).max() < 1e-5


def test_what_stands_before_a_liquid_changes_nothing_beside_itself():
    g, camera = filled(slab, 0.02), ahead()
    normals = np.tile([0.0, -1.0, 0.0], (len(g), 1))
    post = np.zeros(camera.size[::-1], np.float32)
    post[:, : camera.size[0] // 2] = 0.5 * camera.project(g.means)[1].min()
    alone, behind = (splat_surface(g, normals, camera, volume=0.02**3, ground=wall) for wall in (None, post))
    for name in ("depth", "normal", "albedo", "covered"):
        whole, part = getattr(alone, name), getattr(behind, name)
        np.testing.assert_array_equal(part[post == 0], whole[post == 0])
    assert behind.covered[post > 0].max() == 0 and behind.covered[post == 0].max() == 1


def test_behind_a_rock_liquid_is_as_thick_as_beside_it():
    g = filled(slab, 0.02)
    wall = np.full((48, 64), 3.0)
    wall[:, :32] = 1.0
    seen = splat_surface(g, np.tile([0.0, -1.0, 0.0], (len(g), 1)), ahead(), volume=0.02**3, ground=wall)
    assert not seen.covered[:, :32].any()
    # a bell that counts the rock as empty has half at its outline; splats leave a ripple of some per cent
    np.testing.assert_allclose(seen.thickness[12:36, 32:34].mean(), seen.thickness[12:36, 38:48].mean(), rtol=0.05)


def test_a_picture_drawn_in_parts_is_the_same(monkeypatch):
    g, camera = filled(ball, 0.06), ahead(size=(40, 30))
    features = g.means
    whole = splatted_thickness(g, features, camera, 0.06**3, 0.1)
    monkeypatch.setattr("fluidlift.numerics.splatting.PAIRS_MAX", 60)
    parts = splatted_thickness(g, features, camera, 0.06**3, 0.1)
    assert all(np.abs(a - b).max() < 1e-6 for a, b in zip(whole, parts, strict=True))
    far = splatted_thickness(g, features, camera, 0.06**3, 0.1, far=True)
    monkeypatch.undo()
    whole = splatted_thickness(g, features, camera, 0.06**3, 0.1, far=True)
    assert all(np.abs(a - b).max() < 1e-6 for a, b in zip(whole, far, strict=True))
    # the far skin lies behind the near one
    seen = whole[0] > 0.2
    assert (whole[1][seen, 1] / whole[1][seen, 0] > parts[1][seen, 1] / parts[1][seen, 0]).all()


def test_the_volume_of_particles_is_found_in_a_body_and_in_a_film():
    # edge of the cube; Poisson's points and lattices differ by 2 % in what k neighbours measure
    for inside, allowed in ((ball, 0.03), (lambda p: slab(p) & (np.abs(p[:, 1]) < 0.05), 0.03)):
        assert mean_volume(filled(inside, 0.02).means) ** (1 / 3) == pytest.approx(0.02, rel=allowed)
    assert mean_volume(np.zeros((5, 3))) == 0.0


def test_broken_and_no_gaussians_do_no_harm():
    camera, g = ahead(), filled(ball, 0.05)
    nothing = splat_surface(Gaussians.empty(), np.zeros((0, 3)), camera)
    assert nothing.covered.max() == 0 and nothing.depth.max() == 0
    whole = splat_surface(g, g.means, camera, volume=0.05**3)
    means, normals = g.means.copy(), g.means.copy()
    means[0], normals[1] = np.nan, np.inf
    broken = Gaussians(means, g.quats, g.scales, g.opacities, g.sh)
    seen = splat_surface(broken, normals, camera, volume=0.05**3)
    assert all(np.isfinite(x).all() for x in (seen.depth, seen.normal, seen.thickness, seen.albedo, seen.covered))
    assert 0 < seen.thickness.sum() < whole.thickness.sum()
    behind = PinholeCamera.looking(np.array([0.0, -2.0, 0.0]), np.array([0.0, -4.0, 0.0]), 30.0, (16, 12))
    assert splat_surface(g, g.means, behind).covered.max() == 0


def test_wrong_arguments_are_told():
    g = filled(ball, 0.1)
    with pytest.raises(ValueError, match="normals"):
        splat_surface(g, np.zeros((1, 3)), ahead())
    with pytest.raises(ValueError, match="colours"):
        splat_surface(g, g.means, ahead(), colors=np.zeros((2, 3)))
    with pytest.raises(ValueError, match="volume"):
        splat_surface(g, g.means, ahead(), volume=0.0)


def test_compiled_and_plain_surfaces_agree():
    camera, rng = ahead(), np.random.default_rng(6)
    height, width = camera.size[::-1]
    total = rng.uniform(0, 0.1, (height, width)).astype(np.float32)
    skin = rng.normal(size=(height, width, 8)).astype(np.float32)
    skin[..., 0], skin[::5, ::7] = 0.02 * np.abs(skin[..., 0]), 0.0
    found = [np.empty_like(total), np.empty_like(total), *(np.empty((height, width, 3), np.float32) for _ in range(2))]
    rated(total, skin, _eye(camera), np.array([*(0.05 * c for c in COVERED), *AWAY, LEANING]), *found)
    for mine, plain in zip(found, rated_plain(total, skin, camera, 0.05), strict=True):
        np.testing.assert_allclose(mine, plain, atol=2e-6)
    rays = camera.rays(camera.pixel_grid())
    far_normals(skin, _eye(camera), LEANING, found[2])
    away = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    np.testing.assert_allclose(found[2], facing_plain(skin[..., 2:5], away), atol=2e-6)
