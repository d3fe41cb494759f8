"""A warning is a text that keeps its code on the way through the cache and between processes."""

import json
import pickle
from dataclasses import dataclass

from fluidlift.io.stage_codec import packed, unpacked
from fluidlift.messages import Notice, as_plain, code_of, from_plain, without


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
