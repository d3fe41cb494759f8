"""Viscosity in a liquid's substep on a Warp device.

Twins: `Surroundings.viscous`, `LiquidGrid._pressed`, `._dragged`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from fluidlift.backends.warp_inflow import WarpInlet
from fluidlift.backends.warp_region import WarpRegion
from fluidlift.backends.warp_viscosity import WarpViscosity
from fluidlift.types import FluidParameters, SolveReport

if TYPE_CHECKING:
    from fluidlift.backends.warp_projection import WarpProjection


class WarpDrag:
    """The viscosity of a region; all memory is taken in the constructor.

    Args:
        region: walls and fields.
        parameters: of the fluid.
        tolerance: of the solve.
    """

    def __init__(self, region: WarpRegion, parameters: FluidParameters, tolerance: float) -> None:
        self._region, self._parameters, self._tolerance = region, parameters, tolerance
        self._solver = WarpViscosity(region.grid.shape, region.grid.spacing, region.device)
        self._pressed, self._viscous = region.new_faces(), region.new_faces()
        self._prescribed, self._solved, self._fixed, self._walls = (region.new_marks() for _ in range(4))

    def apply(
        self, projection: WarpProjection, inlet: WarpInlet, dt: float, *, eager: bool, outlet: bool
    ) -> tuple[SolveReport, ...]:
        """`region.velocity` after dt (s) of viscosity; none is reported where it is negligible.

        Args:
            projection: has built its system.
            inlet: whose faces keep their velocity.
            dt: s.
            eager: the pressure of the step before, `region.rate`, is at work already.
            outlet: `region.known` counts.
        """
        import warp as wp

        from fluidlift.backends import warp_velocity_kernels as kernels

        r, p = self._region, self._parameters
        pressed = r.velocity
        if eager:
            pressed = self._pressed
            projection.press(dt, pressed, outlet=outlet)
        inlet.mark(r, self._prescribed)
        inputs = [r.shape, r.wet, r.holding, r.openings, r.normals, self._prescribed]
        r.launch(kernels.face_roles, inputs, [self._solved, self._fixed, self._walls], faces=True)
        r.launch(kernels.stop_at_walls, [r.shape, r.openings, pressed, self._viscous], faces=True)
        roles = tuple(_three(marks) for marks in (self._solved, self._fixed, self._walls))
        report = self._solver.diffuse(
            _three(self._viscous), (roles[0], roles[1], roles[2]), r.distance, r.nodes,
            viscosity=p.kinematic_viscosity, dt=dt, wall_share=p.wall_damping, tolerance=self._tolerance,
        )  # fmt: skip
        if report is None:
            return ()
        gain = wp.vec3(*(float(g * dt) for g in p.gravity))
        inputs = [r.shape, r.openings, r.nodes, pressed, self._viscous, gain, int(p.wall_damping != 0), r.velocity]
        r.launch(kernels.add_drag, inputs, faces=True)
        return (report,)


def _three(faces: Any) -> tuple[Any, Any, Any]:
    return faces.x, faces.y, faces.z
