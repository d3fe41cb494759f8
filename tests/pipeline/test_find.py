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
from fluidlift.types.hints import Arrow, Click, ClipHints, Region, Ruler


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
    given, config = GivenFiles.of(Inputs(clip)), begin.uncropped(config)
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


def reversed_arrow(looked):
    """An arrow in the middle of the stream that points upstream, and the way that it was found to run there."""
    flow = looked[4].facts()["flow"]
    middle = 0.5 * np.array(looked[3].size)
    nearest = min(flow, key=lambda a: float(np.linalg.norm(np.array(a["at"]) - middle)))
    at, to = np.array(nearest["at"]), np.array(nearest["to"])
    back = at - 20.0 * (to - at) / np.linalg.norm(to - at)
    return Arrow((at[0], at[1]), (back[0], back[1])), to - at


def test_an_arrow_turns_what_is_found_around_it_and_the_mainstream_and_is_told(looked):
    arrow, found_way = reversed_arrow(looked)
    hints = ClipHints(looked[3], flow=(arrow,))
    assert again(looked, hints)[0] == ["view"]
    clip, folder, config = looked[:3]
    found = find_hints(Inputs(clip), folder, config, hints)
    assert any("arrow 1 of the flow" in w for w in found.warnings)
    now = min(found.facts()["flow"], key=lambda a: float(np.linalg.norm(np.array(a["at"]) - arrow.at)))
    assert np.dot(np.array(now["to"]) - now["at"], found_way) < 0
    ways = []
    for said in (ClipHints(looked[3]), hints):
        runner = Runner(folder, ("read", "flow", "segment", "geometry"), progress=Silence())
        given = GivenFiles.of(Inputs(clip))
        shaped = begin.shape(runner, begin.look(runner, given, config, said=said), given, config, said)
        # the world's x axis lies along the mainstream: seen by the camera, the two point against each other
        ways.append(shaped.camera.camera_from_world.rotation @ shaped.setting.terrain.mainstream)
    assert ways[0][:2] @ ways[1][:2] < 0 and shaped.said_flow is not None


def test_a_click_is_found_again_without_looking_at_the_clip_anew(looked, monkeypatch):
    from fluidlift.shape import segment as finding

    clip, folder, config, identity, _ = looked
    (w, h), memory, asked = identity.size, {}, []
    real = finding.clues_of
    monkeypatch.setattr(finding, "clues_of", lambda *args: (asked.append(1), real(*args))[1])
    masks = []
    for x in (0.4, 0.6):
        hints = ClipHints(identity, clicks=(Click((x * w, 0.5 * h), False),))
        found = find_hints(Inputs(clip), folder, config, hints, memory=memory)
        masks.append(np.array(found.segmentation.labels.labels))
    assert len(asked) == 1
    alone = find_hints(Inputs(clip), folder / "alone", config, hints)
    assert np.array_equal(np.array(alone.segmentation.labels.labels), masks[1])


def test_a_level_line_gives_the_roll_and_what_contradicts_it_is_refused(looked):
    identity = looked[3]
    w, h = identity.size
    level = ((0.0, 0.5 * h), (float(w), 0.5 * h + 0.05 * w))
    seen = again(looked, ClipHints(identity, level=level))[2]
    assert seen.up.roll == pytest.approx(-np.degrees(np.arctan(0.05)), abs=1.0) or seen.up.roll == pytest.approx(
        np.degrees(np.arctan(0.05)), abs=1.0
    )
    with pytest.raises(InputRejected, match="two horizons: the level line"):
        again(looked, ClipHints(identity, level=level, horizon=((0.0, 0.4 * h), (float(w), 0.4 * h - 0.1 * w))))
    ledge = Region("ledge", ((0.3 * w, 0.3 * h), (0.7 * w, 0.3 * h), (0.7 * w, 0.7 * h), (0.3 * w, 0.7 * h)))
    up = Arrow((0.5 * w, 0.6 * h), (0.5 * w, 0.4 * h))
    with pytest.raises(InputRejected, match="ledge 1 runs uphill"):
        again(looked, ClipHints(identity, regions=(ledge,), flow=(up,)))


def test_the_path_of_the_camera_and_the_parts_are_told(looked):
    facts = looked[4].facts()
    assert facts["camera"]["words"].startswith("the camera ") and facts["parts"][0]["is"] == facts["kind"]
    assert 0.0 <= facts["level_probability"] <= 1.0
