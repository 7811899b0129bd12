"""Whole pipelines in the shape of published course systems, run with two modules of lesson functions.

Each system takes the module as its only link to the lesson: `vehicle_detection.course`, or the reference. Its
results must be equal: features within float32 precision, windows, hits, heat maps, boxes and images exactly.
"""

from collections import deque
from types import SimpleNamespace

import matplotlib.pyplot as plt
import numpy as np
import pytest
from scipy.ndimage import label
from sklearn.model_selection import train_test_split
from sklearn.naive_bayes import GaussianNB
from sklearn.preprocessing import StandardScaler
from sklearn.svm import LinearSVC
from sklearn.tree import DecisionTreeClassifier

import vehicle_detection.course
from tests import lesson_reference
from tests.helpers import rendered_patches
from vehicle_detection import render_scene, write_image

pytestmark = pytest.mark.filterwarnings("ignore:the image has values 0-1, which")

# The kernels compute HOG in float32, scikit-image in float64: values up to 1.
FEATURE_TOLERANCE = 5e-6


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """File names of patches as PNG and JPEG, vehicles first, and four uint8 frames."""
    folder = tmp_path_factory.mktemp("data")
    patches, labels = rendered_patches(80)
    names = {"png": ([], []), "jpg": ([], [])}
    for index, (patch, vehicle) in enumerate(zip(patches, labels)):
        for suffix, (cars, notcars) in names.items():
            path = folder / f"{index:03d}.{suffix}"
            write_image(path, patch)
            (cars if vehicle else notcars).append(str(path))
    frames = [
        render_scene(shape=(224, 400), focal_px=380, vehicles=4, random_state=seed).image for seed in range(4)
    ]
    return SimpleNamespace(png=names["png"], jpg=names["jpg"], frames=frames)


def system_1(lesson, data):
    """LUV, HOG of the lightness with ``transform_sqrt``; lists of windows; heat without assignment."""
    options = {
        "color_space": "LUV", "spatial_size": (16, 16), "hist_bins": 16, "orient": 8, "pix_per_cell": 8,
        "cell_per_block": 2, "hog_channel": 0, "spatial_feat": True, "hist_feat": True, "hog_feat": True,
        "transform_sqrt": True,
    }  # fmt: skip
    car_features = lesson.extract_features(data.jpg[0], **options)
    notcar_features = lesson.extract_features(data.jpg[1], **options)
    X = np.vstack((car_features, notcar_features)).astype(np.float64)
    X_scaler = StandardScaler().fit(X)
    y = np.hstack((np.ones(len(car_features)), np.zeros(len(notcar_features))))
    svc = LinearSVC(C=0.01, random_state=0, max_iter=10_000).fit(X_scaler.transform(X), y)
    image = data.frames[0]
    windows = lesson.slide_window(image, [60, None], [95, 190], (64, 64), (0.9, 0.8))
    windows += lesson.slide_window(image, [60, None], [100, 210], (80, 70), (0.8, 0.75))
    windows += lesson.slide_window(
        image, x_start_stop=[60, None], y_start_stop=[90, 215], xy_window=(110, 90)
    )
    hot_windows = lesson.search_windows(image, windows, svc, X_scaler, **options)
    heat = np.zeros_like(image[:, :, 0]).astype(np.float64)
    lesson.add_heat(heat, hot_windows)
    lesson.apply_threshold(heat, 1)
    drawn = lesson.draw_labeled_bboxes(np.copy(image), label(heat))
    return {"features": X, "windows": windows, "hits": hot_windows, "heat": heat, "drawn": drawn}


