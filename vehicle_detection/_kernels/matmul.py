"""Matrix products of a few rows on the calling thread.

BLAS starts a thread for each core even for small products, and these compete with the threads of the search.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._kernels.jit import jit

# Columns whose sums fit into the first-level cache.
_COLUMNS = 512
# Number of rows from which BLAS is faster, as in training.
_MIN_BLAS_ROWS = 256


def matmul(rows: NDArray[np.float32], matrix: NDArray[np.float32]) -> NDArray[np.float32]:
    """Multiply row-major float32 matrices, ``(N, depth)`` by ``(depth, M)``.

    >>> matmul(np.float32([[1, 2]]), np.float32([[1, 0, 2], [3, 1, 0]])).tolist()
    [[7.0, 2.0, 2.0]]
    """
    if len(rows) >= _MIN_BLAS_ROWS:
        return np.asarray(rows @ matrix, np.float32)
    sums = np.zeros((len(rows), matrix.shape[1]), np.float32)
    if len(rows):
        _add_products(np.ascontiguousarray(rows), matrix, sums)
    return sums


@jit
def _add_products(rows, matrix, sums):
    """Add ``rows @ matrix`` to `sums`, four terms of each sum at a time."""
    depth, columns = matrix.shape
    unrolled = depth - depth % 4
    for first in range(0, columns, _COLUMNS):
        last = min(first + _COLUMNS, columns)
        for k in range(0, unrolled, 4):
            m0, m1 = matrix[k, first:last], matrix[k + 1, first:last]
            m2, m3 = matrix[k + 2, first:last], matrix[k + 3, first:last]
            for i in range(len(rows)):
                r0, r1, r2, r3 = rows[i, k], rows[i, k + 1], rows[i, k + 2], rows[i, k + 3]
                out = sums[i, first:last]
                for x in range(last - first):
                    out[x] += (r0 * m0[x] + r1 * m1[x]) + (r2 * m2[x] + r3 * m3[x])
        for k in range(unrolled, depth):
            m0 = matrix[k, first:last]
            for i in range(len(rows)):
                r0, out = rows[i, k], sums[i, first:last]
                for x in range(last - first):
                    out[x] += r0 * m0[x]
