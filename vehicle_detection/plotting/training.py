"""Figures of a trained model: its weights, its scores, and how it does on each split."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import check_integer, check_number, check_type, describe
from vehicle_detection.classifier import CLASSIFIER_REMEDY, Template, VehicleClassifier
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.params import PATCH_SIZE, FeatureParams
from vehicle_detection.plotting.features import (
    channel_names,
    hog_channel_names,
    part_bounds,
    put_glyphs,
    sum_blocks,
)
from vehicle_detection.plotting.style import OTHER, VEHICLE, Sheet, new_axes, new_figure, panels, put_image
from vehicle_detection.training import SPLITS, TrainingReport

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_TO_RGB = {
    "HSV": cv2.COLOR_HSV2RGB,
    "LUV": cv2.COLOR_LUV2RGB,
    "HLS": cv2.COLOR_HLS2RGB,
    "YUV": cv2.COLOR_YUV2RGB,
    "YCrCb": cv2.COLOR_YCrCb2RGB,
    "LAB": cv2.COLOR_LAB2RGB,
}
# How far, of 255, the picture of the weights goes from the mean patch.
_REACH = 110.0


def plot_weights(classifier: VehicleClassifier, *, template: int = 0, figure: Sheet | None = None) -> Sheet:
    """Draw what a linear SVM looks for: the weights of a template, laid out as the window they belong to.

    All weights are those of the scaled features, so that they can be compared. HOG weights are summed over
    the blocks of each cell and drawn as edges: those that speak for a vehicle, and those that speak
    against one (as in Dalal and Triggs, CVPR 2005, figure 6).

    Parameters
    ----------
    classifier
        The trained model.
    template
        Which of its templates.
    figure
        Where to draw; None makes a new figure.

    Returns
    -------
    matplotlib.figure.Figure or SubFigure
        A row for each channel: HOG for and against, fine and coarse, weights of the spatial bins and of the
        histogram as far as the model has them. With spatial bins the last column shows the mean patch in
        color, and moved towards and away from what the SVM takes for a vehicle.

    Raises
    ------
    InvalidInputError
        If `classifier` is none, or has no such template.

    Examples
    --------
    >>> from vehicle_detection import load_classifier
    >>> [panel.get_title() for panel in plot_weights(load_classifier()).axes[:2]]
    ['HOG for a vehicle', 'HOG against']
    """
    check_type(classifier, "classifier", VehicleClassifier, CLASSIFIER_REMEDY)
    known = classifier.templates[
        check_integer(template, "template", low=0, high=len(classifier.templates) - 1)
    ]
    params = classifier.params
    names = channel_names(params.color_space)
    columns = ["HOG for a vehicle", "HOG against"] if params.hog_feat else []
    columns += ["coarse HOG for", "coarse HOG against"] if params.coarse_length else []
    columns += ["spatial bins"] if params.spatial_feat else []
    columns += ["histogram"] if params.hist_feat else []
    columns += ["in color"] if params.spatial_feat else []
    sheet = new_figure(figure, min(2.6 * len(columns), 15), 7.2)
    grid = panels(sheet, 3, len(columns))
    for title, panel in zip(columns, grid[0]):
        panel.set_title(title, fontsize=10)
    parts = {name: known.coef[start:stop] for name, (start, stop) in part_bounds(params).items()}
    if params.hog_feat:
        _put_hog_weights(grid[:, :2], parts["HOG"], params, params.blocks)
    if params.coarse_length:
        _put_hog_weights(grid[:, 2:4], parts["coarse HOG"], params, params.coarse_blocks)
    if params.spatial_feat:
        _put_spatial_weights(grid[:, columns.index("spatial bins")], parts["spatial bins"], params, names)
        _put_color(grid[:, -1], known, params)
    if params.hist_feat:
        weights = parts["color histogram"].reshape(3, -1)
        top = 1.1 * float(np.abs(weights).max()) or 1.0
        for panel, channel, name in zip(grid[:, columns.index("histogram")], weights, names):
            panel.stairs(channel, np.linspace(0, 256, params.hist_bins + 1), fill=True, color="0.45")
            panel.axhline(0, color="black", linewidth=0.6)
            panel.set_ylim(-top, top)
            panel.set_xlim(0, 256)
            panel.set_xlabel(f"{name} (0-255)", fontsize=8)
            panel.set_ylabel("weight", fontsize=8)
            panel.tick_params(labelsize=7)
    return sheet


def _put_hog_weights(
    grid: NDArray[Any], weights: NDArray[np.float64], params: FeatureParams, blocks: int
) -> None:
    """Draw the weights of all channels' HOG with so many blocks along a side of the patch."""
    block = params.cell_per_block
    shape = (params.hog_channels, blocks, blocks, block, block, params.orient)
    cells = [sum_blocks(channel)[0] for channel in weights.reshape(shape)]
    peak = float(np.abs(cells).max()) or 1.0
    for row, channel, name in zip(grid, cells, hog_channel_names(params)):
        for panel, signed in zip(row, (channel, -channel)):
            put_glyphs(panel, signed.clip(0), size=PATCH_SIZE / len(signed), peak=peak)
        row[0].set_ylabel(f"channel {name}", fontsize=9)
    for panel in grid[len(cells) :].flat:
        panel.remove()


