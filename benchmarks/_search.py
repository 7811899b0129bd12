"""The search of one frame compared with the course's method and with scikit-image's HOG alone."""

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
from vehicle_detection.training import to_pipeline

TOLERANCE = 1e-4
"""Tolerance of scores between the float64 reference and the float32 filters."""

ROUNDS = 3
CALLS = 17
"""Calls of each search per round, about 50 in total."""


def run(context: Context) -> list[Row]:
    """Search one frame by both methods and compare their time and windows."""
    frame, source = searched_frame()
    classifier, model = classifier_for_search()
    return compare_searches(frame, classifier, SearchParams.preset("three-scales"), f"{source}, {model}")


def compare_searches(
    frame: NDArray[np.uint8],
    classifier: VehicleClassifier,
    params: SearchParams,
    material: str,
    *,
    rounds: int = ROUNDS,
    calls: int = CALLS,
) -> list[Row]:
    """Time both methods alternately in one process and check that they agree."""
    scaler, svc = (step for _, step in to_pipeline(classifier).steps[-2:])
    bands = params.place(frame.shape)
    course_seconds, hog_seconds = [], []
    ours: dict[int, list[float]] = {1: [], 2: []}
    with classifier.open_search(1) as one, classifier.open_search(2) as two:
        searches = {1: one, 2: two}
        for search in searches.values():
            for _ in range(3):  # Compile kernels, start threads and allocate memory.
                search.find_windows(frame, params)
        for _ in range(rounds):
            course: CourseSearch | None = None

            def course_method() -> None:
                nonlocal course
                course = search_course(frame, bands, scaler, svc)

            course_seconds.append(seconds_of(course_method))
            assert course is not None
            hog_seconds.append(course.hog_seconds)
            for _ in range(calls):
                for jobs, search in searches.items():
                    ours[jobs].append(seconds_of(functools.partial(search.find_windows, frame, params)))
        assert course is not None
        agreement = check_agreement(frame, one, params, course)
        assert_same(one.find_windows(frame, params), two.find_windows(frame, params))

    medians = {jobs: median_of(seconds) for jobs, seconds in ours.items()}
    course_median, hog_median = median_of(course_seconds), median_of(hog_seconds)
    rows = [
        Row("windows searched", agreement.windows, material=material),
        Row("search, one core", medians[1] * 1e3, unit="ms", target=Target("about", 12)),
        Row("search, two cores", medians[2] * 1e3, unit="ms", target=Target("about", 7)),
        Row("course method (scikit-image, scaler and SVM per window)", course_median, unit="s"),
        Row("scikit-image's HOG alone", hog_median * 1e3, unit="ms"),
    ]
    for name, seconds, min_ratio in (("course method", course_median, 400), ("HOG alone", hog_median, 80)):
        rows += [
            Row(f"faster than {name}, one core", seconds / medians[1], unit="x"),
            Row(f"faster than {name}, two cores", seconds / medians[2], unit="x", target=at_least(min_ratio)),
        ]
    rows += [
        Row("maximum difference of a score", agreement.difference, target=at_most(TOLERANCE)),
        Row("windows above the threshold in both methods", agreement.shared),
        Row(
            f"windows above it in one method, by more than {TOLERANCE:g}",
            agreement.disputed,
            target=Target("=", 0),
        ),
    ]
    return rows


@dataclass(frozen=True)
class Agreement:
    """Comparison of two searches of the same windows: maximum difference, common and disputed hits."""

    windows: int
    difference: float
    shared: int
    disputed: int


def check_agreement(
    frame: NDArray[np.uint8], ours: BandSearch, params: SearchParams, course: CourseSearch
) -> Agreement:
    """Compare the scores of all windows and the hits of both methods.

    A hit whose box is not among the windows counts as disputed.
    """
    windows = ours.find_windows(frame, dataclasses.replace(params, min_score=-1e6))
    if windows.boxes.shape != course.boxes.shape or not np.allclose(windows.boxes, course.boxes, atol=1e-6):
        raise AssertionError(f"the {len(windows)} windows are not the course's {len(course.boxes)}")
    difference = float(np.abs(windows.scores - course.scores).max())
    hits = {tuple(box) for box in ours.find_windows(frame, params).boxes.tolist()}
    found = np.array([tuple(box) in hits for box in windows.boxes.tolist()])
    expected = course.scores > params.min_score
    clear = np.abs(course.scores - params.min_score) >= TOLERANCE
    unknown = len(hits) - int(found.sum())
    disputed = int(((found != expected) & clear).sum()) + unknown
    return Agreement(len(windows), difference, int((found & expected).sum()), disputed)


def assert_same(first: Detections, second: Detections) -> None:
    """Check that the result does not depend on the number of threads."""
    same = np.array_equal(first.boxes, second.boxes) and np.array_equal(first.scores, second.scores)
    if not same:
        raise AssertionError("one thread and two threads find different windows")
