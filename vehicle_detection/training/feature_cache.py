"""Features of a set of patches, computed once per parameter set and kept in memory and on disk."""

from __future__ import annotations

import dataclasses
import errno
import hashlib
import json
import logging
import os
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import atomic_write, check_number, check_patches, check_path
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.features import PATCH_SIZE, FeatureParams, extract_features

_LOGGER = logging.getLogger(__name__)

_N_CHECKED = 8  # Rows computed again to check that a file holds the features of this release.


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

    `patches` is ``(N, 64, 64, 3)`` uint8 RGB. `folder` keeps one ``.npy`` file per parameter set
    (N x length x 4 bytes) between runs; None keeps features in memory only. Beyond `memory_mb` megabytes the
    least recently used sets are dropped, but one set is always kept. `jobs` is the number of threads.

    >>> cache = FeatureCache(np.zeros((3, 64, 64, 3), np.uint8))
    >>> cache.all(FeatureParams()) is cache.all(FeatureParams())
    True
    """

    def __init__(
        self,
        patches: NDArray[np.uint8],
        *,
        folder: str | os.PathLike[str] | None = None,
        memory_mb: float = 2000.0,
        jobs: int | None = None,
    ) -> None:
        self.patches = check_patches(patches, PATCH_SIZE)
        self.digest = digest_of(self.patches)
        self._folder = None if folder is None else check_path(folder, "cache", kind="a folder")
        self._max_bytes = check_number(memory_mb, "memory_mb", low=0) * 1e6
        self._jobs = jobs
        self._in_memory: OrderedDict[tuple[FeatureParams, bool], NDArray[np.float32]] = OrderedDict()
        try:
            if self._folder is not None:
                self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InvalidInputError(
                f"cache must be a folder, {folder} cannot be created ({error.strerror}); choose another"
            ) from error

    def rows(
        self, params: FeatureParams, rows: NDArray[np.intp], *, mirrored: bool = False
    ) -> NDArray[np.float32]:
        """Features of some patches as a new ``(len(rows), length)`` float32 array."""
        path = self._path(params, mirrored)
        cached = (params, mirrored) in self._in_memory or (path is not None and path.exists())
        # Few rows of an uncached set are computed without the others.
        if not cached and len(rows) < len(self.patches) / 4:
            return self._compute(params, mirrored, rows)
        return self.all(params, mirrored=mirrored)[rows]

    def all(self, params: FeatureParams, *, mirrored: bool = False) -> NDArray[np.float32]:
        """Features of all patches, or of the mirrored patches: ``(N, length)`` float32, read-only."""
        key, cached = (params, mirrored), self._in_memory
        if key not in cached:
            features = self._load(params, mirrored)
            features.setflags(write=False)
            cached[key] = features
        cached.move_to_end(key)
        while len(cached) > 1 and sum(each.nbytes for each in cached.values()) > self._max_bytes:
            cached.popitem(last=False)
        return cached[key]

    def _compute(
        self, params: FeatureParams, mirrored: bool, rows: NDArray[np.intp] | slice
    ) -> NDArray[np.float32]:
        patches = self.patches[rows]
        if mirrored:
            patches = np.ascontiguousarray(patches[:, :, ::-1])
        return extract_features(patches, params, jobs=self._jobs)

    def _path(self, params: FeatureParams, mirrored: bool) -> Path | None:
        if self._folder is None:
            return None
        return self._folder / f"{digest_of(self.digest, dataclasses.asdict(params), mirrored)}.npy"

    def _load(self, params: FeatureParams, mirrored: bool) -> NDArray[np.float32]:
        """Read features from their file; compute and save them if it is missing, damaged or outdated."""
        path = self._path(params, mirrored)
        if path is not None and path.exists():
            expected = self._compute(params, mirrored, slice(_N_CHECKED))
            try:
                features = np.asarray(np.load(path, allow_pickle=False))
                has_shape = features.shape == (len(self.patches), params.length)
                if has_shape and features.dtype == np.float32 and (features[:_N_CHECKED] == expected).all():
                    return features
                _LOGGER.warning("cached features %s are from another release; computing them again", path)
            except (OSError, ValueError, EOFError):
                _LOGGER.warning("cached features %s are damaged; computing them again", path)
        features = self._compute(params, mirrored, slice(None))
        if path is not None:
            with atomic_write(path, "cache") as part, part.open("wb") as file:
                try:
                    np.save(file, features, allow_pickle=False)
                except OSError as error:
                    if error.errno is None:  # numpy's, if it can write a part only
                        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)) from error
                    raise
        return features
