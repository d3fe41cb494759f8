"""The pressure projection on a device: twins of `physics.pressure` on Warp arrays, solids at rest."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from fluidlift.backends.warp_poisson import WarpPoisson
from fluidlift.errors import require
from fluidlift.types import SolveReport, triple

if TYPE_CHECKING:
    import warp

    Faces = tuple[warp.array, warp.array, warp.array]
    """[nx+1,ny,nz], [nx,ny+1,nz], [nx,ny,nz+1]"""


class WarpPressure:
    """The pressure of one grid; all memory is taken in the constructor. Its arrays are those of the last `build`.

    Args:
        shape: cells along x, y, z.
        spacing: cell width, m.
        device: where the arrays lie.
        graphs, loops: see `WarpPoisson`.
    """

    def __init__(
        self, shape: tuple[int, int, int], spacing: float, device: warp.Device, *, graphs: bool | None = None,
        loops: bool = False,
    ) -> None:  # fmt: skip
        import warp as wp

        self.shape, self.spacing, self.device = shape, spacing, device
        self.solver = WarpPoisson(shape, spacing, device, graphs=graphs, loops=loops)
        self._face_shapes = [tuple(n + (a == axis) for a, n in enumerate(shape)) for axis in range(3)]
        self.unknown: warp.array = wp.zeros(shape, dtype=wp.uint8, device=device)
        """[nx,ny,nz], 1 where the pressure is solved"""
        self.weights: Faces = triple(wp.zeros(s, dtype=wp.float32, device=device) for s in self._face_shapes)
        """float32, opening / gap on faces of unknown cells"""
        self.openings: Faces = triple(wp.zeros(s, dtype=wp.float32, device=device) for s in self._face_shapes)
        """float32, 0 (wall) to 1 (open), prescribed faces included"""
        self.rhs: warp.array = wp.zeros(shape, dtype=wp.float32, device=device)
        self._none = wp.zeros((0, 0, 0), dtype=wp.float32, device=device)
        self._no_marks = wp.zeros((0, 0, 0), dtype=wp.uint8, device=device)
        self._count = wp.zeros(1, dtype=wp.int32, device=device)

    def build(
        self, types: warp.array, openings: Faces | None = None, gaps: Faces | None = None, *,
        open_border: bool = False, held: Faces | None = None,
    ) -> None:  # fmt: skip
        """`pressure.build_system`: `unknown`, `weights` and `openings` of a cell layout.

        Args:
            types: uint8 [nx,ny,nz], `CellType`.
            openings: float32 per face, open shares of the faces; None: by cell type alone.
            gaps: float32 per face, cells from the liquid cell's centre to the surface, in (0, 1]; None: 1.
            open_border: False: the sides of the box are walls; True: p = 0 outside the box.
            held: uint8 per face, not 0 where the velocity is prescribed besides the faces of inflow (an outlet).

        Raises:
            ValueError: an array of another shape.
        """
        from fluidlift.backends import warp_faces
        from fluidlift.backends import warp_pressure_kernels as kernels

        require(types.shape == self.shape, f"cell types {types.shape}", str(self.shape))
        marks = warp_faces.Marks()
        marks.x, marks.y, marks.z = self._checked(held) if held is not None else (self._no_marks,) * 3
        given = [self._faces(openings), self._faces(gaps), marks, int(open_border)]
        out = [self.unknown, self._faces(self.weights), self._faces(self.openings)]
        self._launch(kernels.build, [types, *given, *out], more=1)

    def right_side(self, velocity: Faces, known: warp.array | None = None) -> None:
        """`rhs` = -div(w v) + what known cells add.

        Args:
            velocity: float32 per face, m/s.
            known: q in the cells that are not unknown, float32 [nx,ny,nz], m^2/s; None: 0.
        """
        from fluidlift.backends import warp_pressure_kernels as kernels

        faces = [self._faces(f) for f in (velocity, self.openings, self.weights)]
        cells = [self.unknown, self._none if known is None else known]
        self._launch(kernels.right_side, [*faces, *cells, float(self.spacing), self.rhs])

    def subtract_gradient(
        self, velocity: Faces, q: warp.array, known: warp.array | None = None, out: Faces | None = None
    ) -> None:
        """v - grad q on the open faces of unknown cells, 0 on closed faces; in place where `out` is not given."""
        from fluidlift.backends import warp_pressure_kernels as kernels

        faces = [self._faces(f) for f in (velocity, self.openings, self.weights)]
        cells = [self.unknown, self._none if known is None else known, q]
        result = self._faces(velocity if out is None else out)
        self._launch(kernels.subtract_gradient, [*faces, *cells, float(self.spacing), result], more=1)

    def solve(
        self, velocity: Faces, *, tolerance: float = 1e-5, initial: warp.array | None = None,
        known: warp.array | None = None, max_iterations: int = 200,
    ) -> tuple[warp.array, SolveReport]:  # fmt: skip
        """q = pressure / density * dt (float32 [nx,ny,nz], m^2/s; the solver's memory), which makes v divergence-free.

        Arguments as in `pressure.project`; the velocity is not changed (see `subtract_gradient`).
        """
        self.right_side(velocity, known)
        return self.solver.solve(
            self.unknown, self.weights, self.rhs, initial, tolerance=tolerance, max_iterations=max_iterations
        )

    def release(self, walls: warp.array, q: warp.array, limit: float) -> int:
        """Cells at walls (uint8 [nx,ny,nz], not 0) whose q is below the limit become air; how many. Waits for them."""
        from fluidlift.backends import warp_pressure_kernels as kernels

        self._count.zero_()
        self._launch(kernels.release, [walls, q, limit, self.unknown, self._count])
        return int(self._count.numpy()[0])

    def _checked(self, faces: Faces) -> Faces:
        for array, shape in zip(faces, self._face_shapes):
            require(array.shape == shape, f"numbers on faces {array.shape}", str(shape))
        return faces

    def _faces(self, faces: Faces | None) -> Any:
        from fluidlift.backends import warp_faces

        out = warp_faces.Faces()
        out.x, out.y, out.z = (self._none,) * 3 if faces is None else self._checked(faces)
        return out

    def _launch(self, kernel: Any, inputs: list[Any], more: int = 0) -> None:
        """One thread per cell of a grid that has `more` cells along each axis."""
        import warp as wp

        wp.launch(kernel, tuple(n + more for n in self.shape), inputs, device=self.device)
