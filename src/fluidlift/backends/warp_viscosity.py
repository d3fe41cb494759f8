"""Implicit viscosity on a device: the coupled stress of `physics.viscosity` by conjugate gradients, in Warp.

One liquid of one viscosity among solids at rest. The diagonal preconditions: on a device a V-cycle costs more launches
than the iterations that it saves. Velocities and residual are kept in double precision, directions in single.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from fluidlift.backends.warp_launches import Launches
from fluidlift.errors import require
from fluidlift.physics.viscosity import NEGLIGIBLE
from fluidlift.types import SolveReport

if TYPE_CHECKING:
    import warp

    Faces = tuple[warp.array, warp.array, warp.array]
    """[nx+1,ny,nz], [nx,ny+1,nz], [nx,ny,nz+1]"""

MAX_ITERATIONS = 600
"""of the conjugate gradients: twice what the CPU allows, which has V-cycles where viscosity is strong"""
PAIR = 2
"""iterations that are replayed together: directions alternate between two arrays"""


class WarpViscosity:
    """Viscous steps on one grid; all memory is taken in the constructor.

    Args:
        shape: cells along x, y, z, 2 or more.
        spacing: cell width, m.
        device: where the arrays lie.
        graphs: replay two iterations as a CUDA graph; None: on a GPU.
        loops: the graph also holds the loop of the iteration, see `Launches`.
    """

    def __init__(
        self, shape: tuple[int, int, int], spacing: float, device: warp.Device, *, graphs: bool | None = None,
        loops: bool = False,
    ) -> None:  # fmt: skip
        import warp as wp

        from fluidlift.backends import warp_stress_assembly as assembly
        from fluidlift.backends import warp_stress_kernels as kernels

        require(min(shape) > 1, f"a grid of {shape} cells", "2 or more along each axis")
        self.shape, self.spacing, self.device = shape, spacing, device
        nodes = tuple(n + 1 + 2 * int(kernels.RING) for n in shape)
        count = int(np.prod(nodes))
        require(3 * count < 2**31, f"a grid of {shape} cells", "7e8 cells at most")
        self._count, self._blocks = count, -(-3 * count // int(kernels.CHUNK))
        self._face_shapes = [tuple(n + (a == axis) for a, n in enumerate(shape)) for axis in range(3)]

        def zeros(size: int, dtype: Any = wp.float64) -> warp.array:
            return wp.zeros(size, dtype=dtype, device=device)

        self._stress, self._search, self._parts = kernels.Stress(), kernels.Search(), assembly.NodeArrays()
        for name in ("mass", "inverse", "normal", "shear"):
            setattr(self._stress, name, zeros(3 * count, wp.float32))
        self._stress.nodes = wp.vec3i(*nodes)
        for name in ("x", "r", "q"):
            setattr(self._search, name, zeros(3 * count))
        self._search.z = zeros(3 * count, wp.float32)
        self._search.scalars, self._search.partials = zeros(kernels.SCALARS), zeros(3 * self._blocks)
        self._search.going, self._search.blocks = zeros(1, wp.int32), self._blocks
        self._parts.roles, self._parts.buried = zeros(3 * count, wp.int8), zeros(3 * count, wp.uint8)
        self._parts.clearance, self._parts.momentum = zeros(3 * count, wp.float32), zeros(3 * count)
        self._parts.octants = wp.zeros((count, 8), dtype=wp.float32, device=device)
        self._parts.cells = zeros(count, wp.float32)
        self._directions = wp.zeros((2, 3 * count), dtype=wp.float32, device=device)
        self._rows = (self._directions[0], self._directions[1])
        self._launch = Launches(device, graphs, loops, self._search.scalars)
        self._expected = 0

    def diffuse(
        self, velocity: Faces, roles: tuple[Faces, Faces, Faces], liquid_distance: warp.array,
        solid_distance: warp.array, *, viscosity: float, dt: float, wall_share: float, tolerance: float = 1e-5,
    ) -> SolveReport | None:  # fmt: skip
        """`viscosity.diffuse`, in place; None where viscosity is negligible and nothing was done.

        Args:
            velocity: float32 per face, m/s; on fixed faces what is prescribed there, on walls 0.
            roles: uint8 per face, not 0 where it is solved, fixed, a wall (`viscosity.FaceRoles`; the first counts).
            liquid_distance: float32 [nx,ny,nz], m, from the surface at cell centres, negative inside.
            solid_distance: float32 [nx+1,ny+1,nz+1], m, at nodes, positive outside.
            viscosity: kinematic, m^2/s.
            dt: s.
            wall_share: 0 (free slip) to 1 (no slip).
            tolerance: residual relative to the momentum of the fluid.

        Raises:
            ValueError: arguments of wrong shape or range.
        """
        from fluidlift.backends import warp_stress_kernels as kernels

        require(viscosity >= 0 and bool(np.isfinite(viscosity)), "a viscosity that is negative or not finite")
        require(0.0 <= wall_share <= 1.0, f"wall share {wall_share}", "0 to 1")
        number = viscosity * dt / self.spacing**2
        given = self._given(roles, liquid_distance, solid_distance, wall_share)
        faces = self._faces(velocity)
        if number < NEGLIGIBLE:
            return None
        self._start(given, faces, number, wall_share, tolerance)
        if self._launch.loops:
            self._launch.loop(self._search.going, self._two_iterations, lambda: None)
        else:
            self._iterate()
        self._finish(given, faces, number, wall_share)
        numbers = self._launch.numbers()
        size2, self._expected = numbers[kernels.SIZE2], int(numbers[kernels.ITERATIONS])
        residual = float(np.sqrt(numbers[kernels.R2] / size2)) if size2 != 0 else 0.0
        return SolveReport(residual <= tolerance * 1.01, self._expected, residual, "viscosity")

    def _faces(self, faces: Faces) -> Any:
        from fluidlift.backends import warp_faces

        out = warp_faces.Faces()
        out.x, out.y, out.z = self._checked(faces)
        return out

    def _checked(self, faces: Faces) -> Faces:
        for array, shape in zip(faces, self._face_shapes):
            require(array.shape == shape, f"numbers on faces {array.shape}", str(shape))
        return faces

    def _given(
        self, roles: tuple[Faces, Faces, Faces], liquid: warp.array, solid: warp.array, wall_share: float
    ) -> Any:
        from fluidlift.backends import warp_faces, warp_stress_assembly

        nodes = tuple(n + 1 for n in self.shape)
        require(liquid.shape == self.shape, f"a liquid distance {liquid.shape}", str(self.shape))
        require(solid.shape == nodes, f"a solid distance {solid.shape}", str(nodes))
        given = warp_stress_assembly.Given()
        for name, faces in zip(("solved", "fixed", "walls"), roles):
            marks = warp_faces.Marks()
            marks.x, marks.y, marks.z = self._checked(faces)
            setattr(given, name, marks)
        given.liquid, given.solid, given.spacing, given.wall_share = liquid, solid, self.spacing, wall_share
        return given

    def _start(self, given: Any, velocity: Any, number: float, wall_share: float, tolerance: float) -> None:
        """The operator, the first residual and what follows from it."""
        from fluidlift.backends import warp_stress_assembly as assembly
        from fluidlift.backends import warp_stress_kernels as kernels

        stress, search, parts = self._stress, self._search, self._parts
        self._launch.cells(assembly.assign_roles, self._count, [given, stress, parts, search, self._directions])
        self._launch.cells(assembly.fill_cells, self._count, [given, stress, parts])
        self._launch.cells(assembly.weigh_stresses, self._count, [stress, parts, number, wall_share])
        self._launch.cells(assembly.weigh_faces, self._count, [velocity, stress, parts, search])
        self._launch.blocks(kernels.residual, self._blocks, [stress, search, parts.momentum])
        self._launch.blocks(kernels.begin, 1, [search, tolerance, float(MAX_ITERATIONS)])
        self._launch.blocks(kernels.descend, self._blocks, [stress, search, self._rows[0]])
        self._launch.blocks(kernels.judge, 1, [search, 0])

    def _iterate(self) -> None:
        """Until the device says that it is done: first as often as the last step took, then a little at a time."""
        from fluidlift.backends import warp_stress_kernels as kernels

        pairs = max(1, self._expected // PAIR)
        for _ in range(MAX_ITERATIONS):
            for _ in range(pairs):
                self._launch.run("iterate", self._two_iterations)
            if self._launch.numbers()[kernels.DONE]:
                return
            pairs = 2

    def _two_iterations(self) -> None:
        from fluidlift.backends import warp_stress_kernels as kernels

        for n in range(PAIR):
            old, new = self._rows[1 - n], self._rows[n]
            self._launch.blocks(kernels.turn, self._blocks, [self._stress, self._search, old, new])
            self._launch.blocks(kernels.choose_alpha, 1, [self._search])
            self._launch.blocks(kernels.descend, self._blocks, [self._stress, self._search, new])
            self._launch.blocks(kernels.judge, 1, [self._search, 1])

    def _finish(self, given: Any, velocity: Any, number: float, wall_share: float) -> None:
        """The true residual, and the velocities on all faces."""
        from fluidlift.backends import warp_stress_assembly as assembly
        from fluidlift.backends import warp_stress_kernels as kernels

        stress, search, parts = self._stress, self._search, self._parts
        self._launch.blocks(kernels.residual, self._blocks, [stress, search, parts.momentum])
        self._launch.blocks(kernels.begin, 1, [search, 0.0, 0.0])
        if wall_share > 0:
            self._launch.cells(assembly.continue_behind_walls, self._count, [stress, parts, search, wall_share])
        left = 0.5 / (0.5 + 2.0 * number)
        self._launch.cells(assembly.carry_out, self._count, [given, velocity, stress, parts, search, left])
        self._launch.cells(assembly.store, self._count, [velocity, stress, parts, search])
