"""How well the data determine each parameter, from the curvature of the loss at its minimum.

The loss L = sum of r^2 is turned into a log likelihood by its own size at the minimum: N effective observations with
the noise that the remaining residual shows, so -log p = N / (2 L) sum of r^2 + prior. With J = dr / d raw and prior
widths s, H = N / L J^T J + diag(1 / s^2) and the covariance of the raw variables is H^-1 (Gauss-Newton, Laplace).

Targets come from pictures: neighbouring cells share their errors, and so do windows of a steady flow. N is the number
of cells reduced by the correlation seen in the residual itself, so a misfit of the model (which is smooth in space)
widens the uncertainty instead of hiding it. Beside it stands the cluster-robust covariance H^-1 M H^-1 (White 1980;
Liang & Zeger 1986), M the scatter of what blocks of cells, over all times, contribute to the gradient: it knows where
the errors are and how they are tied within a block. The wider of the two is reported.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import special

from fluidlift.fit.ranges import UNITS, ParameterSpace
from fluidlift.types import Estimate

DETERMINED_BELOW = 0.8
"""share of the prior's standard deviation below which the data are said to determine a parameter. What is held at its
prior instead pulls those tied to it away from the minimum, so a little knowledge is used"""
BLOCK = 4
"""cells along a side of a block whose errors are taken as tied"""
EXCLUDED_BEYOND = 2.5
"""posterior standard deviations between the minimum and the prior beyond which the prior is excluded"""
MODEL_ERROR = 0.001
"""root mean square misfit, relative to U, that no fit is trusted beyond (single precision, pressure to a tolerance)"""


def noise_level(loss: float) -> float:
    """The loss that noise alone would leave: the loss found, but not below `MODEL_ERROR`."""
    return max(loss, MODEL_ERROR**2)


def _lag_correlation(field: np.ndarray, inside: np.ndarray, axis: int) -> float:
    """Correlation of neighbours along `axis`, of a vector field on the marked cells."""
    n = field.shape[axis]
    if n < 2:
        return 0.0
    a, b = np.take(field, range(n - 1), axis), np.take(field, range(1, n), axis)
    both = np.take(inside, range(n - 1), axis) & np.take(inside, range(1, n), axis)
    if both.sum() < 8:
        return 0.0
    a, b = a[both], b[both]
    power = np.sqrt(np.square(a, dtype=float).sum() * np.square(b, dtype=float).sum())
    return float((a * b).sum(dtype=float) / power) if power > 0 else 0.0


def effective_observations(
    residuals: list[Float[np.ndarray, "nx ny nz k"]], masks: list[Float[np.ndarray, "nx ny nz"]]
) -> float:
    """Number of independent numbers that the residuals amount to.

    Weighted cells count (sum w)^2 / sum w^2; each axis reduces that by (1 - r) / (1 + r), r the correlation of
    neighbours (first-order autoregression); m windows whose residuals correlate by r count as m / (1 + (m - 1) r).

    Args:
        residuals: magnitude terms per window, three per cell.
        masks: weights of the cells.
    """
    counts = []
    for r, w in zip(residuals, masks):
        # the mask's root is in the residual: undone, so that weights do not pass for structure
        field = r / np.sqrt(np.where(w > 0, w, np.ones_like(w)))[..., None]
        count = 3.0 * w.sum(dtype=float) ** 2 / np.square(w, dtype=float).sum()
        for axis in range(3):
            rho = min(max(_lag_correlation(field, w > 0, axis), 0.0), 0.98)
            count *= (1 - rho) / (1 + rho)
        counts.append(count)
    m = len(residuals)
    if m > 1:
        # sum over pairs of unit vectors, from the size of their sum
        sizes = [float(np.square(r, dtype=float).sum()) ** 0.5 for r in residuals]
        total = sum((r / size for r, size in zip(residuals, sizes) if size > 0), np.zeros_like(residuals[0]))
        pairs = float(np.square(total, dtype=float).sum()) - sum(size > 0 for size in sizes)
        between = min(max(pairs / (m * (m - 1)), 0.0), 1.0)
    else:
        between = 0.0
    return max(float(np.mean(counts)) * m / (1 + (m - 1) * between), 3.0)


@dataclass(frozen=True)
class Curvature:
    """The quadratic model of the loss at the minimum."""

    normal: Float[np.ndarray, "p p"]
    """J^T J"""
    loss: float
    """sum of r^2"""
    observations: float
    """N"""

    scatter: Float[np.ndarray, "p p"] | None = None
    """sum over blocks of g g^T, g the block's part of J^T r, corrected for their number; None: unknown"""

    @property
    def precision_per_loss(self) -> float:
        """N / L: turns the loss into twice a negative log likelihood."""
        return self.observations / noise_level(self.loss)

    def covariance(self, prior_sigma: Float[np.ndarray, " p"], fitted: Bool[np.ndarray, " p"]) -> np.ndarray:
        """[f,f] covariance of the fitted raw variables, the others held."""
        part, prior = np.ix_(fitted, fitted), np.diag(1 / prior_sigma[fitted] ** 2)
        laplace = np.linalg.inv(self.precision_per_loss * self.normal[part] + prior)
        if self.scatter is None:
            return laplace
        robust = laplace @ (self.precision_per_loss**2 * self.scatter[part] + prior) @ laplace
        wider = np.sqrt(np.maximum(np.diag(laplace) / np.maximum(np.diag(robust), 1e-300), 1.0))
        return robust * np.outer(wider, wider)

    def covariance_beside(
        self, prior_sigma: Float[np.ndarray, " p"], fitted: Bool[np.ndarray, " p"], held: Bool[np.ndarray, " p"]
    ) -> np.ndarray:
        """[f,f] covariance of the fitted raw variables where others are held at priors that may be wrong.

        An error e of the held ones moves the minimum of the others by -(A_ff + P)^-1 A_fh e, with A the precision of
        the data and P that of the priors; e is as large as its prior allows.
        """
        covariance = self.covariance(prior_sigma, fitted)
        if not held.any():
            return covariance
        data = self.precision_per_loss * self.normal
        stiff = data[np.ix_(fitted, fitted)] + np.diag(1 / prior_sigma[fitted] ** 2)
        moved = np.linalg.solve(stiff, data[np.ix_(fitted, held)] * prior_sigma[held])
        return covariance + moved @ moved.T


