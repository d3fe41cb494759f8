"""Is a frame of particles sound, and does it continue the one before? Words, not exceptions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fluidlift.types import Gaussians

FAR = 0.05
"""of the body's diagonal: farther than this beyond its own speed a particle does not get in a frame"""
SPEEDS = 4.0
"""times the larger of a particle's speeds before and after that it may have had between them, as in a splash"""
ODD = 1e-3
"""share of such jumps that is let pass. Simulated rivers, jets and smoke have none"""
FLATTEST = 3e3
"""ratio of a Gaussian's longest to its shortest axis: its square is what single precision can still tell from flat"""


class ParticleFrame(NamedTuple):
    """What is compared between frames."""

    ids: np.ndarray
    """[n]"""
    positions: np.ndarray
    """[n,3]"""
    velocities: np.ndarray
    """[n,3], positions' units per second"""


def repeated(ids: np.ndarray) -> int:
    """How many ids occurred before; in rising order, as they are written, there is nothing to sort."""
    steps = np.diff(ids)
    return 0 if (steps > 0).all() else int((np.diff(np.sort(ids)) == 0).sum())


def particle_faults(now: ParticleFrame) -> list[str]:
    """Ids that occur twice, and numbers that are not finite."""
    faults = []
    if twice := repeated(now.ids):
        faults.append(f"{twice} ids that occur twice")
    for name in ("positions", "velocities"):
        bad = int((~np.isfinite(getattr(now, name)).all(axis=1)).sum())
        if bad:
            faults.append(f"{bad} {name} that are not finite")
    return faults


def identity_faults(before: ParticleFrame, now: ParticleFrame, seconds: float) -> list[str]:
    """Whether an id names the same particle in both frames: it is where its velocity can have brought it.

    Args:
        before: finite, with unique ids.
        now: the same, `seconds` later.
        seconds: between them.
    """
    if not len(before.ids) or not len(now.ids):
        return []
    _, a, b = np.intersect1d(before.ids, now.ids, assume_unique=True, return_indices=True)
    if not len(a):
        return ["no id of the frame before, as if all particles were new"]
    moved = np.linalg.norm(now.positions[b] - before.positions[a], axis=1)
    speed = np.maximum(np.linalg.norm(before.velocities[a], axis=1), np.linalg.norm(now.velocities[b], axis=1))
    size = float(np.linalg.norm(np.ptp(before.positions, axis=0)))
    jumps = int((moved - SPEEDS * speed * seconds > FAR * size).sum()) if size > 0 else 0
    if jumps > ODD * len(a):
        return [f"{jumps} of {len(a)} ids that jump to where their velocity cannot have brought them"]
    return []


def gaussian_faults(g: Gaussians) -> list[str]:
    """Opacities and scales outside their ranges; covariances that are not positive definite in single precision.

    A Gaussian's eigenvalues are the squares of its scales, so nothing needs to be decomposed.
    """
    if not len(g):
        return []
    faults = []
    for name in ("means", "quats", "scales", "opacities", "sh"):
        if not np.isfinite(getattr(g, name)).all():
            faults.append(f"{name} that are not finite")
    if g.opacities.min() < 0 or g.opacities.max() > 1:
        faults.append("opacities outside 0 to 1")
    shortest, longest = g.scales.min(axis=1), g.scales.max(axis=1)
    flat = int((~((np.square(shortest) > np.finfo(np.float32).tiny) & (longest < FLATTEST * shortest))).sum())
    if flat:
        faults.append(f"{flat} covariances that are not positive definite")
    return faults
