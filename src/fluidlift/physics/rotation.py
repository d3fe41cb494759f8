"""Rotations of rigid bodies: quaternions (w, x, y, z) and their motion."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numba import njit

LARGEST_TURN = 0.1
"""rad per step of the integration of a free rotation"""


def product(a: Float[np.ndarray, "*n 4"], b: Float[np.ndarray, "*n 4"]) -> Float[np.ndarray, "*n 4"]:
    """Quaternion a b (w, x, y, z): first b, then a."""
    aw, ax, ay, az = np.moveaxis(np.asarray(a, np.float64), -1, 0)
    bw, bx, by, bz = np.moveaxis(np.asarray(b, np.float64), -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def rotation_by(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4"]:
    """Quaternion of the rotation about `vector` by its length (rad)."""
    angle = float(np.sqrt(np.square(vector).sum()))
    # sin(x/2)/x without a division by zero
    return np.concatenate([[np.cos(0.5 * angle)], 0.5 * np.sinc(0.5 * angle / np.pi) * np.asarray(vector)])


def rotation_vector(quat: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3"]:
    """Axis times angle (rad, at most pi) of a unit quaternion."""
    q = np.asarray(quat, np.float64)
    q = -q if q[0] < 0 else q
    size = float(np.sqrt(np.square(q[1:]).sum()))
    if size < 1e-12:
        return 2.0 * q[1:]
    return 2.0 * np.arctan2(size, q[0]) / size * q[1:]


@njit(cache=True)
def _rate(q, momentum, inverse_inertia, out):
    """out = w q / 2 for the angular velocity w = R I^-1 R^T L."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    r = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    own, spin, turn = np.zeros(3), np.zeros(3), np.zeros(3)
    for i in range(3):
        for j in range(3):
            own[i] += r[j, i] * momentum[j]
    for i in range(3):
        for j in range(3):
            spin[i] += inverse_inertia[i, j] * own[j]
    for i in range(3):
        for j in range(3):
            turn[i] += r[i, j] * spin[j]
    out[0] = 0.5 * (-turn[0] * x - turn[1] * y - turn[2] * z)
    out[1] = 0.5 * (turn[0] * w + turn[1] * z - turn[2] * y)
    out[2] = 0.5 * (turn[1] * w + turn[2] * x - turn[0] * z)
    out[3] = 0.5 * (turn[2] * w + turn[0] * y - turn[1] * x)


@njit(cache=True)
def _unit(q):
    return q / np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])


@njit(cache=True)
def turned(quat, momentum, inverse_inertia, dt):
    """Orientation after dt (s) of free rotation: dq/dt = w q / 2 by classical Runge-Kutta, angular momentum kept.

    Args:
        quat: float64 [4] unit quaternion, world from body.
        momentum: float64 [3] kg m^2/s about the centre of mass, world axes.
        inverse_inertia: float64 [3,3] 1/(kg m^2), body axes.
        dt: s.
    """
    a, b, c, d = np.empty(4), np.empty(4), np.empty(4), np.empty(4)
    _rate(quat, momentum, inverse_inertia, a)
    speed = 2.0 * np.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2] + a[3] * a[3])
    parts = max(1, np.int64(np.ceil(speed * dt / LARGEST_TURN)))
    s = dt / parts
    q = quat.copy()
    for _ in range(parts):
        _rate(q, momentum, inverse_inertia, a)
        _rate(_unit(q + 0.5 * s * a), momentum, inverse_inertia, b)
        _rate(_unit(q + 0.5 * s * b), momentum, inverse_inertia, c)
        _rate(_unit(q + s * c), momentum, inverse_inertia, d)
        q = _unit(q + s / 6.0 * (a + 2.0 * b + 2.0 * c + d))
    return q
