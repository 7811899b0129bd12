"""Figures of the features: color channels, HOG, and the feature vector before and after scaling."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import check_choice, check_image, check_integer, check_patches, describe
from vehicle_detection.classifier import VehicleClassifier
from vehicle_detection.datasets import PatchSet
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.features import convert_color, extract_features, hog_blocks, hog_source
from vehicle_detection.params import COLOR_SPACES, PATCH_SIZE, FeatureParams
from vehicle_detection.plotting import style
from vehicle_detection.plotting.style import COLORS, LINE_COLORS, OTHER, VEHICLE, FigureLike, Image

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import LineCollection

# Thin lines for glyphs of more cells per row than this.
_MANY_CELLS = 24

_CHANNEL_NAMES = {"YCrCb": ("Y", "Cr", "Cb"), "LAB": ("L", "a", "b")}
_CHANNEL_PAIRS = ((0, 1), (0, 2), (1, 2))


def channel_names(color_space: str) -> tuple[str, ...]:
    """Names of a color space's channels."""
    return _CHANNEL_NAMES.get(color_space, tuple(color_space))


def hog_channel_names(params: FeatureParams) -> tuple[str, ...]:
    """Names of the channels that HOG is computed on."""
    if params.hog_channel == "GRAY":
        return ("gray",)
    names = channel_names(params.color_space)
    return names if params.hog_channel == "ALL" else (names[int(params.hog_channel)],)


