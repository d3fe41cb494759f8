"""Many clips by one command."""

import json
from pathlib import Path

import pytest

from fluidlift.cli import FAILED, REJECTED, main
from fluidlift.io.asset_folder import read_manifest


def summary(folder: Path) -> dict[str, dict]:
    return {row["name"]: row for row in json.loads((folder / "batch.json").read_text())}


def test_what_fails_does_not_stop_the_others(stream_clip, hasty, tmp_path, capsys):
    (tmp_path / "text.mp4").write_text("no film")
    shots = tmp_path / "shots.yaml"
    settings = ", ".join(f"'{s}'" for s in hasty if not s.startswith("--"))
    river = f"- clip: {stream_clip}\n  name: river\n  size: 3\n  roll: -2\n  set: [{settings}]\n"
    shots.write_text("- text.mp4\n" + river + "- clip: gone.mp4\n  size: big\n")
    out = tmp_path / "out"
    assert main(["batch", str(shots), "-o", str(out), "--set", "seed=7"]) == FAILED
    found = summary(out)
    assert list(found) == ["text", "river", "gone"]  # in the order of the list
    assert found["text"]["outcome"] == "rejected" and "a text file, not a video" in found["text"]["reason"]
    assert found["gone"]["outcome"] == "rejected" and "--size" in found["gone"]["reason"]
    assert found["river"]["outcome"].startswith("done") and found["river"]["reason"] == ""
    config = read_manifest(out / "river.fluid")["provenance"]["config"]
    assert config["seed"] == 7 and config["shape"]["size"] == 3 and config["shape"]["roll"] == -2
    assert "finding the fluid" in (out / "river.log").read_text()
    said = capsys.readouterr().out
    assert "[3/3]" in said and "1 of 3 made" in said


def test_a_folder_gives_its_videos(tmp_path, capsys):
    for name in ("b.MOV", "a.mp4", "notes.txt"):
        (tmp_path / name).write_text("no film")
    assert main(["batch", str(tmp_path), "-o", str(tmp_path / "out"), "--jobs", "2", "--json"]) == FAILED
    assert [row["name"] for row in json.loads(capsys.readouterr().out)] == ["a", "b"]
    assert list(summary(tmp_path / "out")) == ["a", "b"]


def test_a_home_of_nobody_is_a_name_like_any_other(tmp_path):
    (tmp_path / "shots.yaml").write_text("- ~nobody-is-called-so.mp4\n")
    assert main(["batch", str(tmp_path / "shots.yaml"), "-o", str(tmp_path / "out")]) == FAILED
    (row,) = summary(tmp_path / "out").values()
    assert row["outcome"] == "rejected" and "no such video" in row["reason"]


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ("- clip: a.mp4\n  sise: 4\n", "shots.yaml, shot 1: unknown option 'sise'. Needed: did you mean size?"),
        ("- a.mp4\n- clip: b/a.mp4\n", "two shots are called a"),
        ("- clip: a.mp4\n  name: ../a\n", "a name that a folder can have"),
        ("- clip: a.mp4\n  size: {x: 1}\n", "a word or a number"),
        ("- size: 3\n", "shot 1 names no clip"),
        ("clip: a.mp4\n", "holds no list"),
        ("- [\n", "shots.yaml cannot be read: line 2"),
        ("- clip: a.mp4\n  out: elsewhere\n", "unknown option 'out'"),
    ],
)
def test_a_list_that_cannot_be_used_is_refused_before_anything_is_made(tmp_path, capsys, rows, words):
    (tmp_path / "shots.yaml").write_text(rows)
    assert main(["batch", str(tmp_path / "shots.yaml"), "-o", str(tmp_path / "out")]) == REJECTED
    assert words in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_places_that_cannot_be_used_are_named(tmp_path, capsys):
    assert main(["batch", str(tmp_path / "gone.yaml"), "-o", str(tmp_path / "out")]) == REJECTED
    assert "no such list of shots" in capsys.readouterr().err
    (tmp_path / "a.mp4").write_text("no film")
    assert main(["batch", str(tmp_path / "a.mp4"), "-o", "/proc/no"]) == REJECTED
    assert "/proc/no" in capsys.readouterr().err
