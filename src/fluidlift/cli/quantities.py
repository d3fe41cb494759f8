"""Options that take a length, a time or an angle with its unit, and how options are shown in the help."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, TypeVar, dataclass_transform, get_type_hints

import tyro
from tyro.constructors import PrimitiveConstructorSpec

from fluidlift.types.quantity import BYTES, DEGREES, METRES, SECONDS, quantity

Class = TypeVar("Class", bound=type)


def _spec(metavar: str, units: Mapping[str, float]) -> PrimitiveConstructorSpec[float]:
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=metavar,
        instance_from_str=lambda args: quantity(args[0], units),
        is_instance=lambda value: isinstance(value, int | float),
        str_from_instance=lambda value: [f"{value:g}"],
    )


Seconds = Annotated[float, _spec("SECONDS", SECONDS)]
"""such as 3, 3s, 500ms or "2 min" """
Metres = Annotated[float, _spec("METRES", METRES)]
"""such as 0.1, 10cm or "4 in" """
Degrees = Annotated[float, _spec("DEGREES", DEGREES)]
"""such as 12, 12deg or 0.2rad"""
Bytes = Annotated[float, _spec("BYTES", BYTES)]
"""such as 8GB or 512MiB"""


def _folder(text: str) -> Path | str:
    from fluidlift.farm.store import is_url

    return text if is_url(text) else Path(text)


Folder = Annotated[
    Path | str,
    PrimitiveConstructorSpec(
        nargs=1, metavar="FOLDER|URL", instance_from_str=lambda args: _folder(args[0]),
        is_instance=lambda value: isinstance(value, Path | str), str_from_instance=lambda value: [str(value)],
    ),
]  # fmt: skip
"""such as assets/ or s3://bucket/assets"""

_NO_DEFAULTS = ("not given", "False", "True", "")
HINT = tyro.conf.arg(help_behavior_hint=lambda label: "" if label in _NO_DEFAULTS else f"(default: {label})")
"""The help names a default only where there is one: an option that may be left out says by its text what then is."""


@dataclass_transform(frozen_default=True)
def command(made: Class) -> Class:
    """A frozen dataclass whose fields are options, shown with `HINT`."""
    done: Any = dataclass(frozen=True)(made)
    hints = get_type_hints(done, include_extras=True)
    done.__annotations__ = {option.name: Annotated[hints[option.name], HINT] for option in fields(done)}
    return done
