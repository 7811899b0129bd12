from collections import deque

import cv2
import matplotlib.pyplot as plt
import numpy as np
import pytest
from sklearn.naive_bayes import GaussianNB
from sklearn.preprocessing import StandardScaler
from sklearn.svm import LinearSVC

import vehicle_detection.course as lesson
from tests.helpers import rendered_patches
from vehicle_detection import TrackTable, detector_from, load_classifier, load_frames, read_labels
from vehicle_detection.course import (
    Box,
    BoxSmoother,
    HeatmapDetector,
    adjust_bbox,
    extract_features,
    find_car_windows,
    process_image,
    reference,
)
from vehicle_detection.course.versions import lesson_defaults
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation import LabelledFrames, evaluate_detections
from vehicle_detection.scenes import render_scene

FEATURES = {"spatial_size": (16, 16), "hist_bins": 16, "divide_by": 1}


@pytest.fixture(scope="module")
def patches():
    return rendered_patches(80)


@pytest.fixture(scope="module")
def features(patches):
    X = extract_features(patches[0], "YCrCb", (16, 16), hist_bins=16, hog_channel="ALL")
    scaler = StandardScaler().fit(X)
    return scaler.transform(X), scaler


@pytest.fixture(scope="module")
def estimators(features, patches):
    return LinearSVC(random_state=0).fit(features[0], patches[1]), features[1]


@pytest.fixture(scope="module")
def scene():
    return cv2.resize(render_scene(shape=(540, 960), random_state=3).image, (1280, 720))


def frame_of(patches, shift=0):
    frame = np.full((360, 640, 3), 90, np.uint8)
    frame[210:274, 300 + shift : 364 + shift] = patches[0][0]
    return frame


@pytest.mark.parametrize("kind", [LinearSVC(random_state=0), GaussianNB()], ids=["svm", "bayes"])
def test_it_takes_the_steps_of_the_reference(kind, features, patches):
    estimators = kind.fit(features[0], patches[1]), features[1]
    detector = HeatmapDetector(*estimators, threshold=1, n_frames=2, **FEATURES)
    history = deque(maxlen=2)
    for shift in range(0, 6, 2):
        frame = frame_of(patches, shift)
        hits = [
            box
            for scale in (0.8, 1.0, 1.5)
            for box in find_car_windows(
                frame, 200, 328, scale / 2, *estimators, 9, 8, 2, (16, 16), 16, divide_by=1
            )
        ]
        np.testing.assert_array_equal(detector(frame), reference.process_frame(frame, hits, history, 1))
        assert detector.windows == hits != []
        assert reference.labeled_bboxes(detector.labels)


def test_scales_have_rows_and_columns_of_their_own(estimators, patches):
    bands = [(0.5, (400, 656)), (0.75, (420, 560), (560, 760))]
    hits = HeatmapDetector(*estimators, scales=bands, **FEATURES)
    plain = HeatmapDetector(*estimators, scales=[0.5], **FEATURES)
    frame = frame_of(patches)
    for detector in (hits, plain):
        detector(frame)
    assert hits.windows[: len(plain.windows)] == plain.windows
    for (x1, y1), (x2, y2) in hits.windows[len(plain.windows) :]:
        assert 280 <= x1 < x2 <= 380
        assert 210 <= y1 < y2 <= 280
    highway = HeatmapDetector(scales=[(1.0, (400, 500), (640, 1280))])
    assert all(x1 >= 639 for x1, *_ in highway.find_windows(np.zeros((720, 1280, 3), np.uint8)))


def test_both_methods_find_the_vehicles_of_a_scene(scene, estimators):
    for method in (1, 2):
        detector = HeatmapDetector(method=method)
        drawn = process_image(scene, method=method)
        np.testing.assert_array_equal(drawn, detector(scene))
        assert detector.labels[1] > 0
    own = HeatmapDetector(*estimators, method=1, **FEATURES)
    own(scene)
    windows = [((x1, y1), (x2, y2)) for x1, y1, x2, y2 in own.windows]
    everything = HeatmapDetector(*estimators, method=1, threshold=0, **FEATURES)
    everything(np.zeros((720, 1280, 3), np.uint8))
    options = {"color_space": "YCrCb", "hog_channel": "ALL", "spatial_size": (16, 16), "hist_bins": 16}
    assert windows == lesson.search_windows(scene, windows, *estimators, **options)


def test_any_function_finds_the_windows(scene):
    detector = HeatmapDetector(lambda image: [((10, 20), (50, 60)), ((20, 20), (60, 60))], threshold=1)
    assert detector.find_cars(scene) == [((20, 20), (49, 59))]
    assert detector.detect(scene).boxes.tolist() == [[20, 20, 50, 60]]
    assert detector.detect(scene).scores.tolist() == [2]
    with detector_from(detector.detect, score=(1, 4)) as tracked:
        assert tracked.detect(scene).boxes.tolist() == [[20, 20, 50, 60]]


def test_a_frame_of_another_size_starts_anew(scene):
    detector = HeatmapDetector(lambda image: [((10, 20), (50, 60))], threshold=0)
    for frame in (scene, scene, scene[:360, :640]):
        detector(frame)
    assert len(detector.history) == 1
    assert detector.heatmap.shape == (360, 640)


