"""`fluidlift batch`: many clips, one after the other or side by side, each in a process of its own."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from fluidlift.cli.options import MOVED, Make, options_of
from fluidlift.cli.quantities import Bytes, Folder, Seconds, command
from fluidlift.errors import InputRejected

if TYPE_CHECKING:
    from fluidlift.farm.engine import Engine
    from fluidlift.farm.shots import Shot
    from fluidlift.farm.store import Store

_OURS = ("clip", "out", "json", "print_config", "warnings_ok", "shots")
"""options of make that the batch itself gives"""


@command
class Batch:
    """Turn many clips into assets; a clip that fails does not stop the others, and the same command goes on."""

    clips: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="CLIPS")]
    """clips, folders of videos, or a list (.yaml) of shots, each with options of make; with --status the folder"""
    out: Annotated[Folder | None, tyro.conf.arg(aliases=["-o"])] = None
    """folder for the assets (NAME.fluid), their logs (NAME.log), what became of each (NAME.state.json) and the summary
    (batch.json); needed but for --status. Or a URL that fsspec knows, such as s3://bucket/assets"""
    scratch: Path | None = None
    """with a URL: where each machine makes what is put there; by default below the user's cache folder"""
    jobs: int | None = None
    """clips at a time; each takes the memory of a make of its own, and its share of the cores; by default one, and with
    --engine ray as many as its machines hold"""
    engine: Literal["local", "ray"] = "local"
    """who makes them: processes of this machine, or tasks of Ray, on this machine or on a cluster (--address)"""
    address: str | None = None
    """of the head of a Ray cluster, such as 10.0.0.5:6379"""
    cores: int | None = None
    """of each clip; by default those of this machine over --jobs, and with --engine ray two"""
    gpus: float | None = None
    """of each clip, with --engine ray; by default none"""
    tries: int | None = None
    """how often a clip is tried that broke down, ran out of memory (with twice as much then) or lost its machine; by
    default once, and with --engine ray three times"""
    preset: str | None = None
    """of all shots that name none: draft, standard, hero"""
    config: Path | None = None
    """YAML file with settings, of all shots that name none"""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = field(default_factory=tuple)
    """one setting for all shots; may be repeated"""
    shots: Literal["auto"] | None = None
    """auto: a clip with cuts becomes a shot, and an asset, for each of its parts: NAME_01, NAME_02, ..."""
    time_limit: Seconds | None = None
    """that a shot may take, such as 30min; it counts as failed then"""
    memory_limit: Bytes | None = None
    """that a shot may take, such as 8GB; it counts as failed then"""
    retry: Literal["input", "memory", "time", "crash", "stopped"] | None = None
    """make only those shots again that failed like this"""
    shard: str | None = None
    """i/n: every n-th shot from the i-th on, for tasks of a farm; their states lie in one folder"""
    plan: Literal["openjd", "slurm", "commands"] | None = None
    """write a job for a scheduler into the folder instead, one task per shot: an Open Job Description, a Slurm array
    script, or a command per line"""
    status: bool = False
    """tell how far a folder is, and make nothing"""
    csv: bool = False
    """write the summary as batch.csv too, a row per shot; with --status print it"""
    parquet: bool = False
    """write the summary as batch.parquet too"""
    html: bool = False
    """with --status: write status.html, a page with pictures of all shots, the most doubtful first"""
    dataset: bool = False
    """write dataset.parquet into the folder as well, an index with a row per asset; with --status of what is there"""
    progress: Literal["lines", "openjd"] = "lines"
    """how progress is told; openjd: as tasks of Open Job Description do"""
    warnings_ok: bool = False
    """end with 0 instead of 4 where assets have warnings: farms take any other code for a failure"""
    json: bool = False
    """print the summary as JSON"""


def run(wanted: Batch) -> int:
    """Make every shot; the exit code: 0 all done, 4 some with warnings, 1 some failed.

    Raises:
        InputRejected: a list that cannot be used, two shots of one name, no clips; nothing was made.
    """
    from fluidlift.farm.shots import shard_of

    if wanted.dataset or wanted.parquet:
        from fluidlift.farm.dataset import require_parquet

        require_parquet()
    store, out = _store(wanted), wanted.out
    if store is not None:
        out = store.folder
    assert not isinstance(out, str)
    if wanted.status:
        return _status(wanted, out or wanted.clips[0])
    if out is None:
        raise InputRejected("no -o", "the folder for the assets, such as -o assets/")
    if wanted.html:
        raise InputRejected("--html without --status", "fluidlift batch FOLDER --status --html")
    _require_counts(wanted)
    shots = _parted(wanted, out, shots_of(wanted))
    return _plan(wanted, out, len(shots)) if wanted.plan else _make(wanted, out, shard_of(shots, wanted.shard), store)


