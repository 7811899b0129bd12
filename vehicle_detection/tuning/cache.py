"""Features that are computed once for each parameter set, kept in memory and, if wanted, in a folder."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import os
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import atomic_write, check_number, check_patches
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.features import extract_features
from vehicle_detection.params import PATCH_SIZE, FeatureParams

_LOGGER = logging.getLogger(__name__)

_PROBE = 8  # Rows that tell whether a file still holds what this release computes.


def digest_of(*facts: Any) -> str:
    """Short hash of JSON values and arrays: the same facts, the same hash, in every run."""
    digest = hashlib.sha256()
    for fact in facts:
        if isinstance(fact, np.ndarray):
            digest.update(f"{fact.shape}{fact.dtype}".encode())
            digest.update(np.ascontiguousarray(fact).tobytes())
        else:
            digest.update(json.dumps(fact, sort_keys=True).encode())
        digest.update(b"\n")
    return digest.hexdigest()[:16]


class FeatureCache:
    """Feature vectors of one set of patches, by parameters; the same call twice computes once.

    Parameters
    ----------
    patches
        ``(N, 64, 64, 3)`` uint8 RGB.
    folder
        Where features are kept from run to run, a ``.npy`` file for each parameter set (N x length x 4
        bytes); it is made if it does not exist. None keeps them in memory alone.
    memory_mb
        Megabytes to keep in memory; the features used longest ago go first. One set is always kept.
    n_jobs
        Threads of the extraction.

    Raises
    ------
    InvalidInputError
        If the patches are malformed, or `folder` is a file or cannot be written.

    Examples
    --------
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
        n_jobs: int | None = None,
    ) -> None:
        self.patches = check_patches(patches, PATCH_SIZE)
        self.folder = None if folder is None else _check_folder(folder)
        self._most_bytes = check_number(memory_mb, "memory_mb", low=0) * 1e6
        self._n_jobs = n_jobs
        self._kept: OrderedDict[tuple[FeatureParams, bool], NDArray[np.float32]] = OrderedDict()
        self.digest = digest_of(self.patches)
        """Hash of the patches, in their order."""

    def rows(
        self, params: FeatureParams, rows: NDArray[np.intp], *, mirrored: bool = False
    ) -> NDArray[np.float32]:
        """Features of some patches as a new array ``(len(rows), length)`` float32; the caller may change it.

        A few rows of features that are not at hand are computed alone.
        """
        if not self._is_at_hand(params, mirrored) and len(rows) < len(self.patches) / 4:
            return self._compute(params, mirrored, rows)
        return self.all(params, mirrored=mirrored)[rows]

    def all(self, params: FeatureParams, *, mirrored: bool = False) -> NDArray[np.float32]:
        """Features of all patches, ``(N, length)`` float32, read-only; `mirrored`, of the patches flipped."""
        key = (params, mirrored)
        features = self._kept.get(key)
        if features is None:
            features = self._load(params, mirrored)
            if features is None:
                features = self._compute(params, mirrored, slice(None))
                self._save(features, params, mirrored)
            features.setflags(write=False)
            self._kept[key] = features
        self._kept.move_to_end(key)
        while len(self._kept) > 1 and sum(kept.nbytes for kept in self._kept.values()) > self._most_bytes:
            self._kept.popitem(last=False)
        return features

    def _compute(
        self, params: FeatureParams, mirrored: bool, rows: NDArray[np.intp] | slice
    ) -> NDArray[np.float32]:
        patches = self.patches[rows]
        if mirrored:
            patches = np.ascontiguousarray(patches[:, :, ::-1])
        return extract_features(patches, params, n_jobs=self._n_jobs)

    def _path(self, params: FeatureParams, mirrored: bool) -> Path | None:
        if self.folder is None:
            return None
        return self.folder / f"{digest_of(self.digest, dataclasses.asdict(params), mirrored)}.npy"

    def _is_at_hand(self, params: FeatureParams, mirrored: bool) -> bool:
        path = self._path(params, mirrored)
        return (params, mirrored) in self._kept or (path is not None and path.exists())

    def _save(self, features: NDArray[np.float32], params: FeatureParams, mirrored: bool) -> None:
        path = self._path(params, mirrored)
        if path is not None:
            with atomic_write(path, "cache") as part, part.open("wb") as file:
                np.save(file, features, allow_pickle=False)

    def _load(self, params: FeatureParams, mirrored: bool) -> NDArray[np.float32] | None:
        """Read features from their file; None if there is none, or not what would be computed now."""
        path = self._path(params, mirrored)
        if path is None or not path.exists():
            return None
        try:
            features = np.asarray(np.load(path, allow_pickle=False))
        except (OSError, ValueError, EOFError):
            _LOGGER.warning("cached features %s are damaged and are computed again", path)
            return None
        # Another release may compute other features under the same parameters.
        probe = self._compute(params, mirrored, slice(_PROBE))
        fits = features.shape == (len(self.patches), params.length) and features.dtype == np.float32
        if not fits or not np.array_equal(features[:_PROBE], probe):
            _LOGGER.warning("cached features %s are not those of this release; computed again", path)
            return None
        return features


def _check_folder(folder: str | os.PathLike[str]) -> Path:
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInputError(
            f"cache must be a folder that can be made, got {path} ({error.strerror}); choose another"
        ) from error
    return path
