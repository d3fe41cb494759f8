"""One reader for all YAML: bounded before anything is built, and numbers as YAML 1.2 has them."""

from __future__ import annotations

import contextlib
import math

import pytest
import yaml

from fluidlift.config import build_config
from fluidlift.errors import InputRejected
from fluidlift.io.yaml_reader import _LOADER, MAX_BYTES, MAX_DEPTH, MAX_NODES, composed, parse_yaml, read_yaml

DOUBLING = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{chr(98 + k)}: &{chr(98 + k)} [{', '.join(['*' + chr(97 + k)] * 9)}]\n" for k in range(9)
)
"""418 bytes that stand for 9^10 texts"""
MEGABYTES = {
    "flow": "[" + "1," * (MAX_BYTES // 2 - 1) + "]", "block": "- a\n" * (MAX_BYTES // 4), "comment": "#" * MAX_BYTES,
    "braces": "a: " + "{" * 900_000, "blanks": "a: 1\n" + " " * (MAX_BYTES - 10),
    "breaks": "a: " + "'" + "\n" * (MAX_BYTES - 10) + "'",
}  # fmt: skip


@pytest.fixture
def events(monkeypatch):
    """All that the reader asks libyaml for."""
    found, parse = [], yaml.parse

    def watched(*args, **named):
        for event in parse(*args, **named):
            found.append(event)
            yield event

    monkeypatch.setattr(yaml, "parse", watched)
    composed.cache_clear()
    return found


@pytest.mark.parametrize(
    ("word", "value"),
    [
        ("1e-6", 1e-6), ("1:30", "1:30"), ("1_000", "1_000"), ("010", 10), ("0x1F", 31), ("0o17", 15), ("-7", -7),
        (".5", 0.5), ("5.", 5.0), ("+.inf", math.inf), ("-.inf", -math.inf), ("2001-01-01", "2001-01-01"), ("~", None),
        ("yes", True), ("Off", False), ("<<", "<<"), ("'1'", "1"), ("-", None), (".", "."), ("+", "+"), ("1e", "1e"),
    ],
)  # fmt: skip
def test_words_are_those_of_the_core_schema(word, value):
    found = parse_yaml(f"a: {word}")["a"] if word != "-" else parse_yaml("a:")["a"]
    assert found == value and type(found) is type(value)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (DOUBLING, "aliases"),
        ("a: !!python/object:os.system {}", "tags"),
        ("a: !!binary aGk=", "tags"),
        ("a: " + "9" * 5000, "a number of 5000 characters"),
        ("a: 1e999", "too large"),
        ("a: " + "[" * 5000 + "]" * 5000, "inside each other"),
        ("\n".join("  " * k + "a:" for k in range(200)), "inside each other"),
        ("a: '" + "x" * 70_000 + "'", "a text of 70000 characters"),
        ("? [a, b]\n: c", "as a key"),
        ("a: 1\na: 2", "twice"),
        ("0x1: 1\n1: 2", "twice"),
        ("a: 1\n---\na: 2", "second document"),
        ("a: \ud800", "surrogate"),
        ("a: [1, 2", "flow"),
    ],
)
def test_what_is_not_taken_is_refused_at_once(text, why, events):
    with pytest.raises(yaml.YAMLError) as caught:
        parse_yaml(text)
    assert why in str(caught.value)
    assert len(events) < 1000  # a few lines are never unfolded


@pytest.mark.parametrize("text", MEGABYTES.values(), ids=MEGABYTES)
def test_a_megabyte_is_read_no_further_than_the_bounds(text, events):
    with contextlib.suppress(yaml.YAMLError):
        parse_yaml(text)
    assert 0 < len(events) <= MAX_NODES + 3 * MAX_DEPTH  # beginnings of nodes, and ends of those that are open


def test_the_parser_is_the_fast_one():
    assert _LOADER is yaml.CSafeLoader  # in PyYAML from PyPI; times: benchmarks/yaml_reader.py


def test_bounds_can_be_reached():
    assert len(parse_yaml("\n".join(f"k{k}: 1" for k in range(MAX_NODES // 2 - 1)))) == MAX_NODES // 2 - 1
    assert str(parse_yaml("[" * MAX_DEPTH + "]" * MAX_DEPTH)).count("[") == MAX_DEPTH


def test_places_count_characters_also_behind_a_byte_order_mark():
    text = "\ufeffä: [ö, üü]\r\nb: 1\r\n"
    root = composed(text)
    (_, listed), (key, one) = root.value
    assert text[listed.value[1].start_mark.index : listed.value[1].end_mark.index] == "üü"
    assert text[key.start_mark.index] == "b" and text[one.start_mark.index] == "1"


@pytest.mark.parametrize("text", [DOUBLING, "read: " + "{a: " * 500, "fit: {max_seconds: 1:30}", "x: \x00", "- 1"])
def test_settings_of_strangers_are_refused(tmp_path, text):
    path = tmp_path / "settings.yaml"
    path.write_text(text)
    with pytest.raises(InputRejected):
        build_config(None, path)


def test_a_file_says_where_it_is_wrong(tmp_path):
    path = tmp_path / "shots.yaml"
    path.write_text("- clip: a.mp4\n- *b\n")
    with pytest.raises(InputRejected, match=r"shots\.yaml cannot be read: line 2: aliases"):
        read_yaml(path, "list of shots")
    path.write_bytes(b"a: \xff\xfe")
    with pytest.raises(InputRejected, match="no text"):
        read_yaml(path, "list of shots")
    path.write_bytes(b"#" * (MAX_BYTES + 1))
    with pytest.raises(InputRejected, match="at most"):
        read_yaml(path, "list of shots")
