"""Patches to train on and patches to test on, and how far the two are alike."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import check_integer, check_number, describe
from vehicle_detection.datasets.archives import natural_key, parent_folder
from vehicle_detection.datasets.near_duplicates import find_nearest, group_copies, make_thumbnails
from vehicle_detection.datasets.patches import PatchSet, check_labels
from vehicle_detection.errors import InvalidInputError


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


def split_random(
    patches_or_labels: PatchSet | ArrayLike, *, test_size: float = 0.2, random_state: int
) -> Split:
    """Split at random, with the same share of vehicles on both sides.

    On frames of a drive this tests on near duplicates of what was trained on (see `split_leakage`): quote
    `split_groups`, `split_sequences` or `split_sources` beside it.

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
    labels = given.labels if isinstance(given, PatchSet) else check_labels(given, "patches_or_labels")
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


def split_sequences(patch_set: PatchSet, *, test_size: float = 0.2) -> Split:
    """Test on the end of each folder, by the number in the file name.

    Where a folder is numbered through its drives, as those of GTI are, the frames of one car stay on one
    side. ``KITTI_extracted`` is not: its numbers are shuffled, and on the course's patches `split_leakage` is
    0.21, against 0.22 for a random split, 0.02 for `split_sources` and 0 for `split_groups`.

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


def split_groups(
    patch_set: PatchSet, *, test_size: float = 0.2, threshold: float = 0.9, random_state: int = 0
) -> Split:
    """Split at random, with near duplicates on one side: `split_leakage` at `threshold` is 0.

    Near duplicates, and near duplicates of those, form a group. In random order, each group is tested on as a whole
    where it still fits into the share of its folders, and trained on where it does not; so a group of more
    than that share is always trained on.

    Two crops of one car may differ too much to be near duplicates. Where a folder is numbered through its drives,
    as those of GTI are, `split_sequences` keeps more of them together; this split does for
    ``KITTI_extracted``, whose numbers are shuffled.

    Parameters
    ----------
    patch_set
        The patches; folders are told apart by their whole path.
    test_size
        Share of each folder, and of each class in it, to test on, in (0, 1), rounded; large groups may leave
        less.
    threshold
        Correlation, in (0, 1], from which two patches are near duplicates, as in `find_near_duplicates`. Of the
        course's vehicles, pairs at 0.9 show mostly one car; at 0.85 chance makes a quarter of all patches one
        group.
    random_state
        Seed; the same seed gives the same split.

    Returns
    -------
    Split
        Rows in ascending order; together they are all rows.

    Raises
    ------
    InvalidInputError
        If an argument is out of range, or no group fits into the share to test on.

    Examples
    --------
    >>> patches = np.random.default_rng(0).integers(0, 256, (6, 64, 64, 3), np.uint8)
    >>> patches[1::2] = patches[::2]
    >>> patch_set = PatchSet(patches, [1] * 6, [f"vehicles/KITTI/{number}.png" for number in range(6)])
    >>> split_groups(patch_set, test_size=0.4)
    Split(train=array([0, 1, 2, 3]), test=array([4, 5]))
    """
    share = _check_share(test_size)
    limit = check_number(threshold, "threshold", above=0, high=1)
    seed = check_integer(random_state, "random_state", low=0, high=2**32 - 1)
    strata = [f"{label:d}{parent_folder(name)}" for label, name in zip(patch_set.labels, patch_set.names)]
    _, stratum, sizes = np.unique(strata, return_inverse=True, return_counts=True)
    # As in split_sequences; clipping to [1, 0] gives 0.
    room = np.clip(np.round(sizes * share).astype(np.intp), 1, sizes - 1)

    # A little below the limit, so that no pair at the limit comes apart by a rounding error.
    groups = group_copies(make_thumbnails(patch_set), limit * (1 - 1e-5))
    order = np.argsort(groups, kind="stable")
    members = np.split(order, np.flatnonzero(np.diff(groups[order])) + 1)
    tested = np.zeros(len(patch_set), np.bool_)
    for group in np.random.default_rng(seed).permutation(len(members)):
        needed = np.bincount(stratum[members[group]], minlength=len(room))
        if (needed <= room).all():
            tested[members[group]] = True
            room -= needed
    if not tested.any():
        raise InvalidInputError(
            f"patch_set holds no group of near duplicates that fits into test_size={share:g} of its folders; "
            "raise test_size or threshold"
        )
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


def split_leakage(patch_set: PatchSet, split: Split, *, threshold: float = 0.95) -> float:
    """Share of the test patches that have a near duplicate among the training patches.

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
    thumbnails = make_thumbnails(patch_set)
    _, correlation = find_nearest(thumbnails[split.test], thumbnails[split.train], same=False)
    return float((correlation >= limit).mean())


def _check_share(test_size: object) -> float:
    share = check_number(test_size, "test_size", above=0)
    if share >= 1:
        raise InvalidInputError(f"test_size must be a share in (0, 1), got {share:g}; 0.2 is a fifth")
    return share
