"""How the body of each kind of fluid is built: one file per kind, found by its name."""

from __future__ import annotations

from importlib import import_module

from fluidlift.shape.kinds.base import AirborneBuilder, BodyBuilder, Observation
from fluidlift.types.kind import FluidKind, kind_of

__all__ = ["AirborneBuilder", "BodyBuilder", "Observation", "builder_of"]


def builder_of(kind: str | FluidKind) -> BodyBuilder:
    """`BUILDER` of the kind's file.

    Raises:
        InputRejected: an unknown name.
    """
    return import_module(f"{__name__}.{kind_of(kind).name}").BUILDER
