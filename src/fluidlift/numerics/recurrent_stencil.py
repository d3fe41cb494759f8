"""The Poisson iteration as a recurrent convolution with fitted kernels (paper: PeRCNN; Rao, Sun, Liu 2021).

A sub-step passes the latents q (potential) and p (its last change) through one shared layer:

    r = S (b - A q)        second-order Laplacian (PDE-Net: a convolution with the weights of the boundary conditions)
    p = m_k p + w_k K r    K: 3x3x3 convolution over the unknown cells, one weight per kind of neighbour
    q = q + S p            S: one over the root of the diagonal of A, times gains of cells beside air and beside walls

Boundary conditions are input: open shares of faces, the mask of unknown cells, the shares of air and wall around each.
Fitted are K, the gains, and the relaxations w_k and momenta m_k, which repeat in a cycle; w = 0.9, m = 0, K = 1 is
Jacobi's method. Whatever they are, A q = b stays a fixed point, and the only one, since S K S is positive definite.

After n sub-steps from zero, q is a polynomial in S K S A applied to S K S b: a symmetric map. So the adjoint of the
whole recurrence is the recurrence itself on the incoming gradient, and nothing need be stored for it. On any domain
the eigenvalues of S K S A lie between 0 and `FittedStencil.bound`, so `amplification` proves convergence beforehand.
"""

from __future__ import annotations

import itertools
import weakref
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from fluidlift.errors import require
from fluidlift.numerics.poisson import PoissonSystem, label_components
from fluidlift.numerics.recurrent_stencil_kernels import convolved_sub_steps, diagonal_sub_steps, residual_squares

