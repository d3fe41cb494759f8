"""Contact of rigid bodies: sequential impulses.

Each contact has an impulse along its normal that only pushes and one along the surface of at most friction times as
much (Coulomb); Gauss-Seidel over the contacts until none is violated (Catto 2005, "Iterative dynamics with temporal
coherence"). Bodies may close the gap that is left within the step but no more; impacts faster than gravity's gain in
two steps bounce with the restitution afterwards. Overlap is taken back by a second velocity that moves bodies but is
forgotten after the step (split impulse, Guendelman et al. 2003), so that it adds no energy. Bodies come to rest a small
gap apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

from fluidlift.physics.contact_search import Contacts

REST_GAP = 0.05
"""cells between bodies at rest: open enough for the film of liquid between them to carry pressure (faces that are open
by less than `boundaries.SMALLEST_OPENING` count as closed)"""
SLACK = 0.01
"""cells of overlap with the gap that are left alone"""
RECOVERY = 0.2
"""share of the overlap taken back per step"""
FASTEST_RECOVERY = 0.2
"""cells per step"""
SWEEPS = 60


@dataclass
class BodyMotion:
    """Velocities of b bodies and how they answer to impulses; changed by contacts."""

    center: Float[np.ndarray, "b 3"]
    """m, of mass"""
    velocity: Float[np.ndarray, "b 3"]
    """m/s"""
    spin: Float[np.ndarray, "b 3"]
    """rad/s"""
    inverse_mass: Float[np.ndarray, " b"]
    """1/kg; 0 for bodies whose motion is prescribed"""
    inverse_inertia: Float[np.ndarray, "b 3 3"]
    """1/(kg m^2), in the world's axes"""


@njit(cache=True)
def _prepare(first, second, points, normals, center, inverse_mass, inverse_inertia):
    """Per contact: normal and two tangents; the torque on both bodies of a unit impulse along each; their change of
    spin by it; softness along the normal; impulse per speed along the surface."""
    n = len(first)
    frames, levers, turns = np.empty((n, 3, 3)), np.zeros((n, 2, 3, 3)), np.zeros((n, 2, 3, 3))
    soft, across = np.zeros(n), np.empty(n)
    for c in range(n):
        m = normals[c]
        # the axis least along the normal gives the first tangent
        e = np.zeros(3)
        e[np.argmin(np.abs(m))] = 1.0
        t = e - m * (m[0] * e[0] + m[1] * e[1] + m[2] * e[2])
        t /= np.sqrt(t[0] * t[0] + t[1] * t[1] + t[2] * t[2])
        frames[c, 0], frames[c, 1] = m, t
        frames[c, 2] = np.array([m[1] * t[2] - m[2] * t[1], m[2] * t[0] - m[0] * t[2], m[0] * t[1] - m[1] * t[0]])
        softness = np.zeros((3, 3))
        for side in range(2):
            body = first[c] if side == 0 else second[c]
            if body < 0:
                continue
            sign = 1.0 if side == 0 else -1.0
            r = points[c] - center[body]
            for d in range(3):
                f = frames[c, d]
                levers[c, side, d, 0] = sign * (r[1] * f[2] - r[2] * f[1])
                levers[c, side, d, 1] = sign * (r[2] * f[0] - r[0] * f[2])
                levers[c, side, d, 2] = sign * (r[0] * f[1] - r[1] * f[0])
                for i in range(3):
                    for j in range(3):
                        turns[c, side, d, i] += inverse_inertia[body, i, j] * levers[c, side, d, j]
            for d in range(3):
                softness[d, d] += inverse_mass[body]
                for e_ in range(3):
                    for i in range(3):
                        softness[d, e_] += levers[c, side, d, i] * turns[c, side, e_, i]
        soft[c] = softness[0, 0]
        half, difference = 0.5 * (softness[1, 1] + softness[2, 2]), 0.5 * (softness[1, 1] - softness[2, 2])
        # the largest eigenvalue: one number for both tangents, or sliding friction would not oppose the velocity
        across[c] = 1.0 / (half + np.sqrt(difference * difference + softness[1, 2] * softness[1, 2]))
    return frames, levers, turns, soft, across


