"""A warning is a text that keeps its code on the way through the cache and between processes."""

import json
import pickle
from dataclasses import dataclass

from fluidlift.io.stage_codec import packed, unpacked
from fluidlift.messages import Notice, code_of, without


@dataclass(frozen=True)
class Told:
    warnings: tuple[str, ...]


def test_a_warning_is_its_text():
    warning = Notice("cut", "the clip is cut")
    assert warning == "the clip is cut" and f"{warning}!" == "the clip is cut!" and code_of(warning) == "cut"
    assert json.loads(json.dumps([warning])) == ["the clip is cut"]
    assert code_of("the clip is cut") == ""


def test_warnings_of_one_code_are_left_out_whatever_they_say():
    said = (Notice("cut", "a"), Notice("shake", "a"), "a")
    assert [code_of(w) for w in without(said, "cut")] == ["shake", ""]


def test_codes_outlast_the_cache_and_another_process():
    told = Told((Notice("cut", "the clip is cut"), "and more"))
    arrays, data = packed(told)
    for back in (unpacked(Told, arrays, json.loads(json.dumps(data))), pickle.loads(pickle.dumps(told))):
        assert back == told and [code_of(w) for w in back.warnings] == ["cut", ""]