def test_it_keeps_the_defaults_of_its_construction(estimators):
    frame = render_scene(shape=(360, 640), random_state=3).image
    before = dict(lesson_defaults)
    try:
        lesson.set_lesson_defaults(transform_sqrt=True)
        detector = HeatmapDetector(*estimators, threshold=1, **FEATURES)
    finally:
        lesson_defaults.update(before)
    told, plain = (
        HeatmapDetector(*estimators, threshold=1, **FEATURES, transform_sqrt=value) for value in (True, False)
    )
    found, expected, other = (each.find_windows(frame) for each in (detector, told, plain))
    assert found == expected
    assert found != other


def test_a_single_image_is_shown_with_its_steps(scene):
    plt.close("all")
    detector = HeatmapDetector()
    drawn = detector(scene, test=True)
    assert [panel.get_title() for panel in plt.gcf().axes] == ["windows", "heat", "labels", "boxes"]
    assert [np.shape(panel.images[0].get_array()) for panel in plt.gcf().axes[1:3]] == [(720, 1280)] * 2
    plt.close("all")
    assert not detector.history
    np.testing.assert_array_equal(drawn, detector(scene))
    assert (drawn != scene).any()


BOX, MOVED = ((0, 0), (40, 40)), ((10, 0), (50, 40))


@pytest.mark.parametrize(
    ("options", "frames", "expected"),
    [
        ({}, [[BOX], [MOVED], []], [[BOX], [MOVED], []]),
        ({"weight": 0.5}, [[BOX], [MOVED]], [[BOX], [((5, 0), (45, 40))]]),
        ({"hold": 2}, [[BOX], [], [], []], [[BOX], [BOX], [BOX], []]),
        ({"show_after": 2}, [[BOX], [MOVED], [MOVED]], [[], [MOVED], [MOVED]]),
        (
            {"hold": 9, "estimate": True},
            [[BOX], [MOVED], [], [((30, 0), (70, 40))], []],
            [[BOX], [MOVED], [((20, 0), (60, 40))], [((30, 0), (70, 40))], [((40, 0), (80, 40))]],
        ),
        ({"hold": 1}, [[BOX], [((90, 0), (130, 40))]], [[BOX], [((90, 0), (130, 40)), BOX]]),
    ],
)
def test_boxes_are_smoothed(options, frames, expected):
    smoother = BoxSmoother(**options)
    assert [smoother(boxes) for boxes in frames] == expected


def test_the_detector_smooths_its_boxes(scene):
    boxes = iter([[BOX], []])
    detector = HeatmapDetector(lambda _: next(boxes), threshold=0, n_frames=1, smoother=BoxSmoother(hold=1))
    assert [detector.find_cars(scene) for _ in range(2)] == [[((0, 0), (39, 39))]] * 2


def test_newer_boxes_weigh_more():
    box = Box(n=3)
    shown = [box.add(((x, 0), (x + 40, 40))) for x in (0, 30, 60, 60)]
    assert [x for (x, _), _ in shown] == [0, 20, 40, 55]
    assert adjust_bbox(MOVED, BOX, weight=0.3) == ((3, 0), (43, 40))


@pytest.mark.realdata
def test_it_finds_the_vehicles_of_the_courses_images(real_data):
    labels = read_labels(real_data / "labels" / "test_images.csv")
    images = LabelledFrames("test images", load_frames(real_data / "test_images"), labels)
    detector = HeatmapDetector()
    table = TrackTable.from_detections({key: detector.detect(image) for key, image in images})
    scores = evaluate_detections(table, images.labels, frames=images.keys)
    assert (scores.tp, scores.fn, scores.fp) == (9, 0, 0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"clf": "highway", "scaler": 5}, "scaler and options of the features must be omitted"),
        ({"orient": 9}, r"must be omitted with a model of the library, .*'orient'"),
        ({"clf": LinearSVC()}, "or a fitted classifier with a scaler, got .LinearSVC"),
        ({"clf": None}, "clf must be a model of the library"),
        ({"scales": (0,)}, "scales must be a number"),
        ({"y_start_stop": (400, 400)}, "scales and y_start_stop must hold"),
        ({"scales": [(1.0, 400, 656)]}, "scales and y_start_stop must hold"),
    ],
)
def test_invalid_arguments_are_rejected(arguments, message):
    with pytest.raises(InvalidInputError, match=message):
        HeatmapDetector(**arguments)


def test_options_are_checked_before_the_first_frame(estimators):
    with pytest.raises(InvalidInputError, match="fitted on 6108 features, but these options give 8460"):
        HeatmapDetector(*estimators, divide_by=1)
    options = {name: value for name, value in FEATURES.items() if name != "divide_by"}
    with pytest.warns(UserWarning, match="divide_by=1") as caught:
        HeatmapDetector(*estimators, **options)
    assert {warning.filename for warning in caught} == {__file__}
    with pytest.raises(TypeError, match="spatial"):
        HeatmapDetector(*estimators, **FEATURES, spatial=True)


def test_a_model_of_the_library_or_its_file(tmp_path, scene):
    model = load_classifier()
    model.save(tmp_path / "model.safetensors")
    found = [HeatmapDetector(clf)(scene) for clf in (model, tmp_path / "model.safetensors", "highway")]
    for drawn in found[1:]:
        np.testing.assert_array_equal(drawn, found[0])
