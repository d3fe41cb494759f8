"""The linear operators of a rollout as sparse matrices: the readable form of what the kernels compute.

Matrices act on one face component raveled in C order, or on cells.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool
from scipy import sparse


def neighbour_pairs(shape: tuple[int, ...], axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Flat indices of all entries that have a neighbour at +1 along `axis`, and of that neighbour."""
    index = np.arange(int(np.prod(shape))).reshape(shape)
    n = shape[axis]
    return np.take(index, range(n - 1), axis).ravel(), np.take(index, range(1, n), axis).ravel()


def extrapolation_matrix(known: Bool[np.ndarray, "a b c"], sweeps: int) -> sparse.csr_matrix:
    """Each sweep gives unknown entries the mean of their known neighbours, which then count as known.

    Entries that no sweep reaches become 0.
    """
    flat = known.ravel().copy()
    low, high = zip(*(neighbour_pairs(known.shape, axis) for axis in range(3)))
    rows, cols = np.concatenate([*low, *high]), np.concatenate([*high, *low])
    total = sparse.diags(flat.astype(float)).tocsr()
    for _ in range(sweeps):
        use = ~flat[rows] & flat[cols]
        if not use.any():
            break
        count = np.bincount(rows[use], minlength=flat.size)
        mean = sparse.csr_matrix((1.0 / count[rows[use]], (rows[use], cols[use])), shape=total.shape)
        total = total + mean @ total
        flat |= count > 0
    return sparse.csr_matrix(total)


def viscous_matrices(
    dynamic: Bool[np.ndarray, "a b c"],
    prescribed: Bool[np.ndarray, "a b c"],
    wall: Bool[np.ndarray, "a b c"],
    axis: int,
    h: float,
) -> tuple[sparse.csr_matrix, sparse.csr_matrix]:
    """Laplacian of one component: among dynamic faces (with its diagonal), and from prescribed faces, 1/m^2.

    A wall face ahead or behind holds the normal velocity 0; walls beside a face are left to `wall_count`; towards air
    the derivative is 0.
    """
    n = dynamic.size
    d, b, z = dynamic.ravel(), prescribed.ravel(), wall.ravel()
    inner, outer = [], []
    diagonal = np.zeros(n)
    for direction in range(3):
        low, high = neighbour_pairs(dynamic.shape, direction)
        for row, col in ((low, high), (high, low)):
            use = d[row] & d[col]
            inner.append((row[use], col[use]))
            given = d[row] & b[col]
            outer.append((row[given], col[given]))
            zero = d[row] & z[col] if direction == axis else np.zeros(row.size, bool)
            np.add.at(diagonal, row[use | given | zero], 1.0)

    def assemble(parts: list[tuple[np.ndarray, np.ndarray]]) -> sparse.csr_matrix:
        rows, cols = (np.concatenate(side) for side in zip(*parts))
        return sparse.csr_matrix((np.full(rows.size, 1 / h**2), (rows, cols)), shape=(n, n))

    return assemble(inner) - sparse.diags(diagonal / h**2), assemble(outer)


def pressure_matrices(
    reach: np.ndarray, opening: np.ndarray, unknown: Bool[np.ndarray, "nx ny nz"], axis: int, h: float
) -> tuple[sparse.csr_matrix, sparse.csr_matrix]:
    """Divergence (cells from faces) and gradient (faces from cells, times `reach`) across one axis, 1/m."""
    faces = np.arange(reach.size).reshape(reach.shape)
    n = unknown.shape[axis]
    cells = np.arange(unknown.size)
    low, high = np.take(faces, range(n), axis).ravel(), np.take(faces, range(1, n + 1), axis).ravel()
    use = unknown.ravel()
    cells, low, high = cells[use], low[use], high[use]
    area = opening.ravel()
    values = np.concatenate([area[high], -area[low]]) / h
    columns, rows = np.tile(cells, 2), np.concatenate([high, low])
    divergence = sparse.csr_matrix((values, (columns, rows)), shape=(unknown.size, reach.size))
    signs = np.concatenate([-np.ones(cells.size), np.ones(cells.size)]) / h
    gradient = sparse.csr_matrix((signs, (rows, columns)), shape=(reach.size, unknown.size))
    return divergence, sparse.csr_matrix(sparse.diags(reach.ravel()) @ gradient)
