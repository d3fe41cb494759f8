"""Values of stages that are kept in an asset's folder work/, read back without knowing how to make them."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from fluidlift.io.stage_cache import load_stage, owner_of
from fluidlift.io.stage_codec import Mistyped, unpacked
from fluidlift.types.stages import Fit, Flow, Geometry, Motion, Read, Refined, Segmentation

T = TypeVar("T")


class KeptStage(NamedTuple):
    """A stage that an asset was made from, as it lies in the cache."""

    name: str
    key: str
    value: Any
    seconds: float
    """that its work took"""


OF_CLIP: dict[str, type] = {
    "read": Read, "flow": Flow, "segment": Segmentation, "geometry": Geometry, "refine": Refined, "motion": Motion,
    "fit": Fit,
}  # fmt: skip
"""stages that need the clip, and what they leave"""
CORRECTED = {"segment": "correct"}
"""stages whose value is replaced by that of another where that was run: labels with a person's regions over them"""


def kept_value(folder: Path, name: str, key: str, kind: type[T], *, exact: bool = True) -> tuple[T, float] | None:
    """A stage's value in the cache with the seconds that it took; None where it is gone, damaged or of another type.

    Not `exact`: the type may have other fields than when it was kept (`stage_codec.unpacked`).
    """
    found = load_stage(folder, name, key)
    if found is None:
        return None
    arrays, meta = found
    try:
        return unpacked(kind, arrays, meta["value"], exact=exact), float(meta["seconds"])
    except (Mistyped, KeyError, TypeError, ValueError, OverflowError):
        return None


def last_value(folder: Path, name: str, kind: type[T]) -> T | None:
    """The value whose files lie beside the cache now (the frames of a simulation); None where that is not known."""
    key = owner_of(folder, name)
    found = None if key is None else kept_value(folder, name, key, kind)
    return None if found is None else found[0]


def kept_stage(folder: Path, manifest: dict[str, Any], name: str, kind: type) -> KeptStage | None:
    """A stage that an asset was made from, or the one that corrected it; None where its value is gone.

    Args:
        folder: of the asset.
        manifest: of the asset.
        name: of the stage.
        kind: type of its value.
    """
    keys = stage_keys(manifest)
    stage = CORRECTED[name] if CORRECTED.get(name) in keys else name
    # it may be of a version before, whose values had other fields
    found = None if stage not in keys else kept_value(folder, stage, keys[stage], kind, exact=False)
    return None if found is None else KeptStage(stage, keys[stage], *found)


def recalled(folder: Path, manifest: dict[str, Any], name: str) -> Any:
    """The value of one stage of `OF_CLIP` that an asset was made from; None where it is gone."""
    found = kept_stage(folder, manifest, name, OF_CLIP[name])
    return None if found is None else found.value


def stage_keys(manifest: dict[str, Any]) -> dict[str, str]:
    """Keys of the cached values that an asset was made from; those that are none are left out."""
    keys = manifest.get("provenance", {}).get("stages", {})
    return {n: k for n, k in keys.items() if is_key(k)} if isinstance(keys, dict) else {}


def is_key(text: Any) -> bool:
    """Whether this can be the key of a value."""
    return isinstance(text, str) and len(text) == 64 and text.isalnum() and text.isascii()
