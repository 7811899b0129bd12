"""Windows and boxes as corner pairs: listed, added as heat, and drawn."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vehicle_detection import heatmap as library
from vehicle_detection._common import check, describe, invalid
from vehicle_detection.course.features import Image, check_lesson_image
from vehicle_detection.course.versions import FORMULAS, lesson_function
from vehicle_detection.errors import InvalidInputError

Corners = tuple[tuple[int, int], tuple[int, int]]

BLUE = (0, 0, 255)
THICKNESS = 6


@lesson_function()
def slide_window(
    img: Any,
    x_start_stop: Sequence[float | None] = (None, None),
    y_start_stop: Sequence[float | None] = (None, None),
    xy_window: Sequence[float] = (64, 64),
    xy_overlap: Sequence[float] = (0.5, 0.5),
    *,
    formula: str = "old",
) -> list[Corners]:
    """List the windows of one size over a region of an image, row by row.

    Returns corner pairs ``((x1, y1), (x2, y2))``.

    Parameters
    ----------
    img
        Only its height and width are used.
    x_start_stop, y_start_stop
        Pixel range of the region, whole numbers; None means the image's border. Lists are not changed.
    xy_window, xy_overlap
        Width and height of a window, whole numbers, and overlap of neighboring windows as fractions of these.
    formula
        Number of windows along an axis; the course has published both. ``"old"``: ``int(span / step) - 1``;
        with overlaps above 0.5 the last windows extend beyond the region, and below 0.5 some that fit are
        left out. ``"new"``: ``int((span - int(window * overlap)) / step)``, the windows that fit.

    Examples
    --------
    >>> slide_window(np.zeros((64, 128, 3)), xy_overlap=(0.5, 0))
    []
    >>> slide_window(np.zeros((64, 128, 3)), xy_overlap=(0.5, 0), formula="new")
    [((0, 0), (64, 64)), ((32, 0), (96, 64)), ((64, 0), (128, 64))]
    """
    if not isinstance(img, np.ndarray) or img.ndim < 2:
        raise InvalidInputError(f"img must be an image array; got {describe(img)}")
    check.choice(formula, "formula", FORMULAS)
    for name, pair in (("xy_window", xy_window), ("xy_overlap", xy_overlap)):
        if check.array(pair, name).shape != (2,):
            raise InvalidInputError(f"{name} must be a pair of numbers; got {describe(pair)}")
    width, height = (check.integer(_as_whole(side), "xy_window", low=1) for side in xy_window)
    x1, x2 = _check_span(x_start_stop, img.shape[1], "x_start_stop")
    y1, y2 = _check_span(y_start_stop, img.shape[0], "y_start_stop")
    lefts = _window_starts(x1, x2, width, xy_overlap[0], formula)
    tops = _window_starts(y1, y2, height, xy_overlap[1], formula)
    return [((x, y), (x + width, y + height)) for y in tops for x in lefts]


def _as_whole(value: Any) -> Any:
    """Return a whole-number float as an int, other values as they are."""
    return int(value) if isinstance(value, (float, np.floating)) and value.is_integer() else value


def _check_span(limits: Any, size: int, name: str) -> tuple[int, int]:
    """Return the pixel range ``[start, stop]`` with None replaced by the image's border."""
    pair = [_as_whole(limit) for limit in limits] if check.array(limits, name).shape == (2,) else []
    if not pair or not all(isinstance(limit, (int, np.integer, type(None))) for limit in pair):
        raise InvalidInputError(f"{name} must be [start, stop], whole pixels or None; got {describe(limits)}")
    start = 0 if pair[0] is None else int(pair[0])
    stop = size if pair[1] is None else int(pair[1])
    if not 0 <= start <= stop:
        raise InvalidInputError(f"{name} must satisfy 0 <= start <= stop; got {[start, stop]}")
    return start, stop


def _window_starts(start: int, stop: int, side: int, overlap: float, formula: str) -> range:
    """First pixels of the windows along one axis."""
    step = int(side * (1 - check.number(overlap, "xy_overlap", low=0)))
    if step < 1:
        raise invalid("xy_overlap", f"leave a step of a pixel between windows of {side} pixels", overlap)
    if formula == "old":
        count = int((stop - start) / step) - 1
    else:
        count = int((stop - start - int(side * overlap)) / step)
    return range(start, start + max(count, 0) * step, step)


