"""Shots made on this machine, each in a process of its own with its share of the cores, its memory and its time."""

from __future__ import annotations

import contextlib
import datetime
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field, replace
from pathlib import Path
from platform import node

from fluidlift import __version__
from fluidlift.farm.shots import Shot
from fluidlift.farm.state import (
    LOG,
    Outcome,
    claimed,
    is_finished,
    list_names,
    manifest_digest,
    read_outcome,
    write_outcome,
)
from fluidlift.machine import THREADS, cores, group_memory

_OUTCOMES = {0: "done", 2: "rejected", 3: "rejected", 4: "done, warnings"}
_STOPPED = (130, 143, -signal.SIGINT, -signal.SIGTERM)
_POLL = 0.5
"""s between two looks at a make that runs"""
_LAST_STEPS = 30.0
"""s that a make that is told to end has to finish the file it writes"""
_STAGE = re.compile(r"\[(\d+)/(\d+)\]", re.ASCII)

Tell = Callable[[str], None]


@dataclass(frozen=True)
class Limits:
    """What each shot may take."""

    jobs: int = 1
    """at a time; the cores of this process are divided among them"""
    seconds: float | None = None
    memory: float | None = None
    """bytes, resident, of a make and all that it starts"""
    retry: str | None = None
    """make only shots that failed like that; None: all that are not finished"""
    program: tuple[str, ...] = (sys.executable, "-m", "fluidlift.cli")
    """what makes a shot, given the arguments of `fluidlift`"""


@dataclass
class _Running:
    """Makes that run, to be ended with the batch."""

    processes: list[subprocess.Popen] = field(default_factory=list)
    stopped: bool = False

    def stop(self) -> None:
        """Tell all to end, and insist on it after a while."""
        self.stopped = True
        for process in self.processes:
            _end(process)


def make_shots(
    shots: list[Shot], folder: Path, limits: Limits, tell: Tell, part: Tell = lambda text: None
) -> Iterator[Outcome]:
    """Each shot as it ends; of those that are finished what is known of them, and no process is started.

    Stopped (Ctrl-C, SIGTERM), the makes that run are told to end; what they finished is kept.

    Args:
        shots: with names of their own.
        folder: for assets, logs and states.
        limits: of each.
        tell: lines for people.
        part: told "done of all" of the stages of a shot that is the only one, for farms.
    """
    list_names(folder, [shot.name for shot in shots])
    running = _Running()
    with ThreadPoolExecutor(limits.jobs) as pool:
        waiting = [pool.submit(_shot, shot, folder, limits, running, tell, part) for shot in shots]
        try:
            for one in as_completed(waiting):
                if (outcome := one.result()) is not None:
                    yield outcome
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            running.stop()
            raise


def _shot(shot: Shot, folder: Path, limits: Limits, running: _Running, tell: Tell, part: Tell) -> Outcome | None:
    """What became of one; None where it is not wanted."""
    fingerprint = shot.fingerprint()
    with claimed(folder, shot.name) as ours:
        known = read_outcome(folder, shot.name)
        if not ours:
            tell(f"{shot.name}: being made by another batch, left to it")
            return None
        if known is not None and is_finished(folder, known, fingerprint):
            now = replace(known, clip=str(shot.clip), licence=shot.licence, source=shot.source)
            if now != known:
                write_outcome(folder, now)
            return now
        if running.stopped or not _wanted(known, limits.retry):
            return None
        outcome = _made(shot, folder, fingerprint, limits, running, tell, part)
        write_outcome(folder, outcome)
        return outcome


def _wanted(known: Outcome | None, retry: str | None) -> bool:
    """Whether a shot that is not finished is to be made: only after one kind of failure, where one is named."""
    return retry is None or (known is not None and known.failure == retry)