NEIGHBOUR_KINDS = ((1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, 1), (0, 1, 1), (1, 1, 1))
"""offsets up to sign: across faces, edges, corners"""
NEIGHBOUR_COUNTS = np.array([2.0 ** sum(kind) for kind in NEIGHBOUR_KINDS])
FORMAT_VERSION = 1
Operator = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class FittedStencil:
    """The recurrent layer's weights; dimensionless, so good for any spacing."""

    neighbours: Float[np.ndarray, "7"]
    """weights of K per `NEIGHBOUR_KINDS`; the centre has 1. Sizes add up to less than 1 over all 26 neighbours"""
    air_gain: float
    wall_gain: float
    """logarithms: how much more a cell surrounded by air, or by wall, answers"""
    relaxation: Float[np.ndarray, " m"]
    momentum: Float[np.ndarray, " m"]
    """one per sub-step of the cycle"""
    sub_steps: int
    """of one solve, for which it was fitted"""

    def __post_init__(self) -> None:
        require(self.neighbours.shape == (7,), f"neighbour weights {self.neighbours.shape}", "[7]")
        shape = self.relaxation.shape
        require(
            len(shape) == 1 and shape[0] > 0 and self.momentum.shape == shape, "schedules of two lengths", "[m], [m]"
        )
        require(self.sub_steps >= 1, f"{self.sub_steps} sub-steps", "at least one")
        total = float((NEIGHBOUR_COUNTS * np.abs(self.neighbours)).sum())
        require(total < 1, f"neighbour weights of sum {total}", "below 1, else the kernel may lose a direction")

    @classmethod
    def jacobi(cls, sub_steps: int, relaxation: float = 0.9) -> FittedStencil:
        """The plain sweep as a stencil."""
        return cls(np.zeros(7), 0.0, 0.0, np.array([relaxation]), np.zeros(1), sub_steps)

    def kernel(self) -> Float[np.ndarray, "3 3 3"]:
        """K."""
        out = np.zeros((3, 3, 3))
        for place in itertools.product(range(3), repeat=3):
            kind = tuple(abs(i - 1) for i in place)
            out[place] = self.neighbours[NEIGHBOUR_KINDS.index(kind)] if any(kind) else 1.0
        return out

    @property
    def bound(self) -> float:
        """No eigenvalue of S K S A is larger, on any domain: 2 for the scaled Laplacian, times the sizes of K and S."""
        sizes = 1 + float((NEIGHBOUR_COUNTS * np.abs(self.neighbours)).sum())
        return 2 * sizes * float(np.exp(2 * max(self.air_gain, self.wall_gain, 0.0)))

    def schedule(self, sub_steps: int) -> tuple[np.ndarray, np.ndarray]:
        """Relaxations and momenta of that many sub-steps."""
        turn = np.arange(sub_steps) % len(self.relaxation)
        return self.relaxation[turn], self.momentum[turn]

    def amplification(self, eigenvalues: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """What is left of the error's component of each eigenvalue of S K S A; below 1 on (0, bound]: converges."""
        error, change = np.ones_like(eigenvalues), np.zeros_like(eigenvalues)
        for w, m in zip(*self.schedule(self.sub_steps)):
            change = m * change - w * eigenvalues * error
            error = error + change
        return np.abs(error)

    @property
    def converges_anywhere(self) -> bool:
        """No component of the error grows over a solve, whatever the domain."""
        lowest, highest = np.geomspace(1e-6, 1, 2000), np.linspace(0, 1, 4001)[1:]
        samples = self.bound * np.concatenate([lowest, highest])
        # components that a solve does not reach stay as large as they were: 1 to rounding
        return bool((self.amplification(samples) <= 1 + 1e-9).all())

    def save(self, path: Path) -> None:
        """Plain arrays in an npz file."""
        with path.open("wb") as file:
            np.savez(file, version=FORMAT_VERSION, **vars(self))

    @classmethod
    def load(cls, path: Path) -> FittedStencil:
        """Read what `save` wrote.

        Raises:
            ValueError: another version, missing entries, or weights that are not allowed.
        """
        with np.load(path, allow_pickle=False) as file:
            names = {"neighbours", "air_gain", "wall_gain", "relaxation", "momentum", "sub_steps"}
            require(names | {"version"} <= set(file.files), f"{path.name} with {file.files}", f"{sorted(names)}")
            version = int(file["version"])
            require(version <= FORMAT_VERSION, f"stencil version {version}", f"at most {FORMAT_VERSION}")
            return cls(
                np.asarray(file["neighbours"], float), float(file["air_gain"]), float(file["wall_gain"]),
                np.asarray(file["relaxation"], float), np.asarray(file["momentum"], float), int(file["sub_steps"]),
            )  # fmt: skip


@dataclass(frozen=True, eq=False)
class StencilDomain:
    """Boundary conditions of a system as the input of the recurrent layer: a box around the unknown cells, with one
    layer of zeros around it."""

    shape: tuple[int, int, int]
    """of the system"""
    low: tuple[int, int, int]
    """first cell of the box"""
    scale: Float[np.ndarray, "a b c"]
    """one over the root of the diagonal of A, m; 0 off the unknown cells"""
    air: Float[np.ndarray, "a b c"]
    """share of the diagonal that leads to p = 0"""
    wall: Float[np.ndarray, "a b c"]
    """share of closed faces, of what `air` leaves"""
    weights: Float[np.ndarray, "3 a b c"]
    """-A towards the next cell along each axis, 1/m^2; 0 where one of the two is not unknown"""
    closed: np.ndarray
    """int64 [a,b,c]: number of the component without p = 0, -1 elsewhere"""
    scaled: dict[tuple, Operator] = field(default_factory=dict)
    """see `scaled_operator`"""

    @property
    def inside(self) -> np.ndarray:
        """bool [a,b,c]: unknown cells with an equation."""
        return self.scale > 0

    def into_box(self, values: np.ndarray) -> np.ndarray:
        """Cells of the system to the padded box; 0 off the unknown cells."""
        out = np.zeros(self.scale.shape, values.dtype)
        size = [n - 2 for n in out.shape]
        inner = tuple(slice(i, i + n) for i, n in zip(self.low, size))
        out[1:-1, 1:-1, 1:-1] = values[inner]
        out[~self.inside] = 0
        return out

    def out_of_box(self, values: np.ndarray) -> np.ndarray:
        """The reverse, 0 outside."""
        out = np.zeros(self.shape, values.dtype)
        size = [n - 2 for n in values.shape]
        out[tuple(slice(i, i + n) for i, n in zip(self.low, size))] = values[1:-1, 1:-1, 1:-1]
        return out

    def crop(self, values: Tensor) -> Tensor:
        """`into_box` for tensors, recorded; without the mask."""
        size = [n - 2 for n in self.scale.shape]
        inner = values[tuple(slice(i, i + n) for i, n in zip(self.low, size))]
        return torch.nn.functional.pad(inner, (1, 1) * 3)

    def uncrop(self, values: Tensor) -> Tensor:
        """`out_of_box` for tensors, recorded."""
        size = [n - 2 for n in self.scale.shape]
        ends = [(i, total - i - n) for i, n, total in zip(self.low, size, self.shape)]
        return torch.nn.functional.pad(values[1:-1, 1:-1, 1:-1], [end for pair in reversed(ends) for end in pair])

    def without_constants(self, values: np.ndarray) -> np.ndarray:
        """Values less their mean over each closed component."""
        if self.closed.max(initial=-1) < 0:
            return values
        at = self.closed >= 0
        group = self.closed[at]
        means = np.bincount(group, weights=values[at]) / np.maximum(np.bincount(group), 1)
        out = values.copy()
        out[at] -= means[group].astype(values.dtype)
        return out

    def scaled_operator(self, stencil: FittedStencil, dtype: np.dtype) -> Operator:
        """S, the diagonal of S A S, and minus its entries towards the next cell along each axis; kept for next time."""
        key = (stencil.air_gain, stencil.wall_gain, np.dtype(dtype).str)
        if key not in self.scaled:
            gain = np.exp(stencil.air_gain * self.air + stencil.wall_gain * self.wall)
            s = self.scale * gain
            diagonal = np.where(self.inside, gain**2, 0.0)
            couplings = np.stack([w * s * np.roll(s, -1, axis) for axis, w in enumerate(self.weights)])
            self.scaled[key] = (s.astype(dtype), diagonal.astype(dtype), couplings.astype(dtype))
        return self.scaled[key]


_known: dict[int, StencilDomain] = {}


def stencil_domain(system: PoissonSystem) -> StencilDomain:
    """The boundary conditions of a system, prepared once and kept as long as the system lives."""
    found = _known.get(id(system))
    if found is None:
        found = _known[id(system)] = _prepare(system)
        weakref.finalize(system, _known.pop, id(system), None)
    return found


def _prepare(system: PoissonSystem) -> StencilDomain:
    diagonal = system.diagonal()
    active = system.unknown & (diagonal > 0)
    places = np.nonzero(active)
    i, j, k = (int(p.min()) if p.size else 0 for p in places)
    low = (i, j, k)
    high = tuple(int(p.max()) + 1 if p.size else 1 for p in places)
    box = tuple(slice(a, b) for a, b in zip(low, high))

    def padded(values: np.ndarray) -> np.ndarray:
        return np.pad(values[box], 1)

    weights, shut, inner = [], np.zeros(active.shape), np.zeros(active.shape)
    for axis, w in enumerate(system.weights):
        w = np.moveaxis(np.asarray(w, float), axis, 0)
        both = np.moveaxis(active, axis, 0)
        link = np.zeros(both.shape)
        link[:-1] = np.where(both[:-1] & both[1:], w[1:-1], 0.0)
        back = np.concatenate([np.zeros_like(link[:1]), link[:-1]])
        inner += np.moveaxis(link + back, 0, axis)
        shut += np.moveaxis((w[1:] == 0).astype(float) + (w[:-1] == 0), 0, axis)
        weights.append(padded(np.moveaxis(link, 0, axis)) / system.spacing**2)
    total = np.where(active, diagonal, 1.0)
    air = np.where(active, np.clip(1 - inner / (total * system.spacing**2), 0, 1), 0.0)
    labels, is_closed = label_components(system)
    number = np.append(np.where(is_closed, np.cumsum(is_closed) - 1, -1), -1)
    closed = np.where(active, number[labels], -1)
    return StencilDomain(
        shape=active.shape,
        low=low,
        scale=padded(np.where(active, 1 / np.sqrt(total), 0.0)),
        air=padded(air),
        wall=padded(np.where(active, shut / 6 * (1 - air), 0.0)),
        weights=np.stack(weights),
        closed=np.pad(closed[box], 1, constant_values=-1),
    )


def recurrent_solve(
    stencil: FittedStencil, domain: StencilDomain, rhs: Float[np.ndarray, "nx ny nz"], sub_steps: int | None = None
) -> Float[np.ndarray, "nx ny nz"]:
    """q after the sub-steps, from zero: fast, of the number type of `rhs`, linear and symmetric in it."""
    dtype = rhs.dtype
    s, diagonal, couplings = domain.scaled_operator(stencil, dtype)
    b = s * domain.without_constants(domain.into_box(rhs))
    relaxation, momentum = (v.astype(dtype) for v in stencil.schedule(sub_steps or stencil.sub_steps))
    if stencil.neighbours.any():
        weights = stencil.neighbours.astype(dtype)
        inside = domain.inside.astype(dtype)
        x = convolved_sub_steps(b, diagonal, couplings, inside, weights, relaxation, momentum)
    else:
        x = diagonal_sub_steps(b, diagonal, couplings, relaxation, momentum)
    return domain.out_of_box(domain.without_constants(s * x))


def relative_residual(
    domain: StencilDomain, rhs: Float[np.ndarray, "nx ny nz"], q: Float[np.ndarray, "nx ny nz"]
) -> float:
    """|b - A q| / |b|, where b is rhs without what no q can answer; 0 for b = 0."""
    b = domain.without_constants(domain.into_box(rhs))
    scale = domain.scale.astype(b.dtype)
    total, left = residual_squares(b, scale, domain.weights.astype(b.dtype), domain.into_box(q))
    return float(np.sqrt(left / total)) if total > 0 else 0.0


@dataclass(frozen=True)
class LayerWeights:
    """The stencil as tensors, with or without gradients."""

    kernel: Float[Tensor, "3 3 3"]
    air_gain: Tensor
    wall_gain: Tensor
    relaxation: Float[Tensor, " m"]
    momentum: Float[Tensor, " m"]

    @classmethod
    def of(cls, stencil: FittedStencil, dtype: torch.dtype, device: torch.device | str = "cpu") -> LayerWeights:
        """Constants."""
        values = (stencil.kernel(), stencil.air_gain, stencil.wall_gain, stencil.relaxation, stencil.momentum)
        return cls(*(torch.as_tensor(np.asarray(v), dtype=dtype, device=device) for v in values))


@dataclass(frozen=True)
class LayerInput:
    """Boundary conditions of one domain, or of several in boxes of one size, as tensors [..., a, b, c]."""

    scale: Tensor
    air: Tensor
    wall: Tensor
    weights: Tensor
    """[3, ..., a, b, c]"""

    @classmethod
    def of(cls, domain: StencilDomain, dtype: torch.dtype, device: torch.device | str = "cpu") -> LayerInput:
        """One domain."""
        values = (domain.scale, domain.air, domain.wall, domain.weights)
        return cls(*(torch.as_tensor(v, dtype=dtype, device=device) for v in values))


def recurrent_layers(
    weights: LayerWeights, conditions: LayerInput, b: Float[Tensor, "*n a b c"], sub_steps: int
) -> Float[Tensor, "*n a b c"]:
    """q after the sub-steps as torch records them: the plain twin of `recurrent_solve`, differentiable in all it takes.

    Each sub-step keeps its latents until `backward`. Closed components are the caller's business.
    """
    inside = conditions.scale > 0
    gain = torch.exp(weights.air_gain * conditions.air + weights.wall_gain * conditions.wall)
    s, diagonal = conditions.scale * gain, gain**2 * inside
    couplings = [w * s * s.roll(-1, axis - 3) for axis, w in enumerate(conditions.weights)]
    kernel = weights.kernel[None, None]
    # K = 1, as in Jacobi's sweep, needs no convolution
    plain = not weights.kernel.requires_grad and int(torch.count_nonzero(weights.kernel)) == 1
    source = s * b
    x, p = torch.zeros_like(b), torch.zeros_like(b)
    for k in range(sub_steps):
        r = source - diagonal * x
        for axis, c in enumerate(couplings):
            r = r + c * x.roll(-1, axis - 3) + (c * x).roll(1, axis - 3)
        if not plain:
            flat = r.reshape(-1, 1, *r.shape[-3:])
            r = torch.nn.functional.conv3d(flat, kernel, padding=1).reshape(r.shape) * inside
        turn = k % len(weights.relaxation)
        p = weights.momentum[turn] * p + weights.relaxation[turn] * r
        x = x + p
    return s * x
