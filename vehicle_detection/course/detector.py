"""The course's detector of videos: hot windows, their heat over several frames, threshold, labels, boxes."""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from vehicle_detection._common import check, describe
from vehicle_detection.boxes import Detections
from vehicle_detection.course.methods import FindWindows, read_bands, window_search
from vehicle_detection.course.smoothing import BoxSmoother
from vehicle_detection.course.windows import (
    Corners,
    add_heat,
    apply_threshold,
    draw_boxes,
    labeled_bboxes,
    show_images,
)
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.heatmap import label_boxes


class HeatmapDetector:
    """Detect vehicles in the frames of a video as in the course: windows, heat, threshold, labels, boxes.

    Calling it with a frame draws the boxes, as in ``clip.image_transform(detector)`` of moviepy. It keeps the
    heat of the last frames and nothing else, unless `smoother` does.

    Parameters
    ----------
    clf
        What finds the hot windows: ``"highway"``, the path of a model file, a `VehicleClassifier`; a fitted
        classifier with ``predict``, which needs `scaler` unless it is a pipeline; or a function of an image
        that returns boxes.
    scaler
        The fitted scaler with ``transform`` of such a classifier.
    method
        1: a list of 130 windows, each classified by itself; 2: HOG sub-sampling at several scales.
    scales
        Sides of the windows divided by 64 pixels, for method 2, each alone or with its own rows and columns:
        ``(1.5, (400, 656), (0, 1280))``.
    y_start_stop
        Rows for the other scales. All positions are those of a 1280x720 frame, and scale with it.
    threshold, n_frames
        A pixel is hot if more than this number of windows hit it, as the mean over so many frames. By default
        1 for method 1 and 2 for method 2. It fits one density of windows: four times as many windows, as with
        half the step, need four times the threshold.
    smoother
        A `BoxSmoother`, or another function of the boxes of a frame that returns those to show.
    **options
        For method 2, ``cells_per_step``. For a classifier of your own, the features that it was trained on,
        as in `find_cars` and `search_windows`, by default ``orient=9, pix_per_cell=8, cell_per_block=2,
        spatial_size=(32, 32), hist_bins=32``, and ``divide_by``.

    Attributes
    ----------
    windows, heatmap, labels
        Of the last frame: hot windows, mean heat above the threshold ``(H, W)``, and what
        ``scipy.ndimage.label`` returns for it.

    Examples
    --------
    >>> detector = HeatmapDetector(threshold=2)
    >>> frame = np.full((720, 1280, 3), 90, np.uint8)
    >>> np.array_equal(detector(frame), frame), float(detector.heatmap.max()), detector.labels[1]
    (True, 0.0, 0)
    """

    def __init__(
        self,
        clf: Any = "highway",
        scaler: Any = None,
        *,
        method: Literal[1, 2] = 2,
        scales: Sequence[Any] = (0.8, 1.0, 1.5),
        y_start_stop: Sequence[int] = (400, 656),
        threshold: float | None = None,
        n_frames: int = 5,
        smoother: BoxSmoother | Callable[[list[Corners]], Any] | None = None,
        **options: Any,
    ) -> None:
        bands = read_bands(scales, y_start_stop)
        self.find_windows: FindWindows = window_search(clf, scaler, method, bands, options)
        self.threshold = check.number(float(method) if threshold is None else threshold, "threshold", low=0)
        self.history: deque[NDArray[Any]] = deque(maxlen=check.integer(n_frames, "n_frames", low=1))
        if smoother is not None and not callable(smoother):
            raise InvalidInputError(f"smoother must be a BoxSmoother or a function; got {describe(smoother)}")
        self.smoother = smoother
        self.windows: Any = []
        self.heatmap: Any = None
        self.labels: Any = None

    def __call__(self, frame: NDArray[np.uint8], test: bool = False) -> NDArray[np.uint8]:
        """Draw the vehicles on a copy of the next frame; with `test`, of a single one, and show its steps."""
        if not test:
            return draw_boxes(frame, self.find_cars(frame))
        alone = self.without_history()
        drawn = alone(frame)
        steps = draw_boxes(frame, alone.windows), alone.heatmap, alone.labels[0], drawn
        show_images(steps, ["windows", "heat", "labels", "boxes"])
        return drawn

    def find_cars(self, frame: NDArray[np.uint8]) -> list[Corners]:
        """Find the vehicles of the next frame: pairs of corners."""
        check.image(frame, "frame")
        self.windows = self.find_windows(frame)
        heat = add_heat(np.zeros(frame.shape[:2], np.float32), self.windows)
        if self.history and self.history[-1].shape != heat.shape:
            self.history.clear()
        self.history.append(heat)
        self.heatmap = apply_threshold(np.mean(self.history, axis=0), self.threshold)
        self.labels = label(self.heatmap)
        boxes = labeled_bboxes(self.labels)
        return boxes if self.smoother is None else self.smoother(boxes)

    def detect(self, image: NDArray[np.uint8]) -> Detections:
        """Find the vehicles of a single image: half-open boxes, and the highest heat of each as its score."""
        alone = self.without_history()
        alone.find_cars(image)
        return label_boxes(alone.heatmap)

    def without_history(self) -> HeatmapDetector:
        """Return a detector with the same settings for a single image."""
        alone = copy.copy(self)
        alone.history, alone.smoother = deque(maxlen=1), None
        return alone


def process_image(
    image: NDArray[np.uint8], *, method: Literal[1, 2] = 2, **options: Any
) -> NDArray[np.uint8]:
    """Draw the vehicles of a single image; the options are those of `HeatmapDetector`."""
    return HeatmapDetector(method=method, **options)(image)
