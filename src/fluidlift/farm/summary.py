"""How far a folder of shots is: counts, rate, failures by class; as text, JSON and CSV."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from fluidlift.farm.state import Outcome, is_running, names_of, read_outcome

SUMMARY = "batch.json"
_HIDDEN = ("fingerprint", "manifest")


@dataclass(frozen=True)
class Status:
    """Of a folder."""

    outcomes: tuple[Outcome, ...]
    """of shots that ended, in the order of their list"""
    running: tuple[str, ...]
    """being made, as far as locks reach"""
    waiting: tuple[str, ...]

    @property
    def done(self) -> tuple[Outcome, ...]:
        """Those that became assets."""
        return tuple(o for o in self.outcomes if o.well)

    @property
    def seconds(self) -> float:
        """Mean time of a shot that became an asset, 0 where there is none."""
        return sum(o.seconds for o in self.done) / max(len(self.done), 1)

    @property
    def failures(self) -> dict[str, int]:
        """Shots by class of failure."""
        return dict(Counter(o.failure or "crash" for o in self.outcomes if not o.well))

    def to_dict(self) -> dict:
        """For programs."""
        return {
            "done": len(self.done), "with_warnings": sum(bool(o.warnings) for o in self.done),
            "failed": self.failures, "running": list(self.running), "waiting": list(self.waiting),
            "seconds_per_shot": round(self.seconds, 1), "seconds_left": round(self.left, 1),
            "versions": sorted({o.version for o in self.outcomes if o.version}), "shots": rows(self.outcomes),
        }  # fmt: skip

    @property
    def left(self) -> float:
        """Seconds until all are made: those that wait, over those that run at a time (one where none does)."""
        return self.seconds * len(self.waiting) / max(len(self.running), 1)

    def lines(self) -> list[str]:
        """For people."""
        count = len(self.outcomes) + len(self.running) + len(self.waiting)
        warned = sum(bool(o.warnings) for o in self.done)
        told = [f"{len(self.done)} of {count} done ({warned} with warnings), {len(self.running)} running, "
                f"{len(self.waiting)} waiting"]  # fmt: skip
        if self.done:
            told.append(
                f"{self.seconds:.0f} s a shot" + (f", about {self.left / 60:.0f} min left" if self.waiting else "")
            )
        if self.failures:
            told.append("failed: " + ", ".join(f"{n} {kind}" for kind, n in sorted(self.failures.items())))
        told += [f"  {o.line()}" for o in self.outcomes if not o.well]
        versions = sorted({o.version for o in self.outcomes if o.version})
        if len(versions) > 1:
            told.append(f"made by several versions of fluidlift: {', '.join(versions)}")
        return told


def status_of(folder: Path) -> Status:
    """What is known of a folder's shots."""
    ended, running, waiting = [], [], []
    for name in names_of(folder):
        found = read_outcome(folder, name)
        if is_running(folder, name):
            running.append(name)
        elif found is None:
            waiting.append(name)
        else:
            ended.append(found)
    return Status(tuple(ended), tuple(running), tuple(waiting))


def rows(outcomes: Sequence[Outcome]) -> list[dict]:
    """Without what only resuming needs."""
    return [{k: v for k, v in dataclasses.asdict(o).items() if k not in _HIDDEN} for o in outcomes]


def as_csv(outcomes: Sequence[Outcome]) -> str:
    """A row per shot; of warnings their number."""
    file = io.StringIO()
    names = [f.name for f in dataclasses.fields(Outcome) if f.name not in _HIDDEN]
    writer = csv.DictWriter(file, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(row | {"warnings": len(row["warnings"])} for row in rows(outcomes))
    return file.getvalue()


def summarise(folder: Path) -> None:
    """Write batch.json: every shot of the folder that ended, whichever batch made it."""
    from fluidlift.io.atomic import atomic_write

    found = [o for name in names_of(folder) if (o := read_outcome(folder, name)) is not None]
    with atomic_write(folder / SUMMARY) as file:
        file.write((json.dumps(rows(found), indent=1) + "\n").encode())
