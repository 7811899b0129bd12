"""Figures of the training patches: what they show, how many there are, which are near duplicates."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import check_integer, check_type, describe
from vehicle_detection.datasets import PatchSet, Split, make_thumbnails
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.plotting.style import (
    OTHER,
    VEHICLE,
    check_count,
    check_picture,
    check_sequence,
    new_axes,
    put_tiles,
    spread,
    tile_axes,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_REMEDY = "read one with load_training_patches, or build PatchSet(patches, labels, names)"


def _class_color(label: object) -> Any:
    return None if label is None else VEHICLE if label else OTHER


def plot_patches(
    patches: PatchSet | NDArray[np.uint8] | Sequence[NDArray[np.uint8]],
    *,
    count: int = 32,
    columns: int = 8,
    labels: ArrayLike | None = None,
    captions: Sequence[str] | None = None,
    scores: ArrayLike | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Show patches on a grid, each with a caption, in an edge of its class's color.

    Parameters
    ----------
    patches
        A set, or ``(H, W, 3)`` images.
    count
        Where there are more, this many are taken at even distances.
    columns
        Patches in a row.
    labels
        ``(N,)`` 1 for a vehicle, 0 for anything else; those of a set are known. None draws no edges.
    captions
        A text for each patch; by default the source of a set's patches.
    scores
        ``(N,)`` numbers that go to the captions, such as decision values.
    ax
        Where to draw; None makes a new figure.

    Returns
    -------
    matplotlib.axes.Axes
        With one picture and one text a patch.

    Raises
    ------
    InvalidInputError
        If a patch is malformed, or a column is not as long as the patches.

    Examples
    --------
    >>> from vehicle_detection import render_patches
    >>> patches, labels = render_patches(20)
    >>> len(plot_patches(patches, labels=labels, count=8).images)
    8
    """
    kinds: list[Any]
    listed: Any
    if isinstance(patches, PatchSet):
        listed = patches.patches
        kinds = patches.labels.tolist() if labels is None else _column(labels, "labels", len(patches))
        texts = check_count(captions or patches.sources.tolist(), "captions", len(patches), "patches")
    else:
        listed = check_sequence(patches, "patches", "images")
        kinds = _column(labels, "labels", len(listed))
        texts = check_count(captions, "captions", len(listed), "patches")
    values = _column(scores, "scores", len(listed))
    rows = spread(len(listed), check_integer(count, "count", low=1, high=1000)).tolist()
    if not rows:
        raise InvalidInputError("patches must hold at least one patch; got none")
    lines = [[texts[row] or "", "" if values[row] is None else f"score {values[row]:+.2f}"] for row in rows]
    across = min(check_integer(columns, "columns", low=1, high=100), len(rows))
    named = max(sum(map(bool, line)) for line in lines)
    axes = tile_axes(ax, len(rows), across, inches=1.25, lines=named)
    put_tiles(
        axes,
        [check_picture(listed[row], f"patches[{row}]") for row in rows],
        ["\n".join(filter(None, line)) for line in lines],
        [_class_color(kinds[row]) for row in rows],
        across,
        inches=1.25,
        lines=named,
    )
    if any(kinds[row] is not None for row in rows):
        _class_legend(axes)
    return axes


def _column(values: ArrayLike | None, name: str, count: int) -> list[Any]:
    """Numbers, one for each patch; None for each if there are none."""
    if values is None:
        return [None] * count
    array = np.asarray(values)
    if array.shape != (count,) or array.dtype.kind not in "biuf":
        raise InvalidInputError(
            f"{name} must be one number for each of {count} patches; got {describe(array)}"
        )
    return list(array.tolist())


def _class_legend(axes: Axes) -> None:
    from matplotlib.patches import Patch

    handles = [
        Patch(edgecolor=color, facecolor="none", linewidth=2, label=name)
        for name, color in (("vehicle", VEHICLE), ("other", OTHER))
    ]
    axes.legend(handles=handles, loc="lower right", bbox_to_anchor=(1, 1), ncols=2, fontsize=8, frameon=False)


def plot_balance(patch_set: PatchSet, *, ax: Axes | None = None) -> Axes:
    """Plot how many patches come from each source, vehicles first, and the share of each class.

    Parameters
    ----------
    patch_set
        The patches.
    ax
        Where to draw; None makes a new figure.

    Returns
    -------
    matplotlib.axes.Axes
        With one bar for each class and source, from top to bottom.

    Raises
    ------
    InvalidInputError
        If `patch_set` is no `PatchSet`, or empty.

    Examples
    --------
    >>> names = ["vehicles/KITTI/1.png", "vehicles/KITTI/2.png", "non-vehicles/GTI/1.png"]
    >>> axes = plot_balance(PatchSet(np.zeros((3, 64, 64, 3), np.uint8), [1, 1, 0], names))
    >>> [text.get_text() for text in axes.get_yticklabels()]
    ['KITTI', 'GTI']
    """
    _check_set(patch_set)
    counted = Counter(zip((~patch_set.labels).tolist(), patch_set.sources.tolist()))
    keys = sorted(counted)
    axes = new_axes(ax, 7, 1.2 + 0.35 * len(keys))
    for other, name in ((False, "vehicles"), (True, "other")):
        places = [place for place, key in enumerate(keys) if key[0] == other]
        share = float((~patch_set.labels == other).mean())
        total = sum(counted[keys[place]] for place in places)
        if places:
            bars = axes.barh(
                places,
                [counted[keys[place]] for place in places],
                color=OTHER if other else VEHICLE,
                label=f"{name}: {total:,} ({share:.1%})",
            )
            axes.bar_label(bars, fmt="{:,.0f}", padding=3, fontsize=9)
    axes.set_yticks(range(len(keys)), [source for _, source in keys])
    axes.invert_yaxis()
    axes.set_xlabel("patches")
    axes.margins(x=0.14)
    axes.legend(loc="upper left", bbox_to_anchor=(0, 1.0), ncols=2, frameon=False, fontsize=9)
    axes.set_ylim(len(keys) - 0.4, -1.2)
    axes.spines[["top", "right"]].set_visible(False)
    return axes


