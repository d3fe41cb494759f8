"""The compiled loop of `physics.whitewater`: how neighbouring cells move relative to each other."""

from __future__ import annotations

import numpy as np

from fluidlift.numerics.sharing import PIECES, shared


@shared(lambda asked, *_: (0, asked.shape[0]), pieces=PIECES)
def relative_motion(begin, end, asked, wet, velocity, offsets, closing, apart):
    """How fast the liquid around the cells that are asked for closes in on them, and how they move against it.

    With x the offset of a neighbour, v its velocity relative to the cell and w = 1 - |x| / R its weight, closing is
    the mean of max(0, -v . x / |x|), and `apart` that of -v. Neither knows a motion of the whole; closing does not
    know a rotation of the whole either.

    Args:
        begin: first plane of cells.
        end: behind the last one.
        asked: bool [nx,ny,nz].
        wet: bool [nx,ny,nz], neighbours that count.
        velocity: [nx,ny,nz,3], at the middles of wet cells, m/s.
        offsets: [m,4] of neighbours: three whole numbers of cells, and the weight.
        closing: [nx,ny,nz], m/s, written where asked.
        apart: [nx,ny,nz,3], m/s, written where asked.
    """
    nx, ny, nz = wet.shape
    for i in range(begin, end):
        for j in range(ny):
            for k in range(nz):
                if not asked[i, j, k]:
                    continue
                total, near, u, v, w = 0.0, 0.0, 0.0, 0.0, 0.0
                for m in range(len(offsets)):
                    x, y, z = offsets[m, 0], offsets[m, 1], offsets[m, 2]
                    a, b, c = i + np.int64(x), j + np.int64(y), k + np.int64(z)
                    if a < 0 or b < 0 or c < 0 or a >= nx or b >= ny or c >= nz or not wet[a, b, c]:
                        continue
                    weight = offsets[m, 3]
                    du = np.float64(velocity[a, b, c, 0]) - np.float64(velocity[i, j, k, 0])
                    dv = np.float64(velocity[a, b, c, 1]) - np.float64(velocity[i, j, k, 1])
                    dw = np.float64(velocity[a, b, c, 2]) - np.float64(velocity[i, j, k, 2])
                    near += weight * max(0.0, -(du * x + dv * y + dw * z) / np.sqrt(x * x + y * y + z * z))
                    total += weight
                    u -= weight * du
                    v -= weight * dv
                    w -= weight * dw
                if total > 0.0:
                    closing[i, j, k] = near / total
                    apart[i, j, k, 0], apart[i, j, k, 1], apart[i, j, k, 2] = u / total, v / total, w / total
