"""What a person should know: a text, and a code by which programs tell it from other texts."""

from __future__ import annotations


class Notice(str):
    """A text with a code; wherever a text will do, it is one.

    Codes last as long as values do (`io.stage_codec` keeps them); files for people hold the text alone.

    Args:
        code: a word of the module that warns.
        text: for people.
    """

    code: str

    def __new__(cls, code: str, text: str) -> Notice:
        self = super().__new__(cls, text)
        self.code = code
        return self

    def __getnewargs__(self) -> tuple[str, str]:
        return self.code, str(self)


def without(warnings: tuple[str, ...], code: str) -> tuple[str, ...]:
    """All warnings but those of a code."""
    return tuple(w for w in warnings if code_of(w) != code)


def code_of(warning: str) -> str:
    """The code of a warning; empty where it has none."""
    return warning.code if isinstance(warning, Notice) else ""
