"""What a pressure projection does before and after its solve, face by face, compiled (see `physics.pressure`, whose
array operations are the readable twins). The same bits as those."""

from __future__ import annotations

import numpy as np

from fluidlift.numerics.sharing import shared


@shared(lambda unknown, *_: (0, unknown.shape[0]))
def outflow(begin, end, unknown, u, v, w, open_u, open_v, open_w, h, out):
    """out = net outflow of each unknown cell per volume through the open shares of its faces, 1/s; 0 elsewhere."""
    _, ny, nz = unknown.shape
    for i in range(begin, end):
        for j in range(ny):
            for k in range(nz):
                if not unknown[i, j, k]:
                    out[i, j, k] = 0.0
                    continue
                total = np.float64(u[i + 1, j, k]) * np.float64(open_u[i + 1, j, k])
                total -= np.float64(u[i, j, k]) * np.float64(open_u[i, j, k])
                along = np.float64(v[i, j + 1, k]) * np.float64(open_v[i, j + 1, k])
                total += along - np.float64(v[i, j, k]) * np.float64(open_v[i, j, k])
                along = np.float64(w[i, j, k + 1]) * np.float64(open_w[i, j, k + 1])
                total += along - np.float64(w[i, j, k]) * np.float64(open_w[i, j, k])
                out[i, j, k] = total / h


@shared(lambda component, *_: (0, component.shape[0]))
def accelerated(begin, end, component, weight, opening, gap, unknown, q, axis, h, out):
    """out = a velocity component less the gradient of q on weighted faces, 0 on closed ones. q counts in unknown cells,
    and is 0 elsewhere; `gap` (empty: none) is the distance of the surface on each face, cells."""
    nx, ny, nz = q.shape
    _, mj, mk = component.shape
    di, dj, dk = np.int64(axis == 0), np.int64(axis == 1), np.int64(axis == 2)
    zero, spacing = q.dtype.type(0), q.dtype.type(h)
    for i in range(begin, end):
        for j in range(mj):
            for k in range(mk):
                if not opening[i, j, k] > 0:
                    out[i, j, k] = 0.0
                    continue
                if not weight[i, j, k] > 0:
                    out[i, j, k] = component[i, j, k]
                    continue
                high = low = zero
                if i < nx and j < ny and k < nz and unknown[i, j, k]:
                    high = q[i, j, k]
                if i >= di and j >= dj and k >= dk and unknown[i - di, j - dj, k - dk]:
                    low = q[i - di, j - dj, k - dk]
                change = (high - low) / spacing
                if gap.size > 0:
                    change = change / gap[i, j, k]
                out[i, j, k] = component[i, j, k] - change
