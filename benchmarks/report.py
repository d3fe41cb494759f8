"""Writes docs/results.md from the figures in `benchmarks/results/`, and compares them with those of another commit.

    python -m benchmarks.report                    write the page
    python -m benchmarks.report --against v0.1     what got better or worse since then

One JSON file per topic:

    title, text        of its section
    rows               "subject": a row per subject, a column per figure; "figure": the other way round; "record": a row
                       per record
    command, date, machine        of all records that have none of their own
    figures            name: {unit, better ("less", "more" or ""), goal}
    records            {subject, figure, value, before; goal, unit, better, command, date, machine where they differ}

Topics, figures and records with `"shown": false` are in the file, in comparisons, and not on the page. `before` is the
value that the last change replaced. A benchmark adds its records with `put`, as `clips.py` does for clips and cases;
the figures of the other topics were copied from what their commands print, and have to be again after a new run.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / "benchmarks" / "results"
PAGE = ROOT / "docs" / "results.md"
LONGEST = 200
"""lines of the page"""
ORDER = (
    "clips", "cases", "as_filmed", "hinted", "geometry", "motion", "splats",
    "fit", "simulator", "peers", "device", "cost", "trust",
)  # fmt: skip
"""of the sections; other topics follow by name"""
SAME = 0.005
"""relative difference that `--against` does not mention"""
HEAD = """# Results