def _check_set(patch_set: PatchSet) -> None:
    check_type(patch_set, "patch_set", PatchSet, _REMEDY)
    if not len(patch_set):
        raise InvalidInputError(f"patch_set must hold patches, got none; {_REMEDY}")


def plot_near_duplicates(
    patch_set: PatchSet,
    pairs: NDArray[Any],
    *,
    split: Split | None = None,
    count: int = 10,
    ax: Axes | None = None,
) -> Axes:
    """Show pairs of patches that are near duplicates: each patch, and under it the one most like it.

    Parameters
    ----------
    patch_set
        The patches.
    pairs
        ``(M, 2)`` row numbers, what `find_near_duplicates` returns.
    split
        A split of the patches: only pairs that it tears apart are shown, the tested patch above.
    count
        Where there are more pairs, this many are taken at even distances.
    ax
        Where to draw; None makes a new figure.

    Returns
    -------
    matplotlib.axes.Axes
        With two pictures and two texts a pair: the source, and the correlation of the two. The title tells
        which share of the patches has a near duplicate, or which share of the tested ones one to train on.

    Raises
    ------
    InvalidInputError
        If an argument is malformed, or there is no pair to show.

    Examples
    --------
    >>> patches = np.random.default_rng(0).integers(0, 256, (4, 64, 64, 3), np.uint8)
    >>> patches[3] = patches[1] // 2
    >>> drawn = PatchSet(patches, [1, 1, 1, 1], [f"vehicles/drawn/{row}.png" for row in range(4)])
    >>> plot_near_duplicates(drawn, np.array([[1, 3], [3, 1]])).get_title()
    '2 of 4 patches have a near duplicate (50.0%)'
    """
    _check_set(patch_set)
    rows = np.asarray(pairs)
    if rows.ndim != 2 or rows.shape[1] != 2 or rows.dtype.kind not in "iu" or not _inside(rows, patch_set):
        raise InvalidInputError(
            f"pairs must be (M, 2) row numbers of the {len(patch_set)} patches, got {describe(rows)}; "
            "pass what find_near_duplicates returns for this set"
        )
    whole, title = len(patch_set), "patches have a near duplicate"
    if split is not None:
        check_type(split, "split", Split, "make one with split_random or the like")
        tested = np.zeros(len(patch_set), np.bool_)
        tested[split.test[split.test < len(patch_set)]] = True
        rows = rows[tested[rows[:, 0]] & ~tested[rows[:, 1]]]
        whole, title = len(split.test), "tested patches have their nearest copy among the training patches"
    if not len(rows):
        raise InvalidInputError("pairs must hold at least one pair to show; got none")
    chosen = rows[spread(len(rows), check_integer(count, "count", low=1, high=200))]
    per_line = min(len(chosen), 10)
    images: list[NDArray[Any]] = []
    captions: list[str] = []
    for start in range(0, len(chosen), per_line):
        line = chosen[start : start + per_line]
        for side in range(2):
            images += [patch_set.patches[row] for row in line[:, side]]
            texts = patch_set.sources[line[:, 0]] if side == 0 else _correlations(patch_set, line)
            captions += [str(text) for text in texts]
            blanks = (per_line - len(line)) if start else 0
            images += [np.full((1, 1, 3), 255, np.uint8)] * blanks
            captions += [""] * blanks
    axes = tile_axes(ax, len(images), per_line, inches=1.2, lines=1)
    put_tiles(axes, images, captions, [None] * len(images), per_line, inches=1.2, lines=1)
    axes.set_title(f"{len(rows):,} of {whole:,} {title} ({len(rows) / whole:.1%})", fontsize=10)
    return axes


def _inside(rows: NDArray[Any], patch_set: PatchSet) -> bool:
    return not rows.size or (rows.min() >= 0 and bool(rows.max() < len(patch_set)))


def _correlations(patch_set: PatchSet, pairs: NDArray[Any]) -> list[str]:
    first, second = (make_thumbnails(patch_set[pairs[:, side]]) for side in range(2))
    return [f"r = {value:.3f}" for value in (first * second).sum(axis=1)]
