"""The training patches and frames: read, split honestly, and searched for near-copies."""

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

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._checks import check_choice, check_integer, check_number, check_patches, describe
from vehicle_detection._download import (
    decode_listings,
    infer_labels,
    is_image,
    list_patches,
    natural_key,
    parent_folder,
)
from vehicle_detection._download import fetch_patches as fetch_patches
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
        labels, names = _check_labels(self.labels, "labels"), tuple(self.names)
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


@dataclass(frozen=True, eq=False)
class Split:
    """Rows to train on and rows to test on; unpacks as ``train, test = split``.

    Attributes
    ----------
    train, test
        ``(N,)`` and ``(M,)`` intp indices without a common one, neither empty.
    """

    train: NDArray[np.intp]
    test: NDArray[np.intp]

    def __post_init__(self) -> None:
        for name in ("train", "test"):
            rows = np.asarray(getattr(self, name))
            if rows.ndim != 1 or not rows.size or rows.dtype.kind not in "iu" or rows.min() < 0:
                raise InvalidInputError(f"{name} must be a list of row numbers, got {describe(rows)}")
            object.__setattr__(self, name, rows.astype(np.intp, copy=False))
        rows = np.concatenate([self.train, self.test])
        if len(np.unique(rows)) != len(rows):
            raise InvalidInputError("train and test must share no row and repeat none; drop the doubles")

    def __iter__(self) -> Iterator[NDArray[np.intp]]:
        return iter((self.train, self.test))


def _check_labels(labels: ArrayLike, name: str) -> NDArray[np.bool_]:
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


def split_random(
    patches_or_labels: PatchSet | ArrayLike, *, test_size: float = 0.2, random_state: int
) -> Split:
    """Split at random, with the same share of vehicles on both sides.

    On frames of a drive this tests on near-copies of what was trained on (see `split_leakage`): quote
    `split_sequences` or `split_sources` beside it.

    Parameters
    ----------
    patches_or_labels
        The set, or its ``(N,)`` labels.
    test_size
        Share to test on, in (0, 1); rounded up to whole patches.
    random_state
        Seed; the same seed gives the same split.

    Returns
    -------
    Split
        Rows in ascending order; together they are all rows.

    Raises
    ------
    InvalidInputError
        If a class has too few patches for both sides, or an argument is out of range.

    Examples
    --------
    >>> train, test = split_random([1, 1, 1, 1, 1, 0, 0, 0, 0, 0], random_state=0)
    >>> len(train), len(test)
    (8, 2)
    """
    from sklearn.model_selection import train_test_split

    given = patches_or_labels
    labels = given.labels if isinstance(given, PatchSet) else _check_labels(given, "patches_or_labels")
    share = _check_share(test_size)
    seed = check_integer(random_state, "random_state", low=0, high=2**32 - 1)
    try:
        train, test = train_test_split(
            np.arange(len(labels)), test_size=share, random_state=seed, stratify=labels
        )
    except ValueError as error:
        raise InvalidInputError(
            f"patches_or_labels cannot be split at test_size={share:g}: {labels.sum()} vehicles and "
            f"{(~labels).sum()} others are too few; pass more patches or another test_size"
        ) from error
    return Split(np.sort(train), np.sort(test))


def _check_share(test_size: object) -> float:
    share = check_number(test_size, "test_size", above=0)
    if share >= 1:
        raise InvalidInputError(f"test_size must be a share in (0, 1), got {share:g}; 0.2 is a fifth")
    return share