def _store(wanted: Batch) -> Store | None:
    """Where a batch puts its assets, once it was looked at and what is known of its shots was fetched.

    Raises:
        InputRejected: it cannot be used, or for what is asked.
    """
    if not isinstance(wanted.out, str):
        if wanted.scratch is not None:
            raise InputRejected("--scratch with a folder", "a URL as -o", "leave it out: assets are made in the folder")
        return None
    for option in ("plan", "html", "dataset"):
        if getattr(wanted, option):
            raise InputRejected(
                f"--{option} with the URL of a store", "a folder: what it reads or writes are files of a machine",
                "for a plan give each task the URL and --shard i/n; else fetch the assets, or mount the store",
            )  # fmt: skip
    from fluidlift.farm.store import Store

    store = Store(wanted.out, wanted.scratch)
    if not wanted.status:
        store.require()
    store.pull()
    return store


def shots_of(wanted: Batch) -> list[Shot]:
    """All that the command names, in its order; raises as `run`."""
    from fluidlift.farm.shots import ShotOptions, read_shots

    base: dict[str, Any] = {"preset": wanted.preset, "config": wanted.config and wanted.config.absolute()}
    kinds = options_of(Make) | dict.fromkeys(MOVED, "")
    return read_shots(
        wanted.clips, ShotOptions({k: v for k, v in kinds.items() if k not in _OURS}),
        base={k: v for k, v in base.items() if v is not None}, settings=wanted.set,
    )  # fmt: skip


def _parted(wanted: Batch, out: Path, shots: list[Shot]) -> list[Shot]:
    """The shots, where it is asked for one for each part of a clip with cuts."""
    if wanted.shots is None:
        return shots
    from fluidlift.farm.cuts import parted
    from fluidlift.io.atomic import require_writable

    require_writable(out)
    folder = out.absolute()
    folder.mkdir(parents=True, exist_ok=True)
    return parted(shots, folder, _printers(wanted)[0])


def _require_counts(wanted: Batch) -> None:
    for name in ("jobs", "cores", "tries"):
        value = getattr(wanted, name)
        if value is not None and value < 1:
            raise InputRejected(f"--{name} {value}", "a whole number of 1 or more")
    if wanted.gpus is not None and wanted.gpus < 0:
        raise InputRejected(f"--gpus {wanted.gpus:g}", "0 or more")
    if wanted.engine != "ray" and (wanted.address is not None or wanted.gpus is not None):
        raise InputRejected("--address or --gpus without --engine ray", "the engine that has them", "--engine ray")


def _engine(wanted: Batch, store: Store | None) -> Engine:
    if wanted.engine == "ray":
        from fluidlift.farm.ray_cluster import RayEngine

        return RayEngine(wanted.address, wanted.jobs, wanted.cores, wanted.gpus or 0.0, store)
    from fluidlift.farm.local import LocalEngine

    return LocalEngine(wanted.jobs or 1, store)


TRIES = {"local": 1, "ray": 3}
"""by engine: of many machines one is lost now and then"""


