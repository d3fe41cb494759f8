"""What ten thousand clips cost: measured for a few, and multiplied.

    python benchmarks/farm_costs.py --preset draft standard hero [--clip CLIP --name NAME]   measure; an hour for hero
    python benchmarks/farm_costs.py --page                                   write the arithmetic into docs/farms.md
    python benchmarks/farm_costs.py --page --price 0.05 --clips 10000        at another price, US dollars per core-hour

Measured is the processor time of the whole process (user and system, all threads), which other work on the machine
changes little, unlike the time on the clock. Without `--clip`, the clip that comes with the package.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from page_section import replace_section
from report import FOLDER, number, put

PAGE = Path(__file__).resolve().parent.parent / "docs" / "farms.md"
BEGIN, END = "<!-- arithmetic:begin -->", "<!-- arithmetic:end -->"
PRICE = 0.04
"""US dollars per core-hour, an example; --price takes your own"""
CLIPS = 10_000
TOPIC, DEMO = "farm", "demo, 40 frames"
PARTS = {
    "cache (work/)": ("work",),
    "frames (frames/)": ("frames",),
    "body, velocity, terrain (rest/)": ("rest",),
}
"""parts of an asset by what they are good for; all others are report, preview and small files"""


def measured(clip: Path, preset: str, folder: Path) -> dict[str, float]:
    """Seconds, memory and disk of one make."""
    words = [sys.executable, "-m", "fluidlift", "make", str(clip), "--out", str(folder), "--preset", preset]
    began = time.monotonic()
    process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    code = os.waitstatus_to_exitcode(status)
    if code not in (0, 4):
        raise SystemExit(f"{' '.join(words)} ended with {code}")
    return {
        "processor time": round(used.ru_utime + used.ru_stime, 1),
        "time": round(time.monotonic() - began, 1),
        "memory": round(used.ru_maxrss / 1024),
        **{f"disk: {name}": round(size / 1e6, 2) for name, size in sizes(folder).items()},
    }


def sizes(folder: Path) -> dict[str, int]:
    """Bytes of an asset by its parts."""
    found = dict.fromkeys([*PARTS, "the rest"], 0)
    by_folder = {name: part for part, names in PARTS.items() for name in names}
    for file in folder.rglob("*"):
        if file.is_file() and not file.is_symlink():
            found[by_folder.get(file.relative_to(folder).parts[0], "the rest")] += file.stat().st_size
    return found


def main(argv: list[str] | None = None) -> int:
    """Measure, or write the page."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--clip", type=Path)
    parser.add_argument("--name", default=DEMO, help="of the clip, in the table")
    parser.add_argument("--preset", nargs="*", default=[])
    parser.add_argument("--page", action="store_true")
    parser.add_argument("--price", type=float, default=PRICE)
    parser.add_argument("--clips", type=int, default=CLIPS)
    args = parser.parse_args(argv)
    for preset in args.preset:
        room = Path(tempfile.mkdtemp())
        try:
            clip = demo() if args.clip is None else args.clip
            found = measured(clip, preset, room / "asset.fluid")
        finally:
            shutil.rmtree(room)
        print(json.dumps(found), flush=True)
        recorded(args.name, preset, found)
    if args.page:
        replace_section(PAGE, section(args.price, args.clips), BEGIN, END)
    return 0


def recorded(name: str, preset: str, found: dict[str, float]) -> None:
    """Put what was measured into the results; of the default, clips per core-hour onto their page as well."""
    units, subject = {"processor time": "s", "time": "s", "memory": "MB"}, f"{name}, {preset}"
    of_all = {
        "command": f"python benchmarks/farm_costs.py --preset {preset}", "date": datetime.date.today().isoformat(),
        "machine": f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} at the end, {platform.system()}, "
                   f"Python {platform.python_version()}",
    }  # fmt: skip
    rows = [{"subject": subject, "figure": k, "value": v, "unit": units.get(k, "MB"), "better": "less"}
            for k, v in found.items()]  # fmt: skip
    put(TOPIC, rows, **of_all)
    if preset == "draft" and name == DEMO:
        value = round(3600.0 / found["processor time"], 1)
        shown = {"figure": "clips per core-hour", "value": value, "unit": "", "better": "more", "shown": True}
        put("cost", [{"subject": subject} | shown], **of_all)


def demo() -> Path:
    """The clip that comes with the package."""
    from fluidlift.synthetic.demo import demo_clip

    return demo_clip()


def section(price: float, clips: int) -> str:
    """The arithmetic, from the figures as they lie in the results."""
    content = json.loads((FOLDER / f"{TOPIC}.json").read_text(encoding="utf-8"))
    found: dict[str, dict[str, float]] = {}
    for record in content["records"]:
        found.setdefault(record["subject"], {})[record["figure"]] = record["value"]
    subjects = {name: row for name, row in found.items() if "processor time" in row and "memory" in row}
    head = ["clip, preset", "core-hours", f"US$ at {price:g}", "assets per core-hour", "memory of a make, GB",
            "disk, TB", "of it the cache, TB", "without cache and frames, TB"]  # fmt: skip
    lines = [f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}"]
    for name, row in subjects.items():
        hours = row["processor time"] * clips / 3600.0
        disk = {key.removeprefix("disk: "): value for key, value in row.items() if key.startswith("disk: ")}
        all_of, cache = sum(disk.values()), disk["cache (work/)"]
        least = all_of - cache - disk["frames (frames/)"]
        each = [3600.0 / row["processor time"], row["memory"] / 1000.0]
        each += [mb * clips / 1e6 for mb in (all_of, cache, least)]
        cells = [name, number(hours), f"{hours * price:.0f}", *map(number, each)]
        lines.append(f"| {' | '.join(cells)} |")
    engines = {name: row for name, row in found.items() if "overhead of a shot" in row}
    told = [
        f"For {clips} clips like these (`python benchmarks/farm_costs.py --page`, from "
        "[results](../benchmarks/results/farm.json); a core-hour is an hour of processor time, so cores that wait come "
        "on top; other clips take other times, so make some of your own first):",
        "\n".join(lines),
        "Of a finished shot two parts can be thrown away. `work/` is what resuming and `fit` go on from, and what a "
        "new simulation is held against the clip by. `frames/` is made again by `fluidlift sim`, which needs neither.",
    ]
    if engines:
        rows = "; ".join(f"{name} {number(row['overhead of a shot'])} s" for name, row in engines.items())
        most = max(row["overhead of a shot"] for row in engines.values())
        told.append(
            f"What an engine adds to each shot beside its make: {rows}. For {clips} clips that is at most "
            f"{most * clips / 3600.0:.1f} hours of a slot."
        )
    return "\n\n".join(told)


if __name__ == "__main__":
    raise SystemExit(main())
