"""Fitting the recurrent stencil to solved pressure problems, and judging it before use (paper: `percnn_str_fit`).

The start is Jacobi's sweep with a little momentum; Adam then lowers the logarithm of the mean squared relative error
of q after the last sub-step, on the gradient that torch records through all sub-steps. Relaxations and momenta stay
where a constant schedule converges on any domain.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from fluidlift.errors import require
from fluidlift.numerics.poisson import PoissonSystem
from fluidlift.numerics.recurrent_stencil import (
    NEIGHBOUR_COUNTS,
    NEIGHBOUR_KINDS,
    FittedStencil,
    LayerInput,
    LayerWeights,
    StencilDomain,
    recurrent_layers,
    recurrent_solve,
    relative_residual,
    stencil_domain,
)

GAIN_LIMIT = 0.5
"""of the logarithms of the gains beside air and walls"""
MOMENTUM_LIMIT = 0.999
START_RELAXATION, START_MOMENTUM = 0.9, 0.3
RATE = 0.15
"""Adam's first step in raw units; it falls to a tenth"""


class PressureSample(NamedTuple):
    """One solved problem."""

    system: PoissonSystem
    rhs: Float[np.ndarray, "nx ny nz"]
    """q / m^2"""
    potential: Float[np.ndarray, "nx ny nz"]
    """q with A q = rhs"""


@dataclass(frozen=True)
class StencilFit:
    """A stencil and the way to it."""

    stencil: FittedStencil
    errors: Float[np.ndarray, " iterations+1"]
    """relative error of q, root mean square over the samples, before each iteration and after the last"""


@dataclass(frozen=True)
class StencilValidation:
    """How a stencil does on samples, beside Jacobi's sweeps of the same number. Errors are relative 2-norms of q."""

    errors: Float[np.ndarray, " samples"]
    residuals: Float[np.ndarray, " samples"]
    jacobi_errors: Float[np.ndarray, " samples"]
    jacobi_residuals: Float[np.ndarray, " samples"]
    sub_steps: np.ndarray
    """int [n]: where the curves are sampled"""
    curve: Float[np.ndarray, " n"]
    """mean error after so many sub-steps"""
    jacobi_curve: Float[np.ndarray, " n"]
    converges_anywhere: bool
    """no component of the error can grow over a solve, on any domain"""

    @property
    def accepted(self) -> bool:
        """Fit for use: proven not to diverge, and better than Jacobi on every sample."""
        better = bool((self.errors < self.jacobi_errors).all())
        return better and self.converges_anywhere

    @property
    def advice(self) -> str:
        """Why not; empty if accepted."""
        if self.accepted:
            return ""
        if not self.converges_anywhere:
            return "the fitted schedule amplifies part of the error: use the implicit route"
        worst = int(np.argmax(self.errors / self.jacobi_errors))
        return (
            f"on sample {worst} the stencil leaves {self.errors[worst]:.2g} of the potential, as many Jacobi sweeps "
            f"{self.jacobi_errors[worst]:.2g}: fit longer or on such samples, or use the implicit route"
        )


