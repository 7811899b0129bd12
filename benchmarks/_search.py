"""The search of one frame against the course's method, and against scikit-image's HOG alone."""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks._course import CourseSearch, search_course
from benchmarks._material import Context, classifier_for_search, searched_frame
from benchmarks._report import Row, Target, at_least, at_most
from benchmarks._timing import median_of, seconds_of
from vehicle_detection import Detections, SearchParams, VehicleClassifier
from vehicle_detection.search import BandSearch

TOLERANCE = 1e-4
"""Difference of scores between float64, a window at a time, and the float32 filters."""

ROUNDS = 3
CALLS = 17
"""Calls of each of our searches in a round: some 50 in all."""


def run(context: Context) -> list[Row]:
    """Search one frame by both methods in turn, and compare time and windows."""
    frame, source = searched_frame()
    classifier, model = classifier_for_search()
    return compare_searches(frame, classifier, SearchParams.preset("three-scales"), f"{source}, {model}")


def compare_searches(
    frame: NDArray[np.uint8],
    classifier: VehicleClassifier,
    search: SearchParams,
    material: str,
    *,
    rounds: int = ROUNDS,
    calls: int = CALLS,
) -> list[Row]:
    """Time both methods alternately in this process, and check that they agree."""
    scaler, svc = (step for _, step in classifier.to_pipeline().steps[-2:])
    bands = search.place(frame.shape)
    course_seconds, hog_seconds = [], []
    ours: dict[int, list[float]] = {1: [], 2: []}
    with BandSearch(classifier, n_jobs=1) as one, BandSearch(classifier, n_jobs=2) as two:
        searches = {1: one, 2: two}
        for ready in searches.values():
            for _ in range(3):  # Kernels, threads and buffers are there from then on.
                ready.find_windows(frame, search)
        for _ in range(rounds):
            course: CourseSearch | None = None

            def course_method() -> None:
                nonlocal course
                course = search_course(frame, bands, scaler, svc)

            course_seconds.append(seconds_of(course_method))
            assert course is not None
            hog_seconds.append(course.hog_seconds)
            for _ in range(calls):
                for jobs, ready in searches.items():
                    ours[jobs].append(seconds_of(functools.partial(ready.find, frame, search)))
        assert course is not None
        agreement = check_agreement(frame, one, search, course)
        assert_same(one.find_windows(frame, search), two.find_windows(frame, search))

    medians = {jobs: median_of(seconds) for jobs, seconds in ours.items()}
    course_median, hog_median = median_of(course_seconds), median_of(hog_seconds)
    rows = [
        Row(what="windows searched", value=agreement.windows, material=material),
        Row(what="search, one core", value=medians[1] * 1e3, unit="ms", target=Target("about", 12)),
        Row(what="search, two cores", value=medians[2] * 1e3, unit="ms", target=Target("about", 7)),
        Row(what="course method (scikit-image, scaler and SVM a window)", value=course_median, unit="s"),
        Row(what="scikit-image's HOG alone", value=hog_median * 1e3, unit="ms"),
    ]
    for name, seconds, least in (("course method", course_median, 400), ("HOG alone", hog_median, 90)):
        rows += [
            Row(what=f"faster than {name}, one core", value=seconds / medians[1], unit="x"),
            Row(
                what=f"faster than {name}, two cores",
                value=seconds / medians[2],
                unit="x",
                target=at_least(least),
            ),
        ]
    rows += [
        Row(what="largest difference of a score", value=agreement.difference, target=at_most(TOLERANCE)),
        Row(what="windows that both methods call vehicles", value=agreement.shared),
        Row(
            what=f"windows that one method calls a vehicle, score beyond {TOLERANCE:g}",
            value=agreement.disputed,
            target=Target("=", 0),
        ),
    ]
    return rows


@dataclass(frozen=True)
class Agreement:
    """How far two searches of the same windows agree."""

    windows: int
    difference: float
    shared: int
    disputed: int


def check_agreement(
    frame: NDArray[np.uint8], ours: BandSearch, search: SearchParams, course: CourseSearch
) -> Agreement:
    """Compare the scores of all windows, and the windows that each side calls a vehicle.

    Our hits are looked up by their boxes among all windows; one that is none of them counts as disputed.
    """
    windows = ours.find_windows(frame, dataclasses.replace(search, min_score=-1e6))
    if windows.boxes.shape != course.boxes.shape or not np.allclose(windows.boxes, course.boxes, atol=1e-6):
        raise AssertionError(f"the {len(windows)} windows are not the course's {len(course.boxes)}")
    difference = float(np.abs(windows.scores - course.scores).max())
    hits = {tuple(box) for box in ours.find_windows(frame, search).boxes.tolist()}
    found = np.array([tuple(box) in hits for box in windows.boxes.tolist()])
    expected = course.scores > search.min_score
    clear = np.abs(course.scores - search.min_score) >= TOLERANCE
    strangers = len(hits) - int(found.sum())
    disputed = int(((found != expected) & clear).sum()) + strangers
    return Agreement(len(windows), difference, int((found & expected).sum()), disputed)


def assert_same(first: Detections, second: Detections) -> None:
    """Results do not depend on the number of threads."""
    same = np.array_equal(first.boxes, second.boxes) and np.array_equal(first.scores, second.scores)
    if not same:
        raise AssertionError("one thread and two threads find different windows")
