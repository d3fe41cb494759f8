"""`fluidlift batch`: many clips, one after the other or side by side, each in a process of its own."""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import json
import os
import reprlib
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from fluidlift.cli.options import MOVED, Make, options_of
from fluidlift.cli.quantities import command
from fluidlift.errors import InputRejected

VIDEOS = frozenset({".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".mpg", ".mpeg", ".mxf", ".gif"})
LISTS = (".yaml", ".yml")
SUMMARY = "batch.json"
_OUTCOMES = {0: "done", 2: "rejected", 3: "rejected", 4: "done, warnings"}
_WELL = ("done", "done, warnings")
_OURS = ("clip", "out", "json", "print_config")
"""options of make that the batch itself gives"""


@command
class Batch:
    """Turn many clips into assets; a clip that fails does not stop the others, and the same command goes on."""

    clips: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="CLIPS")]
    """clips, folders of videos, or a list (.yaml) of shots, each with options of make"""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """folder for the assets (NAME.fluid), their logs (NAME.log) and the summary (batch.json)"""
    jobs: int = 1
    """clips at a time; each takes the memory of a make of its own"""
    preset: str | None = None
    """of all shots that name none: draft, standard, hero"""
    config: Path | None = None
    """YAML file with settings, of all shots that name none"""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = field(default_factory=tuple)
    """one setting for all shots; may be repeated"""
    json: bool = False
    """print the summary as JSON"""


@dataclass(frozen=True)
class Shot:
    """One clip, the name of its asset, and the options of make that it has of its own."""

    clip: Path
    name: str
    options: dict[str, Any]

    def arguments(self, folder: Path) -> list[str]:
        """Of the command line that makes it, below `folder`."""
        told = ["make", str(self.clip), "--out", str(folder / f"{self.name}.fluid"), "--json"]
        for key, value in self.options.items():
            values = value if isinstance(value, list | tuple) else [value]
            told += [f"--{key.replace('_', '-')}={v}" for v in values]
        return told


@dataclass(frozen=True)
class Outcome:
    """How the make of one shot ended."""

    name: str
    outcome: str
    """done, "done, warnings", rejected or failed"""
    seconds: float
    asset: str
    log: str
    warnings: list[str]
    reason: str
    """what a make that failed said last"""

    def line(self) -> str:
        """For people."""
        warned = f" ({len(self.warnings)} warnings)" if self.warnings else ""
        return f"{self.name}: {self.outcome.partition(',')[0]} in {self.seconds:.0f} s{warned}" + (
            f": {self.reason}" if self.reason else ""
        )


def run(command: Batch) -> int:
    """Make every shot; the exit code: 0 all done, 4 some with warnings, 1 some failed.

    Raises:
        InputRejected: a list that cannot be used, two shots of one name, no clips; nothing was made.
    """
    from fluidlift.io.atomic import require_writable

    shots = _shots(command)
    folder = command.out.absolute()
    require_writable(command.out)
    folder.mkdir(parents=True, exist_ok=True)
    ended: dict[str, Outcome] = {}
    tell = print if not command.json else lambda text: print(text, file=sys.stderr)
    for outcome in _all_made(shots, folder, command.jobs, tell):
        ended[outcome.name] = outcome
        tell(f"[{len(ended)}/{len(shots)}] {outcome.line()}")
        _summarise([ended[s.name] for s in shots if s.name in ended], folder)
    outcomes = list(ended.values())
    bad = [o for o in outcomes if o.outcome not in _WELL]
    if command.json:
        print((folder / SUMMARY).read_text(encoding="utf-8"), end="")
    else:
        print(f"{len(outcomes) - len(bad)} of {len(outcomes)} made; summary: {command.out / SUMMARY}")
    return 1 if bad else 4 if any(o.warnings for o in outcomes) else 0


def _shots(command: Batch) -> list[Shot]:
    """All that the command names, in its order."""
    if command.jobs < 1:
        raise InputRejected(f"--jobs {command.jobs}", "a whole number of 1 or more")
    base: dict[str, Any] = {"preset": command.preset, "config": command.config and command.config.absolute()}
    base = {k: v for k, v in base.items() if v is not None}
    shots: list[Shot] = []
    for path in command.clips:
        rows: list[dict[str, Any]]
        if path.suffix.lower() in LISTS:
            rows = _listed(path)
        elif path.is_dir() and (videos := _videos(path)):
            rows = [{"clip": v} for v in videos]
        else:
            rows = [{"clip": path.absolute()}]
        for row in rows:
            clip = row.pop("clip")
            name = str(row.pop("name", clip.stem or "clip"))
            row["set"] = [*command.set, *row.get("set", ())]
            shots.append(Shot(clip, name, base | row))
    _require_names(shots)
    return shots


def _videos(folder: Path) -> list[Path]:
    """Those in a folder, by name; none in a folder of numbered pictures, which is itself a clip."""
    return sorted(p.absolute() for p in folder.iterdir() if p.suffix.lower() in VIDEOS and p.is_file())


