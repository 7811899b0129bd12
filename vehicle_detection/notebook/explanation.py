"""Figure of an explanation: the share of each cell on the vehicle, and the sum of the terms."""

from __future__ import annotations

import numpy as np

from vehicle_detection._common import check_image, check_type
from vehicle_detection.evaluation import Explanation
from vehicle_detection.notebook import style
from vehicle_detection.notebook.style import BLUE, VERMILION, YELLOW, FigureLike, Image

# Part of the image around the window that is shown, as a fraction of the window's longer side.
_AROUND = 0.25
# Opacity of the cell with the largest share.
_MAX_ALPHA = 0.75


def plot_explanation(
    image: Image, explanation: Explanation, *, figure: FigureLike | None = None
) -> FigureLike:
    """Draw why a detector finds a vehicle in a box.

    Three panels: the vehicle with its box; the same with the cells of the window, orange where a cell speaks
    for a vehicle and blue where it speaks against one, the stronger the more; and the terms of the margin
    with their sum.

    Parameters
    ----------
    image, explanation
        ``(H, W, 3)`` uint8 RGB, and what `explain` returned for it.

    Examples
    --------
    >>> from vehicle_detection import VehicleDetector, explain
    >>> road = np.full((360, 640, 3), 90, np.uint8)
    >>> figure = plot_explanation(road, explain(VehicleDetector(), road, [300, 200, 360, 250]))
    >>> [panel.get_title() for panel in figure.axes][:2]
    ['not found', 'share of each cell, orange: for a vehicle']
    """
    from matplotlib.colors import to_rgb

    height, width = check_image(image).shape[:2]
    check_type(explanation, "explanation", Explanation, "pass what explain returned")
    figure, grid = style.new_panels(figure, (10.5, 3.6), 1, 3)
    plain, shares, sums = grid.flat
    score = "not found" if explanation.score is None else f"score {explanation.score:.2f}"
    left, top, right, bottom = explanation.window.tolist()
    both = explanation.window, explanation.box
    first, last = np.minimum(*both), np.maximum(*both)
    around = _AROUND * max(right - left, bottom - top)
    for panel, title in ((plain, score), (shares, "share of each cell, orange: for a vehicle")):
        style.add_image(panel, image, title)
        style.add_boxes(panel, explanation.box[None], YELLOW)
        panel.set_xlim(max(first[0] - around, -0.5), min(last[2] + around, width - 0.5))
        panel.set_ylim(min(last[3] + around, height - 0.5), max(first[1] - around, -0.5))
    peak = float(np.abs(explanation.cells).max()) or 1.0
    colors = np.empty((*explanation.cells.shape, 4))
    colors[..., :3] = np.where(explanation.cells[..., None] > 0, to_rgb(VERMILION), to_rgb(BLUE))
    colors[..., 3] = _MAX_ALPHA * np.abs(explanation.cells) / peak
    limits = shares.get_xlim(), shares.get_ylim()
    shares.imshow(colors, extent=(left, right, bottom, top), interpolation="nearest", zorder=2)
    shares.set(xlim=limits[0], ylim=limits[1])
    names, values = list(explanation.terms), list(explanation.terms.values())
    ends = np.concatenate(([0.0], np.cumsum(values)))
    starts = ends[:-1]
    rows = np.arange(len(values))
    sums.barh(rows, values, left=starts, color=[VERMILION if value > 0 else BLUE for value in values])
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
