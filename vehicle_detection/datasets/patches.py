"""The training patches and frames: read, split honestly, and searched for near duplicates."""

from __future__ import annotations

import hashlib
import math
import operator
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import check_choice, check_patches, describe
from vehicle_detection.datasets.archives import (
    decode_listings,
    infer_labels,
    is_image,
    list_patches,
    natural_key,
    parent_folder,
)
from vehicle_detection.errors import DatasetError, InvalidInputError
from vehicle_detection.images import read_image
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


def load_patches(
    source: str | os.PathLike[str],
    *,
    label: int | None = None,
    size: int = PATCH_SIZE,
    n_jobs: int | None = None,
    progress: bool = False,
) -> PatchSet:
    """Read all patches (PNG, JPEG) under a folder, or straight from a zip.

    The order is natural (``image2`` before ``image10``) and the same for a zip, in whatever order it was
    packed, and for the folder it unpacks to. Hidden files and what macOS leaves behind are skipped.

    Parameters
    ----------
    source
        A folder, searched with all folders in it, or a zip.
    label
        1 if these are vehicles, 0 if not. None reads it off the folders: ``vehicles`` or ``cars``,
        ``non-vehicles`` or ``notcars``; the innermost decides.
    size
        Side in pixels that every patch must have.
    n_jobs
        Threads that decode; None for one a core, 8 at most.
    progress
        Show a progress bar on standard error.

    Raises
    ------
    DatasetError
        If `source` is missing, is no folder or whole zip, or holds no patch, an unreadable one, or one of
        another size.
    InvalidInputError
        If an option is out of range, or `label` is None and no folder tells the class.

    Examples
    --------
    >>> import tempfile
    >>> from vehicle_detection.images import write_image
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     for number in (10, 9):
    ...         write_image(f"{folder}/{number}.png", np.zeros((64, 64, 3), np.uint8))
    ...     patches = load_patches(folder, label=1)
    >>> patches, [name.split("/")[1] for name in patches.names]
    (PatchSet(2 patches of 64x64 pixels, 2 of them vehicles), ['9.png', '10.png'])
    """
    check_choice(label, "label", (None, 0, 1))
    listing = list_patches(source, "source")
    labels = infer_labels(listing) if label is None else np.full(len(listing.names), bool(label))
    patches = decode_listings([listing], size=size, n_jobs=n_jobs, progress=progress)
    return PatchSet(patches, labels, listing.names)


def load_training_patches(
    vehicles: str | os.PathLike[str],
    non_vehicles: str | os.PathLike[str],
    *,
    n_jobs: int | None = None,
    progress: bool = False,
) -> PatchSet:
    """Read both classes into one set, vehicles first; takes what `fetch_patches` returns.

    Parameters
    ----------
    vehicles, non_vehicles
        A folder or zip for each class, as in `load_patches`.
    n_jobs, progress
        As in `load_patches`.

    Raises
    ------
    DatasetError
        As in `load_patches`; also if one of the two holds no patch.

    Examples
    --------
    >>> load_training_patches("v.zip", "n.zip")
    Traceback (most recent call last):
    ...
    vehicle_detection.errors.DatasetError: vehicles v.zip does not exist; check the path or use fetch_patches
    """
    listings = [list_patches(vehicles, "vehicles"), list_patches(non_vehicles, "non_vehicles")]
    patches = decode_listings(listings, size=PATCH_SIZE, n_jobs=n_jobs, progress=progress)
    names = listings[0].names + listings[1].names
    return PatchSet(patches, np.arange(len(names)) < len(listings[0].names), names)


@dataclass(frozen=True)
class FrameSet:
    """Frames of a folder, each read when it is asked for; iterating yields ``(name, image)``.

    Attributes
    ----------
    folder
        Where they lie.
    names
        Their file names, in natural order.
    """

    folder: Path
    names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.names)

    def __repr__(self) -> str:
        return f"FrameSet({len(self)} frames of {self.folder})"

    def __getitem__(self, index: int) -> NDArray[np.uint8]:
        """Read one frame: ``(H, W, 3)`` uint8 RGB."""
        try:
            return read_image(self.folder / self.names[operator.index(index)])
        except InvalidInputError as error:
            raise DatasetError(f"{error}; replace or remove it") from error

    def __iter__(self) -> Iterator[tuple[str, NDArray[np.uint8]]]:
        for index, name in enumerate(self.names):
            yield name, self[index]


def load_frames(folder: str | os.PathLike[str]) -> FrameSet:
    """List the frames (PNG, JPEG) that lie in a folder; their boxes are read with `read_labels`.

    Parameters
    ----------
    folder
        The folder; folders in it are not searched.

    Returns
    -------
    FrameSet
        ``frames.names[i]`` is the file name that labels go by, ``frames[i]`` the image.

    Raises
    ------
    DatasetError
        If the folder is missing or holds no frame; on reading, if a frame is damaged.

    Examples
    --------
    >>> load_frames("missing")
    Traceback (most recent call last):
    ...
    vehicle_detection.errors.DatasetError: folder missing does not exist or is no folder; check the path
    """
    path = Path(folder)
    if not path.is_dir():
        raise DatasetError(f"folder {path} does not exist or is no folder; check the path")
    names = [file.name for file in path.iterdir() if is_image(file.name) and file.is_file()]
    if not names:
        raise DatasetError(f"folder {path} holds no PNG or JPEG frames; name the folder they lie in")
    return FrameSet(path, tuple(sorted(names, key=natural_key)))