def split_sequences(patch_set: PatchSet, *, test_size: float = 0.2) -> Split:
    """Test on the end of each folder, by the number in the file name.

    Where a folder is numbered through its drives, as those of GTI are, the frames of one car stay on one
    side. ``KITTI_extracted`` is not: its numbers are shuffled, and on the course's patches `split_leakage` is
    0.21, against 0.22 for a random split and 0.02 for `split_sources`.

    Parameters
    ----------
    patch_set
        The patches; folders are told apart by their whole path.
    test_size
        Share of each folder to test on, in (0, 1), rounded. A folder of two or more patches gives at least
        one to each side; a single patch is trained on.

    Returns
    -------
    Split
        Rows in ascending order; together they are all rows.

    Raises
    ------
    InvalidInputError
        If `test_size` is out of range, or every folder holds a single patch.

    Examples
    --------
    >>> names = [f"vehicles/KITTI/{number}.png" for number in (10, 9, 8, 7, 11)]
    >>> split_sequences(PatchSet(np.zeros((5, 64, 64, 3), np.uint8), [1] * 5, names)).test
    array([4])
    """
    share = _check_share(test_size)
    folders: dict[str, list[int]] = {}
    for row, name in enumerate(patch_set.names):
        folders.setdefault(parent_folder(name), []).append(row)
    tested = np.zeros(len(patch_set), np.bool_)
    for rows in folders.values():
        rows.sort(key=lambda row: natural_key(patch_set.names[row]))
        count = min(max(round(len(rows) * share), 1), len(rows) - 1)
        tested[rows[len(rows) - count :]] = True
    if not tested.any():
        raise InvalidInputError("patch_set holds no folder of two or more patches; use split_random")
    return Split(np.flatnonzero(~tested), np.flatnonzero(tested))


def split_sources(
    patch_set: PatchSet, *, train: Sequence[str] = ("GTI",), test: Sequence[str] = ("KITTI", "Extras")
) -> Split:
    """Train on some sources and test on others: another camera, another country.

    The default trains on the GTI vehicles and GTI non-vehicles and tests on the KITTI vehicles and the
    Extras; the reverse is ``train=("KITTI", "Extras"), test=("GTI",)``.

    Parameters
    ----------
    patch_set
        The patches.
    train, test
        How the sources of each side begin: ``"GTI"`` takes ``GTI``, ``GTI_Far`` and the others of GTI.
        Sources of neither side are left out.

    Returns
    -------
    Split
        Rows in ascending order.

    Raises
    ------
    InvalidInputError
        If a beginning matches no source, a source falls on both sides, or a side lacks one of the classes.

    Examples
    --------
    >>> names = ["v/GTI_Far/1.png", "n/GTI/1.png", "v/KITTI_extracted/1.png", "n/Extras/1.png"]
    >>> patches = PatchSet(np.zeros((4, 64, 64, 3), np.uint8), [1, 0, 1, 0], names)
    >>> split_sources(patches)
    Split(train=array([0, 1]), test=array([2, 3]))
    """
    known = ", ".join(patch_set.counts()) or "none"
    masks = []
    for side, starts in (("train", train), ("test", test)):
        starts = (starts,) if isinstance(starts, str) else tuple(starts)
        found = [np.char.startswith(patch_set.sources, start) for start in starts]
        for start, mask in zip(starts, found):
            if not start or not mask.any():
                raise InvalidInputError(f"{side} must name sources of patch_set ({known}); got {start!r}")
        chosen = np.logical_or.reduce(found) if found else np.zeros(len(patch_set), np.bool_)
        if len(np.unique(patch_set.labels[chosen])) < 2:
            raise InvalidInputError(
                f"{side} must name sources of vehicles and of non-vehicles, got {starts}; it has {known}"
            )
        masks.append(chosen)
    if (masks[0] & masks[1]).any():
        shared = sorted(set(patch_set.sources[masks[0] & masks[1]].tolist()))
        raise InvalidInputError(f"train and test must share no source, both take {shared}; narrow one down")
    return Split(np.flatnonzero(masks[0]), np.flatnonzero(masks[1]))


