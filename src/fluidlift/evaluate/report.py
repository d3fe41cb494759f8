"""The sheet of figures that an evaluation fills."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Metric:
    """One number, or the reason why there is none."""

    key: str
    """group.name, stable over versions"""
    value: float | None
    unit: str = ""
    note: str = ""
    """what the number was measured on, or why it is missing"""

    @property
    def group(self) -> str:
        """The first part of the key."""
        return self.key.split(".", 1)[0]

    @property
    def text(self) -> str:
        """The value with four digits, '-' where there is none."""
        return "-" if self.value is None else f"{self.value:.4g}"


def figure(key: str, value: float | None, unit: str = "", note: str = "") -> Metric:
    """A figure whose value is a finite Python float or None."""
    if value is not None and not np.isfinite(value):
        return Metric(key, None, unit, f"not finite ({value}) {note}".strip())
    return Metric(key, None if value is None else float(value), unit, note)


@dataclass(frozen=True)
class Evaluation:
    """How close an asset came to the truth of one case."""

    case: str
    figures: tuple[Metric, ...]
    series: dict[str, tuple[float, ...]] = field(default_factory=dict)
    """figures per frame"""

    def __getitem__(self, key: str) -> float | None:
        """The value of a figure.

        Raises:
            KeyError: no figure of this key.
        """
        for item in self.figures:
            if item.key == key:
                return item.value
        raise KeyError(key)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, lists and strings."""
        return {
            "case": self.case,
            "figures": {f.key: {"value": f.value, "unit": f.unit, "note": f.note} for f in self.figures},
            "series": {k: [float(x) if np.isfinite(x) else None for x in v] for k, v in self.series.items()},
        }

    def to_json(self) -> str:
        """`to_dict` as text."""
        return json.dumps(self.to_dict(), indent=1, allow_nan=False)

    def table(self) -> list[tuple[str, str, str, str]]:
        """Rows (key, value, unit, note) in the order of measurement."""
        return [(f.key, f.text, f.unit, f.note) for f in self.figures]
