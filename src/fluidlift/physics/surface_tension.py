"""Surface tension (Young-Laplace, ghost fluid): the pressure jumps by sigma times the sum of the principal curvatures.

The jump enters the pressure solve at the place of the surface (Kang, Fedkiw, Liu 2000, "A boundary condition capturing
method for multiphase incompressible flow"), so that a round drop at rest has no forces left to move it. It is explicit
in time: steps beyond `capillary_time_step` are unstable.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8

from fluidlift.errors import require, required
from fluidlift.physics.free_surface import Faces, LiquidSurface
from fluidlift.types import CellType


def capillary_time_step(density: float, surface_tension: float, spacing: float) -> float:
    """Longest step (s) in which the shortest capillary wave of the grid crosses less than a cell; inf without tension.

    sqrt(rho h^3 / (4 pi sigma)), after Brackbill, Kothe, Zemach 1992, "A continuum method for modeling surface
    tension", without the density of the air.

    Args:
        density: kg/m^3.
        surface_tension: N/m.
        spacing: cell width, m.

    Raises:
        ValueError: a negative surface tension, or a density or spacing that is not positive.
    """
    require(surface_tension >= 0, f"surface tension {surface_tension}", "0 or more N/m")
    require(density > 0 and spacing > 0, f"density {density}, spacing {spacing}", "positive numbers")
    if surface_tension == 0:
        return float("inf")
    return float(np.sqrt(density * spacing**3 / (4.0 * np.pi * surface_tension)))


def surface_tension_jumps(surface: LiquidSurface, types: UInt8[np.ndarray, "nx ny nz"], strength: float) -> Faces:
    """By how much q exceeds the air's at the surface, on faces between FLUID and EMPTY cells (m^2/s); 0 elsewhere.

    Drops and films too thin for a surface of their own (about 1.2 cells) feel none.

    Args:
        surface: from `free_surface.liquid_surface`.
        types: from `free_surface.pressure_cells`.
        strength: surface tension * dt / density, m^3/s.
    """
    curvature = required(surface.curvature, "a surface without curvature", "`liquid_surface` with curvature")
    liquid = (types == CellType.FLUID) & (surface.distance < 0)
    air = (types == CellType.EMPTY) & (surface.distance > 0)
    out = []
    for axis in range(3):
        jump = np.zeros(tuple(n + (a == axis) for a, n in enumerate(types.shape)), np.float32)
        inner = np.moveaxis(jump, axis, 0)[1:-1]
        arrays = (surface.distance, curvature, liquid, air)
        d, bend, wet, dry = (np.moveaxis(f, axis, 0) for f in arrays)
        for one, other in ((slice(None, -1), slice(1, None)), (slice(1, None), slice(None, -1))):
            here = wet[one] & dry[other]
            part = d[one][here] / (d[one][here] - d[other][here])
            inner[here] = strength * ((1.0 - part) * bend[one][here] + part * bend[other][here])
        out.append(jump)
    return tuple(out)
