"""Figures of training patches: a grid of patches, class balance, and near duplicates."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import check_integer, check_type, describe
from vehicle_detection.datasets import PatchSet, Split, make_thumbnails
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.plotting import style
from vehicle_detection.plotting.style import OTHER, VEHICLE, Image

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def plot_patches(
    patches: PatchSet | NDArray[np.uint8] | Sequence[Image],
    *,
    count: int = 32,
    columns: int = 8,
    labels: ArrayLike | None = None,
    captions: Sequence[str] | None = None,
    scores: ArrayLike | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Show patches on a grid, each with a caption and an edge in the color of its class.

    Parameters
    ----------
    patches
        A set, or ``(H, W, 3)`` images.
    count, columns
        Maximum number of patches, chosen at even distances if there are more, and patches per row.
    labels
        ``(N,)`` 1 for a vehicle, 0 for anything else. None takes those of a set, or draws no edges.
    captions, scores
        One caption per patch, by default the source of a set's patches; and ``(N,)`` numbers to add to the
        captions, such as decision values.
    ax : matplotlib.axes.Axes, optional

    Returns
    -------
    matplotlib.axes.Axes
        Contains one image and one text per patch.

    Raises
    ------
    InvalidInputError
        If a patch is malformed, or the number of labels, captions or scores is wrong.

    Examples
    --------
    >>> from vehicle_detection import render_patches
    >>> patches, labels = render_patches(20)
    >>> len(plot_patches(patches, labels=labels, count=8).images)
    8
    """
    images: Any
    if isinstance(patches, PatchSet):
        images = patches.patches
        labels = patches.labels if labels is None else labels
        captions = captions or patches.sources.tolist()
    else:
        images = style.check_list(patches, "patches", "images")
    classes = style.check_numbers(labels, "labels", len(images), "patches")
    texts = style.check_length(captions, "captions", len(images), "patches")
    values = style.check_numbers(scores, "scores", len(images), "patches")
    rows = style.evenly_spaced(len(images), check_integer(count, "count", low=1, high=1000)).tolist()
    if not rows:
        raise InvalidInputError("patches must hold at least one patch; got none")
    tiles = []
    for row in rows:
        lines = [texts[row]] if texts[row] else []
        lines += [] if values is None else [f"score {values[row]:+.2f}"]
        tiles.append((style.check_displayable(images[row], f"patches[{row}]"), "\n".join(lines)))
    caption_lines = any(texts[row] for row in rows) + (values is not None)
    colors = None if classes is None else [VEHICLE if classes[row] else OTHER for row in rows]
    axes, _ = style.add_tiles(
        ax, tiles, columns=columns, inches=1.25, caption_lines=caption_lines, colors=colors
    )
    if colors:
        _add_class_legend(axes)
    return axes


def _add_class_legend(axes: Axes) -> None:
    from matplotlib.patches import Patch

    handles = [
        Patch(edgecolor=color, facecolor="none", linewidth=2, label=name)
        for name, color in (("vehicle", VEHICLE), ("other", OTHER))
    ]
    axes.legend(handles=handles, loc="lower right", bbox_to_anchor=(1, 1), ncols=2, fontsize=8, frameon=False)


