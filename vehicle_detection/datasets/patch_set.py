"""Training patches as columns."""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import check_patches, describe
from vehicle_detection.datasets.archives import natural_key, parent_folder
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.params import PATCH_SIZE


@dataclass(frozen=True, eq=False, repr=False)
class PatchSet:
    """Training patches with their labels and names as columns, checked on construction.

    Attributes
    ----------
    patches
        ``(N, 64, 64, 3)`` uint8 RGB; another side than 64 is allowed, the features refuse it.
    labels
        ``(N,)`` bool, True for a vehicle; given as booleans or as 0 and 1.
    names
        N strings ``set/folder/file``, such as ``vehicles/GTI_Far/image0000.png``.

    Raises
    ------
    InvalidInputError
        If the columns differ in length or are of another kind.

    Examples
    --------
    >>> names = ["vehicles/KITTI/1.png", "vehicles/KITTI/2.png", "non-vehicles/GTI/1.png"]
    >>> patches = PatchSet(np.zeros((3, 64, 64, 3), np.uint8), [1, 1, 0], names)
    >>> patches.counts()
    {'GTI': 1, 'KITTI': 2}
    >>> patches[patches.labels]
    PatchSet(2 patches of 64x64 pixels, 2 of them vehicles)
    """

    patches: NDArray[np.uint8]
    labels: NDArray[np.bool_]
    names: tuple[str, ...]

    def __post_init__(self) -> None:
        given: object = self.patches
        side = given.shape[1] if isinstance(given, np.ndarray) and given.ndim == 4 else PATCH_SIZE
        patches = check_patches(given, side)
        labels, names = check_labels(self.labels, "labels"), tuple(self.names)
        if not all(isinstance(name, str) for name in names):
            raise InvalidInputError("names must be strings like 'vehicles/GTI_Far/image0000.png'")
        for column, length in (("labels", len(labels)), ("names", len(names))):
            if length != len(patches):
                raise InvalidInputError(
                    f"{column} must hold one entry for each of the {len(patches)} patches, got {length}"
                )
        object.__setattr__(self, "patches", patches)
        object.__setattr__(self, "labels", labels)
        object.__setattr__(self, "names", names)

    @classmethod
    def concatenate(cls, sets: Sequence[PatchSet]) -> PatchSet:
        """Put the patches of several sets, all of one side, into one set, in the order given."""
        if not sets or len({each.patches.shape[1:] for each in sets}) > 1:
            shapes = [each.patches.shape[1:] for each in sets]
            raise InvalidInputError(f"sets must be one or more sets of one patch size; got {shapes}")
        return cls(
            np.concatenate([each.patches for each in sets]),
            np.concatenate([each.labels for each in sets]),
            tuple(name for each in sets for name in each.names),
        )

    def __len__(self) -> int:
        return len(self.patches)

    def __repr__(self) -> str:
        side = self.patches.shape[1]
        return f"PatchSet({len(self)} patches of {side}x{side} pixels, {self.labels.sum()} of them vehicles)"

    def __getitem__(self, rows: slice | NDArray[Any] | Sequence[int]) -> PatchSet:
        """Take patches by a slice, a mask or indices."""
        chosen = np.arange(len(self))[rows]
        if chosen.ndim != 1:
            raise InvalidInputError(
                f"rows must be a slice, a mask or a list of indices, got {describe(rows)}; "
                "a single patch is patch_set.patches[index]"
            )
        names = tuple(self.names[row] for row in chosen)
        return PatchSet(self.patches[rows], self.labels[rows], names)

    @cached_property
    def sources(self) -> NDArray[np.str_]:
        """``(N,)`` name of the folder that each patch lies in, such as ``GTI_Far``."""
        return np.array([parent_folder(name).rpartition("/")[2] for name in self.names], np.str_)

    def counts(self) -> dict[str, int]:
        """Count the patches of each source."""
        counted = Counter(self.sources.tolist())
        return {source: counted[source] for source in sorted(counted, key=natural_key)}

    @property
    def balance(self) -> float:
        """Share of vehicles, 0-1; NaN for an empty set."""
        return float(self.labels.mean()) if len(self) else math.nan

    @property
    def fingerprint(self) -> str:
        """SHA-256 over names, labels and pixels: the same in any order, and from a zip or a folder."""
        rows = zip(self.names, self.labels.tolist(), self.patches)
        digests = sorted(
            f"{name}\0{label:d}\0{hashlib.sha256(patch.tobytes()).hexdigest()}" for name, label, patch in rows
        )
        return hashlib.sha256("\n".join(digests).encode("utf-8", "surrogatepass")).hexdigest()


def check_labels(labels: ArrayLike, name: str) -> NDArray[np.bool_]:
    """Return `labels` as one boolean a patch."""
    array = np.asarray(labels)
    if array.size == 0:
        array = np.empty(0, np.bool_)
    if array.ndim != 1 or array.dtype.kind not in "biu" or not np.isin(array, (0, 1)).all():
        raise InvalidInputError(
            f"{name} must be one boolean (or 0 or 1) for each patch, got {describe(array)}; "
            "labels of -1 and 1 convert with labels > 0"
        )
    return array.astype(np.bool_)