def _put_spatial_weights(
    column: NDArray[Any], weights: NDArray[np.float64], params: FeatureParams, names: tuple[str, ...]
) -> None:
    maps = weights.reshape(3, params.spatial_size, params.spatial_size)
    top = float(np.abs(maps).max()) or 1.0
    for panel, values, name in zip(column, maps, names):
        put_image(panel, values, cmap="PuOr_r", vmin=-top, vmax=top)
        panel.set_ylabel(name, fontsize=9)
        bar = panel.figure.colorbar(panel.images[0], ax=panel, shrink=0.8)
        bar.ax.tick_params(labelsize=6)


def _put_color(column: NDArray[Any], template: Template, params: FeatureParams) -> None:
    """Show the mean patch, and how it looks when it is moved along the weights of the spatial bins."""
    stop, size = params.spatial_length, params.spatial_size
    direction = template.coef[:stop] * template.scale[:stop]
    step = _REACH / (float(np.abs(direction).max()) or 1.0)
    for panel, name, sign in zip(column, ("more vehicle", "mean patch", "less vehicle"), (1, 0, -1)):
        values = template.mean[:stop] + sign * step * direction
        picture = values.reshape(3, size, size).transpose(1, 2, 0)
        limits = [179 if params.color_space in ("HSV", "HLS") else 255, 255, 255]
        picture = np.ascontiguousarray(picture.clip(0, limits).round().astype(np.uint8))
        if params.color_space in _TO_RGB:
            picture = np.asarray(cv2.cvtColor(picture, _TO_RGB[params.color_space]), np.uint8)
        put_image(panel, picture)
        panel.set_xlabel(name, fontsize=9)


