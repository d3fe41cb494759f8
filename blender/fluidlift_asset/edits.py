"""What the panel says about the fluid, and which changes of the asset that makes."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from .facts import Facts

if TYPE_CHECKING:
    from . import Settings


def read_settings(settings: Settings, facts: Facts) -> None:
    """What the frames were simulated with, into the panel."""
    values = facts.parameters
    settings.viscosity, settings.density = values["kinematic_viscosity"], values["density"]
    settings.gravity, settings.inflow = values["gravity"], values["inflow_velocity"]
    settings.loaded = json.dumps(panel_values(settings))


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
