"""Windows, overlaps and heat thresholds of the course's search, compared on labelled frames."""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

from vehicle_detection._common import check
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation import LabelledFrames, evaluate_detections
from vehicle_detection.features import PATCH_SIZE
from vehicle_detection.heatmap import HeatParams, bounding_boxes
from vehicle_detection.search import SearchBand, SearchParams
from vehicle_detection.svm import CLASSIFIER_REMEDY, VehicleClassifier
from vehicle_detection.tables import TrackTable

if TYPE_CHECKING:
    import pandas as pd


def compare_searches(
    classifier: VehicleClassifier,
    frames: LabelledFrames,
    *,
    scales: Sequence[Sequence[float]] = ((1.0,), (1.0, 1.5), (0.8, 1.0, 1.5)),
    overlaps: Sequence[float] = (0.5, 0.75, 0.875),
    thresholds: Sequence[float] = (0, 1, 2, 4, 8, 16, 32),
    horizon: float = 400 / 720,
) -> pd.DataFrame:
    """Search labelled frames with all combinations of windows, overlap and heat threshold.

    Returns a table with a row for each combination, best F1 first: ``scales``, ``overlap``, ``threshold``,
    ``f1``, ``recall``, ``precision``, ``mean_iou``, and ``search_ms``, the time of the search per frame.

    Parameters
    ----------
    classifier, frames
        The trained model, and frames with their boxes, whose own horizon is used if it is known.
    scales, overlaps, thresholds
        Sets of sides of windows divided by 64 pixels, in a frame whose longer side is 1280; overlaps of
        neighbors as a fraction; and the number of windows that a pixel must exceed.
    horizon
        As in `SearchParams`; the windows lie in the 256 rows below it.

    Examples
    --------
    >>> from vehicle_detection import load_classifier, render_scene
    >>> from vehicle_detection.scenes import truth_table
    >>> scene = render_scene(shape=(540, 960), random_state=1)
    >>> frames = LabelledFrames("scene", [scene.image], truth_table({0: scene.truth}))
    >>> table = compare_searches(load_classifier(), frames, overlaps=[0.75], thresholds=[1, 4])
    >>> len(table), list(table.columns[:4])
    (6, ['scales', 'overlap', 'threshold', 'f1'])
    """
    import pandas as pd

    check.instance(classifier, "classifier", VehicleClassifier, CLASSIFIER_REMEDY)
    check.instance(frames, "frames", LabelledFrames, "pass LabelledFrames(name, images, labels)")
    sets = [
        _check_numbers(each, "scales", 0.25, 20)
        for each in check.sequence(scales, "scales", "sets of numbers")
    ]
    steps = _check_numbers(overlaps, "overlaps", 0, 0.99)
    limits = _check_numbers(thresholds, "thresholds", 0, 1e9)
    rows = []
    for sides, overlap in itertools.product(sets, steps):
        bands = [
            SearchBand(window=(PATCH_SIZE * side,) * 2, y=(0.0, 256.0), overlap=(overlap, overlap))
            for side in sides
        ]
        params = SearchParams(bands=tuple(bands), horizon=horizon).with_horizon(frames.horizon)
        windows, seconds = [], 0.0
        with classifier.open_search() as search:
            search.find_windows(frames[frames.keys[0]], params)  # compiles kernels and allocates buffers
            for key, image in frames:
                start = time.perf_counter()
                found_windows = search.find_windows(image, params)
                seconds += time.perf_counter() - start
                windows.append((key, image.shape, found_windows))
        for limit in limits:
            heat = HeatParams(weighting="count", threshold=limit, peak_fraction=0)
            found = {key: bounding_boxes(shape, each, params=heat) for key, shape, each in windows}
            scores = evaluate_detections(TrackTable.from_detections(found), frames.labels, frames=frames.keys)
            row = {"scales": tuple(sides), "overlap": overlap, "threshold": limit}
            row |= {name: getattr(scores, name) for name in ("f1", "recall", "precision", "mean_iou")}
            rows.append(row | {"search_ms": 1000 * seconds / len(windows)})
    if not rows:
        raise InvalidInputError("scales, overlaps and thresholds must hold a value each; got an empty list")
    return pd.DataFrame(rows).sort_values("f1", ascending=False, kind="stable", ignore_index=True)


def _check_numbers(values: Sequence[float], name: str, low: float, high: float) -> list[float]:
    listed = check.sequence(values, name, "numbers")
    return [check.number(each, name, low=low, high=high) for each in listed]
