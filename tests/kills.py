"""`make` is killed at random moments and resumed: what comes out is what an undisturbed run makes.

    python tests/kills.py [--runs 10] [--kills 5] [--seed S] [--record]     many, which takes a while

A run is killed (SIGKILL) some times, each at a random line of what it tells plus a random delay, and then let finish.
"""

from __future__ import annotations

import argparse
import datetime
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

if __name__ == "__main__":  # as pytest finds them
    sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1])]

from catalogue import digests, stream_pictures, write_clip

OPTIONS = (
    "--set", "shape.cells=12", "--set", "shape.refine_iterations=0", "--set", "motion.targets=1",
    "--set", "fit.max_seconds=600", "--set", "simulate.frames=6",
)  # fmt: skip
"""the smallest asset; the fit may take its time, because one that the clock ends depends on the machine"""
LONGEST_WAIT = 0.6
"""s after a line, before the kill"""


@dataclass(frozen=True)
class Undisturbed:
    """What a run makes that nobody kills."""

    clip: Path
    lines: int
    """that it tells on stderr"""
    digests: dict[str, str]


@dataclass(frozen=True)
class Outcome:
    """What came of a run that was killed."""

    kills: int
    different: list[str]
    """files that are not those of the undisturbed run"""
    left: list[str]
    """temporary files"""
    said: str
    """by the run that was let finish"""


def started(clip: Path, folder: Path) -> subprocess.Popen[str]:
    """A `make` whose stderr can be read."""
    command = [sys.executable, "-m", "fluidlift", "make", str(clip), "--out", str(folder), *OPTIONS]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def undisturbed(place: Path) -> Undisturbed:
    """Make the asset once, in a folder."""
    clip = write_clip(place / "stream.mp4", stream_pictures())
    run = started(clip, place / "whole.fluid")
    _, said = run.communicate(timeout=600)
    if run.returncode not in (0, 4):
        raise RuntimeError(said)
    return Undisturbed(clip, len(said.splitlines()), digests(place / "whole.fluid"))


def killed(whole: Undisturbed, folder: Path, draw: random.Random) -> bool:
    """Start, and kill at a random moment; False where the run had finished before."""
    run, at = started(whole.clip, folder), draw.randint(1, max(whole.lines - 1, 1))
    assert run.stderr is not None
    for count, _ in enumerate(run.stderr, start=1):
        if count >= at:
            time.sleep(draw.uniform(0.0, LONGEST_WAIT))
            break
    run.send_signal(signal.SIGKILL)
    run.communicate()
    return run.returncode == -signal.SIGKILL


def resumed(whole: Undisturbed, folder: Path, draw: random.Random, kills: int) -> Outcome:
    """Kill a run some times, let it finish, and compare."""
    done = sum(killed(whole, folder, draw) for _ in range(kills))
    run = started(whole.clip, folder)
    _, said = run.communicate(timeout=600)
    found = digests(folder) if run.returncode in (0, 4) else {}
    different = sorted(name for name in found.keys() | whole.digests if found.get(name) != whole.digests.get(name))
    left = [p.name for p in folder.rglob("*.part*")]
    return Outcome(done, different, left, said)


def record(runs: int, kills: int, wrong: int, command: str) -> None:
    """The figures for docs/results.md."""
    from benchmarks.report import put

    subject = "kill -9 of make, then resumed"
    values = {"kills": kills, "runs let finish": runs, "wrong results": wrong}
    put("trust", [{"subject": subject, "figure": f, "value": v} for f, v in values.items()], command=command,
        date=str(datetime.date.today()))  # fmt: skip


def main() -> int:
    """Kill many; 1 where one came out otherwise."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--kills", type=int, default=5, help="of each run, before it is let finish")
    parser.add_argument("--seed", type=int, default=int.from_bytes(os.urandom(4)))
    parser.add_argument("--record", action="store_true", help="write the figures for docs/results.md")
    asked = parser.parse_args()
    draw, kills, wrong = random.Random(asked.seed), 0, 0
    print(f"seed {asked.seed}", flush=True)
    with tempfile.TemporaryDirectory() as place:
        whole = undisturbed(Path(place))
        for k in range(asked.runs):
            outcome = resumed(whole, Path(place) / f"{k}.fluid", draw, asked.kills)
            kills, wrong = kills + outcome.kills, wrong + bool(outcome.different or outcome.left)
            print(f"run {k}: {outcome.kills} kills; different: {outcome.different}; left: {outcome.left}", flush=True)
    if asked.record:
        command = f"python tests/kills.py --runs {asked.runs} --kills {asked.kills} --seed {asked.seed} --record"
        record(asked.runs, kills, wrong, command)
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
