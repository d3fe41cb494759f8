"""Settings: presets, files, options and overrides, in this order, and what is refused."""

import dataclasses

import pytest
import yaml

from fluidlift.config import PRESETS, RANGES, JobConfig, build_config
from fluidlift.errors import InputRejected


def test_the_defaults_are_the_draft():
    assert build_config() == JobConfig()


@pytest.mark.parametrize("preset", list(PRESETS))
def test_a_preset_sets_what_it_names_and_nothing_else(preset):
    config, plain = build_config(preset).to_dict(), JobConfig().to_dict()
    assert config.pop("preset") == preset
    plain.pop("preset")
    for section, values in PRESETS[preset].items():
        plain[section] |= values
    assert config == plain


def test_finer_presets_are_finer():
    draft, standard, hero = (build_config(p) for p in ("draft", "standard", "hero"))
    for figure in (
        lambda c: c.shape.cells, lambda c: c.shape.cell_limit, lambda c: c.shape.max_gaussians,
        lambda c: c.motion.targets, lambda c: c.fit.max_seconds, lambda c: c.simulate.max_particles,
    ):  # fmt: skip
        assert figure(draft) < figure(standard) < figure(hero)


def test_the_preset_of_the_paper_is_its_method_throughout():
    config = build_config("paper")
    motion, fit, simulate = config.motion, config.fit, config.simulate
    assert (motion.method, motion.filling) == ("farneback", "sum")
    assert (motion.divergence, motion.constraint) == ("paper", "hard")
    assert (motion.half_window, motion.reach, motion.along_paths, motion.wall) == (0, 0, False, "cubic")
    assert (fit.method, fit.pressure, fit.advection_gradient) == ("adam", "recurrent", "upwind")
    assert (fit.compare, fit.start_rounds, fit.free) == ("last", 0, ("all",))
    assert (simulate.skin, simulate.follow, simulate.guide) == (False, 0.0, 0.0)
    assert config.shape == build_config("draft").shape  # as fine as draft: what differs is the method


def test_later_sources_win(tmp_path):
    file = tmp_path / "job.yaml"
    file.write_text("shape:\n  cells: 50\n  stride: 5\n  rays: 11\nfit:\n  max_seconds: 7\n")
    config = build_config("standard", file, ["shape.rays=13"], {"shape.stride": 6, "shape.size": None})
    assert config.shape.cells == 50  # file over preset
    assert config.shape.stride == 6  # option over file
    assert config.shape.rays == 13  # override over all
    assert config.fit.max_seconds == 7.0
    assert config.shape.refine_iterations == 100  # the preset where nothing else is said
    assert config.shape.size is None  # an option that was not given


def test_a_file_may_choose_the_preset(tmp_path):
    file = tmp_path / "job.yaml"
    file.write_text("preset: hero\nshape: {cells: 40}\n")
    config = build_config(None, file)
    assert build_config("draft", file).preset == "draft"  # said on the command line, it wins
    assert config.preset == "hero" and config.read.max_size == 768 and config.shape.cells == 40


@pytest.mark.parametrize("own", ["seed: 3\n", "preset: standard\n"])
def test_an_override_of_the_preset_brings_all_its_values(tmp_path, own):
    file = tmp_path / "job.yaml"
    file.write_text(own)
    assert build_config("draft", file, ["preset=hero"]) == dataclasses.replace(
        build_config("hero"), seed=3 if "seed" in own else 0
    )


def test_what_is_printed_can_be_read_again(tmp_path):
    config = build_config("standard", None, ["shape.size=2.5", "shape.kind=fall", "seed=4"])
    file = tmp_path / "printed.yaml"
    file.write_text(yaml.safe_dump(config.to_dict(), sort_keys=False))
    assert build_config(None, file) == config


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("shape.size=2", 2.0), ("shape.size=null", None), ("shape.kind=pour", "pour"), ("show.usd=false", False),
        (" shape.cells = 32 ", 32), ("shape.pitch=12", 12.0),
    ],
)  # fmt: skip
def test_overrides_have_the_type_of_their_setting(text, value):
    name = text.partition("=")[0].strip()
    section, field = name.split(".")
    got = getattr(getattr(build_config(overrides=[text]), section), field)
    assert got == value and type(got) is type(value)


