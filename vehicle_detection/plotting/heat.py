"""A figure of the course's way from windows to boxes: the heat map."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_image, check_type, describe
from vehicle_detection.boxes import Detections
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.heatmap import apply_threshold, frame_heat, label_boxes
from vehicle_detection.params import HeatParams
from vehicle_detection.plotting.style import (
    COLORS,
    SKY,
    YELLOW,
    Sheet,
    new_figure,
    panels,
    put_boxes,
    put_image,
)

Image = NDArray[np.uint8]


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
        Three panels: frame with windows; heat with its scale; frame with each labelled region in a colour
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
    found = label_boxes(warm, threshold=params.threshold, share=params.share)
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
    """Lay a colour over each connected region above the threshold, on a copy of a gray frame."""
    from scipy import ndimage

    labels, _ = ndimage.label(apply_threshold(heat, threshold) > 0, structure=np.ones((3, 3)))
    gray = np.repeat(image.mean(axis=2, keepdims=True) * 0.8, 3, axis=2)
    colors = np.array([(0.0, 0.0, 0.0), *COLORS]) * 255
    chosen = np.where(labels > 0, (labels - 1) % len(COLORS) + 1, 0)
    mixed = np.where(labels[..., None] > 0, 0.45 * gray + 0.55 * colors[chosen], gray)
    return np.asarray(mixed.round(), np.uint8)