def find_near_duplicates(
    patches: PatchSet | NDArray[np.uint8], *, threshold: float = 0.95
) -> NDArray[np.intp]:
    """Find the patches that have a near-copy among the others.

    Patches are compared by the correlation of their 16x16 gray thumbnails, so that brightness and contrast
    do not count; a patch of one plain colour is a copy of nothing. Labels do not count either.

    Parameters
    ----------
    patches
        A set, or ``(N, 64, 64, 3)`` uint8 RGB.
    threshold
        Correlation, in (0, 1], from which two patches are near-copies.

    Returns
    -------
    numpy.ndarray
        ``(M, 2)`` row numbers: each patch that has a near-copy, ascending, and the patch most like it.

    Raises
    ------
    InvalidInputError
        If `patches` are of another kind, or `threshold` is out of range.

    Examples
    --------
    >>> patches = np.random.default_rng(0).integers(0, 256, (4, 64, 64, 3), np.uint8)
    >>> patches[3] = patches[1] // 2
    >>> find_near_duplicates(patches)
    array([[1, 3],
           [3, 1]])
    """
    limit = check_number(threshold, "threshold", above=0, high=1)
    thumbnails = _thumbnails(patches)
    nearest, correlation = _nearest(thumbnails, thumbnails, same=True)
    rows = np.flatnonzero(correlation >= limit)
    return np.stack([rows, nearest[rows]], axis=1)


def split_leakage(patch_set: PatchSet, split: Split, *, threshold: float = 0.95) -> float:
    """Share of the test patches that have a near-copy among the training patches.

    Parameters
    ----------
    patch_set
        The patches.
    split
        A split of them.
    threshold
        As in `find_near_duplicates`.

    Returns
    -------
    float
        In [0, 1]; 0 is a split whose test is news to the classifier.

    Raises
    ------
    InvalidInputError
        If `split` names rows that `patch_set` has not, or `threshold` is out of range.

    Examples
    --------
    >>> patches = np.random.default_rng(0).integers(0, 256, (4, 64, 64, 3), np.uint8)
    >>> patches[3] = patches[0]
    >>> patch_set = PatchSet(patches, [1, 1, 0, 0], ["1.png", "2.png", "3.png", "4.png"])
    >>> split_leakage(patch_set, Split([0, 1], [2, 3]))
    0.5
    """
    limit = check_number(threshold, "threshold", above=0, high=1)
    last = max(int(rows.max()) for rows in split)
    if last >= len(patch_set):
        raise InvalidInputError(
            f"split names row {last} of a set of {len(patch_set)} patches; pass the set it was made from"
        )
    thumbnails = _thumbnails(patch_set)
    _, correlation = _nearest(thumbnails[split.test], thumbnails[split.train], same=False)
    return float((correlation >= limit).mean())


def _thumbnails(patches: PatchSet | NDArray[np.uint8]) -> NDArray[np.float32]:
    """16x16 gray of each patch, without mean and of length one: products are correlations."""
    images = patches.patches if isinstance(patches, PatchSet) else check_patches(patches, PATCH_SIZE)
    vectors = np.empty((len(images), 16 * 16), np.float32)
    for row, image in enumerate(images):
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
        vectors[row] = cv2.resize(gray, (16, 16), interpolation=cv2.INTER_AREA).ravel()
    vectors -= vectors.mean(axis=1, keepdims=True)
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    # A plain patch has only rounding errors left to compare.
    return np.asarray(np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0.01))


def _nearest(
    queries: NDArray[np.float32], pool: NDArray[np.float32], *, same: bool
) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Row in `pool` most like each query, and their correlation; with `same`, other than itself."""
    nearest = np.zeros(len(queries), np.intp)
    correlation = np.full(len(queries), -np.inf, np.float32)
    for start in range(0, len(queries), 512):
        products = queries[start : start + 512] @ pool.T
        rows = np.arange(len(products))
        if same:
            products[rows, start + rows] = -np.inf
        best = products.argmax(axis=1)
        nearest[start : start + 512] = best
        correlation[start : start + 512] = products[rows, best]
    return nearest, correlation


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
