"""Semi-Lagrangian advection of face velocities, differentiable (Stam 1999; paper, "Grid-Based Velocity Evolution").

A face at x takes the value that the flow carried there: q_new(x) = q(x - dt v(x)), trilinear in q, one Euler
back-trace, back-traced points clamped to the box. Two gradients are offered:

* "exact": the derivative of what is computed, weights and back-trace included. The fast path is a Numba kernel with a
  hand-written adjoint; `advect_plain` is its readable twin in torch operations.
* "upwind": the paper's surrogate. Forward is the same back-trace; backward differentiates one explicit first-order
  upwind step q - dt (v . grad) q instead. It is not the derivative of the forward pass.

Index units: velocities are multiplied by k = dt / h, so that displacements are in cells.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from fluidlift.errors import require

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


@numba.njit(cache=True)
def _advect_kernel(q, b, c, n, sq, sb, sc, k, active, out):
    """Faces across the first of the axes (a, b, c); arrays are flat, `s*` their strides along a, b, c; n cells."""
    na, nb, nc = n[0], n[1], n[2]
    for i in range(na + 1):
        i0, i1 = max(i - 1, 0), min(i, na - 1)
        for j in range(nb):
            for m in range(nc):
                f = i * sq[0] + j * sq[1] + m * sq[2]
                if not active[f]:
                    out[f] = q[f]
                    continue
                low, high = i0 * sb[0] + j * sb[1] + m * sb[2], i1 * sb[0] + j * sb[1] + m * sb[2]
                vb = 0.25 * (b[low] + b[high] + b[low + sb[1]] + b[high + sb[1]])
                low, high = i0 * sc[0] + j * sc[1] + m * sc[2], i1 * sc[0] + j * sc[1] + m * sc[2]
                vc = 0.25 * (c[low] + c[high] + c[low + sc[2]] + c[high + sc[2]])
                x = min(max(i - k * q[f], 0.0), np.float64(na))
                y = min(max(j - k * vb, 0.0), np.float64(nb - 1))
                z = min(max(m - k * vc, 0.0), np.float64(nc - 1))
                x0, y0, z0 = min(int(x), na - 1), min(int(y), max(nb - 2, 0)), min(int(z), max(nc - 2, 0))
                fx, fy, fz = x - x0, y - y0, z - z0
                dy, dz = min(nb - 1 - y0, 1) * sq[1], min(nc - 1 - z0, 1) * sq[2]
                o = x0 * sq[0] + y0 * sq[1] + z0 * sq[2]
                p = o + sq[0]
                near = (q[o] * (1 - fy) + q[o + dy] * fy) * (1 - fz) + (q[o + dz] * (1 - fy) + q[o + dy + dz] * fy) * fz
                far = (q[p] * (1 - fy) + q[p + dy] * fy) * (1 - fz) + (q[p + dz] * (1 - fy) + q[p + dy + dz] * fy) * fz
                out[f] = near * (1 - fx) + far * fx


@numba.njit(cache=True)
def _advect_adjoint_kernel(q, b, c, n, sq, sb, sc, k, active, g, gq, gb, gc):
    """Adds the adjoint of `_advect_kernel` to gq, gb, gc; returns the derivative with respect to k. Serial scatter."""
    na, nb, nc = n[0], n[1], n[2]
    gk = 0.0
    for i in range(na + 1):
        i0, i1 = max(i - 1, 0), min(i, na - 1)
        for j in range(nb):
            for m in range(nc):
                f = i * sq[0] + j * sq[1] + m * sq[2]
                s = np.float64(g[f])
                if s == 0.0:
                    continue
                if not active[f]:
                    gq[f] += s
                    continue
                bl, bh = i0 * sb[0] + j * sb[1] + m * sb[2], i1 * sb[0] + j * sb[1] + m * sb[2]
                vb = 0.25 * (b[bl] + b[bh] + b[bl + sb[1]] + b[bh + sb[1]])
                cl, ch = i0 * sc[0] + j * sc[1] + m * sc[2], i1 * sc[0] + j * sc[1] + m * sc[2]
                vc = 0.25 * (c[cl] + c[ch] + c[cl + sc[2]] + c[ch + sc[2]])
                rx, ry, rz = i - k * q[f], j - k * vb, m - k * vc
                x = min(max(rx, 0.0), np.float64(na))
                y = min(max(ry, 0.0), np.float64(nb - 1))
                z = min(max(rz, 0.0), np.float64(nc - 1))
                x0, y0, z0 = min(int(x), na - 1), min(int(y), max(nb - 2, 0)), min(int(z), max(nc - 2, 0))
                fx, fy, fz = x - x0, y - y0, z - z0
                dx, dy, dz = sq[0], min(nb - 1 - y0, 1) * sq[1], min(nc - 1 - z0, 1) * sq[2]
                o = x0 * sq[0] + y0 * sq[1] + z0 * sq[2]
                ex, ey, ez = 1 - fx, 1 - fy, 1 - fz
                q000, q100, q010, q110 = q[o], q[o + dx], q[o + dy], q[o + dx + dy]
                q001, q101, q011, q111 = q[o + dz], q[o + dx + dz], q[o + dy + dz], q[o + dx + dy + dz]
                gq[o] += s * ex * ey * ez
                gq[o + dx] += s * fx * ey * ez
                gq[o + dy] += s * ex * fy * ez
                gq[o + dx + dy] += s * fx * fy * ez
                gq[o + dz] += s * ex * ey * fz
                gq[o + dx + dz] += s * fx * ey * fz
                gq[o + dy + dz] += s * ex * fy * fz
                gq[o + dx + dy + dz] += s * fx * fy * fz
                tx = ((q100 - q000) * ey + (q110 - q010) * fy) * ez + ((q101 - q001) * ey + (q111 - q011) * fy) * fz
                ty = ((q010 - q000) * ex + (q110 - q100) * fx) * ez + ((q011 - q001) * ex + (q111 - q101) * fx) * fz
                tz = ((q001 - q000) * ex + (q101 - q100) * fx) * ey + ((q011 - q010) * ex + (q111 - q110) * fx) * fy
                # a clamped coordinate does not move with the velocity
                tx = s * tx if rx == x else 0.0
                ty = s * ty if ry == y else 0.0
                tz = s * tz if rz == z else 0.0
                gk -= tx * q[f] + ty * vb + tz * vc
                gq[f] -= k * tx
                r = -0.25 * k * ty
                gb[bl] += r
                gb[bh] += r
                gb[bl + sb[1]] += r
                gb[bh + sb[1]] += r
                r = -0.25 * k * tz
                gc[cl] += r
                gc[ch] += r
                gc[cl + sc[2]] += r
                gc[ch + sc[2]] += r
    return gk


def _views(arrays: list[np.ndarray], axis: int) -> tuple[list[int], np.ndarray, list[np.ndarray]]:
    """Order of axes starting at `axis`, cells along them, and element strides of the three arrays along them."""
    order = [axis, (axis + 1) % 3, (axis + 2) % 3]
    cells = np.array([arrays[a].shape[a] - 1 for a in order], dtype=np.int64)
    strides = [np.array([arrays[o].strides[a] // arrays[o].itemsize for a in order], dtype=np.int64) for o in order]
    return order, cells, strides


class _AdvectExact(torch.autograd.Function):
    """Back-trace by Numba kernels, derivative of exactly that."""

    @staticmethod
    def forward(ctx: Any, u: Tensor, v: Tensor, w: Tensor, k: Tensor, active: tuple[np.ndarray, ...]) -> Any:
        tensors = [t.detach().contiguous() for t in (u, v, w)]
        ctx.save_for_backward(*tensors, k)
        ctx.active = active
        arrays = [t.numpy() for t in tensors]
        out = [np.empty_like(a) for a in arrays]
        for axis in range(3):
            order, cells, strides = _views(arrays, axis)
            flat = [arrays[o].ravel() for o in order]
            _advect_kernel(*flat, cells, *strides, float(k), active[axis], out[axis].ravel())
        return tuple(torch.from_numpy(o) for o in out)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        *tensors, k = ctx.saved_tensors
        arrays = [t.numpy() for t in tensors]
        # accumulated in float64: many small contributions meet on one face
        total = [np.zeros(a.shape) for a in arrays]
        gk = 0.0
        for axis in range(3):
            order, cells, strides = _views(arrays, axis)
            flat = [arrays[o].ravel() for o in order]
            sums = [total[o].ravel() for o in order]
            g = gradients[axis].contiguous().numpy().ravel()
            gk += _advect_adjoint_kernel(*flat, cells, *strides, float(k), ctx.active[axis], g, *sums)
        grads = [torch.from_numpy(t).to(s.dtype) for t, s in zip(total, tensors)]
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