@njit(cache=True)
def _opening(c, d, first, second, frames, levers, velocity, spin):
    """Relative velocity of the two bodies along direction d of contact c."""
    a, b = first[c], second[c]
    out = 0.0
    for i in range(3):
        out += frames[c, d, i] * velocity[a, i] + levers[c, 0, d, i] * spin[a, i]
        if b >= 0:
            out += levers[c, 1, d, i] * spin[b, i] - frames[c, d, i] * velocity[b, i]
    return out


@njit(cache=True)
def _kick(c, d, impulse, first, second, frames, turns, inverse_mass, velocity, spin):
    """Both bodies after an impulse along direction d of contact c."""
    a, b = first[c], second[c]
    for i in range(3):
        velocity[a, i] += inverse_mass[a] * impulse * frames[c, d, i]
        spin[a, i] += impulse * turns[c, 0, d, i]
        if b >= 0:
            velocity[b, i] -= inverse_mass[b] * impulse * frames[c, d, i]
            spin[b, i] += impulse * turns[c, 1, d, i]


@njit(cache=True)
def _solve(first, second, frames, levers, turns, soft, across, closing, bounce, friction, tolerance, impulses,
           velocity, spin, inverse_mass):  # fmt: skip
    """Gauss-Seidel. `closing` m/s: how fast each gap may close; `bounce` m/s: speed to part with, 0 for none."""
    for _ in range(SWEEPS):
        worst = 0.0
        for c in range(len(first)):
            if friction[c] > 0.0:
                s = impulses[c, 1] - across[c] * _opening(c, 1, first, second, frames, levers, velocity, spin)
                t = impulses[c, 2] - across[c] * _opening(c, 2, first, second, frames, levers, velocity, spin)
                size, most = np.sqrt(s * s + t * t), friction[c] * impulses[c, 0]
                if size > most:
                    s, t = s * most / size, t * most / size
                _kick(c, 1, s - impulses[c, 1], first, second, frames, turns, inverse_mass, velocity, spin)
                _kick(c, 2, t - impulses[c, 2], first, second, frames, turns, inverse_mass, velocity, spin)
                worst = max(worst, (abs(s - impulses[c, 1]) + abs(t - impulses[c, 2])) * soft[c])
                impulses[c, 1], impulses[c, 2] = s, t
            away = _opening(c, 0, first, second, frames, levers, velocity, spin)
            wanted = bounce[c] if bounce[c] > 0.0 else -closing[c]
            more = max((wanted - away) / soft[c], -impulses[c, 0])
            impulses[c, 0] += more
            _kick(c, 0, more, first, second, frames, turns, inverse_mass, velocity, spin)
            worst = max(worst, abs(more) * soft[c])
        if worst <= tolerance:
            return


@njit(cache=True)
def _apply(first, second, frames, turns, impulses, inverse_mass, velocity, spin):
    for c in range(len(first)):
        for d in range(3):
            _kick(c, d, impulses[c, d], first, second, frames, turns, inverse_mass, velocity, spin)


@njit(cache=True)
def _openings(first, second, frames, levers, velocity, spin):
    """Speed (m/s) at which each contact opens."""
    out = np.empty(len(first))
    for c in range(len(first)):
        out[c] = _opening(c, 0, first, second, frames, levers, velocity, spin)
    return out


