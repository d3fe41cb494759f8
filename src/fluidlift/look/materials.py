"""What a liquid is made of, for pictures: refractive index, absorption, scattering, glow.

All colours are linear light with the primaries of sRGB. Spectra were rounded to three numbers at the dominant
wavelengths of those primaries (611, 549 and 465 nm). Lengths are metres: a material looks thin in a small body and
deep in a large one, as in the world. `carried` says how much of the splats' own colour is kept. Where absorption and
scattering are both measured, the colour of a deep body follows from them (`optics.deep_color`).
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from fluidlift.errors import InputRejected, require
from fluidlift.look.optics import two_fluxes

Color = tuple[float, float, float]

TINT_DEPTH = 0.1
"""m of liquid through which white light takes on a tint in full"""
TINT_LEAST = 1e-3
"""a channel of a tint counts as at least this: nothing absorbs without end"""


@dataclass(frozen=True)
class Material:
    """How a liquid deals with light. It shows itself by the index at its surface and by the rest in its body."""

    name: str
    refractive_index: float = 1.333
    """next to air's, 1 to 4"""
    absorption: Color = (0.0, 0.0, 0.0)
    """1/m: exp(-absorption d) of the light is left after d metres"""
    scattering: float = 0.0
    """1/m: share of light that leaves its way per metre; 0: clear, 1000: nothing is seen through a few millimetres"""
    albedo: Color = (0.8, 0.8, 0.8)
    """linear colour, 0 to 1, of a body so deep that one sees nothing behind it, under white light"""
    roughness: float = 0.0
    """of the surface, 0 (a mirror) to 1 (dull), as in GGX: the width of slopes is its square"""
    emission: Color = (0.0, 0.0, 0.0)
    """linear radiance of the hottest part; 1 is a white sheet in the light of the environment"""
    carried: float = 0.0
    """0 to 1: how much the colour of the splats shows in the body, in place of the albedo"""
    foams: bool = False
    """where it falls and breaks it is white with air, as its splats show it (`surface_foam`)"""

    def __post_init__(self) -> None:
        one = f"material '{self.name}' with"
        require(1.0 <= self.refractive_index <= 4.0, f"{one} refractive index {self.refractive_index}", "1 to 4")
        for what in ("absorption", "emission", "albedo"):
            color = tuple(float(c) for c in getattr(self, what))
            top = 1.0 if what == "albedo" else np.inf
            good = len(color) == 3 and all(np.isfinite(c) and 0.0 <= c <= top for c in color)
            require(good, f"{one} {what} {color}", "three numbers" + (" of 0 to 1" if what == "albedo" else " from 0"))
            object.__setattr__(self, what, color)
        good = np.isfinite(self.scattering) and self.scattering >= 0
        require(good, f"{one} scattering {self.scattering}", "1/m, from 0")
        require(0.0 <= self.roughness <= 1.0, f"{one} roughness {self.roughness}", "0 to 1")
        require(0.0 <= self.carried <= 1.0, f"{one} carried colour {self.carried}", "0 to 1")

    @property
    def fluxes(self) -> tuple[np.ndarray, np.ndarray]:
        """Fading (1/m) and cloud (0 to 1) of light in the body, per channel (`optics.passed`, `optics.two_fluxes`).

        A clear body has no cloud and fades by its absorption. Nor has one that is seen by colours put into it (those of
        the splats alone, or a glow): they take the place of all light that is lost, scattered forward or not.
        """
        return _fluxes(self)

    def before_white(self, depth: float) -> np.ndarray:
        """Linear colour [3] of `depth` metres of it before a white ground, for previews without rays: a spoon of honey
        is gold, though a barrel is brown. Without the mirror of its surface, its glow, what it carries, and
        what is scattered forward."""
        absorption = np.asarray(self.absorption)
        left = np.exp(-(absorption + self.scattering) * depth)
        own = (1.0 - left) * np.asarray(self.albedo) if self.scattering > 0 else 0.0
        return left + own

    def tinted(self, tint: Color) -> Material:
        """The same liquid dyed: body and glow times `tint` (linear, 0 to 1), and light through `TINT_DEPTH` as well.

        Raises:
            ValueError: a tint outside 0 to 1.
        """
        t = np.asarray(tint, float)
        require(t.shape == (3,) and bool(((t >= 0) & (t <= 1)).all()), f"tint {tint}", "three numbers of 0 to 1")
        dye = -np.log(np.maximum(t, TINT_LEAST)) / TINT_DEPTH

        def color(values: np.ndarray) -> Color:
            return (float(values[0]), float(values[1]), float(values[2]))

        return replace(
            self, absorption=color(np.asarray(self.absorption) + dye), albedo=color(np.asarray(self.albedo) * t),
            emission=color(np.asarray(self.emission) * t),
        )  # fmt: skip


