"""Figures of the search: its windows, its bands, and the fast one beside the reference."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import check_image, check_number, check_type, describe
from vehicle_detection.boxes import Detections
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation import FrameBoxes
from vehicle_detection.heatmap import apply_threshold, frame_heat, label_boxes
from vehicle_detection.params import HeatParams, PixelBand, SearchParams
from vehicle_detection.plotting.style import (
    BLUE,
    COLORS,
    SKY,
    TRUTH,
    VERMILION,
    YELLOW,
    Sheet,
    boxes_of,
    new_axes,
    new_figure,
    panels,
    put_boxes,
    put_image,
)
from vehicle_detection.windows import band_windows

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Image = NDArray[np.uint8]


def plot_windows(
    image: Image,
    windows: Detections | ArrayLike,
    *,
    truth: Detections | FrameBoxes | ArrayLike | None = None,
    title: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw windows on a frame, colored by their scores.

    Parameters
    ----------
    image
        ``(H, W, 3)`` uint8 RGB.
    windows
        `Detections`, such as those of `find_cars`; or ``(N, 4)`` boxes without scores, such as those of
        `slide_window`, drawn in one color.
    truth
        Labelled boxes, drawn with dashes.
    title
        None says how many windows there are.
    ax
        Where to draw; None makes a new figure.

    Returns
    -------
    matplotlib.axes.Axes
        Its first collection holds the windows, the best last, so that they lie on top; its array the
        scores.

    Raises
    ------
    InvalidInputError
        If the image or the boxes are malformed.

    Examples
    --------
    >>> found = Detections([[0, 0, 64, 64], [8, 0, 72, 64]], [1.5, 0.5])
    >>> axes = plot_windows(np.zeros((72, 128, 3), np.uint8), found)
    >>> axes.collections[0].get_array().tolist(), axes.get_title()
    ([0.5, 1.5], '2 windows')
    """
    picture = check_image(image)
    height, width = picture.shape[:2]
    boxes = boxes_of(windows, "windows")
    true = None if truth is None else boxes_of(truth, "truth")
    axes = new_axes(ax, 8.5, 8.5 * height / width + 0.6)
    put_image(axes, picture, ticks=True)
    thin = 1.4 if len(boxes) < 60 else 0.8
    if isinstance(windows, Detections) and len(windows):
        order = np.argsort(windows.scores, kind="stable")
        lines = put_boxes(axes, boxes[order], halo=len(boxes) < 400, linewidths=thin)
        lines.set_array(windows.scores[order])
        lines.set_cmap("plasma")
        bar = axes.figure.colorbar(lines, ax=axes, shrink=0.75, pad=0.02)
        bar.set_label("score")
    else:
        put_boxes(axes, boxes, SKY, halo=False, linewidths=thin)
    if true is not None:
        put_boxes(axes, true, TRUTH, linestyles="--", linewidths=2.0)
    _show_beyond(axes, boxes, width, height)
    count = f"{len(boxes):,} window{'s' * (len(boxes) != 1)}"
    axes.set_title(count if title is None else title, fontsize=10)
    return axes


def _show_beyond(axes: Axes, boxes: NDArray[Any], width: int, height: int) -> None:
    """Widen the view to windows that reach beyond the frame."""
    left = min(0.0, float(boxes[:, 0].min(initial=0)))
    right = max(float(width), float(boxes[:, 2].max(initial=width)))
    top = min(0.0, float(boxes[:, 1].min(initial=0)))
    bottom = max(float(height), float(boxes[:, 3].max(initial=height)))
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)


