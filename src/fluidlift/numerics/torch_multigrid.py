"""The Poisson equation on irregular domains on any torch device: multigrid-preconditioned conjugate gradients.

The operator and its coarser levels are those of `multigrid_plain` (McAdams, Sifakis, Teran 2010; the factors are
derived in `multigrid_assembly`). What differs is what suits whole-array operations: a Chebyshev polynomial as smoother
(Adams et al. 2003, "Parallel multigrid smoothers"), which needs no colours, and the pseudo-inverse on the coarsest
level. The Krylov space is double precision, the V-cycle single, so that the true residual falls as far as is asked.

Closed components are summed by `index_add`, which on CUDA adds in any order unless torch is told to be deterministic.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from fluidlift.errors import require
from fluidlift.numerics.torch_poisson import DeviceSystem, ScaledLevel, add_neighbours, interior
from fluidlift.types import SolveReport

DEGREE = 3
"""of the smoother, before and after each coarse correction"""
EIGENVALUES = (0.3, 2.0)
"""the smoother damps these of the scaled operator: 2 is Gershgorin's bound, below 1/3 waves are longer than 4 cells"""
RESTARTS = 4
"""times the residual is computed anew"""
CHECK_EVERY = 4
"""iterations between looks at the residual where the device works ahead of the host"""
JACOBI_RELAXATION = 0.9
"""as `poisson.jacobi`"""


def host_value(value: Tensor) -> float:
    """The number: here the host waits for the device."""
    return float(value)


def check_every(device: torch.device) -> int:
    """Iterations between two looks at the residual."""
    return 1 if device.type == "cpu" else CHECK_EVERY


def _smooth(level: ScaledLevel, x: Tensor | None, b: Tensor) -> Tensor:
    """A Chebyshev polynomial of the scaled operator on the residual (Saad 2003, algorithm 12.1); None: x = 0."""
    low, high = EIGENVALUES
    middle, half = (high + low) / 2, (high - low) / 2
    residual = b if x is None else _residual(level, x, b)
    step = residual / middle
    x = step.clone() if x is None else x.add_(step)
    rho = half / middle
    for _ in range(DEGREE - 1):
        residual = _residual(level, x, b)
        rho, before = 1 / (2 * middle / half - rho), rho
        step.mul_(rho * before).add_(residual, alpha=2 * rho / half)
        x.add_(step)
    return x


def _residual(level: ScaledLevel, x: Tensor, b: Tensor) -> Tensor:
    out = b - x
    add_neighbours(x, level.couplings, level, out, 1.0)
    return out


def _restrict(fine: ScaledLevel, coarse: ScaledLevel, residual: Tensor) -> Tensor:
    """The scaled right side of the coarser level: sums over eight cells."""
    r = (fine.unscale * residual).view(fine.shape)[1:-1, 1:-1, 1:-1]
    r = r[0::2] + r[1::2]
    r = r[:, 0::2] + r[:, 1::2]
    r = r[:, :, 0::2] + r[:, :, 1::2]
    out = torch.zeros(coarse.shape, dtype=r.dtype, device=r.device)
    nx, ny, nz = r.shape
    interior(out, (nx, ny, nz)).copy_(r)
    return out.view(-1).mul_(coarse.scale)


def v_cycle(system: DeviceSystem, b: Float[Tensor, " n"], depth: int = 0) -> Float[Tensor, " n"]:
    """An approximate solution of the scaled equation on a level (float32, flat): linear, symmetric, positive."""
    level = system.levels[depth]
    if depth == len(system.levels) - 1:
        return _solve_coarsest(system, level, b)
    coarse = system.levels[depth + 1]
    x = _smooth(level, None, b)
    y = v_cycle(system, _restrict(level, coarse, _residual(level, x, b)), depth + 1)
    x.addcmul_(level.unscale, (coarse.scale * y).index_select(0, level.parent))
    return _smooth(level, x, b)


