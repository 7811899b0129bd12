"""Figures of the features: color channels, HOG, feature vectors, weights, and what they add to a score."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check, invalid
from vehicle_detection.drawing import draw_cell_shares
from vehicle_detection.evaluation import Explanation
from vehicle_detection.features import (
    PATCH_SIZE,
    FeatureParams,
    hog_blocks,
    hog_source,
    part_slices,
    sum_blocks,
)
from vehicle_detection.notebook import style
from vehicle_detection.notebook.style import FigureLike, Image
from vehicle_detection.svm import CLASSIFIER_REMEDY, Template, VehicleClassifier

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import LineCollection

# Thin lines for glyphs of more cells per row than this.
_MANY_CELLS = 24

# Part of the image around an explained window, as a fraction of the window's longer side.
_AROUND = 0.25

_CHANNEL_NAMES = {"YCrCb": ("Y", "Cr", "Cb"), "LAB": ("L", "a", "b")}


def channel_names(color_space: str) -> tuple[str, ...]:
    """Names of a color space's channels."""
    return _CHANNEL_NAMES.get(color_space, tuple(color_space))


def hog_channel_names(params: FeatureParams) -> tuple[str, ...]:
    """Names of the channels that HOG is computed on."""
    if params.hog_channel == "GRAY":
        return ("gray",)
    names = channel_names(params.color_space)
    return names if params.hog_channel == "ALL" else (names[int(params.hog_channel)],)


def add_glyphs(
    ax: Axes, cells: NDArray[Any], *, size: float = 1.0, peak: float | None = None
) -> LineCollection:
    """Draw a line along the edge for each cell and orientation of ``(rows, columns, orient)`` > 0.

    The brightness is the value, relative to `peak` (None: the maximum). A cell has the side `size` in data
    units.
    """
    from matplotlib.collections import LineCollection

    rows, columns, orient = cells.shape
    angles = np.pi * (np.arange(orient) + 0.5) / orient
    # An edge is perpendicular to its gradient, as drawn by skimage.feature.hog.
    offsets = np.stack([np.sin(angles), -np.cos(angles)], axis=1) * (0.47 * size)
    places = np.argwhere(cells > 0)
    values = cells[cells > 0]
    order = np.argsort(values, kind="stable")  # strong lines on top
    row, column, bin_ = places[order].T
    center = np.stack([column + 0.5, row + 0.5], axis=1) * size
    lines = LineCollection(
        list(np.stack([center - offsets[bin_], center + offsets[bin_]], axis=1)),
        array=values[order],
        cmap="gray",
        linewidths=1.1 if columns <= _MANY_CELLS else 0.5,
    )
    lines.set_clim(0, peak or values.max(initial=0) or 1.0)
    ax.add_collection(lines, autolim=False)
    ax.set_facecolor("black")
    ax.set(xlim=(0, columns * size), ylim=(rows * size, 0), aspect="equal", xticks=[], yticks=[])
    return lines


def plot_hog(
    images: Image | Sequence[Image] | Mapping[str, Image],
    params: FeatureParams | None = None,
    *,
    pix_per_cell: Sequence[int] = (8, 16),
    figure: FigureLike | None = None,
) -> FigureLike:
    """Draw the HOG of each channel of images at several cell sizes.

    Each cell shows its block-normalized histogram, averaged over the blocks that contain the cell (Dalal and
    Triggs, CVPR 2005). Lines are parallel to the edges, that is, perpendicular to the gradients.

    `images` is one ``(H, W, 3)`` uint8 RGB image or several, such as a vehicle and a non-vehicle; the keys of
    a mapping are the titles. There is a row of panels for each cell size of `pix_per_cell`; `params` has the
    color space, channels, orientations and block.

    >>> patch = np.arange(64 * 64 * 3).reshape(64, 64, 3).astype(np.uint8)
    >>> len(plot_hog(patch, pix_per_cell=[8]).axes)
    6
    """
    check.instance(params, "params", FeatureParams | None, "omit it for the default")
    params = params or FeatureParams()
    single = isinstance(images, np.ndarray) and images.ndim == 3
    listed, names = style.split_titles([images] if single else images)
    sizes = style.check_list(pix_per_cell, "pix_per_cell", "cell sizes")
    cell_sizes = [check.integer(cell, "pix_per_cell", low=2) for cell in sizes]
    columns, side = [], max(cell_sizes) * params.cell_per_block
    for index, (image, name) in enumerate(zip(listed, names)):
        source = hog_source(check.image(image, f"images[{index}]"), params)
        if min(source.shape[:2]) < side:
            must, remedy = f"have {side}x{side} pixels, a block, or more", "or pass a smaller pix_per_cell"
            raise invalid(f"images[{index}]", must, image, remedy)
        for channel, letter in enumerate(hog_channel_names(params)):
            columns.append((source[..., channel], f"{name}: {letter}" if name else letter))
    width = min(2.2, 12.5 / len(columns)) if len(columns) > 1 else 6.0
    height = width * columns[0][0].shape[0] / columns[0][0].shape[1]
    rows = 1 + len(cell_sizes)
    size = width * len(columns), height * rows + 0.4
    figure, grid = style.new_panels(figure, size, rows, len(columns), layout="compressed")
    block, sqrt = params.cell_per_block, params.transform_sqrt
    for (first, *others), (gray, title) in zip(grid.T, columns):
        style.add_image(first, gray, title, vmin=0, vmax=255)
        for panel, cell in zip(others, cell_sizes):
            blocks = hog_blocks(gray, params.orient, cell, block, transform_sqrt=sqrt)
            add_glyphs(panel, sum_blocks(blocks) / sum_blocks(np.ones_like(blocks)), size=cell)
            panel.set(xlim=(0, gray.shape[1]), ylim=(gray.shape[0], 0))
    for panel, cell in zip(grid[1:, 0], cell_sizes):
        panel.set_ylabel(f"{cell} px cells", fontsize=9)
    return figure


