"""DiffSim^n in plain torch operations on any device: the readable twin of `rollout`, and its way onto a GPU.

The terms, their order and their meaning are those of `rollout.step`; only the arrays differ (`TorchDomain`). Gradients:
pressure and viscosity by implicit differentiation (one more solve on the same device), all else by autograd. The
back-trace of advection is differentiated as it is computed ("exact") or by the paper's surrogate ("upwind").

On CUDA two runs may differ by rounding, because sums over scattered indices are added in any order there
(`torch.use_deterministic_algorithms(True)` makes them equal, at some cost).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from fluidlift.errors import require
from fluidlift.numerics import torch_multigrid
from fluidlift.physics.advection import Faces, upwind_step
from fluidlift.physics.rollout import Rollout, RolloutParameters, flatten
from fluidlift.physics.rollout_domain import RolloutDomain
from fluidlift.physics.rollout_operators import TOO_VISCOUS
from fluidlift.physics.rollout_pressure import RolloutOptions
from fluidlift.physics.rollout_torch_domain import (
    TorchDomain,
    box_to_flat,
    differences,
    flat_to_box,
    flux_balance,
    neighbour_sum,
)
from fluidlift.types import FaceVelocity, SolveReport

Box = Float[Tensor, "3 X Y Z"]
MOST_DIFFUSION_ITERATIONS = 500
"""of conjugate gradients; c / h^2 = 50 takes some 100"""


@dataclass
class Solved:
    """The pressure of one step. A step that is computed again for its gradient takes it from here."""

    guess: Tensor | None = None
    potential: Tensor | None = None
    report: SolveReport | None = None


def extrapolate(velocity: Box, domain: TorchDomain) -> Box:
    """Faces beyond the fluid take the mean of their known neighbours, sweep by sweep."""
    velocity = velocity * domain.known
    for fill in domain.fills:
        velocity = velocity + fill * neighbour_sum(velocity)
    return velocity


def back_trace(velocity: Box, k: Tensor, domain: TorchDomain) -> Box:
    """Dynamic faces take the trilinear value at x - k v (k = dt / h); the others keep theirs. See `advection`."""
    t = domain.trace
    flat = velocity.reshape(-1)
    beside = flat.index_select(0, t.around.reshape(-1)).view(t.around.shape).mean(dim=1)
    carrier = torch.cat([flat.index_select(0, t.faces)[None], beside])
    point = (t.position - k * carrier).clamp(min=0).clamp(max=t.limit)
    low = torch.minimum(point.detach().floor(), (t.limit - 1).clamp(min=0))
    fraction = point - low
    corner = t.first + (low.to(torch.int32) * t.stride).sum(dim=0, dtype=torch.int32)
    for stride, limit in zip(t.stride, t.limit):
        corner = torch.stack([corner, torch.where(limit > 0, corner + stride, corner)])
    value = flat.index_select(0, corner.reshape(-1)).view(corner.shape)
    for axis in (2, 1, 0):
        value = torch.lerp(value[0], value[1], fraction[axis])
    return flat.index_copy(0, t.faces, value).view(velocity.shape)


class _UpwindSurrogate(torch.autograd.Function):
    """Forward: the back-trace. Backward: the derivative of `upwind_step` (a declared surrogate)."""

    @staticmethod
    def forward(ctx: Any, velocity: Tensor, k: Tensor, domain: TorchDomain) -> Tensor:
        ctx.save_for_backward(velocity, k)
        ctx.domain = domain
        return back_trace(velocity, k, domain)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        box, k = (t.detach().requires_grad_() for t in ctx.saved_tensors)
        layout = ctx.domain.layout
        with torch.enable_grad():
            u, v, w = (box[a, : s[0], : s[1], : s[2]] for a, s in enumerate(layout.face_shapes))
            moved = flat_to_box(torch.cat([m.reshape(-1) for m in upwind_step((u, v, w), k)]), layout)
            out = torch.where(ctx.domain.dynamic > 0, moved, box)
            grads = torch.autograd.grad(out, (box, k), gradients[0])
        return (*grads, None)


def advect(velocity: Box, time_step: Tensor, domain: TorchDomain, gradient: str) -> Box:
    """Carry the velocity along itself.

    Raises:
        ValueError: an unknown gradient.
    """
    require(gradient in ("exact", "upwind"), f"advection gradient '{gradient}'", "'exact' or 'upwind'")
    k = time_step / domain.spacing
    if gradient == "upwind":
        return _UpwindSurrogate.apply(velocity, k, domain)
    return back_trace(velocity, k, domain)


def apply_walls(velocity: Box, domain: TorchDomain, parameters: RolloutParameters) -> Box:
    """Friction of walls along the motion, and the bounce of walls across it."""
    velocity = velocity * (1 - 0.5 * parameters.wall_damping * domain.wall_share)
    arriving = (velocity.abs() * parameters.time_step / domain.spacing).clamp(max=1)
    ahead = torch.where(velocity.detach() < 0, domain.wall_below, domain.wall_above)
    return velocity * (1 - parameters.restitution * ahead * arriving)


def set_inflow(velocity: Box, domain: TorchDomain, parameters: RolloutParameters, pattern: Box | None) -> Box:
    """Inflow faces take the bulk velocity plus fluctuation times pattern; closed faces become 0."""
    given = parameters.inflow_velocity[:, None, None, None]
    if pattern is not None:
        given = given + parameters.inflow_fluctuation * pattern
    return velocity * domain.interior + given * domain.inflow


class _DiffuseTorch(torch.autograd.Function):
    """x with (1 - c L + e W) x = b; gradients as `rollout_operators`."""

    @staticmethod
    def forward(
        ctx: Any, b: Tensor, c: Tensor, e: Tensor, domain: TorchDomain, failed: list[SolveReport] | None
    ) -> Tensor:
        x = _solve_diffusion(b, c, e, domain, failed)
        ctx.save_for_backward(x, c, e)
        ctx.domain = domain
        return x

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        x, c, e = ctx.saved_tensors
        domain = ctx.domain
        adjoint = _solve_diffusion(gradients[0], c, e, domain)
        wide = adjoint.double()
        gc = (wide * _laplacian(x, domain)).sum().to(c.dtype)
        ge = -(wide * domain.wall_count * x).sum().to(e.dtype)
        return adjoint, gc, ge, None, None


def _laplacian(x: Box, domain: TorchDomain) -> Box:
    """Viscous Laplacian between dynamic faces, 1/m^2."""
    inside = neighbour_sum(domain.dynamic * x) / domain.spacing**2
    return domain.dynamic * inside - domain.neighbours * x


def _solve_diffusion(b: Box, c: Tensor, e: Tensor, domain: TorchDomain, failed: list[SolveReport] | None = None) -> Box:
    """Conjugate gradients for (1 - c L + e W) x = b; the diagonal varies little, so no preconditioner is needed.

    Where they miss the tolerance a report is appended to `failed`.
    """
    tolerance = 1e-6 if b.dtype == torch.float32 else 1e-13
    every = torch_multigrid.check_every(b.device)

    rate = (c / domain.spacing**2) * domain.dynamic
    drag = c * domain.neighbours + e * domain.wall_count
    keep = 1 + drag
    x = b.clone()
    residual = rate * neighbour_sum(b * domain.dynamic) - drag * b
    # zero off the dynamic faces from here on, as the residual
    direction = residual.clone()
    rr = (residual * residual).sum()
    zero = torch.zeros_like(rr)
    goal = (tolerance**2) * (b * b).sum()
    for iteration in range(MOST_DIFFUSION_ITERATIONS):
        if iteration % every == 0 and not torch_multigrid.host_value(rr - goal) > 0:
            break
        image = torch.addcmul(keep * direction, rate, neighbour_sum(direction), value=-1)
        curvature = (direction * image).sum()
        alpha = torch.where(curvature > 0, rr / curvature, zero)
        x.addcmul_(direction, alpha)
        residual.addcmul_(image, -alpha)
        rr, previous = (residual * residual).sum(), rr
        direction = torch.addcmul(residual, direction, torch.where(previous > 0, rr / previous, zero))
    else:
        left = tolerance * math.sqrt(torch_multigrid.host_value(rr / goal))
        if failed is not None and not left <= tolerance:
            failed.append(SolveReport(False, MOST_DIFFUSION_ITERATIONS, left, "viscosity", TOO_VISCOUS))
    return x


def diffuse(
    velocity: Box, domain: TorchDomain, parameters: RolloutParameters, failed: list[SolveReport] | None = None
) -> Box:
    """One backward Euler step of viscosity, as `rollout_operators.implicit_diffusion`."""
    c = parameters.kinematic_viscosity * parameters.time_step
    prescribed = neighbour_sum(velocity * domain.inflow) * domain.dynamic / domain.spacing**2
    e = c * parameters.wall_damping * (2 / domain.spacing**2)
    return _DiffuseTorch.apply(velocity + c * prescribed, c, e, domain, failed)


class _Pressure(torch.autograd.Function):
    """q with A q = rhs; A is symmetric, so the adjoint is the same solve (or the same sweeps) of the gradient."""

    @staticmethod
    def forward(ctx: Any, rhs: Tensor, domain: TorchDomain, options: RolloutOptions, solved: Solved) -> Tensor:
        ctx.domain, ctx.options = domain, options
        if solved.potential is None:
            solved.potential, solved.report = _solve_pressure(rhs, domain, options, solved.guess)
        return solved.potential.clone()

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        return _solve_pressure(gradients[0], ctx.domain, ctx.options, None)[0], None, None, None


def _solve_pressure(
    rhs: Tensor, domain: TorchDomain, options: RolloutOptions, guess: Tensor | None
) -> tuple[Tensor, SolveReport]:
    if options.projection == "jacobi":
        return torch_multigrid.jacobi(domain.system, rhs, sweeps=options.sweeps)
    return torch_multigrid.solve(
        domain.system, rhs, tolerance=options.tolerance, max_iterations=options.max_iterations, initial=guess
    )


def project(
    velocity: Box, domain: TorchDomain, *, options: RolloutOptions | None = None, solved: Solved | None = None
) -> Box:
    """The velocity without its divergence; the potential and the report of the solve are left in `solved`.

    Raises:
        ValueError: a way through the pressure that only the CPU knows.
    """
    options = options or RolloutOptions()
    known = ("implicit", "jacobi")
    require(options.projection in known, f"projection '{options.projection}' on {domain.device}", " or ".join(known))
    rhs = -flux_balance(domain.area * velocity)
    q = _Pressure.apply(rhs, domain, options, Solved() if solved is None else solved)
    return velocity - domain.slope * differences(q)


def step(
    velocity: Box,
    domain: TorchDomain,
    parameters: RolloutParameters,
    *,
    pattern: Box | None = None,
    options: RolloutOptions | None = None,
    solved: Solved | None = None,
) -> Box:
    """One time step, as `rollout.step`; all tensors on the domain's device and of its number type."""
    options = options or RolloutOptions()
    dt = parameters.time_step
    velocity = extrapolate(velocity, domain)
    velocity = advect(velocity, dt, domain, options.advection_gradient)
    velocity = apply_walls(velocity, domain, parameters)
    velocity = velocity + dt * parameters.gravity[:, None, None, None] * domain.force
    velocity = set_inflow(velocity, domain, parameters, pattern)
    failed: list[SolveReport] = []
    velocity = diffuse(velocity, domain, parameters, failed)
    velocity = velocity * (1 - domain.outflow_faces) + parameters.outflow_velocity * domain.outflow
    velocity = velocity + dt * torch.einsum("g,gaxyz->axyz", parameters.gravity, domain.outlet_head)
    velocity = project(velocity, domain, options=options, solved=solved)
    if failed and solved is not None:
        solved.report = failed[0]
    return velocity


