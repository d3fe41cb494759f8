"""Semi-Lagrangian advection of face velocities, differentiable (Stam 1999; paper, "Grid-Based Velocity Evolution").

A face at x takes the value that the flow carried there: q_new(x) = q(x - dt v(x)), trilinear in q, one Euler
back-trace, back-traced points clamped to the box. Two gradients are offered:

* "exact": the derivative of what is computed, weights and back-trace included. The fast path is a Numba kernel with a
  hand-written adjoint (`advection_kernels`); `advect_plain` is its readable twin in torch operations.
* "upwind": the paper's surrogate. Forward is the same back-trace; backward differentiates one explicit first-order
  upwind step q - dt (v . grad) q instead. It is not the derivative of the forward pass.

Index units: velocities are multiplied by k = dt / h, so that displacements are in cells.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from fluidlift.errors import require
from fluidlift.physics.advection_kernels import advect_component, advect_component_adjoint
from fluidlift.physics.rollout_kernels import find_runs

Faces = tuple[Tensor, Tensor, Tensor]
"""u [nx+1,ny,nz], v [nx,ny+1,nz], w [nx,ny,nz+1]"""


def sample_trilinear(field: Float[Tensor, "a b c"], points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n"]:
    """Trilinear values of `field` at `points` in its own index units, clamped to the array."""
    low, fraction = [], []
    for axis, n in enumerate(field.shape):
        x = points[..., axis].clamp(0, n - 1)
        i = x.detach().floor().clamp(max=max(n - 2, 0))
        low.append(i.long())
        fraction.append(x - i)
    total: Any = 0.0
    for corner in range(8):
        weight: Any = 1.0
        index = []
        for axis in range(3):
            high = (corner >> axis) & 1
            weight = weight * (fraction[axis] if high else 1 - fraction[axis])
            index.append((low[axis] + high).clamp(max=field.shape[axis] - 1))
        total = total + weight * field[index[0], index[1], index[2]]
    return total


def velocity_at_faces(velocity: Faces, axis: int) -> Float[Tensor, "fx fy fz 3"]:
    """All three components at the faces across `axis`: the other two are means of the four nearest faces."""
    components = []
    n = velocity[axis].shape[axis] - 1
    for other in range(3):
        q = velocity[other]
        if other != axis:
            q = 0.5 * (q.narrow(other, 0, q.shape[other] - 1) + q.narrow(other, 1, q.shape[other] - 1))
            padded = torch.cat([q.narrow(axis, 0, 1), q, q.narrow(axis, n - 1, 1)], dim=axis)
            q = 0.5 * (padded.narrow(axis, 0, n + 1) + padded.narrow(axis, 1, n + 1))
        components.append(q)
    return torch.stack(components, dim=-1)


def advect_plain(velocity: Faces, k: Tensor) -> Faces:
    """The back-trace in torch operations: the readable twin of the kernels."""
    out = []
    for axis, q in enumerate(velocity):
        index = torch.meshgrid(*(torch.arange(n, dtype=q.dtype) for n in q.shape), indexing="ij")
        points = torch.stack(index, dim=-1) - k * velocity_at_faces(velocity, axis)
        out.append(sample_trilinear(q, points))
    return (out[0], out[1], out[2])


def upwind_step(velocity: Faces, k: Tensor) -> Faces:
    """One explicit step q - k (v . d) q with first-order upwind differences: the model behind the surrogate."""
    out = []
    for axis, q in enumerate(velocity):
        carrier = velocity_at_faces(velocity, axis)
        change: Any = 0.0
        for direction in range(3):
            n = q.shape[direction]
            first, last = q.narrow(direction, 0, 1), q.narrow(direction, n - 1, 1)
            backward = q - torch.cat([first, q.narrow(direction, 0, n - 1)], dim=direction)
            forward = torch.cat([q.narrow(direction, 1, n - 1), last], dim=direction) - q
            speed = carrier[..., direction]
            change = change + speed * torch.where(speed.detach() > 0, backward, forward)
        out.append(q - k * change)
    return (out[0], out[1], out[2])


class _AdvectExact(torch.autograd.Function):
    """Back-trace by Numba kernels, derivative of exactly that."""

    @staticmethod
    def forward(ctx: Any, u: Tensor, v: Tensor, w: Tensor, k: Tensor, active: tuple[np.ndarray, ...]) -> Any:
        tensors = [t.detach().contiguous() for t in (u, v, w)]
        ctx.save_for_backward(*tensors, k)
        ctx.shapes = tuple(tuple(t.shape) for t in tensors)
        ctx.active = active
        ctx.runs = [find_runs(m.reshape(s), a == 2)[0] for a, (m, s) in enumerate(zip(active, ctx.shapes))]
        parts = tuple(t.numpy().ravel() for t in tensors)
        out = [p.copy() for p in parts]
        for axis in range(3):
            advect_component(axis, parts, ctx.shapes, parts[0].dtype.type(float(k)), ctx.runs[axis], out[axis])
        return tuple(torch.from_numpy(o.reshape(s)) for o, s in zip(out, ctx.shapes))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        *tensors, k = ctx.saved_tensors
        parts = tuple(t.numpy().ravel() for t in tensors)
        incoming = [g.contiguous().numpy().ravel() for g in gradients]
        totals = tuple(np.where(a, g.dtype.type(0), g) for a, g in zip(ctx.active, incoming))
        real, gk = parts[0].dtype.type, 0.0
        for axis in range(3):
            arguments = (axis, parts, ctx.shapes, real(float(k)), ctx.runs[axis], incoming[axis], totals)
            gk += advect_component_adjoint(*arguments)
        grads = [torch.from_numpy(t.reshape(s)) for t, s in zip(totals, ctx.shapes)]
        return (*grads, torch.as_tensor(gk, dtype=k.dtype).reshape(k.shape), None)


class _AdvectUpwindSurrogate(torch.autograd.Function):
    """Forward: the back-trace. Backward: the derivative of `upwind_step` (a declared surrogate)."""

    @staticmethod
    def forward(ctx: Any, u: Tensor, v: Tensor, w: Tensor, k: Tensor, active: tuple[np.ndarray, ...]) -> Any:
        ctx.save_for_backward(u, v, w, k)
        ctx.active = active
        return _AdvectExact.forward(_NoContext(), u, v, w, k, active)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        inputs = [t.detach().requires_grad_() for t in ctx.saved_tensors]
        with torch.enable_grad():
            moved = upwind_step((inputs[0], inputs[1], inputs[2]), inputs[3])
            masks = [torch.from_numpy(a).reshape(t.shape) for a, t in zip(ctx.active, inputs)]
            out = [torch.where(m, after, before) for m, after, before in zip(masks, moved, inputs)]
            grads = torch.autograd.grad(out, inputs, gradients)
        return (*grads, None)


class _NoContext:
    """Stands in for autograd's context where nothing has to be kept."""

    def save_for_backward(self, *_: Tensor) -> None:
        """Nothing is kept."""


