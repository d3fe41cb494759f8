"""A stream ends in a clean section where its outlet begins."""

from pathlib import Path

import numpy as np
import pytest

from fluidlift.io.scene_look import Look
from fluidlift.look.outlet_section import OpenEnd
from fluidlift.look.stream_slab import Slab
from fluidlift.numerics.triangles import rasterize_closed
from fluidlift.present.looks import Frame, Painter
from fluidlift.present.without_fluid import Backdrop
from fluidlift.types import CellType, Gaussians, Grid, PinholeCamera, Terrain, TriangleMesh, sh_from_rgb

H = 0.1
CELLS = (24, 8, 6)


def cells() -> np.ndarray:
    found = np.full(CELLS, CellType.EMPTY, np.uint8)
    found[:, :, 0] = CellType.SOLID
    found[:20, :, 1:4] = CellType.FLUID
    found[20:23, :, 1:] = CellType.OUTFLOW
    return found


GRID = Grid(CELLS, H)
EMPTY = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))
STREAM = np.array([0.98, 0.0, -0.2])


def test_the_section_stands_upright_where_the_outlet_begins():
    end = OpenEnd.of(cells(), GRID, STREAM)
    assert end is not None
    np.testing.assert_allclose(end.along, [1.0, 0.0, 0.0])
    assert end.at == pytest.approx(2.05)  # the middle of the first of the outlet's cells
    points = np.array([[2.0, 0, 0], [2.1, 0, 0], [2.3, 0, 0]])
    np.testing.assert_array_equal(end.before(points), [True, False, False])


def test_behind_the_section_the_liquid_goes_on_as_a_prism():
    # a stream two rows high, and behind the section a drop that lies higher and one that lies beside it
    stream = np.stack(np.meshgrid(np.arange(1.625, 2.05, 0.05), [0.4], [0.2, 0.25], indexing="ij"), -1).reshape(-1, 3)
    points = np.concatenate([stream, [[2.1, 0.4, 0.4], [2.15, 0.7, 0.2]]])
    end = OpenEnd.of(cells(), GRID, STREAM)
    assert end is not None
    which, places = end.carried_on(points)
    assert which.max() < len(stream)
    np.testing.assert_array_equal(places[:, 1:], points[which, 1:])  # carried straight on
    rows = np.arange(1.625, 2.25, 0.05)  # two cells on, with the distances of the stream
    np.testing.assert_allclose(np.unique(np.round(places[:, 0], 6)), rows, atol=1e-6)
    assert len(which) == 2 * len(rows)


def test_what_falls_or_has_no_outlet_has_no_section():
    assert OpenEnd.of(cells(), GRID, np.array([0.1, 0.0, -0.99])) is None
    closed = np.where(cells() == CellType.OUTFLOW, CellType.EMPTY, cells()).astype(np.uint8)
    assert OpenEnd.of(closed, GRID, STREAM) is None


def test_a_mesh_cut_there_is_closed_and_flat():
    end = OpenEnd(np.array([1.0, 0.0, 0.0]), 0.25, H)
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    rise = np.linspace(0.2, np.pi - 0.2, 12)
    ring = np.stack([np.outer(np.sin(rise), np.cos(turn)), np.outer(np.sin(rise), np.sin(turn)),
                     np.repeat(np.cos(rise)[:, None], 24, 1)], -1).reshape(-1, 3)  # fmt: skip
    points = np.concatenate([ring, [[0, 0, 1.0], [0, 0, -1.0]]])
    faces = []
    for j in range(24):
        k = (j + 1) % 24
        for i in range(11):
            a, b, c, d = 24 * i + j, 24 * i + k, 24 * (i + 1) + j, 24 * (i + 1) + k
            faces += [[a, c, b], [b, c, d]]
        faces += [[288, j, k], [289, 264 + k, 264 + j]]
    found = end.section(TriangleMesh(points, np.array(faces)))
    assert found.vertices[:, 0].max() <= 0.25 + 1e-12
    # seen along the plane, nothing is behind it, and well before it all is as it was
    camera = PinholeCamera.looking(np.array([0.0, -6.0, 0.0]), np.zeros(3), 30.0, (80, 80))
    whole, cut = (rasterize_closed(v, np.array(faces), camera).inside for v in (points, found.vertices))
    column = int(np.floor(camera.project(np.array([[0.25, 0.0, 0.0]]))[0][0, 0]))
    # the silhouette's plane lies before the middle's by at most a unit in six
    assert np.abs(cut[:, column + 4 :]).max() < 1e-6 and whole[40, column + 8] > 0.5
    np.testing.assert_allclose(cut[:, : column - 6], whole[:, : column - 6], atol=1e-5)