def _solve_coarsest(system: DeviceSystem, level: ScaledLevel, b: Tensor) -> Tensor:
    cells = system.cells
    for _ in system.levels[1:]:
        cells = ((cells[0] + 1) // 2, (cells[1] + 1) // 2, (cells[2] + 1) // 2)
    x = system.inverse @ interior(b.view(level.shape), cells).reshape(-1)
    out = torch.zeros(level.shape, dtype=b.dtype, device=b.device)
    interior(out, cells).copy_(x.view(cells))
    return out.view(-1)


def _precondition(system: DeviceSystem, residual: Tensor) -> Tensor:
    scale = system.levels[0].scale
    return (v_cycle(system, residual.to(torch.float32).mul_(scale)).mul_(scale)).to(torch.float64)


def _conjugate_gradients(
    system: DeviceSystem, p: Tensor, b: Tensor, goal: float, max_iterations: int
) -> tuple[int, float]:
    """Solve in place to |b - A p| <= goal; returns the iterations and the true |b - A p|."""
    every = check_every(b.device)
    iterations, size = 0, math.inf
    zero = torch.zeros((), dtype=b.dtype, device=b.device)
    for _ in range(RESTARTS):
        residual = b - system.apply(p)
        size, before = math.sqrt(host_value(torch.dot(residual, residual))), size
        if not size > goal or not size < 0.5 * before or iterations >= max_iterations:
            break
        now, rz, direction = size, zero, torch.zeros_like(p)
        while now > goal and iterations < max_iterations:
            z = _precondition(system, residual)
            rz, previous = torch.dot(residual, z), rz
            # past the end of the iteration nothing moves
            direction = torch.addcmul(z, direction, torch.where(previous > 0, rz / previous, zero))
            image = system.apply(direction)
            curvature = torch.dot(direction, image)
            step = torch.where(curvature > 0, rz / curvature, zero)
            p.addcmul_(direction, step)
            residual.addcmul_(image, -step)
            iterations += 1
            if iterations % every == 0 or iterations == max_iterations:
                now = math.sqrt(host_value(torch.dot(residual, residual)))
    return iterations, size


def solve(
    system: DeviceSystem,
    rhs: Float[Tensor, "nx ny nz"],
    *,
    tolerance: float = 1e-5,
    max_iterations: int = 200,
    initial: Float[Tensor, "nx ny nz"] | None = None,
) -> tuple[Float[Tensor, "nx ny nz"], SolveReport]:
    """p with A p = rhs to |rhs - A p| <= tolerance |rhs|, as `poisson.solve` (there: closed components).

    Args:
        system: the operator, see `DeviceSystem.of`.
        rhs: right side on the system's device, p / m^2; values outside the unknown cells are ignored.
        tolerance: relative residual in the 2-norm.
        max_iterations: of the conjugate gradients. Off the CPU they are counted in multiples of `CHECK_EVERY`.
        initial: first guess.

    Returns:
        p (dtype of rhs, 0 outside the unknown cells) and the report with the true residual before rounding to it.

    Raises:
        ValueError: a wrong shape or device.
    """
    b, norm, removed = _right_side(system, rhs)
    p = torch.zeros_like(b)
    if initial is not None:
        require(initial.shape == system.shape, "a first guess of another shape", str(system.shape))
        p = system.load(initial)
        norm = norm + 0 * host_value(torch.dot(p, p))  # not finite if the guess is not
    if norm == 0 or not math.isfinite(norm):
        return torch.zeros_like(rhs), _report(0, norm, 0.0, tolerance)
    iterations, size = _conjugate_gradients(system, p.div_(norm), b.div_(norm), tolerance, max_iterations)
    p.mul_(norm)
    system.remove_means(p)
    return system.store(p, rhs.dtype), _report(iterations, size, removed / norm, tolerance)


def _right_side(system: DeviceSystem, rhs: Tensor) -> tuple[Tensor, float, float]:
    """h^2 rhs without its means, its norm, and the norm of these."""
    require(rhs.shape == system.shape, f"rhs {tuple(rhs.shape)}", str(system.shape))
    device = system.diagonal.device
    require(rhs.device.type == device.type, f"rhs on {rhs.device}", f"the system's device {device}")
    b = system.load(rhs).mul_(system.spacing**2)
    removed = system.remove_means(b)
    sizes = torch.stack([torch.dot(b, b), removed]).sqrt()
    return b, host_value(sizes[0]), host_value(sizes[1]) if system.closed_cells.numel() else 0.0


def _report(iterations: int, residual: float, removed: float, tolerance: float) -> SolveReport:
    advice = []
    if not math.isfinite(residual):
        advice.append("the right side or the first guess is not finite")
    elif removed > 1e-6:
        advice.append(
            "closed components whose in- and outflow do not balance: the mean of the right side was removed there"
        )
    converged = math.isfinite(residual) and residual <= tolerance * (1 + 1e-6)
    if not converged and math.isfinite(residual):
        advice.append("raise max_iterations or the tolerance")
    return SolveReport(converged, iterations, residual, "torch multigrid", "; ".join(advice))


def jacobi(
    system: DeviceSystem, rhs: Float[Tensor, "nx ny nz"], *, sweeps: int
) -> tuple[Float[Tensor, "nx ny nz"], SolveReport]:
    """Exactly `sweeps` sweeps of `poisson.jacobi` from zero: linear in rhs and symmetric.

    Raises:
        ValueError: a wrong shape or device.
    """
    b, norm, removed = _right_side(system, rhs)
    p = torch.zeros_like(b)
    if norm == 0 or not math.isfinite(norm):
        return torch.zeros_like(rhs), _report(0, norm, 0.0, 0.0)
    step = torch.where(system.active, JACOBI_RELAXATION / system.diagonal, 0.0)
    residual = b.clone()
    for _ in range(sweeps):
        p.addcmul_(step, residual)
        torch.sub(b, system.apply(p), out=residual)
    size = host_value(torch.dot(residual, residual).sqrt())
    system.remove_means(p)
    return system.store(p, rhs.dtype), _report(sweeps, size / norm, removed / norm, 0.0)
