"""The terms of a rollout's step as differentiable functions, each by its kernel and a hand-written adjoint.

`rollout.explicit_terms_plain` and the matrices of `RolloutDomain` are the readable twins.
"""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from fluidlift.physics import rollout_diffusion, rollout_kernels
from fluidlift.physics.advection_kernels import advect_component, advect_component_adjoint
from fluidlift.physics.rollout_domain import LinearMap, RolloutDomain
from fluidlift.types import SolveReport

TOO_VISCOUS = "too viscous for one time step: shorten it"


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()


class _Apply(torch.autograd.Function):
    """A linear map; backward is its transpose."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, linear: LinearMap) -> Tensor:
        ctx.linear = linear
        return torch.from_numpy(linear.forward(_array(x)))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        return torch.from_numpy(ctx.linear.adjoint(_array(gradients[0]))), None


def apply_linear(x: Tensor, linear: LinearMap) -> Tensor:
    """The linear map of a vector; differentiable."""
    return _Apply.apply(x, linear)


class _SubtractGradient(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, velocity: Tensor, q: Tensor, domain: RolloutDomain) -> Tensor:
        ctx.domain = domain
        out = _array(velocity).copy()
        scale = out.dtype.type(-1.0 / float(domain.system.spacing))
        cells = _array(q).reshape(domain.shape)
        rollout_kernels.faces_from_cells(cells, domain.reach, domain.system.unknown, scale, out)
        return torch.from_numpy(out)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        to_q = -torch.from_numpy(ctx.domain.gradient.adjoint(_array(gradients[0])))
        return gradients[0], to_q, None


def subtract_gradient(
    velocity: Float[Tensor, " f"], q: Float[Tensor, " c"], domain: RolloutDomain
) -> Float[Tensor, " f"]:
    """velocity - gradient q in one go."""
    return _SubtractGradient.apply(velocity, q, domain)


class ExplicitTerms(torch.autograd.Function):
    """Advection, walls, body force and inflow of an extrapolated velocity; see `rollout.explicit_terms_plain`.

    Kept for backward: the velocity, and what advection brought to the faces beside walls.
    """

    @staticmethod
    def forward(
        ctx: Any,
        velocity: Tensor,
        time_step: Tensor,
        damping: Tensor,
        restitution: Tensor,
        gravity: Tensor,
        inflow: Tensor,
        fluctuation: Tensor,
        pattern: Tensor | None,
        domain: RolloutDomain,
    ) -> Tensor:
        lists, v = domain.lists, _array(velocity)
        dt, h, real = float(time_step), float(domain.system.spacing), v.dtype.type
        shapes, parts = domain.face_shapes, _split(v, domain)
        out = v.copy()
        for axis, (runs, _) in enumerate(lists.runs):
            advect_component(axis, parts, shapes, real(dt / h), runs, _split(out, domain)[axis])
        arrived = np.empty(len(lists.walls), v.dtype)
        wall = (lists.walls, lists.wall_layout, float(damping), float(restitution), dt / h)
        rollout_kernels.walls(out, *wall, arrived)
        for axis, (runs, _) in enumerate(lists.runs):
            change = real(dt * float(gravity[axis]))
            rollout_kernels.push(out, lists.components[axis], runs, domain.force, change)
        given = np.repeat(_array(inflow), np.diff(lists.inflow_ends))
        if pattern is not None:
            given = given + float(fluctuation) * _array(pattern)[lists.inflow]
        out[lists.inflow] = given
        out[lists.closed] = 0
        kept = [velocity, gravity, fluctuation, torch.from_numpy(arrived)]
        ctx.save_for_backward(*kept, *([] if pattern is None else [pattern]))
        ctx.domain, ctx.wall, ctx.time_step = domain, wall, dt
        return torch.from_numpy(out)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        velocity, gravity, fluctuation, arrived, *rest = ctx.saved_tensors
        domain, dt, h = ctx.domain, ctx.time_step, float(ctx.domain.system.spacing)
        lists, g = domain.lists, _array(gradients[0]).copy()
        at_inflow, ends = g[lists.inflow].astype(np.float64), lists.inflow_ends
        to_inflow = [float(at_inflow[ends[a] : ends[a + 1]].sum()) for a in range(3)]
        to_fluctuation, to_pattern = 0.0, None
        if rest:
            to_fluctuation = float((at_inflow * _array(rest[0])[lists.inflow]).sum())
            if ctx.needs_input_grad[7]:
                to_pattern = torch.zeros_like(rest[0])
                to_pattern[torch.from_numpy(lists.inflow).long()] = fluctuation * gradients[0][lists.inflow]
        g[lists.inflow] = 0
        g[lists.closed] = 0
        felt = np.array([
            rollout_kernels.weighted_sum(g, c, runs, domain.force) for c, (runs, _) in zip(lists.components, lists.runs)
        ])  # fmt: skip
        to_dt = float((felt * _array(gravity)).sum())
        faces, layout, damping, bounce, reach = ctx.wall
        wall = (g, faces, layout, damping, bounce, reach, _array(arrived))
        to_damping, to_bounce, to_reach = rollout_kernels.walls_adjoint(*wall)
        back, to_k = _advect_back(_array(velocity), g, dt / h, domain)
        to_dt += (to_reach + to_k) / h
        numbers = (to_dt, to_damping, to_bounce, (dt * felt).tolist(), to_inflow, to_fluctuation)
        dtype = gravity.dtype
        return torch.from_numpy(back), *(torch.tensor(n, dtype=dtype) for n in numbers), to_pattern, None


def _split(flat: np.ndarray, domain: RolloutDomain) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    o = domain.offsets
    return flat[: o[1]], flat[o[1] : o[2]], flat[o[2] :]


def _advect_back(v: np.ndarray, g: np.ndarray, k: float, domain: RolloutDomain) -> tuple[np.ndarray, float]:
    """Gradients of the velocity before advection, and of k; faces that are not dynamic pass theirs through."""
    total = g.copy()
    total[domain.dynamic] = 0
    parts, sums, to_k = _split(v, domain), _split(total, domain), 0.0
    for axis, (runs, _) in enumerate(domain.lists.runs):
        arguments = (axis, parts, domain.face_shapes, v.dtype.type(k), runs, _split(g, domain)[axis])
        to_k += advect_component_adjoint(*arguments, sums)
    return total, to_k


class _Diffuse(torch.autograd.Function):
    """x with (1 - c L + e W) x = v + c B v, L symmetric, W diagonal, B from prescribed faces.

    The adjoint l = (1 - c L + e W)^-1 g gives dv = l + c B^T l, dc = l . (L x + B v), de = -l . W x. Prescribed faces
    pass through, so x holds v there.
    """

    @staticmethod
    def forward(
        ctx: Any, velocity: Tensor, c: Tensor, e: Tensor, domain: RolloutDomain, failed: list[SolveReport] | None
    ) -> Tensor:
        x = _array(velocity).copy()
        real, h = x.dtype.type, float(domain.system.spacing)
        ctx.rates, ctx.domain = (real(float(c) / h**2), real(float(e))), domain
        lists = domain.lists
        rows, cols = lists.boundary
        rollout_diffusion.add_boundary(x, x, rows, cols, ctx.rates[0])
        for component, (runs, _) in zip(lists.components, lists.runs):
            layout = (lists.couplings, domain.wall_count)
            work = _work(domain, x.dtype)
            found = rollout_diffusion.diffuse(x, component, runs, layout, ctx.rates, _tolerance(x), work)
            # a bound at the tolerance may round to above it
            if failed is not None and found[1] > 1.01 * _tolerance(x):
                failed.append(SolveReport(False, *found, "viscosity", TOO_VISCOUS))
        out = torch.from_numpy(x)
        ctx.save_for_backward(out)
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        x, domain = ctx.saved_tensors[0].numpy(), ctx.domain
        lists, g = domain.lists, _array(gradients[0]).copy()
        to_a, to_e = 0.0, 0.0
        for component, (runs, _) in zip(lists.components, lists.runs):
            layout = (lists.couplings, domain.wall_count)
            a, e = rollout_diffusion.diffuse_adjoint(
                g, x, component, runs, layout, ctx.rates, _tolerance(x), _work(domain, x.dtype)
            )
            to_a, to_e = to_a + a, to_e + e
        rows, cols = lists.boundary
        to_a += rollout_diffusion.dot_boundary(g, x, rows, cols)
        rollout_diffusion.add_boundary(g, g, cols, rows, ctx.rates[0])
        to_c = to_a / float(domain.system.spacing) ** 2
        dtype = gradients[0].dtype
        return torch.from_numpy(g), torch.tensor(to_c, dtype=dtype), torch.tensor(to_e, dtype=dtype), None, None


_threads = threading.local()


def _work(domain: RolloutDomain, dtype: np.dtype) -> tuple[np.ndarray, ...]:
    """Work arrays of this thread for diffusion, kept from call to call: fresh memory costs as much as some sweeps."""
    size = max(rollout_diffusion.padded_size(s) for s in domain.face_shapes)
    kept = getattr(_threads, "kept", {})
    if dtype not in kept or len(kept[dtype][0]) < size:
        kept[dtype] = tuple(np.empty(size, dtype) for _ in range(4))
        _threads.kept = kept
    return kept[dtype]


def _tolerance(values: np.ndarray) -> float:
    """Of diffusion, relative: near the rounding of the number type."""
    return 1e-6 if values.dtype == np.float32 else 1e-13


def implicit_diffusion(
    velocity: Float[Tensor, " f"],
    domain: RolloutDomain,
    viscosity: Tensor,
    wall_damping: Tensor,
    time_step: Tensor,
    failed: list[SolveReport] | None = None,
) -> Float[Tensor, " f"]:
    """One backward Euler step of viscosity; prescribed faces act as boundary values, walls by their damping.

    A component whose solve misses its tolerance appends a report to `failed`.
    """
    c = viscosity * time_step
    e = c * wall_damping * (2 / float(domain.system.spacing) ** 2)
    return _Diffuse.apply(velocity, c, e, domain, failed)


class _Outflow(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, velocity: Tensor, speed: Tensor, domain: RolloutDomain) -> Tensor:
        ctx.domain = domain
        out, faces = _array(velocity).copy(), domain.lists.outflow
        out[faces] = out.dtype.type(float(speed)) * domain.outflow[faces]
        return torch.from_numpy(out)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        g, faces = _array(gradients[0]).copy(), ctx.domain.lists.outflow
        to_speed = float((g[faces].astype(np.float64) * ctx.domain.outflow[faces]).sum())
        g[faces] = 0
        return torch.from_numpy(g), torch.tensor(to_speed, dtype=gradients[0].dtype), None


def set_outflow(velocity: Float[Tensor, " f"], domain: RolloutDomain, speed: Tensor) -> Float[Tensor, " f"]:
    """Faces to OUTFLOW cells take `speed` along the mainstream."""
    return _Outflow.apply(velocity, speed, domain) if len(domain.lists.outflow) else velocity


def push_outlet(
    velocity: Float[Tensor, " f"], domain: RolloutDomain, gravity: Float[Tensor, "3"], time_step: Tensor
) -> Float[Tensor, " f"]:
    """Faces to OUTFLOW cells feel the weight of the liquid behind them for one step."""
    faces = domain.lists.outlet
    if not len(faces):
        return velocity
    push = time_step * (gravity @ torch.from_numpy(domain.outlet_head[:, faces]))
    return velocity.index_add(0, torch.from_numpy(faces), push)
