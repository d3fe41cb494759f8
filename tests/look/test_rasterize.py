"""What a picture of Gaussians must hold, whatever they are."""

import numpy as np
import pytest

from fluidlift.look.project import sound, sound_plain, view_colors
from fluidlift.look.rasterize import over_kernel, over_plain, render
from fluidlift.types.camera import PinholeCamera
from fluidlift.types.gaussians import Gaussians, concatenate
from fluidlift.types.transforms import RigidTransform

CAMERA = PinholeCamera.looking(np.array([0.0, -3.0, 1.0]), np.zeros(3), 50, (96, 64))


def ball(count: int = 2000, seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)
    p = rng.normal(size=(count, 3))
    p *= rng.random((count, 1)) ** (1 / 3) / np.linalg.norm(p, axis=1, keepdims=True)
    return Gaussians.isotropic(p.astype(np.float32), 0.06, rng.random((count, 3)).astype(np.float32), 0.7)


def test_a_white_body_before_white_is_white():
    g = ball()
    white = Gaussians.isotropic(g.means, 0.06, np.ones((len(g), 3)), 0.7)
    np.testing.assert_allclose(render(white, CAMERA, background=(1.0, 1.0, 1.0)).image, 1, atol=1e-5)


def test_depth_is_that_of_the_nearest_opaque_surface():
    rendered = render(ball(20_000), CAMERA)
    # distance sqrt(10), radius 1; the front is soft by about one Gaussian (0.06) and bulges out by one
    assert abs(rendered.depth[32, 48] - (10**0.5 - 1)) < 0.1
    assert rendered.alpha[32, 48] > 0.99
    assert rendered.alpha[2, 2] == 0 and rendered.depth[2, 2] == 0


def test_order_of_the_list_does_not_matter():
    g = ball()
    shuffled = g.select(np.random.default_rng(1).permutation(len(g)))
    # other lanes, same sums per pixel
    np.testing.assert_allclose(render(g, CAMERA).image, render(shuffled, CAMERA).image, atol=1e-6)


def test_a_picture_as_background_shows_where_nothing_is():
    behind = np.random.default_rng(0).random((64, 96, 3)).astype(np.float32)
    rendered = render(ball(), CAMERA, background=behind)
    empty = rendered.alpha == 0
    assert empty.any() and np.array_equal(rendered.image[empty], behind[empty])


def test_features_are_drawn_in_place_of_colours():
    g = ball()
    features = np.concatenate([g.rgb, g.rgb[:, :1]], 1)
    rendered = render(g, CAMERA, features=features)
    assert rendered.image.shape == (64, 96, 4)
    np.testing.assert_allclose(rendered.image[..., :3], render(g, CAMERA).image, atol=1e-6)


def test_colours_of_degree_one_turn_with_the_view():
    sh = np.zeros((1, 4, 3), np.float32)
    sh[0, 2, 0] = 1.0  # grows with z of the line of sight
    g = Gaussians(np.zeros((1, 3)), np.float32([[1, 0, 0, 0]]), np.full((1, 3), 0.3), np.float32([0.9]), sh)
    below = PinholeCamera.looking(np.array([0, -1e-3, -3.0]), np.zeros(3), 50, (16, 16))
    above = PinholeCamera.looking(np.array([0, -1e-3, 3.0]), np.zeros(3), 50, (16, 16))
    np.testing.assert_allclose(view_colors(g, below)[0], [0.5 + 0.4886, 0.5, 0.5], atol=1e-4)
    np.testing.assert_allclose(view_colors(g, above)[0], [0.5 - 0.4886, 0.5, 0.5], atol=1e-4)
    assert render(g, below).image[8, 8, 0] > 5 * render(g, above).image[8, 8, 0]


def test_rubbish_does_not_spoil_the_picture():
    rubbish = Gaussians(
        np.float32([[np.nan, 0, 0], [0, 0, 0], [0, 0, 0], [0, -3, 1], [1e30, 0, 0], [0, 0, 0]]),
        np.float32([[1, 0, 0, 0], [1, 0, 0, 0], [0, 0, 0, 0], [1, 0, 0, 0], [1, 0, 0, 0], [1, 0, 0, 0]]),
        np.float32([[1, 1, 1], [np.inf, 1, 1], [1, 1, 1], [1e9, 1e9, 1e9], [1, 1, 1], [-1, 1, 1]]),
        np.full(6, 0.9),
        np.zeros((6, 1, 3)),
    )
    clean, dirty = render(ball(), CAMERA), render(concatenate([ball(), rubbish]), CAMERA)
    assert np.isfinite(dirty.image).all() and np.isfinite(dirty.depth).all()
    np.testing.assert_allclose(dirty.image, clean.image, atol=1e-5)


