"""Diagnostic pictures: a mosaic of the steps of detection, and heat maps in color."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import check_array, check_boxes, check_image, check_type, describe
from vehicle_detection.boxes import Detections
from vehicle_detection.drawing.boxes import draw_boxes
from vehicle_detection.drawing.primitives import (
    BLACK,
    WHITE,
    Image,
    draw_text,
    fill_rectangle,
    text_scale,
    text_size,
)
from vehicle_detection.drawing.tracks import TRACK_COLORS, TrackDrawer, check_tracks
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.params import DrawParams
from vehicle_detection.tracking import Track

# Colors of cells that speak for and against a vehicle, and opacity of the one with the largest share.
_FOR_COLOR, _AGAINST_COLOR, _MAX_ALPHA = TRACK_COLORS[5], TRACK_COLORS[4], 0.75


def draw_diagnostics(
    frame: Image,
    windows: Detections | ArrayLike,
    heat: NDArray[Any],
    tracks: Iterable[Track],
    *,
    params: DrawParams | None = None,
) -> Image:
    """Draw a 2x2 mosaic: the frame, its positive windows, the heat map, the tracks.

    Parameters
    ----------
    frame, tracks
        ``(H, W, 3)`` uint8 RGB, and its tracks.
    windows
        Positive windows, as `Detections` or boxes in any form that `draw_boxes` accepts.
    heat
        ``(h, w)`` finite numbers, of the frame's size or smaller; drawn from black (0) to yellow (maximum).
    params
        Labels, units, lines and colors of the tracks; a bird's-eye view is not drawn.

    Returns
    -------
    numpy.ndarray
        An image of the frame's shape; an odd side ends with a black line.

    Raises
    ------
    InvalidInputError
        If an argument is malformed, or the frame is smaller than 4x4 pixels.
    """
    if params is not None:
        check_type(params, "params", DrawParams, "omit it for the defaults")
    checked = check_image(frame, "frame")
    height, width = (side // 2 for side in checked.shape[:2])
    if min(height, width) < 2:
        raise InvalidInputError(
            f"frame must be at least 4x4 pixels, got {describe(frame)}; pass a larger image"
        )
    # Draw at the panels' size, so that lines and text stay sharp.
    small = np.asarray(cv2.resize(checked, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    scale = np.array([width, height, width, height]) / np.array(checked.shape[:2] * 2)[[1, 0, 1, 0]]
    boxes = check_boxes(windows)
    scaled = [dataclasses.replace(track, box=track.box * scale) for track in check_tracks(tracks)]
    panels = [
        ("frame", small),
        ("windows", draw_boxes(small, boxes * scale, color=TRACK_COLORS[1], thickness=1)),
        ("heat", np.asarray(cv2.resize(heat_image(heat), (width, height)), np.uint8)),
        (
            "tracks",
            TrackDrawer(dataclasses.replace(params or DrawParams(), panel="none")).draw(small, scaled),
        ),
    ]
    mosaic = np.zeros(checked.shape, np.uint8)  # not zeros_like: OpenCV needs rows in C order
    for index, (title, panel) in enumerate(panels):
        top, left = index // 2 * height, index % 2 * width
        view = mosaic[top : top + height, left : left + width]
        view[:] = panel
        scale = text_scale(view.shape)
        title_width, title_height = text_size([title], scale)
        fill_rectangle(view, (0, 0, title_width, title_height), BLACK, 0.6)
        draw_text(view, [title], 0, 0, scale, WHITE)
    return mosaic


def draw_cell_shares(image: Image, window: ArrayLike, cells: NDArray[Any]) -> Image:
    """Draw the shares of a window's cells in its score on a copy of an image, as `Explanation` holds them.

    Orange cells raise the score and blue ones lower it, the stronger the more. `window` is
    ``[x1, y1, x2, y2]`` in pixels, and `cells` are ``(rows, columns)``.
    """
    result = check_image(image).copy()
    x1, y1, x2, y2 = check_boxes([window], "window")[0].astype(np.float64).tolist()
    rows, columns = cells.shape
    peak = float(np.abs(cells).max()) or 1.0
    xs, ys = np.linspace(x1, x2, columns + 1).round(), np.linspace(y1, y2, rows + 1).round()
    for (row, column), share in np.ndenumerate(cells):
        place = int(xs[column]), int(ys[row]), int(xs[column + 1]), int(ys[row + 1])
        color = _FOR_COLOR if share > 0 else _AGAINST_COLOR
        fill_rectangle(result, place, color, _MAX_ALPHA * abs(float(share)) / peak)
    return result


def heat_image(heat: NDArray[Any]) -> Image:
    """Color an ``(h, w)`` heat map from black (0) to yellow (its maximum), as ``(h, w, 3)`` uint8 RGB."""
    values = check_array(heat, "heat")
    if values.ndim != 2 or not values.size or values.dtype.kind not in "iufb":
        raise InvalidInputError(
            f"heat must be an (h, w) array of numbers, got {describe(heat)}; pass a heat map"
        )
    values = values.astype(np.float32)
    if not np.isfinite(values).all():
        raise InvalidInputError("heat must be finite, got NaN or infinity; build it with add_heat")
    peak = float(values.max())
    gray = np.clip(values * (255 / peak if peak > 0 else 0.0), 0, 255).astype(np.uint8)
    colored = cv2.applyColorMap(gray, cv2.COLORMAP_INFERNO)
    return np.asarray(cv2.cvtColor(colored, cv2.COLOR_BGR2RGB), np.uint8)