# Largest difference, in gray levels, between the mean patch and the patch shifted along the weights.
_MAX_SHIFT = 110.0


def plot_weights(
    classifier: VehicleClassifier, *, template: int = 0, figure: FigureLike | None = None
) -> FigureLike:
    """Draw the weights of a classifier's template, arranged as in the window, with a row for each channel.

    The weights belong to the scaled features, so they are comparable. HOG weights are summed over the blocks
    of each cell and drawn as edges, positive and negative ones separately (Dalal and Triggs, CVPR 2005,
    figure 6). The other columns are the weights of coarse HOG, of the spatial bins and of the histogram, as
    far as the model uses them; with spatial bins also the mean patch, shifted along the weights in both
    directions.

    >>> from vehicle_detection import load_classifier
    >>> [panel.get_title() for panel in plot_weights(load_classifier()).axes[:2]]
    ['HOG, positive', 'HOG, negative']
    """
    check.instance(classifier, "classifier", VehicleClassifier, CLASSIFIER_REMEDY)
    number = check.integer(template, "template", low=0, high=len(classifier.templates) - 1)
    chosen = classifier.templates[number]
    params = classifier.params
    weights = {part: chosen.coef[rows] for part, rows in part_slices(params).items()}
    hogs = {"HOG": params.blocks, "coarse HOG": params.coarse_blocks}
    titles = [f"{part}, {sign}" for part in hogs if part in weights for sign in ("positive", "negative")]
    titles += ["spatial bins"] if params.spatial_feat else []
    titles += ["histogram"] if params.hist_feat else []
    titles += ["in color"] if params.spatial_feat else []
    figure, grid = style.new_panels(figure, (min(2.6 * len(titles), 15), 7.2), 3, len(titles))
    columns = dict(zip(titles, grid.T))
    for title, column in columns.items():
        column[0].set_title(title, fontsize=10)
    for part, blocks in hogs.items():
        if part in weights:
            pair = columns[f"{part}, positive"], columns[f"{part}, negative"]
            _add_hog_weights(np.stack(pair, axis=1), weights[part], params, blocks)
    if params.spatial_feat:
        _add_spatial_weights(columns["spatial bins"], weights["spatial bins"], params)
        _add_shifted_patches(columns["in color"], chosen, params)
    if params.hist_feat:
        _add_histogram_weights(columns["histogram"], weights["color histogram"], params)
    return figure


def _add_hog_weights(
    grid: NDArray[Any], weights: NDArray[np.float64], params: FeatureParams, blocks: int
) -> None:
    """Draw the HOG weights of all channels; the patch has ``(blocks, blocks)`` blocks."""
    block = params.cell_per_block
    shape = (params.hog_channels, blocks, blocks, block, block, params.orient)
    cells = [sum_blocks(channel) for channel in weights.reshape(shape)]
    peak = float(np.abs(cells).max()) or 1.0
    for row, channel, name in zip(grid, cells, hog_channel_names(params)):
        for panel, signed in zip(row, (channel, -channel)):
            add_glyphs(panel, signed.clip(0), size=PATCH_SIZE / len(signed), peak=peak)
        row[0].set_ylabel(f"channel {name}", fontsize=9)
    for panel in grid[len(cells) :].flat:
        panel.remove()


def _add_spatial_weights(column: NDArray[Any], weights: NDArray[np.float64], params: FeatureParams) -> None:
    maps = params.spatial_planes(weights)
    top = float(np.abs(maps).max()) or 1.0
    for panel, values, name in zip(column, maps, channel_names(params.color_space)):
        style.add_image(panel, values, cmap="PuOr_r", vmin=-top, vmax=top)
        panel.set_ylabel(name, fontsize=9)
        bar = panel.figure.colorbar(panel.images[0], ax=panel, shrink=0.8)
        bar.ax.tick_params(labelsize=6)