def _make(wanted: Batch, out: Path, shots: list[Shot], store: Store | None) -> int:
    from fluidlift.farm.engine import Limits
    from fluidlift.farm.state import LISTED, list_names
    from fluidlift.farm.summary import SUMMARY, BatchPace, Summary
    from fluidlift.io.atomic import require_writable

    require_writable(out)
    folder = out.absolute()
    folder.mkdir(parents=True, exist_ok=True)
    limits = Limits(
        wanted.time_limit, wanted.memory_limit, wanted.retry, wanted.tries or TRIES[wanted.engine], wanted.cores
    )
    tell, part = _printers(wanted)
    if store is not None:
        list_names(folder, [shot.name for shot in shots])
        store.put_file(LISTED)
        tell(f"made in {folder}; locks do not reach {store.url}: no two batches at a time should make the same shots")
    outcomes, pace, summary = [], BatchPace(len(shots)), Summary(folder)
    try:
        for outcome in _engine(wanted, store).shots(shots, folder, limits, tell, part):
            outcomes.append(outcome)
            tell(f"[{len(outcomes)}/{len(shots)}] {outcome.line()}{pace.after(outcome)}")
            summary.write_now_and_then()
    except BaseException:
        with suppress(InputRejected):  # a full disk, which has been said
            summary.write()
            if store is not None:
                store.put_files()
        raise
    summary.write(table=wanted.csv, parquet=wanted.parquet)
    if store is not None:
        store.put_files()
    if wanted.dataset:
        _index(folder)
    bad = [o for o in outcomes if not o.well]
    if wanted.json:
        print((folder / SUMMARY).read_text(encoding="utf-8"), end="")
    else:
        told = out / SUMMARY if store is None else store.where(SUMMARY)
        print(f"{len(outcomes) - len(bad)} of {len(outcomes)} made; summary: {told}")
    return 1 if bad else 4 if any(o.warnings for o in outcomes) and not wanted.warnings_ok else 0


def _printers(wanted: Batch) -> tuple[Callable[[str], None], Callable[[str], None]]:
    """Who prints lines for people, and how far the stages of a shot are, as "done of all"."""

    def line(text: str) -> None:
        print(f"openjd_status: {text}" if wanted.progress == "openjd" else text,
              file=sys.stderr if wanted.json else sys.stdout, flush=True)  # fmt: skip

    def part(text: str) -> None:
        done, _, count = text.partition("/")
        print(f"openjd_progress: {100 * (int(done) - 1) / int(count):.1f}", flush=True)

    single = wanted.progress == "openjd" and wanted.jobs in (None, 1)
    return line, part if single else (lambda text: None)


def _plan(wanted: Batch, out: Path, shots: int) -> int:
    """Write a job instead of doing it; paths in it are absolute, as other machines of the farm see them."""
    from fluidlift.farm.engine import TASK_CORES, TASK_MEMORY
    from fluidlift.farm.plans import TaskPlan, written
    from fluidlift.io.atomic import require_writable
    from fluidlift.machine import cores

    assert wanted.plan is not None
    require_writable(out)
    folder = out.absolute()
    folder.mkdir(parents=True, exist_ok=True)
    arguments = [str(p.absolute()) for p in wanted.clips] + ["-o", str(folder)]
    given = {"preset": wanted.preset, "config": wanted.config and wanted.config.absolute(),
             "time-limit": wanted.time_limit, "memory-limit": wanted.memory_limit, "cores": wanted.cores,
             "shots": wanted.shots}  # fmt: skip
    arguments += [f"--{name}={value}" for name, value in given.items() if value is not None]
    arguments += [f"--set={text}" for text in wanted.set]
    plan = TaskPlan(
        arguments,
        shots,
        wanted.cores or min(cores(), TASK_CORES),
        wanted.memory_limit or TASK_MEMORY,
        wanted.time_limit,
    )
    path = written(wanted.plan, plan, folder)
    print(f"{shots} tasks; plan: {path}\nIts paths are those of this machine: they must be the same on the farm's.")
    return 0


def _status(wanted: Batch, folder: Path) -> int:
    from fluidlift.farm.summary import as_csv, status_of
    from fluidlift.io.atomic import write_bytes

    if not folder.is_dir():
        raise InputRejected(f"'{folder}'", "the folder of a batch")
    found = status_of(folder)
    if wanted.json:
        print(json.dumps(found.to_dict(), indent=1))
    elif wanted.csv:
        print(as_csv(found.outcomes), end="")
    else:
        print("\n".join(found.lines()))
    if wanted.parquet:
        from fluidlift.farm.summary import write_parquet

        print(f"summary: {write_parquet(folder, found.outcomes)}", file=sys.stderr)
    if wanted.dataset:
        _index(folder)
    if wanted.html:
        from fluidlift.farm.page import page

        write_bytes(folder / "status.html", page(folder, found).encode())
        print(f"page: {folder / 'status.html'}", file=sys.stderr)
    return 0


def _index(folder: Path) -> None:
    """Write the index of a data set, and say so."""
    from fluidlift.farm.dataset import write_index
    from fluidlift.farm.summary import status_of

    path, rows = write_index(folder, status_of(folder).outcomes)
    print(f"data set: {path}, {rows} assets", file=sys.stderr)
