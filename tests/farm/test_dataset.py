"""A data set: an index with a row per asset, and its assets as arrays."""

import importlib.util
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from fluidlift.cli import main
from fluidlift.errors import InputRejected
from fluidlift.farm.dataset import COLUMNS, INDEX, read_index, sample_of, samples, write_index
from fluidlift.farm.local import LocalEngine
from fluidlift.farm.shots import ShotOptions, read_shots
from fluidlift.farm.state import ShotOutcome, list_names, read_outcome, write_outcome
from fluidlift.io.asset_folder import load_asset, read_manifest


def told(name: str, **facts) -> ShotOutcome:
    return replace(ShotOutcome(name, "done", 12.0, "", ""), **facts)


@pytest.fixture
def folder(tmp_path, made):
    """A batch's folder with one asset, and a shot that failed."""
    shutil.copytree(made.folder, tmp_path / "river.fluid")
    outcomes = [told("river", licence="CC0-1.0", source="a friend", verdict="usable"), told("lost", outcome="failed")]
    for outcome in outcomes:
        write_outcome(tmp_path, outcome)
    list_names(tmp_path, ["river", "lost"])
    return tmp_path


def test_the_index_has_a_row_per_asset_with_its_parameters_and_figures(folder, made):
    assert main(["batch", str(folder), "--status", "--dataset"]) == 0
    (row,) = read_index(folder)
    asset, manifest = load_asset(made.folder), read_manifest(made.folder)
    assert (row["name"], row["asset"], row["kind"]) == ("river", "river.fluid", "stream")
    assert (row["licence"], row["source"], row["verdict"]) == ("CC0-1.0", "a friend", "usable")
    assert (row["cells_x"], row["cells_y"], row["cells_z"]) == asset.grid.shape and row["spacing"] == asset.grid.spacing
    viscosity = asset.estimates["kinematic_viscosity"]
    assert row["kinematic_viscosity"] == viscosity.value and row["kinematic_viscosity_fitted"] == viscosity.fitted
    assert (row["kinematic_viscosity_low"], row["kinematic_viscosity_high"]) == (viscosity.interval or (None, None))
    figures = manifest["simulation"]["as_filmed"]["figures"]
    assert {f"filmed_{name}" for name in figures} <= set(row) and row["filmed_level"] == figures["level"]["value"]
    assert set(COLUMNS) <= set(row) and row["clip_sha256"] == manifest["provenance"]["inputs"]["clip"]["sha256"]


def test_samples_are_the_assets_arrays_and_the_film_where_the_clip_is_gone(folder):
    write_index(folder, (read_outcome(folder, "river"),))
    (sample,) = samples(folder, where=lambda row: row["kind"] == "stream")
    asset = load_asset(folder / "river.fluid")
    np.testing.assert_array_equal(sample.velocity, asset.velocity.at_centers())
    np.testing.assert_array_equal(sample.gaussians.means, asset.rest.means)
    assert sample.parameters == asset.parameters and sample.cell_types.shape == asset.grid.shape
    assert not sample.of_clip and sample.frames.dtype == np.uint8 and sample.frames.shape[-1] == 3
    assert list(samples(folder, where=lambda row: row["kind"] == "plume")) == []


def test_frames_are_the_clips_where_it_lies_with_its_content(folder, made):
    from fluidlift.io.video import read_clip

    clip = made.clip
    write_outcome(folder, told("river", clip=str(clip)))
    write_index(folder, (read_outcome(folder, "river"),))
    (row,) = read_index(folder)
    sample = sample_of(folder, row)
    read = read_manifest(folder / "river.fluid")["provenance"]["config"]["read"]
    wanted = read_clip(clip, max_size=read["max_size"], fps=read["fps"], duration=read["duration"]).frames
    assert sample.of_clip
    np.testing.assert_array_equal(sample.frames, wanted)
    assert not sample_of(folder, row | {"clip_sha256": "0" * 64}).of_clip


@pytest.mark.parametrize("name", ["../river.fluid", "/etc", "", None])
def test_an_index_that_names_a_folder_elsewhere_is_refused(folder, name):
    with pytest.raises(InputRejected, match="of the index"):
        sample_of(folder, {"asset": name})


def test_a_folder_without_an_index_and_a_damaged_one_are_refused(tmp_path):
    with pytest.raises(InputRejected, match=r"dataset\.parquet"):
        read_index(tmp_path)
    (tmp_path / INDEX).write_bytes(b"PAR1 no table PAR1")
    with pytest.raises(InputRejected, match="an index that fluidlift wrote"):
        read_index(tmp_path)


def test_without_pyarrow_it_is_said_before_anything_is_made(tmp_path, monkeypatch, capsys):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if name == "pyarrow" else find(name, *a))
    (tmp_path / "a.mp4").write_text("film")
    assert main(["batch", str(tmp_path / "a.mp4"), "-o", str(tmp_path / "out"), "--dataset"]) == 3
    assert "fluidlift[dataset]" in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_licence_and_source_of_a_list_reach_the_state_and_change_nothing_else(tmp_path, limits, runs):
    clip, out = tmp_path / "a.mp4", tmp_path / "out"
    clip.write_text("film")
    out.mkdir()

    def listed(notes: str):
        (tmp_path / "shots.yaml").write_text(f"- clip: a.mp4\n{notes}")
        return read_shots([tmp_path / "shots.yaml"], ShotOptions({}), base={}, settings=())

    plain, noted = listed(""), listed("  licence: CC-BY-4.0\n  source: https://example.org/a\n")
    assert plain[0].fingerprint() == noted[0].fingerprint() and plain[0].arguments(out) == noted[0].arguments(out)
    for shots in (plain, noted):
        list(LocalEngine().shots(shots, out, limits, lambda text: None, lambda text: None))
    found = read_outcome(out, "a")
    assert (found.licence, found.source, found.clip) == ("CC-BY-4.0", "https://example.org/a", str(clip))
    assert runs(out, "a") == 1
    assert json.loads((out / "a.state.json").read_text())["outcome"] == "done"
