"""What is found of a clip with hints: what a hint reaches is done again, and nothing else."""

import numpy as np
import pytest

from fluidlift.config import build_config
from fluidlift.errors import InputRejected
from fluidlift.pipeline import Inputs, begin
from fluidlift.pipeline.find import FIND_STAGES, find_hints, identity_of, view
from fluidlift.pipeline.inputs import GivenFiles
from fluidlift.pipeline.runner import Runner
from fluidlift.pipeline.settings import GivenView
from fluidlift.seams import Silence
from fluidlift.types.hints import ClipHints, Region, Ruler


@pytest.fixture(scope="module")
def looked(stream_clip, tmp_path_factory):
    """A folder in which the small clip was looked at once, and its identity."""
    folder = tmp_path_factory.mktemp("look") / "look"
    config = build_config("draft")
    return stream_clip, folder, config, identity_of(stream_clip), find_hints(Inputs(stream_clip), folder, config)


def again(looked, hints):
    """The stages that hints have done again, and the runner's values."""
    clip, folder, config, _, _ = looked
    runner = Runner(folder, begin.stages_of(FIND_STAGES, hints), progress=Silence())
    given = GivenFiles.of(Inputs(clip))
    found = begin.look(runner, given, config, said=hints)
    settings = begin.geometry_settings(found[0], config, hints)
    seen = runner.run("view", view, *found, GivenView.of(given, config), settings)
    return [name for name, t in runner.timings.items() if not t["cached"]], found, seen


def test_only_what_depends_on_a_hint_is_done_again(looked):
    identity = looked[3]
    w, h = identity.size
    level = ClipHints(identity, horizon=((0.0, 0.1 * h), (float(w), 0.1 * h)))
    assert again(looked, level)[0] == ["view"]
    assert again(looked, ClipHints(identity))[0] == []
    area = Region("rock", ((0.4 * w, 0.5 * h), (0.5 * w, 0.5 * h), (0.5 * w, 0.6 * h)))
    assert again(looked, ClipHints(identity, regions=(area,)))[0] == ["correct", "view"]


def test_a_drawn_horizon_and_a_ruler_are_taken(looked):
    identity = looked[3]
    w, h = identity.size
    hints = ClipHints(
        identity, horizon=((0.0, -0.3 * h), (float(w), -0.3 * h)),
        ruler=Ruler((0.3 * w, 0.6 * h), (0.7 * w, 0.6 * h), 2.0),
    )  # fmt: skip
    seen = again(looked, hints)[2]
    half = 0.8 * h * 2 * np.tan(np.radians(25.0)) / max(w, h)
    assert seen.up.pitch == pytest.approx(np.degrees(np.arctan(half)), abs=0.1) and seen.up.source == "user"
    assert seen.scale.source == "ruler" and not seen.scale.warning


def test_what_was_found_is_told_in_px_of_the_clip(looked):
    facts = looked[4].facts()
    (w, h), area = looked[3].size, np.array(facts["mask"][0]["area"])
    assert facts["kind"] == "stream" and facts["flow"]
    assert 0.5 * w < area[:, 0].max() <= w and area[:, 1].max() <= h


def test_a_horizon_and_a_pitch_contradict_each_other(looked):
    clip, _, _, identity, _ = looked
    hints = ClipHints(identity, horizon=((0.0, 1.0), (9.0, 1.0)))
    with pytest.raises(InputRejected, match="two horizons"):
        begin.look(
            Runner(looked[1], FIND_STAGES, progress=Silence()), GivenFiles.of(Inputs(clip)),
            build_config("draft", flat={"shape.pitch": 10.0}), said=hints,
        )  # fmt: skip
