"""Features of a set of patches, computed once per parameter set and kept in memory."""

from __future__ import annotations

import hashlib
import json
from collections import OrderedDict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_number, check_patches
from vehicle_detection.features import PATCH_SIZE, FeatureParams, extract_features


def digest_of(*parts: Any) -> str:
    """Short hash of JSON values and arrays, the same in every run."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            digest.update(f"{part.shape}{part.dtype}".encode())
            digest.update(np.ascontiguousarray(part).tobytes())
        else:
            digest.update(json.dumps(part, sort_keys=True).encode())
        digest.update(b"\n")
    return digest.hexdigest()[:16]


class FeatureCache:
    """Feature vectors of one set of patches by parameters.

    `patches` is ``(N, 64, 64, 3)`` uint8 RGB. Beyond `memory_mb` megabytes the least recently used sets are
    dropped, but one set is always kept. `jobs` is the number of threads.

    >>> cache = FeatureCache(np.zeros((3, 64, 64, 3), np.uint8))
    >>> cache.all(FeatureParams()) is cache.all(FeatureParams())
    True
    """

    def __init__(
        self, patches: NDArray[np.uint8], *, memory_mb: float = 2000.0, jobs: int | None = None
    ) -> None:
        self.patches = check_patches(patches, PATCH_SIZE)
        self.digest = digest_of(self.patches)
        self._max_bytes = check_number(memory_mb, "memory_mb", low=0) * 1e6
        self._jobs = jobs
        self._in_memory: OrderedDict[tuple[FeatureParams, bool], NDArray[np.float32]] = OrderedDict()

    def rows(
        self, params: FeatureParams, rows: NDArray[np.intp], *, mirrored: bool = False
    ) -> NDArray[np.float32]:
        """Features of some patches as a new ``(len(rows), length)`` float32 array."""
        return self.all(params, mirrored=mirrored)[rows]

    def all(self, params: FeatureParams, *, mirrored: bool = False) -> NDArray[np.float32]:
        """Features of all patches, or of the mirrored patches: ``(N, length)`` float32, read-only."""
        key, cached = (params, mirrored), self._in_memory
        if key not in cached:
            patches = np.ascontiguousarray(self.patches[:, :, ::-1]) if mirrored else self.patches
            cached[key] = extract_features(patches, params, jobs=self._jobs)
            cached[key].setflags(write=False)
        cached.move_to_end(key)
        while len(cached) > 1 and sum(each.nbytes for each in cached.values()) > self._max_bytes:
            cached.popitem(last=False)
        return cached[key]
