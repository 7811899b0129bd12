"""Figures of images: grids of images and patches, methods side by side, class balance, near duplicates."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import check
from vehicle_detection.datasets import PatchSet, check_labels
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.notebook import style
from vehicle_detection.notebook.style import OTHER, SKY, TRUTH, VEHICLE, Boxes, FigureLike, Image

if TYPE_CHECKING:
    from matplotlib.axes import Axes


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
    per_row = min(3, count) if columns is None else check.integer(columns, "columns", low=1, high=100)
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
    classes = None if labels is None else check_labels(labels, count=len(images))
    texts = style.check_length(captions, "captions", len(images), "patches")
    values = style.check_length(scores, "scores", len(images), "patches")
    shown = min(len(images), check.integer(count, "count", low=1, high=1000))
    rows = np.linspace(0, len(images) - 1, shown).round().astype(np.intp).tolist()
    if not rows:
        raise InvalidInputError("patches must hold at least one patch; got none")
    tiles = []
    for row in rows:
        score = "" if scores is None else f"score {check.number(values[row], 'scores'):+.2f}"
        caption = "\n".join(filter(None, (texts[row], score)))
        tiles.append((style.check_displayable(images[row], f"patches[{row}]"), caption))
    lines = any(texts[row] for row in rows) + (scores is not None)
    colors = None if classes is None else [VEHICLE if classes[row] else OTHER for row in rows]
    axes, _ = style.add_tiles(ax, tiles, columns=columns, inches=1.25, caption_lines=lines, colors=colors)
    if colors:
        handles = style.legend_lines(("vehicle", VEHICLE, "-"), ("other", OTHER, "-"))
        place: Any = {"loc": "lower right", "bbox_to_anchor": (1, 1), "ncols": 2}
        axes.legend(handles=handles, **place, fontsize=8, frameon=False)
    return axes
