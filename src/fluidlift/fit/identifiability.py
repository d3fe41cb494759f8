"""How well the data determine each parameter, from the curvature of the loss at its minimum.

The loss L = sum of r^2 is turned into a log likelihood by its own size at the minimum: N effective observations with
the noise that the remaining residual shows, so -log p = N / (2 L) sum of r^2 + prior. With J = dr / d raw and prior
widths s, the covariance of the raw variables is (N / L J^T J + diag(1 / s^2))^-1 (Gauss-Newton, Laplace).

Targets come from pictures: neighbouring cells share their errors, and so do windows of a steady flow. N is the number
of cells reduced by the correlation seen in the residual itself, so a misfit of the model (which is smooth in space)
widens the uncertainty instead of hiding it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float

from fluidlift.fit.ranges import UNITS, FittedParameter, ParameterSpace
from fluidlift.types import Estimate

IDENTIFIABLE_BELOW = 0.5
"""share of the prior's standard deviation below which the data are said to determine a parameter"""
EXCLUDED_BEYOND = 2.5
"""posterior standard deviations between the minimum and the prior beyond which the prior is excluded"""
MODEL_ERROR = 0.01
"""root mean square misfit, relative to U, that no fit is trusted beyond (discretisation)"""


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
    power = np.sqrt((a[both] ** 2).sum() * (b[both] ** 2).sum())
    return float((a[both] * b[both]).sum() / power) if power > 0 else 0.0


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
        field = r / np.sqrt(np.where(w > 0, w, 1.0))[..., None]
        count = 3.0 * w.sum() ** 2 / (w**2).sum()
        for axis in range(3):
            rho = min(max(_lag_correlation(field, w > 0, axis), 0.0), 0.98)
            count *= (1 - rho) / (1 + rho)
        counts.append(count)
    m = len(residuals)
    if m > 1:
        stack = np.stack([r.ravel() for r in residuals])
        stack = stack / np.maximum(np.linalg.norm(stack, axis=1, keepdims=True), 1e-300)
        products = stack @ stack.T
        between = min(max(float(products[~np.eye(m, dtype=bool)].mean()), 0.0), 1.0)
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

    @property
    def precision_per_loss(self) -> float:
        """N / L: turns the loss into twice a negative log likelihood."""
        return self.observations / noise_level(self.loss)

    def covariance(self, prior_sigma: Float[np.ndarray, "p"], fitted: Bool[np.ndarray, "p"]) -> np.ndarray:
        """[f,f] covariance of the fitted raw variables, the others held."""
        data = self.precision_per_loss * self.normal[np.ix_(fitted, fitted)]
        return np.linalg.inv(data + np.diag(1 / prior_sigma[fitted] ** 2))


def determined(
    curvature: Curvature, prior_sigma: Float[np.ndarray, "p"], displacement: Float[np.ndarray, "p"] | None = None
) -> Bool[np.ndarray, "p"]:
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
        if ratio.max() < IDENTIFIABLE_BELOW:
            break
        keep[np.flatnonzero(keep)[ratio.argmax()]] = False
    return keep


def _estimate(parameter: FittedParameter, raw: float, sigma: float, identifiable: bool) -> Estimate:
    fitted = float(parameter.range.physical(torch.tensor(raw, dtype=torch.float64)))
    return Estimate(
        value=fitted if identifiable else parameter.prior,
        sigma=sigma * parameter.range.slope(raw) if np.isfinite(sigma) else float("inf"),
        identifiable=identifiable,
        prior=parameter.prior,
        unit=UNITS[parameter.name],
    )


def estimates(
    space: ParameterSpace,
    raw: Float[np.ndarray, "p"],
    keep: Bool[np.ndarray, "p"],
    *,
    everything: Curvature,
    kept: Curvature,
) -> dict[str, Estimate]:
    """Value and standard deviation per parameter, by label (`gravity_z`, `restitution`, ...).

    Identifiable ones: uncertainty with the undetermined ones held at their prior. Undetermined ones: their prior, with
    the uncertainty that they have when everything is free (inf where no data depend on them). Fixed ones: inf.

    Args:
        space: of all fitted parameters.
        raw: their values.
        keep: which the data determine.
        everything: curvature where all were free.
        kept: curvature at the end, of the same size; only the kept block is used.
    """
    sigma = np.full(len(raw), np.inf)
    felt = np.diag(everything.normal) > 0
    if felt.any():
        sigma[felt] = np.sqrt(np.diag(everything.covariance(space.prior_sigma, felt)))
    if keep.any():
        sigma[keep] = np.sqrt(np.diag(kept.covariance(space.prior_sigma, keep)))
    out = {}
    for i, parameter in enumerate(space.fitted):
        value = float(raw[i]) if keep[i] else parameter.prior_raw
        out[parameter.label] = _estimate(parameter, value, float(sigma[i]), bool(keep[i]))
    for fixed in space.fixed:
        out[fixed.label] = Estimate(fixed.value, float("inf"), False, fixed.value, UNITS[fixed.name])
    return out
