"""What is told of a folder of shots: counts, a table, a page."""

import csv
import io
import json

import numpy as np
import pytest

from fluidlift.cli import main
from fluidlift.farm.page import doubt, page
from fluidlift.farm.state import ShotOutcome, list_names, write_outcome
from fluidlift.farm.summary import as_csv, status_of
from fluidlift.io.pictures import write_png
from fluidlift.io.video import write_video


def outcome(name: str, folder, **values) -> ShotOutcome:
    given = {"outcome": "done", "seconds": 60.0, "asset": str(folder / f"{name}.fluid"), "log": ""} | values
    return ShotOutcome(name, **given)


def folder_of(tmp_path):
    list_names(tmp_path, ["good", "poor", "bad", "later", "last"])
    for found in (
        outcome("good", tmp_path, verdict="good", version="1"),
        outcome(
            "poor", tmp_path, verdict="does not hold", outcome="done, warnings", warnings=["<b>foam"], seconds=120.0
        ),
        outcome("bad", tmp_path, outcome="failed", failure="memory", reason="took more memory than 1 GB", version="2"),
    ):
        write_outcome(tmp_path, found)
    return tmp_path


def test_the_status_counts_and_says_how_long_it_will_take(tmp_path, capsys):
    folder = folder_of(tmp_path)
    assert main(["batch", str(folder), "--status"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "2 of 5 done (1 with warnings), 0 running, 2 waiting",
        "90 s a shot, about 3 min left",
        "failed: 1 memory",
        "  bad: failed in 60 s: took more memory than 1 GB",
        "made by several versions of fluidlift: 1, 2",
    ]
    assert main(["batch", str(folder), "--status", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["done"], told["failed"], told["waiting"]) == (2, {"memory": 1}, ["later", "last"])


def test_a_table_has_a_row_per_shot(tmp_path, capsys):
    folder = folder_of(tmp_path)
    assert main(["batch", str(folder), "--status", "--csv"]) == 0
    rows = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    assert [r["name"] for r in rows] == ["good", "poor", "bad"] and rows[1]["warnings"] == "1"
    assert "fingerprint" not in rows[0] and as_csv(()).startswith("name,outcome")


def test_the_page_shows_the_most_doubtful_first_with_its_pictures_and_no_markup_of_others(tmp_path):
    folder = folder_of(tmp_path)
    asset = folder / "poor.fluid"
    asset.mkdir()
    write_png(asset / "mask_overlay.png", np.full((40, 60, 3), 90, np.uint8))
    write_video(asset / "preview.mp4", iter(np.full((5, 32, 96, 3), 120, np.uint8)), 25.0)
    status = status_of(folder)
    text = page(folder, status)
    assert text.index("<h2>bad") < text.index("<h2>poor") < text.index("<h2>good")
    assert text.count("data:image/jpeg") == 2 and "&lt;b&gt;foam" in text and "<b>foam" not in text
    assert [doubt(o) for o in status.outcomes] == [0.0, 2.1, 3.0]
    assert 'src="http' not in text and "default-src 'none'" in text


def test_a_folder_that_is_none_is_refused(tmp_path, capsys):
    assert main(["batch", str(tmp_path / "nowhere"), "--status"]) == 3
    assert main(["batch", str(tmp_path), "--html", "-o", str(tmp_path)]) == 3
    assert main(["batch", str(tmp_path)]) == 3
    assert "-o" in capsys.readouterr().err


@pytest.mark.parametrize(
    "changes",
    [
        {"seconds": "long"}, {"seconds": None}, {"seconds": 1e999}, {"warnings": 3}, {"warnings": [3]}, {"reason": [1]},
        {"verdict": {}}, {"peak_memory_mb": float("nan")}, {"version": 1}, {"name": "good"},
    ],
)  # fmt: skip
def test_a_state_of_other_types_counts_as_none(tmp_path, changes):
    folder = folder_of(tmp_path)
    state = json.loads((folder / "poor.state.json").read_text()) | changes
    (folder / "poor.state.json").write_text(json.dumps(state))
    status = status_of(folder)
    assert [o.name for o in status.outcomes] == ["good", "bad"] and "poor" in status.waiting
    assert status.lines() and as_csv(status.outcomes) and page(folder, status)


@pytest.mark.parametrize(
    "listed", ["[" * 100_000, '{"a": ' * 900 + "1" + "}" * 900, json.dumps(["n" * 300]), "[7, null]"]
)
def test_a_damaged_list_of_names_leaves_what_is_known_of_the_shots(tmp_path, listed):
    folder = folder_of(tmp_path)
    (folder / "shots.json").write_text(listed)
    assert sorted(o.name for o in status_of(folder).outcomes) == ["bad", "good", "poor"]
    (folder / "poor.state.json").write_text("[" * 100_000)
    assert status_of(folder).waiting == ("poor",)


def test_pictures_of_one_column_become_no_millions_of_rows(tmp_path):
    folder = folder_of(tmp_path)
    asset = folder / "poor.fluid"
    asset.mkdir()
    write_png(asset / "mask_overlay.png", np.full((3000, 1, 3), 90, np.uint8))
    text = page(folder, status_of(folder))
    assert text.count("data:image/jpeg") == 1 and len(text) < 1e6
