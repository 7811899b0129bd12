import cv2
import numpy as np
import pytest
from scipy.ndimage import label
from sklearn.naive_bayes import GaussianNB
from sklearn.preprocessing import StandardScaler
from sklearn.svm import LinearSVC

import vehicle_detection.course as lesson
from tests.helpers import rendered_patches
from tests.video.clips import write_clip
from vehicle_detection.course import HeatmapDetector, extract_features, find_car_windows
from vehicle_detection.datasets import load_frames
from vehicle_detection.errors import InvalidInputError
from vehicle_detection.evaluation import LabelledFrames, evaluate_detections
from vehicle_detection.formats import read_labels
from vehicle_detection.scenes import render_scene
from vehicle_detection.tables import TrackTable
from vehicle_detection.video import process_video

FEATURES = {"spatial_size": (16, 16), "hist_bins": 16, "divide_by": 1}


@pytest.fixture(scope="module")
def patches():
    return rendered_patches(80)


@pytest.fixture(scope="module", params=[LinearSVC(random_state=0), GaussianNB()], ids=["svm", "bayes"])
def estimators(request, patches):
    images, labels = patches
    X = extract_features(images, "YCrCb", (16, 16), hist_bins=16, hog_channel="ALL")
    scaler = StandardScaler().fit(X)
    return request.param.fit(scaler.transform(X), labels), scaler


def frame_of(patches, shift=0):
    frame = np.full((360, 640, 3), 90, np.uint8)
    frame[210:274, 300 + shift : 364 + shift] = patches[0][0]
    return frame


def lesson_boxes(heats, threshold):
    """Boxes of the lesson: labels of the mean heat above the threshold."""
    heat = lesson.apply_threshold(np.mean(heats, axis=0), threshold)
    array, count = label(heat, structure=np.ones((3, 3)))
    return [
        [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
        for rows, columns in (np.nonzero(array == number) for number in range(1, count + 1))
    ]


def test_it_takes_the_steps_of_the_lesson(estimators, patches):
    svc, scaler = estimators
    detector = HeatmapDetector(svc, scaler, threshold=1, n_frames=3, **FEATURES)
    heats = []
    for shift in range(0, 12, 2):
        frame = frame_of(patches, shift)
        hits = [
            box
            for scale in (0.8, 1.0, 1.5)
            for box in find_car_windows(
                frame, 200, 328, scale / 2, svc, scaler, 9, 8, 2, (16, 16), 16, divide_by=1
            )
        ]
        heats = [*heats[-2:], lesson.add_heat(np.zeros(frame.shape[:2]), hits)]
        result = detector.process(frame)
        np.testing.assert_array_equal(result.windows.boxes, np.array(hits, float).reshape(-1, 4))
        np.testing.assert_allclose(detector.heatmap, np.mean(heats, axis=0), rtol=1e-6)
        expected = lesson_boxes(heats, 1)
        assert sorted(result.detections.boxes.tolist()) == sorted(map(list, expected))
        assert detector.labels[1] == len(expected)
    assert hits


def test_it_keeps_the_defaults_of_its_construction(estimators):
    frame = render_scene(shape=(360, 640), random_state=3).image
    try:
        lesson.set_lesson_defaults(transform_sqrt=True)
        detector = HeatmapDetector(*estimators, threshold=1, **FEATURES)
    finally:
        lesson.set_lesson_defaults(transform_sqrt=False)
    told, plain = (
        HeatmapDetector(*estimators, threshold=1, **FEATURES, transform_sqrt=value) for value in (True, False)
    )
    found, expected, other = (each.process(frame).windows.boxes for each in (detector, told, plain))
    np.testing.assert_array_equal(found, expected)
    assert found.tolist() != other.tolist() or isinstance(estimators[0], GaussianNB)


def test_calling_it_draws_in_the_style_of_the_course(tmp_path):
    scene = render_scene(shape=(540, 960), random_state=3)
    frame = cv2.resize(scene.image, (1280, 720))
    detector = HeatmapDetector()
    assert detector.heatmap is None
    with pytest.raises(InvalidInputError, match="labels need a frame"):
        _ = detector.labels
    drawn = detector(frame)
    boxes = detector.detect(frame).boxes
    assert len(boxes)
    np.testing.assert_array_equal(drawn, lesson.draw_boxes(frame, boxes))
    labels = detector.labels
    assert labels[0].shape == frame.shape[:2]
    assert labels[1] == len(boxes)
    assert detector.heatmap.shape == (720, 1280)
    detector.reset()
    assert detector.heatmap is None
    clip = write_clip(tmp_path / "clip.mp4", [scene.image] * 6, fps="25")
    assert process_video(clip, tmp_path / "out.mp4", detector).frames == 6


def test_the_threshold_fits_the_density():
    sparse, dense = HeatmapDetector(), HeatmapDetector(cells_per_step=1)
    assert dense.detector.region_params.threshold == pytest.approx(
        4 * sparse.detector.region_params.threshold
    )
    assert sparse.detector.region_params.threshold == pytest.approx(2, abs=0.2)
    with pytest.warns(UserWarning, match="the heat threshold 40 does not fit the density"):
        HeatmapDetector(threshold=40)


@pytest.mark.realdata
def test_it_finds_all_vehicles_of_the_courses_images(real_data):
    labels = read_labels(real_data / "labels" / "test_images.csv")
    images = LabelledFrames("test images", load_frames(real_data / "test_images"), labels)
    with HeatmapDetector() as detector:
        found = TrackTable.from_detections({key: detector.detect(image) for key, image in images})
    scores = evaluate_detections(found, images.labels, frames=images.keys)
    assert (scores.tp, scores.fn, scores.fp) == (9, 0, 0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"clf": "highway", "scaler": 5}, "scaler and options of the features must be omitted"),
        ({"orient": 9}, r"must be omitted with a model of the library, .*'orient'"),
        ({"clf": LinearSVC()}, "or a fitted classifier with a scaler; got LinearSVC"),
        ({"clf": None}, "clf must be a model of the library"),
        ({"ystart": -1}, "ystart must be an integer"),
        ({"ystop": 400}, "ystop must be an integer at least 401"),
        ({"scales": 1.5}, "scales must be a sequence of numbers"),
        ({"scales": (0,)}, "scales must be a number"),
        ({"cells_per_step": 0}, "cells_per_step must be an integer"),
        ({"n_frames": 0}, "frames must be an integer"),
        ({"clf": "default"}, "search_params must be a NetworkParams"),
    ],
)
def test_invalid_arguments_are_rejected(arguments, message):
    with pytest.raises(InvalidInputError, match=message):
        HeatmapDetector(**arguments)


def test_options_are_checked_before_the_first_frame(estimators):
    with pytest.raises(InvalidInputError, match="fitted on 6108 features, but these options give 8460"):
        HeatmapDetector(*estimators)
    # Frames may be searched in other threads, whose warnings name no line of the caller.
    options = {name: value for name, value in FEATURES.items() if name != "divide_by"}
    with pytest.warns(UserWarning, match="divide_by=1") as caught:
        HeatmapDetector(*estimators, **options)
    assert caught[0].filename == __file__
    with pytest.raises(TypeError, match="spatial"):
        HeatmapDetector(*estimators, **FEATURES, spatial=True)