def plot_bands(image: Image, search: SearchParams | None = None, *, figure: Sheet | None = None) -> Sheet:
    """Draw where windows of each size are searched: outer bound, first window, and the steps from it.

    Parameters
    ----------
    image
        ``(H, W, 3)`` uint8 RGB frame.
    search
        The bands; the default is ``SearchParams.preset()``.
    figure
        Where to draw; None makes a new figure.

    Returns
    -------
    matplotlib.figure.Figure or SubFigure
        A panel for each band that fits into the frame. Its collections are the outer bound, the windows one
        step to the right and one step down, and the first window; the dashed line is the horizon.

    Raises
    ------
    InvalidInputError
        If the image is malformed, or holds no window.

    Examples
    --------
    >>> frame = np.zeros((720, 1280, 3), np.uint8)
    >>> figure = plot_bands(frame, SearchParams.preset("three-scales"))
    >>> len(figure.axes), figure.axes[1].get_title()
    (3, '64x64 px, step 8x8, 3,825 windows')
    """
    picture = check_image(image)
    search = search or SearchParams.preset()
    check_type(search, "search", SearchParams, "pass SearchParams.preset()")
    bands = search.place(picture.shape)
    height, width = picture.shape[:2]
    columns = 2 if len(bands) in (2, 4) else min(len(bands), 3)
    rows = math.ceil(len(bands) / columns)
    # All panels show the same: what the widest band needs.
    bounds = np.array([[band.x1, band.y1, band.x2, band.y2] for band in bands])
    seen = max(width, bounds[:, 2].max()) - min(0, bounds[:, 0].min())
    sheet = new_figure(figure, 13, rows * (13 / columns * height / seen + 0.3) + 0.4, layout="compressed")
    grid = panels(sheet, rows, columns)
    for panel in grid.flat[len(bands) :]:
        panel.remove()
    for panel, band, bound in zip(grid.flat, bands, bounds):
        put_image(panel, picture)
        panel.axhline(search.horizon * height, color="white", linestyle="--", linewidth=0.8)
        _put_band(panel, band, bound[None])
        _show_beyond(panel, bounds, width, height)
        size, step = (f"{x}x{y}" for x, y in (band.window, band.step))
        count = len(band_windows(band))
        panel.set_title(f"{size} px, step {step}, {count:,} window{'s' * (count != 1)}", fontsize=9)
    _band_legend(sheet)
    return sheet


def _put_band(panel: Axes, band: PixelBand, bound: NDArray[Any]) -> None:
    windows = band_windows(band)
    first = windows[:1]
    shift = np.array([[band.step[0], 0] * 2, [0, band.step[1]] * 2])
    # A band may be too low or too narrow for a second window that way.
    nexts = [row for row in first + shift if (windows == row).all(axis=1).any()]
    put_boxes(panel, bound, YELLOW)
    put_boxes(panel, np.array(nexts).reshape(-1, 4), SKY, linewidths=1.0)
    put_boxes(panel, first, VERMILION, linewidths=1.4)


def _band_legend(sheet: Sheet) -> None:
    from matplotlib.lines import Line2D

    names = (("outer bound", YELLOW), ("first window", VERMILION), ("next ones, right and down", SKY))
    handles = [Line2D([], [], color=color, linewidth=2, label=name) for name, color in names]
    handles.append(Line2D([], [], color="0.6", linestyle="--", linewidth=1, label="horizon"))
    sheet.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=9, frameon=False)


def plot_comparison(fast: ArrayLike, reference: ArrayLike, *, figure: Sheet | None = None) -> Sheet:
    """Plot the scores of the fast search against those of the reference, window by window.

    Parameters
    ----------
    fast, reference
        ``(N,)`` scores of the same windows in the same order, such as ``find_cars(...).scores``.
    figure
        Where to draw; None makes a new figure.

    Returns
    -------
    matplotlib.figure.Figure or SubFigure
        Two panels: the scores against each other, with the line on which they are equal; and how the
        differences are distributed. The title tells the greatest.

    Raises
    ------
    InvalidInputError
        If the two differ in length, are empty or hold NaN.

    Examples
    --------
    >>> figure = plot_comparison([0.5, 1.0], [0.5, 1.25])
    >>> figure.axes[1].get_title()
    'greatest difference 0.25'
    """
    pair = [_check_scores(scores, name) for scores, name in ((fast, "fast"), (reference, "reference"))]
    if len(pair[0]) != len(pair[1]):
        raise InvalidInputError(
            f"fast and reference must be scores of the same windows; got {len(pair[0])} and {len(pair[1])}"
        )
    quick, slow = pair
    difference = quick - slow
    sheet = new_figure(figure, 10, 4.2)
    left, right = panels(sheet, 1, 2)[0]
    ends = [min(quick.min(), slow.min()), max(quick.max(), slow.max())]
    left.plot(ends, ends, color="0.3", linewidth=0.8, label="equal")
    left.scatter(slow, quick, s=5, color=BLUE, alpha=0.5, linewidths=0, label=f"{len(quick):,} windows")
    left.set_xlabel("score of the reference search")
    left.set_ylabel("score of the fast search")
    left.legend(fontsize=9)
    worst = float(np.abs(difference).max())
    reach = worst or 1e-12
    right.hist(difference, bins=60, range=(-reach, reach), color=BLUE)
    right.set_yscale("log")
    right.set_xlabel("fast - reference")
    right.set_ylabel("windows")
    right.set_title(f"greatest difference {worst:.2g}", fontsize=10)
    right.ticklabel_format(axis="x", style="sci", scilimits=(-3, 3))
    return sheet


