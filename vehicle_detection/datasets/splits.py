"""Splits into training and test patches, near duplicates among patches, and the leakage they cause."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import check, describe, natural_key
from vehicle_detection.datasets.archives import parent_folder
from vehicle_detection.datasets.patches import PatchSet, check_labels
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.features import PATCH_SIZE

_PATCH_SET_REMEDY = "read one with load_training_patches"

_CHUNK = 512  # Rows compared with all others at a time, to limit the memory of the correlation matrix.
_ROUNDING = 1e-5  # relative error of a correlation


@dataclass(frozen=True, eq=False, repr=False)
class Split:
    """Row numbers of training and test patches; unpacks as ``train, test = split``.

    Both parts are ``(N,)`` intp, not empty, and share no row; anything else raises an `InvalidInputError`.
    Functions return all rows (`split_sources`: those of its sources), ascending in each part.

    >>> train, test = Split([0, 2], [1])
    >>> train
    array([0, 2])
    """

    train: NDArray[np.intp]
    test: NDArray[np.intp]

    def __post_init__(self) -> None:
        for name in ("train", "test"):
            rows = check.array(getattr(self, name), name)
            if rows.ndim != 1 or not rows.size or rows.dtype.kind not in "iu" or rows.min() < 0:
                raise InvalidInputError(f"{name} must be a list of row numbers, got {describe(rows)}")
            object.__setattr__(self, name, rows.astype(np.intp, copy=False))
        rows = np.concatenate([self.train, self.test])
        if len(np.unique(rows)) != len(rows):
            raise InvalidInputError("train and test must not share or repeat rows; drop the duplicates")

    def __iter__(self) -> Iterator[NDArray[np.intp]]:
        return iter((self.train, self.test))

    def __repr__(self) -> str:
        return f"Split(train: {len(self.train):,} rows, test: {len(self.test):,} rows)"


def split_random(
    patches_or_labels: PatchSet | ArrayLike, *, test_size: float = 0.2, random_state: int
) -> Split:
    """Split at random, with the same fraction of vehicles in both parts.

    On frames of a drive this tests on near duplicates of training patches (see `split_leakage`). Report
    `split_groups`, `split_sequences` or `split_sources` as well. The patches are a set or its ``(N,)``
    labels; `test_size` is the fraction of test patches, in (0, 1), rounded up to whole patches.

    >>> split_random([1, 1, 1, 1, 1, 0, 0, 0, 0, 0], random_state=0)
    Split(train: 8 rows, test: 2 rows)
    """
    from sklearn.model_selection import train_test_split

    given = patches_or_labels
    labels = given.labels if isinstance(given, PatchSet) else check_labels(given, "patches_or_labels")
    fraction = _check_test_size(test_size)
    seed = check.integer(random_state, "random_state", low=0, high=2**32 - 1)
    rows = np.arange(len(labels))
    try:
        parts = train_test_split(rows, test_size=fraction, random_state=seed, stratify=labels)
    except ValueError as error:
        raise InvalidInputError(
            f"{labels.sum()} vehicles and {(~labels).sum()} non-vehicles are too few for a test part of "
            f"{fraction:.0%}; use more patches"
        ) from error
    return Split(*map(np.sort, parts))


def split_sequences(patch_set: PatchSet, *, test_size: float = 0.2) -> Split:
    """Test on the end of each folder, in the order of the numbers in the file names.

    If the numbers follow the drive, as in the GTI folders, the frames of one car stay in one part. Those of
    ``KITTI_extracted`` are shuffled: on the course's patches `split_leakage` is 0.21, compared with 0.22 for
    a random split, 0.02 for `split_sources` and 0 for `split_groups`. `test_size` is the fraction of each
    folder to test on, in (0, 1), rounded; a folder of two or more patches gives at least one to each part.

    >>> names = [f"vehicles/KITTI/{number}.png" for number in (10, 9, 8, 7, 11)]
    >>> split_sequences(PatchSet(np.zeros((5, 64, 64, 3), np.uint8), [1] * 5, names)).test
    array([4])
    """
    check.instance(patch_set, "patch_set", PatchSet, _PATCH_SET_REMEDY)
    fraction = _check_test_size(test_size)
    folders: dict[str, list[int]] = {}
    for row, name in enumerate(patch_set.names):
        folders.setdefault(parent_folder(name), []).append(row)
    tested = np.zeros(len(patch_set), np.bool_)
    for rows in folders.values():
        rows.sort(key=lambda row: natural_key(patch_set.names[row]))
        count = min(max(round(len(rows) * fraction), 1), len(rows) - 1)
        tested[rows[len(rows) - count :]] = True
    if not tested.any():
        raise InvalidInputError(
            "patch_set must hold a folder of two or more patches; add patches, or split at random"
        )
    return Split(np.flatnonzero(~tested), np.flatnonzero(tested))


def split_groups(
    patch_set: PatchSet, *, test_size: float = 0.2, threshold: float = 0.9, random_state: int = 0
) -> Split:
    """Split groups of near duplicates at random, so that `split_leakage` at `threshold` is 0.

    Near duplicates, and their near duplicates in turn, form a group. In random order, each group goes to the
    test part if it still fits into `test_size` of its folders, else to the training part. Two crops of one
    car may differ too much to be near duplicates: `split_sequences` keeps more of them together in folders
    whose numbers follow the drive (GTI), this split in those whose numbers are shuffled (KITTI).

    Parameters
    ----------
    patch_set, test_size
        As for `split_sequences`, but of each class in a folder; large groups may make the test part smaller.
    threshold, random_state
        As in `find_near_duplicates`, and the seed. On the course's vehicles, most pairs at 0.9 show the same
        car; at 0.85 a quarter of all patches fall into one group by chance.

    Examples
    --------
    >>> patches = np.random.default_rng(0).integers(0, 256, (6, 64, 64, 3), np.uint8)
    >>> patches[1::2] = patches[::2]
    >>> patch_set = PatchSet(patches, [1] * 6, [f"vehicles/KITTI/{number}.png" for number in range(6)])
    >>> split_groups(patch_set, test_size=0.4).test
    array([4, 5])
    """
    check.instance(patch_set, "patch_set", PatchSet, _PATCH_SET_REMEDY)
    fraction = _check_test_size(test_size)
    limit = check.number(threshold, "threshold", above=0, high=1)
    seed = check.integer(random_state, "random_state", low=0, high=2**32 - 1)
    strata = [f"{label:d}{parent_folder(name)}" for label, name in zip(patch_set.labels, patch_set.names)]
    _, stratum, sizes = np.unique(strata, return_inverse=True, return_counts=True)
    # Test patches that each folder may still give, as in split_sequences; clipping to [1, 0] gives 0.
    remaining = np.clip(np.round(sizes * fraction).astype(np.intp), 1, sizes - 1)
    groups = group_near_duplicates(make_thumbnails(patch_set), limit * (1 - 2 * _ROUNDING))
    order = np.argsort(groups, kind="stable")
    members = np.split(order, np.flatnonzero(np.diff(groups[order])) + 1)
    tested = np.zeros(len(patch_set), np.bool_)
    for group in np.random.default_rng(seed).permutation(len(members)):
        needed = np.bincount(stratum[members[group]], minlength=len(remaining))
        if (needed <= remaining).all():
            tested[members[group]] = True
            remaining -= needed
    if not tested.any():
        raise InvalidInputError(
            f"patch_set must hold a group of near duplicates that fits into the test part, {fraction:.0%} of "
            "a folder; add patches, split at random, or raise test_size or threshold"
        )
    return Split(np.flatnonzero(~tested), np.flatnonzero(tested))


def split_sources(
    patch_set: PatchSet, *, train: Sequence[str] = ("GTI",), test: Sequence[str] = ("KITTI", "Extras")
) -> Split:
    """Train on some sources and test on others, which are from another camera and country.

    `train` and `test` are prefixes of the sources of each part: ``"GTI"`` selects ``GTI``, ``GTI_Far`` and
    so on. Rows of other sources are left out. The reverse of the default is ``train=("KITTI", "Extras"),
    test=("GTI",)``.

    >>> names = ["v/GTI_Far/1.png", "n/GTI/1.png", "v/KITTI_extracted/1.png", "n/Extras/1.png"]
    >>> split_sources(PatchSet(np.zeros((4, 64, 64, 3), np.uint8), [1, 0, 1, 0], names)).test
    array([2, 3])
    """
    check.instance(patch_set, "patch_set", PatchSet, _PATCH_SET_REMEDY)
    known = ", ".join(patch_set.counts()) or "none"
    masks = []
    for side, prefixes in (("train", train), ("test", test)):
        prefixes = (prefixes,) if isinstance(prefixes, str) else check.sequence(prefixes, side, "names")
        for prefix in prefixes:
            check.instance(prefix, side, str, "name the sources by the beginnings of their names")
            if not prefix or not np.char.startswith(patch_set.sources, prefix).any():
                raise InvalidInputError(f"{side} must name sources of patch_set ({known}); got {prefix!r}")
        mask = np.array([source.startswith(prefixes) for source in patch_set.sources], np.bool_)
        if len(np.unique(patch_set.labels[mask])) < 2:
            raise InvalidInputError(
                f"{side} must name sources of vehicles and of non-vehicles, got {prefixes}; "
                f"patch_set has {known}"
            )
        masks.append(mask)
    shared = sorted(set(patch_set.sources[masks[0] & masks[1]].tolist()))
    if shared:
        raise InvalidInputError(
            f"train and test must not share sources, both match {shared}; use longer prefixes"
        )
    return Split(np.flatnonzero(masks[0]), np.flatnonzero(masks[1]))


SPLIT_NAMES = ("sequences", "groups", "gti_to_kitti", "kitti_to_gti", "random")
SEEDED_SPLITS = ("groups", "random")  # the splits that depend on the seed


def make_split(patch_set: PatchSet, name: str, *, test_size: float = 0.2, random_state: int = 0) -> Split:
    """Make a split by its name, one of `SPLIT_NAMES`."""
    if name in SEEDED_SPLITS:
        split = split_random if name == "random" else split_groups
        return split(patch_set, test_size=test_size, random_state=random_state)
    if name == "sequences":
        return split_sequences(patch_set, test_size=test_size)
    if name == "gti_to_kitti":
        return split_sources(patch_set)
    return split_sources(patch_set, train=("KITTI", "Extras"), test=("GTI",))


def find_near_duplicates(
    patches: PatchSet | NDArray[np.uint8], *, threshold: float = 0.95
) -> NDArray[np.intp]:
    """Find the patches that have a near duplicate in the same set.

    Patches are compared by the correlation of their 16x16 gray thumbnails, which ignores brightness and
    contrast; near duplicates reach `threshold`, in (0, 1]. A uniform patch has none. Labels are ignored.

    Returns ``(M, 2)`` row numbers: each patch that has a near duplicate, ascending, and the most similar
    patch.

    >>> patches = np.random.default_rng(0).integers(0, 256, (4, 64, 64, 3), np.uint8)
    >>> patches[3] = patches[1] // 2
    >>> find_near_duplicates(patches)
    array([[1, 3],
           [3, 1]])
    """
    limit = check.number(threshold, "threshold", above=0, high=1)
    thumbnails = make_thumbnails(patches)
    nearest, correlation = find_nearest(thumbnails, thumbnails, same=True)
    rows = np.flatnonzero(correlation >= limit * (1 - _ROUNDING))
    return np.stack([rows, nearest[rows]], axis=1)


def make_thumbnails(patches: PatchSet | NDArray[np.uint8]) -> NDArray[np.float32]:
    """16x16 gray thumbnails with zero mean and unit length, ``(N, 256)``; products are correlations."""
    images = patches.patches if isinstance(patches, PatchSet) else check.patches(patches, PATCH_SIZE)
    vectors = np.empty((len(images), 16 * 16), np.float32)
    for row, image in enumerate(images):
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
        vectors[row] = cv2.resize(gray, (16, 16), interpolation=cv2.INTER_AREA).ravel()
    vectors -= vectors.mean(axis=1, keepdims=True)
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    # Only rounding errors remain of a uniform patch: set them to 0.
    return np.asarray(np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0.01))


def find_nearest(
    queries: NDArray[np.float32], pool: NDArray[np.float32], *, same: bool
) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Row of `pool` most similar to each query, and their correlation; `same` excludes the query itself."""
    nearest = np.zeros(len(queries), np.intp)
    correlation = np.full(len(queries), -np.inf, np.float32)
    for start in range(0, len(queries), _CHUNK):
        products = queries[start : start + _CHUNK] @ pool.T
        rows = np.arange(start, start + len(products))
        if same:
            products[rows - start, rows] = -np.inf
        nearest[rows], correlation[rows] = products.argmax(axis=1), products.max(axis=1)
    return nearest, correlation


