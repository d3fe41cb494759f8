"""`python -m tests.fuzz [--inputs N] [--seed S] [--keep FOLDER] [TARGET ...]`: many damaged files for every reader.

One process per target, two at a time; a table of what was found, and exit code 1 where something did not hold. Inputs
that ended in something else than a refusal are kept. Of most inputs, bytes are changed; a share (`--formed`) keeps the
form of its format, drawn with Hypothesis, and another (`--borders`) is changed at borders of it.
`--guided SECONDS` lets Atheris lead, where it is installed. `--record` writes what was found down for docs/results.md.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

TESTS = Path(__file__).parents[1]
sys.path[:0] = [str(TESTS)]  # the targets use modules of the tests by their names, as pytest lets them

from fuzz.targets import TARGETS  # noqa: E402
from fuzz.trial import LARGEST, SLOWEST  # noqa: E402

ALL = "all readers"


def environment() -> dict[str, str]:
    """Of the processes that try."""
    paths = [str(TESTS), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}


def tried(name: str, inputs: int, formed: int, borders: int, seed: int, keep: str) -> dict[str, Any]:
    """What a run of one target found; a process that died counts as one raw exception."""
    run = subprocess.run(
        [sys.executable, "-m", "fuzz.trial", name, str(inputs - formed - borders), str(formed),
         str(borders), str(seed), keep],
        capture_output=True, text=True, env=environment(),
    )  # fmt: skip
    if run.returncode != 0:
        last = (run.stderr.strip() or f"exit code {run.returncode}").splitlines()[-1]
        return {"target": name, "raw": {f"the process ended: {last}": 1}}
    return json.loads(run.stdout.strip().splitlines()[-1])


def held(found: dict[str, Any]) -> bool:
    """Whether every input was read or refused within bounds."""
    return not (found["raw"] or found["outside"]) and found["slowest"] < SLOWEST and found["peak_bytes"] < LARGEST


def guided(names: list[str], seconds: int, keep: str) -> int:
    """Let Atheris lead through some targets, one after the other; 1 where it found something."""
    worst = 0
    for name in names:
        command = [sys.executable, "-m", "fuzz.guided", name, str(seconds), keep or "."]
        worst = max(worst, subprocess.run(command, env=environment()).returncode != 0)
    return worst


def figures(found: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """The records of one target for docs/results.md."""
    values = {
        "inputs": found["inputs"], "of them formed": found["formed"],
        "changed at borders": found["bordered"], "refused": found["refused"],
        "tracebacks": sum(found["raw"].values()), "files opened outside": len(found["outside"]),
        "processor time": round(found["seconds"], 1), "slowest input": round(found["slowest"], 2),
        "memory": round(found["peak_bytes"] / 1e6),
    }  # fmt: skip
    for figure, value in values.items():
        yield {"subject": found["target"], "figure": figure, "value": value, "shown": found["target"] == ALL}


def record(all_found: list[dict[str, Any]], command: str) -> None:
    """Write the figures of targets, and what they add up to, into benchmarks/results/trust.json."""
    from benchmarks.report import put

    ran = [found for found in all_found if "inputs" in found]
    whole = {n: sum(f[n] for f in ran) for n in ("inputs", "formed", "bordered", "refused", "seconds")}
    whole |= {"raw": {f["target"]: sum(f["raw"].values()) for f in all_found}}
    whole |= {"outside": [name for f in ran for name in f["outside"]], "target": ALL}
    whole |= {n: max(f[n] for f in ran) for n in ("slowest", "peak_bytes")}
    put("trust", [r for f in [whole, *ran] for r in figures(f)], command=command, date=str(datetime.date.today()))


def main() -> int:
    """Try the targets; 1 where something did not hold."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__.splitlines()[0])
    parser.add_argument("targets", nargs="*", metavar="TARGET", help="all of them where none is named")
    parser.add_argument("--inputs", type=int, default=100_000, help="of each target")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--formed", type=float, default=0.1, help="share of them that keeps its form")
    parser.add_argument("--borders", type=float, default=0.1, help="share of them that is changed at borders of it")
    parser.add_argument("--guided", type=int, metavar="SECONDS", help="of each target, led by Atheris, instead")
    parser.add_argument("--record", action="store_true", help="write the figures for docs/results.md")
    parser.add_argument("--keep", default="", help="folder for inputs that were neither read nor refused")
    asked = parser.parse_args()
    unknown = sorted(set(asked.targets) - set(TARGETS))
    if unknown:
        parser.error(f"no target {', '.join(unknown)}; there are {', '.join(TARGETS)}")
    keep = str(Path(asked.keep).absolute()) if asked.keep else ""
    if asked.guided:
        return guided(asked.targets or list(TARGETS), asked.guided, keep)
    whole, all_found = True, list[dict[str, Any]]()
    formed, borders = round(asked.inputs * asked.formed), round(asked.inputs * asked.borders)
    print(f"{'target':14} {'inputs':>8} {'refused':>8} {'s':>8} {'slowest s':>10} {'peak MB':>8}")
    with ThreadPoolExecutor(2) as pool:
        jobs = pool.map(
            lambda name: tried(name, asked.inputs, formed, borders, asked.seed, keep), asked.targets or TARGETS
        )
        for found in jobs:
            all_found.append(found)
            if "inputs" in found:
                print(f"{found['target']:14} {found['inputs']:8d} {found['refused']:8d} {found['seconds']:8.1f}"
                      f" {found['slowest']:10.3f} {found['peak_bytes'] / 1e6:8.0f}", flush=True)  # fmt: skip
                whole &= held(found)
            for what, count in found["raw"].items():
                whole = False
                print(f"{found['target']:14} {count:8d} x {what}", flush=True)
            for name in found.get("outside", ()):
                print(f"{found['target']:14} opened {name}", flush=True)
    if asked.record:
        record(all_found, f"python -m tests.fuzz --inputs {asked.inputs} --seed {asked.seed} --record")
    return 0 if whole else 1


if __name__ == "__main__":
    sys.exit(main())
