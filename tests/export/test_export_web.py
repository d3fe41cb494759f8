"""A finished asset for the web and for compositing: glTF, SPZ, the page, and what the clip showed."""

import json
import shutil

import numpy as np
import pytest
import trimesh
from PIL import Image

from fluidlift.cli import DONE, REJECTED, WITH_WARNINGS, main
from fluidlift.errors import InputRejected
from fluidlift.export import ExportRequest, export_asset, page
from fluidlift.export.job import every
from fluidlift.export.page import thinned
from fluidlift.io.asset_folder import load_asset
from fluidlift.io.flow_files import UNKNOWN, read_flo
from fluidlift.io.ply import read_splats
from fluidlift.io.spz import read_spz
from fluidlift.io.views import read_view
from fluidlift.look.rasterize import render
from fluidlift.messages import code_of
from fluidlift.present.looping import FAINTEST
from fluidlift.scene.splat_files import read_frame
from fluidlift.types import Gaussians, PinholeCamera

WELL = (DONE, WITH_WARNINGS)


def export(made, out, *options):
    return main(["export", str(made.folder), "-o", str(out), *options])


def frame(made, number: int):
    return read_frame(made.folder / "frames" / "splats" / f"{number}.flsp")


def names(folder) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


@pytest.fixture
def copy(made, tmp_path):
    """The asset, to be spoilt."""
    shutil.copytree(made.folder, tmp_path / "copy.fluid")
    return tmp_path / "copy.fluid"


@pytest.mark.parametrize("axis", ["z", "y"])
def test_splat_files_of_either_axis_show_the_same_picture(made, tmp_path, axis):
    assert export(made, tmp_path / "out", "--to", "splats", "--up-axis", axis, "--frames", "1002-1002") in WELL
    camera = load_asset(made.folder).camera
    back = read_splats(tmp_path / "out" / "1002.ply").gaussians
    # the same numbers, turned there and back in single precision
    np.testing.assert_allclose(render(back, camera).image, render(frame(made, 1002).gaussians, camera).image, atol=2e-3)


def test_spz_frames_show_the_same_picture_in_a_fraction_of_the_size(made, tmp_path):
    assert export(made, tmp_path / "out", "--to", "spz", "--frames", "1001-1002") in WELL
    assert names(tmp_path / "out") == ["1001.spz", "1002.spz"]
    camera, own = load_asset(made.folder).camera, frame(made, 1002).gaussians
    error = render(read_spz(tmp_path / "out" / "1002.spz"), camera).image - render(own, camera).image
    assert -10 * np.log10((error**2).mean()) > 45  # colours in steps of 1/135, scales of 6 %
    assert (tmp_path / "out" / "1002.spz").stat().st_size < 84 * len(own) / 4  # of a PLY


def test_gltf_holds_the_middle_frame_with_its_ground(made, tmp_path, capsys):
    assert export(made, tmp_path / "out", "--to", "gltf", "--frames", "1001-1003", "--json") in WELL
    told = json.loads(capsys.readouterr().out)
    assert (told["frames"], told["first"], told["up_axis"]) == (1, 1002, "y")
    assert names(tmp_path / "out") == ["hero.glb", "surface.glb"]
    scene = trimesh.load(tmp_path / "out" / "surface.glb", process=False)
    own, terrain = frame(made, 1002).gaussians, load_asset(made.folder).terrain.mesh
    low, high = scene.geometry["surface"].bounds
    x, y, z = own.means.T
    inner = np.percentile(np.stack([x, z, -y], axis=1), [2, 98], axis=0)  # y up
    assert (low < inner[0]).all() and (high > inner[1]).all()
    assert len(scene.geometry["terrain"].faces) == len(terrain.faces)


def test_the_page_is_one_file_of_the_name_that_was_given(made, tmp_path, capsys):
    assert export(made, tmp_path / "river.html", "--to", "html", "--frames", "1001-1003", "--json") in WELL
    told = json.loads(capsys.readouterr().out)
    assert told["bytes"] == (tmp_path / "river.html").stat().st_size and told["frames"] == 3
    assert names(tmp_path) == ["river.html"]
    assert (tmp_path / "river.html").read_text(encoding="utf-8").count('class="frame"') == 3


