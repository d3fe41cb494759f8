"""The layout of a rollout as tensors on any device, and its linear operators as whole-array slices.

`RolloutDomain` holds sparse matrices over one flat vector. Here the three components lie in one box
[3, nx+1, ny+1, nz+1], zero where a component has no face, so that every operator is a few slices over all of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from fluidlift.numerics.torch_poisson import DeviceSystem
from fluidlift.physics.rollout_domain import RolloutDomain


def flat_to_box(
    flat: Float[Tensor, " f"] | Bool[Tensor, " f"], layout: RolloutDomain
) -> Float[Tensor, "3 X Y Z"] | Bool[Tensor, "3 X Y Z"]:
    """The flat face vector as three padded arrays."""
    o = layout.offsets
    parts = []
    for axis, shape in enumerate(layout.face_shapes):
        missing = [int(d != axis) for d in range(3)]
        pad = (0, missing[2], 0, missing[1], 0, missing[0])
        parts.append(functional.pad(flat[o[axis] : o[axis + 1]].reshape(shape), pad))
    return torch.stack(parts)


def box_to_flat(box: Float[Tensor, "3 X Y Z"], layout: RolloutDomain) -> Float[Tensor, " f"]:
    """The reverse."""
    parts = [box[a, : s[0], : s[1], : s[2]].reshape(-1) for a, s in enumerate(layout.face_shapes)]
    return torch.cat(parts)


@dataclass(frozen=True)
class BackTrace:
    """Where the faces that advection moves lie. Axes are those of a face: across it first, the next two in turn."""

    faces: Int[Tensor, " m"]
    """place in the flattened box"""
    around: Int[Tensor, "2 4 m"]
    """places of the four nearest faces of each of the other two components"""
    position: Float[Tensor, "3 m"]
    """index along each axis"""
    limit: Float[Tensor, "3 m"]
    """largest index along each axis"""
    stride: Int[Tensor, "3 m"]
    """distance of neighbours in the flattened box"""
    first: Int[Tensor, " m"]
    """where the face's component begins in the flattened box"""


@dataclass(frozen=True)
class TorchDomain:
    """A `RolloutDomain` on one device; arrays are boxes [3, nx+1, ny+1, nz+1] (see there for what they mean)."""

    layout: RolloutDomain
    """on the host"""
    system: DeviceSystem
    dynamic: Float[Tensor, "3 X Y Z"]
    """1 or 0"""
    inflow: Float[Tensor, "3 X Y Z"]
    outflow: Float[Tensor, "3 X Y Z"]
    outflow_faces: Float[Tensor, "3 X Y Z"]
    outlet_head: Float[Tensor, "3 3 X Y Z"]
    """times gravity (first index)"""
    interior: Float[Tensor, "3 X Y Z"]
    force: Float[Tensor, "3 X Y Z"]
    wall_share: Float[Tensor, "3 X Y Z"]
    wall_count: Float[Tensor, "3 X Y Z"]
    wall_below: Float[Tensor, "3 X Y Z"]
    wall_above: Float[Tensor, "3 X Y Z"]
    known: Float[Tensor, "3 X Y Z"]
    """1 on faces that extrapolation starts from"""
    fills: tuple[Float[Tensor, "3 X Y Z"], ...]
    """per sweep of the extrapolation: 1 / number of known neighbours on the faces that it fills, else 0"""
    neighbours: Float[Tensor, "3 X Y Z"]
    """what the viscous Laplacian takes from a dynamic face itself, 1/m^2"""
    area: Float[Tensor, "3 X Y Z"]
    """open share over h, 1/m: weight of a face in the divergence"""
    slope: Float[Tensor, "3 X Y Z"]
    """1 over the distance of pressures across a dynamic face, 1/m"""
    trace: BackTrace

    @property
    def spacing(self) -> float:
        """Cell width, m."""
        return self.system.spacing

    @property
    def dtype(self) -> torch.dtype:
        """Number type of the velocity."""
        return self.inflow.dtype

    @property
    def device(self) -> torch.device:
        """Where the tensors are."""
        return self.inflow.device

    @classmethod
    def of(cls, domain: RolloutDomain, device: torch.device | str) -> TorchDomain:
        """Everything about a layout that a rollout on `device` needs.

        Raises:
            ValueError: a device that is not there, or that has no double precision.
        """
        device, h = torch.device(device), float(domain.system.spacing)
        known = domain.dynamic | domain.wall | (domain.inflow > 0)
        on_faces = {name: getattr(domain, name) for name in _MASKS} | {
            "known": known.astype(domain.inflow.dtype),
            "area": domain.opening / h,
            "slope": domain.reach / h,
            "wall": domain.wall,
            "exists": np.ones_like(domain.inflow),
        }
        boxes = {k: flat_to_box(torch.from_numpy(np.ascontiguousarray(v)), domain) for k, v in on_faces.items()}
        dynamic = boxes["dynamic"]
        boxes["outlet_head"] = torch.stack([flat_to_box(torch.from_numpy(h), domain) for h in domain.outlet_head])
        boxes["dynamic"] = dynamic.to(boxes["inflow"].dtype)
        neighbours = _viscous_neighbours(dynamic, boxes["inflow"], boxes.pop("wall")) / h**2
        return cls(
            layout=domain,
            system=DeviceSystem.of(domain.system, device),
            neighbours=neighbours.to(device),
            fills=tuple(f.to(device) for f in _fills(boxes["known"], domain.sweeps, boxes.pop("exists"))),
            trace=_back_trace(dynamic.numpy(), domain, device),
            **{k: v.to(device) for k, v in boxes.items()},
        )


