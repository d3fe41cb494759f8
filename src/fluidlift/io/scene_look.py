"""The section `look` of scene.yaml: how frames are drawn. Nothing in it changes how the fluid moves."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from fluidlift.errors import InputRejected, require
from fluidlift.io.asset_paths import asset_file
from fluidlift.io.entries import Entries
from fluidlift.io.hashes import digest
from fluidlift.messages import Notice

STYLES = ("splats", "relit", "transparent", "surface")
MATERIALS = ("source", "water", "muddy_water", "honey", "lava", "milk", "oil", "chocolate")
"""names of `look.materials.PRESETS`"""
ENVIRONMENTS = ("sky", "studio", "white")
"""names of `look.environment.BUILT_IN`"""
PICTURES = (".hdr", ".exr")
"""of an environment in a file"""

EXPOSURE = 20.0
"""stops, most up or down"""


@dataclass(frozen=True)
class Look:
    """How frames are drawn. The default is the splats with the clip's own colours, as lifted."""

    style: str = "splats"
    """splats: as lifted; relit: splats under other light; transparent, surface: a liquid that refracts and reflects"""
    material: str = "source"
    """one of `MATERIALS`; source: the clip's own colours"""
    environment: str = "sky"
    """one of `ENVIRONMENTS`, or a .hdr or .exr file inside the asset; splats are not lit"""
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """linear RGB, 0 to 1, by which the body's colour is multiplied"""
    exposure: float = 0.0
    """stops: +1 is twice the light"""

    def __post_init__(self) -> None:
        object.__setattr__(self, "tint", tuple(float(c) for c in self.tint))
        require(self.style in STYLES, f"style '{self.style}'", ", ".join(STYLES))
        require(self.material in MATERIALS, f"material '{self.material}'", ", ".join(MATERIALS))
        known = self.environment in ENVIRONMENTS or Path(self.environment).suffix.lower() in PICTURES
        require(known, f"environment '{self.environment}'", ", ".join(ENVIRONMENTS) + ", or a .hdr or .exr file")
        require(len(self.tint) == 3 and all(0 <= c <= 1 for c in self.tint), f"tint {self.tint}", "three of 0 to 1")
        good = math.isfinite(self.exposure) and abs(self.exposure) <= EXPOSURE
        require(good, f"exposure {self.exposure}", f"-{EXPOSURE:g} to {EXPOSURE:g} stops")

    def to_dict(self) -> dict[str, Any]:
        """Plain values, as they stand in scene.yaml."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items()}

    def mark(self, folder: Path | str) -> dict[str, Any]:
        """What pictures depend on: two equal marks draw the same ones.

        Splats as lifted are not lit, so only the style counts for them; an environment in a file comes with its hash.
        """
        if self.style == "splats":
            return {"style": self.style}
        found, path = self.to_dict(), Path(folder) / self.environment
        if self.environment not in ENVIRONMENTS and path.is_file():
            found["environment_sha256"] = digest(path)
        return found

    def warning(self) -> Notice | None:
        """What is said but not drawn."""
        plain = Look()
        idle = [k for k in ("material", "environment", "tint", "exposure") if getattr(self, k) != getattr(plain, k)]
        if self.style != "splats" or not idle:
            return None
        what = f"look.{' and look.'.join(idle)} change{'s' * (len(idle) == 1)} nothing while look.style is splats"
        return Notice("look-not-drawn", f"{what}: set it to relit, transparent or surface")


def read_look(scene: Entries, folder: Path) -> Look:
    """The section `look` of a scene.

    Args:
        scene: all of scene.yaml.
        folder: of the asset, in which an environment's file must lie.

    Raises:
        InputRejected: an entry that is unknown or out of range, or an environment that is not there.
    """
    look, plain = scene.part("look", "look"), Look()
    look.only(plain.to_dict())
    tint = look.vector("tint", plain.tint, limit=1.0, unit="", low=0.0, example="[1, 0.8, 0.6]")
    return Look(
        look.word("style", plain.style, STYLES),
        look.word("material", plain.material, MATERIALS),
        _environment(look, folder) if look.given("environment") else plain.environment,
        tint,
        look.number("exposure", plain.exposure, low=-EXPOSURE, high=EXPOSURE, unit="stops"),
    )


def _environment(look: Entries, folder: Path) -> str:
    name = look.data["environment"]
    if not isinstance(name, str) or Path(name).suffix.lower() not in PICTURES:
        try:
            return look.word("environment", None, ENVIRONMENTS)
        except InputRejected as error:
            raise InputRejected(error.got, f"{error.needed}, or a .hdr or .exr file in the asset", error.do) from None
    try:
        there = asset_file(folder, name).is_file()
    except InputRejected as error:
        raise look.wrong("environment", error.got, error.needed, "copy it into the asset") from None
    if not there:
        raise look.wrong("environment", f"there is no '{name}'", "a file inside the asset", "copy it there")
    return name
