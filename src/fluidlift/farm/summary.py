"""How far a folder of shots is: counts, rate, failures by class; as text, JSON, CSV and Parquet."""

from __future__ import annotations

import csv
import dataclasses
import datetime
import io
import json
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from fluidlift.farm.state import ShotOutcome, is_running, names_of, read_outcome

SUMMARY, TABLE, PARQUET = "batch.json", "batch.csv", "batch.parquet"
_HIDDEN = ("fingerprint", "manifest")


@dataclass(frozen=True)
class Status:
    """Of a folder."""

    outcomes: tuple[ShotOutcome, ...]
    """of shots that ended, in the order of their list"""
    running: tuple[str, ...]
    """being made, as far as locks reach"""
    waiting: tuple[str, ...]

    @property
    def done(self) -> tuple[ShotOutcome, ...]:
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


def rows(outcomes: Sequence[ShotOutcome]) -> list[dict]:
    """Without what only resuming needs."""
    return [{k: v for k, v in dataclasses.asdict(o).items() if k not in _HIDDEN} for o in outcomes]


def as_csv(outcomes: Sequence[ShotOutcome]) -> str:
    """A row per shot; of warnings their number."""
    file = io.StringIO()
    names = [f.name for f in dataclasses.fields(ShotOutcome) if f.name not in _HIDDEN]
    writer = csv.DictWriter(file, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(row | {"warnings": len(row["warnings"])} for row in rows(outcomes))
    return file.getvalue()


def write_parquet(folder: Path, outcomes: Sequence[ShotOutcome]) -> Path:
    """Write batch.parquet: a row per shot that ended.

    Args:
        folder: of the batch.
        outcomes: of its shots.

    Raises:
        InputRejected: the folder cannot be written.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    from fluidlift.io.atomic import atomic_path

    path = folder / PARQUET
    kinds = {"float": pa.float64(), "list[str]": pa.list_(pa.string())}
    fields = [f for f in dataclasses.fields(ShotOutcome) if f.name not in _HIDDEN]
    schema = pa.schema([(f.name, kinds.get(str(f.type), pa.string())) for f in fields])
    with atomic_path(path) as temporary:
        pq.write_table(pa.Table.from_pylist(rows(outcomes), schema=schema), temporary)
    return path


@dataclass
class Summary:
    """batch.json of a folder: every shot that ended, whichever batch made it.

    Reading what became of ten thousand shots takes long: while shots are made it is written so seldom that a twentieth
    of the time at most goes into it.
    """

    folder: Path
    _next: float = 0.0

    def write_now_and_then(self) -> None:
        """Write it where it is time to."""
        if (began := time.monotonic()) >= self._next:
            self.write()
            self._next = time.monotonic() + 20.0 * (time.monotonic() - began)

    def write(self, *, table: bool = False, parquet: bool = False) -> None:
        """Write it.

        Args:
            table: batch.csv as well.
            parquet: batch.parquet as well.

        Raises:
            InputRejected: the folder cannot be written.
        """
        from fluidlift.io.asset_lock import held
        from fluidlift.io.atomic import atomic_write, write_bytes

        found = [o for name in names_of(self.folder) if (o := read_outcome(self.folder, name)) is not None]
        # machines do not know each other's processes, and would take a summary half written for a leftover
        with held(self.folder / ".summary.lock", "writing the summary", wait=10.0):
            with atomic_write(self.folder / SUMMARY) as file:
                file.write((json.dumps(rows(found), indent=1) + "\n").encode())
            if table:
                write_bytes(self.folder / TABLE, as_csv(found).encode())
            if parquet:
                write_parquet(self.folder, found)


@dataclass
class BatchPace:
    """How long a batch will take, by how fast its shots ended so far."""

    count: int
    """of all shots"""
    began: float = dataclasses.field(default_factory=time.time)
    ended: int = 0
    made: int = 0
    """by this batch"""

    def after(self, outcome: ShotOutcome) -> str:
        """What to say behind the line of a shot that ended; nothing of the last one, nor of what was done before."""
        self.ended += 1
        with suppress(ValueError):
            self.made += datetime.datetime.fromisoformat(outcome.ended).timestamp() >= self.began - 1.0
        left = self.count - self.ended
        if not self.made or not left:
            return ""
        seconds = (time.time() - self.began) / self.made * left
        return f"; about {seconds / 60:.0f} min left" if seconds >= 90 else f"; about {seconds:.0f} s left"
