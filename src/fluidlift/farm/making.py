"""One shot, made in a process of its own with its share of the cores, its memory and its time.

Every engine makes shots by this, on whatever machine: limits, classes of failure and ways to end are the same.
"""

from __future__ import annotations

import contextlib
import datetime
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from platform import node

from fluidlift import __version__
from fluidlift.farm.engine import Limits, Tell
from fluidlift.farm.guard import WATCHED
from fluidlift.farm.shots import Shot
from fluidlift.farm.state import (
    LOG,
    ShotOutcome,
    claimed,
    is_finished,
    manifest_digest,
    read_outcome,
    write_outcome,
)
from fluidlift.farm.store import Store
from fluidlift.io.atomic import require_free_space
from fluidlift.machine import THREADS, cores, group_memory

MAKE = (sys.executable, "-m", "fluidlift")
"""what makes a shot, given the arguments of `fluidlift`"""
ROOM = 600_000_000
"""bytes that are free before a shot begins: what a draft of the demo takes, with its cache; a full disk fails all"""
_OUTCOMES = {0: "done", 2: "rejected", 3: "rejected", 4: "done, warnings"}
_STOPPED = (130, 143, -signal.SIGINT, -signal.SIGTERM)
_POLL = 0.5
"""s between two looks at a make that runs"""
_LAST_STEPS = 30.0
"""s that a make that is told to end has to finish the file it writes"""
_HANDOVER = 2.0
"""s to wait for the lock of a shot: makes of a batch that was killed end in milliseconds, or within a long call"""
_STAGE = re.compile(r"\[(\d+)/(\d+)\]", re.ASCII)


@dataclass
class RunningMakes:
    """Makes that run, to be ended with the batch; who is told how far they are."""

    tell: Tell = lambda text: None
    """lines for people"""
    part: Tell = lambda text: None
    """told "done of all" of the stages of a shot that is the only one, for farms"""
    processes: list[subprocess.Popen] = field(default_factory=list)
    stopped: bool = False
    settle: float = 0.0
    """s after a make was killed from outside until that is written down: where the killer ends this process next, it
    was no failure of the shot"""

    def stop(self) -> None:
        """Tell all to end, and insist on it after a while."""
        self.stopped = True
        for process in self.processes:
            _end(process)


def make_shot(
    shot: Shot, folder: Path, limits: Limits, making: RunningMakes, store: Store | None = None
) -> ShotOutcome | None:
    """What became of one; None where somebody else makes it, or it is not wanted.

    Args:
        shot: which.
        folder: for its asset, log and state.
        limits: of this try.
        making: where the process is listed while it runs.
        store: where its files belong in the end; None: where they are made.

    Raises:
        InputRejected: the disk of the folder is full, or the store cannot be read.
    """
    fingerprint = shot.fingerprint()
    with claimed(folder, shot.name, wait=_HANDOVER) as lock:
        if lock is None:
            making.tell(f"{shot.name}: being made by another batch, left to it")
            return None
        known = _known(shot, folder, fingerprint) if store is None else store.finished(shot)
        if known is not None:
            return known
        if making.stopped or not is_wanted(folder, shot.name, limits.retry):
            return None
        require_free_space(folder, ROOM)
        outcome = _made(shot, folder, fingerprint, limits, making, lock)
        if store is not None:
            outcome = store.put(outcome)
        write_outcome(folder, outcome)
        if store is not None and outcome.well:
            shutil.rmtree(folder / f"{shot.name}.fluid")
        return outcome


def finished(shot: Shot, folder: Path, store: Store | None = None) -> ShotOutcome | None:
    """What is known of a shot with which nothing is left to do; None of others, and of one that somebody makes."""
    if store is not None:
        return store.finished(shot)
    known = read_outcome(folder, shot.name)
    if known is None or not known.well:  # the clip, which may be large, is not read in vain
        return None
    with claimed(folder, shot.name) as lock:
        return None if lock is None else _known(shot, folder, shot.fingerprint())


def _known(shot: Shot, folder: Path, fingerprint: str) -> ShotOutcome | None:
    """As `finished`, while its lock is held; what the list says of the clip is kept."""
    known = read_outcome(folder, shot.name)
    if known is None or not is_finished(folder, known, fingerprint):
        return None
    now = replace(known, clip=str(shot.clip), licence=shot.licence, source=shot.source)
    if now != known:
        write_outcome(folder, now)
    return now


def is_wanted(folder: Path, name: str, retry: str | None) -> bool:
    """Whether a shot that is not finished is to be made: only after one kind of failure, where one is named."""
    if retry is None:
        return True
    known = read_outcome(folder, name)
    return known is not None and known.failure == retry


def _made(shot: Shot, folder: Path, fingerprint: str, limits: Limits, making: RunningMakes, lock: int) -> ShotOutcome:
    log, began = folder / f"{shot.name}{LOG}", time.monotonic()
    making.tell(f"{shot.name}: begun, {log.name} tells how far it is")
    with _started(shot, folder, limits, log, lock) as process:
        making.processes.append(process)
        told, over = _watched(process, log, limits, began, making)
    making.processes.remove(process)
    code = process.returncode
    if code == -signal.SIGKILL and not over and not making.stopped:
        time.sleep(making.settle)
    outcome = "failed" if over else _OUTCOMES.get(code, "failed")
    found: dict = {}
    with contextlib.suppress(ValueError, TypeError):
        found = dict(json.loads(told))
    reason = "" if outcome in ("done", "done, warnings") else over or _last_words(log, code)
    stages, card = found.get("stages", {}), found.get("as_filmed", {})
    return ShotOutcome(
        shot.name, outcome, round(time.monotonic() - began, 1), str(folder / f"{shot.name}.fluid"), str(log),
        [str(w) for w in found.get("warnings", ())], reason, failure_of(outcome, code, reason),
        str(card.get("verdict") or ""), max((s.get("peak_memory_mb", 0.0) for s in stages.values()), default=0.0),
        node(), __version__, now(), fingerprint, manifest_digest(folder, shot.name), str(shot.clip), shot.licence,
        shot.source,
    )  # fmt: skip


def now() -> str:
    """UTC, for people."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


@contextlib.contextmanager
def _started(shot: Shot, folder: Path, limits: Limits, log: Path, lock: int) -> Iterator[subprocess.Popen]:
    """A make that begins: it holds the shot's lock as well, and ends when this process does, however that ends."""
    read, write = os.pipe()
    try:
        with log.open("w", encoding="utf-8") as said:
            process = subprocess.Popen(
                [*(limits.program or MAKE), *shot.arguments(folder)], start_new_session=True, pass_fds=(lock,),
                env=os.environ | environment(limits.threads or cores()) | {WATCHED: "1"},
                stdin=read, stdout=subprocess.PIPE, stderr=said, text=True, encoding="utf-8",
            )  # fmt: skip
        os.close(read)
        read = -1
        yield process
    finally:
        os.close(write)
        if read >= 0:
            os.close(read)


def _watched(
    process: subprocess.Popen, log: Path, limits: Limits, began: float, making: RunningMakes
) -> tuple[str, str]:
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
                making.part(far)
        except KeyboardInterrupt:  # a task that is cancelled
            making.stopped = True
            _end(process)


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


def environment(threads: int) -> dict[str, str]:
    """Of a make beside others: its share of the cores, for every library that starts threads."""
    return dict.fromkeys(THREADS, str(max(threads, 1)))


def failure_of(outcome: str, code: int, reason: str) -> str:
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
