"""Waves in pictures and meshes of a finished asset: asked for in scene.yaml, said where there are none."""

from __future__ import annotations

import json
import shutil

import cv2
import numpy as np
import pytest

from fluidlift.backends.splashsurf import SplashsurfMesher
from fluidlift.cli import DONE, WITH_WARNINGS, main
from fluidlift.io.ply_records import read_elements
from fluidlift.look.wave_spectrum import FilmedWaves
from fluidlift.scene import waves as of_scene

LOOK = ("--look", "surface", "--engine", "screen", "--draft", "--background", "terrain", "--frames", "1002-1002")


@pytest.fixture
def asked(made, tmp_path):
    """An asset whose scene.yaml asks for waves."""
    folder = shutil.copytree(made.folder, tmp_path / "asked.fluid")
    with (folder / "scene.yaml").open("a", encoding="utf-8") as scene:
        scene.write("\nwaves: {amount: 1}\n")
    return folder


@pytest.fixture
def filmed(monkeypatch):
    """As if its film showed waves."""
    found = FilmedWaves(np.array([[0.0, 3.0], [2.0, 2.0]]), np.array([0.01, 0.01]), np.zeros(2, bool), 0.5, (0.5, 2.0))
    monkeypatch.setattr(of_scene, "filmed_waves", lambda scene: found)


def done(command, *options) -> bool:
    return main([command, *map(str, options)]) in (DONE, WITH_WARNINGS)


def picture(folder):
    found = cv2.imread(str(folder / "1002.png"), cv2.IMREAD_UNCHANGED)
    assert found is not None
    return found.astype(int)


@pytest.fixture
def meshed_once(monkeypatch):
    """The same surface for the same particles: the mesher gives vertices in the order in which its threads end, those
    between two of its blocks with another last bit."""
    found, surface = {}, SplashsurfMesher.surface

    def once(self, positions, radius, attributes):
        values = tuple((name, np.asarray(value).tobytes()) for name, value in attributes.items())
        asked = (np.asarray(positions).tobytes(), radius, values)
        if asked not in found:
            found[asked] = surface(self, positions, radius, attributes)
        return found[asked]

    monkeypatch.setattr(SplashsurfMesher, "surface", once)
    return found


def mesh(folder, number=1002):
    """Places and velocities of vertices."""
    table = read_elements(folder / f"{number}.ply")[0]["vertex"]
    return tuple(np.stack([table[a] for a in names], axis=1) for names in ("xyz", ("vx", "vy", "vz")))


def test_a_picture_shows_them_the_same_each_time(made, asked, filmed, tmp_path):
    for name, folder in (("bare", made.folder), ("one", asked), ("two", asked)):
        assert done("render", folder, "-o", tmp_path / name, *LOOK)
    bare, one, two = (picture(tmp_path / name) for name in ("bare", "one", "two"))
    np.testing.assert_array_equal(one, two)
    assert (np.abs(one - bare).max(axis=-1) > 3).mean() > 0.01


def test_what_the_film_shows_is_told_in_numbers(asked, filmed, tmp_path, capsys):
    mesh_of_one = ("export", asked, "-o", tmp_path / "mesh", "--to", "obj", "--frames", "1001-1001")
    for command in (("render", asked, "-o", tmp_path / "one", *LOOK), mesh_of_one):
        assert done(*command, "--json")
        told = json.loads(capsys.readouterr().out)["waves"]
        assert told["wavelength"] == pytest.approx(2 * np.pi / np.mean([3.0, np.sqrt(8.0)]), rel=1e-3)
        assert told["slope"] == pytest.approx(np.sqrt(0.02), rel=1e-3)
        assert told["slope_range"] == pytest.approx([0.5 * told["slope"], 2 * told["slope"]], rel=1e-3)
        assert told["standing"] == 0.0 and told["carried"] is True


def test_other_looks_know_nothing_of_them(made, asked, filmed, tmp_path):
    for name, folder in (("bare", made.folder), ("one", asked)):
        assert done("render", folder, "-o", tmp_path / name, "--frames", "1002-1002")
    np.testing.assert_array_equal(picture(tmp_path / "bare"), picture(tmp_path / "one"))


def test_a_clip_that_shows_none_has_none_and_it_is_said(made, asked, tmp_path, capsys):
    assert done("render", made.folder, "-o", tmp_path / "bare", *LOOK)
    capsys.readouterr()
    assert done("render", asked, "-o", tmp_path / "one", *LOOK, "--json")
    told = json.loads(capsys.readouterr().out)
    assert "waves-not-filmed" in told["warning_codes"]
    np.testing.assert_array_equal(picture(tmp_path / "bare"), picture(tmp_path / "one"))
    assert done("export", asked, "-o", tmp_path / "mesh", "--to", "mesh", "--frames", "1001-1001", "--json")
    assert "waves-not-filmed" in json.loads(capsys.readouterr().out)["warning_codes"]
    assert done("export", asked, "-o", tmp_path / "splats", "--to", "splats", "--frames", "1001-1001", "--json")
    assert "waves-not-filmed" not in json.loads(capsys.readouterr().out)["warning_codes"]


def test_meshes_have_them_with_their_motion(made, asked, filmed, meshed_once, tmp_path):
    for name, folder, frames in (("bare", made.folder, "1002-1002"), ("one", asked, "1001-1003"),
                                 ("two", asked, "1002-1002")):  # fmt: skip
        assert done("export", folder, "-o", tmp_path / name, "--to", "mesh", "--frames", frames)
    assert len(meshed_once) == 3  # of the same particles, waves or none
    (bare, still), (one, moving), (two, _) = (mesh(tmp_path / name) for name in ("bare", "one", "two"))
    np.testing.assert_array_equal(one, two)  # a frame's waves are those of its time, whatever else is written
    np.testing.assert_array_equal(one[:, :2], bare[:, :2])
    raised = np.abs(one[:, 2] - bare[:, 2])
    assert 0.001 < raised.max() < 0.2 and (raised == 0).any()
    assert np.abs(moving[:, 2] - still[:, 2]).max() > 0.001