def _made(
    shot: Shot, folder: Path, fingerprint: str, limits: Limits, running: _Running, tell: Tell, part: Tell
) -> Outcome:
    log, began = folder / f"{shot.name}{LOG}", time.monotonic()
    tell(f"{shot.name}: begun, {log.name} tells how far it is")
    with log.open("w", encoding="utf-8") as said:
        process = subprocess.Popen(
            [*limits.program, *shot.arguments(folder)], start_new_session=True,
            env=os.environ | environment(limits.jobs),
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=said, text=True, encoding="utf-8",
        )  # fmt: skip
        running.processes.append(process)
        told, over = _watched(process, log, limits, began, part)
    running.processes.remove(process)
    code = process.returncode
    outcome = "failed" if over else _OUTCOMES.get(code, "failed")
    found: dict = {}
    with contextlib.suppress(ValueError, TypeError):
        found = dict(json.loads(told))
    reason = "" if outcome in ("done", "done, warnings") else over or _last_words(log, code)
    stages, card = found.get("stages", {}), found.get("as_filmed", {})
    return Outcome(
        shot.name, outcome, round(time.monotonic() - began, 1), str(folder / f"{shot.name}.fluid"), str(log),
        [str(w) for w in found.get("warnings", ())], reason, _failure(outcome, code, reason),
        str(card.get("verdict") or ""), max((s.get("peak_memory_mb", 0.0) for s in stages.values()), default=0.0),
        node(), __version__, datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"), fingerprint,
        manifest_digest(folder, shot.name), str(shot.clip), shot.licence, shot.source,
    )  # fmt: skip


def _watched(process: subprocess.Popen, log: Path, limits: Limits, began: float, part: Tell) -> tuple[str, str]:
    """What a make printed, once it has ended, and which limit it went over, in words."""
    over, shown = "", ""
    while True:
        try:
            return process.communicate(timeout=_POLL)[0], over
        except subprocess.TimeoutExpired:
            if limits.seconds is not None and time.monotonic() - began > limits.seconds:
                over = f"took longer than {limits.seconds:g} s"
            if limits.memory is not None and group_memory(process.pid) > limits.memory:
                over = f"took more memory than {limits.memory / 1e9:.3g} GB"
            if over:
                _end(process)
            if (far := _stage(log)) != shown:
                shown = far
                part(far)


def _stage(log: Path) -> str:
    """How far a make is, such as "3/10", by the end of its log."""
    with log.open("rb") as file:
        file.seek(max(file.seek(0, os.SEEK_END) - 4096, 0))
        found = _STAGE.findall(file.read().decode("utf-8", "replace"))
    return "/".join(found[-1]) if found else ""


def _end(process: subprocess.Popen) -> None:
    """SIGTERM to a make and all that it started; SIGKILL to what is left after a while."""
    for kind, wait in ((signal.SIGTERM, _LAST_STEPS), (signal.SIGKILL, _LAST_STEPS)):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, kind)
        until = time.monotonic() + wait
        while process.poll() is None and time.monotonic() < until:
            time.sleep(0.05)
        if process.poll() is not None:
            return


def environment(jobs: int) -> dict[str, str]:
    """Of a make beside others: its share of the cores of this process, for every library that starts threads."""
    return dict.fromkeys(THREADS, str(max(cores() // jobs, 1)))


def _failure(outcome: str, code: int, reason: str) -> str:
    """Which class of failure it is; empty for none."""
    if outcome == "rejected":
        return "input"
    if outcome != "failed":
        return ""
    if "took longer than" in reason:
        return "time"
    if "took more memory" in reason or "ran out of memory" in reason or code in (137, -signal.SIGKILL):
        return "memory"
    return "stopped" if code in _STOPPED else "crash"


def _last_words(log: Path, code: int) -> str:
    """What a make said last, on one line; of a wrong option what is wrong with it, without the frame around it."""
    lines = [" ".join(t.replace("│", " ").split()) for t in log.read_text("utf-8", "replace").splitlines()]
    lines = [t for t in lines if any(c.isalnum() for c in t)]
    own = [t for t in lines if t.startswith(("fluidlift: ", "Error parsing"))]
    return (own or lines or [f"ended with {code}"])[-1].removeprefix("fluidlift: ")
