"""Waves of a scene: those of its film, on the current of its frames; a reason where there are none."""

from dataclasses import replace

import numpy as np
import pytest
from made_waves import MadeWaves, brightness
from small_scene import H, striped_channel

from fluidlift.errors import InputRejected
from fluidlift.io.footage_file import write_footage
from fluidlift.io.scene import MOST_WAVES, edits_of
from fluidlift.look.wave_relief import WaveRelief
from fluidlift.look.wave_spectrum import FilmedWaves
from fluidlift.messages import Notice
from fluidlift.numerics.srgb import srgb_from_linear
from fluidlift.scene import waves as of_scene
from fluidlift.scene.waves import filmed_waves, medium_of, played_waves, surface_of_body
from fluidlift.types import PinholeCamera

STEP, CURRENT = 0.04, (0.6, 0.0)
CAMERA = PinholeCamera.looking((-1.0, 0.4, 0.85), (0.6, 0.4, 0.25), fov_degrees=40.0, size=(192, 128))
"""along the channel of 1.2 x 0.8 m"""
FILMED = FilmedWaves(np.array([[40.0, 0.0]]), np.array([0.01]), np.array([False]), 2.0, (0.5, 2.0))


def film(path, waves, scene, frames=90):
    """What the camera sees of the channel's surface under a uniform sky, with noise of a level."""
    level = float(np.median(surface_of_body(scene).height))
    rays, rng = CAMERA.rays(CAMERA.pixel_grid()), np.random.default_rng(0)
    down = np.minimum(rays[..., 2], -1e-3)
    places = CAMERA.position[:2] + ((level - CAMERA.position[2]) / down)[..., None] * rays[..., :2]
    across = np.linalg.norm(rays[..., :2], axis=-1)
    water = ((places > 0) & (places < [1.2, 0.8])).all(axis=-1)
    towards = 0.0 if waves is None else waves.towards(places, rays[..., :2] / across[..., None], STEP, frames)
    rgb = srgb_from_linear(
        (brightness(np.arctan2(across, -down), towards) + np.zeros((frames, 1, 1))).astype(np.float32)
    )
    pictures = np.clip(np.rint(255 * rgb + rng.normal(size=rgb.shape)), 0, 255).astype(np.uint8)
    return write_footage(path, pictures[..., None].repeat(3, -1), np.broadcast_to(water, rgb.shape), STEP)


@pytest.fixture(scope="module")
def channel_with(tmp_path_factory):
    def made(waves):
        scene = striped_channel(6, camera=CAMERA)
        folder = tmp_path_factory.mktemp("film")
        return replace(scene, film=film(folder / "film.mp4", waves, scene))

    return made


def test_a_film_with_waves_gives_them(channel_with):
    made = MadeWaves.running(0.12, 0.06, CURRENT, 0.0, medium_of(striped_channel(2), 0.2), seed=3)
    found = filmed_waves(channel_with(made))
    assert isinstance(found, FilmedWaves)
    assert found.wavelength() == pytest.approx(0.12, rel=0.2)
    assert found.slope_variance == pytest.approx(0.06**2, rel=0.5)  # of the one window that fits


def test_a_film_of_smooth_water_gives_a_reason(channel_with):
    found = filmed_waves(channel_with(None))
    assert isinstance(found, Notice) and found.code == "waves-not-filmed"


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"film": None}, "no film"),
        ({"kind": "fall"}, "a fall"),
        ({"kind": "plume"}, "a plume"),
        ({"kind": "pour"}, "a pour"),
    ],
    ids=["no film", "fall", "smoke", "pour"],
)
def test_what_has_no_film_or_no_level_surface_has_none(change, told):
    found = filmed_waves(striped_channel(2, **change))
    assert isinstance(found, Notice) and found.code == "waves-not-filmed" and told in found


def test_a_film_that_cannot_be_read_gives_a_reason(tmp_path):
    (tmp_path / "film.mp4").write_bytes(b"no film")
    found = filmed_waves(striped_channel(2, film=tmp_path / "film.mp4"))
    assert isinstance(found, Notice) and "cannot be read" in found


def frames(scene, speed):
    moving = np.zeros(scene.body.positions.shape, np.float32)
    moving[:, 0] = speed
    return [(scene.body.positions, moving)] * 3


def played(monkeypatch, filmed: FilmedWaves | Notice = FILMED, speed=0.6, **changed):
    monkeypatch.setattr(of_scene, "filmed_waves", lambda scene: filmed)
    lifted = striped_channel(6)
    scene = replace(lifted, **changed)
    return played_waves(scene, lifted, frames(scene, speed), 1.0)


def test_they_run_on_the_mean_current_of_the_frames_over_its_depth(monkeypatch):
    found = played(monkeypatch, speed=0.9)
    assert isinstance(found, WaveRelief)
    middle = found.current[tuple(n // 2 for n in found.growth.shape)]
    assert middle == pytest.approx([0.9, 0.0], abs=0.02)
    assert found.medium.depth == pytest.approx(0.2, abs=H)
    assert found.medium.tension == pytest.approx(7.28e-5, rel=0.01)
    assert (found.growth == 1.0).all()  # nobody edited it


def test_without_frames_they_run_on_the_lifted_current(monkeypatch):
    monkeypatch.setattr(of_scene, "filmed_waves", lambda scene: FILMED)
    lifted = striped_channel(6)
    found = played_waves(lifted, lifted, [], 1.0)
    assert isinstance(found, WaveRelief)
    assert found.current[tuple(n // 2 for n in found.growth.shape)] == pytest.approx([0.6, 0.0], abs=0.02)


def test_in_an_edited_scene_they_grow_with_the_current(monkeypatch):
    found = played(monkeypatch, speed=0.9, changes=("inflow_velocity",))
    assert isinstance(found, WaveRelief)
    middle = tuple(n // 2 for n in found.growth.shape)
    assert found.growth[middle] == pytest.approx((0.95 / 0.65) ** 2, rel=0.05)


def test_crests_that_were_taken_for_a_current_run_on_water_at_rest(monkeypatch):
    found = played(monkeypatch, replace(FILMED, carried=False), changes=("inflow_velocity",))
    assert isinstance(found, WaveRelief)
    assert (found.current == 0.0).all() and (found.growth == 1.0).all()


def test_a_reason_is_passed_on(monkeypatch):
    reason = Notice("waves-not-filmed", "no waves are shown: why")
    assert played(monkeypatch, reason) is reason


def test_the_dial_in_scene_yaml(tmp_path):
    assert edits_of("", tmp_path).waves == 0.0
    assert edits_of("waves: {amount: 2.5}", tmp_path).waves == 2.5
    for wrong in (f"{{amount: {2 * MOST_WAVES}}}", "{amount: -1}", "{amount: high}", "{height: 1}"):
        with pytest.raises(InputRejected, match=r"waves|amount"):
            edits_of(f"waves: {wrong}", tmp_path)
