"""fluidlift hints, and make --hints."""

import json

import pytest

from fluidlift.cli import main
from fluidlift.io.hints_file import read_found, read_hints


@pytest.fixture(scope="module")
def written(stream_clip, tmp_path_factory):
    file = tmp_path_factory.mktemp("hints") / "stream.hints.yaml"
    assert main(["hints", str(stream_clip), "-o", str(file)]) in (0, 4)
    return file


def test_what_was_found_is_written_and_hints_that_stand_there_are_kept(written, stream_clip, tmp_path, capsys):
    file = tmp_path / "h.yaml"
    file.write_text(written.read_text().replace("found:", "kind: fall\nfound:", 1))
    assert main(["hints", str(stream_clip), "-o", str(file), "--json"]) in (0, 4)
    assert json.loads(capsys.readouterr().out)["kind"] == "fall"
    assert read_hints(file).kind == "fall" and read_found(file)["probability"]


def test_make_takes_the_hints(written, stream_clip, tmp_path, hasty):
    file, out = tmp_path / "h.yaml", tmp_path / "a.fluid"
    text = written.read_text()
    w, h = read_hints(written).clip.size
    rock = f"regions:\n- {{is: rock, brush: [[{w / 2}, {h / 2}]], width: 6}}\n"
    file.write_text(text.replace("found:", f"kind: fall\n{rock}found:", 1))
    assert main(["make", str(stream_clip), "-o", str(out), "--hints", str(file), *hasty]) in (0, 4)
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["kind"] == "fall" and manifest["provenance"]["hints"]["regions"][0]["is"] == "rock"
    assert "correct" in manifest["provenance"]["stages"]


def test_hints_of_another_clip_are_refused_in_one_line(written, tmp_path, stream_clip, capsys):
    other = tmp_path / "other.mp4"
    other.write_bytes(stream_clip.read_bytes() + b" ")
    assert main(["make", str(other), "-o", str(tmp_path / "a.fluid"), "--hints", str(written)]) == 3
    assert "belongs to another clip" in capsys.readouterr().err
    assert not (tmp_path / "a.fluid").exists()