@pytest.mark.parametrize("number", ["1e1", "1.0e1", "1.e+1", "10"])
def test_every_way_to_write_a_number_is_one(number):
    assert build_config(overrides=[f"fit.max_seconds={number}"]).fit.max_seconds == 10.0


@pytest.mark.parametrize(
    "text",
    [
        "shape.cells", "cells=3", "shape.cell=3", "shape.cells.x=3", "shape=3", "shape.cells=many", "shape.cells=2.5",
        "shape.cells=true", "show.usd=1", "shape.kind=river", "shape.size=[1", "shape.size=[1, 2]", "=3", "seed=1.5",
        "preset=huge",
    ],
)  # fmt: skip
def test_overrides_that_make_no_sense_are_rejected(text):
    with pytest.raises(InputRejected) as caught:
        build_config(overrides=[text])
    assert caught.value.needed  # the message says what would be right


@pytest.mark.parametrize(
    "text",
    [
        "shape.cells=0", "shape.stride=0", "shape.fov=0", "shape.fov=200", "shape.size=0", "shape.size=-2",
        "shape.size=.nan", "shape.size=.inf", "shape.pitch=120", "shape.roll=200", "shape.depth_ratio=0",
        "shape.refine_iterations=-1", "shape.max_gaussians=0",
        "shape.longest_union=0", "shape.rays=0", "shape.cell_limit=0", "motion.targets=0", "motion.complete_every=0",
        "fit.max_seconds=-1", "simulate.frames=0", "simulate.max_particles=0", "show.width=0", "read.max_size=4",
        "read.max_frames=0", "read.max_pixels=-5", "read.fps=0", "read.start=-1", "read.duration=0", "seed=-1",
    ],
)  # fmt: skip
def test_numbers_that_mean_nothing_are_rejected_before_the_work_begins(text):
    with pytest.raises(InputRejected) as caught:
        build_config(overrides=[text])
    assert text.partition("=")[0] in caught.value.got


def test_every_number_has_a_range_and_every_default_lies_in_it():
    for preset in PRESETS:
        values = build_config(preset).to_dict()
        flat = {"seed": values["seed"]}
        flat |= {f"{s}.{k}": v for s, part in values.items() if isinstance(part, dict) for k, v in part.items()}
        numbers = {k: v for k, v in flat.items() if isinstance(v, int | float) and not isinstance(v, bool)}
        assert set(numbers) <= set(RANGES) <= set(flat)
        assert all(RANGES[k][0] <= v <= RANGES[k][1] for k, v in numbers.items())


@pytest.mark.parametrize(
    "content",
    ["[1, 2", "- a\n- b\n", "just words", "shape:\n  cell: 3\n", "shapes: {cells: 3}\n", "shape: 3\n", "",
     "preset: huge\n", "shape: {cells: {x: 3}}\n"],
)  # fmt: skip
def test_config_files_that_make_no_sense_are_rejected(tmp_path, content):
    file = tmp_path / "job.yaml"
    file.write_text(content)
    with pytest.raises(InputRejected):
        build_config(file=file)


def test_a_missing_config_file_is_named(tmp_path):
    with pytest.raises(InputRejected, match=r"nowhere\.yaml"):
        build_config(file=tmp_path / "nowhere.yaml")


def test_an_unknown_preset_is_answered_with_the_known_ones():
    with pytest.raises(InputRejected, match="standard"):
        build_config("huge")


def test_settings_do_not_change_once_made():
    with pytest.raises(dataclasses.FrozenInstanceError):
        build_config().seed = 3
