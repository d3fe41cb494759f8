"""A clip with cuts becomes a shot for each of its parts."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from catalogue import stream_pictures, write_clip

from fluidlift.cli import main
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


def test_a_plan_has_a_task_for_each_part(film, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["batch", str(film), "-o", str(out), "--shots", "auto", "--plan", "openjd"]) == 0
    job = yaml.safe_load((out / "plan.openjd.yaml").read_text())
    assert "1-3" in json.dumps(job["steps"][0]["parameterSpace"]) and "--shots=auto" in json.dumps(job)
    assert "film: 3 shots" in capsys.readouterr().out
