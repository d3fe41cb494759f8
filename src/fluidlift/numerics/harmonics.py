"""Real spherical harmonics up to degree 3, in the order and sign of 3D Gaussian Splatting (Kerbl et al. 2023).

Their definition stands with the Gaussians (`types.harmonics`), which turn their own; computations find it here.
"""

from __future__ import annotations

from fluidlift.types.harmonics import basis, harmonics_rotation

__all__ = ["basis", "harmonics_rotation"]