def box_rows(boxes: Any) -> Any:
    """Return the boxes of `Detections` or ``supervision.Detections``, other values as they are."""
    boxes = getattr(boxes, "boxes", boxes)
    return getattr(boxes, "xyxy", boxes)


def corner_array(boxes: Any, name: str) -> NDArray[np.int64]:
    """Return boxes as ``(N, 4)`` whole pixels, from corner pairs, an array or detections."""
    rows = box_rows(boxes)
    if isinstance(rows, Iterable) and not isinstance(rows, (str, np.ndarray)):
        rows = list(rows)
    items = rows if isinstance(rows, list) or (isinstance(rows, np.ndarray) and rows.ndim) else ()
    # An RGB image, or a list with images or rows of one, as by boxes.extend(image).
    if any(isinstance(item, np.ndarray) and item.ndim >= 2 and item.shape[-1] == 3 for item in items):
        got = "got an image or rows of one; find_cars returns a picture, find_car_windows returns the boxes"
        raise InvalidInputError(f"{name} must be a list of corner pairs ((x1, y1), (x2, y2)), {got}")
    try:
        array = np.asarray(rows)
    except ValueError:  # rows of different lengths, such as boxes with scores
        try:
            array = np.array([(box[0], box[1]) for box in rows])
        except (TypeError, IndexError, KeyError, ValueError):
            array = np.array(None)
    if array.size == 0:
        return np.empty((0, 4), np.int64)
    if array.shape[1:] not in ((4,), (2, 2)) or array.dtype.kind not in "iuf" or not np.isfinite(array).all():
        raise invalid(name, "be a list of corner pairs ((x1, y1), (x2, y2))", boxes)
    return np.asarray(np.rint(array).astype(np.int64).reshape(-1, 4))


def add_heat(heatmap: NDArray[Any], bbox_list: Any) -> NDArray[Any]:
    """Add 1 to the pixels of each box, in place, and return the same array.

    Parameters
    ----------
    heatmap, bbox_list
        ``(H, W)``, changed; corner pairs, an ``(N, 4)`` array, or `Detections`, cut off at the map's border.

    Examples
    --------
    >>> heat = np.zeros((2, 4))
    >>> add_heat(heat, [((0, 0), (2, 2)), ((1, 0), (3, 1))]) is heat
    True
    >>> heat
    array([[1., 2., 1., 0.],
           [1., 1., 0., 0.]])
    """
    return library.add_heat(heatmap, corner_array(bbox_list, "bbox_list"))


apply_threshold = library.apply_threshold


def draw_boxes(img: Image, bboxes: Any, color: Sequence[float] = BLUE, thick: int = THICKNESS) -> Image:
    """Draw boxes on a copy of an image; the lines are centered on the box's edges, as by ``cv2.rectangle``.

    Parameters
    ----------
    img, bboxes
        ``(H, W, 3)``, uint8 or float; corner pairs, an ``(N, 4)`` array, or `Detections`.
    color, thick
        RGB, 0-255 each, and width of the lines in pixels; -1 fills the boxes.

    Examples
    --------
    >>> drawn = draw_boxes(np.zeros((40, 60, 3), np.uint8), [((10, 5), (30, 25))], thick=1)
    >>> drawn[25, 30].tolist()
    [0, 0, 255]
    """
    check_lesson_image(img)
    result: Image = np.array(img, order="C")
    given = check.array(color, "color")
    if given.shape not in ((), (3,)) or given.dtype.kind not in "iuf" or not np.isfinite(given).all():
        raise InvalidInputError(f"color must be (red, green, blue); got {describe(color)}")
    values = [float(given), 0.0, 0.0] if given.ndim == 0 else given.astype(float).tolist()
    check.integer(thick, "thick", low=-1)
    draw_corners(result, corner_array(bboxes, "bboxes"), values, thick)
    return result


