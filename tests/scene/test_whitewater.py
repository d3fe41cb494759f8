"""White water of a scene: asked for by its film, born where the scene was edited, shown as splats of its own."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage
from small_asset import small_asset
from small_scene import H, striped_channel

from fluidlift.errors import InputRejected
from fluidlift.io.footage_file import write_footage
from fluidlift.io.scene import edits_of
from fluidlift.look.surface_skin import of_skin
from fluidlift.look.whitewater_splats import kinds_of
from fluidlift.pipeline.runner import Runner
from fluidlift.scene.build import edited_scene, whitewater_amount
from fluidlift.scene.simulator import simulator_of
from fluidlift.scene.surface_appearance import SurfaceAppearance
from fluidlift.scene.whitewater import IDS_FROM, Kept, SceneWhitewater, kept_measure, measured
from fluidlift.scene.whitewater_law import carried_cover
from fluidlift.seams import Silence
from fluidlift.types import FluidParameters

FRAMES = 5


def film(path, foam=True):
    """Blue water, with drifting white patches on a sixteenth of it or without."""
    frames = np.full((16, 48, 64, 3), (40, 90, 120), np.uint8)
    for k in range(len(frames) * foam):
        for column in range(0, 64, 16):
            frames[k, 10:22, (column + k) % 60 : (column + k) % 60 + 4] = (225, 232, 235)
    return write_footage(path, frames, np.ones(frames.shape[:3], bool), 0.04)


def edited(lifted):
    """The same with twice the inflow in the middle of its body: fast water runs into slow."""
    body = lifted.body
    fast = (body.positions[:, 0] > 0.3) & (body.positions[:, 0] < 0.7)
    moves = np.where(fast[:, None], np.float32([3.0, 0.0, 0.0]), body.velocities)
    return replace(lifted, body=replace(body, velocities=moves), whitewater=1.0, as_lifted=lifted)


@pytest.fixture(scope="module")
def foaming(tmp_path_factory):
    return striped_channel(FRAMES, film=film(tmp_path_factory.mktemp("film") / "film.mp4"))


@pytest.fixture(scope="module")
def found(foaming):
    """What is measured of it."""
    measure = measured(foaming)
    assert measure is not None
    return measure


def played(scene, white):
    """The appearance, the simulator, and the splats of the last frame."""
    simulator, appearance = simulator_of(scene), SurfaceAppearance(scene, white)
    for k in range(FRAMES):
        if k:
            simulator.advance(scene.interval)
        appearance.advance(simulator.particles, k)
    return appearance, simulator, appearance.dressed(simulator.particles, FRAMES - 1)


def test_white_water_is_born_where_a_scene_was_edited_and_is_no_liquid(foaming, found):
    scene = edited(foaming)
    appearance, _, shown = played(scene, SceneWhitewater(scene, found))
    kinds = kinds_of(shown.gaussians, H)
    assert (kinds >= 0).sum() > 20 and appearance.warnings == ()
    np.testing.assert_array_equal(kinds >= 0, shown.ids >= IDS_FROM)
    assert of_skin(shown.gaussians, H)[kinds >= 0].all()
    assert (shown.ids[kinds >= 0] % 2 == 1).all() and len(np.unique(shown.ids)) == len(shown.ids)
    # in the colour of the film's foam: coding changes it by a few levels
    np.testing.assert_allclose(shown.gaussians.rgb[kinds >= 0].mean(axis=0), np.array([225, 232, 235]) / 255, atol=0.03)
    _, _, bare = played(replace(scene, whitewater=0.0), None)
    np.testing.assert_array_equal(bare.gaussians.means, shown.gaussians.means[kinds < 0])
    np.testing.assert_array_equal(bare.ids, shown.ids[kinds < 0])


def test_the_scene_as_lifted_makes_next_to_none_since_its_film_shows_it(foaming, found):
    assert 0.03 < found.share < 0.08  # a sixteenth, but for what coding blurs
    plain, changed = replace(foaming, whitewater=1.0, as_lifted=foaming), edited(foaming)
    few, many = (played(s, SceneWhitewater(s, found))[2] for s in (plain, changed))
    assert (kinds_of(few.gaussians, H) >= 0).sum() < 0.1 * (kinds_of(many.gaussians, H) >= 0).sum()


def test_everywhere_there_is_white_water_where_the_film_shows_foam(foaming, found):
    assert found.filmed.sum() > 100 and (found.filmed >= 0).all()
    plain = replace(foaming, whitewater=1.0, as_lifted=foaming)
    white = SceneWhitewater(replace(plain, whitewater_everywhere=True), found)
    _, _, shown = played(replace(plain, whitewater_everywhere=True), white)
    born = white.particles
    # what the film shows is there from the first frame on, and goes on being born
    many = found.there.sum() + found.filmed.sum() * (FRAMES - 1) * foaming.interval
    assert born is not None and born.next_id == pytest.approx(many, rel=0.25)
    kinds = kinds_of(shown.gaussians, H)
    column = foaming.terrain.grid.cell_of(shown.gaussians.means[kinds == 1])
    beside = ndimage.maximum_filter(found.filmed, 3)[column[:, 0], column[:, 1]]
    assert (kinds == 1).sum() > 10 and (beside > 0).mean() > 0.9
    # the jerk with which a body begins is known, and makes none
    alone = SceneWhitewater(plain, found)
    played(plain, alone)
    assert alone.particles is not None and alone.particles.next_id < 0.05 * born.next_id


def test_a_film_without_foam_asks_for_none(channel, tmp_path):
    lifted = channel(FRAMES, film=film(tmp_path / "film.mp4", foam=False))
    assert measured(lifted) is None and measured(replace(lifted, film=None)) is None
    scene = edited(lifted)
    white = SceneWhitewater(scene, None)
    assert white.particles is None and white.splats() is None
    _, _, shown = played(scene, white)
    assert (kinds_of(shown.gaussians, H) < 0).all()
    assert [w.code for w in white.warnings] == ["whitewater-not-filmed"]


def test_more_than_the_limit_is_said_once(foaming, found):
    scene = edited(foaming)
    white = SceneWhitewater(scene, replace(found, rate=1e7))
    played(scene, white)
    assert [w.code for w in white.warnings] == ["whitewater-thinned"] and "50000" in white.warnings[0]


def measure_of(scene, folder):
    """As the stage that simulates asks for it."""
    runner = Runner(folder, ("simulate",), progress=Silence())

    def stage(*, work) -> Kept:
        return work.part("whitewater", kept_measure, scene, "cpu")

    return runner.run("simulate", stage).found


def test_a_measure_is_kept_and_read_again(foaming, found, tmp_path, monkeypatch):
    monkeypatch.setattr("fluidlift.scene.whitewater.measured", lambda *_: found)
    first = measure_of(foaming, tmp_path)
    (tmp_path / "work/simulate").rename(tmp_path / "gone")
    monkeypatch.setattr("fluidlift.scene.whitewater.measured", lambda *_: pytest.fail("measured once more"))
    again = measure_of(foaming, tmp_path)
    assert first is not None and again is not None and again is not first
    for name, value in vars(first).items():
        np.testing.assert_array_equal(value, getattr(again, name))


def test_a_broken_measure_is_taken_anew(foaming, found, tmp_path, monkeypatch):
    monkeypatch.setattr("fluidlift.scene.whitewater.measured", lambda *_: found)
    measure_of(foaming, tmp_path)
    (tmp_path / "work/simulate").rename(tmp_path / "gone")
    (file,) = (tmp_path / "work/whitewater").glob("*.npz")
    file.write_bytes(b"no arrays")
    assert measure_of(foaming, tmp_path) is not None and file.stat().st_size > 100


def test_a_state_goes_on_bit_for_bit(foaming, found):
    scene = edited(foaming)
    first, simulator, _ = played(scene, SceneWhitewater(scene, found))
    second = SurfaceAppearance(scene, SceneWhitewater(scene, found))
    second.restore(first.state())
    simulator.advance(scene.interval)
    for one in (first, second):
        one.advance(simulator.particles, FRAMES)
    other = second.state()
    for name, value in first.state().items():
        np.testing.assert_array_equal(value, other[name], err_msg=name)


def test_what_is_born_goes_downstream_with_the_flow():
    births, flow = np.zeros((40, 10)), np.zeros((40, 10, 2))
    births[5, 5], flow[..., 0] = 1.0, 0.5
    cover = carried_cover(births, flow, 0.1, 1.45, 1.0)
    # 0.5 m/s over 1.45 s are 7 cells
    assert cover[6:11, 5].min() > 0 and cover[14:, 5].max() == 0 and cover[:4].max() == 0
    still = carried_cover(births, 0 * flow, 0.1, 1.45, 1.0)
    assert still.sum() == pytest.approx(cover.sum(), rel=0.1)


# how much is asked for ------------------------------------------------------------------------------------------


def test_there_is_as_much_as_is_asked_for(channel):
    scene = channel(2)
    assert whitewater_amount(scene, 0.0) == 0.0 and whitewater_amount(scene, 2.0) == 2.0


@pytest.mark.parametrize("kind, viscosity", [("plume", 1e-5), ("stream", 7e-3)], ids=["smoke", "honey"])
def test_smoke_and_honey_refuse_it(channel, kind, viscosity):
    thick = FluidParameters(kinematic_viscosity=viscosity)
    scene = channel(2, kind=kind, parameters=thick, changes=("kinematic_viscosity",))
    assert whitewater_amount(scene, 0.0) == 0.0
    with pytest.raises(InputRejected, match=r"whitewater.amount 1 of a (gas|liquid)"):
        whitewater_amount(scene, 1.0)


def test_the_dial_is_read_and_checked(tmp_path):
    assert edits_of("whitewater:\n  amount: 0.5\n", tmp_path).whitewater == 0.5
    assert not edits_of("whitewater: {amount: 1}\n", tmp_path).whitewater_everywhere
    assert edits_of("whitewater: {amount: 1, everywhere: true}\n", tmp_path).whitewater_everywhere
    assert edits_of("whitewater:\n", tmp_path).whitewater == 0.0
    for wrong in ("everywhere: 3", "amount: -1", "amount: 1e9", "amount: much", "ammount: 1"):
        with pytest.raises(InputRejected, match="line 2"):
            edits_of(f"whitewater:\n  {wrong}\n", tmp_path)


def test_an_edit_of_the_dial_makes_the_simulation_stale_and_no_other_part(tmp_path):
    asset = small_asset()
    parts = [edited_scene(asset, edits_of(text, tmp_path)).parts for text in ("", "whitewater: {amount: 2}\n")]
    assert parts[1].keys() - parts[0].keys() == {"white water"}
    assert all(parts[1][name] == value for name, value in parts[0].items())
