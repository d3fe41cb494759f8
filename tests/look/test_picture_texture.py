"""Over a map of the picture each place is seen in itself, and lends its look where the film shows fluid."""

import numpy as np

from fluidlift.look.footage import FluidFootage
from fluidlift.look.picture_texture import PictureTexture
from fluidlift.look.surface_axes import PictureAxes
from fluidlift.look.surface_map import SurfaceMap
from fluidlift.types import PinholeCamera

CELL = 0.1
CAMERA = PinholeCamera.looking((0.0, -5.0, 1.0), (0.0, 0.0, 1.0), fov_degrees=40.0, size=(120, 90))
AXES = PictureAxes(CAMERA, 5.0)


def curtain() -> np.ndarray:
    """A sheet of water (m) that stands before the camera, wider and higher than the picture."""
    x, z = (a.ravel() for a in np.meshgrid(np.arange(-2.4, 2.4, 0.04), np.arange(-0.9, 2.9, 0.04)))
    return np.stack([x, 0 * x, z], axis=-1)


def texture(fluid: np.ndarray) -> PictureTexture:
    world = curtain()
    surface = SurfaceMap.of(AXES.points(world), AXES.velocities(world, np.tile([0, 0, -1.0], (len(world), 1))), CELL)
    frames = np.full((8, 90, 120, 3), 100, np.uint8)
    film = FluidFootage.of(frames, np.repeat(fluid[None], 8, axis=0), 0.04)
    assert film is not None
    return PictureTexture(AXES, surface, film)


def left_half() -> np.ndarray:
    return np.broadcast_to(np.arange(120) < 60, (90, 120))


def test_places_are_found_in_the_row_and_column_in_which_they_are_seen():
    found = texture(left_half())
    world = CAMERA.unproject(np.array([[10.5, 20.5], [59.5, 44.5], [100.5, 80.5]]), np.array([4.0, 5.0, 6.0]))
    points = AXES.points(world)
    # pixel centres are at a half; whatever the depth
    np.testing.assert_allclose(found.seen_at(points), [[20, 10], [44, 59], [80, 100]], atol=1e-6)
    np.testing.assert_array_equal(found.index_of(points[:, :2]), found.seen_at(points))


def test_what_the_film_shows_as_fluid_may_lend_its_look():
    found = texture(left_half())
    assert found.usable
    places = AXES.points(np.array([[-1.0, 0, 1.0], [-0.5, 0, 0.5], [0.5, 0, 1.0], [1.0, 0, 1.4]]))[:, :2]
    trust = found.trust(places)
    # the blur of one column (5 cm) reaches no further than four of them
    np.testing.assert_allclose(trust, [1, 1, 0, 0], atol=1e-3)
    edge = found.trust(np.array([[0.0, 0.0]]))[0]
    assert 0.3 < edge < 0.7, "half of the surroundings of the edge, known to a column"


def test_what_is_beside_the_picture_lends_nothing():
    found = texture(np.ones((90, 120), bool))
    half = 5.0 * np.tan(np.radians(20.0))  # m from the middle to the picture's side
    trust = found.trust(np.array([[half - 0.3, 0.0], [half + 0.3, 0.0], [0.0, 0.75 * half + 0.3]]))
    np.testing.assert_allclose(trust, [1, 0, 0], atol=1e-3)


def test_a_source_needs_room_around_it():
    found = texture(left_half())
    surface, within = found.surface, found.trust_within(0.4)
    places = np.array([[-1.0, 0.0], [-0.2, 0.0], [0.3, 0.0]])
    good = surface.at(within, places)
    assert good[0] > 0.99 and good[2] == 0
    # a square of 0.8 m about a place 0.2 m from the edge: three quarters, known to a column of 5 cm on either side
    assert 0.65 < good[1] < 0.85


def test_a_film_whose_fluid_is_elsewhere_is_not_usable():
    corner = np.zeros((90, 120), bool)
    corner[:1, :1] = True  # one pixel: a place of the map is larger
    assert not texture(corner).usable
