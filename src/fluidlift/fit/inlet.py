"""What the targets say about the inlet and the outlet: first values, and the pattern of the fluctuation."""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from fluidlift.fit.scene import FitScene
from fluidlift.types import FluidParameters


def boundary_prior(scene: FitScene, initial: FluidParameters) -> FluidParameters:
    """Inlet and outlet values read off the targets where `initial` gives none (paper: "reasonable initialization").

    Bulk inflow is the mean over inlet and time of each component, the fluctuation the root mean square about it, the
    outflow the mean speed through the outlet along the mainstream.
    """
    changes: dict[str, object] = {}
    values = scene.inflow_values()
    if any(d.inflow.any() for d in scene.domains):
        o = scene.domains[0].offsets
        parts = [values[:, o[a] : o[a + 1]] for a in range(3)]
        bulk = [float(np.nanmean(p)) if np.isfinite(p).any() else 0.0 for p in parts]
        if not any(initial.inflow_velocity):
            changes["inflow_velocity"] = tuple(bulk)
        if initial.inflow_fluctuation == 0:
            _, size, noise = _inflow_deviation(scene)
            changes["inflow_fluctuation"] = math.sqrt(max(size**2 - noise**2, 0.0))
    if initial.outflow_velocity == 0:
        through = []
        for flat, domain, seen in zip(scene.flat, scene.domains, scene.seen):
            at = (domain.outflow != 0) & seen
            if at.any():
                through.append(float((flat * domain.outflow)[at].sum() / (domain.outflow[at] ** 2).sum()))
        if through:
            changes["outflow_velocity"] = float(np.mean(through))
    return initial.updated(changes)


def inflow_patterns(scene: FitScene) -> tuple[Tensor | None, ...]:
    """Deviation of the inlet velocity from its bulk, per frame, for a fluctuation of one.

    Its root mean square is one where nothing is known about errors. Errors are taken out in two steps: where the change
    in time is no more than they explain, the mean over time is used; and what they still add to the size shrinks the
    pattern so that the fitted factor of it is the root mean square without them (least squares of s by a c (s + n),
    with a = |s|). None where the inlet is uniform and steady.
    """
    rest, size, noise = _inflow_deviation(scene)
    if size < 1e-6 * scene.speed or size <= noise:
        return (None,) * len(scene.targets)
    true = math.sqrt(size**2 - noise**2)
    return tuple(torch.from_numpy((row * true / size**2).astype(np.float32)) for row in rest)


def _inflow_deviation(scene: FitScene) -> tuple[Float[np.ndarray, "t f"], float, float]:
    """Inlet velocity less the mean of each component over inlet and time (0 off the inlet), its size, and its error.

    Sizes are those of the vector: the root of the components' mean squares added up.
    """
    values = scene.inflow_values()
    seen = np.isfinite(values)
    mean = np.where(seen, values, 0.0).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
    mean = np.where(seen.any(axis=0), mean, np.nan)
    about = np.where(seen, values - mean, 0.0)
    # errors alone change the inlet by this much about its mean over time
    steady = len(values) >= 3 and np.square(about).sum() < 2 * scene.noise**2 * max(int(seen.sum()), 1)
    values = np.broadcast_to(mean, values.shape) if steady else values
    o = scene.domains[0].offsets
    rest, power, errors = np.zeros(values.shape), 0.0, 0.0
    for a in range(3):
        part = values[:, o[a] : o[a + 1]]
        if np.isfinite(part).any():
            change = part - np.nanmean(part)
            power += float(np.nanmean(change**2))
            errors += scene.noise**2 / (len(values) if steady else 1)
            rest[:, o[a] : o[a + 1]] = np.nan_to_num(change)
    return rest, math.sqrt(power), math.sqrt(errors)


def fluctuation_error(scene: FitScene) -> dict[str, float]:
    """Standard deviation that errors of the inlet's pattern leave in the fitted fluctuation, m/s, by label.

    From |s + n|^2 - |n|^2 over m numbers: the cross term gives n / sqrt(m), the scatter of |n|^2 gives
    n^2 / (s sqrt(2 m)).
    """
    _, size, noise = _inflow_deviation(scene)
    m = max(int(np.isfinite(scene.inflow_values()).sum(axis=1).max()), 1)
    true = math.sqrt(max(size**2 - noise**2, 0.0))
    if noise == 0 or true == 0:
        return {}
    return {"inflow_fluctuation": math.hypot(noise, noise**2 / (math.sqrt(2) * true)) / math.sqrt(m)}