def sum_blocks(blocks: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sum the values of each cell over the blocks that contain it.

    ``(block rows, block columns, b, b, orient)``, as `hog_blocks` returns, to ``(rows, columns, orient)``
    sums and ``(rows, columns, 1)`` numbers of blocks.
    """
    down, across, side, _, orient = blocks.shape
    sums = np.zeros((down + side - 1, across + side - 1, orient))
    counts = np.zeros((*sums.shape[:2], 1))
    for row in range(side):
        for column in range(side):
            sums[row : row + down, column : column + across] += blocks[:, :, row, column]
            counts[row : row + down, column : column + across] += 1
    return sums, counts


def add_glyphs(
    ax: Axes, cells: NDArray[Any], *, size: float = 1.0, peak: float | None = None
) -> LineCollection:
    """Draw a line along the edge for each cell and orientation of ``(rows, columns, orient)`` > 0.

    The brightness is the value, relative to `peak` (None: the maximum). A cell has the side `size` in data
    coordinates.
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


def plot_channels(
    images: Image | PatchSet | Sequence[Image],
    color_space: str = "YCrCb",
    *,
    labels: ArrayLike | None = None,
    points: int = 4000,
    random_state: int = 0,
    figure: FigureLike | None = None,
) -> FigureLike:
    """Plot the distribution of pixels in a color space: each channel, and pairs of channels.

    Parameters
    ----------
    images
        One ``(H, W, 3)`` uint8 RGB image, several images, or a set of patches.
    color_space
        One of ``COLOR_SPACES``.
    labels
        ``(N,)`` 1 for a vehicle, 0 for anything else: one curve per class. None takes those of a set.
    points, random_state
        Number of randomly chosen pixels per class in the lower panels, and seed of the choice; without
        labels each point has the color of its pixel.
    figure : matplotlib.figure.Figure or SubFigure, optional

    Returns
    -------
    matplotlib.figure.Figure or SubFigure
        Three histograms of the channels over all pixels; below, three scatter plots of pairs of channels.

    Raises
    ------
    InvalidInputError
        If an image is malformed, the color space unknown, or the number of labels wrong.

    Examples
    --------
    >>> figure = plot_channels(np.full((8, 8, 3), 90, np.uint8), "HSV")
    >>> [panel.get_xlabel() for panel in figure.axes]
    ['H', 'S', 'V', 'H', 'H', 'S']
    """
    check_choice(color_space, "color_space", COLOR_SPACES)
    rng = np.random.default_rng(check_integer(random_state, "random_state", low=0))
    max_points = check_integer(points, "points", low=1, high=1_000_000)
    groups = _pixels_by_class(images, labels)
    names = channel_names(color_space)
    figure, (upper, lower) = style.new_panels(figure, (11, 6), 2, 3)
    converted = [convert_color(pixels[None], color_space)[0] for _, _, pixels in groups]
    for (label, color, pixels), values in zip(groups, converted):
        for channel, panel in enumerate(upper):
            fractions = np.bincount(values[:, channel] // 2, minlength=128) / len(values)
            panel.stairs(100 * fractions, np.arange(0, 257, 2), color=color, label=label, linewidth=1.4)
        chosen = rng.choice(len(values), min(max_points, len(values)), replace=False)
        point_colors = pixels[chosen] / 255 if label is None else [color]
        for panel, (first, second) in zip(lower, _CHANNEL_PAIRS):
            x, y = values[chosen, first], values[chosen, second]
            panel.scatter(x, y, s=3, c=point_colors, alpha=0.5, linewidths=0, label=label)
    limits = [_axis_limits([values[:, channel] for values in converted]) for channel in range(3)]
    for name, panel, limit in zip(names, upper, limits):
        panel.set(xlabel=name, ylabel="pixels (%)", xlim=limit)
    for panel, (first, second) in zip(lower, _CHANNEL_PAIRS):
        panel.set(xlabel=names[first], ylabel=names[second], xlim=limits[first], ylim=limits[second])
    if groups[0][0] is not None:
        upper[0].legend(fontsize=9)
    figure.suptitle(f"{color_space}, 8 bits per channel", fontsize=11)
    return figure


def _axis_limits(channel: list[NDArray[np.uint8]]) -> tuple[float, float]:
    """Axis limits that contain all but 0.1% of each class's pixels at either end."""
    ends = np.concatenate([np.quantile(values, (0.001, 0.999)) for values in channel])
    margin = max(2.0, 0.04 * float(np.ptp(ends)))
    return max(0.0, float(ends.min()) - margin), min(256.0, float(ends.max()) + margin)


def _pixels_by_class(images: object, labels: ArrayLike | None) -> list[tuple[str | None, Any, Image]]:
    """Name, color and ``(N, 3)`` RGB pixels of each class, or of all images without labels."""
    if isinstance(images, np.ndarray) and images.ndim == 3:
        images = [images]
    elif isinstance(images, PatchSet):
        labels = images.labels if labels is None else labels
        images = images.patches
    listed = style.check_list(images, "images", "images")
    flat = [check_image(image, f"images[{index}]").reshape(-1, 3) for index, image in enumerate(listed)]
    known = style.check_numbers(labels, "labels", len(flat), "images")
    if known is None:
        return [(None, "0.35", np.concatenate(flat))]
    groups: list[tuple[str | None, Any, Image]] = []
    for name, color, mask in (("vehicle", VEHICLE, known > 0), ("other", OTHER, known <= 0)):
        if mask.any():
            groups.append((name, color, np.concatenate(list(itertools.compress(flat, mask)))))
    return groups


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

    Parameters
    ----------
    images
        One ``(H, W, 3)`` uint8 RGB image or several, such as a vehicle and a non-vehicle; the keys of a
        mapping are the titles.
    params, pix_per_cell
        Color space, channels, orientations and block, by default ``FeatureParams()``; and cell sizes in
        pixels, one row of panels each.
    figure : matplotlib.figure.Figure or SubFigure, optional

    Returns
    -------
    matplotlib.figure.Figure or SubFigure
        One column per image and channel: the channel in gray, and its HOG as a line collection per cell size.

    Raises
    ------
    InvalidInputError
        If an image is malformed, or smaller than a block.

    Examples
    --------
    >>> patch = np.arange(64 * 64 * 3).reshape(64, 64, 3).astype(np.uint8)
    >>> len(plot_hog(patch, pix_per_cell=[8]).axes)
    6
    """
    params = params or FeatureParams()
    single = isinstance(images, np.ndarray) and images.ndim == 3
    listed, names = style.split_titles([images] if single else images)
    sizes = style.check_list(pix_per_cell, "pix_per_cell", "cell sizes")
    cell_sizes = [check_integer(cell, "pix_per_cell", low=2) for cell in sizes]
    columns = []
    for index, (image, name) in enumerate(zip(listed, names)):
        source = hog_source(check_image(image, f"images[{index}]"), params)
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
            sums, counts = sum_blocks(hog_blocks(gray, params.orient, cell, block, transform_sqrt=sqrt))
            add_glyphs(panel, sums / counts, size=cell)
            panel.set(xlim=(0, gray.shape[1]), ylim=(gray.shape[0], 0))
    for panel, cell in zip(grid[1:, 0], cell_sizes):
        panel.set_ylabel(f"{cell} px cells", fontsize=9)
    return figure


def plot_features(
    patches: PatchSet | NDArray[np.uint8] | Sequence[Image],
    model: VehicleClassifier | FeatureParams,
    *,
    rows: Sequence[int] = (0,),
    names: Sequence[str] | None = None,
    template: int = 0,
    figure: FigureLike | None = None,
) -> FigureLike:
    """Plot feature vectors before and after scaling, with their parts shaded.

    Before scaling, histogram counts are much larger than HOG values; after scaling, all parts have the same
    range.

    Parameters
    ----------
    patches
        ``(N, 64, 64, 3)`` uint8 RGB, or a set.
    model, template
        A classifier and the number of the template whose scaler is used; or parameters, with the scaler
        fitted to all of `patches`.
    rows, names
        Row numbers of the patches to plot, and one name per row.
    figure : matplotlib.figure.Figure or SubFigure, optional

    Returns
    -------
    matplotlib.figure.Figure or SubFigure
        Two panels with one line per row: the vector before and after scaling.

    Raises
    ------
    InvalidInputError
        If the patches are malformed, or a row or template does not exist.

    Examples
    --------
    >>> from vehicle_detection import render_patches
    >>> figure = plot_features(render_patches(8)[0], FeatureParams(hog_channel=0))
    >>> len(figure.axes[1].lines[0].get_ydata())
    2628
    """
    images = check_patches(patches.patches if isinstance(patches, PatchSet) else patches, PATCH_SIZE)
    numbers = style.check_list(rows, "rows", "row numbers")
    chosen = [check_integer(row, "rows", low=0, high=len(images) - 1) for row in numbers]
    labels = style.check_length(names, "names", len(chosen), "rows")
    params, mean, scale = _scaler(images, model, template)
    raw = extract_features(images[chosen], params)
    figure, grid = style.new_panels(figure, (11, 5.5), 2, 1, sharex=True)
    above, below = grid.flat
    for panel, values in ((above, raw), (below, (raw - mean) / scale)):
        for line, label, color in zip(values, labels, LINE_COLORS * len(chosen)):
            panel.plot(line, linewidth=0.6, color=color, label=label)
        _shade_parts(panel, params)
    above.set(ylabel="value", xlim=(0, params.length))
    below.set(ylabel="value (standard deviations)", xlabel="feature")
    above.set_title("before scaling", loc="left", fontsize=10)
    below.set_title("after scaling", loc="left", fontsize=10)
    if any(label is not None for label in labels):
        legend = above.legend(loc="upper right", fontsize=9)
        for handle in legend.get_lines():
            handle.set_linewidth(2)
    return figure


def _scaler(
    images: Image, model: object, template: int
) -> tuple[FeatureParams, NDArray[np.float64], NDArray[np.float64]]:
    """Feature parameters, mean and scale."""
    if isinstance(model, VehicleClassifier):
        known = model.templates[check_integer(template, "template", low=0, high=len(model.templates) - 1)]
        return model.params, known.mean, known.scale
    if not isinstance(model, FeatureParams):
        raise InvalidInputError(
            f"model must be a VehicleClassifier or FeatureParams, got {describe(model)}; "
            "pass load_classifier() or FeatureParams()"
        )
    features = extract_features(images, model).astype(np.float64)
    scale = features.std(axis=0)
    scale[scale == 0] = 1  # as StandardScaler does for constant features
    return model, features.mean(axis=0), scale


def part_slices(params: FeatureParams) -> dict[str, slice]:
    """Position of each part in the feature vector, if the vector has it."""
    lengths = {
        "spatial bins": params.spatial_length,
        "color histogram": params.hist_length,
        "HOG": params.hog_length - params.coarse_length,
        "coarse HOG": params.coarse_length,
    }
    stops = itertools.accumulate(lengths.values())
    return {name: slice(stop - lengths[name], stop) for name, stop in zip(lengths, stops) if lengths[name]}


def _shade_parts(panel: Axes, params: FeatureParams) -> None:
    colors = (COLORS[1], COLORS[3], "0.6", COLORS[2])
    for color, (name, part) in zip(colors, part_slices(params).items()):
        panel.axvspan(part.start, part.stop, color=color, alpha=0.18, linewidth=0)
        label, middle = f"{name} ({part.stop - part.start:,})", (part.start + part.stop) / 2
        above = panel.get_xaxis_transform()
        panel.annotate(label, (middle, 1.0), (0, 3), above, "offset points", ha="center", fontsize=8)