def test_thousands_of_giants_are_drawn_in_bounded_memory(monkeypatch):
    import fluidlift.look.rasterize as module

    monkeypatch.setattr(module, "PAIRS_DRAWN_MAX", 20_000)
    g = ball()
    giants = Gaussians.isotropic(g.means, 1e6, g.rgb, 0.5)
    rendered = render(giants, CAMERA)
    assert np.isfinite(rendered.image).all() and rendered.alpha.max() > 0.9


def test_nothing_gives_the_background():
    rendered = render(Gaussians.empty(), CAMERA, background=(0.1, 0.2, 0.3))
    np.testing.assert_array_equal(rendered.image, np.broadcast_to(np.float32([0.1, 0.2, 0.3]), (64, 96, 3)))


def test_a_body_behind_the_camera_is_not_seen():
    away = PinholeCamera.from_fov(50, (32, 32), RigidTransform(np.eye(3), np.array([0, 0, -5.0])))
    assert render(ball(), away).alpha.max() == 0


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match="features"):
        render(ball(10), CAMERA, features=np.ones((9, 3)))
    with pytest.raises(ValueError, match="background"):
        render(ball(10), CAMERA, background=(1.0, 1.0))


def test_more_gaussians_than_can_be_numbered_are_refused(monkeypatch):
    import fluidlift.look.rasterize as module

    monkeypatch.setattr(module, "COUNT_MAX", 1000)
    with pytest.raises(ValueError, match=r"2000 Gaussians.*at most 1000.*prune"):
        render(ball(), CAMERA)


def test_only_what_is_seen_gets_colours(monkeypatch):
    import fluidlift.look.rasterize as module

    g = ball()
    away = g.select(np.arange(1000))
    away = Gaussians(away.means + np.float32([0, -100, 0]), away.quats, away.scales, away.opacities, away.sh)
    counts = []
    monkeypatch.setattr(module, "view_colors", lambda g, c, i: counts.append(len(i)) or view_colors(g, c, i))
    drawn = render(concatenate([away, g]), CAMERA)
    np.testing.assert_array_equal(drawn.image, render(g, CAMERA).image)
    assert counts == [len(g)] * 2, "those behind the camera cost no colours"


def test_bands_of_tiles_change_no_bit_of_a_picture(monkeypatch):
    from fluidlift.numerics import splatting

    whole = render(ball(), CAMERA)
    monkeypatch.setattr(splatting, "PAIRS_MAX", 500)
    parts = render(ball(), CAMERA)
    assert np.array_equal(parts.image, whole.image) and np.array_equal(parts.depth, whole.depth)


@pytest.mark.parametrize("behind", [(1, 1), (13, 17)])
def test_the_pass_that_puts_a_background_behind_is_its_plain_twin(behind):
    rng = np.random.default_rng(0)
    image, depth, light = (rng.random(shape).astype(np.float32) for shape in ((13, 17, 3), (13, 17), (13, 17)))
    light[:5] = 1 - np.float32(1e-4)  # too thin for a depth
    background = rng.random((*behind, 3)).astype(np.float32)
    wanted = over_plain(image, depth, light, background)
    over_kernel(image, depth, light, background)
    for one, other in zip((image, depth, light), wanted):
        np.testing.assert_allclose(one, other, rtol=1e-6)  # product and sum may be one instruction


def test_one_broken_number_anywhere_makes_a_gaussian_unsound():
    g = ball(64)
    g = Gaussians(g.means, g.quats, g.scales, g.opacities, np.concatenate([g.sh, np.zeros((64, 3, 3), np.float32)], 1))
    arrays = [a.copy() for a in (g.means, g.quats, g.scales, g.opacities, g.sh)]
    row = 0
    for array in arrays:
        for bad in (np.nan, np.inf, -np.inf):
            array.reshape(64, -1)[row, -1] = bad
            row += 1
    arrays[1][row] = 0
    arrays[2][row + 1] *= -1
    broken = Gaussians(*arrays)
    assert np.array_equal(sound(broken), sound_plain(broken))
    assert np.flatnonzero(~sound(broken)).tolist() == list(range(row + 2))
