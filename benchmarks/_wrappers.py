"""The lesson functions of `vehicle_detection.course` compared with the main API on the same input."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

import vehicle_detection as vd
from benchmarks._material import Context, patches, searched_frame
from benchmarks._report import Row, at_most
from benchmarks._timing import median_of, seconds_of
from vehicle_detection import course
from vehicle_detection.training import TrainingOptions, to_pipeline

ROUNDS = 15
_TOP, _BOTTOM, _SCALES = 400, 656, (1.5, 1.0, 0.8)


def run(context: Context) -> list[Row]:
    """Alternately call each lesson function and its counterpart."""
    frame, source = searched_frame()
    found, kind = patches()
    some = np.ascontiguousarray(found.patches[:: max(1, len(found) // 800)])
    labels = found.labels[:: max(1, len(found) // 800)].astype(int)
    params = vd.FeatureParams(spatial_size=32, spatial_order="interleaved")
    features = np.array(course.extract_features(some, "YCrCb", hog_channel="ALL"))
    model = vd.train_classifier(some, labels, params=params, options=TrainingOptions(mirror=False))
    _, scaler, svc = (step for _, step in to_pipeline(model).steps)
    search = model.open_search(1)
    bands = vd.SearchParams.preset("three-scales")
    windows = vd.slide_window(frame, y_start_stop=(_TOP, _BOTTOM), xy_window=(96, 96))
    pairs = course.slide_window(frame, (None, None), (_TOP, _BOTTOM), (96, 96), formula="new")
    heat = np.zeros(frame.shape[:2], np.float32)
    sizes = (9, 8, 2, (32, 32), 32)
    options = {"divide_by": 1, "resize": "before conversion", "cells_per_step": 1}

    def find_cars() -> None:
        for scale in _SCALES:
            course.find_car_windows(frame, _TOP, _BOTTOM, scale, svc, scaler, *sizes, **options)

    compared: dict[str, tuple[Callable[[], object], Callable[[], object]]] = {
        "extract_features": (
            lambda: course.extract_features(some, "YCrCb", hog_channel="ALL"),
            lambda: vd.extract_features(some, params),
        ),
        "search_windows": (
            lambda: course.search_windows(frame, pairs, svc, scaler, "YCrCb", hog_channel="ALL"),
            lambda: vd.search_windows(frame, windows, model, jobs=1),
        ),
        "find_cars": (find_cars, lambda: search.find_windows(frame, bands)),
        "add_heat": (lambda: course.add_heat(heat, pairs), lambda: vd.add_heat(heat, windows)),
        "draw_boxes": (lambda: course.draw_boxes(frame, pairs), lambda: vd.draw_boxes(frame, windows)),
    }
    assert features.shape == (len(some), params.length)
    rows = []
    for name, (wrapper, main) in compared.items():
        for function in (wrapper, main):  # compile kernels, allocate memory
            function()
        # Short calls are measured several at a time.
        calls = range(1 + int(0.05 / seconds_of(main)))
        seconds = [
            tuple(seconds_of(lambda: [each() for _ in calls]) for each in (wrapper, main))  # noqa: B023
            for _ in range(ROUNDS)
        ]
        ours, theirs = (median_of(column) for column in zip(*seconds))
        rows.append(
            Row(
                f"course.{name}: time relative to the main API",
                ours / theirs,
                unit="x",
                target=at_most(1.1),
                material=f"{source}, {len(some)} patches ({kind})" if not rows else "",
            )
        )
    return rows
