"""What is put into the 3D view, with a scene that only notes it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fluidlift.io.asset_folder import load_asset
from fluidlift.io.obstacles import Obstacle
from fluidlift.look.surface_skin import PITCH, THICKNESS, WIDTH
from fluidlift.numerics.solid_mesh import box_mesh
from fluidlift.types import Gaussians, TriangleMesh, concatenate
from fluidlift.viewer.arrows import LONGEST, SHORTEST, arrows, barbed
from fluidlift.viewer.frames import splat_frame
from fluidlift.viewer.stage import Stage, VisibleLayers, vertical_fov, whole_fov

TURN = np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
"""a quarter about z"""


class Notes:
    """Stands in for viser's scene."""

    def __init__(self):
        self.nodes = {}

    def __getattr__(self, kind):
        def add(name, *parts, **options):
            node = SimpleNamespace(kind=kind, parts=parts, **options)
            node.remove = lambda: self.nodes.pop(name)
            self.nodes[name] = node
            return node

        return add


@pytest.fixture
def stage(tmp_path, finished_tank):
    return Stage(SimpleNamespace(scene=Notes()), tmp_path, load_asset(finished_tank))


def obstacle(colors=None):
    mesh = box_mesh((0.1, 0.1, 0.1))
    return Obstacle("box", TriangleMesh(mesh.vertices, mesh.faces, colors), (0.3, 0.2, 0.1), TURN)


def shown(stage, *found, **more):
    stage.obstacles(found, None, VisibleLayers(), **more)
    return stage._scene.nodes["/obstacles/box"]


def test_a_page_that_looks_from_the_clips_camera_shows_its_whole_picture_until_it_is_turned_away(stage):
    camera, heard = stage._asset.camera, []
    view = SimpleNamespace(aspect=0.8, position=np.asarray(camera.position, float), fov=0.0, on_update=heard.append)
    half = 0.5 * np.asarray(camera.size) / camera.focal  # tangents, right and down
    stage.keep_whole(SimpleNamespace(camera=view))
    assert np.tan(0.5 * view.fov) * view.aspect == pytest.approx(half[0])  # narrower than the clip: its width fits
    view.aspect = 3.0  # the window is drawn wider
    heard[0](view)
    assert view.fov == pytest.approx(vertical_fov(camera)) and np.tan(0.5 * view.fov) == pytest.approx(half[1])
    view.aspect, view.position = 0.5, view.position + 1.0  # looked at from elsewhere, the view is left alone
    heard[0](view)
    assert view.fov == pytest.approx(vertical_fov(camera)) and whole_fov(camera, 0.5) > view.fov


def test_an_obstacle_of_one_colour_has_it_and_one_without_is_marked_while_it_is_edited(stage):
    count = len(box_mesh((1, 1, 1)).vertices)
    assert shown(stage, obstacle(np.tile([1.0, 0.8, 0.1], (count, 1)))).color == (255, 204, 26)
    assert shown(stage, obstacle(np.tile([0.0, 0.0, 1.0], (count, 1)))).color == (0, 0, 255)  # painted anew
    plain = shown(stage, obstacle()).color
    assert shown(stage, obstacle(), chosen="box").color != plain


