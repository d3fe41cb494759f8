"""Quantities as people write them, "3 s", "10 cm", "2 cSt", in SI units."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

SECONDS: Mapping[str, float] = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0}
METRES: Mapping[str, float] = {"m": 1.0, "cm": 0.01, "mm": 1e-3, "km": 1e3, "in": 0.0254, "ft": 0.3048}
DEGREES: Mapping[str, float] = {"deg": 1.0, "°": 1.0, "degrees": 1.0, "rad": 180.0 / math.pi}
BYTES: Mapping[str, float] = {"B": 1.0, "KB": 1e3, "MB": 1e6, "GB": 1e9, "MiB": 2.0**20, "GiB": 2.0**30}
OF_UNIT: Mapping[str, Mapping[str, float]] = {
    "kg/m^3": {"kg/m^3": 1.0, "g/cm^3": 1e3, "g/ml": 1e3, "kg/l": 1e3},
    "m^2/s": {"m^2/s": 1.0, "mm^2/s": 1e-6, "cm^2/s": 1e-4, "St": 1e-4, "cSt": 1e-6},
    "N/m": {"N/m": 1.0, "mN/m": 1e-3, "dyn/cm": 1e-3},
    "m/s^2": {"m/s^2": 1.0, "g": 9.80665},
    "m/s": {"m/s": 1.0, "cm/s": 0.01, "mm/s": 1e-3, "km/h": 1.0 / 3.6},
    "s": SECONDS,
}
"""what a unit of the table of parameters may be written as, with the factor to it"""
DYNAMIC: Mapping[str, float] = {"Pa s": 1.0, "Pa*s": 1.0, "mPa s": 1e-3, "mPa*s": 1e-3, "P": 0.1, "cP": 1e-3}
"""dynamic viscosity: over the density it is the kinematic one"""

_NUMBER = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(.*?)\s*", re.ASCII)
_DIGITS = 400
"""characters of a quantity that are looked at: no number of double precision is longer"""


def quantity(text: str, units: Mapping[str, float]) -> float:
    """The number of a text such as "10 cm", in the unit whose factor is 1; a bare number is in that unit.

    Raises:
        ValueError: no number, not a finite one, or another unit; its text names those there are.
    """
    found = _NUMBER.fullmatch(text) if len(text) <= _DIGITS else None
    unit = (
        ""
        if found is None
        else found[2].replace("²", "^2").replace("³", "^3").replace("m2", "m^2").replace("m3", "m^3")
    )
    factor = 1.0 if unit == "" else units.get(unit)
    if found is None or factor is None or not math.isfinite(value := float(found[1]) * factor):
        raise ValueError(f"'{text[:40]}' is no number, alone or with one of {', '.join(units)}")
    return float(f"{value:.12g}")  # 20e-6, not 1.9999999999999998e-05


def parameter(text: str, unit: str, *, density: float | None = None) -> float:
    """A physical parameter in its own unit; viscosities may be dynamic where the density (kg/m^3) is known.

    Raises:
        ValueError: as `quantity`.
    """
    units = dict(OF_UNIT.get(unit, {}))
    if unit == "m^2/s" and density is not None:
        units |= {name: factor / density for name, factor in DYNAMIC.items()}
    return quantity(text, units)