def test_a_page_that_grows_too_large_leaves_out_frames_then_splats_and_says_so(made, tmp_path, monkeypatch):
    whole = export_asset(made.folder, tmp_path / "a.html", ExportRequest("html"))
    assert whole.warnings == ()
    monkeypatch.setattr(page, "MOST_BYTES", whole.facts["bytes"] / 3)
    monkeypatch.setattr(page, "FEWEST", 100)
    small = export_asset(made.folder, tmp_path / "b.html", ExportRequest("html"))
    assert small.facts["bytes"] < 0.75 * whole.facts["bytes"]  # ground, script and poster stay
    assert any("frames are in the page, at 12.5 per second" in w for w in small.warnings)
    assert "page-splats-thinned" in map(code_of, small.warnings)
    text = (tmp_path / "b.html").read_text(encoding="utf-8")
    assert small.warnings[0] in text  # who opens it is told as well


def test_the_limit_of_a_page_counts_the_splats_that_it_draws(made, tmp_path, monkeypatch):
    drawn = [int((frame(made, n).gaussians.opacities >= FAINTEST).sum()) for n in (1001, 1002)]
    assert drawn[0] < len(frame(made, 1001).gaussians)
    monkeypatch.setattr(page, "MOST_SPLATS", drawn[0])
    told = export_asset(made.folder, tmp_path / "a.html", ExportRequest("html", frames=(1001, 1002)))
    assert told.warnings == ()
    monkeypatch.setattr(page, "MOST_SPLATS", drawn[0] // 2)
    told = export_asset(made.folder, tmp_path / "b.html", ExportRequest("html", frames=(1001, 1002)))
    assert [code_of(w) for w in told.warnings] == ["page-splats-thinned"]


def test_thinning_keeps_the_same_splats_in_every_frame_and_the_room_they_fill():
    rng = np.random.default_rng(0)
    g = Gaussians.isotropic(rng.uniform(size=(20_000, 3)), 0.01, rng.uniform(size=(20_000, 3)))
    ids = np.arange(20_000, dtype=np.int32)
    few, kept = thinned(g, ids, 0.3)
    assert len(few) / len(g) == pytest.approx(0.3, abs=0.02)
    _, later = thinned(g.select(ids[5000:]), ids[5000:], 0.3)
    assert set(later) == set(kept[kept >= 5000])
    volume = [(x.scales.astype(float) ** 3).sum() for x in (g, few)]
    assert volume[1] == pytest.approx(volume[0], rel=0.05)
    gaps = np.diff(kept)
    assert gaps.max() < 30  # spread over the ids, and so over the body


def test_the_camera_is_one_that_other_commands_take(made, tmp_path):
    assert export(made, tmp_path / "out", "--to", "camera") in WELL
    own, back = load_asset(made.folder).camera, read_view(tmp_path / "out" / "camera.json")
    assert isinstance(back, PinholeCamera) and back.focal == own.focal and back.size == own.size
    np.testing.assert_allclose(back.position, own.position)
    told = json.loads((tmp_path / "out" / "camera.json").read_text())
    width = 2 * np.tan(np.radians(told["fov_degrees"]["horizontal"] / 2))
    assert width == pytest.approx(own.size[0] / own.focal[0])
    # a film back of 36 mm behind a lens of that focal length sees as much
    assert 36 / told["film"]["focal_length_mm"] == pytest.approx(max(own.size) / own.focal[0])


def test_masks_and_flow_of_the_clip_are_those_that_make_found(made, tmp_path):
    for to in ("masks", "flow", "flo"):
        assert export(made, tmp_path / to, "--to", to, "--frames", "1002-1003") in WELL
    assert names(tmp_path / "masks") == ["1002.png", "1003.png"]
    assert names(tmp_path / "flow") == ["flow.1002.exr", "flow.1003.exr"]
    mask, flow = np.asarray(Image.open(tmp_path / "masks" / "1002.png")), read_flo(tmp_path / "flo" / "flow.1002.flo")
    assert set(np.unique(mask)) == {0, 255} and mask.shape == flow.shape[:2]
    known = np.abs(flow).max(axis=-1) < UNKNOWN
    np.testing.assert_array_equal(known, mask > 0)  # nothing is known outside the fluid
    assert np.median(flow[known][:, 0]) == pytest.approx(2.0, abs=0.5)  # the texture runs 2 px per frame


def test_what_the_clip_showed_is_gone_with_the_work_folder(copy, tmp_path, capsys):
    shutil.rmtree(copy / "work" / "motion")
    assert main(["export", str(copy), "-o", str(tmp_path / "out"), "--to", "flow"]) == REJECTED
    said = capsys.readouterr().err
    assert "no work/motion" in said and "fluidlift make again" in said
    assert not (tmp_path / "out").exists()
    assert main(["export", str(copy), "-o", str(tmp_path / "masks"), "--to", "masks"]) in WELL


def test_a_missing_frame_is_told_and_a_damaged_one_refused(copy, tmp_path):
    splats = copy / "frames" / "splats"
    (splats / "1002.flsp").write_bytes((splats / "1002.flsp").read_bytes()[:2000])
    with pytest.raises(InputRejected, match=r"1002\.flsp"):
        export_asset(copy, tmp_path / "out", ExportRequest("spz"))
    (splats / "1003.flsp").unlink()
    shutil.copy(splats / "1001.flsp", splats / "1002.flsp")
    told = export_asset(copy, tmp_path / "out", ExportRequest("spz"))
    assert names(tmp_path / "out") == ["1001.spz", "1002.spz"]
    assert "frame 1003 is missing" in told.warnings[0]


def test_a_lower_frame_rate_takes_every_second_frame_and_numbers_them_without_gaps(made, tmp_path):
    request = ExportRequest("splats", fps=12.5, frames=(1001, 1003))
    told = export_asset(made.folder, tmp_path / "out", request)
    assert told.facts["fps"] == 12.5 and names(tmp_path / "out")[:2] == ["1001.ply", "1002.ply"]
    second = read_splats(tmp_path / "out" / "1002.ply")
    np.testing.assert_array_equal(second.extras["id"], frame(made, 1003).ids)


@pytest.mark.parametrize(
    ("fps", "interval", "step"), [(None, 0.04, 1), (25, 0.04, 1), (12.5, 0.04, 2), (24, 1001 / 24000, 1), (8, 0.04, 3)]
)
def test_rates_are_the_assets_own_over_whole_numbers(fps, interval, step):
    if fps == 8:  # 25 / 3 is 8.33
        with pytest.raises(InputRejected, match="fluidlift sim ASSET --fps 8"):
            every(fps, interval)
        return
    assert every(fps, interval) == step


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--to", "gltff"), "did you mean gltf"),
        (("--to", "spz", "--up-axis", "z", "--meters-per-unit", "0.01"), "y up and metres"),
        (("--to", "masks", "--frames", "1050-1060"), "masks 1050 to 1060"),
    ],
)
def test_what_cannot_be_written_is_refused_before_anything_is(made, tmp_path, capsys, options, words):
    assert export(made, tmp_path / "out", *options) == REJECTED
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("to", ["spz", "gltf", "html", "camera", "masks", "flow"])
def test_a_full_disk_is_told_in_words(made, tmp_path, monkeypatch, to):
    import os

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(InputRejected, match="disk full"):
        export_asset(made.folder, tmp_path / "out", ExportRequest(to, frames=(1001, 1001)))
    assert [p for p in (tmp_path / "out").iterdir() if p.is_file()] == []


def test_a_place_that_is_a_file_is_refused(made, tmp_path):
    (tmp_path / "out").write_text("mine")
    with pytest.raises(InputRejected, match="a file"):
        export_asset(made.folder, tmp_path / "out", ExportRequest("gltf"))
    (tmp_path / "a.html").mkdir()
    with pytest.raises(InputRejected, match="a folder"):
        export_asset(made.folder, tmp_path / "a.html", ExportRequest("html"))
    assert (tmp_path / "out").read_text() == "mine"
