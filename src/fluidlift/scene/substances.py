"""What liquids weigh and how they flow, by the names of the looks: density and viscosity from standard tables.

At 20 degrees Celsius unless said. They are round values of materials that vary: honey's viscosity changes tenfold
with two per cent of water. All are simulated as Newtonian liquids; chocolate and lava are not quite that.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Substance:
    """A liquid's mechanics."""

    density: float
    """kg/m^3"""
    dynamic_viscosity: float
    """Pa s"""
    source: str
    """where the two come from"""

    @property
    def kinematic_viscosity(self) -> float:
        """m^2/s, to three digits."""
        return float(f"{self.dynamic_viscosity / self.density:.2e}")


SUBSTANCES = {
    "water": Substance(998.2, 1.002e-3, "CRC Handbook of Chemistry and Physics, from the IAPWS formulations"),
    # grammes of silt a litre make water dark long before they make it heavy or thick
    "muddy_water": Substance(998.2, 1.002e-3, "as water: a gramme of silt a litre changes both by about 1e-3"),
    "honey": Substance(1420.0, 10.0, "order of Yanniotis, Skaltsi and Karaburnioti 2006, J. Food Eng. 72, 17 % water"),
    "lava": Substance(
        2600.0, 100.0, "order of Shaw, Wright, Peck and Okamura 1968, Am. J. Science 266: basalt, 1400 K"
    ),
    "milk": Substance(1030.0, 2.0e-3, "whole milk: Walstra, Wouters and Geurts 2006, Dairy Science and Technology"),
    "oil": Substance(911.0, 84.0e-3, "olive oil: CRC Handbook of Chemistry and Physics"),
    "chocolate": Substance(
        1270.0, 3.0, "milk chocolate at 40 degrees, stirred: order of Beckett, Science of Chocolate"
    ),
}
"""by the names of `look.materials.PRESETS`, without "source": that is the liquid as fitted"""
