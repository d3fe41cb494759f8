"""Light at a surface: energy, angles, the limits that textbooks give."""

import numpy as np
import pytest

from fluidlift.look.materials import PRESETS
from fluidlift.look.optics import deep_color, fresnel, held_inside, mirrored, refract, scattering_share, transmittance

RNG = np.random.default_rng(3)


def directions(n):
    d = RNG.normal(size=(n, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def test_straight_on_and_grazing_light_is_reflected_as_the_formulas_say():
    for index in (1.333, 1.5, 2.4):
        assert fresnel(np.array(1.0), index) == pytest.approx(((index - 1) / (index + 1)) ** 2, rel=1e-12)
        assert fresnel(np.array(-1.0), index) == pytest.approx(((index - 1) / (index + 1)) ** 2, rel=1e-12)
        assert fresnel(np.array(0.0), index) == 1.0
        assert fresnel(np.array(1e-9), index) == pytest.approx(1.0, abs=1e-7)


def test_at_brewsters_angle_half_of_what_the_other_polarisation_reflects_is_left():
    index = 1.333
    cos = np.cos(np.arctan(index))  # light polarised along the plane of incidence passes without loss
    across = ((cos - np.sqrt(index**2 - 1 + cos**2)) / (cos + np.sqrt(index**2 - 1 + cos**2))) ** 2
    assert fresnel(np.array(cos), index) == pytest.approx(0.5 * across, rel=1e-12)


def test_reflection_is_the_same_both_ways_along_the_refracted_ray_and_the_rest_is_refracted():
    n = np.tile([0.0, 0.0, 1.0], (200, 1))
    d = directions(200)
    d[:, 2] = -np.abs(d[:, 2])
    into, passes = refract(d, n, 1 / 1.5)
    assert passes.all()
    reflected, back = fresnel(-d[:, 2], 1.5), fresnel(into[:, 2], 1.5)
    np.testing.assert_allclose(back, reflected, rtol=1e-9)
    # power through the surface: radiance times solid angle times cosine; n^2 cos dw is the same on both sides, so that
    # what is not reflected is what passes, amplitude by amplitude
    ci, ct = -d[:, 2], -into[:, 2]
    across = 2 * ci / (ci + 1.5 * ct)
    along = 2 * ci / (1.5 * ci + ct)
    passed = 0.5 * (across**2 + along**2) * 1.5 * ct / ci
    np.testing.assert_allclose(reflected + passed, 1.0, rtol=1e-12)


def test_there_is_total_reflection_from_within_beyond_the_critical_angle_and_nowhere_else():
    index = 1.333
    critical = np.sqrt(1 - 1 / index**2)
    cos = np.linspace(-1, 0, 500)
    np.testing.assert_array_equal(fresnel(cos, index) == 1.0, -cos <= critical)
    d = np.stack([np.sqrt(1 - cos**2), 0 * cos, -cos], axis=-1)  # up, from below
    out, passes = refract(d, np.array([0.0, 0.0, 1.0]), index)
    np.testing.assert_array_equal(passes, -cos >= critical)
    np.testing.assert_allclose(out[~passes], d[~passes] * [1, 1, -1], atol=1e-12)  # the mirror's


def test_refraction_keeps_snells_law_the_plane_and_the_length():
    d, n = directions(300), directions(300)
    out, passes = refract(d, n, 1 / 1.333)
    assert passes.all()
    np.testing.assert_allclose(np.linalg.norm(out, axis=1), 1.0, atol=1e-12)
    sine_in = np.linalg.norm(np.cross(d, n), axis=1)
    sine_out = np.linalg.norm(np.cross(out, n), axis=1)
    np.testing.assert_allclose(sine_in, 1.333 * sine_out, atol=1e-12)
    np.testing.assert_allclose(np.einsum("ij,ij->i", np.cross(d, n), out), 0.0, atol=1e-12)
    back, _ = refract(-out, -n, 1.333)
    np.testing.assert_allclose(back, -d, atol=1e-9)


def test_a_mirror_keeps_the_angle():
    d, n = directions(50), directions(50)
    m = mirrored(d, n)
    np.testing.assert_allclose((m * n).sum(1), -(d * n).sum(1), atol=1e-12)
    np.testing.assert_allclose(np.cross(m, n), np.cross(d, n), atol=1e-12)


def test_light_is_absorbed_layer_by_layer():
    a = np.array([0.5, 2.0, 20.0])
    np.testing.assert_allclose(transmittance(a, np.array(0.3)), np.exp(-0.3 * a), rtol=1e-12)
    both = transmittance(a, np.array([0.1])) * transmittance(a, np.array([0.2]))
    np.testing.assert_allclose(both, transmittance(a, np.array([0.3])), rtol=1e-12)
    np.testing.assert_array_equal(transmittance(a, np.array([0.0, -1.0])), 1.0)


def test_an_index_that_is_none_is_refused():
    with pytest.raises(ValueError, match="refractive index"):
        fresnel(np.array(1.0), 0.0)


def test_a_deep_body_returns_what_chandrasekhar_says():
    # 1960: a half space of albedo w under light from everywhere reflects 1 - 2 sqrt(1 - w) int H mu dmu
    nodes, weights = np.polynomial.legendre.leggauss(32)
    mu, weights = 0.5 * (nodes + 1), 0.5 * weights
    for share in (0.3, 0.9, 0.99):
        h = np.ones(32)
        for _ in range(400):
            h = 1 / (np.sqrt(1 - share) + 0.5 * share * (weights * mu * h / (mu[:, None] + mu)).sum(1))
        reflected = 1 - 2 * np.sqrt(1 - share) * (weights * mu * h).sum()
        assert scattering_share(np.array([reflected])) == pytest.approx([share], abs=0.01)  # of the fit
        assert deep_color(np.array([1 - share]), share) == pytest.approx([reflected], abs=0.01)
    assert scattering_share(np.array([0.0, 1.0])) == pytest.approx([0.0, 1.0], abs=1e-9)


def test_the_colour_of_a_deep_body_and_the_share_that_it_scatters_are_inverse():
    absorption = np.array([0.5, 3.0, 40.0])
    for index in (1.0, 1.333, 1.5):
        share = scattering_share(deep_color(absorption, 6.0, index), index)
        np.testing.assert_allclose(share, 6.0 / (absorption + 6.0), rtol=1e-9)
    assert (deep_color((1.0, 2.0, 3.0), 0.0, 1.3) == 0).all() and deep_color((0.0, 0.0, 0.0), 1.0)[0] == 1.0


def test_more_than_half_of_the_even_light_in_glass_does_not_get_out():
    # a smooth surface of index 1.5 mirrors 9.18 % of even light from outside (Walsh 1926), and 59.6 % from inside
    assert held_inside(1.5) == pytest.approx(0.596, abs=1e-3)
    assert held_inside(1.0) == pytest.approx(0.0, abs=1e-6)


def test_presets_of_liquids_show_in_the_deep_what_their_numbers_make():
    for name, allowed in (("honey", 0.001), ("oil", 0.0001), ("milk", 0.015)):
        m = PRESETS[name]
        # honey and oil are rounded; milk was measured for itself (Jensen et al. 2001: 0.91, 0.88, 0.76)
        found = deep_color(m.absorption, m.scattering, m.refractive_index)
        np.testing.assert_allclose(found, m.albedo, atol=allowed)
