"""The ground as a closed block with colours."""

import numpy as np
import pytest
import trimesh

from fluidlift.numerics.srgb import linear_from_srgb
from fluidlift.shape.ground_mesh import LOAM, cut_colour, ground_colours, ground_mesh
from fluidlift.types import Grid, PinholeCamera

GRID = Grid((12, 8, 6), 0.25, (-1.5, -1.0, -1.0))


def hills():
    nodes = GRID.nodes()[:, :, 0]
    return 0.3 * np.sin(2 * nodes[..., 0]) * np.cos(nodes[..., 1])


@pytest.mark.parametrize("parts", [1, 3])
def test_every_edge_belongs_to_two_faces_and_the_block_has_the_volume_of_its_columns(parts):
    z = hills()
    mesh = ground_mesh(GRID, z, parts=parts)
    body = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert body.is_watertight and body.is_winding_consistent
    floor = body.bounds[0, 2]
    assert floor < z.min()
    corners = 0.25 * (z[:-1, :-1] + z[1:, :-1] + z[:-1, 1:] + z[1:, 1:])
    columns = (corners - floor).sum() * GRID.spacing**2
    assert body.volume == pytest.approx(columns, rel=0.01)  # the smooth surface bulges a little between the nodes


def test_the_top_passes_through_the_heights():
    z = hills()
    mesh = ground_mesh(GRID, z, parts=2)
    top = mesh.vertices[: 25 * 17].reshape(25, 17, 3)[::2, ::2]
    np.testing.assert_allclose(top[..., 2], z, atol=1e-6)
    np.testing.assert_allclose(top[..., :2], GRID.nodes()[:, :, 0, :2], atol=1e-6)


@pytest.mark.parametrize("heights", [np.zeros((12, 8)), np.full((13, 9), np.nan)])
def test_heights_that_are_none_are_refused(heights):
    with pytest.raises(ValueError):
        ground_mesh(GRID, heights)


def test_seen_ground_has_the_colours_of_the_picture_and_cut_sides_those_of_earth():
    camera = PinholeCamera.looking((0.0, -0.01, 4.0), (0.0, 0.0, 0.0), 30.0, (80, 80))
    plate = np.zeros((80, 80, 3), np.uint8)
    plate[:, :40], plate[:, 40:] = (200, 40, 40), (40, 40, 200)
    mesh = ground_mesh(GRID, np.zeros((13, 9)))
    colours = ground_colours(mesh, plate, camera)
    top = mesh.vertices[:, 2] > -1e-6
    x, y = mesh.vertices[:, 0], mesh.vertices[:, 1]
    seen = top & (np.abs(x) < 1.0) & (np.abs(y) < 0.9)
    for side, colour in ((x < -0.1, (200, 40, 40)), (x > 0.1, (40, 40, 200))):
        np.testing.assert_allclose(colours[seen & side], np.tile(np.array(colour) / 255, ((seen & side).sum(), 1)))
        beyond = top & side & (np.abs(x) > 1.2)  # out of the picture: as the ground beside it
        np.testing.assert_allclose(colours[beyond], np.tile(np.array(colour) / 255, (beyond.sum(), 1)), atol=1e-6)
    assert np.ptp(colours[~top], axis=0).max() == 0


@pytest.mark.parametrize(("pitch", "kept"), [(4.0, 0.0), (30.0, 1.0)])
def test_what_stands_behind_ground_that_is_seen_flatly_is_not_drawn_over_it(pitch, kept):
    way = 6.0 * np.array([0.0, -np.cos(np.radians(pitch)), np.sin(np.radians(pitch))])
    camera = PinholeCamera.looking(tuple(way), (0.0, 0.0, 0.0), 40.0, (80, 80))
    plate = np.zeros((80, 80, 3), np.uint8)
    plate[:, :40], plate[:, 40:] = (200, 40, 40), (40, 40, 200)
    mesh = ground_mesh(GRID, np.zeros((13, 9)))
    colours = ground_colours(mesh, plate, camera)
    top, x = mesh.vertices[:, 2] > -1e-6, mesh.vertices[:, 0]
    left, right = (colours[top & side].mean(axis=0) for side in (x < -0.3, x > 0.3))
    assert left[0] - right[0] == pytest.approx(kept * 160 / 255, abs=0.1)
    assert colours[top, 0].mean() == pytest.approx(0.5, abs=0.15)  # evened out, and not gone


def test_a_cut_is_of_neutral_earth_under_ground_of_any_colour():
    for top in ([0.1, 0.5, 0.1], [0.02, 0.02, 0.02], [0.95, 0.95, 0.95]):
        cut, own = linear_from_srgb(cut_colour(np.tile(top, (5, 1)))), linear_from_srgb(np.array(top))
        # between the ground's colour and earth, and never so dark that a side in half of the sky's light is black
        assert (np.minimum(own, LOAM) - 1e-6 <= cut).all() and (cut <= np.maximum(own, LOAM) + 1e-6).all()
        assert cut.min() > 0.4 * LOAM.min()
        assert np.ptp(cut) < max(0.6 * np.ptp(own), np.ptp(LOAM))  # a cut through turf is not green
