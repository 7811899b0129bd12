"""Figures of the search: windows, bands, heat map, and the fast search compared with the reference."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from vehicle_detection._common import check, describe, pluralize
from vehicle_detection.boxes import Detections
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.heatmap import HeatParams, frame_heat, heat_threshold, label_heat
from vehicle_detection.notebook import style
from vehicle_detection.notebook.style import SKY, VERMILION, YELLOW, FigureLike, Image
from vehicle_detection.search import SearchParams
from vehicle_detection.windows import band_windows

if TYPE_CHECKING:
    pass


def plot_bands(
    image: Image, search: SearchParams | None = None, *, figure: FigureLike | None = None
) -> FigureLike:
    """Draw the search band of each window size: its bounds, the first window, and the next ones.

    Each band of `search` (by default ``SearchParams.preset()``) that fits into the frame has a panel. Its
    collections are the bounds, the windows one step to the right and one step down, and the first window; the
    dashed line is the horizon.

    >>> frame = np.zeros((720, 1280, 3), np.uint8)
    >>> figure = plot_bands(frame, SearchParams.preset("three-scales"))
    >>> len(figure.axes), figure.axes[1].get_title()
    (3, '64x64 px, step 8x8, 3,825 windows')
    """
    height, width = check.image(image).shape[:2]
    check.instance(search, "search", SearchParams | None, "pass SearchParams.preset()")
    search = search or SearchParams.preset()
    bands = search.place(image.shape)
    columns = 2 if len(bands) in (2, 4) else min(len(bands), 3)
    rows = math.ceil(len(bands) / columns)
    # All panels have the limits of the widest band.
    bounds = np.array([[band.x1, band.y1, band.x2, band.y2] for band in bands])
    visible = max(width, bounds[:, 2].max()) - min(0, bounds[:, 0].min())
    panel_height = 13 / columns * height / visible + 0.3
    size = 13, rows * panel_height + 0.4
    figure, grid = style.new_panels(figure, size, rows, columns, count=len(bands), layout="compressed")
    for panel, band, bound in zip(grid.flat, bands, bounds):
        style.add_image(panel, image)
        panel.axhline(search.horizon * height, color="white", linestyle="--", linewidth=0.8)
        windows = band_windows(band)
        shift = np.array([[band.step[0], 0] * 2, [0, band.step[1]] * 2])
        # A low or narrow band may not have a second window in that direction.
        neighbors = [row for row in windows[:1] + shift if (windows == row).all(axis=1).any()]
        style.add_boxes(panel, bound[None], YELLOW)
        style.add_boxes(panel, np.array(neighbors).reshape(-1, 4), SKY, linewidths=1.0)
        style.add_boxes(panel, windows[:1], VERMILION, linewidths=1.4)
        right, bottom = np.maximum((width, height), bounds[:, 2:].max(axis=0))
        panel.set(xlim=(min(0, bounds[:, 0].min()), right), ylim=(bottom, min(0, bounds[:, 1].min())))
        side, step = (f"{x}x{y}" for x, y in (band.window, band.step))
        panel.set_title(f"{side} px, step {step}, {pluralize(len(windows), 'window')}", fontsize=9)
    handles = style.legend_lines(
        ("band", YELLOW, "-"),
        ("first window", VERMILION, "-"),
        ("next windows to the right and down", SKY, "-"),
        ("horizon", "0.6", "--"),
    )
    figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=9, frameon=False)
    return figure


def plot_heatmap(
    image: Image,
    windows: Detections,
    *,
    params: HeatParams | None = None,
    heat: NDArray[Any] | None = None,
    figure: FigureLike | None = None,
) -> FigureLike:
    """Show how windows become boxes: the windows, their heat map, and the regions above the threshold.

    The regions have different colors, and the boxes of `label_boxes` are one line collection. `params` are by
    default as in `bounding_boxes`; `heat` is an ``(H, W)`` map, such as the mean over the last frames, by
    default that of `windows`.

    >>> frame = np.zeros((72, 128, 3), np.uint8)
    >>> found = Detections([[10, 10, 40, 40], [20, 10, 50, 40]], [1.5, 1.5])
    >>> figure = plot_heatmap(frame, found)
    >>> [panel.get_title() for panel in figure.axes[:3]]
    ['2 windows', 'heat, peak 3.0', '1 region above 2']
    """
    height, width = check.image(image).shape[:2]
    check.instance(windows, "windows", Detections, "pass what find_cars returns")
    check.instance(params, "params", HeatParams | None, "pass HeatParams()")
    params = params or HeatParams()
    heat = frame_heat(image.shape, windows, params) if heat is None else heat
    if np.shape(heat) != (height, width):
        raise InvalidInputError(
            f"heat must be an array of the frame's size {(height, width)}, got {describe(heat)}; "
            "compute it with add_heat"
        )
    found, threshold = label_heat(heat, params), heat_threshold(params)
    size = 15, 5 * height / width + 0.5
    figure, ((first, second, third),) = style.new_panels(figure, size, 1, 3, layout="compressed")
    style.add_image(first, image)
    style.add_boxes(first, windows.boxes, SKY, halo=False, linewidths=0.8)
    first.set_title(pluralize(len(windows), "window"), fontsize=10)
    peak = float(heat.max())
    style.add_image(second, heat, cmap="inferno", vmin=0, vmax=peak if peak > 0 else 1.0)
    bar = second.figure.colorbar(second.images[0], ax=second, shrink=0.8, pad=0.02)
    bar.set_label("sum of scores" if params.weighting == "score" else "windows")
    if threshold <= peak:
        bar.ax.axhline(threshold, color=SKY, linewidth=2)
    second.set_title(f"heat, peak {peak:.1f}", fontsize=10)
    style.add_image(third, _color_regions(image, heat, threshold))
    style.add_boxes(third, found.boxes, YELLOW, linewidths=2.0)
    third.set_title(f"{pluralize(len(found), 'region')} above {threshold:g}", fontsize=10)
    return figure


def _color_regions(image: Image, heat: NDArray[Any], threshold: float) -> Image:
    """Blend a color over each connected region above the threshold, on a gray copy of the frame."""
    labels, _ = ndimage.label(heat > threshold, structure=np.ones((3, 3)))
    gray = np.repeat(image.mean(axis=2, keepdims=True) * 0.8, 3, axis=2)
    colors = 255 * np.array(style.COLORS)[(labels - 1) % len(style.COLORS)]
    blended = np.where(labels[..., None] > 0, 0.45 * gray + 0.55 * colors, gray)
    return np.asarray(blended.round(), np.uint8)
