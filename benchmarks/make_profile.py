"""Tells where `fluidlift make` spends its processor time and memory, stage by stage.

    python benchmarks/make_profile.py demo                       the clip of the package
    python benchmarks/make_profile.py --top 12 CLIP --duration 1.2     options after the clip are those of make
    python benchmarks/make_profile.py ASSET.fluid                simulates an asset again and shows it
    python benchmarks/make_profile.py --cold demo                with an empty cache of compiled functions

A timer of the process's own processor time looks at the main thread every few milliseconds; what was spent since the
last look, by all threads, counts for what the main thread does. So a compiled function that is called for long counts
in full, under the line that calls it. Wall times are those of the machine as it is: on a busy one, compare the others;
what of a stage's time the main thread spends itself ("main s") tells how much of it cannot go beside that.
"""

from __future__ import annotations

import argparse
import gc
import os
import signal
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from types import FrameType

TICK = 0.005
"""s of processor time between two looks"""
PARTS = ("kernels", "arrays", "own lines", "compilation", "disk")
"""of a stage: compiled functions that threads share; NumPy, SciPy, OpenCV and torch inside their own Python; lines of
the package, with what they call that is neither Python nor shared; Numba at work; files written and read"""
FILES = ("fluidlift/io/", "/av/", "pathlib.py", "shutil.py", "tempfile.py", "zipfile.py", "/json/")
ARRAYS = ("/numpy/", "/scipy/", "/torch/", "/cv2/")


def part_of(frame: FrameType) -> str:
    """Which of `PARTS` a frame and its callers stand for."""
    name = frame.f_code.co_filename
    if name.endswith("numerics/sharing.py"):
        return "kernels"
    at: FrameType | None = frame
    for _ in range(60):
        if at is None:
            break
        file = at.f_code.co_filename
        if "/numba/" in file or "/llvmlite/" in file:
            return "compilation"
        at = at.f_back
    if any(part in name for part in FILES):
        return "disk"
    return "arrays" if any(part in name for part in ARRAYS) else "own lines"


def line_of(frame: FrameType) -> str:
    """The innermost line of the package, and the compiled function where one is shared out."""
    kernel, at = "", frame
    while at.f_back is not None and "fluidlift/" not in at.f_code.co_filename:
        at = at.f_back
    if at.f_code.co_filename.endswith("numerics/sharing.py"):
        loop = at.f_locals.get("self")
        kernel = f" > {loop.py_func.__name__}" if hasattr(loop, "py_func") else ""
        while at.f_back is not None and at.f_code.co_filename.endswith("numerics/sharing.py"):
            at = at.f_back
    file = at.f_code.co_filename.rpartition("fluidlift/")[2]
    return f"{file}:{at.f_lineno} {at.f_code.co_name}{kernel}"


class Looks:
    """Collects what the timer sees."""

    def __init__(self) -> None:
        self.stage, self.last = "begin", time.process_time()
        self.spent: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(float))
        self.lines: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(float))
        self.under: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(float))
        self.wall: dict[str, float] = {}
        self.main: dict[str, float] = {}
        self.memory: dict[str, float] = {}
        self._began, self._main = time.perf_counter(), time.thread_time()

    def __call__(self, _: int, frame: FrameType | None) -> None:
        """The timer has run out."""
        now = time.process_time()
        spent, self.last = now - self.last, now
        if frame is None:
            return
        self.spent[self.stage][part_of(frame)] += spent
        self.lines[self.stage][line_of(frame)] += spent
        seen, at = set(), frame
        while at is not None:
            name = at.f_code.co_filename.rpartition("fluidlift/")[2]
            if "fluidlift/" in at.f_code.co_filename and (key := f"{name} {at.f_code.co_qualname}") not in seen:
                seen.add(key)
                self.under[self.stage][key] += spent
            at = at.f_back

    def begin(self, name: str) -> None:
        """A stage begins."""
        from fluidlift.machine import peak_memory_mb

        now, main_now = time.perf_counter(), time.thread_time()
        self.wall[self.stage] = now - self._began
        self.main[self.stage] = main_now - self._main
        self.memory[self.stage] = peak_memory_mb()
        self.stage, self._began, self._main = name, now, main_now


def profiled(clip: str, options: list[str], folder: Path) -> Looks:
    """Make an asset and look at it meanwhile."""
    from fluidlift import kernels
    from fluidlift.cli import main
    from fluidlift.progress import PlainProgress

    kernels.compiled = lambda: True  # nothing beside it: what is compiled on the way shall be seen
    looks = Looks()
    told = PlainProgress.stage

    def stage(self: PlainProgress, name: str, number: int, count: int) -> None:
        looks.begin(name)
        told(self, name, number, count)

    PlainProgress.stage = stage  # type: ignore[method-assign]
    signal.signal(signal.SIGPROF, looks)
    signal.setitimer(signal.ITIMER_PROF, TICK, TICK)
    out = ["--out", str(folder / "profiled.fluid")]
    arguments = ["demo", *out] if clip == "demo" else ["make", clip, *options, *out]
    if clip.endswith(".fluid"):
        arguments = ["sim", clip, "--restart", *options]
    try:
        main(arguments)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        looks.begin("end")
    return looks


def shown(looks: Looks, top: int) -> None:
    """Print it."""
    print(f"{'stage':12}{'wall s':>8}{'cpu s':>8}{'main s':>8}{'peak MB':>9}" + "".join(f"{p:>13}" for p in PARTS))
    total: dict[str, float] = defaultdict(float)
    for stage, parts in looks.spent.items():
        row = "".join(f"{parts[p]:13.1f}" for p in PARTS)
        cpu = sum(parts.values())
        times = f"{looks.wall.get(stage, 0):8.1f}{cpu:8.1f}{looks.main.get(stage, 0):8.1f}"
        print(f"{stage:12}{times}{looks.memory.get(stage, 0):9.0f}{row}")
        for part, seconds in parts.items():
            total[part] += seconds
    row = "".join(f"{total[p]:13.1f}" for p in PARTS)
    wall, main_thread, most = sum(looks.wall.values()), sum(looks.main.values()), max(looks.memory.values())
    print(f"{'all':12}{wall:8.1f}{sum(total.values()):8.1f}{main_thread:8.1f}{most:9.0f}{row}")
    for title, table in (("lines", looks.lines), ("with all they call", looks.under)):
        count = top if title == "lines" else 2 * top
        for stage, lines in table.items() if top else ():
            print(f"\n{stage}: {title}")
            for line, seconds in sorted(lines.items(), key=lambda item: -item[1])[:count]:
                print(f"{seconds:8.2f}  {line}")


def main() -> int:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clip", help="a clip, an asset, or demo")
    parser.add_argument("--top", type=int, default=0, help="lines of each stage")
    parser.add_argument("--cold", action="store_true", help="an empty cache of compiled functions")
    parser.add_argument("options", nargs=argparse.REMAINDER, help="for the command")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if given.cold:
            os.environ["NUMBA_CACHE_DIR"] = str(Path(folder) / "compiled")
        gc.collect()
        looks = profiled(given.clip, given.options, Path(folder))
    shown(looks, given.top)
    return 0


if __name__ == "__main__":
    sys.exit(main())
