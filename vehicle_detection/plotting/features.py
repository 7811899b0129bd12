"""Figures of the features: colors, HOG, and the vector before and after scaling."""

from __future__ import annotations

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
from vehicle_detection.plotting.style import (
    COLORS,
    LINE_COLORS,
    OTHER,
    VEHICLE,
    Sheet,
    check_count,
    check_sequence,
    new_figure,
    panels,
    put_image,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import LineCollection

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Cells in a row from which the lines are thin.
_MANY = 24


def sum_blocks(blocks: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sum for each cell what the blocks that it belongs to hold of it.

    Parameters
    ----------
    blocks
        ``(block rows, block columns, b, b, orient)``, as `hog_blocks` gives it, or weights laid out alike.

    Returns
    -------
    sums, counts : numpy.ndarray
        ``(rows, columns, orient)`` and ``(rows, columns, 1)`` float64: the number of blocks of each cell.
    """
    down, across, side, _, orient = blocks.shape
    sums = np.zeros((down + side - 1, across + side - 1, orient))
    counts = np.zeros((*sums.shape[:2], 1))
    for row in range(side):
        for column in range(side):
            sums[row : row + down, column : column + across] += blocks[:, :, row, column]
            counts[row : row + down, column : column + across] += 1
    return sums, counts


def put_glyphs(
    ax: Axes, cells: NDArray[Any], *, size: float = 1.0, peak: float | None = None, cmap: str = "gray"
) -> LineCollection:
    """Draw a line for each cell and orientation, along the edge: the brighter, the more there is of it.

    Parameters
    ----------
    ax
        Where to draw; it becomes a square-celled picture with its origin at the top left.
    cells
        ``(rows, columns, orient)``; what is zero or less is not drawn.
    size
        Side of a cell in the coordinates of the axes.
    peak
        Value of the brightest line; None takes the greatest.
    cmap
        Colors from nothing to `peak`; its first one is the ground.
    """
    from matplotlib import colormaps
    from matplotlib.collections import LineCollection

    rows, columns, orient = cells.shape
    angles = np.pi * (np.arange(orient) + 0.5) / orient
    row, column, bin_ = np.nonzero(cells > 0)
    values = cells[row, column, bin_]
    order = np.argsort(values, kind="stable")  # Strong ones lie on top.
    row, column, bin_, values = row[order], column[order], bin_[order], values[order]
    middle = np.stack([column + 0.5, row + 0.5], axis=1) * size
    # An edge runs across its gradient; skimage.feature.hog draws the same.
    along = np.stack([np.sin(angles), -np.cos(angles)], axis=1)[bin_] * (0.47 * size)
    top = float(values.max()) if peak is None and len(values) else peak or 1.0
    lines = LineCollection(
        list(np.stack([middle - along, middle + along], axis=1)),
        array=values,
        cmap=cmap,
        linewidths=1.1 if columns <= _MANY else 0.5,
    )
    lines.set_clim(0, top)
    ax.add_collection(lines, autolim=False)
    ax.set_facecolor(colormaps[cmap](0.0))
    ax.set_xlim(0, columns * size)
    ax.set_ylim(rows * size, 0)
    ax.set_aspect("equal")
    ax.set_xticks([])
    ax.set_yticks([])
    return lines


Image = NDArray[np.uint8]

_CHANNELS = {
    "YCrCb": ("Y", "Cr", "Cb"),
    "LAB": ("L", "a", "b"),
}
_PAIRS = ((0, 1), (0, 2), (1, 2))


def channel_names(color_space: str) -> tuple[str, ...]:
    """Names of a color space's channels."""
    return _CHANNELS.get(color_space, tuple(color_space))


def hog_channel_names(params: FeatureParams) -> tuple[str, ...]:
    """Names of the channels that HOG sees."""
    if params.hog_channel == "GRAY":
        return ("gray",)
    names = channel_names(params.color_space)
    return names if params.hog_channel == "ALL" else (names[int(params.hog_channel)],)


def plot_channels(
    images: Image | PatchSet | Sequence[Image],
    color_space: str = "YCrCb",
    *,
    labels: ArrayLike | None = None,
    points: int = 4000,
    random_state: int = 0,
    figure: Sheet | None = None,
) -> Sheet:
    """Plot how the pixels of images lie in a color space: each channel by itself, and pairs of channels.

    Parameters
    ----------
    images
        One ``(H, W, 3)`` uint8 RGB image, several, or a set of patches.
    color_space
        One of ``COLOR_SPACES``.
    labels
        ``(N,)`` 1 for a vehicle, 0 for anything else: the classes are drawn apart. Those of a set are known.
    points
        Pixels of each class, drawn at random, in the lower panels; without classes each has its own color.
    random_state
        Seed of that draw.
    figure
        Where to draw; None makes a new figure.

    Returns
    -------
    matplotlib.figure.Figure or SubFigure
        Three panels with the channels' distributions over all pixels, and under them three with pairs of
        channels.

    Raises
    ------
    InvalidInputError
        If an image is malformed, the color space unknown, or the labels do not fit.

    Examples
    --------
    >>> figure = plot_channels(np.full((8, 8, 3), 90, np.uint8), "HSV")
    >>> [panel.get_xlabel() for panel in figure.axes]
    ['H', 'S', 'V', 'H', 'H', 'S']
    """
    check_choice(color_space, "color_space", COLOR_SPACES)
    seed = check_integer(random_state, "random_state", low=0)
    wanted = check_integer(points, "points", low=1, high=1_000_000)
    groups = _pixels_of(images, labels)
    names = channel_names(color_space)
    sheet = new_figure(figure, 11, 6)
    upper, lower = panels(sheet, 2, 3)
    rng = np.random.default_rng(seed)
    spaces = [convert_color(pixels[None], color_space)[0] for _, _, pixels in groups]
    for (label, color, pixels), values in zip(groups, spaces):
        for channel, panel in enumerate(upper):
            shares = np.bincount(values[:, channel] // 2, minlength=128) / len(values)
            panel.stairs(100 * shares, np.arange(0, 257, 2), color=color, label=label, linewidth=1.4)
        chosen = rng.choice(len(values), min(wanted, len(values)), replace=False)
        paint = pixels[chosen] / 255 if label is None else [color]
        for panel, (first, second) in zip(lower, _PAIRS):
            x, y = values[chosen, first], values[chosen, second]
            panel.scatter(x, y, s=3, c=paint, alpha=0.5, linewidths=0, label=label)
    reach = [_reach([values[:, channel] for values in spaces]) for channel in range(3)]
    for name, panel, ends in zip(names, upper, reach):
        panel.set(xlabel=name, ylabel="share of the pixels (%)", xlim=ends)
    for panel, (first, second) in zip(lower, _PAIRS):
        panel.set(xlabel=names[first], ylabel=names[second], xlim=reach[first], ylim=reach[second])
    if groups[0][0] is not None:
        upper[0].legend(fontsize=9)
    sheet.suptitle(f"{color_space}, 8 bits a channel", fontsize=11)
    return sheet


def _reach(channel: list[NDArray[np.uint8]]) -> tuple[float, float]:
    """Find the ends of an axis on which all classes are seen, but for a thousandth of their pixels."""
    ends = np.concatenate([np.quantile(values, (0.001, 0.999)) for values in channel])
    spare = max(2.0, 0.04 * float(np.ptp(ends)))
    return max(0.0, float(ends.min()) - spare), min(256.0, float(ends.max()) + spare)


def _pixels_of(images: object, labels: ArrayLike | None) -> list[tuple[str | None, Any, Image]]:
    """Name, color and ``(N, 3)`` RGB pixels of each class; without classes, of all."""
    if isinstance(images, np.ndarray) and images.ndim == 3:
        listed = [images]
    elif isinstance(images, PatchSet):
        labels = images.labels if labels is None else labels
        listed = check_sequence(images.patches, "images", "images")
    else:
        listed = check_sequence(images, "images", "images")
    flat = [check_image(image, f"images[{index}]").reshape(-1, 3) for index, image in enumerate(listed)]
    if labels is None:
        return [(None, "0.35", np.concatenate(flat))]
    known = np.asarray(labels)
    if known.shape != (len(flat),) or known.dtype.kind not in "biuf":
        raise InvalidInputError(
            f"labels must be one number for each of {len(flat)} images; got {describe(known)}"
        )
    groups = (("vehicle", VEHICLE, known > 0), ("other", OTHER, known <= 0))
    return [
        (name, color, np.concatenate([flat[row] for row in np.flatnonzero(mask)]))
        for name, color, mask in groups
        if mask.any()
    ]


def plot_hog(
    images: Image | Sequence[Image] | Mapping[str, Image],
    params: FeatureParams | None = None,
    *,
    pix_per_cell: Sequence[int] = (8, 16),
    titles: Sequence[str] | None = None,
    figure: Sheet | None = None,
) -> Sheet:
    """Draw the HOG of each channel at several cell sizes, image beside image.

    What is drawn are the normalized histograms that the SVM sees: of each cell, the mean over the blocks it
    belongs to. The lines run along the edges, across the gradients. Dalal and Triggs (CVPR 2005).

    Parameters
    ----------
    images
        One ``(H, W, 3)`` uint8 RGB image or several, such as a vehicle and a non-vehicle; a mapping gives the
        titles.
    params
        Color space, channels, orientations and block; the default is ``FeatureParams()``.
    pix_per_cell
        Cell sizes, a row of panels each.
    titles
        One for each image.
    figure
        Where to draw; None makes a new figure.

    Returns
    -------
    matplotlib.figure.Figure or SubFigure
        A column for each image and channel: above the channel in gray, below its HOG, whose lines are the
        panel's one collection.

    Raises
    ------
    InvalidInputError
        If an image is malformed, or too small for a block.

    Examples
    --------
    >>> patch = np.arange(64 * 64 * 3).reshape(64, 64, 3).astype(np.uint8)
    >>> len(plot_hog(patch, pix_per_cell=[8]).axes)
    6
    """
    params = params or FeatureParams()
    if isinstance(images, Mapping):
        titles = list(images) if titles is None else titles
        images = list(images.values())
    elif isinstance(images, np.ndarray) and images.ndim == 3:
        images = [images]
    listed = check_sequence(images, "images", "images")
    names = check_count(titles, "titles", len(listed), "images")
    cells = [
        check_integer(cell, "pix_per_cell", low=2)
        for cell in check_sequence(pix_per_cell, "pix_per_cell", "cell sizes")
    ]
    columns = []
    for index, (image, name) in enumerate(zip(listed, names)):
        source = hog_source(check_image(image, f"images[{index}]"), params)
        for channel, letter in enumerate(hog_channel_names(params)):
            columns.append((source[..., channel], f"{name}: {letter}" if name else letter))
    wide = min(2.2, 12.5 / len(columns)) if len(columns) > 1 else 6.0
    aspect = columns[0][0].shape[0] / columns[0][0].shape[1]
    sheet = new_figure(
        figure, wide * len(columns), wide * aspect * (1 + len(cells)) + 0.4, layout="compressed"
    )
    grid = panels(sheet, 1 + len(cells), len(columns))
    for place, (channel_image, title) in enumerate(columns):
        put_image(grid[0, place], channel_image, title, vmin=0, vmax=255)
        for panel, cell in zip(grid[1:, place], cells):
            blocks = hog_blocks(
                channel_image,
                params.orient,
                cell,
                params.cell_per_block,
                transform_sqrt=params.transform_sqrt,
            )
            sums, counts = sum_blocks(blocks)
            put_glyphs(panel, sums / counts, size=cell)
            panel.set_xlim(0, channel_image.shape[1])
            panel.set_ylim(channel_image.shape[0], 0)
            if place == 0:
                panel.set_ylabel(f"{cell} px cells", fontsize=9)
    return sheet


def plot_features(
    patches: PatchSet | NDArray[np.uint8] | Sequence[Image],
    model: VehicleClassifier | FeatureParams,
    *,
    rows: Sequence[int] = (0,),
    names: Sequence[str] | None = None,
    template: int = 0,
    figure: Sheet | None = None,
) -> Sheet:
    """Plot feature vectors before and after scaling, with their parts shaded.

    Before scaling the counts of the histograms drown the HOG values; after it all parts have the same say.

    Parameters
    ----------
    patches
        ``(N, 64, 64, 3)`` uint8 RGB, or a set.
    model
        A classifier, whose scaler is used; or parameters: then the scaler is fitted to all of `patches`.
    rows
        The patches to draw.
    names
        A name for each of them.
    template
        The classifier's template whose scaler is used.
    figure
        Where to draw; None makes a new figure.

    Returns
    -------
    matplotlib.figure.Figure or SubFigure
        Two panels, one line for each of `rows` in either: the vector as it is, and scaled.

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
    given = patches.patches if isinstance(patches, PatchSet) else patches
    images = check_patches(given, PATCH_SIZE)
    chosen = [
        check_integer(row, "rows", low=0, high=len(images) - 1)
        for row in check_sequence(rows, "rows", "row numbers")
    ]
    texts = check_count(names, "names", len(chosen), "rows")
    params, mean, scale = _scaler(images, model, template)
    raw = extract_features(images[chosen], params)
    sheet = new_figure(figure, 11, 5.5)
    above, below = panels(sheet, 2, 1, sharex=True)[:, 0]
    for panel, values in ((above, raw), (below, (raw - mean) / scale)):
        for line, text, color in zip(values, texts, LINE_COLORS * len(chosen)):
            panel.plot(line, linewidth=0.6, color=color, label=text)
        _shade_parts(panel, params)
    above.set_ylabel("value")
    below.set_ylabel("value (standard deviations)")
    below.set_xlabel("number of the feature")
    above.set_title("before scaling", loc="left", fontsize=10)
    below.set_title("after scaling", loc="left", fontsize=10)
    above.set_xlim(0, params.length)
    if any(text is not None for text in texts):
        legend = above.legend(loc="upper right", fontsize=9)
        for handle in legend.get_lines():
            handle.set_linewidth(2)
    return sheet


def _scaler(
    images: Image, model: object, template: int
) -> tuple[FeatureParams, NDArray[np.float64], NDArray[np.float64]]:
    """Parameters, mean and scale."""
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
    scale[scale == 0] = 1  # As the scaler does: a constant feature stays at zero.
    return model, features.mean(axis=0), scale


def part_bounds(params: FeatureParams) -> dict[str, tuple[int, int]]:
    """First and last feature, half-open, of each part of the vector."""
    lengths = {
        "spatial bins": params.spatial_length,
        "color histogram": params.hist_length,
        "HOG": params.hog_length - params.coarse_length,
        "coarse HOG": params.coarse_length,
    }
    bounds, start = {}, 0
    for name, length in lengths.items():
        if length:
            bounds[name] = (start, start + length)
        start += length
    return bounds


def _shade_parts(panel: Axes, params: FeatureParams) -> None:
    colors = (COLORS[1], COLORS[3], "0.6", COLORS[2])
    for color, (name, (start, stop)) in zip(colors, part_bounds(params).items()):
        panel.axvspan(start, stop, color=color, alpha=0.18, linewidth=0)
        panel.annotate(
            f"{name} ({stop - start:,})",
            ((start + stop) / 2, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(0, 3),
            textcoords="offset points",
            ha="center",
            fontsize=8,
        )
