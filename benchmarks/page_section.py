"""A part of a page between two markers, written anew by a benchmark."""

from __future__ import annotations

from pathlib import Path


def replace_section(page: Path, text: str, begin: str, end: str) -> None:
    """Put the text between the markers of the page.

    Raises:
        ValueError: the page has no such markers.
    """
    old = page.read_text(encoding="utf-8")
    if begin not in old or end not in old:
        raise ValueError(f"{page.name} has no markers {begin} and {end}")
    head, rest = old.split(begin, 1)
    page.write_text(head + begin + "\n" + text + "\n" + end + rest.split(end, 1)[1], encoding="utf-8")
