"""Figures of images: grids of images and patches, methods side by side, class balance, near duplicates."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import check_array, check_image, check_integer, check_type, describe, pluralize
from vehicle_detection.boxes import Detections
from vehicle_detection.datasets import PatchSet, Split, make_thumbnails
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.notebook import style
from vehicle_detection.notebook.style import OTHER, SKY, TRUTH, VEHICLE, Boxes, FigureLike, Image

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True)
class ImageDescription:
    """The contents of an array, and whether the library accepts it as an image; ``print`` shows them."""

    shape: tuple[int, ...]
    dtype: str
    min: float
    max: float
    mean: tuple[float, ...]  # of each channel; a single value unless the array has three dimensions
    problem: str  # why the library rejects it as an image, and the remedy; empty if it is accepted

    def __str__(self) -> str:
        mean = ", ".join(f"{value:.4g}" for value in self.mean)
        text = f"{self.dtype} array of shape {self.shape}, values {self.min:g} to {self.max:g}, mean {mean}"
        return f"{text}\n{self.problem}" if self.problem else text


def describe_image(image: NDArray[Any]) -> ImageDescription:
    """Describe an array: shape, dtype, range and mean, and whether the library accepts it as an image.

    It tells, for example, a PNG that was read as floats from 0 to 1 from a JPEG of integers from 0 to 255.

    >>> print(describe_image(np.full((2, 3, 3), 7, np.uint8)))
    uint8 array of shape (2, 3, 3), values 7 to 7, mean 7, 7, 7
    >>> describe_image(np.full((2, 3, 3), 0.5)).problem.partition("; ")[2]
    'scale its values 0-1 with (image * 255).round().astype(numpy.uint8)'
    """
    given: object = image
    if not isinstance(given, np.ndarray) or not image.size or image.dtype.kind not in "iufb":
        raise InvalidInputError(
            f"image must be an array of numbers, got {describe(given)}; read a file with read_image"
        )
    problem = ""
    try:
        check_image(image)
    except InvalidInputError as error:
        problem = str(error)
    mean = image.mean(axis=(0, 1) if image.ndim == 3 else None, dtype=np.float64)
    low, high, means = float(image.min()), float(image.max()), tuple(np.atleast_1d(mean).tolist())
    return ImageDescription(image.shape, str(image.dtype), low, high, means, problem)


def show_images(
    images: Sequence[NDArray[Any]] | Mapping[str, NDArray[Any]],
    titles: Sequence[str] | None = None,
    *,
    boxes: Sequence[Boxes | None] | None = None,
    truth: Sequence[Boxes | None] | None = None,
    columns: int | None = None,
    figure: FigureLike | None = None,
) -> FigureLike:
    """Show images in a row or a grid.

    `images` are ``(H, W, 3)`` uint8 RGB, or ``(H, W)`` numbers, shown in gray, with a title each, by default
    the keys of a mapping. `boxes` are those to draw on each image, or None: `Detections`, `TrackTable` or
    ``(N, 4)``; `truth` are labelled boxes in the same form, drawn with dashed lines. There are up to three
    images per row.

    >>> road = np.full((72, 128, 3), 90, np.uint8)
    >>> figure = show_images({"first": road, "second": road}, boxes=[[[10, 10, 30, 30]], None])
    >>> [panel.get_title() for panel in figure.axes]
    ['first', 'second']
    """
    listed, names = style.split_titles(images, titles)
    shown = [style.check_displayable(image, f"images[{index}]") for index, image in enumerate(listed)]
    count = len(shown)
    found = style.check_length(boxes, "boxes", count, "images")
    true = style.check_length(truth, "truth", count, "images")
    per_row = min(3, count) if columns is None else check_integer(columns, "columns", low=1, high=100)
    rows = math.ceil(count / per_row)
    width = max(2.0, min(12.5 / per_row, 6.5))
    height = width * float(np.median([image.shape[0] / image.shape[1] for image in shown]))
    size = per_row * width, rows * (height + 0.3 * any(names))
    figure, grid = style.new_panels(figure, size, rows, per_row, count=count, layout="compressed")
    for index, (panel, image, name) in enumerate(zip(grid.flat, shown, names)):
        style.add_image(panel, image, "" if name is None else str(name))
        if true[index] is not None:
            style.add_boxes(panel, style.box_array(true[index], f"truth[{index}]"), TRUTH, linestyles="--")
        if found[index] is not None:
            style.add_boxes(panel, style.box_array(found[index], f"boxes[{index}]"), SKY)
    return figure


def plot_methods(
    images: Sequence[Image] | Mapping[str, Image],
    methods: Mapping[str, Sequence[Detections]],
    *,
    truth: Sequence[Boxes | None] | None = None,
    figure: FigureLike | None = None,
) -> FigureLike:
    """Show the boxes that several methods find in the same images: one row per image, one column per method.

    `methods` holds the detections in each image by the name of a method; `images` and `truth` are as in
    `show_images`.

    >>> road = np.full((72, 128, 3), 90, np.uint8)
    >>> found = Detections([[10, 10, 30, 30]], [1.0])
    >>> figure = plot_methods([road], {"count": [Detections.empty()], "score": [found]})
    >>> [panel.get_title() for panel in figure.axes]
    ['count: 0 boxes', 'score: 1 box']
    """
    remedy = 'pass {"default": [detector.detect(image) for image in images]}'
    style.check_mapping(methods, "methods", "names to a list of Detections", remedy)
    listed, rows = style.split_titles(images)
    true = style.check_length(truth, "truth", len(listed), "images")
    for name, found in methods.items():
        style.check_length(found, f"methods[{name!r}]", len(listed), "images")
    titles, panels = [], []
    for index, (image, row) in enumerate(zip(listed, rows)):
        check_image(image, f"images[{index}]")
        for name, found in methods.items():
            count = len(style.box_array(found[index], f"methods[{name!r}][{index}]"))
            titles.append(f"{'' if row is None else f'{row}, '}{name}: {pluralize(count, 'box', 'es')}")
            panels.append((image, found[index], true[index]))
    shown, boxes, repeated = zip(*panels)
    return show_images(shown, titles, boxes=boxes, truth=repeated, columns=len(methods), figure=figure)


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

    `patches` are a set or ``(H, W, 3)`` images, of which at most `count` are shown, chosen at even distances.
    `labels` are ``(N,)`` 1 for a vehicle, 0 for anything else, and `captions` a text each, by default classes
    and sources of a set; `scores` are ``(N,)`` numbers to add to the captions, such as decision values.

    >>> from vehicle_detection import render_patches
    >>> patches, labels = render_patches(20)
    >>> len(plot_patches(patches, labels=labels, count=8).images)
    8
    """
    images: Any
    if isinstance(patches, PatchSet):
        images = patches.patches
        labels = patches.labels if labels is None else labels
        captions = patches.sources.tolist() if captions is None else captions
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
        score = "" if values is None else f"score {values[row]:+.2f}"
        caption = "\n".join(filter(None, (texts[row], score)))
        tiles.append((style.check_displayable(images[row], f"patches[{row}]"), caption))
    lines = any(texts[row] for row in rows) + (values is not None)
    colors = None if classes is None else [VEHICLE if classes[row] else OTHER for row in rows]
    axes, _ = style.add_tiles(ax, tiles, columns=columns, inches=1.25, caption_lines=lines, colors=colors)
    if colors:
        handles = style.legend_lines(("vehicle", VEHICLE, "-"), ("other", OTHER, "-"))
        place: Any = {"loc": "lower right", "bbox_to_anchor": (1, 1), "ncols": 2}
        axes.legend(handles=handles, **place, fontsize=8, frameon=False)
    return axes


def plot_balance(patch_set: PatchSet, *, ax: Axes | None = None) -> Axes:
    """Plot the number of patches of each source and class, vehicles first, and the percentage of each class.

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
    axes.spines[["top", "right"]].set_visible(False)
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

    `pairs` are ``(M, 2)`` row numbers, as `find_near_duplicates` returns, of which at most `count` are shown,
    chosen at even distances; with a `split`, only pairs of a test patch (above) and a training patch.
    Captions are the source, and the correlation of the two patches. The title states the percentage of (test)
    patches that have a near duplicate (in the training part).

    >>> patches = np.random.default_rng(0).integers(0, 256, (4, 64, 64, 3), np.uint8)
    >>> patches[3] = patches[1] // 2
    >>> drawn = PatchSet(patches, [1, 1, 1, 1], [f"vehicles/drawn/{row}.png" for row in range(4)])
    >>> plot_near_duplicates(drawn, np.array([[1, 3], [3, 1]])).get_title()
    '2 of 4 patches have a near duplicate (50.0%)'
    """
    _check_patch_set(patch_set)
    rows = check_array(pairs, "pairs")
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
