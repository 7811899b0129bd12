"""The course's detector: hits of the window search, their heat over several frames, threshold, labels."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehicle_detection._common import check_integer, check_number, check_sequence, check_type, describe
from vehicle_detection.camera import Camera
from vehicle_detection.course.features import or_default
from vehicle_detection.course.search import find_car_windows
from vehicle_detection.course.windows import draw_boxes
from vehicle_detection.detector import VehicleDetector
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.features import PATCH_SIZE
from vehicle_detection.function_model import FunctionModel
from vehicle_detection.heatmap import HeatParams, heat_threshold
from vehicle_detection.search import REFERENCE_WIDTH, SearchBand, SearchParams
from vehicle_detection.svm import VehicleClassifier
from vehicle_detection.tracking import FrameResult

_HORIZON = 400 / 720


class HeatmapDetector(VehicleDetector):
    """Detect vehicles as in the course: search windows, add up the heat of the hits, threshold, label.

    A `VehicleDetector` with the course's parameters: calling it with a frame draws the boxes, and
    `process_video`, `annotate_clip`, `detect` and the evaluation work as usual.

    Parameters
    ----------
    clf
        ``"highway"``, the path of a model file, a `VehicleClassifier`, or any fitted classifier with
        ``predict``, which needs `scaler` unless it is a pipeline.
    scaler
        The fitted scaler with ``transform`` of such a classifier.
    ystart, ystop, scales
        Rows to search in a 1280x720 frame, and sides of the windows divided by 64 pixels; they scale with it.
    cells_per_step
        Step between windows in cells of 8 pixels.
    threshold, n_frames
        A pixel is hot if more than this number of windows hit it, as the mean over so many frames. None:
        chosen for the density of the windows.
    **options
        For a classifier with `scaler`, the features that it was trained on: arguments of `find_car_windows`
        such as ``orient`` (default 9), ``pix_per_cell`` (8), ``cell_per_block`` (2), ``spatial_size``
        ((32, 32)), ``hist_bins`` (32), ``color_space``, ``transform_sqrt`` and ``divide_by``.

    A warning says if the threshold cannot fit the density of the windows.

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
        ystart: int = 400,
        ystop: int = 656,
        scales: Sequence[float] = (0.8, 1.0, 1.5),
        cells_per_step: int = 2,
        threshold: float | None = None,
        n_frames: int = 5,
        **options: Any,
    ) -> None:
        scales = check_sequence(scales, "scales", "numbers")
        search = _search_params(ystart, ystop, scales, cells_per_step)
        heat = HeatParams(weighting="count", frames=n_frames, threshold=threshold, peak_fraction=0)
        if isinstance(clf, (str, os.PathLike, VehicleClassifier)):
            if scaler is not None or options:
                raise InvalidInputError(
                    "scaler and options of the features must be omitted with a model of the library, which "
                    f"contains them; got {describe(scaler)} and {sorted(options)}"
                )
            super().__init__(clf, search_params=search, region_params=heat)
        else:
            scaled = hasattr(scaler, "transform") or (scaler is None and hasattr(clf, "steps"))
            if not hasattr(clf, "predict") or not scaled:
                raise InvalidInputError(
                    "clf must be a model of the library, or a fitted classifier with a scaler; got "
                    f"{describe(clf)} and {describe(scaler)}; pass the scaler, or a pipeline of both"
                )
            defaults = {"orient": 9, "pix_per_cell": 8, "cell_per_block": 2, "spatial_size": (32, 32)}
            options = {**defaults, "hist_bins": 32, "cells_per_step": cells_per_step, **options}
            # Later changes of the default must not change a detector.
            options["transform_sqrt"] = or_default(options.get("transform_sqrt"), "transform_sqrt")
            hits = _WindowSearch((ystart, ystop), scales, {"svc": clf, "X_scaler": scaler, **options})
            # An image of one window checks the options, the estimators and the range before the first frame.
            white = np.full((PATCH_SIZE, PATCH_SIZE, 3), 255, np.uint8)
            find_car_windows(white, None, None, 1, **hits.arguments)
            model = FunctionModel(function=hits, score="logit", thread_safe=True, name="find_car_windows")
            camera = Camera.dashcam(horizon=_HORIZON)
            super().__init__(model, region_params=heat.for_search(search), camera=camera)
        self._warned = True  # the course shows no speeds

    @property
    def heatmap(self) -> NDArray[np.float32] | None:
        """Mean number of hits per pixel over the last frames, ``(H, W)``; None before the first frame."""
        return None if self.heat is None else self.heat.copy()

    @property
    def labels(self) -> tuple[NDArray[np.int32], int]:
        """Label array ``(H, W)`` of the regions above the threshold, and their number."""
        from scipy.ndimage import label

        if self.heat is None or self.detector.heat_params is None:
            raise InvalidInputError("labels need a frame; call the detector with one first")
        array, count = label(self.heat > heat_threshold(self.detector.heat_params), structure=np.ones((3, 3)))
        return array, count

    def annotate(self, frame: NDArray[np.uint8], result: FrameResult) -> NDArray[np.uint8]:
        """Draw the boxes of the hot regions on a copy of the frame, in the course's style."""
        if self.annotator.diagnostics:
            return super().annotate(frame, result)
        check_type(result, "result", FrameResult, "pass what process or track returns")
        return draw_boxes(frame, result.detections)


def _search_params(ystart: int, ystop: int, scales: Sequence[float], cells_per_step: int) -> SearchParams:
    """Bands with the windows of the lesson's ``find_cars`` at each scale."""
    top = check_integer(ystart, "ystart", low=0)
    bottom = check_integer(ystop, "ystop", low=top + 1)
    overlap = 1 - check_integer(cells_per_step, "cells_per_step", low=1, high=8) / 8
    if not len(scales):
        raise InvalidInputError("scales must hold a number at least, such as (1.0, 1.5); got none")
    sides = [PATCH_SIZE * check_number(scale, "scales", low=0.25, high=20) for scale in scales]
    y = (top - 400.0, bottom - 400.0)
    bands = tuple(SearchBand(window=(side, side), y=y, overlap=(overlap, overlap)) for side in sides)
    return SearchParams(bands=bands, horizon=_HORIZON)


@dataclass(frozen=True, eq=False)
class _WindowSearch:
    """The hits of ``find_cars`` at several scales: boxes, and scores of 1."""

    rows: tuple[int, int]
    scales: tuple[float, ...]
    arguments: dict[str, Any]

    def __call__(self, image: NDArray[np.uint8]) -> tuple[NDArray[Any], NDArray[np.float64]]:
        factor = max(image.shape) / REFERENCE_WIDTH
        ystart, ystop = (round(row * factor) for row in self.rows)
        hits = [
            box
            for scale in self.scales
            for box in find_car_windows(image, ystart, ystop, scale * factor, **self.arguments)
        ]
        return np.array(hits, np.float64).reshape(-1, 4), np.ones(len(hits))
