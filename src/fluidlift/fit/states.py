"""What a window starts from: a whole, divergence-free velocity out of targets with noise and hidden cells.

Noise is estimated from differences of targets in time, hidden faces are filled smoothly from seen ones, neighbouring
frames are averaged by a local line, and the layout's projection takes out the divergence.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fluidlift.physics.rollout_domain import RolloutDomain
from fluidlift.physics.rollout_pressure import RolloutOptions, project
from fluidlift.types import CellType

DIFFERENCES = ((1.0, -1.0), (1.0, -2.0, 1.0), (1.0, -3.0, 3.0, -1.0))
"""weights over consecutive frames that a steady, a linear and a quadratic change in time do not pass"""
FILL_SWEEPS = 30
"""Jacobi sweeps of each level of the fill"""
COARSEST = 3
"""faces: the fill's coarsest level is not smaller"""


def seen_faces(domain: RolloutDomain, cell_types: np.ndarray, observed: np.ndarray | None) -> Bool[np.ndarray, " f"]:
    """Open faces whose velocity was seen: those of observed cells with fluid in them."""
    is_open = domain.dynamic | (domain.inflow > 0)
    if observed is None:
        return is_open
    wet = domain.system.unknown | np.isin(cell_types, (CellType.INFLOW, CellType.OUTFLOW))
    cells = np.asarray(observed, bool) & wet
    parts = []
    for axis in range(3):
        wide = np.pad(cells, [(int(a == axis),) * 2 for a in range(3)])
        n = cells.shape[axis]
        parts.append((np.take(wide, range(n + 1), axis) | np.take(wide, range(1, n + 2), axis)).ravel())
    return is_open & np.concatenate(parts)


def noise_of(
    frames: Sequence[Float[np.ndarray, " f"]], seen: Sequence[Bool[np.ndarray, " f"]], firsts: Sequence[int] = (0,)
) -> float:
    """Standard deviation of the error of a face that is independent from frame to frame, m/s.

    The smallest of the root mean square differences of first to third order in time, each scaled to what independent
    errors would give: a change of the flow itself only raises it. 0 for one frame. Frames on both sides of one of
    `firsts`, with which another stretch of time begins, are not compared.
    """
    found = []
    for weights in DIFFERENCES:
        n = len(weights)
        total, count = 0.0, 0
        for t in range(len(frames) - n + 1):
            if any(t < first < t + n for first in firsts):
                continue
            all_seen = np.logical_and.reduce(seen[t : t + n])
            difference = np.zeros(len(all_seen))
            for w, f in zip(weights, frames[t : t + n]):
                difference += w * np.asarray(f, float)
            total += float(np.square(difference[all_seen]).sum())
            count += int(all_seen.sum())
        if count:
            found.append((total / count / sum(w * w for w in weights)) ** 0.5)
    return min(found, default=0.0)


def smooth_in_time(
    frames: Sequence[Float[np.ndarray, " f"]],
    seen: Sequence[Bool[np.ndarray, " f"]],
    at: int,
    *,
    within: range | None = None,
) -> tuple[Float[np.ndarray, " f"], Bool[np.ndarray, " f"]]:
    """Value at frame `at` of the straight line through two frames on either side, face by face.

    Faces seen less than three times take their mean. The second result marks faces seen at all. `within` are the frames
    that follow each other there; None: all.
    """
    near = [t for t in range(at - 2, at + 3) if t in (within or range(len(frames)))]
    m = np.stack([seen[t] for t in near]).astype(float)
    y = np.stack([np.asarray(frames[t], float) for t in near])
    x = np.array([t - at for t in near], float)[:, None]
    count = m.sum(axis=0)
    some = np.maximum(count, 1.0)
    middle, mean = (m * x).sum(axis=0) / some, np.where(m > 0, y, 0.0).sum(axis=0) / some
    spread = (m * (x - middle) ** 2).sum(axis=0)
    tilt = (m * (x - middle) * np.where(m > 0, y, 0.0)).sum(axis=0)
    slope = np.where((count >= 3) & (spread > 0), tilt / np.maximum(spread, 1e-12), 0.0)
    return mean - slope * middle, count > 0


def _fill(values: np.ndarray, known: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Harmonic on unknown entries inside, from coarse to fine; entries outside neither give nor take."""
    out = np.where(known, values, 0.0)
    if known.all() or not known.any():
        return out
    if min(values.shape) > COARSEST:
        pad = [(0, n % 2) for n in values.shape]
        nx, ny, nz = ((n + 1) // 2 for n in values.shape)

        def blocks(a: np.ndarray) -> np.ndarray:
            return np.pad(a, pad).reshape(nx, 2, ny, 2, nz, 2)

        count = blocks(known.astype(float)).sum(axis=(1, 3, 5))
        mean = blocks(out).sum(axis=(1, 3, 5)) / np.maximum(count, 1.0)
        rough = _fill(mean, count > 0, np.asarray(blocks(inside).any(axis=(1, 3, 5))))
        wide = rough.repeat(2, 0).repeat(2, 1).repeat(2, 2)
        out = np.where(known, out, wide[tuple(slice(n) for n in values.shape)])
    else:
        out = np.where(known, out, out[known].mean())
    count = _neighbours(np.pad(inside.astype(float), 1))
    still, mean = known | (count == 0), np.maximum(count, 1.0)
    wide = np.zeros([n + 2 for n in values.shape])
    box = wide[1:-1, 1:-1, 1:-1]
    for _ in range(FILL_SWEEPS):
        box[...] = np.where(inside, out, 0.0)
        out = np.where(still, out, _neighbours(wide) / mean)
    return out


def _neighbours(wide: np.ndarray) -> np.ndarray:
    """Sum of the six neighbours of each entry, of an array with a border of one."""
    total = np.zeros([n - 2 for n in wide.shape])
    for axis in range(3):
        for side in (slice(2, None), slice(None, -2)):
            total += wide[tuple(side if a == axis else slice(1, -1) for a in range(3))]
    return total


def fill_hidden(
    flat: Float[np.ndarray, " f"], seen: Bool[np.ndarray, " f"], domain: RolloutDomain
) -> Float[np.ndarray, " f"]:
    """Open faces that were not seen take a smooth continuation of their component; values there do not matter."""
    is_open = domain.dynamic | (domain.inflow > 0)
    o, out = domain.offsets, []
    for axis, shape in enumerate(domain.face_shapes):
        part = slice(o[axis], o[axis + 1])
        inside = is_open[part].reshape(shape)
        filled = _fill(flat[part].reshape(shape), seen[part].reshape(shape), inside)
        out.append(np.where(inside, filled, 0.0).ravel())
    return np.concatenate(out)


def divergence_free(flat: Tensor, domain: RolloutDomain, options: RolloutOptions) -> Tensor:
    """The layout's projection of an open-face velocity; differentiable."""
    is_open = torch.from_numpy((domain.dynamic | (domain.inflow > 0)).astype(np.float32)).to(flat.dtype)
    return project(flat * is_open, domain, options=options)
