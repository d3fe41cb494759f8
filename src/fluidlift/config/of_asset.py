"""The settings that an asset was made with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from fluidlift.config import PRESETS, JobConfig, build_config
from fluidlift.errors import InputRejected

SECOND_HALF_SECTIONS = ("simulate", "show")
"""settings that the second half depends on"""


def settings_of(
    manifest: dict[str, Any], overrides: Sequence[str], flat: dict[str, Any], *, sections: Sequence[str], work: str
) -> JobConfig:
    """The settings that the asset was made with, and what is changed now.

    Of an asset made by another version, settings that this one does not know are left out.

    Args:
        manifest: of the asset.
        overrides: `section.name=value`.
        flat: settings by dotted name; None values are left out.
        sections: that matter for the work.
        work: a word for it.

    Raises:
        InputRejected: a setting of another section, an unknown one, or a wrong value.
    """
    for text in overrides:
        if text.partition("=")[0].strip().partition(".")[0] not in sections:
            raise InputRejected(
                f"--set {text}, which has no effect on {work}", " or ".join(f"{s}.name=value" for s in sections),
                "change it with fluidlift make",
            )  # fmt: skip
    provenance = manifest.get("provenance", {})
    stored = provenance.get("config", {})
    values: dict[str, Any] = {"seed": provenance.get("seed")}
    for section in sections:
        part = stored.get(section, {}) if isinstance(stored, dict) else {}
        known = JobConfig().section(section)
        values |= {f"{section}.{k}": v for k, v in part.items() if k in known} if isinstance(part, dict) else {}
    preset = stored.get("preset") if isinstance(stored, dict) else None
    preset = preset if isinstance(preset, str) and preset in PRESETS else None
    return build_config(preset, None, overrides, values | {k: v for k, v in flat.items() if v is not None})