class _RawWeights:
    """The optimiser's variables and the weights that they stand for."""

    def __init__(self, seed: int, dtype: torch.dtype) -> None:
        generator = torch.Generator().manual_seed(seed)

        def start(value: float, shape: int, spread: float) -> Tensor:
            noise = spread * torch.randn(shape, generator=generator, dtype=dtype)
            return (value + noise).requires_grad_()

        momentum = START_MOMENTUM / MOMENTUM_LIMIT
        share = START_RELAXATION / (1 + START_MOMENTUM)
        self.momentum = start(math.log(momentum / (1 - momentum)), 1, 0.0)
        self.relaxation = start(math.log(share / (1 - share)), 1, 0.0)
        self.neighbours = start(0.0, len(NEIGHBOUR_KINDS), 1e-3)  # signs of weights at zero would never part
        self.gains = start(0.0, 2, 0.0)
        self.counts = torch.as_tensor(NEIGHBOUR_COUNTS, dtype=dtype)
        kinds = {kind: i for i, kind in enumerate(NEIGHBOUR_KINDS)} | {(0, 0, 0): len(NEIGHBOUR_KINDS)}
        offsets = itertools.product((1, 0, 1), (1, 0, 1), (1, 0, 1))
        self.places = torch.tensor([kinds[o] for o in offsets]).reshape(3, 3, 3)

    def all(self) -> list[Tensor]:
        """What the optimiser moves."""
        return [self.momentum, self.relaxation, self.neighbours, self.gains]

    def layer(self) -> tuple[LayerWeights, Tensor]:
        """The weights, and K's per kind of neighbour."""
        near = self.neighbours / (1 + (self.counts * self.neighbours.abs()).sum())
        kernel = torch.cat([near, near.new_ones(1)])[self.places]
        gains = GAIN_LIMIT * torch.tanh(self.gains)
        bound = 2 * (1 + (self.counts * near.abs()).sum()) * torch.exp(2 * gains.max().clamp(min=0))
        momentum = MOMENTUM_LIMIT * torch.sigmoid(self.momentum)
        # the second-order Richardson iteration converges for relaxation < 2 (1 + momentum) / largest eigenvalue
        relaxation = 2 * (1 + momentum) / bound * torch.sigmoid(self.relaxation)
        return LayerWeights(kernel, gains[0], gains[1], relaxation, momentum), near

    def stencil(self, sub_steps: int) -> FittedStencil:
        """The weights as plain numbers."""
        with torch.no_grad():
            layer, near = self.layer()
        gains = float(layer.air_gain), float(layer.wall_gain)
        schedules = layer.relaxation.double().numpy(), layer.momentum.double().numpy()
        return FittedStencil(near.double().numpy(), *gains, *schedules, sub_steps)


class _Adam:
    """Kingma and Ba 2015, as in torch.optim, whose first step loads torch's compiler: seconds for eleven numbers."""

    def __init__(self, variables: Sequence[Tensor]) -> None:
        self.moments = [(v, torch.zeros_like(v), torch.zeros_like(v)) for v in variables]
        self.count = 0

    def step(self, rate: float) -> None:
        """Move the variables along their gradients, and clear these."""
        self.count += 1
        with torch.no_grad():
            for variable, mean, square in self.moments:
                gradient = torch.zeros_like(variable) if variable.grad is None else variable.grad
                mean.lerp_(gradient, 0.1)
                square.lerp_(gradient**2, 0.001)
                size = (square / (1 - 0.999**self.count)).sqrt() + 1e-8
                variable -= rate * mean / (1 - 0.9**self.count) / size
                variable.grad = None


@dataclass(frozen=True)
class _Batch:
    """Samples in boxes of one size, scaled so that each solution has norm 1."""

    conditions: LayerInput
    rhs: Float[Tensor, "n a b c"]
    potential: Float[Tensor, "n a b c"]

    @classmethod
    def of(cls, samples: Sequence[PressureSample], dtype: torch.dtype) -> _Batch:
        """Boxes padded to the largest."""
        domains = [stencil_domain(s.system) for s in samples]
        size = np.max([d.scale.shape for d in domains], axis=0)

        def stacked(arrays: list[np.ndarray], axis: int = 0) -> Tensor:
            grown = [
                np.pad(a, [(0, 0)] * (a.ndim - 3) + [(0, n - m) for n, m in zip(size, a.shape[-3:])]) for a in arrays
            ]
            return torch.as_tensor(np.stack(grown, axis), dtype=dtype)

        pairs = [_boxed(d, s) for d, s in zip(domains, samples)]
        conditions = LayerInput(
            stacked([d.scale for d in domains]), stacked([d.air for d in domains]), stacked([d.wall for d in domains]),
            stacked([d.weights for d in domains], 1),
        )  # fmt: skip
        return cls(conditions, stacked([b for b, _ in pairs]), stacked([q for _, q in pairs]))

    def select(self, index: Sequence[int]) -> _Batch:
        """Some of the samples."""
        pick, c = list(index), self.conditions
        part = LayerInput(c.scale[pick], c.air[pick], c.wall[pick], c.weights[:, pick])
        return _Batch(part, self.rhs[pick], self.potential[pick])

    def squared_errors(self, weights: LayerWeights, sub_steps: int) -> Float[Tensor, " n"]:
        """Of q after the last sub-step, relative."""
        q = recurrent_layers(weights, self.conditions, self.rhs, sub_steps)
        return ((q - self.potential) ** 2).sum((1, 2, 3))


