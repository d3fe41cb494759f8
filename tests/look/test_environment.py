"""Light from all around: where it is, what a rough mirror and a dull body see of it."""

import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.look.environment import BUILT_IN, LUMINANCE, Environment, built_in
from fluidlift.look.environment_filter import clamped_cosine, convolved, ggx_lobe, resized, solid_angles
from fluidlift.look.environment_lookup import grid_directions, lookup, lookup_plain

AXES = {"+x": (1, 0, 0), "-x": (-1, 0, 0), "+y": (0, 1, 0), "-y": (0, -1, 0), "+z": (0, 0, 1), "-z": (0, 0, -1)}


def directions(count: int = 500, seed: int = 0) -> np.ndarray:
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)


def noise(rows: int, seed: int = 0) -> Environment:
    return Environment(np.random.default_rng(seed).random((rows, 2 * rows, 3), np.float32))


def lamp(direction, rows: int = 64, radiance: float = 100.0) -> Environment:
    """Dark, but for a disc of 8 degrees."""
    near = grid_directions(rows) @ (np.asarray(direction, float) / np.linalg.norm(direction)) > np.cos(np.radians(8))
    return Environment(np.where(near[..., None], radiance, 0.0) * np.array([1.0, 0.8, 0.6]))


def test_the_picture_lies_around_the_scene_as_documented():
    rows = 32
    picture = np.zeros((rows, 2 * rows, 3), np.float32)
    picture[:, rows // 2 - 8 : rows // 2 + 8] = (1, 0, 0)  # left quarter: -x
    picture[:, rows - 8 : rows + 8] = (0, 1, 0)  # middle: +y
    picture[:, rows + rows // 2 - 8 : rows + rows // 2 + 8] = (0, 0, 1)  # right quarter: +x
    picture[:2], picture[-2:] = 5, 7
    seen = Environment(picture).toward(np.array([AXES[name] for name in ("-x", "+y", "+x", "+z", "-z")], float))
    np.testing.assert_array_equal(seen, [(1, 0, 0), (0, 1, 0), (0, 0, 1), (5, 5, 5), (7, 7, 7)])


def test_pixel_centres_show_their_own_pixels():
    environment = noise(24)
    # float32 angles: a share of 1e-6 of the circle is 5e-5 of a pixel
    np.testing.assert_allclose(environment.toward(grid_directions(24)), environment.radiance, atol=2e-4)


def test_lookup_is_its_twin_and_takes_any_length_of_direction():
    picture, d = noise(16).radiance, directions()
    np.testing.assert_allclose(lookup(picture, 7.5 * d), lookup_plain(picture, d), atol=2e-4)  # float32 angles


def test_lookup_has_no_seam_and_no_hole_at_the_poles():
    picture = noise(16).radiance
    around = np.linspace(0, 2 * np.pi, 50)
    pole = np.stack([1e-4 * np.cos(around), 1e-4 * np.sin(around), np.ones(50)], axis=1)
    ring = picture[0]
    middle = 0.5 * (ring + np.roll(ring, 16, axis=0))  # half a pixel from the pole on either side
    seen = lookup(picture, pole)
    assert seen.min() >= middle.min() - 1e-3 and seen.max() <= middle.max() + 1e-3
    seam = np.stack([[1e-4, -1e-4], [-1, -1], [0.3, 0.3]], axis=1)
    np.testing.assert_allclose(*lookup(picture, seam), atol=2e-3)  # neighbours 2e-4 rad apart: 5e-4 of a pixel


def test_a_direction_that_is_no_number_sees_nothing():
    assert (lookup(noise(8).radiance, np.array([[np.nan, 0, 1]])) == 0).all()


def test_roughness_0_is_the_environment_itself():
    environment, d = noise(32), directions()
    np.testing.assert_array_equal(environment.blurred(d, 0.0), environment.toward(d))
    np.testing.assert_array_equal(environment.blurred(d, np.zeros(len(d))), environment.toward(d))


@pytest.mark.parametrize("roughness", [0.0, 0.05, 0.12, 0.3, 0.6, 1.0])
def test_an_even_light_stays_even_at_every_roughness(roughness):
    environment, d = Environment.white(0.7), directions()
    np.testing.assert_allclose(environment.blurred(d, roughness), 0.7, rtol=1e-5)  # float32
    np.testing.assert_allclose(environment.irradiance(d), 0.7, rtol=1e-5)


def test_one_roughness_for_all_or_one_for_each_give_the_same():
    environment, d = noise(32), directions(60)
    rough = np.linspace(0, 1, 60)
    single = np.concatenate([environment.blurred(d[k : k + 1], float(rough[k])) for k in range(60)])
    np.testing.assert_allclose(environment.blurred(d, rough), single, atol=1e-6)


@pytest.mark.parametrize("roughness", [0.35, 0.5, 0.7, 1.0])
def test_the_prefiltered_light_is_the_integral_over_the_lobe(roughness):
    """Against GGX half vectors drawn one by one, as in Karis 2013, weighted by the cosine of the light."""
    environment = lamp((0.3, 1.0, 0.6), radiance=10.0)
    u, v = np.random.default_rng(1).random((2, 400_000))
    alpha = roughness**2
    cos_half = np.sqrt((1 - u) / (1 + (alpha**2 - 1) * u))
    sin_half, around = np.sqrt(1 - cos_half**2), 2 * np.pi * v
    half = np.stack([sin_half * np.cos(around), sin_half * np.sin(around), cos_half], axis=1)
    light = 2 * half[:, 2:] * half - [0, 0, 1]
    light, weight = light[light[:, 2] > 0], light[light[:, 2] > 0, 2]
    for normal in np.array([(0.3, 1.0, 0.6), (0.0, 1.0, 0.2), (0.6, 0.6, 0.5)]):
        normal = normal / np.linalg.norm(normal)
        across = np.cross(normal, (0, 0, 1.0))
        across /= np.linalg.norm(across)
        frame = np.stack([across, np.cross(normal, across), normal])
        drawn = (environment.toward(light @ frame) * weight[:, None]).sum(0) / weight.sum()
        # the pictures are 32 to 64 rows: a lamp of 8 degrees is 1.5 to 3 of their pixels
        np.testing.assert_allclose(environment.blurred(normal, roughness), drawn, rtol=0.08, atol=0.02)


def test_irradiance_of_a_linear_gradient_is_two_thirds_of_it():
    """Radiance 1 + b . d: the cosine lobe keeps the mean, and 2/3 of a linear part (Ramamoorthi and Hanrahan 2001)."""
    b = np.array([0.3, -0.2, 0.5])
    values = 1 + grid_directions(64) @ b
    environment = Environment(np.repeat(values[..., None], 3, axis=2))
    d = directions()
    # pictures of 32 rows, read between their pixels: (pi / 32)^2 / 8 of the linear part
    np.testing.assert_allclose(environment.irradiance(d)[:, 0], 1 + 2 / 3 * d @ b, atol=1.5e-3)


def test_irradiance_is_the_integral_over_the_hemisphere():
    environment, normals = noise(16), directions(20)
    fine = grid_directions(128).reshape(-1, 3)
    weight = np.repeat(solid_angles(128), 256)
    cosine = np.maximum(normals @ fine.T, 0) * weight
    exact = cosine @ environment.toward(fine) / np.pi
    np.testing.assert_allclose(environment.irradiance(normals), exact, rtol=5e-3)  # 32 rows instead of 128


def test_blurring_on_the_sphere_keeps_all_light():
    picture = noise(32).radiance
    weights = solid_angles(32)[:, None, None]
    for lobe in (clamped_cosine, ggx_lobe(0.5)):
        # rows are normalised one by one, so the sum is kept to the error of the quadrature
        np.testing.assert_allclose((convolved(picture, lobe) * weights).sum(), (picture * weights).sum(), rtol=3e-3)


@pytest.mark.parametrize("rows", [8, 10, 37, 40])
def test_a_smaller_picture_holds_the_same_light(rows):
    picture = noise(40).radiance
    total = (picture * solid_angles(40)[:, None, None]).sum((0, 1))
    small = resized(picture, rows)
    assert small.shape == (rows, 2 * rows, 3)
    # exact where the rows divide; else a row that lies in two is shared by its height, not by its solid angle
    whole = 40 % rows == 0
    np.testing.assert_allclose(
        (small * solid_angles(rows)[:, None, None]).sum((0, 1)), total, rtol=1e-5 if whole else 5e-3
    )


def test_solid_angles_add_up_to_the_sphere():
    assert np.isclose(2 * 17 * solid_angles(17).sum(), 4 * np.pi)


def test_a_turned_environment_shows_what_was_elsewhere():
    environment, d = noise(16), directions()
    turned = environment.turned(90)  # +x goes to +y
    before = np.stack([d[:, 1], -d[:, 0], d[:, 2]], axis=1)
    np.testing.assert_allclose(turned.toward(d), environment.toward(before), atol=2e-3)  # float32 angles
    np.testing.assert_allclose(environment.turned(13.0).mean, environment.mean, rtol=1e-5)
    np.testing.assert_array_equal(environment.turned(0).radiance, environment.radiance)


@pytest.mark.parametrize("toward", [(1.0, 0.2, 0.5), (-0.2, -1.0, 0.3), (0.0, 0.05, 1.0)])
def test_the_strongest_light_is_found_where_it_is_and_is_all_there_is(toward):
    environment = lamp(toward)
    direction, irradiance, share = environment.light()
    toward = np.asarray(toward) / np.linalg.norm(toward)
    assert direction @ toward > np.cos(np.radians(1.0))  # pixels of 2.8 degrees
    np.testing.assert_allclose(irradiance, environment.irradiance(toward), rtol=0.02)
    assert share > 0.97


def test_an_even_light_casts_no_shadow():
    direction, irradiance, share = Environment.white().light()
    assert share < 1e-3 and irradiance.max() < 1e-3 and np.isclose(np.linalg.norm(direction), 1)


@pytest.mark.parametrize("name", ["sky", "studio"])
def test_a_level_white_body_in_built_in_light_is_white(name):
    # scaled on 256 rows, seen on 32
    assert built_in(name).irradiance(np.array([0.0, 0.0, 1.0])) @ LUMINANCE == pytest.approx(1.0, abs=0.02)


def test_the_sky_is_blue_above_and_its_sun_is_the_strongest_light():
    sky = built_in("sky")
    up = sky.toward(np.array([0.2, -0.5, 1.0]))
    assert up[2] > 1.5 * up[0]
    direction, _, share = sky.light()
    assert np.degrees(np.arcsin(direction[2])) == pytest.approx(40, abs=1.0)
    assert 0.6 < share < 0.9  # outdoors the sun gives about this of a face towards it
    assert sky.toward(np.array([0, 0, -1.0])) @ LUMINANCE < 0.3


def test_every_built_in_name_gives_light_and_another_tells_the_nearest():
    for name in BUILT_IN:
        assert built_in(name).mean.min() > 0
    with pytest.raises(InputRejected, match="studio"):
        built_in("studoi")


@pytest.mark.parametrize(
    "radiance", [np.ones((4, 6, 3)), np.full((4, 8, 3), -1.0), np.full((4, 8, 3), np.nan), np.ones((4, 8))]
)
def test_what_is_no_light_is_refused(radiance):
    with pytest.raises(ValueError):
        Environment(radiance)
