"""`python -m tests.fuzz [--inputs N] [--seed S] [--keep FOLDER] [TARGET ...]`: many damaged files for every reader.

One process per target, two at a time; a table of what was found, and exit code 1 where something did not hold. Inputs
that ended in something else than a refusal are kept.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

TESTS = Path(__file__).parents[1]
sys.path[:0] = [str(TESTS)]  # the targets use modules of the tests by their names, as pytest lets them

from fuzz.targets import TARGETS  # noqa: E402
from fuzz.trial import LARGEST, SLOWEST  # noqa: E402


def tried(name: str, inputs: int, seed: int, keep: str) -> dict[str, Any]:
    """What a run of one target found; a process that died counts as one raw exception."""
    paths = [str(TESTS), *filter(None, [os.environ.get("PYTHONPATH")])]
    run = subprocess.run(
        [sys.executable, "-m", "fuzz.trial", name, str(inputs), str(seed), keep],
        capture_output=True, text=True, env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
    )  # fmt: skip
    if run.returncode != 0:
        last = (run.stderr.strip() or f"exit code {run.returncode}").splitlines()[-1]
        return {"target": name, "raw": {f"the process ended: {last}": 1}}
    return json.loads(run.stdout.strip().splitlines()[-1])


def held(found: dict[str, Any]) -> bool:
    """Whether every input was read or refused within bounds."""
    return not (found["raw"] or found["outside"]) and found["slowest"] < SLOWEST and found["peak_bytes"] < LARGEST


def main() -> int:
    """Try the targets; 1 where something did not hold."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__.splitlines()[0])
    parser.add_argument("targets", nargs="*", metavar="TARGET", help="all of them where none is named")
    parser.add_argument("--inputs", type=int, default=100_000, help="of each target")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", default="", help="folder for inputs that were neither read nor refused")
    asked = parser.parse_args()
    unknown = sorted(set(asked.targets) - set(TARGETS))
    if unknown:
        parser.error(f"no target {', '.join(unknown)}; there are {', '.join(TARGETS)}")
    keep = str(Path(asked.keep).absolute()) if asked.keep else ""
    whole = True
    print(f"{'target':14} {'inputs':>8} {'refused':>8} {'s':>8} {'slowest s':>10} {'peak MB':>8}")
    with ThreadPoolExecutor(2) as pool:
        jobs = pool.map(lambda name: tried(name, asked.inputs, asked.seed, keep), asked.targets or TARGETS)
        for found in jobs:
            if "inputs" in found:
                print(f"{found['target']:14} {found['inputs']:8d} {found['refused']:8d} {found['seconds']:8.1f}"
                      f" {found['slowest']:10.3f} {found['peak_bytes'] / 1e6:8.0f}", flush=True)  # fmt: skip
                whole &= held(found)
            for what, count in found["raw"].items():
                whole = False
                print(f"{found['target']:14} {count:8d} x {what}", flush=True)
            for name in found.get("outside", ()):
                print(f"{found['target']:14} opened {name}", flush=True)
    return 0 if whole else 1


if __name__ == "__main__":
    sys.exit(main())
