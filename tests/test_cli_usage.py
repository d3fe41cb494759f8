"""What a person sees who types something wrong, asks for help, or reads only the first lines."""

import io
import sys
from typing import get_args, get_type_hints

import numpy as np
import pytest
import tyro

from fluidlift.cli import FAILED, REJECTED, USAGE, Command, main
from fluidlift.cli.options import Make
from fluidlift.scene.splat_files import frames_told


def shown(capsys, *arguments):
    """What is printed by a command that ends in the parser, on one line, without the frame around it."""
    with pytest.raises(SystemExit) as caught:
        main(list(arguments))
    said = capsys.readouterr()
    return caught.value.code, " ".join((said.out + said.err).replace("│", " ").split())


def test_a_wrong_kind_is_answered_with_the_kinds_there_are_in_their_order(capsys):
    code, said = shown(capsys, "make", "x.mp4", "--kind", "river")
    assert code == USAGE
    assert "('auto', 'stream', 'fall', 'pour', 'plume', 'dam', 'basin', 'fountain')" in said


@pytest.mark.parametrize("command", ["make", "motion", "mask", "studio", "sim", "fit", "render", "export", "inspect"])
def test_help_does_not_offer_none(command, capsys):
    code, said = shown(capsys, command, "--help")
    assert code == 0
    assert "None" not in said and "(default: )" not in said and "default: not given" not in said


@pytest.mark.parametrize("command", sorted(get_args(Command), key=lambda c: c.__name__), ids=lambda c: c.__name__)
def test_help_tells_what_stands_without_an_option(command, capsys):
    """A sign such as | in its placeholder takes it out of the help without a word."""
    (mark,) = tyro.conf.Positional[int].__metadata__
    hints = get_type_hints(command, include_extras=True).values()
    bare = any(mark in getattr(hint, "__metadata__", ()) for hint in hints)
    _, said = shown(capsys, command.__name__.lower(), "--help")
    assert ("positional arguments" in said) == bare
    assert "default: True" not in said


def test_learned_models_are_asked_for_alike_wherever_a_clip_is_looked_at(capsys):
    told = {}
    for command in ("make", "mask", "motion", "studio"):
        _, said = shown(capsys, command, "--help")
        text = " ".join(said[said.rindex("--models STR") :].replace("│", " ").split())
        told[command] = text.partition("(`fluidlift models`)")[0]
    assert len(set(told.values())) == 1 and "names with commas" in told["make"]


def test_help_of_make_has_its_options_in_groups(capsys):
    code, said = shown(capsys, "make", "--help")
    groups = ["input options", "scene options", "part options", "quality options", "body options", "settings options"]
    places = [said.index(group) for group in groups]
    assert code == 0 and places == sorted(places)
    assert places[0] < said.index("--mask PATH") < places[1] < said.index("--size METRES") < places[2]
    assert "--max-pixels" not in said


def test_an_old_option_without_a_value_is_a_wrong_option(capsys):
    code, said = shown(capsys, "make", "x.mp4", "--max-pixels")
    assert code == USAGE and "--max-pixels" in said


def test_a_word_in_place_of_a_number_names_its_option(capsys):
    code, said = shown(capsys, "make", "x.mp4", "--size", "big")
    assert code == USAGE
    assert "--size METRES" in said and "big" in said


@pytest.mark.parametrize(
    ("word", "meant"),
    [("mak", "fluidlift make or fluidlift mask"), ("rendr", "fluidlift render"), ("SIM", "fluidlift sim")],
)
def test_a_command_with_a_letter_missing_is_answered_with_those_it_looks_like(word, meant, capsys):
    assert main([word, "x.mp4"]) == USAGE
    assert capsys.readouterr().err == f"fluidlift: there is no command '{word}'. Do: {meant}\n"


def test_a_length_in_another_unit_is_one_in_metres(stream_clip, tmp_path, capsys):
    assert (
        main(["make", str(stream_clip), "--size", "30 cm", "--duration=500ms", "--roll", "0.1rad", "--print-config"])
        == 0
    )
    said = capsys.readouterr().out
    assert "size: 0.3\n" in said and "duration: 0.5\n" in said and "roll: 5.7295" in said


def test_options_that_are_left_out_are_none():
    import tyro

    from fluidlift.cli.optional import REGISTRY

    with REGISTRY:
        command = tyro.cli(Make, args=["x.mp4", "--fov", "40"])
    assert command.scene.fov == 40.0
    assert command.scene.kind is command.scene.size is command.input.mask is None


def test_a_reader_who_has_seen_enough_gets_no_traceback(monkeypatch):
    class Closed(io.StringIO):
        def write(self, text):
            raise BrokenPipeError

    monkeypatch.setattr(sys, "stdout", Closed())
    assert main(["--version"]) == FAILED


def refused_early(capsys, tmp_path, clip, *more):
    """The message, and the stages that had begun."""
    capsys.readouterr()
    assert main(["make", str(clip), "-o", str(tmp_path / "x.fluid"), *map(str, more)]) == REJECTED
    said = capsys.readouterr().err
    return said, [line.partition(" ")[2] for line in said.splitlines() if line.startswith("[") and "..." in line]


def test_a_depth_file_of_another_shape_is_refused_before_the_flow_is_computed(stream_clip, tmp_path, capsys):
    file = tmp_path / "depth.npy"
    np.save(file, np.linspace(1, 2, 64 * 64, dtype=np.float32).reshape(64, 64))
    said, begun = refused_early(capsys, tmp_path, stream_clip, "--depth", file)
    assert "depth.npy" in said and "aspect ratio" in said
    assert not any("finding the fluid" in stage for stage in begun)


def test_a_folder_without_bodies_is_refused_before_the_flow_is_computed(stream_clip, tmp_path, capsys):
    (tmp_path / "bodies").mkdir()
    said, begun = refused_early(capsys, tmp_path, stream_clip, "--geometry-from", tmp_path / "bodies")
    assert "no PLY file in 'bodies'" in said
    assert not any("finding the fluid" in stage for stage in begun)


def test_bodies_that_are_not_there_are_asked_for_by_the_option_that_exists(stream_clip, tmp_path, capsys):
    said, begun = refused_early(capsys, tmp_path, stream_clip, "--geometry-from", tmp_path / "nowhere")
    assert "--geometry-from" in said and "folder" in said
    assert not begun


@pytest.mark.parametrize("weights", [[], ["--depth-weights", "nowhere.pt"]])
def test_a_depth_model_without_weights_is_refused_before_the_clip_is_read(weights, stream_clip, tmp_path, capsys):
    said, begun = refused_early(capsys, tmp_path, stream_clip, "--depth-model", "moge", *weights)
    assert "--depth-weights" in said
    assert not begun


def test_one_frame_is_told_in_the_singular():
    assert [frames_told(n) for n in (0, 1, 2)] == ["0 frames", "1 frame", "2 frames"]
