"""Pressure and crowds of a liquid's substep on a Warp device (twins: `LiquidGrid._projected`,
`physics.position_correction.spreading`)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from fluidlift.backends.warp_pressure import WarpPressure
from fluidlift.backends.warp_region import WarpRegion
from fluidlift.physics.surroundings import SimulationSettings
from fluidlift.types import SolveReport

if TYPE_CHECKING:
    import warp

SUCTION = 0.1
"""of the weight of a cell of liquid: what wall cells are pulled by at least where the liquid leaves the wall"""
ROUGH, FEW = 0.1, 6
"""relative residual and iterations that do for crowds: what is left, the next step takes"""


class WarpProjection:
    """The pressure of a region. `region.q` holds its result.

    Args:
        region: walls and fields.
        settings: tolerance, and whether liquid may leave walls.
        gravity: m/s^2.
    """

    def __init__(self, region: WarpRegion, settings: SimulationSettings, gravity: tuple[float, float, float]) -> None:
        self._region, self._settings = region, settings
        self._pull = float(np.linalg.norm(gravity))
        self._pressure = WarpPressure(region.grid.shape, region.grid.spacing, region.device)

    def build(self) -> None:
        """The system of `region.types` and `region.gaps`."""
        r = self._region
        self._pressure.build(r.types, _three(r.openings), _three(r.gaps), open_border=True)

    def press(self, dt: float, out: Any, *, outlet: bool) -> None:
        """`out` (`Faces`): `region.velocity` with the pressure of the step before already at work for dt (s)."""
        r = self._region
        self._scaled(r.rate, float(dt), r.guess)
        known = r.known if outlet else None
        self._pressure.subtract_gradient(_three(r.velocity), r.guess, known, _three(out))

    def project(self, dt: float, *, guessed: bool, outlet: bool) -> SolveReport:
        """`region.velocity` loses its divergence, by the system that `build` has made; no wall sucks.

        Args:
            dt: s.
            guessed: begin with `region.rate` times dt.
            outlet: `region.known` counts.
        """
        r, pressure = self._region, self._pressure
        known, first = r.known if outlet else None, None
        if guessed:
            self._scaled(r.rate, float(dt), r.guess)
            first = r.guess
        tolerance = self._settings.pressure_tolerance
        velocity = _three(r.velocity)
        q, report = pressure.solve(velocity, tolerance=tolerance, initial=first, known=known)
        weight = self._pull * r.grid.spacing * dt
        # cells that would hold liquid by suction are solved again as air (see `LiquidGrid._projected`)
        if self._settings.separate_from_walls and weight > 0 and pressure.release(r.wall_cells, q, -SUCTION * weight):
            q, report = pressure.solve(velocity, tolerance=tolerance, initial=q, known=known)
        pressure.subtract_gradient(velocity, q, known)
        self._scaled(q, 1.0, r.q)
        return report

    def keep_rate(self, dt: float) -> None:
        """`region.rate` from `region.q`, for the next step."""
        self._scaled(self._region.q, float(1.0 / dt), self._region.rate)

    def spread(self) -> None:
        """`region.field`: the displacement on faces (m) that evens out the particles, from `region.crowd`."""
        from fluidlift.backends import warp_step_kernels as kernels
        from fluidlift.backends.warp_faces import Faces

        r, pressure = self._region, self._pressure
        # the skin of the liquid counts here, and p = 0 lies outside all cells that hold particles
        pressure.build(r.holding, _three(r.openings), open_border=True)
        weights = Faces()
        weights.x, weights.y, weights.z = pressure.weights
        r.launch(kernels.wanted_spread, [pressure.unknown, weights, r.crowd, r.capacity], [r.wanted])
        psi, _ = pressure.solver.solve(
            pressure.unknown, pressure.weights, r.wanted, tolerance=ROUGH, max_iterations=FEW
        )
        for component in _three(r.field):
            component.zero_()
        pressure.subtract_gradient(_three(r.field), psi)

    def _scaled(self, values: warp.array, factor: float, out: warp.array) -> None:
        from fluidlift.backends import warp_step_kernels as kernels

        self._region.launch(kernels.scale, [values, factor], [out])


def _three(faces: Any) -> tuple[warp.array, warp.array, warp.array]:
    return faces.x, faces.y, faces.z
