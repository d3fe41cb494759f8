"""What happens to a run that goes wrong through no fault of its user, or that a scheduler ends."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from catalogue import write_clip

import fluidlift.cli as cli
from fluidlift.cli import FAILED, TERMINATED, main
from fluidlift.errors import InputRejected
from fluidlift.progress import PlainProgress, shown_progress

SIGNALS = pytest.mark.skipif(sys.platform == "win32", reason="has no such signals")


@pytest.fixture(autouse=True)
def interruptible():
    """Ctrl-C does what it does at a terminal, in this process and in what it starts: jobs of a shell in the background
    begin with SIGINT ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def broken(monkeypatch, tmp_path):
    """The command `doctor`, which raises what it is told to in the middle of a stage."""

    def breaks(error: BaseException) -> None:
        def command(_: object) -> int:
            with shown_progress() as progress:
                progress.stage("simulate", 2, 3)
                raise error

        monkeypatch.setitem(cli._COMMANDS, cli.Doctor, command)
        monkeypatch.setattr("tempfile.tempdir", str(tmp_path))

    return breaks


def test_an_unexpected_error_is_one_line_with_the_stage_and_a_file_of_details(broken, capsys, tmp_path):
    broken(ZeroDivisionError("a mistake\nin two lines"))
    assert main(["doctor"]) == FAILED
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith("fluidlift: doctor failed while [2/3] re-simulating (ZeroDivisionError: a mistake in two")
    (log,) = tmp_path.glob("fluidlift-*.log")
    assert str(log) in line and "Do: " in line
    text = log.read_text()
    assert "Traceback" in text and "ZeroDivisionError" in text and "fluidlift doctor" in text
    assert log.stat().st_mode & 0o077 == 0


def test_the_traceback_is_shown_where_it_is_asked_for(broken, capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("FLUIDLIFT_DEBUG", "1")
    broken(ZeroDivisionError("a mistake"))
    assert main(["doctor"]) == FAILED
    assert "Traceback" in capsys.readouterr().err
    assert not list(tmp_path.glob("fluidlift-*.log"))


def test_too_little_memory_is_said_as_that(broken, capsys, tmp_path):
    broken(MemoryError())
    assert main(["doctor"]) == FAILED
    assert "doctor ran out of memory while [2/3] re-simulating" in capsys.readouterr().err
    assert not list(tmp_path.glob("fluidlift-*.log"))


def test_a_folder_for_details_that_cannot_be_written_hides_nothing(broken, capsys, monkeypatch, tmp_path):
    broken(ZeroDivisionError("a mistake"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "nowhere"))
    assert main(["doctor"]) == FAILED
    assert "not kept" in capsys.readouterr().err


def test_a_refusal_is_still_a_refusal(broken, capsys):
    broken(InputRejected("this", "that"))
    assert main(["doctor"]) == cli.REJECTED
    assert capsys.readouterr().err.splitlines()[-1] == "fluidlift: this. Needed: that."


@SIGNALS
@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_a_scheduler_ends_a_run_as_a_person_does(tmp_path, sent):
    write_clip(tmp_path / "a.mp4", np.random.default_rng(0).integers(0, 255, (30, 96, 128, 3)).astype(np.uint8))
    run = subprocess.Popen(
        [sys.executable, "-m", "fluidlift", "make", str(tmp_path / "a.mp4"), "-o", str(tmp_path / "a.fluid")],
        stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True,
        env={**os.environ, "FLUIDLIFT_DEBUG": ""}, start_new_session=True,
    )  # fmt: skip
    assert run.stderr is not None
    for line in run.stderr:
        if re.match(r"\[\d/\d+\] reading the clip \.\.\.", line):
            break
    time.sleep(0.2)
    run.send_signal(sent)
    _, said = run.communicate(timeout=60)
    assert run.returncode == (TERMINATED if sent == signal.SIGTERM else FAILED), said
    assert "fluidlift: stopped. Finished stages and frames are kept" in said and "Traceback" not in said
    assert not list(Path(tmp_path).rglob("*.part*"))


@SIGNALS
@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_that_a_library_swallows_ends_the_run_at_its_next_step(sent):
    progress = PlainProgress()
    with cli._interruptible() as terminated:
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(sent)  # as an import within a bare `except:` loses it
        assert terminated.is_set() == (sent == signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):
            progress.stage("flow", 2, 10)
        with pytest.raises(KeyboardInterrupt):
            progress.update(1, 2)
    progress.stage("flow", 2, 10)  # of the next run
    assert signal.getsignal(signal.SIGINT) == signal.default_int_handler


@SIGNALS
def test_an_interrupt_within_code_given_as_text_leaves_the_exit_code_alone(tmp_path):
    (tmp_path / "run.py").write_text("""
import signal, sys
import fluidlift.cli as cli
def command(_):  # as a dataclass is defined while a module is being imported
    exec("signal.raise_signal(signal.SIGINT)")
cli._COMMANDS[cli.Doctor] = command
sys.exit(cli.main(["doctor"]))
""")
    run = subprocess.run([sys.executable, "-m", "run"], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert (run.returncode, "fluidlift: stopped." in run.stderr) == (FAILED, True), run.stderr
