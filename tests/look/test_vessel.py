"""A pour's vessel is glass: it is told from its table, and shows what it holds."""

from collections import Counter
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from fluidlift.backends.mitsuba_renderer import MitsubaRenderer
from fluidlift.backends.mitsuba_scene import FinalScene
from fluidlift.io.scene_look import Look
from fluidlift.look import vessel as glass
from fluidlift.look.environment import Environment
from fluidlift.look.materials import material_named
from fluidlift.look.scenery import terrain_surfels
from fluidlift.look.vessel import pane_share, panes, vessel_apart
from fluidlift.present import looks
from fluidlift.present.looks import Frame, Painter, Quality
from fluidlift.present.without_fluid import Backdrop
from fluidlift.shape.terrain import terrain_mesh
from fluidlift.types import Gaussians, Grid, PinholeCamera, Terrain, TriangleMesh, sh_from_rgb

H = 0.02
"""m, of a cell"""
RADIUS, RIM = 0.12, 0.26
"""m, of the inside of the vessel, and its height"""


@lru_cache
def pour() -> Terrain:
    """A vessel on a table at z = 0, as a pour's ground is made."""
    grid = Grid((28, 28, 20), H, (-0.28, -0.28, -0.06))
    p = grid.nodes()
    wall = np.maximum(np.abs(np.hypot(p[..., 0], p[..., 1]) - (RADIUS + 1.2 * H)) - 1.2 * H, p[..., 2] - RIM)
    phi = np.minimum(p[..., 2], wall).astype(np.float32)
    mesh = terrain_mesh(grid, phi)
    return Terrain(grid, phi, np.float32([0, 0, -1]), TriangleMesh(mesh.vertices, mesh.faces, mesh.colors))


def water() -> Gaussians:
    """Stands in the vessel to 0.12 m."""
    step = 0.5 * H
    axes = (np.arange(-0.13, 0.13, step), np.arange(-0.13, 0.13, step), np.arange(0.5 * step, 0.12, step))
    p = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    p = p[np.hypot(p[:, 0], p[:, 1]) < RADIUS - 0.3 * H]
    p = p + np.random.default_rng(0).normal(0, 0.05 * step, p.shape)
    color = sh_from_rgb(np.tile([0.8, 0.2, 0.1], (len(p), 1)))
    return Gaussians(
        p, np.tile([1.0, 0, 0, 0], (len(p), 1)), np.full((len(p), 3), 0.42 * H), np.full(len(p), 0.9), color
    )


def beside(elevation: float = 0.15) -> PinholeCamera:
    return PinholeCamera.looking(np.array([0.0, -1.0, elevation]), np.array([0.0, 0.0, 0.12]), 24.0, (72, 72))


def test_the_vessel_is_told_from_its_table():
    ground = pour().mesh
    table, vessel = vessel_apart(ground, H)
    assert vessel is not None
    assert table.vertices[np.unique(table.faces)][:, 2].max() < 1e-6
    # the table goes on below the walls: seen from above it has no hole
    points = table.vertices.astype(float)[table.faces]
    across = 0.5 * np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])[:, 2]
    upward = across[across > 0].sum()
    # of 0.56 m a side, or up to a cell less where the mesh ends at the middles of cells
    assert (0.56 - 2 * H) ** 2 < upward < (0.56 + 2 * H) ** 2, upward
    walls = vessel.walls
    edges = Counter((int(a), int(b)) for f in walls.faces for a, b in zip(f, np.roll(f, -1), strict=True))
    assert all(edges[b, a] == n for (a, b), n in edges.items())  # closed
    # two sheets 2.4 cells apart, with a rim and an underside: half of the surface is that of one sheet and a little
    assert 1.9 * H < vessel.thickness < 2.5 * H, vessel.thickness
    middle = walls.vertices[walls.faces[vessel.inner]].mean(axis=1)
    assert np.abs(np.hypot(middle[:, 0], middle[:, 1]) - RADIUS).max() < H
    sheet = vessel.sheet.vertices
    assert np.hypot(sheet[:, 0], sheet[:, 1]).max() > RADIUS + 2 * H and sheet[:, 2].max() > RIM - H


def test_ground_on_which_nothing_stands_stays_as_it_is():
    square = np.float32([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    flat = TriangleMesh(square, np.array([[0, 1, 2], [0, 2, 3]]))
    none = TriangleMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), int))
    upright = TriangleMesh(square[:, [0, 2, 1]], flat.faces)  # nothing of it is level
    for ground in (flat, none, upright):
        found, vessel = vessel_apart(ground, H)
        assert found is ground and vessel is None


def test_the_table_below_the_walls_has_the_colours_around_them():
    ground = pour().mesh
    high = ground.vertices[:, 2:] > 0.5 * H
    painted = TriangleMesh(ground.vertices, ground.faces, np.where(high, [0.0, 0.0, 1.0], [0.6, 0.4, 0.2]))
    table, _ = vessel_apart(painted, H)
    assert table.colors is not None
    shown = table.colors[np.unique(table.faces)]
    np.testing.assert_allclose(shown, np.broadcast_to([0.6, 0.4, 0.2], shown.shape), atol=1e-9)


def test_a_pane_mirrors_what_fresnel_says_of_both_its_surfaces():
    r = ((1.52 - 1) / (1.52 + 1)) ** 2
    # r + (1 - r)^2 r (1 + r^2 + ...), summed term by term
    whole = r + sum((1 - r) ** 2 * r ** (2 * k + 1) for k in range(20))
    assert pane_share(np.ones(1))[0] == pytest.approx(whole, rel=1e-9)
    assert pane_share(np.zeros(1))[0] == pytest.approx(1.0)