def _add_histogram_weights(column: NDArray[Any], weights: NDArray[np.float64], params: FeatureParams) -> None:
    top = 1.1 * float(np.abs(weights).max()) or 1.0
    for panel, values, name in zip(column, weights.reshape(3, -1), channel_names(params.color_space)):
        panel.stairs(values, np.linspace(0, 256, len(values) + 1), fill=True, color="0.45")
        panel.axhline(0, color="black", linewidth=0.6)
        panel.set(xlim=(0, 256), ylim=(-top, top))
        panel.set_xlabel(f"{name} (0-255)", fontsize=8)
        panel.set_ylabel("weight", fontsize=8)
        panel.tick_params(labelsize=7)


def _add_shifted_patches(column: NDArray[Any], template: Template, params: FeatureParams) -> None:
    """Show the mean patch, and the mean patch shifted along the weights of the spatial bins."""
    stop = params.spatial_length
    direction = template.coef[:stop] * template.scale[:stop]
    step = _MAX_SHIFT / (float(np.abs(direction).max()) or 1.0)
    for panel, name, sign in zip(column, ("mean + weights", "mean patch", "mean - weights"), (1, 0, -1)):
        values = template.mean[:stop] + sign * step * direction
        patch = params.spatial_planes(values).transpose(1, 2, 0)
        limits = [179 if params.spatial_space in ("HSV", "HLS") else 255, 255, 255]
        patch = np.ascontiguousarray(patch.clip(0, limits).round().astype(np.uint8))
        if params.spatial_space != "RGB":
            conversion = getattr(cv2, f"COLOR_{params.spatial_space}2RGB")
            patch = np.asarray(cv2.cvtColor(patch, conversion), np.uint8)
        style.add_image(panel, patch)
        panel.set_xlabel(name, fontsize=9)


def plot_explanation(
    image: Image, explanation: Explanation, *, figure: FigureLike | None = None
) -> FigureLike:
    """Draw why a detector finds a vehicle in a box, given the image and what `explain` returned for it.

    Three panels: the vehicle with its box; the same with the cells of the window, orange where a cell speaks
    for a vehicle and blue where it speaks against one, the stronger the more; and the terms of the margin
    with their sum.

    >>> from vehicle_detection import VehicleDetector, explain
    >>> road = np.full((360, 640, 3), 90, np.uint8)
    >>> figure = plot_explanation(road, explain(VehicleDetector(), road, [300, 200, 360, 250]))
    >>> [panel.get_title() for panel in figure.axes][:2]
    ['not found', 'share of each cell, orange: for a vehicle']
    """
    height, width = check.image(image).shape[:2]
    check.instance(explanation, "explanation", Explanation, "pass what explain returned")
    figure, grid = style.new_panels(figure, (10.5, 3.6), 1, 3)
    plain, shares, sums = grid.flat
    score = "not found" if explanation.score is None else f"score {explanation.score:.2f}"
    left, top, right, bottom = explanation.window.tolist()
    both = explanation.window, explanation.box
    first, last = np.minimum(*both), np.maximum(*both)
    around = _AROUND * max(right - left, bottom - top)
    drawn = draw_cell_shares(image, explanation.window, explanation.cells)
    shares_title = "share of each cell, orange: for a vehicle"
    for panel, shown, title in ((plain, image, score), (shares, drawn, shares_title)):
        style.add_image(panel, shown, title)
        style.add_boxes(panel, explanation.box[None], style.YELLOW)
        panel.set_xlim(max(first[0] - around, -0.5), min(last[2] + around, width - 0.5))
        panel.set_ylim(min(last[3] + around, height - 0.5), max(first[1] - around, -0.5))
    names, values = list(explanation.terms), list(explanation.terms.values())
    ends = np.concatenate(([0.0], np.cumsum(values)))
    starts = ends[:-1]
    rows = np.arange(len(values))
    bar_colors = [style.VERMILION if value > 0 else style.BLUE for value in values]
    sums.barh(rows, values, left=starts, color=bar_colors)
    for row, start, value in zip(rows.tolist(), starts.tolist(), values):
        end = max(start, start + value), row
        # White behind the text, which the line of the margin may cross.
        options = {"bbox": {"facecolor": "white", "edgecolor": "none", "pad": 1}, "fontsize": 9}
        sums.annotate(f"{value:+.2f}", end, (4, 0), textcoords="offset points", va="center", **options)
    sums.axvline(explanation.margin, color="black", linestyle="--", linewidth=1)
    sums.axvline(0, color="gray", linewidth=0.8)
    sums.set_yticks(rows, names)
    sums.invert_yaxis()
    room = 0.25 * max(np.ptp(ends), 0.1)
    sums.set_xlim(ends.min() - 0.2 * room, ends.max() + room)
    sums.set_title(f"margin {explanation.margin:.2f}", fontsize=9)
    return figure