def _check_scores(scores: ArrayLike, name: str) -> NDArray[np.float64]:
    array = np.asarray(scores)
    if array.ndim != 1 or not array.size or array.dtype.kind not in "iuf" or not np.isfinite(array).all():
        raise InvalidInputError(
            f"{name} must be a list of finite scores, at least one; got {describe(array)}"
        )
    return array.astype(np.float64)


def plot_speedups(
    seconds: Mapping[str, float], *, reference: str | None = None, ax: Axes | None = None
) -> Axes:
    """Plot how long several ways to do the same take, and how many times faster than one of them.

    Parameters
    ----------
    seconds
        Seconds by name.
    reference
        The one the others are compared with; None takes the slowest.
    ax
        Where to draw; None makes a new figure.

    Returns
    -------
    matplotlib.axes.Axes
        One bar each, in milliseconds on a logarithmic scale.

    Raises
    ------
    InvalidInputError
        If `seconds` holds something else than positive numbers, or not the reference.

    Examples
    --------
    >>> axes = plot_speedups({"one by one": 4.0, "shared": 0.01})
    >>> [text.get_text() for text in axes.texts]
    ['4,000 ms', '10 ms, 400x faster']
    """
    given: object = seconds
    if not isinstance(given, Mapping) or not given:
        raise InvalidInputError(f"seconds must map names to seconds, at least one; got {describe(given)}")
    times = {str(name): check_number(value, f"seconds[{name!r}]", above=0) for name, value in given.items()}
    slowest = max(times, key=times.__getitem__) if reference is None else reference
    if slowest not in times:
        raise InvalidInputError(f"reference must be one of {', '.join(times)}; got {describe(reference)}")
    axes = new_axes(ax, 8, 0.8 + 0.45 * len(times))
    values = [1000 * value for value in times.values()]
    colors = ["0.6" if name == slowest else BLUE for name in times]
    bars = axes.barh(list(times), values, color=colors)
    axes.bar_label(bars, [_time_text(times, name, slowest) for name in times], padding=3, fontsize=9)
    axes.set_xscale("log")
    axes.set_xlim(min(values) / 3, max(values) * 12)
    axes.invert_yaxis()
    axes.set_xlabel("time (ms)")
    axes.spines[["top", "right"]].set_visible(False)
    return axes


def _time_text(times: Mapping[str, float], name: str, reference: str) -> str:
    value = 1000 * times[name]
    text = f"{value:,.0f} ms" if value >= 10 else f"{value:.2g} ms"
    ratio = times[reference] / times[name]
    if name == reference:
        return text
    if ratio < 1:
        return f"{text}, {1 / ratio:.1f}x slower"
    return f"{text}, {ratio:,.0f}x faster" if ratio >= 10 else f"{text}, {ratio:.1f}x faster"