def system_2(lesson, data):
    """YCrCb of PNG patches; the HOG sub-sampling quiz at three scales; heat of the last frames of a video."""
    orient, pix_per_cell, cell_per_block, spatial_size, hist_bins = 9, 8, 2, (32, 32), 32
    features = [
        lesson.extract_features(
            files, color_space="YCrCb", spatial_size=spatial_size, hist_bins=hist_bins, orient=orient,
            pix_per_cell=pix_per_cell, cell_per_block=cell_per_block, hog_channel="ALL", spatial_feat=True,
            hist_feat=True, hog_feat=True,
        )
        for files in data.png
    ]  # fmt: skip
    X = np.vstack(features).astype(np.float64)
    y = np.hstack([np.ones(len(features[0])), np.zeros(len(features[1]))])
    X_scaler = StandardScaler().fit(X)
    X_train, _, y_train, _ = train_test_split(X_scaler.transform(X), y, test_size=0.2, random_state=3)
    svc = LinearSVC(random_state=0, max_iter=10_000)
    svc.fit(X_train, y_train)
    history, hits, heats = deque(maxlen=3), [], []

    def process_image(img):
        boxes = []
        for ystart, ystop, scale in [(90, 170, 0.75), (90, 190, 1), (96, 224, 1.5)]:
            boxes += lesson.find_car_windows(
                img, ystart, ystop, scale, svc, X_scaler, orient, pix_per_cell, cell_per_block, spatial_size,
                hist_bins,
            )  # fmt: skip
        history.append(boxes)
        hits.extend(boxes)
        heat = np.zeros(img.shape[:2])
        for recent in history:
            heat = lesson.add_heat(heat, recent)
        heat = lesson.apply_threshold(heat, len(history) // 2)
        heats.append(heat)
        return lesson.draw_labeled_bboxes(np.copy(img), label(np.clip(heat, 0, 255)))

    video = [process_image(frame) for frame in data.frames]
    sizes = orient, pix_per_cell, cell_per_block, spatial_size, hist_bins
    quiz = lesson.find_cars(data.frames[2], 90, 190, 1, svc, X_scaler, *sizes)
    return {"features": X, "hits": hits, "heat": np.array(heats), "drawn": [*video, quiz]}


def system_3(lesson, data):
    """HSV of PNG patches, bins by channel, histograms of 0-1; naive Bayes; every argument by position."""
    arguments = ("HSV", (16, 16), 32, 9, 8, 2, 2, True, True, True)
    extra = {"spatial_order": "channels", "hist_range": (0.0, 1.0)}
    cars = lesson.extract_features(data.png[0], *arguments, **extra)
    notcars = lesson.extract_features(data.png[1], *arguments, **extra)
    X = np.array(cars + notcars)
    scaler = StandardScaler()
    clf = GaussianNB().fit(scaler.fit_transform(X), [1] * len(cars) + [0] * len(notcars))
    image = data.frames[1].astype(np.float32) / 255
    windows = lesson.slide_window(image, [None, None], [90, None], (64, 64), (0.8, 0.8))
    hot = lesson.search_windows(
        image, windows, clf, scaler, "HSV", (16, 16), 32, (0.0, 1.0), 9, 8, 2, 2, True, True, True,
        spatial_order="channels",
    )  # fmt: skip
    heat = lesson.apply_threshold(lesson.add_heat(np.zeros(image.shape[:2], np.int64), hot), 2)
    drawn = lesson.draw_boxes(image, hot, (0, 0, 1), 2)
    return {"features": X, "windows": windows, "hits": hot, "heat": heat, "drawn": drawn}


def system_4(lesson, data):
    """The system's own features and sub-sampling, built from the lesson's parts; plots of HOG; a tree."""
    orient, pix_per_cell, cell_per_block = 8, 8, 2

    def color_parts(converted):
        spatial = lesson.bin_spatial(converted, size=(16, 16))
        histogram = lesson.color_hist(converted, nbins=16, bins_range=(0, 256))
        return [spatial, histogram]

    def features_of(image):
        converted = lesson.convert_color(image, conv="RGB2HLS")
        parts = color_parts(converted)
        for channel in range(3):
            sizes = orient, pix_per_cell, cell_per_block
            parts.append(
                lesson.get_hog_features(converted[:, :, channel], *sizes, vis=False, feature_vec=True)
            )
        return np.concatenate(parts)

    images = [lesson_reference.read_file(name) for names in data.jpg for name in names]
    X = np.array([features_of(image) for image in images])
    y = np.repeat((1, 0), [len(names) for names in data.jpg])
    scaler = StandardScaler().fit(X)
    clf = DecisionTreeClassifier(max_depth=4, random_state=0).fit(scaler.transform(X), y)

    gray = lesson.convert_color(images[0], "RGB2GRAY")
    _, hog_image = lesson.get_hog_features(gray, orient, pix_per_cell, cell_per_block, vis=True)
    figure, (left, right) = plt.subplots(1, 2)
    left.imshow(gray, cmap="gray")
    right.imshow(hog_image, cmap="gray")
    plt.close(figure)

    image = data.frames[3]
    band = lesson.convert_color(image[90:200], conv="RGB2HLS")
    hogs = [
        lesson.get_hog_features(band[:, :, channel], orient, pix_per_cell, cell_per_block, feature_vec=False)
        for channel in range(3)
    ]
    blocks = 64 // pix_per_cell - cell_per_block + 1
    on_windows, off = [], 0
    for y_cell in range(0, hogs[0].shape[0] - blocks + 1, 2):
        for x_cell in range(0, hogs[0].shape[1] - blocks + 1, 2):
            top, left = y_cell * pix_per_cell, x_cell * pix_per_cell
            parts = color_parts(band[top : top + 64, left : left + 64])
            parts += [hog[y_cell : y_cell + blocks, x_cell : x_cell + blocks].ravel() for hog in hogs]
            if clf.predict(scaler.transform(np.hstack(parts).reshape(1, -1))) == 1:
                on_windows.append(((left, 90 + top), (left + 64, 90 + top + 64)))
            else:
                off += 1
    assert off
    heat = np.zeros_like(image[:, :, 0])
    lesson.add_heat(heat, on_windows)
    lesson.apply_threshold(heat, 1)
    return {
        "features": X,
        "hits": on_windows,
        "heat": heat,
        "drawn": [hog_image, lesson.draw_boxes(image, on_windows)],
    }


@pytest.mark.parametrize("system", [system_1, system_2, system_3, system_4])
def test_a_published_system_runs_with_another_import(system, data):
    found, expected = (system(module, data) for module in (vehicle_detection.course, lesson_reference))
    assert found.keys() == expected.keys()
    np.testing.assert_allclose(
        found.pop("features"), expected.pop("features"), rtol=1e-6, atol=FEATURE_TOLERANCE
    )
    assert found["hits"]
    assert found["heat"].any()
    assert found["heat"].dtype == expected["heat"].dtype
    for name in ("windows", "hits"):
        assert found.get(name) == expected.get(name)
    np.testing.assert_array_equal(found["heat"], expected["heat"])
    for image, other in zip(found["drawn"], expected["drawn"], strict=True):
        np.testing.assert_allclose(image, other, rtol=1e-6)