def test_clear_glass_in_a_white_world_is_white(monkeypatch):
    monkeypatch.setattr(glass, "TINT", (1.0, 1.0, 1.0))
    _, vessel = vessel_apart(pour().mesh, H)
    assert vessel is not None
    for pane in panes(vessel, beside(0.6), Environment.white()):
        assert (pane.depth > 0).mean() > 0.05
        np.testing.assert_allclose(pane.over(np.ones_like(pane.mirrored)), 1.0, atol=1e-5)


def test_glass_is_darkest_at_its_outline_and_stands_in_the_right_order():
    _, vessel = vessel_apart(pour().mesh, H)
    assert vessel is not None
    near, far = panes(vessel, beside(), Environment.white())
    both = (near.depth > 0) & (far.depth > 0)
    # the camera is 1 m from the axis: one wall before it, the other behind it
    assert both.mean() > 0.1 and near.depth[both].max() < 1.0 < far.depth[36, 36]
    assert near.passes[40, 36].min() > 0.8
    row = near.passes[40, :, 0][near.depth[40] > 0]
    assert row.min() < 0.75 and min(np.argmin(row), len(row) - 1 - np.argmin(row)) < 0.2 * len(row)
    # seen from straight above into its mouth, no wall is before what it holds
    above = PinholeCamera.looking(np.array([0.0, 0.01, 2.0]), np.array([0.0, 0.0, 0.0]), 12.0, (64, 64))
    near, _ = panes(vessel, above, Environment.white())
    assert near.depth[32, 32] == 0


def _drawn(style: str, material: str, kind: str, **more) -> np.ndarray:
    engine = more.pop("engine", "mesh")
    painter = Painter(
        Look(style, material, "white"), pour(), Path(), kind=kind, engine=engine, quality=Quality(samples=16)
    )
    fluid = water()
    return painter.picture(Frame(fluid, np.zeros_like(fluid.means)), beside(), Backdrop(**more)).image


@pytest.mark.parametrize(
    ("style", "engine"),
    [("relit", "mesh"), ("transparent", "mesh"), ("surface", "mesh"), ("surface", "screen"), ("surface", "mitsuba")],
)
def test_what_a_vessel_holds_is_seen_through_its_wall_in_every_look(style, engine):
    held = np.s_[42:50, 28:44]  # pixels of the water, behind the front wall
    for kind, seen in (("pour", True), ("stream", False)):
        milk, dark = (_drawn(style, m, kind, engine=engine)[held].mean() for m in ("milk", "chocolate"))
        # white and brown: their albedos are 0.85 and 0.06; behind ground there is the same ground
        assert (milk > dark + 0.3) == seen, (kind, milk, dark)


def test_a_cut_out_pour_is_not_hidden_by_its_vessel_and_has_no_glass():
    for style in ("relit", "transparent", "surface"):
        painter = Painter(Look(style, "milk", "white"), pour(), Path(), kind="pour")
        fluid = water()
        lit = painter.picture(Frame(fluid, np.zeros_like(fluid.means)), beside(), Backdrop(cut_out=True))
        assert lit.alpha[42:50, 28:44].min() > 0.9
        np.testing.assert_array_equal(lit.image[lit.alpha == 0], 0.0)


def test_other_kinds_never_ask_what_is_glass(monkeypatch):
    before = _drawn("relit", "milk", "stream")

    def refused(*_):
        raise AssertionError("asked for a vessel")

    for name in ("vessel_apart", "panes"):
        monkeypatch.setattr(looks, name, refused)
    np.testing.assert_array_equal(_drawn("relit", "milk", "stream"), before)


def test_the_vessel_of_surfels_lets_light_through():
    whole, thin, none = (terrain_surfels(pour(), glass=g) for g in (None, 0.25, 0.0))
    high = [g.opacities[g.means[:, 2] > 3 * H] for g in (whole, thin, none)]
    assert high[0].min() > 0.9 and len(high[1]) > 100 and len(high[2]) == 0
    np.testing.assert_allclose(high[1], 0.25)
    assert (thin.opacities[thin.means[:, 2] < 0] > 0.9).all()


def test_path_traced_panes_take_no_light_from_a_white_world(monkeypatch):
    monkeypatch.setattr("fluidlift.backends.mitsuba_scene.TINT", (1.0, 1.0, 1.0))

    def square(z: float, half: float) -> TriangleMesh:
        corners = np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])
        return TriangleMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), np.ones((4, 3)))

    none = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    camera = PinholeCamera.looking(np.array([0.0, -1.0, 1.5]), np.zeros(3), 30.0, (24, 16))
    scene = FinalScene(
        none, material_named("water"), camera, np.ones((16, 32, 3)), (square(0.0, 1.0),), (square(0.3, 0.5),),
        samples=256, denoise=False,
    )  # fmt: skip
    # a white floor below a pane: light comes to it through the pane, and through it to the camera. 256 paths of a
    # spread of about 0.3 over 384 pixels
    assert MitsubaRenderer("scalar_rgb").picture(scene).mean() == pytest.approx(1.0, abs=0.01)


def test_a_vessel_that_is_looked_into_is_no_glass():
    terrain = pour()
    assert glass.glass_of("pour", terrain) == glass.GLASS
    opaque = replace(terrain, opaque=True)
    assert glass.glass_of("pour", opaque) is None and glass.glass_of("stream", terrain) is None
    look = Look("surface", "milk", "white")
    clear, hidden = (
        Painter(look, t, Path(), kind="pour").picture(
            Frame(water(), np.zeros_like(water().means)), beside(), Backdrop()
        ).image[42:50, 28:44].mean()
        for t in (terrain, opaque)
    )  # fmt: skip
    assert clear > hidden + 0.3, "milk behind the front wall"