def test_an_obstacle_of_many_colours_arrives_with_them_in_its_pose(stage):
    colors = np.random.default_rng(0).uniform(size=(len(box_mesh((1, 1, 1)).vertices), 3))
    node = shown(stage, obstacle(colors))
    assert node.kind == "add_glb" and node.parts[0][:4] == b"glTF"
    # the y axis of glTF is our z, and the quarter turn leaves that where it is
    up = Rotation.from_quat(node.wxyz, scalar_first=True).apply([0, 1, 0])
    np.testing.assert_allclose(up, [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(node.position, [0.3, 0.2, 0.1])


def test_nothing_without_points_is_put_into_the_view(stage):
    empty = splat_frame(Gaussians.isotropic(np.zeros((0, 3)), 0.1, np.zeros((0, 3))), np.zeros((0, 3), np.float32))
    before = set(stage._scene.nodes)
    stage._scene.get_handle_by_name = lambda name: None
    stage.show(empty, VisibleLayers(points=True, arrows=True), 0.1)
    assert set(stage._scene.nodes) == before


def test_the_surface_is_meshed_around_the_liquid_without_the_skin_that_is_painted_on_it(stage):
    cell, body = 0.05, np.random.default_rng(0).uniform(size=(5, 3))
    paint = Gaussians.isotropic(np.ones((3, 3)), 1.0, np.full((3, 3), 0.5))
    skin = replace(paint, scales=np.tile(cell * np.array([WIDTH * PITCH, WIDTH * PITCH, THICKNESS]), (3, 1)))
    splats = concatenate([Gaussians.isotropic(body, 0.02, np.full((5, 3), 0.5)), skin])
    asked = []
    stage._surfacer = SimpleNamespace(ask=lambda *wish: asked.append(wish), made=None)
    stage.show(splat_frame(splats, np.zeros((8, 3)), cell=cell), VisibleLayers(splats=False, surface=True), cell)
    ((_, positions, _),) = asked
    np.testing.assert_allclose(positions, body)


def block(velocity):
    """A block of water one metre wide, under way at some velocity where x is above a half, and half of it elsewhere."""
    at = np.stack(np.meshgrid(*[np.linspace(0, 1, 20)] * 3, indexing="ij"), -1).reshape(-1, 3)
    share = np.where(at[:, :1] > 0.5, 1.0, 0.5)
    return splat_frame(Gaussians.isotropic(at, 0.02, np.full((8000, 3), 0.5)), (share * velocity).astype(np.float32))


def test_arrows_stand_outside_the_fluid_along_its_velocity_and_tell_the_speed_by_colour_and_length():
    ends, colors = arrows(block([2.0, 0.0, 0.0]), 1.0)
    along = ends[:, 1] - ends[:, 0]
    np.testing.assert_allclose(along[:, 1:], 0, atol=1e-9)
    inside = ((ends[:, 0] > 0.1) & (ends[:, 0] < 0.9)).all(axis=1)
    assert not inside.any() and (ends[:, 0, 2] > 1.0).sum() > 100  # above the upper side
    fast = ends[:, 0, 0] > 0.6
    # the means of blocks that lie across the step in speed are between the two
    np.testing.assert_allclose(along[fast, 0], LONGEST, rtol=1e-6)
    assert along[ends[:, 0, 0] < 0.4, 0] == pytest.approx(0.5 * (LONGEST + SHORTEST), rel=1e-6)
    assert (colors[fast] == [255, 235, 60]).all() and (colors[ends[:, 0, 0] < 0.4] == [225, 60, 100]).all()


def test_a_frame_at_rest_has_no_arrows():
    assert arrows(block([0.0, 0.0, 0.0]), 1.0) is None


@pytest.mark.parametrize("way", [(1.0, 0, 0), (0, 0, -1.0), (0.6, -0.64, 0.48)])
def test_an_arrow_is_a_shaft_and_four_barbs_that_lie_behind_its_tip_and_around_its_axis(way):
    tail, way = np.array([0.3, 0.2, 0.1]), np.array(way)
    lines, colors = barbed(np.stack([tail, tail + way])[None], np.array([[1, 2, 3]], np.uint8), 0.1)
    assert lines.shape == (5, 2, 3) and (colors == [1, 2, 3]).all()
    np.testing.assert_allclose(lines[0], [tail, tail + way])
    barbs = lines[1:, 1] - (tail + way)
    np.testing.assert_allclose(barbs @ way, -0.1)
    across = barbs - (barbs @ way)[:, None] * way
    np.testing.assert_allclose(np.linalg.norm(across, axis=1), 0.04)
    np.testing.assert_allclose(across.sum(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(across[0] @ across[2], 0, atol=1e-12)
