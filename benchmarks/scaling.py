"""How making an asset scales with the processors it may use: seconds of each stage, by number of threads.

    python benchmarks/scaling.py [CLIP] [--threads 1 2 4 8] [--seconds 1] [--rounds 3] [--work runs] [--json FILE]

The draft of a clip (the shipped one, unless another is given) is made on one processor, then on twice as many, as far
as the machine has them: each run is held to its own processors and told so many threads. Everything should be compiled
first (`fluidlift doctor --compile`), and nothing else run beside. Medians of the rounds.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from statistics import median

from as_filmed import WELL
from report import table

from fluidlift.io.asset_folder import read_manifest
from fluidlift.machine import THREADS, cores
from fluidlift.synthetic.demo import demo_clip


def seconds_of(clip: Path, duration: float, threads: int, folder: Path) -> dict[str, float]:
    """s of each stage of one draft on the first processors of those that this process may use."""
    shutil.rmtree(folder, ignore_errors=True)
    used = sorted(os.sched_getaffinity(0))[:threads]
    command = [sys.executable, "-m", "fluidlift", "make", str(clip), "-o", str(folder), "--duration", str(duration)]
    done = subprocess.run(
        command, check=False, env=os.environ | dict.fromkeys(THREADS, str(threads)), capture_output=True,
        preexec_fn=lambda: os.sched_setaffinity(0, used),
    )  # fmt: skip
    if done.returncode not in WELL:
        raise SystemExit(done.stderr.decode()[-2000:])
    timings = {k: float(v) for k, v in read_manifest(folder)["timings"].items()}
    shutil.rmtree(folder)
    return timings | {"all": sum(timings.values())}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clip", nargs="?", type=Path)
    parser.add_argument("--threads", type=int, nargs="+", default=[1 << k for k in range(cores().bit_length())])
    parser.add_argument("--seconds", type=float, default=1.0, help="of the clip")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--work", type=Path, default=Path("runs"), help="folder for what is made")
    parser.add_argument("--json", type=Path)
    a = parser.parse_args()
    found: dict[int, dict[str, float]] = {}
    for threads in a.threads:
        runs = [
            seconds_of(a.clip or demo_clip(), a.seconds, threads, a.work / "scaling.fluid") for _ in range(a.rounds)
        ]
        found[threads] = {stage: median(run[stage] for run in runs) for stage in runs[0]}
        print(threads, found[threads], file=sys.stderr, flush=True)
    first = found[a.threads[0]]
    rows = [
        [stage, *(f"{found[n][stage]:.1f} ({first[stage] / max(found[n][stage], 1e-3):.2f})" for n in a.threads)]
        for stage in first
    ]
    print("\n".join(table(["stage: s (speed-up)", *(f"{n} threads" for n in a.threads)], rows)))
    if a.json:
        a.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