@pytest.mark.parametrize(("style", "engine"), [("surface", "mesh"), ("surface", "screen"), ("transparent", "mesh")])
def test_a_ragged_end_is_cut_before_the_terrain_and_kept_on_a_plate(style, engine):
    rng = np.random.default_rng(0)
    axes = (np.arange(0.6, 2.05, 0.5 * H), np.arange(0.2, 0.6, 0.5 * H), np.arange(0.125, 0.4, 0.5 * H))
    body = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    loose = rng.uniform([2.1, 0.2, 0.12], [2.35, 0.6, 0.3], (60, 3))
    p = np.concatenate([body, loose])
    fluid = Gaussians(p, np.tile([1.0, 0, 0, 0], (len(p), 1)), np.full((len(p), 3), 0.42 * H), np.full(len(p), 0.9),
                      sh_from_rgb(np.full((len(p), 3), 0.5)))  # fmt: skip
    floor = TriangleMesh(np.array([[0, 0, 0.1], [2.4, 0, 0.1], [2.4, 0.8, 0.1], [0, 0.8, 0.1]], float),
                         np.array([[0, 1, 2], [0, 2, 3]]), np.full((4, 3), 0.1))  # fmt: skip
    terrain = Terrain(GRID, (GRID.nodes()[..., 2] - 0.1).astype(np.float32), np.float32([1, 0, 0]), floor)
    camera = PinholeCamera.looking(np.array([2.05, 0.39, 4.0]), np.array([2.05, 0.4, 0.2]), 20.0, (80, 48))
    look, frame = Look(style, "milk", "white"), Frame(fluid, np.zeros_like(p))
    end = OpenEnd.of(cells(), GRID, STREAM)
    assert end is not None
    cut, whole = (Painter(look, terrain, Path(), engine=engine, slab=s) for s in (Slab((end,)), None))
    bare, ragged = (q.picture(frame, camera, Backdrop()).image.mean(axis=-1) for q in (cut, whole))
    right = int(np.floor(camera.project(np.array([[2.05, 0.4, 0.3]]))[0][0, 0]))
    # milk is white, the floor dark; splats stand out by most of their spacing of 0.05 m, some 3 px
    milk = bare[10:38] > 0.5
    assert milk[:, right + 5 :].sum() == 0 < (ragged[10:38, right + 5 :] > 0.5).sum()
    edge = np.array([row.nonzero()[0].max() for row in bare[18:30] > 0.5])
    assert np.ptp(edge) <= 2, edge
    plate = Backdrop(np.zeros((48, 80, 3), np.float32))
    np.testing.assert_array_equal(cut.picture(frame, camera, plate).image, whole.picture(frame, camera, plate).image)


def test_what_lies_behind_the_section_leaves_no_film_beside_it():
    from fluidlift.backends.splashsurf import SplashsurfMesher
    from fluidlift.present.surfacing import surface_of

    # half a cell behind the section liquid stands twice as high as before it
    before = np.meshgrid(np.arange(1.3, 2.05, 0.05), np.arange(0.2, 0.6, 0.05), np.arange(0.125, 0.3, 0.05))
    behind = np.meshgrid(np.arange(2.1, 2.35, 0.05), np.arange(0.2, 0.6, 0.05), np.arange(0.125, 0.5, 0.05))
    p = np.concatenate([np.stack(part, -1).reshape(-1, 3) for part in (before, behind)])
    fluid = Gaussians(p, np.tile([1.0, 0, 0, 0], (len(p), 1)), np.full((len(p), 3), 0.42 * H), np.full(len(p), 0.9),
                      sh_from_rgb(np.full((len(p), 3), 0.5)))  # fmt: skip
    terrain = Terrain(GRID, np.ones(tuple(n + 1 for n in CELLS), np.float32), np.float32([1, 0, 0]), EMPTY)
    end = OpenEnd.of(cells(), GRID, STREAM)
    assert end is not None
    mesh, _ = surface_of(fluid, np.zeros_like(p), terrain, SplashsurfMesher(), clamped=False, ends=(end,))
    # the highest particles lie at 0.275 m, and a surface stands a radius of 0.04 m outside them
    assert mesh.vertices[:, 2].max() < 0.33
