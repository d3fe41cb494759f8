"""Foam and waves of a film stand beside the other parameters of an asset, and stay there."""

import pytest
from small_asset import small_asset

from fluidlift.io.asset_folder import read_parameters, save_asset
from fluidlift.pipeline.resimulate import write_filmed_numbers
from fluidlift.present.report import _filmed_rows
from fluidlift.scene.whitewater_law import LAW
from fluidlift.types import Estimate
from fluidlift.validate import validate_asset


def number(value):
    return Estimate(value, 0.1 * value, False, 0.0, "m", (0.8 * value, 1.25 * value), "measured: by a test")


@pytest.fixture
def folder(tmp_path):
    save_asset(tmp_path, small_asset())
    return tmp_path


def known(folder):
    return read_parameters(folder / "parameters.json")[1]


def test_they_come_beside_the_others_and_take_the_place_of_earlier_ones(folder):
    before, parameters = known(folder), read_parameters(folder / "parameters.json")[0]
    law = {name: number(k + 1.0) for k, name in enumerate(LAW)}
    write_filmed_numbers(folder, {"foam_share": number(0.1), "wave_length": number(0.4)} | law)
    found = known(folder)
    assert list(found) == [*before, "foam_share", *LAW, "wave_length"]
    assert found["whitewater_rate"] == law["whitewater_rate"] and found["density"] == before["density"]
    # one that went on from a checkpoint did not see how the flow began; a film without waves takes them away
    write_filmed_numbers(folder, {"foam_share": number(0.2)})
    found = known(folder)
    assert found["foam_share"].value == 0.2 and "wave_length" not in found
    assert {name: found[name] for name in LAW} == law
    assert read_parameters(folder / "parameters.json")[0] == parameters
    said = [f.line() for f in validate_asset(folder) if not f.passed]
    assert not [line for line in said if "parameters" in line or "hash" in line]


def test_the_report_shows_them_with_their_intervals(folder):
    assert _filmed_rows(folder) == []
    write_filmed_numbers(folder, {"foam_share": number(0.1)})
    ((name, value, unit, between, sure, prior, source),) = _filmed_rows(folder)
    assert (name, value, unit, between, prior) == ("foam_share", 0.1, "m", "0.08 to 0.125", "")
    assert sure.count("▰") == 8 and source == "measured: by a test"
