"""What the panel says about the fluid, and which changes of the asset that makes."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from . import Settings
    from .facts import Facts


def read_settings(settings: Settings, facts: Facts) -> None:
    """What the frames were simulated with, into the panel."""
    values = facts.parameters
    settings.viscosity, settings.density = values["kinematic_viscosity"], values["density"]
    settings.gravity, settings.inflow = values["gravity"], values["inflow_velocity"]
    settings.loaded = json.dumps(panel_values(settings))


def read_scene(settings: Settings, facts: Facts, told: str) -> None:
    """What scene.yaml says by now, into the panel: the frames may still show another scene.

    Args:
        told: by `fluidlift edit --json`; lines around it are passed over.

    Raises:
        RuntimeError: it is not what that command says.
    """
    try:
        scene = json.loads(told[told.index("{") : told.rindex("}") + 1])["scene"]
        values, look = facts.fitted | (scene.get("parameters") or {}), scene.get("look") or {}
        styled = look.get("style", "splats") != "splats"
        settings.duration = float(scene.get("duration") or 0.0)
        settings.tint = look.get("tint") or (1.0, 1.0, 1.0)
        settings.material = look.get("material", "source") if styled else "source"
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise RuntimeError(f"fluidlift edit did not say what scene.yaml holds now ({error}): press Refresh.") from None
    read_settings(settings, facts._replace(parameters=values))


def panel_values(s: Settings) -> dict[str, object]:
    """Places in scene.yaml, and what the panel says for them; single precision, rounded to what that holds."""

    def numbers(values) -> list[float]:
        return [float(f"{v:.7g}") for v in values]

    return {
        "parameters.kinematic_viscosity": numbers([s.viscosity])[0], "parameters.density": numbers([s.density])[0],
        "parameters.gravity": numbers(s.gravity), "parameters.inflow_velocity": numbers(s.inflow),
        "duration": numbers([s.duration])[0] or None, "look.material": s.material, "look.tint": numbers(s.tint),
    }  # fmt: skip


def changes(s: Settings) -> list[str]:
    """Options of `fluidlift edit` for what was changed in the panel; what was fitted and left alone stays as it is, in
    full precision."""
    before = json.loads(s.loaded or "{}")
    words = {k: v for k, v in panel_values(s).items() if before.get(k) != v}
    if words.get("look.material", "source") != "source" and before.get("look.material") == "source":
        words["look.style"] = "surface"  # splats as they were lifted have no material
    return [x for k, v in words.items() for x in ("--set", f"{k}={json.dumps(v)}")]