_MASKS = (
    "dynamic", "inflow", "outflow", "outflow_faces", "interior", "force", "wall_share", "wall_count", "wall_below",
    "wall_above",
)  # fmt: skip


def _viscous_neighbours(dynamic: Tensor, inflow: Tensor, wall: Tensor) -> Tensor:
    """How many neighbours of a dynamic face pull on it: dynamic and inflow faces, and walls ahead and behind."""
    free = dynamic | (inflow > 0)
    count = neighbour_sum(free.to(inflow.dtype))
    for axis in range(3):
        across = (wall[axis] & ~free[axis]).to(inflow.dtype)
        n = across.shape[axis] - 1
        count[axis].narrow(axis, 0, n).add_(across.narrow(axis, 1, n))
        count[axis].narrow(axis, 1, n).add_(across.narrow(axis, 0, n))
    return count * dynamic


def _fills(known: Tensor, sweeps: int, faces: Tensor) -> list[Tensor]:
    """The sweeps of `rollout_matrices.extrapolation_matrix`."""
    fills = []
    for _ in range(sweeps):
        count = neighbour_sum(known) * faces
        fill = torch.where((known == 0) & (count > 0), 1 / count.clamp(min=1), 0)
        if not bool(fill.any()):
            break
        known = torch.where(fill > 0, 1, known)
        fills.append(fill)
    return fills


def _back_trace(dynamic: np.ndarray, domain: RolloutDomain, device: torch.device) -> BackTrace:
    box = dynamic.shape
    stride = np.array([box[2] * box[3], box[3], 1])
    size = int(np.prod(box[1:]))
    found: dict[str, list[np.ndarray]] = {n: [] for n in ("around", "position", "limit", "stride", "first")}
    for axis in range(3):
        index = np.argwhere(dynamic[axis]).T
        order = [axis, (axis + 1) % 3, (axis + 2) % 3]
        around = []
        for other in order[1:]:
            # cells on both sides of the face (one twice at the ends of the box), and both of their faces
            cells = []
            for side in (-1, 0):
                cell = index.copy()
                cell[axis] = np.clip(cell[axis] + side, 0, domain.shape[axis] - 1)
                cells.append(other * size + stride @ cell)
            around.append([c + stride[other] * ahead for c in cells for ahead in (0, 1)])
        found["around"].append(np.array(around))
        found["position"].append(index[order])
        found["limit"].append(np.repeat([[domain.face_shapes[axis][d] - 1] for d in order], index.shape[1], axis=1))
        found["stride"].append(np.repeat(stride[order][:, None], index.shape[1], axis=1))
        found["first"].append(np.full(index.shape[1], axis * size))
    joined = {n: np.concatenate(parts, axis=-1) for n, parts in found.items()}
    real = domain.inflow.dtype
    kinds = {"around": np.int32, "position": real, "limit": real, "stride": np.int32, "first": np.int32}
    tensors = {n: torch.from_numpy(v.astype(kinds[n])).to(device) for n, v in joined.items()}
    return BackTrace(torch.from_numpy(np.flatnonzero(dynamic)).to(device), **tensors)


def neighbour_sum(x: Float[Tensor, "3 X Y Z"]) -> Float[Tensor, "3 X Y Z"]:
    """Sum of the six neighbours of the same component; 0 beyond the box. Its own transpose."""
    return _NeighbourSum.apply(x)


class _NeighbourSum(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        out = torch.zeros_like(x)
        for axis in (1, 2, 3):
            n = x.shape[axis] - 1
            out.narrow(axis, 0, n).add_(x.narrow(axis, 1, n))
            out.narrow(axis, 1, n).add_(x.narrow(axis, 0, n))
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        return neighbour_sum(gradients[0])


def flux_balance(flux: Float[Tensor, "3 X Y Z"]) -> Float[Tensor, "nx ny nz"]:
    """What leaves each cell through its six faces."""
    return _FluxBalance.apply(flux)


class _FluxBalance(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, flux: Tensor) -> Tensor:
        nx, ny, nz = (n - 1 for n in flux.shape[1:])
        u, v, w = flux.unbind(0)
        out = u[1:, :ny, :nz] - u[:nx, :ny, :nz]
        out += v[:nx, 1:, :nz]
        out -= v[:nx, :ny, :nz]
        out += w[:nx, :ny, 1:]
        return out.sub_(w[:nx, :ny, :nz])

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        return -differences(gradients[0])


def differences(q: Float[Tensor, "nx ny nz"]) -> Float[Tensor, "3 X Y Z"]:
    """Cell ahead minus cell behind every face; 0 beyond the box. Minus the transpose of `flux_balance`."""
    return _Differences.apply(q)


class _Differences(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, q: Tensor) -> Tensor:
        nx, ny, nz = q.shape
        out = torch.zeros((3, nx + 1, ny + 1, nz + 1), dtype=q.dtype, device=q.device)
        u, v, w = out.unbind(0)
        u[:nx, :ny, :nz] += q
        u[1:, :ny, :nz] -= q
        v[:nx, :ny, :nz] += q
        v[:nx, 1:, :nz] -= q
        w[:nx, :ny, :nz] += q
        w[:nx, :ny, 1:] -= q
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        return -flux_balance(gradients[0])
