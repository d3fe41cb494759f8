"""A clip with cuts becomes a shot for each of its parts."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from catalogue import stream_pictures, write_clip

from fluidlift.cli import REJECTED, main
from fluidlift.errors import InputRejected
from fluidlift.farm.cuts import Cut, cuts_of, parted
from fluidlift.farm.shots import Shot
from fluidlift.io.video import read_clip

LENGTHS = (20, 16, 24)
"""frames of the parts, at 25 per second"""


@pytest.fixture(scope="module")
def film(tmp_path_factory) -> Path:
    """Three shots, one after the other: a stream, another one in other colours, one upside down."""
    one, two, three = (stream_pictures(n, seed=k) for k, n in enumerate(LENGTHS))
    frames = np.concatenate([one, 255 - two[:, :, ::-1], three[:, ::-1]])
    return write_clip(tmp_path_factory.mktemp("film") / "film.mp4", frames)


def test_the_parts_meet_between_frames_and_take_each_frame_once(film):
    parts = cuts_of(film)
    assert [(p.start, p.end) for p in parts] == [(0.0, 0.78), (0.78, 1.42), (1.42, None)]
    assert [p.seconds for p in parts] == pytest.approx([0.78, 0.64, 0.98])
    counts = [len(read_clip(film, start=p.start, duration=None if p.end is None else p.end - p.start)) for p in parts]
    assert counts == list(LENGTHS)


def test_a_part_of_a_clip_is_parted_within_it(film):
    assert cuts_of(film, start=0.4, duration=0.8) == [Cut(0.4, 0.78, 0.38), Cut(0.78, 1.2, 0.42)]


def test_each_part_becomes_a_shot_with_the_options_of_its_clip(film, tmp_path):
    told: list[str] = []
    whole = Shot(film, "film", {"size": 2.0}, licence="CC0")
    found = parted([whole, Shot(tmp_path / "gone.mp4", "gone", {})], tmp_path, told.append)
    assert [s.name for s in found] == ["film_01", "film_02", "film_03", "gone"] and told == ["film: 3 shots"]
    assert found[1].options == {"size": 2.0, "start": 0.78, "duration": 0.64} and found[1].licence == "CC0"
    assert "duration" not in found[2].options
    trimmed = parted([Shot(film, "film", {"start": 0.4, "duration": 0.8})], tmp_path, told.append)
    assert [s.name for s in trimmed] == ["film"]  # nothing of it is long enough: left to make, which says so


def test_a_clip_is_looked_through_once(film, tmp_path, monkeypatch):
    shots = parted([Shot(film, "film", {})], tmp_path, print)
    monkeypatch.setattr("fluidlift.farm.cuts.cuts_of", lambda *a, **k: pytest.fail("looked through again"))
    assert parted([Shot(film, "film", {})], tmp_path, print) == shots
    (tmp_path / "film.cuts.json").write_text("{")
    with pytest.raises(pytest.fail.Exception):
        parted([Shot(film, "film", {})], tmp_path, print)


@pytest.mark.parametrize(
    "parts",
    [
        "[" * 900 + "]" * 900, '[{"start": 0, "end": "x", "seconds": 1}]', '[{"start": NaN, "end": 2, "seconds": 1}]',
        '[{"start": 0, "end": [], "seconds": 1}, 7]', '[[]]', '"ab"', '[{"start": 0, "end": 1e999, "seconds": 1}]',
    ],
)  # fmt: skip
def test_a_damaged_file_of_cuts_is_as_none(film, tmp_path, parts):
    shots = parted([Shot(film, "film", {})], tmp_path, lambda line: None)
    (found,) = tmp_path.glob("*.cuts.json")
    asked = json.dumps(json.loads(found.read_text())["asked"])
    found.write_text(f'{{"asked": {asked}, "parts": {parts}}}')
    assert parted([Shot(film, "film", {})], tmp_path, lambda line: None) == shots


def test_a_plan_has_a_task_for_each_part(film, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["batch", str(film), "-o", str(out), "--shots", "auto", "--plan", "openjd"]) == 0
    job = yaml.safe_load((out / "plan.openjd.yaml").read_text())
    assert "1-3" in json.dumps(job["steps"][0]["parameterSpace"]) and "--shots=auto" in json.dumps(job)
    assert "film: 3 shots" in capsys.readouterr().out


def asked_for(monkeypatch, codes) -> list[tuple]:
    """What `make` is asked to make, which ends with these codes, or raises them."""
    found: list[tuple] = []

    def run_job(clip, out, config, **rest) -> int:
        found.append((out.name, config.read.start, config.read.duration))
        if isinstance(code := codes[out.name], Exception):
            raise code
        return code

    monkeypatch.setattr("fluidlift.cli._run_job", run_job)
    return found


def test_make_makes_each_shot_and_ends_as_the_worst(film, tmp_path, monkeypatch, capsys):
    codes = {"film_01.fluid": 0, "film_02.fluid": 4, "film_03.fluid": 0}
    found = asked_for(monkeypatch, codes)
    words = ["make", str(film), "-o", str(tmp_path / "film.fluid"), "--shots", "auto", "--size", "2"]
    assert main(words) == 4
    assert found == [("film_01.fluid", 0.0, 0.78), ("film_02.fluid", 0.78, 0.64), ("film_03.fluid", 1.42, None)]
    assert "3 of 3 shots made" in capsys.readouterr().out and not list(tmp_path.iterdir())
    assert main([*words, "--warnings-ok"]) == 0
    codes["film_01.fluid"] = InputRejected("no fluid", "a fluid")
    found.clear()
    assert main(words) == 1 and len(found) == 3
    said = capsys.readouterr()
    assert "film_01.fluid: no fluid" in said.err and "2 of 3 shots made" in said.out


def test_make_looks_for_shots_in_the_part_that_settings_ask_for(film, tmp_path, monkeypatch):
    found = asked_for(monkeypatch, {"a_01.fluid": 0, "a_02.fluid": 0, "b.fluid": 0})
    out = ["--shots", "auto", "-o", str(tmp_path / "a.fluid")]
    assert main(["make", str(film), *out, "--set", "read.start=0.2", "--duration", "1.22"]) == 0
    assert found == [("a_01.fluid", 0.2, 0.58), ("a_02.fluid", 0.78, 0.64)]
    assert main(["make", str(film), "--shots", "auto", "-o", str(tmp_path / "b.fluid"), "--duration", "0.7"]) == 0
    assert found[2:] == [("b.fluid", 0.0, 0.7)]  # one shot: as without the option


def test_make_refuses_what_is_known_of_one_view_for_several(film, tmp_path, monkeypatch, capsys):
    found = asked_for(monkeypatch, {})
    (tmp_path / "camera.json").write_text("{}")
    words = ["make", str(film), "-o", str(tmp_path / "a.fluid"), "--shots", "auto"]
    assert main([*words, "--camera", str(tmp_path / "camera.json")]) == REJECTED
    said = capsys.readouterr().err
    assert "--camera" in said and "fluidlift batch" in said and not found


def test_rows_of_a_list_have_no_shots_of_their_own(film, tmp_path, capsys):
    (tmp_path / "shots.yaml").write_text(f"- clip: {film}\n  shots: auto\n")
    assert main(["batch", str(tmp_path / "shots.yaml"), "-o", str(tmp_path / "out")]) == REJECTED
    assert "unknown option 'shots'" in capsys.readouterr().err
