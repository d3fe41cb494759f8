"""Light inside a liquid: to the far side where it is, and on inside to where it gets out."""

import numpy as np
import pytest

from fluidlift.look.liquid import Behind, followed
from fluidlift.look.optics import refract
from fluidlift.look.screen_space import mesh_surface
from fluidlift.numerics.solid_mesh import box_mesh, ellipsoid_mesh
from fluidlift.types import PinholeCamera, TriangleMesh

SIZE = (96, 72)


def watching(eye) -> PinholeCamera:
    return PinholeCamera.looking(np.array(eye), np.zeros(3), 36.0, SIZE)


def nothing(goes_on=False) -> Behind:
    return Behind(np.ones((*SIZE[::-1], 3)), np.zeros(SIZE[::-1]), goes_on)


def unit_rays(camera, pixels):
    d = camera.rays(camera.pixel_grid()[pixels[:, 0], pixels[:, 1]])
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def tank() -> TriangleMesh:
    """A cube of 1 m with corners of their own for each face: its normals jump at the edges."""
    box = box_mesh((1.0, 1.0, 1.0))
    corner = np.asarray(box.faces).ravel()
    return TriangleMesh(np.asarray(box.vertices)[corner], np.arange(len(corner)).reshape(-1, 3))


@pytest.mark.parametrize("index", [1.333, 1.5])
def test_through_a_ball_light_takes_the_way_that_snells_law_says(index):
    camera, radius = watching((0.0, -2.5, 0.4)), 0.5
    surface = mesh_surface(ellipsoid_mesh((radius, radius, radius)), camera)
    pixels = np.argwhere(surface.covered > 0.99)
    d, eye = unit_rays(camera, pixels), camera.position
    closest = -(d @ eye)
    under = closest**2 - (eye @ eye - radius**2)
    inner = under > (0.3 * radius) ** 2  # the rest is within a pixel or two of the outline
    pixels, d, closest, under = pixels[inner], d[inner], closest[inner], under[inner]
    hit = eye + d * (closest - np.sqrt(under))[:, None]
    t, _ = refract(d, hit / radius, 1 / index)
    way = -2 * (t * hit).sum(axis=1)
    out, _ = refract(t, -(hit + t * way[:, None]) / radius, index)
    rays = followed(surface, nothing(), camera, pixels, index)
    # the mesh has faces of 10 degrees: a chord of it is up to 1 - cos 5 degrees short, and its normals are interpolated
    assert np.abs(rays.path / way - 1).max() < 0.02
    turned = np.degrees(np.arccos(np.clip((rays.through * out).sum(axis=1), -1, 1)))
    assert np.median(turned) < 1.0 and np.percentile(turned, 95) < 3.0
    # the plane through the end of the straight line would be off by this
    straight = 2 * np.sqrt(under)
    assert np.abs(straight / way - 1).max() > 0.2


def test_light_that_is_mirrored_at_the_bottom_of_a_tank_leaves_through_its_back():
    camera = watching((0.0, -3.0, 0.5))
    surface = mesh_surface(tank(), camera)
    pixels = np.argwhere(surface.covered > 0.99)
    d, eye = unit_rays(camera, pixels), camera.position
    hit = eye + d * ((-0.5 - eye[1]) / d[:, 1])[:, None]
    t, _ = refract(d, np.broadcast_to([0.0, -1.0, 0.0], d.shape), 1 / 1.333)
    down = (-0.5 - hit[:, 2]) / t[:, 2]
    floor = hit + t * down[:, None]
    up = t * (1.0, 1.0, -1.0)
    more = (0.5 - floor[:, 1]) / up[:, 1]
    back = floor + up * more[:, None]
    clear = 0.06  # m, of the edges: a pixel is 0.025
    good = (np.abs(hit[:, 2]) < 0.5 - clear) & (np.abs(floor[:, 1]) < 0.5 - clear) & (down > 0)
    good &= (np.abs(floor[:, 0]) < 0.5 - clear) & (np.abs(back[:, 0]) < 0.5 - clear) & (back[:, 2] < 0.5 - clear)
    assert good.sum() > 40
    rays = followed(surface, nothing(), camera, pixels[good], 1.333)
    assert (rays.turned > 0.99).all()  # far beyond the critical angle
    np.testing.assert_allclose(rays.path, down[good], rtol=0.05)
    # out through the back as it came in through the front, but upwards
    off = np.linalg.norm(rays.inward - d[good] * (1.0, 1.0, -1.0), axis=1)
    # where a side stands between the camera and the way, pictures of the near and the far side do not hold it
    assert np.median(off) < 1e-5 and np.mean(off < 0.03) > 0.85
    np.testing.assert_allclose(np.median(rays.farther / more[good]), 1.0, atol=0.05)


def test_around_a_clip_there_is_no_other_world():
    """A ball bends light far out of the picture: before a plate that is the plate's, rim and mean."""
    camera = watching((0.0, -1.6, 0.0))
    surface = mesh_surface(ellipsoid_mesh((0.5, 0.5, 0.5)), camera)
    pixels = np.argwhere(surface.covered > 0.99)
    known, alone = (followed(surface, nothing(g), camera, pixels, 1.5) for g in (True, False))
    assert not known.surroundings.any() and not known.beyond.any()
    np.testing.assert_allclose(known.color, 1.0, atol=1e-6)
    assert alone.surroundings.any() and alone.beyond.any()
