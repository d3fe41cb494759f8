"""DiffSim^n: n differentiable steps of incompressible flow on a MAC grid (paper, "Presumed APIC Simulation").

One step splits the momentum equation as: extrapolate, advect, wall friction and bounce, body force, inflow, viscosity,
outflow, pressure. Advection comes first, so that the carrying velocity is free of divergence; walls answer the motion
that is there and not what gravity adds before the pressure takes it back, so a pool at rest stays at rest.

* Gravity acts on the fluid only and EMPTY cells hold p = 0, so a slope accelerates the flow; density drops out of the
  velocity and only scales the pressure.
* Viscosity: backward Euler at any value (so the result is smooth in it), no stress at air; a wall beside a face takes
  v = 0 at half a cell's distance, times `wall_damping`.
* `wall_damping` d also takes the share d / 2 of the tangential velocity of the cells along a wall per step: the mean
  over a cell of a share that fades linearly with the distance from the wall, as for the particles in `boundaries`.
* `restitution` b: of the fluid that moves to a wall one cell ahead, the share dt |v| / h arrives within a step and
  has its normal velocity v answered by -b v. The wall itself stays closed: no volume is made.
* Outflow: faces to OUTFLOW cells take `outflow_velocity` along the mainstream, then the pressure corrects them as it
  does all others. Behind them it is hydrostatic: the outlet cuts a stream that goes on.

Gradients: pressure and viscosity by implicit differentiation (one more solve with the same symmetric operator), the
rest by hand-written adjoints. `explicit_terms_plain` and the matrices of `RolloutDomain` are their readable twins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from fluidlift.errors import require
from fluidlift.physics.advection import Faces, advect
from fluidlift.physics.rollout_domain import RolloutDomain
from fluidlift.physics.rollout_operators import (
    ExplicitTerms,
    apply_linear,
    implicit_diffusion,
    push_outlet,
    set_outflow,
)
from fluidlift.physics.rollout_pressure import RolloutOptions, project
from fluidlift.types import FaceVelocity, FluidParameters, SolveReport


@dataclass(frozen=True)
class RolloutParameters:
    """Physical parameters as tensors (units of `FluidParameters`)."""

    density: Tensor
    kinematic_viscosity: Tensor
    gravity: Tensor
    """[3]"""
    inflow_velocity: Tensor
    """[3]"""
    inflow_fluctuation: Tensor
    outflow_velocity: Tensor
    restitution: Tensor
    wall_damping: Tensor
    time_step: Tensor

    @classmethod
    def of(cls, parameters: FluidParameters, dtype: torch.dtype = torch.float32) -> RolloutParameters:
        """Constants from plain numbers. Surface tension is left out: the rollout has none."""
        values = parameters.to_dict()
        return cls(**{f.name: torch.tensor(values[f.name], dtype=dtype) for f in fields(cls)})

    def fluid_parameters(self) -> FluidParameters:
        """Plain numbers."""
        return FluidParameters(**{k: v.detach().double().tolist() for k, v in vars(self).items()})


@dataclass(frozen=True)
class Rollout:
    """What a rollout gives."""

    velocity: Float[Tensor, " f"]
    """flat face velocity after the last step, m/s, extrapolated beyond the fluid"""
    domain: RolloutDomain
    """layout of the last step"""
    potentials: tuple[np.ndarray, ...]
    """p dt / density of every step, m^2/s: good first guesses for a neighbouring rollout"""
    reports: tuple[SolveReport, ...]
    """one per step, forward: of the pressure solve, or of the viscous one (method "viscosity") where that failed"""

    def faces(self) -> Faces:
        """u, v, w."""
        return unflatten(self.velocity, self.domain)

    def pressure(self, parameters: RolloutParameters) -> Float[np.ndarray, "nx ny nz"]:
        """Pressure of the last step, Pa."""
        return self.potentials[-1] * float(parameters.density) / float(parameters.time_step)


def flatten(velocity: FaceVelocity | Faces, dtype: torch.dtype = torch.float32) -> Float[Tensor, " f"]:
    """Face arrays to the flat vector."""
    parts = velocity.components if isinstance(velocity, FaceVelocity) else velocity
    return torch.cat([torch.as_tensor(p, dtype=dtype).reshape(-1) for p in parts])


def unflatten(flat: Float[Tensor, " f"], domain: RolloutDomain) -> Faces:
    """The flat vector to u, v, w."""
    o = domain.offsets
    u, v, w = (flat[o[a] : o[a + 1]].reshape(s) for a, s in enumerate(domain.face_shapes))
    return (u, v, w)


def apply_walls(
    velocity: Float[Tensor, " f"], domain: RolloutDomain, parameters: RolloutParameters
) -> Float[Tensor, " f"]:
    """Wall friction between free slip and no-slip, and restitution across the wall."""
    share = torch.from_numpy(domain.wall_share)
    below, above = torch.from_numpy(domain.wall_below), torch.from_numpy(domain.wall_above)
    velocity = velocity * (1 - 0.5 * parameters.wall_damping * share)
    arriving = (velocity.abs() * parameters.time_step / domain.system.spacing).clamp(max=1)
    ahead = torch.where(velocity.detach() < 0, below, above)
    return velocity * (1 - parameters.restitution * ahead * arriving)


def set_inflow(
    velocity: Float[Tensor, " f"],
    domain: RolloutDomain,
    parameters: RolloutParameters,
    pattern: Float[Tensor, " f"] | None,
) -> Float[Tensor, " f"]:
    """Dirichlet inflow: its faces take the bulk velocity plus fluctuation times pattern; closed faces become 0."""
    o = domain.offsets
    given = torch.cat([parameters.inflow_velocity[a].expand(o[a + 1] - o[a]) for a in range(3)])
    if pattern is not None:
        given = given + parameters.inflow_fluctuation * pattern
    return velocity * torch.from_numpy(domain.interior) + given * torch.from_numpy(domain.inflow)


def explicit_terms_plain(
    velocity: Float[Tensor, " f"],
    domain: RolloutDomain,
    parameters: RolloutParameters,
    pattern: Float[Tensor, " f"] | None = None,
    advection_gradient: str = "exact",
) -> Float[Tensor, " f"]:
    """Advection, walls, body force, inflow of an extrapolated velocity, term by term."""
    o, h, dt = domain.offsets, float(domain.system.spacing), parameters.time_step
    moved = advect(unflatten(velocity, domain), dt, spacing=h, gradient=advection_gradient, active=domain.active())
    velocity = apply_walls(torch.cat([m.reshape(-1) for m in moved]), domain, parameters)
    force = torch.cat([parameters.gravity[a].expand(o[a + 1] - o[a]) for a in range(3)])
    velocity = velocity + dt * force * torch.from_numpy(domain.force)
    return set_inflow(velocity, domain, parameters, pattern)


def explicit_terms(
    velocity: Float[Tensor, " f"],
    domain: RolloutDomain,
    parameters: RolloutParameters,
    pattern: Float[Tensor, " f"] | None = None,
) -> Float[Tensor, " f"]:
    """`explicit_terms_plain` with the exact gradient, in one go."""
    p = parameters
    moving = (p.time_step, p.wall_damping, p.restitution, p.gravity, p.inflow_velocity, p.inflow_fluctuation)
    return ExplicitTerms.apply(velocity, *moving, pattern, domain)


def step(
    velocity: Float[Tensor, " f"],
    domain: RolloutDomain,
    parameters: RolloutParameters,
    *,
    pattern: Float[Tensor, " f"] | None = None,
    options: RolloutOptions | None = None,
    guess: np.ndarray | None = None,
    kept: list[tuple[np.ndarray, SolveReport]] | None = None,
) -> Float[Tensor, " f"]:
    """One time step of the flat face velocity; see the module for the order of terms.

    Faces beyond the fluid and its walls keep what the extrapolation gave them.
    """
    options = options or RolloutOptions()
    p = parameters
    velocity = apply_linear(velocity, domain.extrapolation)
    if options.advection_gradient == "exact":
        velocity = explicit_terms(velocity, domain, p, pattern)
    else:
        velocity = explicit_terms_plain(velocity, domain, p, pattern, options.advection_gradient)
    failed: list[SolveReport] = []
    velocity = implicit_diffusion(velocity, domain, p.kinematic_viscosity, p.wall_damping, p.time_step, failed)
    velocity = set_outflow(velocity, domain, p.outflow_velocity)
    velocity = push_outlet(velocity, domain, p.gravity, p.time_step)
    velocity = project(velocity, domain, options=options, guess=guess, kept=kept)
    if failed and kept:
        kept[-1] = (kept[-1][0], max(failed, key=lambda report: report.residual))
    return velocity


def rollout(
    start: FaceVelocity | Faces | Float[Tensor, " f"],
    domains: RolloutDomain | Sequence[RolloutDomain],
    parameters: RolloutParameters,
    *,
    steps: int,
    patterns: Float[Tensor, " f"] | Sequence[Float[Tensor, " f"] | None] | None = None,
    options: RolloutOptions | None = None,
    guesses: Sequence[np.ndarray] | None = None,
    checkpoint_every: int | None = None,
) -> Rollout:
    """DiffSim^n of the paper (`optLoss`): the face velocity after `steps` steps.

    Args:
        start: face velocity, m/s (types, or tensors, or the flat vector).
        domains: the cell layout, or one per step; all of one shape and number type.
        parameters: with or without gradients.
        steps: n.
        patterns: flat fluctuation of the inflow of unit root mean square, or one per step (None: bulk velocity only).
        options: see there.
        guesses: potentials of an earlier, similar rollout (`Rollout.potentials`), first guesses of the solves.
        checkpoint_every: for the backward pass keep the velocity every so many steps only, and compute the steps
            between again from there, by the same solves from the same guesses: gradients are the same to the last
            bit. None keeps all steps.

    Returns:
        the last velocity and the reports; a solve that failed is seen in the reports.

    Raises:
        ValueError: counts that do not match.
    """
    layouts = [domains] * steps if isinstance(domains, RolloutDomain) else list(domains)
    fields = [patterns] * steps if patterns is None or isinstance(patterns, Tensor) else list(patterns)
    require(steps >= 1 and len(layouts) == steps, f"{len(layouts)} domains for {steps} steps", "one per step")
    require(len(fields) == steps, f"{len(fields)} patterns for {steps} steps", "one per step")
    dtype = torch.from_numpy(layouts[0].inflow).dtype
    flat = start if isinstance(start, Tensor) else flatten(start, dtype)
    require(flat.shape == (layouts[0].offsets[3],), f"{tuple(flat.shape)} faces", str(layouts[0].offsets[3]))
    length = steps if checkpoint_every is None else checkpoint_every
    require(length >= 1, f"checkpoints every {length} steps", "1 or more")
    guess_of = [None] * steps if guesses is None else list(guesses)
    kept: dict[int, tuple[np.ndarray, SolveReport]] = {}

    def segment(velocity: Tensor, begin: int) -> Tensor:
        """Steps `begin` to `begin + length`, the first time or again for the backward pass."""
        for i in range(begin, min(begin + length, steps)):
            solved: list[tuple[np.ndarray, SolveReport]] = []
            given = {"pattern": fields[i], "guess": guess_of[i], "kept": solved}
            velocity = step(velocity, layouts[i], parameters, options=options, **given)
            kept.setdefault(i, solved[0])
        return velocity

    for begin in range(0, steps, length):
        if checkpoint_every is None or not torch.is_grad_enabled():
            flat = segment(flat, begin)
        else:
            flat = checkpoint(segment, flat, begin, use_reentrant=False, preserve_rng_state=False)
    flat = apply_linear(flat, layouts[-1].extrapolation)
    potentials, reports = zip(*(kept[i] for i in range(steps)))
    return Rollout(flat, layouts[-1], potentials, reports)
