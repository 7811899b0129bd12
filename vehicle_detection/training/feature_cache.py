"""Features of a set of patches, computed once per parameter set and kept on disk."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import io
import json
import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

import vehicle_detection
from vehicle_detection._common import atomic_write, check, make_folder
from vehicle_detection.features import PATCH_SIZE, FeatureParams
from vehicle_detection.training.classifier import TrainingOptions, patch_features


def digest_of(*parts: Any) -> str:
    """Short hash of JSON values and arrays, the same in every run."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            digest.update(f"{part.shape}{part.dtype}".encode())
            digest.update(np.ascontiguousarray(part).tobytes())
        else:
            digest.update(json.dumps(part, sort_keys=True, default=np.generic.item).encode())
        digest.update(b"\n")
    return digest.hexdigest()[:16]


class FeatureCache:
    """Features of ``(N, 64, 64, 3)`` patches: the last ones in memory, all as files in a folder if given.

    >>> cache = FeatureCache(np.zeros((3, 64, 64, 3), np.uint8))
    >>> cache.features(FeatureParams(), mirror=True).shape
    (6, 6156)
    """

    def __init__(
        self,
        patches: NDArray[np.uint8],
        *,
        folder: str | os.PathLike[str] | None = None,
        jobs: int | None = None,
    ) -> None:
        self.patches = check.patches(patches, PATCH_SIZE)
        self.digest = digest_of(self.patches)
        self._jobs = jobs
        self._folder = None if folder is None else make_folder(folder, "cache")
        self._last = functools.lru_cache(1)(self._read)

    def features(self, params: FeatureParams, *, mirror: bool = False) -> NDArray[np.float32]:
        """Features of all patches, not to be changed; `mirror` adds those of their mirror images."""
        return self._last(params, mirror)

    def _read(self, params: FeatureParams, mirror: bool) -> NDArray[np.float32]:
        """Read features from their file; compute and write them if it is missing or damaged."""
        facts = dataclasses.asdict(params), mirror, vehicle_detection.__version__
        path = self._folder and self._folder / f"{digest_of(self.digest, *facts)}.npy"
        if path and path.exists():
            with contextlib.suppress(OSError, ValueError, EOFError):
                return np.asarray(np.load(path, allow_pickle=False))
        features = patch_features(self.patches, params, TrainingOptions(mirror=mirror), jobs=self._jobs)
        if path:
            content = io.BytesIO()  # unlike `numpy.save`, writing it names the error of a full disk
            np.save(content, features, allow_pickle=False)
            with atomic_write(path, "cache") as part:
                part.write_bytes(content.getvalue())
        return features
