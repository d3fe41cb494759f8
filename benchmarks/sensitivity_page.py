"""What the trials of `sensitivity.py` say: bounds, classes, results/sensitivity.json, the tables of its page."""

from __future__ import annotations

import json
import platform
from collections import Counter
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
from report import FOLDER, text_of
from sensitivity_constants import Constant
from sensitivity_scenes import SCENES, SEEDS

PAGE = Path(__file__).resolve().parent.parent / "docs" / "experiments" / "2026-11-sensitivity.md"
MARKS = ("<!-- made by benchmarks/sensitivity.py --record -->", "<!-- end of what is made -->")
SHOWN = 15
"""numbers of the table"""
COMMAND = "python benchmarks/sensitivity.py --seeds"
Row = dict[str, Any]


def bounds(seeds: dict[str, dict[str, float]]) -> dict[str, float]:
    """By figure: median over the scenes of the standard deviation over the seeds."""
    spread: dict[str, list[float]] = {}
    for scene in SCENES:
        several = [seeds[f"{scene}-{seed}"] for seed in SEEDS if f"{scene}-{seed}" in seeds]
        if len(several) < len(SEEDS) or any("failed" in s for s in several):
            continue
        for figure in several[0]:
            values = np.array([s[figure] for s in several], float)
            if np.isfinite(values).all():
                spread.setdefault(figure, []).append(float(np.std(values, ddof=1)))
    return {figure: float(np.median(values)) for figure, values in spread.items() if any(values)}


def worst(row: Row, base: dict[str, float], bound: dict[str, float]) -> tuple[float, str, float]:
    """How many bounds the most changed figure of a trial changes by, which one that is, and by how much."""
    found = (0.0, "", 0.0)
    for figure, value in row.get("figures", {}).items():
        before = base.get(figure, 0.0)
        if figure not in bound or not np.isfinite(before) or not np.isfinite(value):
            continue
        size = abs(value - before) / bound[figure]
        if size > found[0]:
            found = (float(size), figure, float(value - before))
    return found


def judged(rows: list[Row], bound: dict[str, float]) -> dict[str, Row]:
    """By constant: the trial of a made scene that changes most; its class: matters, ends the run, little or nothing."""
    rows = [r for r in rows if r["scene"] in SCENES]
    base = {r["scene"]: r["figures"] for r in rows if not r["constant"]}
    found: dict[str, Row] = {}
    for row in rows:
        if not row["constant"] or row["scene"] not in base:
            continue
        size, figure, change = worst(row, base[row["scene"]], bound)
        entry = found.setdefault(row["constant"], {"size": -1.0, "changed": False, "failed": [], "scenes": set()})
        entry["scenes"].add(row["scene"])
        entry["changed"] |= bool(row.get("changed"))
        if "failed" in row:
            entry["failed"].append(f"times {row['factor']:g}: {row['failed']}")
        if size > entry["size"]:
            entry |= {"size": size, "figure": figure, "change": change, "scene": row["scene"], "factor": row["factor"]}
    for entry in found.values():
        if entry["size"] > 1.0:
            entry["class"] = "matters"
        else:
            entry["class"] = "ends the run" if entry["failed"] else "little" if entry["changed"] else "nothing"
    return found


def counts(found: dict[str, Row], constants: list[Constant], left_out: dict[str, str]) -> dict[str, int]:
    """How many numbers there are of each class."""
    classes = Counter(entry["class"] for entry in found.values())
    return {
        "numbers in all": len(constants) + len(left_out),
        "not tuned (physics, memory, steps of a search)": len(left_out),
        "reached by no scene": len([c for c in constants if c.key not in found]),
        "tried": len(found),
        "change a figure by more than its bound": classes["matters"],
        "end a run, and change no figure by more": classes["ends the run"],
        "change something, by less": classes["little"],
        "change nothing": classes["nothing"],
    }


def record(
    rows: list[Row], seeds: dict[str, dict[str, float]], reached: dict[str, list[str]], constants: list[Constant],
    left_out: dict[str, str],
) -> None:  # fmt: skip
    """Write results/sensitivity.json and the tables of the page.

    Args:
        rows: all trials.
        seeds: figures of other seeds.
        reached: constants that each scene reads.
        constants: all that are tuned.
        left_out: why others are not.
    """
    bound = bounds(seeds)
    found = judged(rows, bound)
    number = counts(found, constants, left_out)
    first = sorted(found, key=lambda k: -found[k]["size"])[:SHOWN]
    scenes = [s for s in SCENES if s in reached]
    records = [{"subject": "all scenes", "figure": k, "value": v} for k, v in number.items()]
    records += [{"subject": k, "figure": "times its bound", "value": round(found[k]["size"], 2)} for k in first]
    records += [{"subject": k, "figure": "bound", "value": float(f"{v:.3g}")} for k, v in bound.items()]
    content = {
        "title": "Tuned numbers",
        "text": "Which numbers of shape and motion matter, each times 0.5 and times 2.",
        "shown": False,
        "rows": "record",
        "command": COMMAND,
        "date": date.today().isoformat(),
        "machine": f"2 cores, {platform.system()}, Python {platform.python_version()}",
        "figures": {r["figure"]: {"unit": "", "better": ""} for r in records},
        "records": records,
    }
    (FOLDER / "sensitivity.json").write_text(text_of(content), encoding="utf-8")
    before, rest = PAGE.read_text(encoding="utf-8").split(MARKS[0])
    after = rest.split(MARKS[1])[1]
    made = "\n".join([*_tables(found, bound, number, first), *_lists(found, constants, scenes)])
    PAGE.write_text(f"{before}{MARKS[0]}\n\n{made}\n{MARKS[1]}{after}", encoding="utf-8")
    print(json.dumps(number, indent=1))


def _tables(found: dict[str, Row], bound: dict[str, float], number: dict[str, int], first: list[str]) -> list[str]:
    lines = ["| numbers | |", "| --- | --- |", *(f"| {k} | {v} |" for k, v in number.items()), ""]
    lines += ["| figure | bound |", "| --- | --- |", *(f"| {k} | {v:.3g} |" for k, v in bound.items()), ""]
    lines += ["| number | changes most | in | times | by | in bounds |", "| --- | --- | --- | --- | --- | --- |"]
    for key in first:
        e = found[key]
        lines.append(
            f"| `{key}` | {e['figure']} | {e['scene']} | {e['factor']:g} | {e['change']:+.3g} | {e['size']:.0f} |"
        )
    failed = [f"`{k}` ({'; '.join(sorted(set(e['failed'])))})" for k, e in sorted(found.items()) if e["failed"]]
    return [*lines, "", "Runs that ended: " + (", ".join(failed) if failed else "none") + ".", ""]


def _lists(found: dict[str, Row], constants: list[Constant], scenes: list[str]) -> list[str]:
    lines = [f"Scenes: {', '.join(scenes)}.", ""]
    for title, keys in (
        ("Change nothing, in any scene that reads them", [k for k, e in found.items() if e["class"] == "nothing"]),
        ("Read by no scene", [c.key for c in constants if c.key not in found]),
    ):
        by_module: dict[str, list[str]] = {}
        for key in sorted(keys):
            module, name = key.rsplit(".", 1)
            by_module.setdefault(module, []).append(name)
        lines += [f"**{title}** ({len(keys)}): " + "; ".join(f"{m} {', '.join(n)}" for m, n in by_module.items()), ""]
    return lines
