"""The part of the box that a substep works on, on a Warp device: walls, and room for all fields of the grid."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from fluidlift.physics.active_region import Box, face_box, inner_grid
from fluidlift.physics.boundaries import Walls, beside_closed_faces
from fluidlift.physics.free_surface import SolidShares
from fluidlift.types import triple

if TYPE_CHECKING:
    import warp


def faces_of(components: tuple[np.ndarray, ...], device: warp.Device) -> Any:
    """`warp_faces.Faces` with copies of host arrays."""
    import warp as wp

    from fluidlift.backends.warp_faces import Faces

    out = Faces()
    for name, values in zip("xyz", components):
        setattr(out, name, wp.array(np.ascontiguousarray(values, np.float32), dtype=wp.float32, device=device))
    return out


def _filled(out: Any, shape: tuple[int, int, int], dtype: Any, device: warp.Device) -> Any:
    """A struct of faces of a grid of cells, all 0."""
    import warp as wp

    for axis, name in enumerate("xyz"):
        faces = tuple(n + (a == axis) for a, n in enumerate(shape))
        setattr(out, name, wp.zeros(faces, dtype=dtype, device=device))
    return out


class WarpBox:
    """What is static about the whole box, uploaded once.

    Args:
        walls: of the whole box.
        capacity: [nx,ny,nz], share of each cell that is open.
        solids: of the whole box.
        device: where.
    """

    def __init__(self, walls: Walls, capacity: np.ndarray, solids: SolidShares, device: warp.Device) -> None:
        import warp as wp

        def bytes_of(cells: np.ndarray) -> warp.array:
            return wp.array(np.ascontiguousarray(cells, np.uint8), dtype=wp.uint8, device=device)

        def floats_of(cells: np.ndarray) -> warp.array:
            return wp.array(np.ascontiguousarray(cells, np.float32), dtype=wp.float32, device=device)

        self.grid, self.device = walls.grid, device
        self.openings = [floats_of(o) for o in walls.openings]
        self.normals = [wp.array(np.ascontiguousarray(n), dtype=wp.vec3, device=device) for n in walls.normals]
        self.cells = {
            "solid": bytes_of(walls.solid), "buried": bytes_of(walls.buried), "regions": bytes_of(walls.regions),
            "wall_cells": bytes_of(beside_closed_faces(walls)), "capacity": floats_of(capacity),
            "layer": bytes_of(solids.layer), "open_share": floats_of(solids.open_share),
            "clear": floats_of(solids.clear),
        }  # fmt: skip
        """by the name that they have in a `WarpRegion`"""
        self.nodes = floats_of(walls.signed_distance)
        self.has_solid = bool(solids.layer.any())


class WarpRegion:
    """The walls of a region, which are views of those of the box, and the fields of a substep there.

    Args:
        whole: the box.
        box: the cells of the region.
    """

    solid: warp.array
    buried: warp.array
    regions: warp.array
    wall_cells: warp.array
    capacity: warp.array
    layer: warp.array
    open_share: warp.array
    clear: warp.array

    def __init__(self, whole: WarpBox, box: Box) -> None:
        import warp as wp

        from fluidlift.backends import warp_surface_kernels as surface_kernels
        from fluidlift.backends.warp_faces import Faces, Normals

        self.box, self.device, self.grid = box, whole.device, inner_grid(whole.grid, box)
        self.first = triple(s.start for s in box)
        self.shape = wp.vec3i(*self.grid.shape)
        self.low, self.spacing = wp.vec3(*self.grid.low), float(self.grid.spacing)
        self.face_range = (3, *(n + 1 for n in self.grid.shape))
        self.openings, self.normals = Faces(), Normals()
        for axis, name in enumerate("xyz"):
            setattr(self.openings, name, whole.openings[axis][face_box(box, axis)])
            setattr(self.normals, name, whole.normals[axis][face_box(box, axis)])
        self.nodes: Any = whole.nodes[tuple(slice(s.start, s.stop + 1) for s in box)]
        for name, values in whole.cells.items():
            setattr(self, name, values[box])
        self.has_solid = whole.has_solid
        self._graphs: dict[str, tuple[Hashable, Any]] = {}
        self._make_room(self.grid.shape)
        self.launch(surface_kernels.three_point, [self.open_share, 0.25], [self.around])

    def _make_room(self, shape: tuple[int, int, int]) -> None:
        import warp as wp

        device, number = self.device, int(np.prod(shape))

        def cells(dtype: Any) -> warp.array:
            return wp.zeros(shape, dtype=dtype, device=device)

        self.share, self.crowd, self.fill, self.around, self.filling, self.mixed = (cells(wp.float32) for _ in range(6))
        self.smooth, self.surface, self.distance, self.known, self.rate = (cells(wp.float32) for _ in range(5))
        self.wanted, self.scratch, self.q, self.guess = (cells(wp.float32) for _ in range(4))
        self.continued_distance, self.normal = cells(wp.float32), cells(wp.vec3)
        self.full, self.holding, self.filled, self.types, self.wet = (cells(wp.uint8) for _ in range(5))
        self.splits, self.merges, self.ranks = (wp.zeros(number, dtype=wp.int32, device=device) for _ in range(3))
        self.carried, self.masses, self.velocity, self.gaps, self.field, self.grown, self.final = (
            self.new_faces() for _ in range(7)
        )
        self.wet_faces, self.marks, self.layers = (self.new_marks() for _ in range(3))

    def new_faces(self) -> Any:
        """`warp_faces.Faces`, all 0."""
        import warp as wp

        from fluidlift.backends.warp_faces import Faces

        return _filled(Faces(), self.grid.shape, wp.float32, self.device)

    def new_marks(self) -> Any:
        """`warp_faces.Marks`, all 0."""
        import warp as wp

        from fluidlift.backends.warp_faces import Marks

        return _filled(Marks(), self.grid.shape, wp.uint8, self.device)

    def take_rate(self, other: WarpRegion) -> None:
        """The `rate` of another region where both lie; 0 elsewhere."""
        import warp as wp

        lows = [max(a.start, b.start) for a, b in zip(self.box, other.box)]
        highs = [min(a.stop, b.stop) for a, b in zip(self.box, other.box)]
        if any(low >= high for low, high in zip(lows, highs)):
            return
        source, target = (  # views
            r.rate[tuple(slice(low - first, high - first) for low, high, first in zip(lows, highs, r.first))]
            for r in (other, self)
        )
        wp.copy(cast(Any, target), cast(Any, source))

    def launch(self, kernel: Any, inputs: list, outputs: list | None = None, *, faces: bool = False) -> None:
        """One thread per cell, or per face."""
        import warp as wp

        wp.launch(kernel, self.face_range if faces else self.grid.shape, inputs, outputs or [], device=self.device)

    def replay(self, name: str, key: Hashable, work: Callable[[], None]) -> None:
        """Do the work, on a GPU from the second time on that it comes with the same key (all that it depends on and
        that may change: numbers, addresses of arrays) as one graph: a launch takes longer than most kernels."""
        import warp as wp

        last, graph = self._graphs.get(name, (None, None))
        if not self.device.is_cuda or last != key:
            self._graphs[name] = (key, None)
            work()
            return
        if graph is None:
            capture: Any
            with wp.ScopedCapture(self.device) as capture:
                work()
            graph = capture.graph
            self._graphs[name] = (key, graph)
        wp.capture_launch(cast(Any, graph))