class ContactSolver:
    """The contacts of one step: first the impulses expected from the step before, later what is really needed.

    Args:
        contacts: of the present poses.
        motion: of the bodies; its velocities are changed.
    """

    def __init__(self, contacts: Contacts, motion: BodyMotion) -> None:
        self.contacts, self.motion = contacts, motion
        self._frames, self._levers, self._turns, self._soft, self._across = _prepare(
            contacts.first, contacts.second, contacts.points, contacts.normals, motion.center, motion.inverse_mass,
            motion.inverse_inertia,
        )  # fmt: skip
        self.impulses = np.zeros((len(contacts), 3))
        """N s along normal and tangents"""

    def expect(self, keys: Int[np.ndarray, " m"], impulses: Float[np.ndarray, "m 3"]) -> None:
        """Apply what the same contacts (by key) needed before: impulses in the world's axes, N s, pushing ones only.

        The liquid then feels a body at rest on the bed as one at rest, not as one that falls for a step.
        """
        c, m = self.contacts, self.motion
        found = np.searchsorted(keys, c.keys)
        known = found < len(keys)
        known[known] = keys[found[known]] == c.keys[known]
        old = np.zeros((len(c), 3))
        old[known] = impulses[found[known]]
        self.impulses = np.einsum("nij,nj->ni", self._frames, old)
        # where the normal has turned nothing pulls
        self.impulses[self.impulses[:, 0] <= 0] = 0.0
        _apply(c.first, c.second, self._frames, self._turns, self.impulses, m.inverse_mass, m.velocity, m.spin)

    def world_impulses(self) -> Float[np.ndarray, "n 3"]:
        """N s on the first body of each contact."""
        return np.einsum("nij,ni->nj", self._frames, self.impulses)

    def solve(
        self,
        friction: Float[np.ndarray, " n"],
        restitution: Float[np.ndarray, " n"],
        *,
        dt: float,
        spacing: float,
        gain: float,
    ) -> Bool[np.ndarray, " n"]:
        """Change the velocities so that nothing gets closer than the gap at rest; which contacts were impacts.

        Args:
            friction: Coulomb's coefficient of each contact.
            restitution: 0 to 1.
            dt: s.
            spacing: m, of the grid.
            gain: m/s that gravity adds in a step.
        """
        c, m = self.contacts, self.motion
        closing = np.maximum(c.gaps - REST_GAP * spacing, 0.0) / dt
        before = _openings(c.first, c.second, self._frames, self._levers, m.velocity, m.spin)
        impact = before < -2.0 * gain - 1e-9
        tolerance = 1e-5 * max(gain, float(np.abs(before).max(initial=0.0)))
        none = np.zeros(len(c))
        self._sweep(slice(None), closing, none, friction, tolerance, self.impulses, m.velocity, m.spin)
        bounce = np.where(impact & (self.impulses[:, 0] > 0), -restitution * before, 0.0)
        if (bounce > 0).any():
            self._sweep(slice(None), closing, bounce, friction, tolerance, self.impulses, m.velocity, m.spin)
        return impact

    def _sweep(
        self,
        index: slice | np.ndarray,
        closing: np.ndarray,
        bounce: np.ndarray,
        friction: np.ndarray,
        tolerance: float,
        impulses: np.ndarray,
        velocity: np.ndarray,
        spin: np.ndarray,
    ) -> None:
        """`_solve` on some of the contacts."""
        c = self.contacts
        _solve(
            c.first[index], c.second[index], self._frames[index], self._levers[index], self._turns[index],
            self._soft[index], self._across[index], closing, bounce, friction, tolerance, impulses, velocity, spin,
            self.motion.inverse_mass,
        )  # fmt: skip

    def recovery(self, *, dt: float, spacing: float) -> tuple[np.ndarray, np.ndarray]:
        """Velocities (m/s and rad/s, per body) that take back overlap with the gap at rest within this step."""
        velocity, spin = np.zeros_like(self.motion.velocity), np.zeros_like(self.motion.spin)
        overlap = (REST_GAP - SLACK) * spacing - self.contacts.gaps
        wanted = np.clip(RECOVERY * overlap, 0.0, FASTEST_RECOVERY * spacing) / dt
        index = np.flatnonzero(wanted > 0)
        if len(index):
            none, impulses = np.zeros(len(index)), np.zeros((len(index), 3))
            self._sweep(index, none, wanted[index], none, 1e-4 * float(wanted.max()), impulses, velocity, spin)
        return velocity, spin
