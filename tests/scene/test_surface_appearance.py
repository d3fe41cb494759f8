"""What frames look like: splats that move with their particles, and a skin over what lies."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from fluidlift.errors import InputRejected
from fluidlift.look.surface_map import SurfaceMap
from fluidlift.numerics.sampling import sample_nodes
from fluidlift.scene.simulator import simulator_of
from fluidlift.scene.surface_appearance import CLEAR, FAINT, SurfaceAppearance, levelled
from fluidlift.types import FluidParameters, sh_from_rgb

FRAMES = 6


def played(scene, frames: int = FRAMES, appearance: SurfaceAppearance | None = None):
    """SurfaceAppearance and particles at the last frame."""
    simulator, appearance = simulator_of(scene), SurfaceAppearance(scene) if appearance is None else appearance
    for k in range(frames):
        if k:
            simulator.advance(scene.interval)
        appearance.advance(simulator.particles, k)
    return appearance, simulator.particles


def test_the_first_frame_is_the_body_as_it_was_lifted(channel):
    scene = channel(2)
    appearance, p = played(scene, 1)
    shown = appearance.dressed(p, 0)
    np.testing.assert_array_equal(shown.gaussians.means, p.positions)
    np.testing.assert_array_equal(shown.gaussians.sh, scene.rest.sh[p.source])
    np.testing.assert_array_equal(shown.ids, 2 * p.ids)


def test_later_frames_hold_all_particles_and_the_skin_over_them(channel):
    appearance, p = played(channel(FRAMES))
    shown = appearance.dressed(p, FRAMES - 1)
    skin = shown.ids % 2 == 1
    np.testing.assert_array_equal(np.sort(shown.ids[~skin]), np.sort(2 * p.ids))
    np.testing.assert_array_equal(shown.velocities[~skin], p.velocities)
    assert skin.sum() > 500 and len(np.unique(shown.ids)) == len(shown.ids)
    tracers = shown.gaussians.means[skin]
    assert cKDTree(p.positions).query(tracers)[0].max() < 0.1, "on particles, by less than a cell"
    beside = cKDTree(p.positions[:, :2]).query_ball_point(tracers[:, :2], 0.05)
    buried = [p.positions[i, 2].max(initial=0.0) - z for i, z in zip(beside, tracers[:, 2])]
    assert np.quantile(buried, 0.95) < 0.05, "at the top of their columns, within half a cell"
    # what is just below it is not drawn, but is there
    covered = shown.gaussians.opacities[~skin] < 2 * FAINT
    assert 0.2 < covered.mean() < 0.8 and (shown.gaussians.opacities > 0).all()
    np.testing.assert_allclose(shown.velocities[skin][:, 0].mean(), 0.6, rtol=0.2)


def test_how_many_splats_a_frame_has_is_known_before_it_is_simulated(channel):
    for scene in (channel(FRAMES), channel(FRAMES, kind="fall")):
        expected = SurfaceAppearance(scene).splats
        appearance, p = played(scene, 3)
        assert expected == pytest.approx(len(appearance.dressed(p, 2).ids), rel=0.1)


def test_what_falls_or_rises_and_what_is_turned_on_its_side_has_no_skin(channel):
    turned = channel(FRAMES, parameters=FluidParameters(inflow_velocity=(0.6, 0.0, 0.0), gravity=(0.0, 9.81, 0.0)))
    for scene in (channel(FRAMES, kind="fall"), turned):
        appearance, p = played(scene, 3)
        assert len(appearance.dressed(p, 2).ids) == len(p) and appearance.state() == {}


def test_without_a_skin_the_deformed_splats_are_all_there_is(channel):
    scene = replace(channel(FRAMES), skin=False)
    appearance, p = played(scene)
    shown = appearance.dressed(p, FRAMES - 1)
    np.testing.assert_array_equal(shown.ids, 2 * p.ids)
    np.testing.assert_array_equal(shown.gaussians.means, p.positions)
    assert appearance.state() == {} and scene.cache_key != channel(FRAMES).cache_key


def test_skin_and_splats_stay_out_of_the_ground(channel):
    scene = channel(FRAMES)
    nodes, grid = scene.terrain.grid.nodes(), scene.terrain.grid
    rock = np.linalg.norm(nodes - [0.6, 0.4, 0.15], axis=-1) - 0.22
    terrain = replace(scene.terrain, signed_distance=np.minimum(scene.terrain.signed_distance, rock).astype(np.float32))
    scene = replace(scene, terrain=terrain)
    appearance, p = played(scene)
    shown = appearance.dressed(p, FRAMES - 1)
    g = shown.gaussians
    room = sample_nodes(terrain.signed_distance, grid, g.means)
    skin = shown.ids % 2 == 1
    assert room[skin].min() > CLEAR * 0.1
    beside = (~skin) & (room < 0.05)
    assert beside.sum() > 20 and (g.scales[beside].max(axis=1) < 0.5 * (room[beside].clip(0) + 0.011)).all()


def test_dye_shows_through_the_skin(channel):
    """Half of the body brings a colour of its own."""
    scene = channel(FRAMES)
    dyed = scene.rest.means[:, 1] > 0.4
    sh = np.where(dyed[:, None, None], sh_from_rgb(np.array([[1.0, 0.0, 0.0]])), scene.rest.sh)
    painted = np.where(dyed[:, None], np.nan, scene.rest.means)
    appearance, p = played(replace(scene, rest=replace(scene.rest, sh=sh.astype(np.float32)), painted=painted))
    shown = appearance.dressed(p, FRAMES - 1)
    skin = shown.ids % 2 == 1
    rgb, y = shown.gaussians.rgb[skin], shown.gaussians.means[skin, 1]
    inner = shown.gaussians.means[skin, 0] > 0.4  # what has come in since is another matter
    assert np.ptp(rgb[inner & (y > 0.5)], axis=1).mean() > 0.7


def test_a_dressing_goes_on_where_another_one_stopped(channel):
    scene = channel(FRAMES)
    simulator, first = simulator_of(scene), SurfaceAppearance(scene)
    for k in range(3):
        if k:
            simulator.advance(scene.interval)
        first.advance(simulator.particles, k)
    second = SurfaceAppearance(scene)
    second.restore(first.state())
    simulator.advance(scene.interval)
    for appearance in (first, second):
        appearance.advance(simulator.particles, 3)
    one, two = (d.dressed(simulator.particles, 3) for d in (first, second))
    np.testing.assert_array_equal(one.gaussians.means, two.gaussians.means)
    np.testing.assert_array_equal(one.gaussians.sh, two.gaussians.sh)
    np.testing.assert_array_equal(one.ids, two.ids)


def test_the_first_frame_starts_it_afresh(channel):
    scene = channel(FRAMES)
    appearance, _ = played(scene, 3)
    again, p = played(scene, FRAMES, appearance)
    fresh, q = played(scene, FRAMES)
    np.testing.assert_allclose(p.positions, q.positions, atol=1e-5)  # sums of two threads
    assert abs(len(again.dressed(p, 5).ids) - len(fresh.dressed(q, 5).ids)) < 0.02 * len(p)
    assert again.state()["skin.next_id"] == pytest.approx(fresh.state()["skin.next_id"], rel=0.02)


@pytest.mark.parametrize("fault", ["missing", "shape", "infinite"])
def test_a_state_that_does_not_fit_changes_nothing(channel, fault):
    appearance, _ = played(channel(FRAMES), 2)
    before, state = appearance.state(), appearance.state()
    if fault == "missing":
        del state["skin.places"]
    elif fault == "shape":
        state["patches.turns"] = np.zeros(1)
    else:
        state["patches.centers"] = state["patches.centers"] * np.inf
    with pytest.raises(InputRejected, match="state of a surface"):
        appearance.restore(state)
    after = appearance.state()
    assert before.keys() == after.keys()
    for name, array in before.items():
        np.testing.assert_array_equal(after[name], array, err_msg=name)


def test_there_is_no_skin_in_an_obstacle(channel):
    appearance, p = played(channel(FRAMES))
    shown = appearance.dressed(p, FRAMES - 1, lambda points: np.hypot(points[:, 0] - 0.6, points[:, 1] - 0.4) < 0.15)
    away = np.hypot(*(shown.gaussians.means[:, :2] - [0.6, 0.4]).T)
    skin = shown.ids % 2 == 1
    assert (away[skin] >= 0.15).all() and (away[skin] < 0.2).any()


def test_a_calm_surface_is_level_and_a_splash_stands_out():
    wet, rest = np.ones((3, 1), bool), np.zeros((3, 1))
    heights = rest + [[0.04], [-0.08], [0.5]]
    found = levelled(SurfaceMap(np.zeros(2), 0.1, wet, heights + 2.0, np.zeros((3, 1, 3))), 2.0, 0.1)
    np.testing.assert_allclose(found.height[:, 0], [2.0, 2.0, 2.4])