def plot_heatmap(
    image: Image,
    windows: Detections,
    *,
    params: HeatParams | None = None,
    heat: NDArray[Any] | None = None,
    figure: Sheet | None = None,
) -> Sheet:
    """Show how windows become boxes: the windows, their heat, and what is left above the threshold.

    Parameters
    ----------
    image
        ``(H, W, 3)`` uint8 RGB frame.
    windows
        Its positive windows.
    params
        Weighting, threshold and share of the peak; the default is ``HeatParams()``.
    heat
        ``(H, W)`` heat map, such as the mean over the last frames; None makes that of `windows`.
    figure
        Where to draw; None makes a new figure.

    Returns
    -------
    matplotlib.figure.Figure or SubFigure
        Three panels: frame with windows; heat with its scale; frame with each labelled region in a color
        of its own and the boxes of `label_boxes`, which are the panel's one collection.

    Raises
    ------
    InvalidInputError
        If an argument is malformed, or the heat is not of the frame's size.

    Examples
    --------
    >>> frame = np.zeros((72, 128, 3), np.uint8)
    >>> found = Detections([[10, 10, 40, 40], [20, 10, 50, 40]], [1.5, 1.5])
    >>> figure = plot_heatmap(frame, found)
    >>> [panel.get_title() for panel in figure.axes[:3]]
    ['2 windows', 'heat, peak 3.0', '1 region above 2']
    """
    picture = check_image(image)
    check_type(windows, "windows", Detections, "pass what find_cars returns, or Detections(boxes, scores)")
    params = params or HeatParams()
    check_type(params, "params", HeatParams, "pass HeatParams()")
    warm = frame_heat(picture.shape, windows, params) if heat is None else heat
    given: object = warm
    if not isinstance(given, np.ndarray) or warm.shape != picture.shape[:2]:
        raise InvalidInputError(
            f"heat must be an array of the frame's size {picture.shape[:2]}, got {describe(given)}; "
            "add it up with add_heat"
        )
    found = label_boxes(warm, threshold=params.threshold, peak_fraction=params.peak_fraction)
    height, width = picture.shape[:2]
    sheet = new_figure(figure, 15, 5 * height / width + 0.5, layout="compressed")
    first, second, third = panels(sheet, 1, 3)[0]
    put_image(first, picture)
    put_boxes(first, windows.boxes, SKY, halo=False, linewidths=0.8)
    _hold_view(first, width, height)
    first.set_title(_count(len(windows), "window"), fontsize=10)
    peak = float(warm.max())
    put_image(second, warm, cmap="inferno", vmin=0, vmax=max(peak, 1e-6))
    bar = second.figure.colorbar(second.images[0], ax=second, shrink=0.8, pad=0.02)
    bar.set_label("sum of scores" if params.weighting == "score" else "windows")
    if params.threshold <= peak:
        bar.ax.axhline(params.threshold, color=SKY, linewidth=2)
    second.set_title(f"heat, peak {peak:.1f}", fontsize=10)
    put_image(third, paint_regions(picture, warm, params.threshold))
    put_boxes(third, found.boxes, YELLOW, linewidths=2.0)
    _hold_view(third, width, height)
    third.set_title(f"{_count(len(found), 'region')} above {params.threshold:g}", fontsize=10)
    return sheet


def _hold_view(panel: Any, width: int, height: int) -> None:
    panel.set_xlim(0, width)
    panel.set_ylim(height, 0)


def _count(number: int, name: str) -> str:
    return f"{number:,} {name}{'s' * (number != 1)}"


def paint_regions(image: Image, heat: NDArray[Any], threshold: float) -> Image:
    """Lay a color over each connected region above the threshold, on a copy of a gray frame."""
    from scipy import ndimage

    labels, _ = ndimage.label(apply_threshold(heat, threshold) > 0, structure=np.ones((3, 3)))
    gray = np.repeat(image.mean(axis=2, keepdims=True) * 0.8, 3, axis=2)
    colors = np.array([(0.0, 0.0, 0.0), *COLORS]) * 255
    chosen = np.where(labels > 0, (labels - 1) % len(COLORS) + 1, 0)
    mixed = np.where(labels[..., None] > 0, 0.45 * gray + 0.55 * colors[chosen], gray)
    return np.asarray(mixed.round(), np.uint8)