def everywhere(velocity: Faces) -> tuple[np.ndarray, ...]:
    """Masks (bool, flat, one per component) which mark every face as advected."""
    return tuple(np.ones(q.numel(), dtype=np.bool_) for q in velocity)


def advect(
    velocity: Faces,
    time_step: Tensor | float,
    *,
    spacing: float,
    gradient: str = "exact",
    active: tuple[np.ndarray, ...] | None = None,
) -> Faces:
    """Carry the face velocity along itself for `time_step`.

    Args:
        velocity: three tensors on the CPU, m/s, defined (extrapolated) wherever back-traced points may fall.
        time_step: s.
        spacing: cell width, m.
        gradient: "exact", "upwind" (the paper's surrogate) or "plain" (exact, by torch operations; advects everywhere).
        active: bool, flat, one per component: faces to advect; others pass through. Default: all.

    Raises:
        ValueError: an unknown gradient, or tensors that are not on the CPU.
    """
    require(gradient in ("exact", "upwind", "plain"), f"gradient '{gradient}'", "'exact', 'upwind' or 'plain'")
    u, v, w = velocity
    require(u.device.type == "cpu", f"tensors on {u.device}", "tensors on the CPU")
    k = torch.as_tensor(time_step, dtype=u.dtype) / spacing
    if gradient == "plain":
        return advect_plain(velocity, k)
    function = _AdvectExact if gradient == "exact" else _AdvectUpwindSurrogate
    return function.apply(u, v, w, k, everywhere(velocity) if active is None else active)
