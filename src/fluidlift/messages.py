"""What a person should know: a text, and a code by which programs tell it from other texts; and texts for terminals."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any, TextIO


class Notice(str):
    """A text with a code; wherever a text will do, it is one.

    Codes last as long as values do (`io.stage_codec` keeps them); files and JSON for programs hold them beside the
    texts (`as_plain`), and files for people hold the text alone.

    Args:
        code: lower-case words with hyphens, which stay what they are: docs/warnings.md lists them.
        text: for people.
    """

    code: str

    def __new__(cls, code: str, text: str) -> Notice:
        self = super().__new__(cls, text)
        self.code = code
        return self

    def __getnewargs__(self) -> tuple[str, str]:
        return self.code, str(self)


NONE = Notice("", "")
"""nothing to say"""


def without(warnings: tuple[Notice, ...], code: str) -> tuple[Notice, ...]:
    """All warnings but those of a code."""
    return tuple(w for w in warnings if code_of(w) != code)


def code_of(warning: str) -> str:
    """The code of a warning; empty where it has none, as in files of earlier versions."""
    return warning.code if isinstance(warning, Notice) else ""


def as_plain(warnings: Iterable[str]) -> dict[str, list[str]]:
    """Texts, and as many codes beside them, as JSON and YAML hold both."""
    told = list(warnings)
    return {"warnings": [str(w) for w in told], "warning_codes": [code_of(w) for w in told]}


def from_plain(data: Mapping[str, Any]) -> list[Notice]:
    """The reverse of `as_plain`, of data that anybody may have written: without codes where there are none."""
    texts, codes = data.get("warnings"), data.get("warning_codes")
    texts = [t for t in texts if isinstance(t, str)] if isinstance(texts, list) else []
    known = isinstance(codes, list) and len(codes) == len(texts) and all(isinstance(c, str) for c in codes)
    return [Notice(c, t) for c, t in zip(codes if known and isinstance(codes, list) else [""] * len(texts), texts)]


_COMMANDS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
"""characters that a terminal obeys instead of showing them, but for tabs and line breaks: they would clear it, change
its title, fill the clipboard, or let a name read backwards"""


def visible(text: str) -> str:
    """A text with names and words of strangers, as a terminal may have it: what commands a terminal is spelled out."""
    return _COMMANDS.sub(lambda c: c.group().encode("unicode_escape").decode("ascii"), text)


class VisibleOutput:
    """A stream that takes texts as `visible` shows them; in everything else it is the stream that it holds.

    Args:
        stream: such as standard output.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """How many characters were taken."""
        self._stream.write(visible(text))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        """One after the other."""
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        """Hand on what is buffered."""
        self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)