def _require_names(shots: list[Shot]) -> None:
    if not shots:
        raise InputRejected("no clip", "clips, folders of videos, or a list of shots (.yaml)")
    seen: dict[str, Path] = {}
    for shot in shots:
        if not shot.name or shot.name.startswith((".", "-")) or any(c in shot.name for c in '/\\:*?"<>|\0'):
            raise InputRejected(f"the name '{shot.name}' of {shot.clip.name}", "a name that a folder can have")
        if shot.name in seen:
            raise InputRejected(
                f"two shots are called {shot.name}: {seen[shot.name]} and {shot.clip}",
                "a name for each", "give one of them a name: in a list of shots",
            )  # fmt: skip
        seen[shot.name] = shot.clip


def _listed(path: Path) -> list[dict[str, Any]]:
    """The rows of a list, checked, with paths from where the list lies."""
    from fluidlift.io.yaml_reader import read_yaml

    needed = "a list: - clip: river.mp4, and below it options of make such as size: 4"
    rows = read_yaml(path, "list of shots")
    if not isinstance(rows, list) or not rows:
        raise InputRejected(f"{path.name} holds no list", needed)
    return [_row(row, f"{path.name}, shot {k}", path.absolute().parent) for k, row in enumerate(rows, 1)]


def _row(row: Any, where: str, folder: Path) -> dict[str, Any]:
    row = {"clip": row} if isinstance(row, str) else row
    if not isinstance(row, dict) or not isinstance(row.get("clip"), str):
        raise InputRejected(f"{where} names no clip", "clip: and the name of a file")
    kinds = options_of(Make) | dict.fromkeys(MOVED, "")
    known = ["clip", "name", *(k for k in kinds if k not in _OURS)]
    found: dict[str, Any] = {}
    for key, value in row.items():
        key = str(key).replace("-", "_")
        if key not in known:
            near = difflib.get_close_matches(key, known, 1)
            hint = f"did you mean {near[0]}?" if near else "one of " + ", ".join(known)
            raise InputRejected(f"{where}: unknown option '{key}'", hint)
        several = "UseAppendAction" in kinds.get(key, "")
        values = value if isinstance(value, list) and several else [value]
        if not all(isinstance(v, str | int | float) and not isinstance(v, bool) for v in values):
            needed = "a word or a number" + (", or a list of them" * several)
            raise InputRejected(f"{where}: {key}: {reprlib.repr(value)}", needed)
        if key == "clip" or "Path" in kinds.get(key, ""):
            found[key] = folder / os.path.expanduser(str(value))  # pathlib raises where there is no such user
        else:
            found[key] = [str(v) for v in values] if several else value
    return found


def _all_made(shots: list[Shot], folder: Path, jobs: int, tell: Callable[[str], None]) -> Iterator[Outcome]:
    """Each shot as it ends. Stopped with Ctrl-C, the makes that run are stopped too; what they finished is kept."""
    running: list[subprocess.Popen] = []
    with ThreadPoolExecutor(jobs) as pool:
        waiting = [pool.submit(_made, shot, folder, running, tell) for shot in shots]
        try:
            for one in as_completed(waiting):
                yield one.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in running:
                process.terminate()
            raise


def _made(shot: Shot, folder: Path, running: list[subprocess.Popen], tell: Callable[[str], None]) -> Outcome:
    log, began = folder / f"{shot.name}.log", time.monotonic()
    tell(f"{shot.name}: begun, {log.name} tells how far it is")
    with log.open("w", encoding="utf-8") as said:
        process = subprocess.Popen(
            [sys.executable, "-m", "fluidlift.cli", *shot.arguments(folder)],
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=said, text=True, encoding="utf-8",
        )  # fmt: skip
        running.append(process)
        told, _ = process.communicate()
    outcome = _OUTCOMES.get(process.returncode, "failed")
    warnings: list[str] = []
    with contextlib.suppress(ValueError, KeyError, TypeError):
        warnings = [str(w) for w in json.loads(told)["warnings"]]
    reason = "" if outcome in _WELL else _last_words(log, process.returncode)
    asset = folder / f"{shot.name}.fluid"
    return Outcome(shot.name, outcome, round(time.monotonic() - began, 1), str(asset), str(log), warnings, reason)


def _last_words(log: Path, code: int) -> str:
    """What a make said last, on one line; of a wrong option what is wrong with it, without the frame around it."""
    lines = [" ".join(t.replace("│", " ").split()) for t in log.read_text("utf-8", "replace").splitlines()]
    lines = [t for t in lines if any(c.isalnum() for c in t)]
    own = [t for t in lines if t.startswith(("fluidlift: ", "Error parsing"))]
    return (own or lines or [f"ended with {code}"])[-1].removeprefix("fluidlift: ")


def _summarise(outcomes: list[Outcome], folder: Path) -> None:
    from fluidlift.io.atomic import atomic_write

    with atomic_write(folder / SUMMARY) as file:
        file.write((json.dumps([dataclasses.asdict(o) for o in outcomes], indent=1) + "\n").encode())
