"""The made clear stream keeps the laws that its truth is used for."""

import numpy as np
import pytest
from made_beds import CAMERAS, filmed

from fluidlift.numerics.srgb import linear_from_srgb
from fluidlift.synthetic.clear_stream import INDEX, ClearStream

SCENE = ClearStream.make(3, depth=0.5)


def test_a_vertical_ray_goes_straight_down():
    places = np.array([[0.0, 0.0, 0.0], [0.4, 0.8, 0.0]])
    run = SCENE.bed_below(places, np.tile([0.0, 0.0, -1.0], (2, 1)))
    np.testing.assert_allclose(run, [0.5, 0.5 * (1.0 - 0.25)], rtol=1e-3)


def test_slopes_and_caustics_have_no_mean_over_time():
    times = np.linspace(0.0, 400.0, 2001)
    found = [SCENE.ripples(np.array([[0.3, 0.2]]), t) for t in times]
    slope, bend = np.array([f[0][0] for f in found]), np.array([f[1][0] for f in found])
    # independent about every 0.1 s: a hundredth of the spread remains of 2001 of them, twice that is seldom
    assert (np.abs(slope.mean(axis=0)) < 0.06 * slope.std(axis=0)).all()
    assert abs(bend.mean()) < 0.06 * bend.std()
    assert slope.std() == pytest.approx(0.04 / np.sqrt(2.0), rel=0.25)  # of one axis; 24 waves are no continuum


def test_light_of_the_bed_falls_exponentially_with_what_the_water_absorbs():
    """Twice the absorption squares what is left of the light."""
    clear, once, twice = (
        filmed("steep", 3, 1, absorption=(k * 0.7,) * 3)[1].still for k in (0.0, 1.0, 2.0)
    )  # fmt: skip
    wet = clear.sum(axis=-1) > 0
    np.testing.assert_allclose(twice[wet] / clear[wet], (once[wet] / clear[wet]) ** 2, rtol=1e-9)
    assert (once[wet] < clear[wet]).all()


def test_the_opaque_twin_shows_nothing_of_its_bed():
    _, shallow = filmed("steep", 3, 1, opaque=True, depth=0.2)
    _, deep = filmed("steep", 3, 1, opaque=True, depth=1.0)
    water = shallow.water & deep.water
    np.testing.assert_allclose(shallow.still[water], deep.still[water])


def test_its_flow_is_that_of_its_surface():
    _, film = filmed("oblique", 3, 1)
    camera = CAMERAS["oblique"]
    depth, uv = film.depth[film.water], camera.pixel_grid()[film.water]
    moved = camera.unproject(uv + film.flow[film.water], depth) - camera.unproject(uv, depth)
    # along x the camera z stays: the step is that of the current, 0.5 m/s in 0.04 s
    np.testing.assert_allclose(moved, np.tile([0.02, 0.0, 0.0], (len(moved), 1)), atol=1e-9)


def test_dry_ground_has_its_albedo_in_white_light():
    scene, film = filmed("steep", 3, 1)
    camera, dry = CAMERAS["steep"], ~film.water
    points = camera.unproject(camera.pixel_grid()[dry], film.depth[dry])
    shown = linear_from_srgb(film.frames[0][dry] / 255.0)
    # the sensor's noise of a grey level is 0.01 of linear light at most
    assert np.abs(shown - scene.albedo(points[:, :2])).mean() < 0.01
    assert INDEX > 1.3
