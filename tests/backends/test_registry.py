"""The table of back ends names modules and classes that are there, and what is kept depends on their source."""

import ast
from importlib.util import find_spec
from pathlib import Path

import pytest

from fluidlift.backends.registry import BACK_ENDS, class_of, module_name, names
from fluidlift.config import build_config
from fluidlift.pipeline.settings import FlowSettings, SegmentSettings
from fluidlift.source import source_hash

ENTRIES = [(purpose, name) for purpose in BACK_ENDS for name in names(purpose)]


@pytest.mark.parametrize(("purpose", "name"), ENTRIES, ids=lambda x: x)
def test_every_back_end_is_where_the_table_says(purpose, name):
    spec = find_spec(module_name(purpose, name))
    assert spec is not None and spec.origin is not None
    tree = ast.parse(Path(spec.origin).read_text(encoding="utf-8"))
    assert BACK_ENDS[purpose][name].partition(":")[2] in {n.name for n in tree.body if isinstance(n, ast.ClassDef)}


def test_another_name_is_refused_with_those_that_there_are():
    with pytest.raises(ValueError, match="one of raft, sea-raft"):
        class_of("flow method", "rafting")


def test_the_key_of_a_learned_stage_knows_the_source_of_its_model_and_our_own_knows_none():
    own, learned = (FlowSettings.of(build_config(overrides=[f"motion.method={m}"])) for m in ("multiframe", "raft"))
    assert own.source == "" and learned.source == source_hash("fluidlift.backends.torchvision_raft")
    assert SegmentSettings.of(build_config()).source == ""