def group_near_duplicates(thumbnails: NDArray[np.float32], limit: float) -> NDArray[np.int32]:
    """Group number of each patch, ``(N,)``: connected components of the near-duplicate relation."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(thumbnails)
    groups = np.arange(count, dtype=np.int32)
    for start in range(0, count, _CHUNK):
        similar = thumbnails[start : start + _CHUNK] @ thumbnails[start:].T >= limit
        rows, others = groups[start + np.array(similar.nonzero())]
        # Merge the groups chunk by chunk: all pairs at once may not fit into memory.
        edges = coo_array((np.ones(len(rows), np.bool_), (rows, others)), shape=(count, count))
        groups = connected_components(edges, directed=False)[1][groups]
    return groups


def split_leakage(patch_set: PatchSet, split: Split, *, threshold: float = 0.95) -> float:
    """Fraction of test patches that have a near duplicate among the training patches, in [0, 1].

    It is 0 for a split by `split_groups` at this threshold (see `find_near_duplicates`) or a lower one.

    >>> patches = np.random.default_rng(0).integers(0, 256, (4, 64, 64, 3), np.uint8)
    >>> patches[3] = patches[0]
    >>> patch_set = PatchSet(patches, [1, 1, 0, 0], ["1.png", "2.png", "3.png", "4.png"])
    >>> split_leakage(patch_set, Split([0, 1], [2, 3]))
    0.5
    """
    check.instance(patch_set, "patch_set", PatchSet, _PATCH_SET_REMEDY)
    check_split(split, patch_set)
    limit = check.number(threshold, "threshold", above=0, high=1)
    thumbnails = make_thumbnails(patch_set)
    _, correlation = find_nearest(thumbnails[split.test], thumbnails[split.train], same=False)
    return float((correlation >= limit * (1 - _ROUNDING)).mean())


def check_split(split: Split, patch_set: PatchSet, name: str = "split") -> None:
    """Raise unless the patches have all rows of the split."""
    check.instance(split, name, Split, "split_sequences and others return one")
    last = max(int(rows.max()) for rows in split)
    if last >= len(patch_set):
        raise InvalidInputError(
            f"{name} holds row {last}, but patch_set has {len(patch_set)} patches; pass the set that it is of"
        )


def _check_test_size(test_size: object) -> float:
    fraction = check.number(test_size, "test_size", above=0)
    if fraction >= 1:
        raise InvalidInputError(f"test_size must be a fraction in (0, 1), got {fraction:g}; 0.2 is a fifth")
    return fraction
