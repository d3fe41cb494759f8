"""Puts docs/paper.md together from its sections, the pictures that lie there and the figures in benchmarks/results."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.report import FOLDER, number, table

ROOT = Path(__file__).resolve().parent.parent.parent
PAGE = ROOT / "docs" / "paper.md"
PICTURES = ROOT / "docs" / "pictures" / "paper"

HEAD = """# The paper's figures, and ours

*3D Dynamic Fluid Assets from Single-View Videos with Generative Gaussian Splatting* (Zhao, Zhao, Li, Hu,
[arXiv:2503.00868](https://arxiv.org/abs/2503.00868)): each figure and table of it in our words, and what this program
makes of the same question. The paper's pictures are not shown here, and its clips are not at hand: ours are of the demo
clip and of scenes that this project simulates and films itself, so that the truth is known. Which equation is which
function, and where we differ: [paper_map.md](paper_map.md).

Written by `python -m benchmarks.paper` from [benchmarks/results](../benchmarks/results/paper.json); by its
parts about an hour on two cores (never timed in one go), seconds where its work folder is still there (`--only STEP`
and `--again STEP` for one part, `--page` for the text alone). What is re-simulated here was drawn before patches of the
film stayed in their own places up to its end ([looks.md](looks.md#the-film-that-a-surface-plays)), which brings
re-simulations nearer to their clips. Tables of other benchmarks have their own commands.
"""

Table = Callable[["Results"], list[str]]


@dataclass(frozen=True)
class Results:
    """Figures by topic, subject and name: value and unit."""

    by_topic: dict[str, dict[tuple[str, str], tuple[float, str]]]

    @classmethod
    def read(cls, folder: Path = FOLDER) -> Results:
        """All files of benchmarks/results."""
        found = {}
        for path in sorted(folder.glob("*.json")):
            content = json.loads(path.read_text(encoding="utf-8"))
            units = {name: f.get("unit", "") for name, f in content["figures"].items()}
            found[path.stem] = {
                (r["subject"], r["figure"]): (float(r["value"]), r.get("unit") or units.get(r["figure"], ""))
                for r in content["records"]
            }
        return cls(found)

    def cell(self, topic: str, subject: str, figure: str) -> str:
        """The value with its unit; nothing where it was not measured."""
        found = self.by_topic.get(topic, {}).get((subject, figure))
        return "" if found is None else f"{number(found[0])} {found[1]}".rstrip()

    def subjects(self, topic: str, beginning: str = "") -> list[str]:
        """Of a topic, in the order of the file."""
        return list(dict.fromkeys(s for s, _ in self.by_topic.get(topic, {}) if s.startswith(beginning)))

    def figures(self, topic: str, subject: str) -> list[str]:
        """Of a subject, in the order of the file."""
        return [f for s, f in self.by_topic.get(topic, {}) if s == subject]


@dataclass(frozen=True)
class Section:
    """One figure or table of the paper."""

    name: str
    title: str
    paper: str
    """what it shows, in our words"""
    ours: str
    """what our pictures and tables show"""
    commands: tuple[str, ...]
    better: str
    """where the paper, or another, does better"""
    pictures: tuple[tuple[str, str], ...] = ()
    """file in docs/pictures/paper, and what it shows"""
    tables: tuple[Table, ...] = field(default=())
    missing: str = ""
    """why nothing was measured, where that is so"""

    def lines(self, results: Results) -> list[str]:
        """Markdown."""
        out = [f"## {self.title}", "", f"**In the paper.** {self.paper}", ""]
        shown = [(file, text) for file, text in self.pictures if (PICTURES / file).is_file()]
        out += [line for file, text in shown for line in (f"![{text}](pictures/paper/{file})", "")]
        rows = [line for one in self.tables for line in one(results)]
        if not shown and not rows:
            return [*out, f"**Not measured.** {self.missing or 'Its command was not run yet.'}", "", *self._end()]
        return [*out, f"**Here.** {self.ours}", "", *rows, *self._end()]

    def _end(self) -> list[str]:
        """The commands, and where others are better."""
        commands = ", ".join(f"`{c}`" for c in self.commands)
        return [*([f"Made by {commands}.", ""] if commands else []), f"**Better there.** {self.better}", ""]


def columns(topic: str, subjects: dict[str, str], figures: dict[str, str]) -> Table:
    """A row per subject and a column per figure, as far as measured; both by their names here."""

    def rows(results: Results) -> list[str]:
        body = [[named, *(results.cell(topic, s, f) for f in figures)] for s, named in subjects.items()]
        kept = [row for row in body if any(row[1:])]
        return table(["", *figures.values()], kept) if kept else []

    return rows


def listed(topic: str, subject: str) -> Table:
    """All figures of a subject, a row each."""

    def rows(results: Results) -> list[str]:
        body = [[f, results.cell(topic, subject, f)] for f in results.figures(topic, subject)]
        return table([subject, ""], body) if body else []

    return rows


def page(sections: tuple[Section, ...], results: Results | None = None) -> str:
    """The text of docs/paper.md."""
    found = Results.read() if results is None else results
    contents = [f"- [{s.title}](#{anchor(s.title)})" for s in sections]
    lines = [*HEAD.splitlines(), "", *contents, ""]
    for section in sections:
        lines += section.lines(found)
    return "\n".join(lines).rstrip() + "\n"


def anchor(title: str) -> str:
    """As GitHub makes them."""
    kept = "".join(c for c in title.lower() if c.isalnum() or c in " -_")
    return kept.replace(" ", "-")