Written by `python -m benchmarks.report` from [benchmarks/results](../benchmarks/results): more figures than are shown
here, each with its command, date and machine. `python -m benchmarks.report --against REV` says what got better or worse
since a commit. How each was measured, what was tried and left out: [experiments](experiments/README.md).
**Bold**: misses its goal. In brackets: the value before the last change. Cases and clips other than the demo are not
part of the project; no figure is [held out](experiments/2026-11-clips.md#how-to-read-these-figures) unless it says so.
"""


@dataclass(frozen=True)
class Record:
    """One measured figure of one subject."""

    topic: str
    subject: str
    figure: str
    unit: str
    value: float
    before: float | None
    goal: float | None
    better: str
    """less, more, or nothing where neither is"""
    command: str
    date: str
    machine: str
    shown: bool

    @property
    def met(self) -> bool:
        """Whether the goal is, or there is none."""
        if self.goal is None:
            return True
        return self.value <= self.goal if self.better == "less" else self.value >= self.goal

    def cell(self) -> str:
        """The value for a table, with the one before."""
        text = number(self.value) if self.met else f"**{number(self.value)}**"
        return text if self.before is None else f"{text} ({number(self.before)})"


def number(value: float) -> str:
    """Three digits, without an exponent where that is short."""
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def records_of(topic: str, content: dict[str, Any]) -> list[Record]:
    """The records of one file, with what they inherit from it.

    Raises:
        ValueError: a record lacks a field, names a figure that is not listed, or has a word for `better` that is none.
    """
    found = []
    for r in content["records"]:
        if r.get("figure") not in content["figures"] or "subject" not in r or "value" not in r:
            raise ValueError(f"{topic}: {r} needs subject, value, and a figure of {sorted(content['figures'])}")
        all_of = {"before": None, "goal": None, "unit": "", "better": "", "shown": True}
        all_of |= {k: content[k] for k in ("command", "date", "machine")} | content["figures"][r["figure"]] | r
        found.append(Record(topic=topic, **all_of))
        if found[-1].better not in ("less", "more", ""):
            raise ValueError(f"{topic}: better is '{found[-1].better}', not less, more or nothing")
    return found


def put(topic: str, records: Iterable[dict[str, Any]], *, folder: Path = FOLDER, **defaults: str) -> None:
    """Add records to a topic's file, or replace those of the same subject and figure; what they replace is `before`.

    A figure that the file does not list is added, not shown on the page.

    Args:
        topic: Name of a file that is there.
        records: subject, figure, value; unit and better of a new figure.
        folder: Where the files lie.
        defaults: command, date and machine of these records.

    Raises:
        FileNotFoundError: there is no such topic.
    """
    path = folder / f"{topic}.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    there = {(r["subject"], r["figure"]): r for r in content["records"]}
    for new in records:
        unit, better = new.pop("unit", ""), new.pop("better", "")
        content["figures"].setdefault(new["figure"], {"unit": unit, "better": better, "shown": False})
        old = there.get((new["subject"], new["figure"]), {})
        changed = "value" in old and abs(new["value"] - old["value"]) > SAME * abs(old["value"])
        before = {"before": old["value"]} if changed else {}
        there[new["subject"], new["figure"]] = {**old, **before, **new, **defaults}
    content["records"] = list(there.values())
    path.write_text(text_of(content), encoding="utf-8")


def text_of(content: dict[str, Any]) -> str:
    """JSON with one record, and one figure, per line."""
    lines = [f"{json.dumps(k)}: {json.dumps(v)}" for k, v in content.items() if k not in ("figures", "records")]
    figures = ",\n  ".join(f"{json.dumps(k)}: {json.dumps(v)}" for k, v in content["figures"].items())
    records = ",\n  ".join(json.dumps(r) for r in content["records"])
    lines += [f'"figures": {{\n  {figures}\n }}', f'"records": [\n  {records}\n ]']
    return "{\n " + ",\n ".join(lines) + "\n}\n"


def table(head: list[str], rows: list[list[str]]) -> list[str]:
    """Markdown, with an empty line after it."""
    clean = [[cell.replace("|", "/") for cell in row] for row in rows]
    return ["| " + " | ".join(r) + " |" for r in [head, ["---"] * len(head), *clean]] + [""]


def section(content: dict[str, Any], records: list[Record]) -> list[str]:
    """One topic of the page."""
    shown = [r for r in records if r.shown]
    command = f"`{content['command']}`, " if content["command"] else ""
    lines = [f"## {content['title']}", "", f"{content['text']} {command}{content['date']}.", ""]
    if content["rows"] == "record":
        rows = [[r.subject, r.figure, f"{r.cell()} {r.unit}".strip(), bound(r.goal, r.better)] for r in shown]
        return lines + table(["subject", "figure", "value", "goal"], rows)
    cells = {(r.subject, r.figure): r.cell() for r in shown}
    subjects, figures = (list(dict.fromkeys(x)) for x in zip(*cells))
    named = {f: ", ".join(filter(None, (f, content["figures"][f]["unit"], goal_of(content, f)))) for f in figures}
    if content["rows"] == "subject":
        rows = [[s, *(cells.get((s, f), "") for f in figures)] for s in subjects]
        return lines + table(["subject", *named.values()], rows)
    rows = [[named[f], *(cells.get((s, f), "") for s in subjects)] for f in figures]
    return lines + table(["figure", *subjects], rows)


def goal_of(content: dict[str, Any], figure: str) -> str:
    """Such as "goal ≤ 0.05"; nothing where there is none."""
    f = content["figures"][figure]
    text = bound(f.get("goal"), f.get("better", ""))
    return f"goal {text}" if text else ""


def bound(goal: float | None, better: str) -> str:
    """A goal with its direction."""
    return "" if goal is None else f"{'≤' if better == 'less' else '≥'} {number(goal)}"


def topics(folder: Path = FOLDER) -> dict[str, dict[str, Any]]:
    """The contents of all files, in the order of the page."""
    found = {p.stem: json.loads(p.read_text(encoding="utf-8")) for p in sorted(folder.glob("*.json"))}
    return {k: found[k] for k in sorted(found, key=lambda k: (ORDER.index(k) if k in ORDER else len(ORDER), k))}


def page(folder: Path = FOLDER) -> str:
    """The text of docs/results.md."""
    lines = [*HEAD.splitlines(), ""]
    hidden = []
    for topic, content in topics(folder).items():
        if content.get("shown", True):
            lines += section(content, records_of(topic, content))
        else:
            hidden.append(f"[{content['title'].lower()}](../benchmarks/results/{topic}.json)")
    if hidden:
        lines.append(f"In the files alone: {', '.join(hidden)}.")
    return "\n".join(lines).rstrip() + "\n"


def topics_at(revision: str) -> dict[str, dict[str, Any]]:
    """The contents of the files in another commit.

    Raises:
        SystemExit: git knows no such commit, or it has no figures.
    """
    command = ["git", "-C", str(ROOT), "ls-tree", "--name-only", revision, "benchmarks/results/"]
    listed = subprocess.run(command, capture_output=True, text=True)
    names = [n for n in listed.stdout.split() if n.endswith(".json")]
    if listed.returncode or not names:
        raise SystemExit(f"no figures in {revision}: {listed.stderr.strip() or 'it has no benchmarks/results/*.json'}")
    found = {}
    for name in names:
        shown = subprocess.run(
            ["git", "-C", str(ROOT), "show", f"{revision}:{name}"], capture_output=True, text=True, check=True
        )
        found[Path(name).stem] = json.loads(shown.stdout)
    return found


def compared(now: Iterable[Record], then: Iterable[Record]) -> dict[str, list[str]]:
    """What is better, worse, changed (no direction), new and gone, a line each."""
    old = {(r.topic, r.subject, r.figure): r for r in then}
    new = {(r.topic, r.subject, r.figure): r for r in now}
    found: dict[str, list[str]] = {k: [] for k in ("better", "worse", "changed", "new", "gone")}
    for key, r in new.items():
        name = f"{r.topic}: {r.subject}, {r.figure}"
        if key not in old:
            found["new"].append(f"{name}: {number(r.value)} {r.unit}".rstrip())
            continue
        change = r.value - old[key].value
        if abs(change) <= SAME * abs(old[key].value):
            continue
        outcome = "changed" if not r.better else "better" if (change < 0) == (r.better == "less") else "worse"
        missed = ", now misses its goal" if old[key].met and not r.met else ""
        found[outcome].append(f"{name}: {number(old[key].value)} > {number(r.value)} {r.unit}".rstrip() + missed)
    found["gone"] = [f"{t}: {s}, {f}" for t, s, f in old if (t, s, f) not in new]
    return found


def main(argv: list[str] | None = None) -> int:
    """Write the page, or compare."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--against", metavar="REV", help="a commit, branch or tag to compare with")
    args = parser.parse_args(argv)
    if args.against is None:
        PAGE.write_text(page(), encoding="utf-8")
        return 0
    both = [
        [r for topic, content in some.items() for r in records_of(topic, content)]
        for some in (topics(), topics_at(args.against))
    ]
    for outcome, lines in compared(*both).items():
        if lines:
            print("\n".join([f"{outcome} ({len(lines)})", *(f"  {line}" for line in lines)]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