@lru_cache(maxsize=64)
def _fluxes(material: Material) -> tuple[np.ndarray, np.ndarray]:
    m = material
    extinction = np.asarray(m.absorption, np.float64) + m.scattering
    if m.scattering == 0 or m.carried >= 1.0 or max(m.emission) > 0:
        return extinction, np.zeros(3)
    return two_fluxes(extinction, np.asarray(m.albedo), m.refractive_index)


WATER = Material("water", 1.333, absorption=(0.27, 0.056, 0.010), foams=True)
"""Absorption of pure water, Pope and Fry 1997 (Applied Optics 36, 8710): 0.27, 0.056 and 0.010 per metre."""

MUDDY_WATER = Material(
    "muddy_water", 1.334, absorption=(0.9, 1.6, 3.4), scattering=22.0, albedo=(0.30, 0.185, 0.085), carried=0.15,
    foams=True,
)  # fmt: skip
"""A river in flood: some 50 mg of silt a litre, which scatter about 0.4 m^2/g (Kirk 1994), brown by iron and humus that
take more blue than red."""

HONEY = Material(
    "honey", 1.49, absorption=(3.0, 16.0, 70.0), scattering=15.0, albedo=(0.1992, 0.0614, 0.0164), roughness=0.04
)
"""Honey as it is extracted and strained. Index at 18 % water. White to extra light amber, by the USDA's colour standard
(absorbance of 0.19 to 0.6 through 3.15 cm at 560 nm, so 14 to 43 per metre), which is of clear honey; red and blue
after the usual fall of brown spectra with wavelength. Cloudiness (reduced scattering) is an estimate from what such
honey holds, to a factor of two: a quarter of a percent of first crystals of glucose of 10 um, 8 per metre; 0.15 % of
fine air (40 um), 4; colloids, 2.5; 20,000 to 100,000 grains of pollen in 10 g, which throw light forward, 0.5. Ground
is still seen through a centimetre. Filtered and heated honey has 2 to 6, creamed honey hundreds. Gold in a spoon, brown
amber in a vat: the albedo is `optics.deep_color` of the rest."""

LAVA = Material(
    "lava", 1.58, absorption=(300.0, 300.0, 300.0), scattering=3000.0, albedo=(0.035, 0.030, 0.028), roughness=0.45,
    emission=(4.5, 0.60, 0.006),
)  # fmt: skip
"""Basalt: a dark, rough skin over a melt of about 1430 K, whose glow has the colour of a black body."""

MILK = Material("milk", 1.35, absorption=(1.1, 2.4, 14.0), scattering=3200.0, albedo=(0.91, 0.88, 0.76), roughness=0.05)
"""Whole milk, Jensen, Marschner, Levoy and Hanrahan 2001 (table 2): absorption, reduced scattering and diffuse
reflectance."""

OIL = Material(
    "oil", 1.47, absorption=(9.0, 7.0, 150.0), scattering=0.8, albedo=(0.0073, 0.0093, 0.0004), roughness=0.02
)
"""Olive oil: carotenes take the blue (absorbance near 0.7 through 1 cm at 465 nm), chlorophyll some of the red. All but
clear: its colour is that of the light behind it, and a deep body is as dark as `optics.deep_color` says."""

CHOCOLATE = Material(
    "chocolate", 1.457, absorption=(400.0, 900.0, 1500.0), scattering=4000.0, albedo=(0.105, 0.042, 0.018),
    roughness=0.22,
)  # fmt: skip
"""Melted milk chocolate: cocoa butter (index 1.457) full of cocoa and sugar, opaque within a millimetre."""

SOURCE = Material("source", 1.333, scattering=400.0, albedo=(0.8, 0.8, 0.8), roughness=0.12, carried=1.0)
"""The colours of the clip as paint in the body, seen within a few millimetres, under a surface like water's."""

PRESETS: dict[str, Material] = {m.name: m for m in (WATER, MUDDY_WATER, HONEY, LAVA, MILK, OIL, CHOCOLATE, SOURCE)}


def material_named(name: str) -> Material:
    """One of `PRESETS`.

    Raises:
        InputRejected: there is none of that name; the nearest is told.
    """
    key = str(name).strip().lower().replace(" ", "_").replace("-", "_")
    if key in PRESETS:
        return PRESETS[key]
    near = difflib.get_close_matches(key, PRESETS, 1, 0.5)
    raise InputRejected(f"no material '{name}'", ", ".join(PRESETS), f"did you mean {near[0]}?" if near else "")