def plot_balance(patch_set: PatchSet, *, ax: Axes | None = None) -> Axes:
    """Plot the number of patches of each source and class, and the percentage of each class.

    Parameters
    ----------
    patch_set
        The patches.
    ax : matplotlib.axes.Axes, optional

    Returns
    -------
    matplotlib.axes.Axes
        Contains one bar per class and source, vehicles first.

    Raises
    ------
    InvalidInputError
        If `patch_set` is not a `PatchSet`, or is empty.

    Examples
    --------
    >>> names = ["vehicles/KITTI/1.png", "vehicles/KITTI/2.png", "non-vehicles/GTI/1.png"]
    >>> axes = plot_balance(PatchSet(np.zeros((3, 64, 64, 3), np.uint8), [1, 1, 0], names))
    >>> [text.get_text() for text in axes.get_yticklabels()]
    ['KITTI', 'GTI']
    """
    _check_patch_set(patch_set)
    counts = Counter(zip((~patch_set.labels).tolist(), patch_set.sources.tolist()))
    keys = sorted(counts)
    axes = style.new_axes(ax, 7, 1.2 + 0.35 * len(keys))
    for other, name, color in ((False, "vehicles", VEHICLE), (True, "other", OTHER)):
        rows = [row for row, key in enumerate(keys) if key[0] == other]
        lengths = [counts[keys[row]] for row in rows]
        if rows:
            label = f"{name}: {sum(lengths):,} ({sum(lengths) / len(patch_set):.1%})"
            bars = axes.barh(rows, lengths, color=color, label=label)
            axes.bar_label(bars, fmt="{:,.0f}", padding=3, fontsize=9)
    axes.set_yticks(range(len(keys)), [source for _, source in keys])
    axes.margins(x=0.14)
    axes.legend(loc="upper left", bbox_to_anchor=(0, 1.0), ncols=2, frameon=False, fontsize=9)
    axes.set(xlabel="patches", ylim=(len(keys) - 0.4, -1.2))
    style.hide_spines(axes)
    return axes


def _check_patch_set(patch_set: object) -> None:
    if not isinstance(patch_set, PatchSet) or not len(patch_set):
        raise InvalidInputError(
            f"patch_set must be a PatchSet with patches, got {describe(patch_set)}; "
            "read one with load_training_patches, or build PatchSet(patches, labels, names)"
        )


def plot_near_duplicates(
    patch_set: PatchSet,
    pairs: NDArray[Any],
    *,
    split: Split | None = None,
    count: int = 10,
    ax: Axes | None = None,
) -> Axes:
    """Show pairs of near duplicates: each patch, and below it the patch that is most similar.

    Parameters
    ----------
    patch_set, pairs
        The patches, and ``(M, 2)`` of their row numbers, as `find_near_duplicates` returns.
    split
        A split of the patches: only pairs of a test patch (above) and a training patch are shown.
    count
        Maximum number of pairs, chosen at even distances if there are more.
    ax : matplotlib.axes.Axes, optional

    Returns
    -------
    matplotlib.axes.Axes
        Two images and two texts per pair: the source, and the correlation of the two patches. The title
        states the percentage of (test) patches that have a near duplicate (in the training part).

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
    _check_patch_set(patch_set)
    rows = np.asarray(pairs)
    size = len(patch_set)
    valid = rows.ndim == 2 and rows.shape[1] == 2 and rows.dtype.kind in "iu"
    if not valid or rows.min(initial=0) < 0 or rows.max(initial=0) >= size:
        raise InvalidInputError(
            f"pairs must be (M, 2) row numbers of the {size} patches, got {describe(rows)}; "
            "pass what find_near_duplicates returns for this set"
        )
    total, title = size, "patches have a near duplicate"
    if split is not None:
        check_type(split, "split", Split, "make one with split_random or a similar function")
        tested = np.zeros(size, np.bool_)
        tested[split.test[split.test < size]] = True
        rows = rows[tested[rows[:, 0]] & ~tested[rows[:, 1]]]
        total, title = len(split.test), "test patches have their nearest duplicate in the training part"
    if not len(rows):
        raise InvalidInputError("pairs must hold at least one pair to show; got none")
    chosen = rows[style.evenly_spaced(len(rows), check_integer(count, "count", low=1, high=200))]
    first, second = chosen.T
    correlations = (make_thumbnails(patch_set[first]) * make_thumbnails(patch_set[second])).sum(axis=1)
    above = [(patch_set.patches[row], patch_set.sources[row]) for row in first]
    below = [(patch_set.patches[row], f"r = {value:.3f}") for row, value in zip(second, correlations)]
    columns = min(len(chosen), 10)
    blank = [(None, "")] * (-len(chosen) % columns)
    tiles: list[tuple[NDArray[Any] | None, str]] = []
    for start in range(0, len(chosen), columns):
        for side in (above + blank, below + blank):
            tiles += side[start : start + columns]
    axes, _ = style.add_tiles(ax, tiles, columns=columns, inches=1.2)
    axes.set_title(f"{len(rows):,} of {total:,} {title} ({len(rows) / total:.1%})", fontsize=10)
    return axes
