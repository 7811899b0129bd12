"""Training patches with labels and names, read from folders and zip files."""

from __future__ import annotations

import hashlib
import math
import os
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import check, invalid, natural_key
from vehicle_detection.datasets.archives import (
    decode_listings,
    folder_labels,
    infer_labels,
    list_patches,
    parent_folder,
)
from vehicle_detection.errors import DatasetError, InvalidInputError
from vehicle_detection.features import PATCH_SIZE


@dataclass(frozen=True, eq=False, repr=False)
class PatchSet:
    """Training patches with labels and names. A notebook displays the counts of each source as a table.

    >>> names = ["vehicles/KITTI/1.png", "vehicles/KITTI/2.png", "non-vehicles/GTI/1.png"]
    >>> patches = PatchSet(np.zeros((3, 64, 64, 3), np.uint8), [1, 1, 0], names)
    >>> patches[patches.labels], patches.counts()
    (PatchSet(2 patches of 64x64 pixels: 2 vehicles, 0 non-vehicles), {'GTI': 1, 'KITTI': 2})
    """

    #: ``(N, 64, 64, 3)`` uint8 RGB; features cannot be extracted of another side length.
    patches: NDArray[np.uint8]
    labels: NDArray[np.bool_]  #: ``(N,)``, True for a vehicle; may be given as 0 and 1
    names: tuple[str, ...]  #: ``set/folder/file``, such as ``vehicles/GTI_Far/image0000.png``

    if TYPE_CHECKING:  # The constructor converts its arguments.

        def __init__(self, patches: ArrayLike, labels: ArrayLike, names: Iterable[str]) -> None: ...

    def __post_init__(self) -> None:
        given: object = self.patches
        side = given.shape[1] if isinstance(given, np.ndarray) and given.ndim == 4 else PATCH_SIZE
        patches = check.patches(given, side)
        labels, names = check_labels(self.labels), check.sequence(self.names, "names", "file names")
        if not all(isinstance(name, str) for name in names):
            raise InvalidInputError("names must be strings like 'vehicles/GTI_Far/image0000.png'")
        columns: dict[str, Any] = {"patches": patches, "labels": labels, "names": names}
        for column, values in columns.items():
            if len(values) != len(patches):
                raise InvalidInputError(
                    f"{column} must hold one entry for each of the {len(patches)} patches, got {len(values)}"
                )
            object.__setattr__(self, column, values)

    @classmethod
    def concatenate(cls, sets: Sequence[PatchSet]) -> PatchSet:
        """Join several sets of the same patch size, in the given order."""
        sets = check.sequence(sets, "sets", "PatchSet")
        for each in sets:
            check.instance(each, "sets", PatchSet, "read each one with load_patches")
        shapes = [each.patches.shape[1:] for each in sets]
        if len(set(shapes)) != 1:
            raise InvalidInputError(f"sets must be one or more sets of the same patch size; got {shapes}")
        return cls(
            np.concatenate([each.patches for each in sets]),
            np.concatenate([each.labels for each in sets]),
            tuple(name for each in sets for name in each.names),
        )

    def __len__(self) -> int:
        return len(self.patches)

    def __repr__(self) -> str:
        side, vehicles = self.patches.shape[1], int(self.labels.sum())
        text = f"{vehicles:,} vehicles, {len(self) - vehicles:,} non-vehicles"
        return f"PatchSet({len(self):,} patches of {side}x{side} pixels: {text})"

    def _repr_html_(self) -> str:
        """Table of the number of patches by source and class."""
        import pandas as pd

        total, vehicles = self.counts(), Counter(self.sources[self.labels].tolist())
        rows = [(vehicles[source], count - vehicles[source], count) for source, count in total.items()]
        table = pd.DataFrame(rows, index=list(total), columns=["vehicles", "non-vehicles", "total"])
        table.loc["total"] = table.sum()
        return str(table.to_html(max_rows=60))

    def __getitem__(self, rows: slice | NDArray[Any] | Sequence[int]) -> PatchSet:
        """Select patches by a slice, a mask or indices."""
        selected = np.arange(len(self))[rows]
        if selected.ndim != 1:
            remedy = "a single patch is patch_set.patches[index]"
            raise invalid("rows", "be a slice, a mask or a list of indices", rows, remedy)
        names = tuple(self.names[row] for row in selected)
        return PatchSet(self.patches[rows], self.labels[rows], names)

    @cached_property
    def sources(self) -> NDArray[np.str_]:
        """``(N,)`` name of each patch's folder, such as ``GTI_Far``."""
        return np.array([parent_folder(name).rpartition("/")[2] for name in self.names], np.str_)

    def counts(self) -> dict[str, int]:
        """Count the patches of each source."""
        counted = Counter(self.sources.tolist())
        return {source: counted[source] for source in sorted(counted, key=natural_key)}

    @property
    def balance(self) -> float:
        """Fraction of vehicles; NaN for an empty set."""
        return float(self.labels.mean()) if len(self) else math.nan

    @property
    def fingerprint(self) -> str:
        """SHA-256 of names, labels and pixels; it does not depend on the order, nor on zip or folder."""
        rows = zip(self.names, self.labels.tolist(), self.patches)
        digests = sorted(
            f"{name}\0{label:d}\0{hashlib.sha256(patch.tobytes()).hexdigest()}" for name, label, patch in rows
        )
        return hashlib.sha256("\n".join(digests).encode("utf-8", "surrogatepass")).hexdigest()


