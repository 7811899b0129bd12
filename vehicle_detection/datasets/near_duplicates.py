"""Near duplicates among patches: consecutive frames of a drive show the same car."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_number, check_patches
from vehicle_detection.datasets.patches import PatchSet
from vehicle_detection.params import PATCH_SIZE

_CHUNK = 512  # Rows compared with all others at a time, to limit the memory of the correlation matrix.


def find_near_duplicates(
    patches: PatchSet | NDArray[np.uint8], *, threshold: float = 0.95
) -> NDArray[np.intp]:
    """Find the patches that have a near duplicate in the same set.

    Patches are compared by the correlation of their 16x16 gray thumbnails, which ignores brightness and
    contrast. A uniform patch has no near duplicate. Labels are ignored.

    Parameters
    ----------
    patches
        A `PatchSet`, or ``(N, 64, 64, 3)`` uint8 RGB.
    threshold
        Correlation, in (0, 1], from which two patches are near duplicates.

    Returns
    -------
    numpy.ndarray
        ``(M, 2)`` row numbers: each patch that has a near duplicate, ascending, and the most similar patch.

    Raises
    ------
    InvalidInputError
        If `patches` has another shape or type, or `threshold` is out of range.

    Examples
    --------
    >>> patches = np.random.default_rng(0).integers(0, 256, (4, 64, 64, 3), np.uint8)
    >>> patches[3] = patches[1] // 2
    >>> find_near_duplicates(patches)
    array([[1, 3],
           [3, 1]])
    """
    limit = check_number(threshold, "threshold", above=0, high=1)
    thumbnails = make_thumbnails(patches)
    nearest, correlation = find_nearest(thumbnails, thumbnails, same=True)
    rows = np.flatnonzero(correlation >= limit)
    return np.stack([rows, nearest[rows]], axis=1)


def make_thumbnails(patches: PatchSet | NDArray[np.uint8]) -> NDArray[np.float32]:
    """16x16 gray thumbnails with zero mean and unit length, ``(N, 256)``; products are correlations."""
    images = patches.patches if isinstance(patches, PatchSet) else check_patches(patches, PATCH_SIZE)
    vectors = np.empty((len(images), 16 * 16), np.float32)
    for row, image in enumerate(images):
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
        vectors[row] = cv2.resize(gray, (16, 16), interpolation=cv2.INTER_AREA).ravel()
    vectors -= vectors.mean(axis=1, keepdims=True)
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    # Of a uniform patch only rounding errors remain: set them to 0.
    return np.asarray(np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0.01))


def find_nearest(
    queries: NDArray[np.float32], pool: NDArray[np.float32], *, same: bool
) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Row of `pool` most similar to each query, and their correlation; `same` excludes the query itself."""
    nearest = np.zeros(len(queries), np.intp)
    correlation = np.full(len(queries), -np.inf, np.float32)
    for start in range(0, len(queries), _CHUNK):
        products = queries[start : start + _CHUNK] @ pool.T
        rows = np.arange(len(products))
        if same:
            products[rows, start + rows] = -np.inf
        best = products.argmax(axis=1)
        nearest[start : start + _CHUNK] = best
        correlation[start : start + _CHUNK] = products[rows, best]
    return nearest, correlation


def group_near_duplicates(thumbnails: NDArray[np.float32], limit: float) -> NDArray[np.int32]:
    """Group number of each patch, ``(N,)``: connected components of the near-duplicate relation."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(thumbnails)
    groups = np.arange(count, dtype=np.int32)
    for start in range(0, count, _CHUNK):
        similar = thumbnails[start : start + _CHUNK] @ thumbnails[start:].T >= limit
        rows, others = groups[start + np.array(similar.nonzero())]
        # Merge the groups chunk by chunk: all pairs at once may not fit into memory.
        edges = coo_array((np.ones(len(rows), np.bool_), (rows, others)), shape=(count, count))
        groups = connected_components(edges, directed=False)[1][groups]
    return groups
