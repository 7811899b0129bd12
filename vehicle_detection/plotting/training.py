"""Figures of a trained classifier: its weights and its scores."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import check_integer, check_number, check_type, describe
from vehicle_detection.classifier import CLASSIFIER_REMEDY, Template, VehicleClassifier
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.params import PATCH_SIZE, FeatureParams
from vehicle_detection.plotting import features, style
from vehicle_detection.plotting.style import OTHER, VEHICLE, FigureLike

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Largest difference, in gray levels, between the mean patch and the patch shifted along the weights.
_MAX_SHIFT = 110.0


def plot_weights(
    classifier: VehicleClassifier, *, template: int = 0, figure: FigureLike | None = None
) -> FigureLike:
    """Draw the weights of a linear SVM template, arranged as in the window.

    The weights belong to the scaled features, so they are comparable. HOG weights are summed over the blocks
    of each cell and drawn as edges, positive and negative ones separately (Dalal and Triggs, CVPR 2005,
    figure 6).

    Parameters
    ----------
    classifier, template
        The trained model, and the number of its template.
    figure : matplotlib.figure.Figure or SubFigure, optional

    Returns
    -------
    matplotlib.figure.Figure or SubFigure
        One row per channel. Columns: positive and negative weights of HOG and of coarse HOG, weights of the
        spatial bins and of the histogram, as far as the model uses them. With spatial bins, the last column
        shows the mean patch, and the mean patch shifted along the weights in both directions.

    Raises
    ------
    InvalidInputError
        If `classifier` is not a classifier, or does not have the template.

    Examples
    --------
    >>> from vehicle_detection import load_classifier
    >>> [panel.get_title() for panel in plot_weights(load_classifier()).axes[:2]]
    ['HOG, positive', 'HOG, negative']
    """
    check_type(classifier, "classifier", VehicleClassifier, CLASSIFIER_REMEDY)
    number = check_integer(template, "template", low=0, high=len(classifier.templates) - 1)
    chosen = classifier.templates[number]
    params = classifier.params
    names = features.channel_names(params.color_space)
    weights = {part: chosen.coef[rows] for part, rows in features.part_slices(params).items()}
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
        _add_spatial_weights(columns["spatial bins"], weights["spatial bins"], params, names)
        _add_shifted_patches(columns["in color"], chosen, params)
    if params.hist_feat:
        _add_histogram_weights(columns["histogram"], weights["color histogram"], names)
    return figure


def _add_hog_weights(
    grid: NDArray[Any], weights: NDArray[np.float64], params: FeatureParams, blocks: int
) -> None:
    """Draw the HOG weights of all channels; the patch has ``(blocks, blocks)`` blocks."""
    block = params.cell_per_block
    shape = (params.hog_channels, blocks, blocks, block, block, params.orient)
    cells = [features.sum_blocks(channel)[0] for channel in weights.reshape(shape)]
    peak = float(np.abs(cells).max()) or 1.0
    for row, channel, name in zip(grid, cells, features.hog_channel_names(params)):
        for panel, signed in zip(row, (channel, -channel)):
            features.add_glyphs(panel, signed.clip(0), size=PATCH_SIZE / len(signed), peak=peak)
        row[0].set_ylabel(f"channel {name}", fontsize=9)
    for panel in grid[len(cells) :].flat:
        panel.remove()


def _add_spatial_weights(
    column: NDArray[Any], weights: NDArray[np.float64], params: FeatureParams, names: tuple[str, ...]
) -> None:
    maps = weights.reshape(3, params.spatial_size, params.spatial_size)
    top = float(np.abs(maps).max()) or 1.0
    for panel, values, name in zip(column, maps, names):
        style.add_image(panel, values, cmap="PuOr_r", vmin=-top, vmax=top)
        panel.set_ylabel(name, fontsize=9)
        bar = panel.figure.colorbar(panel.images[0], ax=panel, shrink=0.8)
        bar.ax.tick_params(labelsize=6)


def _add_histogram_weights(
    column: NDArray[Any], weights: NDArray[np.float64], names: tuple[str, ...]
) -> None:
    top = 1.1 * float(np.abs(weights).max()) or 1.0
    for panel, values, name in zip(column, weights.reshape(3, -1), names):
        panel.stairs(values, np.linspace(0, 256, len(values) + 1), fill=True, color="0.45")
        panel.axhline(0, color="black", linewidth=0.6)
        panel.set(xlim=(0, 256), ylim=(-top, top))
        panel.set_xlabel(f"{name} (0-255)", fontsize=8)
        panel.set_ylabel("weight", fontsize=8)
        panel.tick_params(labelsize=7)


def _add_shifted_patches(column: NDArray[Any], template: Template, params: FeatureParams) -> None:
    """Show the mean patch, and the mean patch shifted along the weights of the spatial bins."""
    stop, size = params.spatial_length, params.spatial_size
    direction = template.coef[:stop] * template.scale[:stop]
    step = _MAX_SHIFT / (float(np.abs(direction).max()) or 1.0)
    for panel, name, sign in zip(column, ("mean + weights", "mean patch", "mean - weights"), (1, 0, -1)):
        values = template.mean[:stop] + sign * step * direction
        patch = values.reshape(3, size, size).transpose(1, 2, 0)
        limits = [179 if params.color_space in ("HSV", "HLS") else 255, 255, 255]
        patch = np.ascontiguousarray(patch.clip(0, limits).round().astype(np.uint8))
        if params.color_space != "RGB":
            patch = np.asarray(cv2.cvtColor(patch, getattr(cv2, f"COLOR_{params.color_space}2RGB")), np.uint8)
        style.add_image(panel, patch)
        panel.set_xlabel(name, fontsize=9)


def plot_scores(
    scores: ArrayLike, labels: ArrayLike, *, threshold: float = 0.0, bins: int = 60, ax: Axes | None = None
) -> Axes:
    """Plot histograms of the scores of both classes, on a logarithmic scale that makes errors visible.

    Parameters
    ----------
    scores, labels
        ``(N,)`` decision values, and ``(N,)`` 1 for a vehicle, 0 for anything else.
    threshold, bins
        Score above which a patch is classified as a vehicle, and number of bins over the range of the scores.
    ax : matplotlib.axes.Axes, optional

    Returns
    -------
    matplotlib.axes.Axes
        The legend counts the errors at the threshold; the vertical line is the threshold.

    Raises
    ------
    InvalidInputError
        If scores and labels differ in number, are empty or contain NaN.

    Examples
    --------
    >>> axes = plot_scores([1.0, 2.0, -0.5, -2.0], [1, 1, 1, 0])
    >>> [text.get_text() for text in axes.get_legend().get_texts()]
    ['vehicles: 1 of 3 missed', 'other: 0 of 1 classified as vehicles', 'threshold 0']
    """
    from matplotlib.ticker import LogFormatter

    values, known = style.check_scores(scores, "scores"), np.asarray(labels)
    if known.shape != values.shape or not np.isin(known, (0, 1)).all():
        raise InvalidInputError(
            f"labels must be 0 or 1 for each of the {len(values)} scores; got {describe(known)}"
        )
    limit = check_number(threshold, "threshold")
    edges = _bin_edges(values, limit, check_integer(bins, "bins", low=1, high=10_000))
    axes = style.new_axes(ax)
    classes = ((1, VEHICLE, "vehicles", "missed"), (0, OTHER, "other", "classified as vehicles"))
    for vehicle, color, name, error in classes:
        own = values[known == vehicle]
        errors = int(((own > limit) != vehicle).sum())
        counts = np.histogram(own, edges)[0]
        axes.stairs(counts, edges, fill=True, color=color, alpha=0.35)
        label = f"{name}: {errors:,} of {len(own):,} {error}"
        axes.stairs(counts, edges, color=color, linewidth=1.4, label=label)
    axes.axvline(limit, color="black", linestyle="--", linewidth=1, label=f"threshold {limit:g}")
    axes.set(yscale="log", xlabel="score (decision value)", ylabel="patches")
    axes.set_ylim(bottom=0.7)
    # The default formatter writes 4x10^0 on an axis of less than a decade.
    axes.yaxis.set_major_formatter("{x:,.0f}")
    axes.yaxis.set_minor_formatter(LogFormatter())
    style.legend_above(axes, 3)
    return axes


def _bin_edges(values: NDArray[np.float64], threshold: float, count: int) -> NDArray[np.float64]:
    """Edges of about `count` bins, one of them at the threshold, so that no bin mixes both decisions."""
    low, high = min(float(values.min()), threshold), max(float(values.max()), threshold)
    width = (high - low) / count or 1.0
    before = np.ceil((threshold - low) / width)
    after = np.floor((high - threshold) / width) + 1
    return np.asarray(threshold + width * np.arange(-before, after + 1), np.float64)
