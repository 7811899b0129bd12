"""Windows: listed by `slide_window`, and classified by `search_windows` and `find_cars`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vehicle_detection._common import check, describe, invalid
from vehicle_detection.boxes import Detections
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.features import PATCH_SIZE, extract_features
from vehicle_detection.search import PixelBand, SearchParams
from vehicle_detection.svm import CLASSIFIER_REMEDY, VehicleClassifier

Range = Sequence[int | None]


def slide_window(
    image: NDArray[np.uint8],
    *,
    x_start_stop: Range = (None, None),
    y_start_stop: Range = (None, None),
    xy_window: Sequence[int] = (64, 64),
    xy_overlap: Sequence[float] = (0.5, 0.5),
) -> NDArray[np.int64]:
    """List the windows of one size over a region of the image.

    Returns ``(N, 4)`` int64 ``[x1, y1, x2, y2]``, row by row: every window of the grid that fits into the
    region. ``+`` joins two such arrays, as it joins the lists of the course.

    Parameters
    ----------
    image
        ``(H, W, 3)`` uint8 RGB; only its shape is used.
    x_start_stop, y_start_stop
        Half-open pixel range of the region; None means the image's border.
    xy_window, xy_overlap
        Width and height of a window, and the overlap of neighbors as fractions of these, in [0, 1).

    Examples
    --------
    >>> slide_window(np.zeros((64, 128, 3), np.uint8), xy_window=(64, 64)).tolist()
    [[0, 0, 64, 64], [32, 0, 96, 64], [64, 0, 128, 64]]
    """
    height, width = check.image(image).shape[:2]
    x1, x2 = _check_range(x_start_stop, width, "x_start_stop")
    y1, y2 = _check_range(y_start_stop, height, "y_start_stop")
    given = {"xy_window": xy_window, "xy_overlap": xy_overlap}
    if any(np.shape(check.array(pair, name)) != (2,) for name, pair in given.items()):
        raise InvalidInputError(f"xy_window and xy_overlap must be pairs; got {xy_window} and {xy_overlap}")
    steps = []
    for index, side in enumerate(xy_window):
        check.integer(side, f"xy_window[{index}]", low=1)
        overlap = check.number(xy_overlap[index], f"xy_overlap[{index}]", low=0, high=0.999)
        # The step is truncated as in the course; the small term compensates rounding, as in 50 * (1 - 0.9).
        steps.append(max(1, int(side * (1 - overlap) + 1e-9)))
    band = PixelBand(x1, y1, x2, y2, (int(xy_window[0]), int(xy_window[1])), (steps[0], steps[1]))
    return band_windows(band)


def band_windows(band: PixelBand) -> NDArray[np.int64]:
    """All windows of a band, ``(N, 4)`` int64, row by row."""
    width, height = band.window
    xs = np.arange(band.x1, band.x2 - width + 1, band.step[0])
    ys = np.arange(band.y1, band.y2 - height + 1, band.step[1])
    left, top = (grid.ravel() for grid in np.meshgrid(xs, ys))
    return np.stack([left, top, left + width, top + height], axis=1).astype(np.int64)


def _check_range(limits: Range, size: int, name: str) -> tuple[int, int]:
    """Replace None by the image's border and check that the range is inside."""
    pair: Any = limits
    numbers = (int, np.integer, type(None))
    if np.shape(check.array(pair, name)) != (2,) or not all(isinstance(limit, numbers) for limit in pair):
        raise InvalidInputError(f"{name} must be (start, stop), whole pixels or None; got {describe(limits)}")
    start = 0 if limits[0] is None else int(limits[0])
    stop = size if limits[1] is None else int(limits[1])
    if not 0 <= start < stop <= size:
        raise InvalidInputError(f"{name} must satisfy 0 <= start < stop <= {size}; got {(start, stop)}")
    return start, stop


def search_windows(
    image: NDArray[np.uint8],
    windows: Detections | ArrayLike,
    classifier: VehicleClassifier,
    *,
    min_score: float | None = 0.0,
    jobs: int | None = None,
) -> Detections:
    """Classify each window of a list, cropped and resized to 64x64; return windows and scores in their order.

    Parameters
    ----------
    image, windows
        ``(H, W, 3)`` uint8 RGB, and ``(N, 4)`` whole-pixel boxes inside it, of any size.
    classifier, jobs
        As in `find_cars`.
    min_score
        Minimum score of the returned windows (exclusive); None returns all.

    Examples
    --------
    >>> from vehicle_detection import load_classifier, read_image
    >>> image, classifier = read_image("test_images/road1.jpg"), load_classifier()
    >>> len(search_windows(image, [[600, 400, 664, 464]], classifier, min_score=None))  # with its score
    1
    """
    check.image(image)
    check.instance(classifier, "classifier", VehicleClassifier, CLASSIFIER_REMEDY)
    given = check.boxes(windows, "windows")
    boxes = given.astype(np.int64)
    fractional = (boxes != given).any(1)
    if fractional.any():
        row = int(np.argmax(fractional))
        raise invalid(f"windows[{row}]", "be whole pixels", given[row].tolist(), "round them first")
    min_score = -np.inf if min_score is None else check.number(min_score, "min_score")
    height, width = image.shape[:2]
    inside = (boxes[:, :2] >= 0).all(1) & (boxes[:, 2] <= width) & (boxes[:, 3] <= height)
    valid = inside & (boxes[:, 2:] > boxes[:, :2]).all(1)
    if not valid.all():
        row = int(np.argmin(valid))
        must = f"be non-empty boxes inside the {width}x{height} image"
        remedy = "use slide_window, or clip_boxes and drop empty boxes"
        raise invalid(f"windows[{row}]", must, boxes[row].tolist(), remedy)
    patches = np.empty((len(boxes), PATCH_SIZE, PATCH_SIZE, 3), np.uint8)
    for patch, (x1, y1, x2, y2) in zip(patches, boxes):
        cv2.resize(image[y1:y2, x1:x2], (PATCH_SIZE, PATCH_SIZE), dst=patch)
    features = extract_features(patches, classifier.params, jobs=jobs)
    scores = classifier.decision_function(features)
    return Detections(boxes, scores)[scores > min_score]


def find_cars(
    image: NDArray[np.uint8],
    classifier: VehicleClassifier,
    params: SearchParams | None = None,
    *,
    jobs: int | None = None,
) -> Detections:
    """Find the windows of a frame that look like vehicles.

    A band is resized once, and its windows share their features. Gradients are zero at the band's border, and
    not at a window's as in `search_windows`; `vehicle_detection.course.reference` gives the same scores.

    Returns float boxes in pixels of the image and scores, ordered by band and row.

    Parameters
    ----------
    image, classifier
        ``(H, W, 3)`` uint8 RGB, and the trained model.
    params
        Bands and minimum score, by default ``SearchParams.preset("default")``. Steps between windows are
        rounded to whole cells, at least one.
    jobs
        Threads, each of which searches a band; the result does not depend on them.

    Examples
    --------
    >>> from vehicle_detection import load_classifier
    >>> len(find_cars(np.zeros((720, 1280, 3), np.uint8), load_classifier()))
    0
    """
    check.instance(classifier, "classifier", VehicleClassifier, CLASSIFIER_REMEDY)
    with classifier.open_search(jobs) as search:
        return search.find_windows(image, SearchParams.preset() if params is None else params)