def block_scatter(
    parts: list[tuple[Float[np.ndarray, "p n"], Float[np.ndarray, " n"], Int[np.ndarray, " n"]]], parameters: int
) -> Float[np.ndarray, "p p"]:
    """Sum of g g^T over blocks, g = J^T r of a block less the mean, for a Gaussian reading of its square root.

    B blocks and p parameters: B / (B - p) for the freedom that the fit took, and the square of Student's quantile of
    B - p degrees over the normal one, since the scatter itself is an estimate.

    Args:
        parts: columns of J, residuals and number of the block, per row; a number means the same block in all parts.
        parameters: p.
    """
    count = 1 + max(int(block.max()) for _, _, block in parts)
    sums, used = np.zeros((count, parameters)), np.zeros(count, bool)
    for columns, rest, block in parts:
        for p in range(parameters):
            sums[:, p] += np.bincount(block, weights=columns[p].astype(float) * rest, minlength=count)
        used |= np.bincount(block, weights=rest**2, minlength=count) > 0
    sums = sums[used] - sums[used].mean(axis=0)
    freedom = max(len(sums) - parameters, 2)
    student = special.stdtrit(freedom, 0.975) / special.ndtri(0.975)  # Student's over the normal quantile
    return student**2 * len(sums) / freedom * np.einsum("bi,bj->ij", sums, sums)


