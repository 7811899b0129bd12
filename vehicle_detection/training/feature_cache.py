"""Features of a set of patches, computed once per parameter set and kept in memory and on disk."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import io
import json
import os
from collections import OrderedDict
from typing import Any

import numpy as np
from numpy.typing import NDArray

import vehicle_detection
from vehicle_detection._common import atomic_write, check_number, check_patches, check_path
from vehicle_detection.errors import InvalidInputError
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

    `patches` is ``(N, 64, 64, 3)`` uint8 RGB. `folder` keeps a ``.npy`` file for each set between runs.
    Beyond `memory_mb` megabytes the least recently used sets are dropped from memory, but one set is always
    kept. `jobs` is the number of threads.

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
        self._max_bytes = check_number(memory_mb, "memory_mb", low=0) * 1e6
        self._jobs = jobs
        self._folder = None if folder is None else check_path(folder, "cache", kind="a folder")
        if self._folder is not None:
            try:
                self._folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise InvalidInputError(
                    f"cache must be a folder, {folder} cannot be created ({error.strerror}); choose another"
                ) from error
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
            cached[key] = self._read(params, mirrored)
            cached[key].setflags(write=False)
        cached.move_to_end(key)
        while len(cached) > 1 and sum(each.nbytes for each in cached.values()) > self._max_bytes:
            cached.popitem(last=False)
        return cached[key]

    def _read(self, params: FeatureParams, mirrored: bool) -> NDArray[np.float32]:
        """Read features from their file; compute and write them if it is missing or damaged."""
        facts = dataclasses.asdict(params), mirrored, vehicle_detection.__version__
        path = self._folder and self._folder / f"{digest_of(self.digest, *facts)}.npy"
        if path and path.exists():
            with contextlib.suppress(OSError, ValueError, EOFError):
                features = np.asarray(np.load(path, allow_pickle=False))
                if features.shape == (len(self.patches), params.length) and features.dtype == np.float32:
                    return features
        patches = np.ascontiguousarray(self.patches[:, :, ::-1]) if mirrored else self.patches
        features = extract_features(patches, params, jobs=self._jobs)
        if path:
            with atomic_write(path, "cache") as part:
                part.write_bytes(npy_bytes(features))
        return features


def npy_bytes(array: NDArray[np.float32]) -> bytes:
    """Content of a ``.npy`` file; unlike `numpy.save`, writing it names the error of a full disk."""
    content = io.BytesIO()
    np.save(content, array, allow_pickle=False)
    return content.getvalue()
