"""The page that holds our figures against the paper's: each section has something to show and a command that exists."""

import re
import sys
from dataclasses import replace
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
LARGEST = 3_000_000
"""bytes of all its pictures: a page that a telephone loads, and a repository that stays small"""
WITHOUT = {"generators"}
"""sections that say why nothing was measured"""


@pytest.fixture(scope="module")
def made():
    """Modules page and sections of the benchmark."""
    sys.path.insert(0, str(ROOT))
    from benchmarks.paper import page, sections

    yield page, sections.SECTIONS
    sys.path.remove(str(ROOT))


def test_the_page_is_what_the_command_writes(made):
    page, sections = made
    assert page.PAGE.read_text(encoding="utf-8") == page.page(sections), "run python -m benchmarks.paper --page"


def test_every_section_shows_a_picture_or_a_figure_or_says_why_not(made):
    page, sections = made
    results = page.Results.read()
    bare = set()
    for section in sections:
        shown = [file for file, _ in section.pictures if (page.PICTURES / file).is_file()]
        figures = [line for table in section.tables for line in table(results) if re.search(r"\d", line)]
        if not shown and not figures:
            assert section.missing, f"{section.name} shows nothing, and no reason"
            bare.add(section.name)
        assert len(shown) == len(section.pictures), f"{section.name} lacks a picture"
        assert section.paper and section.better
    assert bare == WITHOUT


def test_every_command_of_the_page_exists(made):
    _, sections = made
    steps = set(re.findall(r'^    "(\w+)": ', (ROOT / "benchmarks/paper/__main__.py").read_text(), flags=re.M))
    assert len(steps) > 10
    for section in sections:
        assert section.commands
        for command in section.commands:
            script = re.match(r"python (benchmarks/[\w/]+\.py)", command)
            step = re.match(r"python -m benchmarks\.paper --only (\w+)", command)
            assert script is None or (ROOT / script[1]).is_file(), command
            assert step is None or step[1] in steps, command
            assert script or step or command.startswith("fluidlift "), command


def test_a_section_without_measurements_says_so_in_bold(made):
    page, sections = made
    section = replace(sections[0], pictures=(), tables=(), missing="Nobody was there.")
    lines = section.lines(page.Results({}))
    assert "**Not measured.** Nobody was there." in lines
    assert any(line.startswith("**Better there.**") for line in lines)


def test_its_pictures_are_small_and_all_of_them_are_shown(made):
    page, sections = made
    there = {path.name: path.stat().st_size for path in page.PICTURES.iterdir()}
    assert sum(there.values()) < LARGEST
    assert set(there) == {file for section in sections for file, _ in section.pictures}
