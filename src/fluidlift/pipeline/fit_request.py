"""What a person asks of the fit: which parameters are free, which values are known."""

from __future__ import annotations

import difflib
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import yaml

from fluidlift.config import FitConfig
from fluidlift.errors import InputRejected
from fluidlift.io.yaml_reader import parse_yaml
from fluidlift.types import FluidParameters
from fluidlift.types.parameter_table import FITTABLE, VECTORS

NAMES = tuple(FITTABLE)
"""what can be fitted: the paper's parameters"""
Value = float | tuple[float, float, float]


@dataclass(frozen=True)
class FitRequest:
    """What is asked of one fit."""

    free: tuple[str, ...] = ()
    """names; empty: all that the clip can tell something about"""
    held: dict[str, Value] = field(default_factory=dict)
    """known values; a number for a vector is its length"""
    everything: bool = False
    """whether all that there is shall be fitted"""

    def free_of(self, usual: tuple[str, ...]) -> tuple[str, ...]:
        """The names to fit, where `usual` would be fitted otherwise."""
        return tuple(name for name in (NAMES if self.everything else self.free or usual) if name not in self.held)

    def applied(self, guess: FluidParameters, *, along: np.ndarray) -> FluidParameters:
        """The first guess with the known values in it.

        Args:
            guess: where the fit starts.
            along: unit direction that a speed at the inlet has where the guess gives none.
        """
        values: dict[str, Any] = {}
        for name, value in self.held.items():
            if name in VECTORS and not isinstance(value, tuple):
                arrow = np.asarray(getattr(guess, name))
                length = float(np.linalg.norm(arrow))
                direction = arrow / length if length > 0 else np.asarray(along, float)
                # gravity=-9.81 means the same as 9.81: down
                size = abs(value) if name == "gravity" else value
                value = tuple(float(x) for x in size * direction)
            values[name] = value
        return guess.updated(values)


def request_of(config: FitConfig) -> FitRequest:
    """The request that settings make.

    Raises:
        InputRejected: an unknown or ambiguous name, a value that is no number or out of range, a parameter that is to
            be fitted and known at once, a device that is not there.
    """
    if config.device != "cpu":
        from fluidlift.fit.settings import there

        if not there(config.device):
            raise InputRejected(
                f"fit.device = {config.device}", "cpu, or a device with double precision that torch sees, such as cuda"
            )
    held: dict[str, Value] = {}
    for text in config.hold:
        word, sign, value = text.partition("=")
        if not sign:
            raise InputRejected(f"the known value '{text}'", "name=value, such as viscosity=1e-6")
        name = parameter_named(word.strip())
        held[name] = _value(name, value.strip())
    everything = config.free == ("all",)
    free = () if everything else tuple(dict.fromkeys(parameter_named(word) for word in config.free))
    both = [name for name in free if name in held]
    if both:
        raise InputRejected(f"{both[0]} is to be fitted and known", "one of --free and --hold")
    if "time_step" in held:
        raise InputRejected(
            "a known time_step", "another parameter: the fit divides the frame interval by a whole number of its own",
            "give time_step in scene.yaml, for the simulation",
        )  # fmt: skip
    return FitRequest(free, held, everything)


def parameter_named(word: str) -> str:
    """The one parameter that a word means: its name, or a part of it that no other has (viscosity, damping).

    Raises:
        InputRejected: none, or several.
    """
    plain = word.strip().lower().replace("-", "_").replace(" ", "_")
    found = [name for name in NAMES if plain == name] or [name for name in NAMES if plain and plain in name]
    if len(found) == 1:
        return found[0]
    if found:
        raise InputRejected(f"the parameter '{word}' could be {' or '.join(found)}", "one of them")
    near = difflib.get_close_matches(plain, NAMES, n=1, cutoff=0.5)
    raise InputRejected(f"unknown parameter '{word}'", "one of " + ", ".join(NAMES), f"try {near[0]}" if near else "")


def _value(name: str, text: str) -> Value:
    numbers: Any = None
    try:
        numbers = parse_yaml(text)
        found = [float(x) for x in numbers] if isinstance(numbers, list) else float(numbers)
    except (yaml.YAMLError, TypeError, ValueError, OverflowError):
        raise InputRejected(f"the value '{text}' of {name}", "a number") from None
    if isinstance(found, list):
        if name not in VECTORS or len(found) != 3:
            wanted = "a number, or three in brackets" if name in VECTORS else "a number"
            raise InputRejected(f"the value '{text}' of {name}", wanted)
        found = (found[0], found[1], found[2])
    checked = (0.0, 0.0, found) if name in VECTORS and not isinstance(found, tuple) else found
    FluidParameters().updated({name: checked})
    return found


def startable(initial: FluidParameters, held: dict[str, Value]) -> FluidParameters:
    """The initial values, known zeros a trace above zero: the fit reads zeros at the ends off the velocities."""
    trace = 1e-9
    changes: dict[str, Any] = {n: trace for n in ("inflow_fluctuation", "outflow_velocity")
                               if n in held and getattr(initial, n) == 0}  # fmt: skip
    if "inflow_velocity" in held and not any(initial.inflow_velocity):
        changes["inflow_velocity"] = (trace, 0.0, 0.0)
    return replace(initial, **changes)
