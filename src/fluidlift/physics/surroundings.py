"""What a fluid moves in: its box, walls and inlet, the numerical choices, and what viscosity does between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fluidlift.physics.active_region import ActiveRegion
from fluidlift.physics.boundaries import Walls
from fluidlift.physics.inlet import Inlet
from fluidlift.physics.no_bodies import NoBodies
from fluidlift.physics.rigid import RigidBodies
from fluidlift.physics.viscosity import NEGLIGIBLE, FaceRoles, diffuse_with_bodies
from fluidlift.types import FaceVelocity, FluidParameters, Grid, SolveReport


@dataclass(frozen=True)
class SimulationSettings:
    """Numerical choices, independent of the fluid."""

    particles_per_cell: int = 8
    """of the inflow; its cube root is rounded"""
    courant: float = 1.0
    """cells that the fastest particle may cross in a substep"""
    pressure_tolerance: float = 1e-5
    viscosity_tolerance: float = 1e-5
    max_substeps: int = 1000
    """per call of `advance`"""
    max_stretch: float = 4.0
    """of the deformation of a particle"""
    deform: bool = True
    """carry the deformation of the particles along; False: what they look like is not asked for"""
    spread_crowds: bool = True
    """correct clumps of particles"""
    separate_from_walls: bool = True
    """let liquid leave a wall that would have to hold it by suction"""
    reseed: bool = True
    """split and merge particles inside the liquid where cells run empty or crowded"""
    discharge_speed: float | None = None
    """m/s: discharge of the inlet over its section, where that is less than the speed at which it flows in. The liquid
    is then a share of what is seen of it, this over the speed (continuity); None: all of it"""
    airy_above: float | None = None
    """m: z above which what is there at the start is spray, and so is what flows in, and flies as stones do; None:
    nothing is and does"""
    airy: float = 1.0
    """share of spray that is liquid"""
    prescribe_outflow: bool = False
    """True: the outlet's faces move with `outflow_velocity` along the mainstream; False: free outflow"""


@dataclass(frozen=True)
class Surroundings:
    """What stays from step to step of a simulation, and its inlet."""

    grid: Grid
    parameters: FluidParameters
    settings: SimulationSettings
    walls: Walls
    """of the whole box"""
    capacity: np.ndarray
    """[nx,ny,nz], share of each cell that is open"""
    mainstream: np.ndarray
    """unit [3]"""
    inlet: Inlet

    def viscous(
        self,
        velocity: FaceVelocity,
        wet: tuple,
        region: ActiveRegion,
        dt: float,
        prescribed: tuple | None = None,
        distance: np.ndarray | None = None,
        solid: FaceVelocity | None = None,
        bodies: RigidBodies | NoBodies | None = None,
    ) -> tuple[FaceVelocity, tuple[SolveReport, ...]]:
        """Viscosity on the wet faces; inflow and other `prescribed` faces (bool per component) keep their velocity.

        `distance` to the liquid's surface as for `viscosity.diffuse`; closed faces move with `solid`, or rest.
        The liquid drags free `bodies`.
        """
        number = self.parameters.kinematic_viscosity * dt / self.grid.spacing**2
        if number < NEGLIGIBLE:
            return velocity, ()
        walls = region.walls
        fixed = self.inlet.face_masks(tuple(w.shape for w in wet), region.first)
        if prescribed is not None:
            fixed = [f | o for f, o in zip(fixed, prescribed)]
        solved = tuple(w & ~f for w, f in zip(wet, fixed))
        head_on, beside = [], []
        for axis, opening in enumerate(walls.openings):
            closed = opening == 0
            # a wall across the component stops it; a wall along it drags by its share
            across = closed & (np.abs(walls.normals[axis][..., axis]) > 0.7)
            head_on.append(fixed[axis] | across)
            beside.append(closed & ~across)
        resting = FaceVelocity.zeros(walls.grid) if solid is None else solid
        stopped = FaceVelocity(
            *(np.where(o == 0, r, c) for o, r, c in zip(walls.openings, resting.components, velocity.components))
        )
        dragged = bodies.dragged() if bodies is not None else ()
        roles = FaceRoles(solved, tuple(head_on), tuple(beside), distance, walls.signed_distance, solid, dragged)
        new, change, reports = diffuse_with_bodies(
            stopped, roles, viscosity=self.parameters.kinematic_viscosity, dt=dt, spacing=self.grid.spacing,
            wall_share=self.parameters.wall_damping, tolerance=self.settings.viscosity_tolerance,
        )  # fmt: skip
        if bodies is not None and dragged:
            bodies.apply_viscosity(dragged, change)
        return (new if reports else velocity), reports
