"""A warning is a text that keeps its code on the way through the cache and between processes."""

import io
import json
import pickle
from dataclasses import dataclass

import numpy as np
from catalogue import write_clip

from fluidlift.cli import main
from fluidlift.errors import InputRejected
from fluidlift.io.stage_codec import packed, unpacked
from fluidlift.messages import Notice, VisibleOutput, as_plain, code_of, from_plain, visible, without
from fluidlift.progress import PlainProgress


@dataclass(frozen=True)
class Told:
    warnings: tuple[Notice, ...]


def test_a_warning_is_its_text():
    warning = Notice("cut", "the clip is cut")
    assert warning == "the clip is cut" and f"{warning}!" == "the clip is cut!" and code_of(warning) == "cut"
    assert json.loads(json.dumps([warning])) == ["the clip is cut"]
    assert code_of("the clip is cut") == ""


def test_warnings_of_one_code_are_left_out_whatever_they_say():
    said = (Notice("cut", "a"), Notice("shake", "a"), "a")
    assert [code_of(w) for w in without(said, "cut")] == ["shake", ""]


def test_codes_outlast_the_cache_and_another_process():
    told = Told((Notice("cut", "the clip is cut"), Notice("", "and more")))
    arrays, data = packed(told)
    for back in (unpacked(Told, arrays, json.loads(json.dumps(data))), pickle.loads(pickle.dumps(told))):
        assert back == told and [code_of(w) for w in back.warnings] == ["cut", ""]


def test_values_of_earlier_versions_hold_texts_without_codes():
    assert unpacked(Told, {}, {"warnings": ["the clip is cut"]}).warnings == (Notice("", "the clip is cut"),)


def test_files_hold_codes_beside_the_texts():
    told = [Notice("cut", "the clip is cut"), Notice("shake", "it shakes")]
    data = json.loads(json.dumps(as_plain(told)))
    assert data == {"warnings": ["the clip is cut", "it shakes"], "warning_codes": ["cut", "shake"]}
    assert [code_of(w) for w in from_plain(data)] == ["cut", "shake"] and from_plain(data) == told


def test_codes_of_a_file_count_only_where_there_is_one_for_each_text():
    for codes in (None, ["cut"], ["cut", 3], "ab", {"a": "cut"}):
        back = from_plain({"warnings": ["a", "b"], "warning_codes": codes})
        assert back == ["a", "b"] and [code_of(w) for w in back] == ["", ""]
    assert from_plain({}) == from_plain({"warnings": "text"}) == []


def test_texts_for_files_are_plain():
    """A subclass of str is nothing that YAML knows."""
    (text,) = as_plain([Notice("dry", "no water")])["warnings"]
    assert type(text) is str and text == "no water"


CLEARING = "a\x1b[2J\x1b]0;title\x07\x9b1A\r\u202eb"
"""clears a terminal, sets its title, moves its cursor, and lets what follows read backwards"""
SHOWN = r"a\x1b[2J\x1b]0;title\x07\x9b1A\r\u202eb"


def test_what_would_command_a_terminal_is_spelled_out():
    assert visible(CLEARING) == SHOWN
    assert visible("a\tb\nü 水 😀") == "a\tb\nü 水 😀"
    held = io.StringIO()
    shown = VisibleOutput(held)
    print(CLEARING, file=shown)
    shown.writelines([CLEARING, "\n"])
    assert held.getvalue() == f"{SHOWN}\n" * 2 and not shown.isatty()


def test_names_of_strangers_command_no_terminal(tmp_path, capsys):
    clip = tmp_path / "c\x1b[2J\u202e.mp4"
    clip.write_bytes(b"")
    assert main(["inspect", str(clip)]) == 3
    write_clip(clip, np.zeros((4, 32, 48, 3), np.uint8))
    assert main(["inspect", str(clip)]) in (0, 4)
    said = capsys.readouterr()
    for text in said:
        assert r"c\x1b[2J\u202e.mp4" in text and "\x1b" not in text and "\u202e" not in text


def test_warnings_with_words_of_strangers_command_no_terminal():
    held = io.StringIO()
    progress = PlainProgress(held)
    progress.warn(CLEARING)
    progress.say(CLEARING)
    assert held.getvalue() == f"warning: {SHOWN}\n{SHOWN}\n"


def test_a_question_ends_as_a_question():
    assert str(InputRejected("no look 'a'", "b", "did you mean b?")).endswith("Do: did you mean b?")
    assert str(InputRejected("no look 'a'", "b", "write b")).endswith("Do: write b.")