def rollout_on_device(
    start: FaceVelocity | Faces | Float[Tensor, " f"],
    domains: RolloutDomain | TorchDomain | Sequence[RolloutDomain | TorchDomain],
    parameters: RolloutParameters,
    *,
    steps: int,
    patterns: Float[Tensor, " f"] | Sequence[Float[Tensor, " f"] | None] | None = None,
    options: RolloutOptions | None = None,
    guesses: Sequence[np.ndarray] | None = None,
    device: torch.device | str = "cpu",
    checkpoint_every: int | None = None,
) -> Rollout:
    """`rollout.rollout` in torch operations on `device`.

    Args:
        start: face velocity, m/s, on any device.
        domains: the cell layout, or one per step. `TorchDomain.of` once saves the assembly at each call.
        parameters: with or without gradients, on any device.
        steps: n.
        patterns: as `rollout.rollout`.
        options: "implicit" and "jacobi" projection, "exact" and "upwind" gradients.
        guesses: potentials of an earlier, similar rollout.
        device: where to compute.
        checkpoint_every: steps of which only the start is kept; the rest is computed again for the gradient, but for
            the pressure, which is remembered. None: everything is kept.

    Returns:
        the last velocity on the device of `start`, and the reports.

    Raises:
        ValueError: counts that do not match, or options that only the CPU knows.
    """
    single = isinstance(domains, (RolloutDomain, TorchDomain))
    layouts = _placed([domains] * steps if single else list(domains), torch.device(device))
    fields = [patterns] * steps if patterns is None or isinstance(patterns, Tensor) else list(patterns)
    require(steps >= 1 and len(layouts) == steps, f"{len(layouts)} domains for {steps} steps", "one per step")
    require(len(fields) == steps, f"{len(fields)} patterns for {steps} steps", "one per step")
    require(checkpoint_every is None or checkpoint_every >= 1, f"checkpoint_every {checkpoint_every}", "at least 1")
    first = layouts[0]
    flat = start if isinstance(start, Tensor) else flatten(start, first.dtype)
    require(flat.shape == (first.layout.offsets[3],), f"{tuple(flat.shape)} faces", str(first.layout.offsets[3]))
    kind = {"dtype": first.dtype, "device": first.device}
    moved = RolloutParameters(**{k: v.to(**kind) for k, v in vars(parameters).items()})
    kept = [Solved(None if guesses is None else torch.as_tensor(guesses[i], **kind)) for i in range(steps)]

    def advance(box: Tensor, begin: int, end: int) -> Tensor:
        for i in range(begin, end):
            field = fields[i]
            pattern = None if field is None else flat_to_box(field.to(**kind), first.layout)
            box = step(box, layouts[i], moved, pattern=pattern, options=options, solved=kept[i])
        return box

    box = flat_to_box(flat.to(**kind), first.layout)
    segment = checkpoint_every or steps
    for begin in range(0, steps, segment):
        end = min(begin + segment, steps)
        if checkpoint_every is None or not torch.is_grad_enabled():
            box = advance(box, begin, end)
        else:
            box = checkpoint(advance, box, begin, end, use_reentrant=False, preserve_rng_state=False)
    last = layouts[-1]
    velocity = box_to_flat(extrapolate(box, last), last.layout).to(flat.device)
    potentials = tuple(_on_host(s.potential) for s in kept if s.potential is not None)
    reports = tuple(s.report for s in kept if s.report is not None)
    return Rollout(velocity, last.layout, potentials, reports)


def _on_host(values: Tensor) -> np.ndarray:
    return values.cpu().numpy()


def _placed(domains: Sequence[RolloutDomain | TorchDomain], device: torch.device) -> list[TorchDomain]:
    """All on the device, each assembled once."""
    placed: dict[int, TorchDomain] = {}
    for domain in domains:
        if id(domain) not in placed:
            placed[id(domain)] = domain if isinstance(domain, TorchDomain) else TorchDomain.of(domain, device)
    return [placed[id(domain)] for domain in domains]
