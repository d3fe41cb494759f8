"""Values of stages that are kept in an asset's folder work/, read back without knowing how to make them."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

from fluidlift.io.stage_cache import load_stage, owner_of
from fluidlift.io.stage_codec import Mistyped, unpacked

T = TypeVar("T")


def kept_value(folder: Path, name: str, key: str, kind: type[T]) -> tuple[T, float] | None:
    """A stage's value in the cache with the seconds that it took; None where it is gone, damaged or of another type."""
    found = load_stage(folder, name, key)
    if found is None:
        return None
    arrays, meta = found
    try:
        return unpacked(kind, arrays, meta["value"]), float(meta["seconds"])
    except (Mistyped, KeyError, TypeError, ValueError, OverflowError):
        return None


def last_value(folder: Path, name: str, kind: type[T]) -> T | None:
    """The value whose files lie beside the cache now (the frames of a simulation); None where that is not known."""
    key = owner_of(folder, name)
    found = None if key is None else kept_value(folder, name, key, kind)
    return None if found is None else found[0]