def check_labels(
    labels: ArrayLike,
    name: str = "labels",
    *,
    count: int | None = None,
    of: str = "patches",
    both: bool = False,
) -> NDArray[np.bool_]:
    """Return labels, 0 or 1 for each `of` a number of samples, as booleans; `both` classes must occur."""
    array = check.array(labels, name)
    if array.size == 0:
        array = np.empty(0, np.bool_)
    numbers = array.ndim == 1 and array.dtype.kind in "biuf" and np.isin(array, (0, 1)).all()
    if not numbers or count not in (None, len(array)):
        all_of = of if count is None else f"{count} {of}"
        must = f"be 0 or 1, or booleans, for each of the {all_of}"
        raise invalid(name, must, array, "convert labels of -1 and 1 with labels > 0")
    if both and len(np.unique(array)) < 2:
        raise InvalidInputError(f"{name} must hold both classes: vehicles (1) and non-vehicles (0)")
    return array.astype(np.bool_)


def load_patches(
    source: str | os.PathLike[str],
    *,
    label: int | None = None,
    size: int = PATCH_SIZE,
    jobs: int | None = None,
    progress: bool = False,
) -> PatchSet:
    """Read all patches (PNG, JPEG) in a folder or zip file, with their labels and names.

    The order is natural (``image2`` before ``image10``) and the same for a zip and the folder it unpacks to.
    Hidden files and macOS resource files are skipped. A damaged patch raises a `DatasetError`.

    Parameters
    ----------
    source
        A folder, searched with its subfolders, or a zip file.
    label
        1 for vehicles, 0 for non-vehicles. None takes the label from the innermost folder named
        ``vehicles``, ``cars``, ``non-vehicles`` or ``notcars``.
    size, jobs, progress
        Side in pixels that every patch must have; threads, None for one per core, at most 8; and whether to
        show a progress bar on standard error.

    Examples
    --------
    >>> import tempfile
    >>> from vehicle_detection.images import write_image
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     for number in (10, 9):
    ...         write_image(f"{folder}/{number}.png", np.zeros((64, 64, 3), np.uint8))
    ...     patches = load_patches(folder, label=1)
    >>> [name.split("/")[1] for name in patches.names]
    ['9.png', '10.png']
    """
    check.choice(label, "label", (None, 0, 1))
    listing = list_patches(source, "source")
    labels = infer_labels(listing) if label is None else np.full(len(listing.names), bool(label))
    patches = decode_listings([listing], size=size, jobs=jobs, progress=progress)
    return PatchSet(patches, labels, listing.names)


def load_training_patches(
    vehicles: str | os.PathLike[str],
    non_vehicles: str | os.PathLike[str],
    *,
    jobs: int | None = None,
    progress: bool = False,
) -> PatchSet:
    """Read both classes into one set of 64x64 patches, vehicles first, each in natural order.

    `vehicles` and `non_vehicles` are a folder or zip file each, such as `fetch_patches` returns; a folder in
    them whose name stands for the other class raises a `DatasetError`. Options: see `load_patches`.

    >>> load_training_patches("v.zip", "n.zip")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    ...
    vehicle_detection.errors.DatasetError: vehicles v.zip does not exist; check the path, ...
    """
    listings = [list_patches(vehicles, "vehicles"), list_patches(non_vehicles, "non_vehicles")]
    for listing, name, label in zip(listings, ("vehicles", "non_vehicles"), (True, False)):
        swapped = [folder for folder, known in folder_labels(listing).items() if known is (not label)]
        if swapped:
            must = f"hold one class only, but {swapped[0]!r} is a folder of the other"
            raise DatasetError(f"{name} {listing.path} must {must}; pass the two classes apart and in order")
    patches = decode_listings(listings, size=PATCH_SIZE, jobs=jobs, progress=progress)
    names, others = (listing.names for listing in listings)
    return PatchSet(patches, np.arange(len(patches)) < len(names), names + others)
