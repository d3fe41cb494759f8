"""What can go wrong, by whose fault it is: every message says what was got, what is needed and what to do."""

from typing import TypeVar

T = TypeVar("T")


class FluidliftError(Exception):
    """The work failed (exit code 1)."""


class InputRejected(FluidliftError):
    """The input cannot be used as it is (exit code 3).

    Args:
        got: what was found, with the name of the file or option.
        needed: what would be accepted.
        do: what the user can do about it.
    """

    def __init__(self, got: str, needed: str = "", do: str = "") -> None:
        self.got, self.needed, self.do = got, needed, do
        parts = [got.rstrip(".") + "."]
        if needed:
            parts.append("Needed: " + needed.rstrip(".") + ".")
        if do:
            parts.append("Do: " + do.rstrip(".") + "." * (not do.endswith("?")))
        super().__init__(" ".join(parts))


class MissingPackage(FluidliftError):
    """An optional package is not installed; the message says which and how to install it."""


def required(value: T | None, got: str, needed: str = "") -> T:
    """The value; `ValueError` as `require` raises it where it is None."""
    if value is None:
        raise ValueError(str(InputRejected(got, needed)))
    return value


def require(condition: bool, got: str, needed: str = "", do: str = "") -> None:
    """Raise `ValueError` with got / needed / do unless the condition holds (for wrong arguments in code)."""
    if not condition:
        raise ValueError(str(InputRejected(got, needed, do)))