def determined(
    curvature: Curvature, prior_sigma: Float[np.ndarray, " p"], displacement: Float[np.ndarray, " p"] | None = None
) -> Bool[np.ndarray, " p"]:
    """Which raw variables the data determine: clearly narrower than the prior, or clearly not at the prior.

    Where two variables are tied, each alone is undetermined, but fixing one determines the other. So the worst one is
    given up first and the rest judged again.

    Args:
        curvature: of all variables.
        prior_sigma: widths of the priors.
        displacement: raw distance of the minimum from the prior's centre. More than `EXCLUDED_BEYOND` posterior widths
            mean that the data exclude the prior, even where they only bound the variable loosely.
    """
    moved = np.zeros(len(prior_sigma)) if displacement is None else np.abs(displacement)
    keep = np.diag(curvature.normal) > 0
    while keep.any():
        sigma = np.sqrt(np.diag(curvature.covariance(prior_sigma, keep)))
        ratio = np.where(moved[keep] > EXCLUDED_BEYOND * sigma, 0.0, sigma / prior_sigma[keep])
        if ratio.max() < DETERMINED_BELOW:
            break
        keep[np.flatnonzero(keep)[ratio.argmax()]] = False
    return keep


def precise(
    space: ParameterSpace, raw: Float[np.ndarray, " p"], sigma: Float[np.ndarray, " p"], within: float
) -> Bool[np.ndarray, " p"]:
    """Which variables are known to `within` of their value (components: of the size); `sigma` is physical."""
    values = [float(f.range.physical(torch.tensor(x, dtype=torch.float64))) for f, x in zip(space.fitted, raw)]
    size: dict[str, float] = {}
    for f, value in zip(space.fitted, values):
        size[f.name] = math.hypot(size.get(f.name, 0.0), value)
    for f in space.fixed:
        if f.component is not None and f.name in size:
            size[f.name] = math.hypot(size[f.name], f.value)
    return np.array([s <= within * size[f.name] for f, s in zip(space.fitted, sigma)], bool)


def estimates(
    space: ParameterSpace,
    raw: Float[np.ndarray, " p"],
    keep: Bool[np.ndarray, " p"],
    curvature: Curvature,
    *,
    also: dict[str, float] | None = None,
    within: float = math.inf,
) -> dict[str, Estimate]:
    """Value and standard deviation per parameter, by label (`gravity_z`, `restitution`, ...).

    Determined ones: the fitted value, and its uncertainty with the undetermined ones held at their prior, right or
    wrong; identifiable where that is precise. Undetermined ones: their prior, with the uncertainty that they have when
    everything is free (inf where no data depend on them). Fixed ones: inf.

    Args:
        space: of all fitted parameters.
        raw: their values.
        keep: which the data determine.
        curvature: at the end.
        also: physical standard deviations from elsewhere, by label, added in squares.
        within: relative standard deviation up to which a determined one is called identifiable.
    """
    sigma = np.full(len(raw), np.inf)
    felt = np.diag(curvature.normal) > 0
    for some, held in ((felt, ~felt), (keep & felt, felt & ~keep)):
        if some.any():
            sigma[some] = np.sqrt(np.diag(curvature.covariance_beside(space.prior_sigma, some, held & felt)))
    slopes = np.array([f.range.slope(float(x)) for f, x in zip(space.fitted, raw)])
    more = np.array([(also or {}).get(f.label, 0.0) for f in space.fitted])
    physical = np.where(np.isfinite(sigma), np.hypot(np.where(np.isfinite(sigma), sigma, 0) * slopes, more), np.inf)
    sure = keep & precise(space, raw, physical, within) if math.isfinite(within) else keep
    out = {}
    for i, parameter in enumerate(space.fitted):
        fitted = float(parameter.range.physical(torch.tensor(float(raw[i]), dtype=torch.float64)))
        out[parameter.label] = Estimate(
            value=fitted if keep[i] else parameter.prior,
            sigma=float(physical[i]),
            identifiable=bool(sure[i]),
            prior=parameter.prior,
            unit=UNITS[parameter.name],
        )
    for fixed in space.fixed:
        out[fixed.label] = Estimate(fixed.value, float("inf"), False, fixed.value, UNITS[fixed.name])
    return out