def draw_labeled_bboxes(img: Image, labels: Any) -> Image:
    """Draw the bounding box of each labeled region on the image itself, and return it.

    The corners of the blue rectangles, 6 pixels thick, are a region's first and last pixels, so they are one
    pixel smaller than the half-open boxes of the main API.

    Parameters
    ----------
    img, labels
        ``(H, W, 3)``, uint8 or float, writable, with contiguous rows; the label array ``(H, W)`` and the
        number of regions, as ``scipy.ndimage.label`` returns them.

    Examples
    --------
    >>> from scipy.ndimage import label
    >>> heat = np.zeros((40, 60))
    >>> heat[10:30, 20:50] = 1
    >>> image = np.zeros((40, 60, 3), np.uint8)
    >>> draw_labeled_bboxes(image, label(heat)) is image, image[29, 49].tolist()
    (True, [0, 0, 255])
    """
    check_lesson_image(img)
    corners = labeled_bboxes(labels, img.shape[:2])
    rows = img.strides[0] > 0 and img.strides[1:] == (3 * img.itemsize, img.itemsize)
    if corners and not (img.flags.writeable and rows):
        raise InvalidInputError("img must be writable and contiguous to be drawn on; pass numpy.copy(img)")
    draw_corners(img, corner_array(corners, "labels"))
    return img


def labeled_bboxes(labels: Any, shape: tuple[int, ...] | None = None) -> list[Corners]:
    """First and last pixel of each region that ``scipy.ndimage.label`` finds in an image of `shape`."""
    from scipy.ndimage import find_objects

    array, count = labels if isinstance(labels, (tuple, list)) and len(labels) == 2 else (None, 0)
    array = array if isinstance(array, np.ndarray) else np.array(None)
    if array.ndim != 2 or array.dtype.kind not in "iu" or shape not in (None, array.shape):
        must = f"be the pair that scipy.ndimage.label returns for a map of {shape or '(H, W)'}"
        raise invalid("labels", must, labels)
    regions = find_objects(array, max_label=check.integer(count, "the number of labels", low=0))
    return [((x.start, y.start), (x.stop - 1, y.stop - 1)) for y, x in filter(None, regions)]


def bounding_boxes(image: Image, windows: Any, threshold: float = 1) -> list[Corners]:
    """Boxes of the regions of an image that more than `threshold` hot windows cover: heat, threshold, labels.

    Examples
    --------
    >>> windows = [((0, 0), (8, 8)), ((4, 0), (12, 8))]
    >>> bounding_boxes(np.zeros((20, 20, 3)), windows, 1)
    [((4, 0), (7, 7))]
    """
    from scipy.ndimage import label

    heat = add_heat(np.zeros(check_lesson_image(image, "image").shape[:2]), windows)
    return labeled_bboxes(label(apply_threshold(heat, threshold)))


def show_images(images: Sequence[Image], titles: Sequence[str] = (), columns: int = 2) -> None:
    """Show images in a grid with matplotlib's pyplot: RGB, or ``(H, W)`` in a color map."""
    import matplotlib.pyplot as plt

    for image in (images := check.sequence(images, "images", "images")):
        # A row of a single image is no (H, W) image.
        if not isinstance(image, np.ndarray) or image.ndim != 2 or image.shape[1] <= 4:
            check_lesson_image(image, "each of the images")
    columns = min(check.integer(columns, "columns", low=1), len(images) or 1)
    rows, titles = -(-len(images) // columns) or 1, check.sequence(titles, "titles", "texts")
    panels = plt.subplots(rows, columns, figsize=(6 * columns, 3.6 * rows), squeeze=False)[1].ravel()
    for panel, image in zip(panels, images):
        panel.imshow(image, cmap="hot" if image.ndim == 2 else None)
    for panel, title in zip(panels, titles):
        panel.set_title(title)
    for panel in panels:
        panel.axis("off")


def draw_corners(
    image: Image, corners: NDArray[np.int64], color: Sequence[float] = BLUE, thick: int = THICKNESS
) -> None:
    """Draw boxes on the image itself."""
    for x1, y1, x2, y2 in corners.tolist():
        cv2.rectangle(image, (x1, y1), (x2, y2), color, thick)