def _boxed(domain: StencilDomain, sample: PressureSample) -> tuple[np.ndarray, np.ndarray]:
    q = domain.without_constants(domain.into_box(np.asarray(sample.potential, float)))
    b = domain.without_constants(domain.into_box(np.asarray(sample.rhs, float)))
    norm = math.sqrt(float(np.square(q).sum()))
    require(norm > 0, "a sample without pressure", "a right side that is not zero")
    return b / norm, q / norm


def fit_stencil(
    samples: Sequence[PressureSample],
    *,
    sub_steps: int = 100,
    iterations: int = 60,
    seed: int = 0,
) -> StencilFit:
    """`fit_recurrent_stencil` with its history. Torch keeps some ten values per cell and sub-step of a batch meanwhile.

    Args:
        samples: solved problems; their domains may differ.
        sub_steps: of one solve.
        iterations: of Adam, each on two samples in random order.
        seed: of the order and of the start.

    Raises:
        ValueError: no samples, or counts below one.
    """
    require(len(samples) > 0, "no samples", "one solved pressure problem or more")
    require(min(sub_steps, iterations) >= 1, "a count below 1", "sub_steps, iterations >= 1")
    dtype = torch.float32
    data = _Batch.of([PressureSample(*s) for s in samples], dtype)
    raw, rng = _RawWeights(seed, dtype), np.random.default_rng(seed)
    optimizer = _Adam(raw.all())
    errors = []
    order: list[int] = []
    for iteration in range(iterations):
        if len(order) < 2:
            order += [int(i) for i in rng.permutation(len(samples))]
        pick, order = order[:2], order[2:]
        squared = data.select(pick).squared_errors(raw.layer()[0], sub_steps).mean()
        # the floor of single precision: below it there is nothing to learn
        torch.log(squared + 1e-12).backward()
        errors.append(math.sqrt(float(squared.detach())))
        optimizer.step(RATE * (1 - 0.9 * iteration / iterations))
    with torch.no_grad():
        last = data.squared_errors(raw.layer()[0], sub_steps).mean()
    return StencilFit(raw.stencil(sub_steps), np.array([*errors, math.sqrt(float(last))]))


def fit_recurrent_stencil(
    samples: Sequence[PressureSample], *, sub_steps: int = 100, iterations: int = 60, seed: int = 0
) -> FittedStencil:
    """The recurrent layer whose `sub_steps` applications come nearest to the solutions (paper: PeRCNN).

    Args:
        samples: (system, rhs, exact q).
        sub_steps: of one solve; the paper takes about 100.
        iterations: of Adam.
        seed: of the order of the samples.

    Raises:
        ValueError: no samples, or counts below one.
    """
    return fit_stencil(samples, sub_steps=sub_steps, iterations=iterations, seed=seed).stencil


def validate(stencil: FittedStencil, samples: Sequence[PressureSample]) -> StencilValidation:
    """Errors, residuals and convergence over sub-steps on samples that the fit should not have seen.

    Args:
        stencil: to be judged at its own number of sub-steps.
        samples: (system, rhs, exact q).
    """
    require(len(samples) > 0, "no samples", "one solved pressure problem or more")
    n = stencil.sub_steps
    places = np.unique(np.geomspace(1, 2 * n, 12).round().astype(int))
    plain = FittedStencil.jacobi(n)
    ours, theirs = (np.array([_judged(s, PressureSample(*x), n) for x in samples]) for s in (stencil, plain))
    curve_of = [
        np.array([np.mean([_judged(s, PressureSample(*x), int(k))[0] for x in samples]) for k in places])
        for s in (stencil, plain)
    ]
    return StencilValidation(
        ours[:, 0], ours[:, 1], theirs[:, 0], theirs[:, 1], places, curve_of[0], curve_of[1], stencil.converges_anywhere
    )


def _judged(stencil: FittedStencil, sample: PressureSample, sub_steps: int) -> tuple[float, float]:
    """Relative error of q and relative residual."""
    domain = stencil_domain(sample.system)
    rhs = np.asarray(sample.rhs, np.float64)
    q = recurrent_solve(stencil, domain, rhs, sub_steps)
    exact = domain.out_of_box(domain.without_constants(domain.into_box(np.asarray(sample.potential, np.float64))))
    error = math.sqrt(float(np.square(q - exact).sum() / np.square(exact).sum()))
    return error, relative_residual(domain, rhs, q)