def plot_scores(
    scores: ArrayLike,
    labels: ArrayLike,
    *,
    threshold: float = 0.0,
    bins: int = 60,
    ax: Axes | None = None,
) -> Axes:
    """Plot how the scores of both classes are distributed, on a logarithmic scale that shows the mistakes.

    Parameters
    ----------
    scores
        ``(N,)`` decision values.
    labels
        ``(N,)`` 1 for a vehicle, 0 for anything else.
    threshold
        Score above which a patch is taken for a vehicle.
    bins
        Number of bins over the range of the scores.
    ax
        Where to draw; None makes a new figure.

    Returns
    -------
    matplotlib.axes.Axes
        Its legend counts the mistakes at the threshold; its one vertical line is the threshold.

    Raises
    ------
    InvalidInputError
        If scores and labels differ in number, hold NaN, or there are none.

    Examples
    --------
    >>> axes = plot_scores([1.0, 2.0, -0.5, -2.0], [1, 1, 1, 0])
    >>> [text.get_text() for text in axes.get_legend().get_texts()]
    ['vehicles: 1 of 3 missed', 'other: 0 of 1 taken for vehicles', 'threshold 0']
    """
    values, known = np.asarray(scores), np.asarray(labels)
    if values.ndim != 1 or not values.size or values.dtype.kind not in "iuf" or not np.isfinite(values).all():
        raise InvalidInputError(
            f"scores must be a list of finite numbers, at least one; got {describe(values)}"
        )
    if known.shape != values.shape or not np.isin(known, (0, 1)).all():
        raise InvalidInputError(
            f"labels must be 0 or 1 for each of the {len(values)} scores; got {describe(known)}"
        )
    limit = check_number(threshold, "threshold")
    count = check_integer(bins, "bins", low=1, high=10_000)
    from matplotlib.ticker import LogFormatter

    edges = _edges(values, limit, count)
    axes = new_axes(ax)
    for vehicle, color in ((True, VEHICLE), (False, OTHER)):
        own = values[known == vehicle]
        wrong = int(((own > limit) != vehicle).sum())
        name = f"vehicles: {wrong:,} of {len(own):,} missed"
        other = f"other: {wrong:,} of {len(own):,} taken for vehicles"
        counts = np.histogram(own, edges)[0]
        axes.stairs(counts, edges, fill=True, color=color, alpha=0.35)
        axes.stairs(counts, edges, color=color, linewidth=1.4, label=name if vehicle else other)
    axes.axvline(limit, color="black", linestyle="--", linewidth=1, label=f"threshold {limit:g}")
    axes.set_yscale("log")
    axes.set_ylim(bottom=0.7)
    # Few patches fill less than a decade, where the scale's own formatter writes 4x10^0.
    axes.yaxis.set_major_formatter("{x:,.0f}")
    axes.yaxis.set_minor_formatter(LogFormatter())
    axes.set_xlabel("score (decision value)")
    axes.set_ylabel("patches")
    axes.legend(fontsize=9, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, frameon=False)
    return axes


def _edges(values: NDArray[Any], limit: float, count: int) -> NDArray[np.float64]:
    """Edges of about `count` bins, one of them at the threshold: no bin holds right and wrong answers."""
    low, high = min(float(values.min()), limit), max(float(values.max()), limit)
    width = (high - low) / count or 1.0
    before = np.ceil((limit - low) / width)
    after = np.floor((high - limit) / width) + 1
    return np.asarray(limit + width * np.arange(-before, after + 1), np.float64)


def plot_split_scores(report: TrainingReport, *, ax: Axes | None = None) -> Axes:
    """Plot what a model gets wrong on each split, with its accuracy and the share of near duplicates.

    Parameters
    ----------
    report
        What `train_and_evaluate` returns.
    ax
        Where to draw; None makes a new figure.

    Returns
    -------
    matplotlib.axes.Axes
        Two bars a split, in percent: vehicles that are missed, other patches that are taken for vehicles.

    Raises
    ------
    InvalidInputError
        If `report` is no `TrainingReport`.

    Examples
    --------
    >>> from vehicle_detection import render_patches, train_and_evaluate
    >>> from vehicle_detection.datasets.patches import PatchSet
    >>> patches, labels = render_patches(20)
    >>> drawn = PatchSet(patches, labels, [f"vehicles/drawn/{number}.png" for number in range(20)])
    >>> _, report = train_and_evaluate(drawn, params=FeatureParams(hog_channel=0), seeds=1)
    >>> [text.get_text().splitlines()[0] for text in plot_split_scores(report).get_yticklabels()]
    ['random fifth']
    """
    check_type(report, "report", TrainingReport, "pass the second value that train_and_evaluate returns")
    axes = new_axes(ax, 8, 1.2 + 0.75 * len(report.splits))
    places = np.arange(len(report.splits))
    for offset, name, color, label in (
        (-0.19, "missed", VEHICLE, "vehicles missed"),
        (0.19, "false", OTHER, "other patches taken for vehicles"),
    ):
        shares = [100 * getattr(score, name) for score in report.splits.values()]
        bars = axes.barh(places + offset, shares, 0.36, color=color, label=label)
        axes.bar_label(bars, fmt="%.2f%%", padding=3, fontsize=8)
    names = [
        f"{SPLITS[name]}\naccuracy {score.accuracy:.4f}, near duplicates {score.leakage:.1%}"
        for name, score in report.splits.items()
    ]
    axes.set_yticks(places, names, fontsize=9)
    axes.invert_yaxis()
    axes.margins(x=0.15)
    axes.set_xlabel("share of the tested patches of that class (%)")
    axes.legend(fontsize=9, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    return axes
